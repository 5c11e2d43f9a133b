"""Collisions between rectangles.

Source: thesis, collision chapter, which prints ``F_max``, ``d_c``, ``d_b`` and ``c1`` to ``c3``.
The form of the gap law and the treatment of penetration are reconstructed [R].

Gap law, x the distance (negative inside), a bell with its peak at contact:

    F_d(x) = F_max B(x / d_c),    B(0) = 1,    B(1) = 1/2,    F_d = 0 for x >= d_b

(a run leaves out what is below 1e-12 F_max: ``reach``)

    gaussian      B(r) = 2^-r^2
    lorentzian    B(r) = 1 / (1 + r^2)
    sech2         B(r) = 1 / cosh(r arcosh(sqrt 2))^2
    quartic       B(r) = 1 / (1 + r^4)

Inside, the ``even`` law is the same bell: F_d(-x) = F_d(x). A body that is past the middle of the
bell is pushed out ever less, and a very hard blow passes through. The ``held`` law keeps F_max
for x < 0. Speed factor, v the normal closing speed:

    F_c = F_d max(0, c1 v|v| + c2 v + c3)

The asymmetry about v = 0 is what takes energy out. Geometry, in the frame of the other body with
half length a and half width b: a corner beside a wall is pushed along the wall's normal with the
opposite force at the foot point; a corner beyond both ends of the walls meets the other body's
corner, along the line of corners, once per pair. A corner inside a body keeps the wall it came
through until it is out again: that memory is a bit mask of the walls the corner was outside of at
the last accepted step (1 front, 2 rear, 4 left, 8 right).
"""

from __future__ import annotations

import math

from derail_ros.engine.jit import jit

FRONT, REAR, LEFT, RIGHT = 1, 2, 4, 8

ON_LINE = 1e-9
"""A point this close to the line of a wall lies on it, m."""


GAP_LAWS = {"gaussian": 0, "lorentzian": 1, "sech2": 2, "quartic": 3}
"""Shapes of the gap law and their numbers in the kernels."""

INSIDE = {"held": 0, "even": 1}
"""The gap law inside a body."""

LN_2 = 0.6931471805599453
ARCOSH_SQRT_2 = 0.881373587019543

NOTHING = 1e-12
"""Forces below this share of ``F_max`` (some micronewtons) count as none."""


def reach(d_c: float, d_b: float, law: int) -> float:
    """Gap beyond which there is no force, m: ``d_b``, or where it is below NOTHING."""
    bells = (
        math.sqrt(math.log2(1.0 / NOTHING)),
        math.sqrt(1.0 / NOTHING),
        math.acosh(NOTHING**-0.5) / ARCOSH_SQRT_2,
        NOTHING**-0.25,
    )
    return min(d_b, bells[law] * d_c)


@jit
def gap_force(x: float, f_max: float, d_c: float, d_b: float, law: int, even: int) -> float:
    """``F_d(x)``, N, for a gap ``x`` (m); ``law`` and ``even`` as in GAP_LAWS and INSIDE."""
    if x <= 0.0 and even == 0:
        return f_max
    if abs(x) >= d_b:
        return 0.0
    r = x / d_c
    if law == 1:
        return f_max / (1.0 + r * r)
    if law == 2:
        c = math.cosh(ARCOSH_SQRT_2 * r)
        return f_max / (c * c)
    if law == 3:
        return f_max / (1.0 + r * r * r * r)
    return f_max * math.exp(-LN_2 * r * r)


@jit
def speed_factor(v: float, c1: float, c2: float, c3: float) -> float:
    """``max(0, c1 v|v| + c2 v + c3)``, v the closing speed (m/s)."""
    return max(0.0, c1 * v * abs(v) + c2 * v + c3)


@jit
def outside_mask(u: float, w: float, a: float, b: float) -> int:
    """Walls of a rectangle (half length a, half width b) that the point (u, w) is outside of.

    A point on a wall's line is not outside of it.
    """
    mask = 0
    if u > a + ON_LINE:
        mask = FRONT
    elif u < -a - ON_LINE:
        mask = REAR
    if w > b + ON_LINE:
        mask |= LEFT
    elif w < -b - ON_LINE:
        mask |= RIGHT
    return mask


@jit
def on_line(x: float, half: float, turn: float) -> bool:
    """A corner at the coordinate ``x`` along a wall meets the corner of an aligned body there.

    ``turn`` is the sine of the angle between the bodies. Cars on straight track are exactly
    aligned: all four corners of a head-on impact lie on the ends of the walls they meet, where a
    shift of the last bit would leave two of them. Of such contacts only those of the pair's first
    car count: the force of the neighbouring positions.
    """
    return abs(abs(x) - half) <= ON_LINE and abs(turn) <= ON_LINE


@jit
def nearest_wall(u: float, w: float, a: float, b: float, mask: int) -> int:
    """Among the walls in ``mask`` (all for 0), the one the inner point (u, w) is least behind."""
    if mask == 0:
        mask = FRONT | REAR | LEFT | RIGHT
    best = 0
    depth = 1.0e300
    if mask & FRONT and a - u < depth:
        depth = a - u
        best = FRONT
    if mask & REAR and a + u < depth:
        depth = a + u
        best = REAR
    if mask & LEFT and b - w < depth:
        depth = b - w
        best = LEFT
    if mask & RIGHT and b + w < depth:
        depth = b + w
        best = RIGHT
    return best
