"""Track: the lateral forces that hold trucks on the rails, and their limit.

Constraint: each truck on the rails stays on the centre line (``engine.track``), one row of J a
truck; its multiplier is the lateral force of the rails, which does no work. Limit: a truck whose
lateral force exceeds its share of the weight times ``lv_limit`` leaves the rails. Moments: a truck
passes a rail break; a truck reaches its limit.
"""

from __future__ import annotations

import math

from derail_ros.engine.arrays import F64, Model, Rows, State, Work
from derail_ros.engine.interpolation import LOCATED, cubic_root
from derail_ros.engine.jit import inner_jit, keep_separate
from derail_ros.engine.track import locate

OVERLOAD = 1e-3
"""A lateral derailment is located to this, relative to the limit."""


@inner_jit
def truck_arm(car: Rows, i: int, k: int) -> float:
    """Place of truck ``k`` (0 front, 1 rear) of car ``i`` along its axis, m."""
    return car[i].truck if k == 0 else -car[i].truck


@inner_jit
def truck_rows(model: Model, state: State, work: Work, q: F64) -> None:
    """Rows of J, offsets and curvature terms of the trucks on the rails into ``work.wk``.

    Also moves ``state.truck_s`` to the foot points (for a straight track it is X).
    """
    keep_separate()
    wk = work.wk
    straight = model.track.shape[0] == 0
    for i in range(q.shape[0]):
        ct = wk[i].ct
        st = wk[i].st
        for k in range(2):
            if state.truck_on[i, k] == 0:
                continue
            r = truck_arm(model.car, i, k)
            row = work.row[i, k]
            x = q[i, 0] + r * ct
            y = q[i, 1] + r * st
            if straight:
                row.nx = 0.0
                row.ny = 1.0
                row.arm = r * ct
                row.curve = 0.0
                row.offset = y
                state.truck_s[i, k] = x
            else:
                s, d, h, kappa, _ = locate(model.track, x, y, state.truck_s[i, k])
                nx = -math.sin(h)
                ny = math.cos(h)
                row.nx = nx
                row.ny = ny
                row.arm = r * (ct * ny - st * nx)
                row.curve = kappa / (1.0 - kappa * d)
                row.offset = d
                state.truck_s[i, k] = s


@inner_jit
def truck_rate(v: F64, rows: Rows, i: int, k: int) -> float:
    """``J v`` of truck ``k`` of car ``i``: its speed along the track's left normal, m/s."""
    row = rows[i, k]
    return row.nx * v[i, 0] + row.ny * v[i, 1] + row.arm * v[i, 2]


@inner_jit
def _along(car: Rows, rows: Rows, v: F64, i: int, k: int, ct: float, st: float) -> float:
    """Speed of truck ``k`` of car ``i`` along the track, m/s, for the car's cos and sin of yaw."""
    row = rows[i, k]
    turn = truck_arm(car, i, k) * v[i, 2]
    return row.ny * (v[i, 0] - turn * st) - row.nx * (v[i, 1] + turn * ct)


@inner_jit
def truck_gamma(model: Model, state: State, work: Work, v: F64) -> None:
    """Trucks' part of ``gamma = -(dJ/dt) v`` into ``work.gamma_t``, m/s^2.

    The centripetal part of the truck's acceleration and the turning of the normal; with
    Baumgarte's terms unless positions are projected.
    """
    par = model.par[0]
    wk = work.wk
    stabilize = par.project == 0.0
    for i in range(v.shape[0]):
        ct = wk[i].ct
        st = wk[i].st
        for k in range(2):
            if state.truck_on[i, k] == 0:
                continue
            row = work.row[i, k]
            r2 = truck_arm(model.car, i, k) * v[i, 2] * v[i, 2]
            along = _along(model.car, work.row, v, i, k, ct, st)
            g = r2 * (row.nx * ct + row.ny * st)
            g += row.curve * along * along
            if stabilize:
                g -= par.baumgarte_v * truck_rate(v, work.row, i, k) + par.baumgarte_q * row.offset
            work.gamma_t[i, k] = g


@inner_jit
def lateral_limit(model: Model, i: int) -> float:
    """Lateral force at which a truck of car ``i`` leaves the rails, N; infinity if it never does.

    A virtual body never does.
    """
    if model.car[i].virtual != 0.0:
        return math.inf
    return model.par[0].lv_limit * 0.5 * model.par[0].gravity * model.car[i].mass


@inner_jit
def breaks_in_use(state: State) -> int:
    """Number of rail breaks: the unused rows are infinite and come last."""
    count = 0
    while count < state.breaks.shape[0] and state.breaks[count] < math.inf:
        count += 1
    return count


@inner_jit
def break_passed(state: State, work: Work, i: int, k: int) -> float:
    """Track coordinate of the break that truck ``k`` of car ``i`` passed in the last step, m.

    In either direction, or reached within ``LOCATED``; nan without one.
    """
    s0 = work.truck_s[i, k]
    s1 = state.truck_s[i, k]
    passed = math.nan
    for b in range(breaks_in_use(state)):
        sb = state.breaks[b]
        if (s1 > s0 and s0 <= sb <= s1 + LOCATED) or (s1 < s0 and s1 - LOCATED <= sb <= s0):
            passed = sb
    return passed


@inner_jit
def on_track(model: Model, state: State) -> bool:
    """Every truck on the rails lies within the alignment."""
    pieces = model.track.shape[0]
    if pieces == 0:
        return True
    first = model.track[0].s
    last = model.track[pieces - 1].s + model.track[pieces - 1].length
    for i in range(state.q.shape[0]):
        for k in range(2):
            if state.truck_on[i, k] and not first <= state.truck_s[i, k] <= last:
                return False
    return True


# Moments inside a step -----------------------------------------------------------------------


@inner_jit
def first_passing(model: Model, state: State, work: Work, h: float) -> float:
    """Share of the step ``h`` at which the first truck passes a rail break.

    The step's end is in ``work.stage_v``, ``state.truck_s`` and, with its truck rows, in
    ``work.wk``. 1.0 if none does, or only within ``LOCATED`` (m) of the end.
    """
    keep_separate()
    share = 1.0
    wk = work.wk
    breaks = breaks_in_use(state)
    if breaks == 0:
        return share
    for i in range(state.q.shape[0]):
        for k in range(2):
            if state.truck_on[i, k] == 0:
                continue
            s0 = work.truck_s[i, k]
            s1 = state.truck_s[i, k]
            sign = 1.0 if s1 > s0 else -1.0
            for b in range(breaks):
                g0 = sign * (s0 - state.breaks[b])
                g1 = sign * (s1 - state.breaks[b])
                if g0 > 0.0 or g1 <= LOCATED:
                    continue
                theta = state.q[i, 2]
                v0 = _along(model.car, work.row, state.v, i, k, math.cos(theta), math.sin(theta))
                v1 = _along(model.car, work.row, work.stage_v, i, k, wk[i].ct, wk[i].st)
                share = min(share, cubic_root(g0, sign * h * v0, g1, sign * h * v1))
    return share


@inner_jit
def first_overload(model: Model, state: State, work: Work) -> float:
    """Share of the step at which the first truck reaches its lateral limit, by the secant.

    Forces at the step's end are in ``work.lam_t``. 1.0 without one, or when the first is within
    ``OVERLOAD`` of the limit already; 0.0 when a truck is above it from the start, because
    another constraint has gone.
    """
    share = 1.0
    for i in range(state.q.shape[0]):
        limit = lateral_limit(model, i)
        for k in range(2):
            f1 = abs(work.lam_t[i, k])
            if state.truck_on[i, k] and f1 > limit * (1.0 + OVERLOAD):
                f0 = abs(state.rail_force[i, k])
                if f0 >= limit:
                    share = 0.0
                else:
                    share = min(share, (limit * (1.0 + 0.5 * OVERLOAD) - f0) / (f1 - f0))
    return share
