"""Runge-Kutta-Fehlberg 4(5): the reference integrator.

Source: E. Fehlberg, NASA TR R-315 (1969). The fifth-order solution is carried on.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from derail_ros.engine import layout as L
from derail_ros.engine.arrays import Model, State, Work
from derail_ros.engine.dynamics import accelerations
from derail_ros.engine.jit import inner_jit, keep_separate

F64 = NDArray[np.float64]

# Fehlberg's 4(5) pair.
RKF_C = (0.0, 1 / 4, 3 / 8, 12 / 13, 1.0, 1 / 2)
RKF_A = np.array(
    [
        [0, 0, 0, 0, 0],
        [1 / 4, 0, 0, 0, 0],
        [3 / 32, 9 / 32, 0, 0, 0],
        [1932 / 2197, -7200 / 2197, 7296 / 2197, 0, 0],
        [439 / 216, -8, 3680 / 513, -845 / 4104, 0],
        [-8 / 27, 2, -3544 / 2565, 1859 / 4104, -11 / 40],
    ]
)
RKF_B = (16 / 135, 0.0, 6656 / 12825, 28561 / 56430, -9 / 50, 2 / 55)
RKF_E = (1 / 360, 0.0, -128 / 4275, -2197 / 75240, 1 / 50, 2 / 55)


@inner_jit
def rkf45_step(model: Model, state: State, work: Work, h: float) -> float:
    """One Fehlberg step of size ``h`` from the accepted state into ``work.stage_q/v``.

    Returns the error in units of the tolerance (fifth less fourth order, largest component): the
    scale is ``rtol`` times 1 m for coordinates and ``rtol (1 m/s + |v|)`` for velocities, so it
    does not depend on where along the track the train is. Angles count by their arc at the radius
    of gyration ``sqrt(I / m)``: the metric of the kinetic energy. Mean powers go into
    ``work.mean_power``.
    """
    keep_separate()
    n = state.q.shape[0]
    q1 = work.stage_q
    v1 = work.stage_v
    for i in range(n):
        for k in range(5):
            work.kq[0, i, k] = state.v[i, k]
            work.kv[0, i, k] = state.a[i, k]
    for k in range(L.N_POWER):
        work.kp[0, k] = state.power[k]
    t = state.clock[L.T]
    for s in range(1, 6):
        for i in range(n):
            for k in range(5):
                dq = 0.0
                dv = 0.0
                for r in range(s):
                    dq += RKF_A[s, r] * work.kq[r, i, k]
                    dv += RKF_A[s, r] * work.kv[r, i, k]
                q1[i, k] = state.q[i, k] + h * dq
                v1[i, k] = state.v[i, k] + h * dv
        ok = accelerations(
            model, state, work, t + RKF_C[s] * h, state.truck_on, state.coupled, q1, v1,
            work.kv[s], False,
        )  # fmt: skip
        if not ok:
            return math.inf
        for i in range(n):
            for k in range(5):
                work.kq[s, i, k] = v1[i, k]
        for k in range(L.N_POWER):
            work.kp[s, k] = work.power[k]
    error = 0.0
    rtol = model.par[L.RTOL]
    for i in range(n):
        for k in range(5):
            dq = 0.0
            dv = 0.0
            eq = 0.0
            ev = 0.0
            for s in range(6):
                dq += RKF_B[s] * work.kq[s, i, k]
                dv += RKF_B[s] * work.kv[s, i, k]
                eq += RKF_E[s] * work.kq[s, i, k]
                ev += RKF_E[s] * work.kv[s, i, k]
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
        for s in range(6):
            total += RKF_B[s] * work.kp[s, k]
        work.mean_power[k] = total
    return error
