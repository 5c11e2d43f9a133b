"""Contacts with fixed bodies over a run, and which cars have been in which area.

Works on accepted states: ``forces.fixed`` has left the sums in ``state.struck`` and
``state.group``.
"""

from __future__ import annotations

import math

from derail_ros.engine.arrays import Model, State, Work
from derail_ros.engine.forces.fixed import remember
from derail_ros.engine.jit import inner_jit, keep_separate
from derail_ros.engine.outlines import meets


@inner_jit
def _end(state: State, p: int, t: float) -> None:
    """Close the contact in progress in row ``p`` of ``state.struck``; it ended at ``t``."""
    contact = state.contact[int(state.struck[p].contact)]
    contact.end = t
    contact.stage = 2.0
    contact.version += 1.0
    state.struck[p].contact = -1.0


@inner_jit
def track_fixed(model: Model, state: State, work: Work, t: float, h: float) -> None:
    """Follow the contacts with fixed bodies at an accepted state that ends a step of ``h``."""
    keep_separate()
    par = model.par[0]
    remember(model, state, work)
    for g in range(state.group.shape[0]):
        group = state.group[g]
        group.energy += 0.5 * h * (group.power + group.last)
        group.last = group.power
        if group.energy >= group.limit:
            group.gone = 1.0
    bodies = model.fixed.shape[0]
    for p in range(state.struck.shape[0]):
        row = state.struck[p]
        if row.peak == 0.0 and row.contact < 0.0:
            row.last_power = 0.0
            continue
        resultant = math.sqrt(row.fx * row.fx + row.fy * row.fy)
        if row.contact < 0.0:
            row.last_power = row.power
            if resultant < par.begin_force:
                continue
            k = state.cnt[0].contacts
            state.cnt[0].contacts += 1
            row.contact = k
            row.below = -1.0
            contact = state.contact[k]
            contact.a = p // bodies + 1.0
            contact.b = -(p % bodies) - 1.0
            contact.start = t
            contact.end = math.nan
            contact.closing = row.closing
        else:
            contact = state.contact[int(row.contact)]
            contact.energy += 0.5 * h * (row.power + row.last_power)
            row.last_power = row.power
        if row.peak > contact.peak:
            if contact.stage == 1.0 and row.peak > 1.01 * contact.peak:
                contact.stage = 0.0
            contact.peak = row.peak
            contact.peak_time = t
            contact.corner_car = contact.a
            contact.corner = row.corner
            contact.x = row.x
            contact.y = row.y
            contact.nx = row.nx
            contact.ny = row.ny
            yaw = state.q[int(contact.a) - 1, 2]
            across = math.cos(yaw) * row.nx + math.sin(yaw) * row.ny
            contact.angle = math.asin(min(1.0, abs(across)))
        elif contact.stage == 0.0 and row.peak < 0.9 * contact.peak:
            contact.stage = 1.0
            contact.version += 1.0
        if resultant > contact.resultant:
            contact.resultant = resultant
            contact.resultant_time = t
        if resultant >= par.end_force:
            row.below = -1.0
        elif row.below < 0.0:
            row.below = t
        elif t - row.below >= par.end_hold:
            _end(state, p, row.below)


@inner_jit
def end_fixed(state: State, t: float) -> None:
    """Close all contacts with fixed bodies, at the end of the run."""
    for p in range(state.struck.shape[0]):
        if state.struck[p].contact >= 0.0:
            _end(state, p, t)


@inner_jit
def note_inside(model: Model, state: State) -> None:
    """Note which cars have a part in which area at the accepted state."""
    keep_separate()
    car = model.car
    q = state.q
    for i in range(q.shape[0]):
        c = math.cos(q[i, 2])
        s = math.sin(q[i, 2])
        for a in range(model.area.shape[0]):
            if state.inside[i, a] == 0 and car[i].virtual == 0.0:
                x, y, half_l, half_w = q[i, 0], q[i, 1], car[i].half_l, car[i].half_w
                if meets(model.outline, model.area, a, x, y, c, s, half_l, half_w):
                    state.inside[i, a] = 1
