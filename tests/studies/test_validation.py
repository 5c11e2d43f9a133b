"""The comparison with the published runs, on made-up ensembles."""

import json
import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from derail_ros.scenario import load_scenario
from derail_ros.studies.doubt import DOUBTS, doubtful_runs, draw
from derail_ros.studies.ensemble import Result, member_factor
from derail_ros.studies.impact import impact, words
from derail_ros.studies.validation import (
    ARGUED,
    MEASURES,
    Case,
    CaseResult,
    Published,
    Spread,
    evaluate,
    goals,
    load_published,
    markdown,
    pairs_words,
    spread,
    validate,
    verdict,
)
from derail_ros.vocabulary.params import ContactParams, InitiationParams
from tests.studies.made_up import outcome as made_up

LIMITS = {
    "count_rms": 0.8,
    "duration_rms_s": 1.2,
    "peak_inside_share": 0.8,
    "peak_log_ratio": 0.3,
    "length_rms": 0.15,
    "width_rms": 0.15,
}


def record(cars=10, duration=20.0, peak=5e6, length=60.0, width=25.0, **more):
    return {
        "cars_derailed": cars,
        "duration_s": duration,
        "peak_force_N": peak,
        "peak_force_pair": [2, 1],
        "scene_length_m": length,
        "scene_width_m": width,
        "scene_area_m2": length * width,
        "cars_above_10MN": [],
        "void": False,
    } | more


def case(**published):
    return Case("a", "A", "scenario", published)


# The data ----------------------------------------------------------------------------------


def test_published_data():
    data = load_published()
    assert [c.published["cars_derailed"] for c in data.cases] == [
        24,
        21,
        18,
        12,
        5,
        10,
        14,
        18,
        24,
    ]
    assert [c.published["duration_s"] for c in data.cases] == [
        25.3, 22.7, 16.2, 11.5, 12.7, 17.9, 21.4, 23.7, 25.9,
    ]  # fmt: skip
    assert [c.published["peak_force_MN"] for c in data.cases] == [
        23.09, 18.4, 18.3, 9.15, 0.78, 3.16, 9.47, 9.48, 19.0,
    ]  # fmt: skip
    assert sum("scene_length_m" in c.published for c in data.cases) == 7
    assert data.goals == LIMITS
    assert len({c.name for c in (*data.cases, *data.beside)}) == 10


def test_published_areas_are_length_times_width():
    for c in load_published().cases:
        if "scene_area_m2" in c.published:
            product = c.published["scene_length_m"] * c.published["scene_width_m"]
            assert product == pytest.approx(c.published["scene_area_m2"], rel=0.01)


def test_every_case_has_its_scenario():
    from derail_ros.scenario import load_scenario

    data = load_published()
    for c in (*data.cases, *data.beside):
        params = load_scenario(c.scenario).with_overrides(c.overrides).to_params()
        assert params.initiation.lateral_forces
        if "train.speed_kmh" in c.overrides:
            assert params.initiation.speed == pytest.approx(c.overrides["train.speed_kmh"] / 3.6)


# Statistics --------------------------------------------------------------------------------


def test_spread_matches_numpy():
    x = np.random.default_rng(3).normal(25.0, 1.0, 20)
    s = spread(x, 25.3)
    assert s.mean == pytest.approx(x.mean())
    assert s.sd == pytest.approx(x.std(ddof=1))
    assert (s.low, s.high) == pytest.approx(tuple(np.quantile(x, [0.05, 0.95])))
    assert s.inside


def test_spread_without_runs_or_published_value():
    assert spread([], 3.0).inside is None
    assert spread([1.0, 2.0], None).inside is None
    assert spread([1.0], 1.0).sd is None


def test_void_and_failed_runs_are_left_out_and_counted():
    records = [record(cars=10), record(cars=12), record(cars=99, void=True), {"error": "E: x"}]
    result = evaluate(case(cars_derailed=11), records)
    assert result.spreads["cars_derailed"].mean == 11.0
    assert (result.runs, result.void, result.failed) == (4, 1, 1)
    assert result.errors == ("E: x",)
    assert result.pairs == {"2-1": 2}


def test_goals_by_hand():
    first = evaluate(
        case(cars_derailed=10, duration_s=19.0, peak_force_MN=5.0, scene_length_m=50.0),
        [record(), record(cars=12, duration=22.0)],
    )
    second = evaluate(
        case(cars_derailed=8, duration_s=21.0, peak_force_MN=10.0, scene_width_m=25.0),
        [record(), record()],
    )
    g = {goal.name: goal for goal in goals([first, second], LIMITS)}
    assert g["count_rms"].value == pytest.approx(math.sqrt((1.0 + 4.0) / 2.0))
    assert g["count_rms"].cases == 2
    assert g["duration_rms_s"].value == pytest.approx(math.sqrt((4.0 + 1.0) / 2.0))
    assert g["peak_inside_share"].value == 0.5
    assert g["peak_log_ratio"].value == pytest.approx(0.5 * math.log(2.0))
    assert g["length_rms"].value == pytest.approx(0.2)
    assert g["width_rms"].value == pytest.approx(0.0)
    assert not g["count_rms"].met
    assert not g["peak_inside_share"].met
    assert g["width_rms"].met


def test_scatter_of_the_log_ratio_is_that_of_a_log_normal():
    draws = np.exp(np.random.default_rng(0).normal(1.0, 0.3, 20_000))
    result = evaluate(case(peak_force_MN=math.e), [record(peak=1e6 * d) for d in draws])
    (goal,) = (g for g in goals([result], LIMITS) if g.name == "peak_log_ratio")
    assert goal.scatter == pytest.approx(np.median(np.abs(np.log(draws) - 1.0)), rel=0.03)


def test_a_goal_without_cases_is_not_met():
    result = evaluate(case(), [record()])
    assert all(g.value is None and not g.met for g in goals([result], LIMITS))


def test_verdicts():
    assert verdict(spread([10.0, 11.0, 12.0], 11.5), 1) == "in the band"
    assert verdict(spread([10.0, 11.0, 12.0], 14.0), 1) == "mean 3.0 below"
    assert verdict(spread([], 14.0), 1) == "no runs"
    assert verdict(spread([1.0], None), 1) == ""


# The whole ---------------------------------------------------------------------------------


def fake_run(runs, jobs=None):
    """Results out of order, in the manner of ``run_many``."""
    made = []
    for index, run in enumerate(runs):
        outcome = made_up(
            cars_derailed=10 + run.member % 2,
            duration=20.0 + run.member,
            peak_force=4e6 + 1e6 * run.member,
            energy_residual=0.0,
        )
        made.append(Result(index, run, outcome, None, 0.1))
    yield from reversed(made)


class FakeScenario:
    def with_overrides(self, overrides):
        return self

    def to_params(self):
        return SimpleNamespace(
            contact=ContactParams(), initiation=InitiationParams(10.0, lateral_forces=())
        )


@pytest.fixture
def comparison():
    published = Published(
        (
            Case("a", "A train", "a", {"cars_derailed": 10, "peak_force_MN": 4.5}),
            Case("b", "Another", "b", {"duration_s": 30.0}, {"train.speed_kmh": 30}),
        ),
        (Case("c", "Beside", "c", {"cars_derailed": 30}),),
        LIMITS,
    )
    seen = []
    result = validate(
        4,
        published=published,
        load=lambda name: FakeScenario(),
        run=fake_run,
        progress=lambda done, total: seen.append((done, total)),
    )
    assert seen[-1] == (20, 20)
    return result


def test_cases_beside_count_in_no_goal(comparison):
    (count,) = (g for g in comparison.goals if g.name == "count_rms")
    assert count.cases == 1
    assert count.value == pytest.approx(0.5)
    assert len(comparison.beside) == 1


def test_json(comparison):
    data = json.loads(json.dumps(comparison.as_dict(), allow_nan=False))
    assert data["cases"][0]["measures"]["cars_derailed"]["mean"] == 10.5
    assert data["cases"][0]["measures"]["peak_force_MN"]["inside_band"] is True
    assert data["cases"][1]["overrides"] == {"train.speed_kmh": 30}
    assert data["passed"] is False


def test_doubtful_ensembles_stand_beside_the_cases_and_count_in_no_goal(comparison):
    assert [r.case.name for r in comparison.doubtful] == ["a", "b"]
    assert [r.runs for r in comparison.doubtful] == [4, 4]
    assert all(g.cases <= 2 for g in comparison.goals)


def test_settings_are_compared_without_doubt():
    published = Published((Case("a", "A train", "a", {"cars_derailed": 10}),), (), LIMITS)
    result = validate(
        2, settings={"x": 1}, published=published, load=lambda name: FakeScenario(), run=fake_run
    )
    assert result.doubtful == ()
    assert "in doubt" not in markdown(result)


def test_doubtful_constants_reach_the_runs():
    scenario = load_scenario("mississauga_published_brake_traction")
    runs = list(doubtful_runs(scenario, 3, seed=4))
    params = [run.params() for run in runs]
    for run, p in zip(runs, params, strict=True):
        drawn = draw(4, run.member)
        assert p.brakes.force == drawn["brakes.force_N"]
        assert p.brakes.traction_coefficient == drawn["brakes.traction_coefficient"]
        assert (p.ground.c_v, p.ground.c_d) == (drawn["ground.c_v_s_per_m"], drawn["ground.c_d"])
        assert p.contact.force_max == drawn["contact.force_max_N"]
        assert p.contact.half_distance == drawn["contact.half_distance_m"]
        assert {c.front.k2 for c in p.cars} == {drawn["couplers.k2_N_per_m"]}
    forces = [p.initiation.lateral_forces[0].force for p in params]
    assert forces == [50e3 * member_factor(4, k) for k in range(3)]


def test_draws_fill_their_ranges_and_depend_on_seed_and_member_alone():
    assert draw(0, 1) == draw(0, 1)
    assert draw(0, 1) != draw(0, 2)
    assert draw(0, 1) != draw(1, 1)
    for d in DOUBTS:
        values = np.array([draw(0, k)[d.path] for k in range(400)]) / d.scale
        assert d.low <= values.min() < d.at(0.05) / d.scale
        assert d.at(0.95) / d.scale < values.max() <= d.high
        middle = d.at(0.5) / d.scale
        assert 0.4 < np.mean(values < middle) < 0.6
    # the model's own values lie within what is in doubt about them
    home = load_scenario("mississauga_published_brake_traction").to_params()
    own = (home.brakes.force, home.brakes.traction_coefficient, home.ground.c_v, home.ground.c_d,
           home.contact.force_max, home.contact.half_distance, home.cars[0].front.k2)  # fmt: skip
    for d, value in zip(DOUBTS, own, strict=True):
        assert d.low < value / d.scale < d.high, d.label


# Impact tests ------------------------------------------------------------------------------


@pytest.mark.parametrize("law", ["gaussian", "lorentzian"])
def test_an_impact_without_speed_dependence_gives_its_energy_back(law):
    contact = ContactParams(c1=0.0, c2=0.0, half_distance=0.3, gap_law=law)
    found = impact(5.0, contact=contact)
    # the force begins at d_b with a jump, so a step's part of it is lost or won
    assert found.parting_speed_mps == pytest.approx(5.0 / 3.6, rel=1e-3)


def test_an_impact_that_the_force_never_stops_within_the_gap():
    # by energy: 2 F_max times the depth beyond contact takes what the gap has left
    contact = ContactParams(c1=0.0, c2=0.0)
    found = impact(25.0, contact=contact)
    assert found.peak_force_N == 2.0 * contact.force_max


def test_slow_impacts_are_soft_and_no_speed_is_refused():
    assert impact(2.0).peak_force_N < impact(15.0).peak_force_N
    with pytest.raises(ValueError, match="speed_kmh"):
        impact(0.0)


def test_the_sentence_on_the_impacts_has_their_numbers(comparison):
    text = words(comparison.impacts)
    smallest, largest = comparison.impacts[0], comparison.impacts[-1]
    assert f"{smallest.peak_force_N / 1e6:.1f} to {largest.peak_force_N / 1e6:.1f} MN" in text
    assert f"{largest.peak_force_N / 4.5e6:.1f} times the largest" in text
    assert text in " ".join(markdown(comparison).split())


def test_page(comparison):
    page = markdown(comparison)
    assert "| A train | 10.0 | 10.5 | 0.6 | 10.0 to 11.0 | in the band |" in page
    assert "| Another | 30.0 | 21.5 |" in page
    assert "| A train | 4.50 | 4.15 to 6.85 | 4.15 to 6.85 |" in page
    assert "| cars derailed | 1 of 1 | 1 of 1 |" in page
    assert "**missed**" in page
    assert "nan" not in page
    assert max(len(line) for line in page.splitlines() if not line.startswith("|")) < 100


def test_the_page_says_in_how_many_cases_the_published_pair_occurs():
    def case(name, pair):
        published = {} if pair is None else {"peak_force_pair": pair}
        return Case(name, name.upper(), "s", published)

    def result(name, pair, *pairs):
        spreads = dict.fromkeys([m[0] for m in MEASURES], Spread(*[None] * 6))
        return CaseResult(case(name, pair), spreads, 20, 0, 0, (), dict.fromkeys(pairs, 10))

    none = [result("a", [11, 9], "8-6", "15-14"), result("b", [7, 6], "10-11"), result("c", None)]
    words = pairs_words(none)
    assert "in 0 of 2 cases: which cars strike hardest is not reproduced" in words
    # struck and striking car are not the same pair
    one = [*none, result("d", [3, 2], "5-4", "3-2"), result("e", [2, 3], "3-2")]
    assert "in 1 of 4 cases (D)." in pairs_words(one)
    assert "No pair" in pairs_words([result("c", None)])


def test_the_page_says_which_goals_are_missed_and_where_that_is_argued(comparison):
    import dataclasses

    met = [dataclasses.replace(g, value=2.0 if g.at_least else -1.0) for g in comparison.goals]
    missed = [dataclasses.replace(met[2], value=-1.0), *met[3:]]
    missed = [*met[:2], *missed]
    text = " ".join(markdown(dataclasses.replace(comparison, goals=tuple(missed))).split())
    assert f"Missed: {met[2].text}. {ARGUED}" in text
    text = markdown(dataclasses.replace(comparison, goals=tuple(met)))
    assert "Missed" not in text and "decisions.md" not in text
    assert " ".join(pairs_words(comparison.cases).split()) in " ".join(text.split())


DOCS = Path(__file__).parents[2] / "docs"


def test_the_paragraph_that_argues_is_there():
    title = ARGUED.split('"')[1]
    assert f"**{title}.**" in (DOCS / "decisions.md").read_text(encoding="utf-8")


def test_the_readme_says_what_the_validation_page_says():
    page = (DOCS / "validation.md").read_text(encoding="utf-8")
    readme = " ".join((DOCS.parent / "README.md").read_text(encoding="utf-8").split())
    reached = [line.split("|")[4].strip() for line in page.splitlines() if "| at " in line]
    cars, duration, _, _, length, width = reached
    for said in (
        f"cars derailed to {cars} cars (rms)",
        f"durations to {duration} s",
        f"scene lengths to {length} and widths to {width} of themselves",
    ):
        assert said in readme
    peaks = page.split("## Peak force (MN)")[1].split("## ")[0]
    rows = [line.split("|")[2:7] for line in peaks.splitlines() if "all 74 cars" not in line]
    rows = [row for row in rows if len(row) == 5 and row[0].strip()[:1].isdigit()]
    near = sum(abs(float(row[0]) / float(row[1]) - 1.0) <= 0.1 for row in rows)
    inside = sum("in the band" in row[4] for row in rows)
    assert len(rows) == 9
    assert f"within a tenth of the mean in {near} of 9 cases" in readme
    assert f"in the 90 % band of {inside} of 9 ensembles" in readme
