"""Brakes: retarding force of a car after an emergency application.

Source: thesis, brake section; numbers marked [R] in the parameters are reconstructed.

    F_b = K_b K_d(t) F(v),    F(v) = F0 mu(v) / mu(0)

``K_d`` is 0 until the signal reaches the car, then rises linearly to 1 in the rise time.
Composition shoe [R]: ``mu(v) = 0.21 (v + 19.223) / (v + 9.388)``, v in m/s, held constant above
80 km/h. Cast iron [R]: ``(V + 100) / (V + 20)``, V in km/h, scaled to the same stopping distance
from 80 km/h. The traction limited mode replaces ``F(v)`` by ``mu_t m g``.
"""

from __future__ import annotations

import math

from derail_ros.engine.jit import jit

SPEED_LIMIT = 80.0 / 3.6
"""Speed above which the composition shoe's friction stays constant, m/s."""


def _stopping_integral(law: object) -> float:
    """Integral of v / F(v) from 0 to 80 km/h (Simpson's rule): distance for m = F0 = 1."""
    n = 2000
    h = SPEED_LIMIT / n
    total = 0.0
    for i in range(n + 1):
        v = i * h
        weight = 1.0 if i in (0, n) else (4.0 if i % 2 else 2.0)
        total += weight * v / law(v)  # type: ignore[operator]
    return total * h / 3.0


def _composition(v: float) -> float:
    return (v + 19.223) / (v + 9.388) * (9.388 / 19.223)


def _cast_iron(v: float) -> float:
    return (3.6 * v + 100.0) / (3.6 * v + 20.0)


CAST_IRON_SCALE = _stopping_integral(_cast_iron) / _stopping_integral(_composition)
"""Factor that gives cast iron the composition shoe's stopping distance from 80 km/h."""


@jit
def composition_factor(v: float) -> float:
    """``mu(v) / mu(0)`` of a composition shoe at the speed ``v`` >= 0 (m/s)."""
    u = min(v, SPEED_LIMIT)
    return (u + 19.223) / (u + 9.388) * (9.388 / 19.223)


@jit
def cast_iron_factor(v: float) -> float:
    """Speed factor of a cast iron shoe at the speed ``v`` >= 0 (m/s), scaled as above."""
    u = 3.6 * v
    return CAST_IRON_SCALE * (u + 100.0) / (u + 20.0)


@jit
def rise(t: float, arrival: float, rise_time: float) -> float:
    """``K_d``: share of the full force at time ``t`` (s) after the signal's arrival."""
    if t <= arrival:
        return 0.0
    if t >= arrival + rise_time:
        return 1.0
    return (t - arrival) / rise_time


@jit
def smooth_direction(speed: float, eps: float) -> float:
    """1 / sqrt(v^2 + eps^2): times the velocity, its direction, fading to zero at rest [R]."""
    return 1.0 / math.sqrt(speed * speed + eps * eps)
