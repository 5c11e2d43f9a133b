"""The measures of a run in a study's table: key, words, unit, digits, where each comes from."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from derail_ros.vocabulary.outcome import Outcome
    from derail_ros.vocabulary.params import TrainParams


@dataclass(frozen=True)
class Measure:
    """A column of the table.

    Attributes
    ----------
    label : in words
    unit : "" for a number of cars and for shares
    digits : after the point, where it is shown
    whole : a count
    """

    label: str
    unit: str = ""
    digits: int = 1
    whole: bool = False

    @property
    def title(self) -> str:
        """Words with unit."""
        return f"{self.label} ({self.unit})" if self.unit else self.label


MEASURES: Mapping[str, Measure] = {
    "cars_derailed": Measure("cars derailed", whole=True),
    "duration_s": Measure("duration", "s"),
    "peak_force_MN": Measure("peak force", "MN", 2),
    "peak_force_time_s": Measure("time of the peak force", "s"),
    "peak_resultant_MN": Measure("peak resultant between two cars", "MN", 2),
    "cars_above_5MN": Measure("cars struck above 5 MN", whole=True),
    "cars_above_10MN": Measure("cars struck above 10 MN", whole=True),
    "scene_length_m": Measure("scene length", "m"),
    "scene_width_m": Measure("scene width", "m"),
    "scene_area_m2": Measure("scene area", "m\N{SUPERSCRIPT TWO}", 0),
    "first_derailed": Measure("first car derailed", whole=True),
    "last_derailed": Measure("last car derailed", whole=True),
    "rear_stop_m": Measure("place where the rear part stopped", "m"),
    "energy_MJ": Measure("kinetic energy at the start", "MJ"),
    "share_brakes": Measure("share of the energy taken by the brakes", digits=3),
    "share_ground": Measure("share of the energy taken by the ground", digits=3),
    "share_collisions": Measure("share of the energy taken by collisions", digits=3),
    "severity": Measure("relative severity", digits=2),
}
"""All measures. Severity is not in the table: it compares with the mean of
the base point, not with the source's base train as :mod:`derail_ros.vocabulary.severity` does."""

DEFAULT_MEASURES = ("cars_derailed", "duration_s", "peak_force_MN", "scene_area_m2")

COLUMNS = tuple(key for key in MEASURES if key != "severity")
"""Measures with a column in the table."""

FIELDS = ("status", "error", "train_cars", "lateral_factor", "peak_pair", *COLUMNS)
"""What a run gives, in the order of the table's columns, after point, member and parameters."""

TEXTS = ("status", "error", "peak_pair")

Row = list[Any]


def _finite(value: float, factor: float = 1.0) -> float | None:
    value = float(value) * factor
    return value if math.isfinite(value) else None


def row(outcome: Outcome, params: TrainParams, factor: float) -> Row:
    """What a run that did not fail gives, in the order of :data:`FIELDS`."""
    derailed = outcome.derailed_cars
    pair = outcome.peak_force_pair
    energy, initial = outcome.energy, outcome.energy["initial"]
    ground = energy["ground_trucks"] + energy["ground_body"]
    share = 1.0 / initial if initial > 0.0 else math.nan
    values: dict[str, Any] = {
        "status": "void" if outcome.void else outcome.status,
        "error": "",
        "train_cars": sum(car.represents for car in params.cars),
        "lateral_factor": factor,
        "peak_pair": "" if pair is None else f"{pair[0]}-{pair[1]}",
        "cars_derailed": int(outcome.cars_derailed),
        "duration_s": _finite(outcome.duration),
        "peak_force_MN": _finite(outcome.peak_force, 1e-6),
        "peak_force_time_s": _finite(outcome.peak_force_time),
        "peak_resultant_MN": _finite(outcome.peak_resultant, 1e-6),
        "cars_above_5MN": len(outcome.cars_above_5MN),
        "cars_above_10MN": len(outcome.cars_above_10MN),
        "scene_length_m": _finite(outcome.scene_length),
        "scene_width_m": _finite(outcome.scene_width),
        "scene_area_m2": _finite(outcome.scene_area),
        "first_derailed": int(derailed[0]) if derailed else None,
        "last_derailed": int(derailed[-1]) if derailed else None,
        "rear_stop_m": _finite(outcome.rear_stop),
        "energy_MJ": _finite(initial, 1e-6),
        "share_brakes": _finite(energy["brakes"], share),
        "share_ground": _finite(ground, share),
        "share_collisions": _finite(energy["collisions"], share),
    }
    return [values[name] for name in FIELDS]


def failed_row(error: str, factor: float) -> Row:
    """What a run that failed gives."""
    values = {"status": "failed", "error": error, "lateral_factor": factor, "peak_pair": ""}
    return [values.get(name) for name in FIELDS]


def shown(key: str, value: float | None, more: int = 0) -> str:
    """A measure's value in a table, ``-`` for none."""
    if value is None or not math.isfinite(value):
        return "-"
    return f"{value:.{MEASURES[key].digits + more}f}"
