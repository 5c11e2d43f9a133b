"""The figures of the source: laws, scenes, variations."""

import numpy as np
import pytest

from derail_ros.scenario import load_scenario
from derail_ros.studies.law_figures import CLOSING, laws
from derail_ros.studies.published import load_published
from derail_ros.studies.published_figures import (
    MEASURES_SHOWN,
    VARIATIONS,
    final_scenes,
    published_points,
    scene_sheet,
    scenes_at,
    variation_ensembles,
    variations,
)
from tests.studies.made_up import outcome, runner

BASE = load_scenario("base_train")


def curves(axes):
    return {line.get_label(): line.get_xydata() for line in axes.lines}


def test_laws():
    figure = laws(BASE.to_params(), BASE.coupler_types())
    brakes, strikers, knuckles, ground, gap, collision = figure.axes[:6]
    shoe = curves(brakes)["composition"]
    assert shoe[0, 1] == pytest.approx(BASE.to_params().brakes.force / 1e3)
    assert np.ptp(shoe[shoe[:, 0] > 81.0][:, 1]) == pytest.approx(0.0)
    assert {"E60", "E67", "E68", "E69", "F70", "F73", "F79"} <= set(curves(strikers))
    f73 = curves(strikers)["F73"]
    assert np.interp(0.3, *f73.T) == pytest.approx(0.3 * 4.88, rel=1e-3)
    ends = [c[-1, 0] for label, c in curves(knuckles).items() if "parts" in label]
    assert ends == pytest.approx([0.9, 0.71, 0.8])
    assert ground.lines[0].get_xydata()[-1, 1] == pytest.approx(0.7 + 0.03 * 30.0)
    bell = curves(gap)["gaussian"]
    assert np.interp([-0.08, 0.0, 0.08], *bell.T) == pytest.approx([1.5, 3.0, 1.5], rel=1e-3)
    assert len([c for c in curves(collision) if "m/s" in c or c == "0"]) == len(CLOSING)
    assert np.interp(0.0, *curves(collision)["+10 m/s"].T) == pytest.approx(3.0 * 4.5, rel=1e-3)
    assert "inside even" in " ".join(t.get_text() for t in figure.texts)


def test_published_points():
    speed = dict(published_points("train.speed_kmh", 1.0))
    assert sorted(speed) == [30, 48, 60, 72, 90]
    mass = dict(published_points("train.consist.0.mass_kg", 1e3))
    assert mass[34]["cars_derailed"] == 11
    assert mass[68]["cars_derailed"] == 14
    # kept back: only the base train itself
    assert list(dict(published_points("ground.scale", 1.0))) == [1.0]


def test_variations():
    found = variation_ensembles(2, run=runner(lambda job: outcome(duration=20.0 + job.member)))
    assert len(found) == 30
    figure = variations(found)
    assert len(figure.axes) == len(VARIATIONS) * len(MEASURES_SHOWN)
    (count,) = (a for a in figure.axes if "derailed" in a.get_ylabel())
    assert [len(line.get_xdata()) for line in count.lines] == [5, 5]


def test_scenes_at_times():
    (early, first), (late, last) = scenes_at(BASE, [500.0, 2.0])
    assert (early, first.straight) == (2.0, True)
    assert 15.0 < late < 40.0
    assert first.derailed.sum() < last.derailed.sum()
    # car 1 after 2 s: at most the train's speed on
    assert 10.0 < first.pose[0, 0] < 2.0 * 60.0 / 3.6


def test_sheet_of_final_scenes():
    cases = [c for c in load_published().cases if c.name in ("base_30", "base_60")]
    scenes = final_scenes(cases, jobs=1)
    assert [s.title for s in scenes] == [c.title for c in cases]
    figure = scene_sheet(scenes)
    assert len(figure.axes) == 2
    # one scale
    spans = [np.ptp(a.get_xlim()) for a in figure.axes]
    assert spans[0] == pytest.approx(spans[1])
    assert any("cars" in t.get_text() for t in figure.texts)
