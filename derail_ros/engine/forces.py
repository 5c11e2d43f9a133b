"""Generalized forces on all cars at a state, and the power of each.

The coordinates of a car are ``(X, Y, theta, alpha, beta)``. A force (fx, fy) at the offset
(rx, ry) from the mass centre adds (fx, fy) and the moment ``rx fy - ry fx``.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from derail_ros.engine import arrays as A
from derail_ros.engine import layout as L
from derail_ros.engine.arrays import Model
from derail_ros.engine.jit import inner_jit, jit, keep_separate
from derail_ros.engine.laws.brake import (
    cast_iron_factor,
    composition_factor,
    rise,
    smooth_direction,
)
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
from derail_ros.engine.laws.ground import BODY_POINTS, drag
from derail_ros.engine.laws.joint import joint_energy, joint_moment
from derail_ros.engine.laws.knuckle import knuckle_energy, knuckle_moment
from derail_ros.engine.laws.striker import spring_energy, spring_force

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]


@jit
def coupler_energy(model: Model, coupled: U8, q: F64) -> tuple[float, float]:
    """Energy now in the striker springs and in the knuckles, J."""
    striker = 0.0
    knuckle = 0.0
    n = q.shape[0]
    car = model.car
    kn = model.knuckle
    for i in range(n):
        x = car[i, L.ARM_F] * (q[i, 3] - q[i, 2])
        striker += spring_energy(x, car[i, L.OPEN_F], car[i, L.K1_F], car[i, L.K2_F])
        x = car[i, L.ARM_R] * (q[i, 4] - q[i, 2])
        striker += spring_energy(x, car[i, L.OPEN_R], car[i, L.K1_R], car[i, L.K2_R])
        if i < n - 1 and coupled[i]:
            x = q[i, 4] - q[i + 1, 3]
            if model.par[L.JOINT_HELD] != 0.0:
                knuckle += joint_energy(
                    x, kn[i, L.KN_0], kn[i, L.KN_1], kn[i, L.KN_2], kn[i, L.KN_ROOT],
                    kn[i, L.KN_WIDENING], kn[i, L.KN_TOP],
                )  # fmt: skip
            else:
                knuckle += knuckle_energy(
                    x, kn[i, L.KN_0], kn[i, L.KN_1], kn[i, L.KN_2], kn[i, L.KN_ROOT]
                )
    return striker, knuckle


@jit
def kinetic_energy(model: Model, v: F64) -> float:
    """Kinetic energy of all bodies, J."""
    total = 0.0
    car = model.car
    for i in range(v.shape[0]):
        total += 0.5 * (
            car[i, L.MASS] * (v[i, 0] * v[i, 0] + v[i, 1] * v[i, 1])
            + car[i, L.INERTIA] * v[i, 2] * v[i, 2]
            + car[i, L.IC] * (v[i, 3] * v[i, 3] + v[i, 4] * v[i, 4])
        )
    return total


@inner_jit
def brake_force(
    rise_time: float,
    unit: F64,
    first: int,
    last: int,
    arrival: F64,
    t: float,
    t_on: float,
    speed: float,
) -> float:
    """Retarding force of the brake units ``first`` to ``last`` of a body on the rails, N.

    ``t_on`` decides which instant applications are on: the beginning of the step, so that a
    force is never switched inside one.
    """
    composition = composition_factor(speed)
    total = 0.0
    for u in range(first, last):
        shoe = unit[u, L.U_SHOE]
        if shoe == 0.0:
            continue
        k = rise(t, arrival[u, L.ARR_CONV], rise_time)
        if t_on >= arrival[u, L.ARR_INST]:
            k = 1.0
        f = k * unit[u, L.U_FORCE]
        f *= composition if shoe == 1.0 else cast_iron_factor(speed)
        if t > arrival[u, L.ARR_TL] or t_on >= arrival[u, L.ARR_INST_TL]:
            k = rise(t, arrival[u, L.ARR_TL], rise_time)
            if t_on >= arrival[u, L.ARR_INST_TL]:
                k = 1.0
            f = max(f, k * unit[u, L.U_TRACTION])
        total += f
    return total


@inner_jit
def _note_corner(
    report: F64, i: int, corner: int, force: float, gap: float, closing: float, other: int
) -> None:
    """Keep the strongest contact of a corner for the report."""
    base = A.R_CORNER + 4 * corner
    if force > report[i, base]:
        report[i, base] = force
        report[i, base + 1] = gap
        report[i, base + 2] = closing
        report[i, base + 3] = other + 1


@inner_jit
def _push(force: F64, q: F64, i: int, px: float, py: float, fx: float, fy: float) -> float:
    """Add a force at a place to car ``i``; returns its moment about the mass centre."""
    moment = (px - q[i, 0]) * fy - (py - q[i, 1]) * fx
    force[i, 0] += fx
    force[i, 1] += fy
    force[i, 2] += moment
    return moment


@inner_jit
def _speed_along(v: F64, q: F64, i: int, px: float, py: float, nx: float, ny: float) -> float:
    """Speed of the point of car ``i`` at (px, py) along (nx, ny), m/s."""
    return nx * (v[i, 0] - v[i, 2] * (py - q[i, 1])) + ny * (v[i, 1] + v[i, 2] * (px - q[i, 0]))


@inner_jit
def _corner_contacts(
    par: F64,
    car: F64,
    q: F64,
    v: F64,
    wk: F64,
    force: F64,
    pair: F64,
    mask: U8,
    report: F64,
    p: int,
    i: int,
    j: int,
    u0: float,
    w0: float,
    c: float,
    s: float,
    flip: bool,
) -> None:
    """Contacts of the corners of car ``i`` with car ``j``.

    (u0, w0) is the centre of i and (c, s) its direction, both in the frame of j. ``flip`` says
    that ``i`` is the second car of the pair row ``p``; corner meets corner is treated only when it
    is not, so that it is done once.
    """
    keep_separate()
    d_b = par[L.C_BUFFER]
    a_i = car[i, L.HALF_L]
    b_i = car[i, L.HALF_W]
    a_j = car[j, L.HALF_L]
    b_j = car[j, L.HALF_W]
    cj = wk[j, L.W_CT]
    sj = wk[j, L.W_ST]
    for corner in range(4):
        u = a_i if corner < 2 else -a_i
        w = b_i if corner % 2 == 0 else -b_i
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
            wall = nearest_wall(ju, jw, a_j, b_j, mask[p, 4 + corner] if flip else mask[p, corner])
        if wall == FRONT or wall == REAR:
            nu = 1.0 if wall == FRONT else -1.0
            gap = nu * ju - a_j
            if flip and on_line(jw, b_j, s):
                continue
        elif (wall & (FRONT | REAR)) == 0:
            nw = 1.0 if wall == LEFT else -1.0
            gap = nw * jw - b_j
            if flip and on_line(ju, a_j, s):
                continue
        else:
            if flip:
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
        px = q[i, 0] + wk[i, L.W_CT] * u - wk[i, L.W_ST] * w
        py = q[i, 1] + wk[i, L.W_ST] * u + wk[i, L.W_CT] * w
        nx = cj * nu - sj * nw
        ny = sj * nu + cj * nw
        fpx = px - gap * nx
        fpy = py - gap * ny
        closing = _speed_along(v, q, j, fpx, fpy, nx, ny) - _speed_along(v, q, i, px, py, nx, ny)
        f = gap_force(gap, par[L.C_FMAX], par[L.C_DC], d_b, int(par[L.C_LAW])) * speed_factor(
            closing, par[L.C_C1], par[L.C_C2], par[L.C_C3]
        )
        if f <= 0.0:
            continue
        fx = f * nx
        fy = f * ny
        mi = _push(force, q, i, px, py, fx, fy)
        mj = _push(force, q, j, fpx, fpy, -fx, -fy)
        sign = -1.0 if flip else 1.0
        pair[p, L.P_FX] += sign * fx
        pair[p, L.P_FY] += sign * fy
        pair[p, L.P_POWER] += f * closing
        if f > pair[p, L.P_FMAX]:
            pair[p, L.P_FMAX] = f
            pair[p, L.P_CORNER] = corner + (4 if flip else 0)
            pair[p, L.P_X] = px
            pair[p, L.P_Y] = py
            pair[p, L.P_NX] = sign * nx
            pair[p, L.P_NY] = sign * ny
            pair[p, L.P_CLOSING] = closing
        if report.shape[0]:
            report[i, A.R_COLLISION] += fx
            report[i, A.R_COLLISION + 1] += fy
            report[i, A.R_COLLISION + 2] += mi
            report[j, A.R_COLLISION] -= fx
            report[j, A.R_COLLISION + 1] -= fy
            report[j, A.R_COLLISION + 2] += mj
            _note_corner(report, i, corner, f, gap, closing, j)
            if other_corner >= 0:
                _note_corner(report, j, other_corner, f, gap, closing, i)


@inner_jit
def pair_contacts(
    par: F64, car: F64, q: F64, v: F64, wk: F64, force: F64, pair: F64, mask: U8, report: F64,
    p: int, i: int, j: int,
) -> None:  # fmt: skip
    """Contacts between the cars ``i`` and ``j`` of row ``p``, anew."""
    keep_separate()
    pair[p, L.P_FX] = 0.0
    pair[p, L.P_FY] = 0.0
    pair[p, L.P_FMAX] = 0.0
    pair[p, L.P_POWER] = 0.0
    ci = wk[i, L.W_CT]
    si = wk[i, L.W_ST]
    cj = wk[j, L.W_CT]
    sj = wk[j, L.W_ST]
    dx = q[i, 0] - q[j, 0]
    dy = q[i, 1] - q[j, 1]
    c = ci * cj + si * sj
    s = si * cj - ci * sj
    _corner_contacts(
        par, car, q, v, wk, force, pair, mask, report, p, i, j,
        cj * dx + sj * dy, -sj * dx + cj * dy, c, s, False,
    )  # fmt: skip
    _corner_contacts(
        par, car, q, v, wk, force, pair, mask, report, p, j, i,
        -ci * dx - si * dy, si * dx - ci * dy, c, -s, True,
    )  # fmt: skip


@inner_jit
def collisions(
    par: F64,
    car: F64,
    pairs: I64,
    mask: U8,
    pair: F64,
    active: I64,
    q: F64,
    v: F64,
    wk: F64,
    force: F64,
    report: F64,
) -> float:
    """Contact forces between the pairs in ``active``; returns the power they take out, W.

    Per-pair sums go into ``pair``.
    """
    keep_separate()
    d_b = par[L.C_BUFFER]
    power = 0.0
    for a in range(1, 1 + active[0]):
        p = active[a]
        i = pairs[p, 0]
        j = pairs[p, 1]
        if pair[p, L.P_NEAR] != 0.0:
            pair[p, L.P_FX] = 0.0
            pair[p, L.P_FY] = 0.0
            pair[p, L.P_FMAX] = 0.0
            pair[p, L.P_POWER] = 0.0
            pair[p, L.P_NEAR] = 0.0
        ci = wk[i, L.W_CT]
        si = wk[i, L.W_ST]
        cj = wk[j, L.W_CT]
        sj = wk[j, L.W_ST]
        dx = q[i, 0] - q[j, 0]
        dy = q[i, 1] - q[j, 1]
        # separating axes along both bodies: extents of one in the frame of the other
        c = ci * cj + si * sj
        s = si * cj - ci * sj
        ac = abs(c)
        as_ = abs(s)
        a_i = car[i, L.HALF_L]
        b_i = car[i, L.HALF_W]
        a_j = car[j, L.HALF_L]
        b_j = car[j, L.HALF_W]
        ju = cj * dx + sj * dy
        if abs(ju) > a_j + d_b + a_i * ac + b_i * as_:
            continue
        jw = -sj * dx + cj * dy
        if abs(jw) > b_j + d_b + a_i * as_ + b_i * ac:
            continue
        iu = -ci * dx - si * dy
        if abs(iu) > a_i + d_b + a_j * ac + b_j * as_:
            continue
        iw = si * dx - ci * dy
        if abs(iw) > b_i + d_b + a_j * as_ + b_j * ac:
            continue
        pair[p, L.P_NEAR] = 1.0
        _corner_contacts(
            par, car, q, v, wk, force, pair, mask, report, p, i, j, ju, jw, c, s, False
        )
        _corner_contacts(
            par, car, q, v, wk, force, pair, mask, report, p, j, i, iu, iw, c, -s, True
        )
        power += pair[p, L.P_POWER]
    return power


@inner_jit
def _drag_of_points(par: F64, ground: F64, count: int) -> None:
    """``drag`` at the velocities ``ground[0:2]`` into ``ground[2]``: one loop of vectors."""
    c_s = par[L.G_CS]
    c_d = par[L.G_CD]
    eps = par[L.G_EPS]
    c_v = par[L.G_CV]
    for m in range(count):
        ux = ground[0, m]
        uy = ground[1, m]
        ground[2, m] = drag(math.sqrt(ux * ux + uy * uy), c_s, c_d, eps, c_v)


@inner_jit
def lies_free(coupled: U8, i: int, n: int) -> bool:
    """Both couplers of car ``i`` have parted; a missing neighbour counts as parted."""
    return (i == 0 or coupled[i - 1] == 0) and (i == n - 1 or coupled[i] == 0)


@inner_jit
def ground_points(
    car: F64, truck_on: U8, i: int, free: bool, v: F64, wk: F64, ground: F64, m: int
) -> int:
    """Velocities of the points of car ``i`` on the ground into ``ground`` from column ``m`` on.

    Ten along the body of a free car, else its trucks off the rails. Returns the next column.
    """
    nx = -v[i, 2] * wk[i, L.W_ST]
    ny = v[i, 2] * wk[i, L.W_CT]
    if free:
        for k in range(BODY_POINTS):
            r = car[i, L.HALF_L] * ((2.0 * k + 1.0) / BODY_POINTS - 1.0)
            ground[0, m + k] = v[i, 0] + r * nx
            ground[1, m + k] = v[i, 1] + r * ny
        return m + BODY_POINTS
    for k in range(2):
        if truck_on[i, k] == 0:
            r = car[i, L.DT] if k == 0 else -car[i, L.DT]
            ground[0, m] = v[i, 0] + r * nx
            ground[1, m] = v[i, 1] + r * ny
            m += 1
    return m


@inner_jit
def applied_forces(
    par: F64,
    car: F64,
    knuckle: F64,
    unit: F64,
    unit_start: I64,
    lateral: F64,
    arrival: F64,
    t: float,
    t_on: float,
    truck_on: U8,
    coupled: U8,
    q: F64,
    v: F64,
    wk: F64,
    ground: F64,
    force: F64,
    power: F64,
    report: F64,
) -> None:
    """All forces but those of collisions at ``(t, q, v)``, and the power of each.

    Angles are in ``wk``. Switched forces (initiating forces, instant brakes) are those on at
    ``t_on``.
    """
    keep_separate()
    n = q.shape[0]
    p_brake = 0.0
    p_truck = 0.0
    p_body = 0.0
    p_damper = 0.0
    p_external = 0.0
    eps = par[L.G_EPS]
    rise_time = par[L.BRAKE_RISE]
    held = par[L.JOINT_HELD] != 0.0
    reporting = report.shape[0] > 0
    if reporting:
        for i in range(n):
            for k in range(A.N_REPORT):
                report[i, k] = 0.0

    count = 0
    for i in range(n):
        if truck_on[i, 0] == 0 or truck_on[i, 1] == 0:
            free = lies_free(coupled, i, n)
            count = ground_points(car, truck_on, i, free, v, wk, ground, count)
    _drag_of_points(par, ground, count)

    m = 0
    for i in range(n):
        theta = q[i, 2]
        omega = v[i, 2]

        # strikers
        arm_f = car[i, L.ARM_F]
        x = arm_f * (q[i, 3] - theta)
        xd = arm_f * (v[i, 3] - omega)
        f_front = (
            spring_force(x, car[i, L.OPEN_F], car[i, L.K1_F], car[i, L.K2_F])
            + car[i, L.DAMP_F] * xd
        )
        p_damper += car[i, L.DAMP_F] * xd * xd
        arm_r = car[i, L.ARM_R]
        x = arm_r * (q[i, 4] - theta)
        xd = arm_r * (v[i, 4] - omega)
        f_rear = (
            spring_force(x, car[i, L.OPEN_R], car[i, L.K1_R], car[i, L.K2_R])
            + car[i, L.DAMP_R] * xd
        )
        p_damper += car[i, L.DAMP_R] * xd * xd
        fx = 0.0
        fy = 0.0
        moment = arm_f * f_front + arm_r * f_rear
        force[i, 3] = -arm_f * f_front
        force[i, 4] = -arm_r * f_rear
        if reporting:
            report[i, A.R_STRIKER] = f_front
            report[i, A.R_STRIKER + 1] = f_rear

        # brakes, at the mass centre, against its velocity
        trucks = int(truck_on[i, 0]) + int(truck_on[i, 1])
        vx = v[i, 0]
        vy = v[i, 1]
        if trucks > 0:
            speed = math.sqrt(vx * vx + vy * vy)
            f = brake_force(
                rise_time, unit, unit_start[i], unit_start[i + 1], arrival, t, t_on, speed
            ) * (0.5 * trucks)
            if f != 0.0:
                g = f * smooth_direction(speed, eps)
                fx -= g * vx
                fy -= g * vy
                p_brake += g * speed * speed
            if reporting:
                report[i, A.R_BRAKE] = f * speed * smooth_direction(speed, eps)

        # ground
        if trucks < 2:
            ct = wk[i, L.W_CT]
            st = wk[i, L.W_ST]
            free = lies_free(coupled, i, n)
            load = par[L.G_SCALE] * car[i, L.MASS] * par[L.GRAVITY]
            load /= BODY_POINTS if free else 2
            gx = 0.0
            gy = 0.0
            gm = 0.0
            lost = 0.0
            for k in range(BODY_POINTS if free else 2):
                if free:
                    r = car[i, L.HALF_L] * ((2.0 * k + 1.0) / BODY_POINTS - 1.0)
                else:
                    if truck_on[i, k]:
                        continue
                    r = car[i, L.DT] if k == 0 else -car[i, L.DT]
                ux = ground[0, m]
                uy = ground[1, m]
                g = ground[2, m] * load
                m += 1
                px = -g * ux
                py = -g * uy
                gx += px
                gy += py
                gm += r * (ct * py - st * px)
                lost -= px * ux + py * uy
                if reporting and not free:
                    report[i, A.R_TRUCK + 2 * k] = px
                    report[i, A.R_TRUCK + 2 * k + 1] = py
            fx += gx
            fy += gy
            moment += gm
            if free:
                p_body += lost
            else:
                p_truck += lost
            if reporting:
                report[i, A.R_GROUND_MOMENT] = gm
                if free:
                    report[i, A.R_BODY] = gx
                    report[i, A.R_BODY + 1] = gy
        force[i, 0] = fx
        force[i, 1] = fy
        force[i, 2] = moment

    # knuckles
    for i in range(n - 1):
        if coupled[i]:
            x = q[i, 4] - q[i + 1, 3]
            if held:
                moment = joint_moment(
                    x,
                    knuckle[i, L.KN_0],
                    knuckle[i, L.KN_1],
                    knuckle[i, L.KN_2],
                    knuckle[i, L.KN_ROOT],
                    knuckle[i, L.KN_WIDENING],
                    knuckle[i, L.KN_TOP],
                )
            else:
                moment = knuckle_moment(
                    x,
                    knuckle[i, L.KN_0],
                    knuckle[i, L.KN_1],
                    knuckle[i, L.KN_2],
                    knuckle[i, L.KN_ROOT],
                )
            force[i, 4] += moment
            force[i + 1, 3] -= moment
            if reporting:
                report[i, A.R_KNUCKLE] = moment

    # forces that start the motion
    for k in range(lateral.shape[0]):
        if lateral[k, L.LF_T0] <= t_on < lateral[k, L.LF_T1]:
            i = int(lateral[k, L.LF_CAR])
            r = lateral[k, L.LF_OFFSET]
            ex = lateral[k, L.LF_X]
            ey = lateral[k, L.LF_Y]
            rx = r * wk[i, L.W_CT]
            ry = r * wk[i, L.W_ST]
            force[i, 0] += ex
            force[i, 1] += ey
            force[i, 2] += rx * ey - ry * ex
            p_external += ex * (v[i, 0] - v[i, 2] * ry) + ey * (v[i, 1] + v[i, 2] * rx)
            if reporting:
                report[i, A.R_EXTERNAL] += ex
                report[i, A.R_EXTERNAL + 1] += ey

    power[L.E_BRAKE] = p_brake
    power[L.E_GROUND_TRUCK] = p_truck
    power[L.E_GROUND_BODY] = p_body
    power[L.E_DAMPER] = p_damper
    power[L.E_EXTERNAL] = p_external
