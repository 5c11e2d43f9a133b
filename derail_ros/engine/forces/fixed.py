"""Fixed bodies: walls, piers and buildings that cars strike.

Force: the law between cars (``laws.contact``, with ``held`` inside), as from a body that does not
move. A corner of a car is pushed along the normal of the nearest edge, or away from the nearest
corner of the body; a corner of the body pushes the side of the car that it meets. A body that
yields does so at its force F: the bell has F in the place of ``F_max`` where that is less, its top
is F at any speed, and how far it has been pushed in there (``state.dent``) stays. Each group of
edges gives way for good when it has taken its energy. Power: what the contacts take out.

``state.hold`` remembers for each corner on which side of which edge it is (side times one more
than the edge; 0 beyond the reach or past the end of a chain), so that it is pushed back to the
side it came from; for each corner of a body the sides of each car that it came in through.
"""

from __future__ import annotations

import math
from typing import Any

from derail_ros.engine import layout
from derail_ros.engine.arrays import F64, Model, Rows, State, Work
from derail_ros.engine.forces.collisions import clear, corner_of, speed_along
from derail_ros.engine.jit import inner_jit, jit, keep_separate
from derail_ros.engine.laws.contact import (
    FRONT,
    LEFT,
    REAR,
    gap_force,
    nearest_wall,
    outside_mask,
    speed_factor,
)
from derail_ros.engine.outlines import from_edge

TIE = 1e-18
"""Squared distances that differ less are those of one vertex, m^2."""


@inner_jit
def _apart(model: Model, q: F64, i: int, k: int, c: float, s: float) -> float:
    """Widest gap between car ``i`` and edge ``k`` along their axes, m; c, s: of the yaw."""
    edge = model.outline[k]
    half_l = model.car[i].half_l
    half_w = model.car[i].half_w
    dx = q[i, 0] - edge.x
    dy = q[i, 1] - edge.y
    cos = abs(c * edge.ux + s * edge.uy)
    sin = abs(c * edge.uy - s * edge.ux)
    along = dx * edge.ux + dy * edge.uy
    gap = abs(dy * edge.ux - dx * edge.uy) - half_l * sin - half_w * cos
    gap = max(gap, max(-along, along - edge.length) - half_l * cos - half_w * sin)
    u = -c * dx - s * dy
    w = s * dx - c * dy
    u2 = u + edge.length * (c * edge.ux + s * edge.uy)
    w2 = w + edge.length * (c * edge.uy - s * edge.ux)
    gap = max(gap, max(min(u, u2), -max(u, u2)) - half_l)
    return max(gap, max(min(w, w2), -max(w, w2)) - half_w)


@jit
def list_near(model: Model, state: State, work: Work, h: float) -> float:
    """List the fixed bodies, and their edges, that each car may touch within the step ``h``.

    Returns the step, or less: near a body no corner may move further than a step's share.
    """
    keep_separate()
    q = state.q
    v = state.v
    count = 0
    share = model.par[0].step_share
    buffer = model.par[0].buffer
    for i in range(q.shape[0]):
        if model.car[i].virtual != 0.0:
            continue
        x = q[i, 0]
        y = q[i, 1]
        speed = math.sqrt(v[i, 0] * v[i, 0] + v[i, 1] * v[i, 1])
        speed += abs(v[i, 2]) * model.car[i].radius
        room = 1.5 * buffer + 2.0 * share + h * speed
        reach = model.car[i].radius + room
        for b in range(model.fixed.shape[0]):
            row = model.fixed[b]
            if not (row.x0 - reach < x < row.x1 + reach and row.y0 - reach < y < row.y1 + reach):
                continue
            c = math.cos(q[i, 2])
            s = math.sin(q[i, 2])
            low = -1
            high = -1
            least = math.inf
            for k in range(int(row.first), int(row.last)):
                gap = _apart(model, q, i, k, c, s)
                least = min(least, gap)
                if gap < room:
                    low = k if low < 0 else low
                    high = k + 1
            if low < 0:
                continue
            count += 1
            work.near[count, 0] = i
            work.near[count, 1] = b
            work.near[count, 2] = low
            work.near[count, 3] = high
            way = share + max(0.0, least - buffer)
            if h * speed > way:
                h = way / speed
    work.near[0, 0] = count
    return h


@inner_jit
def _edge(row: Any, k: int) -> int:
    """Edge ``k`` of a body, counted round a polygon; -1 where a chain has none."""
    first = int(row.first)
    last = int(row.last)
    if row.closed != 0.0:
        return first + (k - first) % (last - first)
    return k if first <= k < last - 1 else -1


@inner_jit
def _nearest(
    model: Model, state: State, b: int, low: int, high: int, x: float, y: float
) -> tuple[int, float, float, float]:
    """Nearest edge of body ``b`` from ``low`` to before ``high``: (edge, squared distance, place,
    side), as ``from_edge``; edge -1 if all are gone.

    At a vertex the edge counts whose line is further away: its side is that of the bend.
    """
    best = -1
    least = math.inf
    at = 0.0
    side = 0.0
    for j in range(low, high):
        k = _edge(model.fixed[b], j)
        if k < 0:
            continue
        if state.group[int(model.outline[k].group)].gone != 0.0:
            continue
        d2, along, across = from_edge(model.outline, k, x, y)
        if d2 < least - TIE or (d2 <= least + TIE and abs(across) > abs(side)):
            best = k
            least = d2
            at = along
            side = across
    return best, least, at, side


@inner_jit
def _feature(
    model: Model, state: State, b: int, held: int, low: int, high: int, x: float, y: float
) -> tuple[int, float, float, float, int, int]:
    """What a corner of a car at (x, y) meets of body ``b``.

    Returns the edge (-1: nothing), the gap (m, negative behind it), the normal of the push, the
    corner of the body that is nearest (-1: a place along an edge), and the new ``held``.
    """
    outline = model.outline
    if held != 0 and state.group[int(outline[abs(held) - 1].group)].gone != 0.0:
        held = 0
    if held != 0:
        sign = 1.0 if held > 0 else -1.0
        k = abs(held) - 1
        k, d2, at, side = _nearest(model, state, b, k - 1, k + 2, x, y)
        if k < 0:
            return -1, 0.0, 0.0, 0.0, -1, 0
        if sign * side < 0.0:
            held = k + 1 if sign > 0.0 else -k - 1
            nx, ny = -sign * outline[k].uy, sign * outline[k].ux
            past_end = model.fixed[b].closed == 0.0 and (
                (at == 0.0 and k == model.fixed[b].first)
                or (at == outline[k].length and k == model.fixed[b].last - 2)
            )
            if not past_end:
                return k, -math.sqrt(d2), nx, ny, -1, held
    k, d2, at, side = _nearest(model, state, b, low, high, x, y)
    gap = math.sqrt(d2)
    if k < 0 or gap >= model.par[0].buffer:
        return -1, gap, 0.0, 0.0, -1, 0
    held = k + 1 if side > 0.0 else -k - 1
    if 0.0 < at < outline[k].length:
        sign = 1.0 if side > 0.0 else -1.0
        return k, gap, -sign * outline[k].uy, sign * outline[k].ux, -1, held
    vertex = k
    if at > 0.0:
        vertex = k + 1
        if vertex == model.fixed[b].last:
            vertex = int(model.fixed[b].first)
    if outline[vertex].bx == 0.0 and outline[vertex].by == 0.0:
        held = 0  # round the end of a chain
    if gap < 1e-12:
        return -1, gap, 0.0, 0.0, -1, held
    nx = (x - outline[vertex].x) / gap
    ny = (y - outline[vertex].y) / gap
    return k, gap, nx, ny, vertex, held


@inner_jit
def _law(model: Model, b: int, gap: float, closing: float) -> float:
    """Force of one corner on body ``b``, N."""
    par = model.par[0]
    most = model.fixed[b].force
    top = min(par.force_max, most)
    f = gap_force(gap, top, par.half_distance, par.buffer, int(par.gap_law), 0)
    return min(most, f * speed_factor(closing, par.c1, par.c2, par.c3))


@inner_jit
def _add(
    state: State, work: Work, q: F64, i: int, row: int, edge_group: int, corner: int,
    px: float, py: float, nx: float, ny: float, f: float, gap: float, closing: float,
) -> None:  # fmt: skip
    """Push car ``i`` with the force ``f`` along the normal, and keep it in the sums."""
    fx = f * nx
    fy = f * ny
    moment = (px - q[i, 0]) * fy - (py - q[i, 1]) * fx
    work.force[i, 0] += fx
    work.force[i, 1] += fy
    work.force[i, 2] += moment
    struck = state.struck[row]
    struck.fx += fx
    struck.fy += fy
    struck.power += f * closing
    state.group[edge_group].power += f * closing
    if f > struck.peak:
        struck.peak = f
        struck.corner = corner
        struck.x = px
        struck.y = py
        struck.nx = nx
        struck.ny = ny
        struck.closing = closing
    report = work.report
    if report.shape[0]:
        report[i, layout.R_COLLISION] += fx
        report[i, layout.R_COLLISION + 1] += fy
        report[i, layout.R_COLLISION + 2] += moment
        base = layout.R_CORNER + 4 * corner
        if f > report[i, base]:
            report[i, base] = f
            report[i, base + 1] = gap
            report[i, base + 2] = closing
            report[i, base + 3] = 0.0


@inner_jit
def beyond(car: Rows, q: F64, wk: Rows, i: int, corner: int, x: float, y: float) -> bool:
    """The place lies past the end and past the side of car ``i`` that meet at its corner."""
    u, w = corner_of(car, i, corner)
    dx = x - q[i, 0]
    dy = y - q[i, 1]
    along = wk[i].ct * dx + wk[i].st * dy
    across = wk[i].ct * dy - wk[i].st * dx
    return along * u > car[i].half_l * car[i].half_l and across * w > car[i].half_w * car[i].half_w


@inner_jit
def _corners(
    model: Model, state: State, work: Work, q: F64, v: F64, i: int, b: int, low: int, high: int
) -> None:
    """Contacts of the corners of car ``i`` with body ``b``."""
    keep_separate()
    wk = work.wk
    bodies = model.fixed.shape[0]
    for corner in range(4):
        u, w = corner_of(model.car, i, corner)
        px = q[i, 0] + wk[i].ct * u - wk[i].st * w
        py = q[i, 1] + wk[i].st * u + wk[i].ct * w
        slot = 4 * b + corner
        k, gap, nx, ny, vertex, _ = _feature(
            model, state, b, state.hold[i, slot], low, high, px, py
        )
        if k < 0:
            continue
        if vertex >= 0 and model.outline[vertex].corner != 0.0:
            x, y = model.outline[vertex].x, model.outline[vertex].y
            if not beyond(model.car, q, wk, i, corner, x, y):
                continue
        closing = -speed_along(v, q, i, px, py, nx, ny)
        f = _law(model, b, gap + state.dent[i, slot], closing)
        if f > 0.0:
            group = int(model.outline[k].group)
            _add(state, work, q, i, bodies * i + b, group, corner, px, py, nx, ny, f, gap, closing)


@inner_jit
def seen_from(q: F64, wk: Rows, i: int, x: float, y: float) -> tuple[float, float]:
    """A place along and across car ``i``, m."""
    dx = x - q[i, 0]
    dy = y - q[i, 1]
    return wk[i].ct * dx + wk[i].st * dy, wk[i].ct * dy - wk[i].st * dx


@inner_jit
def _vertices(
    model: Model, state: State, work: Work, q: F64, v: F64, i: int, b: int, low: int, high: int
) -> None:
    """Contacts of the corners of body ``b`` with the sides of car ``i``."""
    keep_separate()
    par = model.par[0]
    bodies = model.fixed.shape[0]
    half_l = model.car[i].half_l
    half_w = model.car[i].half_w
    ct = work.wk[i].ct
    st = work.wk[i].st
    for j in range(low, high + 1):
        k = j
        if j == int(model.fixed[b].last):
            break
        u, w = seen_from(q, work.wk, i, model.outline[k].x, model.outline[k].y)
        if abs(u) >= half_l + par.buffer or abs(w) >= half_w + par.buffer:
            continue
        row = model.outline[k]
        if row.corner == 0.0 or state.group[int(row.group)].gone != 0.0:
            continue
        wall = outside_mask(u, w, half_l, half_w)
        slot = 4 * bodies + k
        if wall == 0:
            wall = nearest_wall(u, w, half_l, half_w, state.hold[i, slot])
        nu = 0.0
        nw = 0.0
        if wall == FRONT or wall == REAR:
            nu = 1.0 if wall == FRONT else -1.0
            gap = nu * u - half_l
        elif (wall & (FRONT | REAR)) == 0:
            nw = 1.0 if wall == LEFT else -1.0
            gap = nw * w - half_w
        else:
            continue
        nx = -(ct * nu - st * nw)
        ny = -(st * nu + ct * nw)
        if row.bx * nx + row.by * ny < 0.0:  # bends away from that side of the car
            continue
        px = model.outline[k].x + gap * nx
        py = model.outline[k].y + gap * ny
        closing = -speed_along(v, q, i, px, py, nx, ny)
        f = _law(model, b, gap + state.dent[i, slot], closing)
        if f > 0.0:
            corner = (0 if u > 0.0 else 2) + (0 if w > 0.0 else 1)
            group = int(model.outline[k].group)
            _add(state, work, q, i, bodies * i + b, group, corner, px, py, nx, ny, f, gap, closing)


@inner_jit
def fixed_forces(model: Model, state: State, work: Work, q: F64, v: F64) -> None:
    """Add the forces of the bodies in ``work.near`` to ``work.force``; sums into ``state``."""
    keep_separate()
    bodies = model.fixed.shape[0]
    for g in range(state.group.shape[0]):
        state.group[g].power = 0.0
    for p in range(state.struck.shape[0]):
        if state.struck[p].peak != 0.0:
            clear(state.struck, p)
    power = 0.0
    for r in range(1, 1 + work.near[0, 0]):
        i = work.near[r, 0]
        b = work.near[r, 1]
        _corners(model, state, work, q, v, i, b, work.near[r, 2], work.near[r, 3])
        _vertices(model, state, work, q, v, i, b, work.near[r, 2], work.near[r, 3])
        power += state.struck[bodies * i + b].power
    work.power[layout.E_FIXED] = power


@inner_jit
def remember(model: Model, state: State, work: Work) -> None:
    """Keep for the accepted state what holds each corner, and how far bodies are pushed in."""
    keep_separate()
    q = state.q
    wk = work.wk
    bodies = model.fixed.shape[0]
    for r in range(1, 1 + work.near[0, 0]):
        i = work.near[r, 0]
        b = work.near[r, 1]
        yields = model.fixed[b].force < math.inf
        for corner in range(4):
            u, w = corner_of(model.car, i, corner)
            px = q[i, 0] + wk[i].ct * u - wk[i].st * w
            py = q[i, 1] + wk[i].st * u + wk[i].ct * w
            slot = 4 * b + corner
            k, gap, _, _, _, held = _feature(
                model, state, b, state.hold[i, slot], work.near[r, 2], work.near[r, 3], px, py
            )
            state.hold[i, slot] = held
            if k < 0:
                state.dent[i, slot] = 0.0
            elif yields:
                state.dent[i, slot] = max(state.dent[i, slot], -gap)
        for k in range(work.near[r, 2], min(work.near[r, 3] + 1, int(model.fixed[b].last))):
            slot = 4 * bodies + k
            u, w = seen_from(q, wk, i, model.outline[k].x, model.outline[k].y)
            half_l = model.car[i].half_l
            half_w = model.car[i].half_w
            out = outside_mask(u, w, half_l, half_w)
            if out == 0:
                out = nearest_wall(u, w, half_l, half_w, state.hold[i, slot])
                depth = half_l - abs(u) if out == FRONT or out == REAR else half_w - abs(w)
                if yields:
                    state.dent[i, slot] = max(state.dent[i, slot], depth)
            elif abs(u) > half_l + model.par[0].buffer or abs(w) > half_w + model.par[0].buffer:
                state.dent[i, slot] = 0.0
            state.hold[i, slot] = out
