"""Cars on second tracks: against closed forms, and apart from the train in all counts."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad

from derail_ros.engine import PlanarSimulation
from derail_ros.engine.laws.brake import composition_factor
from derail_ros.vocabulary.errors import CommandError, ParameterError
from derail_ros.vocabulary.params import (
    BrakeTrigger,
    BrakeUnit,
    LateralForce,
    SecondTrack,
    StandingCut,
    TrackParams,
    TrackSegment,
)
from tests.engine.support import CURVE, all_trucks, make_car, make_train, tight, with_integration

SPEED = 6.0
HALF = 0.5 * 14.1


def straight(x, y, heading=0.0, length=600.0):
    """A straight second track that begins at a place."""
    line = TrackParams(
        segments=(TrackSegment(length),), start_x=x, start_y=y, start_heading=heading
    )
    return SecondTrack("siding", line)


def with_cut(params, track, position, cars):
    """The run with a cut on a second track."""
    track = replace(track, line=replace(track.line))
    cut = StandingCut(len(params.tracks), position, len(cars))
    return replace(
        params,
        cars=(*params.cars, *cars),
        tracks=(*params.tracks, track),
        standing=(*params.standing, cut),
    )


def braked(hand, **changes):
    return make_car(brakes=(BrakeUnit(distance=0.0, force=0.0, hand=hand),), **changes)


def collinear(cars, time_limit=6.0, mass=68e3):
    """A car at ``SPEED`` that runs into a cut on the same line; the bodies are 6 m apart."""
    params = make_train((make_car(mass=mass),), speed=SPEED)
    params = with_cut(params, straight(-100.0, 0.0), 100.0 + 2.0 * HALF + 6.0 + _back(cars), cars)
    return PlanarSimulation(with_integration(tight(params, 1e-8), time_limit=time_limit))


def _back(cars):
    """From the rear car's centre to the first one's, m."""
    return sum(
        a.pivot_distance + a.rear.length + b.front.length + b.pivot_distance
        for a, b in zip(cars[:-1], cars[1:], strict=True)
    )


@pytest.mark.parametrize("number", [1, 3])
def test_momentum_and_energy_of_a_car_that_strikes_a_standing_cut(number):
    mass, other = 68e3, 90e3
    run = collinear(tuple(make_car(mass=other) for _ in range(number)))
    outcome = run.run()
    own, *cut = run.sample().velocity[:, 0]
    assert np.ptp(cut) < 1e-9  # rigid couplings: it goes as one
    assert mass * own + number * other * cut[0] == pytest.approx(mass * SPEED, rel=1e-9)
    reduced = mass * number * other / (mass + number * other)
    lost = 0.5 * reduced * (SPEED**2 - (cut[0] - own) ** 2)
    assert 0.0 < cut[0] - own < SPEED
    assert outcome.energy["collisions"] == pytest.approx(lost, rel=1e-6)
    assert outcome.energy_residual < 1e-6
    hit, *rest = run.collisions
    assert (hit.car_a, hit.car_b) == (1, 1 + number)
    assert hit.closing_speed == pytest.approx(SPEED, rel=1e-2)
    assert not rest


def test_a_struck_cut_rolls_as_its_hand_brakes_let_it():
    hand = 60e3
    # the light car that strikes is thrown back and comes no more
    free, held = collinear((braked(0.0),), mass=2e4), collinear((braked(hand),), 25.0, mass=2e4)
    free.run()
    speed = free.sample().velocity[1, 0]
    at = free.collisions[0].end
    rolled = free.sample().pose[1, 0] - (2.0 * HALF + 6.0)
    # from its first touch on; over the contact itself it gains its speed
    assert speed * (free.time - at) < rolled < speed * (free.time - free.collisions[0].start)
    held.advance_to(1.0)
    while not (held.collisions and held.collisions[0].final):
        held.advance_steps(1)
    begin, v0 = held.sample().pose[1, 0], held.sample().velocity[1, 0]
    way = quad(lambda v: 68e3 * v / (hand * composition_factor(v)), 0.0, v0)[0]
    held.run()
    assert held.sample().velocity[1, 0] == pytest.approx(0.0, abs=1e-3)
    assert held.sample().pose[1, 0] - begin == pytest.approx(way, rel=5e-3)
    assert held.outcome().energy_residual < 1e-5
    assert len(free.collisions) == len(held.collisions) == 1


def far_and_near():
    concentric = TrackParams(
        segments=tuple(
            TrackSegment(
                s.length * (1.0 - 4.5 * 0.5 * (s.curvature_start + s.curvature_end)),
                s.curvature_start / (1.0 - 4.5 * s.curvature_start),
                s.curvature_end / (1.0 - 4.5 * s.curvature_end),
            )
            for s in CURVE.segments
        ),
        start_coordinate=-200.0,
        start_x=CURVE.start_x - 4.5 * math.sin(CURVE.start_heading),
        start_y=CURVE.start_y + 4.5 * math.cos(CURVE.start_heading),
        start_heading=CURVE.start_heading,
    )
    return SecondTrack("loop", concentric)


def test_a_cut_that_nobody_reaches_changes_no_bit():
    cars = (make_car(), braked(40e3), make_car(coupler="F79"))
    push = LateralForce(force=2e5, car=1)
    alone = make_train(
        6, speed=15.0, track=CURVE, derailed=[(1, "front"), (1, "rear")], lateral=[push],
        triggers=[BrakeTrigger()],
    )  # fmt: skip
    beside = with_cut(alone, far_and_near(), 900.0, cars)
    runs = [PlanarSimulation(with_integration(p, time_limit=5.0)) for p in (alone, beside)]
    before = runs[1].sample()
    outcomes = [run.run() for run in runs]
    q, v = runs[1]._state.q, runs[1]._state.v
    assert np.array_equal(runs[1].sample().pose[6:], before.pose[6:])
    assert np.array_equal(q[:6], runs[0]._state.q) and not v[6:].any()
    assert repr(runs[0].events) == repr(runs[1].events)  # nan is not itself
    assert repr(runs[0].collisions) == repr(runs[1].collisions)
    assert outcomes[0].energy == outcomes[1].energy
    assert outcomes[1].standing.record == {"cars": 3, "struck": [], "moved": [], "derailed": []}


def test_a_train_passes_a_cut_at_arm_s_length():
    alone = with_integration(make_train(3, speed=20.0, track=CURVE), time_limit=8.0)
    beside = with_cut(alone, far_and_near(), 60.0, (make_car(), make_car()))
    runs = [PlanarSimulation(p) for p in (alone, beside)]
    before = runs[1].sample().pose
    for run in runs:
        run.run()
    assert np.array_equal(runs[1].sample().pose[3:], before[3:])
    assert runs[1].sample().pose[:3] == pytest.approx(runs[0].sample().pose, abs=1e-6)
    assert [e.kind for e in runs[0].events] == [e.kind for e in runs[1].events]
    assert not runs[1].collisions


@pytest.fixture(scope="module")
def broadside():
    """A derailed car that slides into the side of the middle one of three standing cars."""
    params = make_train(2, speed=20.0, derailed=all_trucks(2), triggers=[BrakeTrigger()])
    params = replace(params, brakes=replace(params.brakes, vent_on_parting=True))
    line = straight(20.0, -200.0, 0.5 * math.pi)
    run = PlanarSimulation(with_cut(params, line, 200.0 + 16.348, (make_car(),) * 3))
    run.run()
    return run


def test_a_cut_is_pushed_off_its_rails_and_counted_apart(broadside):
    outcome = broadside.outcome()
    assert outcome.derailed_cars == (1, 2) and outcome.cars_derailed == 2
    assert 4 in outcome.standing.derailed and 4 in outcome.standing.struck
    assert set(outcome.standing.derailed) <= set(outcome.standing.moved) <= {3, 4, 5}
    lateral = [e for e in broadside.events if e.cause == "lateral force"]
    assert {e.cars[0] for e in lateral} == set(outcome.standing.derailed)
    assert outcome.train.cars == 2
    assert outcome.peak_force_pair in {(1, 4), (2, 4)} or min(outcome.peak_force_pair) <= 2
    assert set(outcome.cars_above(1.0)) <= {1, 2}
    assert outcome.car_peak_force[3] > 1.0
    assert outcome.energy_residual < 1e-3
    # the box of the scene is that of the train's own cars
    assert outcome.scene_length < 2.0 * 16.348 + 30.0


def test_standing_cars_have_no_pipe(broadside):
    reached = {e.cars[0] for e in broadside.events if e.kind.name == "BRAKE_SIGNAL_REACHED"}
    assert reached == {1, 2}
    parted = [e for e in broadside.events if e.kind.name == "COUPLER_PARTED"]
    vented = [e for e in broadside.events if e.cause == "vented"]
    assert {e.cars for e in vented} == {e.cars for e in parted if min(e.cars) == 1}
    assert all(p.coupling == 1 for p in broadside.outcome().parted)


def test_saved_in_the_middle_it_goes_on_to_the_bit(broadside):
    run = PlanarSimulation(broadside.params)
    run.advance_to(1.0)
    again = PlanarSimulation.from_bytes(run.to_bytes())
    again.run()
    assert again.state_hash() == broadside.state_hash()


def test_commands_are_for_the_train(broadside):
    run = PlanarSimulation(broadside.params)
    with pytest.raises(CommandError, match="no car 3"):
        run.inject_rail_break(car=3)
    with pytest.raises(CommandError, match="car"):
        run.trigger_emergency_brake(source="car", car=4)


def test_what_cannot_stand_there_is_refused():
    params = make_train(3)
    cases = [
        (straight(-100.0, 0.0), 90.0, "site.standing.0.position", "car 4 stands where car 1 is"),
        (straight(-100.0, 6.0), 900.0, "site.standing.0.position", "beyond the alignment"),
        (
            SecondTrack("bend", TrackParams(segments=(TrackSegment(100.0, 1 / 15, 1 / 15),))),
            60.0,
            "site.tracks.0",
            "do not pass the curve",
        ),
        (SecondTrack("none", TrackParams()), 0.0, "site.tracks.0.line.segments", "empty"),
    ]
    for track, position, field, reason in cases:
        with pytest.raises(ParameterError, match=reason) as error:
            PlanarSimulation(with_cut(params, track, position, (make_car(),) * 2))
        assert error.value.field == field
    both = with_cut(params, straight(-100.0, 6.0), 200.0, (make_car(),))
    both = with_cut(both, straight(-100.0, 7.0), 205.0, (make_car(),))
    with pytest.raises(ParameterError, match="car 5 stands where car 4 is"):
        PlanarSimulation(both)
    virtual = replace(params, cars=(*params.cars[:2], replace(params.cars[2], represents=9)))
    with pytest.raises(ParameterError, match="only the last body"):
        PlanarSimulation(with_cut(virtual, straight(-100.0, 6.0), 90.0, (make_car(),)))
