"""Trains for the tests, and the only handles on the engine's private parts.

`place` puts a run into any state; all else the tests ask of it goes through its public methods.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from derail_ros.engine import PlanarSimulation
from derail_ros.engine.dynamics import project_positions, project_velocities
from derail_ros.engine.energy import stored_energy
from derail_ros.engine.neighbours import rebuild
from derail_ros.vocabulary.params import (
    BrakeParams,
    BrakeUnit,
    Car,
    ContactParams,
    CouplerType,
    GroundParams,
    InitiationParams,
    TrackParams,
    TrackSegment,
    TrainParams,
)

# The source's coupler table: d_C, d_st, d_so (m), k1 (N/m).
COUPLERS = {
    "E60": CouplerType("E60", "E", 0.851, 0.546, 0.150, 2.18e6),
    "E67": CouplerType("E67", "E", 0.940, 0.635, 0.150, 2.54e6),
    "E68": CouplerType("E68", "E", 1.092, 0.788, 0.260, 3.15e6),
    "E69": CouplerType("E69", "E", 1.524, 1.220, 0.390, 4.88e6),
    "F70": CouplerType("F70", "F", 0.743, 0.438, 0.080, 1.75e6),
    "F79": CouplerType("F79", "F", 1.092, 0.788, 0.170, 3.15e6),
    "F73": CouplerType("F73", "F", 1.524, 1.220, 0.300, 4.88e6),
}


def make_car(index=0, shoe="composition", coupler="F73", spacing=16.348, **changes):
    """Car of the source's base train, number ``index + 1`` of a train of such cars."""
    mass = changes.get("mass", 68e3)
    fields = {
        "mass": mass,
        "inertia": mass * (14.1**2 / 12.0 + 1.5**2 / 4.0),
        "length": 14.1,
        "width": 2.6,
        "pivot_distance": 6.65,
        "truck_distance": 5.75,
        "front": COUPLERS[coupler],
        "rear": COUPLERS[coupler],
        "brakes": (BrakeUnit(distance=spacing * index, shoe=shoe, weight=mass),),
    }
    return Car(**{**fields, **changes})


def mixed_cars(n):
    """Cars that differ in everything, with both kinds of head."""
    kinds = ("F79", "E69", "F73", "E60", "E68")
    cars = []
    for i in range(n):
        length = 12.0 + 1.1 * (i % 4)
        mass = 40e3 + 17e3 * (i % 5)
        front, rear = COUPLERS[kinds[i % 5]], COUPLERS[kinds[(i + 2) % 5]]
        cars.append(
            Car(
                mass=mass,
                inertia=mass * (length**2 / 12.0 + 0.7),
                length=length,
                width=2.6 + 0.1 * (i % 3),
                pivot_distance=0.5 * length - 0.3 - 0.05 * (i % 3),
                truck_distance=0.5 * length - 1.2 - 0.1 * (i % 2),
                front=front,
                rear=rear,
                coupler_inertia=20e3 + 2e3 * (i % 4),
                brakes=(BrakeUnit(distance=15.5 * i, weight=mass),),
            )
        )
    return tuple(cars)


def make_train(
    cars,
    speed=15.0,
    position=0.0,
    derailed=(),
    parted=(),
    lateral=(),
    breaks=(),
    triggers=(),
    track=None,
    **sections,
):
    """Parameters of a run. ``cars`` is a number of base cars or the cars; nothing starts it."""
    if isinstance(cars, int):
        cars = tuple(make_car(i) for i in range(cars))
    track = TrackParams() if track is None else track
    return TrainParams(
        cars=tuple(cars),
        initiation=InitiationParams(
            speed=speed,
            position=position,
            derailed_trucks=tuple(derailed),
            parted_couplings=tuple(parted),
            lateral_forces=tuple(lateral),
        ),
        track=replace(track, rail_breaks=tuple(breaks)),
        brakes=sections.pop("brakes", BrakeParams(triggers=tuple(triggers))),
        **sections,
    )


def all_trucks(n):
    """Both trucks of ``n`` cars, for ``derailed``."""
    return tuple((i + 1, end) for i in range(n) for end in ("front", "rear"))


def free_train(cars, **options):
    """A train on frictionless ground, off the rails, without brakes."""
    n = cars if isinstance(cars, int) else len(cars)
    options.setdefault("ground", GroundParams(scale=0.0))
    return make_train(cars, derailed=all_trucks(n), **options)


NO_CONTACT = ContactParams(c1=0.0, c2=0.0, c3=0.0)
"""Contact law that does nothing, for runs that are about something else."""


CURVE = TrackParams(
    segments=(
        TrackSegment(300.0),
        TrackSegment(80.0, 0.0, 1.0 / 400.0),
        TrackSegment(500.0, 1.0 / 400.0, 1.0 / 400.0),
        TrackSegment(120.0, 1.0 / 400.0, -1.0 / 300.0),
        TrackSegment(300.0, -1.0 / 300.0, -1.0 / 300.0),
        TrackSegment(200.0, -1.0 / 300.0, 0.0),
        TrackSegment(400.0),
    ),
    start_coordinate=-200.0,
    start_x=-150.0,
    start_y=40.0,
    start_heading=0.3,
)
"""Tangent, spiral, left-hand curve, reversing spiral, right-hand curve, spiral, tangent."""


def with_integration(params, **changes):
    """The same run with other settings of the integration."""
    return replace(params, integration=replace(params.integration, **changes))


def tight(params, rtol=1e-10, method="rkf45", **changes):
    """The same run at a tight tolerance, by the reference method."""
    return with_integration(params, rtol=rtol, method=method, **changes)


def fixed_steps(params, h):
    """The same run in steps of ``h`` whatever the error (for slow motion, which has no cap)."""
    return with_integration(params, rtol=1e-1, max_step=h)


def place(run, q=None, v=None, truck_on=None, coupled=None, remember=False):
    """Put a run into a state as it is given, constraints met or not.

    ``remember`` keeps which wall each corner came through, as of the last step.
    """
    s = run._state
    for own, given in ((s.q, q), (s.v, v), (s.truck_on, truck_on), (s.coupled, coupled)):
        if given is not None:
            own[...] = given
    for i, car in enumerate(run.params.cars):
        for k, r in enumerate((car.truck_distance, -car.truck_distance)):
            x = s.q[i, 0] + r * math.cos(s.q[i, 2])
            y = s.q[i, 1] + r * math.sin(s.q[i, 2])
            s.truck_s[i, k] = run.track.locate(x, y)[0]
    if not remember:
        s.cnt["pairs"] = 0
    run._grow_until(rebuild(run._model, s, run._work))
    assert run._evaluate()
    for last, now in (
        (s.q0, s.q),
        (s.v0, s.v),
        (s.a0, s.a),
        (s.a1, s.a),
        (s.truck_on0, s.truck_on),
        (s.coupled0, s.coupled),
        (s.power0, s.power),
        (s.power1, s.power),
    ):
        last[...] = now
    s.clock["initial_energy"] = stored_energy(run._model, s, s.q, s.v)
    return run


def start(params, q=None, v=None, **constraints):
    """A run from a given state."""
    return place(PlanarSimulation(params), q, v, **constraints)


def project(run):
    """Move the state onto the constraints, in the metric of the masses."""
    s = run._state
    assert project_positions(run._model, s, run._work, s.q)
    project_velocities(run._model, s, run._work, s.v)
    return place(run)


def propose(run, h):
    """Make the next step one of ``h``, if nothing else shortens it."""
    run._state.clock["h_next"] = h
    return run


def kicked(params, seed, angle=0.02, rate=0.2):
    """A run from a random state that meets its constraints."""
    rng = np.random.default_rng(seed)
    run = PlanarSimulation(params)
    home = run.sample()
    q = home.q + rng.normal(0.0, angle, home.q.shape)
    v = home.v + rng.normal(0.0, rate, home.v.shape)
    return project(place(run, q, v))


def steps_of(run, until):
    """Advance one step at a time; yields after each."""
    while not run.ended and run.time < until:
        run.advance_steps(1)
        yield run


def same_run(a, b):
    """Two runs are equal to the bit, in state, events and collisions."""
    # repr: nan equals nan there
    return (
        a.state_hash() == b.state_hash()
        and repr(a.events) == repr(b.events)
        and repr(a.collisions) == repr(b.collisions)
    )


def relative(a, b, floor=1.0):
    """Largest difference, in units of the largest entry of ``b`` (at least ``floor``)."""
    a, b = np.asarray(a), np.asarray(b)
    return float(np.max(np.abs(a - b), initial=0.0) / np.max(np.abs(b), initial=floor))
