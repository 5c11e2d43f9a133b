"""The contacts of a run: which wall each corner came through, and the record of each collision.

Works on accepted states: ``forces.collisions`` has left each pair's forces in ``state.pair``.
"""

from __future__ import annotations

import math
from typing import Any

from derail_ros.engine.arrays import U8, Model, Rows, State, Work
from derail_ros.engine.forces.collisions import (
    Frame,
    corner_of,
    pair_contacts,
    pair_frames,
    speed_along,
)
from derail_ros.engine.interpolation import hermite
from derail_ros.engine.jit import inner_jit, keep_separate
from derail_ros.engine.laws.contact import nearest_wall, outside_mask
from derail_ros.engine.trigonometry import sincos


@inner_jit
def remember_walls(
    car: Rows, mask: U8, p: int, i: int, j: int, seen: tuple[Frame, Frame], corners: int,
    fresh: bool,
) -> None:  # fmt: skip
    """Update the memory of pair ``p``: which walls each corner is outside of, or came through.

    A corner that is inside keeps its wall; ``fresh`` forgets it (a new pair). ``corners`` has a
    bit for each corner that is looked at.
    """
    keep_separate()
    for side in range(2):
        u0, w0, c, turn = seen[side]
        a = i if side == 0 else j
        b = j if side == 0 else i
        for corner in range(4):
            k = 4 * side + corner
            if (corners >> k) & 1 == 0:
                continue
            u, w = corner_of(car, a, corner)
            x = u0 + c * u - turn * w
            y = w0 + turn * u + c * w
            out = outside_mask(x, y, car[b].half_l, car[b].half_w)
            if out == 0:
                old = 0 if fresh else mask[p, k]
                out = nearest_wall(x, y, car[b].half_l, car[b].half_w, old)
            mask[p, k] = out


@inner_jit
def end_contact(state: State, p: int, t: float) -> None:
    """Close the contact in progress of pair ``p``; it ended at ``t``."""
    k = int(state.pair[p].contact)
    state.contact[k].end = t
    state.contact[k].stage = 2.0
    state.contact[k].version += 1.0
    state.pair[p].contact = -1.0


@inner_jit
def _note_force(state: State, row: Any, k: int, i: int, j: int, angle: float, t: float) -> None:
    """Keep the force between the cars ``i`` and ``j`` at ``t`` if it is the largest so far.

    ``row`` is the pair's, ``k`` the row of its contact (-1 without one), ``angle`` the angle
    between the cars.
    """
    keep_separate()
    corner_force = row.peak
    if corner_force > state.peak[i].force:
        state.peak[i].force = corner_force
        state.peak[i].time = t
        state.peak[i].other = j + 1.0
    if corner_force > state.peak[j].force:
        state.peak[j].force = corner_force
        state.peak[j].time = t
        state.peak[j].other = i + 1.0
    if k < 0:
        return
    contact = state.contact[k]
    if corner_force > contact.peak:
        if contact.stage == 1.0 and corner_force > 1.01 * contact.peak:
            contact.stage = 0.0
        contact.peak = corner_force
        contact.peak_time = t
        corner = int(row.corner)
        contact.corner_car = i + 1.0 if corner < 4 else j + 1.0
        contact.corner = corner % 4
        contact.x = row.x
        contact.y = row.y
        sign = 1.0 if contact.a == i + 1.0 else -1.0
        contact.nx = sign * row.nx
        contact.ny = sign * row.ny
        contact.angle = math.atan2(abs(math.sin(angle)), abs(math.cos(angle)))
    elif contact.stage == 0.0 and corner_force < 0.9 * contact.peak:
        contact.stage = 1.0
        contact.version += 1.0
    resultant = math.sqrt(row.fx * row.fx + row.fy * row.fy)
    if resultant > contact.resultant:
        contact.resultant = resultant
        contact.resultant_time = t


@inner_jit
def _force_within(model: Model, state: State, work: Work, a: int, x: float, h: float) -> float:
    """Largest corner force of the active pair ``a`` at the share ``x`` of the last step, N.

    The pair's row at that moment is left in ``work.pair``, its state in ``work.within_q/v``.
    """
    keep_separate()
    q = work.within_q
    v = work.within_v
    wk = work.within_wk
    p = work.active[a]
    for side in range(2):
        i = state.pairs[p, side]
        for k in range(3):
            q[i, k], v[i, k], _ = hermite(
                x, h, state.q0[i, k], state.v0[i, k], state.a0[i, k], state.q[i, k],
                state.v[i, k], state.a1[i, k],
            )  # fmt: skip
        wk[i].st, wk[i].ct = sincos(q[i, 2])
    work.pair[p].near = 1.0
    pair_contacts(model, state, work, q, v, wk, work.within_force, work.pair, a, a + 1)
    return work.pair[p].peak


@inner_jit
def _peak_within(
    model: Model, state: State, work: Work, k: int, a: int, t: float, h: float
) -> None:
    """Find the largest force of the active pair ``a`` in the step to ``t``, for contact ``k``.

    A step may be as long as the rise of a contact. The force within a step rises, falls or does
    both: with its end the highest there is nothing to find; else three more moments and the
    vertex of a parabola through the highest and its neighbours.
    """
    keep_separate()
    p = work.active[a]
    first = state.pair[p].last_peak
    last = state.pair[p].peak
    if _force_within(model, state, work, a, 0.95, h) <= last:
        return
    before = first
    best = first
    after = last
    at = 0.0
    f1 = _force_within(model, state, work, a, 0.25, h)
    f2 = _force_within(model, state, work, a, 0.5, h)
    f3 = _force_within(model, state, work, a, 0.75, h)
    if f1 > best:
        before, best, after, at = first, f1, f2, 0.25
    if f2 > best:
        before, best, after, at = f1, f2, f3, 0.5
    if f3 > best:
        before, best, after, at = f2, f3, last, 0.75
    if at == 0.0:
        return
    bend = before - 2.0 * best + after
    if bend < 0.0:
        vertex = at + 0.125 * (before - after) / bend
        if _force_within(model, state, work, a, vertex, h) < best:
            _force_within(model, state, work, a, at, h)
        else:
            at = vertex
    else:
        _force_within(model, state, work, a, at, h)
    q = work.within_q
    i = state.pairs[p, 0]
    j = state.pairs[p, 1]
    _note_force(state, work.pair[p], k, i, j, q[i, 2] - q[j, 2], t - (1.0 - at) * h)


NEAR_PEAK = 0.8
"""A step that begins or ends above this share of a contact's peak may hold a higher one."""


@inner_jit
def track_contacts(model: Model, state: State, work: Work, t: float, h: float) -> None:
    """Follow the contacts of all pairs at an accepted state: events, peaks, energy."""
    keep_separate()
    par = model.par[0]
    pair = state.pair
    wk = work.wk
    q = state.q
    a = 1  # of the active pairs, which are in order
    for p in range(state.cnt[0].pairs):
        row = pair[p]
        if row.near == 0.0 and row.contact < 0.0:
            continue
        i = state.pairs[p, 0]
        j = state.pairs[p, 1]
        while a < work.active[0] and work.active[a] < p:
            a += 1
        if row.near != 0.0:
            seen = pair_frames(q, i, j, wk[i].ct, wk[i].st, wk[j].ct, wk[j].st)
            remember_walls(model.car, state.mask, p, i, j, seen, work.corners[a], False)
        resultant = math.sqrt(row.fx * row.fx + row.fy * row.fy)
        angle = state.q[i, 2] - state.q[j, 2]
        if row.contact < 0.0:
            row.last_power = row.power
            if resultant < par.begin_force:
                _note_force(state, row, -1, i, j, angle, t)
                row.last_peak = row.peak
                continue
            k = state.cnt[0].contacts
            state.cnt[0].contacts += 1
            row.contact = k
            row.below = -1.0
            contact = state.contact[k]
            # the car whose point comes faster along the normal struck the other
            x, y = row.x, row.y
            nx, ny = row.nx, row.ny
            vi = -speed_along(state.v, state.q, i, x, y, nx, ny)
            vj = speed_along(state.v, state.q, j, x, y, nx, ny)
            contact.a = i + 1.0 if vi >= vj else j + 1.0
            contact.b = j + 1.0 if vi >= vj else i + 1.0
            contact.start = t
            contact.end = math.nan
            contact.closing = row.closing
        else:
            k = int(row.contact)
            contact = state.contact[k]
            contact.energy += 0.5 * h * (row.power + row.last_power)
            row.last_power = row.power
        if max(row.last_peak, row.peak) > NEAR_PEAK * contact.peak:
            _peak_within(model, state, work, k, a, t, h)
        _note_force(state, row, k, i, j, angle, t)
        row.last_peak = row.peak
        if resultant >= par.end_force:
            row.below = -1.0
        elif row.below < 0.0:
            row.below = t
        elif t - row.below >= par.end_hold:
            end_contact(state, p, row.below)
