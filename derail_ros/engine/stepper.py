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

from numpy.typing import NDArray

from derail_ros.engine import layout
from derail_ros.engine.arrays import Model, State, Work
from derail_ros.engine.blocks import cars_in_scope, find_blocks
from derail_ros.engine.contacts import track_contacts
from derail_ros.engine.contacts_fixed import note_inside, track_fixed
from derail_ros.engine.dynamics import (
    FACTORED,
    PLAIN,
    accelerations,
    constraint_error,
    onto_constraints,
    place,
    project_velocities,
)
from derail_ros.engine.energy import energy_residual, stored_energy
from derail_ros.engine.events import (
    note_coupling_forces,
    note_progress,
    remove_constraints,
    speed_of,
)
from derail_ros.engine.forces.brakes import next_application, settle_brakes
from derail_ros.engine.forces.collisions import first_jump
from derail_ros.engine.forces.couplers import first_kink, first_limit
from derail_ros.engine.forces.draft_gear import first_fracture, keep_travel
from derail_ros.engine.forces.fixed import list_near
from derail_ros.engine.forces.pushes import next_push
from derail_ros.engine.forces.track import first_overload, first_passing, on_track, truck_rows
from derail_ros.engine.forces.zones import limit_border
from derail_ros.engine.implicit import longest_stable
from derail_ros.engine.jit import inner_jit, jit, keep_separate
from derail_ros.engine.methods import BOUND, EXPONENT, GAMMA, META
from derail_ros.engine.neighbours import limit_way, longest_listed, rebuild, strays
from derail_ros.engine.runge_kutta import (
    error_at_end,
    last_stage_at_end,
    stages_of,
    step_error,
    take_stages,
)

# What `advance` stopped for.
DONE, DRAIN, GROW_PAIRS, GROW_CONTACTS = 0, 1, 2, 3
NON_FINITE, STEP_FLOOR, SINGULAR, TRACK_END = -1, -2, -3, -4

# Verdicts on a trial: it stands; its error is too large; its end cannot be put onto the
# constraints; there is a moment inside it (the next trial ends there); there are no accelerations
# at its end; it leads further than pairs were looked up for.
STANDS, INACCURATE, OFF_CONSTRAINTS, MOMENT_INSIDE, DEGENERATE, ASTRAY = 0, 1, 2, 3, 4, 5


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
def _foresee(state: State, work: Work, h: float) -> None:
    """Where uniform acceleration leads in the time ``h`` into ``work.stage_q/v``."""
    for i in range(state.q.shape[0]):
        for k in range(5):
            gain = h * state.a[i, k]
            work.stage_q[i, k] = state.q[i, k] + h * (state.v[i, k] + 0.5 * gain)
            work.stage_v[i, k] = state.v[i, k] + gain


@inner_jit
def plan_step(model: Model, state: State, work: Work) -> None:
    """Choose the size of the first trial, and note what limits it."""
    keep_separate()
    par = model.par[0]
    trial = work.trial[0]
    t = state.clock[0].t
    copy_rows(work.truck_s, state.truck_s)
    state.clock[0].t_on = t
    find_blocks(model, state, work, state.q, state.v)
    h = state.clock[0].h_next
    trial.wanted = h
    limit = layout.BY_ACCURACY
    if h >= par.h_max:
        h = par.h_max
        limit = layout.BY_LARGEST
    # cars that may turn or bend go no further over the ground than their share either: accuracy
    # would let them, and lose digits in free motion
    cap = h
    for a in range(1, 1 + work.live[0]):
        i = work.live[a]
        fastest = speed_of(state.v, i) + abs(state.v[i, 2]) * model.car[i].radius
        if cap * fastest > par.step_share:
            cap = par.step_share / fastest
    cap = limit_way(model, state, work, longest_listed(model, state, cap))
    if model.fixed.shape[0] > 0:
        cap = list_near(model, state, work, cap)
    if model.zone.shape[0] > 0:
        cap = limit_border(model, state, cap)
    if cap < h:
        h = cap
        limit = layout.BY_CAP
    if model.table[META, GAMMA] == 0.0:  # an explicit method
        stable = longest_stable(model, state, work, h, model.table[META, BOUND])
        if stable < h:
            h = stable
            limit = layout.BY_STABILITY
    if par.locate != 0.0:
        # a kink that can be foreseen costs no trial beyond it
        _foresee(state, work, h)
        share = first_kink(model, state, work, h)
        if share < 1.0:
            h = max(share * h, par.h_min)
            limit = layout.BY_MOMENT
    # land on a switched force exactly; a sliver before it is spread over two steps
    switch = min(next_push(model, t), next_application(state, t))
    if t + h >= switch:
        h = switch - t
        limit = layout.BY_MOMENT
    elif t + 2.0 * h > switch:
        h = 0.5 * (switch - t)
    scope = cars_in_scope(model, state, work)
    trial.scope = scope
    trial.mass = 0.0
    for i in range(scope, state.q.shape[0]):
        trial.mass += model.car[i].mass
    settle_brakes(model, state, work, h)
    trial.size = h
    trial.switch = switch
    trial.limit = limit
    trial.rejected = 0.0


@inner_jit
def try_stages(model: Model, state: State, work: Work) -> int:
    """Take the stages of a step and put its end, ``work.stage_q/v``, onto the constraints."""
    keep_separate()
    trial = work.trial[0]
    h = trial.size
    end = state.clock[0].t + h
    trial.end = trial.switch if end >= trial.switch else end
    trial.error = math.inf
    # feet of the trucks start from the accepted state, whatever a rejected trial left
    copy_rows(state.truck_s, work.truck_s)
    work.scope[1] = 0
    verdict = _stages_onto_constraints(model, state, work, h)
    work.scope[1] = 1
    return verdict


@inner_jit
def _stages_onto_constraints(model: Model, state: State, work: Work, h: float) -> int:
    """The work of ``try_stages``."""
    trial = work.trial[0]
    if not take_stages(model, state, work, h):
        return INACCURATE
    if strays(model, state, work, h):
        return ASTRAY
    if not error_at_end(model.table):
        trial.error = step_error(model, state, work, h, stages_of(model.table))
        if not trial.error <= 1.0:
            return INACCURATE
    trial.energy = stored_energy(model, state, work.stage_q, work.stage_v)
    if model.par[0].project != 0.0:
        factors = last_stage_at_end(model.table) and trial.implicit == 0.0
        if not onto_constraints(model, state, work, work.stage_q, factors):
            return OFF_CONSTRAINTS
        project_velocities(model, state, work, work.stage_v)
    else:
        place(model, state, work, work.stage_q)
        truck_rows(model, state, work, work.stage_q)
    return STANDS


@inner_jit
def try_end(model: Model, state: State, work: Work) -> int:
    """Accelerations at the end of the step, and the error of methods that count them."""
    keep_separate()
    trial = work.trial[0]
    stages = stages_of(model.table)
    mode = FACTORED if model.par[0].project != 0.0 else PLAIN
    if not accelerations(
        model, state, work, trial.end, work.stage_q, work.stage_v, work.kv[stages], mode
    ):
        return DEGENERATE
    if error_at_end(model.table):
        copy_rows(work.kq[stages], work.stage_v)
        trial.error = step_error(model, state, work, trial.size, stages + 1)
        if not trial.error <= 1.0:
            return INACCURATE
    return STANDS


@inner_jit
def _end_at(model: Model, work: Work, share: float) -> int:
    """Let the next trial end at a ``share`` of this one, unless that is its end already.

    A truck that stands on a break derails within the smallest step.
    """
    trial = work.trial[0]
    size = max(share * trial.size, model.par[0].h_min)
    if not size < trial.size:
        return STANDS
    trial.size = size
    trial.limit = layout.BY_MOMENT
    trial.switch = math.inf
    return MOMENT_INSIDE


@inner_jit
def locate_moment(model: Model, state: State, work: Work) -> int:
    """Find the first moment inside the step that its motion shows."""
    keep_separate()
    h = work.trial[0].size
    share = first_passing(model, state, work, h)
    share = min(share, first_limit(model, state, work, h))
    share = min(share, first_jump(model, state, work, h))
    share = min(share, first_kink(model, state, work, h))
    return _end_at(model, work, share)


@inner_jit
def locate_overload(model: Model, state: State, work: Work) -> int:
    """Find the first moment at which a truck or a coupling reaches its limit.

    It needs the forces of ``try_end``.
    """
    share = 1.0
    if model.par[0].lv_hold == 0.0:
        share = first_overload(model, state, work)
    if model.par[0].strength != 0.0:
        share = min(share, first_fracture(model, state, work))
    return _end_at(model, work, share)


@inner_jit
def reject(model: Model, state: State, work: Work, verdict: int) -> int:
    """Choose a smaller size after a bad trial; an error code when it falls below the floor."""
    keep_separate()
    trial = work.trial[0]
    state.cnt[0].rejected += 1
    trial.rejected = 1.0
    shrink = 0.25
    code = SINGULAR
    if verdict == INACCURATE:
        trial.limit = layout.BY_ACCURACY
        error = trial.error
        shrink = 0.2
        code = NON_FINITE
        if math.isfinite(error):
            shrink = min(0.9, max(0.2, 0.85 * error ** -model.table[META, EXPONENT]))
            code = STEP_FLOOR
    trial.size *= shrink
    trial.wanted = trial.size
    return code if trial.size < model.par[0].h_min else DONE


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
def _count_limit(cnt: Any, limit: float) -> None:
    """Count a step by what has set its size."""
    if limit == layout.BY_ACCURACY:
        cnt.by_accuracy += 1
    elif limit == layout.BY_CAP:
        cnt.by_cap += 1
    elif limit == layout.BY_MOMENT:
        cnt.by_moment += 1
    elif limit == layout.BY_STABILITY:
        cnt.by_stability += 1
    else:
        cnt.by_largest += 1


@inner_jit
def take_over(model: Model, state: State, work: Work) -> None:
    """Make the end of the trial the accepted state, with its ledger and counters."""
    keep_separate()
    trial = work.trial[0]
    clock = state.clock[0]
    cnt = state.cnt[0]
    h = trial.size
    clock.t_prev = clock.t
    clock.t = trial.end
    _keep_last(state)
    copy_rows(state.q, work.stage_q)
    copy_rows(state.v, work.stage_v)
    for k in range(layout.N_POWER):
        state.energy[k] += h * work.mean_power[k]
    moved = stored_energy(model, state, state.q, state.v) - trial.energy
    state.energy[layout.E_STAB_NET] += moved
    state.energy[layout.E_STAB_GROSS] += abs(moved)
    cnt.steps += 1
    _count_limit(cnt, trial.limit)
    cnt.implicit += int(trial.implicit)
    copy_rows(state.a1, work.kv[stages_of(model.table)])
    copy_rows(state.a, state.a1)
    copy_items(state.power1, work.power)
    _keep_forces(state, work)
    gap, offset = constraint_error(model, state, work, state.q)
    clock.max_gap = max(clock.max_gap, gap)
    clock.max_offset = max(clock.max_offset, offset)
    if model.par[0].gear != 0.0:
        keep_travel(model, state, work)
    note_coupling_forces(state)


@inner_jit
def _next_size(model: Model, state: State, work: Work) -> None:
    """Propose the next size from the error; a step cut short for other reasons shrinks nothing."""
    trial = work.trial[0]
    grow = 0.85 * max(trial.error, 1e-10) ** -model.table[META, EXPONENT]
    grow = min(2.0, max(0.2, grow))
    if trial.rejected != 0.0:
        grow = min(grow, 1.0)
    proposal = trial.size * grow
    if trial.limit != layout.BY_ACCURACY and trial.limit != layout.BY_LARGEST:
        proposal = max(proposal, trial.wanted)
    state.clock[0].h_next = min(max(proposal, model.par[0].h_min), model.par[0].h_max)


@inner_jit
def accept(model: Model, state: State, work: Work) -> int:
    """Go on to the end of the trial: contacts, constraints that go, events, the ledger."""
    keep_separate()
    clock = state.clock[0]
    take_over(model, state, work)
    track_contacts(model, state, work, clock.t, work.trial[0].size)
    if model.fixed.shape[0] > 0:
        track_fixed(model, state, work, clock.t, work.trial[0].size)
    if model.area.shape[0] > 0:
        note_inside(model, state)
    changed = remove_constraints(model, state, work)
    note_progress(model, state, work)
    if changed or clock.t == work.trial[0].switch:
        clock.t_on = clock.t
        find_blocks(model, state, work, state.q, state.v)
        settle_brakes(model, state, work, 0.0)
        if not accelerations(model, state, work, clock.t, state.q, state.v, state.a, PLAIN):
            return SINGULAR
        _keep_forces(state, work)
    if clock.initial_energy > 0.0:
        clock.max_residual = max(
            clock.max_residual, abs(energy_residual(model, state)) / clock.initial_energy
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
    locate = model.par[0].locate != 0.0
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
    clock = state.clock[0]
    cnt = state.cnt[0]
    while clock.t < t_target and taken < max_steps and cnt.status == layout.RUNNING:
        h = min(clock.h_next, model.par[0].h_max)
        if longest_listed(model, state, h) < h:
            if not rebuild(model, state, work):
                return GROW_PAIRS
        if state.contact.shape[0] - cnt.contacts < cnt.pairs + state.struck.shape[0]:
            return GROW_CONTACTS
        if work.event.shape[0] - cnt.events < event_room:
            return DRAIN
        code = step(model, state, work)
        if code != DONE:
            cnt.status = layout.FAILED
            return code
        taken += 1
    return DONE
