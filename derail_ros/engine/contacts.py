"""The contacts of a run: which wall each corner came through, and the record of each collision.

Works on accepted states: ``forces.collisions`` has left each pair's forces in ``state.pair``.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from derail_ros.engine import layout as L
from derail_ros.engine.arrays import Model, State, Work
from derail_ros.engine.forces.collisions import (
    clear,
    corner_of,
    pair_contacts,
    pair_frames,
    speed_along,
)
from derail_ros.engine.interpolation import hermite
from derail_ros.engine.jit import inner_jit, keep_separate
from derail_ros.engine.laws.contact import nearest_wall, outside_mask
from derail_ros.engine.trigonometry import sincos

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]


@inner_jit
def remember_walls(car: F64, q: F64, mask: U8, p: int, i: int, j: int, fresh: bool) -> None:
    """Update the memory of pair ``p``: which walls each corner is outside of, or came through.

    A corner that is inside keeps its wall; ``fresh`` forgets it (a new pair).
    """
    keep_separate()
    si, ci = sincos(q[i, 2])
    sj, cj = sincos(q[j, 2])
    seen = pair_frames(q, i, j, ci, si, cj, sj)
    for side in range(2):
        u0, w0, c, turn = seen[side]
        a = i if side == 0 else j
        b = j if side == 0 else i
        for corner in range(4):
            u, w = corner_of(car, a, corner)
            x = u0 + c * u - turn * w
            y = w0 + turn * u + c * w
            out = outside_mask(x, y, car[b, L.HALF_L], car[b, L.HALF_W])
            k = 4 * side + corner
            if out == 0:
                old = 0 if fresh else mask[p, k]
                out = nearest_wall(x, y, car[b, L.HALF_L], car[b, L.HALF_W], old)
            mask[p, k] = out


@inner_jit
def end_contact(state: State, p: int, t: float) -> None:
    """Close the contact in progress of pair ``p``; it ended at ``t``."""
    k = int(state.pair[p, L.P_ID])
    state.contact[k, L.K_ENDT] = t
    state.contact[k, L.K_STAGE] = 2.0
    state.contact[k, L.K_VERSION] += 1.0
    state.pair[p, L.P_ID] = -1.0


@inner_jit
def _note_force(
    state: State, row: F64, contact: F64, i: int, j: int, angle: float, t: float
) -> None:
    """Keep the force between the cars ``i`` and ``j`` at ``t`` if it is the largest so far.

    ``row`` is the pair's, ``angle`` that between the cars.
    """
    keep_separate()
    corner_force = row[L.P_FMAX]
    if corner_force > state.peak[i, L.PK_F]:
        state.peak[i, L.PK_F] = corner_force
        state.peak[i, L.PK_T] = t
        state.peak[i, L.PK_OTHER] = j + 1.0
    if corner_force > state.peak[j, L.PK_F]:
        state.peak[j, L.PK_F] = corner_force
        state.peak[j, L.PK_T] = t
        state.peak[j, L.PK_OTHER] = i + 1.0
    if contact.shape[0] == 0:
        return
    if corner_force > contact[L.K_PEAK]:
        if contact[L.K_STAGE] == 1.0 and corner_force > 1.01 * contact[L.K_PEAK]:
            contact[L.K_STAGE] = 0.0
        contact[L.K_PEAK] = corner_force
        contact[L.K_PEAK_T] = t
        corner = int(row[L.P_CORNER])
        contact[L.K_CORNER_CAR] = i + 1.0 if corner < 4 else j + 1.0
        contact[L.K_CORNER] = corner % 4
        contact[L.K_X] = row[L.P_X]
        contact[L.K_Y] = row[L.P_Y]
        sign = 1.0 if contact[L.K_A] == i + 1.0 else -1.0
        contact[L.K_NX] = sign * row[L.P_NX]
        contact[L.K_NY] = sign * row[L.P_NY]
        contact[L.K_ANGLE] = math.atan2(abs(math.sin(angle)), abs(math.cos(angle)))
    elif contact[L.K_STAGE] == 0.0 and corner_force < 0.9 * contact[L.K_PEAK]:
        contact[L.K_STAGE] = 1.0
        contact[L.K_VERSION] += 1.0
    resultant = math.sqrt(row[L.P_FX] * row[L.P_FX] + row[L.P_FY] * row[L.P_FY])
    if resultant > contact[L.K_RES]:
        contact[L.K_RES] = resultant
        contact[L.K_RES_T] = t


@inner_jit
def _force_within(model: Model, state: State, work: Work, p: int, x: float, h: float) -> float:
    """Largest corner force of the pair in row ``p`` at the share ``x`` of the last step, N.

    The pair's row at that moment is left in ``work.pair``, its state in ``work.within_q/v``.
    """
    keep_separate()
    q = work.within_q
    v = work.within_v
    wk = work.within_wk
    for side in range(2):
        i = state.pairs[p, side]
        for k in range(3):
            q[i, k], v[i, k], _ = hermite(
                x, h, state.q0[i, k], state.v0[i, k], state.a0[i, k], state.q[i, k],
                state.v[i, k], state.a1[i, k],
            )  # fmt: skip
        wk[i, L.W_CT] = math.cos(q[i, 2])
        wk[i, L.W_ST] = math.sin(q[i, 2])
    i = state.pairs[p, 0]
    j = state.pairs[p, 1]
    seen = pair_frames(q, i, j, wk[i, L.W_CT], wk[i, L.W_ST], wk[j, L.W_CT], wk[j, L.W_ST])
    clear(work.pair, p)
    pair_contacts(model, state, q, v, wk, work.within_force, work.pair, work.report, p, seen)
    return work.pair[p, L.P_FMAX]


@inner_jit
def _peak_within(
    model: Model, state: State, work: Work, contact: F64, p: int, t: float, h: float
) -> None:
    """Find and keep a pair's largest force inside the step that ended at ``t``.

    A step may be as long as the rise of a contact. The force within a step rises, falls or does
    both: with its end the highest there is nothing to find; else three more moments and the
    vertex of a parabola through the highest and its neighbours.
    """
    keep_separate()
    first = state.pair[p, L.P_LAST_FMAX]
    last = state.pair[p, L.P_FMAX]
    if _force_within(model, state, work, p, 0.95, h) <= last:
        return
    before = first
    best = first
    after = last
    at = 0.0
    f1 = _force_within(model, state, work, p, 0.25, h)
    f2 = _force_within(model, state, work, p, 0.5, h)
    f3 = _force_within(model, state, work, p, 0.75, h)
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
        if _force_within(model, state, work, p, vertex, h) < best:
            _force_within(model, state, work, p, at, h)
        else:
            at = vertex
    else:
        _force_within(model, state, work, p, at, h)
    q = work.within_q
    i = state.pairs[p, 0]
    j = state.pairs[p, 1]
    _note_force(state, work.pair[p], contact, i, j, q[i, 2] - q[j, 2], t - (1.0 - at) * h)


NEAR_PEAK = 0.8
"""A step that begins or ends above this share of a contact's peak may hold a higher one."""


@inner_jit
def track_contacts(model: Model, state: State, work: Work, t: float, h: float) -> None:
    """Follow the contacts of all pairs at an accepted state: events, peaks, energy."""
    keep_separate()
    par = model.par
    pair = state.pair
    for p in range(state.cnt[L.N_PAIRS]):
        if pair[p, L.P_NEAR] == 0.0 and pair[p, L.P_ID] < 0.0:
            continue
        i = state.pairs[p, 0]
        j = state.pairs[p, 1]
        if pair[p, L.P_NEAR] != 0.0:
            remember_walls(model.car, state.q, state.mask, p, i, j, False)
        resultant = math.sqrt(
            pair[p, L.P_FX] * pair[p, L.P_FX] + pair[p, L.P_FY] * pair[p, L.P_FY]
        )
        angle = state.q[i, 2] - state.q[j, 2]
        if pair[p, L.P_ID] < 0.0:
            pair[p, L.P_LAST_POWER] = pair[p, L.P_POWER]
            if resultant < par[L.C_BEGIN]:
                _note_force(state, pair[p], state.contact[0, 0:0], i, j, angle, t)
                pair[p, L.P_LAST_FMAX] = pair[p, L.P_FMAX]
                continue
            k = state.cnt[L.N_CONTACTS]
            state.cnt[L.N_CONTACTS] += 1
            pair[p, L.P_ID] = k
            pair[p, L.P_BELOW] = -1.0
            contact = state.contact[k]
            for c in range(L.N_CONTACT):
                contact[c] = 0.0
            # the car whose point comes faster along the normal struck the other
            x, y = pair[p, L.P_X], pair[p, L.P_Y]
            nx, ny = pair[p, L.P_NX], pair[p, L.P_NY]
            vi = -speed_along(state.v, state.q, i, x, y, nx, ny)
            vj = speed_along(state.v, state.q, j, x, y, nx, ny)
            contact[L.K_A] = i + 1.0 if vi >= vj else j + 1.0
            contact[L.K_B] = j + 1.0 if vi >= vj else i + 1.0
            contact[L.K_START] = t
            contact[L.K_ENDT] = math.nan
            contact[L.K_CLOSING] = pair[p, L.P_CLOSING]
        else:
            k = int(pair[p, L.P_ID])
            contact = state.contact[k]
            contact[L.K_ENERGY] += 0.5 * h * (pair[p, L.P_POWER] + pair[p, L.P_LAST_POWER])
            pair[p, L.P_LAST_POWER] = pair[p, L.P_POWER]
        if max(pair[p, L.P_LAST_FMAX], pair[p, L.P_FMAX]) > NEAR_PEAK * contact[L.K_PEAK]:
            _peak_within(model, state, work, contact, p, t, h)
        _note_force(state, pair[p], contact, i, j, angle, t)
        pair[p, L.P_LAST_FMAX] = pair[p, L.P_FMAX]
        if resultant >= par[L.C_END]:
            pair[p, L.P_BELOW] = -1.0
        elif pair[p, L.P_BELOW] < 0.0:
            pair[p, L.P_BELOW] = t
        elif t - pair[p, L.P_BELOW] >= par[L.C_HOLD]:
            end_contact(state, p, pair[p, L.P_BELOW])
