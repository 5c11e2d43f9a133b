"""The engine in three dimensions through commands, recordings, views and worlds."""

import json
import xml.etree.ElementTree as ET

import mujoco
import numpy as np
import pytest

from derail_ros.cli import main
from derail_ros.recording.reader import read_bag
from derail_ros.review.scene import scene_at
from derail_ros.review.view3d import View
from derail_ros.review.world import Slab, World, bed, entered, ground_level, slopes

SCENARIO = """
version: 1
title: A tank car and three box cars
model: spatial
train:
  speed_kmh: 36
  consist: [{car: source_tank_12m44, count: 1, contents: toluene}, {car: box_car, count: 3}]
track: {rail_breaks: [0]}
integration: {time_limit_s: 15.0}
"""


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A recorded run, its folder and what the command said."""
    folder = tmp_path_factory.mktemp("spatial")
    (folder / "small.yaml").write_text(SCENARIO)
    assert main(["simulate", str(folder / "small.yaml"), "-o", str(folder / "out")]) == 0
    return folder / "out"


def said(capsys, *arguments):
    capsys.readouterr()
    assert main([str(a) for a in arguments]) == 0
    return capsys.readouterr().out


def test_an_ensemble_tells_of_the_third_dimension(recording, capsys):
    text = said(capsys, "simulate", recording.parent / "small.yaml", "--ensemble", 2, "--json")
    outcomes = json.loads(text)["outcomes"]
    for outcome in outcomes:
        assert outcome["cars_derailed"] >= 2
        assert 0 <= outcome["cars_on_side"] <= outcome["cars_derailed"]
        assert 3.0 < outcome["pile_height_m"] < 16.0
        assert outcome["real_time_factor"] > 0.0
    assert outcomes[0]["scene_length_m"] != outcomes[1]["scene_length_m"]


def test_the_model_is_chosen_on_the_command_line(recording, tmp_path, capsys):
    path = tmp_path / "planar.yaml"
    path.write_text(SCENARIO.replace("model: spatial\n", ""))
    report = json.loads(said(capsys, "simulate", path, "--model", "spatial", "--json"))
    assert report["model"] == "spatial" and report["outcomes"][0]["pile_height_m"] > 3.0
    report = json.loads(said(capsys, "simulate", path, "--json"))
    assert report["outcomes"][0]["pile_height_m"] is None


def test_a_recording_has_heights_and_is_repeated_to_the_bit(recording, capsys):
    run = read_bag(recording / "recording")
    assert run.model == "spatial"
    assert run.outcome.status == "at rest"
    fallen = run.pose[-1, run.derailed[-1], 2]
    assert (fallen < -0.05).any() and np.abs(run.pose[:, :, 3:5]).max() > 0.01
    assert run.outcome.values["pile_height_m"] > 3.0
    assert "differ" not in said(capsys, "replay", recording / "recording")
    said(capsys, "review", recording / "recording", "-o", recording / "review", "--no-figures")
    facts = json.loads((recording / "review" / "summary.json").read_text())
    assert facts["outcome"]["pile_height_m"] == pytest.approx(run.outcome.values["pile_height_m"])


def test_the_wreck_loads_in_mujoco_and_stays(recording, capsys):
    path = recording / "wreck.xml"
    assert "4 cars" in said(
        capsys, "export-world", recording / "recording", "-o", path, "--at", 0.0
    )
    said(capsys, "export-world", recording / "recording", "-o", path)
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    run = read_bag(recording / "recording")
    mass = run.cars.mass.sum()
    assert model.body_mass.sum() == pytest.approx(mass, rel=1e-6)
    mujoco.mj_forward(model, data)
    before = data.xpos.copy()
    mujoco.mj_step(model, data, nstep=1000)
    assert np.abs(data.xpos - before).max() < 0.1


def test_the_wreck_as_sdf_and_gltf(recording, capsys):
    bag = recording / "recording"
    said(capsys, "export-world", bag, "-o", recording / "wreck.sdf", "--format", "sdf")
    root = ET.parse(recording / "wreck.sdf").getroot()
    assert root.tag == "sdf" and root.get("version") == "1.9"
    # what SDFormat 1.9 requires of a world and of the elements used here
    required = {
        "world": ("physics", "gravity", "magnetic_field", "atmosphere", "scene"),
        "physics": ("max_step_size", "real_time_factor", "real_time_update_rate"),
        "scene": ("ambient", "background", "shadows"),
        "model": ("link",), "inertial": ("mass", "inertia"), "collision": ("geometry",),
        "visual": ("geometry",), "plane": ("normal", "size"), "box": ("size",),
        "capsule": ("radius", "length"), "light": ("direction",),
        "inertia": ("ixx", "iyy", "izz", "ixy", "ixz", "iyz"),
    }  # fmt: skip
    numbers = {"pose": 6, "gravity": 3, "ambient": 4, "diffuse": 4, "normal": 3, "direction": 3}
    for element in root.iter():
        for child in required.get(element.tag, ()):
            assert len(element.findall(child)) >= 1, (element.tag, child)
        if element.tag in numbers:
            assert len([float(v) for v in element.text.split()]) == numbers[element.tag]
        if element.tag in ("world", "model", "link", "collision", "visual", "light", "physics"):
            assert element.get("name")
    world = World.of(read_bag(bag), 1e9)
    models = root.findall("world/model")
    assert [m.get("name") for m in models] == ["ground", "car_1", "car_2", "car_3", "car_4"]
    for m, body in zip(models[1:], world.bodies, strict=True):
        link = m.find("link")
        assert float(link.find("inertial/mass").text) == pytest.approx(body.mass)
        assert len(link.findall("collision")) == len(link.findall("visual")) == 3
        assert len([float(v) for v in m.find("pose").text.split()]) == 6
        names = [e.get("name") for e in link if e.get("name")]
        assert len(set(names)) == len(names)
    assert root.find(".//capsule/radius") is not None
    said(capsys, "export-world", bag, "-o", recording / "wreck.glb", "--format", "gltf")
    import trimesh

    scene = trimesh.load(recording / "wreck.glb")
    assert len(scene.geometry) == 3 * 4 + 1 + 3  # cars, ground, track bed
    assert main(["export-world", str(bag), "-o", str(recording / "x"), "--format", "obj"]) == 2


def test_the_view_moves_cars_and_camera(recording):
    run = read_bag(recording / "recording")
    view = View(run, port=18080)
    try:
        assert view.address.startswith("http://127.0.0.1:")
        view.show(run.time[-1])
        at = {i: p for cars, h, _ in view.batches for i, p in zip(cars, h.batched_positions)}
        assert at[0][:2] == pytest.approx(run.pose[-1, 0, :2], abs=1e-3)
        for by in ("force", "contents", "speed", "state"):
            view.by.value = by
            view.show(run.time[-1])
        view.follow.value = 2
        view.numbered.value = True
        view.show(0.5 * run.time[-1])
        assert "derailed (spatial)" in view.clock.content
        before = view.time
        view.run_for(0.3)
        assert view.time > before
    finally:
        view.server.stop()


PLACE = (
    SCENARIO.replace("A tank car and three box cars", "Three box cars, a berm and a wall")
    + """
site:
  tracks: [{name: siding, offset_m: -5, from_m: -150, to_m: 150}]
  standing: [{track: siding, position_m: -60, consist: [{car: box_car}]}]
  fixed:
    - {name: wall, outline_along_m: [[-40, 6], [-10, 6], [60, 7]], height_m: 2.5}
    - {name: pier, closed: true, outline_along_m: [[70, 4], [72, 4], [72, 6], [70, 6]]}
  zones:
    - {name: berm, outline_along_m: [[-30, -8], [60, -8], [60, -14], [10, -11], [-30, -14]],
       rise_percent: 30, uphill_deg: 270}
"""
)


@pytest.fixture(scope="module")
def placed(tmp_path_factory):
    """A recorded run at a place."""
    folder = tmp_path_factory.mktemp("place")
    (folder / "place.yaml").write_text(PLACE)
    assert main(["simulate", str(folder / "place.yaml"), "-o", str(folder / "out")]) == 0
    return folder / "out"


def test_an_outcome_tells_of_its_place(placed, capsys):
    report = json.loads(said(capsys, "simulate", placed.parent / "place.yaml", "--json"))
    (outcome,) = report["outcomes"]
    assert [row["name"] for row in outcome["site"]["fixed"]] == ["wall", "pier"]
    assert [row["name"] for row in outcome["site"]["zones"]] == ["berm"]
    assert outcome["standing_cars"] == 1 and outcome["standing_moved"] == []
    assert any("no accident" in said for said in report["limits"])
    (assumed,) = (w for w in report["warnings"] if "assumed" in w)
    assert "pier" in assumed and "5 m" in assumed and "wall" not in assumed
    assert "differ" not in said(capsys, "replay", placed / "recording")


def test_a_place_is_part_of_worlds_and_views(placed, capsys):
    bag = placed / "recording"
    for form, name in (("mjcf", "w.xml"), ("sdf", "w.sdf"), ("gltf", "w.glb")):
        said(capsys, "export-world", bag, "-o", placed / name, "--format", form, "--at", 0.0)
    model = mujoco.MjModel.from_xml_path(str(placed / "w.xml"))
    names = [model.geom(k).name for k in range(model.ngeom)]
    assert sum(name.startswith("wall ") for name in names) == 2 + 4
    wedges = [k for k in range(model.ngeom) if names[k].startswith("slope ")]
    assert len(wedges) == 3  # a polygon of five corners, one of which bends inwards
    # the berm's crest: 6 m behind its foot, 0.3 times as high
    run = read_bag(bag)
    top = max(wedge[:, 2].max() for wedge in slopes(run))
    assert top == pytest.approx(ground_level(run) + 0.3 * 6.0)
    sides = [np.diff(wedge[:3, :2], axis=0) for wedge in slopes(run)]
    area = sum(0.5 * abs(np.linalg.det(pair)) for pair in sides)
    assert area == pytest.approx(90.0 * 6.0 - 0.5 * 90.0 * 3.0)
    siding = [slab for slab in bed(run, -100.0, 100.0) if slab.at[1] < -4.9]
    assert siding
    sdf = ET.parse(placed / "w.sdf").getroot()
    assert len(sdf.findall(".//collision[@name='wall_0_collision']")) == 1
    import trimesh

    assert {"wall 0", "slope 0"} <= set(trimesh.load(placed / "w.glb").geometry)
    view = View(run, port=18090)
    try:
        view.show(run.time[-1])
        own = int(run.derailed[-1][: run.cars.own].sum())
        assert f"{own} derailed" in view.clock.content
    finally:
        view.server.stop()


def test_a_wall_that_a_car_is_in_is_left_out_of_a_world(placed):
    run = read_bag(placed / "recording")
    whole = World.of(run, 0.0)
    x, y = run.pose[0, 0, :2]
    edge = Slab((20.0, 0.3, 2.0), (float(x), float(y) + 1.0, 1.0), 0.0, 0.1)
    far = Slab((20.0, 0.3, 2.0), (float(x), float(y) + 4.0, 1.0), 0.0, 0.1)
    scene = scene_at(run, 0.0)
    assert entered(edge, scene.corners()) and not entered(far, scene.corners())
    assert len(whole.walls) == 6
