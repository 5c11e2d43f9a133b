"""Which cars may touch: the neighbour list, and the pairs of it that matter in the next step.

The neighbour list holds every pair whose circles come within the buffer plus a margin; it stays
valid until a car has moved half the margin. Virtual bodies never collide.

A step may be as long as nothing is missed. What counts is how fast a corner moves as the other
body sees it: a train that moves as one limits no step, and two bodies far apart limit it by the
time they need to come near each other.
"""

from __future__ import annotations

import math

from derail_ros.engine.arrays import ALL_CORNERS, F64, Model, State, Work
from derail_ros.engine.contacts import end_contact, remember_walls
from derail_ros.engine.forces.collisions import (
    Frame,
    corner_of,
    leave_out,
    pair_frames,
    widest_gap,
)
from derail_ros.engine.jit import inner_jit, jit, keep_separate
from derail_ros.engine.trigonometry import angles, sincos

MARGIN = 4.0
"""Room between the circles that a fresh list allows for, m."""

ZONE = 0.5
"""Share of the buffer within which no corner may pass a step's share in one step."""


@inner_jit
def longest_listed(model: Model, state: State, h: float) -> float:
    """The step ``h``, or less: as far as the neighbour list as it is allows for, s.

    Cars move straight on; ``strays`` checks afterwards that they did, but for a step's share.
    """
    limit = 0.5 * MARGIN
    longest = h
    for i in range(state.q.shape[0]):
        dx = state.q[i, 0] - state.built[i, 0]
        dy = state.q[i, 1] - state.built[i, 1]
        vx = state.v[i, 0]
        vy = state.v[i, 1]
        moved = math.sqrt(dx * dx + dy * dy)
        speed = math.sqrt(vx * vx + vy * vy)
        if not moved + speed * longest <= limit:
            longest = max(limit - moved, 0.0) / speed if moved < limit else 0.0
    return longest


@inner_jit
def strays(model: Model, state: State, work: Work, h: float) -> bool:
    """A car has moved a step's share away from where its velocity led it in the trial step."""
    share = model.par[0].step_share
    if model.par[0].collide == 0.0:
        return False
    for i in range(state.q.shape[0]):
        dx = work.stage_v[i, 0] - state.v[i, 0]
        dy = work.stage_v[i, 1] - state.v[i, 1]
        turn = model.car[i].radius * abs(work.stage_v[i, 2] - state.v[i, 2])
        if not h * (math.sqrt(dx * dx + dy * dy) + turn) <= share:
            return True
    return False


@inner_jit
def _see_corners(
    model: Model, v: F64, i: int, j: int, seen: Frame, vx: float, vy: float, near: float,
    h: float,
) -> tuple[int, float]:  # fmt: skip
    """Which corners of car ``i`` may touch car ``j`` (a bit each), and the step ``h``, or less, s.

    ``vx``, ``vy`` is the velocity of the centre of ``i`` for ``j``, along and across it (m/s). A
    corner may touch if no more than ``near`` and its way in the step ``h`` are between them.
    """
    car = model.car
    x0, y0, c, s = seen
    spin = v[i, 2] - v[j, 2]
    share = model.par[0].step_share
    zone = ZONE * model.par[0].buffer
    half_l = car[j].half_l
    half_w = car[j].half_w
    bits = 0
    least = h
    for corner in range(4):
        u, w = corner_of(car, i, corner)
        rx = c * u - s * w
        ry = s * u + c * w
        gap = max(abs(x0 + rx) - half_l, abs(y0 + ry) - half_w)
        ux = vx - spin * ry
        uy = vy + spin * rx
        square = ux * ux + uy * uy
        rest = max(0.0, gap - near)
        if rest * rest <= h * h * square:
            bits |= 1 << corner
        way = share + max(0.0, gap - zone)
        if least * least * square > way * way:
            least = way / math.sqrt(square)
    return bits, least


@inner_jit
def limit_way(model: Model, state: State, work: Work, h: float) -> float:
    """The step ``h``, or less: no corner passes its share near another body; lists what may touch.

    A corner nearer to the other body than ``ZONE`` of the buffer may move a step's share relative
    to it, one that is further away by so much more. What is left out of ``work.active`` and
    ``work.corners`` has no force throughout the step: a corner that is further away than the reach
    of the law, than both cars may stray and than its way in the step, straight or bent by the
    turning of the cars.
    """
    keep_separate()
    q = state.q
    v = state.v
    car = model.car
    wk = work.wk
    pair = state.pair
    room = model.par[0].reach + 2.0 * model.par[0].step_share  # both may stray
    largest = max(room, ZONE * model.par[0].buffer)
    angles(q, wk, work.ang, work.live)
    for i in range(q.shape[0]):
        wk[i].ct0 = wk[i].ct
        wk[i].st0 = wk[i].st
    count = 0
    for p in range(state.cnt[0].pairs):
        i = state.pairs[p, 0]
        j = state.pairs[p, 1]
        # velocity of the one's centre for the other, which turns
        dx = q[i, 0] - q[j, 0]
        dy = q[i, 1] - q[j, 1]
        wx = v[i, 0] - v[j, 0]
        wy = v[i, 1] - v[j, 1]
        ax = wx + v[j, 2] * dy
        ay = wy - v[j, 2] * dx
        bx = -wx - v[i, 2] * dy
        by = -wy + v[i, 2] * dx
        radii = car[i].radius + car[j].radius
        spin = abs(v[i, 2] - v[j, 2])
        speed = max(abs(ax) + abs(ay), abs(bx) + abs(by)) + spin * radii  # no less than any
        turn = max(abs(v[i, 2]), abs(v[j, 2]))
        bend = turn * (turn * (radii + abs(dx) + abs(dy)) + speed)
        far = largest + h * (speed + h * bend)
        # the circles around them say enough of most pairs
        if dx * dx + dy * dy <= (radii + far) * (radii + far):
            first, second = pair_frames(q, i, j, wk[i].ct, wk[i].st, wk[j].ct, wk[j].st)
            if widest_gap(car, i, j, (first, second)) <= far:
                ci = wk[i].ct
                si = wk[i].st
                cj = wk[j].ct
                sj = wk[j].st
                near = room + h * h * bend
                vx = cj * ax + sj * ay
                vy = cj * ay - sj * ax
                bits, least = _see_corners(model, v, i, j, first, vx, vy, near, h)
                vx = ci * bx + si * by
                vy = ci * by - si * bx
                more, h = _see_corners(model, v, j, i, second, vx, vy, near, h)
                h = min(h, least)
                bits |= more << 4
                if bits != 0:
                    count += 1
                    work.active[count] = p
                    work.corners[count] = bits
                    continue
        leave_out(pair, p)
    work.active[0] = count
    return h


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
    room = model.par[0].buffer + MARGIN + 2.0 * model.par[0].step_share
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
            si, ci = sincos(q[i, 2])
            sj, cj = sincos(q[j, 2])
            seen = pair_frames(q, i, j, ci, si, cj, sj)
            remember_walls(model.car, state.mask, p, i, j, seen, ALL_CORNERS, True)
        work.active[1 + p] = p
        work.corners[1 + p] = ALL_CORNERS
    for i in range(n):
        state.built[i, 0] = q[i, 0]
        state.built[i, 1] = q[i, 1]
    work.active[0] = count
    state.cnt[0].pairs = count
    state.cnt[0].rebuilds += 1
    return True
