"""Accelerations of the constrained train, and projection onto its constraints."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from derail_ros.engine import layout as L
from derail_ros.engine.arrays import Model, State, Work
from derail_ros.engine.forces import applied_forces, collisions
from derail_ros.engine.jit import inner_jit, jit, keep_separate
from derail_ros.engine.solver import (
    acceleration_gamma,
    constraint_error,
    coupling_gap,
    coupling_rate,
    factor,
    solve,
    truck_rate,
    truck_rows,
)
from derail_ros.engine.trigonometry import angles

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]

PROJECTED = 1e-10
"""Constraint error at which the projection of positions stops, m."""

PLAIN, FACTORED, IMPLICIT = 0, 1, 2
"""How ``accelerations`` works: from scratch; with angles, truck rows and factors at ``q`` in
``work`` already; with the implicit friction of stiff cars (their masses in ``work``)."""


@jit
def accelerations(
    model: Model,
    state: State,
    work: Work,
    t: float,
    truck_on: U8,
    coupled: U8,
    q: F64,
    v: F64,
    out: F64,
    mode: int,
) -> bool:
    """Accelerations at ``(t, q, v)`` into ``out``, multipliers and powers into ``work``.

    ``mode`` is PLAIN, FACTORED or IMPLICIT. Returns False when the constraint equations are
    singular.
    """
    keep_separate()
    par = model.par
    car = model.car
    wk = work.wk
    force = work.force
    if mode != FACTORED:
        angles(q, wk, work.ang)
    applied_forces(
        par, car, model.knuckle, model.unit, model.unit_start, model.lateral, state.arrival,
        t, state.clock[L.T_ON], truck_on, coupled, q, v, wk, work.ground, force, work.power,
        work.report,
    )  # fmt: skip
    work.power[L.E_COLLISION] = collisions(
        par, car, state.pairs, state.mask, state.pair, work.active, q, v, wk, force, work.report
    )
    ok = True
    if mode != FACTORED:
        truck_rows(car, model.track, state.truck_s, truck_on, q, wk)
        ok = factor(car, truck_on, coupled, wk)
    if mode == IMPLICIT:
        for i in range(q.shape[0]):
            if wk[i, L.W_STIFF] != 0.0:
                sx = wk[i, L.W_SX]
                sy = wk[i, L.W_SY]
                sw = wk[i, L.W_SW]
                force[i, 0] -= wk[i, L.W_C] * sx + wk[i, L.W_C + 1] * sy + wk[i, L.W_C + 2] * sw
                force[i, 1] -= (
                    wk[i, L.W_C + 1] * sx + wk[i, L.W_C + 3] * sy + wk[i, L.W_C + 4] * sw
                )
                force[i, 2] -= (
                    wk[i, L.W_C + 2] * sx + wk[i, L.W_C + 4] * sy + wk[i, L.W_C + 5] * sw
                )
    acceleration_gamma(par, car, truck_on, coupled, q, v, wk, work.gamma_t, work.gamma_c)
    solve(
        car, truck_on, coupled, wk, force, work.gamma_t, work.gamma_c, out, work.lam_t, work.lam_c
    )
    state.cnt[L.EVALS] += 1
    return ok


@inner_jit
def no_force(force: F64) -> None:
    """Set all generalized forces to zero."""
    for i in range(force.shape[0]):
        for k in range(5):
            force[i, k] = 0.0


@inner_jit
def onto_constraints(
    model: Model, state: State, work: Work, truck_on: U8, coupled: U8, q: F64, reuse: bool
) -> bool:
    """The work of ``project_positions``; ``reuse`` takes the factors in ``work`` at first.

    Those are of a place nearby: Newton's method converges a little slower, and the error is
    checked after each of its steps all the same.
    """
    keep_separate()
    n = q.shape[0]
    car = model.car
    wk = work.wk
    factored = reuse
    for _ in range(12):
        angles(q, wk, work.ang)
        truck_rows(car, model.track, state.truck_s, truck_on, q, wk)
        gap, offset = constraint_error(car, truck_on, coupled, q, wk)
        # Beyond 1e5 m from the origin a double resolves no better than its own spacing.
        done = max(gap, offset) <= PROJECTED + 1e-15 * abs(q[0, 0])
        if done or not factored:
            if not factor(car, truck_on, coupled, wk):
                return False
        if done:
            return True
        factored = False
        for i in range(n):
            for k in range(2):
                if truck_on[i, k]:
                    work.gamma_t[i, k] = -wk[i, L.W_OFF + k]
            if i < n - 1 and coupled[i]:
                gx, gy = coupling_gap(car, q, wk, i)
                work.gamma_c[i, 0] = -gx
                work.gamma_c[i, 1] = -gy
        no_force(work.force)
        solve(
            car, truck_on, coupled, wk, work.force, work.gamma_t, work.gamma_c, work.dx,
            work.lam_t, work.lam_c,
        )  # fmt: skip
        for i in range(n):
            for k in range(5):
                q[i, k] += work.dx[i, k]
    return False


@jit
def project_positions(
    model: Model, state: State, work: Work, truck_on: U8, coupled: U8, q: F64
) -> bool:
    """Move ``q`` onto the constraints, as little as possible in the metric of the masses.

    Newton's method; leaves angles, truck rows and factors at ``q`` in ``work``. Returns False when
    it does not converge.
    """
    return onto_constraints(model, state, work, truck_on, coupled, q, False)


@jit
def project_velocities(model: Model, work: Work, truck_on: U8, coupled: U8, v: F64) -> None:
    """Move ``v`` onto the tangent of the constraints; uses the factors in ``work``."""
    keep_separate()
    n = v.shape[0]
    car = model.car
    wk = work.wk
    for i in range(n):
        for k in range(2):
            if truck_on[i, k]:
                work.gamma_t[i, k] = -truck_rate(v, wk, i, k)
        if i < n - 1 and coupled[i]:
            gx, gy = coupling_rate(car, v, wk, i)
            work.gamma_c[i, 0] = -gx
            work.gamma_c[i, 1] = -gy
    no_force(work.force)
    solve(
        car, truck_on, coupled, wk, work.force, work.gamma_t, work.gamma_c, work.dx, work.lam_t,
        work.lam_c,
    )  # fmt: skip
    for i in range(n):
        for k in range(5):
            v[i, k] += work.dx[i, k]
