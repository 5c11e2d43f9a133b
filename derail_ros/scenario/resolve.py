"""From the fields of a scenario to a train: types looked up, gaps filled, contradictions refused.

What a single field may hold is checked in ``schema.py``; here is what takes several to judge.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

from derail_ros import models
from derail_ros.scenario.errors import Refusal
from derail_ros.scenario.messages import did_you_mean, shown
from derail_ros.scenario.rolling_stock import RollingStock, check_car_type
from derail_ros.scenario.schema import (
    MAX_CARS,
    Brakes,
    BrakeSpec,
    CarType,
    ConsistBlock,
    CouplerSpec,
    ScenarioModel,
    Section,
    engine_default,
    to_engine,
)
from derail_ros.scenario.second_tracks import check_pieces, segments, standing_cuts
from derail_ros.scenario.site import check_site, site_params
from derail_ros.scenario.strict_yaml import Path
from derail_ros.vocabulary.params import (
    GRAVITY,
    METHODS,
    BrakeParams,
    BrakeTrigger,
    BrakeUnit,
    Car,
    ContactParams,
    CouplerType,
    CouplingParams,
    DerailmentParams,
    DraftGearParams,
    GradeChange,
    GroundParams,
    InitiationParams,
    IntegrationParams,
    LateralForce,
    Notch,
    SecondTrack,
    StandingCut,
    TrackParams,
    TractionParams,
    TrainParams,
    WeakCoupling,
)
from derail_ros.vocabulary.train import TRAIN_COUNTS, length_over_couplers

KMH = 1.0 / 3.6
"""1 km/h in m/s."""

CYLINDER_RADIUS = 1.5
"""Radius of the solid cylinder whose yaw inertia stands in for a missing one, m [R]."""

SHORT_PIVOT_INSET = 0.34
LONG_PIVOT_INSET = 1.16
"""Body length less pivot distance where none is given, with couplers as short as the F79 and as
long as the F73, m [R]: in the consist of the source these lie deeper within the body."""

LONG_COUPLER = 1.3
"""Coupler length that tells the two apart, m."""

LEAST_LOAD = 0.1
"""Share of its load from which a car counts as loaded."""

DEVICE_SHARE = 0.2
"""Share of its load below which an empty/load device is in its empty position, assumed."""

SHOE_FRICTION = 0.21 * 19.223 / 9.388
"""Friction of a composition shoe near rest, 0.43: that of the brake law (``laws.brake``); 0.28 at
80 km/h, about 0.3 over a stop."""

JOINT = "ARTICULATED"
"""Coupler type between the platforms of an articulated car."""

PLATFORM_FIELDS = (
    "car",
    "count",
    "name",
    "contents",
    "load",
    "front_coupler",
    "rear_coupler",
    "brake",
)
"""What may be given of an articulated car as a whole."""

DEFAULT_WIDTH = 2.6
"""Width of the body in collisions, m: 0.4 m less than real, which is part of the buffer."""


ADHESION = 0.25
EFFICIENCY = 0.82
"""Of a locomotive known by its power alone: tractive effort over weight at most, power at the
rail over that of the engine. Assumed."""

Curve = tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Block:
    """A block of the consist with nothing left open.

    Attributes
    ----------
    count : number of cars
    name, contents : labels
    mass : of one car, kg
    inertia : yaw inertia, kg m^2
    length, width : body, m
    pivots : between the coupler pivots, m
    trucks : between the truck pivots, m
    front, rear : names of the coupler types
    coupler_inertia : kg m^2
    shoe, scale, delay : brake
    empty, loaded : mass empty and loaded, kg; None if not known
    load : share of the load, 0 to 1; None if not known
    locomotive : it is one
    brake : what was said of the brake, the type's with the block's over it
    axles : number of axles, where resistance counts them
    tractive_effort, dynamic_brake : largest effort over speed, (km/h, kN), where locomotives
        work
    """

    count: int
    name: str
    contents: str
    mass: float
    inertia: float
    length: float
    width: float
    pivots: float
    trucks: float
    front: str
    rear: str
    coupler_inertia: float
    shoe: str
    scale: float
    delay: float
    empty: float | None = None
    loaded: float | None = None
    load: float | None = None
    locomotive: bool = False
    brake: BrakeSpec = BrakeSpec()

    def coupled_length(self, couplers: dict[str, CouplerType]) -> float:
        """From pulling face to pulling face, m."""
        return couplers[self.front].length + self.pivots + couplers[self.rear].length

    axles: int = 0
    tractive_effort: Curve = ()
    dynamic_brake: Curve = ()


@dataclass(frozen=True)
class Resolved:
    """A scenario whose types are looked up and whose fields have been judged together.

    ``entries`` are the blocks of each entry of the consist: one, or those of an articulated car;
    ``cuts`` the same of each cut of standing cars.
    """

    model: ScenarioModel
    entries: tuple[tuple[Block, ...], ...]
    couplers: dict[str, CouplerType]
    cuts: tuple[tuple[tuple[Block, ...], ...], ...] = ()

    @property
    def blocks(self) -> tuple[Block, ...]:
        """All blocks, from the first one back."""
        return tuple(block for entry in self.entries for block in entry)

    @property
    def cut_entries(self) -> tuple[tuple[Block, ...], ...]:
        """The entries of all cuts, one after the other."""
        return tuple(entry for cut in self.cuts for entry in cut)

    @property
    def n_cars(self) -> int:
        """Number of real cars."""
        return sum(block.count for block in self.blocks)

    def cars(self) -> Iterator[Block]:
        """The block of each car, from the first one back."""
        for block in self.blocks:
            for _ in range(block.count):
                yield block


def cylinder_inertia(mass: float, length: float) -> float:
    """Yaw inertia of a uniform solid cylinder, ``m (L^2/12 + r^2/4)`` with r = 1.5 m [R].

    Parameters
    ----------
    mass
        kg.
    length
        m.

    Returns
    -------
    float
        kg m^2.
    """
    return mass * (length * length / 12.0 + CYLINDER_RADIUS**2 / 4.0)


def resolve(model: ScenarioModel, stock: RollingStock) -> Resolved:
    """Look up the types, fill the gaps and check what belongs together.

    Raises
    ------
    Refusal
        With the path of the first mistake.
    """
    for name, kind in model.train.car_types.items():
        check_car_type(kind, ("train", "car_types", name))
    couplers = coupler_types(model, stock)
    entries = tuple(
        _entry(block, ("train", "consist", i), model, stock, couplers)
        for i, block in enumerate(model.train.consist)
    )
    cuts = tuple(
        tuple(
            _entry(block, ("site", "standing", j, "consist", i), model, stock, couplers)
            for i, block in enumerate(cut.consist)
        )
        for j, cut in enumerate(model.site.standing if model.site else ())
    )
    every = (*entries, *(entry for cut in cuts for entry in cut))
    used = {name for entry in every for block in entry for name in (block.front, block.rear)}
    kept = {name: couplers[name] for name in sorted(used)}
    resolved = Resolved(model, entries, kept, cuts)
    _check_counts(resolved)
    _check_numbers(resolved)
    _check_brakes(resolved)
    _check_integration(model)
    _check_track(resolved)
    _check_along(resolved)
    _check_derails(resolved)
    check_site(model)
    _standing(resolved)
    return resolved


# --- rolling stock ----------------------------------------------------------------------------


def coupler_types(model: ScenarioModel, stock: RollingStock) -> dict[str, CouplerType]:
    """Engine coupler types by name: the library's, with the scenario's changes and additions."""
    section = model.couplers
    specs: dict[str, CouplerSpec] = dict(stock.couplers)
    for name, spec in section.types.items():
        base = specs.get(name)
        specs[name] = spec if base is None else _overlay(base, spec)
    types = {}
    for name, spec in specs.items():
        path = ("couplers", "types", name)
        for key in ("head", "pivot_to_face_m", "pivot_to_striker_m", "striker_opening_m"):
            if getattr(spec, key) is None:
                raise Refusal((*path, key), "is required for a new coupler type")
        if spec.k1_N_per_m is None:
            raise Refusal((*path, "k1_N_per_m"), "is required for a new coupler type")
        if spec.pivot_to_striker_m >= spec.pivot_to_face_m:  # type: ignore[operator]
            reason = (
                f"must be below the coupler length, {shown(spec.pivot_to_face_m)} m, "
                f"got {shown(spec.pivot_to_striker_m)} m"
            )
            raise Refusal((*path, "pivot_to_striker_m"), reason)
        types[name] = CouplerType(
            name=name,
            head=spec.head,  # type: ignore[arg-type]
            length=spec.pivot_to_face_m,  # type: ignore[arg-type]
            striker_arm=spec.pivot_to_striker_m,  # type: ignore[arg-type]
            striker_opening=spec.striker_opening_m,  # type: ignore[arg-type]
            k1=spec.k1_N_per_m,
            k2=_first(section.k2_N_per_m, spec.k2_N_per_m, engine_default(CouplerType, "k2")),
            damping=_first(
                section.damping_N_s_per_m,
                spec.damping_N_s_per_m,
                engine_default(CouplerType, "damping"),
            ),
        )
    return types


def _overlay(base: Any, top: Any) -> Any:
    """``base`` with what is given in ``top``."""
    given = {k: v for k, v in top if v is not None}
    return base.model_copy(update=given)


def _first(*values: Any) -> Any:
    """The first value that is given."""
    return next((value for value in values if value is not None), None)


def _entry(
    block: ConsistBlock,
    path: Path,
    model: ScenarioModel,
    stock: RollingStock,
    couplers: dict[str, CouplerType],
) -> tuple[Block, ...]:
    """The blocks of an entry of the consist; an articulated car has one for each platform."""
    known = {**stock.cars, **model.train.car_types}
    kind: CarType | None = None
    if block.car is not None:
        kind = known.get(block.car)
        if kind is None:
            reason = f"unknown car type {block.car!r}{did_you_mean(block.car, known)}"
            raise Refusal((*path, "car"), reason)
    if kind is None or not kind.platforms:
        return (_block(block, kind, path, model, couplers),)
    for key in type(block).model_fields:
        if key not in PLATFORM_FIELDS and getattr(block, key) != ConsistBlock().__dict__[key]:
            reason = f"{block.car!r} has platforms: give it by their types, {kind.platforms[0]!r}"
            raise Refusal((*path, key), reason)
    last = len(kind.platforms) - 1
    parts = []
    for i, name in enumerate(kind.platforms):
        part = known.get(name)
        if part is None or part.platforms:
            raise Refusal((*path, "car"), f"platform {name!r} of {block.car!r} is no car type")
        ends = {
            "front_coupler": JOINT if i else block.front_coupler,
            "rear_coupler": JOINT if i < last else block.rear_coupler,
        }
        label = f"{block.name or kind.title or block.car}, platform {i + 1}"
        one = block.model_copy(update={"car": name, "count": 1, "name": label[:60], **ends})
        parts.append(_block(one, part, path, model, couplers))
    return tuple(parts) * block.count


def _block(
    block: ConsistBlock,
    kind: CarType | None,
    path: Path,
    model: ScenarioModel,
    couplers: dict[str, CouplerType],
) -> Block:

    def value(key: str, needed: bool = False) -> Any:
        found = _first(getattr(block, key), getattr(kind, key, None))
        if found is None and needed:
            raise Refusal((*path, key), "is required where no car type gives it")
        return found

    def coupler(key: str) -> str:
        name = getattr(block, key)
        place = (*path, key)
        if name is None:
            name = value("coupler", needed=True)
            place = (*path, "coupler")
        if name not in couplers:
            raise Refusal(place, f"unknown coupler type {name!r}{did_you_mean(name, couplers)}")
        return str(name)

    front, rear = coupler("front_coupler"), coupler("rear_coupler")
    length, pivots = _lengths(block, kind, path, couplers[front], couplers[rear])
    trucks = value("truck_centres_m", needed=True)
    empty, loaded = value("empty_mass_kg"), value("loaded_mass_kg")
    mass, load = _mass(block, kind, empty, loaded, path)
    brake: BrakeSpec = _overlay(kind.brake if kind else BrakeSpec(), block.brake)
    result = Block(
        count=block.count,
        name=_first(block.name, (kind.title or block.car) if kind else None, ""),
        contents=block.contents or "",
        mass=mass,
        inertia=_inertia(block, kind, mass, length),
        length=length,
        width=_first(value("width_m"), DEFAULT_WIDTH),
        pivots=pivots,
        trucks=trucks,
        front=front,
        rear=rear,
        coupler_inertia=_first(block.coupler_inertia_kg_m2, model.couplers.inertia_kg_m2),
        shoe=_first(brake.shoe, engine_default(BrakeUnit, "shoe")),
        scale=_first(brake.scale, 1.0),
        delay=_first(brake.delay_s, engine_default(BrakeUnit, "delay")),
        empty=empty,
        loaded=loaded,
        load=load,
        locomotive=bool(value("locomotive")),
        brake=brake,
        **_along(block, kind, mass, model),
    )
    _check_block(result, path, couplers)
    return result


def fcalc(mass: float, axles: int, area: float) -> tuple[float, float, float]:
    """Constants of the resistance ``r0 + r1 v + r2 v^2`` (N, v in m/s) of a car by FCalc.

    FCalc is CN's formula of the AREMA form: 1.65 lb a ton, 18.1 lb an axle, 0.0165 lb a ton and
    mile/h, 0.0005 lb a square foot and (mile/h)^2. ``mass`` in kg, ``area`` in m^2.
    """
    short_tons = mass / 907.185
    return 7.355 * short_tons + 80.625 * axles, 0.1645 * short_tons, 0.1198 * area


def _curve(points: Curve) -> Curve:
    """Effort over speed in (m/s, N), from (km/h, kN)."""
    return tuple((speed * KMH, force * 1e3) for speed, force in points)


def _along(
    block: ConsistBlock, kind: CarType | None, mass: float, model: ScenarioModel
) -> dict[str, Any]:
    """What a car needs for the forces along the track that are on."""

    def value(key: str) -> Any:
        return _first(getattr(block, key), getattr(kind, key, None))

    along: dict[str, Any] = {}
    if model.resistance.law != "none":
        along["axles"] = _first(value("axles"), model.resistance.axles)
    if model.traction.notch or model.traction.schedule:
        effort = value("tractive_effort_kmh_kN")
        power = kind.power_kW if kind is not None else None
        known = effort or () if effort or not power else _effort_of_power(power, mass)
        along["tractive_effort"] = known
        along["dynamic_brake"] = value("dynamic_brake_kmh_kN") or ()
    return along


def _effort_of_power(power_kW: float, mass: float) -> Curve:
    """Largest tractive effort over speed of a locomotive of which the power is known."""
    power, most = EFFICIENCY * power_kW, 1e-3 * ADHESION * mass * GRAVITY
    speeds = [v for k in range(20) if (v := power / most * 1.15**k) < 100.0]  # m/s
    points = [(round(v / KMH, 3), round(power / v, 3)) for v in speeds]
    return ((0.0, points[0][1]), *points)


def _lengths(
    block: ConsistBlock,
    kind: CarType | None,
    path: Path,
    front: CouplerType,
    rear: CouplerType,
) -> tuple[float, float]:
    """Length of the body and distance between the coupler pivots, m.

    The pivots follow from the length over couplers, which is the pitch of the cars in the train;
    where only one of body and pivots is given, the body overhangs the pivots as in the type.
    """
    faces = front.length + rear.length
    inset = (
        LONG_PIVOT_INSET if max(front.length, rear.length) > LONG_COUPLER else SHORT_PIVOT_INSET
    )
    body: float | None = None
    pivots: float | None = None
    if kind is not None:  # of the type as it is
        body, pivots = kind.length_m, kind.coupler_pivots_m
        if kind.length_over_couplers_m is not None:
            pivots = kind.length_over_couplers_m - faces
        if body is not None and pivots is not None:
            inset = body - pivots
        elif pivots is not None:
            body = pivots + inset
    if block.length_over_couplers_m is not None:
        if block.coupler_pivots_m is not None:
            reason = "coupler_pivots_m is given too: give one of the two"
            raise Refusal((*path, "length_over_couplers_m"), reason)
        pivots = block.length_over_couplers_m - faces
        return _first(block.length_m, pivots + inset), pivots
    if block.length_m is not None:
        moved = kind is not None and kind.length_over_couplers_m is not None
        pivots, body = (None if moved else pivots), block.length_m
    if body is None:
        raise Refusal((*path, "length_m"), "is required where no car type gives it")
    return body, _first(block.coupler_pivots_m, pivots, body - inset)


def _mass(
    block: ConsistBlock,
    kind: CarType | None,
    empty: float | None,
    loaded: float | None,
    path: Path,
) -> tuple[float, float | None]:
    """Mass of one car, kg: given, of its type, or between empty and loaded; and its load."""
    if empty is not None and loaded is not None and empty > loaded:
        reason = f"must not be above loaded_mass_kg, {shown(loaded)} kg, got {shown(empty)} kg"
        raise Refusal((*path, "empty_mass_kg"), reason)
    if block.mass_kg is not None:
        if block.load is not None:
            raise Refusal((*path, "load"), "mass_kg is given too: give one of the two")
        if empty is None or loaded is None or empty == loaded:
            return block.mass_kg, None
        return block.mass_kg, min(max((block.mass_kg - empty) / (loaded - empty), 0.0), 1.0)
    if empty is None and loaded is None:
        if kind is None:
            raise Refusal((*path, "mass_kg"), "is required where no car type gives it")
        if block.load is not None:
            raise Refusal((*path, "load"), f"car type {block.car!r} has no empty and loaded mass")
        assert kind.mass_kg is not None  # check_car_type has seen to it
        return kind.mass_kg, None
    load = float(_first(block.load, 1.0))
    for share, key, mass in (
        (load, "loaded_mass_kg", loaded),
        (1.0 - load, "empty_mass_kg", empty),
    ):
        if share > 0.0 and mass is None:
            raise Refusal((*path, key), f"is required with load {shown(load)}")
    if empty is None or loaded is None:
        return float(_first(empty, loaded)), load
    return float(empty + load * (loaded - empty)), load


def _inertia(block: ConsistBlock, kind: CarType | None, mass: float, length: float) -> float:
    """Yaw inertia of one car, kg m^2."""
    if block.inertia_kg_m2 is not None:
        return block.inertia_kg_m2
    if kind is not None and kind.inertia_kg_m2 is not None and length == kind.length_m:
        full = _first(kind.mass_kg, kind.loaded_mass_kg)
        if full is not None:
            return float(kind.inertia_kg_m2 * (mass / full))
    return cylinder_inertia(mass, length)


def _check_block(block: Block, path: Path, couplers: dict[str, CouplerType]) -> None:
    if block.pivots <= 0.0:
        reason = f"the body of {shown(block.length)} m is too short for coupler {block.front!r}"
        raise Refusal((*path, "length_m"), reason)
    if block.pivots > block.length:
        reason = f"coupler pivots beyond the body: {_over(block.pivots, block.length)}"
        raise Refusal((*path, "coupler_pivots_m"), reason)
    if block.trucks >= block.length:
        reason = f"trucks beyond the body: {_over(block.trucks, block.length)}"
        raise Refusal((*path, "truck_centres_m"), reason)
    overhang = 0.5 * (block.length - block.pivots)
    for key, name in (("front_coupler", block.front), ("rear_coupler", block.rear)):
        if couplers[name].length <= overhang:
            reason = (
                f"coupler {name!r} of {shown(couplers[name].length)} m is shorter than the "
                f"overhang of {shown(overhang)} m beyond its pivot"
            )
            raise Refusal((*path, key), reason)
    # all of the mass at the ends of the body would give this much
    most = block.mass * (block.length**2 + block.width**2) / 4.0
    if block.inertia > most:
        reason = (
            f"{shown(block.inertia)} kg m2 is more than {shown(block.mass)} kg within "
            f"{shown(block.length)} m can have ({most:.4g} kg m2)"
        )
        raise Refusal((*path, "inertia_kg_m2"), reason)


def _over(distance: float, length: float) -> str:
    return f"{shown(distance)} m on a length of {shown(length)} m"


# --- checks across sections -------------------------------------------------------------------


def _check_counts(resolved: Resolved) -> None:
    total = 0
    for i, entry in enumerate(resolved.entries):
        total += sum(block.count for block in entry)
        if total > MAX_CARS:
            reason = f"the train has {resolved.n_cars} cars, the limit is {MAX_CARS}"
            raise Refusal(("train", "consist", i, "count"), reason)
    start = resolved.model.train.virtual_from
    if start is not None and start >= total:
        reason = f"must be below the number of cars, {total}, to leave two or more, got {start}"
        raise Refusal(("train", "virtual_from"), reason)


def _check_numbers(resolved: Resolved) -> None:
    """Car numbers that do not exist, or stand within the virtual body."""
    model = resolved.model
    total = resolved.n_cars
    modelled = (model.train.virtual_from or total + 1) - 1

    def check(path: Path, number: int | None, last: int, what: str) -> None:
        if number is not None and number > last:
            raise Refusal(path, f"there is no {what} {number}, the last one is {last}")

    start = model.initiation
    word = "car" if modelled == total else "modelled car"
    for i, truck in enumerate(start.derailed_trucks):
        check(("initiation", "derailed_trucks", i, "car"), truck.car, modelled, word)
    bodies = modelled + (modelled < total)
    for i, coupling in enumerate(start.parted_couplings):
        path = ("initiation", "parted_couplings", i)
        if bodies == 1:
            raise Refusal(path, "a single car has no coupling")
        check(path, coupling, bodies - 1, "coupling")
    if start.lateral_force_N != 0.0:
        check(("initiation", "lateral_force_car"), start.lateral_force_car, modelled, word)
    for i, force in enumerate(start.lateral_forces):
        check(("initiation", "lateral_forces", i, "car"), force.car, modelled, word)
    for i, number in enumerate(model.track.rail_breaks_under_cars):
        check(("track", "rail_breaks_under_cars", i), number, modelled, word)
    word = "car" if modelled == total else "body"
    check(("brakes", "signal_car"), model.brakes.signal_car, bodies, word)
    for i, trigger in enumerate(model.brakes.triggers):
        check(("brakes", "triggers", i, "car"), trigger.car, bodies, word)
    for i, number in enumerate(model.brakes.remote_locomotives):
        check(("brakes", "remote_locomotives", i), number, total, "car")


def _check_brakes(resolved: Resolved) -> None:
    model = resolved.model
    brakes = model.brakes
    if brakes.remote_locomotives and brakes.system != "distributed_power":
        path: Path = ("brakes", "remote_locomotives")
        raise Refusal(path, f"only goes with system distributed_power, got {brakes.system}")
    if brakes.system == "distributed_power" and not _remote_cars(resolved):
        reason = "is required: no locomotive stands behind the head of the train"
        raise Refusal(("brakes", "remote_locomotives"), reason)
    if brakes.signal_source == "car" and brakes.signal_car is None:
        raise Refusal(("brakes", "signal_car"), "is required with signal_source car")
    if brakes.signal_source != "car" and brakes.signal_car is not None:
        raise Refusal(("brakes", "signal_car"), "only goes with signal_source car")
    for i, trigger in enumerate(brakes.triggers):
        path = ("brakes", "triggers", i, "car")
        if trigger.source == "car" and trigger.car is None:
            raise Refusal(path, "is required with source car")
        if trigger.source != "car" and trigger.car is not None:
            raise Refusal(path, "only goes with source car")


def _check_integration(model: ScenarioModel) -> None:
    integration, contact = model.integration, model.contact
    if model.model not in models.names():
        reason = f"must be one of {', '.join(models.names())}, got {model.model}"
        raise Refusal(("model",), reason)
    if integration.method not in METHODS:
        reason = f"must be one of {', '.join(METHODS)}, got {integration.method!r}"
        raise Refusal(("integration", "method"), reason)
    if integration.min_step_s >= integration.max_step_s:
        reason = f"must be below max_step_s, {shown(integration.max_step_s)} s"
        raise Refusal(("integration", "min_step_s"), reason)
    if contact.end_force_N > contact.begin_force_N:
        reason = f"must not be above begin_force_N, {shown(contact.begin_force_N)} N"
        raise Refusal(("contact", "end_force_N"), reason)
    if contact.half_distance_m > contact.buffer_m:
        reason = f"must not be above buffer_m, {shown(contact.buffer_m)} m"
        raise Refusal(("contact", "half_distance_m"), reason)


def _check_track(resolved: Resolved) -> None:
    """The alignment's pieces, and the train and the breaks within its ends."""
    track = resolved.model.track
    if not track.alignment:
        for key in ("start_coordinate_m", "start_x_m", "start_y_m", "start_heading_rad"):
            if getattr(track, key) != 0.0:
                raise Refusal(("track", key), "has no effect without track.alignment")
        return
    check_pieces(track.alignment, ("track", "alignment"))
    begin = track.start_coordinate_m
    end = begin + sum(segment.length for segment in segments(track.alignment))
    train = placed_bodies(resolved)
    centre = resolved.model.initiation.position_m
    front = centre + 0.5 * train[0][1].trucks
    rear = centre - train[-1][0] - 0.5 * train[-1][1].trucks
    for place, what in ((front, "front"), (rear, "rear")):
        if not begin <= place <= end:
            reason = (
                f"the {what} truck of the train would stand at {place:.1f} m, the track runs "
                f"from {begin:.1f} to {end:.1f} m"
            )
            raise Refusal(("initiation", "position_m"), reason)
    for i, place in enumerate(track.rail_breaks):
        if not begin <= place <= end:
            reason = f"lies outside the track, which runs from {begin:.1f} to {end:.1f} m"
            raise Refusal(("track", "rail_breaks", i), reason)


def _check_along(resolved: Resolved) -> None:
    """Grades, settings of locomotives and strengths of couplings."""
    model = resolved.model
    end = -math.inf
    for i, change in enumerate(model.track.grades):
        path: Path = ("track", "grades", i)
        if change.from_m is None:
            if i:
                raise Refusal((*path, "from_m"), "is required for all but the first")
            continue
        half = 0.5 * change.vertical_curve_m
        if change.from_m - half < end:
            reason = (
                f"must be {shown(end + half)} m or more, where the vertical curve before it ends"
            )
            raise Refusal((*path, "from_m"), reason)
        end = change.from_m + half
    traction = model.traction
    cars = list(resolved.cars())
    engines = [i for i, car in enumerate(cars, 1) if car.tractive_effort or car.dynamic_brake]
    given: list[tuple[Path, int]] = [(("traction", "notch"), traction.notch)]
    before = 0.0
    for i, spec in enumerate(traction.schedule):
        path = ("traction", "schedule", i)
        if spec.time_s < before:
            raise Refusal((*path, "time_s"), f"must not be before the last, {shown(before)} s")
        before = spec.time_s
        for j, number in enumerate(spec.cars):
            if number not in engines:
                reason = f"car {number} is no locomotive of the train"
                raise Refusal((*path, "cars", j), reason)
        given.append(((*path, "notch"), spec.notch))
    for path, notch in given:
        key = "tractive_effort" if notch > 0 else "dynamic_brake"
        if notch and not any(getattr(car, key) for car in cars):
            raise Refusal(path, f"no car of the train has {key}_kmh_kN")
    start = model.train.virtual_from
    if start is not None and any(number >= start for number in engines):
        used = traction.notch or traction.schedule
        if used:
            raise Refusal(("train", "virtual_from"), "a virtual body holds a locomotive at work")
    bodies = len(cars) if start is None else start
    for i, weak in enumerate(model.couplers.weak):
        if weak.coupling >= bodies:
            reason = f"there is no coupling {weak.coupling}, the last one is {bodies - 1}"
            raise Refusal(("couplers", "weak", i, "coupling"), reason)


def _check_derails(resolved: Resolved) -> None:
    """Whether anything can leave the rails at all."""
    model = resolved.model
    start = model.initiation
    if start.await_command or start.derailed_trucks:
        return
    if any(_strengths(model)) or model.couplers.weak:
        return  # a train that parts
    if any(piece.tangent is None for piece in model.track.alignment):
        return  # a curve may overturn the rail without further help
    bodies = placed_bodies(resolved)
    if model.train.virtual_from is not None:
        bodies = bodies[:-1]
    last_truck = start.position_m - bodies[-1][0] - 0.5 * bodies[-1][1].trucks
    if any(place >= last_truck for place in rail_breaks(resolved)):
        return
    for force in _lateral_forces(model):
        weight = bodies[force.car - 1][1].mass * GRAVITY
        share = 0.5 if force.place == "centre" else 1.0
        if abs(force.force) * share > model.derailment.lv_limit * 0.5 * weight:
            return
    reason = (
        "nothing to derail: no truck is derailed, no rail break lies ahead of the last truck, no "
        "lateral force is above the derailment quotient, and the track is straight "
        "(initiation.await_command accepts that)"
    )
    raise Refusal(("initiation",), reason)


def placed_bodies(resolved: Resolved) -> list[tuple[float, Block]]:
    """Distance behind the centre of car 1 (m) and block of each body."""
    cars = list(_distances(resolved))
    start = resolved.model.train.virtual_from
    return cars if start is None else cars[:start]


# --- to the engine ----------------------------------------------------------------------------


def _distances(resolved: Resolved) -> Iterator[tuple[float, Block]]:
    """Arc length behind the centre of car 1 (m) and block of each real car."""
    distance = 0.0
    ahead: Block | None = None
    for block in resolved.cars():
        if ahead is not None:
            couplers = resolved.couplers[ahead.rear].length + resolved.couplers[block.front].length
            distance += 0.5 * ahead.pivots + couplers + 0.5 * block.pivots
        yield distance, block
        ahead = block


def _remote_cars(resolved: Resolved) -> tuple[int, ...]:
    """Numbers of the cars at which distributed power vents the pipe, from 1."""
    given = resolved.model.brakes.remote_locomotives
    if given:
        return tuple(sorted(set(given)))
    power = [block.locomotive for block in resolved.cars()]
    return tuple(i + 1 for i in range(1, len(power)) if power[i] and not power[i - 1])


def _remote(resolved: Resolved) -> tuple[float, ...]:
    """Places that the radio orders to vent, as arc length behind the centre of car 1, m."""
    system = resolved.model.brakes.system
    distances = [distance for distance, _ in _distances(resolved)]
    if system == "two_way_eot":
        return (distances[-1],)
    if system == "distributed_power":
        return tuple(distances[number - 1] for number in _remote_cars(resolved))
    return ()


def _brake_unit(block: Block, distance: float, brakes: Brakes) -> BrakeUnit:
    """The brake of one car.

    By the law of braking ratios its full emergency force near rest is the net braking ratio of
    its load state, times the weight in that state, the emergency factor and the friction of the
    shoe near rest. Without an empty/load device the shoes press as on the loaded car.
    """
    spec, scale = block.brake, block.scale * brakes.force_scale
    if brakes.system == "ecp":
        scale *= brakes.ecp_ratio_factor
    full = _first(block.loaded, block.mass)
    force = None
    if spec.cut_out:
        force = 0.0
    elif brakes.law == "braking_ratio":
        light = block.load is not None and block.load < DEVICE_SHARE and not block.locomotive
        if light and spec.empty_load_device is not False:
            ratio = _first(spec.net_braking_ratio_empty, brakes.net_braking_ratio_empty)
            weight = _first(block.empty, block.mass)
        else:
            ratio = _first(spec.net_braking_ratio_loaded, brakes.net_braking_ratio_loaded)
            weight = full
        force = ratio * weight * GRAVITY * brakes.emergency_factor * SHOE_FRICTION * scale
    hand = 0.0
    if spec.hand_brake:
        hand = brakes.hand_brake_ratio * full * GRAVITY * SHOE_FRICTION
    weight = 0.0 if spec.cut_out else block.mass
    return BrakeUnit(distance, block.shoe, scale, block.delay, weight, force, hand)


def _mode(instant: bool, traction_limited: bool) -> str:
    words = ["instant"] * instant + ["traction_limited"] * traction_limited
    return "_".join(words) or "conventional"


def rail_breaks(resolved: Resolved) -> tuple[float, ...]:
    """Track coordinates of all breaks, m, rising."""
    model = resolved.model
    breaks = list(model.track.rail_breaks)
    if model.track.rail_breaks_under_cars:
        cars = list(_distances(resolved))
        for number in model.track.rail_breaks_under_cars:
            distance, block = cars[number - 1]
            truck = model.initiation.position_m - distance + 0.5 * block.trucks
            breaks.append(truck + model.derailment.break_ahead_of_truck_m)
    return tuple(sorted(breaks))


def _lateral_forces(model: ScenarioModel) -> tuple[LateralForce, ...]:
    start = model.initiation
    forces = [
        LateralForce(
            start.lateral_force_N,
            start.lateral_force_car,
            start.lateral_force_place,
            start.lateral_force_start_s,
            start.lateral_force_duration_s,
        )
    ]
    forces += [
        LateralForce(f.force_N, f.car, f.place, f.start_s, f.duration_s)
        for f in start.lateral_forces
    ]
    return tuple(force for force in forces if force.force != 0.0)


def derailed_trucks(model: ScenarioModel) -> tuple[tuple[int, str], ...]:
    """``(car number, "front" | "rear")`` of each truck derailed from the start, each once."""
    trucks = {
        (truck.car, end)
        for truck in model.initiation.derailed_trucks
        for end in (("front", "rear") if truck.truck == "both" else (truck.truck,))
    }
    return tuple(sorted(trucks))


def _strengths(model: ScenarioModel) -> tuple[float | None, float | None]:
    return model.couplers.knuckle_strength_N, model.couplers.body_strength_N


STARTS = {"stretched": 1.0, "middle": 0.0, "bunched": -1.0}


def _couplings(model: ScenarioModel) -> CouplingParams:
    """What couplings do along the train."""
    gear = DraftGearParams()
    if (given := model.couplers.draft_gear) is not None:
        gear = DraftGearParams(
            on=True, start=STARTS[given.start], **to_engine(given, DraftGearParams)
        )
    knuckle, body = (value or 0.0 for value in _strengths(model))
    weak = (WeakCoupling(w.coupling, w.strength_N, w.part) for w in model.couplers.weak)
    return CouplingParams(gear, knuckle, body, tuple(weak))


def _traction(model: ScenarioModel) -> TractionParams:
    """Settings of the locomotives."""
    traction = model.traction
    notches = [Notch(0.0, traction.notch)] if traction.notch else []
    notches += [Notch(n.time_s, n.notch, n.cars) for n in traction.schedule]
    return TractionParams(tuple(notches), **to_engine(traction, TractionParams))


def train_params(resolved: Resolved) -> TrainParams:
    """The engine's parameters (SI units) of a resolved scenario."""
    model = resolved.model
    cuts, tracks, standing = _standing(resolved)
    return TrainParams(
        cars=(*_cars(resolved), *(car for cut in cuts for car in cut)),
        initiation=InitiationParams(
            speed=model.train.speed_kmh * KMH,
            position=model.initiation.position_m,
            derailed_trucks=derailed_trucks(model),
            parted_couplings=tuple(sorted(set(model.initiation.parted_couplings))),
            lateral_forces=_lateral_forces(model),
        ),
        track=replace(
            _line(model),
            rail_breaks=rail_breaks(resolved),
            grades=tuple(
                GradeChange(
                    _first(g.from_m, -math.inf), 0.01 * g.grade_percent, g.vertical_curve_m
                )
                for g in model.track.grades
            ),
        ),
        brakes=BrakeParams(
            triggers=_triggers(model),
            remote=_remote(resolved),
            **{**to_engine(model.brakes, BrakeParams), **_build_up(model.brakes)},
        ),
        ground=_copy(model.ground, GroundParams),
        contact=_copy(model.contact, ContactParams),
        derailment=_copy(model.derailment, DerailmentParams),
        integration=_copy(model.integration, IntegrationParams),
        model=model.model,
        traction=_traction(model),
        couplings=_couplings(model),
        site=site_params(model),
        tracks=tracks,
        standing=standing,
    )


def _line(model: ScenarioModel) -> TrackParams:
    """The centre line of the main track."""
    return TrackParams(
        segments=tuple(segments(model.track.alignment)), **to_engine(model.track, TrackParams)
    )


def _standing(
    resolved: Resolved,
) -> tuple[list[list[Car]], tuple[SecondTrack, ...], tuple[StandingCut, ...]]:
    """Cars that stand on second tracks, by their cuts, and these."""
    model = resolved.model
    if model.site is None or not (model.site.tracks or model.site.standing):
        return [], (), ()
    if model.site.standing and model.train.virtual_from is not None:
        reason = "the train has a body that stands for many cars (train.virtual_from)"
        raise Refusal(("site", "standing"), reason)
    brakes = model.brakes
    cuts = [
        [
            _car(resolved, block, replace(_brake_unit(block, 0.0, brakes), scale=0.0, force=0.0))
            for entry in entries
            for block in entry
            for _ in range(block.count)
        ]
        for entries in resolved.cuts
    ]
    if resolved.n_cars + sum(map(len, cuts)) > MAX_CARS:
        raise Refusal(("site", "standing"), f"with these there are more than {MAX_CARS} cars")
    widest = max(block.width for block in resolved.blocks)
    return cuts, *standing_cuts(model.site, cuts, _line(model), widest)


def _build_up(brakes: Brakes) -> dict[str, float]:
    """The build-up of ECP brakes in place of that of the others."""
    return {"rise_time": brakes.ecp_rise_time_s} if brakes.system == "ecp" else {}


def _copy(section: Section, owner: type[Any]) -> Any:
    return owner(**to_engine(section, owner))


def _triggers(model: ScenarioModel) -> tuple[BrakeTrigger, ...]:
    brakes = model.brakes
    triggers = []
    if brakes.signal_source != "none":
        triggers.append(
            BrakeTrigger(
                source=brakes.signal_source,
                car=brakes.signal_car or 0,
                mode=_mode(brakes.instant, brakes.traction_limited),
                delay=brakes.delay_s,
            )
        )
    triggers += [
        BrakeTrigger(
            time=t.time_s,
            source=t.source,
            car=t.car or 0,
            mode=_mode(t.instant, t.traction_limited),
            delay=t.delay_s,
        )
        for t in brakes.triggers
    ]
    return tuple(triggers)


def _cars(resolved: Resolved) -> tuple[Car, ...]:
    """Bodies of the train; the last one may stand for several cars."""
    brakes = resolved.model.brakes
    cars = [
        _car(resolved, block, _brake_unit(block, distance, brakes))
        for distance, block in _distances(resolved)
    ]
    start = resolved.model.train.virtual_from
    if start is None:
        return tuple(cars)
    return (*cars[: start - 1], _virtual_body(cars[start - 1 :]))


def _car(resolved: Resolved, block: Block, unit: BrakeUnit) -> Car:
    """One car of a block, with its brake."""
    resistance = resolved.model.resistance
    counts = block.load is not None and not block.locomotive
    level = (0.0, 0.0, 0.0)
    if resistance.law == "fcalc":
        level = fcalc(block.mass, block.axles, resistance.area_m2)
    return Car(
        mass=block.mass,
        inertia=block.inertia,
        length=block.length,
        width=block.width,
        pivot_distance=0.5 * block.pivots,
        truck_distance=0.5 * block.trucks,
        front=resolved.couplers[block.front],
        rear=resolved.couplers[block.rear],
        coupler_inertia=block.coupler_inertia,
        brakes=(unit,),
        name=block.name,
        contents=block.contents,
        locomotives=int(block.locomotive),
        loads=int(counts and block.load >= LEAST_LOAD),  # type: ignore[operator]
        empties=int(counts and block.load < LEAST_LOAD),  # type: ignore[operator]
        resistance=level,
        tractive_effort=_curve(block.tractive_effort),
        dynamic_brake=_curve(block.dynamic_brake),
    )


def _virtual_body(cars: list[Car]) -> Car:
    """One body in the place of the first of these cars, with the mass and the brakes of all."""
    first = cars[0]
    return Car(
        mass=math.fsum(car.mass for car in cars),
        inertia=math.fsum(car.inertia for car in cars),
        length=first.length,
        width=first.width,
        pivot_distance=first.pivot_distance,
        truck_distance=first.truck_distance,
        front=first.front,
        rear=first.rear,
        coupler_inertia=first.coupler_inertia,
        brakes=tuple(unit for car in cars for unit in car.brakes),
        represents=len(cars),
        resistance=tuple(map(math.fsum, zip(*(car.resistance for car in cars)))),  # type: ignore[arg-type]
        name=f"{len(cars)} virtual cars",
        **{key: sum(getattr(car, key) for car in cars) for key in TRAIN_COUNTS},
        coupled_length=math.fsum(length_over_couplers(car) for car in cars),
    )
