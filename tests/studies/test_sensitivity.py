"""The sensitivity study: what is changed, paired differences, words and figure."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from derail_ros.engine import PlanarSimulation
from derail_ros.scenario import load_scenario
from derail_ros.studies.published import load_published
from derail_ros.studies.sensitivity import (
    COMPARED,
    REDUCED,
    Change,
    Difference,
    choose_cases,
    choose_constants,
    coupler_mass,
    cylinder_radius,
    difference,
    load_constants,
    over_cases,
    sensitivity,
    shoes,
    shown,
    stands_out,
)
from derail_ros.vocabulary.measures import failed_record, outcome_record
from tests.studies.made_up import outcome, runner

COUNT, DURATION, FORCE, _, _ = COMPARED
CONSTANTS = load_constants()
BASE = load_scenario("base_train")


# What is changed ---------------------------------------------------------------------------


def test_names_are_unique_and_groups_together():
    names = [c.name for c in CONSTANTS]
    assert len(set(names)) == len(names)
    groups = [c.group for c in CONSTANTS]
    assert len(set(groups)) == 1 + sum(a != b for a, b in zip(groups, groups[1:], strict=False))


@pytest.mark.parametrize("constant", CONSTANTS, ids=lambda c: c.name)
def test_every_change_changes_the_engine_and_is_accepted(constant):
    scenario = BASE
    if constant.only:
        scenario = load_scenario("mississauga_published_brake_instant_traction")
    before = scenario.to_params()
    seen = [before]
    for change in constant.changes:
        params = change.params(scenario)
        assert params not in seen
        seen.append(params)
        PlanarSimulation(params)


def test_defaults_in_words_are_those_of_the_engine():
    params = BASE.to_params()
    said = {c.name: c.default for c in CONSTANTS}
    assert float(said["F_max"]) * 1e6 == params.contact.force_max
    assert float(said["F0"]) * 1e3 == params.brakes.force
    assert float(said["k2"]) * 1e6 == params.cars[0].front.k2
    assert float(said["rest_speed"]) == params.integration.rest_speed
    assert float(said["rtol"]) == params.integration.rtol
    begin, end = (float(text) * 1e3 for text in said["event"].split(", "))
    assert (begin, end) == (params.contact.begin_force, params.contact.end_force)
    assert said["method"] == params.integration.method
    test = load_scenario("mississauga_published_brake_instant_traction").to_params()
    assert float(said["traction"]) == test.brakes.triggers[0].delay
    assert said["inside"] == params.contact.inside == test.contact.inside
    assert {f.force for f in params.initiation.lateral_forces} == {50e3}


def test_sides():
    for constant in CONSTANTS:
        sides = [c.side for c in constant.changes]
        assert sides == sorted(sides, key=lambda s: (s == 0, s))


def test_edits_of_the_cars():
    params = BASE.to_params()
    car = params.cars[0]
    thin = cylinder_radius(0.0)(params).cars[0]
    assert thin.inertia == pytest.approx(car.mass * car.length**2 / 12.0, rel=1e-3)
    lumped = coupler_mass(500.0)(params).cars[0]
    assert lumped.mass == car.mass
    assert lumped.inertia == pytest.approx(
        car.inertia * (1.0 - 1000.0 / car.mass) + 1000.0 * car.pivot_distance**2
    )
    assert {u.shoe for c in shoes("cast_iron")(params).cars for u in c.brakes} == {"cast_iron"}


def test_choices():
    published = load_published()
    assert [c.name for c in choose_cases(published, ())] == list(REDUCED)
    assert choose_cases(published, ["all"]) == published.cases
    assert [c.name for c in choose_cases(published, ["base_48"])] == ["base_48"]
    with pytest.raises(ValueError, match="unknown case 'x'.*base_48"):
        choose_cases(published, ["x"])
    assert [c.name for c in choose_constants(["d_c", "k2"])] == ["k2", "d_c"]
    with pytest.raises(ValueError, match="unknown constant 'x'.*k2"):
        choose_constants(["x"])


# Statistics --------------------------------------------------------------------------------


def records(**columns):
    keys = {"cars": "cars_derailed", "force": "peak_force"}
    rows = zip(*columns.values(), strict=True)
    return [
        outcome_record(outcome(**dict(zip((keys[k] for k in columns), row, strict=True))))
        for row in rows
    ]


def test_difference_is_paired():
    a, b = [10, 12, 15, 11], [9, 12, 13, 11]
    d = difference(records(cars=a), records(cars=b), COUNT)
    x = np.array(a) - np.array(b)
    assert d.mean == x.mean()
    assert d.error == pytest.approx(x.std(ddof=1) / 2.0)
    assert d.pairs == 4


def test_forces_are_compared_by_their_ratio():
    d = difference(records(force=[2e6, 8e6]), records(force=[1e6, 1e6]), FORCE)
    assert d.shown_in(FORCE)[0] == pytest.approx(300.0)  # geometric mean 4
    assert shown(Difference(math.log(1.1), 0.01, 5), FORCE) == "+10.0 ± 1.1"


def test_pairs_without_both_runs_are_left_out():
    default = records(cars=[10, 10, 10, 10])
    changed = records(cars=[11, 13, 12, 12])
    changed[1] = failed_record("E: x")
    changed[2]["void"] = True
    d = difference(changed, default, COUNT)
    assert (d.mean, d.pairs) == (1.5, 2)
    nothing = difference(changed[1:2], default[1:2], COUNT)
    assert not nothing.known
    assert shown(nothing, COUNT) == "-"


def test_over_cases():
    d = over_cases([Difference(1.0, 0.3, 5), Difference(2.0, 0.4, 5)])
    assert (d.mean, d.error, d.pairs) == (1.5, pytest.approx(0.25), 10)
    assert over_cases([Difference(math.nan, math.nan, 0)]).known is False


def test_what_stands_out():
    floor = {"cars_derailed": 0.5}
    assert stands_out(Difference(1.0, 0.2, 9), COUNT, floor)
    assert not stands_out(Difference(1.0, 0.6, 9), COUNT, floor)
    assert not stands_out(Difference(0.4, 0.1, 9), COUNT, floor)
    assert shown(Difference(-0.001, 0.0, 2), COUNT) == "+0.00 ± 0.00"


# The whole ---------------------------------------------------------------------------------


def respond(run):
    """Cars derailed follow from the brake force, the duration from the rest threshold."""
    p = run.scenario
    if p.contact.gap_law == "lorentzian" and run.member == 1:
        return RuntimeError("x")
    return outcome(
        cars_derailed=10 + (p.brakes.force < 40e3) + run.member % 2,
        duration=20.0 - p.integration.rest_speed,
        peak_force=p.contact.force_max * 3.0,
        status="void" if p.brakes.force == 20e3 and run.member == 0 else "at rest",
    )


def made_up_study(progress=None):
    return sensitivity(
        4,
        cases=["base_60", "instant_traction"],
        constants=["F0", "F_max", "gap_law", "traction", "mirror"],
        progress=progress,
        run=runner(respond),
    )


@pytest.fixture(scope="module")
def study():
    seen = []
    study = made_up_study(lambda done, total: seen.append((done, total)))
    assert seen[-1] == (study.runs, study.runs)
    return study


def test_study(study):
    effects = {(e.constant.name, e.change.value): e for e in study.effects}
    assert effects["F0", "35"].overall["cars_derailed"].mean == 1.0
    assert effects["F0", "50"].overall["cars_derailed"].mean == 0.0
    ratio = 2.4e6 / BASE.to_params().contact.force_max
    assert effects["F_max", "2.4"].overall["peak_force_N"].shown_in(FORCE)[0] == pytest.approx(
        100.0 * (ratio - 1.0)
    )
    assert effects["F0", "20"].ensemble.void == 2
    assert effects["gap_law", "Lorentzian"].ensemble.failed == 2
    assert study.failed == 2
    assert list(effects["traction", "5"].cases) == ["instant_traction"]
    # the default, then F0, F_max, gap_law and mirror on both cases, traction on one
    assert study.runs == 4 * (2 + 2 * (4 + 3 + 3 + 1) + 4)
    # the mirror image changes nothing here
    assert study.floor == dict.fromkeys((c.key for c in COMPARED), 0.0)
    assert effects["F0", "35"].reached[0].value != study.default[0].value


def test_a_constant_without_a_case_is_left_out():
    study = sensitivity(2, cases=["base_60"], constants=["traction", "F0"], run=runner(respond))
    assert {e.constant.name for e in study.effects} == {"F0"}


def test_json(study):
    data = json.loads(json.dumps(study.as_dict(), allow_nan=False))
    assert data["cases"] == ["base_60", "instant_traction"]
    effect = next(e for e in data["effects"] if e["value"] == "35")
    assert effect["overall"]["cars_derailed"]["change"] == 1.0
    assert effect["settings"] == {"brakes.force_N": 35e3}


def test_a_study_of_one_member_is_refused():
    with pytest.raises(ValueError, match="members"):
        sensitivity(1)


@pytest.mark.slow
def test_controls_are_within_chance():
    study = sensitivity(
        16, cases=["base_60", "instant_traction"], constants=["mirror", "rtol", "method"]
    )
    assert study.failed == 0
    for effect in study.effects:
        for c in COMPARED:
            d = effect.overall[c.key]
            slack = {"cars": 0.3, "s": 0.3}.get(c.unit, 0.12)
            assert abs(d.mean) < 3.0 * d.error + slack, (effect.change, c.key)


def test_changes_apply_to_the_parameters_alone():
    change = Change("x", 0, edit=lambda p: replace(p, cars=p.cars[:1]))
    assert len(change.params(BASE).cars) == 1
    assert len(BASE.to_params().cars) == 60
