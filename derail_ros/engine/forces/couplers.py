"""Couplers: strikers, knuckles, and the joint of two mated couplers.

Force: a striker holds its coupler body in the middle with a spring and a damper
(``laws.striker``); two mated knuckles resist the angle between their couplers (``laws.knuckle``,
or ``laws.joint`` where the moment is held). Power: what the dampers take out. Energy: what springs
and knuckles store. Constraint: the mated faces of a coupling coincide, two rows of J a coupling.
Moments: a spring or knuckle begins or ceases to work; a coupling reaches its limit angle.
"""

from __future__ import annotations

import math

from derail_ros.engine import layout
from derail_ros.engine.arrays import F64, U8, Model, Rows, State, Work
from derail_ros.engine.interpolation import LOCATED, cubic_root
from derail_ros.engine.jit import inner_jit, jit, keep_separate
from derail_ros.engine.laws.joint import joint_energy, joint_moment
from derail_ros.engine.laws.knuckle import knuckle_energy, knuckle_moment
from derail_ros.engine.laws.striker import spring_energy, spring_force


@inner_jit
def _moment(model: Model, i: int, angle: float) -> float:
    """Moment of the knuckles behind car ``i`` on its rear coupler, N m."""
    kn = model.knuckle
    if model.par[0].joint_held != 0.0:
        return joint_moment(
            angle, kn[i].c0, kn[i].c1, kn[i].c2, kn[i].root,
            kn[i].widening, kn[i].top,
        )  # fmt: skip
    return knuckle_moment(angle, kn[i].c0, kn[i].c1, kn[i].c2, kn[i].root)


@inner_jit
def _energy(model: Model, i: int, angle: float) -> float:
    """Energy in the knuckles behind car ``i``, J."""
    kn = model.knuckle
    if model.par[0].joint_held != 0.0:
        return joint_energy(
            angle, kn[i].c0, kn[i].c1, kn[i].c2, kn[i].root,
            kn[i].widening, kn[i].top,
        )  # fmt: skip
    return knuckle_energy(angle, kn[i].c0, kn[i].c1, kn[i].c2, kn[i].root)


@inner_jit
def _striker(striker: Rows, q: F64, v: F64, i: int, end: int) -> tuple[float, float]:
    """Force of a striker of car ``i`` (``end`` 0 front, 1 rear), N, and its damper's power, W."""
    s = striker[i, end]
    x = s.arm * (q[i, 3 + end] - q[i, 2])
    rate = s.arm * (v[i, 3 + end] - v[i, 2])
    spring = spring_force(x, s.free, s.opening, s.k1, s.k2)
    return spring + s.damping * rate, s.damping * rate * rate


@inner_jit
def coupler_forces(model: Model, state: State, work: Work, q: F64, v: F64) -> None:
    """Set ``work.force`` to the forces of strikers and knuckles."""
    keep_separate()
    n = work.scope[0]
    striker = model.striker
    force = work.force
    report = work.report
    reporting = report.shape[0] > 0
    power = 0.0
    for i in range(n):
        for k in range(5):
            force[i, k] = 0.0
    for a in range(1, 1 + work.live[0]):
        i = work.live[a]
        front, lost_front = _striker(striker, q, v, i, 0)
        rear, lost_rear = _striker(striker, q, v, i, 1)
        power += lost_front
        power += lost_rear
        arm_front = striker[i, 0].arm
        arm_rear = striker[i, 1].arm
        force[i, 2] = arm_front * front + arm_rear * rear
        force[i, 3] = -arm_front * front
        force[i, 4] = -arm_rear * rear
        if reporting:
            report[i, layout.R_STRIKER] = front
            report[i, layout.R_STRIKER + 1] = rear
    for i in range(n - 1):
        if state.coupled[i] and work.head[i + 1] > i:
            moment = _moment(model, i, q[i, 4] - q[i + 1, 3])
            force[i, 4] += moment
            force[i + 1, 3] -= moment
            if reporting:
                report[i, layout.R_KNUCKLE] = moment
    work.power[layout.E_DAMPER] = power


@jit
def coupler_energy(model: Model, coupled: U8, q: F64) -> tuple[float, float]:
    """Energy now in the striker springs and in the knuckles, J."""
    striker = 0.0
    knuckle = 0.0
    n = q.shape[0]
    for i in range(n):
        for end in range(2):
            s = model.striker[i, end]
            x = s.arm * (q[i, 3 + end] - q[i, 2])
            striker += spring_energy(x, s.free, s.opening, s.k1, s.k2)
        if i < n - 1 and coupled[i]:
            knuckle += _energy(model, i, q[i, 4] - q[i + 1, 3])
    return striker, knuckle


# The joint -----------------------------------------------------------------------------------


@inner_jit
def rear_rate(car: Rows, v: F64, wk: Rows, k: int) -> tuple[float, float]:
    """Velocity of the rear face of car ``k``, m/s."""
    return (
        v[k, 0] + car[k].pivot * wk[k].st * v[k, 2] + wk[k].reach * wk[k].sb * v[k, 4],
        v[k, 1] - car[k].pivot * wk[k].ct * v[k, 2] - wk[k].reach * wk[k].cb * v[k, 4],
    )


@inner_jit
def front_rate(car: Rows, v: F64, wk: Rows, k: int) -> tuple[float, float]:
    """Velocity of the front face of car ``k``, m/s."""
    return (
        v[k, 0] - car[k].pivot * wk[k].st * v[k, 2] - car[k].front * wk[k].sa * v[k, 3],
        v[k, 1] + car[k].pivot * wk[k].ct * v[k, 2] + car[k].front * wk[k].ca * v[k, 3],
    )


@inner_jit
def coupling_rate(car: Rows, v: F64, wk: Rows, k: int) -> tuple[float, float]:
    """``J v`` of coupling ``k``: rear face of car ``k`` less front face of ``k + 1``, m/s."""
    bx, by = rear_rate(car, v, wk, k)
    fx, fy = front_rate(car, v, wk, k + 1)
    return bx - fx, by - fy


@inner_jit
def coupling_gap(car: Rows, q: F64, wk: Rows, k: int) -> tuple[float, float]:
    """Rear face of car ``k`` less front face of car ``k + 1``, m."""
    gx = (
        q[k, 0]
        - q[k + 1, 0]
        - car[k].pivot * wk[k].ct
        - wk[k].reach * wk[k].cb
        - car[k + 1].pivot * wk[k + 1].ct
        - car[k + 1].front * wk[k + 1].ca
    )
    gy = (
        q[k, 1]
        - q[k + 1, 1]
        - car[k].pivot * wk[k].st
        - wk[k].reach * wk[k].sb
        - car[k + 1].pivot * wk[k + 1].st
        - car[k + 1].front * wk[k + 1].sa
    )
    return gx, gy


@inner_jit
def coupling_gamma(model: Model, state: State, work: Work, q: F64, v: F64) -> None:
    """Couplings' part of ``gamma = -(dJ/dt) v`` into ``work.gamma_c``, m/s^2.

    With Baumgarte's terms unless positions are projected.
    """
    par = model.par[0]
    car = model.car
    wk = work.wk
    stabilize = par.project == 0.0
    for k in range(work.scope[0] - 1):
        if state.coupled[k] == 0 or work.head[k + 1] <= k:
            continue
        w1 = car[k].pivot * v[k, 2] * v[k, 2]
        w2 = wk[k].reach * v[k, 4] * v[k, 4]
        w3 = car[k + 1].pivot * v[k + 1, 2] * v[k + 1, 2]
        w4 = car[k + 1].front * v[k + 1, 3] * v[k + 1, 3]
        gx = -(w1 * wk[k].ct + w2 * wk[k].cb + w3 * wk[k + 1].ct + w4 * wk[k + 1].ca)
        gy = -(w1 * wk[k].st + w2 * wk[k].sb + w3 * wk[k + 1].st + w4 * wk[k + 1].sa)
        if stabilize:
            rx, ry = coupling_rate(car, v, wk, k)
            px, py = coupling_gap(car, q, wk, k)
            gx -= par.baumgarte_v * rx + par.baumgarte_q * px
            gy -= par.baumgarte_v * ry + par.baumgarte_q * py
        work.gamma_c[k, 0] = gx
        work.gamma_c[k, 1] = gy


# Moments inside a step -----------------------------------------------------------------------

KINK = 0.002
"""A spring that begins or ends within a step counts as located below this share of ``F_max``."""


@inner_jit
def first_limit(model: Model, state: State, work: Work, h: float) -> float:
    """Share of the step ``h`` at which the first coupling reaches its limit angle.

    The step's end is in ``work.stage_q/v``. 1.0 if none does, or only within ``LOCATED`` (rad) of
    the end.
    """
    share = 1.0
    for i in range(state.q.shape[0] - 1):
        if state.coupled[i] == 0:
            continue
        n0 = state.q[i, 4] - state.q[i + 1, 3]
        n1 = work.stage_q[i, 4] - work.stage_q[i + 1, 3]
        g0 = abs(n0) - model.knuckle[i].limit
        g1 = abs(n1) - model.knuckle[i].limit
        if g1 > LOCATED and g0 <= 0.0:
            d0 = h * math.copysign(1.0, n0) * (state.v[i, 4] - state.v[i + 1, 3])
            d1 = h * math.copysign(1.0, n1) * (work.stage_v[i, 4] - work.stage_v[i + 1, 3])
            share = min(share, cubic_root(g0, d0, g1, d1))
    return share


@inner_jit
def _engages(
    x0: float, d0: float, x1: float, d1: float, start: float, stiffness: float, force: float
) -> float:
    """Share of the step at which ``|x|`` passes ``start``, either way; 1.0 if it may stand.

    ``d0`` and ``d1`` are the slopes of x times the step. The step may stand if the spring's force
    beyond ``start``, or what it lacks to begin, is below ``force`` at either end.
    """
    on = 1.0 if abs(x1) > abs(x0) and x1 > 0.0 or abs(x1) <= abs(x0) and x0 > 0.0 else -1.0
    g0 = on * x0 - start
    g1 = on * x1 - start
    if (g0 > 0.0) == (g1 > 0.0):
        return 1.0
    most = force / stiffness
    if g1 > most and g0 < -most:
        return cubic_root(g0, on * d0, g1, on * d1)
    if g1 < -most and g0 > most:
        return cubic_root(-g0, -on * d0, -g1, -on * d1)
    return 1.0


@inner_jit
def first_kink(model: Model, state: State, work: Work, h: float) -> float:
    """Share of the step at which the first striker or knuckle begins or ceases to work.

    Their forces have a kink there, which limits the order of a step with stiff strikers.
    """
    keep_separate()
    knuckle = model.knuckle
    q0 = state.q
    v0 = state.v
    q1 = work.stage_q
    v1 = work.stage_v
    force = KINK * model.par[0].force_max
    share = 1.0
    n = q0.shape[0]
    for a in range(1, 1 + work.live[0]):
        i = work.live[a]
        for end in range(2):
            s = model.striker[i, end]
            arm = s.arm
            x0 = arm * (q0[i, 3 + end] - q0[i, 2])
            d0 = h * arm * (v0[i, 3 + end] - v0[i, 2])
            x1 = arm * (q1[i, 3 + end] - q1[i, 2])
            d1 = h * arm * (v1[i, 3 + end] - v1[i, 2])
            share = min(share, _engages(x0, d0, x1, d1, s.opening, s.k2, force))
            if s.free > 0.0:
                share = min(share, _engages(x0, d0, x1, d1, s.free, s.k1, force))
        if i < n - 1 and state.coupled[i]:
            root = knuckle[i].root
            slope = abs(knuckle[i].c1 + 2.0 * knuckle[i].c2 * root)
            share = min(share, _engages(
                q0[i, 4] - q0[i + 1, 3], h * (v0[i, 4] - v0[i + 1, 3]),
                q1[i, 4] - q1[i + 1, 3], h * (v1[i, 4] - v1[i + 1, 3]),
                root, slope, force,
            ))  # fmt: skip
    return share
