"""Forces and tests of the engine in three dimensions, around MuJoCo's steps.

MuJoCo moves the bodies and solves contacts, couplings and limits. The planar engine's kernels give
what acts in the plane (strikers, knuckles, brakes, grades, resistance, locomotives, pushes) from
``state.q``, the train seen from above. Added here:

- rails: each truck stands on four springs' halves, one a rail and truck. With u the compression,
  ``N = k u + k_s max(u - travel, 0) + c du/dt``, never below 0; across the track
  ``F = -(k_g d + c_g dd/dt)`` for the truck's offset d;
- a truck leaves at a break, when ``|F|`` exceeds ``lv_limit`` times what it stands on (the load
  of its wheels now, at least its own weight), when both wheels have lifted past their flanges, or
  when the car has tipped;
- coupler pitch: spring and damper;
- ground: at each point of a car below it, along the normal n with the depth u and the speed v,
  ``N = max(k u - c v . n, 0)``, and the planar model's reaction (``laws.ground``) to N against
  what of v is along it. ``k`` and ``c`` are an eighth of GROUND_STIFFNESS and GROUND_DAMPING times
  the car's mass: eight points carry one that stands;
- the ground's shape: the beds of all tracks, and zones that rise or fall (``terrain``). Where
  there are slopes, ``N = k u / n_z`` with u upright: the force is then minus the gradient of
  ``k u^2 / 2`` whatever the shape, and a face stops what runs into it;
- draft gear: each rear coupler slides in its car under ``forces.draft_gear``'s force;
- guidance: a derailed truck's rail (``forces.guidance``), at the height of its wheels;
- contacts between cars, their forces summed by pair. Walls: ``derail_ros.spatial.walls``.

The work of a force over a step is its value times the mean of the velocities at both ends, which
is exact for a semi-implicit Euler step with constant inertia.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from derail_ros.engine import layout, pointers
from derail_ros.engine.arrays import F64, I64, U8, Model, Rows, State, Work
from derail_ros.engine.events import note_coupling_forces, note_progress
from derail_ros.engine.forces.along import along_forces
from derail_ros.engine.forces.brakes import brake_forces
from derail_ros.engine.forces.draft_gear import gear_force
from derail_ros.engine.forces.ground import ground_forces
from derail_ros.engine.forces.pushes import push_forces
from derail_ros.engine.forces.track import askew_load, break_passed, locate_on, standing
from derail_ros.engine.jit import inner_jit, jit, keep_separate
from derail_ros.engine.laws.draft_gear import loading_energy
from derail_ros.engine.laws.ground import drag
from derail_ros.engine.laws.joint import joint_energy, joint_moment
from derail_ros.engine.laws.knuckle import knuckle_energy, knuckle_moment
from derail_ros.engine.laws.striker import spring_energy, spring_force
from derail_ros.engine.outlines import from_edge, holds
from derail_ros.engine.track import locate
from derail_ros.spatial import constants as c
from derail_ros.vocabulary.shapes import (
    BED_HALF_WIDTH,
    BED_HEIGHT,
    BED_SLOPE,
    GROUND_DAMPING,
    GROUND_STIFFNESS,
    HALF_GAUGE,
    RAIL_HEIGHT,
)


def _table(names: str) -> np.dtype[np.void]:
    return np.dtype([(name, np.float64) for name in names.split()])


BODY = _table("""
    height width bottom top share spring damping free guide guide_damping weight
    qpos qvel body front rear hinge_front hinge_rear
""")
"""A car: centre of gravity, width, underside and top over the rail (m); springs of one wheel side
of one truck, compression at rest (m); lateral springs; own weight of a truck (N); places in
MuJoCo's arrays."""

TOUCH = _table("i j fx fy fz x y z nx ny nz most closing power contact below seen")
"""A pair of cars in contact: force on the first, place and normal of the hardest contact."""

LEFT, PARTED, SIDE, OVER = range(4)
"""What :func:`observe` finds: a truck off the rails, a coupling parted, a car on its side, a car
overridden."""
FOUND = _table("kind car other cause value")
BREAK, LATERAL, LIFTED, TIPPED, ANGLE, KNUCKLE, COUPLER_BODY, SLIP = range(8)
"""Causes, by their places in ``simulation.CAUSES``."""


class Space(NamedTuple):
    """State that the third dimension adds to a run. MuJoCo's own arrays first, then the state."""

    qpos: F64
    qvel: F64
    xpos: F64  # (bodies, 3)
    xmat: F64  # (bodies, 9)
    qfrc: F64
    eq_active: Any
    geom_car: I64  # (geoms,) index of the car, -1: not a car
    body: Rows  # (N,) BODY
    flat: U8  # (1,) 1: cars move in the plane only
    points: F64  # (N, P, 5) of a car, in its frame: x, y, z, radius, kind of ground contact
    n_points: I64  # (N,)
    beside: F64  # (N, 2, 3) each truck's offset from the track, and the normal of the track
    shelf: U8  # (N, 2) the coupler does not slip: front, rear
    wrench: F64  # (3, N, 6) force and torque at the centre: ground trucks, ground body, cars
    before: F64  # (N, 6) velocity at the beginning of the step: linear, angular, in space
    velocity: F64  # (N, 6) now
    pose: F64  # (N, 6) x, y, z, roll, pitch, yaw
    rates: F64  # (N, 6)
    wheel: F64  # (N, 2, 2) load of each wheel side, N: truck, left and right
    xfrc: F64  # (bodies, 6) force and torque in space, for the next step
    load: F64  # (N, 2) load on the ground: trucks, body, N
    ledger: F64  # (5,) energy of springs, work of dampers, gravity, strikers, knuckles
    coupler_lift: F64  # (N-1,) vertical force in a coupling, N
    fell: U8  # (N, 2) on its side, overridden: reported
    touch: Rows  # (T,) TOUCH
    count: I64  # (2,) touches, found
    found: Rows  # (F,) FOUND
    height: F64  # (K, 2) height and vertical normal of each collision's peak
    crest: F64  # (1,) height of the highest ground over the rail, m
    rise: F64  # (Z, 2) of each zone: r . p0, and how wide its edge is, m
    lines: I64  # (T, 2) rows of ``Model.side`` of each second track
    along: F64  # (N, 2, 1 + T) each truck's coordinate on the main track and on second ones
    sides: F64  # (N, 2, T, 3) its offset from second tracks, and their normals
    soil: F64  # (7,) scratch: c_s, c_d, eps, c_v; height, its slope along x and y
    wall: F64  # (N, 6) wrench of the fixed bodies; 0 rows without any
    tops: F64  # (B,) height of each fixed body over the rail, m
    round: U8  # (N,) the car is a tank
    span: F64  # (N, 5) scratch: lowest and highest point of its body, and of its trucks; dW/dphi
    level: F64  # (N,) height at which fixed bodies push it, m


pointers.register(Space)

SPRINGS, DAMPERS, GRAVITY, STRIKERS, KNUCKLES = range(5)


@inner_jit
def _find(space: Space, kind: int, car: int, other: int, cause: int, value: float) -> None:
    row = space.found[space.count[1]]
    row.kind = kind
    row.car = car
    row.other = other
    row.cause = cause
    row.value = value
    space.count[1] += 1


@inner_jit
def _turn(space: Space, b: int, x: float, y: float, z: float) -> tuple[float, float, float]:
    """A vector of a body's frame in space."""
    m = space.xmat
    return (
        m[b, 0] * x + m[b, 1] * y + m[b, 2] * z,
        m[b, 3] * x + m[b, 4] * y + m[b, 5] * z,
        m[b, 6] * x + m[b, 7] * y + m[b, 8] * z,
    )


@inner_jit
def _speeds(space: Space, i: int) -> None:
    """Velocity of car ``i`` in space into ``space.velocity``."""
    row = space.body[i]
    a = int(row.qvel)
    v = space.velocity
    if space.flat[0]:
        v[i, 0] = space.qvel[a]
        v[i, 1] = space.qvel[a + 1]
        v[i, 5] = space.qvel[a + 2]
        return
    for k in range(3):
        v[i, k] = space.qvel[a + k]
    v[i, 3], v[i, 4], v[i, 5] = _turn(
        space, int(row.body), space.qvel[a + 3], space.qvel[a + 4], space.qvel[a + 5]
    )


@inner_jit
def _place(space: Space, i: int, joint: int) -> int:
    """Place in ``qpos`` of a hinge of car ``i``: free joints have one more there."""
    return joint if space.flat[0] else joint + i + 1


@inner_jit
def look(model: Model, state: State, work: Work, space: Space) -> None:
    """Poses, rates and the plane view ``state.q``, ``state.v`` from MuJoCo's bodies."""
    keep_separate()
    h = state.clock[0].t - state.clock[0].t_prev
    for i in range(state.q.shape[0]):
        row = space.body[i]
        b = int(row.body)
        m = space.xmat
        _speeds(space, i)
        v = space.velocity
        yaw = math.atan2(m[b, 3], m[b, 0])
        yaw += 2.0 * math.pi * round((state.q[i, 2] - yaw) / (2.0 * math.pi))
        level = math.sqrt(m[b, 0] * m[b, 0] + m[b, 3] * m[b, 3])
        pose = space.pose[i]
        for k in range(3):
            pose[k] = space.xpos[b, k]
        roll = math.atan2(m[b, 7], m[b, 8])
        pose[3] = roll + 2.0 * math.pi * round((pose[3] - roll) / (2.0 * math.pi))
        pose[4] = math.atan2(-m[b, 6], level)
        pose[5] = yaw
        cy = math.cos(yaw)
        sy = math.sin(yaw)
        along = v[i, 3] * cy + v[i, 4] * sy
        level = max(level, 0.05)
        rates = space.rates[i]
        for k in range(3):
            rates[k] = v[i, k]
        rates[3] = along / level
        rates[4] = -v[i, 3] * sy + v[i, 4] * cy
        rates[5] = v[i, 5] - m[b, 6] / level * along
        work.wk[i].ct = cy
        work.wk[i].st = sy
        old = state.v
        new = (v[i, 0], v[i, 1], rates[5])
        for k in range(3):
            if h > 0.0:
                state.a[i, k] = (new[k] - old[i, k]) / h
            state.v[i, k] = new[k]
        state.q[i, 0] = pose[0]
        state.q[i, 1] = pose[1]
        state.q[i, 2] = yaw
        for end in range(2):
            joint = int(row.hinge_front if end == 0 else row.hinge_rear)
            state.q[i, 3 + end] = yaw + space.qpos[_place(space, i, joint)]
            rate = rates[5] + space.qvel[joint]
            if h > 0.0:
                state.a[i, 3 + end] = (rate - state.v[i, 3 + end]) / h
            state.v[i, 3 + end] = rate


@inner_jit
def _push(
    space: Space, b: int, rx: float, ry: float, rz: float, fx: float, fy: float, fz: float
) -> None:
    """Add a force at a place relative to the centre of body ``b``."""
    f = space.xfrc
    f[b, 0] += fx
    f[b, 1] += fy
    f[b, 2] += fz
    f[b, 3] += ry * fz - rz * fy
    f[b, 4] += rz * fx - rx * fz
    f[b, 5] += rx * fy - ry * fx


@inner_jit
def _other_tracks(
    model: Model, state: State, space: Space, i: int, k: int, x: float, y: float
) -> None:
    """Offsets of a truck off the rails from the tracks whose beds it may meet; all of them."""
    if standing(model, i):
        s, d, heading, _, _ = locate(model.track, x, y, space.along[i, k, 0])
        space.along[i, k, 0] = s
        space.beside[i, k, 0] = d
        space.beside[i, k, 1] = -math.sin(heading)
        space.beside[i, k, 2] = math.cos(heading)
    if state.truck_on[i, 0] and state.truck_on[i, 1]:
        return
    for t in range(space.lines.shape[0]):
        line = model.side[space.lines[t, 0] : space.lines[t, 1]]
        s, d, heading, _, _ = locate(line, x, y, space.along[i, k, 1 + t])
        space.along[i, k, 1 + t] = s
        space.sides[i, k, t, 0] = d
        space.sides[i, k, t, 1] = -math.sin(heading)
        space.sides[i, k, t, 2] = math.cos(heading)


@inner_jit
def _rails(model: Model, state: State, work: Work, space: Space, h: float) -> None:
    """Springs of the trucks on the rails, and which trucks leave them."""
    keep_separate()
    straight = model.track.shape[0] == 0
    flat = space.flat[0] != 0
    energy = 0.0
    damped = 0.0
    for i in range(state.q.shape[0]):
        row = space.body[i]
        b = int(row.body)
        v = space.velocity
        for k in range(2):
            arm = model.car[i].truck if k == 0 else -model.car[i].truck
            rx, ry, rz = _turn(space, b, arm, 0.0, -row.height)
            x = space.xpos[b, 0] + rx
            y = space.xpos[b, 1] + ry
            work.truck_s[i, k] = state.truck_s[i, k]
            other = standing(model, i)
            if other:
                s, d, heading, _, _ = locate_on(model, i, x, y, state.truck_s[i, k])
            elif straight:
                s, d, heading = x, y, 0.0
            else:
                s, d, heading, _, _ = locate(model.track, x, y, state.truck_s[i, k])
            state.truck_s[i, k] = s
            nx = -math.sin(heading)
            ny = math.cos(heading)
            if space.lines.shape[0] > 0:
                _other_tracks(model, state, space, i, k, x, y)
            if not other:
                space.beside[i, k, 0] = d
                space.beside[i, k, 1] = nx
                space.beside[i, k, 2] = ny
            state.rail_force[i, k] = 0.0
            space.wheel[i, k, 0] = 0.0
            space.wheel[i, k, 1] = 0.0
            if state.truck_on[i, k] == 0:
                continue
            load = 0.5 * model.car[i].mass * model.par[0].gravity
            lifted = False
            spring = 0.0
            lost = 0.0
            if not flat:
                load = 0.0
                lifted = True
                for side in range(2):
                    across = HALF_GAUGE if side == 0 else -HALF_GAUGE
                    wx, wy, wz = _turn(space, b, arm, across, -row.height)
                    u = row.free - (space.xpos[b, 2] + wz)
                    if u > -c.FLANGE_HEIGHT:
                        lifted = False
                    if u <= 0.0:
                        continue
                    rate = -(v[i, 2] + v[i, 3] * wy - v[i, 4] * wx)
                    solid = max(u - c.SPRING_TRAVEL, 0.0)
                    stiff = c.SPRING_SOLID * row.share
                    force = row.spring * u + stiff * solid
                    total = max(force + row.damping * rate, 0.0)
                    spring += 0.5 * (row.spring * u * u + stiff * solid * solid)
                    lost += (total - force) * rate
                    space.wheel[i, k, side] = total
                    load += total
                    _push(space, b, wx, wy, wz, 0.0, 0.0, total)
            vx = v[i, 0] + v[i, 4] * rz - v[i, 5] * ry
            vy = v[i, 1] + v[i, 5] * rx - v[i, 3] * rz
            rate = vx * nx + vy * ny
            force = -(row.guide * d + row.guide_damping * rate)
            spring += 0.5 * row.guide * d * d
            lost += row.guide_damping * rate * rate
            state.rail_force[i, k] = force
            cause = -1
            value = math.nan
            passed = break_passed(model, state, work, i, k)
            sideways = abs(force)
            if model.par[0].truck_play != 0.0:
                sideways += askew_load(model, state, state.q, state.coupler_force, i, k)
            quotient = sideways / max(load, row.weight)
            if not math.isnan(passed):
                cause = BREAK
                value = passed
            elif model.car[i].virtual == 0.0:
                if quotient > model.par[0].lv_limit:
                    if math.isnan(state.over_since[i, k]):
                        state.over_since[i, k] = state.clock[0].t
                    if state.clock[0].t - state.over_since[i, k] >= model.par[0].lv_hold:
                        cause = LATERAL
                        value = quotient
                else:
                    state.over_since[i, k] = math.nan
                if lifted:
                    cause = LIFTED
                elif abs(space.pose[i, 3]) > c.TIPPED:
                    cause = TIPPED
                    value = space.pose[i, 3]
            if cause >= 0 and h > 0.0:
                _find(space, LEFT, i + 1, k, cause, value)
                if model.car[i].virtual == 0.0:
                    state.truck_on[i, k] = 0
                    space.ledger[DAMPERS] += spring  # of the springs that have let go
                    state.rail_force[i, k] = 0.0
                continue
            _push(space, b, rx, ry, rz, force * nx, force * ny, 0.0)
            energy += spring
            damped += lost
    space.ledger[SPRINGS] = energy
    space.ledger[DAMPERS] += h * damped


@inner_jit
def _couplers(model: Model, state: State, work: Work, space: Space) -> None:
    """Strikers (``laws.striker``) and pitch springs between couplers and cars."""
    keep_separate()
    striker = 0.0
    lost = 0.0
    for i in range(state.q.shape[0]):
        row = space.body[i]
        for end in range(2):
            s = model.striker[i, end]
            joint = int(row.hinge_front if end == 0 else row.hinge_rear)
            x = s.arm * space.qpos[_place(space, i, joint)]
            rate = s.arm * space.qvel[joint]
            force = spring_force(x, s.free, s.opening, s.k1, s.k2) + s.damping * rate
            space.qfrc[joint] = -s.arm * force
            work.report[i, layout.R_STRIKER + end] = force
            striker += spring_energy(x, s.free, s.opening, s.k1, s.k2)
            lost += s.damping * rate * rate
            if space.flat[0]:
                continue
            joint += 1
            angle = space.qpos[_place(space, i, joint)]
            rate = space.qvel[joint]
            space.qfrc[joint] = -c.PITCH_STIFFNESS * angle - c.PITCH_DAMPING * rate
            striker += 0.5 * c.PITCH_STIFFNESS * angle * angle
            lost += c.PITCH_DAMPING * rate * rate
    space.ledger[STRIKERS] = striker
    work.power[layout.E_DAMPER] = lost


@inner_jit
def _slide(space: Space, i: int) -> int:
    """Degree of freedom along which the rear coupler of car ``i`` slides, with draft gear."""
    return int(space.body[i].hinge_rear) + (1 if space.flat[0] else 2)


@inner_jit
def _travel(space: Space, i: int) -> float:
    """How much longer than in the middle of its slack the rear coupler of car ``i`` is, m."""
    return space.qpos[_place(space, i, _slide(space, i))]


@inner_jit
def _gear_energy(model: Model, k: int, x: float) -> float:
    """Energy in the draft gear of coupling ``k`` at the travel ``x`` (m), J."""
    link = model.link[k]
    u = abs(x) - 0.5 * link.slack
    if u <= 0.0:
        return 0.0
    hard = max(u - link.travel, 0.0)
    line = loading_energy(u, link.preload, link.stiffness, link.transition)
    return link.unloading * line + 0.5 * link.solid * hard * hard


@jit
def gear_energy(model: Model, state: State, space: Space) -> float:
    """Energy now in the draft gears, J."""
    total = 0.0
    for k in range(state.coupled.shape[0]):
        if state.coupled[k]:
            total += _gear_energy(model, k, _travel(space, k))
    return total


@inner_jit
def _gears(model: Model, state: State, work: Work, space: Space, h: float) -> None:
    """Draft gears between the cars and their rear couplers; parted ones go back to the middle."""
    keep_separate()
    lost = 0.0
    for k in range(state.q.shape[0]):
        joint = _slide(space, k)
        x = _travel(space, k)
        rate = space.qvel[joint]
        if k == state.coupled.shape[0] or state.coupled[k] == 0:
            space.qfrc[joint] = -c.LOOSE_STIFFNESS * x - c.LOOSE_DAMPING * rate
            continue
        tension, back, share = gear_force(model, state, k, x)
        space.qfrc[joint] = -tension
        lost += (tension - back) * rate
        if h > 0.0:
            row = state.coupling[k]
            row.travel0 = row.travel
            row.share0 = row.share
            row.travel = x
            row.share = share
    work.power[layout.E_GEAR] = lost


@inner_jit
def _guide(model: Model, state: State, work: Work, space: Space, h: float) -> None:
    """Rails beside derailed trucks (``forces.guidance``), until they have broken out.

    At the height of the rails, while the truck's wheels are not above them.
    """
    keep_separate()
    par = model.par[0]
    reach = par.guide_play + par.guide_strength / par.guide_stiffness
    v = space.velocity
    lost = 0.0
    for i in range(state.q.shape[0]):
        b = int(space.body[i].body)
        for k in range(2):
            if state.truck_on[i, k] or state.loose[i, k]:
                continue
            arm = model.car[i].truck if k == 0 else -model.car[i].truck
            rx, ry, rz = _turn(space, b, arm, 0.0, -space.body[i].height)
            x = space.xpos[b, 0] + rx
            y = space.xpos[b, 1] + ry
            _, d, heading, _, _ = locate_on(model, i, x, y, state.truck_s[i, k])
            if abs(d) > reach and h > 0.0:
                state.loose[i, k] = 1
            over = abs(d) - par.guide_play
            if over <= 0.0 or state.loose[i, k] or space.xpos[b, 2] + rz > 0.0:
                continue
            f = -math.copysign(min(par.guide_stiffness * over, par.guide_strength), d)
            nx = -math.sin(heading)
            ny = math.cos(heading)
            _push(space, b, rx, ry, rz, f * nx, f * ny, 0.0)
            vx = v[i, 0] + v[i, 4] * rz - v[i, 5] * ry
            vy = v[i, 1] + v[i, 5] * rx - v[i, 3] * rz
            lost -= f * (nx * vx + ny * vy)
    work.power[layout.E_GUIDANCE] = lost


@inner_jit
def _couplings(model: Model, state: State, work: Work, space: Space) -> None:
    """Moments of the knuckles; which couplings part by angle, tension or vertical slip.

    The knuckles resist the angle between the two couplers about the axis across both.
    """
    keep_separate()
    m = space.xmat
    kn = model.knuckle
    space.ledger[KNUCKLES] = 0.0
    for i in range(state.q.shape[0] - 1):
        if state.coupled[i] == 0:
            continue
        a = int(space.body[i].rear)
        b = int(space.body[i + 1].front)
        along = m[a, 0] * m[b, 0] + m[a, 3] * m[b, 3] + m[a, 6] * m[b, 6]
        ux = m[b, 3] * m[a, 6] - m[b, 6] * m[a, 3]
        uy = m[b, 6] * m[a, 0] - m[b, 0] * m[a, 6]
        uz = m[b, 0] * m[a, 3] - m[b, 3] * m[a, 0]
        across = math.sqrt(ux * ux + uy * uy + uz * uz)
        angle = math.atan2(across, along)
        row = kn[i]
        if model.par[0].joint_held != 0.0:
            moment = joint_moment(angle, row.c0, row.c1, row.c2, row.root, row.widening, row.top)
            energy = joint_energy(angle, row.c0, row.c1, row.c2, row.root, row.widening, row.top)
        else:
            moment = knuckle_moment(angle, row.c0, row.c1, row.c2, row.root)
            energy = knuckle_energy(angle, row.c0, row.c1, row.c2, row.root)
        force = state.coupler_force[i]
        line = m[a, 0] * force[0] + m[a, 3] * force[1] + m[a, 6] * space.coupler_lift[i]
        cause = -1
        value = 0.0
        if angle >= row.limit:
            cause = ANGLE
            value = angle
        elif -line >= model.link[i].strength:
            cause = KNUCKLE if model.link[i].part == 0.0 else COUPLER_BODY
            value = -line
        elif not space.flat[0] and not (space.shelf[i, 1] and space.shelf[i + 1, 0]):
            # where the two heads would be, held level in their cars
            first = int(space.body[i].body)
            second = int(space.body[i + 1].body)
            up = space.xpos[a, 2] - model.car[i].rear * m[first, 6]
            down = space.xpos[b, 2] + model.car[i + 1].front * m[second, 6]
            if abs(up - down) > c.KNUCKLE_HEIGHT:
                cause = SLIP
                value = up - down
        if cause >= 0:
            state.coupled[i] = 0
            space.eq_active[i] = False
            if model.par[0].gear != 0.0:
                energy += _gear_energy(model, i, _travel(space, i))
            state.energy[layout.E_KNUCKLE] += energy
            _find(space, PARTED, i + 1, i + 2, cause, value)
            continue
        space.ledger[KNUCKLES] += energy
        if across > 0.0 and moment != 0.0:
            g = moment / across
            work.report[i, layout.R_KNUCKLE] = math.copysign(moment, uz * moment)
            for k, u in ((3, ux), (4, uy), (5, uz)):
                space.xfrc[a, k] += g * u
                space.xfrc[b, k] -= g * u


@inner_jit
def _plane(model: Model, state: State, work: Work, space: Space, h: float) -> None:
    """The planar engine's forces, onto the bodies; their work."""
    keep_separate()
    n = state.q.shape[0]
    t = state.clock[0].t
    q = state.q
    v = state.v
    work.force[:] = 0.0
    brake_forces(model, state, work, t, v)
    if model.par[0].along != 0.0:
        along_forces(model, state, work, t, q, v)
    push_forces(model, state, work, v)
    if space.flat[0]:
        ground_forces(model, state, work, q, v)
    force = work.force
    for i in range(n):
        b = int(space.body[i].body)
        space.xfrc[b, 0] += force[i, 0]
        space.xfrc[b, 1] += force[i, 1]
        space.xfrc[b, 5] += force[i, 2]
    for k in range(layout.N_POWER):
        state.energy[k] += 0.5 * h * (state.power[k] + work.power[k])
        state.power[k] = work.power[k]


@inner_jit
def _sum_wrench(space: Space, i: int, p: Any, f: Any, sign: float) -> None:
    """Add a force at the place ``p`` on car ``i`` to that of the cars that it touches."""
    b = int(space.body[i].body)
    rx = p[0] - space.xpos[b, 0]
    ry = p[1] - space.xpos[b, 1]
    rz = p[2] - space.xpos[b, 2]
    w = space.wrench[2, i]
    w[0] += sign * f[0]
    w[1] += sign * f[1]
    w[2] += sign * f[2]
    w[3] += sign * (ry * f[2] - rz * f[1])
    w[4] += sign * (rz * f[0] - rx * f[2])
    w[5] += sign * (rx * f[1] - ry * f[0])


@jit
def ground_height(d: float) -> tuple[float, float]:
    """Height over the rail, m, and slope of the ground at the offset ``d`` (m) from the track."""
    out = abs(d) - BED_HALF_WIDTH
    if out <= 0.0:
        return -RAIL_HEIGHT, 0.0
    if out * BED_SLOPE >= BED_HEIGHT:
        return -RAIL_HEIGHT - BED_HEIGHT, 0.0
    return -RAIL_HEIGHT - BED_SLOPE * out, -math.copysign(BED_SLOPE, d)


@inner_jit
def _share(d: float, border: float) -> tuple[float, float]:
    """How much of a zone a place has that lies ``d`` (m) within it, and its change with d."""
    if d >= 0.5 * border:
        return 1.0, 0.0
    if d <= -0.5 * border:
        return 0.0, 0.0
    t = d / border + 0.5
    return t * t * (3.0 - 2.0 * t), 6.0 * t * (1.0 - t) / border


@inner_jit
def _zones(model: Model, space: Space, x: float, y: float) -> None:
    """Constants of the ground at a place, its height over the level ground and its slope.

    Into ``space.soil``. The height of a zone is ``r . p - rise[0]``.
    """
    par = model.par[0]
    soil = space.soil
    soil[0] = par.ground_cs
    soil[1] = par.ground_cd
    soil[2] = max(par.ground_eps, c.GROUND_EPS)
    soil[3] = par.ground_cv
    soil[4] = 0.0
    soil[5] = 0.0
    soil[6] = 0.0
    for z in range(model.zone.shape[0]):
        row = model.zone[z]
        wide = space.rise[z, 1]
        half = 0.5 * wide
        if not (row.x0 - half < x < row.x1 + half and row.y0 - half < y < row.y1 + half):
            continue
        first = int(row.first)
        last = int(row.last)
        best = first
        least = math.inf
        foot = 0.0
        for k in range(first, last):
            d2, at, _ = from_edge(model.outline, k, x, y)
            if d2 < least:
                least = d2
                best = k
                foot = at
        d = math.sqrt(least)
        sign = 1.0 if holds(model.outline, first, last, x, y) else -1.0
        edge = model.outline[best]
        nx = -edge.uy
        ny = edge.ux
        if d > 1e-9:
            nx = sign * (x - edge.x - foot * edge.ux) / d
            ny = sign * (y - edge.y - foot * edge.uy) / d
        share, _ = _share(sign * d, par.border)
        soil[0] += share * (row.c_s - soil[0])
        soil[1] += share * (row.c_d - soil[1])
        soil[2] += share * (max(row.eps, c.GROUND_EPS) - soil[2])
        soil[3] += share * (row.c_v - soil[3])
        share, change = _share(sign * d, wide)
        more = row.rise_x * x + row.rise_y * y - space.rise[z, 0] - soil[4]
        soil[5] += share * (row.rise_x - soil[5]) + change * nx * more
        soil[6] += share * (row.rise_y - soil[6]) + change * ny * more
        soil[4] += share * more


@jit
def terrain(model: Model, space: Space, x: float, y: float) -> float:
    """Height of the zones at a place over the level ground, m."""
    _zones(model, space, x, y)
    return float(space.soil[4])


@inner_jit
def _ground(model: Model, state: State, space: Space) -> None:
    """The ground's wrench on each car that is off the rails, and its loads.

    Near rest friction is a damper, at most what stops a small share of the car in a step.
    """
    keep_separate()
    par = model.par[0]
    soil = space.soil
    soil[0] = par.ground_cs
    soil[1] = par.ground_cd
    soil[2] = max(par.ground_eps, c.GROUND_EPS)
    soil[3] = par.ground_cv
    zones = model.zone.shape[0] > 0
    sloped = par.slopes != 0.0
    for kind in range(2):
        for i in range(state.q.shape[0]):
            space.load[i, kind] = 0.0
            for k in range(6):
                space.wrench[kind, i, k] = 0.0
    if space.flat[0]:
        return
    for i in range(state.q.shape[0]):
        if state.truck_on[i, 0] and state.truck_on[i, 1]:
            continue
        b = int(space.body[i].body)
        v = space.velocity[i]
        stiffness = 0.125 * GROUND_STIFFNESS * model.car[i].mass
        damping = 0.125 * GROUND_DAMPING * model.car[i].mass
        for k in range(space.n_points[i]):
            point = space.points[i, k]
            rx, ry, rz = _turn(space, b, point[0], point[1], point[2])
            z = space.xpos[b, 2] + rz
            if z - point[3] > space.crest[0]:
                continue
            end = 0 if point[0] >= 0.0 else 1
            arm = model.car[i].truck if end == 0 else -model.car[i].truck
            tx, ty, _ = _turn(space, b, arm, 0.0, -space.body[i].height)
            lx = space.beside[i, end, 1]
            ly = space.beside[i, end, 2]
            d = space.beside[i, end, 0] + (rx - tx) * lx + (ry - ty) * ly
            level, slope = ground_height(d)
            for t in range(space.lines.shape[0]):
                mx = space.sides[i, end, t, 1]
                my = space.sides[i, end, t, 2]
                d = space.sides[i, end, t, 0] + (rx - tx) * mx + (ry - ty) * my
                bed, fall = ground_height(d)
                if bed > level:
                    level, slope, lx, ly = bed, fall, mx, my
            up = 1.0 / math.sqrt(1.0 + slope * slope)
            depth = point[3] - (z - level) * up
            nx = -slope * up * lx
            ny = -slope * up * ly
            if zones:
                _zones(model, space, space.xpos[b, 0] + rx, space.xpos[b, 1] + ry)
                if sloped:
                    gx = slope * lx + soil[5]
                    gy = slope * ly + soil[6]
                    up = 1.0 / math.sqrt(1.0 + gx * gx + gy * gy)
                    nx = -gx * up
                    ny = -gy * up
                    high = point[3] * min(1.0 / up, 1.5)
                    depth = (level + soil[4] - z + high) / up
            if depth <= 0.0:
                continue
            rx -= point[3] * nx
            ry -= point[3] * ny
            rz -= point[3] * up
            vx = v[0] + v[4] * rz - v[5] * ry
            vy = v[1] + v[5] * rx - v[3] * rz
            vz = v[2] + v[3] * ry - v[4] * rx
            leaving = vx * nx + vy * ny + vz * up
            load = stiffness * depth - damping * leaving
            if load <= 0.0:
                continue
            vx -= leaving * nx
            vy -= leaving * ny
            vz -= leaving * up
            speed = math.sqrt(vx * vx + vy * vy + vz * vz)
            g = load * drag(speed, soil[0], soil[1], soil[2], soil[3])
            g = min(par.ground_scale * g, c.GROUND_HOLD * model.car[i].mass / c.TIME_STEP)
            fx = load * nx - g * vx
            fy = load * ny - g * vy
            fz = load * up - g * vz
            kind = int(point[4])
            space.load[i, kind] += load
            w = space.wrench[kind, i]
            w[0] += fx
            w[1] += fy
            w[2] += fz
            w[3] += ry * fz - rz * fy
            w[4] += rz * fx - rx * fz
            w[5] += rx * fy - ry * fx


@inner_jit
def _touching(space: Space, i: int, j: int) -> int:
    """Row of the pair in the list of touches; the list's end for a new one."""
    for k in range(space.count[0]):
        if space.touch[k].i == i and space.touch[k].j == j:
            return k
    k = space.count[0]
    if k == space.touch.shape[0]:
        return -1
    row = space.touch[k]
    row.i = i
    row.j = j
    row.contact = -1.0
    row.below = -1.0
    row.seen = 0.0
    space.count[0] += 1
    return k


@inner_jit
def _collide(space: Space, i: int, j: int, p: Any, normal: Any, f: Any) -> None:
    """Add a contact's force on car ``j`` to the pair of cars ``i < j`` or ``j < i``."""
    first = min(i, j)
    k = _touching(space, first, max(i, j))
    if k < 0:
        return
    sign = 1.0 if j == first else -1.0
    row = space.touch[k]
    row.fx += sign * f[0]
    row.fy += sign * f[1]
    row.fz += sign * f[2]
    closing = 0.0
    for car in (i, j):
        b = int(space.body[car].body)
        v = space.before[car]
        rx = p[0] - space.xpos[b, 0]
        ry = p[1] - space.xpos[b, 1]
        rz = p[2] - space.xpos[b, 2]
        vx = v[0] + v[4] * rz - v[5] * ry
        vy = v[1] + v[5] * rx - v[3] * rz
        vz = v[2] + v[3] * ry - v[4] * rx
        along = vx * normal[0] + vy * normal[1] + vz * normal[2]
        work = vx * f[0] + vy * f[1] + vz * f[2]
        closing += along if car == i else -along
        row.power += work if car == i else -work
    size = math.sqrt(f[0] * f[0] + f[1] * f[1] + f[2] * f[2])
    if size > row.most:
        row.most = size
        row.x = p[0]
        row.y = p[1]
        row.z = p[2]
        row.nx = sign * normal[0]
        row.ny = sign * normal[1]
        row.nz = sign * normal[2]
        row.closing = closing


@jit
def gather(
    model: Model,
    state: State,
    space: Space,
    h: float,
    equal: I64,
    eq_force: F64,
    geom: Any,
    place: F64,
    frame: F64,
    address: Any,
    force: F64,
) -> None:
    """Forces that MuJoCo found in the step just taken: couplings, contacts and their work.

    ``equal`` (E,) equality of each of the first constraint rows; ``geom`` (C, 2), ``place``
    (C, 3), ``frame`` (C, 9), ``address`` (C,) of the contacts; ``force`` of all constraint rows.
    """
    n = state.q.shape[0]
    for i in range(n):
        for k in range(6):
            space.before[i, k] = space.velocity[i, k]
        _speeds(space, i)
    state.coupler_force[:] = 0.0
    space.coupler_lift[:] = 0.0
    for r in range(0, equal.shape[0] - 2, 3):
        k = equal[r]
        state.coupler_force[k, 0] = eq_force[r]
        state.coupler_force[k, 1] = eq_force[r + 1]
        space.coupler_lift[k] = eq_force[r + 2]
    space.wrench[2] = 0.0
    for k in range(space.count[0]):
        row = space.touch[k]
        row.fx = 0.0
        row.fy = 0.0
        row.fz = 0.0
        row.most = 0.0
        row.power = 0.0
    for k in range(geom.shape[0]):
        a = address[k]
        if a < 0:
            continue
        i = space.geom_car[geom[k, 0]]
        j = space.geom_car[geom[k, 1]]
        f0 = force[a]
        f1 = force[a + 1]
        f2 = force[a + 2]
        e = frame[k]
        f = (
            e[0] * f0 + e[3] * f1 + e[6] * f2,
            e[1] * f0 + e[4] * f1 + e[7] * f2,
            e[2] * f0 + e[5] * f1 + e[8] * f2,
        )
        p = place[k]
        _sum_wrench(space, i, p, f, -1.0)
        _sum_wrench(space, j, p, f, 1.0)
        _collide(space, i, j, p, e, f)
    work = (layout.E_GROUND_TRUCK, layout.E_GROUND_BODY, layout.E_COLLISION)
    for kind in range(3):
        total = 0.0
        for i in range(n):
            for k in range(6):
                total -= (
                    space.wrench[kind, i, k] * 0.5 * (space.before[i, k] + space.velocity[i, k])
                )
        state.energy[work[kind]] += h * total
    if space.wall.shape[0] > 0:
        total = 0.0
        for i in range(n):
            for k in range(6):
                total -= space.wall[i, k] * 0.5 * (space.before[i, k] + space.velocity[i, k])
        state.energy[layout.E_FIXED] += h * total


@inner_jit
def _follow(model: Model, state: State, space: Space, t: float, h: float) -> None:
    """Collisions as events: beginning, peak, end; cars that lie on others."""
    keep_separate()
    par = model.par[0]
    k = 0
    while k < space.count[0]:
        row = space.touch[k]
        i = int(row.i)
        j = int(row.j)
        force = math.sqrt(row.fx * row.fx + row.fy * row.fy + row.fz * row.fz)
        for car, other in ((i, j), (j, i)):
            if force > state.peak[car].force:
                state.peak[car].force = force
                state.peak[car].time = t
                state.peak[car].other = other + 1.0
        if row.contact < 0.0 and force >= par.begin_force:
            n = state.cnt[0].contacts
            state.cnt[0].contacts += 1
            row.contact = n
            row.below = -1.0
            contact = state.contact[n]
            vi = 0.0
            vj = 0.0
            for axis in range(3):
                normal = row.nx if axis == 0 else (row.ny if axis == 1 else row.nz)
                vi -= space.before[i, axis] * normal
                vj += space.before[j, axis] * normal
            contact.a = i + 1.0 if vi >= vj else j + 1.0
            contact.b = j + 1.0 if vi >= vj else i + 1.0
            contact.start = t
            contact.end = math.nan
            contact.closing = row.closing
        if row.contact >= 0.0:
            n = int(row.contact)
            contact = state.contact[n]
            contact.energy += h * row.power
            if force > contact.peak:
                if contact.stage == 1.0 and force > 1.01 * contact.peak:
                    contact.stage = 0.0
                contact.peak = force
                contact.peak_time = t
                contact.resultant = force
                contact.resultant_time = t
                # the corner of the striking car that is nearest
                a = int(contact.a) - 1
                cy = math.cos(state.q[a, 2])
                sy = math.sin(state.q[a, 2])
                dx = row.x - state.q[a, 0]
                dy = row.y - state.q[a, 1]
                corner = 0.0 if dx * cy + dy * sy >= 0.0 else 2.0
                if dy * cy - dx * sy < 0.0:
                    corner += 1.0
                contact.corner_car = contact.a
                contact.corner = corner
                contact.x = row.x
                contact.y = row.y
                sign = 1.0 if a == i else -1.0
                contact.nx = sign * row.nx
                contact.ny = sign * row.ny
                space.height[n, 0] = row.z
                space.height[n, 1] = sign * row.nz
                angle = state.q[i, 2] - state.q[j, 2]
                contact.angle = math.atan2(abs(math.sin(angle)), abs(math.cos(angle)))
            elif contact.stage == 0.0 and force < 0.9 * contact.peak:
                contact.stage = 1.0
                contact.version += 1.0
            if force >= par.end_force:
                row.below = -1.0
            elif row.below < 0.0:
                row.below = t
            elif t - row.below >= par.end_hold:
                contact.end = row.below
                contact.stage = 2.0
                contact.version += 1.0
                row.contact = -1.0
            if row.seen == 0.0 and abs(row.fz) > 0.1 * par.gravity * model.car[i].mass:
                low = j if space.pose[i, 2] > space.pose[j, 2] else i
                high = i + j - low
                apart = space.pose[high, 2] - space.pose[low, 2]
                if apart > c.KNUCKLE_HEIGHT and abs(row.nz) > 0.7:
                    row.seen = 1.0
                    _find(space, OVER, low + 1, high + 1, 0, row.z)
        if row.contact < 0.0 and force == 0.0 and row.seen == 0.0:
            space.count[0] -= 1
            if k < space.count[0]:
                space.touch[k] = space.touch[space.count[0]]
            continue
        k += 1


@inner_jit
def _fallen(space: Space) -> None:
    """Cars that have come onto their side."""
    for i in range(space.pose.shape[0]):
        b = int(space.body[i].body)
        tilt = math.acos(min(1.0, max(-1.0, space.xmat[b, 8])))
        if tilt > c.ON_SIDE and space.fell[i, 0] == 0:
            space.fell[i, 0] = 1
            _find(space, SIDE, i + 1, 0, 0, space.pose[i, 3])
        elif tilt < 0.5 * c.ON_SIDE:
            space.fell[i, 0] = 0


@inner_jit
def _still(state: State, space: Space) -> bool:
    """No car rolls, pitches, rises or falls."""
    for i in range(space.rates.shape[0]):
        if abs(space.rates[i, 2]) > 0.3 or abs(space.velocity[i, 3]) > 0.1:
            return False
    return True


@inner_jit
def _potential(model: Model, space: Space) -> float:
    """Potential energy of gravity over that of all cars at rest on the rails, J."""
    total = 0.0
    for i in range(space.pose.shape[0]):
        rise = space.pose[i, 2] - space.body[i].height
        total += model.car[i].mass * model.par[0].gravity * rise
    return total


@inner_jit
def _generalize(space: Space, i: int) -> None:
    """Forces of car ``i`` and torques of its couplers along their degrees of freedom.

    MuJoCo's own ``xfrc_applied`` makes a Jacobian of each body, which takes longer than the step.
    """
    row = space.body[i]
    a = int(row.qvel)
    b = int(row.body)
    m = space.xmat
    f = space.xfrc[b]
    torque = (f[3], f[4], f[5])
    for end in range(2):
        joint = int(row.hinge_front if end == 0 else row.hinge_rear)
        c0 = int(row.front if end == 0 else row.rear)
        t = space.xfrc[c0]
        space.qfrc[joint] += t[3] * m[b, 2] + t[4] * m[b, 5] + t[5] * m[b, 8]
        if space.flat[0] == 0:
            space.qfrc[joint + 1] += t[3] * m[c0, 1] + t[4] * m[c0, 4] + t[5] * m[c0, 7]
        torque = (torque[0] + t[3], torque[1] + t[4], torque[2] + t[5])
    space.qfrc[a] = f[0]
    space.qfrc[a + 1] = f[1]
    if space.flat[0]:
        space.qfrc[a + 2] = torque[2]
        return
    space.qfrc[a + 2] = f[2]
    for k in range(3):
        turned = m[b, k] * torque[0] + m[b, 3 + k] * torque[1] + m[b, 6 + k] * torque[2]
        space.qfrc[a + 3 + k] = turned


@jit
def push(model: Model, state: State, work: Work, space: Space, h: float) -> None:
    """Forces of the next step from the state as it stands, after ``h`` s (0: anew)."""
    space.xfrc[:] = 0.0
    look(model, state, work, space)
    state.clock[0].t_on = state.clock[0].t
    space.count[1] = 0
    _rails(model, state, work, space, h)
    work.report[:] = 0.0
    work.power[:] = 0.0
    _couplers(model, state, work, space)
    if model.par[0].gear != 0.0:
        _gears(model, state, work, space, h)
    if model.par[0].guide_strength != 0.0:
        _guide(model, state, work, space, h)
    _couplings(model, state, work, space)
    _plane(model, state, work, space, h)
    _ground(model, state, space)
    for i in range(state.q.shape[0]):
        b = int(space.body[i].body)
        for k in range(6):
            space.xfrc[b, k] += space.wrench[0, i, k] + space.wrench[1, i, k]
        _generalize(space, i)
    space.ledger[GRAVITY] = 0.0 if space.flat[0] else _potential(model, space)


@jit
def observe(model: Model, state: State, work: Work, space: Space, h: float) -> bool:
    """After MuJoCo's step: the state, the next forces, what has happened; False: not finite."""
    push(model, state, work, space, h)
    for i in range(state.q.shape[0]):
        if not math.isfinite(space.pose[i, 0] + space.pose[i, 2] + space.velocity[i, 5]):
            return False
    note_coupling_forces(state)
    _follow(model, state, space, state.clock[0].t, h)
    _fallen(space)
    if not _still(state, space):
        state.clock[0].rest_since = -1.0
    note_progress(model, state, work)
    if state.cnt[0].status != layout.RUNNING:
        for k in range(space.count[0]):
            n = int(space.touch[k].contact)
            if n >= 0:
                state.contact[n].end = state.clock[0].t
                state.contact[n].stage = 2.0
                state.contact[n].version += 1.0
                space.touch[k].contact = -1.0
    return True
