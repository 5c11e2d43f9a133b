"""What happens at an accepted state: derailments, parted couplings, brakes, rest, the end."""

from __future__ import annotations

import math

from derail_ros.engine import layout
from derail_ros.engine.arrays import F64, Model, State, Work
from derail_ros.engine.contacts import end_contact
from derail_ros.engine.contacts_fixed import end_fixed
from derail_ros.engine.forces.brakes import apply_brakes
from derail_ros.engine.forces.couplers import coupler_energy
from derail_ros.engine.forces.draft_gear import gear_energy, tension
from derail_ros.engine.forces.guidance import break_out
from derail_ros.engine.forces.track import (
    break_passed,
    breaks_in_use,
    lateral_load,
    standing,
    truck_arm,
)
from derail_ros.engine.interpolation import LOCATED
from derail_ros.engine.jit import inner_jit, keep_separate
from derail_ros.vocabulary.events import EventKind

TRUCK_DERAILED = int(EventKind.TRUCK_DERAILED)
COUPLER_PARTED = int(EventKind.COUPLER_PARTED)
RAIL_BREAK_SET = int(EventKind.RAIL_BREAK_SET)
BRAKES_TRIGGERED = int(EventKind.BRAKES_TRIGGERED)
BRAKE_SIGNAL_REACHED = int(EventKind.BRAKE_SIGNAL_REACHED)
CAR_AT_REST = int(EventKind.CAR_AT_REST)
RUN_ENDED = int(EventKind.RUN_ENDED)
RUN_VOID = int(EventKind.RUN_VOID)

ROLLS = 0.005
"""A part of the train with cars on the rails that gains speed faster is not at rest, m/s^2."""


@inner_jit
def speed_of(v: F64, i: int) -> float:
    """Speed of the mass centre of car ``i``, m/s."""
    return math.sqrt(v[i, 0] * v[i, 0] + v[i, 1] * v[i, 1])


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
    k = state.cnt[0].events
    while k > 0 and work.event[k - 1].time > t:
        work.event[k] = work.event[k - 1]
        k -= 1
    row = work.event[k]
    row.kind = kind
    row.time = t
    row.car = car
    row.car2 = car2
    row.end = end
    row.cause = cause
    row.x = x
    row.y = y
    row.s = s
    row.speed = speed
    row.value = value
    row.step = state.cnt[0].steps
    state.cnt[0].events += 1


@inner_jit
def _derail_truck(
    model: Model, state: State, work: Work, i: int, k: int, cause: int, value: float
) -> None:
    """Take a truck off the rails, with its event."""
    keep_separate()
    t = state.clock[0].t
    state.truck_on[i, k] = 0
    r = truck_arm(model.car, i, k)
    speed = speed_of(state.v, i)
    if math.isnan(state.peak[i].derail_time):
        state.peak[i].derail_time = t
        state.peak[i].derail_speed = speed
    add_event(
        state, work, TRUCK_DERAILED, t, i + 1, 0, k + 1, cause,
        state.q[i, 0] + r * math.cos(state.q[i, 2]), state.q[i, 1] + r * math.sin(state.q[i, 2]),
        state.truck_s[i, k], speed, value,
    )  # fmt: skip


@inner_jit
def _part_coupling(
    model: Model, state: State, work: Work, i: int, cause: int, value: float
) -> None:
    """Part the coupling behind car ``i``; its knuckle's energy is lost; the pipe may vent."""
    keep_separate()
    t = state.clock[0].t
    before = coupler_energy(model, state.coupled, state.q)[1]
    before += gear_energy(model, state.coupled, state.q)
    state.coupled[i] = 0
    after = coupler_energy(model, state.coupled, state.q)[1]
    after += gear_energy(model, state.coupled, state.q)
    state.energy[layout.E_KNUCKLE] += before - after
    arm = model.car[i].pivot
    reach = model.car[i].rear
    x = state.q[i, 0] - arm * math.cos(state.q[i, 2]) - reach * math.cos(state.q[i, 4])
    y = state.q[i, 1] - arm * math.sin(state.q[i, 2]) - reach * math.sin(state.q[i, 4])
    speed = speed_of(state.v, i)
    add_event(state, work, COUPLER_PARTED, t, i + 1, i + 2, 0, cause, x, y, math.nan, speed, value)
    if model.par[0].vent != 0.0 and not standing(model, i):
        at = 0.5 * (model.car[i].distance + model.car[i + 1].distance)
        apply_brakes(model, state, at, layout.ARR_CONV, t)
        add_event(
            state, work, BRAKES_TRIGGERED, t, i + 1, i + 2, 0, layout.CAUSE_VENT, x, y, math.nan,
            speed, at,
        )  # fmt: skip


@inner_jit
def remove_constraints(model: Model, state: State, work: Work) -> bool:
    """Test the accepted state for derailments and parted couplings; True when any happened."""
    keep_separate()
    changed = False
    n = state.q.shape[0]
    weight = 0.5 * model.par[0].gravity
    breaking = model.par[0].strength != 0.0
    for i in range(n):
        virtual = model.car[i].virtual != 0.0
        for k in range(2):
            if state.truck_on[i, k] == 0:
                continue
            s1 = state.truck_s[i, k]
            passed = break_passed(model, state, work, i, k)
            if not math.isnan(passed):
                if virtual:
                    state.cnt[0].status = layout.VOID
                    add_event(
                        state, work, RUN_VOID, state.clock[0].t, i + 1, 0, k + 1,
                        layout.CAUSE_BREAK, state.q[i, 0], state.q[i, 1], s1,
                        speed_of(state.v, i), passed,
                    )  # fmt: skip
                    return changed
                _derail_truck(model, state, work, i, k, layout.CAUSE_BREAK, passed)
                if model.par[0].whole_car != 0.0 and state.truck_on[i, 1 - k]:
                    _derail_truck(model, state, work, i, 1 - k, layout.CAUSE_BREAK, passed)
                changed = True
                continue
            if virtual:
                continue
            load = lateral_load(model, state, state.q, state.rail_force, state.coupler_force, i, k)
            quotient = load / (weight * model.car[i].mass)
            if not quotient > model.par[0].lv_limit:
                state.over_since[i, k] = math.nan
                continue
            if math.isnan(state.over_since[i, k]):
                state.over_since[i, k] = state.clock[0].t
            if state.clock[0].t - state.over_since[i, k] >= model.par[0].lv_hold:
                _derail_truck(model, state, work, i, k, layout.CAUSE_LATERAL, quotient)
                changed = True
                if model.par[0].break_follows != 0.0 and not standing(model, i):
                    breaks = breaks_in_use(state)
                    if breaks < state.breaks.shape[0]:
                        state.breaks[breaks] = s1
                    add_event(
                        state, work, RAIL_BREAK_SET, state.clock[0].t, i + 1, 0, k + 1,
                        layout.CAUSE_LATERAL, math.nan, math.nan, s1, math.nan, quotient,
                    )  # fmt: skip
        if i < n - 1 and state.coupled[i]:
            angle = abs(state.q[i, 4] - state.q[i + 1, 3])
            if angle >= model.knuckle[i].limit - LOCATED:
                _part_coupling(model, state, work, i, layout.CAUSE_ANGLE, angle)
                changed = True
            elif breaking:
                force = tension(state.q, state.coupler_force, i)
                if force >= model.link[i].strength:
                    cause = layout.CAUSE_KNUCKLE
                    if model.link[i].part != 0.0:
                        cause = layout.CAUSE_BODY
                    _part_coupling(model, state, work, i, cause, force)
                    changed = True
    if model.par[0].guide_strength != 0.0:
        changed = break_out(model, state) or changed
    return changed


@inner_jit
def note_coupling_forces(state: State) -> None:
    """Keep the largest draft and buff forces of the couplings at the accepted state.

    Along the line between the mass centres, as ``Sample.axial_force``.
    """
    q = state.q
    force = state.coupler_force
    for k in range(force.shape[0]):
        dx = q[k + 1, 0] - q[k, 0]
        dy = q[k + 1, 1] - q[k, 1]
        along = (force[k, 0] * dx + force[k, 1] * dy) / math.sqrt(dx * dx + dy * dy)
        if along > state.coupling[k].draft:
            state.coupling[k].draft = along
            state.coupling[k].draft_time = state.clock[0].t
        elif -along > state.coupling[k].buff:
            state.coupling[k].buff = -along
            state.coupling[k].buff_time = state.clock[0].t


@inner_jit
def _rolls(model: Model, state: State) -> bool:
    """A part of the train gains speed: one that turns back on a grade is slow but not at rest.

    By the acceleration of cars that hang together, which draft gears do not change.
    """
    mass = 0.0
    x = 0.0
    y = 0.0
    rails = False
    n = state.q.shape[0]
    for i in range(n):
        m = model.car[i].mass
        mass += m
        x += m * state.a[i, 0]
        y += m * state.a[i, 1]
        rails = rails or state.truck_on[i, 0] != 0 or state.truck_on[i, 1] != 0
        if i == n - 1 or state.coupled[i] == 0:
            if rails and math.sqrt(x * x + y * y) > ROLLS * mass:
                return True
            mass = 0.0
            x = 0.0
            y = 0.0
            rails = False
    return False


@inner_jit
def note_progress(model: Model, state: State, work: Work) -> None:
    """Events of the brakes and of cars that come to rest, and the end of the run."""
    keep_separate()
    t = state.clock[0].t
    par = model.par[0]
    for u in range(state.arrival.shape[0]):
        if state.reached[u]:
            continue
        arrival = state.arrival[u, 0]
        for k in range(1, 4):
            arrival = min(arrival, state.arrival[u, k])
        if arrival <= t:
            state.reached[u] = 1
            i = int(model.unit[u].body)
            add_event(
                state, work, BRAKE_SIGNAL_REACHED, arrival, int(model.unit[u].number), 0, 0,
                layout.CAUSE_SIGNAL, state.q[i, 0], state.q[i, 1], math.nan,
                speed_of(state.v, i), model.unit[u].distance,
            )  # fmt: skip
    resting = True
    for i in range(state.q.shape[0]):
        speed = speed_of(state.v, i)
        rate = abs(state.v[i, 2])
        if not (speed < par.rest_speed and rate < par.rest_yaw_rate):
            resting = False
            if speed > 3.0 * par.rest_speed or rate > 3.0 * par.rest_yaw_rate:
                state.peak[i].resting = 0.0
        elif state.peak[i].resting == 0.0:
            state.peak[i].resting = 1.0
            add_event(
                state, work, CAR_AT_REST, t, i + 1, 0, 0, layout.CAUSE_NONE, state.q[i, 0],
                state.q[i, 1], math.nan, speed, math.nan,
            )  # fmt: skip
    if resting and par.along != 0.0:
        resting = not _rolls(model, state)
    if not resting:
        state.clock[0].rest_since = -1.0
    elif state.clock[0].rest_since < 0.0:
        state.clock[0].rest_since = t
    elif t - state.clock[0].rest_since >= par.rest_hold and state.cnt[0].status == layout.RUNNING:
        state.cnt[0].status = layout.AT_REST
        state.clock[0].duration = state.clock[0].rest_since
    if t >= par.time_limit and state.cnt[0].status == layout.RUNNING:
        state.cnt[0].status = layout.TIME_LIMIT
        state.clock[0].duration = t
    if state.cnt[0].status != layout.RUNNING:
        for p in range(state.cnt[0].pairs):
            if state.pair[p].contact >= 0.0:
                end_contact(state, p, t)
        end_fixed(state, t)
        add_event(
            state, work, RUN_ENDED, t, 0, 0, 0, state.cnt[0].status, math.nan, math.nan, math.nan,
            math.nan, state.clock[0].duration,
        )  # fmt: skip
