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
def leave_out(pair: Rows, p: int) -> None:
    """Forget the forces of the pair in row ``p``: it is too far apart to have any."""
    if pair[p].near != 0.0:
        clear(pair, p)
        pair[p].near = 0.0


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
def _report_contact(
    report: F64, i: int, j: int, corner: int, other: int, fx: float, fy: float, mi: float,
    mj: float, f: float, gap: float, closing: float,
) -> None:  # fmt: skip
    """Add a contact to the report: force on ``i`` and moments; the strongest of a corner is kept.

    ``other`` is the corner of ``j`` that is met, below 0 for a wall.
    """
    keep_separate()
    for side in range(2):
        car = i if side == 0 else j
        sign = 1.0 if side == 0 else -1.0
        report[car, layout.R_COLLISION] += sign * fx
        report[car, layout.R_COLLISION + 1] += sign * fy
        report[car, layout.R_COLLISION + 2] += mi if side == 0 else mj
        point = corner if side == 0 else other
        base = layout.R_CORNER + 4 * point
        if point >= 0 and f > report[car, base]:
            report[car, base] = f
            report[car, base + 1] = gap
            report[car, base + 2] = closing
            report[car, base + 3] = (j if side == 0 else i) + 1


@inner_jit
def pair_contacts(
    model: Model,
    state: State,
    work: Work,
    q: F64,
    v: F64,
    wk: Rows,
    force: F64,
    pair: Rows,
    first: int,
    last: int,
) -> float:
    """Contacts of the active pairs ``first`` to before ``last`` into ``force`` and ``pair``.

    Only corners in ``work.corners`` are looked at. Returns the power taken out, W. Corner meets
    corner is treated where the corner is the first car's, so that it is done once.
    """
    keep_separate()
    par = model.par[0]
    car = model.car
    report = work.report
    # what is reported begins with the law; a run leaves out what is nothing
    reach = par.buffer if report.shape[0] > 0 else par.reach
    total = 0.0
    for a in range(first, last):
        p = work.active[a]
        bits = work.corners[a]
        car_i = state.pairs[p, 0]
        car_j = state.pairs[p, 1]
        leave_out(pair, p)
        row = pair[p]
        both = pair_frames(q, car_i, car_j, wk[car_i].ct, wk[car_i].st, wk[car_j].ct, wk[car_j].st)
        sum_x = 0.0  # on the first car
        sum_y = 0.0
        power = 0.0
        for side in range(2):
            if (bits >> (4 * side)) & 15 == 0:
                continue
            second = side == 1
            i = car_j if second else car_i
            j = car_i if second else car_j
            a_j = car[j].half_l
            b_j = car[j].half_w
            ci = wk[i].ct
            si = wk[i].st
            cj = wk[j].ct
            sj = wk[j].st
            u0, w0, c, s = both[1] if second else both[0]
            for corner in range(4):
                if (bits >> (4 * side + corner)) & 1 == 0:
                    continue
                u, w = corner_of(car, i, corner)
                ju = u0 + c * u - s * w
                jw = w0 + s * u + c * w
                if abs(ju) >= a_j + reach or abs(jw) >= b_j + reach:
                    continue
                row.near = 1.0
                wall = outside_mask(ju, jw, a_j, b_j)
                if wall == 0:
                    wall = nearest_wall(ju, jw, a_j, b_j, state.mask[p, 4 * side + corner])
                gap = 0.0
                nu = 0.0
                nw = 0.0
                other_corner = -1
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
                    # both outside: corner of j that is nearest, if each lies in the other's
                    # corner region
                    su = 1.0 if wall & FRONT else -1.0
                    sw = 1.0 if wall & LEFT else -1.0
                    du = ju - su * a_j
                    dw = jw - sw * b_j
                    gap = math.sqrt(du * du + dw * dw)
                    if gap >= reach or gap < 1e-12:
                        continue
                    # that corner in the frame of i: beyond both walls, on the side of this one
                    eu = su * a_j - u0
                    ew = sw * b_j - w0
                    iu = c * eu + s * ew
                    iw = -s * eu + c * ew
                    a_i = car[i].half_l
                    b_i = car[i].half_w
                    if u * iu <= a_i * (a_i + ON_LINE) or w * iw <= b_i * (b_i + ON_LINE):
                        continue
                    nu = du / gap
                    nw = dw / gap
                    other_corner = (0 if su > 0.0 else 2) + (0 if sw > 0.0 else 1)
                if gap >= reach:
                    continue
                nx = cj * nu - sj * nw
                ny = sj * nu + cj * nw
                # lever arms: of the corner, and of its foot on the other body
                rx = ci * u - si * w
                ry = si * u + ci * w
                ou = ju - gap * nu
                ow = jw - gap * nw
                ox = cj * ou - sj * ow
                oy = sj * ou + cj * ow
                vx = v[j, 0] - v[j, 2] * oy - v[i, 0] + v[i, 2] * ry
                vy = v[j, 1] + v[j, 2] * ox - v[i, 1] - v[i, 2] * rx
                closing = nx * vx + ny * vy
                f = _bell(par, gap) * speed_factor(closing, par.c1, par.c2, par.c3)
                if f <= 0.0:
                    continue
                fx = f * nx
                fy = f * ny
                mi = rx * fy - ry * fx
                mj = oy * fx - ox * fy
                force[i, 0] += fx
                force[i, 1] += fy
                force[i, 2] += mi
                force[j, 0] -= fx
                force[j, 1] -= fy
                force[j, 2] += mj
                sign = -1.0 if second else 1.0
                sum_x += sign * fx
                sum_y += sign * fy
                power += f * closing
                if f > row.peak:
                    row.peak = f
                    row.corner = corner + 4 * side
                    row.x = q[i, 0] + rx
                    row.y = q[i, 1] + ry
                    row.nx = sign * nx
                    row.ny = sign * ny
                    row.closing = closing
                if report.shape[0]:
                    _report_contact(
                        report, i, j, corner, other_corner, fx, fy, mi, mj, f, gap, closing
                    )
        if row.near != 0.0:
            row.fx = sum_x
            row.fy = sum_y
            row.power = power
            total += power
    return total


@inner_jit
def collision_forces(model: Model, state: State, work: Work, q: F64, v: F64) -> None:
    """Add the contact forces between the pairs in ``work.active`` to ``work.force``.

    Per-pair sums go into ``state.pair``.
    """
    last = 1 + work.active[0]
    work.power[layout.E_COLLISION] = pair_contacts(
        model, state, work, q, v, work.wk, work.force, state.pair, 1, last
    )


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
def _drift(
    v: F64, i: int, j: int, rx: float, ry: float, dx: float, dy: float, cj: float, sj: float
) -> tuple[float, float]:
    """Velocity, in the frame of car ``j``, of the point (rx, ry) from the centre of car ``i``.

    (dx, dy) is the point from the centre of ``j``.
    """
    vx = v[i, 0] - v[i, 2] * ry - v[j, 0] + v[j, 2] * dy
    vy = v[i, 1] + v[i, 2] * rx - v[j, 1] - v[j, 2] * dx
    return cj * vx + sj * vy, -sj * vx + cj * vy


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
    reach = par.reach
    least = JUMP * par.force_max
    share = 1.0
    q0 = state.q
    q1 = work.stage_q
    for a in range(1, 1 + work.active[0]):
        p = work.active[a]
        if state.pair[p].near == 0.0:
            continue
        bits = work.corners[a]
        for side in range(2):
            if (bits >> (4 * side)) & 15 == 0:
                continue
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
            for corner in range(4):
                if (bits >> (4 * side + corner)) & 1 == 0:
                    continue
                u, w = corner_of(car, i, corner)
                rx1 = ci * u - si * w
                ry1 = si * u + ci * w
                dx1 = q1[i, 0] + rx1 - q1[j, 0]
                dy1 = q1[i, 1] + ry1 - q1[j, 1]
                x1 = cj * dx1 + sj * dy1
                y1 = -sj * dx1 + cj * dy1
                if abs(x1) > a_j + 2.0 * reach or abs(y1) > b_j + 2.0 * reach:
                    continue
                ci0 = wk[i].ct0
                si0 = wk[i].st0
                cj0 = wk[j].ct0
                sj0 = wk[j].st0
                rx0 = ci0 * u - si0 * w
                ry0 = si0 * u + ci0 * w
                dx0 = q0[i, 0] + rx0 - q0[j, 0]
                dy0 = q0[i, 1] + ry0 - q0[j, 1]
                x0 = cj0 * dx0 + sj0 * dy0
                y0 = -sj0 * dx0 + cj0 * dy0
                for axis in range(2):
                    # z along the wall whose end is passed, n across it
                    if axis == 0:
                        z0, z1, end = x0, x1, a_j
                        n0, n1, wall = y0, y1, b_j
                    else:
                        z0, z1, end = y0, y1, b_j
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
                        fx = cj * ex - sj * ey + q1[j, 0] - q1[i, 0]
                        fy = sj * ex + cj * ey + q1[j, 1] - q1[i, 1]
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
                    vx0, vy0 = _drift(state.v, i, j, rx0, ry0, dx0, dy0, cj0, sj0)
                    vx1, vy1 = _drift(work.stage_v, i, j, rx1, ry1, dx1, dy1, cj, sj)
                    d0 = on * h * (vx0 if axis == 0 else vy0)
                    d1 = on * h * (vx1 if axis == 0 else vy1)
                    if g0 <= 0.0:
                        share = min(share, _passing(g0, d0, g1, d1))
                    else:
                        share = min(share, _passing(-g0, -d0, -g1, -d1))
    return share
