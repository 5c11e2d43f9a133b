"""Events, collisions and commands of a run: what happened, when, where, to which cars and why.

A dataclass here has the fields of the message of the same name, and a recording is read back into
it: there is one shape of each.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from derail_ros.vocabulary.params import LATER
from derail_ros.vocabulary.status import CORNERS
from derail_ros.vocabulary.words import coordinate, force, speed


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
    CAR_ON_SIDE = 11
    CAR_OVERRIDDEN = 12

    @property
    def word(self) -> str:
        """Its name in JSON, tables and messages: ``truck_derailed``."""
        return self.name.lower()


@dataclass(frozen=True)
class Event:
    """An event in a run.

    Attributes
    ----------
    kind : what happened
    time : run time at which it happened, s
    step : number of accepted steps when it was recorded
    cars : car numbers (1 leads); a coupling is named by its two cars
    end : "front" or "rear" truck of ``cars[0]``, or ""
    cause : why: "initial", "rail break", "lateral force", "angle", "command", ...
    x, y : place, m (nan where there is none)
    track_coordinate : arc length along the track, m (nan where there is none)
    speed : speed of the first car's mass centre, m/s (nan where there is none)
    value : the number behind the cause, in :attr:`value_unit` (quotient, angle, place, ...)
    before, after : state before and after, in words ("on the rails" -> "derailed")
    z : height of the place, m
    object : name of a fixed body that takes part, "" for none
    more : further numbers by name, unit in the name ("force_N")
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
    z: float = field(default=0.0, metadata=LATER)
    object: str = field(default="", metadata=LATER)
    more: Mapping[str, float] = field(default_factory=dict, metadata=LATER)

    @property
    def value_unit(self) -> str:
        """Unit of :attr:`value`; "1" for a quotient, "" where there is no value."""
        if not math.isfinite(self.value):
            return ""
        if self.cause == "lateral force":
            return "1"
        if self.kind == EventKind.BRAKES_TRIGGERED and self.cause != "vented":
            return ""
        return _UNITS.get(self.kind, "")

    @property
    def text(self) -> str:
        """The event in a line, without its time."""
        return describe(self)


_UNITS = {
    EventKind.TRUCK_DERAILED: "m",
    EventKind.COUPLER_PARTED: "rad",
    EventKind.BRAKES_TRIGGERED: "m",
    EventKind.BRAKE_SIGNAL_REACHED: "m",
    EventKind.RUN_ENDED: "s",
    EventKind.RUN_VOID: "m",
    EventKind.CAR_ON_SIDE: "rad",
    EventKind.CAR_OVERRIDDEN: "m",
}


def describe(e: Event) -> str:
    """An event in a line, without its time."""
    car = f"car {e.cars[0]}" if e.cars else "the train"
    place = coordinate(e.track_coordinate) if math.isfinite(e.track_coordinate) else ""
    where = f" at {place} m" if place else ""
    how_fast = f", at {speed(e.speed)}" if math.isfinite(e.speed) else ""
    why = f" ({e.cause})" if e.cause else ""
    if e.kind == EventKind.TRUCK_DERAILED:
        truck = f"the {e.end} truck of {car}" if e.end else car
        if e.cause == "initial":
            return f"{truck} is off the rails from the start{how_fast}"
        if e.cause == "rail break":
            return f"{truck} derails at the rail break{where}{how_fast}"
        if e.cause == "lateral force":
            ratio = f": lateral force {e.value:.2f} times the load" * math.isfinite(e.value)
            return f"{truck} is pushed off the rails{where}{how_fast}{ratio}"
        return f"{truck} derails{why}{where}{how_fast}"
    if e.kind == EventKind.COUPLER_PARTED and len(e.cars) > 1:
        pair = f"cars {e.cars[0]} and {e.cars[1]}"
        if e.cause == "initial":
            return f"{pair} are uncoupled from the start"
        if e.cause == "angle" and math.isfinite(e.value):
            angle = f"{math.degrees(abs(e.value)):.0f}\N{DEGREE SIGN}"
            return f"{pair} part: their couplers turned {angle} apart{how_fast}"
        if e.cause.endswith("broke") and math.isfinite(e.value):
            return f"{pair} part: the {e.cause} at a tension of {force(e.value)}{how_fast}"
        return f"{pair} part{why}{how_fast}"
    if e.kind == EventKind.RAIL_BREAK_SET:
        return f"{_BREAKS.get(e.cause, 'the rail breaks')}{where}"
    if e.kind == EventKind.BRAKES_TRIGGERED:
        if e.cause == "vented":
            return "the brake pipe parts: emergency application from there"
        cause = e.cause.replace("from the car", f"from {car}") if e.cars else e.cause
        return f"emergency brakes{': ' + cause if cause else ''}"
    if e.kind == EventKind.BRAKE_SIGNAL_REACHED:
        return f"the brake signal reaches {car}"
    if e.kind == EventKind.CAR_AT_REST:
        return f"{car} comes to rest"
    if e.kind == EventKind.CAR_ON_SIDE:
        return f"{car} falls on its side{how_fast}"
    if e.kind == EventKind.CAR_OVERRIDDEN and len(e.cars) > 1:
        return f"car {e.cars[1]} rides up on {car}{how_fast}"
    if e.kind == EventKind.RUN_ENDED:
        return _ENDINGS.get(e.cause, f"the run ends{why}")
    if e.kind == EventKind.RUN_VOID:
        return "the run is void: a body that stands for many cars reached the break"
    words = _WORDS.get(e.kind, e.kind.name.lower().replace("_", " "))
    return f"{words}: {e.cause}" if e.cause else words


_BREAKS = {
    "initial": "the rail is broken from the start",
    "command": "the rail breaks, by command",
    "lateral force": "the rail rolls over under the lateral force",
}
_ENDINGS = {
    "at rest": "the run ends: all cars are at rest",
    "time limit": "the run ends at its time limit",
    "command": "the run ends by command",
}
_WORDS = {
    EventKind.RUN_LOADED: "the run begins",
    EventKind.RUN_RESET: "the run begins again",
    EventKind.RUN_FAILED: "the computation failed",
}


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
    peak_force : largest force at a single corner, N, as in the source
    peak_time : when, s
    peak_resultant : largest resultant force between the two cars, N
    peak_resultant_time : when, s
    closing_speed : normal speed of approach at the corner when the contact began, m/s
    x, y : place of the corner at the peak, m
    normal_x, normal_y : direction of the force on ``car_a`` at the peak
    angle : angle between the long axes of the two cars at the peak, or between that of the
        car and the fixed thing's side, rad, 0 to pi/2
    energy_lost : work that the contact has taken out of the two cars, J
    z, normal_z : height of the place, m, and vertical part of the direction
    object : name of the fixed body that was struck in place of ``car_b`` (then 0), "" for a car
    wall : wall of the other car that the corner struck, in words, "" where it is not known
    """

    id: int
    final: bool
    car_a: int
    car_b: int
    corner_car: int
    corner: int
    start: float
    end: float
    peak_force: float
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
    z: float = 0.0
    normal_z: float = 0.0
    object: str = ""
    wall: str = ""

    @property
    def other_car(self) -> int:
        """The car that was touched by the corner of :attr:`corner_car`."""
        return self.car_b if self.corner_car == self.car_a else self.car_a

    @property
    def touch(self) -> str:
        """The two parts that touched, in words."""
        corner = CORNERS[self.corner] if 0 <= self.corner < len(CORNERS) else "a"
        wall = f", {self.wall}" if self.wall else ""
        if self.object:
            return f"{corner} corner of car {self.corner_car}{wall}"
        return f"{corner} corner of car {self.corner_car} on car {self.other_car}{wall}"

    @property
    def approach(self) -> str:
        """How fast the parts closed, or separated, in words."""
        way = "separating" if self.closing_speed <= -0.05 else "closing"
        return f"{way} at {abs(self.closing_speed):.1f} m/s"

    @property
    def text(self) -> str:
        """The collision in a line, without its time."""
        struck = self.object or f"car {self.car_b}"
        return (
            f"car {self.car_a} strikes {struck}: {force(self.peak_force)} at the {self.touch}, "
            f"{self.approach}, "
            f"{math.degrees(self.angle):.0f}\N{DEGREE SIGN} "
            + ("to it" if self.object else "between the cars")
        )


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
