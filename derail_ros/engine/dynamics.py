"""Accelerations of the constrained train, and projection onto its constraints."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from derail_ros.engine import layout as L
from derail_ros.engine.arrays import Model, State, Work
from derail_ros.engine.forces import generalized_forces
from derail_ros.engine.jit import jit, keep_separate
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
    factored: bool,
) -> bool:
    """Accelerations at ``(t, q, v)`` into ``out``, multipliers and powers into ``work``.

    ``factored`` says that truck rows and factors at ``q`` are in ``work`` already. Returns False
    when the constraint equations are singular.
    """
    keep_separate()
    generalized_forces(model, state, work, t, truck_on, coupled, q, v)
    ok = True
    if not factored:
        truck_rows(model, state, truck_on, q, work.wk)
        ok = factor(model, truck_on, coupled, work.wk)
    acceleration_gamma(model, truck_on, coupled, q, v, work.wk, work.gamma_t, work.gamma_c)
    solve(
        model,
        truck_on,
        coupled,
        work.wk,
        work.force,
        work.gamma_t,
        work.gamma_c,
        out,
        work.lam_t,
        work.lam_c,
    )
    state.cnt[L.EVALS] += 1
    return ok


@jit
def project_positions(
    model: Model, state: State, work: Work, truck_on: U8, coupled: U8, q: F64
) -> bool:
    """Move ``q`` onto the constraints, as little as possible in the metric of the masses.

    Newton's method; leaves angles, truck rows and factors at ``q`` in ``work``. Returns False when
    it does not converge.
    """
    keep_separate()
    n = q.shape[0]
    for _ in range(12):
        angles(q, work.wk)
        truck_rows(model, state, truck_on, q, work.wk)
        if not factor(model, truck_on, coupled, work.wk):
            return False
        gap, offset = constraint_error(model, truck_on, coupled, q, work.wk)
        # Beyond 1e5 m from the origin a double resolves no better than its own spacing.
        if max(gap, offset) <= PROJECTED + 1e-15 * abs(q[0, 0]):
            return True
        for i in range(n):
            for k in range(2):
                if truck_on[i, k]:
                    work.gamma_t[i, k] = -work.wk[i, L.W_OFF + k]
            if i < n - 1 and coupled[i]:
                gx, gy = coupling_gap(model, q, work.wk, i)
                work.gamma_c[i, 0] = -gx
                work.gamma_c[i, 1] = -gy
        work.force[:] = 0.0
        solve(
            model, truck_on, coupled, work.wk, work.force, work.gamma_t, work.gamma_c,
            work.dx, work.lam_t, work.lam_c,
        )  # fmt: skip
        for i in range(n):
            for k in range(5):
                q[i, k] += work.dx[i, k]
    return False


@jit
def project_velocities(model: Model, work: Work, truck_on: U8, coupled: U8, v: F64) -> None:
    """Move ``v`` onto the tangent of the constraints; uses the factors in ``work``."""
    keep_separate()
    n = v.shape[0]
    for i in range(n):
        for k in range(2):
            if truck_on[i, k]:
                work.gamma_t[i, k] = -truck_rate(v, work.wk, i, k)
        if i < n - 1 and coupled[i]:
            gx, gy = coupling_rate(model, v, work.wk, i)
            work.gamma_c[i, 0] = -gx
            work.gamma_c[i, 1] = -gy
    work.force[:] = 0.0
    solve(
        model, truck_on, coupled, work.wk, work.force, work.gamma_t, work.gamma_c,
        work.dx, work.lam_t, work.lam_c,
    )  # fmt: skip
    for i in range(n):
        for k in range(5):
            v[i, k] += work.dx[i, k]
