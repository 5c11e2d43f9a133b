"""Guidance: rails beside which a derailed truck runs, until it has broken out.

A derailed wheelset runs with one wheel between the rails and strikes the next rail when it moves
aside. Force on the truck at the offset d from the centre line, across the track:

    F = -sign(d) min(k (|d| - play), F_max)    |d| > play

until ``k (|d| - play)`` passes F_max: then the rail has rolled over or the wheels are across it,
and the truck is free for good. Power: taken out, less what the rail gives back. That low parts of
bogies and wheels guide derailed vehicles along the rail: D. Brabie and E. Andersson, Vehicle
System Dynamics 46 suppl. (2008); play, stiffness and strength are assumed.
"""

from __future__ import annotations

import math

from derail_ros.engine import layout
from derail_ros.engine.arrays import F64, Model, State, Work
from derail_ros.engine.forces.track import locate_on, truck_arm
from derail_ros.engine.jit import inner_jit, keep_separate


@inner_jit
def guidance_forces(model: Model, state: State, work: Work, q: F64, v: F64) -> None:
    """Add the rails' forces on derailed trucks to ``work.force``; follows them along the track."""
    keep_separate()
    par = model.par[0]
    wk = work.wk
    force = work.force
    lost = 0.0
    for i in range(q.shape[0]):
        for k in range(2):
            if state.truck_on[i, k] or state.loose[i, k]:
                continue
            r = truck_arm(model.car, i, k)
            x = q[i, 0] + r * wk[i].ct
            y = q[i, 1] + r * wk[i].st
            s, d, heading, _, _ = locate_on(model, i, x, y, state.truck_s[i, k])
            state.truck_s[i, k] = s
            over = abs(d) - par.guide_play
            if over <= 0.0:
                continue
            f = -math.copysign(min(par.guide_stiffness * over, par.guide_strength), d)
            nx = -math.sin(heading)
            ny = math.cos(heading)
            arm = r * (wk[i].ct * ny - wk[i].st * nx)
            force[i, 0] += f * nx
            force[i, 1] += f * ny
            force[i, 2] += f * arm
            lost -= f * (nx * v[i, 0] + ny * v[i, 1] + arm * v[i, 2])
    work.power[layout.E_GUIDANCE] = lost


@inner_jit
def break_out(model: Model, state: State) -> bool:
    """Free the derailed trucks whose rail has reached its strength; True when there are any."""
    par = model.par[0]
    reach = par.guide_play + par.guide_strength / par.guide_stiffness
    some = False
    for i in range(state.q.shape[0]):
        for k in range(2):
            if state.truck_on[i, k] or state.loose[i, k]:
                continue
            r = truck_arm(model.car, i, k)
            x = state.q[i, 0] + r * math.cos(state.q[i, 2])
            y = state.q[i, 1] + r * math.sin(state.q[i, 2])
            if abs(locate_on(model, i, x, y, state.truck_s[i, k])[1]) > reach:
                state.loose[i, k] = 1
                some = True
    return some
