"""The two sets of constants: what a scenario says itself stays, the rest is drawn."""

import numpy as np
import pytest

from derail_ros import models
from derail_ros.predict.emulator import Emulator, quick_distribution
from derail_ros.predict.runs import members
from derail_ros.predict.scores import mean
from derail_ros.predict.trains import Train, limited, masses, start_few, train_params
from derail_ros.scenario import loads_scenario
from derail_ros.scenario.calibrated import Draw, load_calibrated
from derail_ros.scenario.constants import FIELDS

OWN = """\
version: 1
title: Ten cars of one's own
train: {speed_kmh: 60, consist: [{car: tank_dot_111, count: 10}]}
track: {rail_breaks: [10]}
"""
DRAW = Draw(brake_distance=100.0, brake_time=2.0, brake_force=0.8, ground=0.5, length=1.1)


def test_a_scenario_of_ones_own_starts_calibrated_and_says_so() -> None:
    own = loads_scenario(OWN)
    assert own.constants == "calibrated"
    assert set(own.model.drawn) == set(FIELDS)
    assert own.model.brakes.law == "braking_ratio"
    again = loads_scenario(own.to_yaml())
    assert (again.hash, again.model.drawn) == (own.hash, own.model.drawn)
    assert again.to_params() == own.to_params()
    assert again.member_params(5) == own.member_params(5) != own.to_params()
    assert own.member_params(5, seed=1) != own.member_params(5)


def test_what_is_given_is_not_drawn() -> None:
    own = loads_scenario(OWN + "ground: {scale: 2}\nbrakes: {delay_s: 4}\n")
    assert set(own.model.drawn) == {"brake_force", "push", "contact"}
    for member in range(4):
        params = own.member_params(member)
        assert (params.ground.scale, params.brakes.triggers[0].delay) == (2.0, 4.0)
    changed = loads_scenario(own.to_yaml()).with_overrides({"contact.force_max_N": 4e6})
    assert set(changed.model.drawn) == {"brake_force", "push"}
    published = loads_scenario("constants: published\n" + OWN)
    assert (published.constants, published.model.drawn) == ("published", ())
    assert published.to_params().brakes.force == 64_000.0


def test_the_brake_delay_counts_from_the_first_car_off() -> None:
    """The front truck, 4.93 m ahead of the middle, meets the break at 10 m after 0.30 s."""
    draw = load_calibrated().central
    own = loads_scenario(OWN)
    reached = (10.0 - 0.5 * 9.86) / (60 / 3.6)
    assert own.model.brakes.delay_s == pytest.approx(draw.delay(60 / 3.6) + reached)
    assert own.model.initiation.lateral_force_start_s >= reached


def test_shipped_draws_are_a_distribution_with_provenance() -> None:
    shipped = load_calibrated()
    assert len(shipped.draws) == 1000
    known = shipped.provenance
    assert known["runs"] > 500 and len(known["engine"]) >= 16
    assert shipped.warning(known["engine"]) == ""
    assert "this is 0000" in shipped.warning("0" * 64)
    one = [shipped.draw(i, 7) for i in range(1000)]
    assert len({d.brake_distance for d in one}) > 500
    assert [shipped.draw(i, 7) for i in range(5)] == one[:5]


@pytest.mark.slow
def test_the_shipped_set_was_checked_with_this_engine() -> None:
    """After an edit of the engine: ``python -m research calibration --check``."""
    assert load_calibrated().warning(models.source_hash()) == ""


def test_a_reports_train_has_its_mean_mass_and_length() -> None:
    train = Train(20.0, 60, 100e3, 0.75)
    kg, loaded = masses(train, np.random.default_rng(0))
    assert kg.mean() == pytest.approx(100e3)
    assert loaded.sum() == 45
    assert kg[~loaded] == pytest.approx(28.5e3)
    params = train_params(train, DRAW)
    assert sum(c.mass for c in params.cars) == pytest.approx(60 * 100e3)
    assert params.cars[1].brakes[0].distance == pytest.approx(1.1 * 16.35, rel=1e-3)
    assert params.brakes.triggers[0].delay == pytest.approx(2.0 + 100.0 / 20.0)
    small = limited(params, DRAW)
    assert sum(c.represents for c in small.cars) == 60 > len(small.cars)
    assert sum(c.mass for c in small.cars) == pytest.approx(60 * 100e3)
    few = start_few(params, 4)
    assert few.track.rail_breaks == () and len(few.initiation.derailed_trucks) == 8


def test_members_hold_the_learned_share_of_few() -> None:
    shipped = load_calibrated()
    share = shipped.few["equipment"].share(15.0, 60)
    chosen = members(shipped, "equipment", 15.0, 60, 400)
    few = [m.few for m in chosen if m.few]
    assert len(few) == pytest.approx(400 * share, abs=1.0)
    assert all(1 <= k <= 60 for k in few)
    assert members(shipped, "equipment", 15.0, 60, 400) == chosen


def test_more_speed_and_more_cars_behind_derail_more() -> None:
    shipped = load_calibrated()
    counts = [
        mean(quick_distribution(shipped, "broken_rail", Train(v, n, 110e3)))
        for v, n in ((8.0, 60), (14.0, 60), (20.0, 60), (20.0, 110))
    ]
    assert counts == sorted(counts)
    assert counts[0] < 0.6 * counts[2]


def test_an_emulator_finds_a_known_law() -> None:
    """Counts of ``exp(1 + ln(v/12) + 0.3 ground)`` times noise of 0.1."""
    rng = np.random.default_rng(1)
    n = 1500
    train = np.column_stack([rng.uniform(5, 25, n), rng.integers(20, 120, n),
                             rng.uniform(4e4, 1.3e5, n), rng.random(n)])  # fmt: skip
    z = rng.standard_normal((n, 10)) * 0.5 + np.array([3.9, 0.7, 0, -0.36, 10.8, 1.6, 14.9, 0, 0,
                                                       0.07])  # fmt: skip
    true = 2.0 + np.log(train[:, 0] / 12.0) + 0.3 * z[:, 3]
    found = Emulator.of(train, z, np.exp(true + 0.1 * rng.standard_normal(n)))
    m, sd = found(train, z)
    assert np.sqrt(np.mean((m - true) ** 2)) < 0.05
    assert sd.mean() == pytest.approx(0.1, abs=0.03)
