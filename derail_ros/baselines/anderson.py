r"""Birk, Anderson and Coppens 1990: stiff springs as couplings, collisions by impulse.

Three coordinates a car, (X, Y, theta). Couplings are very stiff springs between the faces of
couplers that are rigid parts of the bodies, removed at a limiting force
(``engine.laws.coupling_spring``); derailed trucks drag with a constant Coulomb friction of 1.0 to
1.5; overlapping bodies exchange an impulse as point masses do (``engine.laws.impulse``); a car
that came free at both ends may roll (``engine.laws.roll``); any car may derail.

The springs and impulses do not fit the main engine, whose couplings are constraints and whose
velocities never jump, so this is a small model of its own. It shares the engine's arrays and
parameters, its track, the truck constraints and their solver (with the coupling rows off), the
brake and ground laws, the initiating forces, Fehlberg's coefficients, the projection and the
typed errors.

Interpretation [R]: stiffness, damper, limiting force, restitution and friction within its range;
the truck constraint in place of motion prescribed along the track; derailment as in the thesis (a
break passed, or a lateral force above the derailment quotient); bodies as the thesis' rectangles;
the normal of a contact, that of least overlap; the friction of a car off the rails always at its
trucks. Point masses take no spin from an impulse, and nothing pushes overlapping bodies apart:
bodies that turn into each other stay overlapped. The source calls the springs numerically
delicate; a step that cannot be taken is the engine's typed error.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from derail_ros.engine import layout
from derail_ros.engine.arrays import Model, Rows, State, Work
from derail_ros.engine.blocks import no_blocks
from derail_ros.engine.dynamics import constraint_gamma, project_positions, project_velocities
from derail_ros.engine.forces.brakes import apply_brakes, brake_forces, next_application
from derail_ros.engine.forces.pushes import next_push, push_forces
from derail_ros.engine.forces.track import truck_rows
from derail_ros.engine.jit import inner_jit, jit, keep_separate
from derail_ros.engine.laws.coupling_spring import coupling_energy, coupling_force
from derail_ros.engine.laws.ground import drag
from derail_ros.engine.laws.impulse import collision_impulse, energy_lost
from derail_ros.engine.laws.roll import roll_angle
from derail_ros.engine.methods import ERRORS, RKF45, STAGES, TIMES, WEIGHTS
from derail_ros.engine.sampling import WORK_ENTRIES
from derail_ros.engine.simulation import PlanarSimulation
from derail_ros.engine.solver import factor, plain_masses, solve
from derail_ros.engine.trigonometry import angles
from derail_ros.vocabulary.errors import (
    ConstraintError,
    NonFiniteStateError,
    ParameterError,
    StepSizeError,
    TrackEndError,
)
from derail_ros.vocabulary.ledger import residual
from derail_ros.vocabulary.outcome import Outcome
from derail_ros.vocabulary.params import GRAVITY, TrainParams
from derail_ros.vocabulary.sample import planar
from derail_ros.vocabulary.scene import car_corners, scene_box
from derail_ros.vocabulary.status import AT_REST
from derail_ros.vocabulary.train import train_totals

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]


@dataclass(frozen=True)
class RollParams:
    """Inputs of the roll estimate, a loaded tank car's [R]."""

    height: float = 2.3  # of the mass centre above the rails, m
    track_width: float = 1.5  # between the wheels' contacts, m
    friction: float = 1.0  # of the ground
    radius: float = 1.5  # of the shell, m
    fittings: float = 0.5  # height of the top fittings above the shell, m


@dataclass(frozen=True)
class AndersonParams:
    """Constants of the model [R]."""

    stiffness: float = 1.0e8  # k of the coupling springs, N/m
    damping: float = 1.0e6  # c beside them, N s/m
    force_limit: float = 5.0e6  # F_max, N
    friction: float = 1.25  # Coulomb friction at derailed trucks (source: 1.0 to 1.5)
    restitution: float = 0.25  # e of collisions
    max_step: float = 5e-3  # s
    roll: RollParams = field(default_factory=RollParams)


# columns of the model's own parameters
S_K, S_C, S_LIMIT, S_MU, S_E, S_HMAX = range(6)
OWN = ("stiffness", "damping", "force_limit", "friction", "restitution", "max_step")
# columns of the cars' own state: time and speed at which a car came free, largest impulse's
# approach speed, other car, time
O_FREE_T, O_FREE_V, O_HIT_V, O_HIT_OTHER, O_HIT_T, N_O = range(6)


class Springs(NamedTuple):
    """State of the model beside the engine's arrays."""

    own: F64  # its constants, see OWN
    linked: U8  # (N-1,) springs that hold
    other: F64  # (N, N_O) the cars' own state


RKF = np.array(RKF45)
"""Fehlberg's 4(5)."""

DONE, NON_FINITE, STEP_FLOOR, SINGULAR, TRACK_END = 0, -1, -2, -3, -4
_ERRORS = {
    NON_FINITE: (NonFiniteStateError, "the state is no longer finite"),
    STEP_FLOOR: (StepSizeError, "the step size fell below its floor"),
    SINGULAR: (ConstraintError, "the truck constraints cannot be solved"),
    TRACK_END: (TrackEndError, "a truck on the rails left the end of the alignment"),
}


@inner_jit
def _gap(
    model: Model, q: F64, v: F64, wk: Rows, i: int
) -> tuple[float, float, float, float, float, float, float, float]:
    """Vector from the rear face of car i to the front face of i + 1, its rate, both arms."""
    b = model.car[i].pivot + model.car[i].rear
    f = model.car[i + 1].pivot + model.car[i + 1].front
    bx = -b * wk[i].ct
    by = -b * wk[i].st
    fx = f * wk[i + 1].ct
    fy = f * wk[i + 1].st
    gx = q[i + 1, 0] + fx - q[i, 0] - bx
    gy = q[i + 1, 1] + fy - q[i, 1] - by
    rx = v[i + 1, 0] - v[i + 1, 2] * fy - v[i, 0] + v[i, 2] * by
    ry = v[i + 1, 1] + v[i + 1, 2] * fx - v[i, 1] - v[i, 2] * bx
    return gx, gy, rx, ry, bx, by, fx, fy


@jit
def applied_forces(
    model: Model, state: State, work: Work, springs: Springs, t: float, q: F64, v: F64
) -> None:
    """All applied forces into ``work.force``, their powers into ``work.power``."""
    keep_separate()
    n = q.shape[0]
    eps = model.par[0].ground_eps
    own, linked = springs.own, springs.linked
    mu = own[S_MU]
    wk = work.wk
    force = work.force
    angles(q, wk, work.ang, work.live)
    for i in range(n):
        for k in range(5):
            force[i, k] = 0.0
    drag_power = 0.0
    damper_power = 0.0
    brake_forces(model, state, work, t, v)
    for i in range(n):
        for k in range(2):
            if state.truck_on[i, k]:
                continue
            r = model.car[i].truck if k == 0 else -model.car[i].truck
            rx = r * wk[i].ct
            ry = r * wk[i].st
            ux = v[i, 0] - v[i, 2] * ry
            uy = v[i, 1] + v[i, 2] * rx
            speed = math.sqrt(ux * ux + uy * uy)
            f = drag(speed, mu, mu, eps, 0.0) * (0.5 * model.par[0].gravity * model.car[i].mass)
            force[i, 0] -= f * ux
            force[i, 1] -= f * uy
            force[i, 2] -= f * (rx * uy - ry * ux)
            drag_power += f * speed * speed
    for i in range(n - 1):
        if linked[i] == 0:
            continue
        gx, gy, rx, ry, bx, by, ax, ay = _gap(model, q, v, wk, i)
        sx, sy = coupling_force(gx, gy, rx, ry, own[S_K], own[S_C])
        force[i, 0] += sx
        force[i, 1] += sy
        force[i, 2] += bx * sy - by * sx
        force[i + 1, 0] -= sx
        force[i + 1, 1] -= sy
        force[i + 1, 2] -= ax * sy - ay * sx
        damper_power += own[S_C] * (rx * rx + ry * ry)
    push_forces(model, state, work, v)
    work.power[layout.E_GROUND_TRUCK] = drag_power
    work.power[layout.E_GROUND_BODY] = 0.0
    work.power[layout.E_COLLISION] = 0.0
    work.power[layout.E_DAMPER] = damper_power


@jit
def rates(
    model: Model, state: State, work: Work, springs: Springs, t: float, q: F64, v: F64, out: F64
) -> bool:
    """Accelerations of the cars under their truck constraints; False when singular."""
    keep_separate()
    applied_forces(model, state, work, springs, t, q, v)
    truck_rows(model, state, work, q)
    ok = factor(model, state, work)
    constraint_gamma(model, state, work, q, v)
    solve(model, state, work, out)
    state.cnt[0].evaluations += 1
    return ok


@jit
def stored_energy(
    model: Model, springs: Springs, q: F64, v: F64, work: Work
) -> tuple[float, float]:
    """Kinetic energy of the cars and energy of the springs, J."""
    keep_separate()
    wk = work.wk
    angles(q, wk, work.ang, work.live)
    kinetic = 0.0
    spring = 0.0
    for i in range(q.shape[0]):
        kinetic += 0.5 * model.car[i].mass * (v[i, 0] * v[i, 0] + v[i, 1] * v[i, 1])
        kinetic += 0.5 * model.car[i].inertia * v[i, 2] * v[i, 2]
        if i < q.shape[0] - 1 and springs.linked[i]:
            gx, gy, _, _, _, _, _, _ = _gap(model, q, v, wk, i)
            spring += coupling_energy(gx, gy, springs.own[S_K])
    return kinetic, spring


@inner_jit
def _separation(model: Model, q: F64, wk: Rows, i: int, j: int) -> tuple[float, float, float]:
    """Overlap (m) of two rectangles and its normal from i to j; not positive when apart."""
    dx = q[j, 0] - q[i, 0]
    dy = q[j, 1] - q[i, 1]
    least = 1.0e300
    nx = 0.0
    ny = 0.0
    for axis in range(4):
        k = i if axis < 2 else j
        if axis % 2 == 0:
            ax = wk[k].ct
            ay = wk[k].st
        else:
            ax = -wk[k].st
            ay = wk[k].ct
        along = dx * ax + dy * ay
        reach = 0.0
        for m in range(2):
            b = i if m == 0 else j
            reach += model.car[b].half_l * abs(ax * wk[b].ct + ay * wk[b].st)
            reach += model.car[b].half_w * abs(ay * wk[b].ct - ax * wk[b].st)
        overlap = reach - abs(along)
        if overlap <= 0.0:
            return overlap, 0.0, 0.0
        if overlap < least:
            least = overlap
            sign = 1.0 if along >= 0.0 else -1.0
            nx = sign * ax
            ny = sign * ay
    return least, nx, ny


@jit
def collide(model: Model, state: State, work: Work, springs: Springs) -> None:
    """Impulses between all bodies that overlap and approach.

    The mobilities under the truck constraints are those of the factors in ``work.wk``: a car on
    the rails gives way along them only.
    """
    keep_separate()
    n = state.q.shape[0]
    q = state.q
    v = state.v
    wk = work.wk
    restitution, other = springs.own[S_E], springs.other
    for i in range(n):
        if model.car[i].virtual != 0.0:
            continue
        for j in range(i + 1, n):
            if model.car[j].virtual != 0.0:
                continue
            dx = q[j, 0] - q[i, 0]
            dy = q[j, 1] - q[i, 1]
            reach = model.car[i].radius + model.car[j].radius
            if dx * dx + dy * dy >= reach * reach:
                continue
            overlap, nx, ny = _separation(model, q, wk, i, j)
            if overlap <= 0.0:
                continue
            closing = (v[i, 0] - v[j, 0]) * nx + (v[i, 1] - v[j, 1]) * ny
            if closing <= 0.0:
                continue
            ax = wk[i].w_xx * nx + wk[i].w_xy * ny
            ay = wk[i].w_xy * nx + wk[i].w_yy * ny
            at = wk[i].w_xt * nx + wk[i].w_yt * ny
            bx = wk[j].w_xx * nx + wk[j].w_xy * ny
            by = wk[j].w_xy * nx + wk[j].w_yy * ny
            bt = wk[j].w_xt * nx + wk[j].w_yt * ny
            w_a = ax * nx + ay * ny
            w_b = bx * nx + by * ny
            p = collision_impulse(closing, w_a, w_b, restitution)
            if not p > 0.0:
                continue
            state.energy[layout.E_COLLISION] += energy_lost(closing, w_a, w_b, restitution)
            v[i, 0] -= p * ax
            v[i, 1] -= p * ay
            v[i, 2] -= p * at
            v[j, 0] += p * bx
            v[j, 1] += p * by
            v[j, 2] += p * bt
            for c in range(2):
                me = i if c == 0 else j
                if closing > other[me, O_HIT_V]:
                    other[me, O_HIT_V] = closing
                    other[me, O_HIT_OTHER] = (j if c == 0 else i) + 1.0
                    other[me, O_HIT_T] = state.clock[0].t


@inner_jit
def _note_derailed(state: State, i: int) -> None:
    if math.isnan(state.peak[i].derail_time):
        state.peak[i].derail_time = state.clock[0].t
        state.peak[i].derail_speed = math.hypot(state.v[i, 0], state.v[i, 1])


@inner_jit
def _note_free(state: State, springs: Springs, i: int) -> None:
    n = state.q.shape[0]
    linked, other = springs.linked, springs.other
    free = (i == 0 or linked[i - 1] == 0) and (i == n - 1 or linked[i] == 0)
    off = state.truck_on[i, 0] == 0 or state.truck_on[i, 1] == 0
    if free and off and math.isnan(other[i, O_FREE_T]):
        other[i, O_FREE_T] = state.clock[0].t
        other[i, O_FREE_V] = math.hypot(state.v[i, 0], state.v[i, 1])


@jit
def advance(model: Model, state: State, work: Work, springs: Springs, t_target: float) -> int:
    """Step until ``t_target`` or the end of the run."""
    keep_separate()
    n = state.q.shape[0]
    clock = state.clock[0]
    cnt = state.cnt[0]
    par = model.par[0]
    floor = par.h_min
    own, linked = springs.own, springs.linked
    q1 = work.stage_q
    v1 = work.stage_v
    while clock.t < t_target and cnt.status == layout.RUNNING:
        t = clock.t
        clock.t_on = t
        if not rates(model, state, work, springs, t, state.q, state.v, work.kv[0]):
            return SINGULAR
        for k in range(layout.N_POWER):
            work.kp[0, k] = work.power[k]
        for i in range(n):
            for k in range(5):
                work.kq[0, i, k] = state.v[i, k]
            # kept: the stages move the track coordinates
            for k in range(2):
                work.truck_s[i, k] = state.truck_s[i, k]
        switch = min(next_push(model, t), next_application(state, t))
        h = min(clock.h_next, own[S_HMAX])
        reaches = False
        if t + h >= switch:
            h = switch - t
            reaches = True
        while True:
            for s in range(1, 6):
                for i in range(n):
                    for k in range(5):
                        dq = 0.0
                        dv = 0.0
                        for r in range(s):
                            dq += RKF[STAGES + s, r] * work.kq[r, i, k]
                            dv += RKF[STAGES + s, r] * work.kv[r, i, k]
                        q1[i, k] = state.q[i, k] + h * dq
                        v1[i, k] = state.v[i, k] + h * dv
                        work.kq[s, i, k] = v1[i, k]
                at = t + RKF[TIMES, s] * h
                if not rates(model, state, work, springs, at, q1, v1, work.kv[s]):
                    return SINGULAR
                for k in range(layout.N_POWER):
                    work.kp[s, k] = work.power[k]
            error = 0.0
            rtol = par.rtol
            for i in range(n):
                for k in range(3):
                    dq = 0.0
                    dv = 0.0
                    eq = 0.0
                    ev = 0.0
                    for s in range(6):
                        dq += RKF[WEIGHTS, s] * work.kq[s, i, k]
                        dv += RKF[WEIGHTS, s] * work.kv[s, i, k]
                        eq += RKF[ERRORS, s] * work.kq[s, i, k]
                        ev += RKF[ERRORS, s] * work.kv[s, i, k]
                    q1[i, k] = state.q[i, k] + h * dq
                    v1[i, k] = state.v[i, k] + h * dv
                    arm = model.car[i].gyration if k == 2 else 1.0
                    eq = abs(h * eq) * arm
                    ev = abs(h * ev) * arm / (1.0 + arm * abs(state.v[i, k]))
                    # written so that a nan counts as an error
                    if not eq <= error * rtol:
                        error = eq / rtol
                    if not ev <= error * rtol:
                        error = ev / rtol
            ok = math.isfinite(error)
            grow = 0.2
            if ok:
                grow = min(2.0, max(0.2, 0.85 * max(error, 1e-10) ** -0.2))
            if ok and error <= 1.0:
                break
            cnt.rejected += 1
            h *= min(grow, 0.9)
            reaches = False
            if h < floor:
                return STEP_FLOOR if ok else NON_FINITE
        for k in range(layout.N_POWER):
            total = 0.0
            for s in range(6):
                total += RKF[WEIGHTS, s] * work.kp[s, k]
            state.energy[k] += h * total
        before, spring = stored_energy(model, springs, q1, v1, work)
        before += spring
        for i in range(n):
            for k in range(3):
                if not math.isfinite(q1[i, k] + v1[i, k]):
                    return NON_FINITE
        if not project_positions(model, state, work, q1):
            return SINGULAR
        project_velocities(model, state, work, v1)
        after, spring = stored_energy(model, springs, q1, v1, work)
        state.energy[layout.E_STAB_NET] += after + spring - before
        state.energy[layout.E_STAB_GROSS] += abs(after + spring - before)
        clock.t_prev = t
        clock.t = switch if reaches else t + h
        for i in range(n):
            for k in range(5):
                state.q[i, k] = q1[i, k]
                state.v[i, k] = v1[i, k]
        cnt.steps += 1
        clock.h_next = min(max(h * grow, floor), own[S_HMAX])

        # what the rails carry, and what leaves them
        if not rates(model, state, work, springs, clock.t, state.q, state.v, state.a):
            return SINGULAR
        for i in range(n):
            for k in range(2):
                state.rail_force[i, k] = work.lam_t[i, k]
                if state.truck_on[i, k] and model.track.shape[0] > 0:
                    last = model.track.shape[0] - 1
                    end = model.track[last].s + model.track[last].length
                    if not model.track[0].s <= state.truck_s[i, k] <= end:
                        return TRACK_END
        moved = False
        for i in range(n):
            for k in range(2):
                if state.truck_on[i, k] == 0:
                    continue
                s0 = work.truck_s[i, k]
                s1 = state.truck_s[i, k]
                passed = False
                for b in range(state.breaks.shape[0]):
                    sb = state.breaks[b]
                    if s0 <= sb < s1 or s1 < sb <= s0:
                        passed = True
                virtual = model.car[i].virtual != 0.0
                if passed and virtual:
                    cnt.status = layout.VOID
                    return DONE
                quotient = abs(state.rail_force[i, k]) / (0.5 * par.gravity * model.car[i].mass)
                if passed or (quotient > par.lv_limit and not virtual):
                    state.truck_on[i, k] = 0
                    _note_derailed(state, i)
                    moved = True
        if moved:
            # the mobilities of the impulses are those of the trucks that are left
            truck_rows(model, state, work, state.q)
            if not factor(model, state, work):
                return SINGULAR
        for i in range(n - 1):
            if linked[i] == 0:
                continue
            gx, gy, rx, ry, _, _, _, _ = _gap(model, state.q, state.v, work.wk, i)
            sx, sy = coupling_force(gx, gy, rx, ry, own[S_K], own[S_C])
            if sx * sx + sy * sy > own[S_LIMIT] * own[S_LIMIT]:
                linked[i] = 0
                state.energy[layout.E_KNUCKLE] += coupling_energy(gx, gy, own[S_K])
                if par.vent != 0.0:
                    at = 0.5 * (model.car[i].distance + model.car[i + 1].distance)
                    apply_brakes(model, state, at, layout.ARR_CONV, clock.t)
        for i in range(n):
            _note_free(state, springs, i)
        collide(model, state, work, springs)

        # the end
        still = True
        for i in range(n):
            speed = math.sqrt(state.v[i, 0] ** 2 + state.v[i, 1] ** 2)
            if speed > par.rest_speed or abs(state.v[i, 2]) > par.rest_yaw_rate:
                still = False
        if not still:
            clock.rest_since = -1.0
        elif clock.rest_since < 0.0:
            clock.rest_since = clock.t
        elif clock.t - clock.rest_since >= par.rest_hold:
            clock.duration = clock.rest_since
            cnt.status = layout.AT_REST
        if cnt.status == layout.RUNNING and clock.t >= par.time_limit:
            cnt.status = layout.TIME_LIMIT
    return DONE


class AndersonModel:
    """A run of the model.

    Parameters
    ----------
    params : train, track, initiation, brakes and integration as for the main engine; its
        couplers, ground and contact laws are replaced by the model's own
    own : the model's constants

    Raises
    ------
    ParameterError
        A parameter is out of its range.
    """

    def __init__(self, params: TrainParams, own: AndersonParams | None = None) -> None:
        self.own = AndersonParams() if own is None else own
        for name in ("stiffness", "force_limit", "friction", "max_step"):
            value = getattr(self.own, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ParameterError(f"anderson.{name}", f"must be above 0, got {value:g}")
        for name, high in (("damping", math.inf), ("restitution", 1.0)):
            value = getattr(self.own, name)
            if not 0.0 <= value <= high or not math.isfinite(value):
                raise ParameterError(f"anderson.{name}", f"is out of range, got {value:g}")
        self.params = params
        start = PlanarSimulation(params)
        self.track = start.track
        self._model, self._state, self._work = start._model, start._state, start._work
        no_blocks(self._work)
        plain_masses(self._model, self._work.wk)
        n = len(params.cars)
        s = self._state
        linked = s.coupled.copy()
        s.coupled[:] = 0  # springs in place of the engine's joints
        # rigid couplers: their angles are the cars', and have no motion of their own
        s.q[:, 3:] = s.q[:, 2:3]
        s.v[:, 3:] = 0.0
        own = [getattr(self.own, name) for name in OWN]
        other = np.zeros((n, N_O))
        other[:, [O_FREE_T, O_FREE_V, O_HIT_T]] = math.nan
        self._springs = Springs(np.array(own), linked, other)
        self._initial = sum(self._stored())

    def _stored(self) -> tuple[float, float]:
        s = self._state
        return stored_energy(self._model, self._springs, s.q, s.v, self._work)

    @property
    def time(self) -> float:
        """s."""
        return float(self._state.clock["t"][0])

    @property
    def ended(self) -> bool:
        """No further step will be taken."""
        return bool(self._state.cnt["status"][0] != layout.RUNNING)

    @property
    def pose(self) -> F64:
        """(N, 3) x, y (m) and yaw (rad) of the cars."""
        return self._state.q[:, :3].copy()

    @property
    def velocity(self) -> F64:
        """(N, 3) their rates, m/s and rad/s."""
        return self._state.v[:, :3].copy()

    @property
    def truck_on(self) -> U8:
        """(N, 2) trucks on the rails."""
        return self._state.truck_on.copy()

    @property
    def coupled(self) -> U8:
        """(N-1,) springs that hold."""
        return self._springs.linked.copy()

    def advance_to(self, t: float) -> None:
        """Step until ``time >= t`` or the run ends.

        Raises
        ------
        SimulationError
            The run cannot go on; its last accepted state stays.
        """
        code = advance(self._model, self._state, self._work, self._springs, t)
        if code != DONE:
            self._state.cnt["status"][0] = layout.FAILED
            kind, reason = _ERRORS[code]
            raise kind(f"{reason} at t = {self.time:.6f} s")

    def energy(self) -> dict[str, float]:
        """The ledger, J, in the main engine's entries; ``striker`` holds the springs."""
        e = self._state.energy
        kinetic, spring = self._stored()
        ledger = {
            "kinetic": kinetic,
            "striker": spring,
            "initial": self._initial,
            **{key: float(e[k]) for key, k in WORK_ENTRIES.items() if key != "ground_body"},
        }
        return ledger | {"residual": residual(ledger)}

    def residual(self) -> float:
        """Imbalance of the ledger over the initial energy."""
        return abs(self.energy()["residual"]) / max(self._initial, 1e-300)

    def run(self) -> Outcome:
        """Go on to the end."""
        self.advance_to(math.inf)
        return self.outcome()

    def outcome(self) -> Outcome:
        """Result of the run so far.

        ``car_values``: ``approach_speed_m_per_s``, the largest speed of approach in a collision
        (the model computes no forces); ``approach_car``, the car
        on the other side of it, 0 without; ``roll_rad``, the roll estimate, nan for cars that did
        not come free.
        """
        from derail_ros.engine.reports import STATUS

        s, o = self._state, self._springs.other
        off = (s.truck_on == 0).any(axis=1)
        car = self._model.car
        corners = car_corners(s.q[:, :3], 2.0 * car["half_l"], 2.0 * car["half_w"])
        box = scene_box(self.track, corners[off], s.truck_s[off, 0])
        behind = np.flatnonzero(s.truck_on[:, 0])
        behind = behind[behind > (np.flatnonzero(off)[-1] if off.any() else len(off))]
        clock, count = s.clock[0], s.cnt[0]
        status = STATUS[int(count["status"])]
        return replace(
            Outcome.nothing(planar(s.q), status, self.time, int(count["steps"])),
            duration=float(clock["duration"]) if status == AT_REST else math.nan,
            rejected_steps=int(count["rejected"]),
            derailed_cars=tuple(int(i) + 1 for i in np.flatnonzero(off)),
            scene_length=box[0],
            scene_width=box[1],
            scene_area=box[2],
            derail_time=s.peak["derail_time"].copy(),
            derail_speed=s.peak["derail_speed"].copy(),
            rear_part_first_car=int(behind[0]) + 1 if len(behind) else 0,
            rear_part_coordinate=float(s.truck_s[behind[0], 0]) if len(behind) else math.nan,
            energy=self.energy(),
            energy_residual=self.residual(),
            train=train_totals(self.params.cars),
            car_values={
                "approach_speed_m_per_s": o[:, O_HIT_V].copy(),
                "approach_car": o[:, O_HIT_OTHER].copy(),
                "roll_rad": roll_estimates(o[:, O_FREE_V], self.own.roll),
            },
        )


def roll_estimates(free_speed: F64, params: RollParams | None = None) -> F64:
    """Roll (rad) of cars that came free at these speeds (m/s); nan where one did not."""
    p = RollParams() if params is None else params
    speeds = np.asarray(free_speed, dtype=float)
    return np.array(
        [
            math.nan
            if math.isnan(v)
            else roll_angle(v, p.height, p.track_width, p.friction, p.radius, p.fittings, GRAVITY)[
                0
            ]
            for v in speeds.ravel()
        ]
    ).reshape(speeds.shape)


def warm_up() -> None:
    """Compile the kernels."""
    from derail_ros.scenario import load_scenario

    AndersonModel(load_scenario("base_train").to_params()).advance_to(0.01)
