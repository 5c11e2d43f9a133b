"""Fixed bodies and areas in three dimensions: the planar laws on the cars seen from above.

A car's outline from above is the rectangle around its body as it leans. With the roll phi, the
half width w, the half height h of its kind and the kinks of the absolute values rounded,

    W = w |cos phi| + h |sin phi|

(a tank: w). ``forces.fixed`` gives the push of a wall on it. The force acts at the middle of the
height that car and body share: that of its body, or where the wall ends below that, of its trucks.
Its part F across the car acts on the edge that leads: it has the roll moment ``-|F| dW/dphi``
besides, which turns a car that leans into a wall upright, so that the work of the force is that on
the outline. A car that is above a wall passes over it.
"""

from __future__ import annotations

import math

from derail_ros.engine.arrays import Model, State, Work
from derail_ros.engine.contacts_fixed import note_inside, track_fixed
from derail_ros.engine.forces.fixed import fixed_forces, list_near
from derail_ros.engine.jit import inner_jit, jit
from derail_ros.spatial.kernels import Space
from derail_ros.vocabulary.shapes import BED_HEIGHT, RAIL_HEIGHT, TRUCK

FLAT = 0.03
"""Sine of a lean below which a side is taken to touch with more than its edge."""


@inner_jit
def _rounded(x: float) -> tuple[float, float]:
    """``|x|`` with its kink rounded within FLAT, and its derivative."""
    if abs(x) >= FLAT:
        return abs(x) - 0.5 * FLAT, math.copysign(1.0, x)
    return 0.5 * x * x / FLAT, x / FLAT


@inner_jit
def _outline(model: Model, seen: Model, view: State, space: Space, i: int) -> None:
    """The rectangle around car ``i``, and the heights of its body and trucks (``space.span``)."""
    row = space.body[i]
    b = int(row.body)
    m = space.xmat
    cy = math.cos(space.pose[i, 5])
    sy = math.sin(space.pose[i, 5])
    half = (model.car[i].half_l, model.car[i].half_w, 0.5 * (row.top - row.bottom))
    tall = 0.0
    for k in range(3):
        tall += abs(m[b, 6 + k]) * half[k]
    lean = cy * m[b, 5] - sy * m[b, 2]  # of the body's upright axis, to the left
    up = cy * m[b, 4] - sy * m[b, 1]
    width = half[1]
    lever = 0.0
    if space.round[i] == 0:
        flat, flat_rate = _rounded(up)
        side, side_rate = _rounded(lean)
        width = half[1] * (flat + 0.5 * FLAT) + half[2] * side
        # with the roll, which turns up into -lean and the other way round
        lever = half[1] * flat_rate * lean - half[2] * side_rate * up
    middle = 0.5 * (row.top + row.bottom) - row.height
    seen.car[i].half_w = width
    seen.car[i].radius = math.sqrt(half[0] * half[0] + width * width)
    view.q[i, 0] = space.xpos[b, 0] + m[b, 2] * middle
    view.q[i, 1] = space.xpos[b, 1] + m[b, 5] * middle
    view.q[i, 2] = space.pose[i, 5]
    high = space.xpos[b, 2] + m[b, 8] * middle
    space.span[i, 0] = high - tall
    space.span[i, 1] = high + tall
    foot = space.xpos[b, 2] - row.height * m[b, 8]
    other = foot + TRUCK[2] * m[b, 8]
    space.span[i, 2] = min(foot, other)
    space.span[i, 3] = max(foot, other)
    space.span[i, 4] = lever
    _move(view, space, i, high)


@inner_jit
def _move(view: State, space: Space, i: int, z: float) -> None:
    """Velocity of the outline of car ``i`` at the height ``z``, on the side that is pushed."""
    b = int(space.body[i].body)
    v = space.velocity[i]
    rx = view.q[i, 0] - space.xpos[b, 0]
    ry = view.q[i, 1] - space.xpos[b, 1]
    rz = z - space.xpos[b, 2]
    cy = math.cos(view.q[i, 2])
    sy = math.sin(view.q[i, 2])
    pushed = cy * space.wall[i, 1] - sy * space.wall[i, 0] if space.wall.shape[0] > 0 else 0.0
    out = 0.0
    if pushed != 0.0:  # a wall at the left pushes to the right
        out = space.span[i, 4] * (v[3] * cy + v[4] * sy)
        out = out if pushed < 0.0 else -out
    view.v[i, 0] = v[0] + v[4] * rz - v[5] * ry - out * sy
    view.v[i, 1] = v[1] + v[5] * rx - v[3] * rz + out * cy
    view.v[i, 2] = v[5]
    space.level[i] = z


@inner_jit
def _shared(low: float, high: float, top: float) -> float:
    """Middle of the height that a wall up to ``top`` shares with a part; nan: none."""
    low = max(low, -RAIL_HEIGHT - BED_HEIGHT)
    high = min(high, top)
    return 0.5 * (low + high) if high > low else math.nan


@inner_jit
def _drop_passed(model: Model, view: State, work: Work, space: Space) -> None:
    """Leave in ``work.near`` the bodies that cars meet at some height, and note that height."""
    kept = 0
    last = -1
    bodies = model.fixed.shape[0]
    for r in range(1, 1 + work.near[0, 0]):
        i = work.near[r, 0]
        b = work.near[r, 1]
        z = _shared(space.span[i, 0], space.span[i, 1], space.tops[b])
        if math.isnan(z):
            z = _shared(space.span[i, 2], space.span[i, 3], space.tops[b])
        if math.isnan(z):
            for corner in range(4):
                view.hold[i, 4 * b + corner] = 0
            for k in range(int(model.fixed[b].first), int(model.fixed[b].last)):
                view.hold[i, 4 * bodies + k] = 0
            continue
        if i != last:
            # the edge that leads lies as far from that height as the wall leaves of the body
            tall = space.span[i, 1] - space.span[i, 0]
            shared = min(space.span[i, 1], space.tops[b]) - space.span[i, 0]
            space.span[i, 4] *= min(1.0, max(0.0, shared / tall))
            _move(view, space, i, z)
            last = i
        kept += 1
        for k in range(4):
            work.near[kept, k] = work.near[r, k]
    work.near[0, 0] = kept


@jit
def strike(model: Model, seen: Model, view: State, work: Work, space: Space, h: float) -> None:
    """Push the cars off the fixed bodies; after a step follow contacts, and who is in which area.

    ``h`` is the step, s; 0: forces anew. ``seen`` and ``view``: the model and the state with the
    cars' outlines from above, which are made here. Forces go onto ``space.qfrc``, their wrenches
    into ``space.wall``.
    """
    n = view.q.shape[0]
    for i in range(n):
        _outline(model, seen, view, space, i)
    if model.fixed.shape[0] > 0:
        list_near(seen, view, work, h)
        _drop_passed(model, view, work, space)
        work.force[:] = 0.0
        fixed_forces(seen, view, work, view.q, view.v)
        for i in range(n):
            fx = work.force[i, 0]
            fy = work.force[i, 1]
            w = space.wall[i]
            b = int(space.body[i].body)
            rx = view.q[i, 0] - space.xpos[b, 0]
            ry = view.q[i, 1] - space.xpos[b, 1]
            rz = space.level[i] - space.xpos[b, 2]
            w[0] = fx
            w[1] = fy
            w[2] = 0.0
            w[3] = -rz * fy
            w[4] = rz * fx
            w[5] = rx * fy - ry * fx + work.force[i, 2]
            cy = math.cos(view.q[i, 2])
            sy = math.sin(view.q[i, 2])
            turn = -space.span[i, 4] * abs(cy * fy - sy * fx)
            w[3] += turn * cy
            w[4] += turn * sy
            a = int(space.body[i].qvel)
            space.qfrc[a] += fx
            space.qfrc[a + 1] += fy
            if space.flat[0]:
                space.qfrc[a + 2] += w[5]
                continue
            m = space.xmat
            for k in range(3):
                space.qfrc[a + 3 + k] += m[b, k] * w[3] + m[b, 3 + k] * w[4] + m[b, 6 + k] * w[5]
        if h > 0.0:
            t = view.clock[0].t
            track_fixed(seen, view, work, t, h)
            bodies = model.fixed.shape[0]
            for p in range(view.struck.shape[0]):
                k = int(view.struck[p].contact)
                if k >= 0 and view.contact[k].peak_time == t:
                    space.height[k, 0] = space.level[p // bodies]
                    space.height[k, 1] = 0.0
    if h > 0.0 and model.area.shape[0] > 0:
        note_inside(seen, view)
