"""The tables of the integration methods, and the default against the reference."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import ks_2samp

from derail_ros.engine import PlanarSimulation
from derail_ros.engine.laws.ground import drag_slopes
from derail_ros.engine.methods import METHODS, stability_bound
from derail_ros.scenario import load_scenario_by_name
from derail_ros.studies.ensemble import Job, run_many
from derail_ros.vocabulary.params import GroundParams, LateralForce
from tests.engine.support import (
    NO_CONTACT,
    fixed_steps,
    free_train,
    kicked,
    make_train,
    mixed_cars,
    place,
    propose,
    tight,
    with_integration,
)


class Table:
    """A method's coefficients by their usual names."""

    def __init__(self, name):
        rows = np.array(METHODS[name])
        s = self.stages = rows.shape[1] - 1
        self.alpha, self.b = rows[4 : 4 + s, :s], rows[0, :s]
        self.error, self.c = rows[1], rows[2, :s]
        self.gamma = rows[3, 0]
        self.g = rows[4 + s :, :s] + self.gamma * np.eye(s)


def conditions_of_order_4(alpha, b, c):
    return [
        b.sum() - 1,
        b @ c - 1 / 2,
        b @ c**2 - 1 / 3,
        b @ alpha @ c - 1 / 6,
        b @ c**3 - 1 / 4,
        b @ (c * (alpha @ c)) - 1 / 8,
        b @ alpha @ c**2 - 1 / 12,
        b @ alpha @ alpha @ c - 1 / 24,
    ]


@pytest.mark.parametrize("name", METHODS)
def test_explicit_order(name):
    t = Table(name)
    assert conditions_of_order_4(t.alpha, t.b, t.c) == pytest.approx([0.0] * 8, abs=1e-15)
    assert np.triu(t.alpha).max() == 0.0
    assert t.alpha.sum(axis=1) == pytest.approx(t.c, abs=1e-15)
    # the embedded method: one more row for the slope at the new state
    alpha = np.zeros((t.stages + 1, t.stages + 1))
    alpha[:-1, :-1], alpha[-1, :-1] = t.alpha, t.b
    embedded = np.append(t.b, 0.0) - t.error
    order = 8 if t.error[-1] == 0.0 else 4
    found = conditions_of_order_4(alpha, embedded, np.append(t.c, 1.0))
    assert found[:order] == pytest.approx([0.0] * order, abs=1e-15)
    assert max(abs(x) for x in found) > 1e-3 or order == 8


def test_stability_along_the_negative_axis():
    # known: the classical method and Fehlberg's of order 5
    assert stability_bound(Table("row").alpha, Table("row").b) == pytest.approx(2.785293, abs=1e-5)
    t = Table("rkf45")
    z = -np.linspace(0.0, 5.0, 5001)
    ones = np.ones(t.stages)
    factor = np.array(
        [1.0 + x * t.b @ np.linalg.solve(np.eye(t.stages) - x * t.alpha, ones) for x in z]
    )
    first = -z[np.argmax(np.abs(factor) > 1.0 + 1e-12)]
    assert stability_bound(t.alpha, t.b) == pytest.approx(first, abs=2e-3)


@pytest.mark.parametrize("speed", [0.0, 0.003, 0.05])
def test_an_explicit_step_is_no_longer_than_it_is_stable(speed):
    # a car free on the ground: the rate of ten points, from the law
    params = make_train(
        1, speed=0.0, derailed=((1, "front"), (1, "rear")), triggers=(), lateral=()
    )
    run = PlanarSimulation(with_integration(params, method="rkf45", rtol=1e-1, rest_hold=20.0))
    v = np.zeros((1, 5))
    v[0, 1] = speed
    place(run, run.sample().q, v)
    propose(run, 0.05)
    g = params.ground
    across, along = drag_slopes(speed, g.c_s, g.c_d, g.eps, g.c_v)
    run.advance_steps(1)
    longest = 0.9 * stability_bound(Table("rkf45").alpha, Table("rkf45").b) / (9.81 * across)
    assert run.statistics["limited_by_stability"] == 1
    # across the motion, or turning: ten points have a radius of gyration like the car's
    assert 0.6 * longest < run.step_size <= longest * (1.0 + 1e-12)


def test_implicit_friction_keeps_order_3_for_any_damping():
    t = Table("row")
    rows = t.g.sum(axis=1)
    assert [t.b @ rows, t.b @ t.alpha @ rows, t.b @ t.g @ t.c, t.b @ t.g @ rows] == pytest.approx(
        [0.0] * 4, abs=1e-15
    )


def test_implicit_friction_is_stable():
    t = Table("row")
    beta, one = t.alpha + t.g, np.ones(t.stages)
    assert t.b @ np.linalg.solve(beta, one) == pytest.approx(1.0, abs=1e-13)
    z = -np.concatenate([np.linspace(0.0, 10.0, 2001), np.logspace(1.0, 8.0, 500)])
    left = np.array([1 + x * t.b @ np.linalg.solve(np.eye(4) - x * beta, one) for x in z])
    assert left[0] == 1.0
    assert np.all(np.abs(left[1:]) < 1.0)
    assert left.min() > -0.13
    assert np.all(np.abs(left[z < -3.0]) < 0.15)


def test_order_with_stiff_friction():
    # every step implicit, of a friction so smooth that its own error does not hide the order
    end = 0.4
    ground = GroundParams(c_s=6.0, c_d=6.0, eps=1.0, c_v=0.0)
    mark = LateralForce(force=0.0, start=end, duration=1.0)
    params = free_train(
        mixed_cars(4), speed=0.0, ground=ground, lateral=(mark,), contact=NO_CONTACT
    )

    def final(params):
        run = propose(kicked(params, seed=1), params.integration.max_step)
        run.advance_to(end)
        return np.concatenate([run.sample().q, run.sample().v]), run.statistics

    exact, _ = final(tight(with_integration(params, method="rkf45"), 1e-12, max_step=1e-3))
    steps = end / np.array([40, 57, 80, 113])
    errors = []
    for h in steps:
        state, statistics = final(fixed_steps(with_integration(params, method="row"), h))
        assert statistics["implicit"] == statistics["steps"]
        errors.append(np.abs(state - exact).max())
    order = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert order > 2.6, errors


def test_resting_cars_take_long_steps():
    # 40 s after the last motion an explicit method would still take steps of 5 ms
    scenario = load_scenario_by_name("base_train").to_params()
    counts = {}
    for method, rtol in (("rkf45", 1e-4), ("row", 1e-3)):
        run = PlanarSimulation(with_integration(scenario, method=method, rtol=rtol))
        run.run()
        counts[method] = run.statistics
    assert counts["row"]["evaluations"] < 0.6 * counts["rkf45"]["evaluations"]
    assert counts["row"]["implicit"] > 0.3 * counts["row"]["steps"]


@pytest.mark.parametrize("name", ["base_train", "mississauga_published"])
def test_default_agrees_with_the_reference_up_to_the_first_contact(name):
    params = load_scenario_by_name(name).to_params()
    default = PlanarSimulation(params)
    while not default.collisions:
        default.advance_steps(1)
    until = default.collisions[0].start
    run, exact = PlanarSimulation(params), PlanarSimulation(tight(params, 1e-9, method="rkf45"))
    for s in (run, exact):
        s.advance_to(until)
    got, want = run.sample(until), exact.sample(until)
    assert np.abs(got.q - want.q).max() < 1e-2
    assert np.abs(got.v - want.v).max() < 5e-2
    assert np.array_equal(got.truck_on, want.truck_on)
    assert np.array_equal(got.coupled, want.coupled)


def test_default_follows_the_reference_through_contacts():
    # the force jumps where a corner passes the end of a wall, and strikers have kinks: steps that
    # go over them are ten times as far off, whatever the tolerance
    params = load_scenario_by_name("mississauga_published").to_params()
    run, exact = (
        PlanarSimulation(params),
        PlanarSimulation(
            with_integration(params, method="rkf45", rtol=1e-9, buffer_fraction=0.02)
        ),
    )
    for until, off in ((2.5, 1e-4), (4.5, 4e-3), (7.0, 1e-2)):
        for s in (run, exact):
            s.advance_to(until)
        assert np.abs(run.sample(until).q - exact.sample(until).q)[:, :3].max() < off
    assert len(exact.collisions) > 12


@pytest.mark.slow
@pytest.mark.parametrize("name", ["base_train", "mississauga_published"])
def test_default_agrees_with_the_reference_in_distribution(name):
    # after the first contact a run is chaotic: two tolerances of one method differ as much
    scenario = load_scenario_by_name(name).to_params()
    members = 60
    found = {}
    for method, rtol in (("row", 1e-3), ("rkf45", 1e-6)):
        params = with_integration(scenario, method=method, rtol=rtol)
        # different members, so that the samples are independent
        runs = [
            Job(params, member=k, seed=5 if method == "row" else 6) for k in range(1, members + 1)
        ]
        outcomes = [r.outcome for r in run_many(runs)]
        assert len(outcomes) == members
        found[method] = np.array(
            [(o.cars_derailed, o.duration, o.peak_force, o.scene_length) for o in outcomes]
        )
    for k, quantity in enumerate(("derailed", "duration", "peak", "length")):
        a, b = found["row"][:, k], found["rkf45"][:, k]
        print(
            f"{name} {quantity}: {a.mean():.4g} +- {a.std():.2g}, "
            f"reference {b.mean():.4g} +- {b.std():.2g}"
        )
        # half of the runs have the same peak: what differs by less than 1 % is the same
        grain = 0.01 * b.mean()
        assert ks_2samp(np.round(a / grain), np.round(b / grain)).pvalue > 0.005, quantity
    assert replace(scenario).integration.method == "row"
