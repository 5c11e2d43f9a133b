"""The stages of a Runge-Kutta step, and its error.

The method is a table (``methods``). Explicit methods need no more than their weights. In a
W-method (``implicit``) the stages of stiff cars have other masses and a correction of their
forces.
"""

from __future__ import annotations

from derail_ros.engine import layout
from derail_ros.engine.arrays import F64, Model, State, Work
from derail_ros.engine.dynamics import IMPLICIT, PLAIN, accelerations, constraint_gamma, place
from derail_ros.engine.forces.track import truck_rows
from derail_ros.engine.implicit import friction_damping, implicit_masses, restore_masses
from derail_ros.engine.jit import inner_jit, keep_separate
from derail_ros.engine.methods import ERRORS, GAMMA, META, STAGES, TIMES, WEIGHTS
from derail_ros.engine.solver import factor, solve


@inner_jit
def _combine(
    y0: F64, k: F64, table: F64, row: int, terms: int, h: float, out: F64, count: int
) -> None:
    """``out = y0 + h sum_r table[row, r] k_r`` of the first ``count`` numbers.

    ``k`` holds the slopes one after the other.
    """
    n = y0.shape[0]
    for m in range(count):
        out[m] = y0[m]
    for r in range(terms):
        w = h * table[row, r]
        if w != 0.0:
            first = r * n
            for m in range(count):
                out[m] += w * k[first + m]


@inner_jit
def stages_of(table: F64) -> int:
    """Number of stages of a method."""
    return (table.shape[0] - STAGES) // 2


@inner_jit
def error_at_end(table: F64) -> bool:
    """The slope at the new state counts in the error."""
    return table[ERRORS, stages_of(table)] != 0.0


@inner_jit
def last_stage_at_end(table: F64) -> bool:
    """The last stage stands at the end of the step, near the new state."""
    return table[TIMES, stages_of(table) - 1] == 1.0


@inner_jit
def _gamma_sum(table: F64, kv: F64, stages: int, s: int, i: int, k: int) -> float:
    """``sum_j gamma_sj k_j`` of coordinate ``k`` of car ``i``."""
    total = 0.0
    for r in range(s):
        total += table[STAGES + stages + s, r] * kv[r, i, k]
    return total


@inner_jit
def _end_stages(model: Model, work: Work, stiff: bool) -> None:
    """Let evaluations look at all cars again, with their own masses."""
    if stiff:
        restore_masses(model.car, work)
    work.scope[0] = work.wk.shape[0]


@inner_jit
def take_stages(model: Model, state: State, work: Work, h: float) -> bool:
    """The stages of a step of size ``h`` from the accepted state.

    Puts the new state into ``work.stage_q/v``, mean powers into ``work.mean_power``, and whether
    friction was implicit into ``work.trial``. Returns False when the constraints are singular.
    """
    keep_separate()
    n = int(work.trial[0].scope)
    size = state.q.size
    count = 5 * n
    table = model.table
    stages = stages_of(table)
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
    t = state.clock[0].t
    gamma = table[META, GAMMA]
    stiff = False
    if gamma > 0.0:
        place(model, state, work, state.q)
        stiff = friction_damping(model, state, work, h)
    for m in range(count):
        kq[m] = v0_flat[m]
    for k in range(layout.N_POWER):
        work.kp[0, k] = state.power[k]
    mode = PLAIN
    work.trial[0].implicit = 0.0
    work.scope[0] = n
    lead = work.head[n] if n < state.q.shape[0] else 0
    if stiff:
        mode = IMPLICIT
        work.trial[0].implicit = 1.0
        implicit_masses(car, work, h * gamma)
        # The forces at the accepted state are M a less those of its constraints: the multipliers
        # found here are differences, the slopes are the same.
        for i in range(n):
            work.force[i, 0] = car[i].mass * state.a[i, 0]
            work.force[i, 1] = car[i].mass * state.a[i, 1]
            work.force[i, 2] = car[i].inertia * state.a[i, 2]
            work.force[i, 3] = car[i].coupler_inertia * state.a[i, 3]
            work.force[i, 4] = car[i].coupler_inertia * state.a[i, 4]
        if n < state.q.shape[0]:
            work.force[lead, 0] += work.trial[0].mass * state.a[lead, 0]
        truck_rows(model, state, work, state.q)
        if not factor(model, state, work):
            _end_stages(model, work, True)
            return False
        constraint_gamma(model, state, work, state.q, state.v)
        solve(model, state, work, work.kv[0])
    else:
        for i in range(n):
            for k in range(5):
                work.kv[0, i, k] = state.a[i, k]
    for s in range(1, stages):
        _combine(q0_flat, kq, table, STAGES + s, s, h, q1_flat, count)
        _combine(v0_flat, kv, table, STAGES + s, s, h, v1_flat, count)
        for m in range(count):
            kq[s * size + m] = v1_flat[m]
        if stiff:
            for i in range(n):
                if wk[i].stiff != 0.0 or i == lead:
                    wk[i].sx = h * _gamma_sum(table, work.kv, stages, s, i, 0)
                    wk[i].sy = h * _gamma_sum(table, work.kv, stages, s, i, 1)
                    wk[i].sw = h * _gamma_sum(table, work.kv, stages, s, i, 2)
        at = t + table[TIMES, s] * h
        if not accelerations(model, state, work, at, q1, v1, work.kv[s], mode):
            _end_stages(model, work, stiff)
            return False
        for k in range(layout.N_POWER):
            work.kp[s, k] = work.power[k]
    _combine(q0_flat, kq, table, WEIGHTS, stages, h, q1_flat, count)
    _combine(v0_flat, kv, table, WEIGHTS, stages, h, v1_flat, count)
    for i in range(n, state.q.shape[0]):
        q1[i, 0] = q1[lead, 0] - (car[i].distance - car[lead].distance)
        v1[i, 0] = v1[lead, 0]
        for k in range(1, 5):
            q1[i, k] = 0.0
            v1[i, k] = 0.0
    for k in range(layout.N_POWER):
        total = 0.0
        for s in range(stages):
            total += table[WEIGHTS, s] * work.kp[s, k]
        work.mean_power[k] = total
    _end_stages(model, work, stiff)
    return True


@inner_jit
def step_error(model: Model, state: State, work: Work, h: float, last: int) -> float:
    """Error of a step in units of the tolerance: difference to the embedded method, largest one.

    The scale is ``rtol`` times 1 m for coordinates and ``rtol (1 m/s + |v|)`` for velocities, so
    it does not depend on where along the track the train is. Angles count by their arc at the
    radius of gyration ``sqrt(I / m)``: the metric of the kinetic energy. ``last`` slopes count.
    """
    keep_separate()
    size = state.q.size
    table = model.table
    count = 5 * int(work.trial[0].scope)
    eq = work.dx.reshape(size)
    ev = work.force.reshape(size)
    kq = work.kq.reshape(work.kq.size)
    kv = work.kv.reshape(work.kv.size)
    for m in range(count):
        eq[m] = 0.0
        ev[m] = 0.0
    for r in range(last):
        w = h * table[ERRORS, r]
        if w != 0.0:
            first = r * size
            for m in range(count):
                eq[m] += w * kq[first + m]
            for m in range(count):
                ev[m] += w * kv[first + m]
    error = 0.0
    m = 0
    for i in range(int(work.trial[0].scope)):
        for k in range(5):
            arm = 1.0
            if k == 2:
                arm = model.car[i].gyration
            elif k > 2:
                arm = model.car[i].gyration_c
            a = abs(eq[m]) * arm
            b = abs(ev[m]) * arm / (1.0 + arm * abs(state.v[i, k]))
            # written so that a nan counts as an error
            if not a <= error:
                error = a
            if not b <= error:
                error = b
            m += 1
    return error / model.par[0].rtol
