"""Uncertain fields: what members of an ensemble draw, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import kstest, norm, triang

from derail_ros.scenario import ScenarioError, loads_scenario
from derail_ros.scenario.uncertain import share

TEXT = """\
version: 1
title: Two kinds of cars
constants: published
train:
  speed_kmh: 60
  consist: [{car: tank_dot_111, count: 3}, {car: tank_dot_111, load: 0.5}]
track: {rail_breaks: [10]}
uncertain:
  train.speed_mph: {normal: {mean: 40, sd: 5, low: 20}}
  train.consist.*.mass_kg: {triangular: {low: 0.9, mode: 1, high: 1.1}, relative: true}
  ground.scale: {uniform: [0.5, 1.5]}
  contact.inside: {values: [even, held]}
"""


@pytest.fixture(scope="module")
def own():
    return loads_scenario(TEXT)


def test_members_have_what_they_drew(own) -> None:
    base = own.to_params()
    assert own.member_params(0) == base and own.member_inputs(0) == {}
    drawn, params = own.member_inputs(3, seed=2), own.member_params(3, seed=2)
    assert params.initiation.speed == pytest.approx(drawn["train.speed_mph"] * 0.44704)
    factor = drawn["train.consist.*.mass_kg"]
    for car, before in zip(params.cars, base.cars, strict=True):
        assert car.mass == pytest.approx(factor * before.mass)
    assert params.ground.scale == drawn["ground.scale"]
    assert params.contact.inside == drawn["contact.inside"]
    assert own.member_params(3, seed=2) == params != own.member_params(3, seed=3)
    again = loads_scenario(own.to_yaml())
    assert (again.hash, again.member_inputs(3, seed=2)) == (own.hash, drawn)
    same = again.member_params(3, seed=2)  # inertias are given there, and follow the masses
    assert [c.inertia for c in same.cars] == pytest.approx([c.inertia for c in params.cars])
    assert replace(same, cars=params.cars) == params


def test_draws_have_their_distributions() -> None:
    """1500 members against SciPy's distribution functions, and independent of each other."""
    from derail_ros.scenario.distributions import quantile_of

    own = loads_scenario(TEXT).model.uncertain
    speed, mass = own["train.speed_mph"], own["train.consist.*.mass_kg"]
    u, w = (np.array([share(0, m, path) for m in range(1, 1501)]) for path in ("a", "b"))
    assert abs(np.corrcoef(u, w)[0, 1]) < 0.08
    assert kstest([quantile_of(mass)(x) for x in u[:300]], triang(0.5, 0.9, 0.2).cdf).pvalue > 1e-3
    cut = norm(40, 5).cdf(20.0)
    values = [quantile_of(speed)(x) for x in u[:300]]
    assert kstest(values, lambda v: (norm(40, 5).cdf(v) - cut) / (1 - cut)).pvalue > 1e-3
    inside = [quantile_of(own["contact.inside"])(x) for x in u]
    assert inside.count("even") == pytest.approx(750, abs=80)


def test_another_uncertain_field_changes_no_draw(own) -> None:
    fewer = loads_scenario(TEXT.replace("  ground.scale: {uniform: [0.5, 1.5]}\n", ""))
    assert fewer.member_inputs(5)["train.speed_mph"] == own.member_inputs(5)["train.speed_mph"]


def test_calibrated_constants_are_drawn_beside_what_is_uncertain() -> None:
    own = loads_scenario(TEXT.replace("constants: published\n", ""))
    drawn = own.member_inputs(1)
    assert {"brakes.delay_s", "brakes.force_scale", "train.speed_mph"} <= set(drawn)
    params = own.member_params(1)
    assert params.brakes.triggers[0].delay == drawn["brakes.delay_s"]
    assert params.ground.scale == drawn["ground.scale"]  # uncertain, so not calibrated
    central = own.member_inputs(0)  # of the scenario itself, not drawn
    assert central["brakes.delay_s"] == own.to_params().brakes.triggers[0].delay


@pytest.mark.parametrize(
    ("old", "new", "field", "reason"),
    [
        ("train.speed_mph", "train.sped", "'train.sped'", "did you mean 'speed_kmh'"),
        ("sd: 5, low: 20", "sd: 50", "'train.speed_mph'", "can be -145.951: must be above 0"),
        ("sd: 5", "sd: -5", "'train.speed_mph'.normal.sd", "must be above 0"),
        ("[0.5, 1.5]", "[1.5, 0.5]", "'ground.scale'.uniform", "must rise, got 1.5 to 0.5"),
        ("[0.5, 1.5]", "[0.5]", "'ground.scale'.uniform", "at least 2 entries"),
        ("[even, held]", "[even, hold]", "'contact.inside'", "can be hold: must be 'held'"),
        ("consist.*", "cons.*", "'train.cons.*.mass_kg'", "train.cons is not a list"),
        ("mode: 1,", "mode: 2,", "triangular.mode", "must lie between 0.9 and 1.1"),
        ("{uniform: [0.5, 1.5]}", "{}", "'ground.scale'", "must be one of normal, lognormal"),
        ("ground.scale: {", "title: {", "uncertain.title", "must be the dotted path of a field"),
        ("{uniform", "{relate: 1, uniform", "'ground.scale'.relate", "unknown key"),
        ("contact.inside: {values: [even, held]}", "contact.inside: {uniform: [1, 2], relative: "
         "true}", "'contact.inside'", "has no number at contact.inside"),
        ("ground.scale: {", "train.consist.1.mass_kg: {", "mass_kg'", "another path varies too"),
    ],
)  # fmt: skip
def test_mistakes_name_the_field(old: str, new: str, field: str, reason: str) -> None:
    assert old in TEXT
    with pytest.raises(ScenarioError) as caught:
        loads_scenario(TEXT.replace(old, new))
    assert field in caught.value.field and reason in caught.value.reason
    assert str(caught.value).startswith("<inline>:")
