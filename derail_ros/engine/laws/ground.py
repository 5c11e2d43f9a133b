"""Ground reaction on what has left the rails.

Source: thesis, ground section (the form is that of a robot-joint friction model; its equation and
constants are reconstructed [R]). At a point moving with speed v under the normal load N,

    F = K(v) N against the velocity,  K(v) = c_d + (c_s - c_d) exp(-v / eps) + c_v v

with the direction smoothed as ``v / sqrt(v^2 + eps^2)`` near rest.
"""

from __future__ import annotations

import math

from derail_ros.engine.jit import jit

BODY_POINTS = 10
"""Points along the body of a car that lies free: the middles of ten equal parts [R]."""


REACH = 40.0
"""Speeds beyond this many eps have no Stribeck term: it is below the last bit of c_d."""


@jit
def decay(x: float) -> float:
    """``exp(-x)`` for 0 <= x <= 40, to 1e-16 absolute: Taylor's polynomial of degree 10 at x / 32.

    Written out because it has no branches, so that a loop over many points becomes vectors.
    """
    y = x * (1.0 / 32.0)
    p = 1.0 - y * (1.0 / 10.0)
    p = 1.0 - y * (1.0 / 9.0) * p
    p = 1.0 - y * (1.0 / 8.0) * p
    p = 1.0 - y * (1.0 / 7.0) * p
    p = 1.0 - y * (1.0 / 6.0) * p
    p = 1.0 - y * (1.0 / 5.0) * p
    p = 1.0 - y * (1.0 / 4.0) * p
    p = 1.0 - y * (1.0 / 3.0) * p
    p = 1.0 - y * 0.5 * p
    p = 1.0 - y * p
    p *= p
    p *= p
    p *= p
    p *= p
    return p * p


@jit
def resistance(v: float, c_s: float, c_d: float, eps: float, c_v: float) -> float:
    """``K(v)``, 1, for a speed ``v`` >= 0 (m/s)."""
    return c_d + c_v * v + (c_s - c_d) * decay(min(v / eps, REACH))


@jit
def drag(v: float, c_s: float, c_d: float, eps: float, c_v: float) -> float:
    """``K(v) / sqrt(v^2 + eps^2)``, s/m: times N and the velocity vector, the force's size."""
    return resistance(v, c_s, c_d, eps, c_v) / math.sqrt(v * v + eps * eps)


@jit
def drag_slopes(v: float, c_s: float, c_d: float, eps: float, c_v: float) -> tuple[float, float]:
    """Damping of the reaction for N = 1, s/m: across the velocity and along it.

    For the force ``g(v) u`` with ``g = drag(v)``: ``g`` and ``d(g v)/dv``, the latter not below
    zero (it is negative where K falls with speed).
    """
    s2 = v * v + eps * eps
    s = math.sqrt(s2)
    stribeck = (c_s - c_d) * decay(min(v / eps, REACH))
    k = c_d + c_v * v + stribeck
    across = k / s
    along = across + v * ((c_v - stribeck / eps) / s - across * v / s2)
    return across, max(along, 0.0)
