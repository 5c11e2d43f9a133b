"""The spread of outcomes: distributions, words, figure."""

import json

import numpy as np
import pytest

from derail_ros.scenario import load_scenario
from derail_ros.studies.published import load_published
from derail_ros.studies.records import Distribution
from derail_ros.studies.spread import DEFAULT, KEYS, sentence, spread, spread_table
from derail_ros.vocabulary.measures import MEASURES
from tests.studies.made_up import outcome, runner

MISSISSAUGA = load_scenario("mississauga")


def respond(run):
    k = run.member
    if k == 7:
        return RuntimeError("x")
    return outcome(
        cars_derailed=22 + k % 3,
        duration=25.0 + 0.1 * k,
        peak_force=20e6 + 1e5 * k,
        peak_force_pair=None if k == 1 else (11, 9) if k % 2 else (8, 6),
        car_peak_force=np.array(5 * [0.0] + [(k % 2) * 11e6, 0.0, 11e6] + 20 * [0.0]),
        status="void" if k == 9 else "at rest",
    )


def made_up_spread(progress=None):
    published = load_published()
    return spread(
        MISSISSAUGA,
        20,
        published=published.of_run("mississauga", MISSISSAUGA.to_params()),
        accident=published.accident("mississauga"),
        progress=progress,
        run=runner(respond),
    )


@pytest.fixture
def mississauga():
    seen = []
    s = made_up_spread(lambda done, total: seen.append(done))
    assert seen == list(range(1, 21))
    return s


def test_published_values_are_those_of_the_case():
    published = load_published()

    def values(name, **overrides):
        params = load_scenario(name).with_overrides(overrides).to_params()
        return published.of_run(name, params)

    assert values("mississauga")["cars_derailed"] == 24
    assert values("base_train")["cars_derailed"] == 14
    assert values("base_train", **{"train.speed_kmh": 90})["cars_derailed"] == 24
    assert values("base_train", **{"train.speed_kmh": 55}) == {}
    assert values("curve_derailment") == {}
    for name in (*DEFAULT, *published.accidents, *published.same_train):
        load_scenario(name)
    assert published.accident("mississauga_published") == published.accident("mississauga")
    assert published.accident("base_train") == {}


def test_distributions(mississauga):
    d = mississauga.distributions
    k = np.array([i for i in range(20) if i not in (7, 9)])
    assert d["duration_s"].values == pytest.approx(25.0 + 0.1 * k)
    assert d["peak_force_N"].published == 23.09e6
    assert d["scene_length_m"].accident == 132
    assert (mississauga.ensemble.void, mississauga.ensemble.failed) == (1, 1)
    assert mississauga.counted == 18
    assert mississauga.ensemble.pairs == {"8-6": 10, "11-9": 7, "none": 1}
    assert mississauga.published_pair == "11-9"
    assert mississauga.above[7] == 1.0
    assert mississauga.above[5] == pytest.approx(8 / 18)


def test_statistics_of_a_distribution():
    d = Distribution(MEASURES["cars_derailed"], np.array([1.0, 2.0, 4.0]))
    assert d.apart == 2.0  # of 1, 2 and 3
    assert d.below(2.0) == 0.5
    assert d.below(0.0) == 0.0
    empty = Distribution(MEASURES["cars_derailed"], np.array([]))
    assert np.isnan([empty.mean, empty.sd, empty.apart, empty.quantile(0.5)]).all()


def test_json(mississauga):
    data = json.loads(json.dumps(mississauga.as_dict(), allow_nan=False))
    assert len(data["measures"]["duration_s"]["values"]) == 18
    assert data["measures"]["scene_length_m"]["sd"] == 0.0


def test_words(mississauga):
    text = sentence(mississauga)
    assert "22 to 24 cars" in text
    assert "most often 8-6 (56 %)" in text
    table = spread_table(mississauga)
    assert len(table.rows) == len(KEYS)
    assert table.rows[0][-2].startswith("24 (at 8")
    assert "nan" not in table.markdown()


def test_runs_that_all_failed_have_words():
    s = spread(MISSISSAUGA, 3, run=runner(lambda run: RuntimeError("x")))
    assert s.counted == 0
    assert "nan" not in sentence(s) + spread_table(s).markdown()
