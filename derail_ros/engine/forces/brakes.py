"""Brakes: the retarding force of each car, the signal that starts it, and its damping.

Force: the brake units of a body (``laws.brake``) pull at its mass centre against its velocity; a
truck off the rails takes its half away. A hand brake presses the same shoes: the greater of the
two forces counts. Power: force times speed. Damping: of the smoothed
direction near rest. Moments: the arrival of an instant application, at which the force jumps.
"""

from __future__ import annotations

import math

from derail_ros.engine import layout
from derail_ros.engine.arrays import F64, Model, Rows, State, Work
from derail_ros.engine.jit import inner_jit, jit, keep_separate
from derail_ros.engine.laws.brake import (
    cast_iron_factor,
    composition_factor,
    rise,
    smooth_direction,
)
from derail_ros.vocabulary.params import BRAKE_SYSTEMS

DISTRIBUTED_POWER = BRAKE_SYSTEMS.index("distributed_power")
ECP = BRAKE_SYSTEMS.index("ecp")

LARGEST_BRAKING = 20.0
"""Bound on the brake force of a body over its mass, m/s^2: says where damping may matter."""


@inner_jit
def _shoe_forces(model: Model, state: State, i: int, t: float) -> tuple[float, float, bool]:
    """Forces of composition and of cast iron shoes on car ``i`` at rest, at the time ``t``, N.

    And whether a unit is limited by its traction, which the two then leave out. The beginning of
    the step (``t_on``) decides which instant applications are on, so that a force is never
    switched inside one.
    """
    unit = model.unit
    arrival = state.arrival
    t_on = state.clock[0].t_on
    rise_time = model.par[0].brake_rise
    composition = 0.0
    cast_iron = 0.0
    limited = False
    for u in range(model.unit_start[i], model.unit_start[i + 1]):
        if unit[u].shoe == 0.0:
            continue
        if t > arrival[u, layout.ARR_TL] or t_on >= arrival[u, layout.ARR_INST_TL]:
            limited = True
            continue
        k = rise(t, arrival[u, layout.ARR_CONV], rise_time)
        if t_on >= arrival[u, layout.ARR_INST]:
            k = 1.0
        f = max(k * unit[u].force, unit[u].hand)
        if unit[u].shoe == 1.0:
            composition += f
        else:
            cast_iron += f
    return composition, cast_iron, limited


@inner_jit
def _limited_force(
    model: Model, state: State, i: int, t: float, speed: float, composition: float
) -> float:
    """Force of the units of car ``i`` that their traction limits, N."""
    unit = model.unit
    arrival = state.arrival
    t_on = state.clock[0].t_on
    rise_time = model.par[0].brake_rise
    total = 0.0
    for u in range(model.unit_start[i], model.unit_start[i + 1]):
        if unit[u].shoe == 0.0:
            continue
        if t > arrival[u, layout.ARR_TL] or t_on >= arrival[u, layout.ARR_INST_TL]:
            k = rise(t, arrival[u, layout.ARR_CONV], rise_time)
            if t_on >= arrival[u, layout.ARR_INST]:
                k = 1.0
            f = max(k * unit[u].force, unit[u].hand)
            f *= composition if unit[u].shoe == 1.0 else cast_iron_factor(speed)
            k = rise(t, arrival[u, layout.ARR_TL], rise_time)
            if t_on >= arrival[u, layout.ARR_INST_TL]:
                k = 1.0
            total += max(f, k * unit[u].traction)
    return total


@inner_jit
def settle_brakes(model: Model, state: State, work: Work, h: float) -> None:
    """Shoe forces of the cars whose brakes do not change within the step ``h`` into ``work.wk``.

    Those of the others are found anew at each moment.
    """
    keep_separate()
    trial = work.trial[0]
    trial.settled = 1.0
    trial.composition = 0.0
    trial.cast_iron = 0.0
    t = state.clock[0].t
    rise_time = model.par[0].brake_rise
    arrival = state.arrival
    for i in range(state.q.shape[0]):
        settled = True
        for u in range(model.unit_start[i], model.unit_start[i + 1]):
            begins = arrival[u, layout.ARR_CONV]
            settled = settled and (t >= begins + rise_time or t + h <= begins)
            settled = settled and t + h <= arrival[u, layout.ARR_TL]
        work.wk[i].settled = 0.0
        if settled:
            composition, cast_iron, limited = _shoe_forces(model, state, i, t)
            if not limited:
                work.wk[i].settled = 1.0
                work.wk[i].composition = composition
                work.wk[i].cast_iron = cast_iron
        if i >= trial.scope:
            trial.settled = min(trial.settled, work.wk[i].settled)
            trial.composition += work.wk[i].composition
            trial.cast_iron += work.wk[i].cast_iron


@inner_jit
def brake_force(
    model: Model, state: State, wk: Rows, i: int, t: float, speed: float, factor: float
) -> float:
    """Retarding force on car ``i`` at the time ``t`` and ``speed`` (m/s), N.

    ``factor`` is that of composition shoes at that speed.
    """
    trucks = int(state.truck_on[i, 0]) + int(state.truck_on[i, 1])
    if trucks == 0:
        return 0.0
    composition = wk[i].composition
    cast_iron = wk[i].cast_iron
    limited = False
    if wk[i].settled == 0.0:
        composition, cast_iron, limited = _shoe_forces(model, state, i, t)
    total = composition * factor
    if cast_iron != 0.0:
        total += cast_iron * cast_iron_factor(speed)
    if limited:
        total += _limited_force(model, state, i, t, speed, factor)
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
    speed = 0.0
    composition = 1.0
    direction = 0.0
    n = work.scope[0]
    for i in range(n):
        if state.truck_on[i, 0] == 0 and state.truck_on[i, 1] == 0:
            continue
        if work.head[i] == i:  # all cars of a block have one speed
            speed = math.sqrt(v[i, 0] * v[i, 0] + v[i, 1] * v[i, 1])
            composition = composition_factor(speed)
            direction = smooth_direction(speed, eps)
        f = brake_force(model, state, work.wk, i, t, speed, composition)
        if f != 0.0:
            g = f * direction
            force[i, 0] -= g * v[i, 0]
            force[i, 1] -= g * v[i, 1]
            power += g * speed * speed
            if reporting:
                report[i, layout.R_BRAKE] = f * speed * direction
    if n < v.shape[0]:  # the others are of the last block
        trial = work.trial[0]
        f = 0.0
        if trial.settled != 0.0:
            f = trial.composition * composition
            if trial.cast_iron != 0.0:
                f += trial.cast_iron * cast_iron_factor(speed)
        else:
            for i in range(n, v.shape[0]):
                f += brake_force(model, state, work.wk, i, t, speed, composition)
        h = work.head[n]
        force[h, 0] -= f * direction * v[h, 0]
        power += f * direction * speed * speed
    work.power[layout.E_BRAKE] = power


@inner_jit
def add_damping(wk: Rows, i: int, v: F64, speed: float, force: float, eps: float) -> None:
    """Add the damping of a force (N) against the velocity of car ``i`` to its block in ``wk``.

    The force is ``-g(v) v`` with ``g = f / sqrt(v^2 + eps^2)``: damping ``g`` across the velocity,
    ``d(g v)/dv = g eps^2 / (v^2 + eps^2)`` along it.
    """
    across = force * smooth_direction(speed, eps)
    along = across * (eps * eps) / (speed * speed + eps * eps)
    ux = 1.0
    uy = 0.0
    if speed > 0.0:
        ux = v[i, 0] / speed
        uy = v[i, 1] / speed
    wk[i].c_xx += across + (along - across) * ux * ux
    wk[i].c_xy += (along - across) * ux * uy
    wk[i].c_yy += across + (along - across) * uy * uy


@inner_jit
def brake_damping(model: Model, state: State, work: Work, t: float, v: F64) -> None:
    """Add the damping of the brakes of the stiff cars to their blocks in ``work.wk``."""
    keep_separate()
    eps = model.par[0].ground_eps
    for i in range(v.shape[0]):
        if work.wk[i].stiff == 0.0:
            continue
        speed = math.sqrt(v[i, 0] * v[i, 0] + v[i, 1] * v[i, 1])
        f = brake_force(model, state, work.wk, i, t, speed, composition_factor(speed))
        if f != 0.0:
            add_damping(work.wk, i, v, speed, f, eps)


@inner_jit
def _vent(model: Model, state: State, at: float, kind: int, t: float) -> None:
    """Let the pipe's pressure fall at ``at`` (m behind car 1's centre) at the time ``t``."""
    par = model.par[0]
    at_once = kind == layout.ARR_INST or kind == layout.ARR_INST_TL or par.brake_system == ECP
    for u in range(state.arrival.shape[0]):
        if model.unit[u].body >= par.train:  # the pipe of standing cars is empty
            continue
        arrival = t + model.unit[u].delay
        if not at_once:
            arrival += abs(model.unit[u].distance - at) / par.brake_speed
        state.arrival[u, kind] = min(state.arrival[u, kind], arrival)


@jit
def apply_brakes(model: Model, state: State, at: float, kind: int, t: float) -> None:
    """Start an emergency at the arc length ``at`` (m behind car 1's centre) at the time ``t``.

    The signal runs both ways along the pipe. A brake can only be raised: each unit keeps its
    earliest arrival of each kind. As a radio has places of its own (``model.remote``), they vent
    too: as the wave reaches the head, the first car, and one radio delay later. With
    distributed power the locomotives there listen as well, and the head hears of it by radio.
    ECP brakes have no wave: all of them apply at once.
    """
    _vent(model, state, at, kind, t)
    par = model.par[0]
    if model.remote.shape[0] == 0 or par.brake_system == ECP:
        return
    noticed = abs(at)
    if par.brake_system == DISTRIBUTED_POWER:
        for place in model.remote:
            noticed = min(noticed, abs(place - at))
    told = t + noticed / par.brake_speed + par.radio_delay
    for place in model.remote:
        _vent(model, state, place, kind, told)
    if par.brake_system == DISTRIBUTED_POWER:
        _vent(model, state, 0.0, kind, told)


@inner_jit
def next_application(state: State, t: float) -> float:
    """Next time after ``t`` at which an instant application begins, s; infinity without one."""
    soon = math.inf
    for u in range(state.arrival.shape[0]):
        for kind in (layout.ARR_INST, layout.ARR_INST_TL):
            if t < state.arrival[u, kind] < soon:
                soon = state.arrival[u, kind]
    return soon
