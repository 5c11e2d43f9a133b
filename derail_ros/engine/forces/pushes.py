"""Pushes: the lateral forces that start a derailment.

Force: constant, at a place on the car's axis, between two times. Power: put in. Moments: both
times, at which the force jumps.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from derail_ros.engine import layout as L
from derail_ros.engine.arrays import Model, State, Work
from derail_ros.engine.jit import inner_jit

F64 = NDArray[np.float64]


@inner_jit
def push_forces(model: Model, state: State, work: Work, v: F64) -> None:
    """Add the pushes that are on at ``T_ON``, the beginning of the step, to ``work.force``."""
    lateral = model.lateral
    force = work.force
    wk = work.wk
    t_on = state.clock[L.T_ON]
    power = 0.0
    for k in range(lateral.shape[0]):
        if lateral[k, L.LF_T0] <= t_on < lateral[k, L.LF_T1]:
            i = int(lateral[k, L.LF_CAR])
            fx = lateral[k, L.LF_X]
            fy = lateral[k, L.LF_Y]
            rx = lateral[k, L.LF_OFFSET] * wk[i, L.W_CT]
            ry = lateral[k, L.LF_OFFSET] * wk[i, L.W_ST]
            force[i, 0] += fx
            force[i, 1] += fy
            moment = rx * fy - ry * fx
            force[i, 2] += moment
            power += fx * (v[i, 0] - v[i, 2] * ry) + fy * (v[i, 1] + v[i, 2] * rx)
            if work.report.shape[0] > 0:
                work.report[i, L.R_EXTERNAL] += fx
                work.report[i, L.R_EXTERNAL + 1] += fy
                work.report[i, L.R_EXTERNAL + 2] += moment
    work.power[L.E_EXTERNAL] = power


@inner_jit
def next_push(model: Model, t: float) -> float:
    """Next time after ``t`` at which a push begins or ends, s; infinity without one."""
    soon = math.inf
    for k in range(model.lateral.shape[0]):
        for column in (L.LF_T0, L.LF_T1):
            if t < model.lateral[k, column] < soon:
                soon = model.lateral[k, column]
    return soon
