"""Models without forces in the plane: blockage, joint velocities, increments, bars as models."""

import math
import tracemalloc

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import minimize

from derail_ros.baselines.bar import bar_case_2, bar_case_3, limiting_speed
from derail_ros.baselines.blockage import blockage
from derail_ros.baselines.joints import joint_velocities
from derail_ros.baselines.models import MODELS, run_model
from derail_ros.baselines.roorda_gracie import _chain, least_work, roorda_gracie
from derail_ros.baselines.train import ModelError, brakes_of, derailing_train, take_apart
from derail_ros.scenario import load_scenario
from derail_ros.vocabulary.measures import MEASURES
from derail_ros.vocabulary.params import GRAVITY

SPEEDS = (30.0, 48.0, 60.0, 72.0, 90.0)
PUBLISHED = (5.0, 10.0, 14.0, 18.0, 24.0)


def base(speed=60.0, **overrides):
    return load_scenario("base_train").with_overrides({"train.speed_kmh": speed} | overrides)


# Blockage ------------------------------------------------------------------------------------


def test_blockage_reproduces_the_published_speed_series():
    answer = blockage(np.array(SPEEDS) / 3.6, 60)
    assert np.abs(answer.cars_derailed - PUBLISHED).max() < 1.0
    # and what is known of this very model
    assert answer.cars_derailed == pytest.approx([5.7, 10.5, 14.2, 18.2, 24.3], abs=0.11)


@pytest.mark.parametrize(("speed", "published"), list(zip(SPEEDS, PUBLISHED, strict=True)))
def test_blockage_of_the_scenario(speed, published):
    record = run_model("blockage", base(speed).to_params()).record
    assert abs(record["cars_derailed"] - published) < 1.0


def test_blockage_against_an_independent_integration():
    v0, n, m, lc = 20.0, 40, 70e3, 15.0

    def rates(t, y):
        gone = 1.0 + y[0] / lc
        places = np.linspace(gone, n, 4001) * lc
        share = np.clip((t - places / 290.0) / 10.0, 0.0, 1.0).mean()
        v = y[1]
        force = share * 35e3 * (n - gone) + (1.32 + 0.109 * v) * m * GRAVITY
        return [v, -force / ((n - gone) * m)]

    def stop(t, y):
        return y[1]

    stop.terminal = True
    exact = solve_ivp(rates, (0.0, 100.0), [0.0, v0], events=stop, rtol=1e-8, atol=1e-8)
    answer = blockage(v0, n, mass=m, car_length=lc)
    assert float(answer.cars_derailed) == pytest.approx(1.0 + exact.y[0, -1] / lc, abs=2e-3)
    assert float(answer.duration) == pytest.approx(exact.t[-1], abs=2e-2)


def test_thousands_of_trains_are_as_one_at_a_time():
    rng = np.random.default_rng(1)
    v, n = rng.uniform(0.0, 35.0, (40, 50)), rng.integers(5, 150, (40, 50))
    answer = blockage(v, n)
    assert answer.cars_derailed.shape == (40, 50)
    for i, j in ((0, 0), (7, 3), (39, 49)):
        one = blockage(v[i, j], n[i, j])
        assert float(one.cars_derailed) == answer.cars_derailed[i, j]
        assert bool(one.whole_train) == answer.whole_train[i, j]
    assert (answer.cars_derailed <= n).all()
    assert (answer.cars_derailed[answer.whole_train] == n[answer.whole_train]).all()


def test_thousands_of_trains_at_once_do_not_go_one_after_the_other(calls):
    rng = np.random.default_rng(2)
    v, n = rng.uniform(3.0, 33.0, 3000), rng.integers(10, 151, 3000)
    v[0], n[0] = 33.0, 150  # the one that runs the longest
    alone = calls(lambda: blockage(v[0], n[0]))
    assert calls(lambda: blockage(v, n)) < 2 * alone


def test_nothing_drives_the_train():
    v = np.linspace(0.0, 40.0, 200)
    assert (blockage(v, 60).peak_speed == v).all()


def test_blockage_counts_nothing_that_stops_short_of_the_point():
    answer = blockage(np.array([0.0, 3.0, 20.0]), 60, run_up=100.0)
    assert answer.cars_derailed[:2].tolist() == [0.0, 0.0]
    assert answer.cars_derailed[2] < float(blockage(20.0, 60).cars_derailed)


@pytest.mark.parametrize(
    "wrong", [{"mass": 0.0}, {"run_up": -1.0}, {"rise_time": math.nan}, {"signal_speed": 0.0}]
)
def test_blockage_refuses(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        blockage(10.0, 10, **wrong)


# Johnson and Guran ---------------------------------------------------------------------------


def dense(mass, length, inertia, impulse):
    """Free bars with multipliers for the joints: transverse and yaw velocities, all at once."""
    n = len(mass)
    k = np.zeros((3 * n - 1, 3 * n - 1))
    right = np.zeros(3 * n - 1)
    for i in range(n):
        k[2 * i, 2 * i], k[2 * i + 1, 2 * i + 1] = mass[i], inertia[i]
    for j in range(n - 1):
        row = np.zeros(2 * n)
        row[2 * j], row[2 * j + 1] = 1.0, -0.5 * length[j]
        row[2 * j + 2], row[2 * j + 3] = -1.0, -0.5 * length[j + 1]
        k[2 * n + j, : 2 * n] = row
        k[: 2 * n, 2 * n + j] = row
    right[0], right[1] = impulse, 0.5 * length[0] * impulse
    x = np.linalg.solve(k, right)
    return x[0 : 2 * n : 2], x[1 : 2 * n : 2], -x[2 * n :]


def test_joint_velocities_against_a_dense_solve():
    rng = np.random.default_rng(3)
    for n in (1, 2, 5, 40):
        m, lengths = rng.uniform(20e3, 130e3, n), rng.uniform(10.0, 25.0, n)
        inertia = m * lengths**2 / 12.0 * rng.uniform(0.6, 1.2, n)
        centre, yaw, passed = dense(m, lengths, inertia, 700.0)
        answer = joint_velocities(m, lengths, inertia=inertia, impulse=700.0)
        assert answer.centre == pytest.approx(centre, rel=1e-9, abs=1e-15)
        assert answer.yaw_rate == pytest.approx(yaw, rel=1e-9, abs=1e-15)
        assert answer.joint[0] == pytest.approx(centre[0] + 0.5 * lengths[0] * yaw[0])
        assert answer.impulse == pytest.approx(-passed, rel=1e-7, abs=1e-9) or answer.impulse == (
            pytest.approx(passed, rel=1e-7, abs=1e-9)
        )
        energy = 0.5 * (m * centre**2 + inertia * yaw**2).sum()
        assert answer.energy == pytest.approx(energy)


def test_a_chain_of_any_length_costs_no_more_than_its_length():
    n = 50_000  # a matrix of all joints would take 20 GB
    m, lengths = np.full(n, 75e3), np.full(n, 15.0)
    m[::3] = 30e3
    tracemalloc.start()
    try:
        answer = joint_velocities(m, lengths, impulse=1.0)
        used = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert used < 1000 * n
    few = joint_velocities(m[:60], lengths[:60], impulse=1.0)
    assert answer.joint[:30] == pytest.approx(few.joint[:30], abs=1e-15)


def test_equal_bars_fall_off_by_two_less_root_three():
    answer = joint_velocities(np.full(200, 75e3), 15.0)
    ratio = answer.joint[1:20] / answer.joint[:19]
    assert ratio == pytest.approx(np.full(19, -(2.0 - math.sqrt(3.0))))


def test_heavy_cars_near_the_blow_make_it_milder():
    light = np.full(10, 45e3)
    heavy = light.copy()
    heavy[0] = 120e3
    at_blow = joint_velocities(heavy, 15.0)
    all_light = joint_velocities(light, 15.0)
    assert abs(at_blow.bend[0]) < abs(all_light.bend[0])
    assert at_blow.joint[0] < all_light.joint[0]


@pytest.mark.parametrize("wrong", [([], 1.0), ([1.0, -1.0], 1.0), ([1.0], 0.0), ([math.nan], 1.0)])
def test_joint_velocities_refuse(wrong):
    with pytest.raises(ValueError):
        joint_velocities(*wrong)


# Roorda and Gracie ---------------------------------------------------------------------------


def incremental(speed=60.0, **options):
    params = base(speed).to_params()
    train = derailing_train(params)
    return train, roorda_gracie(train, brakes_of(params, train), **options)


def test_motion_has_the_least_frictional_work():
    rng = np.random.default_rng(5)
    theta = rng.uniform(-1.2, 1.2, 4)
    jacobian, push = _chain(theta, np.full(4, 16.0), np.full(4, 8.0), np.full(4, 5.75), 0.25)
    load = rng.uniform(0.5, 1.5, 8)

    def work(x):
        r = jacobian @ x + push
        return float(load @ np.sqrt((r * r).sum(axis=1)))

    found = work(least_work(jacobian, push, load, np.zeros(4)))
    best = min(
        minimize(work, start, method="Nelder-Mead", options={"maxiter": 20000, "xatol": 1e-9,
                 "fatol": 1e-12}).fun
        for start in (np.zeros(4), rng.normal(0.0, 0.01, 4))
    )  # fmt: skip
    assert found < work(np.zeros(4))
    assert found < 1.01 * best


def test_jacobian_of_the_chain_is_its_derivative():
    theta = np.array([0.4, -0.7, 0.2])
    link, behind, truck = np.array([16.0, 14.0, 15.0]), np.array([8.0, 6.5, 7.5]), np.full(3, 5.5)

    def trucks(angles):
        u = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        pin, out = np.zeros(2), np.zeros((6, 2))
        for i in (2, 1, 0):
            out[2 * i] = pin + (behind[i] + truck[i]) * u[i]
            out[2 * i + 1] = pin + (behind[i] - truck[i]) * u[i]
            pin = pin + link[i] * u[i]
        return out

    jacobian, push = _chain(theta, link, behind, truck, 0.25)
    for i in range(3):
        step = np.zeros(3)
        step[i] = 1e-6
        slope = (trucks(theta + step) - trucks(theta - step)) / 2e-6
        assert jacobian[:, :, i] == pytest.approx(slope, abs=1e-7)
    assert push.tolist() == [[0.25, 0.0]] * 6


def test_kinetic_energy_is_spent_and_never_rises():
    train, run = incremental()
    assert (np.diff(run.energy) < 0.0).all()
    assert run.energy[-1] == 0.0
    assert run.energy[0] == pytest.approx(0.5 * train.masses().sum() * train.speed**2)
    assert run.ground_work + run.brake_work == pytest.approx(run.energy[0])
    assert not run.whole_train
    assert (np.diff(run.time) > 0.0).all()


def test_chain_keeps_its_links():
    train, run = incremental(48.0)
    ahead, behind = train.reach()
    u = np.stack([np.cos(run.pose[:, 2]), np.sin(run.pose[:, 2])], axis=-1)
    rear = run.pose[:, :2] - behind[:, None] * u
    front = run.pose[:, :2] + ahead[:, None] * u
    assert rear[:-1] == pytest.approx(front[1:], abs=1e-9)
    assert (run.pose[run.derailed :, 1:] == 0.0).all()
    yaw = run.pose[: run.derailed, 2]
    assert (yaw[:-1] * yaw[1:] < 0.0).all()  # an accordion


def test_outcome_hardly_knows_increment_and_kink():
    counts = {incremental(60.0, increment=h)[1].derailed for h in (0.1, 0.25, 0.5)}
    counts |= {incremental(60.0, start_angle=a)[1].derailed for a in (0.03, 0.3)}
    assert max(counts) - min(counts) <= 1


def test_more_friction_derails_fewer():
    counts = [incremental(90.0, friction=mu)[1].derailed for mu in (0.5, 1.0, 2.0)]
    assert counts[0] > counts[1] > counts[2]


# Trains --------------------------------------------------------------------------------------


def test_cars_ahead_of_the_derailment_are_left_out():
    params = load_scenario("mid_train_break").to_params()
    train = derailing_train(params)
    assert train.first == 23
    assert train.n == 50 - 23
    assert train.run_up == pytest.approx(0.5)
    brakes = brakes_of(params, train)
    assert np.isfinite(brakes.conventional).all()  # opened by the derailment
    assert brakes.conventional[0] == pytest.approx(train.run_up / train.speed)


def test_virtual_cars_are_taken_apart():
    params = load_scenario("mississauga_published").to_params()
    whole = load_scenario("mississauga").to_params()
    cars = take_apart(params.cars)
    assert len(cars) == len(whole.cars) == 74
    assert sum(c.mass for c in cars) == pytest.approx(sum(c.mass for c in params.cars))
    assert derailing_train(params).masses() == pytest.approx(derailing_train(whole).masses())


def test_brakes_are_those_of_the_engine():
    params = base(60.0).to_params()
    brakes = brakes_of(params, derailing_train(params))
    assert brakes.at(0.0, 10.0).tolist() == [0.0] * 60
    full = brakes.at(100.0, 0.0)
    assert full == pytest.approx(np.full(60, 64e3))
    assert brakes.at(100.0, 30.0)[0] == pytest.approx(brakes.at(100.0, 23.0)[0])
    assert brakes.conventional[10] == pytest.approx(10 * 16.348 / 290.0, rel=1e-3)


def test_nothing_derails():
    scenario = base(60.0, **{"track.rail_breaks": [], "initiation.derailed_trucks": [],
                             "initiation.await_command": True})  # fmt: skip
    with pytest.raises(ModelError, match="nothing derails"):
        run_model("blockage", scenario.to_params())


# Bars ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("cars", [10, 20, 60])
def test_published_bar_gains_energy_and_the_corrected_one_does_not(cars):
    # Nothing drives the train, so that a rising speed is energy from nowhere.
    speed = 1.5 * float(limiting_speed(cars))
    published = bar_case_2(speed, cars, form="published")
    corrected = bar_case_2(speed, cars, form="corrected")
    assert bool(published.whole_train)
    assert float(published.peak_speed) > 1.05 * speed
    assert float(corrected.peak_speed) == speed
    assert float(bar_case_3(speed, cars, form="corrected").peak_speed) == speed


@pytest.mark.parametrize("name", [m for m in MODELS if m.startswith("bar")])
def test_bars_as_models(name):
    record = run_model(name, base(60.0).to_params()).record
    assert 0 < record["cars_derailed"] <= 60
    assert set(MEASURES) <= record.keys()
