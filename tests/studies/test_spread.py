"""The spread of outcomes: distributions, words, figure."""

import json

import numpy as np
import pytest

from derail_ros.scenario import load_scenario
from derail_ros.studies.histograms import histograms
from derail_ros.studies.spread import (
    ACCIDENTS,
    DEFAULT,
    MEASURES,
    SAME_TRAIN,
    Distribution,
    markdown,
    published_values,
    sentence,
    spread,
)
from derail_ros.studies.validation import load_published
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


@pytest.fixture
def mississauga():
    published = published_values("mississauga", MISSISSAUGA.to_params(), load_published())
    seen = []
    s = spread(
        MISSISSAUGA,
        20,
        published=published,
        accident=ACCIDENTS["mississauga"],
        progress=seen.append,
        run=runner(respond),
    )
    assert seen == list(range(1, 21))
    return s


def test_published_values_are_those_of_the_case():
    published = load_published()

    def values(name, **overrides):
        params = load_scenario(name).with_overrides(overrides).to_params()
        return published_values(name, params, published)

    assert values("mississauga")["cars_derailed"] == 24
    assert values("base_train")["cars_derailed"] == 14
    assert values("base_train", **{"train.speed_kmh": 90})["cars_derailed"] == 24
    assert values("base_train", **{"train.speed_kmh": 55}) == {}
    assert values("curve_derailment") == {}
    for name in (*DEFAULT, *ACCIDENTS, *SAME_TRAIN):
        load_scenario(name)


def test_distributions(mississauga):
    d = mississauga.distributions
    k = np.array([i for i in range(20) if i not in (7, 9)])
    assert d["duration_s"].values == pytest.approx(25.0 + 0.1 * k)
    assert d["peak_force_MN"].published == 23.09
    assert d["scene_length_m"].accident == 132
    assert (mississauga.void, mississauga.failed, mississauga.counted) == (1, 1, 18)
    assert mississauga.pairs == {"8-6": 10, "11-9": 7, "none": 1}
    assert mississauga.published_pair == "11-9"
    assert mississauga.above[7] == 1.0
    assert mississauga.above[5] == pytest.approx(8 / 18)


def test_statistics_of_a_distribution():
    d = Distribution(MEASURES[0], np.array([1.0, 2.0, 4.0]), None, None)
    assert d.apart == 2.0  # of 1, 2 and 3
    assert d.below(2.0) == 0.5
    assert d.below(0.0) == 0.0
    empty = Distribution(MEASURES[0], np.array([]), None, None)
    assert np.isnan([empty.mean, empty.sd, empty.apart, empty.quantile(0.5)]).all()


def test_words(mississauga):
    text = sentence(mississauga)
    assert "22 to 24 cars" in text
    assert "most often 8-6 (56 %)" in text
    page = markdown([mississauga], ["images/spread_mississauga.png"])
    assert "| duration (s) |" in page
    assert "24 (at 8" in page
    assert "nan" not in page
    assert max(len(line) for line in page.splitlines() if not line.startswith("|")) < 110


def test_json(mississauga):
    data = json.loads(json.dumps(mississauga.as_dict(), allow_nan=False))
    assert len(data["measures"]["duration_s"]["values"]) == 18
    assert data["measures"]["scene_length_m"]["sd"] == 0.0


def test_figure(mississauga):
    figure = histograms(mississauga)
    assert len(figure.axes) == len(MEASURES)
    bars = [sum(p.get_height() for p in axes.patches) for axes in figure.axes]
    assert bars == [18] * len(MEASURES)
    notes = [t.get_text() for axes in figure.axes for t in axes.texts]
    assert {"published 24", "accident 24", "accident 132", "published 23.09"} <= set(notes)


def test_runs_that_all_failed_have_words_and_a_figure():
    s = spread(MISSISSAUGA, 3, run=runner(lambda run: RuntimeError("x")))
    assert s.counted == 0
    assert "nan" not in markdown([s], ["x.png"])
    histograms(s)
