"""From parameters to the arrays of a run: validation, the model, the initial state."""

from __future__ import annotations

import functools
import math

import numpy as np
from numpy.typing import NDArray

from derail_ros.engine import layout
from derail_ros.engine.arrays import Model, Rows, State
from derail_ros.engine.laws.contact import GAP_LAWS, INSIDE, reach
from derail_ros.engine.laws.joint import top_angle
from derail_ros.engine.laws.knuckle import POLYNOMIALS, pair_of_heads, polynomial_root
from derail_ros.engine.methods import METHODS
from derail_ros.engine.negotiability import free_swing
from derail_ros.engine.site import check_site, refuse_overlap, site_state, site_tables
from derail_ros.engine.standing import (
    car_lines,
    check_standing,
    cuts,
    position_field,
    refuse_touching,
    side_lines,
    side_rows,
    side_swing,
)
from derail_ros.engine.track import Track
from derail_ros.vocabulary.errors import ParameterError
from derail_ros.vocabulary.params import (
    BRAKE_SYSTEMS,
    GRAVITY,
    Car,
    CouplerType,
    TrackParams,
    TractionParams,
    TrainParams,
)
from derail_ros.vocabulary.status import BRAKE_MODES, BRAKE_SOURCES, ENDS

F64 = NDArray[np.float64]

SHOES = {"none": 0.0, "composition": 1.0, "cast_iron": 2.0}
STABILIZATIONS = {"projection": 1.0, "baumgarte": 0.0}
ARRIVALS = dict(
    zip(BRAKE_MODES, (layout.ARR_CONV, layout.ARR_INST, layout.ARR_TL, layout.ARR_INST_TL))
)
MAX_CARS = 5000
ARTICULATED = "ARTICULATED"
"""Coupler type of the joints within an articulated car."""
PARTS = ("knuckle", "body")
"""Parts of a coupling that break, by their numbers in LINK."""


def require(condition: bool, field: str, reason: str) -> None:
    """Raise a `ParameterError` unless the condition holds."""
    if not condition:
        raise ParameterError(field, reason)


def finite(value: float, field: str, low: float = -math.inf, high: float = math.inf) -> float:
    """A finite number within ``[low, high]``."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise ParameterError(field, f"must be a number, not {value!r}") from None
    require(math.isfinite(number), field, f"must be finite, not {number}")
    if not low <= number <= high:
        if math.isinf(high):
            raise ParameterError(field, f"must be at least {low:g}, not {number:g}")
        raise ParameterError(field, f"must lie within {low:g} and {high:g}, not {number:g}")
    return number


def positive(value: float, field: str) -> float:
    """A finite number above 0."""
    number = finite(value, field)
    require(number > 0.0, field, f"must be above 0, not {number:g}")
    return number


def _check_coupler(c: CouplerType, where: str) -> None:
    require(c.head in ("E", "F"), f"{where}.head", f"must be 'E' or 'F', not {c.head!r}")
    for name in ("length", "striker_arm", "k1", "k2"):
        positive(getattr(c, name), f"{where}.{name}")
    for name in ("striker_opening", "damping"):
        finite(getattr(c, name), f"{where}.{name}", 0.0)


def _check_car(c: Car, where: str) -> None:
    for name in (
        "mass",
        "inertia",
        "length",
        "width",
        "pivot_distance",
        "truck_distance",
        "coupler_inertia",
    ):
        positive(getattr(c, name), f"{where}.{name}")
    finite(c.coupled_length, f"{where}.coupled_length", 0.0)
    _check_coupler(c.front, f"{where}.front")
    _check_coupler(c.rear, f"{where}.rear")
    half = 0.5 * c.length
    require(
        c.truck_distance <= half,
        f"{where}.truck_distance",
        f"{c.truck_distance:g} m puts the truck beyond the body's end at {half:g} m",
    )
    for end, coupler in (("front", c.front), ("rear", c.rear)):
        require(
            c.pivot_distance + coupler.length > half,
            f"{where}.{end}.length",
            f"{coupler.length:g} m does not reach from the pivot past the body's end "
            f"({half - c.pivot_distance:g} m away)",
        )
    require(
        isinstance(c.represents, int) and c.represents >= 1,
        f"{where}.represents",
        f"must be a whole number of cars from 1 on, not {c.represents!r}",
    )
    for j, unit in enumerate(c.brakes):
        at = f"{where}.brakes.{j}"
        require(unit.shoe in SHOES, f"{at}.shoe", f"must be one of {', '.join(SHOES)}")
        finite(unit.distance, f"{at}.distance")
        finite(unit.scale, f"{at}.scale", 0.0)
        finite(unit.delay, f"{at}.delay", 0.0)
        finite(unit.weight, f"{at}.weight", 0.0)
        finite(unit.hand, f"{at}.hand", 0.0)
        if unit.force is not None:
            finite(unit.force, f"{at}.force", 0.0)


_checked: dict[str, tuple[Car, ...]] = {}
"""The cars that were found right last: those of all members of an ensemble."""


def validate(params: TrainParams) -> None:
    """Refuse parameters that no run can be built from, naming the field and the reason."""
    cars = params.cars
    require(1 <= len(cars) <= MAX_CARS, "cars", f"must be 1 to {MAX_CARS} cars, not {len(cars)}")
    if not isinstance(cars, tuple) or cars is not _checked.get("cars"):
        for i, car in enumerate(cars):
            _check_car(car, f"cars.{i}")
            require(
                car.represents == 1 or i == len(cars) - 1,
                f"cars.{i}.represents",
                "only the last body may stand for several cars",
            )
        _checked["cars"] = cars
    check_standing(params)
    n = params.n_train
    g = params.ground
    for name in ("c_s", "c_d", "c_v", "scale"):
        finite(getattr(g, name), f"ground.{name}", 0.0)
    positive(g.eps, "ground.eps")
    c = params.contact
    for name in ("force_max", "half_distance", "buffer"):
        positive(getattr(c, name), f"contact.{name}")
    for name in ("c1", "c2", "c3", "begin_force", "end_force", "end_hold"):
        finite(getattr(c, name), f"contact.{name}", 0.0)
    for name, known in (("gap_law", GAP_LAWS), ("inside", INSIDE)):
        given = getattr(c, name)
        require(given in known, f"contact.{name}", f"must be one of {', '.join(known)}")
    require(
        c.end_force <= c.begin_force, "contact.end_force", "must not be above contact.begin_force"
    )
    b = params.brakes
    for name in ("force", "rise_time", "traction_coefficient"):
        finite(getattr(b, name), f"brakes.{name}", 0.0)
    positive(b.signal_speed, "brakes.signal_speed")
    finite(b.radio_delay, "brakes.radio_delay", 0.0)
    require(
        b.system in BRAKE_SYSTEMS, "brakes.system", f"must be one of {', '.join(BRAKE_SYSTEMS)}"
    )
    for j, place in enumerate(b.remote):
        finite(place, f"brakes.remote.{j}", 0.0)
    for j, trigger in enumerate(b.triggers):
        check_trigger(
            trigger.mode, trigger.source, trigger.car, trigger.delay, n,
            f"brakes.triggers.{j}",
        )  # fmt: skip
        finite(trigger.time, f"brakes.triggers.{j}.time", 0.0)
    d = params.derailment
    positive(d.lv_limit, "derailment.lv_limit")
    for name in ("lv_hold", "truck_play", "guide_strength", "guide_play"):
        finite(getattr(d, name), f"derailment.{name}", 0.0)
    positive(d.guide_stiffness, "derailment.guide_stiffness")
    finite(d.break_ahead_of_truck, "derailment.break_ahead_of_truck", 0.0)
    for pair in POLYNOMIALS:
        name = f"knuckle_limit_{pair.lower()}"
        positive(getattr(d, name), f"derailment.{name}")
    m = params.integration
    require(m.method in METHODS, "integration.method", f"must be one of {', '.join(METHODS)}")
    finite(m.rtol, "integration.rtol", 1e-12, 1e-1)
    require(
        m.stabilization in STABILIZATIONS,
        "integration.stabilization",
        f"must be one of {', '.join(STABILIZATIONS)}",
    )
    for name in ("baumgarte_velocity", "baumgarte_position"):
        finite(getattr(m, name), f"integration.{name}", 0.0)
    for name in (
        "buffer_fraction",
        "max_step",
        "min_step",
        "rest_speed",
        "rest_yaw_rate",
        "rest_hold",
        "time_limit",
    ):
        positive(getattr(m, name), f"integration.{name}")
    # a contact must not rise and fall within one step
    finite(m.buffer_fraction, "integration.buffer_fraction", 0.0, 0.5)
    require(m.min_step < m.max_step, "integration.min_step", "must be below integration.max_step")
    finite(params.variant.moment_widening, "variant.moment_widening", 0.0)
    _check_along(params)
    check_site(params.site)
    start = params.initiation
    finite(start.speed, "initiation.speed", 0.0, 200.0)
    finite(start.position, "initiation.position")
    for j, (number, end) in enumerate(start.derailed_trucks):
        at = f"initiation.derailed_trucks.{j}"
        require(1 <= number <= n, at, f"there is no car {number}")
        require(end in ENDS, at, f"the end must be 'front' or 'rear', not {end!r}")
        require(cars[number - 1].represents == 1, at, "a virtual body never derails")
    for j, number in enumerate(start.parted_couplings):
        require(
            1 <= number < n,
            f"initiation.parted_couplings.{j}",
            f"there is no coupling between cars {number} and {number + 1}",
        )
    for j, force in enumerate(start.lateral_forces):
        at = f"initiation.lateral_forces.{j}"
        require(1 <= force.car <= n, f"{at}.car", f"there is no car {force.car}")
        require(
            force.place in ("front", "rear", "centre"),
            f"{at}.place",
            f"must be 'front', 'rear' or 'centre', not {force.place!r}",
        )
        finite(force.force, f"{at}.force")
        finite(force.start, f"{at}.start", 0.0)
        finite(force.duration, f"{at}.duration", 0.0)
    track = params.track
    for name in ("start_coordinate", "start_x", "start_y", "start_heading"):
        finite(getattr(track, name), f"track.{name}", -1e6, 1e6)
    for j, segment in enumerate(track.segments):
        positive(segment.length, f"track.segments.{j}.length")
        finite(segment.length, f"track.segments.{j}.length", 0.0, 1e6)
        for name in ("curvature_start", "curvature_end"):
            # R >= 10 m: nothing on rails turns more sharply
            finite(getattr(segment, name), f"track.segments.{j}.{name}", -0.1, 0.1)
    for j, s in enumerate(track.rail_breaks):
        finite(s, f"track.rail_breaks.{j}")


def _check_along(params: TrainParams) -> None:
    """What acts along the track and along the couplings."""
    n = params.n_train
    t = params.traction
    for name in ("response_time", "cut_time"):
        positive(getattr(t, name), f"traction.{name}")
    for j, notch in enumerate(t.notches):
        at = f"traction.notches.{j}"
        finite(notch.time, f"{at}.time", t.notches[j - 1].time if j else 0.0)
        finite(notch.notch, f"{at}.notch", -8.0, 8.0)
        for number in notch.cars:
            require(1 <= number <= n, f"{at}.cars", f"there is no car {number}")
            car = params.cars[number - 1]
            pulls = bool(car.tractive_effort or car.dynamic_brake)
            require(pulls, f"{at}.cars", f"car {number} is no locomotive with an effort")
    for i, car in enumerate(params.cars):
        for name in ("tractive_effort", "dynamic_brake"):
            curve = getattr(car, name)
            for k, (speed, force) in enumerate(curve):
                at = f"cars.{i}.{name}.{k}"
                finite(force, at, 0.0)
                finite(speed, at, 0.0)
                require(k == 0 or speed > curve[k - 1][0], at, "speeds must rise")
        for k, value in enumerate(car.resistance):
            finite(value, f"cars.{i}.resistance.{k}", 0.0)
    finite(params.track.curve_resistance, "track.curve_resistance", 0.0)
    end = -math.inf
    for j, change in enumerate(params.track.grades):
        at = f"track.grades.{j}"
        finite(change.grade, f"{at}.grade", -0.5, 0.5)
        finite(change.length, f"{at}.length", 0.0)
        if j or not math.isinf(change.at):
            finite(change.at, f"{at}.at")
            begin = change.at - 0.5 * change.length
            require(begin >= end, f"{at}.length", "the vertical curve overlaps the one before")
            end = change.at + 0.5 * change.length
    gear = params.couplings.gear
    for name in ("stiffness", "transition"):
        positive(getattr(gear, name), f"couplings.gear.{name}")
    for name in ("slack", "preload", "travel", "solid"):
        finite(getattr(gear, name), f"couplings.gear.{name}", 0.0)
    finite(gear.unloading, "couplings.gear.unloading", 0.0, 1.0)
    finite(gear.start, "couplings.gear.start", -1.0, 1.0)
    for name in ("knuckle_strength", "body_strength"):
        finite(getattr(params.couplings, name), f"couplings.{name}", 0.0)
    for j, weak in enumerate(params.couplings.weak):
        at = f"couplings.weak.{j}"
        require(1 <= weak.coupling < n, f"{at}.coupling", f"there is no coupling {weak.coupling}")
        require(weak.part in PARTS, f"{at}.part", f"must be one of {', '.join(PARTS)}")
        positive(weak.strength, f"{at}.strength")


def check_trigger(mode: str, source: str, car: int, delay: float, n: int, where: str) -> None:
    """Refuse an emergency application that cannot be made."""
    require(
        isinstance(mode, str) and mode in ARRIVALS,
        f"{where}.mode",
        f"must be one of {', '.join(ARRIVALS)}",
    )
    require(
        isinstance(source, str) and source in BRAKE_SOURCES,
        f"{where}.source",
        f"must be one of {', '.join(BRAKE_SOURCES)}",
    )
    if source == "car":
        require(
            isinstance(car, (int, np.integer)) and not isinstance(car, bool),
            f"{where}.car",
            f"must be a whole number, not {car!r}",
        )
        require(1 <= car <= n, f"{where}.car", f"there is no car {car}")
    finite(delay, f"{where}.delay", 0.0)


def build_model(params: TrainParams, track: Track) -> Model:
    """The arrays that do not change during a run."""
    p = params
    n = len(p.cars)
    g, c, m, own = p.ground, p.contact, p.integration, p.variant
    values = {
        "gravity": GRAVITY,
        "brake_rise": p.brakes.rise_time,
        "brake_speed": p.brakes.signal_speed,
        "vent": p.brakes.vent_on_parting,
        "brake_system": BRAKE_SYSTEMS.index(p.brakes.system),
        "radio_delay": p.brakes.radio_delay,
        "ground_cs": g.c_s,
        "ground_cd": g.c_d,
        "ground_eps": g.eps,
        "ground_cv": g.c_v,
        "ground_scale": g.scale,
        "force_max": c.force_max,
        "half_distance": c.half_distance,
        "buffer": c.buffer,
        "reach": reach(c.half_distance, c.buffer, GAP_LAWS[c.gap_law]),
        "c1": c.c1,
        "c2": c.c2,
        "c3": c.c3,
        "begin_force": c.begin_force,
        "end_force": c.end_force,
        "end_hold": c.end_hold,
        "gap_law": GAP_LAWS[c.gap_law],
        "even_inside": INSIDE[c.inside],
        "lv_limit": p.derailment.lv_limit,
        "break_follows": p.derailment.break_follows_lateral,
        "rtol": m.rtol,
        "project": STABILIZATIONS[m.stabilization],
        "baumgarte_v": m.baumgarte_velocity,
        "baumgarte_q": m.baumgarte_position,
        "locate": m.locate_crossings,
        "step_share": m.buffer_fraction * c.buffer,
        "h_max": m.max_step,
        "h_min": m.min_step,
        "rest_speed": m.rest_speed,
        "rest_yaw_rate": m.rest_yaw_rate,
        "rest_hold": m.rest_hold,
        "time_limit": m.time_limit,
        "joint_held": own.held_moment,
        "whole_car": own.whole_car,
        "collide": own.collisions,
        "along": False,
        "profile": len(track.grades) > 0,
        "datum": 0.0,
        "curve_resistance": p.track.curve_resistance,
        "cut": p.traction.cut_time,
        "keep_dynamic": p.traction.keep_dynamic,
        "gear": p.couplings.gear.on,
        "strength": False,
        "lv_hold": p.derailment.lv_hold,
        "truck_play": p.derailment.truck_play,
        "guide_strength": p.derailment.guide_strength,
        "guide_stiffness": p.derailment.guide_stiffness,
        "guide_play": p.derailment.guide_play,
        "ground_most": max([g.c_s, *(zone.c_s for zone in p.site.zones)]),
        "border": p.site.border,
        "slopes": any(any(zone.rise) for zone in p.site.zones),
        "train": p.n_train,
    }
    link = _links(p)
    along, effort, setting = _along(p)
    values["strength"] = bool(np.isfinite(link["strength"]).any())
    resists = any(along[name].any() for name in ("r0", "r1", "r2"))
    values["along"] = bool(
        values["profile"] or p.track.curve_resistance or len(setting) or resists
    )
    par = np.array([tuple(values[name] for name in layout.PAR.names or ())], layout.PAR)
    traction = p.brakes.traction_coefficient * GRAVITY

    car = np.zeros(n, layout.CAR)
    striker = np.zeros((n, 2), layout.STRIKER)
    side = side_lines(p)
    rows = side_rows(p)
    free = np.concatenate([_free_swing(p.cars[: p.n_train], p.track), *side_swing(p)])
    units: list[tuple[float, ...]] = []
    unit_start = np.zeros(n + 1, dtype=np.int64)
    number = 1
    distance = 0.0
    for i, k in enumerate(p.cars):
        half_l, half_w = 0.5 * k.length, 0.5 * k.width
        if i:
            ahead = p.cars[i - 1]
            distance += ahead.pivot_distance + ahead.rear.length
            distance += k.front.length + k.pivot_distance
        car[i] = (
            k.mass,
            k.inertia,
            k.coupler_inertia,
            half_l,
            half_w,
            math.hypot(half_l, half_w),
            k.pivot_distance,
            k.truck_distance,
            k.front.length,
            k.rear.length,
            k.represents > 1,
            distance,
            math.sqrt(k.inertia / k.mass),
            math.sqrt(k.coupler_inertia / k.mass),
            *rows[i],
        )
        for end, e in enumerate((k.front, k.rear)):
            striker[i, end] = (
                e.striker_arm, e.striker_arm * free[i, end], e.striker_opening, e.k1, e.k2,
                e.damping,
            )  # fmt: skip
        for j, u in enumerate(k.brakes):
            units.append(
                (
                    i,
                    u.distance,
                    p.brakes.force * u.scale if u.force is None else u.force,
                    SHOES[u.shoe],
                    traction * u.weight if u.shoe != "none" else 0.0,
                    u.delay,
                    number + min(j, k.represents - 1),
                    u.hand,
                )
            )
        number += k.represents
        unit_start[i + 1] = len(units)

    knuckle = np.zeros(max(n - 1, 0), layout.KNUCKLE)
    for i in range(n - 1):
        pair = pair_of_heads(p.cars[i].rear.head, p.cars[i + 1].front.head)
        limit = getattr(p.derailment, f"knuckle_limit_{pair.lower()}")
        knuckle[i] = (
            *POLYNOMIALS[pair],
            polynomial_root(pair),
            limit,
            p.variant.moment_widening,
            top_angle(*POLYNOMIALS[pair][1:]),
        )

    lateral = np.zeros(len(p.initiation.lateral_forces), layout.PUSH)
    for j, f in enumerate(p.initiation.lateral_forces):
        d_t = p.cars[f.car - 1].truck_distance
        offset = {"front": d_t, "rear": -d_t, "centre": 0.0}[f.place]
        # Direction: filled in by `initial_state`, which knows where the truck stands.
        lateral[j] = (f.car - 1, offset, 0.0, f.force, f.start, f.start + f.duration)

    return Model(
        par=par,
        car=car,
        striker=striker,
        knuckle=knuckle,
        unit=np.array(units, layout.UNIT),
        unit_start=unit_start,
        remote=np.array(p.brakes.remote, dtype=float),
        lateral=lateral,
        track=track.pieces,
        side=np.concatenate([np.zeros(0, layout.TRACK), *(line.pieces for line in side)]),
        table=np.array(METHODS[p.integration.method]),
        link=link,
        along=along,
        effort=effort,
        setting=setting,
        grade=track.grades,
        **site_tables(p.site, track),
    )


def _links(p: TrainParams) -> Rows:
    """Draft gear and strength of the couplings: (N-1,) LINK."""
    c, g = p.couplings, p.couplings.gear
    row = (g.slack, g.preload, g.stiffness, g.unloading, g.transition, g.travel, g.solid)
    knuckle, body = c.knuckle_strength or math.inf, c.body_strength or math.inf
    strength = min(knuckle, body)
    part = float(body < knuckle)
    link = np.array([(*row, strength, part)] * max(len(p.cars) - 1, 0), layout.LINK)
    for i, car in enumerate(p.cars[:-1]):
        if car.rear.name == ARTICULATED:  # a joint without gear, as stiff as one that is solid
            link[i] = (
                0.0,
                0.0,
                g.stiffness + g.solid,
                1.0,
                g.transition,
                g.travel,
                0.0,
                math.inf,
                0,
            )
    for weak in c.weak:
        if weak.strength < link[weak.coupling - 1]["strength"]:
            link[weak.coupling - 1]["strength"] = weak.strength
            link[weak.coupling - 1]["part"] = PARTS.index(weak.part)
    return link


def _along(p: TrainParams) -> tuple[Rows, Rows, Rows]:
    """Resistance and locomotives: (N,) ALONG, EFFORT and SETTING."""
    along = np.zeros(len(p.cars), layout.ALONG)
    effort: list[tuple[float, float]] = []
    setting: list[tuple[float, float]] = []
    for i, car in enumerate(p.cars):
        rows = [*car.resistance]
        for curve in (car.tractive_effort, car.dynamic_brake):
            rows += [len(effort), len(effort) + len(curve)]
            effort += curve
        points = []
        if car.tractive_effort or car.dynamic_brake:
            points = _shares(p.traction, i + 1)
        along[i] = (*rows, len(setting), len(setting) + len(points))
        setting += points
    return along, np.array(effort, layout.EFFORT), np.array(setting, layout.SETTING)


def _shares(traction: TractionParams, number: int) -> list[tuple[float, float]]:
    """(time, share of the effort) of the locomotive ``number``, which follows its notches.

    Linear between the points; empty where it idles all the time. A setting at time 0 is there
    from the start.
    """
    points: list[tuple[float, float]] = [(0.0, 0.0)]
    wanted = 0.0
    for notch in traction.notches:
        if notch.cars and number not in notch.cars:
            continue
        if notch.time == 0.0:
            points = [(0.0, notch.notch / 8.0)]
        else:
            times, shares = ([point[k] for point in points] for k in (0, 1))
            share = float(np.interp(notch.time, times, shares))
            points = [point for point in points if point[0] < notch.time]
            points.append((notch.time, share))
            reached = notch.time + abs(notch.notch / 8.0 - share) * traction.response_time
            if reached > notch.time:
                points.append((reached, notch.notch / 8.0))
        wanted = max(wanted, abs(notch.notch))
    return points if wanted else []


def _pose_on_track(track: Track, s: float, d_t: float) -> tuple[float, float, float]:
    """Mass centre and yaw of a car whose two trucks stand on the line, its centre beside ``s``.

    The trucks are the points at ``s +/- e`` whose distance is twice ``d_t``.
    """
    lo, hi = 0.5 * d_t, 2.0 * d_t
    for _ in range(200):
        e = 0.5 * (lo + hi)
        xf, yf, _, _ = track.point(s + e)
        xr, yr, _, _ = track.point(s - e)
        if math.hypot(xf - xr, yf - yr) > 2.0 * d_t:
            hi = e
        else:
            lo = e
        if hi - lo < 1e-13 * d_t:
            break
    return 0.5 * (xf + xr), 0.5 * (yf + yr), math.atan2(yf - yr, xf - xr)


def initial_travel(params: TrainParams, i: int) -> float:
    """By how much coupling ``i`` (from 0) is longer at the start than amid its slack, m."""
    gear = params.couplings.gear
    jointed = params.cars[i].rear.name == ARTICULATED
    return 0.5 * gear.start * gear.slack if gear.on and not jointed else 0.0


ALIKE = 32
"""Trains of which the place on the track is kept: the runs of an ensemble and saved states have it
in common, and on a curve it takes longer to find than a short run."""


@functools.lru_cache(ALIKE)
def _free_swing(cars: tuple[Car, ...], track: TrackParams) -> F64:
    return free_swing(cars, Track(track))


def initial_positions(params: TrainParams) -> F64:
    """Coordinates (N, 5) of a train standing on the line with all couplers stretched straight.

    The car behind is moved along the line until the distance of the two pivots is the length of
    the two couplers, which then point along it.
    """
    travel = tuple(initial_travel(params, i) for i in range(len(params.cars) - 1))
    n = params.n_train
    own = _standing(params.cars[:n], params.track, params.initiation.position, travel[: n - 1])
    found = [own]
    for cut, first in cuts(params):
        cars = params.cars[first : first + cut.cars]
        line = params.tracks[cut.track].line
        found.append(_standing(cars, line, cut.position, travel[first : first + cut.cars - 1]))
    return np.concatenate(found)


@functools.lru_cache(ALIKE)
def _standing(
    cars: tuple[Car, ...], alignment: TrackParams, s: float, travel: tuple[float, ...]
) -> F64:
    track = Track(alignment)
    n = len(cars)
    q = np.zeros((n, 5))
    if len(track.pieces) == 0:
        for i, car in enumerate(cars):
            if i:
                s -= car.pivot_distance + car.front.length + travel[i - 1]
            q[i, 0] = s
            s -= car.pivot_distance + car.rear.length
        return q
    for i, car in enumerate(cars):
        if i == 0:
            q[0, :3] = _pose_on_track(track, s, car.truck_distance)
            q[0, 3] = q[0, 2]
        else:
            ahead = cars[i - 1]
            reach = ahead.rear.length + car.front.length + travel[i - 1]
            px = q[i - 1, 0] - ahead.pivot_distance * math.cos(q[i - 1, 2])
            py = q[i - 1, 1] - ahead.pivot_distance * math.sin(q[i - 1, 2])
            base = ahead.pivot_distance + reach + car.pivot_distance
            near, far = s - 0.5 * base, s - 2.0 * base
            for _ in range(200):
                middle = 0.5 * (near + far)
                pose = _pose_on_track(track, middle, car.truck_distance)
                fx = pose[0] + car.pivot_distance * math.cos(pose[2])
                fy = pose[1] + car.pivot_distance * math.sin(pose[2])
                # short links: the front pivot may still lie ahead of the rear one by their length
                along = (px - fx) * math.cos(pose[2]) + (py - fy) * math.sin(pose[2])
                if along < 0.0 or math.hypot(px - fx, py - fy) < reach:
                    near = middle
                else:
                    far = middle
                if near - far < 1e-13 * base:
                    break
            s = middle
            q[i, :3] = pose
            # Unwrapped next to the yaw: the alignment may turn past pi.
            angle = math.atan2(py - fy, px - fx)
            angle += 2.0 * math.pi * round((pose[2] - angle) / (2.0 * math.pi))
            q[i - 1, 4] = q[i, 3] = angle
            jump = 2.0 * math.pi * round((q[i - 1, 2] - q[i, 2]) / (2.0 * math.pi))
            q[i, 2] += jump
            q[i, 3] = q[i - 1, 4] = angle + 2.0 * math.pi * round(
                (q[i, 2] - angle) / (2.0 * math.pi)
            )
    q[n - 1, 4] = q[n - 1, 2]
    return q


def initial_velocities(params: TrainParams, track: Track, q: F64) -> F64:
    """Velocities (N, 5) consistent with the constraints; car 1's mass centre has the speed given.

    A car on the line has one degree of freedom: (Vx, Vy, yaw rate) is a multiple of z, the
    direction that keeps both trucks on the line. The couplers, stretched along the line of their
    pivots, carry the motion along that line to the next car and turn with it.
    """
    cars = params.cars
    n = params.n_train
    v = np.zeros((len(cars), 5))
    speed = params.initiation.speed
    if len(track.pieces) == 0:
        v[:n, 0] = speed
        return v

    def direction(i: int) -> F64:
        c, s = math.cos(q[i, 2]), math.sin(q[i, 2])
        rows = []
        hint = None
        for r in (cars[i].truck_distance, -cars[i].truck_distance):
            hint, _ = track.locate(q[i, 0] + r * c, q[i, 1] + r * s, hint)
            h = track.point(hint)[2]
            nx, ny = -math.sin(h), math.cos(h)
            rows.append((nx, ny, r * (c * ny - s * nx)))
        z = np.cross(rows[0], rows[1])
        z /= math.hypot(z[0], z[1])
        return z if z[0] * c + z[1] * s > 0.0 else -z

    z = direction(0)
    v[0, :3] = speed * z
    v[0, 3] = v[0, 2]
    for i in range(1, n):
        ahead, car = cars[i - 1], cars[i]
        angle = q[i, 3]
        e = (math.cos(angle), math.sin(angle))
        t = (-e[1], e[0])

        def pivot(k: int, arm: float, w: F64) -> tuple[float, float]:
            return (
                w[0] - arm * math.sin(q[k, 2]) * w[2],
                w[1] + arm * math.cos(q[k, 2]) * w[2],
            )

        z = direction(i)
        p = pivot(i - 1, -ahead.pivot_distance, v[i - 1])
        f = pivot(i, car.pivot_distance, z)
        u = (p[0] * e[0] + p[1] * e[1]) / (f[0] * e[0] + f[1] * e[1])
        v[i, :3] = u * z
        f = pivot(i, car.pivot_distance, v[i])
        rate = ((p[0] - f[0]) * t[0] + (p[1] - f[1]) * t[1]) / (
            ahead.rear.length + car.front.length + initial_travel(params, i - 1)
        )
        v[i - 1, 4] = v[i, 3] = rate
    v[n - 1, 4] = v[n - 1, 2]
    return v


def initial_state(params: TrainParams, model: Model, track: Track) -> State:
    """The state at time 0, before its first evaluation; fills in ``model.lateral`` directions."""
    n = len(params.cars)
    start = params.initiation
    try:
        q = initial_positions(params)
        v = initial_velocities(params, track, q)
    except (ZeroDivisionError, FloatingPointError) as error:
        raise ParameterError(
            "initiation.position", f"the train does not fit the track here ({error})"
        ) from error
    truck_on = np.ones((n, 2), dtype=np.uint8)
    for number, end in start.derailed_trucks:
        truck_on[number - 1, ENDS.index(end)] = 0
    coupled = np.ones(max(n - 1, 0), dtype=np.uint8)
    for number in start.parted_couplings:
        coupled[number - 1] = 0
    lines = car_lines(params, track)
    for _, first in cuts(params):
        coupled[first - 1] = 0
    truck_s = np.zeros((n, 2))
    hint: float | None = None
    for i, car in enumerate(params.cars):
        line = lines[i]
        hint = hint if i and line is lines[i - 1] else None
        for k, r in enumerate((car.truck_distance, -car.truck_distance)):
            x = q[i, 0] + r * math.cos(q[i, 2])
            y = q[i, 1] + r * math.sin(q[i, 2])
            truck_s[i, k], offset = line.locate(x, y, hint)
            hint = truck_s[i, k]
            if not line.start <= hint <= line.end or abs(offset) > 1e-6:
                raise ParameterError(
                    position_field(params, i),
                    f"car {i + 1} stands beyond the alignment ({line.start:g} to {line.end:g} m)",
                )
    for row in model.lateral:
        i, offset, force = int(row["car"]), row["offset"], row["fy"]
        c, s = math.cos(q[i, 2]), math.sin(q[i, 2])
        at, _ = track.locate(q[i, 0] + offset * c, q[i, 1] + offset * s, truck_s[i, 0])
        heading = track.point(at)[2]
        row["fx"] = -math.sin(heading) * force
        row["fy"] = math.cos(heading) * force

    refuse_overlap(params.site, model, q)
    refuse_touching(params, q)
    m = len(model.unit)
    breaks = np.full(2 * n + 16 + len(params.track.rail_breaks), math.inf)
    for j, s in enumerate(params.track.rail_breaks):
        require(
            track.start <= s <= track.end,
            f"track.rail_breaks.{j}",
            f"{s:g} m lies beyond the alignment ({track.start:g} to {track.end:g} m)",
        )
        breaks[j] = s
    clock = np.zeros(1, layout.CLOCK)
    clock["h_next"] = 1e-3
    clock["rest_since"] = -1.0
    clock["duration"] = math.nan
    coupling = np.zeros(max(n - 1, 0), layout.COUPLING)
    coupling["travel"] = [initial_travel(params, i) for i in range(n - 1)]
    coupling["share"] = -1.0
    for name in ("draft_time", "buff_time"):
        coupling[name] = math.nan
    peak = np.zeros(n, layout.PEAK)
    for name in ("time", "derail_time", "derail_speed"):
        peak[name] = math.nan
    for number, _ in start.derailed_trucks:
        peak[number - 1]["derail_time"] = 0.0
        peak[number - 1]["derail_speed"] = start.speed
    peak["resting"][params.n_train :] = 1.0
    zeros = np.zeros((n, 5))
    pair_rows = 16 * n + 64
    return State(
        q=q,
        v=v,
        a=zeros.copy(),
        q0=q.copy(),
        v0=v.copy(),
        a0=zeros.copy(),
        a1=zeros.copy(),
        rail_force=np.zeros((n, 2)),
        coupler_force=np.zeros((max(n - 1, 0), 2)),
        truck_s=truck_s,
        truck_on=truck_on,
        coupled=coupled,
        truck_on0=truck_on.copy(),
        coupled0=coupled.copy(),
        arrival=np.full((m, 4), math.inf),
        reached=np.zeros(m, dtype=np.uint8),
        breaks=breaks,
        energy=np.zeros(layout.N_ENERGY),
        power=np.zeros(layout.N_POWER),
        energy0=np.zeros(layout.N_ENERGY),
        power0=np.zeros(layout.N_POWER),
        power1=np.zeros(layout.N_POWER),
        clock=clock,
        cnt=np.zeros(1, layout.COUNT),
        built=np.full((n, 2), math.nan),
        pairs=np.zeros((pair_rows, 2), dtype=np.int64),
        mask=np.zeros((pair_rows, 8), dtype=np.uint8),
        pair=np.zeros(pair_rows, layout.PAIR),
        contact=np.zeros(2 * pair_rows, layout.CONTACT),
        peak=peak,
        coupling=coupling,
        over_since=np.full((n, 2), math.nan),
        loose=np.zeros((n, 2), dtype=np.uint8),
        **site_state(params.site, model, n),
    )
