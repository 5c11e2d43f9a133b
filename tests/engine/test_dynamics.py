"""Motion against models derived and integrated in other ways."""

import math

import numpy as np
import pytest

from derail_ros.engine import PlanarSimulation
from derail_ros.vocabulary.params import (
    BrakeTrigger,
    GroundParams,
    LateralForce,
    TrackParams,
    TrackSegment,
)
from tests.engine.reference import KNUCKLE, Reference, knuckle
from tests.engine.support import (
    NO_CONTACT,
    all_trucks,
    free_train,
    kicked,
    make_car,
    make_train,
    mixed_cars,
    relative,
    start,
    tight,
)

# A closed solution -----------------------------------------------------------------------------


def struck_chain(masses, inertia_of_couplers):
    """Velocities after a short transverse blow at the head of a chain at rest (1 m/s for 1 t)."""
    blow = 1e-6
    cars = tuple(
        make_car(
            i,
            mass=m,
            inertia=m * 12.0**2 / 12.0,
            length=12.0,
            pivot_distance=6.0,
            truck_distance=6.0,
            coupler_inertia=inertia_of_couplers,
        )
        for i, m in enumerate(masses)
    )
    push = LateralForce(force=1000.0 / blow, duration=blow)
    params = free_train(cars, speed=0.0, lateral=(push,), contact=NO_CONTACT)
    run = PlanarSimulation(params)
    run.advance_to(blow)
    assert run.time == blow
    return params, run.sample()


@pytest.mark.parametrize(
    "masses",
    [
        [75e3] * 6,  # 450 t of equal cars
        [75e3] * 20,
        [120e3, 90e3, 30e3, 60e3, 30e3],  # heavy cars near the blow
    ],
)
def test_joint_velocities_of_struck_bars(masses):
    # Couplers too heavy to turn make the joints of a chain of uniform bars. After a blow P at
    # the head, momentum and moment of momentum of each bar give a tridiagonal system for the
    # transverse velocities u of the joints: m/6 (u[k-1] + 2 u[k]) + m'/6 (2 u[k] + u[k+1]) = 0.
    _, sample = struck_chain(masses, 1e18)
    n = len(masses)
    matrix = np.zeros((n + 1, n + 1))
    for k, m in enumerate(masses):
        matrix[k : k + 2, k : k + 2] += m / 6.0 * np.array([[2.0, 1.0], [1.0, 2.0]])
    joints = np.linalg.solve(matrix, np.eye(n + 1)[0] * 1000.0)
    # the head of each car, and the tail of the last
    heads = sample.v[:, 1] + 6.0 * sample.v[:, 2]
    tails = sample.v[:, 1] - 6.0 * sample.v[:, 2]
    assert heads == pytest.approx(joints[:-1], abs=1e-6 * joints[0])
    assert tails == pytest.approx(joints[1:], abs=1e-6 * joints[0])
    if len(set(masses)) == 1:
        # far from the tail each joint moves against the last, 2 - sqrt(3) times as fast
        ratio = heads[1:5] / heads[:4]
        assert ratio[:-1] == pytest.approx(math.sqrt(3.0) - 2.0, abs=2e-3)


def test_velocities_of_a_struck_train():
    # with couplers that turn: the dense impulsive equations at the straight position
    params, sample = struck_chain([75e3, 60e3, 40e3, 90e3, 75e3], 20e3)
    reference = Reference(params)
    impulse = np.zeros((5, 5))
    impulse[0, 1] = 1000.0
    impulse[0, 2] = 6000.0
    home = PlanarSimulation(params).sample()
    jacobian = reference.jacobian(home.q)
    velocity, _ = reference.solve(impulse, jacobian, np.zeros(len(jacobian)))
    assert relative(sample.v, velocity, 1e-9) < 1e-5
    # the couplers take part: not the bars' answer
    _, bars = struck_chain([75e3, 60e3, 40e3, 90e3, 75e3], 1e18)
    assert relative(sample.v, bars.v, 1e-9) > 1e-2


# Lagrange's equations, derived by sympy --------------------------------------------------------


def lagrangian(params):
    """Functions M^-1 data of three cars, cars 2 and 3 on straight rails, from the Lagrangian."""
    import sympy as sp

    t = sp.Symbol("t")
    names = ("x", "y", "theta", "alpha", "beta")
    q = [[sp.Function(f"{name}{i}")(t) for name in names] for i in range(3)]
    flat = [c for car in q for c in car]
    kinetic = potential = dissipation = sp.Integer(0)
    for (x, y, theta, alpha, beta), c in zip(q, params.cars):
        kinetic += c.mass * (x.diff(t) ** 2 + y.diff(t) ** 2) / 2
        kinetic += c.inertia * theta.diff(t) ** 2 / 2
        kinetic += c.coupler_inertia * (alpha.diff(t) ** 2 + beta.diff(t) ** 2) / 2
        for angle, e in ((alpha, c.front), (beta, c.rear)):
            stretch = e.striker_arm * (angle - theta)
            potential += e.k1 * stretch**2 / 2
            dissipation += e.damping * stretch.diff(t) ** 2 / 2
    rows = []
    for i in (1, 2):
        for r in (1, -1):
            rows.append(q[i][1] + r * params.cars[i].truck_distance * sp.sin(q[i][2]))
    for i in range(2):
        a, b = params.cars[i], params.cars[i + 1]
        for k, trig in ((0, sp.cos), (1, sp.sin)):
            rear = q[i][k] - a.pivot_distance * trig(q[i][2]) - a.rear.length * trig(q[i][4])
            front = q[i + 1][k] + b.pivot_distance * trig(q[i + 1][2])
            front += b.front.length * trig(q[i + 1][3])
            rows.append(rear - front)
    phi = sp.Matrix(rows)
    rates = [c.diff(t) for c in flat]
    second = [c.diff(t, 2) for c in flat]
    jacobian = phi.jacobian(flat)
    gamma = -(phi.diff(t, 2).subs(dict.fromkeys(second, 0)))
    total = kinetic - potential
    equations = sp.Matrix(
        [total.diff(r).diff(t) - total.diff(c) + dissipation.diff(r) for c, r in zip(flat, rates)]
    )
    # equations = M qdd + rest = J^T lambda
    mass = equations.jacobian(second)
    rest = equations.subs(dict.fromkeys(second, 0))
    plain_q, plain_v = sp.symbols("q:15"), sp.symbols("v:15")
    names = {**dict(zip(rates, plain_v)), **dict(zip(flat, plain_q))}
    out = [m.subs(dict(zip(rates, plain_v))).subs(dict(zip(flat, plain_q)))
           for m in (mass, rest, jacobian, gamma, phi)]  # fmt: skip
    assert len(names) == 30
    return sp.lambdify((plain_q, plain_v), out, cse=True)


def test_three_cars_derived_with_sympy():
    from scipy.integrate import solve_ivp

    params = make_train(
        mixed_cars(3),
        speed=2.0,
        derailed=all_trucks(1),
        ground=GroundParams(scale=0.0),
        contact=NO_CONTACT,
    )
    model = lagrangian(params)
    run = kicked(tight(params), seed=4)
    q0, v0 = run.sample().q, run.sample().v

    def accelerations(q, v):
        mass, rest, jacobian, gamma, _ = model(q, v)
        m = len(gamma)
        kkt = np.block([[mass, -jacobian.T], [jacobian, np.zeros((m, m))]])
        # rows of very different units: scale them to one
        size = 1.0 / np.sqrt(np.abs(np.diag(mass)))
        size = np.concatenate([size, np.full(m, 1.0 / size.mean())])
        x = np.linalg.solve(
            size[:, None] * kkt * size, size * np.concatenate([-rest, gamma]).ravel()
        )
        return (size * x)[:15], (size * x)[15:]

    # the state meets the constraints as sympy writes them
    assert np.abs(model(q0.ravel(), v0.ravel())[4]).max() < 1e-9
    assert np.abs(model(q0.ravel(), v0.ravel())[2] @ v0.ravel()).max() < 1e-9
    a, multipliers = accelerations(q0.ravel(), v0.ravel())
    sample = run.sample()
    assert relative(sample.a, a.reshape(3, 5)) < 1e-9
    assert relative(sample.rail_force[1:], multipliers[:4].reshape(2, 2)) < 1e-9
    assert relative(sample.coupler_force, multipliers[4:].reshape(2, 2)) < 1e-9

    def rhs(t, y):
        return np.concatenate([y[15:], accelerations(y[:15], y[15:])[0]])

    y0 = np.concatenate([q0.ravel(), v0.ravel()])
    end = solve_ivp(rhs, (0.0, 1.5), y0, method="DOP853", rtol=1e-11, atol=1e-12).y[:, -1]
    run.advance_to(1.5)
    after = run.sample(1.5)
    # it has moved well away, within the springs' first stiffness and below the knuckles' root
    assert np.abs(after.q - q0)[:, 2:].max() > 0.05
    for i, c in enumerate(params.cars):
        stretch = c.front.striker_arm * (after.q[i, 3:] - after.q[i, 2])
        assert np.abs(stretch).max() < 0.15
    assert np.abs(after.relative_angle).max() < 0.21
    assert np.abs(after.q.ravel() - end[:15]).max() < 1e-7
    assert np.abs(after.v.ravel() - end[15:]).max() < 1e-6


# The second model, integrated by another method ------------------------------------------------


@pytest.mark.parametrize(
    "track",
    [
        None,
        TrackParams(
            segments=(TrackSegment(150.0), TrackSegment(60.0, 0.0, 1 / 300), TrackSegment(90.0))
        ),
    ],
    ids=["straight", "spiral"],
)
def test_the_first_seconds_of_a_derailment(track):
    # brakes, ground, strikers, knuckles, trucks passing a break
    here = 0.0 if track is None else 170.0
    lateral = (LateralForce(),) if track is None else ()
    params = make_train(
        3,
        speed=60.0 / 3.6,
        position=here,
        derailed=((1, "front"), (1, "rear")),
        breaks=(here - 8.0,),
        lateral=lateral,
        triggers=(BrakeTrigger(),),
        track=track,
    )
    run = PlanarSimulation(tight(params))
    home = run.sample()
    q, v, passed = Reference(params).run(home.q, home.v, 1.0)
    run.advance_to(1.0)
    sample = run.sample(1.0)
    assert not run.collisions
    assert np.abs(sample.q - q).max() < 1e-6
    assert np.abs(sample.v - v).max() < 1e-5
    events = [e for e in run.events if e.cause == "rail break" and e.end]
    assert [(e.cars[0], e.end) for e in events] == [p[1:] for p in passed]
    assert len(passed) == 2
    assert [e.time for e in events] == pytest.approx([p[0] for p in passed], abs=1e-7)
    assert np.abs(sample.q[0, 2]) > 1e-3


@pytest.mark.slow
def test_the_first_seconds_of_a_long_derailment():
    params = make_train(
        mixed_cars(12),
        speed=72.0 / 3.6,
        derailed=((1, "front"), (1, "rear")),
        breaks=(0.0,),
        lateral=(LateralForce(),),
        triggers=(BrakeTrigger(),),
    )
    run = PlanarSimulation(tight(params))
    home = run.sample()
    q, v, passed = Reference(params).run(home.q, home.v, 2.2)
    run.advance_to(2.2)
    sample = run.sample(2.2)
    assert np.abs(sample.q - q).max() < 1e-6
    assert np.abs(sample.v - v).max() < 1e-5
    assert len(passed) >= 5


def test_a_collision_in_the_second_model():
    # two free cars, one yawed, run into each other and part again
    params = free_train(2, parted=(1,), speed=0.0)
    q = np.zeros((2, 5))
    q[1] = [-16.0, 0.9, 0.1, 0.1, 0.1]
    v = np.zeros((2, 5))
    v[1, 0] = 3.0
    run = start(tight(params), q, v)
    run.advance_to(1.5)
    sample = run.sample(1.5)
    (collision,) = run.collisions
    assert collision.final
    assert collision.peak_force > 1e6
    end_q, end_v, _ = Reference(params).run(q, v, 1.5, max_step=0.02)
    assert np.abs(sample.q - end_q).max() < 1e-6
    assert np.abs(sample.v - end_v).max() < 1e-5


# MuJoCo ----------------------------------------------------------------------------------------


def mujoco_chain(cars):
    """The chain as a tree of hinges: its joints are exact, and no multipliers are needed."""
    import mujoco

    tiny = "1e-5"

    def striker(end):
        arm = end.striker_arm**2
        return f'stiffness="{end.k1 * arm}" damping="{end.damping * arm}"'

    def coupler(name, at, inertia, joint, inside):
        half = 0.5 * inertia
        return f"""<body name="{name}" pos="{at} 0 0">
            <joint name="{name}" type="hinge" axis="0 0 1" {joint}/>
            <inertial pos="0 0 0" mass="{tiny}" diaginertia="{half} {half} {inertia}"/>
            {inside}</body>"""

    def car(i):
        c = cars[i]
        half = 0.5 * c.inertia
        inertial = (
            f'<inertial pos="0 0 0" mass="{c.mass}" diaginertia="{half} {half} {c.inertia}"/>'
        )
        behind = ""
        if i + 1 < len(cars):
            d = cars[i + 1]
            # rear coupler of this car, front coupler of the next, the next car
            next_car = f"""<body name="car{i + 1}" pos="{-d.front.length - d.pivot_distance} 0 0">
                <joint name="car{i + 1}" type="hinge" axis="0 0 1" pos="{d.pivot_distance} 0 0"
                 {striker(d.front)}/>{car(i + 1)}</body>"""
            front = coupler(f"front{i + 1}", -c.rear.length, d.coupler_inertia, "", next_car)
            rear = striker(c.rear)
            behind = coupler(f"rear{i}", -c.pivot_distance, c.coupler_inertia, rear, front)
        else:
            rear = striker(c.rear)
            behind = coupler(f"rear{i}", -c.pivot_distance, c.coupler_inertia, rear, "")
        return inertial + behind

    lead = cars[0]
    first = coupler("front0", lead.pivot_distance, lead.coupler_inertia, striker(lead.front), "")
    xml = f"""<mujoco><compiler angle="radian" balanceinertia="false" boundmass="0"/>
      <option gravity="0 0 0" integrator="RK4" timestep="1e-3"><flag contact="disable"/></option>
      <worldbody><body name="car0">
        <joint name="x" type="slide" axis="1 0 0"/><joint name="y" type="slide" axis="0 1 0"/>
        <joint name="car0" type="hinge" axis="0 0 1"/>
        {car(0)}{first}
      </body></worldbody></mujoco>"""
    return mujoco, mujoco.MjModel.from_xml_string(xml)


@pytest.mark.slow
@pytest.mark.parametrize("ground", [0.0, 1.0])
def test_twenty_cars_in_mujoco(ground):
    n = 20
    cars = mixed_cars(n)
    mujoco, model = mujoco_chain(cars)
    law = GroundParams(scale=ground)
    params = free_train(cars, speed=12.0, ground=law, contact=NO_CONTACT)
    run = kicked(tight(params, rtol=1e-11), seed=8, angle=0.01, rate=0.1)
    home = run.sample()
    data = mujoco.MjData(model)
    joint = {model.joint(k).name: model.joint(k).qposadr[0] for k in range(model.njnt)}
    body = [model.body(f"car{i}").id for i in range(n)]

    # joint angles and rates from the absolute ones, front to rear
    for source, target in ((home.q, data.qpos), (home.v, data.qvel)):
        target[joint["x"]], target[joint["y"]] = source[0, :2]
        target[joint["car0"]] = source[0, 2]
        target[joint["front0"]] = source[0, 3] - source[0, 2]
        for i in range(n):
            target[joint[f"rear{i}"]] = source[i, 4] - source[i, 2]
            if i:
                target[joint[f"front{i}"]] = source[i, 3] - source[i - 1, 4]
                target[joint[f"car{i}"]] = source[i, 2] - source[i, 3]

    def forces(m, d):
        # knuckles, and the ground reaction at both trucks of each car
        jac = np.zeros((3, m.nv))
        for i, c in enumerate(cars):
            if i:
                heads = "".join(sorted(cars[i - 1].rear.head + c.front.head))
                moment = knuckle(-d.qpos[joint[f"front{i}"]], *KNUCKLE[heads])
                d.qfrc_passive[joint[f"front{i}"]] -= moment
            if not ground:
                continue
            axis = d.xmat[body[i]].reshape(3, 3)[:, 0]
            for r in (c.truck_distance, -c.truck_distance):
                place = d.xpos[body[i]] + r * axis
                mujoco.mj_jac(m, d, jac, None, place, body[i])
                u = (jac @ d.qvel)[:2]
                speed = math.hypot(*u)
                k = law.c_d + (law.c_s - law.c_d) * math.exp(-speed / law.eps) + law.c_v * speed
                f = -0.5 * c.mass * 9.81 * k * u / math.hypot(speed, law.eps)
                d.qfrc_passive[:] += jac[:2].T @ f

    mujoco.mj_forward(model, data)
    centres = np.array([data.xpos[b][:2] for b in body])
    assert np.abs(centres - home.q[:, :2]).max() < 1e-8
    try:
        mujoco.set_mjcb_passive(forces)
        until = 1.0 if ground else 2.0
        mujoco.mj_step(model, data, nstep=round(until / model.opt.timestep))
    finally:
        mujoco.set_mjcb_passive(None)
    mujoco.mj_forward(model, data)
    assert data.time == pytest.approx(until)
    run.advance_to(until)
    sample = run.sample(until)
    centres = np.array([data.xpos[b][:2] for b in body])
    yaw = np.array([math.atan2(data.xmat[b][3], data.xmat[b][0]) for b in body])
    # strikers within their first stiffness, which is all that MuJoCo's springs know
    for i, c in enumerate(cars):
        for angle, e in ((sample.q[i, 3], c.front), (sample.q[i, 4], c.rear)):
            assert abs(e.striker_arm * (angle - sample.q[i, 2])) < e.striker_opening
    assert (np.abs(sample.knuckle_moment).max() > 0.0) == (ground == 0.0)
    assert np.abs(sample.q - home.q)[:, 2].max() > 0.02
    assert np.abs(centres - sample.q[:, :2]).max() < 1e-5
    assert np.abs(yaw - sample.q[:, 2]).max() < 1e-6
