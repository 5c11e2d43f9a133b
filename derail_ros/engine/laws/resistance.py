"""Resistance of a car on level track, and what a curve adds.

    R(v) = r0 + r1 v + r2 v^2 + c m / r

v in m/s, m in kg, r the radius of the curve in m. The form of Davis and AREMA; the constants are
the cars' (``scenario`` has FCalc's). Curve: 0.8 lb a ton and degree, c = 7 m^2/s^2.
"""

from __future__ import annotations

from derail_ros.engine.jit import jit


@jit
def resistance(v: float, r0: float, r1: float, r2: float) -> float:
    """Resistance on straight level track at the speed ``v`` >= 0 (m/s), N."""
    return r0 + (r1 + r2 * v) * v
