"""Polygons and chains of segments (rows of ``layout.OUTLINE``): distances, and what touches them.

Edge k leads from vertex k to the next one; the last edge of a polygon leads to its first vertex,
the last vertex of a chain has an edge of no length.
"""

from __future__ import annotations

import math

import numpy as np

from derail_ros.engine import layout
from derail_ros.engine.arrays import F64, Rows
from derail_ros.engine.jit import jit

SHARP = math.radians(5.0)
"""A joint that turns less is no corner: what comes beside it touches the edges only."""


def outline_rows(points: F64, closed: bool, group: int) -> Rows:
    """Rows of one polygon, its vertices counter-clockwise, or of one chain.

    ``group`` is that of the polygon, or of the chain's first edge; each further edge has the next.
    """
    n = len(points)
    if closed:
        x, y = points.T
        if (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() < 0.0:
            points = points[::-1]
    rows = np.zeros(n, layout.OUTLINE)
    rows["x"], rows["y"] = points.T
    edges = np.roll(points, -1, axis=0) - points
    if not closed:
        edges[-1] = 0.0
    length = np.hypot(*edges.T)
    unit = np.divide(edges, length[:, None], out=np.zeros_like(edges), where=length[:, None] > 0)
    rows["ux"], rows["uy"] = unit.T
    rows["length"] = length
    before = np.roll(unit, 1, axis=0)
    turn = before[:, 0] * unit[:, 1] - before[:, 1] * unit[:, 0]
    along = (before * unit).sum(axis=1)
    # outward of the bend; a polygon's joints that bend inward touch nothing
    rows["bx"], rows["by"] = (before - unit).T
    rows["corner"] = np.abs(np.arctan2(turn, along)) > SHARP
    if closed:
        rows["corner"] *= turn > 0.0
    else:
        for end in (0, -1):
            rows["corner"][end] = 1.0
            rows["bx"][end] = rows["by"][end] = 0.0
    rows["group"] = group if closed else group + np.minimum(np.arange(n), max(n - 2, 0))
    return rows


@jit
def from_edge(outline: Rows, k: int, x: float, y: float) -> tuple[float, float, float]:
    """A place seen from edge ``k``: (squared distance, m^2; place of the foot along it, m; side).

    The foot lies within the edge; ``side`` is the signed distance from the edge's line, positive
    to its left, m.
    """
    dx = x - outline[k].x
    dy = y - outline[k].y
    along = dx * outline[k].ux + dy * outline[k].uy
    across = dy * outline[k].ux - dx * outline[k].uy
    over = along - min(max(along, 0.0), outline[k].length)
    return over * over + across * across, along - over, across


@jit
def holds(outline: Rows, first: int, last: int, x: float, y: float) -> bool:
    """The polygon holds the place."""
    odd = False
    k = last - 1
    for j in range(first, last):
        if (outline[j].y > y) != (outline[k].y > y):
            share = (y - outline[j].y) / (outline[k].y - outline[j].y)
            if x < outline[j].x + share * (outline[k].x - outline[j].x):
                odd = not odd
        k = j
    return odd


@jit
def depth(outline: Rows, first: int, last: int, x: float, y: float) -> float:
    """Distance from the border of a polygon, m, positive within it."""
    least = math.inf
    for k in range(first, last):
        least = min(least, from_edge(outline, k, x, y)[0])
    d = math.sqrt(least)
    return d if holds(outline, first, last, x, y) else -d


@jit
def meets(
    outline: Rows, row: Rows, z: int, x: float, y: float, c: float, s: float, a: float, b: float
) -> bool:
    """A rectangle and the polygon or chain in row ``z`` of ZONE, FIXED or AREA share a place.

    The rectangle has its centre at (x, y), half length a and half width b; c and s are cosine and
    sine of its direction.
    """
    far = a + b
    if x < row[z].x0 - far or x > row[z].x1 + far or y < row[z].y0 - far or y > row[z].y1 + far:
        return False
    first = int(row[z].first)
    last = int(row[z].last)
    for k in range(first, last):
        length = outline[k].length
        dx = outline[k].x - x
        dy = outline[k].y - y
        # the edge in the frame of the rectangle, clipped by its four sides
        low = 0.0
        high = length
        for axis in range(2):
            if axis == 0:
                p, g, half = c * dx + s * dy, c * outline[k].ux + s * outline[k].uy, a
            else:
                p, g, half = c * dy - s * dx, c * outline[k].uy - s * outline[k].ux, b
            if g == 0.0:
                if abs(p) > half:
                    low = math.inf
            else:
                t0 = (-half - p) / g
                t1 = (half - p) / g
                low = max(low, min(t0, t1))
                high = min(high, max(t0, t1))
        if low <= high:
            return True
    return row[z].closed != 0.0 and holds(outline, first, last, x, y)
