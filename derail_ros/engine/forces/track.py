"""Track: the lateral forces that hold trucks on the rails, and their limit.

Constraint: each truck on the rails stays on the centre line (``engine.track``), one row of J a
truck; its multiplier is the lateral force of the rails, which does no work. Limit: a truck whose
lateral force exceeds its share of the weight times ``lv_limit`` leaves the rails. Where trucks
have play between the rails (``truck_play``), what cars that stand askew in it press sideways in
buff counts too (``askew_load``). Moments: a truck passes a rail break; a truck reaches its limit.
"""

from __future__ import annotations

import math

from derail_ros.engine.arrays import F64, Model, Rows, State, Work
from derail_ros.engine.forces.draft_gear import tension
from derail_ros.engine.interpolation import LOCATED, cubic_root
from derail_ros.engine.jit import inner_jit, keep_separate
from derail_ros.engine.track import locate
from derail_ros.engine.trigonometry import sincos

OVERLOAD = 1e-3
"""A lateral derailment is located to this, relative to the limit."""


@inner_jit
def truck_arm(car: Rows, i: int, k: int) -> float:
    """Place of truck ``k`` (0 front, 1 rear) of car ``i`` along its axis, m."""
    return car[i].truck if k == 0 else -car[i].truck


@inner_jit
def standing(model: Model, i: int) -> bool:
    """Car ``i`` is not the train's own: it stands, or stood, on a second track."""
    return i >= model.par[0].train


@inner_jit
def locate_on(
    model: Model, i: int, x: float, y: float, s: float
) -> tuple[float, float, float, float, float]:
    """``locate`` on the track of car ``i``; a second track goes on beyond its ends."""
    if standing(model, i):
        own = model.side[int(model.car[i].line) : int(model.car[i].line_end)]
        return locate(own, x, y, s)
    return locate(model.track, x, y, s)


@inner_jit
def unmoved(model: Model, state: State, q: F64, i: int) -> bool:
    """Car ``i`` stands on a second track and is to the bit where the accepted state has it."""
    if not standing(model, i):
        return False
    for k in range(5):
        if q[i, k] != state.q[i, k]:
            return False
    return True


@inner_jit
def truck_rows(model: Model, state: State, work: Work, q: F64) -> None:
    """Rows of J, offsets and curvature terms of the trucks on the rails into ``work.wk``.

    Also moves ``state.truck_s`` to the foot points (for a straight track it is X).
    """
    keep_separate()
    wk = work.wk
    straight = model.track.shape[0] == 0
    for i in range(work.scope[0]):
        if work.bound[i]:
            state.truck_s[i, 0] = q[i, 0] + model.car[i].truck
            state.truck_s[i, 1] = q[i, 0] - model.car[i].truck
            continue
        ct = wk[i].ct
        st = wk[i].st
        for k in range(2):
            if state.truck_on[i, k] == 0:
                continue
            r = truck_arm(model.car, i, k)
            row = work.row[i, k]
            x = q[i, 0] + r * ct
            y = q[i, 1] + r * st
            if straight and not standing(model, i):
                row.nx = 0.0
                row.ny = 1.0
                row.arm = r * ct
                row.curve = 0.0
                row.offset = y
                state.truck_s[i, k] = x
            else:
                s, d, h, kappa, _ = locate_on(model, i, x, y, state.truck_s[i, k])
                turn, ny = sincos(h)
                nx = -turn
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
    for a in range(1, 1 + work.live[0]):
        i = work.live[a]
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
def askew_load(model: Model, state: State, q: F64, force: F64, i: int, k: int) -> float:
    """Lateral force on truck ``k`` of car ``i``, N, as cars in buff stand askew in their play.

    With their trucks on opposite rails the cars lie like the teeth of a saw. A coupling between
    the cars a and b, its bar of the length l between the pivots, then leans by the angle

        phi = p (d_P,a / d_T,a + d_P,b / d_T,b) / l

    and pushes the pivots aside with phi times its buff, which the car's two trucks bear as on a
    beam. The motion knows nothing of it: cars stay on the line. ``force`` is of the couplings, N.
    """
    car = model.car
    load = 0.0
    for end in range(2):
        c = i - 1 + end
        if c < 0 or c >= force.shape[0] or state.coupled[c] == 0:
            continue
        buff = -tension(q, force, c)
        if buff <= 0.0:
            continue
        a = car[c]
        b = car[c + 1]
        lean = (a.pivot / a.truck + b.pivot / b.truck) / (a.rear + b.front)
        arm = car[i].pivot + car[i].truck if end == k else car[i].pivot - car[i].truck
        load += buff * model.par[0].truck_play * lean * arm / (2.0 * car[i].truck)
    return load


@inner_jit
def lateral_load(
    model: Model, state: State, q: F64, rail: F64, force: F64, i: int, k: int
) -> float:
    """Lateral force that counts against the limit of truck ``k`` of car ``i``, N."""
    load = abs(rail[i, k])
    if model.par[0].truck_play != 0.0:
        load += askew_load(model, state, q, force, i, k)
    return load


@inner_jit
def breaks_in_use(state: State) -> int:
    """Number of rail breaks: the unused rows are infinite and come last."""
    count = 0
    while count < state.breaks.shape[0] and state.breaks[count] < math.inf:
        count += 1
    return count


@inner_jit
def break_passed(model: Model, state: State, work: Work, i: int, k: int) -> float:
    """Track coordinate of the break that truck ``k`` of car ``i`` passed in the last step, m.

    In either direction, or reached within ``LOCATED``; nan without one.
    """
    if standing(model, i):
        return math.nan
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
    for i in range(int(model.par[0].train)):
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
    for i in range(int(model.par[0].train)):
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
            if state.truck_on[i, k] == 0:
                continue
            f1 = lateral_load(model, state, work.stage_q, work.lam_t, work.lam_c, i, k)
            if f1 > limit * (1.0 + OVERLOAD):
                f0 = lateral_load(
                    model, state, state.q, state.rail_force, state.coupler_force, i, k
                )
                if f0 >= limit:
                    share = 0.0
                else:
                    share = min(share, (limit * (1.0 + 0.5 * OVERLOAD) - f0) / (f1 - f0))
    return share
