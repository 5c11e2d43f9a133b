"""Heights of the track: grades, and vertical curves between them.

The height z over the track coordinate s is made of pieces with a grade that changes linearly,

    z(s) = z0 + g0 (s - s0) + c (s - s0)^2 / 2

(c = 0 between vertical curves). The first piece reaches back and the last one on without end. A
car at s has the potential energy m g z(s); beside the track the ground is as high as the track.
"""

from __future__ import annotations

from derail_ros.engine.arrays import Rows
from derail_ros.engine.jit import jit


@jit
def height(grade: Rows, s: float) -> tuple[float, float]:
    """Height (m) and grade (rise per metre) at the track coordinate ``s`` (m)."""
    k = grade.shape[0] - 1
    while k > 0 and s < grade[k].s:
        k -= 1
    row = grade[k]
    u = s - row.s
    return row.z + (row.grade + 0.5 * row.change * u) * u, row.grade + row.change * u
