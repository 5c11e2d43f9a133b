"""Where within a step a contact changes its features.

A corner that passes the end of a wall begins or ceases to be pushed by that wall, and a corner
that leaves a body through another wall than it came in by is pushed another way: the collision
force jumps there. A step over such a jump is of first order, whatever its method; here the moment
is found, so that one step ends just before it and a tiny one goes across.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from derail_ros.engine import layout as L
from derail_ros.engine.arrays import Model, State, Work
from derail_ros.engine.jit import inner_jit, keep_separate
from derail_ros.engine.laws.contact import FRONT, REAR, gap_force, nearest_wall

F64 = NDArray[np.float64]

CLOSE = 1e-5
"""A step ends this far before a change, m, and the next one as far behind it."""

JUMP = 0.005
"""Jumps of the force below this share of ``F_max`` are left to the error control."""


@inner_jit
def cubic_root(g0: float, d0: float, g1: float, d1: float) -> float:
    """Where in (0, 1] the cubic with values g0 <= 0 < g1 and slopes d0, d1 crosses zero."""
    lo = 0.0
    hi = 1.0
    for _ in range(60):
        x = 0.5 * (lo + hi)
        y = 1.0 - x
        g = (
            g0 * (1.0 + 2.0 * x) * y * y
            + d0 * x * y * y
            + g1 * x * x * (3.0 - 2.0 * x)
            - d1 * x * x * y
        )
        if g > 0.0:
            hi = x
        else:
            lo = x
    return hi


@inner_jit
def _passing(g0: float, d0: float, g1: float, d1: float) -> float:
    """Share of the step that ends beside the change at g = 0, 1.0 if this step may stand.

    ``g`` rises through zero within the step; ``d0`` and ``d1`` are its slopes times the step.
    """
    if g0 < -2.0 * CLOSE:
        return cubic_root(g0 + CLOSE, d0, g1 + CLOSE, d1)
    if g1 > 4.0 * CLOSE:
        return cubic_root(g0 - CLOSE, d0, g1 - CLOSE, d1)
    return 1.0


@inner_jit
def _corner(
    q: F64, v: F64, i: int, j: int, ci: float, si: float, cj: float, sj: float, u: float, w: float
) -> tuple[float, float, float, float]:
    """Place and velocity of the point (u, w) of car ``i`` in the frame of car ``j``."""
    rx = ci * u - si * w
    ry = si * u + ci * w
    dx = q[i, 0] + rx - q[j, 0]
    dy = q[i, 1] + ry - q[j, 1]
    vx = v[i, 0] - v[i, 2] * ry - v[j, 0] + v[j, 2] * dy
    vy = v[i, 1] + v[i, 2] * rx - v[j, 1] - v[j, 2] * dx
    return cj * dx + sj * dy, -sj * dx + cj * dy, cj * vx + sj * vy, -sj * vx + cj * vy


@inner_jit
def first_change(model: Model, state: State, work: Work, h: float) -> float:
    """Share of the step at which the first contact changes its features; 1.0 without a change.

    The step's end is in ``work.stage_q/v``, its angles in ``work.wk``.
    """
    keep_separate()
    par = model.par
    car = model.car
    wk = work.wk
    reach = par[L.C_BUFFER]
    least = JUMP * par[L.C_FMAX]
    share = 1.0
    for a in range(1, 1 + work.active[0]):
        p = work.active[a]
        if state.pair[p, L.P_NEAR] == 0.0:
            continue
        for side in range(2):
            i = state.pairs[p, side]
            j = state.pairs[p, 1 - side]
            a_i = car[i, L.HALF_L]
            b_i = car[i, L.HALF_W]
            a_j = car[j, L.HALF_L]
            b_j = car[j, L.HALF_W]
            ci = wk[i, L.W_CT]
            si = wk[i, L.W_ST]
            cj = wk[j, L.W_CT]
            sj = wk[j, L.W_ST]
            ci0 = math.cos(state.q[i, 2])
            si0 = math.sin(state.q[i, 2])
            cj0 = math.cos(state.q[j, 2])
            sj0 = math.sin(state.q[j, 2])
            for corner in range(4):
                u = a_i if corner < 2 else -a_i
                w = b_i if corner % 2 == 0 else -b_i
                x1, y1, vx1, vy1 = _corner(work.stage_q, work.stage_v, i, j, ci, si, cj, sj, u, w)
                if abs(x1) > a_j + 2.0 * reach or abs(y1) > b_j + 2.0 * reach:
                    continue
                x0, y0, vx0, vy0 = _corner(state.q, state.v, i, j, ci0, si0, cj0, sj0, u, w)
                for axis in range(2):
                    # z along the wall whose end is passed, n across it
                    if axis == 0:
                        z0, z1, dz0, dz1, end = x0, x1, vx0, vx1, a_j
                        n0, n1, wall = y0, y1, b_j
                    else:
                        z0, z1, dz0, dz1, end = y0, y1, vy0, vy1, b_j
                        n0, n1, wall = x0, x1, a_j
                    on = 1.0 if z1 > 0.0 else -1.0
                    g0 = on * z0 - end
                    g1 = on * z1 - end
                    if (g0 <= 0.0) == (g1 <= 0.0) or g0 < -end:
                        continue
                    at = g0 / (g0 - g1)
                    n = n0 + at * (n1 - n0)
                    gap = abs(n) - wall
                    if gap > 0.0:
                        if gap >= reach:
                            continue
                        force = gap_force(
                            gap, par[L.C_FMAX], par[L.C_DC], reach, int(par[L.C_LAW])
                        )
                        if force < least:
                            continue
                        # a corner that meets the other's corner goes on to meet its wall
                        ex = on * end if axis == 0 else math.copysign(wall, n)
                        ey = math.copysign(wall, n) if axis == 0 else on * end
                        fx = cj * ex - sj * ey + work.stage_q[j, 0] - work.stage_q[i, 0]
                        fy = sj * ex + cj * ey + work.stage_q[j, 1] - work.stage_q[i, 1]
                        iu = ci * fx + si * fy
                        iw = -si * fx + ci * fy
                        if u * iu > a_i * a_i and w * iw > b_i * b_i:
                            continue
                    else:
                        # out of the body: by the wall that it came in through?
                        if g1 <= 0.0:
                            continue
                        mask = state.mask[p, 4 * side + corner]
                        came = nearest_wall(x0, y0, a_j, b_j, mask)
                        if (came == FRONT or came == REAR) == (axis == 0):
                            continue
                    if g0 <= 0.0:
                        share = min(share, _passing(g0, on * h * dz0, g1, on * h * dz1))
                    else:
                        share = min(share, _passing(-g0, -on * h * dz0, -g1, -on * h * dz1))
    return share


KINK = 0.002
"""A spring that begins or ends within a step counts as located below this share of ``F_max``."""


@inner_jit
def _engages(g0: float, d0: float, g1: float, d1: float, most: float) -> float:
    """Share of the step at which ``g`` goes through zero, either way; 1.0 if it need not be found.

    Need not: the spring's force, ``g`` times its stiffness, stays below a force (or moment) at
    either end; ``most`` is that divided by the stiffness.
    """
    if g0 <= 0.0 and g1 > most and g0 < -most:
        return cubic_root(g0, d0, g1, d1)
    if g0 >= 0.0 and g1 < -most and g0 > most:
        return cubic_root(-g0, -d0, -g1, -d1)
    return 1.0


@inner_jit
def first_kink(model: Model, state: State, work: Work, h: float) -> float:
    """Share of the step at which the first striker or knuckle begins or ceases to work.

    Their forces have a kink there; with stiff strikers that decides how well a step can be.
    """
    keep_separate()
    car = model.car
    knuckle = model.knuckle
    q0 = state.q
    v0 = state.v
    q1 = work.stage_q
    v1 = work.stage_v
    force = KINK * model.par[L.C_FMAX]
    share = 1.0
    n = q0.shape[0]
    for i in range(n):
        for end in range(2):
            arm = car[i, L.ARM_F] if end == 0 else car[i, L.ARM_R]
            opening = car[i, L.OPEN_F] if end == 0 else car[i, L.OPEN_R]
            stiffness = car[i, L.K2_F] if end == 0 else car[i, L.K2_R]
            x1 = arm * (q1[i, 3 + end] - q1[i, 2])
            x0 = arm * (q0[i, 3 + end] - q0[i, 2])
            on = 1.0 if abs(x1) > abs(x0) and x1 > 0.0 or abs(x1) <= abs(x0) and x0 > 0.0 else -1.0
            g0 = on * x0 - opening
            g1 = on * x1 - opening
            if (g0 > 0.0) != (g1 > 0.0):
                share = min(share, _engages(
                    g0, on * h * arm * (v0[i, 3 + end] - v0[i, 2]),
                    g1, on * h * arm * (v1[i, 3 + end] - v1[i, 2]),
                    force / stiffness,
                ))  # fmt: skip
        if i < n - 1 and state.coupled[i]:
            x1 = q1[i, 4] - q1[i + 1, 3]
            x0 = q0[i, 4] - q0[i + 1, 3]
            on = 1.0 if abs(x1) > abs(x0) and x1 > 0.0 or abs(x1) <= abs(x0) and x0 > 0.0 else -1.0
            root = knuckle[i, L.KN_ROOT]
            g0 = on * x0 - root
            g1 = on * x1 - root
            if (g0 > 0.0) != (g1 > 0.0):
                slope = abs(knuckle[i, L.KN_1] + 2.0 * knuckle[i, L.KN_2] * root)
                share = min(share, _engages(
                    g0, on * h * (v0[i, 4] - v0[i + 1, 3]),
                    g1, on * h * (v1[i, 4] - v1[i + 1, 3]),
                    force / slope,
                ))  # fmt: skip
    return share
