"""Pushes: the lateral forces that start a derailment.

Force: constant, at a place on the car's axis, between two times. Power: put in. Moments: both
times, at which the force jumps.
"""

from __future__ import annotations

import math

from derail_ros.engine import layout
from derail_ros.engine.arrays import F64, Model, State, Work
from derail_ros.engine.jit import inner_jit


@inner_jit
def push_forces(model: Model, state: State, work: Work, v: F64) -> None:
    """Add the pushes that are on at ``T_ON``, the beginning of the step, to ``work.force``."""
    lateral = model.lateral
    force = work.force
    wk = work.wk
    t_on = state.clock[0].t_on
    power = 0.0
    for k in range(lateral.shape[0]):
        if lateral[k].start <= t_on < lateral[k].end:
            i = int(lateral[k].car)
            fx = lateral[k].fx
            fy = lateral[k].fy
            rx = lateral[k].offset * wk[i].ct
            ry = lateral[k].offset * wk[i].st
            force[i, 0] += fx
            force[i, 1] += fy
            moment = rx * fy - ry * fx
            force[i, 2] += moment
            power += fx * (v[i, 0] - v[i, 2] * ry) + fy * (v[i, 1] + v[i, 2] * rx)
            if work.report.shape[0] > 0:
                work.report[i, layout.R_EXTERNAL] += fx
                work.report[i, layout.R_EXTERNAL + 1] += fy
                work.report[i, layout.R_EXTERNAL + 2] += moment
    work.power[layout.E_EXTERNAL] = power


@inner_jit
def next_push(model: Model, t: float) -> float:
    """Next time after ``t`` at which a push begins or ends, s; infinity without one."""
    soon = math.inf
    for k in range(model.lateral.shape[0]):
        push = model.lateral[k]
        for at in (push.start, push.end):
            if t < at < soon:
                soon = at
    return soon
