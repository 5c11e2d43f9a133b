"""Events, collisions and quantities in plain words."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from derail_ros.recording.reader import Contact, Happening, Run
from derail_ros.vocabulary.words import count

ENERGY_TAKERS: dict[str, str] = {
    "work_brakes": "the brakes",
    "work_ground_trucks": "the ground under derailed trucks",
    "work_ground_body": "the ground under uncoupled cars",
    "work_collisions": "collisions between cars",
    "work_striker_dampers": "draft gear",
    "work_knuckles_released": "couplers that parted",
}
"""Ledger entries that take energy out of the train, in words."""

NO_ENERGY = 0.5
"""An entry of less than this would be written as 0 J: it is left out, J."""


def speed(value: float) -> str:
    """A speed: ``24.9 m/s (90 km/h)``."""
    return f"{value:.1f} m/s ({value * 3.6:.0f} km/h)" if math.isfinite(value) else ""


def force(value: float) -> str:
    """A force: ``27.5 MN``, ``340 kN``."""
    return f"{value * 1e-6:.1f} MN" if value >= 0.95e6 else f"{value * 1e-3:.0f} kN"


def energy(value: float) -> str:
    """An energy: ``1.79 GJ``, ``9.5 MJ``, ``12 kJ``."""
    for unit, size in (("GJ", 1e9), ("MJ", 1e6), ("kJ", 1e3)):
        if abs(value) >= size:
            digits = 2 if abs(value) < 10 * size else 1 if abs(value) < 100 * size else 0
            return f"{value / size:.{digits}f} {unit}"
    return f"{value:.0f} J"


def coordinate(value: float, digits: int = 1) -> str:
    """A place or an angle, without the sign of a zero."""
    return f"{round(value, digits) + 0.0:.{digits}f}"


def number_list(cars: Iterable[int]) -> str:
    """``1 to 5, 8`` for 1, 2, 3, 4, 5, 8; "none" for none."""
    groups: list[list[int]] = []
    for car in cars:
        if groups and car == groups[-1][1] + 1:
            groups[-1][1] = car
        else:
            groups.append([car, car])
    parts = [f"{a}" if a == b else f"{a}, {b}" if b == a + 1 else f"{a} to {b}" for a, b in groups]
    return ", ".join(parts) or "none"


def cars(numbers: Sequence[int]) -> str:
    """``car 3``, ``cars 1 to 5``."""
    return f"car{'' if len(numbers) == 1 else 's'} {number_list(numbers)}"


def place(x: float, y: float) -> str:
    """Where, in the plane: ``x = 42.1 m, y = -4.2 m``."""
    return f"x = {coordinate(x)} m, y = {coordinate(y)} m" if math.isfinite(x) else ""


def _where(event: Happening) -> str:
    if not math.isfinite(event.track_coordinate):
        return ""
    return f" at {coordinate(event.track_coordinate)} m"


def _fast(event: Happening) -> str:
    text = speed(event.speed)
    return f", at {text}" if text else ""


def event(e: Happening) -> str:
    """An event in a line."""
    car = f"car {e.cars[0]}" if e.cars else "the train"
    if e.kind == "truck_derailed":
        truck = f"the {e.end} truck of {car}" if e.end else car
        if e.cause == "initial":
            return f"{truck} is off the rails from the start{_fast(e)}"
        if e.cause == "rail break":
            return f"{truck} drops off the rails at the broken rail{_fast(e)}"
        if e.cause == "lateral force":
            quotient = (
                f": lateral force {e.value:.2f} times the load" if math.isfinite(e.value) else ""
            )
            return f"{truck} is pushed off the rails{_where(e)}{_fast(e)}{quotient}"
        return f"{truck} leaves the rails ({e.cause or 'no cause given'}){_where(e)}{_fast(e)}"
    if e.kind == "coupler_parted" and len(e.cars) > 1:
        pair = f"cars {e.cars[0]} and {e.cars[1]}"
        if e.cause == "initial":
            return f"{pair} are not coupled from the start"
        if e.cause == "angle" and math.isfinite(e.value):
            turned = f"their couplers turned {math.degrees(abs(e.value)):.0f}° apart"
            return f"{pair} part: {turned}{_fast(e)}"
        return f"{pair} part ({e.cause or 'no cause given'}){_fast(e)}"
    if e.kind == "rail_break_set":
        why = {
            "scenario": "the rail is broken from the start",
            "initial": "the rail is broken from the start",
            "command": "the rail breaks, by command",
            "lateral force": "the rail rolls over under the lateral force",
        }
        return f"{why.get(e.cause, 'the rail breaks')}{_where(e)}"
    if e.kind == "brakes_triggered":
        if e.cause == "vented":
            return "the brake pipe is torn open: an emergency application from there"
        return f"emergency brakes{': ' + e.cause if e.cause else ''}"
    if e.kind == "brake_signal_reached":
        return f"the brake signal reaches {car}"
    if e.kind == "car_at_rest":
        return f"{car} comes to rest"
    if e.kind == "run_loaded":
        return f"the run begins{': ' + e.cause if e.cause else ''}"
    if e.kind == "run_reset":
        return f"the run begins again{': ' + e.cause if e.cause else ''}"
    if e.kind == "run_ended":
        return {
            "at rest": "the run ends: everything is at rest",
            "time limit": "the time limit ends the run",
            "command": "a command ends the run",
        }.get(e.cause, f"the run ends ({e.cause})")
    if e.kind == "run_void":
        return "the run is void: a body that stands for many cars reached the break"
    if e.kind == "run_failed":
        return f"the computation failed: {e.cause}"
    return e.text or e.kind.replace("_", " ")


def collision(c: Contact) -> str:
    """A collision in a line, without its time."""
    return (
        f"car {c.car_a} strikes car {c.car_b}: {force(c.peak_force)} at the {c.touch},"
        f" closing at {c.closing_speed:.1f} m/s, {math.degrees(c.angle):.0f}° between the cars"
    )


NOT_AT_REST = {
    "running": "still running at",
    "time limit": "not yet at rest at the time limit of",
    "stopped": "ended by a command at",
    "failed": "the computation failed at",
    "cut off": "the recording cut off at",
}
"""Status of a run that has no time to rest -> how it ended, before the time."""


def derailed(n: int) -> str:
    """``no car derailed``, ``1 car derailed``, ``24 cars derailed``."""
    return "no car derailed" if n == 0 else f"{count(n, 'car')} derailed"


def ending(status: str, time: float, duration: float) -> str:
    """How a run ended: ``at rest after 25.3 s``; the duration is nan where nothing rested."""
    if math.isfinite(duration):
        return f"at rest after {duration:.1f} s"
    return f"{NOT_AT_REST.get(status, status + ' at')} {time:.1f} s"


def sentence(run: Run) -> str:
    """The outcome in a line."""
    r = run.result
    n = len(r.derailed)
    text = derailed(n)
    if math.isfinite(r.duration) or r.status:
        text += f", {ending(r.status, r.time, r.duration)}"
    if r.peak_force > 0.0 and r.peak_pair[0]:
        a, b = r.peak_pair
        text += (
            f"; largest force {force(r.peak_force)}, car {a} into car {b} at {r.peak_time:.2f} s"
        )
    if n and math.isfinite(r.length):
        text += f"; scene {r.length:.1f} m × {r.width:.1f} m"
    return text


def shares(run: Run, index: int = -1) -> list[tuple[str, str, float, float]]:
    """What took the energy: entry, words, J, share of the initial energy; the largest first."""
    if not run.energy:
        return []
    initial = float(run.energy["initial"][index])
    rows = [
        (entry, text, -float(run.energy[entry][index])) for entry, text in ENERGY_TAKERS.items()
    ]
    return [
        (entry, text, taken, taken / initial if initial > 0.0 else math.nan)
        for entry, text, taken in sorted(rows, key=lambda row: -row[2])
    ]


def stopped_by(run: Run) -> str:
    """What stopped the train, in a sentence or two."""
    ranked = [row for row in shares(run) if math.isfinite(row[3])]
    if not ranked:
        return "Not known: the recording holds no energy ledger."
    initial = float(run.energy["initial"][-1])
    main = [f"{text} {100.0 * share:.0f} %" for _, text, _, share in ranked if share >= 0.005]
    small = [text for _, text, taken, share in ranked if taken >= NO_ENERGY and share < 0.005]
    opening = f"Of the {energy(initial)} that the train began with, these took: "
    if not main:
        return f"Of the {energy(initial)} that the train began with nothing is gone yet."
    text = opening + _join(main)
    left = float(run.energy["kinetic"][-1]) / initial if initial > 0.0 else 0.0
    if left >= 0.005:
        text += f"; {100.0 * left:.0f} % is still motion"
    text += "."
    if small:
        text += f" Less than half a percent each: {_join(small)}."
    return text


def _join(parts: Sequence[str]) -> str:
    if len(parts) < 2:
        return "".join(parts)
    return ", ".join(parts[:-1]) + " and " + parts[-1]
