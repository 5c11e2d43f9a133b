"""Blocks: cars on straight rails that move as one, until something reaches them.

A car with both trucks on endless straight track, yaw and offset exactly zero, keeps them so
exactly: it can only move along the track. Where two such cars are coupled and their couplers
between them exactly straight and still, nothing bends that joint either: every force across it is
zero. A row of them is a block, one body of the sum of their masses; forces along the track and
across it are counted car by car as before, and the rails take what is across. The force in a joint
inside a block is what its cars ahead of it do not need of their own forces.

So blocks change no law: they leave out what is zero. A block loses cars for good as their couplers
are bent and their trucks leave the rails. It is found anew for every step from the state alone.
"""

from __future__ import annotations

import numpy as np

from derail_ros.engine.arrays import ALL_CORNERS, F64, Model, State, Work
from derail_ros.engine.forces.fixed import list_near
from derail_ros.engine.jit import inner_jit, jit, keep_separate
from derail_ros.engine.solver import weigh_blocks

CLOSED = 1e-9
"""Largest gap of a joint inside a block, m."""


@inner_jit
def _straight_joint(model: Model, state: State, q: F64, v: F64, k: int) -> bool:
    """The couplers between cars ``k`` and ``k + 1`` are exactly straight and still."""
    if state.coupled[k] == 0 or v[k, 0] != v[k + 1, 0]:
        return False
    if q[k, 4] != 0.0 or q[k + 1, 3] != 0.0 or v[k, 4] != 0.0 or v[k + 1, 3] != 0.0:
        return False
    length = model.car[k + 1].distance - model.car[k].distance
    return abs(q[k, 0] - q[k + 1, 0] - length) <= CLOSED


@inner_jit
def inside(work: Work, k: int) -> bool:
    """Coupling ``k`` lies inside a block."""
    return work.head[k + 1] <= k


@jit
def find_blocks(model: Model, state: State, work: Work, q: F64, v: F64) -> None:
    """Blocks of the state (q, v) into ``work``: ``bound``, ``head``, ``tail``, ``live``.

    ``live`` lists the cars of which more may move than the place along the track; the angles of
    the others are put into ``work.wk``, and the truck rows of all that are bound.
    """
    keep_separate()
    n = q.shape[0]
    wk = work.wk
    head = work.head
    tail = work.tail
    par = model.par[0]
    straight = model.track.shape[0] == 0 and par.gear == 0.0 and par.project != 0.0
    for i in range(n):
        held = straight and i < par.train
        held = held and state.truck_on[i, 0] != 0 and state.truck_on[i, 1] != 0
        held = held and q[i, 1] == 0.0 and q[i, 2] == 0.0 and v[i, 1] == 0.0 and v[i, 2] == 0.0
        work.bound[i] = held
        head[i] = i
        if held:
            for k in range(2):
                row = work.row[i, k]
                row.nx = 0.0
                row.ny = 1.0
                row.arm = model.car[i].truck if k == 0 else -model.car[i].truck
                row.curve = 0.0
                row.offset = 0.0
        if held and i > 0 and work.bound[i - 1] and _straight_joint(model, state, q, v, i - 1):
            head[i] = head[i - 1]
    count = 0
    for i in range(n - 1, -1, -1):
        tail[i] = i
        if i < n - 1 and inside(work, i):
            tail[i] = tail[i + 1]
    for i in range(n):
        idle = work.bound[i] != 0
        idle = idle and q[i, 3] == 0.0 and q[i, 4] == 0.0 and v[i, 3] == 0.0 and v[i, 4] == 0.0
        idle = idle and (i == 0 or state.coupled[i - 1] == 0 or inside(work, i - 1))
        if idle and (i == n - 1 or state.coupled[i] == 0 or inside(work, i)):
            wk[i].ct = 1.0
            wk[i].st = 0.0
            wk[i].ca = 1.0
            wk[i].sa = 0.0
            wk[i].cb = 1.0
            wk[i].sb = 0.0
            continue
        count += 1
        work.live[count] = i
    work.live[0] = count
    weigh_blocks(work)


def no_blocks(work: Work) -> None:
    """Every car by itself and free to turn, for models with joints of their own."""
    n = len(work.head)
    work.bound[:] = 0
    work.head[:] = work.tail[:] = work.live[1:] = np.arange(n)
    work.live[0] = n


FEW = 4
"""So few cars of the last block are not left out."""


@inner_jit
def cars_in_scope(model: Model, state: State, work: Work) -> int:
    """Number of the cars, from the first, that the stages of a step look at.

    Those behind are of the last block, move as its first car does, and have no force but their
    brakes.
    """
    n = state.q.shape[0]
    scope = work.head[n - 1] + 1
    par = model.par[0]
    if par.along != 0.0 or par.guide_strength != 0.0:
        return n
    if model.zone.shape[0] > 0 or model.fixed.shape[0] > 0:
        return n
    for k in range(model.lateral.shape[0]):
        scope = max(scope, int(model.lateral[k].car) + 1)
    for a in range(1, 1 + work.active[0]):
        scope = max(scope, state.pairs[work.active[a], 1] + 1)  # the second car is further back
    return scope if scope + FEW <= n else n


@inner_jit
def close_up(model: Model, work: Work, q: F64) -> None:
    """Put the cars of blocks at their places behind the first: rounding moves them."""
    for i in range(q.shape[0]):
        h = work.head[i]
        if h < i:
            q[i, 0] = q[h, 0] - (model.car[i].distance - model.car[h].distance)


@jit
def prepare(model: Model, state: State, work: Work, q: F64, v: F64) -> None:
    """Make ``work`` ready for an evaluation at (q, v): blocks, all listed pairs, fixed bodies."""
    find_blocks(model, state, work, q, v)
    for i in range(q.shape[0]):
        work.wk[i].settled = 0.0
    for p in range(state.cnt[0].pairs):
        work.active[1 + p] = p
        work.corners[1 + p] = ALL_CORNERS
    work.active[0] = state.cnt[0].pairs
    if model.fixed.shape[0] > 0:
        list_near(model, state, work, 0.0)
