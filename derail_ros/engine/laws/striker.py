"""Striker and draft gear: the spring that centres a coupler in its pocket.

Source: thesis, coupler chapter. ``x = d_st (phi - theta)`` is the displacement at the striker;
``phi`` the coupler's absolute angle, ``theta`` the car's yaw.

    F(x) = 0                                            |x| <= free
    F(x) = sign(x) k1 (|x| - free)                      |x| <= d_so
    F(x) = sign(x) (k1 (d_so - free) + k2 (|x| - d_so))   beyond

Odd in x. A damper ``c xdot`` acts in parallel. k2 is reconstructed [R]: 50 MN/m. The source has
``free = 0``: k1 is the self-alignment of a compressed draft gear. A coupler on a curve swings
through the opening without straining its gear; ``free`` is the swing that the alignment asks of it
(``engine.negotiability``), 0 on straight track.
"""

from __future__ import annotations

from derail_ros.engine.jit import jit


@jit
def spring_force(x: float, free: float, opening: float, k1: float, k2: float) -> float:
    """Restoring force for a displacement ``x`` (m), N; stiffnesses in N/m."""
    u = abs(x)
    if u <= free:
        return 0.0
    if u <= opening:
        f = k1 * (u - free)
    else:
        f = k1 * (opening - free) + k2 * (u - opening)
    return f if x > 0.0 else -f


@jit
def spring_energy(x: float, free: float, opening: float, k1: float, k2: float) -> float:
    """Energy stored in the spring at a displacement ``x`` (m), J: the integral of the force."""
    u = abs(x)
    if u <= free:
        return 0.0
    if u <= opening:
        w = u - free
        return 0.5 * k1 * w * w
    o = opening - free
    w = u - opening
    return 0.5 * k1 * o * o + k1 * o * w + 0.5 * k2 * w * w
