"""Accelerations of the constrained train, and projection onto its constraints."""

from __future__ import annotations

import math

from derail_ros.engine import layout
from derail_ros.engine.arrays import F64, Model, State, Work
from derail_ros.engine.blocks import close_up, inside
from derail_ros.engine.forces.along import along_forces
from derail_ros.engine.forces.brakes import brake_forces
from derail_ros.engine.forces.collisions import collision_forces
from derail_ros.engine.forces.couplers import (
    coupler_forces,
    coupling_gamma,
    coupling_gap,
    coupling_rate,
)
from derail_ros.engine.forces.draft_gear import (
    add_gear_forces,
    add_telescoping,
    gear_forces,
    set_reach,
)
from derail_ros.engine.forces.fixed import fixed_forces
from derail_ros.engine.forces.ground import ground_forces
from derail_ros.engine.forces.guidance import guidance_forces
from derail_ros.engine.forces.pushes import push_forces
from derail_ros.engine.forces.track import truck_gamma, truck_rate, truck_rows, unmoved
from derail_ros.engine.jit import inner_jit, jit, keep_separate
from derail_ros.engine.solver import factor, solve
from derail_ros.engine.trigonometry import angles

PROJECTED = 1e-10
"""Constraint error at which the projection of positions stops, m."""

PLAIN, FACTORED, IMPLICIT = 0, 1, 2
"""How ``accelerations`` works: from scratch; with angles, truck rows and factors at ``q`` in
``work`` already; with the implicit friction of stiff cars (their masses in ``work``)."""


@inner_jit
def place(model: Model, state: State, work: Work, q: F64) -> None:
    """Cosines, sines and lengths of couplers at ``q`` into ``work.wk``."""
    angles(q, work.wk, work.ang, work.live)
    if model.par[0].gear != 0.0:
        set_reach(model, state, work, q)


@inner_jit
def constraint_gamma(model: Model, state: State, work: Work, q: F64, v: F64) -> None:
    """``gamma = -(dJ/dt) v`` of all constraints into ``work``."""
    keep_separate()
    truck_gamma(model, state, work, v)
    coupling_gamma(model, state, work, q, v)
    if model.par[0].gear != 0.0:
        for k in range(q.shape[0] - 1):
            if state.coupled[k]:
                add_telescoping(model, work, v, k)


@jit
def accelerations(
    model: Model, state: State, work: Work, t: float, q: F64, v: F64, out: F64, mode: int
) -> bool:
    """Accelerations at ``(t, q, v)`` into ``out``, multipliers and powers into ``work``.

    ``mode`` is PLAIN, FACTORED or IMPLICIT. Returns False when the constraint equations are
    singular.
    """
    keep_separate()
    wk = work.wk
    force = work.force
    geared = model.par[0].gear != 0.0
    if mode != FACTORED:
        place(model, state, work, q)
    for i in range(work.report.shape[0]):
        for k in range(layout.N_REPORT):
            work.report[i, k] = 0.0
    coupler_forces(model, state, work, q, v)
    brake_forces(model, state, work, t, v)
    ground_forces(model, state, work, q, v)
    push_forces(model, state, work, v)
    collision_forces(model, state, work, q, v)
    if model.fixed.shape[0] > 0:
        fixed_forces(model, state, work, q, v)
    if model.par[0].along != 0.0:
        along_forces(model, state, work, t, q, v)
    if model.par[0].guide_strength != 0.0:
        guidance_forces(model, state, work, q, v)
    if geared:
        gear_forces(model, state, work, v)
    ok = True
    if mode != FACTORED:
        truck_rows(model, state, work, q)
        ok = factor(model, state, work)
    if mode == IMPLICIT:
        for i in range(work.scope[0]):
            if wk[i].stiff != 0.0:
                sx = wk[i].sx
                sy = wk[i].sy
                sw = wk[i].sw
                force[i, 0] -= wk[i].c_xx * sx + wk[i].c_xy * sy + wk[i].c_xt * sw
                force[i, 1] -= wk[i].c_xy * sx + wk[i].c_yy * sy + wk[i].c_yt * sw
                force[i, 2] -= wk[i].c_xt * sx + wk[i].c_yt * sy + wk[i].c_tt * sw
        if work.scope[0] < q.shape[0]:
            h = work.head[work.scope[0]]
            force[h, 0] -= work.trial[0].damping * wk[h].sx
    constraint_gamma(model, state, work, q, v)
    solve(model, state, work, out)
    if geared:
        add_gear_forces(model, state, work)
    state.cnt[0].evaluations += 1
    return ok


@inner_jit
def constraint_error(model: Model, state: State, work: Work, q: F64) -> tuple[float, float]:
    """Largest coupler gap and largest truck offset, m (``truck_rows`` must have been called)."""
    gap = 0.0
    offset = 0.0
    for i in range(q.shape[0]):
        for k in range(2):
            if state.truck_on[i, k]:
                offset = max(offset, abs(work.row[i, k].offset))
        if i < q.shape[0] - 1 and state.coupled[i] and not inside(work, i):
            gx, gy = coupling_gap(model.car, q, work.wk, i)
            gap = max(gap, math.sqrt(gx * gx + gy * gy))
    return gap, offset


@inner_jit
def _move(model: Model, state: State, work: Work, x: F64) -> None:
    """Add to ``x`` the smallest change, in the metric of the masses, with ``J dx = gamma``."""
    n = x.shape[0]
    for i in range(n):
        for k in range(5):
            work.force[i, k] = 0.0
    solve(model, state, work, work.dx)
    for i in range(n):
        for k in range(5):
            x[i, k] += work.dx[i, k]


@inner_jit
def onto_constraints(model: Model, state: State, work: Work, q: F64, reuse: bool) -> bool:
    """The work of ``project_positions``; ``reuse`` takes the factors in ``work`` at first.

    Those are of a place nearby: Newton's method converges a little slower, and the error is
    checked after each of its steps all the same.
    """
    keep_separate()
    n = q.shape[0]
    wk = work.wk
    factored = reuse
    close_up(model, work, q)
    for _ in range(12):
        place(model, state, work, q)
        truck_rows(model, state, work, q)
        gap, offset = constraint_error(model, state, work, q)
        # Beyond 1e5 m from the origin a double resolves no better than its own spacing.
        done = max(gap, offset) <= PROJECTED + 1e-15 * abs(q[0, 0])
        if done or not factored:
            if not factor(model, state, work):
                return False
        if done:
            return True
        factored = False
        for i in range(n):
            # what stands untouched stays to the bit, whatever else is moved
            still = unmoved(model, state, q, i)
            for k in range(2):
                if state.truck_on[i, k]:
                    work.gamma_t[i, k] = 0.0 if still else -work.row[i, k].offset
            if i < n - 1 and state.coupled[i] and not inside(work, i):
                gx, gy = coupling_gap(model.car, q, wk, i)
                work.gamma_c[i, 0] = 0.0 if still else -gx
                work.gamma_c[i, 1] = 0.0 if still else -gy
        _move(model, state, work, q)
    return False


@jit
def project_positions(model: Model, state: State, work: Work, q: F64) -> bool:
    """Move ``q`` onto the constraints, as little as possible in the metric of the masses.

    Newton's method; leaves angles, truck rows and factors at ``q`` in ``work``. Returns False when
    it does not converge.
    """
    return onto_constraints(model, state, work, q, False)


@jit
def project_velocities(model: Model, state: State, work: Work, v: F64) -> None:
    """Move ``v`` onto the tangent of the constraints; uses the factors in ``work``."""
    keep_separate()
    n = v.shape[0]
    for i in range(n):
        for k in range(2):
            if state.truck_on[i, k]:
                work.gamma_t[i, k] = -truck_rate(v, work.row, i, k)
        if i < n - 1 and state.coupled[i] and not inside(work, i):
            gx, gy = coupling_rate(model.car, v, work.wk, i)
            work.gamma_c[i, 0] = -gx
            work.gamma_c[i, 1] = -gy
    _move(model, state, work, v)
