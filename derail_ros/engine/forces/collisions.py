"""Collisions: contact forces between the rectangles of two cars.

Force: each corner that comes within the buffer of another car is pushed along the normal of the
wall or corner it meets, the other car the opposite way (``laws.contact``). Power: what the
contacts take out, their force times the closing speed. Moments: a corner passes the end of a wall,
where the force jumps.

``contacts`` follows the contacts over a run, ``neighbours`` lists the pairs to look at.
"""

from __future__ import annotations

import math
from typing import Any

from derail_ros.engine import layout
from derail_ros.engine.arrays import F64, Model, Rows, State, Work
from derail_ros.engine.interpolation import cubic_root
from derail_ros.engine.jit import inner_jit, keep_separate
from derail_ros.engine.laws.contact import (
    FRONT,
    LEFT,
    ON_LINE,
    REAR,
    gap_force,
    nearest_wall,
    on_line,
    outside_mask,
    speed_factor,
)
from derail_ros.engine.trigonometry import sincos

Frame = tuple[float, float, float, float]


@inner_jit
def pair_frames(
    q: F64, i: int, j: int, ci: float, si: float, cj: float, sj: float
) -> tuple[Frame, Frame]:
    """Where car ``i`` is seen from car ``j``, and ``j`` from ``i``.

    A frame is the centre of the one (m) and the cosine and sine of its direction, along and
    across the other. Given are cosine and sine of the yaw of both.
    """
    dx = q[i, 0] - q[j, 0]
    dy = q[i, 1] - q[j, 1]
    c = ci * cj + si * sj
    s = si * cj - ci * sj
    return (
        (cj * dx + sj * dy, -sj * dx + cj * dy, c, s),
        (-ci * dx - si * dy, si * dx - ci * dy, c, -s),
    )


@inner_jit
def widest_gap(car: Rows, i: int, j: int, seen: tuple[Frame, Frame]) -> float:
    """Widest gap between the two rectangles along an axis of either, m; below 0 without one."""
    (ju, jw, c, s), (iu, iw, _, _) = seen
    c = abs(c)
    s = abs(s)
    a_i = car[i].half_l
    b_i = car[i].half_w
    a_j = car[j].half_l
    b_j = car[j].half_w
    return max(
        max(abs(ju) - a_j - a_i * c - b_i * s, abs(jw) - b_j - a_i * s - b_i * c),
        max(abs(iu) - a_i - a_j * c - b_j * s, abs(iw) - b_i - a_j * s - b_j * c),
    )


@inner_jit
def corner_of(car: Rows, i: int, corner: int) -> tuple[float, float]:
    """Place of a corner of car ``i`` along and across it, m.

    0 front left, 1 front right, 2 rear left, 3 rear right.
    """
    return (
        car[i].half_l if corner < 2 else -car[i].half_l,
        car[i].half_w if corner % 2 == 0 else -car[i].half_w,
    )


@inner_jit
def clear(pair: Rows, p: int) -> None:
    """Forget the forces of the pair in row ``p``."""
    pair[p].fx = 0.0
    pair[p].fy = 0.0
    pair[p].peak = 0.0
    pair[p].power = 0.0


@inner_jit
def _bell(par: Any, gap: float) -> float:
    """The gap law of the run, N."""
    return gap_force(
        gap, par.force_max, par.half_distance, par.buffer, int(par.gap_law), int(par.even_inside)
    )


@inner_jit
def speed_along(v: F64, q: F64, i: int, px: float, py: float, nx: float, ny: float) -> float:
    """Speed of the point of car ``i`` at (px, py) along (nx, ny), m/s."""
    return nx * (v[i, 0] - v[i, 2] * (py - q[i, 1])) + ny * (v[i, 1] + v[i, 2] * (px - q[i, 0]))


@inner_jit
def _push(force: F64, q: F64, i: int, px: float, py: float, fx: float, fy: float) -> float:
    """Add a force at a place to car ``i``; returns its moment about the mass centre."""
    moment = (px - q[i, 0]) * fy - (py - q[i, 1]) * fx
    force[i, 0] += fx
    force[i, 1] += fy
    force[i, 2] += moment
    return moment


@inner_jit
def _report_corner(
    report: F64, i: int, corner: int, force: float, gap: float, closing: float, other: int
) -> None:
    """Keep the strongest contact of a corner for the report."""
    base = layout.R_CORNER + 4 * corner
    if force > report[i, base]:
        report[i, base] = force
        report[i, base + 1] = gap
        report[i, base + 2] = closing
        report[i, base + 3] = other + 1


@inner_jit
def _corner_contacts(
    model: Model,
    state: State,
    q: F64,
    v: F64,
    wk: Rows,
    force: F64,
    pair: Rows,
    report: F64,
    p: int,
    i: int,
    j: int,
    seen: Frame,
    second: bool,
) -> None:
    """Contacts of the corners of car ``i`` with car ``j``, from which it is ``seen``.

    ``second`` says that ``i`` is the second car of the pair row ``p``; corner meets corner is
    treated only when it is not, so that it is done once.
    """
    keep_separate()
    par = model.par[0]
    car = model.car
    mask = state.mask
    d_b = par.buffer
    a_i = car[i].half_l
    b_i = car[i].half_w
    a_j = car[j].half_l
    b_j = car[j].half_w
    cj = wk[j].ct
    sj = wk[j].st
    u0, w0, c, s = seen
    for corner in range(4):
        u, w = corner_of(car, i, corner)
        ju = u0 + c * u - s * w
        jw = w0 + s * u + c * w
        if abs(ju) >= a_j + d_b or abs(jw) >= b_j + d_b:
            continue
        out = outside_mask(ju, jw, a_j, b_j)
        wall = out
        gap = 0.0
        nu = 0.0
        nw = 0.0
        other_corner = -1
        if out == 0:
            came = mask[p, 4 + corner] if second else mask[p, corner]
            wall = nearest_wall(ju, jw, a_j, b_j, came)
        if wall == FRONT or wall == REAR:
            nu = 1.0 if wall == FRONT else -1.0
            gap = nu * ju - a_j
            if second and on_line(jw, b_j, s):
                continue
        elif (wall & (FRONT | REAR)) == 0:
            nw = 1.0 if wall == LEFT else -1.0
            gap = nw * jw - b_j
            if second and on_line(ju, a_j, s):
                continue
        else:
            if second:
                continue
            # both outside: corner of j that is nearest, if each lies in the other's corner region
            su = 1.0 if wall & FRONT else -1.0
            sw = 1.0 if wall & LEFT else -1.0
            du = ju - su * a_j
            dw = jw - sw * b_j
            gap = math.sqrt(du * du + dw * dw)
            if gap >= d_b or gap < 1e-12:
                continue
            # that corner in the frame of i: beyond both walls, on the side of this very corner
            eu = su * a_j - u0
            ew = sw * b_j - w0
            iu = c * eu + s * ew
            iw = -s * eu + c * ew
            if u * iu <= a_i * (a_i + ON_LINE) or w * iw <= b_i * (b_i + ON_LINE):
                continue
            nu = du / gap
            nw = dw / gap
            other_corner = (0 if su > 0.0 else 2) + (0 if sw > 0.0 else 1)
        if gap >= d_b:
            continue
        px = q[i, 0] + wk[i].ct * u - wk[i].st * w
        py = q[i, 1] + wk[i].st * u + wk[i].ct * w
        nx = cj * nu - sj * nw
        ny = sj * nu + cj * nw
        fpx = px - gap * nx
        fpy = py - gap * ny
        closing = speed_along(v, q, j, fpx, fpy, nx, ny) - speed_along(v, q, i, px, py, nx, ny)
        f = _bell(par, gap) * speed_factor(closing, par.c1, par.c2, par.c3)
        if f <= 0.0:
            continue
        fx = f * nx
        fy = f * ny
        mi = _push(force, q, i, px, py, fx, fy)
        mj = _push(force, q, j, fpx, fpy, -fx, -fy)
        sign = -1.0 if second else 1.0
        pair[p].fx += sign * fx
        pair[p].fy += sign * fy
        pair[p].power += f * closing
        if f > pair[p].peak:
            pair[p].peak = f
            pair[p].corner = corner + (4 if second else 0)
            pair[p].x = px
            pair[p].y = py
            pair[p].nx = sign * nx
            pair[p].ny = sign * ny
            pair[p].closing = closing
        if report.shape[0]:
            report[i, layout.R_COLLISION] += fx
            report[i, layout.R_COLLISION + 1] += fy
            report[i, layout.R_COLLISION + 2] += mi
            report[j, layout.R_COLLISION] -= fx
            report[j, layout.R_COLLISION + 1] -= fy
            report[j, layout.R_COLLISION + 2] += mj
            _report_corner(report, i, corner, f, gap, closing, j)
            if other_corner >= 0:
                _report_corner(report, j, other_corner, f, gap, closing, i)


@inner_jit
def pair_contacts(
    model: Model,
    state: State,
    q: F64,
    v: F64,
    wk: Rows,
    force: F64,
    pair: Rows,
    report: F64,
    p: int,
    seen: tuple[Frame, Frame],
) -> None:
    """Contacts between the two cars of row ``p`` into ``force`` and ``pair``."""
    i = state.pairs[p, 0]
    j = state.pairs[p, 1]
    _corner_contacts(model, state, q, v, wk, force, pair, report, p, i, j, seen[0], False)
    _corner_contacts(model, state, q, v, wk, force, pair, report, p, j, i, seen[1], True)


@inner_jit
def collision_forces(model: Model, state: State, work: Work, q: F64, v: F64) -> None:
    """Add the contact forces between the pairs in ``work.active`` to ``work.force``.

    Per-pair sums go into ``state.pair``.
    """
    keep_separate()
    wk = work.wk
    pair = state.pair
    power = 0.0
    for a in range(1, 1 + work.active[0]):
        p = work.active[a]
        i = state.pairs[p, 0]
        j = state.pairs[p, 1]
        if pair[p].near != 0.0:
            clear(pair, p)
            pair[p].near = 0.0
        seen = pair_frames(q, i, j, wk[i].ct, wk[i].st, wk[j].ct, wk[j].st)
        if widest_gap(model.car, i, j, seen) <= model.par[0].buffer:
            pair[p].near = 1.0
            pair_contacts(model, state, q, v, wk, work.force, pair, work.report, p, seen)
            power += pair[p].power
    work.power[layout.E_COLLISION] = power


# Moments inside a step -----------------------------------------------------------------------

CLOSE = 1e-5
"""A step ends this far before a jump of the force, m, and the next one as far behind it."""

JUMP = 0.005
"""Jumps of the force below this share of ``F_max`` are left to the error control."""


@inner_jit
def _passing(g0: float, d0: float, g1: float, d1: float) -> float:
    """Share of the step that ends beside the jump at g = 0, 1.0 if this step may stand.

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
def first_jump(model: Model, state: State, work: Work, h: float) -> float:
    """Share of the step at which the first contact changes its features; 1.0 without a change.

    A corner that passes the end of a wall begins or ceases to be pushed by that wall, and a corner
    that leaves a body through another wall than it came in by is pushed another way: the force
    jumps there. A step over such a jump is of first order, whatever its method. So one step ends
    just before it and a tiny one goes across.

    The step's end is in ``work.stage_q/v``, its angles in ``work.wk``.
    """
    keep_separate()
    par = model.par[0]
    car = model.car
    wk = work.wk
    reach = par.buffer
    least = JUMP * par.force_max
    share = 1.0
    for a in range(1, 1 + work.active[0]):
        p = work.active[a]
        if state.pair[p].near == 0.0:
            continue
        for side in range(2):
            i = state.pairs[p, side]
            j = state.pairs[p, 1 - side]
            a_i = car[i].half_l
            b_i = car[i].half_w
            a_j = car[j].half_l
            b_j = car[j].half_w
            ci = wk[i].ct
            si = wk[i].st
            cj = wk[j].ct
            sj = wk[j].st
            si0, ci0 = sincos(state.q[i, 2])
            sj0, cj0 = sincos(state.q[j, 2])
            for corner in range(4):
                u, w = corner_of(car, i, corner)
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
                        if _bell(par, gap) < least:
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
                        depth = n - wall if came == FRONT or came == LEFT else -n - wall
                        if _bell(par, depth) < least:
                            continue
                    if g0 <= 0.0:
                        share = min(share, _passing(g0, on * h * dz0, g1, on * h * dz1))
                    else:
                        share = min(share, _passing(-g0, -on * h * dz0, -g1, -on * h * dz1))
    return share
