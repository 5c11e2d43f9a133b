"""A planar chain of rigid bars in four engines, for work-precision figures.

100 bars of 100 t, 18 m between the pins at their ends, without contacts, at 20 m/s along x with
lateral velocities of the pins from ``chain_lateral.csv``; 8 MN against the motion at the centre of
bar 1 for 10 s. ``python chain.py ENGINE SETTING`` computes it once and prints a line of JSON: wall
time of the integration, that of import and set-up (of this engine with loading its kernels, which
are compiled before), largest distance between two pins that are one, and the error of the energy
balance relative to the energy at the start.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

BEGAN = time.perf_counter()

import numpy as np  # noqa: E402

LENGTH, MASS, SPEED, FORCE, END = 18.0, 100e3, 20.0, 8e6, 10.0
INERTIA = MASS * LENGTH**2 / 12.0
PINS = np.loadtxt(Path(__file__).with_name("chain_lateral.csv"), delimiter=",", comments="#")

# Three settings or more of each engine, from coarse to fine.
SETTINGS: dict[str, list[tuple[Any, ...]]] = {
    # method, rtol
    "derail_ros": [
        ("row", 1e-2), ("row", 1e-3), ("row", 1e-4),
        ("rkf45", 1e-4), ("rkf45", 1e-6), ("rkf45", 1e-8), ("rkf45", 1e-10),
    ],
    # step (s); the stiffest constraints it allows
    "mujoco": [(8e-3,), (2e-3,), (5e-4,)],
    # step (s), iterations of the solver
    "pymunk": [(1e-2, 20), (2e-3, 50), (5e-4, 100)],
    # step (s); generalized alpha with spectral radius 0.9
    "exudyn": [(2e-2,), (5e-3,), (1e-3,)],
}  # fmt: skip


def start(bars: int = 100) -> tuple[np.ndarray, np.ndarray]:
    """Centres' (x, y, angle) and their rates; bar 1 is at the origin, the others behind it."""
    q = np.zeros((bars, 3))
    q[:, 0] = -LENGTH * np.arange(bars)
    head, tail = PINS[:bars], PINS[1 : bars + 1]
    v = np.stack([np.full(bars, SPEED), 0.5 * (head + tail), (head - tail) / LENGTH], axis=1)
    return q, v


def gap(q: np.ndarray) -> float:
    """Largest distance between the two pins of a joint, m."""
    arm = 0.5 * LENGTH * np.stack([np.cos(q[:, 2]), np.sin(q[:, 2])], axis=1)
    return float(np.hypot(*((q[:-1, :2] - arm[:-1]) - (q[1:, :2] + arm[1:])).T).max())


def energy(v: np.ndarray) -> float:
    """Kinetic energy, J."""
    return float(0.5 * (MASS * (v[:, :2] ** 2).sum() + INERTIA * (v[:, 2] ** 2).sum()))


def report(wall: float, worst: float, q: np.ndarray, v: np.ndarray) -> dict[str, float]:
    q0, v0 = start(len(q))
    work = -FORCE * (q[0, 0] - q0[0, 0])
    error = abs(energy(v) - energy(v0) - work) / energy(v0)
    return {"wall_s": wall, "gap_m": worst, "energy_error": error}


def derail_ros(method: str, rtol: float, bars: int = 100, end: float = END) -> dict[str, float]:
    run = chain_run(method, rtol, bars, end)
    began = time.perf_counter()
    run.advance_to(end)
    wall = time.perf_counter() - began
    s = run.sample()
    out = report(wall, run.outcome().max_coupler_gap, s.plane, s.velocity[:, [0, 1, 5]])
    return {**out, **run.statistics}


def chain_run(method: str, rtol: float, bars: int, end: float) -> Any:
    """The chain as a train off the rails on ground without friction."""
    from derail_ros.engine import PlanarSimulation
    from derail_ros.vocabulary.params import (
        BrakeParams,
        Car,
        ContactParams,
        CouplerType,
        DerailmentParams,
        GroundParams,
        InitiationParams,
        IntegrationParams,
        LateralForce,
        TrainParams,
    )

    # couplers without length: the pins are at the ends; nothing turns their bodies
    tiny = 1e-9
    pin = CouplerType("pin", "F", tiny, tiny, 1.0, tiny, tiny, 0.0)
    car = Car(
        mass=MASS, inertia=INERTIA, length=0.1, width=0.1, pivot_distance=0.5 * LENGTH - tiny,
        truck_distance=0.05, front=pin, rear=pin, brakes=(),
    )  # fmt: skip
    trucks = tuple((i + 1, side) for i in range(bars) for side in ("front", "rear"))
    params = TrainParams(
        cars=(car,) * bars,
        initiation=InitiationParams(
            speed=SPEED,
            derailed_trucks=trucks,
            lateral_forces=(LateralForce(force=FORCE, place="centre", duration=2.0 * end),),
        ),
        brakes=BrakeParams(triggers=()),
        ground=GroundParams(scale=0.0),
        # no contacts, and no cap on the steps that matters
        contact=ContactParams(buffer=8.0, force_max=1e-6),
        derailment=DerailmentParams(knuckle_limit_ff=1e9),
        integration=IntegrationParams(
            method=method,
            rtol=rtol,
            buffer_fraction=0.5,
            max_step=0.2,
            time_limit=2.0 * end,
            locate_crossings=False,
        ),
    )
    run = PlanarSimulation(params)
    # The scenarios' forces are lateral and their trains start along the line.
    q, v = start(bars)
    run._model.lateral["fx"], run._model.lateral["fy"] = -FORCE, 0.0
    run._state.v[:, :3] = v
    run._state.v0[...] = run._state.v
    if not run._evaluate():
        raise RuntimeError("singular")
    return run


def mujoco(step: float) -> dict[str, float]:
    import mujoco as mj

    q, v = start()
    half = 0.5 * LENGTH
    bodies = "".join(
        f'<body name="b{i}" pos="{x} 0 0"><joint type="slide" axis="1 0 0"/>'
        '<joint type="slide" axis="0 1 0"/><joint type="hinge" axis="0 0 1"/>'
        f'<inertial pos="0 0 0" mass="{MASS}" diaginertia="{INERTIA} {INERTIA} {INERTIA}"/></body>'
        for i, x in enumerate(q[:, 0])
    )
    # stiffest allowed: a time constant of two steps
    joints = "".join(
        f'<connect body1="b{i}" body2="b{i + 1}" anchor="{-half} 0 0" solref="{2 * step} 1" '
        'solimp="0.9999 0.9999 0.001"/>'
        for i in range(len(q) - 1)
    )
    model = mj.MjModel.from_xml_string(
        f'<mujoco><option timestep="{step}" gravity="0 0 0" solver="Newton" jacobian="sparse" '
        'integrator="implicitfast" tolerance="1e-12"><flag contact="disable"/></option>'
        f'<size memory="200M"/><worldbody>{bodies}</worldbody>'
        f"<equality>{joints}</equality></mujoco>"
    )
    data = mj.MjData(model)
    data.qvel[:] = v.ravel()
    data.xfrc_applied[1, 0] = -FORCE
    worst = 0.0
    wall = 0.0
    for _ in range(round(END / 0.1)):
        began = time.perf_counter()
        mj.mj_step(model, data, nstep=round(0.1 / step))
        wall += time.perf_counter() - began
        now = q + data.qpos.reshape(-1, 3)
        worst = max(worst, gap(now))
    return report(wall, worst, now, data.qvel.reshape(-1, 3))


def pymunk(step: float, iterations: int) -> dict[str, float]:
    import pymunk as pm

    q, v = start()
    half = 0.5 * LENGTH
    space = pm.Space()
    space.iterations = iterations
    bodies = []
    for (x, y, _), (vx, vy, w) in zip(q, v):
        body = pm.Body(MASS, INERTIA)
        body.position, body.velocity, body.angular_velocity = (x, y), (vx, vy), w
        bodies.append(body)
    space.add(*bodies)
    for a, b in zip(bodies, bodies[1:]):
        joint = pm.PivotJoint(a, b, (-half, 0.0), (half, 0.0))
        space.add(joint)
    worst = 0.0
    wall = 0.0
    for _ in range(round(END / 0.1)):
        began = time.perf_counter()
        for _ in range(round(0.1 / step)):
            bodies[0].apply_force_at_world_point((-FORCE, 0.0), bodies[0].position)
            space.step(step)
        wall += time.perf_counter() - began
        now = np.array([(*b.position, b.angle) for b in bodies])
        worst = max(worst, gap(now))
    rates = np.array([(*b.velocity, b.angular_velocity) for b in bodies])
    return report(wall, worst, now, rates)


def exudyn(step: float) -> dict[str, float]:
    import exudyn as exu
    from exudyn.itemInterface import (
        LoadForceVector,
        MarkerBodyPosition,
        MarkerBodyRigid,
        NodeRigidBody2D,
        ObjectJointRevolute2D,
        ObjectRigidBody2D,
    )

    q, v = start()
    half = 0.5 * LENGTH
    system = exu.SystemContainer()
    mbs = system.AddSystem()
    nodes, bodies = [], []
    for place, rate in zip(q, v):
        node = mbs.AddNode(
            NodeRigidBody2D(referenceCoordinates=list(place), initialVelocities=list(rate))
        )
        nodes.append(node)
        bodies.append(
            mbs.AddObject(
                ObjectRigidBody2D(physicsMass=MASS, physicsInertia=INERTIA, nodeNumber=node)
            )
        )
    for a, b in zip(bodies, bodies[1:]):
        pins = [
            mbs.AddMarker(MarkerBodyPosition(bodyNumber=n, localPosition=[x, 0.0, 0.0]))
            for n, x in ((a, -half), (b, half))
        ]
        mbs.AddObject(ObjectJointRevolute2D(markerNumbers=pins))
    centre = mbs.AddMarker(MarkerBodyRigid(bodyNumber=bodies[0], localPosition=[0.0, 0.0, 0.0]))
    mbs.AddLoad(LoadForceVector(markerNumber=centre, loadVector=[-FORCE, 0.0, 0.0]))
    mbs.Assemble()
    settings = exu.SimulationSettings()
    settings.timeIntegration.numberOfSteps = round(END / step)
    settings.timeIntegration.endTime = END
    settings.timeIntegration.generalizedAlpha.spectralRadius = 0.9
    settings.timeIntegration.verboseMode = 0
    settings.solutionSettings.writeSolutionToFile = False
    settings.linearSolverType = exu.LinearSolverType.EigenSparse
    worst = 0.0

    def look(mbs: Any, t: float) -> bool:
        nonlocal worst
        if round(t / step) % round(0.1 / step) == 0:
            worst = max(worst, gap(q + mbs.systemData.GetODE2Coordinates().reshape(-1, 3)))
        return True

    mbs.SetPreStepUserFunction(look)
    began = time.perf_counter()
    mbs.SolveDynamic(settings, solverType=exu.DynamicSolverType.GeneralizedAlpha)
    wall = time.perf_counter() - began
    now = q + mbs.systemData.GetODE2Coordinates().reshape(-1, 3)
    return report(wall, max(worst, gap(now)), now,
                  mbs.systemData.GetODE2Coordinates_t().reshape(-1, 3))  # fmt: skip


ENGINES = {"derail_ros": derail_ros, "mujoco": mujoco, "pymunk": pymunk, "exudyn": exudyn}

if __name__ == "__main__":
    name, index = sys.argv[1], int(sys.argv[2])
    setting = SETTINGS[name][index]
    if name == "derail_ros":
        ENGINES[name](setting[0], 1e-2, end=0.1)  # load the kernels
    result = ENGINES[name](*setting)
    result["setup_s"] = time.perf_counter() - BEGAN - result["wall_s"]
    print(json.dumps({"engine": name, "setting": setting, **result}))
