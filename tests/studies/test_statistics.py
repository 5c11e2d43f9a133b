"""Statistics: against scipy, against closed solutions, and what the sentences make of them."""

import math

import numpy as np
import pytest
from scipy import stats

from derail_ros.api import StudyAnswers as StudyResults
from derail_ros.studies import statistics as s
from derail_ros.studies.runner import run_study

DRAW = np.random.default_rng(4)


def test_the_interval_of_a_mean_is_students():
    x = DRAW.normal(10.0, 2.0, 17)
    d = s.describe(x)
    low, high = stats.t.interval(0.95, 16, x.mean(), stats.sem(x))
    assert (d["mean_low"], d["mean_high"]) == pytest.approx((low, high))
    assert d["median"] == np.median(x)
    assert d["q05"] == np.quantile(x, 0.05)
    assert (d["least"], d["most"], d["n"]) == (x.min(), x.max(), 17)


def test_the_interval_holds_the_true_mean_as_often_as_it_says():
    hits = 0
    for _ in range(2000):
        d = s.describe(DRAW.exponential(1.0, 20))
        hits += d["mean_low"] <= 1.0 <= d["mean_high"]
    assert 0.90 < hits / 2000 < 0.97  # a skew distribution costs a little of the 95 %


def test_few_runs_have_no_interval():
    one, none = s.describe([3.0]), s.describe([math.nan])
    assert one["mean"] == 3.0 and math.isnan(one["mean_low"]) and math.isnan(one["sd"])
    assert none["n"] == 0 and math.isnan(none["mean"])


def test_welch_is_scipys():
    a, b = DRAW.normal(0.0, 1.0, 12), DRAW.normal(0.7, 3.0, 20)
    expected = stats.ttest_ind(b, a, equal_var=False)
    difference, half, p = s.welch(a, b)
    assert difference == pytest.approx(b.mean() - a.mean())
    assert p == pytest.approx(expected.pvalue)
    low, high = expected.confidence_interval(0.95)
    assert (difference - half, difference + half) == pytest.approx((low, high))


def test_constants_are_told_apart_if_they_differ():
    a, b = np.full(5, 2.0), np.full(5, 3.0)
    assert s.welch(a, a)[2] == 1.0
    assert s.welch(a, b) == (1.0, 0.0, 0.0)
    assert math.isnan(s.welch(a, b[:1])[2])


def test_holm_is_the_textbooks():
    """p = 0.01, 0.04, 0.03 of three comparisons at 5 %: the first alone."""
    values = iter([0.01, 0.04, 0.03])
    original, s.welch = s.welch, lambda a, b: (0.0, 0.0, next(values))
    try:
        apart = s.told_apart([None, None, None])
    finally:
        s.welch = original
    assert apart.tolist() == [[False, True, False], [True, False, False], [False, False, False]]


def test_equal_settings_are_told_apart_in_5_percent_of_studies():
    wrong = sum(s.told_apart(list(DRAW.normal(0, 1, (5, 15)))).any() for _ in range(600))
    assert wrong / 600 < 0.085


def test_runs_needed_tell_the_difference():
    a, b = DRAW.normal(0.0, 1.0, 200_000), DRAW.normal(0.5, 1.0, 200_000)
    n = s.runs_needed(a, b)
    assert n is not None and 60 < n < 70  # 63 and one, for 80 % power
    told = 0
    for _ in range(400):
        x, y = DRAW.normal(0.0, 1.0, n), DRAW.normal(0.5, 1.0, n)
        told += s.welch(x, y)[2] < 0.05
    assert 0.73 < told / 400 < 0.87
    assert s.runs_needed(np.zeros(4), np.zeros(4)) is None


@pytest.mark.parametrize(
    ("pairs", "stretches"),
    [
        ([], [(0, 3)]),
        ([(0, 3)], [(0, 2), (1, 3)]),
        ([(0, 1), (1, 2), (2, 3)], []),
        ([(0, 1), (0, 2), (0, 3)], [(1, 3)]),
    ],
)
def test_stretches_of_settings_that_are_alike(pairs, stretches):
    apart = np.zeros((4, 4), dtype=bool)
    for i, j in pairs:
        apart[i, j] = apart[j, i] = True
    assert s.alike(apart) == stretches


def test_rank_correlation_is_scipys():
    x = DRAW.normal(size=60)
    y = np.exp(x) + DRAW.normal(size=60)
    r, low, high = s.spearman(x, y)
    assert r == pytest.approx(stats.spearmanr(x, y).statistic)
    assert low < r < high
    assert all(math.isnan(v) for v in s.spearman(x, np.zeros(60)))


# Whole studies with invented outcomes ------------------------------------------------------

ISHIGAMI = """\
version: 1
title: Ishigami's function
scenario: small
design: sobol
points: 1024
ensemble: 1
parameters:
  a: {path: ground.scale, range: [0, 1]}
  b: {path: brakes.force_scale, range: [0, 1]}
  c: {path: couplers.inertia_kg_m2, range: [10000, 20000]}
measures: [duration_s, cars_derailed]
"""


def test_sobol_indices_are_those_of_the_closed_solution(load, folder, invented, monkeypatch):
    from derail_ros.studies import design as designs

    study = load(ISHIGAMI)
    unit = designs.make(study).unit
    monkeypatch.setattr("derail_ros.studies.runner.check", lambda *a: "none of this is run")
    monkeypatch.setattr("derail_ros.studies.runner.scenario_at", lambda d, p: study.scenario)

    def ishigami(point, member):
        x, y, z = math.pi * (2.0 * unit[point] - 1.0)
        value = math.sin(x) + 7.0 * math.sin(y) ** 2 + 0.1 * z**4 * math.sin(x)
        return {"duration_s": value, "cars_derailed": 4}

    results = StudyResults(run_study(study, folder / "out", run=invented(ishigami)))
    table = results.sobol().set_index("parameter")
    for name, first, total in (("a", 0.314, 0.558), ("b", 0.442, 0.442), ("c", 0.0, 0.244)):
        row = table.loc[name]
        assert row["S1"] == pytest.approx(first, abs=0.04)
        assert row["ST"] == pytest.approx(total, abs=0.04)
        assert row["S1_low"] <= first <= row["S1_high"]
    assert table.loc["a x c", "S2"] == pytest.approx(0.244, abs=0.05)
    said = results.statements()
    assert said[0].startswith("Time to rest: Sobol indices: a in all 0.5")
    assert any("No Sobol indices" in line for line in said if line.startswith("Cars derailed"))


def test_base_points_with_failed_runs_are_left_out(load, folder, invented, monkeypatch):
    study = load(ISHIGAMI.replace("1024", "64"))
    monkeypatch.setattr("derail_ros.studies.runner.check", lambda *a: "none of this is run")
    monkeypatch.setattr("derail_ros.studies.runner.scenario_at", lambda d, p: study.scenario)

    def some(point, member):
        if point == 100:
            raise ValueError("lost")
        return {"duration_s": float(point % 17), "cars_derailed": point % 3}

    results = StudyResults(run_study(study, folder / "out", run=invented(some)))
    assert set(results.sobol()["left_out"]) == {1}
    assert set(results.sobol()["base_points"]) == {63}
    assert any("1 base points" in line for line in results.statements())


GRID = """\
version: 1
title: Grid
scenario: small
design: grid
ensemble: 40
parameters:
  speed: {path: train.speed_kmh, unit: km/h, values: [10, 12, 20]}
  ground: {path: ground.scale, values: [0.8, 1.2]}
measures: [duration_s, relative_severity]
base: {speed: 10, ground: 0.8}
"""


PLAIN = GRID.replace(", relative_severity", "")


def noise(point, member):
    return float(np.random.default_rng([point, member]).normal())


def test_what_cannot_be_told_apart_is_said(load, folder, invented):
    level = {0: 10.0, 1: 15.0, 2: 9.95, 3: 15.0, 4: 20.0, 5: 25.0}

    def some(point, member):
        return {
            "duration_s": level[point] + 0.5 * noise(point, member),
            "cars_derailed": 3,
            "peak_force_N": 1e6,
            "scene_area_m2": 100.0,
        }

    results = StudyResults(run_study(load(GRID), folder / "out", run=invented(some)))
    lines = dict(results.findings())["Time to rest"]
    told = [line for line in lines if "cannot be distinguished" in line]
    assert len(told) == 2
    assert told[0].startswith(
        "At ground 0.8, speed 10 km/h and 12 km/h cannot be distinguished with 40 runs per point "
        "(means"
    )
    assert "runs per point would be needed" in told[0].split("; about")[1]
    assert told[1].startswith("At ground 1.2, speed 10 km/h and 12 km/h")
    assert lines[0].startswith("Shares of the variance of all runs: speed")
    severity = dict(results.findings())["Severity relative to the base"]
    assert any("every run gives 1.00" in line for line in severity)


def test_shares_of_the_variance_add_up(load, folder, invented):
    def some(point, member):
        speed, ground = divmod(point, 2)
        return {"duration_s": 3.0 * speed + ground + 2.0 * speed * ground + noise(point, member)}

    results = StudyResults(run_study(load(PLAIN), folder / "out", run=invented(some)))
    shares = results.effects().set_index("parameter")["share"]
    assert shares.sum() == pytest.approx(1.0)
    mean = np.array([[0.0, 1.0], [3.0, 6.0], [6.0, 11.0]])
    total = mean.var() + 1.0
    assert shares["speed"] == pytest.approx(mean.mean(axis=1).var() / total, rel=0.1)
    assert shares["(chaos)"] == pytest.approx(1.0 / total, rel=0.15)


def test_void_runs_do_not_count_and_ratios_have_their_interval(load, folder, invented):
    def some(point, member):
        void = point == 1 and member < 10
        status = {"status": "void"} if void else {}
        return {
            "duration_s": 4.0 * (1 + (point > 0)) * math.exp(0.1 * noise(point, member))
        } | status

    results = StudyResults(run_study(load(PLAIN), folder / "out", run=invented(some)))
    table = results.summary().set_index("point")
    assert (table.loc[1, "n"], table.loc[1, "void"], table.loc[1, "runs"]) == (30, 10, 40)
    assert table.loc[0, "relative"] == table.loc[0, "relative_low"] == 1.0
    for point in range(1, 6):
        assert table.loc[point, "relative_low"] < 2.0 < table.loc[point, "relative_high"]
    # by bootstrap
    x, y = (results.values("duration_s")[p] for p in (0, 3))
    ratios = [DRAW.choice(y, 40).mean() / DRAW.choice(x, 40).mean() for _ in range(4000)]
    low, high = np.quantile(ratios, [0.025, 0.975])
    assert table.loc[3, "relative_low"] == pytest.approx(low, abs=0.025)
    assert table.loc[3, "relative_high"] == pytest.approx(high, abs=0.025)
    assert results.statements()[0].startswith("10 runs are void")


def test_counts_are_a_distribution(load, folder, invented):
    results = StudyResults(
        run_study(
            load(GRID), folder / "out", run=invented(lambda p, m: {"cars_derailed": p + m % 2})
        )
    )
    counts = results.counts()
    assert (counts.groupby("point")["share"].sum() == 1.0).all()
    assert counts[counts["point"] == 2]["cars_derailed"].tolist() == [2, 3]


def test_latin_hypercube_says_what_it_cannot_see(load, folder, invented):
    text = """\
version: 1
title: Hypercube
scenario: small
design: latin_hypercube
points: 60
ensemble: 1
parameters:
  speed: {path: train.speed_kmh, range: [10, 20]}
  ground: {path: ground.scale, range: [0.5, 1.5]}
  kind: {path: brakes.instant, values: [true, false]}
measures: [duration_s]
"""
    from derail_ros.studies import design as designs

    study = load(text)
    points = list(designs.make(study))
    results = StudyResults(
        run_study(
            study,
            folder / "out",
            run=invented(
                lambda p, m: {"duration_s": points[p].columns["speed"] + 0.5 * noise(p, m)}
            ),
        )
    )
    (first, second) = results.statements()
    assert first.startswith("Time to rest: Rank correlations: speed +0.9")
    assert second == "Time to rest: No significant effect of ground at 60 points."
