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


@jit
def resistance(v: float, c_s: float, c_d: float, eps: float, c_v: float) -> float:
    """``K(v)``, 1, for a speed ``v`` >= 0 (m/s)."""
    k = c_d + c_v * v
    # Beyond 40 eps the Stribeck term is below the last bit of c_d.
    if v < 40.0 * eps:
        k += (c_s - c_d) * math.exp(-v / eps)
    return k


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
    k = resistance(v, c_s, c_d, eps, c_v)
    slope = c_v
    if v < 40.0 * eps:
        slope -= (c_s - c_d) / eps * math.exp(-v / eps)
    across = k / s
    along = across + v * (slope / s - k * v / (s2 * s))
    return across, max(along, 0.0)
