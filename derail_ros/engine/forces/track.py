"""Track: the lateral forces that hold trucks on the rails, and their limit.

Constraint: each truck on the rails stays on the centre line (``engine.track``), one row of J a
truck; its multiplier is the lateral force of the rails, which does no work. Limit: a truck whose
lateral force exceeds its share of the weight times ``lv_limit`` leaves the rails. Moments: a truck
passes a rail break; a truck reaches its limit.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from derail_ros.engine import layout as L
from derail_ros.engine.arrays import Model, State, Work
from derail_ros.engine.interpolation import LOCATED, cubic_root
from derail_ros.engine.jit import inner_jit, keep_separate
from derail_ros.engine.track import locate

F64 = NDArray[np.float64]

OVERLOAD = 1e-3
"""A lateral derailment is located to this, relative to the limit."""


@inner_jit
def truck_arm(car: F64, i: int, k: int) -> float:
    """Place of truck ``k`` (0 front, 1 rear) of car ``i`` along its axis, m."""
    return car[i, L.DT] if k == 0 else -car[i, L.DT]


@inner_jit
def truck_rows(model: Model, state: State, work: Work, q: F64) -> None:
    """Rows of J, offsets and curvature terms of the trucks on the rails into ``work.wk``.

    Also moves ``state.truck_s`` to the foot points (for a straight track it is X).
    """
    keep_separate()
    wk = work.wk
    straight = model.track.shape[0] == 0
    for i in range(q.shape[0]):
        ct = wk[i, L.W_CT]
        st = wk[i, L.W_ST]
        for k in range(2):
            if state.truck_on[i, k] == 0:
                continue
            r = truck_arm(model.car, i, k)
            row = L.W_TRUCK + 3 * k
            x = q[i, 0] + r * ct
            y = q[i, 1] + r * st
            if straight:
                wk[i, row] = 0.0
                wk[i, row + 1] = 1.0
                wk[i, row + 2] = r * ct
                wk[i, L.W_CURVE + k] = 0.0
                wk[i, L.W_OFF + k] = y
                state.truck_s[i, k] = x
            else:
                s, d, h, kappa, _ = locate(model.track, x, y, state.truck_s[i, k])
                nx = -math.sin(h)
                ny = math.cos(h)
                wk[i, row] = nx
                wk[i, row + 1] = ny
                wk[i, row + 2] = r * (ct * ny - st * nx)
                wk[i, L.W_CURVE + k] = kappa / (1.0 - kappa * d)
                wk[i, L.W_OFF + k] = d
                state.truck_s[i, k] = s


@inner_jit
def truck_rate(v: F64, wk: F64, i: int, k: int) -> float:
    """``J v`` of truck ``k`` of car ``i``: its speed along the track's left normal, m/s."""
    row = L.W_TRUCK + 3 * k
    return wk[i, row] * v[i, 0] + wk[i, row + 1] * v[i, 1] + wk[i, row + 2] * v[i, 2]


@inner_jit
def _along(car: F64, wk: F64, v: F64, i: int, k: int, ct: float, st: float) -> float:
    """Speed of truck ``k`` of car ``i`` along the track, m/s, for the car's cos and sin of yaw."""
    row = L.W_TRUCK + 3 * k
    turn = truck_arm(car, i, k) * v[i, 2]
    return wk[i, row + 1] * (v[i, 0] - turn * st) - wk[i, row] * (v[i, 1] + turn * ct)


@inner_jit
def truck_gamma(model: Model, state: State, work: Work, v: F64) -> None:
    """Trucks' part of ``gamma = -(dJ/dt) v`` into ``work.gamma_t``, m/s^2.

    The centripetal part of the truck's acceleration and the turning of the normal; with
    Baumgarte's terms unless positions are projected.
    """
    par = model.par
    wk = work.wk
    stabilize = par[L.PROJECT] == 0.0
    for i in range(v.shape[0]):
        ct = wk[i, L.W_CT]
        st = wk[i, L.W_ST]
        for k in range(2):
            if state.truck_on[i, k] == 0:
                continue
            row = L.W_TRUCK + 3 * k
            r2 = truck_arm(model.car, i, k) * v[i, 2] * v[i, 2]
            along = _along(model.car, wk, v, i, k, ct, st)
            g = r2 * (wk[i, row] * ct + wk[i, row + 1] * st)
            g += wk[i, L.W_CURVE + k] * along * along
            if stabilize:
                g -= par[L.B_VEL] * truck_rate(v, wk, i, k) + par[L.B_POS] * wk[i, L.W_OFF + k]
            work.gamma_t[i, k] = g


@inner_jit
def lateral_limit(model: Model, i: int) -> float:
    """Lateral force at which a truck of car ``i`` leaves the rails, N; infinity if it never does.

    A virtual body never does.
    """
    if model.car[i, L.VIRTUAL] != 0.0:
        return math.inf
    return model.par[L.LV_LIMIT] * 0.5 * model.par[L.GRAVITY] * model.car[i, L.MASS]


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
    first = model.track[0, L.TR_S]
    last = model.track[pieces - 1, L.TR_S] + model.track[pieces - 1, L.TR_LEN]
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
                v0 = _along(model.car, wk, state.v, i, k, math.cos(theta), math.sin(theta))
                v1 = _along(model.car, wk, work.stage_v, i, k, wk[i, L.W_CT], wk[i, L.W_ST])
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
