"""What must stay as it is: momentum, energy, rest, the line, the ledger."""

import math
from dataclasses import replace

import numpy as np
import pytest

from derail_ros.engine import PlanarSimulation
from derail_ros.engine.methods import METHODS
from derail_ros.scenario import loads_scenario
from derail_ros.vocabulary.params import (
    BrakeParams,
    BrakeTrigger,
    ContactParams,
    CouplerType,
    GroundParams,
    LateralForce,
    TrackParams,
    TrackSegment,
)
from tests.engine.support import (
    CURVE,
    NO_CONTACT,
    all_trucks,
    free_train,
    kicked,
    make_car,
    make_train,
    mixed_cars,
    place,
    steps_of,
    tight,
    with_integration,
)


def momentum(params, sample):
    """Momentum (x, y) and moment of momentum about the origin."""
    m = np.array([c.mass for c in params.cars])
    inertia = np.array([[c.inertia, c.coupler_inertia, c.coupler_inertia] for c in params.cars])
    p = (m[:, None] * sample.v[:, :2]).sum(axis=0)
    arm = sample.q[:, 0] * sample.v[:, 1] - sample.q[:, 1] * sample.v[:, 0]
    return np.array([*p, (m * arm).sum() + (inertia * sample.v[:, 2:]).sum()])


def entry(sample, name):
    """An entry of the ledger."""
    return sample.energy[name]


# A free chain ----------------------------------------------------------------------------------


@pytest.mark.parametrize("method", METHODS)
def test_a_free_chain_keeps_momentum_and_energy(method):
    # strikers into their second stiffness, knuckles at work
    rtol = {"rkf45": 1e-8, "row": 1e-9}[method]
    params = tight(free_train(mixed_cars(6), speed=3.0, contact=NO_CONTACT), rtol, method=method)
    run = kicked(params, seed=3, angle=0.12, rate=0.4)
    first = run.sample()
    before = momentum(params, first)
    stored = ("kinetic", "striker", "knuckle")
    energy = sum(entry(first, k) for k in stored)
    seen = {"stiff": False, "knuckle": False}
    scale = abs(before[0])
    for _ in steps_of(run, {"rkf45": 3.0, "row": 1.0}[method]):
        s = run.sample()
        assert momentum(params, s)[:2] == pytest.approx(before[:2], abs=1e-9 * scale)
        assert momentum(params, s)[2] == pytest.approx(before[2], abs=1e-6 * scale)
        now = sum(entry(s, k) for k in (*stored, "striker_dampers", "knuckles_released"))
        assert now == pytest.approx(energy, rel=1e-6)
        for i, c in enumerate(params.cars):
            x = c.front.striker_arm * (s.q[i, 3] - s.q[i, 2])
            seen["stiff"] |= abs(x) > c.front.striker_opening
        seen["knuckle"] |= bool(np.abs(s.knuckle_moment).max() > 0.0)
    assert entry(s, "striker_dampers") > 1e3
    assert seen == {"stiff": True, "knuckle": True}
    assert run.outcome().max_coupler_gap < 1e-9


def test_a_push_gives_its_impulse():
    push = LateralForce(force=30e3, duration=0.7, car=2, place="rear")
    params = tight(free_train(mixed_cars(4), speed=3.0, lateral=(push,), contact=NO_CONTACT))
    run = PlanarSimulation(params)
    before = momentum(params, run.sample())
    run.advance_to(1.0)
    after = momentum(params, run.sample())
    assert (after - before)[:2] == pytest.approx([0.0, 21e3], abs=1e-5)
    # and its work, the energy the ledger says it put in
    work = entry(run.sample(), "external")
    assert work > 10.0
    gained = sum(entry(run.sample(), k) for k in ("kinetic", "striker", "striker_dampers"))
    assert gained - entry(run.sample(), "initial") == pytest.approx(work, rel=1e-6)


def test_a_collision_keeps_momentum_and_loses_energy():
    q = np.zeros((2, 5))
    q[1] = [-16.0, 0.9, 0.1, 0.1, 0.1]
    v = np.zeros((2, 5))
    v[1, 0] = 9.0
    params = tight(free_train(2, parted=(1,), speed=0.0), 1e-8)
    run = place(PlanarSimulation(params), q, v)
    before = momentum(params, run.sample())
    energy = entry(run.sample(), "kinetic")
    run.advance_to(2.0)
    s = run.sample()
    (collision,) = run.collisions
    assert np.abs(s.v - v).max() > 1.0
    assert momentum(params, s) == pytest.approx(before, abs=1e-9 * abs(before[0]))
    now = entry(s, "kinetic") + entry(s, "striker") + entry(s, "striker_dampers")
    assert now < 0.9 * energy
    assert energy - now == pytest.approx(entry(s, "collisions"), rel=1e-6)
    assert collision.energy_lost == pytest.approx(entry(s, "collisions"), rel=1e-3)


def test_a_contact_without_speed_dependence_gives_its_energy_back():
    elastic = ContactParams(c1=0.0, c2=0.0)
    q = np.zeros((2, 5))
    q[1, :2] = [-16.0, 0.3]
    v = np.zeros((2, 5))
    v[1, 0] = 3.0
    # two equal cars, head on: couplers without springs worth the name keep out of it
    params = tight(free_train(2, parted=(1,), speed=0.0, contact=elastic), 1e-9)
    run = place(PlanarSimulation(params), q, v)
    run.advance_to(2.0)
    s = run.sample()
    assert len(run.collisions) == 1
    assert entry(s, "kinetic") == pytest.approx(0.5 * 68e3 * 9.0, rel=1e-3)
    assert abs(entry(s, "collisions")) < 1e-6 * entry(s, "initial")


# The ledger ------------------------------------------------------------------------------------


def ledger_of_samples(run, until):
    """Works integrated by Simpson's rule from what samples say, all in J."""
    cars = run.params.cars
    truck = np.array([[c.truck_distance, -c.truck_distance] for c in cars])
    total = 0.0
    while not run.ended and run.time < until:
        run.advance_steps(1)
        h = run.step_size
        # the step's own constraints: samples just inside of it
        inside = run.time - 1e-9 * h
        for t, weight in ((run.previous_time, 1), (run.time - 0.5 * h, 4), (inside, 1)):
            s = run.sample(t)
            v, q = s.v, s.q
            n = np.stack([-np.sin(q[:, 2]), np.cos(q[:, 2])], axis=1)
            at_truck = v[:, None, :2] + (v[:, 2, None] * truck)[:, :, None] * n[:, None, :]
            brakes = s.brake_force @ np.hypot(*v[:, :2].T)
            trucks = -(s.ground_truck_force * at_truck).sum()
            free = s.ground_truck_force.any(axis=(1, 2)) == 0
            body = -(s.ground_body_force * v[:, :2]).sum()
            body -= (s.ground_moment * v[:, 2])[free & s.ground_body_force.any(axis=1)].sum()
            collisions = -(s.collision_force * v[:, :2]).sum()
            collisions -= (s.collision_moment * v[:, 2]).sum()
            damping = 0.0
            for i, c in enumerate(cars):
                for e, rate in ((c.front, v[i, 3] - v[i, 2]), (c.rear, v[i, 4] - v[i, 2])):
                    damping += e.damping * (e.striker_arm * rate) ** 2
            pushed = np.zeros(2)
            if run.params.initiation.lateral_forces:
                pushed = (s.external_force[0] * at_truck[0, 0]).sum()
            power = np.array([brakes, trucks, body, collisions, damping, np.sum(pushed)])
            total = total + weight / 6.0 * h * power
    return total


def test_the_ledger_is_the_work_of_the_forces_that_samples_show():
    params = make_train(
        8,
        speed=60.0 / 3.6,
        derailed=((1, "front"), (1, "rear")),
        breaks=(0.0,),
        lateral=(LateralForce(),),
        triggers=(BrakeTrigger(),),
    )
    run = PlanarSimulation(with_integration(params, max_step=5e-3))
    works = ledger_of_samples(run, 6.0)
    names = (
        "brakes",
        "ground_trucks",
        "ground_body",
        "collisions",
        "striker_dampers",
        "external",
    )
    final = run.sample().energy
    for name, work in zip(names, works):
        assert work == pytest.approx(final[name], rel=5e-3, abs=1e-4 * final["initial"]), name
        assert final[name] != 0.0, name


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("track", [None, CURVE], ids=["straight", "curved"])
def test_the_ledger_balances(track, method):
    position = 0.0 if track is None else 300.0
    params = make_train(
        15,
        speed=60.0 / 3.6,
        position=position,
        derailed=((1, "front"), (1, "rear")),
        breaks=(position,),
        lateral=(LateralForce(),),
        triggers=(BrakeTrigger(),),
        track=track,
    )
    run = PlanarSimulation(with_integration(params, method=method))
    outcome = run.run()
    assert outcome.status == "at rest"
    assert len(run.collisions) > 3
    limit = {"rkf45": 1e-4, "row": 1e-2}[method]
    assert outcome.energy_residual < limit
    e = outcome.energy
    assert e["initial"] == pytest.approx(0.5 * 15 * 68e3 * (60 / 3.6) ** 2, rel=1e-3)
    taken = ("brakes", "ground_trucks", "ground_body", "collisions", "striker_dampers",
             "knuckles_released")  # fmt: skip
    assert all(e[k] >= 0.0 for k in taken)
    total = e["kinetic"] + e["striker"] + e["knuckle"] + sum(e[k] for k in taken)
    total -= e["external"] + e["stabilization_net"]
    assert total == pytest.approx(e["initial"], rel=limit)
    assert e["kinetic"] < 1e-4 * e["initial"]
    # what the projection puts in is next to nothing
    assert e["stabilization_gross"] < 1e-3 * e["initial"]
    assert outcome.max_coupler_gap < 1e-9
    assert outcome.max_truck_offset < 1e-9


ALL_AT_ONCE = """
version: 1
title: all that can be on, at once
train:
  speed_kmh: 60
  consist:
    - {car: locomotive_sd70ace, count: 2}
    - {car: covered_hopper_286k, count: 8}
    - {car: boxcar_50ft_286k, load: empty, count: 4, brake: {hand_brake: true}}
    - {car: boxcar_50ft_286k, load: empty, count: 4, brake: {cut_out: true}}
    - {car: locomotive_sd70ace}
    - {car: well_car_53ft_3_unit, count: 2}
    - {car: covered_hopper_286k, count: 6, brake: {empty_load_device: false}}
track:
  start_coordinate_m: -600
  start_x_m: -600
  alignment:
    - tangent: {length_m: 600}
    - spiral: {length_m: 60, degree_of_curve_end: 6, turn: left}
    - curve: {length_m: 900, degree_of_curve: 6, turn: left}
    - tangent: {length_m: 900}
  rail_breaks: [220]
  grades: [{grade_percent: 1.0}, {from_m: 200, grade_percent: -1.5, vertical_curve_m: 100}]
  curve_resistance_m2_per_s2: 7
initiation: {position_m: 80, lateral_force_car: 5}
resistance: {law: fcalc}
traction:
  notch: 8
  keep_dynamic: true
  response_time_s: 4
  schedule: [{time_s: 2, notch: -4, cars: [19]}]
brakes: {law: braking_ratio, system: distributed_power, signal_source: none, vent_on_parting: true}
couplers:
  draft_gear: {start: middle}
  knuckle_strength_N: 2.89e6
  body_strength_N: 4.0e6
  weak: [{coupling: 12, strength_N: 0.3e6}]
derailment: {lv_limit: 0.8, lv_hold_s: 0.05, truck_play_m: 0.03, guide_strength_N: 200e3}
"""


def test_the_ledger_balances_with_everything_on():
    outcome = PlanarSimulation(loads_scenario(ALL_AT_ONCE).to_params()).run()
    assert outcome.energy_residual < 1e-3
    for key in ("traction", "dynamic_brake", "resistance", "brakes", "draft_gear_friction",
                "ground_trucks", "collisions", "knuckles_released"):  # fmt: skip
        assert outcome.energy[key] > 1e4, key
    assert abs(outcome.energy["guidance"]) > 1e3 and abs(outcome.energy["potential"]) > 1e5
    assert outcome.cars_derailed > 3 and {p.cause for p in outcome.parted} > {"angle"}


# Rest ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", METHODS)
def test_a_train_at_rest_stays_at_rest(method):
    params = make_train(5, speed=0.0, derailed=((1, "front"), (3, "rear")), parted=(2,),
                        triggers=(BrakeTrigger(),))  # fmt: skip
    run = PlanarSimulation(with_integration(params, method=method))
    home = run.sample()
    outcome = run.run()
    assert outcome.status == "at rest"
    assert 0.0 <= outcome.duration < 0.05
    assert np.array_equal(run.sample().q, home.q)
    assert np.all(run.sample().v == 0.0)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("free", [False, True])
def test_steps_at_rest_do_not_wake_a_car(method, free):
    # Coupled or free on the ground, rounding gives it velocities that no step may make grow.
    cars = (make_car(0), make_car(1))
    params = make_train(cars, speed=0.0, derailed=((1, "front"), (1, "rear"), (2, "rear")),
                        parted=(1,) if free else (), triggers=())  # fmt: skip
    q = PlanarSimulation(params).sample().q
    v = np.zeros((2, 5))
    v[0, :3] = 1e-9, -2e-9, 1e-10
    params = with_integration(params, method=method, rest_hold=20.0, time_limit=10.0)
    run = place(PlanarSimulation(params), q, v)
    before = run.outcome().energy
    outcome = run.run()
    assert np.abs(run.sample().v[:, :3]).max() < 1e-9
    for name in ("ground_trucks", "ground_body", "striker_dampers"):
        assert outcome.energy[name] >= -1e-9, name
    assert outcome.energy["kinetic"] <= before["kinetic"]


def test_a_push_below_the_friction_leaves_a_car_creeping_at_the_smoothed_speed():
    # alone on the ground: 50 kN at the mass centre against 0.8 x 667 kN
    push = LateralForce(place="centre", duration=100.0)
    params = make_train(
        1, speed=0.0, derailed=all_trucks(1), lateral=(push,), ground=GroundParams(c_v=0.0)
    )
    run = PlanarSimulation(tight(params, 1e-9, rest_speed=1e-9, time_limit=3.0))
    run.run()
    v = run.sample().v[0]
    weight = 68e3 * 9.81

    def resistance(u):
        return weight * (0.7 + 0.1 * math.exp(-u / 0.01)) * u / math.hypot(u, 0.01)

    assert 0.0 < v[1] < 1e-3
    assert resistance(v[1]) == pytest.approx(50e3, rel=1e-5)
    assert abs(v[0]) < 1e-12
    assert abs(v[2]) < 1e-12


def test_a_car_alone_slides_to_rest_where_its_friction_says():
    # constant friction: v^2 / (2 mu g), from both trucks and from the ten points of the body
    ground = GroundParams(c_s=0.5, c_d=0.5, c_v=0.0, eps=1e-3)
    params = tight(make_train(1, speed=8.0, derailed=all_trucks(1), ground=ground), 1e-7)
    run = PlanarSimulation(params)
    run.run()
    assert run.sample().q[0, 0] == pytest.approx(64.0 / (2 * 0.5 * 9.81), rel=1e-4)
    limit = params.integration.rest_speed
    assert run.outcome().duration == pytest.approx((8.0 - limit) / (0.5 * 9.81), abs=0.03)
    assert np.abs(run.sample().q[0, 1:]).max() == 0.0


def test_a_car_spinning_on_the_ground_slows_as_its_ten_points_say():
    ground = GroundParams(c_s=0.5, c_d=0.5, c_v=0.0, eps=1e-4)
    params = tight(make_train(1, speed=0.0, derailed=all_trucks(1), ground=ground), 1e-8)
    c = params.cars[0]
    v = np.array([[0.0, 0.0, 2.0, 2.0, 2.0]])
    run = place(PlanarSimulation(params), v=v)
    run.advance_to(0.2)
    # ten points at the middles of tenths: mean distance from the centre is a quarter length
    torque = 0.5 * c.mass * 9.81 * 0.25 * c.length
    # the couplers are carried along by their strikers
    inertia = c.inertia + 2 * c.coupler_inertia
    spin = run.sample(0.2).v[0]
    carried = (c.inertia * spin[2] + 20e3 * (spin[3] + spin[4])) / inertia
    assert carried == pytest.approx(2.0 - torque / inertia * 0.2, rel=1e-6)


# Brakes ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("shoe", ["composition", "cast_iron"])
@pytest.mark.parametrize("cars", [1, 4])
def test_stopping_distance_from_80_kmh(shoe, cars):
    # instant full application: m times the integral of v / F(v), the same for both shoes
    train = tuple(make_car(i, shoe=shoe) for i in range(cars))
    params = make_train(train, speed=80.0 / 3.6, triggers=(BrakeTrigger(mode="instant"),))
    run = PlanarSimulation(tight(params, 1e-7, rest_speed=1e-3, rest_hold=0.1))
    home = run.sample().q
    run.run()
    v = np.linspace(0.0, 80.0 / 3.6, 4001)
    mu = (v + 19.223) / (v + 9.388) * (9.388 / 19.223)
    y = v / mu
    distance = 68e3 / 64e3 * np.sum(0.5 * (y[1:] + y[:-1]) * np.diff(v))
    travelled = run.sample().q[:, 0] - home[:, 0]
    assert travelled == pytest.approx(distance, rel=1e-3)


def test_half_the_brake_of_a_car_with_one_truck_on_the_rails():
    params = make_train(1, derailed=((1, "front"),), triggers=(BrakeTrigger(mode="instant"),),
                        ground=GroundParams(scale=0.0))  # fmt: skip
    whole = replace(params, initiation=replace(params.initiation, derailed_trucks=()))
    none = replace(params, initiation=replace(params.initiation, derailed_trucks=all_trucks(1)))
    forces = [PlanarSimulation(p).sample().brake_force[0] for p in (whole, params, none)]
    u = 15.0
    full = 64e3 * (u + 19.223) / (u + 9.388) * 9.388 / 19.223
    assert forces == pytest.approx([full, 0.5 * full, 0.0], rel=1e-6)


@pytest.mark.parametrize("mode", ["traction_limited", "instant_traction_limited"])
def test_traction_limited_force(mode):
    brakes = BrakeParams(traction_coefficient=0.15, triggers=(BrakeTrigger(mode=mode),))
    run = PlanarSimulation(make_train(3, brakes=brakes, speed=30.0))
    run.advance_to(2.0)
    s = run.sample(2.0)
    full = 0.15 * 68e3 * 9.81
    if mode.startswith("instant"):
        assert s.brake_force == pytest.approx([full] * 3, rel=1e-6)
    else:
        arrivals = np.array([0.0, 16.348, 32.696]) / 290.0
        assert s.brake_force == pytest.approx(full * (2.0 - arrivals) / 10.0, rel=1e-6)


# Curves ----------------------------------------------------------------------------------------

LIMP = CouplerType("limp", "F", 1.524, 1.220, 0.300, 1e-3, k2=1e-3, damping=0.0)
CIRCLE = TrackParams(segments=(TrackSegment(2000.0, 1 / 400, 1 / 400),))


@pytest.mark.parametrize("turn", [1.0, -1.0])
@pytest.mark.parametrize("stabilization", ["projection", "baumgarte"])
def test_one_car_on_a_curve(turn, stabilization):
    circle = TrackParams(segments=(TrackSegment(900.0, turn / 400, turn / 400),))
    params = make_train((make_car(0),), speed=20.0, position=50.0, track=circle)
    run = PlanarSimulation(with_integration(params, stabilization=stabilization))
    c = params.cars[0]
    # the mass centre runs inside of the trucks; both trucks carry the same
    inner = math.sqrt(400.0**2 - c.truck_distance**2)
    expected = 0.5 * c.mass * 20.0**2 * 400.0 / inner**2
    for _ in steps_of(run, 10.0):
        s = run.sample()
        assert s.rail_force == pytest.approx(turn * expected, rel=1e-5)
        assert np.hypot(*s.v[0, :2]) == pytest.approx(20.0, rel=1e-6)
        radius = np.hypot(s.q[0, 0], s.q[0, 1] - turn * 400.0)
        assert radius == pytest.approx(inner, abs=1e-6)
    assert run.sample().truck_coordinate[0, 0] > 240.0
    assert run.outcome().max_truck_offset < 1e-6
    # m v^2 / R
    total = s.rail_force.sum()
    assert total == pytest.approx(turn * c.mass * 20.0**2 / 400.0, rel=1e-3)


def test_a_train_on_a_curve_of_400_m():
    # started within the curve; strikers too limp to matter
    cars = tuple(make_car(i, front=LIMP, rear=LIMP) for i in range(20))
    params = make_train(cars, speed=20.0, position=500.0, track=CIRCLE)
    run = PlanarSimulation(params)
    first = run.sample()
    assert first.coupler_gap.max() < 1e-9
    mass = params.cars[0].mass
    for _ in steps_of(run, 8.0):
        s = run.sample()
        # all cars alike, each on its own circle, nothing in the couplers
        assert s.rail_force == pytest.approx(0.5 * mass * 20.0**2 / 400.0, rel=1e-3)
        assert np.abs(s.coupler_force).max() < 50.0
    outcome = run.outcome()
    assert outcome.max_truck_offset < 1e-6
    assert outcome.max_coupler_gap < 1e-6
    assert np.hypot(*s.v[:, :2].T) == pytest.approx(20.0, rel=1e-5)


@pytest.mark.parametrize("method", METHODS)
def test_through_tangent_spirals_and_curves(method):
    # every truck stays on the line within a micrometre, and the rails carry m v^2 kappa
    params = make_train(10, speed=18.0, position=-5.0, track=CURVE)
    run = PlanarSimulation(with_integration(params, method=method))
    mass = params.cars[0].mass
    offsets, within = 0.0, 0
    while run.time < 70.0:
        run.advance_to(run.time + 0.7)
        s = run.sample()
        for i, car in enumerate(params.cars):
            for k, r in enumerate((car.truck_distance, -car.truck_distance)):
                x = s.q[i, 0] + r * math.cos(s.q[i, 2])
                y = s.q[i, 1] + r * math.sin(s.q[i, 2])
                offsets = max(offsets, abs(run.track.locate(x, y, s.truck_coordinate[i, k])[1]))
        line = np.array([[run.track.point(c) for c in row] for row in s.truck_coordinate])
        heading, kappa = line[:, :, 2], line[:, :, 3]
        # Newton: the rails alone turn the train, along their normals
        rails = np.array(
            [(-s.rail_force * np.sin(heading)).sum(), (s.rail_force * np.cos(heading)).sum()]
        )
        assert rails == pytest.approx((mass * s.a[:, :2]).sum(axis=0), abs=1e-3)
        if np.ptp(kappa) == 0.0 and kappa[0, 0] != 0.0:
            # all in one circular curve: m v^2 / R, and what the couplers hand from car to car
            within += 1
            carried = 0.5 * mass * 18.0**2 * kappa[0, 0]
            assert s.rail_force.mean() == pytest.approx(carried, rel=0.01)
            assert np.abs(s.rail_force - carried).max() < 0.5 * abs(carried)
    assert within > 10
    assert offsets < 1e-6
    assert run.outcome().max_truck_offset < 1e-6
    # nothing brakes: what is lost is lost in the strikers' dampers
    assert s.truck_coordinate[-1, 1] > 850.0
    assert run.outcome().energy_residual < 1e-6


def test_baumgarte_keeps_the_line_too():
    params = with_integration(
        make_train(6, speed=18.0, position=-100.0, track=CURVE), stabilization="baumgarte"
    )
    run = PlanarSimulation(params)
    run.advance_to(30.0)
    outcome = run.outcome()
    assert 0.0 < outcome.max_truck_offset < 1e-3
    assert outcome.max_coupler_gap < 1e-3
