"""Steps of a run: try, locate, accept.

A step goes from one accepted state to the next. Within it the set of constraints and of switched
forces is fixed. It has three acts:

1. try: take the stages of the integration method, put the end onto the constraints, estimate the
   error;
2. locate: look for a moment inside the step at which a force jumps or a constraint goes (a truck
   passes a rail break, a coupling reaches its limit angle, a contact changes its features, a
   spring engages, a truck reaches its lateral limit); if there is one, try again up to there;
3. accept: make the end the state, follow contacts, remove constraints, note events.

``work.trial`` holds the numbers that the acts hand on.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from derail_ros.engine import layout as L
from derail_ros.engine.arrays import Model, State, Work
from derail_ros.engine.contacts import track_contacts
from derail_ros.engine.dynamics import (
    FACTORED,
    PLAIN,
    accelerations,
    constraint_error,
    onto_constraints,
    project_velocities,
)
from derail_ros.engine.energy import energy_residual, stored_energy
from derail_ros.engine.events import note_progress, remove_constraints, speed_of
from derail_ros.engine.forces.brakes import next_application
from derail_ros.engine.forces.collisions import first_jump
from derail_ros.engine.forces.couplers import first_kink, first_limit
from derail_ros.engine.forces.pushes import next_push
from derail_ros.engine.forces.track import first_overload, first_passing, on_track, truck_rows
from derail_ros.engine.implicit import longest_stable
from derail_ros.engine.jit import inner_jit, jit, keep_separate
from derail_ros.engine.methods import BOUND, EXPONENT, GAMMA, META
from derail_ros.engine.neighbours import list_is_stale, rebuild, refresh_active
from derail_ros.engine.runge_kutta import (
    error_at_end,
    last_stage_at_end,
    stages_of,
    step_error,
    take_stages,
)
from derail_ros.engine.trigonometry import angles

F64 = NDArray[np.float64]

# What `advance` stopped for.
DONE, DRAIN, GROW_PAIRS, GROW_CONTACTS = 0, 1, 2, 3
NON_FINITE, STEP_FLOOR, SINGULAR, TRACK_END = -1, -2, -3, -4

# Verdicts on a trial: it stands; its error is too large; its end cannot be put onto the
# constraints; there is a moment inside it (the next trial ends there); there are no accelerations
# at its end.
STANDS, INACCURATE, OFF_CONSTRAINTS, MOMENT_INSIDE, DEGENERATE = 0, 1, 2, 3, 4


@inner_jit
def copy_rows(to: NDArray[Any], what: NDArray[Any]) -> None:
    """Copy a two-dimensional array."""
    for i in range(to.shape[0]):
        for k in range(to.shape[1]):
            to[i, k] = what[i, k]


@inner_jit
def copy_items(to: NDArray[Any], what: NDArray[Any]) -> None:
    """Copy a one-dimensional array."""
    for i in range(to.shape[0]):
        to[i] = what[i]


@inner_jit
def plan_step(model: Model, state: State, work: Work) -> None:
    """Choose the size of the first trial, and note what limits it."""
    keep_separate()
    par = model.par
    trial = work.trial
    t = state.clock[L.T]
    copy_rows(work.truck_s, state.truck_s)
    state.clock[L.T_ON] = t
    # no corner may move further than its share of the buffer
    fastest = 1e-9
    for i in range(state.v.shape[0]):
        rim = abs(state.v[i, 2]) * model.car[i, L.RADIUS]
        fastest = max(fastest, speed_of(state.v, i) + rim)
    cap = min(par[L.H_MAX], par[L.STEP_SHARE] / fastest)
    h = state.clock[L.H_NEXT]
    trial[L.TRY_WANTED] = h
    limit = L.LIMIT_ACCURACY
    if cap < h:
        h = cap
        limit = L.LIMIT_LARGEST if h == par[L.H_MAX] else L.LIMIT_CAP
    if model.table[META, GAMMA] == 0.0:  # an explicit method
        stable = longest_stable(model, state, work, h, model.table[META, BOUND])
        if stable < h:
            h = stable
            limit = L.LIMIT_STABILITY
    # land on a switched force exactly; a sliver before it is spread over two steps
    switch = min(next_push(model, t), next_application(state, t))
    if t + h >= switch:
        h = switch - t
        limit = L.LIMIT_MOMENT
    elif t + 2.0 * h > switch:
        h = 0.5 * (switch - t)
    trial[L.TRY_SIZE] = h
    trial[L.TRY_SWITCH] = switch
    trial[L.TRY_LIMIT] = limit
    trial[L.TRY_REJECTED] = 0.0


@inner_jit
def try_stages(model: Model, state: State, work: Work) -> int:
    """Take the stages of a step and put its end, ``work.stage_q/v``, onto the constraints."""
    keep_separate()
    trial = work.trial
    h = trial[L.TRY_SIZE]
    end = state.clock[L.T] + h
    trial[L.TRY_END] = trial[L.TRY_SWITCH] if end >= trial[L.TRY_SWITCH] else end
    trial[L.TRY_ERROR] = math.inf
    # feet of the trucks start from the accepted state, whatever a rejected trial left
    copy_rows(state.truck_s, work.truck_s)
    if not take_stages(model, state, work, h):
        return INACCURATE
    if not error_at_end(model.table):
        trial[L.TRY_ERROR] = step_error(model, state, work, h, stages_of(model.table))
        if not trial[L.TRY_ERROR] <= 1.0:
            return INACCURATE
    trial[L.TRY_ENERGY] = stored_energy(model, state, work.stage_q, work.stage_v)
    if model.par[L.PROJECT] != 0.0:
        factors = last_stage_at_end(model.table) and trial[L.TRY_IMPLICIT] == 0.0
        if not onto_constraints(model, state, work, work.stage_q, factors):
            return OFF_CONSTRAINTS
        project_velocities(model, state, work, work.stage_v)
    else:
        angles(work.stage_q, work.wk, work.ang)
        truck_rows(model, state, work, work.stage_q)
    return STANDS


@inner_jit
def try_end(model: Model, state: State, work: Work) -> int:
    """Accelerations at the end of the step, and the error of methods that count them."""
    keep_separate()
    trial = work.trial
    stages = stages_of(model.table)
    mode = FACTORED if model.par[L.PROJECT] != 0.0 else PLAIN
    if not accelerations(
        model, state, work, trial[L.TRY_END], work.stage_q, work.stage_v, work.kv[stages], mode
    ):
        return DEGENERATE
    if error_at_end(model.table):
        copy_rows(work.kq[stages], work.stage_v)
        trial[L.TRY_ERROR] = step_error(model, state, work, trial[L.TRY_SIZE], stages + 1)
        if not trial[L.TRY_ERROR] <= 1.0:
            return INACCURATE
    return STANDS


@inner_jit
def _end_at(model: Model, work: Work, share: float) -> int:
    """Let the next trial end at a ``share`` of this one, unless that is its end already.

    A truck that stands on a break derails within the smallest step.
    """
    trial = work.trial
    size = max(share * trial[L.TRY_SIZE], model.par[L.H_MIN])
    if not size < trial[L.TRY_SIZE]:
        return STANDS
    trial[L.TRY_SIZE] = size
    trial[L.TRY_LIMIT] = L.LIMIT_MOMENT
    trial[L.TRY_SWITCH] = math.inf
    return MOMENT_INSIDE


@inner_jit
def locate_moment(model: Model, state: State, work: Work) -> int:
    """Find the first moment inside the step that its motion shows."""
    keep_separate()
    h = work.trial[L.TRY_SIZE]
    share = first_passing(model, state, work, h)
    share = min(share, first_limit(model, state, work, h))
    share = min(share, first_jump(model, state, work, h))
    share = min(share, first_kink(model, state, work, h))
    return _end_at(model, work, share)


@inner_jit
def locate_overload(model: Model, state: State, work: Work) -> int:
    """Find the first moment at which a truck reaches its lateral limit (needs ``try_end``)."""
    return _end_at(model, work, first_overload(model, state, work))


@inner_jit
def reject(model: Model, state: State, work: Work, verdict: int) -> int:
    """Choose a smaller size after a bad trial; an error code when it falls below the floor."""
    keep_separate()
    trial = work.trial
    state.cnt[L.REJECTED] += 1
    trial[L.TRY_REJECTED] = 1.0
    shrink = 0.25
    code = SINGULAR
    if verdict == INACCURATE:
        trial[L.TRY_LIMIT] = L.LIMIT_ACCURACY
        error = trial[L.TRY_ERROR]
        shrink = 0.2
        code = NON_FINITE
        if math.isfinite(error):
            shrink = min(0.9, max(0.2, 0.85 * error ** -model.table[META, EXPONENT]))
            code = STEP_FLOOR
    trial[L.TRY_SIZE] *= shrink
    trial[L.TRY_WANTED] = trial[L.TRY_SIZE]
    return code if trial[L.TRY_SIZE] < model.par[L.H_MIN] else DONE


@inner_jit
def _keep_last(state: State) -> None:
    """Remember the accepted state as the beginning of the last step."""
    copy_rows(state.q0, state.q)
    copy_rows(state.v0, state.v)
    copy_rows(state.a0, state.a)
    copy_rows(state.truck_on0, state.truck_on)
    copy_items(state.coupled0, state.coupled)
    copy_items(state.energy0, state.energy)
    copy_items(state.power0, state.power)


@inner_jit
def _keep_forces(state: State, work: Work) -> None:
    """Powers and multipliers of the last evaluation into the state."""
    copy_items(state.power, work.power)
    copy_rows(state.rail_force, work.lam_t)
    copy_rows(state.coupler_force, work.lam_c)


@inner_jit
def take_over(model: Model, state: State, work: Work) -> None:
    """Make the end of the trial the accepted state, with its ledger and counters."""
    keep_separate()
    trial = work.trial
    clock = state.clock
    cnt = state.cnt
    h = trial[L.TRY_SIZE]
    clock[L.T_PREV] = clock[L.T]
    clock[L.T] = trial[L.TRY_END]
    _keep_last(state)
    copy_rows(state.q, work.stage_q)
    copy_rows(state.v, work.stage_v)
    for k in range(L.N_POWER):
        state.energy[k] += h * work.mean_power[k]
    moved = stored_energy(model, state, state.q, state.v) - trial[L.TRY_ENERGY]
    state.energy[L.E_STAB_NET] += moved
    state.energy[L.E_STAB_GROSS] += abs(moved)
    cnt[L.STEP] += 1
    cnt[int(trial[L.TRY_LIMIT])] += 1
    cnt[L.IMPLICIT_STEPS] += int(trial[L.TRY_IMPLICIT])
    copy_rows(state.a1, work.kv[stages_of(model.table)])
    copy_rows(state.a, state.a1)
    copy_items(state.power1, work.power)
    _keep_forces(state, work)
    gap, offset = constraint_error(model, state, work, state.q)
    clock[L.MAX_GAP] = max(clock[L.MAX_GAP], gap)
    clock[L.MAX_OFFSET] = max(clock[L.MAX_OFFSET], offset)


@inner_jit
def _next_size(model: Model, state: State, work: Work) -> None:
    """Propose the next size from the error; a step cut short for other reasons shrinks nothing."""
    trial = work.trial
    grow = 0.85 * max(trial[L.TRY_ERROR], 1e-10) ** -model.table[META, EXPONENT]
    grow = min(2.0, max(0.2, grow))
    if trial[L.TRY_REJECTED] != 0.0:
        grow = min(grow, 1.0)
    proposal = trial[L.TRY_SIZE] * grow
    if trial[L.TRY_LIMIT] != L.LIMIT_ACCURACY:
        proposal = max(proposal, trial[L.TRY_WANTED])
    state.clock[L.H_NEXT] = min(max(proposal, model.par[L.H_MIN]), model.par[L.H_MAX])


@inner_jit
def accept(model: Model, state: State, work: Work) -> int:
    """Go on to the end of the trial: contacts, constraints that go, events, the ledger."""
    keep_separate()
    clock = state.clock
    take_over(model, state, work)
    track_contacts(model, state, work, clock[L.T], work.trial[L.TRY_SIZE])
    changed = remove_constraints(model, state, work)
    note_progress(model, state, work)
    if changed or clock[L.T] == work.trial[L.TRY_SWITCH]:
        clock[L.T_ON] = clock[L.T]
        if not accelerations(model, state, work, clock[L.T], state.q, state.v, state.a, PLAIN):
            return SINGULAR
        _keep_forces(state, work)
    if clock[L.E_INITIAL] > 0.0:
        clock[L.MAX_RESIDUAL] = max(
            clock[L.MAX_RESIDUAL], abs(energy_residual(model, state)) / clock[L.E_INITIAL]
        )
    _next_size(model, state, work)
    return DONE if on_track(model, state) else TRACK_END


@inner_jit
def _finite_end(work: Work, stages: int) -> bool:
    """State and accelerations at the end of the trial are numbers."""
    q = work.stage_q
    v = work.stage_v
    for i in range(q.shape[0]):
        for k in range(5):
            if not math.isfinite(work.kv[stages, i, k] + q[i, k] + v[i, k]):
                return False
    return True


@inner_jit
def step(model: Model, state: State, work: Work) -> int:
    """Take one accepted step. Returns DONE or one of the error codes."""
    locate = model.par[L.LOCATE] != 0.0
    plan_step(model, state, work)
    code = DONE
    while True:
        verdict = try_stages(model, state, work)
        if verdict == STANDS and locate:
            verdict = locate_moment(model, state, work)
        if verdict == STANDS:
            verdict = try_end(model, state, work)
        if verdict == STANDS and locate:
            verdict = locate_overload(model, state, work)
        if verdict == STANDS:
            if not _finite_end(work, stages_of(model.table)):
                code = NON_FINITE
            break
        if verdict == DEGENERATE:
            code = SINGULAR
            break
        if verdict != MOMENT_INSIDE:
            code = reject(model, state, work, verdict)
            if code != DONE:
                break
    if code != DONE:
        copy_rows(state.truck_s, work.truck_s)  # the accepted state's again
        return code
    return accept(model, state, work)


@jit
def advance(model: Model, state: State, work: Work, t_target: float, max_steps: int) -> int:
    """Step until ``t_target`` is reached, ``max_steps`` are taken or the run ends."""
    n = state.q.shape[0]
    event_room = 6 * n + state.arrival.shape[0] + 8
    taken = 0
    work.placed[0, 0] = math.nan
    while state.clock[L.T] < t_target and taken < max_steps and state.cnt[L.STATUS] == L.RUNNING:
        if list_is_stale(model, state):
            if not rebuild(model, state, work):
                return GROW_PAIRS
        if state.contact.shape[0] - state.cnt[L.N_CONTACTS] < state.cnt[L.N_PAIRS]:
            return GROW_CONTACTS
        if work.event.shape[0] - state.cnt[L.N_EVENTS] < event_room:
            return DRAIN
        refresh_active(model, state, work)
        code = step(model, state, work)
        if code != DONE:
            state.cnt[L.STATUS] = L.FAILED
            return code
        taken += 1
    return DONE
