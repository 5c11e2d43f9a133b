"""Grades, resistance, locomotives: against closed forms and quadrature; energy closes."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq

from derail_ros.engine import PlanarSimulation
from derail_ros.engine.laws.brake import composition_factor
from derail_ros.engine.laws.effort import effort_at
from derail_ros.engine.laws.resistance import resistance
from derail_ros.engine.track import Track
from derail_ros.scenario import loads_scenario
from derail_ros.scenario.resolve import fcalc
from derail_ros.vocabulary.errors import ParameterError
from derail_ros.vocabulary.params import (
    GRAVITY,
    BrakeParams,
    BrakeTrigger,
    GradeChange,
    Notch,
    TrackParams,
    TrackSegment,
    TractionParams,
)
from tests.engine.support import CURVE, make_car, make_train, tight, with_integration

MASS = 120e3
POWER = ((0.0, 400e3), (5.0, 400e3), (10.0, 200e3), (20.0, 100e3), (40.0, 50e3))
DYNAMIC = ((0.0, 0.0), (3.0, 200e3), (12.0, 200e3), (40.0, 60e3))
NOW = BrakeParams(triggers=(BrakeTrigger(mode="instant"),))
NONE = BrakeParams(triggers=())


def grade(rise, at=-math.inf, length=0.0):
    """A track with one grade."""
    return TrackParams(grades=(GradeChange(at, rise, length),))


def cars(n, locomotives=(1,), **changes):
    """Cars with the resistance of FCalc; some are locomotives."""
    rows = []
    for i in range(n):
        car = make_car(i, mass=MASS, resistance=fcalc(MASS, 4, 10.0), **changes)
        if i + 1 in locomotives:
            car = replace(car, tractive_effort=POWER, dynamic_brake=DYNAMIC)
        rows.append(car)
    return tuple(rows)


def drive(params, notches, **changes):
    """The run of a train with these settings."""
    return PlanarSimulation(replace(params, traction=TractionParams(notches=notches, **changes)))


def resisting(v, n):
    return n * resistance(v, *fcalc(MASS, 4, 10.0))


def test_fcalc_is_what_the_formula_says():
    # 100 short tons, 4 axles, 10 m2, 20 m/s
    r = fcalc(100.0 * 907.185, 4, 10.0)
    assert resistance(20.0, *r) == pytest.approx(735.5 + 322.5 + 329.0 + 479.2, rel=1e-9)
    # 0.0005 lb per square foot and (mile/h)^2
    assert fcalc(1e3, 4, 1.0)[2] == pytest.approx(0.0005 * 4.4482 * 10.764 * 2.23694**2, rel=2e-3)


def test_balance_speed_on_a_grade():
    n, rise = 5, 0.012
    params = make_train(cars(n), speed=17.0, track=grade(rise), brakes=NONE)
    params = with_integration(params, time_limit=600.0)
    run = drive(params, (Notch(0.0, 6),))
    outcome = run.run()

    def excess(v):
        pull = 0.75 * np.interp(v, *zip(*POWER))
        return pull - resisting(v, n) - n * MASS * GRAVITY * rise

    expected = brentq(excess, 5.0, 30.0)
    assert run.sample().v[:, 0] == pytest.approx([expected] * n, rel=1e-3)
    assert outcome.status == "time limit"
    assert outcome.energy_residual < 1e-3


@pytest.mark.parametrize("rise", [-0.015, 0.0, 0.015])
def test_stopping_distance_on_a_grade(rise):
    n, speed = 3, 15.0
    params = make_train(cars(n, ()), speed=speed, track=grade(rise), brakes=NOW)
    run = PlanarSimulation(tight(params, 1e-8, max_step=0.02))
    begin = run.sample().q[0, 0]
    outcome = run.run()
    slope = n * MASS * GRAVITY * rise

    def step(v):
        force = n * params.brakes.force * composition_factor(v) + resisting(v, n) + slope
        return n * MASS * v / force

    # the run ends when the train is slower than rest_speed for a while: take it from there
    expected = quad(step, 0.0, speed)[0]
    assert outcome.status == "at rest"
    assert run.sample().q[0, 0] - begin == pytest.approx(expected, abs=0.01)
    energy = outcome.energy
    moved = n * MASS * GRAVITY * rise * (run.sample().q[0, 0] - begin)
    assert energy["potential"] == pytest.approx(moved, rel=1e-6, abs=1.0)
    assert outcome.energy_residual < 1e-4


def test_a_braked_train_stands_on_a_grade_and_an_unbraked_one_rolls():
    rise, n = 0.02, 3
    params = make_train(cars(n, ()), speed=0.0, track=grade(rise), brakes=NOW)
    standing = PlanarSimulation(with_integration(params, time_limit=60.0))
    outcome = standing.run()
    assert outcome.status == "at rest"
    assert abs(standing.sample().q[0, 0]) < 0.05
    # it creeps with the smoothed friction, eps F / F_max, and no faster
    weight = MASS * GRAVITY * rise
    creep = params.ground.eps * weight / math.sqrt(params.brakes.force**2 - weight**2)
    assert standing.sample().v[0, 0] == pytest.approx(-creep, rel=0.05)

    rolling = PlanarSimulation(with_integration(replace(params, brakes=NONE), time_limit=20.0))
    outcome = rolling.run()
    assert outcome.status == "time limit"

    def gain(v):
        return 1.0 / (GRAVITY * rise - resisting(v, 1) / MASS)

    speed = -rolling.sample().v[0, 0]
    assert quad(gain, 0.0, speed)[0] == pytest.approx(20.0, rel=5e-3)


def test_a_train_that_turns_back_is_not_at_rest():
    params = make_train(cars(3, ()), speed=3.0, track=grade(0.02), brakes=NONE)
    run = PlanarSimulation(with_integration(params, time_limit=30.0))
    assert run.run().status == "time limit"
    assert run.sample().v[0, 0] < -2.0


def test_heights_are_the_integral_of_the_grade():
    changes = (GradeChange(-math.inf, 0.01), GradeChange(100.0, -0.02, 80.0),
               GradeChange(400.0, 0.005, 0.0))  # fmt: skip
    track = Track(TrackParams(grades=changes))
    assert track.height(0.0) == (0.0, 0.01)
    assert track.height(100.0)[1] == pytest.approx(-0.005)  # the middle of the vertical curve
    assert track.height(1000.0)[1] == 0.005
    for s in (-300.0, 70.0, 100.0, 139.0, 250.0, 900.0):
        expected = quad(lambda u: track.height(u)[1], 0.0, s, points=(60, 140, 400), limit=200)[0]
        assert track.height(s)[0] == pytest.approx(expected, abs=1e-6)


def test_poses_are_at_the_height_of_the_track():
    track = replace(CURVE, grades=(GradeChange(-math.inf, 0.01), GradeChange(60.0, -0.02, 60.0)))
    run = PlanarSimulation(make_train(4, speed=10.0, track=track, brakes=NONE))
    run.advance_to(6.0)
    s = run.sample(0.5 * (run.previous_time + run.time))
    for i in range(4):
        at, _ = run.track.locate(*s.pose[i, :2], float(s.truck_coordinate[i, 0]))
        z, rise = run.track.height(at)
        assert s.pose[i, 2] == pytest.approx(z, abs=1e-6)
        assert s.pose[i, 4] == pytest.approx(-math.atan(rise), abs=1e-9)
        along = math.hypot(*s.velocity[i, :2])
        assert s.velocity[i, 2] == pytest.approx(rise * along, abs=1e-2 * abs(rise) * along)
    assert run.outcome().pose[:, 2].any()


def test_lateral_force_of_a_train_pulled_through_a_curve():
    # F L / R less the centripetal force, on the two trucks of a car
    radius, n = 250.0, 8
    track = TrackParams(segments=(TrackSegment(600.0, 1.0 / radius, 1.0 / radius),))
    params = make_train(cars(n), speed=2.0, position=300.0, track=track, brakes=NONE)
    run = drive(params, (Notch(0.0, 8),))
    run.advance_to(0.3)
    s = run.sample()
    length = 2.0 * (params.cars[0].pivot_distance + params.cars[0].front.length)
    axial = s.axial_force
    assert axial[0] > 200e3  # draft
    for i in range(1, n - 1):
        speed = math.hypot(*s.v[i, :2])
        lateral = s.rail_force[i].sum()
        expected = -0.5 * (axial[i - 1] + axial[i]) * length / radius + MASS * speed**2 / radius
        # the force along the coupler, not along the line between the centres: second order
        assert lateral == pytest.approx(expected, rel=5e-3)


def test_curve_resistance():
    radius = 400.0
    track = TrackParams(segments=(TrackSegment(3000.0, 1 / radius, 1 / radius),),
                        curve_resistance=7.0)  # fmt: skip
    params = make_train(2, speed=5.0, position=200.0, track=track, brakes=NONE)
    free = replace(params, track=replace(track, curve_resistance=0.0))
    speeds = []
    for one in (free, params):
        run = PlanarSimulation(tight(one, 1e-8))
        run.advance_to(10.0)
        speeds.append(math.hypot(*run.sample(10.0).v[0, :2]))
    lost = speeds[0] - speeds[1]
    assert lost == pytest.approx(10.0 * 7.0 / radius, rel=2e-3)  # 7 m / R over m
    assert run.sample().cars["resistance_N"] == pytest.approx(7.0 * 68e3 / radius, rel=1e-3)


def test_a_locomotive_of_the_library_pulls_and_brakes_by_its_curves():
    text = """
version: 1
title: two SD70ACe and ten cars
train:
  speed_kmh: 60
  consist: [{car: locomotive_sd70ace, count: 2}, {car: covered_hopper_286k, count: 10}]
initiation: {await_command: true, lateral_force_N: 0}
brakes: {signal_source: none}
traction: {notch: 4, schedule: [{time_s: 0, notch: -8, cars: [2]}]}
"""
    force = PlanarSimulation(loads_scenario(text).to_params()).sample().cars["locomotive_force_N"]
    # of modern_locomotives.yaml at 60 km/h: 161.6 kN and 250.7 kN
    assert force[:2] == pytest.approx([0.5 * 161.6e3, -250.7e3], rel=1e-6)
    assert not force[2:].any()


def test_an_emergency_cuts_the_power_of_each_locomotive_as_its_signal_arrives():
    n = 30
    rows = cars(n, (1, n))
    rows = tuple(replace(c, brakes=(replace(c.brakes[0], distance=16.348 * i),))
                 for i, c in enumerate(rows))  # fmt: skip
    trigger = BrakeTrigger(time=2.0, source="front")
    params = make_train(rows, speed=12.0, brakes=BrakeParams(triggers=(trigger,)))
    notches = (Notch(0.0, 8), Notch(1.0, 4, (n,)))
    run = drive(params, notches, response_time=2.0)
    full = effort_at(PlanarSimulation(params)._model.effort, 0, len(POWER), 12.0)
    assert full == pytest.approx(180e3)
    seen = []
    while run.time < 5.0:
        run.advance_to(run.time + 0.05)
        s = run.sample()
        seen.append((s.time, *s.cars["locomotive_force_N"][[0, n - 1]]))
    t, front, rear = np.array(seen).T
    speed = 12.0
    assert front[t < 1.9] == pytest.approx(np.interp(speed, *zip(*POWER)), rel=0.02)
    assert rear[(t > 2.1)][0] / front[t < 1.9][-1] == pytest.approx(0.5, rel=0.03)  # 1 s for half
    arrival = 2.0 + 16.348 * (n - 1) / params.brakes.signal_speed
    assert front[(t > 2.45) & (t < 2.55)] == pytest.approx(0.5 * front[0], rel=0.1)
    assert np.all(front[t > 3.05] == 0.0)
    assert np.all(rear[t < arrival] > 0.0)
    assert np.all(rear[t > arrival + 1.05] == 0.0)


@pytest.mark.parametrize("keep", [False, True])
def test_the_dynamic_brake_slows_the_train_and_may_outlast_an_emergency(keep):
    rows = cars(3, (1,), shoe="none")
    params = make_train(rows, speed=20.0, brakes=NOW)
    run = drive(params, (Notch(0.0, -8),), keep_dynamic=keep)
    run.advance_to(3.0)
    force = run.sample().cars["locomotive_force_N"][0]
    if keep:
        v = run.sample().v[0, 0]
        assert force == pytest.approx(-np.interp(v, *zip(*DYNAMIC)), rel=1e-3)
        assert run.sample().energy["dynamic_brake"] > 0.9 * 3.0 * 18.0 * 100e3
    else:
        assert force == 0.0


def test_energy_closes_with_everything_along_the_track():
    track = replace(CURVE, grades=(GradeChange(-math.inf, 0.015), GradeChange(80.0, -0.02, 50.0)),
                    curve_resistance=7.0)  # fmt: skip
    trigger = BrakeTrigger(time=6.0, source="front")
    params = make_train(cars(12, (1, 2, 12)), speed=14.0, position=20.0, track=track,
                        breaks=(150.0,), brakes=BrakeParams(triggers=(trigger,)))  # fmt: skip
    run = drive(params, (Notch(0.0, 8), Notch(3.0, -6)), response_time=2.0)
    outcome = run.run()
    energy = outcome.energy
    assert outcome.cars_derailed > 3
    for key in ("traction", "dynamic_brake", "resistance", "brakes", "ground_trucks"):
        assert energy[key] > 1e3, key
    assert abs(energy["potential"]) > 1e4
    assert outcome.energy_residual < 1e-3


def test_saved_runs_go_on_to_the_bit_on_a_grade():
    track = replace(CURVE, grades=(GradeChange(-math.inf, 0.01),))
    params = make_train(cars(5), speed=10.0, track=track)
    run = drive(params, (Notch(0.0, 5),))
    run.advance_to(2.0)
    again = PlanarSimulation.from_bytes(run.to_bytes())
    for r in (run, again):
        r.advance_to(5.0)
    assert again.state_hash() == run.state_hash()


@pytest.mark.parametrize(
    ("field", "change"),
    [
        ("traction.notches.0.cars",
         {"traction": TractionParams(notches=(Notch(0.0, 3, (2,)),))}),
        ("traction.notches.0.notch", {"traction": TractionParams(notches=(Notch(0.0, 9),))}),
        ("traction.notches.1.time",
         {"traction": TractionParams(notches=(Notch(3.0, 1), Notch(2.0, 1)))}),
        ("traction.cut_time", {"traction": TractionParams(cut_time=0.0)}),
        ("track.grades.1.length",
         {"track": TrackParams(grades=(GradeChange(0.0, 0.01, 40.0),
                                       GradeChange(30.0, 0.0, 40.0)))}),
        ("track.grades.0.grade", {"track": grade(0.7)}),
        ("track.curve_resistance", {"track": TrackParams(curve_resistance=-1.0)}),
    ],
)  # fmt: skip
def test_mistakes_name_their_field(field, change):
    params = replace(make_train(cars(3)), **change)
    with pytest.raises(ParameterError) as error:
        PlanarSimulation(params)
    assert error.value.field == field


def test_forces_along_the_track_cost_nothing_when_they_are_off():
    model = PlanarSimulation(make_train(3))._model
    flags = ("along", "profile", "gear", "strength", "lv_hold", "guide_strength")
    assert all(model.par[0][name] == 0.0 for name in flags)
