"""Events of a run: what happened, when, where, to which cars and why."""

from __future__ import annotations

import enum
from dataclasses import dataclass, field


class EventKind(enum.IntEnum):
    """Kinds of event; the numbers are those of ``derail_msgs/TrainEvent``."""

    RUN_LOADED = 0
    TRUCK_DERAILED = 1
    COUPLER_PARTED = 2
    RAIL_BREAK_SET = 3
    BRAKES_TRIGGERED = 4
    BRAKE_SIGNAL_REACHED = 5
    CAR_AT_REST = 6
    RUN_ENDED = 7
    RUN_VOID = 8
    RUN_FAILED = 9
    RUN_RESET = 10


@dataclass(frozen=True)
class Event:
    """One thing that happened in a run.

    Attributes
    ----------
    kind : what happened
    time : simulation time at which it happened, s
    step : number of accepted steps when it was recorded
    cars : car numbers (1 leads); a coupling is named by its two cars
    end : "front" or "rear" truck of ``cars[0]``, or ""
    cause : why: "initial", "rail break", "lateral force", "angle", "command", ...
    x, y : place, m (nan where there is none)
    track_coordinate : arc length along the track, m (nan where there is none)
    speed : speed of the first car's mass centre, m/s (nan where there is none)
    value : the number behind the cause (quotient, angle in rad, force in N, ...)
    before, after : state before and after, in words ("on rails" -> "derailed")
    """

    kind: EventKind
    time: float
    step: int
    cars: tuple[int, ...] = ()
    end: str = ""
    cause: str = ""
    x: float = float("nan")
    y: float = float("nan")
    track_coordinate: float = float("nan")
    speed: float = float("nan")
    value: float = float("nan")
    before: str = ""
    after: str = ""


@dataclass(frozen=True)
class Collision:
    """One contact between two cars, from 10 kN up to its end.

    "Car a struck car b": a is the car whose contact point came faster along the normal when the
    contact began.

    Attributes
    ----------
    id : number of the contact within the run, from 0, in order of their beginning
    final : False while the contact goes on
    car_a, car_b : the striking and the struck car (car numbers, 1 leads)
    corner_car, corner : whose corner carried the largest force (``car_a`` or ``car_b``), and
        which: 0 front left, 1 front right, 2 rear left, 3 rear right
    start, end : times at which the pair's force passed 10 kN and at which it had fallen
        below 5 kN for good, s (``end`` is nan while it goes on)
    peak_corner_force : largest force at a single corner, N (the source's "peak force")
    peak_time : when, s
    peak_resultant : largest resultant force between the two cars, N
    peak_resultant_time : when, s
    closing_speed : normal speed of approach at the corner when the contact began, m/s
    x, y : place of the corner at the peak, m
    normal_x, normal_y : direction of the force on ``car_a`` at the peak
    angle : angle between the long axes of the two cars at the peak, rad, 0 to pi/2
    energy_lost : work that the contact has taken out of the two cars, J
    """

    id: int
    final: bool
    car_a: int
    car_b: int
    corner_car: int
    corner: int
    start: float
    end: float
    peak_corner_force: float
    peak_time: float
    peak_resultant: float
    peak_resultant_time: float
    closing_speed: float
    x: float
    y: float
    normal_x: float
    normal_y: float
    angle: float
    energy_lost: float


@dataclass(frozen=True)
class Command:
    """A command as it was applied: enough to repeat the run to the bit.

    Attributes
    ----------
    name : "inject_rail_break" or "trigger_emergency_brake"
    arguments : keyword arguments of the method of that name
    step : number of accepted steps when it was applied
    time : simulation time of that step, s
    """

    name: str
    arguments: dict[str, object] = field(default_factory=dict)
    step: int = 0
    time: float = 0.0
