"""Which cars may touch, and the memory of contacts.

The neighbour list holds every pair whose circles come within the buffer plus a margin; it stays
valid until a car has moved half the margin. Virtual bodies never collide.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from derail_ros.engine import layout as L
from derail_ros.engine.arrays import Model, State, Work
from derail_ros.engine.forces import pair_contacts
from derail_ros.engine.interpolation import hermite
from derail_ros.engine.jit import inner_jit, jit, keep_separate
from derail_ros.engine.laws.contact import nearest_wall, outside_mask
from derail_ros.engine.trigonometry import angles, sincos

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]

MARGIN = 3.0
"""Room between the circles that a fresh list allows for, m."""


@inner_jit
def list_is_stale(model: Model, state: State) -> bool:
    """A car has moved far enough since the list was made that a pair could be missing."""
    limit = 0.5 * MARGIN - model.par[L.STEP_SHARE]
    limit *= limit
    for i in range(state.q.shape[0]):
        dx = state.q[i, 0] - state.built[i, 0]
        dy = state.q[i, 1] - state.built[i, 1]
        if not dx * dx + dy * dy <= limit:
            return True
    return False


@inner_jit
def remember_walls(car: F64, q: F64, mask: U8, p: int, i: int, j: int, fresh: bool) -> None:
    """Update the memory of pair ``p``: which walls each corner is outside of, or came through.

    A corner that is inside keeps its wall; ``fresh`` forgets it (a new pair).
    """
    keep_separate()
    si, ci = sincos(q[i, 2])
    sj, cj = sincos(q[j, 2])
    c = ci * cj + si * sj
    s = si * cj - ci * sj
    for side in range(2):
        # the centre of the one and its direction in the frame of the other
        a = i if side == 0 else j
        b = j if side == 0 else i
        dx = q[a, 0] - q[b, 0]
        dy = q[a, 1] - q[b, 1]
        cb = cj if side == 0 else ci
        sb = sj if side == 0 else si
        turn = s if side == 0 else -s
        u0 = cb * dx + sb * dy
        w0 = -sb * dx + cb * dy
        for corner in range(4):
            u = car[a, L.HALF_L] if corner < 2 else -car[a, L.HALF_L]
            w = car[a, L.HALF_W] if corner % 2 == 0 else -car[a, L.HALF_W]
            x = u0 + c * u - turn * w
            y = w0 + turn * u + c * w
            out = outside_mask(x, y, car[b, L.HALF_L], car[b, L.HALF_W])
            k = 4 * side + corner
            if out == 0:
                old = 0 if fresh else mask[p, k]
                out = nearest_wall(x, y, car[b, L.HALF_L], car[b, L.HALF_W], old)
            mask[p, k] = out


ACTIVE = 3.0
"""How far corners may move before the list of active pairs is made again, in steps' shares."""


@inner_jit
def refresh_active(model: Model, state: State, work: Work) -> None:
    """List the pairs that can come within the buffer before some corner has moved a while.

    Two rectangles are at least as far apart as the widest gap between them along their axes. The
    pairs left out are those whose collision force is exactly zero.
    """
    keep_separate()
    q = state.q
    placed = work.placed
    share = model.par[L.STEP_SHARE]
    n = q.shape[0]
    fresh = True
    for i in range(n):
        dx = q[i, 0] - placed[i, 0]
        dy = q[i, 1] - placed[i, 1]
        moved = math.sqrt(dx * dx + dy * dy) + model.car[i, L.RADIUS] * abs(q[i, 2] - placed[i, 2])
        # half a list's life for the step that comes
        if not moved <= 0.5 * ACTIVE * share:
            fresh = False
            break
    if fresh:
        return
    for i in range(n):
        for k in range(3):
            placed[i, k] = q[i, k]
    wk = work.wk
    car = model.car
    pair = state.pair
    angles(q, wk, work.ang)
    # at the corners of its buffer a body reaches sqrt(2) times as far
    room = 1.5 * model.par[L.C_BUFFER] + 2.0 * ACTIVE * share
    count = 0
    for p in range(state.cnt[L.N_PAIRS]):
        i = state.pairs[p, 0]
        j = state.pairs[p, 1]
        dx = q[i, 0] - q[j, 0]
        dy = q[i, 1] - q[j, 1]
        ci = wk[i, L.W_CT]
        si = wk[i, L.W_ST]
        cj = wk[j, L.W_CT]
        sj = wk[j, L.W_ST]
        ac = abs(ci * cj + si * sj)
        as_ = abs(si * cj - ci * sj)
        a_i = car[i, L.HALF_L]
        b_i = car[i, L.HALF_W]
        a_j = car[j, L.HALF_L]
        b_j = car[j, L.HALF_W]
        gap = abs(cj * dx + sj * dy) - (a_j + a_i * ac + b_i * as_)
        gap = max(gap, abs(cj * dy - sj * dx) - (b_j + a_i * as_ + b_i * ac))
        gap = max(gap, abs(ci * dx + si * dy) - (a_i + a_j * ac + b_j * as_))
        gap = max(gap, abs(ci * dy - si * dx) - (b_i + a_j * as_ + b_j * ac))
        if gap > room:
            pair[p, L.P_FX] = 0.0
            pair[p, L.P_FY] = 0.0
            pair[p, L.P_FMAX] = 0.0
            pair[p, L.P_POWER] = 0.0
            pair[p, L.P_NEAR] = 0.0
        else:
            count += 1
            work.active[count] = p
    work.active[0] = count


@inner_jit
def end_contact(state: State, p: int, t: float) -> None:
    """Close the contact in progress of pair ``p``; it ended at ``t``."""
    k = int(state.pair[p, L.P_ID])
    state.contact[k, L.K_ENDT] = t
    state.contact[k, L.K_STAGE] = 2.0
    state.contact[k, L.K_VERSION] += 1.0
    state.pair[p, L.P_ID] = -1.0


@jit
def rebuild(model: Model, state: State, work: Work) -> bool:
    """Make the neighbour list anew, carrying the memory of pairs that stay.

    Pairs are in the order of their cars, so that sums do not depend on history. Returns False,
    with the old list kept, when ``work.pairs`` has too few rows.
    """
    keep_separate()
    n = state.q.shape[0]
    q = state.q
    order = work.order
    # cars along X: nearly sorted from the last time
    for a in range(1, n):
        i = order[a]
        x = q[i, 0]
        b = a - 1
        while b >= 0 and (q[order[b], 0] > x or (q[order[b], 0] == x and order[b] > i)):
            order[b + 1] = order[b]
            b -= 1
        order[b + 1] = i
    place = work.place
    largest = 0.0
    for a in range(n):
        place[order[a]] = a
        largest = max(largest, model.car[a, L.RADIUS])
    room = model.par[L.C_BUFFER] + MARGIN
    count = 0
    old_count = state.cnt[L.N_PAIRS]
    old = 0
    for i in range(n):
        if model.car[i, L.VIRTUAL] != 0.0 or model.par[L.COLLIDE] == 0.0:
            continue
        first = count
        reach = model.car[i, L.RADIUS] + largest + room
        for direction in (-1, 1):
            a = place[i] + direction
            while 0 <= a < n and abs(q[order[a], 0] - q[i, 0]) <= reach:
                j = order[a]
                a += direction
                if j <= i or model.car[j, L.VIRTUAL] != 0.0:
                    continue
                r = model.car[i, L.RADIUS] + model.car[j, L.RADIUS] + room
                dx = q[i, 0] - q[j, 0]
                dy = q[i, 1] - q[j, 1]
                if dx * dx + dy * dy > r * r:
                    continue
                if count >= work.pairs.shape[0]:
                    return False
                b = count
                while b > first and work.pairs[b - 1, 1] > j:
                    work.pairs[b, 1] = work.pairs[b - 1, 1]
                    b -= 1
                work.pairs[b, 1] = j
                work.pairs[count, 0] = i
                count += 1
    # carry over what is known of pairs that stay: both lists are sorted
    for p in range(count):
        i = work.pairs[p, 0]
        j = work.pairs[p, 1]
        while old < old_count and (
            state.pairs[old, 0] < i or (state.pairs[old, 0] == i and state.pairs[old, 1] < j)
        ):
            if state.pair[old, L.P_ID] >= 0.0:
                end_contact(state, old, state.clock[L.T])
            old += 1
        if old < old_count and state.pairs[old, 0] == i and state.pairs[old, 1] == j:
            for k in range(8):
                work.mask[p, k] = state.mask[old, k]
            for k in range(L.N_PAIR):
                work.pair[p, k] = state.pair[old, k]
            old += 1
        else:
            for k in range(8):
                work.mask[p, k] = 0
            for k in range(L.N_PAIR):
                work.pair[p, k] = 0.0
            work.pair[p, L.P_ID] = -2.0  # new: its walls are looked up below
    while old < old_count:
        if state.pair[old, L.P_ID] >= 0.0:
            end_contact(state, old, state.clock[L.T])
        old += 1
    for p in range(count):
        i = work.pairs[p, 0]
        j = work.pairs[p, 1]
        state.pairs[p, 0] = i
        state.pairs[p, 1] = j
        for k in range(8):
            state.mask[p, k] = work.mask[p, k]
        for k in range(L.N_PAIR):
            state.pair[p, k] = work.pair[p, k]
        if state.pair[p, L.P_ID] == -2.0:
            state.pair[p, L.P_ID] = -1.0
            state.pair[p, L.P_BELOW] = -1.0
            remember_walls(model.car, q, state.mask, p, i, j, True)
        work.active[1 + p] = p
    for i in range(n):
        state.built[i, 0] = q[i, 0]
        state.built[i, 1] = q[i, 1]
        work.placed[i, 0] = math.nan
    work.active[0] = count
    state.cnt[L.N_PAIRS] = count
    state.cnt[L.REBUILDS] += 1
    return True


@inner_jit
def note_force(
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
def force_within(model: Model, state: State, work: Work, p: int, x: float, h: float) -> float:
    """Largest corner force of a pair at the share ``x`` of the last step, N.

    The pair's row at that moment is left in ``work.pair``. Other scratch used here is free once
    the step has been accepted.
    """
    keep_separate()
    q = work.kq[0]
    v = work.kv[0]
    for side in range(2):
        i = state.pairs[p, side]
        for k in range(3):
            q[i, k], v[i, k], _ = hermite(
                x, h, state.q0[i, k], state.v0[i, k], state.a0[i, k], state.q[i, k],
                state.v[i, k], state.a1[i, k],
            )  # fmt: skip
        work.stage_v[i, L.W_CT] = math.cos(q[i, 2])
        work.stage_v[i, L.W_ST] = math.sin(q[i, 2])
    pair_contacts(
        model.par, model.car, q, v, work.stage_v, work.stage_q, work.pair, state.mask,
        work.report, p, state.pairs[p, 0], state.pairs[p, 1],
    )  # fmt: skip
    return work.pair[p, L.P_FMAX]


@inner_jit
def peak_within(
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
    if force_within(model, state, work, p, 0.95, h) <= last:
        return
    before = first
    best = first
    after = last
    at = 0.0
    f1 = force_within(model, state, work, p, 0.25, h)
    f2 = force_within(model, state, work, p, 0.5, h)
    f3 = force_within(model, state, work, p, 0.75, h)
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
        if force_within(model, state, work, p, vertex, h) < best:
            force_within(model, state, work, p, at, h)
        else:
            at = vertex
    else:
        force_within(model, state, work, p, at, h)
    q = work.kq[0]
    i = state.pairs[p, 0]
    j = state.pairs[p, 1]
    note_force(state, work.pair[p], contact, i, j, q[i, 2] - q[j, 2], t - (1.0 - at) * h)


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
                note_force(state, pair[p], state.contact[0, 0:0], i, j, angle, t)
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
            nx = pair[p, L.P_NX]
            ny = pair[p, L.P_NY]
            vi = -(
                nx * (state.v[i, 0] - state.v[i, 2] * (pair[p, L.P_Y] - state.q[i, 1]))
                + ny * (state.v[i, 1] + state.v[i, 2] * (pair[p, L.P_X] - state.q[i, 0]))
            )
            vj = nx * (state.v[j, 0] - state.v[j, 2] * (pair[p, L.P_Y] - state.q[j, 1])) + ny * (
                state.v[j, 1] + state.v[j, 2] * (pair[p, L.P_X] - state.q[j, 0])
            )
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
            peak_within(model, state, work, contact, p, t, h)
        note_force(state, pair[p], contact, i, j, angle, t)
        pair[p, L.P_LAST_FMAX] = pair[p, L.P_FMAX]
        if resultant >= par[L.C_END]:
            pair[p, L.P_BELOW] = -1.0
        elif pair[p, L.P_BELOW] < 0.0:
            pair[p, L.P_BELOW] = t
        elif t - pair[p, L.P_BELOW] >= par[L.C_HOLD]:
            end_contact(state, p, pair[p, L.P_BELOW])
