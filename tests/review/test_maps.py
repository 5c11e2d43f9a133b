"""Maps of a run: covered ground against areas known, GeoJSON and KML of a recording."""

import json
import math
from xml.etree import ElementTree

import numpy as np
import pytest

from derail_ros import models
from derail_ros.recording import record_run
from derail_ros.recording.reader import read_bag
from derail_ros.review import maps
from derail_ros.scenario import loads_scenario
from derail_ros.vocabulary.place import Datum
from derail_ros.vocabulary.scene import car_corners
from msg_adapters.reports import _site, _told_site

shapely = pytest.importorskip("shapely")

TEXT = """\
version: 1
title: a place on the map
train: {speed_kmh: 30, consist: [
  {car: box_car, count: 2, contents: grain}, {car: box_car, name: GATX 7, contents: grain}]}
track: {rail_breaks: [12]}
integration: {time_limit_s: 2}
site:
  datum: {latitude_deg: 43.5, longitude_deg: -79.5, azimuth_deg: 60}
  zones: [{name: soil, outline_m: [[0, 1], [60, 1], [60, 30], [0, 30]], preset: soil_lowest}]
  fixed: [{name: wall, outline_along_m: [[-10, -6], [60, -6]]}]
  areas: [{name: line, outline_m: [[10, -5], [10, 5]], closed: false}]
"""


def footprint(x, y, yaw):
    pose = np.array([[x, y, yaw]])
    return car_corners(pose, np.array([14.0]), np.array([3.0]))[:, maps.ROUND]


def test_ground_is_covered_as_often_as_cars_lie_there():
    runs = [footprint(0.0, 0.0, 0.0)] * 10 + [footprint(3.0, 0.0, 0.0)] * 10
    shapes = maps.covered(runs, cell=0.5)
    assert shapes[0.05].area == pytest.approx((14.0 + 3.0) * 3.0)
    assert shapes[0.5].area == pytest.approx((14.0 + 3.0) * 3.0)
    assert shapes[0.95].area == pytest.approx((14.0 - 3.0) * 3.0)
    assert shapes[0.95].bounds == pytest.approx((-4.0, -1.5, 7.0, 1.5))
    turned = maps.covered([footprint(0.0, 0.0, 0.6)], cell=0.1)
    assert turned[0.95].area == pytest.approx(42.0, rel=0.01)
    assert maps.covered([np.zeros((0, 4, 2))]) == {}


def test_each_share_of_the_runs_is_one_feature():
    """Two heaps far apart, the second in one of 30 runs."""
    runs = [footprint(0.0, 0.0, 0.0)] * 29 + [footprint(90.0, 0.0, 0.0)]
    shapes = maps.covered(runs)
    features = maps.cover_features(shapes, len(runs), maps.Map(None))
    told = [f["properties"] for f in features]
    assert [t["covered"] for t in told] == [
        "in any run", "in 5 % of the runs or more", "in 50 % of the runs or more",
        "in 95 % of the runs or more",
    ]  # fmt: skip
    assert told[0]["probability"] == pytest.approx(1.0 / 30.0, abs=1e-4)
    assert [t["area_m2"] for t in told] == pytest.approx([84.0, 42.0, 42.0, 42.0])
    assert [f["geometry"]["type"] for f in features] == ["MultiPolygon"] * 4
    assert [len(f["geometry"]["coordinates"]) for f in features] == [2, 1, 1, 1]
    for shape, feature in zip(shapes.values(), features, strict=True):
        back = shapely.geometry.shape(feature["geometry"])
        assert back.symmetric_difference(shape).area == pytest.approx(0.0, abs=1e-6)
        assert all(part.exterior.is_ccw for part in back.geoms)


def test_a_run_on_the_map(tmp_path):
    scenario = loads_scenario(TEXT, "there")
    simulation = models.build(scenario.to_params())
    record_run(simulation, scenario, tmp_path / "bag")
    run = read_bag(tmp_path / "bag")
    assert run.outcome.site.record() == simulation.outcome().site.record()
    assert run.outcome.site.inside[0].ever
    members = [maps.outlines(run.cars, run.pose[-1])[:2]] * 4
    counts = maps.export(run, tmp_path, members)
    assert set(counts) == {
        "footprints.geojson", "paths.geojson", "place.geojson", "covered.geojson", "run.kml"
    }  # fmt: skip
    found = {n: json.loads((tmp_path / n).read_text()) for n in counts if n.endswith("json")}
    datum = Datum(43.5, -79.5, 0.0, math.radians(60.0))
    corners = maps.outlines(run.cars, run.pose[-1])
    for car, feature in enumerate(found["footprints.geojson"]["features"]):
        told = feature["properties"]
        assert told["car"] == car + 1 and told["contents"] == "grain"
        assert told["derailed"] == (car + 1 in run.outcome.derailed_cars)
        assert told["name"] == run.cars.name[car] == ("GATX 7" if car == 2 else "box car")
        assert (told["side"] is None) == (told["offset_m"] is None) == (not told["derailed"])
        ring = feature["geometry"]["coordinates"][0]
        assert ring[0] == ring[-1] and shapely.Polygon(ring).exterior.is_ccw
        back = [datum.local(latitude, longitude) for longitude, latitude in ring[:-1]]
        middle = np.mean(back, axis=0)
        assert middle == pytest.approx(corners[car].mean(axis=0), abs=2e-3)
        assert shapely.Polygon(back).area == pytest.approx(
            run.cars.length[car] * run.cars.width[car], rel=1e-3
        )
    place = [f["properties"]["name"] for f in found["place.geojson"]["features"]]
    assert place == ["track", "soil", "wall", "line"]
    root = ElementTree.parse(tmp_path / "run.kml").getroot()
    names = [e.text for e in root.iter("{http://www.opengis.net/kml/2.2}name")]
    assert {
        "footprints",
        "car 3, GATX 7",
        "wall",
        "covered in 95 % of the runs or more",
        "covered in any run",
    } <= set(names)


def test_an_outcome_at_its_place_goes_through_messages():
    from derail_ros.vocabulary.site import Entered, SiteOutcome, Struck

    site = SiteOutcome(
        (Struck("wall", 2e6, 3e5, (3, 1), 1), Struck("pier", 0.0, 0.0, ())),
        (("mud", (2,)), ("ice", ())),
        (Entered("school", (2, 3), ()),),
    )
    assert _told_site(*_site(site, 3)) == site
    assert _told_site({}, {}) is None
