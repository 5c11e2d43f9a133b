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
    MEASURES,
    Trace,
    compare,
    convergence,
    ks_two_sample,
    markdown,
    median_time,
    parted,
    power,
    trace,
)
from derail_ros.studies.convergence_figure import convergence_figure
from derail_ros.studies.ensemble import Run
from derail_ros.vocabulary.params import IntegrationParams, LateralForce
from tests.engine.support import make_train
from tests.studies.made_up import runner

# Statistics --------------------------------------------------------------------------------


@pytest.mark.parametrize("shift", [0.0, 0.3, 1.0])
def test_kolmogorov_smirnov(shift):
    rng = np.random.default_rng(4)
    a, b = rng.normal(0.0, 1.0, 60), rng.normal(shift, 1.0, 45)
    d, p = ks_two_sample(a, b)
    expected = stats.ks_2samp(a, b)
    assert d == pytest.approx(expected.statistic, abs=1e-12)
    assert p == pytest.approx(expected.pvalue, rel=0.15, abs=1e-4)
    assert ks_two_sample(a, a) == (0.0, 1.0)


def test_comparison():
    rng = np.random.default_rng(5)
    x, y = rng.normal(10.0, 2.0, 30), rng.normal(10.0, 2.0, 30)
    c = compare(x, y, x - y)
    error = math.sqrt(x.var(ddof=1) / 30 + y.var(ddof=1) / 30)
    assert c.difference_half == pytest.approx(1.96 * error, rel=1e-3)
    assert c.twins == np.median(np.abs(x - y))
    assert c.strangers == pytest.approx(2.0 * 0.6745 * math.sqrt(2.0), rel=0.3)
    assert c.agrees
    assert not compare(x + 5.0, y, x - y).agrees
    same = compare(np.ones(5), np.ones(5), np.zeros(5))
    assert same.agrees and same.p == 1.0


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
    values = {"cars_derailed": count, "duration": 20.0 + 0.1 * run.member, "peak_force": 5.0,
              "scene_length": 60.0, "scene_width": 25.0}  # fmt: skip
    return Trace(path, None if run.member == 4 else values, 100, 1e-9, 1e-6, 2.0)


@pytest.fixture
def made_up():
    return convergence(
        MadeUp(), 12, tolerances=(1e-4, 1e-2, 1e-3), run=runner(respond), task=respond
    )


def test_levels(made_up):
    assert [level.label for level in made_up.levels] == ["1e-2", "1e-3", "1e-4"]
    assert made_up.reference.label == "rkf45 1e-5"
    assert made_up.default_rtol == 1e-3
    loose, default, tight = made_up.levels
    assert loose.members == 11
    assert not loose.measures["cars_derailed"].agrees
    assert loose.measures["cars_derailed"].twins == 5.0
    assert default.measures["cars_derailed"].agrees
    assert median_time(loose.partings) == "4.0"
    assert median_time(default.partings) == "5.0"
    assert median_time(tight.partings) == "never"


def test_words_and_figure(made_up):
    page = markdown([made_up], 12, 0, "images/convergence.png")
    assert "| rkf45 1e-5 | 100 |" in page
    assert "| 1e-2 | **+5.00 ± " in page
    assert "nan" not in page
    json.dumps(made_up.as_dict(), allow_nan=False)
    assert len(convergence_figure([made_up], 12).axes) == 6


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
    made = trace(Run(short(1e-3)), lambda: False)
    run = PlanarSimulation(short(1e-3))
    run.advance_to(1.0)
    assert made.path[10] == pytest.approx(run.sample(1.0).q[:, :2], abs=1e-9)
    outcome = run.run()
    assert made.values == {m.name: float(m.read(outcome)) for m in MEASURES}
    assert made.steps == outcome.steps
    assert len(made.path) >= outcome.time / INTERVAL


def test_a_trace_agrees_with_a_tighter_one_until_late():
    loose, tight = (trace(Run(short(rtol)), lambda: False) for rtol in (1e-3, 1e-6))
    assert parted(loose.path, tight.path) > min(tight.first_contact, 1.0)


@pytest.mark.slow
def test_the_default_tolerance_gives_the_distribution_of_a_tight_one():
    from derail_ros.scenario import load_scenario

    study = convergence(load_scenario("base_train"), 30, tolerances=(1e-3, 1e-5))
    for level in (study.levels[0], study.reference):
        for m in MEASURES:
            c = level.measures[m.name]
            assert c.p > 1e-3, (level.label, m.name)
        assert level.gap < 1e-6
        assert level.residual < 1e-3
