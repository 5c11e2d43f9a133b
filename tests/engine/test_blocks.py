"""Blocks: cars on straight rails that move as one. They leave out what is zero."""

import numpy as np
import pytest

from derail_ros.engine import PlanarSimulation
from derail_ros.engine.arrays import make_work
from derail_ros.engine.dynamics import PLAIN, accelerations
from derail_ros.engine.solver import plain_masses
from derail_ros.vocabulary.params import BrakeTrigger, LateralForce, TrackParams, TrackSegment
from tests.engine.support import (
    CURVE,
    make_train,
    mixed_cars,
    relative,
    same_run,
    steps_of,
    with_integration,
)

N = 12


def pushed(**options):
    """A train whose fourth car is pushed off the rails, under brakes that reach cars in turn."""
    return make_train(
        mixed_cars(N),
        speed=20.0,
        derailed=((4, "front"), (4, "rear")),
        lateral=(LateralForce(car=4, force=50e3),),
        triggers=(BrakeTrigger(mode="conventional", source="front"),),
        **options,
    )


def blocks(run):
    """First and last car (from 1) of each block as of the last step."""
    head, tail = run._work.head, run._work.tail
    return [(i + 1, int(tail[i]) + 1) for i in range(len(head)) if tail[i] > head[i] == i]


def without_blocks(run):
    """Accelerations, forces and powers of a run's state, every car by itself."""
    model, state = run._model, run._state
    work = make_work(run.n_cars, len(state.pairs), 0, False)
    plain_masses(model, work.wk)
    count = int(state.cnt["pairs"][0])
    work.active[: 1 + count] = [count, *range(count)]
    a = np.empty_like(state.a)
    assert accelerations(model, state, work, run.time, state.q, state.v, a, PLAIN)
    return a, work.lam_t, work.lam_c, work.power


def test_blocks_change_no_acceleration_and_no_force():
    run = PlanarSimulation(pushed())
    compared = 0
    for _ in steps_of(run, 8.0):
        if not blocks(run):
            break
        state = run._state
        own = state.a, state.rail_force, state.coupler_force, state.power
        for mine, plain, unit in zip(own, without_blocks(run), (1.0, 1e5, 1e5, 1e6), strict=True):
            assert relative(mine, plain, unit) < 1e-7
        compared += 1
    assert compared > 100
    assert len(run.outcome().derailed_cars) >= 1


@pytest.mark.parametrize("method", ["row", "rkf45"])
def test_a_train_without_blocks_goes_the_same_way(method):
    # the cars behind are a block on the endless straight, and cars of their own on an alignment
    ends = []
    for track in (None, TrackParams(segments=(TrackSegment(3000.0, 0.0, 0.0),))):
        params = pushed() if track is None else pushed(track=track, position=1000.0)
        run = PlanarSimulation(with_integration(params, method=method, rtol=1e-8))
        run.advance_to(3.0)
        assert bool(blocks(run)) == (track is None)
        s = run.sample(3.0)
        ends.append((s.q - [params.initiation.position, 0, 0, 0, 0], s.v, s.rail_force))
    for mine, other, unit in zip(*ends, (1.0, 1.0, 1e5), strict=True):
        assert np.abs(mine - other).max() < 1e-5 * unit


def test_the_cars_of_a_block_stay_exactly_on_the_line():
    run = PlanarSimulation(pushed(breaks=(-10.0,)))
    seen = set()
    for _ in steps_of(run, 6.0):
        seen.update(blocks(run))
        for first, last in blocks(run):
            rows = slice(first - 1, last)
            q, v = run._state.q[rows], run._state.v[rows]
            assert not q[:, 1:3].any() and not v[:, 1:3].any()
            assert np.ptp(v[:, 0]) == 0.0
            gaps = run.sample().coupler_gap[first - 1 : last - 1]
            assert gaps.max() < 1e-9
    assert (1, 3) in seen and (5, N) in seen
    assert run.outcome().max_coupler_gap < 1e-9
    assert run.outcome().energy_residual < 1e-3


def test_only_cars_that_something_has_reached_are_live():
    params = pushed()
    run = PlanarSimulation(make_train(N, speed=20.0))
    run.advance_steps(5)
    assert blocks(run) == [(1, N)] and run._work.live[0] == 0
    run = PlanarSimulation(params)
    run.advance_steps(1)
    # the pushed car, and the two whose couplers it bends
    assert list(run._work.live[1 : 1 + run._work.live[0]]) == [2, 3, 4]


@pytest.mark.parametrize(
    "params",
    [
        make_train(5, speed=10.0, track=CURVE),
        with_integration(make_train(5, speed=10.0), stabilization="baumgarte"),
    ],
    ids=["curve", "baumgarte"],
)
def test_elsewhere_every_car_is_by_itself(params):
    run = PlanarSimulation(params)
    run.advance_steps(3)
    assert blocks(run) == [] and run._work.live[0] == 5


def test_blocks_follow_from_the_state_alone():
    run = PlanarSimulation(pushed(breaks=(-60.0,)))
    run.advance_to(1.5)
    again = PlanarSimulation.from_bytes(run.to_bytes())
    # scratch of another run at the same state: as if every step had been the first of a call
    for moved in (run, again):
        moved.advance_to(2.0)
    while not again.ended and again.time < 4.0:
        again.advance_steps(1)
    run.advance_to(4.0)
    assert same_run(run, again)
