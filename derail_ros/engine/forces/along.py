"""Along the track: grades, resistance, and locomotives that pull or brake.

Force: the weight's part along the grade (``laws.profile``) at the mass centre, on the rails or
off; rolling, air and curve resistance (``laws.resistance``) against the velocity and the effort of
a locomotive (``laws.effort``) along its axis, both in proportion to the trucks on the rails. An
emergency cuts the effort when its signal reaches the locomotive. Power: effort put in; dynamic
brake and resistance taken out. Energy: potential. Damping: of the smoothed direction near rest.
"""

from __future__ import annotations

import math

from derail_ros.engine import layout
from derail_ros.engine.arrays import F64, Model, State, Work
from derail_ros.engine.forces.brakes import add_damping
from derail_ros.engine.forces.track import locate_on, standing
from derail_ros.engine.jit import inner_jit, jit, keep_separate
from derail_ros.engine.laws.brake import rise, smooth_direction
from derail_ros.engine.laws.effort import effort_at, share_at
from derail_ros.engine.laws.profile import height
from derail_ros.engine.laws.resistance import resistance


@inner_jit
def _foot(model: Model, state: State, q: F64, i: int) -> tuple[float, float, float, float, float]:
    """Foot point of the mass centre of car ``i``: as ``locate_on``, from its front truck's."""
    hint = state.truck_s[i, 0] - model.car[i].truck
    return locate_on(model, i, q[i, 0], q[i, 1], hint)


@inner_jit
def _set_share(model: Model, state: State, i: int, t: float) -> float:
    """Share of its largest effort that locomotive ``i`` gives at the time ``t``."""
    row = model.along[i]
    share = share_at(model.setting, int(row.setting), int(row.setting_end), t)
    if share < 0.0 and model.par[0].keep_dynamic != 0.0:
        return share
    arrival = math.inf
    for u in range(model.unit_start[i], model.unit_start[i + 1]):
        for k in range(state.arrival.shape[1]):
            arrival = min(arrival, state.arrival[u, k])
    return share * (1.0 - rise(t, arrival, model.par[0].cut))


@inner_jit
def _retarding(
    model: Model, state: State, i: int, t: float, speed: float, kappa: float
) -> tuple[float, float]:
    """Resistance and dynamic brake of car ``i``, N, with both trucks on the rails."""
    row = model.along[i]
    resist = resistance(speed, row.r0, row.r1, row.r2)
    resist += model.par[0].curve_resistance * model.car[i].mass * abs(kappa)
    if row.setting_end <= row.setting:
        return resist, 0.0
    share = _set_share(model, state, i, t)
    if share >= 0.0:
        return resist, 0.0
    most = effort_at(model.effort, int(row.dynamic), int(row.dynamic_end), speed)
    return resist, -share * most


@inner_jit
def along_forces(model: Model, state: State, work: Work, t: float, q: F64, v: F64) -> None:
    """Add the forces along the track at ``(t, q, v)`` to ``work.force``."""
    keep_separate()
    force = work.force
    wk = work.wk
    par = model.par[0]
    reporting = work.report.shape[0] > 0
    traction = 0.0
    dynamic = 0.0
    resisted = 0.0
    for i in range(q.shape[0]):
        row = model.along[i]
        s, d, heading, kappa, _ = _foot(model, state, q, i)
        if par.profile != 0.0 and not standing(model, i):
            pull = -model.car[i].mass * par.gravity * height(model.grade, s)[1]
            pull /= 1.0 - kappa * d
            force[i, 0] += pull * math.cos(heading)
            force[i, 1] += pull * math.sin(heading)
            if reporting:
                work.report[i, layout.R_ALONG] = pull
        trucks = 0.5 * (int(state.truck_on[i, 0]) + int(state.truck_on[i, 1]))
        if trucks == 0.0:
            continue
        speed = math.sqrt(v[i, 0] * v[i, 0] + v[i, 1] * v[i, 1])
        resist, brake = _retarding(model, state, i, t, speed, kappa)
        direction = trucks * smooth_direction(speed, par.ground_eps)
        g = (resist + brake) * direction
        force[i, 0] -= g * v[i, 0]
        force[i, 1] -= g * v[i, 1]
        resisted += resist * direction * speed * speed
        dynamic += brake * direction * speed * speed
        effort = 0.0
        if row.setting_end > row.setting:
            share = _set_share(model, state, i, t)
            if share > 0.0:
                most = effort_at(model.effort, int(row.power), int(row.power_end), speed)
                effort = trucks * share * most
                force[i, 0] += effort * wk[i].ct
                force[i, 1] += effort * wk[i].st
                traction += effort * (v[i, 0] * wk[i].ct + v[i, 1] * wk[i].st)
        if reporting:
            work.report[i, layout.R_ALONG + 1] = resist * direction * speed
            work.report[i, layout.R_ALONG + 2] = effort - brake * direction * speed
    work.power[layout.E_TRACTION] = traction
    work.power[layout.E_DYNAMIC] = dynamic
    work.power[layout.E_RESISTANCE] = resisted


@inner_jit
def along_damping(model: Model, state: State, work: Work, t: float, v: F64) -> None:
    """Add the damping of resistance and dynamic brake, of stiff cars, as the brakes' is."""
    keep_separate()
    wk = work.wk
    eps = model.par[0].ground_eps
    for i in range(v.shape[0]):
        trucks = 0.5 * (int(state.truck_on[i, 0]) + int(state.truck_on[i, 1]))
        if wk[i].stiff == 0.0 or trucks == 0.0:
            continue
        speed = math.sqrt(v[i, 0] * v[i, 0] + v[i, 1] * v[i, 1])
        resist, brake = _retarding(model, state, i, t, speed, 0.0)
        add_damping(wk, i, v, speed, trucks * (resist + brake), eps)


@jit
def potential_energy(model: Model, state: State, q: F64) -> float:
    """Potential energy of all cars, J, over the height of the track at its coordinate 0."""
    total = 0.0
    if model.par[0].profile != 0.0:
        for i in range(int(model.par[0].train)):  # second tracks are level
            s = _foot(model, state, q, i)[0]
            z = height(model.grade, s)[0]
            total += model.car[i].mass * model.par[0].gravity * z
    return total
