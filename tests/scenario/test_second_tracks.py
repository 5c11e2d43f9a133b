"""Second tracks and standing cars of a scenario: geometry, what is kept, what is refused."""

import json
import math

import numpy as np
import pytest

from derail_ros.scenario import ScenarioError, load_scenario, loads_scenario
from derail_ros.scenario.second_tracks import along
from derail_ros.vocabulary.params import TrainParams
from derail_ros.vocabulary.plain import from_plain, to_plain

BEND = """
version: 1
title: a train beside a siding
train:
  speed_kmh: 50
  car_types:
    own: {length_m: 14.1, mass_kg: 68000, coupler: F79, truck_centres_m: 10.0, title: own car}
  consist: [{car: own, count: 3}]
track:
  start_heading_rad: 0.4
  alignment:
    - tangent: {length_m: 120}
    - spiral: {length_m: 60, radius_end_m: 350, turn: left}
    - curve: {length_m: 150, radius_m: 350, turn: left}
    - spiral: {length_m: 90, radius_start_m: 350, turn: left}
    - tangent: {length_m: 100}
  rail_breaks: [200]
initiation: {position_m: 100}
site:
  tracks:
    - {name: loop, offset_m: 4.5, from_m: 30, to_m: 500}
    - {name: right, offset_m: -6, from_m: 100, to_m: 400}
    - name: spur
      start_x_m: 0
      start_y_m: 40
      start_heading_rad: 0.5
      alignment: [{tangent: {length_m: 200}}]
  standing:
    - track: loop
      position_m: 300
      consist:
        - {car: own, count: 2, brake: {hand_brake: true}}
        - {car: own, mass_kg: 30000, contents: scrap}
    - {track: spur, position_m: 100, consist: [{car: own}]}
"""


@pytest.fixture(scope="module")
def bend():
    return loads_scenario(BEND)


@pytest.mark.parametrize(("row", "offset"), [(0, 4.5), (1, -6.0)])
def test_a_track_at_an_offset_keeps_it(bend, row, offset):
    params = bend.to_params()
    places, s = along(params.track, 1.0)
    own = (30.0, 500.0) if row == 0 else (100.0, 400.0)
    within = (s >= own[0] - 1e-9) & (s <= own[1] + 1e-9)
    x, y, psi = places[within].T
    beside = np.stack([x - offset * np.sin(psi), y + offset * np.cos(psi)], axis=1)
    line = along(params.tracks[row].line, 0.02)[0]
    apart = [np.hypot(*(line[:, :2] - p).T).min() for p in beside]
    assert max(apart) < 0.011  # half a step of 0.02 m, and a millimetre
    assert np.hypot(*(line[-1, :2] - beside[-1])) < 0.005
    assert line[-1, 2] == pytest.approx(psi[-1], abs=1e-4)
    turned = 150.0 / 350.0 * (1.0 - offset / 350.0)
    curve = [p for p in params.tracks[row].line.segments if p.curvature_start == p.curvature_end]
    round_one = next(p for p in curve if p.curvature_start)
    assert round_one.curvature_start == pytest.approx(1.0 / (350.0 - offset), rel=1e-12)
    assert round_one.length == pytest.approx(350.0 * turned, rel=1e-12)


def test_standing_cars_come_behind_the_train(bend):
    params = bend.to_params()
    assert (len(params.cars), params.n_train) == (7, 3)
    assert params.cut_numbers == (0, 0, 0, 1, 1, 1, 2)
    assert bend.car_types == ("own",) * 7
    assert bend.totals.cars == bend.n_cars == 3
    hands = [car.brakes[0].hand for car in params.cars[3:]]
    assert hands[0] == hands[1] > 0.0 == hands[2] == hands[3]
    assert all(car.brakes[0].force == 0.0 for car in params.cars[3:])
    assert [car.mass for car in params.cars[3:]] == [68e3, 68e3, 30e3, 68e3]
    assert params.cars[5].contents == "scrap"
    assert params.alone.cars == params.cars[:3] and not params.alone.standing


def test_the_resolved_scenario_is_the_same_without_its_types(bend):
    again = loads_scenario(bend.to_yaml())
    assert again.hash == bend.hash
    assert again.to_params() == bend.to_params()
    assert from_plain(TrainParams, to_plain(bend.to_params())) == bend.to_params()


def test_what_cannot_be_meant_is_refused_by_its_field():
    cases = {
        ("track: loop", "track: lop"): r"site.standing.0.track: .*'lop'.* 'loop'",
        ("offset_m: 4.5", "offset_m: 0.8"): r"site.standing.0.position_m: car \d of the cut",
        ("position_m: 300", "position_m: 40"): r"site.standing.0.position_m: .*beyond the track",
        ("to_m: 500", "to_m: 900"): r"site.tracks.0.to_m: .*beyond the alignment",
        ("from_m: 30, to_m: 500", "from_m: 500, to_m: 30"): r"site.tracks.0.to_m: .*above from_m",
        ("offset_m: 4.5, from_m: 30", "offset_m: 4.5"): r"site.tracks.0.from_m: is required",
        ("name: right", "name: loop"): r"site.tracks.1.name: there is a 'loop' already",
        ("offset_m: -6", "offset_m: 349"): r"site.tracks.1.offset_m: .*radius",
        ("[{tangent: {length_m: 200}}]", "[{}]"): r"site.tracks.2.alignment.0: .*exactly one",
        ("start_y_m: 40", "offset_m: 3"): r"site.tracks.2: .*exactly one of offset_m and",
        ("consist: [{car: own}]", "consist: [{car: owl}]"): r"site.standing.1.consist.0.car",
        ("speed_kmh: 50", "speed_kmh: 50\n  virtual_from: 2"): r"site.standing: .*virtual_from",
    }
    for (before, after), told in cases.items():
        assert BEND.count(before) == 1, before
        with pytest.raises(ScenarioError, match=told):
            loads_scenario(BEND.replace(before, after))


def test_a_second_track_comes_from_a_map(tmp_path, bend):
    line = bend.to_params().tracks[0].line
    points = along(line, 10.0)[0][:, :2]
    feature = {
        "type": "Feature",
        "geometry": {"type": "LineString", "coordinates": points.round(4).tolist()},
        "properties": {"role": "second_track", "name": "loop"},
    }
    data = {"type": "FeatureCollection", "features": [feature]}
    (tmp_path / "lines.geojson").write_text(json.dumps(data))
    given = "    - {name: loop, offset_m: 4.5, from_m: 30, to_m: 500}\n"
    assert given in BEND
    place = "site:\n  file: lines.geojson\n  reference_system: local\n"
    text = BEND.replace(given, "").replace("site:\n", place)
    (tmp_path / "there.yaml").write_text(text.replace("position_m: 300", "position_m: 270"))
    found = load_scenario(tmp_path / "there.yaml")
    fitted = found.to_params().tracks[0]
    assert fitted.name == "loop" and len(fitted.line.segments) == 5
    dense = along(fitted.line, 0.02)[0][:, :2]
    assert max(np.hypot(*(dense - p).T).min() for p in points) < 0.02
    assert any("5 pieces of track" in note for note in found.warnings)
    feature["geometry"] = {"type": "Polygon", "coordinates": [[[0, 0], [9, 0], [9, 9], [0, 0]]]}
    (tmp_path / "lines.geojson").write_text(json.dumps(data))
    with pytest.raises(ScenarioError, match=r"feature 1 \(loop\).*LineString"):
        load_scenario(tmp_path / "there.yaml")


def test_cars_stand_clear_at_any_angle_to_the_main_track():
    text = BEND.replace("start_heading_rad: 0.5", "start_heading_rad: 1.2")
    with pytest.raises(ScenarioError, match=r"site.standing.1.position_m: .*main track"):
        # it crosses the main track
        loads_scenario(text.replace("start_y_m: 40", "start_y_m: -78"))


def test_the_shipped_one_stands_beside_the_train():
    params = load_scenario("cars_on_a_siding").to_params()
    assert params.n_train == 40 and len(params.cars) == 52
    assert params.tracks[0].line.start_y == 4.5
    assert math.isclose(params.standing[0].position, 180.0)
