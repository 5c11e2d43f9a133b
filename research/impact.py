r"""The collision law beside the tank car impact tests from which it was derived.

A car of mass m_1 runs into standing cars of mass m_2, head on and aligned: two corners push, each
with the law of :mod:`derail_ros.engine.laws.contact`. With x the gap, v = -x' the closing speed
and m = m_1 m_2 / (m_1 + m_2),

    m x'' = 2 F_c(x, v),        x(0) = d_b,    x'(0) = -v_0

The cars have no draft gear in the model, and their standing row is one mass, as in the tests.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from derail_ros.engine.laws.contact import GAP_LAWS, INSIDE, gap_force, speed_factor
from derail_ros.vocabulary.params import ContactParams

STRIKING, STANDING = 158e3, 327e3
"""Masses of the tests, kg."""

SPEEDS_KMH = (15.0, 20.4, 25.0)
"""Speeds of the tests, km/h."""

MEASURED_FORCE = (2.2e6, 4.5e6)
"""Smallest and largest peak force measured over the tests, N."""

MEASURED_DURATION = (0.2, 0.3)
"""Shortest and longest impact measured over the tests, s."""

STEP = 2e-5
"""Step of the integration, s."""


@dataclass(frozen=True)
class Impact:
    """An impact by the law."""

    speed_kmh: float
    peak_force_N: float  # between the cars, both corners
    duration_s: float  # while the force is above a tenth of its peak
    parting_speed_mps: float  # at which the cars part; nan if the one passes through the other
    depth_m: float  # how far a corner gets inside


def impact(speed_kmh: float, contact: ContactParams | None = None) -> Impact:
    """The impact of a car on standing cars.

    Parameters
    ----------
    speed_kmh : speed of the striking car, km/h
    contact : the law's constants; the model's by default
    """
    if not speed_kmh > 0.0:
        raise ValueError(f"speed_kmh must be positive, got {speed_kmh}")
    c = ContactParams() if contact is None else contact
    form, even = GAP_LAWS[c.gap_law], INSIDE[c.inside]
    mass = STRIKING * STANDING / (STRIKING + STANDING)

    def force(x: float, v: float) -> float:
        push = gap_force(x, c.force_max, c.half_distance, c.buffer, form, even)
        return 2.0 * push * speed_factor(v, c.c1, c.c2, c.c3)

    x, v = c.buffer, speed_kmh / 3.6
    forces = []
    deepest = x
    while (v > 0.0 or x < c.buffer) and x > -c.buffer:  # classical Runge-Kutta of order 4
        f1 = force(x, v)
        f2 = force(x - 0.5 * STEP * v, w2 := v - 0.5 * STEP * f1 / mass)
        f3 = force(x - 0.5 * STEP * w2, w3 := v - 0.5 * STEP * f2 / mass)
        f4 = force(x - STEP * w3, w4 := v - STEP * f3 / mass)
        forces.append(f1)
        x -= STEP / 6.0 * (v + 2.0 * w2 + 2.0 * w3 + w4)
        v -= STEP / (6.0 * mass) * (f1 + 2.0 * f2 + 2.0 * f3 + f4)
        deepest = min(deepest, x)
    found = np.array(forces)
    strong = np.flatnonzero(found > 0.1 * found.max())
    lasted = STEP * float(strong[-1] - strong[0])
    parting = -v if x > 0.0 else math.nan
    return Impact(speed_kmh, float(found.max()), lasted, parting, max(-deepest, 0.0))


def impacts(contact: ContactParams | None = None) -> Sequence[Impact]:
    """The impacts of the tests."""
    return tuple(impact(speed, contact=contact) for speed in SPEEDS_KMH)


def words(found: Sequence[Impact]) -> str:
    """How much stiffer the law is, in two sentences."""
    forces = sorted(i.peak_force_N for i in found)
    times = sorted(i.duration_s for i in found)
    low, high = MEASURED_FORCE
    return (
        f"The tests gave {low / 1e6:g} to {high / 1e6:g} MN, the law {forces[0] / 1e6:.1f} to "
        f"{forces[-1] / 1e6:.1f} MN: {forces[0] / low:.1f} times the smallest and "
        f"{forces[-1] / high:.1f} times the largest. The impacts took "
        f"{MEASURED_DURATION[0]:g} to {MEASURED_DURATION[1]:g} s and take {times[0]:.2f} to "
        f"{times[-1]:.2f} s by the law (above a tenth of the peak)."
    )
