"""The model as a whole: impact tests, the published base train and validation run."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from derail_ros.engine import PlanarSimulation
from derail_ros.engine.methods import METHODS
from derail_ros.scenario import load_scenario
from derail_ros.vocabulary.params import ContactParams
from research.impact import impacts
from tests.engine.support import make_car, make_train, start, steps_of, tight, with_integration

# Impact tests ----------------------------------------------------------------------------------

STRIKER, STANDING = 158e3, 327e3


def impact(kmh):
    """A car of 158 t runs into three standing cars of 327 t, all on rails, nothing braked."""
    cars = (*(make_car(i, mass=STANDING / 3) for i in range(3)), make_car(3, mass=STRIKER))
    params = tight(make_train(cars, speed=0.0, parted=(3,)), 1e-8, max_step=1e-3)
    home = PlanarSimulation(params).sample().q
    home[3, 0] -= 1.0
    v = np.zeros((4, 5))
    v[3, 0] = kmh / 3.6
    run = start(params, home, v)
    rows = []
    for _ in steps_of(run, 10.0):
        s = run.sample()
        rows.append((s.time, s.collision_force[2, 0], s.corner_force.max()))
        if run.collisions and run.collisions[0].final:
            break
    return run, np.array(rows)


def one_dimension(kmh):
    """Peak force of two corners and its duration, from the gap's own equation."""
    reduced = STRIKER * STANDING / (STRIKER + STANDING)

    def force(x, closing):
        factor = max(0.0, 1.0 + 0.1 * closing + 0.025 * closing * abs(closing))
        top = 2.0 * ContactParams().force_max
        return top * 2.0 ** -((max(x, 0.0) / 0.08) ** 2) * factor * (x < 0.8)

    def rhs(t, y):
        return [-y[1], -force(*y) / reduced]

    t = np.linspace(0.0, 0.8, 16001)
    y = solve_ivp(rhs, (0.0, 0.8), [0.81, kmh / 3.6], t_eval=t, rtol=1e-9, atol=1e-11,
                  max_step=5e-3).y  # fmt: skip
    f = np.array([force(*row) for row in y.T])
    on = t[f > 0.1 * f.max()]
    return f.max(), on[-1] - on[0], y[1, -1]


@pytest.mark.parametrize("kmh", [15.0, 20.4, 25.0])
def test_impact_of_tank_cars(kmh):
    # Measured: 2.2 to 4.5 MN, 0.2 to 0.3 s. The law was fitted to that and then made stiffer.
    run, rows = impact(kmh)
    t, force, corner = rows.T
    peak = force.max()
    on = t[force > 0.1 * peak]
    duration = on[-1] - on[0]
    print(
        f"{kmh:4.1f} km/h: peak {peak / 1e6:.2f} MN ({corner.max() / 1e6:.2f} MN at a corner), "
        f"{duration:.3f} s above a tenth of it"
    )
    (collision,) = run.collisions
    assert (collision.car_a, collision.car_b) == (4, 3)
    assert collision.closing_speed == pytest.approx(kmh / 3.6, abs=0.2)
    # head on, aligned: two corners
    assert peak == pytest.approx(2.0 * corner.max(), rel=1e-9)
    expected, length, parting = one_dimension(kmh)
    assert peak == pytest.approx(expected, rel=1e-3)
    assert duration == pytest.approx(length, abs=4e-3)
    s = run.sample()
    assert s.v[3, 0] - s.v[2, 0] == pytest.approx(parting, abs=2e-2)
    assert parting < 0.0
    # stiffer than measured, but of that order
    assert 2.2e6 < peak < 4.0 * 4.5e6
    assert 0.3 / 4.0 < duration < 0.3
    # momentum goes to the standing cars
    total = STRIKER * s.v[3, 0] + STANDING / 3.0 * s.v[:3, 0].sum()
    assert total == pytest.approx(STRIKER * kmh / 3.6, rel=1e-9)


def test_the_impacts_of_the_validation_are_those_of_the_model():
    for found in impacts():
        t, force, _ = impact(found.speed_kmh)[1].T
        on = t[force > 0.1 * force.max()]
        assert found.peak_force_N == pytest.approx(force.max(), rel=1e-3)
        assert found.duration_s == pytest.approx(on[-1] - on[0], abs=4e-3)


def test_faster_impacts_are_harder():
    peaks = [impact(kmh)[1][:, 1].max() for kmh in (15.0, 20.4, 25.0)]
    assert peaks == sorted(peaks)
    assert peaks[2] > 1.2 * peaks[0]


# Published runs --------------------------------------------------------------------------------


@pytest.mark.parametrize("method", METHODS)
def test_the_base_train(method):
    # published: 14 cars, 21.4 s, 9.5 MN, 65.8 m x 26.2 m
    params = load_scenario("base_train").to_params()
    run = PlanarSimulation(with_integration(params, method=method))
    outcome = run.run()
    assert outcome.status == "at rest"
    assert abs(outcome.cars_derailed - 14) <= 1
    assert abs(outcome.duration - 21.4) <= 2.0
    assert 3e6 < outcome.peak_force < 25e6
    assert 45.0 < outcome.scene_length < 95.0
    assert 15.0 < outcome.scene_width < 50.0
    assert outcome.energy_residual < 1e-3
    assert outcome.derailed_cars == tuple(range(1, outcome.cars_derailed + 1))
    # the train stands where its first car on the rails has stopped short of the break
    assert outcome.rear_stop < 0.0
    assert np.nanmin(outcome.derail_time[1:]) > 0.5
    derailed = outcome.derail_time[: outcome.cars_derailed]
    assert np.all(np.diff(derailed) > 0.0)


def test_the_validation_run():
    # published: 24 cars of 24, 25.3 s, 23.1 MN, 109 m x 41.7 m
    params = load_scenario("mississauga_published").to_params()
    run = PlanarSimulation(params)
    outcome = run.run()
    assert outcome.status in ("at rest", "void")
    assert 19 <= outcome.cars_derailed <= 24
    if outcome.status == "at rest":
        assert 21.0 < outcome.duration < 30.0
    assert 8e6 < outcome.peak_force < 60e6
    assert 50.0 < outcome.scene_length < 150.0
    assert 20.0 < outcome.scene_width < 80.0
    assert outcome.energy_residual < 1e-3
    assert outcome.max_coupler_gap < 1e-8
    assert outcome.max_truck_offset < 1e-8
    # the virtual body stands for 50 cars, one brake each
    assert params.cars[-1].represents == 50
    assert math.isclose(sum(c.mass for c in params.cars[-1:]), 50 * 61.4e3, rel_tol=1e-9)
    assert 25 not in outcome.derailed_cars
    # every car above 10 MN is above 5 MN
    assert set(outcome.cars_above_10MN) <= set(outcome.cars_above_5MN)
    assert outcome.peak_force == outcome.car_peak_force.max()
    top = max(run.collisions, key=lambda c: c.peak_force)
    assert outcome.peak_force_pair == (top.car_a, top.car_b)
    assert outcome.peak_force_time == top.peak_time


def test_the_curve():
    outcome = PlanarSimulation(load_scenario("curve_derailment").to_params()).run()
    assert outcome.status == "at rest"
    assert 5 < outcome.cars_derailed < 40
    assert outcome.energy_residual < 1e-3


@pytest.mark.slow
def test_ensembles_of_the_base_train_agree_between_methods():
    # single runs part after the first contacts; counts and durations of many must not
    counts, durations = {}, {}
    for method in METHODS:
        rows = []
        for k in range(24):
            params = with_integration(load_scenario("base_train").to_params(), method=method)
            force = params.initiation.lateral_forces[0]
            push = type(force)(**{**vars(force), "force": 50e3 * (0.95 + 0.1 * k / 23)})
            initiation = type(params.initiation)(
                **{**vars(params.initiation), "lateral_forces": (push,)}
            )
            params = type(params)(**{**vars(params), "initiation": initiation})
            outcome = PlanarSimulation(params).run()
            rows.append((outcome.cars_derailed, outcome.duration))
        counts[method], durations[method] = np.mean(rows, axis=0)
        assert abs(counts[method] - 14) < 1.0
        assert abs(durations[method] - 21.4) < 2.0
    assert np.ptp(list(counts.values())) < 0.4
    assert np.ptp(list(durations.values())) < 0.5
