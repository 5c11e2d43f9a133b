"""Which cars may touch: the neighbour list, and the pairs of it that matter for now.

The neighbour list holds every pair whose circles come within the buffer plus a margin; it stays
valid until a car has moved half the margin. Virtual bodies never collide.
"""

from __future__ import annotations

import math

from derail_ros.engine.arrays import Model, State, Work
from derail_ros.engine.contacts import end_contact, remember_walls
from derail_ros.engine.forces.collisions import clear, pair_frames, within
from derail_ros.engine.jit import inner_jit, jit, keep_separate
from derail_ros.engine.trigonometry import angles

MARGIN = 3.0
"""Room between the circles that a fresh list allows for, m."""


@inner_jit
def list_is_stale(model: Model, state: State) -> bool:
    """A car has moved far enough since the list was made that a pair could be missing."""
    limit = 0.5 * MARGIN - model.par[0].step_share
    limit *= limit
    for i in range(state.q.shape[0]):
        dx = state.q[i, 0] - state.built[i, 0]
        dy = state.q[i, 1] - state.built[i, 1]
        if not dx * dx + dy * dy <= limit:
            return True
    return False


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
    share = model.par[0].step_share
    n = q.shape[0]
    fresh = True
    for i in range(n):
        dx = q[i, 0] - placed[i, 0]
        dy = q[i, 1] - placed[i, 1]
        moved = math.sqrt(dx * dx + dy * dy) + model.car[i].radius * abs(q[i, 2] - placed[i, 2])
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
    pair = state.pair
    angles(q, wk, work.ang)
    # at the corners of its buffer a body reaches sqrt(2) times as far
    room = 1.5 * model.par[0].buffer + 2.0 * ACTIVE * share
    count = 0
    for p in range(state.cnt[0].pairs):
        i = state.pairs[p, 0]
        j = state.pairs[p, 1]
        seen = pair_frames(q, i, j, wk[i].ct, wk[i].st, wk[j].ct, wk[j].st)
        if within(model.car, i, j, seen, room):
            count += 1
            work.active[count] = p
        else:
            clear(pair, p)
            pair[p].near = 0.0
    work.active[0] = count


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
        largest = max(largest, model.car[a].radius)
    room = model.par[0].buffer + MARGIN
    count = 0
    old_count = state.cnt[0].pairs
    old = 0
    for i in range(n):
        if model.car[i].virtual != 0.0 or model.par[0].collide == 0.0:
            continue
        first = count
        reach = model.car[i].radius + largest + room
        for direction in (-1, 1):
            a = place[i] + direction
            while 0 <= a < n and abs(q[order[a], 0] - q[i, 0]) <= reach:
                j = order[a]
                a += direction
                if j <= i or model.car[j].virtual != 0.0:
                    continue
                r = model.car[i].radius + model.car[j].radius + room
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
            if state.pair[old].contact >= 0.0:
                end_contact(state, old, state.clock[0].t)
            old += 1
        if old < old_count and state.pairs[old, 0] == i and state.pairs[old, 1] == j:
            for k in range(8):
                work.mask[p, k] = state.mask[old, k]
            work.pair[p] = state.pair[old]
            old += 1
        else:
            for k in range(8):
                work.mask[p, k] = 0
            work.pair[p] = work.blank[0]
            work.pair[p].contact = -2.0  # new: its walls are looked up below
    while old < old_count:
        if state.pair[old].contact >= 0.0:
            end_contact(state, old, state.clock[0].t)
        old += 1
    for p in range(count):
        i = work.pairs[p, 0]
        j = work.pairs[p, 1]
        state.pairs[p, 0] = i
        state.pairs[p, 1] = j
        for k in range(8):
            state.mask[p, k] = work.mask[p, k]
        state.pair[p] = work.pair[p]
        if state.pair[p].contact == -2.0:
            state.pair[p].contact = -1.0
            state.pair[p].below = -1.0
            remember_walls(model.car, q, state.mask, p, i, j, True)
        work.active[1 + p] = p
    for i in range(n):
        state.built[i, 0] = q[i, 0]
        state.built[i, 1] = q[i, 1]
        work.placed[i, 0] = math.nan
    work.active[0] = count
    state.cnt[0].pairs = count
    state.cnt[0].rebuilds += 1
    return True
