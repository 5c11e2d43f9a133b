"""Measures of a study: those of the vocabulary, and the severity relative to the study's base."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from derail_ros.vocabulary import measures as vocabulary
from derail_ros.vocabulary.measures import MEASURES, Measure
from derail_ros.vocabulary.severity import severity_index

if TYPE_CHECKING:
    import pandas

RELATIVE_SEVERITY = Measure(
    "relative_severity", "severity relative to the base", lambda o: math.nan, digits=2
)
"""Compares with the means of the study's base point: known only when all runs are. ``severity``
compares with the published base run instead."""

BASE_MEASURES = ("cars_derailed", "peak_force_N", "scene_area_m2")
"""What the severity is made of."""

DEFAULT_MEASURES = ("cars_derailed", "duration_s", "peak_force_N", "scene_area_m2")


def columns() -> dict[str, Measure]:
    """The measures that have a column in the table of runs."""
    return {k: m for k, m in MEASURES.items() if m.numeric and k != "derailed_cars"}


def measure_names() -> list[str]:
    """Measures that a study may ask for."""
    return [*columns(), RELATIVE_SEVERITY.key]


def measure_of(name: str) -> Measure:
    """A measure by its key or a former name.

    Raises
    ------
    KeyError
        A study has no such measure.
    """
    found = RELATIVE_SEVERITY if name == RELATIVE_SEVERITY.key else vocabulary.measure(name)
    if found.key not in measure_names():
        raise KeyError(name)
    return found


def with_relative_severity(runs: pandas.DataFrame, base: int | None) -> pandas.DataFrame:
    """The runs with their severity relative to the means of the base point, if it has them."""
    if base is None:
        return runs
    values = [runs[key].to_numpy(dtype=float, na_value=np.nan) for key in BASE_MEASURES]
    at_base = (runs["point"] == base).to_numpy()
    means = [float(v[at_base].mean()) if at_base.any() else math.nan for v in values]
    if all(np.isfinite(means)) and min(means) > 0.0:
        runs[RELATIVE_SEVERITY.key] = severity_index(*values, *means)
    return runs
