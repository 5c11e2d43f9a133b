"""Accelerations and multipliers against a dense solve of independently derived equations."""

import numpy as np
import pytest

from derail_ros.engine import PlanarSimulation
from derail_ros.vocabulary.params import (
    BrakeParams,
    BrakeTrigger,
    LateralForce,
    TrackParams,
    TrackSegment,
)
from tests.engine.reference import Reference
from tests.engine.support import (
    CURVE,
    NO_CONTACT,
    all_trucks,
    free_train,
    make_car,
    make_train,
    mixed_cars,
    place,
    project,
    relative,
    start,
    with_integration,
)

TRACKS = {
    "straight": (None, 0.0),
    "curve": (
        TrackParams(segments=(TrackSegment(600.0, 1 / 400, 1 / 400),), start_heading=-0.4),
        400.0,
    ),
    "spiral": (
        TrackParams(segments=(TrackSegment(400.0, -1 / 500, 1 / 250),), start_y=9.0),
        250.0,
    ),
    "alignment": (CURVE, 190.0),
}


def random_state(params, rng, angle=0.08, rate=0.5):
    """A run in a state away from its constraints, with some of them removed."""
    run = PlanarSimulation(params)
    n = run.n_cars
    home = run.sample()
    q = home.q + rng.normal(0.0, angle, (n, 5))
    v = home.v + rng.normal(0.0, rate, (n, 5))
    share = rng.choice([0.0, 0.3, 0.7, 1.0])
    on = rng.random((n, 2)) < share
    coupled = rng.random(n - 1) < rng.choice([0.0, 0.5, 0.9, 1.0])
    return place(run, q, v, on, coupled), q, v, on, coupled


def compare(run, reference, q, v, t=0.0):
    """Largest relative error of accelerations, rail forces and coupler forces."""
    sample = run.sample()
    a, multipliers = reference.accelerations(t, q, v)
    trucks, couplings = reference.split(multipliers)
    # coupler angles accelerate far faster than cars: each kind in its own scale
    errors = [relative(sample.a[:, k], a[:, k]) for k in (slice(0, 2), 2, slice(3, 5))]
    errors += [relative(sample.rail_force, trucks), relative(sample.coupler_force, couplings)]
    return max(errors)


@pytest.mark.parametrize("name", TRACKS)
def test_dense_solve_on_random_states(name):
    track, position = TRACKS[name]
    rng = np.random.default_rng(7)
    removed = set()
    for case in range(25):
        n = int(rng.integers(1, 8))
        params = make_train(mixed_cars(n), track=track, position=position)
        run, q, v, on, coupled = random_state(params, rng)
        removed.add((bool(on.all()), bool(on.any()), bool(coupled.all())))
        reference = Reference(params, on, coupled)
        assert compare(run, reference, q, v) < 1e-9, f"case {case}"
    assert len(removed) >= 4  # whole, partly and fully removed have all occurred


def test_dense_solve_of_every_pattern_of_removed_constraints():
    # three cars: 6 trucks and 2 couplings
    params = make_train(mixed_cars(3))
    run = PlanarSimulation(params)
    rng = np.random.default_rng(3)
    home = run.sample()
    for pattern in range(2**8):
        bits = np.array([pattern >> k & 1 for k in range(8)], bool)
        on, coupled = bits[:6].reshape(3, 2), bits[6:]
        q = home.q + rng.normal(0.0, 0.05, (3, 5))
        v = home.v + rng.normal(0.0, 0.5, (3, 5))
        place(run, q, v, on, coupled)
        assert compare(run, Reference(params, on, coupled), q, v) < 1e-9, bin(pattern)


def test_dense_solve_with_large_angles():
    # jack-knifed, couplers far beyond their limits
    rng = np.random.default_rng(11)
    params = make_train(mixed_cars(6), contact=NO_CONTACT)
    for _ in range(20):
        run, q, v, on, coupled = random_state(params, rng, angle=0.6, rate=2.0)
        assert compare(run, Reference(params, on, coupled), q, v) < 1e-9


def test_dense_solve_of_a_long_train():
    params = make_train(mixed_cars(40), track=CURVE, position=700.0)
    run = PlanarSimulation(params)
    q, v = run.sample().q.copy(), run.sample().v
    q[:, 3:] += np.random.default_rng(5).normal(0.0, 0.08, (40, 2))  # strains the strikers
    reference = Reference(params)
    place(run, q, v, reference.truck_on, reference.coupled)
    assert compare(run, reference, q, v) < 1e-9


def test_dense_solve_under_brakes_and_lateral_force():
    brakes = BrakeParams(
        triggers=(
            BrakeTrigger(time=0.2, source="both_ends"),
            BrakeTrigger(time=0.3, source="car", car=3, mode="instant_traction_limited"),
        ),
        traction_coefficient=0.15,
    )
    lateral = (LateralForce(duration=5.0), LateralForce(force=-20e3, car=4, place="centre"))
    params = make_train(mixed_cars(5), brakes=brakes, lateral=lateral)
    rng = np.random.default_rng(5)
    for until in (0.1, 0.25, 1.5):
        run, q, v, on, coupled = random_state(params, rng)
        run = start(with_integration(params, max_step=1e-3))
        run.advance_to(until)
        place(run, q, v, on, coupled)
        reference = Reference(params, on, coupled)
        assert compare(run, reference, q, v, run.time) < 1e-9
        assert (reference.brake(0, run.time, 10.0) > 0.0) == (until > 0.2)


@pytest.mark.parametrize("name", TRACKS)
def test_baumgarte_terms(name):
    # the same with both terms of the stabilization on the right-hand side
    track, position = TRACKS[name]
    params = make_train(mixed_cars(4), track=track, position=position)
    stabilized = with_integration(
        params, stabilization="baumgarte", baumgarte_velocity=17.0, baumgarte_position=43.0
    )
    rng = np.random.default_rng(2)
    _, q, v, on, coupled = random_state(params, rng)
    run = start(stabilized, q, v, truck_on=on, coupled=coupled)
    reference = Reference(params, on, coupled)
    gamma = reference.gamma(q, v) - 17.0 * reference.rate(q, v) - 43.0 * reference.phi(q)
    a, multipliers = reference.solve(reference.forces(0.0, q, v), reference.jacobian(q), gamma)
    trucks, couplings = reference.split(multipliers)
    sample = run.sample()
    assert relative(sample.a, a) < 1e-9
    assert relative(sample.rail_force, trucks) < 1e-9
    assert relative(sample.coupler_force, couplings) < 1e-9
    # and they do something
    plain, _ = reference.accelerations(0.0, q, v)
    assert relative(plain, a) > 1e-3


def test_a_removed_constraint_is_a_removed_row():
    # taking a coupling away changes only the accelerations its force caused
    params = make_train(mixed_cars(4), derailed=all_trucks(2))
    rng = np.random.default_rng(13)
    run, q, v, on, coupled = random_state(params, rng)
    on[:], coupled[:] = True, True
    on[:2] = False
    whole = place(run, q, v, on, coupled).sample()
    parted = place(run, q, v, on, [True, False, True]).sample()
    assert np.all(parted.coupler_force[1] == 0.0)
    assert relative(parted.a, whole.a) > 1e-3
    # cars beyond the parted coupling no longer feel what is in front of it
    kicked = v.copy()
    kicked[0, 2] += 1.0
    again = place(run, q, kicked, on, [True, False, True]).sample()
    assert np.array_equal(again.a[2:], parted.a[2:])
    assert not np.array_equal(again.a[:2], parted.a[:2])


@pytest.mark.parametrize("n", [1, 2, 7])
def test_newtons_law_of_the_whole_train(n):
    # all forces on the cars add up to mass times acceleration, as a sample reports them
    params = make_train(mixed_cars(n), triggers=(BrakeTrigger(mode="instant"),))
    rng = np.random.default_rng(n)
    run, q, v, on, coupled = random_state(params, rng)
    s = run.sample()
    mass = np.array([c.mass for c in params.cars])[:, None]
    speed = np.hypot(*s.v[:, :2].T)[:, None]
    external = (
        s.ground_truck_force.sum(axis=1)
        + s.ground_body_force
        + s.external_force
        - s.brake_force[:, None] * s.v[:, :2] / speed
        + np.stack([np.zeros(n), s.rail_force.sum(axis=1)], axis=1)
    )
    couplings = np.zeros((n, 2))
    couplings[:-1] += s.coupler_force
    couplings[1:] -= s.coupler_force
    total = external + couplings + s.collision_force
    assert total == pytest.approx(mass * s.a[:, :2], abs=1e-9 * np.abs(mass * s.a[:, :2]).max())
    assert couplings.sum(axis=0) == pytest.approx([0.0, 0.0], abs=1e-6)


def test_projection_moves_as_little_as_the_masses_allow():
    # one heavy and one light car, coupled, pulled apart by 0.1 m: the common centre stays
    cars = (make_car(0, mass=90e3), make_car(1, mass=30e3))
    run = PlanarSimulation(free_train(cars, speed=0.0))
    q = run.sample().q.copy()
    q[0, 0] += 0.1
    run = place(run, q)
    after = project(run).sample()
    assert after.coupler_gap[0] < 1e-10
    moved = after.q[:, 0] - q[:, 0]
    assert moved == pytest.approx([-0.025, 0.075], rel=1e-6)
