"""Brakes: the retarding force of each car, the signal that starts it, and its damping.

Force: the brake units of a body (``laws.brake``) pull at its mass centre against its velocity; a
truck off the rails takes its half away. Power: force times speed. Damping: of the smoothed
direction near rest. Moments: the arrival of an instant application, at which the force jumps.
"""

from __future__ import annotations

import math

from derail_ros.engine import layout
from derail_ros.engine.arrays import F64, Model, State, Work
from derail_ros.engine.jit import inner_jit, jit, keep_separate
from derail_ros.engine.laws.brake import (
    cast_iron_factor,
    composition_factor,
    rise,
    smooth_direction,
)

LARGEST_BRAKING = 20.0
"""Bound on the brake force of a body over its mass, m/s^2: says where damping may matter."""


@inner_jit
def brake_force(model: Model, state: State, i: int, t: float, speed: float) -> float:
    """Retarding force on car ``i`` at the time ``t`` and ``speed`` (m/s), N.

    The beginning of the step (``T_ON``) decides which instant applications are on, so that a
    force is never switched inside one.
    """
    trucks = int(state.truck_on[i, 0]) + int(state.truck_on[i, 1])
    if trucks == 0:
        return 0.0
    unit = model.unit
    arrival = state.arrival
    t_on = state.clock[0].t_on
    rise_time = model.par[0].brake_rise
    composition = composition_factor(speed)
    total = 0.0
    for u in range(model.unit_start[i], model.unit_start[i + 1]):
        shoe = unit[u].shoe
        if shoe == 0.0:
            continue
        k = rise(t, arrival[u, layout.ARR_CONV], rise_time)
        if t_on >= arrival[u, layout.ARR_INST]:
            k = 1.0
        f = k * unit[u].force
        f *= composition if shoe == 1.0 else cast_iron_factor(speed)
        if t > arrival[u, layout.ARR_TL] or t_on >= arrival[u, layout.ARR_INST_TL]:
            k = rise(t, arrival[u, layout.ARR_TL], rise_time)
            if t_on >= arrival[u, layout.ARR_INST_TL]:
                k = 1.0
            f = max(f, k * unit[u].traction)
        total += f
    return total * (0.5 * trucks)


@inner_jit
def brake_forces(model: Model, state: State, work: Work, t: float, v: F64) -> None:
    """Add the brake forces at the velocities ``v`` to ``work.force``."""
    keep_separate()
    force = work.force
    report = work.report
    reporting = report.shape[0] > 0
    eps = model.par[0].ground_eps
    power = 0.0
    for i in range(v.shape[0]):
        speed = math.sqrt(v[i, 0] * v[i, 0] + v[i, 1] * v[i, 1])
        f = brake_force(model, state, i, t, speed)
        if f != 0.0:
            g = f * smooth_direction(speed, eps)
            force[i, 0] -= g * v[i, 0]
            force[i, 1] -= g * v[i, 1]
            power += g * speed * speed
            if reporting:
                report[i, layout.R_BRAKE] = f * speed * smooth_direction(speed, eps)
    work.power[layout.E_BRAKE] = power


@inner_jit
def brake_damping(model: Model, state: State, work: Work, t: float, v: F64) -> None:
    """Add the damping of the brakes of the stiff cars to their blocks in ``work.wk``.

    The force is ``-g(v) v`` with ``g = f / sqrt(v^2 + eps^2)``: damping ``g`` across the velocity,
    ``d(g v)/dv = g eps^2 / (v^2 + eps^2)`` along it.
    """
    keep_separate()
    wk = work.wk
    eps = model.par[0].ground_eps
    for i in range(v.shape[0]):
        if wk[i].stiff == 0.0:
            continue
        speed = math.sqrt(v[i, 0] * v[i, 0] + v[i, 1] * v[i, 1])
        f = brake_force(model, state, i, t, speed)
        if f == 0.0:
            continue
        across = f * smooth_direction(speed, eps)
        along = across * (eps * eps) / (speed * speed + eps * eps)
        ux = 1.0
        uy = 0.0
        if speed > 0.0:
            ux = v[i, 0] / speed
            uy = v[i, 1] / speed
        wk[i].c_xx += across + (along - across) * ux * ux
        wk[i].c_xy += (along - across) * ux * uy
        wk[i].c_yy += across + (along - across) * uy * uy


@jit
def apply_brakes(
    model: Model, state: State, at: float, backward: bool, forward: bool, kind: int, t: float
) -> None:
    """Start an emergency at the arc length ``at`` (m behind car 1's centre) at the time ``t``.

    The signal runs ``backward`` (to the rear) and / or ``forward``. A brake can only be raised:
    each unit keeps its earliest arrival of each kind.
    """
    speed = model.par[0].brake_speed
    for u in range(state.arrival.shape[0]):
        d = model.unit[u].distance - at
        if (d > 0.0 and not backward) or (d < 0.0 and not forward):
            continue
        arrival = t + model.unit[u].delay
        if kind == layout.ARR_CONV or kind == layout.ARR_TL:
            arrival += abs(d) / speed
        state.arrival[u, kind] = min(state.arrival[u, kind], arrival)


@inner_jit
def next_application(state: State, t: float) -> float:
    """Next time after ``t`` at which an instant application begins, s; infinity without one."""
    soon = math.inf
    for u in range(state.arrival.shape[0]):
        for kind in (layout.ARR_INST, layout.ARR_INST_TL):
            if t < state.arrival[u, kind] < soon:
                soon = state.arrival[u, kind]
    return soon
