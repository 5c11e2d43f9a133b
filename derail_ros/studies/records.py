"""Outcomes as plain records for JSON and tables, and their means.

Units are in the names. What does not exist (the time of a collision in a run without one) is
``None``: neither NaN nor infinity ever leaves this file.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

from derail_ros.vocabulary.severity import severity

if TYPE_CHECKING:
    from derail_ros.engine.sample import Outcome

Record = dict[str, Any]


def number(value: float | None, digits: int | None = None) -> float | None:
    """``value`` as a float, or None if it is not a finite number."""
    if value is None:
        return None
    value = float(value)
    if not math.isfinite(value):
        return None
    return value if digits is None else round(value, digits)


def outcome_record(outcome: Outcome, wall_s: float | None = None) -> Record:
    """One outcome as a record (see ``docs`` of ``derail simulate --json``)."""
    pair = outcome.peak_force_pair
    return {
        "cars_derailed": int(outcome.cars_derailed),
        "derailed_cars": [int(c) for c in outcome.derailed_cars],
        "duration_s": number(outcome.duration),
        "at_rest": outcome.status == "at rest",
        "first_derailment_s": _first(outcome.derail_time),
        "peak_force_N": number(outcome.peak_force),
        "peak_force_pair": None if pair is None else [int(pair[0]), int(pair[1])],
        "peak_force_time_s": number(outcome.peak_force_time),
        "peak_resultant_N": number(outcome.peak_resultant),
        "cars_above_5MN": [int(c) for c in outcome.cars_above_5MN],
        "cars_above_10MN": [int(c) for c in outcome.cars_above_10MN],
        "scene_length_m": number(outcome.scene_length),
        "scene_width_m": number(outcome.scene_width),
        "scene_area_m2": number(outcome.scene_area),
        "severity": number(severity(outcome)),
        "rear_stop_m": number(outcome.rear_stop),
        "max_coupler_gap_m": number(outcome.max_coupler_gap),
        "max_truck_offset_m": number(outcome.max_truck_offset),
        "energy_initial_J": number(outcome.energy_initial),
        "energy_J": {name: number(value) for name, value in outcome.energy.items()},
        "energy_residual": number(outcome.energy_residual),
        "void": bool(outcome.void),
        "status": str(outcome.status),
        "end_time_s": number(outcome.time),
        "steps": int(outcome.steps),
        "rejected_steps": int(outcome.rejected_steps),
        "wall_s": number(wall_s, 6),
    }


def _first(times: Iterable[float]) -> float | None:
    """The earliest of the times that exist, s."""
    return min((float(t) for t in times if math.isfinite(t)), default=None)


def failed_record(error: str, wall_s: float | None = None) -> Record:
    """Record of a run that failed."""
    return {"error": error, "status": "failed", "wall_s": number(wall_s, 6)}


def counted(record: Mapping[str, Any]) -> bool:
    """Whether a record counts in statistics: neither failed nor void."""
    return "error" not in record and not record.get("void", False)


def flatten(record: Mapping[str, Any]) -> dict[str, float]:
    """The measures of a record that have a mean: ``energy_J.brakes`` for nested ones.

    Lists of cars count by their length (``cars_above_5MN``); ``derailed_cars`` is left to
    ``cars_derailed``.
    """
    flat: dict[str, float] = {}
    for key, value in record.items():
        if isinstance(value, bool) or value is None or key in ("derailed_cars", "peak_force_pair"):
            continue
        if isinstance(value, (int, float)):
            flat[key] = float(value)
        elif isinstance(value, list):
            flat[key] = float(len(value))
        elif isinstance(value, Mapping):
            flat.update({f"{key}.{k}": float(v) for k, v in value.items() if v is not None})
    return flat


class Moments:
    """Mean and standard deviation of records, one at a time (Welford), without keeping them."""

    def __init__(self) -> None:
        self.count = 0
        self.void = 0
        self.failed = 0
        self._n: dict[str, int] = {}
        self._mean: dict[str, float] = {}
        self._m2: dict[str, float] = {}

    def add(self, record: Mapping[str, Any]) -> None:
        """Take a record in; void and failed ones are only counted."""
        if "error" in record:
            self.failed += 1
            return
        if record.get("void", False):
            self.void += 1
            return
        self.count += 1
        for key, value in flatten(record).items():
            n = self._n.get(key, 0) + 1
            mean = self._mean.get(key, 0.0)
            delta = value - mean
            mean += delta / n
            self._n[key] = n
            self._mean[key] = mean
            self._m2[key] = self._m2.get(key, 0.0) + delta * (value - mean)

    def mean(self) -> Record:
        """Means over the runs that have the measure, nested as the records are."""
        return _nest(self._mean)

    def sd(self) -> Record:
        """Standard deviations, with N - 1; None for a single run."""
        return _nest(
            {
                k: math.sqrt(max(m2, 0.0) / (self._n[k] - 1)) if self._n[k] > 1 else None
                for k, m2 in self._m2.items()
            }
        )


def _nest(flat: Mapping[str, float | None]) -> Record:
    nested: Record = {}
    for key, value in flat.items():
        outer, dot, inner = key.partition(".")
        if dot:
            nested.setdefault(outer, {})[inner] = value
        else:
            nested[key] = value
    return nested


def summarize(records: Iterable[Mapping[str, Any]]) -> Moments:
    """Moments of all records, in the order given: sums depend on it in the last digit."""
    moments = Moments()
    for record in records:
        moments.add(record)
    return moments
