"""Draft gear: the force along a coupling, and breaking in tension.

Where it is chosen, the two draft gears of a coupling work as one in the rear coupler of the car
ahead, which telescopes: its length is ``car.rear + x`` (``wk.reach``), and of the two constraint
rows of the coupling only the one across that coupler stays. Force: ``laws.draft_gear`` along the
coupler, at its pivot and at the front face of the car behind. Its friction goes by the travel
since the last accepted state (``state.coupling``), so that a gear stands under a load. Power: what
friction takes. Energy: under the unloading line. A coupling breaks when its tension exceeds the
strength of its knuckle or coupler body, with draft gear or without. Moment: the first one does.
"""

from __future__ import annotations

import math

from derail_ros.engine import layout
from derail_ros.engine.arrays import F64, U8, Model, State, Work
from derail_ros.engine.forces.couplers import coupling_rate
from derail_ros.engine.jit import inner_jit, jit, keep_separate
from derail_ros.engine.laws.draft_gear import friction_share, loading, loading_energy

BROKEN = 1e-3
"""A coupling that breaks is located to this, relative to its strength."""


@inner_jit
def set_reach(model: Model, state: State, work: Work, q: F64) -> None:
    """Lengths of the rear couplers with their travel into ``work.wk`` (angles are there)."""
    car = model.car
    wk = work.wk
    for k in range(q.shape[0] - 1):
        a = wk[k]
        b = wk[k + 1]
        a.reach = car[k].rear
        if state.coupled[k]:
            dx = q[k, 0] - q[k + 1, 0] - car[k].pivot * a.ct
            dy = q[k, 1] - q[k + 1, 1] - car[k].pivot * a.st
            dx -= car[k + 1].pivot * b.ct + car[k + 1].front * b.ca
            dy -= car[k + 1].pivot * b.st + car[k + 1].front * b.sa
            a.reach = dx * a.cb + dy * a.sb


@inner_jit
def gear_force(model: Model, state: State, k: int, x: float) -> tuple[float, float, float]:
    """Tension of coupling ``k`` for a travel ``x`` (m), N; its part that comes back; the share."""
    link = model.link[k]
    side = 1.0 if x >= 0.0 else -1.0
    u = side * x - 0.5 * link.slack
    if u <= 0.0:
        return 0.0, 0.0, -1.0
    u0 = side * state.coupling[k].travel - 0.5 * link.slack
    p = friction_share(u, u0, state.coupling[k].share, link.transition)
    line = loading(u, link.preload, link.stiffness, link.transition)
    hard = link.solid * max(u - link.travel, 0.0)
    r = link.unloading
    back = r * line + hard
    return side * (line * (0.5 * (1.0 + r) + 0.5 * p * (1.0 - r)) + hard), side * back, p


@inner_jit
def gear_forces(model: Model, state: State, work: Work, v: F64) -> None:
    """Add the draft gears' forces at the velocities ``v`` to ``work.force``."""
    keep_separate()
    car = model.car
    wk = work.wk
    force = work.force
    lost = 0.0
    for k in range(v.shape[0] - 1):
        if state.coupled[k] == 0:
            continue
        a = wk[k]
        b = wk[k + 1]
        tension, back, _ = gear_force(model, state, k, a.reach - car[k].rear)
        rate_x, rate_y = coupling_rate(car, v, wk, k)
        lost += (tension - back) * (rate_x * a.cb + rate_y * a.sb)
        fx = tension * a.cb
        fy = tension * a.sb
        force[k, 0] -= fx
        force[k, 1] -= fy
        force[k, 2] += car[k].pivot * (a.ct * fy - a.st * fx)
        force[k + 1, 0] += fx
        force[k + 1, 1] += fy
        force[k + 1, 2] += car[k + 1].pivot * (b.ct * fy - b.st * fx)
        force[k + 1, 3] += car[k + 1].front * (b.ca * fy - b.sa * fx)
    work.power[layout.E_GEAR] = lost


@inner_jit
def add_gear_forces(model: Model, state: State, work: Work) -> None:
    """Add the draft gears' forces to ``work.lam_c``: a coupling's force on the car ahead."""
    for k in range(work.lam_c.shape[0]):
        if state.coupled[k]:
            a = work.wk[k]
            tension = gear_force(model, state, k, a.reach - model.car[k].rear)[0]
            work.lam_c[k, 0] -= tension * a.cb
            work.lam_c[k, 1] -= tension * a.sb


@inner_jit
def add_telescoping(model: Model, work: Work, v: F64, k: int) -> None:
    """Add to ``work.gamma_c`` what the travel of coupling ``k`` adds: ``2 beta' x'`` across it."""
    a = work.wk[k]
    rate_x, rate_y = coupling_rate(model.car, v, work.wk, k)
    turn = 2.0 * v[k, 4] * (rate_x * a.cb + rate_y * a.sb)
    work.gamma_c[k, 0] -= turn * a.sb
    work.gamma_c[k, 1] += turn * a.cb


@inner_jit
def keep_travel(model: Model, state: State, work: Work) -> None:
    """Remember the travel and the friction's share of the accepted state."""
    for k in range(state.coupling.shape[0]):
        if state.coupled[k]:
            x = work.wk[k].reach - model.car[k].rear
            share = gear_force(model, state, k, x)[2]
            row = state.coupling[k]
            row.travel0 = row.travel
            row.share0 = row.share
            row.travel = x
            row.share = share


@jit
def gear_energy(model: Model, coupled: U8, q: F64) -> float:
    """Energy now in the draft gears, J."""
    total = 0.0
    if model.par[0].gear == 0.0:
        return total
    car = model.car
    for k in range(coupled.shape[0]):
        if coupled[k] == 0:
            continue
        dx = q[k, 0] - car[k].pivot * math.cos(q[k, 2])
        dy = q[k, 1] - car[k].pivot * math.sin(q[k, 2])
        for arm, angle in ((car[k + 1].pivot, q[k + 1, 2]), (car[k + 1].front, q[k + 1, 3])):
            dx -= arm * math.cos(angle)
            dy -= arm * math.sin(angle)
        dx -= q[k + 1, 0]
        dy -= q[k + 1, 1]
        x = dx * math.cos(q[k, 4]) + dy * math.sin(q[k, 4]) - car[k].rear
        link = model.link[k]
        u = abs(x) - 0.5 * link.slack
        if u > 0.0:
            hard = max(u - link.travel, 0.0)
            total += link.unloading * loading_energy(
                u, link.preload, link.stiffness, link.transition
            )
            total += 0.5 * link.solid * hard * hard
    return total


# Breaking ------------------------------------------------------------------------------------


@inner_jit
def tension(q: F64, force: F64, k: int) -> float:
    """Tension along the rear coupler of car ``k``, N, for the force of the car behind on it."""
    return -(force[k, 0] * math.cos(q[k, 4]) + force[k, 1] * math.sin(q[k, 4]))


@inner_jit
def first_fracture(model: Model, state: State, work: Work) -> float:
    """Share of the step at which the first coupling reaches its strength, by the secant.

    As ``track.first_overload``, for the forces in ``work.lam_c`` at ``work.stage_q``.
    """
    share = 1.0
    for k in range(state.coupled.shape[0]):
        limit = model.link[k].strength
        f1 = tension(work.stage_q, work.lam_c, k)
        if state.coupled[k] and f1 > limit * (1.0 + BROKEN):
            f0 = tension(state.q, state.coupler_force, k)
            if f0 >= limit:
                share = 0.0
            else:
                share = min(share, (limit * (1.0 + 0.5 * BROKEN) - f0) / (f1 - f0))
    return share
