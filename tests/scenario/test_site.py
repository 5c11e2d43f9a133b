"""The place of a scenario: outlines, GeoJSON in three reference systems, refusals."""

import hashlib
import json
import math

import pyproj
import pytest

from derail_ros.scenario import ScenarioError, load_scenario, loads_scenario
from derail_ros.vocabulary.place import Datum

TRAIN = """\
version: 1
title: a place
train: {speed_kmh: 60, consist: [{car: box_car, count: 3}]}
track: {rail_breaks: [30]}
site:
"""
DATUM = "  datum: {latitude_deg: 43.59, longitude_deg: -79.64, azimuth_deg: 70}\n"
PLACE = Datum(43.59, -79.64, 0.0, math.radians(70.0))

WALL = ((0.0, 6.0), (120.0, 7.5))
MUD = ((10.0, -3.0), (90.0, -3.0), (90.0, -40.0), (10.0, -40.0))


def feature(role, points, closed, **properties):
    ring = [list(p) for p in points]
    geometry = {
        "type": "Polygon" if closed else "LineString",
        "coordinates": [[*ring, ring[0]]] if closed else ring,
    }
    return {"type": "Feature", "geometry": geometry, "properties": {"role": role, **properties}}


def collection(convert=lambda x, y: (x, y), **more):
    features = [
        feature("fixed", [convert(*p) for p in WALL], False, name="wall", yields_at_kN=500),
        feature("zone", [convert(*p) for p in MUD], True, name="mud", factor=2),
        feature("area", [convert(*p) for p in MUD], True, name="school"),
    ]
    return {"type": "FeatureCollection", "features": features, **more}


def degrees(x, y):
    latitude, longitude, _ = PLACE.fix(x, y)
    return longitude, latitude


def written(tmp_path, data, site=DATUM):
    (tmp_path / "place.geojson").write_text(json.dumps(data))
    path = tmp_path / "there.yaml"
    path.write_text(f"{TRAIN}{site}  file: place.geojson\n")
    return path


def loaded(*args):
    return load_scenario(written(*args))


def refused(*args):
    with pytest.raises(ScenarioError) as error:
        loaded(*args)
    return str(error.value)


def same_outlines(site, tolerance):
    for part, points in ((site.fixed[0], WALL), (site.zones[0], MUD), (site.areas[0], MUD)):
        for got, wanted in zip(part.outline, points, strict=True):
            assert got == pytest.approx(wanted, abs=tolerance)


def test_the_frame_of_the_track_is_a_plane_that_touches_the_earth():
    for x, y in ((0.0, 0.0), (300.0, -40.0), (-2000.0, 900.0)):
        latitude, longitude, _ = PLACE.fix(x, y)
        assert PLACE.local(latitude, longitude) == pytest.approx((x, y), abs=1e-7)
        # by the geodesic on the ellipsoid, an independent code
        azimuth, _, far = pyproj.Geod(ellps="WGS84").inv(-79.64, 43.59, longitude, latitude)
        turn = math.radians(70.0 - azimuth)
        assert (far * math.cos(turn), far * math.sin(turn)) == pytest.approx(
            (x, y), abs=1e-6 + 8e-8 * (x * x + y * y)
        )


def test_the_same_place_in_three_reference_systems(tmp_path):
    same_outlines(
        loaded(tmp_path, collection(), "  reference_system: local\n").to_params().site, 0
    )
    by_degrees = loaded(tmp_path, collection(degrees)).to_params().site
    same_outlines(by_degrees, 1e-3)
    utm = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32617", always_xy=True)
    data = collection(lambda x, y: utm.transform(*degrees(x, y)))
    projected = loaded(tmp_path, data, f"{DATUM}  reference_system: EPSG:32617\n")
    same_outlines(projected.to_params().site, 1e-3)
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32617"}}
    same_outlines(loaded(tmp_path, {**data, "crs": crs}).to_params().site, 1e-3)
    (wall,) = by_degrees.fixed
    assert (wall.name, wall.closed, wall.force, wall.energy) == ("wall", False, 500e3, math.inf)
    (mud,) = by_degrees.zones
    assert (mud.c_s, mud.c_d, mud.c_v) == pytest.approx((1.6, 1.4, 0.06))


def test_a_site_file_travels_by_its_hash_and_a_resolved_scenario_needs_none(tmp_path):
    scenario = loaded(tmp_path, collection(degrees))
    content = (tmp_path / "place.geojson").read_bytes()
    assert scenario.files["place.geojson"] == content
    (wanted,) = scenario.model.inputs
    assert (wanted.file, wanted.sha256) == ("place.geojson", hashlib.sha256(content).hexdigest())
    again = loads_scenario(scenario.to_yaml(), scenario.name)
    assert again.hash == scenario.hash
    assert again.to_params() == scenario.to_params()


def test_a_scenario_from_text_opens_no_file(tmp_path, monkeypatch):
    written(tmp_path, collection(degrees))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ScenarioError, match="site.file: only goes with a scenario in a file"):
        loads_scenario(f"{TRAIN}{DATUM}  file: place.geojson\n")
    path = tmp_path / "there.yaml"
    for name in ("../place.geojson", "/etc/passwd", ".."):
        path.write_text(f"{TRAIN}{DATUM}  file: {name}\n")
        with pytest.raises(ScenarioError, match="must be the name of a file beside it"):
            load_scenario(path)


def test_zones_beside_the_track_slopes_and_presets():
    text = f"""{TRAIN}
  border_m: 1.0
  zones:
  - {{name: bank, outline_along_m: [[0, 2], [90, 2], [90, 9]], rise_percent: 40, uphill_deg: 90}}
  - {{name: soft, outline_m: [[0, 2], [90, 2], [90, 9]], preset: soil_highest}}
  - {{name: own, outline_m: [[0, 2], [90, 2], [90, 9]], c_s: 1.5, c_v_s_per_m: 0}}
"""
    site = loads_scenario(text).to_params().site
    bank, soft, own = site.zones
    assert bank.beside and not soft.beside and site.border == 1.0
    assert bank.rise == pytest.approx((0.0, 0.4))
    assert (bank.c_s, soft.c_s, soft.c_d, soft.c_v) == (0.8, 3.5, 3.5, 0.0)
    assert (own.c_s, own.c_d, own.c_v) == (1.5, 0.7, 0.0)


def bad(change):
    data = collection(degrees)
    change(data["features"])
    return data


def swap(points):
    return [p[::-1] for p in points]


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (
            lambda f: f[0]["properties"].update(role="wal"),
            "feature 1 (wall): has the unknown role",
        ),
        (lambda f: f[1]["properties"].pop("role"), "feature 2 (mud): has no role"),
        (lambda f: f[1]["properties"].update(factor=-1), "feature 2 (mud): factor"),
        (lambda f: f[2]["geometry"].update(type="Point"), "feature 3 (school): must be a Polygon"),
        (lambda f: f[1]["geometry"]["coordinates"].append([]), "feature 2 (mud): has a hole"),
        (lambda f: f[1]["geometry"]["coordinates"][0].pop(), "feature 2 (mud): the last vertex"),
        (
            lambda f: f[0]["geometry"]["coordinates"].insert(1, [1]),
            "(wall): vertex 2: must be two",
        ),
        (lambda f: f[0]["geometry"]["coordinates"].insert(1, [-79.64, "x"]), "(wall): vertex 2"),
        (lambda f: f[0]["geometry"]["coordinates"].pop(), "(wall): vertex 1: a line needs at"),
    ],
)
def test_bad_features_are_refused_by_feature_and_vertex(tmp_path, change, reason):
    message = refused(tmp_path, bad(change))
    assert message.startswith("place.geojson: ") and reason in message


def test_a_wrong_reference_system_is_refused(tmp_path):
    local = collection()
    assert "feature 1 (wall): vertex 1: lies" in refused(tmp_path, local)
    swapped = collection(lambda x, y: degrees(x, y)[::-1])
    assert "feature 1 (wall): vertex 1: lies" in refused(tmp_path, swapped)
    utm = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32617", always_xy=True)
    data = collection(lambda x, y: utm.transform(*degrees(x, y)))
    assert "is no longitude and latitude" in refused(tmp_path, data)
    assert "EPSG:99999 is no reference" in refused(
        tmp_path, data, f"{DATUM}  reference_system: EPSG:99999\n"
    )
    crs = {"type": "name", "properties": {"name": "EPSG:32618"}}
    site = f"{DATUM}  reference_system: EPSG:32617\n"
    assert "crs: is in EPSG:32618" in refused(tmp_path, {**data, "crs": crs}, site)
    assert "need site.datum" in refused(tmp_path, collection(degrees), "")
    assert "is no GeoJSON" in refused(tmp_path, [])
    exchanged = DATUM.replace("43.59", "-120.35").replace("-79.64", "50.7")
    assert "site.datum.latitude_deg: must be" in refused(tmp_path, collection(degrees), exchanged)
    lacking = DATUM.replace("latitude_deg: 43.59, ", "")
    assert "site.datum.latitude_deg: " in refused(tmp_path, collection(degrees), lacking)


@pytest.mark.parametrize(
    ("zone", "reason"),
    [
        ("outline_m: [[0, 0], [9, 9], [9, 0], [0, 9]]", "outline_m.2: the edge from here crosses"),
        ("outline_m: [[0, 0], [9, 9]]", "outline_m.1: a polygon needs at least 3"),
        ("outline_m: [[0, 0], [9, 0], [9, 0], [0, 9]]", "outline_m.2: repeats the vertex before"),
        ("outline_m: [[0, 0], [9, 0], [0, 9], [0, 0]]", "outline_m.3: is the first vertex"),
        ("outline_m: [[0, 0], [9, 0], [4, 0], [0, 9]]", "outline_m.1: the outline turns back"),
        ("outline_m: [[0, 0], [9e5, 0], [4, 9]]", "outline_m.1: lies 900 km"),
        ("factor: 2", "site.zones.0: must have exactly one of outline_m"),
        ("outline_m: [[0, 0], [9, 9], [9, 0]], factor: 2, preset: soil_lowest", "factor: cannot"),
        ("outline_m: [[0, 0], [9, 9], [9, 0]], rise_percent: 2", "uphill_deg: is required"),
        ("outline_m: [[0, 0], [9, 9], [9, 0]], facto: 2", "site.zones.0.facto"),
    ],
)
def test_bad_zones_are_refused(zone, reason):
    with pytest.raises(ScenarioError) as error:
        loads_scenario(f"{TRAIN}  zones: [{{name: a, {zone}}}]\n")
    assert reason in str(error.value)
