"""Standing cars in recordings, pictures and maps: apart from the train's own."""

import json

import numpy as np
import pytest

from derail_ros import models
from derail_ros.recording import record_run
from derail_ros.recording.derived_outcome import derive_couplings, derive_outcome
from derail_ros.recording.reader import read_bag
from derail_ros.review import drawing, figures, maps, replay_page
from derail_ros.review.scene import final_scene, scene_from_simulation
from derail_ros.review.summary import findings
from derail_ros.scenario import loads_scenario
from derail_ros.vocabulary.measures import outcome_record
from tests.nodes.support import SIDING


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    """A run and its recording."""
    scenario = loads_scenario(SIDING, "siding")
    simulation = models.build(scenario.to_params())
    path = tmp_path_factory.mktemp("standing") / "bag"
    record_run(simulation, scenario, path)
    return simulation, read_bag(path)


def test_the_scenario_strikes_and_derails_standing_cars(both):
    standing = both[0].outcome().standing
    assert standing.struck and standing.moved and standing.derailed
    assert both[0].outcome().derailed_cars


def test_a_recording_tells_them_apart(both):
    simulation, run = both
    outcome = simulation.outcome()
    assert run.outcome.standing == outcome.standing
    assert run.outcome.derailed_cars == outcome.derailed_cars
    told, got = outcome_record(outcome), outcome_record(run.outcome)
    for key in told:
        if key.startswith("standing") or key in ("cars_derailed", "train", "cars_above_5MN"):
            assert got[key] == pytest.approx(told[key]), key
    assert run.cars.cut.tolist() == [0, 0, 0, 0, 1, 1, 1]
    assert run.cars.totals.cars == 4 and run.cars.own == 4
    assert not run.coupled[:, 3].any() and run.coupled[0, 4:].all()


def test_what_is_worked_out_of_a_part_is_the_same(both):
    _, run = both
    derived = derive_outcome(run)
    assert derived.standing.derailed == run.outcome.standing.derailed
    assert derived.standing.struck == run.outcome.standing.struck
    assert derived.derailed_cars == run.outcome.derailed_cars
    assert derived.peak_force == pytest.approx(run.outcome.peak_force)
    held = derive_couplings((), run.time[:1], run.cars.cut)
    assert held.tolist() == [[True, True, True, False, True, True]]


def test_pictures_mark_them(both):
    simulation, run = both
    for scene in (final_scene(run), scene_from_simulation(simulation)):
        assert scene.own.tolist() == [True] * 4 + [False] * 3
        assert not scene.parted[3]
        assert "siding" in {shape.name for shape in scene.site if shape.role == "track"}
        window = drawing.site(scene)
        off = scene.derailed
        corners = scene.corners()[off].reshape(-1, 2)
        assert all(drawing.within(window, x, y) for x, y in corners)
    figure = figures.final_scene(final_scene(run))
    texts = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
    assert "not of the train (3)" in texts
    on = [text for text in texts if text.startswith(("on the rails", "derailed"))]
    assert sum(int(text.rpartition("(")[2][:-1]) for text in on) == 4


def test_maps_and_pages_mark_them(both, tmp_path):
    _, run = both
    maps.export(run, tmp_path, [])
    shapes = json.loads((tmp_path / "footprints.geojson").read_text())["features"]
    told = [f["properties"] for f in shapes]
    assert [t["standing"] for t in told] == [False] * 4 + [True] * 3
    off = {t["car"] for t in told if t["derailed"]}
    assert off == {*run.outcome.derailed_cars, *run.outcome.standing.derailed}
    assert told[4]["contents"] == "grain"
    ways = json.loads((tmp_path / "paths.geojson").read_text())["features"]
    moved = {f["properties"]["car"] for f in ways if f["properties"]["standing"]}
    far = np.hypot(*(run.pose[-1] - run.pose[0])[:, :2].T) > maps.PATH_STEP
    assert moved == {car for car in run.outcome.standing.moved if far[car - 1]}
    place = json.loads((tmp_path / "place.geojson").read_text())["features"]
    assert [f["properties"]["name"] for f in place] == ["track", "wall", "siding"]
    data = replay_page.data(run, findings(run))
    assert [car["cut"] for car in data["cars"]] == [0, 0, 0, 0, 1, 1, 1]
    assert data["place"][1]["role"] == "track"
