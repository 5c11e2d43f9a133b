"""Friction near rest, taken implicitly.

Near rest the smoothed friction of ground and brakes relaxes velocities within a millisecond, which
holds an explicit method to steps of that size long after all else has become slow. A W-method,

    k_i = f(y + h sum_j alpha_ij k_j) + h A (gamma k_i + sum_j gamma_ij k_j)
    y_new = y + h sum_i b_i k_i

keeps the order of its conditions for *any* matrix A, so A may hold just what is stiff: minus the
derivative C of the friction forces by the velocities, one symmetric 3 x 3 block a car, frozen over
the step, and only for the cars whose friction is fast compared with the step. Where A is zero the
explicit method (alpha, b) remains, at its full order.

With the constraints, a stage is one solve with ``M + h gamma C`` in the place of M,

    (M + h gamma C) k_i = Q(y_i) - h C sum_j gamma_ij k_j + J^T lambda,    J k_i = gamma(y_i)

so that an implicit stage costs what an explicit one does. Source of W-methods: T. Steihaug and
A. Wolfbrandt, Math. Comp. 33 (1979).
"""

from __future__ import annotations

import math

from derail_ros.engine.arrays import F64, Model, Rows, State, Work
from derail_ros.engine.forces.along import along_damping
from derail_ros.engine.forces.brakes import LARGEST_BRAKING, brake_damping
from derail_ros.engine.forces.ground import ground_damping, largest_drag
from derail_ros.engine.forces.track import standing
from derail_ros.engine.jit import inner_jit, keep_separate
from derail_ros.engine.solver import plain_mass, weigh_blocks
from derail_ros.engine.trigonometry import angles

STIFF = 0.5
"""Friction is taken implicitly where a step times its fastest rate exceeds this."""


@inner_jit
def moves(v: F64, i: int) -> bool:
    """Some velocity of car ``i`` is not exactly zero."""
    return v[i, 0] != 0.0 or v[i, 1] != 0.0 or v[i, 2] != 0.0


@inner_jit
def friction_damping(model: Model, state: State, work: Work, h: float) -> bool:
    """Damping C by friction of the stiff cars into ``work.wk``; True if there are any.

    C is minus the derivative of the friction forces (ground, brakes) by (Vx, Vy, yaw rate) at the
    accepted state. Angles are in ``work.wk``.
    """
    keep_separate()
    wk = work.wk
    car = model.car
    v = state.v
    eps = model.par[0].ground_eps
    some = False
    for i in range(v.shape[0]):
        # a bound on the rate of the friction at the slowest point of the car
        speed = math.sqrt(v[i, 0] * v[i, 0] + v[i, 1] * v[i, 1])
        slowest = max(0.0, speed - abs(v[i, 2]) * car[i].half_l)
        bound = LARGEST_BRAKING + largest_drag(model, state, i)
        wk[i].stiff = 0.0
        if standing(model, i) and not moves(v, i):
            continue  # no friction yet: what stands untouched changes no step of the train's
        if h * bound > STIFF * math.sqrt(slowest * slowest + eps * eps):
            wk[i].stiff = 1.0
            some = True
            wk[i].c_xx = 0.0
            wk[i].c_xy = 0.0
            wk[i].c_xt = 0.0
            wk[i].c_yy = 0.0
            wk[i].c_yt = 0.0
            wk[i].c_tt = 0.0
    if not some:
        return False
    brake_damping(model, state, work, state.clock[0].t, v)
    ground_damping(model, state, work, state.q, v)
    if model.par[0].along != 0.0:
        along_damping(model, state, work, state.clock[0].t, v)
    some = False
    for i in range(v.shape[0]):
        if wk[i].stiff != 0.0:
            # the largest rate is below the trace
            rate = (wk[i].c_xx + wk[i].c_yy) / car[i].mass
            rate += wk[i].c_tt / car[i].inertia
            if h * rate <= STIFF:
                wk[i].stiff = 0.0
            else:
                some = True
    return some


@inner_jit
def longest_stable(model: Model, state: State, work: Work, h: float, bound: float) -> float:
    """Longest step up to ``h`` in which an explicit method is stable under the friction, s.

    ``bound`` is the method's along the negative real axis; a tenth of it is left to what the
    friction changes within the step. The fastest rate is the largest eigenvalue of ``M^-1 C`` of a
    car, from above: the largest sum of a row's sizes, in the metric of the masses. Constraints
    only make it slower.

    Error control alone does not see the instability of a car at rest: steps grow until what
    rounding has left of its velocities has become an oscillation of the size of the tolerance.
    """
    keep_separate()
    wk = work.wk
    car = model.car
    angles(state.q, wk, work.ang, work.live)
    if not friction_damping(model, state, work, h):
        return h
    fastest = 0.0
    for i in range(wk.shape[0]):
        if wk[i].stiff == 0.0:
            continue
        wk[i].stiff = 0.0
        root = math.sqrt(car[i].mass * car[i].inertia)
        xy = abs(wk[i].c_xy) / car[i].mass
        xt = abs(wk[i].c_xt) / root
        yt = abs(wk[i].c_yt) / root
        fastest = max(fastest, wk[i].c_xx / car[i].mass + xy + xt)
        fastest = max(fastest, xy + wk[i].c_yy / car[i].mass + yt)
        fastest = max(fastest, xt + yt + wk[i].c_tt / car[i].inertia)
    return min(h, 0.9 * bound / fastest)


@inner_jit
def implicit_masses(car: Rows, work: Work, factor_h: float) -> None:
    """Inverse of ``M + factor_h C`` of the stiff cars into ``work.wk``."""
    wk = work.wk
    trial = work.trial[0]
    trial.damping = 0.0
    for i in range(wk.shape[0]):
        if wk[i].stiff == 0.0:
            continue
        xx = car[i].mass + factor_h * wk[i].c_xx
        xy = factor_h * wk[i].c_xy
        xt = factor_h * wk[i].c_xt
        yy = car[i].mass + factor_h * wk[i].c_yy
        yt = factor_h * wk[i].c_yt
        tt = car[i].inertia + factor_h * wk[i].c_tt
        a = yy * tt - yt * yt
        b = xt * yt - xy * tt
        c = xy * yt - xt * yy
        inverse = 1.0 / (xx * a + xy * b + xt * c)
        if i >= trial.scope:
            trial.damping += wk[i].c_xx
        wk[i].m_xx = a * inverse
        wk[i].m_xy = b * inverse
        wk[i].m_xt = c * inverse
        wk[i].m_yy = (xx * tt - xt * xt) * inverse
        wk[i].m_yt = (xy * xt - xx * yt) * inverse
        wk[i].m_tt = (xx * yy - xy * xy) * inverse
    weigh_blocks(work)


@inner_jit
def restore_masses(car: Rows, work: Work) -> None:
    """Inverse of ``M`` of the stiff cars into ``work.wk``, to the bit as ``plain_masses`` has it.

    A run that goes on from a saved state begins with those.
    """
    wk = work.wk
    for i in range(wk.shape[0]):
        if wk[i].stiff != 0.0:
            plain_mass(car, wk, i)
    weigh_blocks(work)
