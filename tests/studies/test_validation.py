"""The comparison with the published runs, on made-up ensembles."""

import dataclasses
import json
import math
from collections import Counter

import numpy as np
import pytest

from derail_ros.scenario import load_scenario
from derail_ros.studies.doubt import DELAY, DOUBTS, INERTIA, doubtful_jobs, draw
from derail_ros.studies.ensemble import member_factor
from derail_ros.studies.published import Published, PublishedCase, load_published
from derail_ros.studies.records import Distribution, Ensemble
from derail_ros.studies.validation import (
    CaseResult,
    doubt_table,
    goal_table,
    goals,
    measure_tables,
    validate,
    verdict,
)
from derail_ros.vocabulary.measures import MEASURES
from tests.studies.made_up import outcome, runner

LIMITS = {
    "count_rms": {"at_most": 0.8},
    "duration_rms_s": {"at_most": 1.0},
    "length_rms": {"at_most": 0.15},
    "width_rms": {"at_most": 0.15},
    "peak_inside_share": {"at_least": 0.8},
    "peak_log_ratio": {"at_most": 0.3},
    "pair_cases": {"at_least": 9},
    "pair_share": {"at_least": 0.4},
    "two_apart_share": {"at_least": 0.7, "at_most": 0.9},
    "base_pair_share": {"at_least": 0.8},
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


def spread(values, published):
    return Distribution(MEASURES["duration_s"], np.array(values, dtype=float), published)


def evaluate(case, records):
    return CaseResult(case, Ensemble(tuple(records)))


def case(**published):
    return PublishedCase("a", "A", "scenario", published)


# The data ----------------------------------------------------------------------------------


def test_published_data():
    data = load_published()
    by_name = {c.name: c.published for c in data.cases}
    assert [len(by_name), len(data.cases)] == [21, 21]
    first = data.cases[:9]
    assert [c.published["cars_derailed"] for c in first] == [24, 21, 18, 12, 5, 10, 14, 18, 24]
    assert [c.published["duration_s"] for c in first] == [
        25.3, 22.7, 16.2, 11.5, 12.7, 17.9, 21.4, 23.7, 25.9,
    ]  # fmt: skip
    assert [c.published["peak_force_N"] * 1e-6 for c in first] == [
        pytest.approx(v) for v in (23.09, 18.4, 18.3, 9.15, 0.78, 3.16, 9.47, 9.48, 19.0)
    ]
    assert [by_name[f"base_{m}t"]["duration_s"] for m in ("34", "54_4", "81_6", "102")] == [
        14.9, 18.6, 22.1, 24.1,
    ]  # fmt: skip
    assert [by_name[f"base_{n}_cars"]["duration_s"] for n in (30, 48, 72, 90)] == [
        14.2, 19.0, 23.5, 24.2,
    ]  # fmt: skip
    lengths = [by_name[f"base_lv_{q}"]["scene_length_m"] for q in ("1_0", "1_6")]
    assert lengths == [67.0, 66.6]
    pairs = [c.pair for c in data.cases if c.pair is not None]
    assert len(pairs) == 19
    assert pairs.count((5, 3)) == 9
    assert data.goals == LIMITS
    assert len({c.name for c in (*data.cases, *data.beside)}) == 21 + len(data.beside)


def test_no_run_is_given_twice():
    data = load_published()
    runs = [load_scenario(c.scenario).with_overrides(c.overrides).to_params() for c in data.cases]
    assert all(a != b for k, a in enumerate(runs) for b in runs[:k])


def test_published_values_belong_to_the_run_and_not_to_its_speed():
    base = load_scenario("base_train")
    of = load_published().of_run
    assert of("base_train", base.to_params())["cars_derailed"] == 14
    light = base.with_overrides({"train.consist.0.mass_kg": 34000})
    assert of("base_train", light.to_params())["cars_derailed"] == 11
    other = base.with_overrides({"train.consist.0.mass_kg": 40000})
    assert of("base_train", other.to_params()) == {}


def test_published_areas_are_length_times_width():
    for c in load_published().cases:
        if {"scene_area_m2", "scene_length_m"} <= set(c.published):
            product = c.published["scene_length_m"] * c.published["scene_width_m"]
            assert product == pytest.approx(c.published["scene_area_m2"], rel=0.01)


def test_every_case_has_its_scenario():
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
    assert s.band == pytest.approx(tuple(np.quantile(x, [0.05, 0.95])))
    assert s.inside


def test_spread_without_runs_or_published_value():
    assert spread([], 3.0).inside is None
    assert spread([1.0, 2.0], None).inside is None
    assert math.isnan(spread([1.0], 1.0).sd)


def test_void_and_failed_runs_are_left_out_and_counted():
    records = [record(cars=10), record(cars=12), record(cars=99, void=True), {"error": "E: x"}]
    result = evaluate(case(cars_derailed=11), records)
    assert result.distributions["cars_derailed"].mean == 11.0
    assert result.ensemble.counts() == {"runs": 4, "void": 1, "failed": 1, "errors": ["E: x"]}
    assert result.pairs == {"2-1": 2}


def test_goals_by_hand():
    first = evaluate(
        case(cars_derailed=10, duration_s=19.0, peak_force_N=5e6, scene_length_m=50.0),
        [record(), record(cars=12, duration=22.0)],
    )
    second = evaluate(
        case(cars_derailed=8, duration_s=21.0, peak_force_N=10e6, scene_width_m=25.0),
        [record(), record()],
    )
    g = {goal.name: goal for goal in goals([first, second], LIMITS)}
    assert g["pair_share"].value is None and g["pair_share"].cases == 0
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


def test_goals_of_pairs_count_a_pair_whichever_struck():
    def result(name, pair, *pairs):
        published = {} if pair is None else {"peak_force_pair": pair}
        found = [record(peak_force_pair=p) for p in pairs]
        return evaluate(PublishedCase(name, name, "s", published), found)

    results = [
        result("base_60", [5, 3], [3, 5], [5, 3], [7, 6], [5, 3]),
        result("b", [2, 1], [5, 4], None),
        result("c", None, [3, 1]),
    ]
    assert [r.pair_share for r in results] == [0.75, 0.0, None]
    assert [r.two_apart_share for r in results] == [0.75, 0.0, 1.0]
    g = {goal.name: goal for goal in goals(results, LIMITS)}
    assert (g["pair_cases"].value, g["pair_cases"].cases) == (1.0, 2)
    assert g["pair_share"].value == pytest.approx(0.375)
    assert g["two_apart_share"].value == pytest.approx(0.375)
    assert g["base_pair_share"].value == 0.75
    assert not g["two_apart_share"].met
    assert dataclasses.replace(g["two_apart_share"], value=0.8).met
    assert not dataclasses.replace(g["two_apart_share"], value=0.95).met


def test_a_published_force_is_judged_with_the_noise_of_the_source():
    forces = [record(peak=1e7), record(peak=1.1e7)]
    for published, inside in ((9.3e6, True), (9.1e6, False), (1.18e7, True), (1.2e7, False)):
        found = evaluate(case(peak_force_N=published), forces).distributions["peak_force_N"]
        assert found.inside is inside
    length = evaluate(case(scene_length_m=59.0), [record(), record()])
    assert length.distributions["scene_length_m"].inside is False


def test_scatter_of_the_log_ratio_is_that_of_a_log_normal():
    draws = np.exp(np.random.default_rng(0).normal(1.0, 0.3, 20_000))
    result = evaluate(case(peak_force_N=math.e * 1e6), [record(peak=1e6 * d) for d in draws])
    (goal,) = (g for g in goals([result], LIMITS) if g.name == "peak_log_ratio")
    assert goal.scatter == pytest.approx(np.median(np.abs(np.log(draws) - 1.0)), rel=0.03)


def test_a_goal_without_cases_is_not_met():
    result = evaluate(case(), [record()])
    assert all(g.value is None and not g.met for g in goals([result], LIMITS))


def test_verdicts():
    assert verdict(spread([10.0, 11.0, 12.0], 11.5)) == "in the band"
    assert verdict(spread([10.0, 11.0, 12.0], 14.0)) == "mean 3.00 below"
    assert verdict(spread([], 14.0)) == "no runs"
    assert verdict(spread([1.0], None)) == ""


# The whole ---------------------------------------------------------------------------------


def respond(run):
    k = run.member
    return outcome(
        cars_derailed=10 + k % 2, duration=20.0 + k, peak_force=4e6 + 1e6 * k, scene_area=1500.0
    )


SHORT = "base_train"


def made_up_comparison(progress=None):
    published = Published(
        (
            PublishedCase("a", "A train", SHORT, {"cars_derailed": 10, "peak_force_N": 4.5e6}),
            PublishedCase("b", "Another", SHORT, {"duration_s": 30.0}, {"train.speed_kmh": 30}),
        ),
        (PublishedCase("c", "Beside", SHORT, {"cars_derailed": 30}),),
        LIMITS,
    )
    return validate(
        4,
        published=published,
        run=runner(respond),
        progress=progress,
    )


@pytest.fixture
def comparison():
    seen = []
    result = made_up_comparison(lambda done, total: seen.append((done, total)))
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
    assert data["cases"][0]["measures"]["peak_force_N"]["inside_band"] is True
    assert data["cases"][1]["overrides"] == {"train.speed_kmh": 30}
    assert data["passed"] is False


def test_tables(comparison):
    tables = {table.title: table.markdown() for table in measure_tables(comparison)}
    assert "| A train | 10 | 10.5 | 0.6 | 10 to 11 | in the band |" in tables["cars derailed"]
    assert "| Another | 30.00 | 21.50 |" in tables[MEASURES["duration_s"].title]
    assert "**missed**" in goal_table(comparison).markdown()
    assert "| cars derailed | 1 of 1 | 1 of 1 |" in doubt_table(comparison).markdown()


def test_doubtful_ensembles_stand_beside_the_cases_and_count_in_no_goal(comparison):
    assert [r.case.name for r in comparison.doubtful] == ["a", "b"]
    assert [len(r.ensemble) for r in comparison.doubtful] == [4, 4]
    assert all(g.cases <= 2 for g in comparison.goals)


def test_settings_are_compared_without_doubt():
    published = Published(
        (PublishedCase("a", "A train", SHORT, {"cars_derailed": 10}),), (), LIMITS
    )
    result = validate(
        2,
        settings={"ground.scale": 1.1},
        published=published,
        run=runner(respond),
    )
    assert result.doubtful == ()


def test_what_is_lost_reaches_the_runs_and_what_is_printed_does_not():
    scenario = load_scenario("mississauga_published_brake_traction")
    own = scenario.to_params()
    runs = list(doubtful_jobs(scenario, 3, seed=4))
    for run in runs:
        p, drawn = run.params(), draw(4, run.member)
        assert p.brakes.force == drawn["brakes.force_N"]
        assert p.brakes.triggers[0].delay == drawn[DELAY]
        assert p.ground.c_v == drawn["ground.c_v_s_per_m"]
        assert (p.contact.gap_law, p.contact.inside) == (
            drawn["contact.gap_law"], drawn["contact.inside"]
        )  # fmt: skip
        assert {c.front.k2 for c in p.cars} == {drawn["couplers.k2_N_per_m"]}
        assert p.contact.force_max == own.contact.force_max == 3.0e6
        assert (p.ground.c_s, p.ground.c_d, p.ground.eps) == (0.8, 0.7, 0.01)
        # the inertias of this train are printed
        assert [c.inertia for c in p.cars[:24]] == [c.inertia for c in own.cars[:24]]
    forces = [run.params().initiation.lateral_forces[0].force for run in runs]
    assert forces == [50e3 * member_factor(4, k) for k in range(3)]


def test_doubt_of_the_base_train_is_in_its_inertia_and_not_in_the_start_of_its_brakes():
    base = load_scenario("base_train")
    own = base.to_params()
    for run in doubtful_jobs(base, 3, seed=4):
        p = run.params()
        factor = draw(4, run.member)[INERTIA]
        assert p.cars[0].inertia == pytest.approx(factor * own.cars[0].inertia)
        assert p.brakes.triggers[0].delay == own.brakes.triggers[0].delay


def test_draws_fill_their_ranges_and_depend_on_seed_and_member_alone():
    assert draw(0, 1) == draw(0, 1)
    assert draw(0, 1) != draw(0, 2)
    assert draw(0, 1) != draw(1, 1)
    draws = [draw(0, k) for k in range(400)]
    for d in DOUBTS:
        if d.forms:
            found = Counter(one[d.path] for one in draws)
            assert set(found) == set(d.forms)
            assert min(found.values()) > 400 / len(d.forms) / 1.4
            continue
        values = np.array([one[d.path] for one in draws]) / d.scale
        low, high = d.low, d.high
        assert low <= values.min() < d.at(0.05) / d.scale
        assert d.at(0.95) / d.scale < values.max() <= high
        assert 0.4 < np.mean(values < d.at(0.5) / d.scale) < 0.6
    # the model's own values lie within what is in doubt about them
    home = load_scenario("mississauga_published_brake_traction").to_params()
    own = {"brakes.force_N": home.brakes.force, "ground.c_v_s_per_m": home.ground.c_v,
           "couplers.k2_N_per_m": home.cars[0].front.k2, INERTIA: 1.0,
           DELAY: home.brakes.triggers[0].delay}  # fmt: skip
    for d in DOUBTS:
        if d.path in own:
            assert d.low <= own[d.path] / d.scale <= d.high, d.label
        else:
            assert getattr(home.contact, d.path.split(".")[1]) in d.forms
