"""One step of a Runge-Kutta method, with friction near rest taken implicitly.

The method is a table (``methods``). Explicit methods need no more than their weights. Near rest
the smoothed friction of ground and brakes relaxes velocities within a millisecond, which holds an
explicit method to steps of that size long after all else has become slow. A W-method,

    k_i = f(y + h sum_j alpha_ij k_j) + h A (gamma k_i + sum_j gamma_ij k_j)
    y_new = y + h sum_i b_i k_i

keeps the order of its conditions for *any* matrix A, so A may hold just what is stiff: minus the
derivative C of the friction forces by the velocities, one symmetric 3 x 3 block a car, frozen over
the step, and only for the cars whose friction is fast compared with the step. Where A is zero the
explicit method (alpha, b) remains, at its full order.

With the constraints, a stage is one solve with ``M + h gamma C`` in the place of M,

    (M + h gamma C) k_i = Q(y_i) - h C sum_j gamma_ij k_j + J^T lambda,    J k_i = gamma(y_i)

so that an implicit stage costs what an explicit one does. Source of W-methods: T. Steihaug and
A. Wolfbrandt, Math. Comp. 33 (1979).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from derail_ros.engine import layout as L
from derail_ros.engine.arrays import Model, State, Work
from derail_ros.engine.dynamics import IMPLICIT, PLAIN, accelerations
from derail_ros.engine.forces import brake_force, ground_points, lies_free
from derail_ros.engine.jit import inner_jit, keep_separate
from derail_ros.engine.laws.brake import smooth_direction
from derail_ros.engine.laws.ground import BODY_POINTS, drag_slopes
from derail_ros.engine.solver import acceleration_gamma, factor, solve, truck_rows
from derail_ros.engine.trigonometry import angles

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]

STIFF = 0.5
"""Friction is taken implicitly where a step times its fastest rate exceeds this."""


@inner_jit
def _slopes_of_points(par: F64, ground: F64, count: int) -> None:
    """``drag_slopes`` at the velocities ``ground[0:2]`` into ``ground[2:4]``."""
    c_s = par[L.G_CS]
    c_d = par[L.G_CD]
    eps = par[L.G_EPS]
    c_v = par[L.G_CV]
    for m in range(count):
        ux = ground[0, m]
        uy = ground[1, m]
        across, along = drag_slopes(math.sqrt(ux * ux + uy * uy), c_s, c_d, eps, c_v)
        ground[2, m] = across
        ground[3, m] = along


@inner_jit
def _may_be_stiff(par: F64, car: F64, trucks: int, v: F64, i: int, h: float) -> bool:
    """A bound on the rate of the friction at the slowest point of car ``i`` is not small."""
    speed = math.sqrt(v[i, 0] * v[i, 0] + v[i, 1] * v[i, 1])
    slowest = max(0.0, speed - abs(v[i, 2]) * car[i, L.HALF_L])
    eps = par[L.G_EPS]
    force = 20.0  # of brakes, for a mass of 1
    if trucks < 2:
        lever = car[i, L.HALF_L] / car[i, L.GYRATION]
        force += par[L.G_SCALE] * par[L.GRAVITY] * par[L.G_CS] * (2.0 + lever * lever)
    return h * force > STIFF * math.sqrt(slowest * slowest + eps * eps)


@inner_jit
def friction_damping(
    par: F64,
    car: F64,
    unit: F64,
    unit_start: I64,
    arrival: F64,
    t: float,
    t_on: float,
    truck_on: U8,
    coupled: U8,
    v: F64,
    wk: F64,
    ground: F64,
    h: float,
) -> bool:
    """Damping C by friction of the stiff cars into ``wk``; True if there are any.

    C is minus the derivative of the friction forces (ground, brakes) by (Vx, Vy, yaw rate): for a
    force ``-g(v) u`` at a point with velocity u, ``g`` across u and ``d(g v)/dv >= 0`` along it.
    """
    keep_separate()
    n = v.shape[0]
    eps = par[L.G_EPS]
    count = 0
    some = False
    for i in range(n):
        trucks = int(truck_on[i, 0]) + int(truck_on[i, 1])
        wk[i, L.W_STIFF] = 0.0
        if _may_be_stiff(par, car, trucks, v, i, h):
            wk[i, L.W_STIFF] = 1.0
            some = True
            if trucks < 2:
                free = lies_free(coupled, i, n)
                count = ground_points(car, truck_on, i, free, v, wk, ground, count)
    if not some:
        return False
    _slopes_of_points(par, ground, count)
    some = False
    m = 0
    for i in range(n):
        if wk[i, L.W_STIFF] == 0.0:
            continue
        xx = 0.0
        xy = 0.0
        xt = 0.0
        yy = 0.0
        yt = 0.0
        tt = 0.0
        trucks = int(truck_on[i, 0]) + int(truck_on[i, 1])
        if trucks > 0:
            vx = v[i, 0]
            vy = v[i, 1]
            speed = math.sqrt(vx * vx + vy * vy)
            f = brake_force(
                par[L.BRAKE_RISE], unit, unit_start[i], unit_start[i + 1], arrival, t, t_on, speed
            ) * (0.5 * trucks)
            if f != 0.0:
                across = f * smooth_direction(speed, eps)
                along = across * (eps * eps) / (speed * speed + eps * eps)
                ux = 1.0
                uy = 0.0
                if speed > 0.0:
                    ux = vx / speed
                    uy = vy / speed
                xx += across + (along - across) * ux * ux
                xy += (along - across) * ux * uy
                yy += across + (along - across) * uy * uy
        if trucks < 2:
            ct = wk[i, L.W_CT]
            st = wk[i, L.W_ST]
            free = lies_free(coupled, i, n)
            load = par[L.G_SCALE] * car[i, L.MASS] * par[L.GRAVITY]
            load /= BODY_POINTS if free else 2
            for k in range(BODY_POINTS if free else 2):
                if free:
                    r = car[i, L.HALF_L] * ((2.0 * k + 1.0) / BODY_POINTS - 1.0)
                else:
                    if truck_on[i, k]:
                        continue
                    r = car[i, L.DT] if k == 0 else -car[i, L.DT]
                ux = ground[0, m]
                uy = ground[1, m]
                across = ground[2, m] * load
                along = ground[3, m] * load
                m += 1
                v2 = ux * ux + uy * uy
                share = 0.0
                if v2 > 0.0:
                    share = (along - across) / v2
                cxx = across + share * ux * ux
                cxy = share * ux * uy
                cyy = across + share * uy * uy
                bx = -r * st
                by = r * ct
                xx += cxx
                xy += cxy
                yy += cyy
                xt += cxx * bx + cxy * by
                yt += cxy * bx + cyy * by
                tt += cxx * bx * bx + 2.0 * cxy * bx * by + cyy * by * by
        # the largest rate is below the trace
        if h * ((xx + yy) / car[i, L.MASS] + tt / car[i, L.INERTIA]) <= STIFF:
            wk[i, L.W_STIFF] = 0.0
            continue
        some = True
        wk[i, L.W_C] = xx
        wk[i, L.W_C + 1] = xy
        wk[i, L.W_C + 2] = xt
        wk[i, L.W_C + 3] = yy
        wk[i, L.W_C + 4] = yt
        wk[i, L.W_C + 5] = tt
    return some


@inner_jit
def longest_stable(model: Model, state: State, work: Work, h: float, bound: float) -> float:
    """Longest step up to ``h`` in which an explicit method is stable under the friction, s.

    ``bound`` is the method's along the negative real axis; a tenth of it is left to what the
    friction changes within the step. The fastest rate is the largest eigenvalue of ``M^-1 C`` of a
    car, from above: the largest sum of a row's sizes, in the metric of the masses. Constraints
    only make it slower.

    Error control alone does not see the instability of a car at rest: steps grow until what
    rounding has left of its velocities has become an oscillation of the size of the tolerance.
    """
    keep_separate()
    wk = work.wk
    car = model.car
    angles(state.q, wk, work.ang)
    if not friction_damping(
        model.par, car, model.unit, model.unit_start, state.arrival, state.clock[L.T],
        state.clock[L.T_ON], state.truck_on, state.coupled, state.v, wk, work.ground, h,
    ):  # fmt: skip
        return h
    fastest = 0.0
    for i in range(wk.shape[0]):
        if wk[i, L.W_STIFF] == 0.0:
            continue
        wk[i, L.W_STIFF] = 0.0
        root = math.sqrt(car[i, L.MASS] * car[i, L.INERTIA])
        xy = abs(wk[i, L.W_C + 1]) / car[i, L.MASS]
        xt = abs(wk[i, L.W_C + 2]) / root
        yt = abs(wk[i, L.W_C + 4]) / root
        fastest = max(fastest, wk[i, L.W_C] / car[i, L.MASS] + xy + xt)
        fastest = max(fastest, xy + wk[i, L.W_C + 3] / car[i, L.MASS] + yt)
        fastest = max(fastest, xt + yt + wk[i, L.W_C + 5] / car[i, L.INERTIA])
    return min(h, 0.9 * bound / fastest)


@inner_jit
def _implicit_masses(car: F64, wk: F64, factor_h: float) -> None:
    """Inverse of ``M + factor_h C`` of the stiff cars into ``wk``."""
    for i in range(wk.shape[0]):
        if wk[i, L.W_STIFF] == 0.0:
            continue
        xx = car[i, L.MASS] + factor_h * wk[i, L.W_C]
        xy = factor_h * wk[i, L.W_C + 1]
        xt = factor_h * wk[i, L.W_C + 2]
        yy = car[i, L.MASS] + factor_h * wk[i, L.W_C + 3]
        yt = factor_h * wk[i, L.W_C + 4]
        tt = car[i, L.INERTIA] + factor_h * wk[i, L.W_C + 5]
        a = yy * tt - yt * yt
        b = xt * yt - xy * tt
        c = xy * yt - xt * yy
        det = xx * a + xy * b + xt * c
        wk[i, L.W_M] = a / det
        wk[i, L.W_M + 1] = b / det
        wk[i, L.W_M + 2] = c / det
        wk[i, L.W_M + 3] = (xx * tt - xt * xt) / det
        wk[i, L.W_M + 4] = (xy * xt - xx * yt) / det
        wk[i, L.W_M + 5] = (xx * yy - xy * xy) / det


@inner_jit
def _restore_masses(car: F64, wk: F64) -> None:
    """Inverse of ``M`` of the stiff cars into ``wk``, to the bit as ``plain_masses`` has it.

    A run that goes on from a saved state begins with those.
    """
    for i in range(wk.shape[0]):
        if wk[i, L.W_STIFF] == 0.0:
            continue
        wk[i, L.W_M] = 1.0 / car[i, L.MASS]
        wk[i, L.W_M + 1] = 0.0
        wk[i, L.W_M + 2] = 0.0
        wk[i, L.W_M + 3] = 1.0 / car[i, L.MASS]
        wk[i, L.W_M + 4] = 0.0
        wk[i, L.W_M + 5] = 1.0 / car[i, L.INERTIA]


@inner_jit
def _combine(y0: F64, k: F64, table: F64, row: int, terms: int, h: float, out: F64) -> None:
    """``out = y0 + h sum_r table[row, r] k_r``; ``k`` holds the slopes one after the other."""
    n = y0.shape[0]
    for m in range(n):
        out[m] = y0[m]
    for r in range(terms):
        w = h * table[row, r]
        if w != 0.0:
            first = r * n
            for m in range(n):
                out[m] += w * k[first + m]


@inner_jit
def take_stages(model: Model, state: State, work: Work, h: float, stages: int) -> int:
    """The stages of a step of size ``h`` from the accepted state.

    Puts the new state into ``work.stage_q/v`` and mean powers into ``work.mean_power``. Returns 0
    for an explicit step, 1 for one with implicit friction, -1 when the constraints are singular.
    """
    keep_separate()
    n = state.q.shape[0]
    size = 5 * n
    table = model.table
    car = model.car
    wk = work.wk
    q1 = work.stage_q
    v1 = work.stage_v
    q0_flat = state.q.reshape(size)
    v0_flat = state.v.reshape(size)
    q1_flat = q1.reshape(size)
    v1_flat = v1.reshape(size)
    kq = work.kq.reshape(work.kq.size)
    kv = work.kv.reshape(work.kv.size)
    t = state.clock[L.T]
    gamma = table[2 * stages + 3, 0]
    stiff = False
    if gamma > 0.0:
        angles(state.q, wk, work.ang)
        stiff = friction_damping(
            model.par, car, model.unit, model.unit_start, state.arrival, t, state.clock[L.T_ON],
            state.truck_on, state.coupled, state.v, wk, work.ground, h,
        )  # fmt: skip
    for m in range(size):
        kq[m] = v0_flat[m]
    for k in range(L.N_POWER):
        work.kp[0, k] = state.power[k]
    mode = PLAIN
    if stiff:
        mode = IMPLICIT
        _implicit_masses(car, wk, h * gamma)
        # The forces at the accepted state are M a less those of its constraints: the multipliers
        # found here are differences, the slopes are the same.
        for i in range(n):
            work.force[i, 0] = car[i, L.MASS] * state.a[i, 0]
            work.force[i, 1] = car[i, L.MASS] * state.a[i, 1]
            work.force[i, 2] = car[i, L.INERTIA] * state.a[i, 2]
            work.force[i, 3] = car[i, L.IC] * state.a[i, 3]
            work.force[i, 4] = car[i, L.IC] * state.a[i, 4]
        truck_rows(car, model.track, state.truck_s, state.truck_on, state.q, wk)
        if not factor(car, state.truck_on, state.coupled, wk):
            _restore_masses(car, wk)
            return -1
        acceleration_gamma(
            model.par, car, state.truck_on, state.coupled, state.q, state.v, wk, work.gamma_t,
            work.gamma_c,
        )  # fmt: skip
        solve(
            car, state.truck_on, state.coupled, wk, work.force, work.gamma_t, work.gamma_c,
            work.kv[0], work.lam_t, work.lam_c,
        )  # fmt: skip
    else:
        for i in range(n):
            for k in range(5):
                work.kv[0, i, k] = state.a[i, k]
    for s in range(1, stages):
        _combine(q0_flat, kq, table, s, s, h, q1_flat)
        _combine(v0_flat, kv, table, s, s, h, v1_flat)
        for m in range(size):
            kq[s * size + m] = v1_flat[m]
        if stiff:
            for i in range(n):
                if wk[i, L.W_STIFF] != 0.0:
                    for k in range(3):
                        total = 0.0
                        for r in range(s):
                            total += table[stages + s, r] * work.kv[r, i, k]
                        wk[i, L.W_SX + k] = h * total
        if not accelerations(
            model, state, work, t + table[2 * stages + 2, s] * h, state.truck_on, state.coupled,
            q1, v1, work.kv[s], mode,
        ):  # fmt: skip
            if stiff:
                _restore_masses(car, wk)
            return -1
        for k in range(L.N_POWER):
            work.kp[s, k] = work.power[k]
    _combine(q0_flat, kq, table, 2 * stages, stages, h, q1_flat)
    _combine(v0_flat, kv, table, 2 * stages, stages, h, v1_flat)
    for k in range(L.N_POWER):
        total = 0.0
        for s in range(stages):
            total += table[2 * stages, s] * work.kp[s, k]
        work.mean_power[k] = total
    if stiff:
        _restore_masses(car, wk)
        return 1
    return 0


@inner_jit
def step_error(model: Model, state: State, work: Work, h: float, stages: int, last: int) -> float:
    """Error of a step in units of the tolerance: difference to the embedded method, largest one.

    The scale is ``rtol`` times 1 m for coordinates and ``rtol (1 m/s + |v|)`` for velocities, so
    it does not depend on where along the track the train is. Angles count by their arc at the
    radius of gyration ``sqrt(I / m)``: the metric of the kinetic energy. ``last`` slopes count.
    """
    keep_separate()
    size = state.q.size
    table = model.table
    eq = work.dx.reshape(size)
    ev = work.force.reshape(size)
    kq = work.kq.reshape(work.kq.size)
    kv = work.kv.reshape(work.kv.size)
    for m in range(size):
        eq[m] = 0.0
        ev[m] = 0.0
    for r in range(last):
        w = h * table[2 * stages + 1, r]
        if w != 0.0:
            first = r * size
            for m in range(size):
                eq[m] += w * kq[first + m]
            for m in range(size):
                ev[m] += w * kv[first + m]
    error = 0.0
    m = 0
    for i in range(state.q.shape[0]):
        for k in range(5):
            arm = 1.0
            if k == 2:
                arm = model.car[i, L.GYRATION]
            elif k > 2:
                arm = model.car[i, L.GYRATION_C]
            a = abs(eq[m]) * arm
            b = abs(ev[m]) * arm / (1.0 + arm * abs(state.v[i, k]))
            # written so that a nan counts as an error
            if not a <= error:
                error = a
            if not b <= error:
                error = b
            m += 1
    return error / model.par[L.RTOL]
