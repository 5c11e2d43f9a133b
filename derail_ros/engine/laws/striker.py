"""Striker and draft gear: the spring that centres a coupler in its pocket.

Source: thesis, coupler chapter. ``x = d_st (phi - theta)`` is the displacement at the striker;
``phi`` the coupler's absolute angle, ``theta`` the car's yaw.

    F(x) = k1 x                             |x| <= d_so
    F(x) = sign(x) (k1 d_so + k2 (|x| - d_so))   beyond

Odd in x. A damper ``c xdot`` acts in parallel. k2 is reconstructed [R]: 50 MN/m.
"""

from __future__ import annotations

from derail_ros.engine.jit import jit


@jit
def spring_force(x: float, opening: float, k1: float, k2: float) -> float:
    """Restoring force for a displacement ``x`` (m), N; stiffnesses in N/m."""
    if x > opening:
        return k1 * opening + k2 * (x - opening)
    if x < -opening:
        return -k1 * opening + k2 * (x + opening)
    return k1 * x


@jit
def spring_energy(x: float, opening: float, k1: float, k2: float) -> float:
    """Energy stored in the spring at a displacement ``x`` (m), J: the integral of the force."""
    u = abs(x)
    if u <= opening:
        return 0.5 * k1 * u * u
    w = u - opening
    return 0.5 * k1 * opening * opening + k1 * opening * w + 0.5 * k2 * w * w
