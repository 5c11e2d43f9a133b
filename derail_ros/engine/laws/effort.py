"""Effort of a locomotive: its largest effort over speed, and the share of it that is set.

The largest tractive effort and the largest effort of the dynamic brake are lines through points,
constant beyond the ends. A notch n of 8 sets the share n / 8 of it (assumed: engines differ), and
the share changes at a limited rate.
"""

from __future__ import annotations

from derail_ros.engine.arrays import Rows
from derail_ros.engine.jit import jit


@jit
def effort_at(effort: Rows, first: int, last: int, v: float) -> float:
    """Effort, N, at the speed ``v`` >= 0 (m/s), of the points ``first`` to ``last - 1``."""
    if last <= first:
        return 0.0
    k = first
    while k < last - 1 and effort[k + 1].speed < v:
        k += 1
    a = effort[k]
    if k == last - 1 or v <= a.speed:
        return a.force
    b = effort[k + 1]
    return a.force + (b.force - a.force) * (v - a.speed) / (b.speed - a.speed)


@jit
def share_at(setting: Rows, first: int, last: int, t: float) -> float:
    """Share of the largest effort at the time ``t`` (s): above 0 tractive, below 0 dynamic."""
    k = first
    while k < last - 1 and setting[k + 1].time <= t:
        k += 1
    a = setting[k]
    if k == last - 1 or t <= a.time:
        return a.share
    b = setting[k + 1]
    return a.share + (b.share - a.share) * (t - a.time) / (b.time - a.time)
