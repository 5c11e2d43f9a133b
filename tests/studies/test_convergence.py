"""Convergence in tolerance: statistics, words, figure, and two real tolerances."""

import json
import math
from dataclasses import dataclass, field

import numpy as np
import pytest
from scipy import stats

from derail_ros.engine import PlanarSimulation
from derail_ros.studies.convergence import (
    INTERVAL,
    KEYS,
    Trace,
    compare,
    convergence,
    mean_table,
    median_time,
    parted,
    power,
    trace,
)
from derail_ros.studies.ensemble import Job
from derail_ros.studies.tables import Strong
from derail_ros.vocabulary.measures import outcome_record
from derail_ros.vocabulary.params import IntegrationParams, LateralForce
from tests.engine.support import make_train
from tests.studies.made_up import outcome, runner

# Statistics --------------------------------------------------------------------------------


def test_comparison():
    rng = np.random.default_rng(5)
    x, y = rng.normal(10.0, 2.0, 30), rng.normal(10.0, 2.0, 30)
    c = compare("duration_s", x, y)
    error = math.sqrt(x.var(ddof=1) / 30 + y.var(ddof=1) / 30)
    assert c.difference_95 == pytest.approx(1.96 * error, rel=1e-3)
    assert c.median_difference_of_twins == np.median(np.abs(x - y))
    assert c.median_difference_of_members == pytest.approx(2.0 * 0.6745 * math.sqrt(2.0), rel=0.3)
    assert c.agrees
    expected = stats.ks_2samp(x, y)
    assert (c.ks_distance, c.ks_p) == (expected.statistic, expected.pvalue)
    assert not compare("duration_s", x + 5.0, y).agrees
    same = compare("duration_s", np.ones(5), np.ones(5))
    assert same.agrees and same.ks_p == 1.0


def test_parting():
    a = np.zeros((30, 2, 2))
    b = a.copy()
    assert parted(a, b) == math.inf
    b[12:, 1, 0] = 0.02
    assert parted(a, b) == pytest.approx(12 * INTERVAL)
    assert parted(a[:10], b) == math.inf
    assert median_time(np.array([1.0, 2.0, math.inf])) == "2.0"
    assert median_time(np.array([1.0, math.inf, math.inf])) == "never"


def test_power():
    assert [power(x) for x in (1e-2, 1e-7, 5e-4)] == ["1e-2", "1e-7", "5e-4"]


# Whole, made up ----------------------------------------------------------------------------


@dataclass(frozen=True)
class MadeUp:
    """A scenario of which only the tolerance matters."""

    name: str = "made_up"
    title: str = "Made up"
    settings: dict = field(default_factory=dict)

    def with_overrides(self, overrides):
        return MadeUp(settings=dict(overrides))

    def to_params(self):
        rtol = self.settings.get("integration.rtol", 1e-3)
        method = self.settings.get("integration.method", "row")
        integration = IntegrationParams(rtol=rtol, method=method)
        return make_train(1, lateral=(LateralForce(),), integration=integration)


def respond(run):
    rtol = run.scenario.integration.rtol
    path = np.zeros((100, 1, 2))
    path[int(20 - 10 * math.log10(rtol)) :] = rtol
    path *= 1e6 * (rtol > 1e-4)
    count = 10 + run.member % 3 + (rtol > 5e-3) * 5
    made = outcome(
        cars_derailed=count,
        duration=20.0 + 0.1 * run.member,
        peak_force=5e6,
        status="void" if run.member == 4 else "at rest",
        steps=100,
    )
    return Trace(path, made, 2.0)


def made_up_study():
    return convergence(
        MadeUp(), 12, tolerances=(1e-4, 1e-2, 1e-3), run=runner(respond), task=respond
    )


@pytest.fixture
def made_up():
    return made_up_study()


def test_levels(made_up):
    assert [level.label for level in made_up.tolerances] == ["1e-2", "1e-3", "1e-4"]
    assert made_up.reference.label == "rkf45 1e-5"
    assert made_up.default_rtol == 1e-3
    loose, default, tight = made_up.tolerances
    assert loose.members == 11
    assert not loose.measures["cars_derailed"].agrees
    assert loose.measures["cars_derailed"].median_difference_of_twins == 5.0
    assert default.measures["cars_derailed"].agrees
    assert median_time(loose.parted_s) == "4.0"
    assert median_time(default.parted_s) == "5.0"
    assert median_time(tight.parted_s) == "never"
    json.dumps(made_up.as_dict(), allow_nan=False)
    (row, *_) = mean_table(made_up).rows
    assert row[:3] == ["1e-2", "100", "4.0"]
    assert isinstance(row[3], Strong) and not isinstance(row[4], Strong)


def test_what_is_refused():
    with pytest.raises(ValueError, match="two"):
        convergence(MadeUp(), 5, tolerances=(1e-3,))
    with pytest.raises(ValueError, match="members"):
        convergence(MadeUp(), 2)
    with pytest.raises(RuntimeError, match="member . at rtol "):
        convergence(
            MadeUp(), 3, tolerances=(1e-2, 1e-3),
            run=runner(lambda run: RuntimeError("x") if run.scenario.integration.rtol < 5e-3
                       else respond(run)),
        )  # fmt: skip


# For real ----------------------------------------------------------------------------------


def short(rtol):
    return make_train(
        4, speed=8.0, derailed=((1, "front"), (1, "rear")), lateral=(LateralForce(),),
        integration=IntegrationParams(rtol=rtol),
    )  # fmt: skip


def test_a_trace_is_the_path_of_the_run():
    made = trace(Job(short(1e-3)), lambda: False)
    run = PlanarSimulation(short(1e-3))
    run.advance_to(1.0)
    assert made.path[10] == pytest.approx(run.sample(1.0).q[:, :2], abs=1e-9)
    outcome = run.run()
    assert outcome_record(made.outcome) == outcome_record(outcome)
    assert len(made.path) >= outcome.time / INTERVAL


def test_a_trace_agrees_with_a_tighter_one_until_late():
    loose, tight = (trace(Job(short(rtol)), lambda: False) for rtol in (1e-3, 1e-6))
    assert parted(loose.path, tight.path) > min(tight.first_contact, 1.0)


@pytest.mark.slow
def test_the_default_tolerance_gives_the_distribution_of_a_tight_one():
    from derail_ros.scenario import load_scenario

    study = convergence(load_scenario("base_train"), 30, tolerances=(1e-3, 1e-5))
    for level in (study.tolerances[0], study.reference):
        for key in KEYS:
            assert level.measures[key].ks_p > 1e-3, (level.label, key)
        assert level.largest_constraint_error_m < 1e-6
        assert level.largest_energy_residual < 1e-3
