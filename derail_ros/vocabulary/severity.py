"""Composite severity of a derailment, relative to a base run.

The base run of the source is its train of 60 identical cars at 60 km/h. What it printed for that
run is the base wherever none is named: in messages, records and reviews. Studies name their own.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from derail_ros.vocabulary.outcome import Outcome

BASE_CARS = 14
BASE_PEAK_FORCE = 9.47e6
BASE_AREA = 1721.0
"""Cars derailed, largest force (N) and scene (m^2) the source printed for that run."""


def severity_index(
    cars: ArrayLike,
    peak_force: ArrayLike,
    area: ArrayLike,
    base_cars: float,
    base_peak_force: float,
    base_area: float,
) -> NDArray[np.float64]:
    r"""Severity ``S = (N/N0 + F/F0 + A/A0) / 3``; 1 for the base run itself.

    Parameters
    ----------
    cars : N, cars derailed
    peak_force : F, largest collision force, N
    area : A, area of the scene, m^2
    base_cars, base_peak_force, base_area : N0, F0, A0 of the base run (or its ensemble's means)

    Raises
    ------
    ValueError
        If a measure of the base run is not positive: nothing can be compared with it.
    """
    for name, value in (
        ("base_cars", base_cars),
        ("base_peak_force", base_peak_force),
        ("base_area", base_area),
    ):
        if not np.isfinite(value) or value <= 0.0:
            raise ValueError(f"{name}: must be positive to compare with, not {value:g}")
    n, f, a = (np.asarray(v, dtype=float) for v in (cars, peak_force, area))
    return np.asarray((n / base_cars + f / base_peak_force + a / base_area) / 3.0)


def severity(outcome: Outcome) -> float:
    """Severity of one outcome against the source's base run, see :func:`severity_index`."""
    own = (outcome.cars_derailed, outcome.peak_force, outcome.scene_area)
    return float(severity_index(*own, BASE_CARS, BASE_PEAK_FORCE, BASE_AREA))
