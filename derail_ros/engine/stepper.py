"""Steps of a run: integration, projection, removal of constraints, events.

A step goes from one accepted state to the next. Within it the set of constraints and of switched
forces is fixed; a truck's passing of a rail break and a coupling's reaching its limit angle are
found inside the step, which is shortened to end there.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from derail_ros.engine import layout as L
from derail_ros.engine.arrays import Model, State, Work
from derail_ros.engine.contacts import end_contact, track_contacts
from derail_ros.engine.dynamics import (
    FACTORED,
    PLAIN,
    accelerations,
    constraint_error,
    kinetic_energy,
    onto_constraints,
    project_velocities,
)
from derail_ros.engine.forces.brakes import apply_brakes, next_application
from derail_ros.engine.forces.collisions import first_jump
from derail_ros.engine.forces.couplers import coupler_energy, first_kink, first_limit
from derail_ros.engine.forces.pushes import next_push
from derail_ros.engine.forces.track import (
    break_passed,
    breaks_in_use,
    first_overload,
    first_passing,
    on_track,
    truck_arm,
    truck_rows,
)
from derail_ros.engine.implicit import longest_stable
from derail_ros.engine.interpolation import LOCATED
from derail_ros.engine.jit import inline_jit, inner_jit, jit, keep_separate
from derail_ros.engine.neighbours import list_is_stale, rebuild, refresh_active
from derail_ros.engine.runge_kutta import step_error, take_stages
from derail_ros.engine.trigonometry import angles
from derail_ros.vocabulary.events import EventKind

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]

TRUCK_DERAILED = int(EventKind.TRUCK_DERAILED)
COUPLER_PARTED = int(EventKind.COUPLER_PARTED)
RAIL_BREAK_SET = int(EventKind.RAIL_BREAK_SET)
BRAKES_TRIGGERED = int(EventKind.BRAKES_TRIGGERED)
BRAKE_SIGNAL_REACHED = int(EventKind.BRAKE_SIGNAL_REACHED)
CAR_AT_REST = int(EventKind.CAR_AT_REST)
RUN_ENDED = int(EventKind.RUN_ENDED)
RUN_VOID = int(EventKind.RUN_VOID)

# What `advance` stopped for.
DONE, DRAIN, GROW_PAIRS, GROW_CONTACTS = 0, 1, 2, 3
NON_FINITE, STEP_FLOOR, SINGULAR, TRACK_END = -1, -2, -3, -4


@inner_jit
def speed_of(v: F64, i: int) -> float:
    """Speed of the mass centre of car ``i``, m/s."""
    return math.sqrt(v[i, 0] * v[i, 0] + v[i, 1] * v[i, 1])


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
def step_cap(model: Model, v: F64) -> float:
    """Largest step in which no corner moves further than its share of the buffer, s."""
    fastest = 1e-9
    for i in range(v.shape[0]):
        fastest = max(fastest, speed_of(v, i) + abs(v[i, 2]) * model.car[i, L.RADIUS])
    return min(model.par[L.H_MAX], model.par[L.STEP_SHARE] / fastest)


@inner_jit
def add_event(
    state: State,
    work: Work,
    kind: int,
    t: float,
    car: int,
    car2: int,
    end: int,
    cause: int,
    x: float,
    y: float,
    s: float,
    speed: float,
    value: float,
) -> None:
    """Append a row to the event buffer, kept in the order of time."""
    keep_separate()
    k = state.cnt[L.N_EVENTS]
    while k > 0 and work.event[k - 1, L.V_TIME] > t:
        for c in range(L.N_EVENT):
            work.event[k, c] = work.event[k - 1, c]
        k -= 1
    row = work.event[k]
    row[L.V_KIND] = kind
    row[L.V_TIME] = t
    row[L.V_CAR] = car
    row[L.V_CAR2] = car2
    row[L.V_END] = end
    row[L.V_CAUSE] = cause
    row[L.V_X] = x
    row[L.V_Y] = y
    row[L.V_S] = s
    row[L.V_SPEED] = speed
    row[L.V_VALUE] = value
    row[L.V_STEP] = state.cnt[L.STEP]
    state.cnt[L.N_EVENTS] += 1


@inner_jit
def derail_truck(
    model: Model, state: State, work: Work, i: int, k: int, cause: int, value: float
) -> None:
    """Take a truck off the rails and say so."""
    keep_separate()
    t = state.clock[L.T]
    state.truck_on[i, k] = 0
    r = truck_arm(model.car, i, k)
    speed = speed_of(state.v, i)
    if math.isnan(state.peak[i, L.PK_DERAIL_T]):
        state.peak[i, L.PK_DERAIL_T] = t
        state.peak[i, L.PK_DERAIL_V] = speed
    add_event(
        state, work, TRUCK_DERAILED, t, i + 1, 0, k + 1, cause,
        state.q[i, 0] + r * math.cos(state.q[i, 2]), state.q[i, 1] + r * math.sin(state.q[i, 2]),
        state.truck_s[i, k], speed, value,
    )  # fmt: skip


@inner_jit
def part_coupling(
    model: Model, state: State, work: Work, i: int, cause: int, value: float
) -> None:
    """Part the coupling behind car ``i``; its knuckle's energy is lost; the pipe may vent."""
    keep_separate()
    t = state.clock[L.T]
    before = coupler_energy(model, state.coupled, state.q)
    state.coupled[i] = 0
    after = coupler_energy(model, state.coupled, state.q)
    state.energy[L.E_KNUCKLE] += before[1] - after[1]
    arm = model.car[i, L.DP]
    reach = model.car[i, L.DCR]
    x = state.q[i, 0] - arm * math.cos(state.q[i, 2]) - reach * math.cos(state.q[i, 4])
    y = state.q[i, 1] - arm * math.sin(state.q[i, 2]) - reach * math.sin(state.q[i, 4])
    speed = speed_of(state.v, i)
    add_event(state, work, COUPLER_PARTED, t, i + 1, i + 2, 0, cause, x, y, math.nan, speed, value)
    if model.par[L.VENT] != 0.0:
        at = 0.5 * (model.car[i, L.DIST] + model.car[i + 1, L.DIST])
        apply_brakes(model, state, at, True, True, L.ARR_CONV, t)
        add_event(
            state, work, BRAKES_TRIGGERED, t, i + 1, i + 2, 0, L.CAUSE_VENT, x, y, math.nan,
            speed, at,
        )  # fmt: skip


@inner_jit
def remove_constraints(model: Model, state: State, work: Work) -> bool:
    """Test the accepted state for derailments and parted couplings; True when any happened."""
    keep_separate()
    changed = False
    n = state.q.shape[0]
    weight = 0.5 * model.par[L.GRAVITY]
    for i in range(n):
        virtual = model.car[i, L.VIRTUAL] != 0.0
        for k in range(2):
            if state.truck_on[i, k] == 0:
                continue
            s1 = state.truck_s[i, k]
            passed = break_passed(state, work, i, k)
            if not math.isnan(passed):
                if virtual:
                    state.cnt[L.STATUS] = L.VOID
                    add_event(
                        state, work, RUN_VOID, state.clock[L.T], i + 1, 0, k + 1, L.CAUSE_BREAK,
                        state.q[i, 0], state.q[i, 1], s1,
                        speed_of(state.v, i), passed,
                    )  # fmt: skip
                    return changed
                derail_truck(model, state, work, i, k, L.CAUSE_BREAK, passed)
                if model.par[L.WHOLE_CAR] != 0.0 and state.truck_on[i, 1 - k]:
                    derail_truck(model, state, work, i, 1 - k, L.CAUSE_BREAK, passed)
                changed = True
                continue
            if virtual:
                continue
            quotient = abs(state.rail_force[i, k]) / (weight * model.car[i, L.MASS])
            if quotient > model.par[L.LV_LIMIT]:
                derail_truck(model, state, work, i, k, L.CAUSE_LATERAL, quotient)
                changed = True
                if model.par[L.BREAK_FOLLOWS] != 0.0:
                    breaks = breaks_in_use(state)
                    if breaks < state.breaks.shape[0]:
                        state.breaks[breaks] = s1
                    add_event(
                        state, work, RAIL_BREAK_SET, state.clock[L.T], i + 1, 0, k + 1,
                        L.CAUSE_LATERAL, math.nan, math.nan, s1, math.nan, quotient,
                    )  # fmt: skip
        if i < n - 1 and state.coupled[i]:
            angle = abs(state.q[i, 4] - state.q[i + 1, 3])
            if angle >= model.knuckle[i, L.KN_LIMIT] - LOCATED:
                part_coupling(model, state, work, i, L.CAUSE_ANGLE, angle)
                changed = True
    return changed


@inner_jit
def note_progress(model: Model, state: State, work: Work) -> None:
    """Events of the brakes and of cars that come to rest, and the end of the run."""
    keep_separate()
    t = state.clock[L.T]
    par = model.par
    for u in range(state.arrival.shape[0]):
        if state.reached[u]:
            continue
        arrival = state.arrival[u, 0]
        for k in range(1, 4):
            arrival = min(arrival, state.arrival[u, k])
        if arrival <= t:
            state.reached[u] = 1
            i = int(model.unit[u, L.U_BODY])
            add_event(
                state, work, BRAKE_SIGNAL_REACHED, arrival, int(model.unit[u, L.U_NUMBER]), 0, 0,
                L.CAUSE_SIGNAL, state.q[i, 0], state.q[i, 1], math.nan,
                speed_of(state.v, i), model.unit[u, L.U_DIST],
            )  # fmt: skip
    resting = True
    for i in range(state.q.shape[0]):
        speed = speed_of(state.v, i)
        rate = abs(state.v[i, 2])
        if not (speed < par[L.REST_V] and rate < par[L.REST_W]):
            resting = False
            if speed > 3.0 * par[L.REST_V] or rate > 3.0 * par[L.REST_W]:
                state.peak[i, L.PK_RESTING] = 0.0
        elif state.peak[i, L.PK_RESTING] == 0.0:
            state.peak[i, L.PK_RESTING] = 1.0
            add_event(
                state, work, CAR_AT_REST, t, i + 1, 0, 0, L.CAUSE_NONE, state.q[i, 0],
                state.q[i, 1], math.nan, speed, math.nan,
            )  # fmt: skip
    if not resting:
        state.clock[L.REST_SINCE] = -1.0
    elif state.clock[L.REST_SINCE] < 0.0:
        state.clock[L.REST_SINCE] = t
    elif t - state.clock[L.REST_SINCE] >= par[L.REST_HOLD] and state.cnt[L.STATUS] == L.RUNNING:
        state.cnt[L.STATUS] = L.AT_REST
        state.clock[L.DURATION] = state.clock[L.REST_SINCE]
    if t >= par[L.T_LIMIT] and state.cnt[L.STATUS] == L.RUNNING:
        state.cnt[L.STATUS] = L.TIME_LIMIT
        state.clock[L.DURATION] = t
    if state.cnt[L.STATUS] != L.RUNNING:
        for p in range(state.cnt[L.N_PAIRS]):
            if state.pair[p, L.P_ID] >= 0.0:
                end_contact(state, p, t)
        add_event(
            state, work, RUN_ENDED, t, 0, 0, 0, state.cnt[L.STATUS], math.nan, math.nan, math.nan,
            math.nan, state.clock[L.DURATION],
        )  # fmt: skip


@inner_jit
def energy_residual(model: Model, state: State) -> float:
    """Imbalance of the ledger, J: initial energy + put in - energy now - taken out."""
    striker, knuckle = coupler_energy(model, state.coupled, state.q)
    e = state.energy
    return (
        state.clock[L.E_INITIAL]
        + e[L.E_EXTERNAL]
        + e[L.E_STAB_NET]
        - kinetic_energy(model, state.v)
        - striker
        - knuckle
        - e[L.E_BRAKE]
        - e[L.E_GROUND_TRUCK]
        - e[L.E_GROUND_BODY]
        - e[L.E_COLLISION]
        - e[L.E_DAMPER]
        - e[L.E_KNUCKLE]
    )


@inner_jit
def keep_last(state: State) -> None:
    """Remember the accepted state as the beginning of the last step."""
    copy_rows(state.q0, state.q)
    copy_rows(state.v0, state.v)
    copy_rows(state.a0, state.a)
    copy_rows(state.truck_on0, state.truck_on)
    copy_items(state.coupled0, state.coupled)
    copy_items(state.energy0, state.energy)
    copy_items(state.power0, state.power)


@inner_jit
def keep_forces(state: State, work: Work) -> None:
    """Powers and multipliers of the last evaluation into the state."""
    copy_items(state.power, work.power)
    copy_rows(state.rail_force, work.lam_t)
    copy_rows(state.coupler_force, work.lam_c)


@inline_jit
def step(model: Model, state: State, work: Work) -> int:
    """Take one accepted step. Returns DONE or one of the error codes."""
    par = model.par
    clock = state.clock
    cnt = state.cnt
    t = clock[L.T]
    floor = par[L.H_MIN]
    project = par[L.PROJECT] != 0.0
    stages = (model.table.shape[0] - 4) // 2
    # the slope at the new state counts in the error, and the last stage stood there
    to_end = model.table[2 * stages + 1, stages] != 0.0
    last_at_end = model.table[2 * stages + 2, stages - 1] == 1.0
    exponent = model.table[2 * stages + 3, 1]
    explicit = model.table[2 * stages + 3, 0] == 0.0
    copy_rows(work.truck_s, state.truck_s)
    clock[L.T_ON] = t
    switch = min(next_push(model, t), next_application(state, t))
    cap = step_cap(model, state.v)
    wanted = clock[L.H_NEXT]
    h = wanted
    limit = L.LIMIT_ACCURACY
    if cap < h:
        h = cap
        limit = L.LIMIT_CAP
        if h == par[L.H_MAX]:
            limit = L.LIMIT_LARGEST
    if explicit:
        stable = longest_stable(model, state, work, h, model.table[2 * stages + 3, 2])
        if stable < h:
            h = stable
            limit = L.LIMIT_STABILITY
    # land on a switch exactly; a sliver before it is spread over two steps
    if t + h >= switch:
        h = switch - t
        limit = L.LIMIT_MOMENT
    elif t + 2.0 * h > switch:
        h = 0.5 * (switch - t)
    rejected = False
    grow = 1.0
    e_before = 0.0
    after = t
    way = 0
    while True:
        # 0: go on; 1: the error is too large; 2: the projection fails; 3: a crossing inside
        verdict = 0
        error = math.inf
        after = switch if t + h >= switch else t + h
        # feet of the trucks start from the accepted state, whatever a rejected try left
        copy_rows(state.truck_s, work.truck_s)
        way = take_stages(model, state, work, h, stages)
        if way >= 0 and not to_end:
            error = step_error(model, state, work, h, stages, stages)
            if not error <= 1.0:
                verdict = 1
        elif way < 0:
            verdict = 1
        if verdict == 0:
            striker, knuckle = coupler_energy(model, state.coupled, work.stage_q)
            e_before = kinetic_energy(model, work.stage_v) + striker + knuckle
            if project:
                if onto_constraints(model, state, work, work.stage_q, last_at_end and way == 0):
                    project_velocities(model, state, work, work.stage_v)
                else:
                    verdict = 2
            else:
                angles(work.stage_q, work.wk, work.ang)
                truck_rows(model, state, work, work.stage_q)
        if verdict == 0 and par[L.LOCATE] != 0.0:
            share = first_passing(model, state, work, h)
            share = min(share, first_limit(model, state, work, h))
            share = min(share, first_jump(model, state, work, h))
            share = min(share, first_kink(model, state, work, h))
            # a truck that stands on the break derails within the smallest step
            located = max(share * h, floor)
            if share < 1.0 and located < h:
                h = located
                limit = L.LIMIT_MOMENT
                switch = math.inf
                verdict = 3
        if verdict == 0:
            if not accelerations(
                model, state, work, after, work.stage_q, work.stage_v, work.kv[stages],
                FACTORED if project else PLAIN,
            ):  # fmt: skip
                copy_rows(state.truck_s, work.truck_s)
                return SINGULAR
            if to_end:
                for i in range(state.q.shape[0]):
                    for k in range(5):
                        work.kq[stages, i, k] = work.stage_v[i, k]
                error = step_error(model, state, work, h, stages, stages + 1)
                if not error <= 1.0:
                    verdict = 1
        if verdict == 0 and par[L.LOCATE] != 0.0:
            located = max(first_overload(model, state, work) * h, floor)
            if located < h:
                h = located
                limit = L.LIMIT_MOMENT
                switch = math.inf
                verdict = 3
        if verdict == 0:
            grow = min(2.0, max(0.2, 0.85 * max(error, 1e-10) ** -exponent))
            break
        if verdict == 3:
            continue
        cnt[L.REJECTED] += 1
        rejected = True
        if verdict == 1:
            ok = math.isfinite(error)
            shrink = 0.2
            if ok:
                shrink = min(0.9, max(0.2, 0.85 * error**-exponent))
            limit = L.LIMIT_ACCURACY
            h *= shrink
            wanted = h
            if h < floor:
                copy_rows(state.truck_s, work.truck_s)
                return STEP_FLOOR if ok else NON_FINITE
        else:
            h *= 0.25
            wanted = h
            if h < floor:
                copy_rows(state.truck_s, work.truck_s)
                return SINGULAR
    for i in range(state.q.shape[0]):
        for k in range(5):
            if not math.isfinite(work.kv[stages, i, k] + work.stage_q[i, k] + work.stage_v[i, k]):
                copy_rows(state.truck_s, work.truck_s)
                return NON_FINITE

    # accepted
    clock[L.T_PREV] = t
    clock[L.T] = after
    keep_last(state)
    copy_rows(state.q, work.stage_q)
    copy_rows(state.v, work.stage_v)
    for k in range(L.N_POWER):
        state.energy[k] += h * work.mean_power[k]
    striker, knuckle = coupler_energy(model, state.coupled, state.q)
    stored = kinetic_energy(model, state.v) + striker + knuckle
    moved = stored - e_before
    state.energy[L.E_STAB_NET] += moved
    state.energy[L.E_STAB_GROSS] += abs(moved)
    cnt[L.STEP] += 1
    cnt[limit] += 1
    cnt[L.IMPLICIT_STEPS] += way
    copy_rows(state.a1, work.kv[stages])
    copy_rows(state.a, state.a1)
    copy_items(state.power1, work.power)
    keep_forces(state, work)
    gap, offset = constraint_error(model, state, work, state.q)
    clock[L.MAX_GAP] = max(clock[L.MAX_GAP], gap)
    clock[L.MAX_OFFSET] = max(clock[L.MAX_OFFSET], offset)

    track_contacts(model, state, work, clock[L.T], h)
    changed = remove_constraints(model, state, work)
    note_progress(model, state, work)
    if changed or clock[L.T] == switch:
        clock[L.T_ON] = clock[L.T]
        if not accelerations(model, state, work, clock[L.T], state.q, state.v, state.a, PLAIN):
            return SINGULAR
        keep_forces(state, work)
    if clock[L.E_INITIAL] > 0.0:
        clock[L.MAX_RESIDUAL] = max(
            clock[L.MAX_RESIDUAL], abs(energy_residual(model, state)) / clock[L.E_INITIAL]
        )
    # The next size follows the error; a step cut short for other reasons does not shrink it.
    if rejected:
        grow = min(grow, 1.0)
    proposal = h * grow
    if limit != L.LIMIT_ACCURACY:
        proposal = max(proposal, wanted)
    clock[L.H_NEXT] = min(max(proposal, floor), par[L.H_MAX])
    if not on_track(model, state):
        return TRACK_END
    return DONE


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
