"""Linearly implicit integration for friction near rest: Rosenbrock-W method of order 3(2).

Near rest the smoothed friction of ground and brakes relaxes velocities within a millisecond, which
holds an explicit method to steps of that size long after all else has become slow. A W-method,

    (I - h gamma A) k_i = f(y + h sum_j alpha_ij k_j) + h A sum_j gamma_ij k_j
    y_new = y + h sum_i b_i k_i

keeps its order for *any* matrix A, so A may hold just what is stiff: the derivative of the
friction forces by the velocities, one symmetric block a car. Source of the coefficients: J. Rang
and L. Angermann, BIT 45 (2005), method ROS34PW2: order 3, embedded order 2, L-stable, stiffly
accurate.

With M the mass matrix and C the damping (positive semidefinite), the accelerations live on the
constraints' tangent, so A = -P M^-1 C with P the projector onto it, and each stage solves

    (M + h gamma C) w = M r + J^T mu,    J w = J r,      r = a_i + s / gamma,  k_i = w - s / gamma

with ``s = sum_j gamma_ij k_j``: the factorization of ``solver``, with M + h gamma C for M.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from derail_ros.engine import layout as L
from derail_ros.engine.arrays import Model, State, Work
from derail_ros.engine.dynamics import accelerations
from derail_ros.engine.forces import brake_force
from derail_ros.engine.jit import inner_jit, keep_separate
from derail_ros.engine.laws.brake import smooth_direction
from derail_ros.engine.laws.ground import BODY_POINTS, drag_slopes
from derail_ros.engine.solver import coupling_rate, factor, solve, truck_rate, truck_rows
from derail_ros.engine.trigonometry import angles

F64 = NDArray[np.float64]

GAMMA = 4.3586652150845900e-01
ALPHA = np.array(
    [
        [0.0, 0.0, 0.0],
        [8.7173304301691801e-01, 0.0, 0.0],
        [8.4457060015369423e-01, -1.1299064236484185e-01, 0.0],
        [0.0, 0.0, 1.0],
    ]
)
GAMMAS = np.array(
    [
        [0.0, 0.0, 0.0],
        [-8.7173304301691801e-01, 0.0, 0.0],
        [-9.0338057013044082e-01, 5.4180672388095326e-02, 0.0],
        [2.4212380706095346e-01, -1.2232505839045147e00, 5.4526025533510214e-01],
    ]
)
C = (0.0, 8.7173304301691801e-01, 7.3157995778885238e-01, 1.0)
B = (
    2.4212380706095346e-01,
    -1.2232505839045147e00,
    1.5452602553351020e00,
    4.3586652150845900e-01,
)
# b less the embedded second-order weights
E = (
    2.4212380706095346e-01 - 3.7810903145819369e-01,
    -1.2232505839045147e00 + 9.6042292212423178e-02,
    1.5452602553351020e00 - 0.5,
    4.3586652150845900e-01 - 2.1793326075422950e-01,
)


@inner_jit
def damped_masses(model: Model, state: State, wk: F64, factor_h: float) -> None:
    """Inverse of ``M + factor_h C`` of every car at the accepted state into ``wk``.

    C is minus the derivative of the friction forces (ground, brakes) by (Vx, Vy, yaw rate): for a
    force ``-g(v) u`` at a point with velocity u, ``g`` across u and ``d(g v)/dv >= 0`` along it.
    """
    keep_separate()
    par = model.par
    n = state.q.shape[0]
    eps = par[L.G_EPS]
    t = state.clock[L.T]
    t_on = state.clock[L.T_ON]
    for i in range(n):
        mass = model.car[i, L.MASS]
        inertia = model.car[i, L.INERTIA]
        vx = state.v[i, 0]
        vy = state.v[i, 1]
        omega = state.v[i, 2]
        xx = 0.0
        xy = 0.0
        xt = 0.0
        yy = 0.0
        yt = 0.0
        tt = 0.0
        trucks = int(state.truck_on[i, 0]) + int(state.truck_on[i, 1])
        if trucks > 0:
            speed = math.sqrt(vx * vx + vy * vy)
            f = brake_force(model, state.arrival, i, t, t_on, speed) * (0.5 * trucks)
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
            free = (i == 0 or state.coupled[i - 1] == 0) and (i == n - 1 or state.coupled[i] == 0)
            points = BODY_POINTS if free else 2
            load = par[L.G_SCALE] * mass * par[L.GRAVITY] / points
            for k in range(points):
                if free:
                    r = model.car[i, L.HALF_L] * ((2.0 * k + 1.0) / BODY_POINTS - 1.0)
                else:
                    if state.truck_on[i, k]:
                        continue
                    r = model.car[i, L.DT] if k == 0 else -model.car[i, L.DT]
                ux = vx - omega * r * st
                uy = vy + omega * r * ct
                speed = math.sqrt(ux * ux + uy * uy)
                across, along = drag_slopes(speed, par[L.G_CS], par[L.G_CD], eps, par[L.G_CV])
                across *= load
                along *= load
                if speed > 0.0:
                    ux /= speed
                    uy /= speed
                else:
                    ux = 1.0
                    uy = 0.0
                cxx = across + (along - across) * ux * ux
                cxy = (along - across) * ux * uy
                cyy = across + (along - across) * uy * uy
                bx = -r * st
                by = r * ct
                xx += cxx
                xy += cxy
                yy += cyy
                xt += cxx * bx + cxy * by
                yt += cxy * bx + cyy * by
                tt += cxx * bx * bx + 2.0 * cxy * bx * by + cyy * by * by
        xx = mass + factor_h * xx
        yy = mass + factor_h * yy
        tt = inertia + factor_h * tt
        xy *= factor_h
        xt *= factor_h
        yt *= factor_h
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
        wk[i, L.W_IA] = 1.0 / model.car[i, L.IC]
        wk[i, L.W_IB] = wk[i, L.W_IA]


@inner_jit
def row_step(model: Model, state: State, work: Work, h: float) -> float:
    """One step of size ``h`` from the accepted state into ``work.stage_q/v``.

    Mean powers go into ``work.mean_power``. Returns the error in units of the tolerance, scaled as
    in ``rkf45``.
    """
    keep_separate()
    n = state.q.shape[0]
    q1 = work.stage_q
    v1 = work.stage_v
    t = state.clock[L.T]
    implicit = work.wk2
    angles(state.q, implicit)
    truck_rows(model, state, state.truck_on, state.q, implicit)
    damped_masses(model, state, implicit, h * GAMMA)
    if not factor(model, state.truck_on, state.coupled, implicit):
        return math.inf
    for s in range(4):
        if s == 0:
            for i in range(n):
                for k in range(5):
                    work.kq[0, i, k] = state.v[i, k]
                    work.kv[0, i, k] = state.a[i, k]
            for k in range(L.N_POWER):
                work.kp[0, k] = state.power[k]
        else:
            for i in range(n):
                for k in range(5):
                    dq = 0.0
                    dv = 0.0
                    for r in range(s):
                        dq += ALPHA[s, r] * work.kq[r, i, k]
                        dv += ALPHA[s, r] * work.kv[r, i, k]
                    q1[i, k] = state.q[i, k] + h * dq
                    v1[i, k] = state.v[i, k] + h * dv
                    work.kq[s, i, k] = v1[i, k]
            ok = accelerations(
                model, state, work, t + C[s] * h, state.truck_on, state.coupled, q1, v1,
                work.kv[s], False,
            )  # fmt: skip
            if not ok:
                return math.inf
            for k in range(L.N_POWER):
                work.kp[s, k] = work.power[k]
        # r = a + s / gamma; forces M r, constraint right-hand side J r
        rate = work.dx
        for i in range(n):
            for k in range(5):
                shift = 0.0
                for r in range(s):
                    shift += GAMMAS[s, r] * work.kv[r, i, k]
                shift /= GAMMA
                work.shift[i, k] = shift
                rate[i, k] = work.kv[s, i, k] + shift
            work.force[i, 0] = model.car[i, L.MASS] * rate[i, 0]
            work.force[i, 1] = model.car[i, L.MASS] * rate[i, 1]
            work.force[i, 2] = model.car[i, L.INERTIA] * rate[i, 2]
            work.force[i, 3] = model.car[i, L.IC] * rate[i, 3]
            work.force[i, 4] = model.car[i, L.IC] * rate[i, 4]
        for i in range(n):
            for k in range(2):
                if state.truck_on[i, k]:
                    work.gamma_t[i, k] = truck_rate(rate, implicit, i, k)
            if i < n - 1 and state.coupled[i]:
                gx, gy = coupling_rate(model, rate, implicit, i)
                work.gamma_c[i, 0] = gx
                work.gamma_c[i, 1] = gy
        solve(
            model, state.truck_on, state.coupled, implicit, work.force, work.gamma_t,
            work.gamma_c, work.kv[s], work.lam_t, work.lam_c,
        )  # fmt: skip
        for i in range(n):
            for k in range(5):
                work.kv[s, i, k] -= work.shift[i, k]
    error = 0.0
    rtol = model.par[L.RTOL]
    for i in range(n):
        for k in range(5):
            dq = 0.0
            dv = 0.0
            eq = 0.0
            ev = 0.0
            for s in range(4):
                dq += B[s] * work.kq[s, i, k]
                dv += B[s] * work.kv[s, i, k]
                eq += E[s] * work.kq[s, i, k]
                ev += E[s] * work.kv[s, i, k]
            q1[i, k] = state.q[i, k] + h * dq
            v1[i, k] = state.v[i, k] + h * dv
            arm = 1.0
            if k == 2:
                arm = model.car[i, L.GYRATION]
            elif k > 2:
                arm = model.car[i, L.GYRATION_C]
            eq = abs(h * eq) * arm
            ev = abs(h * ev) * arm / (1.0 + arm * abs(state.v[i, k]))
            # written so that a nan counts as an error
            if not eq <= error * rtol:
                error = eq / rtol
            if not ev <= error * rtol:
                error = ev / rtol
    for k in range(L.N_POWER):
        total = 0.0
        for s in range(4):
            total += B[s] * work.kp[s, k]
        work.mean_power[k] = total
    return error
