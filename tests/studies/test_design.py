"""Designs: which points they make."""

import numpy as np
import pytest
from scipy import stats

from derail_ros.scenario import load_scenario
from derail_ros.studies import design as designs
from derail_ros.studies.orders import NAMES, reorder
from derail_ros.studies.plan import study_from


def make(parameters, kind="grid", **more):
    return designs.make(
        study_from({"scenario": "base_train", "design": kind, "parameters": parameters, **more})
    )


SPEED = {"path": "train.speed_kmh", "values": [40, 60, 80]}
GROUND = {"path": "ground.scale", "values": [0.5, 1.0]}


def test_a_grid_has_all_combinations_the_last_parameter_fastest():
    design = make({"speed": SPEED, "ground": GROUND})
    assert [tuple(p.columns.values()) for p in design] == [
        (40, 0.5), (40, 1.0), (60, 0.5), (60, 1.0), (80, 0.5), (80, 1.0)
    ]  # fmt: skip
    assert design[3].overrides == {"train.speed_kmh": 60, "ground.scale": 1.0}
    assert [p.index for p in design] == list(range(6))


def test_one_at_a_time_begins_with_the_base():
    design = make({"speed": SPEED, "ground": GROUND}, "one_at_a_time")
    assert design[0].overrides == {}
    assert [(p.varied, p.columns[p.varied]) for p in design[1:]] == [
        ("speed", 40), ("speed", 80), ("ground", 0.5)
    ]  # fmt: skip
    assert all(len(p.overrides) == 1 for p in design[1:])
    assert design.base == 0


def test_percent_of_a_whole_number_is_whole():
    design = make({"size": {"path": "train.consist.0.count", "percent": [-33, 0, 1]}}, "grid")
    assert [p.columns["size"] for p in design] == [40, 60, 61]


def test_value_goes_wherever_it_is_named():
    template = {
        "track.rail_breaks_under_cars": ["$value"],
        "initiation.lateral_force_car": "$value",
    }
    design = make({"car": {"set": template, "values": [1, 5]}})
    assert design[1].overrides == {
        "track.rail_breaks_under_cars": [5],
        "initiation.lateral_force_car": 5,
    }
    designs.check(design)


def test_a_latin_hypercube_has_a_point_in_each_share_of_each_parameter():
    design = make(
        {
            "speed": {"path": "train.speed_kmh", "range": [40, 80]},
            "cars": {"path": "train.consist.0.count", "range": [20, 29], "whole": True},
            "brakes": {"settings": {"normal": {}, "instant": {"brakes.instant": True}}},
        },
        "latin_hypercube",
        points=40,
        seed=3,
    )
    table = [tuple(p.columns.values()) for p in design]
    speeds = sorted(row[0] for row in table)
    assert all(40 + i <= v <= 41 + i for i, v in enumerate(speeds))
    cars = [row[1] for row in table]
    assert all(type(n) is int for n in cars)
    assert {n: cars.count(n) for n in set(cars)} == dict.fromkeys(range(20, 30), 4)
    assert [row[2] for row in table].count("instant") == 20
    again = make(
        {
            name: p.model_dump(exclude_none=True)
            for name, p in design.study.model.parameters.items()
        },
        "latin_hypercube",
        points=40,
        seed=3,
    )
    assert [p.columns for p in again] == [p.columns for p in design]


def test_sobol_states_its_runs():
    ranges = {
        "speed": {"path": "train.speed_kmh", "range": [40, 80]},
        "ground": {"path": "ground.scale", "range": [0.5, 1.5]},
        "brake": {"path": "brakes.force_scale", "range": [0.5, 1.5]},
    }
    design = make(ranges, "sobol", points=16, ensemble=2)
    assert len(design) == 16 * (2 * 3 + 2)
    assert design.size() == "N (2 D + 2) = 16 x (2 x 3 + 2) = 128 points x 2 runs = 256 runs"
    first = np.array([list(p.columns.values()) for p in design[:8]])
    # A, then A with one column of B each, then B with one of A each, then B
    for i in range(3):
        changed = first[1 + i] != first[0]
        assert changed.sum() == 1 and changed[i]
        assert first[1 + i][i] == first[7][i]
        assert first[4 + i][i] == first[0][i]


@pytest.mark.parametrize(
    ("spec", "law"),
    [
        ({"normal": {"mean": 60, "sd": 5}}, stats.norm(60, 5)),
        (
            {"normal": {"mean": 60, "sd": 5, "low": 55, "high": 62}},
            stats.truncnorm(-1, 0.4, 60, 5),
        ),
        ({"lognormal": {"median": 60, "sigma": 0.2}}, stats.lognorm(0.2, scale=60)),
        ({"triangular": {"low": 40, "mode": 50, "high": 80}}, stats.triang(0.25, 40, 40)),
    ],
)
def test_distributions_are_those_of_scipy(spec, law):
    design = make(
        {"speed": {"path": "train.speed_kmh", "distribution": spec}}, "latin_hypercube", points=8
    )
    (axis,) = design.axes
    for u in (0.01, 0.2, 0.5, 0.77, 0.999):
        assert axis.at(u).value == pytest.approx(law.ppf(u), rel=1e-9)
    assert np.isfinite([axis.at(0.0).value, axis.at(1.0).value]).all()


# Orders ------------------------------------------------------------------------------------

LIGHT = {"mass_kg": 30e3, "length_m": 18.0, "count": 2, "name": "a"}
HEAVY = {"mass_kg": 90e3, "length_m": 12.0, "count": 2, "name": "b"}


def names(consist):
    return "".join(b["name"] * b["count"] for b in consist)


@pytest.mark.parametrize(
    ("order", "cars"),
    [
        ("as_given", "aabb"),
        ("reversed", "bbaa"),
        ("light_first", "aabb"),
        ("heavy_first", "bbaa"),
        ("short_first", "bbaa"),
        ("long_first", "aabb"),
        ("light_middle", "baab"),
        ("heavy_middle", "abba"),
        ("short_middle", "abba"),
        ("light_heavy_alternating", "abab"),
        ("short_long_alternating", "baba"),
    ],
)
def test_orders(order, cars):
    assert names(reorder([LIGHT, HEAVY], order)) == cars


def test_orders_keep_all_cars_and_those_outside_their_range():
    consist = [{"mass_kg": 1.0 * i, "length_m": 5.0, "count": 1, "name": str(i)} for i in range(7)]
    for order in (*NAMES, "shuffled_1", "shuffled_2"):
        mixed = names(reorder(consist, order, (2, 6)))
        assert mixed[0] == "0" and mixed[-1] == "6"
        assert sorted(mixed) == list("0123456")
    assert reorder(consist, "shuffled_1") == reorder(consist, "shuffled_1")
    assert reorder(consist, "shuffled_1") != reorder(consist, "shuffled_2")
    assert reorder(consist, "shuffled_1", seed=1) != reorder(consist, "shuffled_1")
    with pytest.raises(ValueError, match="no car 8"):
        reorder(consist, "reversed", (1, 8))


def test_an_order_of_cars_is_a_scenario():
    design = make({"order": {"order": ["as_given", "reversed", "shuffled_3"]}})
    designs.check(design)
    mixed = designs.make(
        study_from(
            {
                "scenario": "mid_train_break",
                "design": "grid",
                "parameters": {"order": {"order": ["as_given", "light_first"], "cars": [3, 50]}},
            }
        )
    )
    given = load_scenario("mid_train_break").to_params()
    same, sorted_ = (designs.scenario_at(mixed, p).to_params() for p in mixed)
    assert same == given
    masses = [car.mass for car in sorted_.cars]
    assert masses[:2] == [car.mass for car in given.cars[:2]]
    assert masses[2:] == sorted(car.mass for car in given.cars[2:])
    assert sum(masses) == pytest.approx(sum(car.mass for car in given.cars))


def test_points_are_checked_as_they_are_hashed():
    a, b = make({"speed": SPEED}), make({"speed": {**SPEED, "values": [40, 60, 81]}})
    told = []
    assert designs.check(a, told.append) == designs.check(a)
    assert told == [1, 2, 3]
    assert designs.check(a) != designs.check(b)
