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
from derail_ros.engine.jit import inner_jit, jit, keep_separate
from derail_ros.engine.laws.contact import nearest_wall, outside_mask

F64 = NDArray[np.float64]

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
def corner_place(model: Model, q: F64, i: int, corner: int) -> tuple[float, float]:
    """Place of a corner of car ``i``: 0 front left, 1 front right, 2 rear left, 3 rear right."""
    u = model.car[i, L.HALF_L] if corner < 2 else -model.car[i, L.HALF_L]
    w = model.car[i, L.HALF_W] if corner % 2 == 0 else -model.car[i, L.HALF_W]
    c = math.cos(q[i, 2])
    s = math.sin(q[i, 2])
    return q[i, 0] + c * u - s * w, q[i, 1] + s * u + c * w


@inner_jit
def remember_walls(model: Model, state: State, p: int, fresh: bool) -> None:
    """Update the memory of pair ``p``: which walls each corner is outside of, or came through.

    A corner that is inside keeps its wall; ``fresh`` forgets it (a new pair).
    """
    keep_separate()
    q = state.q
    for side in range(2):
        i = state.pairs[p, side]
        j = state.pairs[p, 1 - side]
        c = math.cos(q[j, 2])
        s = math.sin(q[j, 2])
        a = model.car[j, L.HALF_L]
        b = model.car[j, L.HALF_W]
        for corner in range(4):
            x, y = corner_place(model, q, i, corner)
            u = c * (x - q[j, 0]) + s * (y - q[j, 1])
            w = -s * (x - q[j, 0]) + c * (y - q[j, 1])
            mask = outside_mask(u, w, a, b)
            k = 4 * side + corner
            if mask == 0:
                old = 0 if fresh else state.mask[p, k]
                mask = nearest_wall(u, w, a, b, old)
            state.mask[p, k] = mask


@inner_jit
def end_contact(state: State, p: int, t: float) -> None:
    """Close the contact in progress of pair ``p``; it ended at ``t``."""
    row = state.contact[int(state.pair[p, L.P_ID])]
    row[L.K_ENDT] = t
    row[L.K_STAGE] = 2.0
    row[L.K_VERSION] += 1.0
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
    place = np.empty(n, dtype=np.int64)
    largest = 0.0
    for a in range(n):
        place[order[a]] = a
        largest = max(largest, model.car[a, L.RADIUS])
    room = model.par[L.C_BUFFER] + MARGIN
    count = 0
    old_count = state.cnt[L.N_PAIRS]
    old = 0
    for i in range(n):
        if model.car[i, L.VIRTUAL] != 0.0:
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
            work.mask[p] = state.mask[old]
            work.pair[p] = state.pair[old]
            old += 1
        else:
            work.mask[p] = 0
            work.pair[p] = 0.0
            work.pair[p, L.P_ID] = -2.0  # new: its walls are looked up below
    while old < old_count:
        if state.pair[old, L.P_ID] >= 0.0:
            end_contact(state, old, state.clock[L.T])
        old += 1
    for p in range(count):
        state.pairs[p] = work.pairs[p]
        state.mask[p] = work.mask[p]
        state.pair[p] = work.pair[p]
        if state.pair[p, L.P_ID] == -2.0:
            state.pair[p, L.P_ID] = -1.0
            state.pair[p, L.P_BELOW] = -1.0
            remember_walls(model, state, p, True)
    for i in range(n):
        state.built[i, 0] = q[i, 0]
        state.built[i, 1] = q[i, 1]
    state.cnt[L.N_PAIRS] = count
    state.cnt[L.REBUILDS] += 1
    return True


@inner_jit
def track_contacts(model: Model, state: State, t: float, h: float) -> None:
    """Follow the contacts of all pairs at an accepted state: events, peaks, energy."""
    keep_separate()
    par = model.par
    for p in range(state.cnt[L.N_PAIRS]):
        row = state.pair[p]
        if row[L.P_NEAR] != 0.0:
            remember_walls(model, state, p, False)
        elif row[L.P_ID] < 0.0:
            continue
        i = state.pairs[p, 0]
        j = state.pairs[p, 1]
        resultant = math.sqrt(row[L.P_FX] * row[L.P_FX] + row[L.P_FY] * row[L.P_FY])
        corner_force = row[L.P_FMAX]
        if corner_force > state.peak[i, L.PK_F]:
            state.peak[i, L.PK_F] = corner_force
            state.peak[i, L.PK_T] = t
            state.peak[i, L.PK_OTHER] = j + 1.0
        if corner_force > state.peak[j, L.PK_F]:
            state.peak[j, L.PK_F] = corner_force
            state.peak[j, L.PK_T] = t
            state.peak[j, L.PK_OTHER] = i + 1.0
        if row[L.P_ID] < 0.0:
            row[L.P_LAST_POWER] = row[L.P_POWER]
            if resultant < par[L.C_BEGIN]:
                continue
            k = state.cnt[L.N_CONTACTS]
            state.cnt[L.N_CONTACTS] += 1
            row[L.P_ID] = k
            row[L.P_BELOW] = -1.0
            contact = state.contact[k]
            contact[:] = 0.0
            # the car whose point comes faster along the normal struck the other
            nx = row[L.P_NX]
            ny = row[L.P_NY]
            vi = -(
                nx * (state.v[i, 0] - state.v[i, 2] * (row[L.P_Y] - state.q[i, 1]))
                + ny * (state.v[i, 1] + state.v[i, 2] * (row[L.P_X] - state.q[i, 0]))
            )
            vj = nx * (state.v[j, 0] - state.v[j, 2] * (row[L.P_Y] - state.q[j, 1])) + ny * (
                state.v[j, 1] + state.v[j, 2] * (row[L.P_X] - state.q[j, 0])
            )
            contact[L.K_A] = i + 1.0 if vi >= vj else j + 1.0
            contact[L.K_B] = j + 1.0 if vi >= vj else i + 1.0
            contact[L.K_START] = t
            contact[L.K_ENDT] = math.nan
            contact[L.K_CLOSING] = row[L.P_CLOSING]
        else:
            k = int(row[L.P_ID])
            contact = state.contact[k]
            contact[L.K_ENERGY] += 0.5 * h * (row[L.P_POWER] + row[L.P_LAST_POWER])
            row[L.P_LAST_POWER] = row[L.P_POWER]
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
            d = state.q[i, 2] - state.q[j, 2]
            contact[L.K_ANGLE] = math.atan2(abs(math.sin(d)), abs(math.cos(d)))
        elif contact[L.K_STAGE] == 0.0 and corner_force < 0.9 * contact[L.K_PEAK]:
            contact[L.K_STAGE] = 1.0
            contact[L.K_VERSION] += 1.0
        if resultant > contact[L.K_RES]:
            contact[L.K_RES] = resultant
            contact[L.K_RES_T] = t
        if resultant >= par[L.C_END]:
            row[L.P_BELOW] = -1.0
        elif row[L.P_BELOW] < 0.0:
            row[L.P_BELOW] = t
        elif t - row[L.P_BELOW] >= par[L.C_HOLD]:
            end_contact(state, p, row[L.P_BELOW])
