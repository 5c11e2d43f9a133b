"""Messages about a run: train, track, events, contacts, commands, outcome, diagnostics."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from derail_ros.vocabulary.events import Collision, Event, EventKind
from derail_ros.vocabulary.params import DerailmentParams, TrainParams
from derail_ros.vocabulary.severity import severity
from derail_ros.vocabulary.status import STATUSES
from msg_adapters.common import NANOSECONDS, RunContext, header, time_message
from msg_adapters.definitions import message_class

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from derail_ros.vocabulary.outcome import Outcome

END = {"": 0, "front": 1, "rear": 2}
WALL_UNKNOWN = 255

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
) -> Any:
    """``derail_msgs/Consist``: what the train is made of and where the run comes from."""
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
        rail_break_coordinate=np.array([s for s, _ in breaks], dtype=np.float64),
        rail_break_x=places[0],
        rail_break_y=places[1],
        rail_break_time=np.array([t for _, t in breaks], dtype=np.float64),
    )


# --- events ----------------------------------------------------------------------------------


def kind_number(kind: EventKind) -> int:
    """Number of a kind of event in ``derail_msgs/TrainEvent``."""
    return int(getattr(message_class("derail_msgs/msg/TrainEvent"), f"KIND_{kind.name}"))


def train_event(event: Event, sequence: int, context: RunContext) -> Any:
    """``derail_msgs/TrainEvent`` of an event."""
    cause = event.cause
    if event.kind == EventKind.RAIL_BREAK_SET and cause == "initial":
        cause = "scenario"
    return message_class("derail_msgs/msg/TrainEvent")(
        header=context.header(event.time),
        run_id=context.run_id,
        step=int(event.step),
        time=float(event.time),
        sequence=sequence,
        kind=kind_number(event.kind),
        kind_name=event.kind.name.lower(),
        cars=np.array(event.cars, dtype=np.uint32),
        end=END[event.end],
        cause=cause,
        x=float(event.x),
        y=float(event.y),
        track_coordinate=float(event.track_coordinate),
        speed=float(event.speed),
        value=float(event.value),
        value_unit=event.value_unit,
        before=event.before,
        after=event.after,
        text=event.text,
    )


def event_from_message(message: Any) -> Event:
    """The event that a ``derail_msgs/TrainEvent`` tells of."""
    ends = {number: name for name, number in END.items()}
    cause = "initial" if message.cause == "scenario" else message.cause
    return Event(
        kind=EventKind[message.kind_name.upper()],
        time=float(message.time),
        step=int(message.step),
        cars=tuple(int(c) for c in message.cars),
        end=ends[int(message.end)],
        cause=cause,
        x=float(message.x),
        y=float(message.y),
        track_coordinate=float(message.track_coordinate),
        speed=float(message.speed),
        value=float(message.value),
        before=message.before,
        after=message.after,
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
        id=int(contact.id),
        is_final=bool(contact.final),
        car_a=int(contact.car_a),
        car_b=int(contact.car_b),
        corner_car=int(contact.corner_car),
        corner=int(contact.corner),
        struck_wall=WALL_UNKNOWN,
        start_time=float(contact.start),
        end_time=float(contact.end),
        peak_corner_force=float(contact.peak_force),
        peak_corner_force_time=float(contact.peak_time),
        peak_resultant_force=float(contact.peak_resultant),
        peak_resultant_force_time=float(contact.peak_resultant_time),
        closing_speed=float(contact.closing_speed),
        x=float(contact.x),
        y=float(contact.y),
        normal_x=float(contact.normal_x),
        normal_y=float(contact.normal_y),
        angle=float(contact.angle),
        energy_taken_out=float(contact.energy_lost),
    )


def collision_from_message(message: Any) -> Collision:
    """The contact that a ``derail_msgs/Collision`` tells of."""
    return Collision(
        id=int(message.id),
        final=bool(message.is_final),
        car_a=int(message.car_a),
        car_b=int(message.car_b),
        corner_car=int(message.corner_car),
        corner=int(message.corner),
        start=float(message.start_time),
        end=float(message.end_time),
        peak_force=float(message.peak_corner_force),
        peak_time=float(message.peak_corner_force_time),
        peak_resultant=float(message.peak_resultant_force),
        peak_resultant_time=float(message.peak_resultant_force_time),
        closing_speed=float(message.closing_speed),
        x=float(message.x),
        y=float(message.y),
        normal_x=float(message.normal_x),
        normal_y=float(message.normal_y),
        angle=float(message.angle),
        energy_lost=float(message.energy_taken_out),
    )


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


def outcome(
    result: Outcome,
    context: RunContext,
    *,
    time: float,
    step: int,
    status: str = "",
) -> Any:
    """``derail_msgs/Outcome`` at the run time ``time``.

    ``status`` overrides the engine's ("failed", "stopped").
    """
    status = status or result.status
    final = result.final or status in ("failed", "stopped")
    pair = result.peak_force_pair or (0, 0)
    pose = np.ascontiguousarray(result.pose[:, [0, 1, 5]].T)
    residual = float(result.energy_residual)
    initial = float(result.energy.get("initial", math.nan))
    return message_class("derail_msgs/msg/Outcome")(
        header=context.header(time),
        run_id=context.run_id,
        step=int(step),
        time=float(time),
        status=STATUSES[status].number,
        status_name=status,
        is_final=bool(final),
        is_void=bool(result.void),
        duration=float(result.duration) if math.isfinite(result.duration) else float(time),
        rejected_steps=int(result.rejected_steps),
        cars_derailed=len(result.derailed_cars),
        derailed_cars=np.array(result.derailed_cars, dtype=np.uint32),
        derailment_time=np.ascontiguousarray(result.derail_time, dtype=np.float64),
        derailment_speed=np.ascontiguousarray(result.derail_speed, dtype=np.float64),
        peak_corner_force=float(result.peak_force),
        peak_car_a=int(pair[0]),
        peak_car_b=int(pair[1]),
        peak_corner_force_time=float(result.peak_force_time),
        peak_resultant_force=float(result.peak_resultant),
        car_peak_force=np.ascontiguousarray(result.car_peak_force, dtype=np.float64),
        car_peak_other_car=np.ascontiguousarray(result.car_peak_other, dtype=np.uint32),
        car_peak_time=np.ascontiguousarray(result.car_peak_time, dtype=np.float64),
        cars_above_5mn=np.array(result.cars_above_5MN, dtype=np.uint32),
        cars_above_10mn=np.array(result.cars_above_10MN, dtype=np.uint32),
        scene_length=float(result.scene_length),
        scene_width=float(result.scene_width),
        scene_area=float(result.scene_area),
        x=pose[0],
        y=pose[1],
        yaw=pose[2],
        rear_part_first_car=result.rear_part_first_car,
        rear_part_track_coordinate=result.rear_part_coordinate,
        max_coupler_gap=float(result.max_coupler_gap),
        max_truck_offset=float(result.max_truck_offset),
        energy_initial=initial,
        energy_residual=residual * initial,
        energy_residual_relative=residual,
        severity=severity(result),
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
