"""The figures of the comparison, and the Mississauga run car by car."""

import numpy as np
import pytest

from derail_ros.review.scene import make_scene
from derail_ros.scenario import load_scenario
from derail_ros.studies import mississauga
from derail_ros.studies.mississauga import Details, details, load_published_run
from derail_ros.studies.validation import FIGURES, MEASURES, markdown, validate
from derail_ros.studies.validation_figures import (
    peaks_by_car,
    published_against_computed,
    scene_series,
)
from tests.studies.made_up import outcome, runner


def test_published_run():
    run = load_published_run()
    assert run.peaks[0].pair == (11, 9)
    assert run.by_car == {
        11: 23.09e6, 9: 23.09e6, 8: 16.11e6, 6: 16.11e6, 7: 15.70e6, 10: 15.36e6, 12: 13.77e6,
    }  # fmt: skip
    assert set(run.by_car) <= set(run.above)
    assert len(run.above) == 11
    assert list(run.scenes) == [5.7, 5.9, 8.0, 8.6]


@pytest.fixture(scope="module")
def made_up():
    """Details of a train of 24 cars and what is behind them."""
    cars = load_scenario(mississauga.SCENARIO).to_params().cars
    pose = np.zeros((len(cars), 3))
    pose[:, 0] = -15.0 * np.arange(len(cars))
    velocity = np.zeros((len(cars), 2))
    velocity[7:, 0] = 20.0
    on = np.ones((len(cars), 2), dtype=bool)
    on[:9] = False
    scene = make_scene(cars, pose, on, np.ones(len(cars) - 1, dtype=bool), breaks=[0.0])
    force = np.random.default_rng(0).uniform(0.0, 25e6, (6, len(cars)))
    force[:, 24:] = 0.0
    scenes = dict.fromkeys(load_published_run().scenes, (scene, velocity))
    return Details(force, scenes, scene, "summary")


def test_shares(made_up):
    assert made_up.share_above()[3] == np.mean(made_up.force[:, 3] > 10e6)


def test_peaks_by_car(made_up):
    figure = peaks_by_car(made_up, load_published_run(), "Mississauga")
    (axes,) = figure.axes
    assert axes.get_xlim()[1] > 24
    assert "11 into 9 23.09" in " ".join(t.get_text() for t in figure.texts)


def test_scenes(made_up):
    figure = scene_series(made_up, load_published_run(), "Mississauga")
    assert len(figure.axes) == 4
    texts = [t.get_text() for t in figure.texts]
    assert "here stand: 1 to 7" in texts
    assert any("11 into 9" in text for text in texts)


def test_published_against_computed():
    comparison = validate(3, run=runner(lambda run: outcome(duration=20.0 + run.member)))
    figure = published_against_computed(comparison)
    assert len(figure.axes) == len(MEASURES)
    page = markdown(comparison, "images")
    for file, _, _ in FIGURES:
        assert f"(images/{file})" in page
    assert "images/" not in markdown(comparison)


@pytest.mark.slow
def test_details_for_real():
    found = details(3)
    assert found.force.shape == (3, 25)
    assert list(found.scenes) == [5.7, 5.9, 8.0, 8.6]
    scene, velocity = found.scenes[5.7]
    assert np.hypot(*velocity[0]) < np.hypot(*velocity[10])
    assert scene.derailed[0]
    assert found.final.derailed.sum() >= 18
    assert "cars derailed" in found.summary
