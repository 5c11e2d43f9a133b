"""The scenario format, version 1: fields, units, defaults and limits.

The models check one field at a time; what takes several fields to judge is in ``resolve.py``.
Key names carry their unit. Defaults come from the engine's parameter classes, so that the two
cannot part; the same field definitions yield the JSON schema and the tables in
``docs/scenarios.md``.

Defaults marked [R] are reconstructed: the surviving copy of the source (E. E. Toma, *A Computer
Model of a Derailment*, PhD thesis, Queen's University, 1998) lost or never gave them.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    StringConstraints,
    WithJsonSchema,
)

from derail_ros.vocabulary.params import (
    PLANAR,
    BrakeParams,
    BrakeTrigger,
    BrakeUnit,
    Car,
    ContactParams,
    DerailmentParams,
    DraftGearParams,
    GroundParams,
    InitiationParams,
    IntegrationParams,
    LateralForce,
    TrackParams,
    TractionParams,
)
from derail_ros.vocabulary.site import WALL_HEIGHT

FORMAT_VERSION = 1
"""Version of the scenario format that this code reads and writes."""

MAX_CARS = 1000
"""Largest number of cars in a train."""

Number = Annotated[
    float,
    Field(strict=True, allow_inf_nan=False),
    AfterValidator(lambda x: x + 0.0),  # -0.0 becomes 0.0, which has another hash otherwise
]
Integer = Annotated[int, Field(strict=True)]
Switch = Annotated[bool, Field(strict=True)]
CarNumber = Annotated[int, Field(strict=True, ge=1, le=MAX_CARS)]
Text = Annotated[str, StringConstraints(strict=True, max_length=4000)]
TITLE_LENGTH = 120
Title = Annotated[str, StringConstraints(strict=True, min_length=1, max_length=TITLE_LENGTH)]
Label = Annotated[str, StringConstraints(strict=True, max_length=60)]
TypeName = Annotated[
    str, StringConstraints(strict=True, pattern=r"^[A-Za-z_][A-Za-z0-9_-]{0,59}$")
]
FileName = Annotated[str, StringConstraints(strict=True, pattern=r"^[^/\\\x00-\x1f]{1,200}$")]
Sha256 = Annotated[str, StringConstraints(strict=True, pattern=r"^[0-9a-f]{64}$")]
Notches = Annotated[int, Field(strict=True, ge=-8, le=8)]
Shoe = Literal["composition", "cast_iron", "none"]
Turn = Literal["left", "right"]


def _load_fraction(value: Any) -> Any:
    """``empty`` and ``loaded`` as 0 and 1."""
    return {"empty": 0.0, "loaded": 1.0}.get(value, value) if isinstance(value, str) else value


Load = Annotated[
    float,
    Field(strict=True, allow_inf_nan=False, ge=0, le=1),
    BeforeValidator(_load_fraction),
    WithJsonSchema(
        {"anyOf": [{"enum": ["empty", "loaded"]}, {"type": "number", "minimum": 0, "maximum": 1}]}
    ),
]


def engine_default(owner: type[Any], name: str) -> Any:
    """Default of a field of one of the engine's parameter classes."""
    (field,) = (f for f in dataclasses.fields(owner) if f.name == name)
    return field.default


def _field(
    default: Any, text: str, *, unit: str | None = None, later: bool = False, **limits: Any
) -> Any:
    """A field of the format: default (``...``: required), meaning and limits.

    Its ``unit`` is given where the end of its key does not name it. One that came ``later`` is
    left out of resolved scenarios at its default: the hashes of older scenarios stay what they
    were.
    """
    extra: dict[str, Any] = {} if unit is None else {"unit": unit}
    extra |= {"later": True} if later else {}
    return Field(default, description=text, json_schema_extra=extra, **limits)


def _engine(owner: type[Any], name: str, text: str, **others: Any) -> Any:
    """A field that is passed on as ``owner.name`` of the engine and has its default."""
    field = _field(engine_default(owner, name), text, **others)
    field.json_schema_extra["engine"] = f"{owner.__name__}.{name}"
    return field


_track = partial(_engine, TrackParams)
_force = partial(_engine, LateralForce)
_gear = partial(_engine, DraftGearParams)
_brakes = partial(_engine, BrakeParams)
_trigger = partial(_engine, BrakeTrigger)
_traction = partial(_engine, TractionParams)
_ground = partial(_engine, GroundParams)
_contact = partial(_engine, ContactParams)
_derailment = partial(_engine, DerailmentParams)
_integration = partial(_engine, IntegrationParams)


class Section(BaseModel):
    """Base of all parts of a scenario: unknown keys are refused, values never change."""

    model_config = ConfigDict(extra="forbid", frozen=True)


def to_engine(section: Section, owner: type[Any]) -> dict[str, Any]:
    """Values of a section under the names of the engine's parameter class ``owner``."""
    values = {}
    for name, info in type(section).model_fields.items():
        extra = info.json_schema_extra
        target = str(extra.get("engine", "")) if isinstance(extra, dict) else ""
        if target.startswith(f"{owner.__name__}."):
            values[target.partition(".")[2]] = getattr(section, name)
    return values


# --- distributions ----------------------------------------------------------------------------

Scalar = bool | int | Annotated[float, Field(allow_inf_nan=False)] | str


class Normal(Section):
    """Normal, truncated at ``low`` and ``high`` if given."""

    mean: Number = _field(..., "mean before truncation")
    sd: Number = _field(..., "standard deviation before truncation", gt=0)
    low: Number | None = _field(None, "least value")
    high: Number | None = _field(None, "largest value")


class Lognormal(Section):
    """Lognormal, truncated likewise."""

    median: Number = _field(..., "median before truncation", gt=0)
    sigma: Number = _field(..., "standard deviation of the logarithm", gt=0)
    low: Number | None = _field(None, "least value")
    high: Number | None = _field(None, "largest value")


class Triangular(Section):
    """Triangular."""

    low: Number = _field(..., "least value")
    mode: Number = _field(..., "most likely value")
    high: Number = _field(..., "largest value")


class Distribution(Section):
    """Exactly one shape."""

    normal: Normal | None = _field(None, "normal")
    lognormal: Lognormal | None = _field(None, "lognormal")
    triangular: Triangular | None = _field(None, "triangular")


class Uncertain(Distribution):
    """The distribution from which each member of an ensemble draws a field: exactly one shape."""

    uniform: tuple[Number, ...] | None = _field(
        None, "uniform between two values", min_length=2, max_length=2
    )
    values: tuple[Scalar, ...] | None = _field(
        None, "one of these, with equal probabilities", min_length=1, max_length=1000
    )
    relative: Switch = _field(False, "draw factors on the scenario's own value")


# --- rolling stock ----------------------------------------------------------------------------


class CouplerSpec(Section):
    """A coupler type; with the name of a library type only what differs needs to be given."""

    head: Literal["E", "F"] | None = _field(
        None, "head; decides the knuckle moment and the angle at which a coupling parts"
    )
    pivot_to_face_m: Number | None = _field(
        None, "coupler length: pivot to mated face", gt=0, le=5
    )
    pivot_to_striker_m: Number | None = _field(
        None, "pivot to striker contact, below the coupler length", gt=0, le=5
    )
    striker_opening_m: Number | None = _field(
        None, "striker displacement at which the stiffness changes", ge=0, le=2
    )
    k1_N_per_m: Number | None = _field(None, "striker stiffness up to the opening", gt=0, le=1e10)
    k2_N_per_m: Number | None = _field(
        None, "striker stiffness beyond the opening; 50e6 unless given [R]", gt=0, le=1e11
    )
    damping_N_s_per_m: Number | None = _field(
        None, "damper beside the striker; 4000 unless given", ge=0, le=1e8
    )


class BrakeSpec(Section):
    """The brake of one car; what is not given is that of its type, or the default."""

    shoe: Shoe | None = _field(
        None, "brake shoe: composition (unless given), cast_iron [R] or none"
    )
    scale: Number | None = _field(
        None, "size of this car's brake, times brakes.force_scale; 1 unless given", ge=0, le=10
    )
    delay_s: Number | None = _field(
        None, "delay after the signal has reached the car; 0 unless given", ge=0, le=600
    )
    net_braking_ratio_loaded: Number | None = _field(
        None, "of this car, in place of that of brakes", ge=0, le=1
    )
    net_braking_ratio_empty: Number | None = _field(
        None, "of this car, in place of that of brakes", ge=0, le=1
    )
    empty_load_device: Switch | None = _field(
        None, "the car has a device that lowers the shoe force when it is empty; true unless given"
    )
    cut_out: Switch | None = _field(
        None, "its air brake is cut out; the signal still passes; false unless given"
    )
    hand_brake: Switch | None = _field(None, "its hand brake is set; false unless given")


CurvePoint = tuple[
    Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0, le=500)],
    Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0, le=5000)],
]


class CarType(Section):
    """A car or locomotive of the library, or of ``train.car_types``."""

    title: Label = _field("", "what it is")
    note: Text = _field("", "source of the numbers")
    mass_kg: Number | None = _field(None, "mass; or give empty and loaded mass", gt=0, le=1e6)
    empty_mass_kg: Number | None = _field(None, "mass empty", gt=0, le=1e6)
    loaded_mass_kg: Number | None = _field(None, "mass fully loaded", gt=0, le=1e6)
    inertia_kg_m2: Number | None = _field(
        None,
        "yaw inertia at mass_kg (the loaded mass); that of a solid cylinder unless given",
        gt=0,
        le=1e10,
    )
    length_m: Number | None = _field(
        None, "length of the body; required unless length_over_couplers_m is given", gt=0, le=100
    )
    length_over_couplers_m: Number | None = _field(
        None, "from pulling face to pulling face", gt=0, le=200
    )
    width_m: Number = _field(2.6, "width of the body in collisions", gt=0, le=10)
    coupler_pivots_m: Number | None = _field(
        None, "between the coupler pivots; from length and coupler unless given", gt=0, le=100
    )
    truck_centres_m: Number | None = _field(
        None, "between the truck pivots; required unless platforms are given", gt=0, le=100
    )
    coupler: TypeName | None = _field(
        None, "coupler type at both ends; required unless platforms are given"
    )
    platforms: tuple[TypeName, ...] = _field(
        (),
        "an articulated car: the types of its platforms from front to rear, each a body of its "
        "own, joined by couplers of the type ARTICULATED",
        max_length=10,
    )
    locomotive: Switch = _field(False, "it is a locomotive")
    aar_codes: tuple[Label, ...] = _field(
        (), "beginnings of the AAR car type codes that consist lists give such a car"
    )
    aliases: tuple[Label, ...] = _field((), "other names of it in consist lists")
    brake: BrakeSpec = _field(BrakeSpec(), "its brake")
    overall_width_m: Number | None = _field(
        None, "width over all, for the record: the model uses width_m", gt=0, le=10
    )
    axles: Integer | None = _field(None, "number of axles, for the record", ge=2, le=24)
    power_kW: Number | None = _field(
        None,
        "power; of a locomotive without tractive_effort_kmh_kN the effort follows from it",
        ge=0,
        le=20000,
    )
    tractive_effort_kmh_kN: tuple[CurvePoint, ...] = _field(
        (), "largest tractive effort over speed, straight between the points"
    )
    dynamic_brake_kmh_kN: tuple[CurvePoint, ...] = _field(
        (), "largest effort of the dynamic brake over speed"
    )


class CarTypeFile(Section):
    """A file of car types in ``config/rolling_stock``."""

    version: Literal[1] = _field(..., "version of the format")
    source: Text = _field("", "source of the numbers")
    car_types: dict[TypeName, CarType] = _field(..., "types by name")


class CouplerTypeFile(Section):
    """A file of coupler types in ``config/rolling_stock``."""

    version: Literal[1] = _field(..., "version of the format")
    source: Text = _field("", "source of the numbers")
    coupler_types: dict[TypeName, CouplerSpec] = _field(..., "types by name")


class ConsistBlock(Section):
    """One car, or ``count`` cars alike, of a named type or given by its numbers."""

    car: TypeName | None = _field(
        None, "car type; what else is given here replaces the type's values"
    )
    count: Integer = _field(1, "number of such cars, one behind the other", ge=1, le=MAX_CARS)
    name: Label | None = _field(None, "label; the type's title unless given")
    contents: Label | None = _field(None, "what the cars carry")
    load: Load | None = _field(
        None,
        "empty, loaded (unless given) or a fraction from 0 to 1, for types with an empty and a "
        "loaded mass",
    )
    mass_kg: Number | None = _field(
        None,
        "mass of one car; changing it by an override scales the yaw inertia in proportion",
        gt=0,
        le=1e6,
    )
    inertia_kg_m2: Number | None = _field(
        None,
        "yaw inertia, coupler masses included. Unless given: the type's in proportion to the "
        "mass, or m (L^2/12 + r^2/4) with r = 1.5 m [R]",
        gt=0,
        le=1e10,
    )
    empty_mass_kg: Number | None = _field(
        None, "mass of one car empty, its light weight", gt=0, le=1e6
    )
    loaded_mass_kg: Number | None = _field(
        None, "mass of one car loaded, its gross weight", gt=0, le=1e6
    )
    length_m: Number | None = _field(None, "length of the body", gt=0, le=100)
    length_over_couplers_m: Number | None = _field(
        None,
        "from pulling face to pulling face; the coupler pivots follow from it, and the body "
        "unless length_m is given too",
        gt=0,
        le=200,
    )
    width_m: Number | None = _field(
        None, "width of the body in collisions; 2.6 unless given", gt=0, le=10
    )
    coupler_pivots_m: Number | None = _field(
        None,
        "between the coupler pivots. Unless given by the type: length - 0.34, or length - 1.16 "
        "with couplers as long as the F73 [R]",
        gt=0,
        le=100,
    )
    truck_centres_m: Number | None = _field(None, "between the truck pivots", gt=0, le=100)
    coupler: TypeName | None = _field(None, "coupler type at both ends")
    front_coupler: TypeName | None = _field(None, "coupler type in front, if different")
    rear_coupler: TypeName | None = _field(None, "coupler type behind, if different")
    coupler_inertia_kg_m2: Number | None = _field(
        None, "inertia of each coupler; couplers.inertia_kg_m2 unless given", gt=0, le=1e7
    )
    brake: BrakeSpec = _field(BrakeSpec(), "brake of each of these cars")
    locomotive: Switch | None = _field(None, "whether it is a locomotive; its type says")
    axles: Integer | None = _field(None, "axles, for the resistance", ge=2, le=24)
    tractive_effort_kmh_kN: tuple[CurvePoint, ...] | None = _field(
        None, "largest tractive effort over speed; its type's unless given"
    )
    dynamic_brake_kmh_kN: tuple[CurvePoint, ...] | None = _field(
        None, "largest effort of the dynamic brake; its type's unless given"
    )


# --- sections ---------------------------------------------------------------------------------


class Train(Section):
    """The train and its speed."""

    speed_kmh: Number = _field(..., "speed at the start", gt=0, le=500)
    consist: tuple[ConsistBlock, ...] = _field(
        ...,
        "the cars from the first one back, as blocks; `train.consist.0` is the first block",
        min_length=1,
        max_length=MAX_CARS,
    )
    virtual_from: Integer | None = _field(
        None,
        "cars from this number on become one virtual body with their mass and brakes, which "
        "never derails and never collides; null models all cars",
        ge=2,
        le=MAX_CARS,
    )
    car_types: dict[TypeName, CarType] = _field(
        {}, "car types of this scenario, beside those of the library"
    )


class DraftGear(Section):
    """Draft gear along every coupling: both gears of it together."""

    slack_m: Number = _gear("slack", "free slack", ge=0, le=1)
    preload_N: Number = _gear("preload", "preload", ge=0, le=1e7)
    stiffness_N_per_m: Number = _gear("stiffness", "stiffness of loading", gt=0, le=1e10)
    unloading: Number = _gear(
        "unloading", "force on unloading over that on loading; 1: no friction", ge=0, le=1
    )
    transition_m: Number = _gear("transition", "travel from one to the other", gt=0, le=1)
    travel_m: Number = _gear("travel", "travel at which the gears are solid", ge=0, le=10)
    solid_N_per_m: Number = _gear("solid", "stiffness that is added beyond", ge=0, le=1e11)
    start: Literal["stretched", "middle", "bunched"] = _field(
        "stretched", "position of the couplings in their slack at the start"
    )


class WeakCouplingSpec(Section):
    """A coupling with a strength of its own."""

    coupling: CarNumber = _field(..., "its number: i joins cars i and i + 1")
    strength_N: Number = _field(..., "tension at which it breaks", gt=0, le=1e9)
    part: Literal["knuckle", "body"] = _field("knuckle", "what breaks")


class Couplers(Section):
    """Values for all couplers, and coupler types of this scenario."""

    k2_N_per_m: Number | None = _field(
        None,
        "striker stiffness beyond the opening for all types; null: each type's own [R]",
        gt=0,
        le=1e11,
    )
    damping_N_s_per_m: Number | None = _field(
        None, "striker damper for all types; null: each type's own", ge=0, le=1e8
    )
    inertia_kg_m2: Number = _engine(
        Car,
        "coupler_inertia",
        "inertia of each coupler; ten times a real one, as in the published runs",
        gt=0,
        le=1e7,
    )
    draft_gear: DraftGear | None = _field(
        None, "slack and draft gear along the train; null: rigid along the train", later=True
    )
    knuckle_strength_N: Number | None = _field(
        None,
        "tension at which knuckles break; AAR M-211: 2.89e6 in the static test; null: never",
        later=True,
        gt=0,
        le=1e9,
    )
    body_strength_N: Number | None = _field(
        None,
        "tension at which coupler bodies break; AAR M-211: 4.0e6 ultimate; null: never",
        later=True,
        gt=0,
        le=1e9,
    )
    weak: tuple[WeakCouplingSpec, ...] = _field(
        (), "couplings that break earlier", max_length=MAX_CARS, later=True
    )
    types: dict[TypeName, CouplerSpec] = _field(
        {}, "new coupler types, or changes to those of the library"
    )


class Tangent(Section):
    """A straight piece of track."""

    length_m: Number = _field(..., "length", gt=0, le=1e6)


class Curve(Section):
    """A circular piece of track."""

    length_m: Number = _field(..., "length along the track", gt=0, le=1e6)
    radius_m: Number = _field(..., "radius", ge=10, le=1e6)
    turn: Turn = _field(..., "left or right")


class Spiral(Section):
    """A clothoid: the curvature changes in proportion to the length."""

    length_m: Number = _field(..., "length along the track", gt=0, le=1e6)
    radius_start_m: Number | None = _field(
        None, "radius where it begins; null: straight", ge=10, le=1e6
    )
    radius_end_m: Number | None = _field(
        None, "radius where it ends; null: straight", ge=10, le=1e6
    )
    turn: Turn = _field(..., "left or right")


class GradeSpec(Section):
    """Where the grade of the track changes."""

    from_m: Number | None = _field(
        None,
        "track coordinate from which it holds, the middle of the vertical curve; null, for the "
        "first one only: from the beginning",
    )
    grade_percent: Number = _field(
        ..., "rise over run, positive uphill in the direction of travel", ge=-15, le=15
    )
    vertical_curve_m: Number = _field(
        30.0, "length over which the grade changes evenly", gt=0, le=1e4
    )


class Piece(Section):
    """A piece of the alignment: exactly one of the three."""

    tangent: Tangent | None = _field(None, "straight")
    spiral: Spiral | None = _field(None, "transition")
    curve: Curve | None = _field(None, "circular curve")


class TrackSection(Section):
    """The centre line. Track coordinates are arc lengths, growing in the direction of travel."""

    alignment: tuple[Piece, ...] = _field(
        (),
        "pieces in the direction of travel; none: an endless straight along +X with track "
        "coordinate X",
        max_length=1000,
    )
    start_coordinate_m: Number = _track(
        "start_coordinate", "track coordinate where the alignment begins"
    )
    start_x_m: Number = _track("start_x", "x where the alignment begins")
    start_y_m: Number = _track("start_y", "y where the alignment begins")
    start_heading_rad: Number = _track(
        "start_heading", "direction in which it begins, CCW from +X"
    )
    file: FileName | None = _field(
        None,
        "file beside the scenario that alignment and grades are fitted to when it is read: a "
        "GeoJSON LineString, by the datum of `site` and heights as third numbers, or a CSV table "
        "of chainage_m, curvature_per_m and height_m",
        later=True,
    )
    file_tolerance_m: Number = _field(
        0.01, "standard deviation granted to its points", gt=0, le=100, later=True
    )
    grades: tuple[GradeSpec, ...] = _field(
        (),
        "changes of the grade in order of travel; level before the first",
        max_length=1000,
        later=True,
    )
    curve_resistance_m2_per_s2: Number = _track(
        "curve_resistance",
        "resistance in curves, times radius over mass; 7 is 0.8 lb a ton and degree",
        later=True,
        ge=0,
        le=100,
    )
    rail_breaks: tuple[Number, ...] = _field(
        (), "track coordinates of the breaks present at the start", max_length=100, unit="m"
    )
    rail_breaks_under_cars: tuple[CarNumber, ...] = _field(
        (),
        "numbers of cars under which a rail breaks at the start: "
        "derailment.break_ahead_of_truck_m ahead of their front truck",
        max_length=100,
    )


class DerailedTruck(Section):
    """A truck that is derailed from the start."""

    car: CarNumber = _field(..., "car number, 1 leads")
    truck: Literal["front", "rear", "both"] = _field(..., "front, rear or both")


class LateralForceSpec(Section):
    """A force that starts the motion."""

    force_N: Number = _field(..., "size, positive to the left", ge=-1e8, le=1e8)
    car: CarNumber = _force("car", "car number")
    place: Literal["front", "rear", "centre"] = _force(
        "place", "front truck, rear truck or centre of the car"
    )
    start_s: Number = _force("start", "when it begins", ge=0, le=1e4)
    duration_s: Number = _force("duration", "how long it acts", gt=0, le=1e4)


class Initiation(Section):
    """How the derailment starts."""

    position_m: Number = _engine(
        InitiationParams, "position", "track coordinate of the mass centre of car 1"
    )
    derailed_trucks: tuple[DerailedTruck, ...] = _field(
        (), "trucks derailed from the start", max_length=2 * MAX_CARS
    )
    parted_couplings: tuple[CarNumber, ...] = _field(
        (),
        "couplings parted from the start: i is the one between cars i and i + 1",
        max_length=MAX_CARS,
    )
    lateral_force_N: Number = _force(
        "force", "force that starts the motion, positive to the left [R]; 0: none", ge=-1e8, le=1e8
    )
    lateral_force_car: CarNumber = _force("car", "car on which it acts")
    lateral_force_place: Literal["front", "rear", "centre"] = _force(
        "place", "where on the car: front truck, rear truck or centre"
    )
    lateral_force_start_s: Number = _force("start", "when it begins", ge=0, le=1e4)
    lateral_force_duration_s: Number = _force("duration", "how long it acts", gt=0, le=1e4)
    lateral_forces: tuple[LateralForceSpec, ...] = _field((), "further forces", max_length=100)
    await_command: Switch = _field(
        False, "accept a train that nothing derails: a rail break is to be injected later"
    )


class BrakeTriggerSpec(Section):
    """A further emergency application."""

    time_s: Number = _trigger("time", "when it is made", ge=0, le=1e4)
    source: Literal["front", "rear", "both_ends", "car"] = _trigger(
        "source", "where the signal starts"
    )
    car: CarNumber | None = _field(None, "car number, for source car")
    instant: Switch = _field(False, "no propagation, no rise")
    traction_limited: Switch = _field(False, "force mu_t m g instead of the brake law")
    delay_s: Number = _trigger("delay", "overall delay", ge=0, le=1e4)


class Brakes(Section):
    """The brakes and the emergency application at the start."""

    law: Literal["published", "braking_ratio"] = _field(
        "published",
        "force of a car: force_N for each (published), or from its net braking ratio, "
        "mass and load (braking_ratio)",
        later=True,
    )
    system: Literal["conventional", "two_way_eot", "distributed_power", "ecp"] = _brakes(
        "system",
        "how an emergency spreads: along the pipe from its source (conventional), from the rear "
        "end too by the radio of a two-way end-of-train device, from locomotives within and "
        "behind the train too, or to all cars at once",
        later=True,
    )
    radio_delay_s: Number = _brakes("radio_delay", "delay of the radio", later=True, ge=0, le=100)
    remote_locomotives: tuple[CarNumber, ...] = _field(
        (),
        "cars whose brake pipe the radio of distributed_power opens; none given: the first "
        "locomotive of each group behind the head",
        max_length=20,
        later=True,
    )
    net_braking_ratio_loaded: Number = _field(
        0.11,
        "shoe force of full service over weight, loaded; 0.085 to 0.14",
        ge=0,
        le=1,
        later=True,
    )
    net_braking_ratio_empty: Number = _field(
        0.25, "the same of an empty car, 0.15 to 0.38", ge=0, le=1, later=True
    )
    emergency_factor: Number = _field(
        1.2, "shoe force in emergency over that of full service", ge=1, le=3, later=True
    )
    hand_brake_ratio: Number = _field(
        0.1, "shoe force of a hand brake over the loaded weight", ge=0, le=1, later=True
    )
    ecp_ratio_factor: Number = _field(
        1.22, "shoe force of an ECP brake over that of others", ge=0.1, le=3, later=True
    )
    ecp_rise_time_s: Number = _field(
        12.0, "from zero to full force of an ECP brake", ge=0, le=1000, later=True
    )
    force_N: Number = _brakes("force", "full force F0 of a car near rest [R]", ge=0, le=1e7)
    force_scale: Number = _engine(
        BrakeUnit, "scale", "factor K_b on the brake of every car", ge=0, le=10
    )
    rise_time_s: Number = _brakes("rise_time", "from zero to full force", ge=0, le=1000)
    signal_speed_m_per_s: Number = _brakes(
        "signal_speed", "speed of the emergency signal", gt=0, le=1e6
    )
    traction_coefficient: Number = _brakes(
        "traction_coefficient", "mu_t of the traction limited mode", ge=0, le=2
    )
    vent_on_parting: Switch = _brakes(
        "vent_on_parting", "a parted coupling starts the emergency from there, both ways"
    )
    signal_source: Literal["front", "rear", "both_ends", "car", "none"] = _trigger(
        "source",
        "where the signal of the application at the start comes from; none: no such application",
    )
    signal_car: CarNumber | None = _field(None, "car number, for signal_source car")
    delay_s: Number = _trigger(
        "delay", "overall delay of the application at the start", ge=0, le=1e4
    )
    instant: Switch = _field(False, "application at the start: no propagation, no rise")
    traction_limited: Switch = _field(
        False, "application at the start: force mu_t m g instead of the brake law"
    )
    triggers: tuple[BrakeTriggerSpec, ...] = _field(
        (), "further emergency applications", max_length=100
    )


class NotchSpec(Section):
    """A setting of locomotives."""

    time_s: Number = _field(..., "when it is made", ge=0, le=1e5)
    notch: Notches = _field(..., "8 to 1 power, 0 idle, -1 to -8 dynamic brake")
    cars: tuple[CarNumber, ...] = _field(
        (), "car numbers of the locomotives; none: all of them", max_length=100
    )


class Traction(Section):
    """How the locomotives of the train pull and brake."""

    notch: Notches = _field(0, "at the start: 8 to 1 power, 0 idle, -1 to -8 dynamic brake")
    schedule: tuple[NotchSpec, ...] = _field(
        (), "later settings in order of their time", max_length=1000
    )
    response_time_s: Number = _traction(
        "response_time", "from none to the full effort", gt=0, le=600
    )
    cut_time_s: Number = _traction(
        "cut_time", "from the arrival of an emergency at a locomotive to no effort", gt=0, le=600
    )
    keep_dynamic: Switch = _traction("keep_dynamic", "an emergency leaves the dynamic brake on")


class Resistance(Section):
    """Rolling and air resistance of cars on the rails."""

    law: Literal["none", "fcalc"] = _field(
        "none", "none, or fcalc: 8.108e-3 m + 80.625 n + 1.8133e-4 m v + 0.1198 A v^2 (N)"
    )
    axles: Integer = _field(4, "axles n of cars whose type does not say", ge=2, le=24)
    area_m2: Number = _field(10.0, "frontal area A", ge=0, le=100)


class Ground(Section):
    """Ground reaction ``K(v) = c_d + (c_s - c_d) exp(-v/eps) + c_v v`` times the weight."""

    c_s: Number = _ground("c_s", "static coefficient", ge=0, le=100, unit="")
    c_d: Number = _ground("c_d", "dynamic coefficient", ge=0, le=100)
    eps_m_per_s: Number = _ground("eps", "speed that smooths the change at rest", gt=0, le=10)
    c_v_s_per_m: Number = _ground("c_v", "growth with speed [R]", ge=0, le=100)
    scale: Number = _ground("scale", "factor on the whole reaction", ge=0, le=100)


class Contact(Section):
    """Collisions between cars."""

    force_max_N: Number = _contact("force_max", "force at contact, F_max", gt=0, le=1e9)
    half_distance_m: Number = _contact(
        "half_distance", "gap at which it is half, d_c", gt=0, le=10
    )
    buffer_m: Number = _contact("buffer", "gap from which there is none, d_b", gt=0, le=10)
    c1_s2_per_m2: Number = _contact("c1", "speed factor: of v|v|", ge=0, le=100)
    c2_s_per_m: Number = _contact("c2", "speed factor: of v", ge=0, le=100)
    c3: Number = _contact("c3", "speed factor: constant", ge=0, le=100)
    gap_law: Literal["gaussian", "lorentzian", "sech2", "quartic"] = _contact(
        "gap_law", "shape of the gap law [R]"
    )
    inside: Literal["held", "even"] = _contact(
        "inside",
        "inside a body: held at F_max, or even, the same bell as outside (published runs) [R]",
    )
    begin_force_N: Number = _contact(
        "begin_force", "a collision begins above this [R]", gt=0, le=1e8
    )
    end_force_N: Number = _contact("end_force", "and ends below this [R]", gt=0, le=1e8)
    end_hold_s: Number = _contact("end_hold", "held for this long [R]", ge=0, le=10)


class Derailment(Section):
    """When trucks leave the rails and couplings part."""

    lv_limit: Number = _derailment(
        "lv_limit",
        "derailment quotient: a truck leaves the rails above this lateral over vertical force",
        gt=0,
        le=1e6,
    )
    lv_hold_s: Number = _derailment(
        "lv_hold", "time for which lv_limit must be exceeded; 0: at once", later=True, ge=0, le=10
    )
    truck_play_m: Number = _derailment(
        "truck_play",
        "play of trucks to either side between the rails; cars in buff turn within it",
        later=True,
        ge=0,
        le=0.2,
    )
    guide_strength_N: Number = _derailment(
        "guide_strength",
        "largest force across the track with which a rail guides a derailed truck; 0: none",
        later=True,
        ge=0,
        le=1e8,
    )
    guide_stiffness_N_per_m: Number = _derailment(
        "guide_stiffness", "stiffness of such a rail", later=True, gt=0, le=1e10
    )
    guide_play_m: Number = _derailment(
        "guide_play", "offset from the centre line from which it guides", later=True, ge=0, le=5
    )
    break_follows_lateral: Switch = _derailment(
        "break_follows_lateral",
        "a lateral derailment also breaks the rail there (rail roll-over) [R]",
    )
    break_ahead_of_truck_m: Number = _derailment(
        "break_ahead_of_truck",
        "distance ahead of the front truck at which a rail breaks under a car",
        ge=0,
        le=100,
    )
    knuckle_limit_ee_rad: Number = _derailment(
        "knuckle_limit_ee", "angle at which two E heads part", gt=0, le=3
    )
    knuckle_limit_ff_rad: Number = _derailment(
        "knuckle_limit_ff", "angle at which two F heads part", gt=0, le=3
    )
    knuckle_limit_ef_rad: Number = _derailment(
        "knuckle_limit_ef", "angle at which an E and an F head part [R]", gt=0, le=3
    )


class Integration(Section):
    """How the run is integrated and when it ends."""

    method: TypeName = _integration(
        "method", "row (friction near rest implicit) or rkf45 (the reference)"
    )
    rtol: Number = _integration(
        "rtol", "relative error allowed per step; 1e-4 suits rkf45", ge=1e-12, le=0.1
    )
    stabilization: Literal["projection", "baumgarte"] = _integration(
        "stabilization", "projection or baumgarte"
    )
    baumgarte_velocity_per_s: Number = _integration(
        "baumgarte_velocity", "its velocity constant [R]", ge=0, le=1e4
    )
    baumgarte_position_per_s2: Number = _integration(
        "baumgarte_position", "its position constant [R]", ge=0, le=1e7
    )
    locate_crossings: Switch = _integration(
        "locate_crossings",
        "find break crossings and coupling failures inside the step; false: only at step ends, "
        "as in the source",
    )
    buffer_fraction: Number = _integration(
        "buffer_fraction",
        "no corner of a car that may turn moves further than this share of the buffer in one step",
        gt=0,
        le=0.5,
    )
    max_step_s: Number = _integration("max_step", "longest step", gt=0, le=1)
    min_step_s: Number = _integration(
        "min_step", "shortest step: below it the run fails", gt=0, le=1
    )
    rest_speed_m_per_s: Number = _integration(
        "rest_speed", "at rest: all cars slower than this [R]", gt=0, le=1
    )
    rest_yaw_rate_rad_per_s: Number = _integration(
        "rest_yaw_rate", "and turning slower than this [R]", gt=0, le=1
    )
    rest_hold_s: Number = _integration("rest_hold", "for this long [R]", gt=0, le=60)
    time_limit_s: Number = _integration(
        "time_limit",
        "the run ends with the first step that ends at this time or later, at rest or not",
        gt=0,
        le=1e5,
    )


class InputSpec(Section):
    """A file that a scenario was made from; it is looked for beside the scenario."""

    file: FileName = _field(..., "its name")
    sha256: Sha256 = _field(..., "SHA-256 of its content, hexadecimal")


class Datum(Section):
    """Where on the Earth the origin of the frame is, and how the frame is turned (WGS 84)."""

    latitude_deg: Number = _field(..., "latitude, north positive", ge=-89, le=89)
    longitude_deg: Number = _field(..., "longitude, east positive", ge=-180, le=180)
    altitude_m: Number = _field(0.0, "height above the ellipsoid", ge=-1000, le=10_000)
    azimuth_deg: Number = _field(
        90.0, "direction of the x axis, clockwise from north", ge=-360, le=360
    )


Vertex = tuple[Number, Number]


class Outlined(Section):
    """Something with an outline."""

    name: Title = _field(..., "name in outputs")
    outline_m: tuple[Vertex, ...] = _field(
        (), "vertices [x, y] in the frame of the track", max_length=2000
    )
    outline_along_m: tuple[Vertex, ...] = _field(
        (), "or vertices [track coordinate, offset to the left]", max_length=2000
    )


class ZoneSpec(Outlined):
    """Ground with its own constants inside a polygon; where zones overlap, the last one counts."""

    factor: Number | None = _field(None, "factor on the constants of `ground`", ge=0, le=100)
    preset: Literal["soil_lowest", "soil_highest"] | None = _field(
        None, "resistance 1 or 3.5: the range that the source cites for soils"
    )
    c_s: Number | None = _field(None, "static coefficient; that of ground", ge=0, le=100, unit="")
    c_d: Number | None = _field(None, "dynamic coefficient; that of ground", ge=0, le=100)
    eps_m_per_s: Number | None = _field(
        None, "speed that smooths the change at rest; that of ground", gt=0, le=10
    )
    c_v_s_per_m: Number | None = _field(None, "growth with speed; that of ground", ge=0, le=100)
    rise_percent: Number = _field(0.0, "slope, rise over run", ge=0, le=200)
    uphill_deg: Number | None = _field(
        None, "direction uphill, counter-clockwise from the x axis", ge=-360, le=360
    )


class FixedSpec(Outlined):
    """A wall, pier or building that cars strike."""

    closed: Switch = _field(False, "a polygon (pier, building), or else a chain (wall)")
    yields_at_N: Number | None = _field(
        None, "force of one corner of a car that pushes it in; null: rigid", gt=0, le=1e9
    )
    takes_J: Number | None = _field(
        None,
        "energy after which it gives way for good: each segment of a chain, a polygon as a "
        "whole; null: never",
        gt=0,
        le=1e12,
    )
    height_m: Number = _field(
        WALL_HEIGHT,
        "over the ground, in model spatial; the default is assumed",
        later=True,
        gt=0,
        le=500,
    )


class AreaSpec(Outlined):
    """A polygon or a line; the outcome says which cars enter it."""

    closed: Switch = _field(True, "a polygon, or else a line")


class SecondTrackSpec(Section):
    """A track beside the main one: at an offset, or with an alignment of its own."""

    name: Title = _field(..., "name in outputs")
    offset_m: Number | None = _field(
        None, "how far to the left of the main track; negative: right", ge=-1e3, le=1e3
    )
    from_m: Number | None = _field(
        None, "with offset_m: coordinate of the main track beside which it begins, and its own"
    )
    to_m: Number | None = _field(None, "the same for its end")
    alignment: tuple[Piece, ...] = _field((), "or pieces as those of `track`", max_length=1000)
    start_coordinate_m: Number = _field(0.0, "coordinate where the alignment begins")
    start_x_m: Number = _field(0.0, "x where the alignment begins", ge=-1e6, le=1e6)
    start_y_m: Number = _field(0.0, "y where the alignment begins", ge=-1e6, le=1e6)
    start_heading_rad: Number = _field(
        0.0, "direction in which it begins, CCW from +X", ge=-10, le=10
    )


class StandingSpec(Section):
    """Coupled cars that stand on a second track."""

    track: Title = _field(..., "name of the second track")
    position_m: Number = _field(
        ..., "coordinate of the first car's mass centre there; the others stand behind it"
    )
    consist: tuple[ConsistBlock, ...] = _field(
        ..., "blocks of cars, as of the train", min_length=1, max_length=500
    )


class Site(Section):
    """The place of the scenario."""

    datum: Datum | None = _field(None, "where on the Earth it is")
    file: FileName | None = _field(
        None,
        "GeoJSON file beside the scenario; its features become zones, fixed bodies and areas "
        "when the scenario is read",
        later=True,
    )
    reference_system: Label | None = _field(
        None,
        "of the file: EPSG:4326 (longitude and latitude, unless given), another by pyproj, or "
        "`local`: x and y in m",
        later=True,
    )
    zones: tuple[ZoneSpec, ...] = _field(
        (), "polygons of ground with constants of their own", max_length=500, later=True
    )
    fixed: tuple[FixedSpec, ...] = _field(
        (), "walls, piers and buildings", max_length=500, later=True
    )
    areas: tuple[AreaSpec, ...] = _field(
        (),
        "lines and polygons; the outcome says which cars enter them",
        max_length=500,
        later=True,
    )
    tracks: tuple[SecondTrackSpec, ...] = _field(
        (), "tracks beside the main one", max_length=100, later=True
    )
    standing: tuple[StandingSpec, ...] = _field(
        (), "cars that stand on them", max_length=100, later=True
    )
    border_m: Number = _field(
        0.5,
        "width over which the ground of one zone passes into the next",
        gt=0,
        le=100,
        later=True,
    )


class ScenarioModel(Section):
    """A derailment scenario."""

    version: Literal[1] = _field(..., "version of the format")
    title: Title = _field(..., "what it is, in a line")
    description: Text = _field("", "longer description")
    source: Text = _field("", "source of the numbers")
    model: TypeName = _field(PLANAR, "model that computes the run; `derail models` lists them")
    constants: Literal["published", "calibrated"] | None = _field(
        None,
        "constants for fields that are not given: published (the thesis') or calibrated (learned "
        "from accident reports); null: calibrated, if such a field is left open",
        later=True,
    )
    drawn: tuple[Label, ...] = _field(
        (), "written by programs: the constants here that ensembles draw", later=True
    )
    uncertain: dict[str, Uncertain] = _field(
        {},
        "dotted path -> what members of an ensemble draw for it; `*` is every entry of a list",
        later=True,
        max_length=50,
    )
    inputs: tuple[InputSpec, ...] = _field(
        (),
        "files that this one was made from; they travel with recordings",
        later=True,
        max_length=20,
    )
    train: Train = _field(..., "the train and its speed")
    couplers: Couplers = _field(Couplers(), "values for all couplers, and types")
    track: TrackSection = _field(TrackSection(), "the centre line and its breaks")
    initiation: Initiation = _field(Initiation(), "how the derailment starts")
    brakes: Brakes = _field(Brakes(), "brakes and their application")
    traction: Traction = _field(Traction(), "how the locomotives pull and brake", later=True)
    resistance: Resistance = _field(Resistance(), "rolling and air resistance", later=True)
    ground: Ground = _field(Ground(), "reaction of the ground on derailed trucks and bodies")
    contact: Contact = _field(Contact(), "collisions between cars")
    derailment: Derailment = _field(Derailment(), "when trucks leave the rails and couplings part")
    integration: Integration = _field(Integration(), "integration and the end of the run")
    site: Site | None = _field(
        None, "the place: where on the Earth it is, and what is beside the track", later=True
    )
