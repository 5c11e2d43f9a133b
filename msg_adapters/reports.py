"""Messages about a run: train, track, events, contacts, commands, outcome, diagnostics."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import struct
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from derail_ros.vocabulary.events import Collision, Event, EventKind
from derail_ros.vocabulary.measures import MEASURES, TEXT
from derail_ros.vocabulary.outcome import PARTED_CAUSES, Outcome, Parted, StandingOutcome
from derail_ros.vocabulary.params import DerailmentParams, TrainParams
from derail_ros.vocabulary.site import Entered, SiteOutcome, Struck
from derail_ros.vocabulary.status import STATUSES
from derail_ros.vocabulary.train import TRAIN_COUNTS, TrainTotals, length_over_couplers
from msg_adapters.car_frame import heights
from msg_adapters.common import NANOSECONDS, RunContext, header, time_message
from msg_adapters.definitions import message_class

if TYPE_CHECKING:
    from numpy.typing import NDArray


CUT = "standing_cut"
"""Key of what ``Consist.more`` says of standing cars: the number of the cut of each, from 1, 0 for
the train's own."""
GRAVITY_HEIGHT = "gravity_height_m"
"""Key of what ``Consist.more`` says of the mass centres in a model that computes heights: theirs
over the rails at rest, from which ``TrainState.z`` counts, m."""
TRACK_SPACING = 10.0
"""Distance between the points that describe the centre line, m."""
TRACK_POINTS = 5000
"""No more points than this; a longer line is sampled more coarsely."""
TRACK_BEHIND, TRACK_AHEAD = 100.0, 1500.0
"""How much of an endless straight is shown behind and ahead of the train, m."""


# --- train and track -------------------------------------------------------------------------


def angle_limit(head_a: str, head_b: str, limits: DerailmentParams) -> float:
    """Relative angle at which a coupling of two heads parts, rad."""
    if head_a != head_b:
        return limits.knuckle_limit_ef
    return limits.knuckle_limit_ee if head_a == "E" else limits.knuckle_limit_ff


def consist(
    params: TrainParams,
    context: RunContext,
    *,
    name: str = "",
    scenario_hash: str = "",
    scenario_yaml: str = "",
    software_version: str = "",
    engine_hash: str = "",
    car_types: Sequence[str] = (),
    files: Mapping[str, bytes] | None = None,
    rises: bool = False,
) -> Any:
    """``derail_msgs/Consist``: what the train is made of and where the run comes from.

    ``files`` are those that the scenario was made from: name -> content. ``rises``: the model
    computes heights.
    """
    file = message_class("derail_msgs/msg/InputFile")
    cars = params.cars
    types = [*car_types, *([""] * (len(cars) - len(car_types)))]

    def doubles(values: Iterable[float]) -> NDArray[np.float64]:
        return np.array([float(v) for v in values], dtype=np.float64)

    return message_class("derail_msgs/msg/Consist")(
        header=context.header(0.0),
        run_id=context.run_id,
        scenario_name=name,
        scenario_hash=scenario_hash,
        scenario_yaml=scenario_yaml,
        software_version=software_version,
        engine_hash=engine_hash,
        model=params.model,
        files=[
            file(name, hashlib.sha256(data).hexdigest(), np.frombuffer(data, np.uint8))
            for name, data in (files or {}).items()
        ],
        initial_speed=float(params.initiation.speed),
        car_name=[car.name or f"car {i}" for i, car in enumerate(cars, 1)],
        car_type=types,
        contents=[car.contents for car in cars],
        mass=doubles(car.mass for car in cars),
        inertia=doubles(car.inertia for car in cars),
        length=doubles(car.length for car in cars),
        width=doubles(car.width for car in cars),
        pivot_distance=doubles(car.pivot_distance for car in cars),
        truck_distance=doubles(car.truck_distance for car in cars),
        coupler_type_front=[car.front.name for car in cars],
        coupler_type_rear=[car.rear.name for car in cars],
        head_type_front=[car.front.head for car in cars],
        head_type_rear=[car.rear.head for car in cars],
        coupler_length_front=doubles(car.front.length for car in cars),
        coupler_length_rear=doubles(car.rear.length for car in cars),
        striker_arm_front=doubles(car.front.striker_arm for car in cars),
        striker_arm_rear=doubles(car.rear.striker_arm for car in cars),
        coupler_inertia=doubles(car.coupler_inertia for car in cars),
        coupling_angle_limit=doubles(
            angle_limit(a.rear.head, b.front.head, params.derailment)
            for a, b in zip(cars[:-1], cars[1:])
        ),
        brake_type=[car.brakes[0].shoe if car.brakes else "none" for car in cars],
        brake_scale=doubles(car.brakes[0].scale if car.brakes else 0.0 for car in cars),
        represents_cars=np.array([car.represents for car in cars], dtype=np.uint32),
        more=[
            quantity("length_over_couplers_m", doubles(map(length_over_couplers, cars)), "m"),
            *(quantity(key, doubles(getattr(c, key) for c in cars)) for key in TRAIN_COUNTS),
            *([quantity(CUT, params.cut_numbers)] if params.standing else []),
            *([quantity(GRAVITY_HEIGHT, heights(cars), "m")] if rises else []),
        ],
    )


def track_coordinates(track: Any, truck_coordinate: NDArray[np.float64]) -> NDArray[np.float64]:
    """Track coordinates (m) at which the centre line is described.

    A finite alignment is described from end to end; of an endless straight only the part around
    the train, given by where its trucks stand at the start.
    """
    start = track.start
    end = track.end
    if not math.isfinite(start):
        start = math.floor((float(truck_coordinate.min()) - TRACK_BEHIND) / 10.0) * 10.0
    if not math.isfinite(end):
        end = math.ceil((float(truck_coordinate.max()) + TRACK_AHEAD) / 10.0) * 10.0
    points = min(TRACK_POINTS, max(2, math.ceil((end - start) / TRACK_SPACING) + 1))
    return np.linspace(start, end, points)


def _height(line: Any, s: float) -> tuple[float, float]:
    """Height (m) and grade at a track coordinate; an engine may know of none."""
    return line.height(s) if hasattr(line, "height") else (0.0, 0.0)


def track(
    line: Any,
    coordinates: NDArray[np.float64],
    breaks: Sequence[tuple[float, float]],
    context: RunContext,
    time: float = 0.0,
) -> Any:
    """``derail_msgs/Track``: the centre line at ``coordinates`` and the breaks.

    ``breaks`` are pairs of track coordinate (m) and the run time at which each opened (s).
    """
    points = np.array([line.point(float(s)) for s in coordinates], dtype=np.float64)
    heights = np.array([_height(line, float(s)) for s in coordinates], dtype=np.float64)
    points = np.ascontiguousarray(points.reshape(-1, 4).T)
    places = np.array([line.point(s)[:2] for s, _ in breaks], dtype=np.float64)
    places = np.ascontiguousarray(places.reshape(-1, 2).T)
    return message_class("derail_msgs/msg/Track")(
        header=context.header(time),
        run_id=context.run_id,
        s=np.ascontiguousarray(coordinates, dtype=np.float64),
        x=points[0],
        y=points[1],
        heading=points[2],
        curvature=points[3],
        z=np.ascontiguousarray(heights[:, 0]),
        grade=np.ascontiguousarray(heights[:, 1]),
        rail_break_coordinate=np.array([s for s, _ in breaks], dtype=np.float64),
        rail_break_x=places[0],
        rail_break_y=places[1],
        rail_break_time=np.array([t for _, t in breaks], dtype=np.float64),
        more=[],
    )


# --- events ----------------------------------------------------------------------------------


def train_event(event: Event, sequence: int, context: RunContext) -> Any:
    """``derail_msgs/TrainEvent`` of an event."""
    more = [quantity(key, [value]) for key, value in event.more.items()]
    same = {name: getattr(event, name) for name in _EVENT}
    return message_class("derail_msgs/msg/TrainEvent")(
        header=context.header(event.time),
        run_id=context.run_id,
        sequence=sequence,
        kind=int(event.kind),
        kind_name=event.kind.name.lower(),
        cars=np.array(event.cars, dtype=np.uint32),
        value_unit=event.value_unit,
        text=event.text,
        more=more,
        **same,
    )


_EVENT = ("step", "time", "end", "cause", "x", "y", "z", "track_coordinate", "speed", "value",
          "object", "before", "after")  # fmt: skip
"""Fields that an event and its message have alike."""


def event_from_message(message: Any) -> Event:
    """The event of a ``derail_msgs/TrainEvent``.

    Raises
    ------
    KeyError
        If it is of a kind that is not known here.
    """
    return Event(
        kind=EventKind[message.kind_name.upper()],
        cars=tuple(int(c) for c in message.cars),
        more={q.key: float(q.values[0]) for q in message.more},
        **{name: getattr(message, name) for name in _EVENT},
    )


# --- contacts --------------------------------------------------------------------------------


def collision(contact: Collision, step: int, context: RunContext) -> Any:
    """``derail_msgs/Collision`` of a contact at its peak or, final, at its end."""
    time = contact.end if contact.final else contact.peak_time
    return message_class("derail_msgs/msg/Collision")(
        header=context.header(time),
        run_id=context.run_id,
        step=step,
        time=float(time),
        **dataclasses.asdict(contact),
    )


def collision_from_message(message: Any) -> Collision:
    """The contact of a ``derail_msgs/Collision``."""
    return Collision(**{f.name: getattr(message, f.name) for f in dataclasses.fields(Collision)})


# --- commands --------------------------------------------------------------------------------


def jsonable(value: Any) -> Any:
    """The value in types that JSON knows; non-finite numbers become their names."""
    if isinstance(value, Mapping):
        return {str(k): jsonable(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [jsonable(v) for v in value]
    if isinstance(value, np.ndarray):
        return jsonable(value.tolist())
    if isinstance(value, np.generic):
        return jsonable(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return "nan" if math.isnan(value) else ("inf" if value > 0 else "-inf")
    return value


def command_log(
    *,
    context: RunContext,
    step: int,
    time: float,
    sequence: int,
    command: str,
    request: Mapping[str, Any],
    caller: str,
    accepted: bool,
    answer: str,
) -> Any:
    """``derail_msgs/CommandLog`` of a command and its answer."""
    stamp = context.stamp(time)
    return message_class("derail_msgs/msg/CommandLog")(
        header=header(stamp, context.frame_id),
        run_id=context.run_id,
        step=int(step),
        time=float(time),
        sequence=sequence,
        command=command,
        request_json=json.dumps(jsonable(request), allow_nan=False),
        caller=caller,
        accepted=accepted,
        message=answer,
        applied_at=time_message(stamp),
    )


# --- outcome ---------------------------------------------------------------------------------


def quantity(key: str, values: Sequence[float] | NDArray[np.float64], unit: str = "") -> Any:
    """``derail_msgs/Quantity``."""
    return message_class("derail_msgs/msg/Quantity")(
        key=key, unit=unit, values=np.ascontiguousarray(values, dtype=np.float64)
    )


def ledger(entries: Mapping[str, float]) -> list[Any]:
    """Entries of an energy ledger (J) as ``derail_msgs/Quantity[]``."""
    return [quantity(key, [value], "J") for key, value in entries.items()]


def ledger_from_message(entries: Iterable[Any]) -> dict[str, float]:
    """The energy ledger of ``derail_msgs/Quantity[]``: entry -> J."""
    return {q.key: float(q.values[0]) for q in entries}


CAR_VALUES = {
    "derail_time_s": "derail_time",
    "derail_speed_m_per_s": "derail_speed",
    "car_peak_force_N": "car_peak_force",
    "car_peak_time_s": "car_peak_time",
    "car_peak_other": "car_peak_other",
}
"""Quantity of the cars in an outcome's message -> attribute of ``Outcome``, (N,)."""
POSE = {"x_m": 0, "y_m": 1, "z_m": 2, "roll_rad": 3, "pitch_rad": 4, "yaw_rad": 5}
"""Quantity of the cars -> column of ``Outcome.pose``."""


def measure_value(kind: str, value: Any) -> list[float]:
    """A measure's value as a message holds it: a number, car numbers, or nothing."""
    if value is None or kind == TEXT:
        return []
    return [float(v) for v in (value if isinstance(value, (list, tuple)) else [value])]


_PARTED = ("parted_time_s", "parted_cause", "parted_force_N")


def _parted(result: Outcome) -> dict[str, NDArray[np.float64]]:
    """When, why (a number of ``PARTED_CAUSES``) and at what force couplings parted, else nan."""
    rows = np.full((len(_PARTED), len(result.pose) - 1), math.nan)
    for p in result.parted:
        cause = PARTED_CAUSES.index(p.cause) if p.cause in PARTED_CAUSES else math.nan
        rows[:, p.coupling - 1] = p.time, cause, p.force
    return dict(zip(_PARTED, rows, strict=True))


def _told_parted(behind: Mapping[str, NDArray[np.float64]]) -> tuple[Parted, ...]:
    """The inverse of :func:`_parted`."""
    rows = zip(*(behind.get(key, np.zeros(0)).tolist() for key in _PARTED), strict=True)
    found = [
        Parted(k, time, PARTED_CAUSES[int(cause)] if math.isfinite(cause) else "", force)
        for k, (time, cause, force) in enumerate(rows, 1)
        if math.isfinite(time)
    ]
    return tuple(sorted(found, key=lambda p: p.time))


_FIXED, _STRUCK, _ZONE, _EVER, _NOW = (
    f"site_{kind}:" for kind in ("fixed", "struck_by", "zone", "ever", "now")
)
"""Beginnings of the keys of what came of a run at its place, before the name of the part."""


def _site(site: SiteOutcome | None, n: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """The place in an outcome: values of bodies, and values of each of ``n`` cars."""
    if site is None:
        return {}, {}

    def row(cars: Sequence[int]) -> NDArray[np.float64]:
        values = np.zeros(n)
        values[np.array(cars, dtype=int) - 1] = np.arange(1, len(cars) + 1)
        return values

    bodies = {_FIXED + f.name: [f.force, f.energy, float(f.given_way)] for f in site.fixed}
    cars = {_STRUCK + f.name: row(f.struck_by) for f in site.fixed}
    cars |= {_ZONE + name: row(found) for name, found in site.zones}
    for entered in site.inside:
        cars |= {_EVER + entered.name: row(entered.ever), _NOW + entered.name: row(entered.now)}
    return bodies, cars


def _told_site(told: dict[str, Any], cars: dict[str, Any]) -> SiteOutcome | None:
    """The inverse of :func:`_site`; takes what belongs to it out of both."""

    def taken(rows: dict[str, Any], begin: str) -> dict[str, Any]:
        return {key[len(begin) :]: rows.pop(key) for key in list(rows) if key.startswith(begin)}

    def numbers(row: Any) -> tuple[int, ...]:
        order = np.argsort(row, kind="stable")
        return tuple(int(i) + 1 for i in order if row[i] > 0.0)

    bodies, by = taken(told, _FIXED), taken(cars, _STRUCK)
    zones, ever, now = (taken(cars, begin) for begin in (_ZONE, _EVER, _NOW))
    if not (bodies or zones or ever):
        return None
    return SiteOutcome(
        tuple(Struck(k, v[0], v[1], numbers(by[k]), int(v[2])) for k, v in bodies.items()),
        tuple((k, numbers(v)) for k, v in zones.items()),
        tuple(Entered(k, numbers(v), numbers(now[k])) for k, v in ever.items()),
    )


def outcome_fields(result: Outcome) -> dict[str, Any]:
    """What the message of an outcome says of it."""
    # Nothing is sent for what does not exist, nor for a list without cars: Fast CDR puts bytes
    # behind an empty sequence of doubles that others do not expect.
    measures = [
        quantity(m.key, values, m.unit)
        for m in MEASURES.values()
        if (values := measure_value(m.kind, m.value(result)))
    ]
    cars = [quantity(key, getattr(result, name)) for key, name in CAR_VALUES.items()]
    cars += [quantity(key, result.pose[:, k]) for key, k in POSE.items()]
    bodies, at_site = _site(result.site, len(result.pose))
    measures += [quantity(key, values) for key, values in bodies.items()]
    cars += [quantity(key, values) for key, values in {**result.car_values, **at_site}.items()]
    # of the coupling behind each car: none behind the last one
    behind = {**result.couplings, **_parted(result)} if result.couplings else {}
    cars += [quantity(f"behind_{key}", [*v, math.nan]) for key, v in behind.items()]
    return {
        "status": STATUSES[result.status].number,
        "status_name": result.status,
        "is_final": result.final,
        "is_void": result.void,
        "derailed_cars": np.array(result.derailed_cars, dtype=np.uint32),
        "measures": measures,
        "cars": cars,
        "energy": ledger(result.energy),
    }


def outcome(
    result: Outcome, context: RunContext, *, time: float, step: int, status: str = ""
) -> Any:
    """``derail_msgs/Outcome`` at the run time ``time``.

    ``status`` overrides the engine's ("failed", "stopped").
    """
    if status:
        result = dataclasses.replace(result, status=status)
    return message_class("derail_msgs/msg/Outcome")(
        header=context.header(time),
        run_id=context.run_id,
        step=int(step),
        time=float(time),
        **outcome_fields(result),
    )


def outcome_from_message(message: Any) -> Outcome:
    """The outcome of a ``derail_msgs/Outcome``."""
    told = {q.key: q.values.tolist() for q in message.measures}
    cars = {q.key: np.array(q.values) for q in message.cars}

    def number(key: str) -> float:
        return told[key][0] if told.get(key) else math.nan

    def whole(key: str) -> int:
        return int(told[key][0]) if told.get(key) else 0

    site = _told_site(told, cars)
    n = len(cars["x_m"])
    pair = [int(c) for c in told.get("peak_force_pair", [])]
    blank = Outcome.nothing(
        np.stack([cars.get(key, np.zeros(n)) for key in POSE], axis=-1),
        str(message.status_name),
        number("end_time_s"),
        int(message.step),
    )
    behind = {k[7:]: cars.pop(k)[:-1] for k in list(cars) if k.startswith("behind_")}
    known = {name: cars[key] for key, name in CAR_VALUES.items() if key in cars}
    known["car_peak_other"] = known["car_peak_other"].astype(np.int64)
    return dataclasses.replace(
        blank,
        duration=number("duration_s"),
        rejected_steps=whole("rejected_steps"),
        derailed_cars=tuple(int(c) for c in told.get("derailed_cars", [])),
        peak_force=number("peak_force_N"),
        peak_force_pair=(pair[0], pair[1]) if len(pair) == 2 else None,
        peak_force_time=number("peak_force_time_s"),
        peak_resultant=number("peak_resultant_N"),
        scene_length=number("scene_length_m"),
        scene_width=number("scene_width_m"),
        scene_area=number("scene_area_m2"),
        max_coupler_gap=number("max_coupler_gap_m"),
        max_truck_offset=number("max_truck_offset_m"),
        rear_part_first_car=whole("rear_part_first_car"),
        rear_part_coordinate=number("rear_part_coordinate_m"),
        energy=ledger_from_message(message.energy),
        energy_residual=number("energy_residual"),
        train=TrainTotals(
            whole("train_cars"),
            **{key: whole(f"train_{key}") for key in TRAIN_COUNTS},
            length=number("train_length_m"),
            mass=number("train_mass_kg"),
        ),
        couplings={k: v for k, v in behind.items() if k not in _PARTED},
        parted=_told_parted(behind),
        standing=StandingOutcome(
            whole("standing_cars"),
            *(
                tuple(int(c) for c in told.get(f"standing_{key}", []))
                for key in ("struck", "moved", "derailed")
            ),
        ),
        values={key: values[0] for key, values in told.items() if len(values) == 1},
        site=site,
        car_values={k: v for k, v in cars.items() if k not in CAR_VALUES and k not in POSE},
        **known,
    )


# --- time, diagnostics, manifest -------------------------------------------------------------


def clock(stamp: int) -> bytes:
    """CDR bytes of ``rosgraph_msgs/Clock``; by hand, for they go out a hundred times a second."""
    return struct.pack("<4siI", b"\0\1\0\0", *divmod(stamp, NANOSECONDS))


def diagnostics(
    stamp: int, name: str, level: int, message: str, values: Mapping[str, Any], hardware_id: str
) -> Any:
    """``diagnostic_msgs/DiagnosticArray`` with one status."""
    pair = message_class("diagnostic_msgs/msg/KeyValue")
    status = message_class("diagnostic_msgs/msg/DiagnosticStatus")(
        level=level,
        name=name,
        message=message,
        hardware_id=hardware_id,
        values=[pair(key, _text(value)) for key, value in values.items()],
    )
    return message_class("diagnostic_msgs/msg/DiagnosticArray")(header(stamp, ""), [status])


def _text(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def string(text: str) -> Any:
    """``std_msgs/String``."""
    return message_class("std_msgs/msg/String")(text)
