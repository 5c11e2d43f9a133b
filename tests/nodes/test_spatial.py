"""A run in three dimensions in the node: poses, frames, markers, events and its recording."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rclpy")
pytest.importorskip("derail_msgs")
pytest.importorskip("mujoco")
pytest.importorskip("simulation_interfaces")

from geometry_msgs.msg import Vector3
from nav_msgs.msg import Odometry
from sensor_msgs.msg import Imu
from simulation_interfaces import srv
from simulation_interfaces.msg import Bounds, EntityFilters

from derail_ros.cli import main
from derail_ros.nodes.serving import snake
from derail_ros.recording import read_manifest
from derail_ros.recording.reader import read_bag
from derail_ros.vocabulary.params import GRAVITY
from derail_ros.vocabulary.shapes import WIDER, height_of, kind_of
from tests.nodes.graph import DEEP, graph
from tests.nodes.support import small

pytestmark = pytest.mark.ros

SCENARIO = """\
version: 1
title: Three cars, the last one pushed over
train: {speed_kmh: 20, consist: [{car: box_car, count: 3}]}
initiation:
  derailed_trucks: [{car: 3, truck: both}]
  lateral_force_N: 400e3
  lateral_force_duration_s: 2.0
  lateral_force_car: 3
  lateral_force_place: centre
integration: {time_limit_s: 3.0}
"""


def turned(quaternion, vector):
    """A vector of the body's frame in space; quaternion x, y, z, w."""
    u, w = np.array(quaternion[:3]), quaternion[3]
    return vector + 2.0 * np.cross(u, np.cross(u, vector) + w * np.array(vector))


def numbers(pose):
    """Place and quaternion of a message."""
    p, q = (getattr(pose, k) for k in (("position", "orientation") if hasattr(pose, "position")
                                       else ("translation", "rotation")))  # fmt: skip
    return np.array([p.x, p.y, p.z]), np.array([q.x, q.y, q.z, q.w])


def call(made, name, **fields):
    """Call a service of the standard."""
    client = made.node.create_client(getattr(srv, name), f"/simulator/{snake(name)}")
    made.until(client.service_is_ready, f"{name} is there")
    future = client.call_async(getattr(srv, name).Request(**fields))
    made.until(future.done, f"{name} answers")
    made.node.destroy_client(client)
    return future.result()


def near(made, kind, place):
    """Entities within 0.1 m of a place."""
    x, y, z = place.tolist()
    points = [Vector3(x=x, y=y, z=z), Vector3(x=0.1)]
    if kind == Bounds.TYPE_BOX:
        points = [Vector3(x=x + d, y=y + d, z=z + d) for d in (0.1, -0.1)]
    filters = EntityFilters(bounds=Bounds(type=kind, points=points))
    return list(call(made, "GetEntities", filters=filters).entities)


def leaning(arrays):
    """How far the upward axis of car 3's marker lies in the plane at most."""
    markers = [m for array in arrays for m in array.markers]
    boxes = [numbers(m.pose)[1] for m in markers if m.ns == "cars" and m.id == 3]
    return max((np.hypot(*turned(turn, [0.0, 0.0, 1.0])[:2]) for turn in boxes), default=0.0)


def test_a_car_rolls_over_in_the_node(tmp_path, capsys) -> None:
    (tmp_path / "over.yaml").write_text(SCENARIO)
    with graph(tmp_path) as made:
        simulator = made.simulator(
            ready=False,
            scenario="over",
            scenario_dirs=f"['{tmp_path}']",
            model="spatial",
            speed_factor=0.0,
            await_listeners=1,
            marker_rate=20.0,
            record=tmp_path / "own",
            odometry="3",
            imu="3",
            **DEEP,
        )
        heard = made.listen("train_state", "car_poses", "/tf", "markers", "events", "outcome")
        for name, kind in (("odometry", Odometry), ("imu_body", Imu)):
            take = heard.setdefault(f"car_3/{name}", []).append
            made.node.create_subscription(kind, f"car_3/{name}", take, 100)
        made.until(lambda: any(m.is_final for m in heard["outcome"]), "the run ends", simulator)
        last = next(m for m in heard["outcome"] if m.is_final).header.stamp
        for topic in ("train_state", "car_poses"):
            made.until(lambda t=topic: any(m.header.stamp == last for m in heard[t]), topic)
        made.until(
            lambda: any(t.header.stamp == last for m in heard["/tf"] for t in m.transforms), "/tf"
        )
        made.until(lambda: leaning(heard["markers"]) > 0.9, "a marker of the car on its side")
        for topic in ("car_3/odometry", "car_3/imu_body"):
            made.until(lambda t=topic: any(m.header.stamp == last for m in heard[t]), topic)
        entity = numbers(call(made, "GetEntityState", entity="car_3").state.pose)
        bounds = call(made, "GetEntityBounds", entity="car_3").bounds
        # the upper edge of the car's end lies in the ball and in the box, what is above does not
        edge = entity[0] + turned(entity[1], [6.0, 0.0, 4.0])
        over = entity[0] + [0.0, 0.0, 4.0]
        for kind in (Bounds.TYPE_SPHERE, Bounds.TYPE_BOX):
            assert near(made, kind, edge) == ["car_3"] and near(made, kind, over) == []
        assert simulator.end() == 0, simulator.output
    assert "Traceback" not in simulator.output
    outcome = next(m for m in heard["outcome"] if m.is_final)
    measures = {q.key: list(q.values) for q in outcome.measures}
    assert measures["cars_on_side"] == [1.0]
    fell = next(e for e in heard["events"] if e.kind_name == "car_on_side")
    assert list(fell.cars) == [3] and fell.z < 2.5

    state = max(heard["train_state"], key=lambda m: m.time)
    assert abs(state.roll[2]) > 1.4 and abs(state.roll[0]) < 0.05 and state.z[2] < -0.3
    stamp = (state.header.stamp.sec, state.header.stamp.nanosec)
    (poses,) = (
        m.poses
        for m in heard["car_poses"]
        if (m.header.stamp.sec, m.header.stamp.nanosec) == stamp
    )
    place, turn = numbers(poses[2])
    up = turned(turn, [0.0, 0.0, 1.0])
    assert up[2] == pytest.approx(np.cos(state.roll[2]) * np.cos(state.pitch[2]), abs=1e-9)
    # the frame of a car stands below its centre of gravity, wherever that turns
    car = small(SCENARIO).to_params().cars[2]
    height = height_of(car)
    centre = np.array([state.x[2], state.y[2], state.z[2] + height])
    frames = {t.child_frame_id: t for m in heard["/tf"] for t in m.transforms
              if t.header.stamp == state.header.stamp}  # fmt: skip
    below, same = numbers(frames["car_3"].transform)
    assert same.tolist() == turn.tolist() and below.tolist() == place.tolist()
    assert below + turned(turn, [0.0, 0.0, height]) == pytest.approx(centre)
    odometry = heard["car_3/odometry"][-1]
    assert [n.tolist() for n in numbers(odometry.pose.pose)] == [below.tolist(), turn.tolist()]
    assert entity[0].tolist() == below.tolist() and entity[1].tolist() == turn.tolist()
    # the box of the entity holds the body, which is wider and taller than in the plane
    upper, lower = ([p.x, p.y, p.z] for p in bounds.points)
    kind = kind_of(car.name)
    assert upper[1] >= 0.5 * (car.width + WIDER) and upper[2] >= kind.top
    assert lower[2] == 0.0 and lower[1] == -upper[1]
    # the specific force of a car on its side points across it
    felt = heard["car_3/imu_body"][-1].linear_acceleration
    assert abs(felt.y) > 0.8 * GRAVITY > 2.0 * abs(felt.z)
    accelerations = [np.abs([m.az, m.roll_acceleration, m.pitch_acceleration]).max(axis=1)
                     for m in heard["train_state"]]  # fmt: skip
    assert (np.max(accelerations, axis=0) > 0.1).all()

    (entry,) = read_manifest(tmp_path / "own").runs
    assert entry.model == "spatial" and entry.outcome["cars_on_side"] == 1.0
    own = read_bag(tmp_path / "own")
    assert own.cars.gravity_height[2] == height
    assert own.pose[-1, 2, 3] == pytest.approx(state.roll[2], abs=1e-6)
    assert main(["replay", str(tmp_path / "own")]) == 0
    assert "differ" not in capsys.readouterr().out


PLACE = """\
version: 1
title: A car pushed against a wall, another that stands on a siding
train: {speed_kmh: 30, consist: [{car: box_car, count: 2}]}
initiation:
  derailed_trucks: [{car: 1, truck: both}]
  lateral_force_N: 300e3
  lateral_force_duration_s: 2.0
site:
  tracks: [{name: siding, offset_m: -6, from_m: -150, to_m: 150}]
  standing: [{track: siding, position_m: -60, consist: [{car: box_car}]}]
  fixed: [{name: wall, outline_along_m: [[-40, 4], [90, 4]], height_m: 3}]
  zones: [{name: berm, outline_along_m: [[-40, 5], [90, 5], [90, 12], [-40, 12]], rise_percent: 30,
           uphill_deg: 90}]
integration: {time_limit_s: 4.0}
"""


def test_a_place_in_three_dimensions_in_the_node(tmp_path, capsys) -> None:
    (tmp_path / "place.yaml").write_text(PLACE)
    with graph(tmp_path) as made:
        simulator = made.simulator(
            ready=False,
            scenario="place",
            scenario_dirs=f"['{tmp_path}']",
            model="spatial",
            speed_factor=0.0,
            await_listeners=1,
            marker_rate=20.0,
            record=tmp_path / "own",
            **DEEP,
        )
        heard = made.listen("collisions", "outcome", "track_markers", "train_state")
        made.until(lambda: any(m.is_final for m in heard["outcome"]), "the run ends", simulator)
        made.until(lambda: heard["track_markers"], "the place's markers")
        made.until(lambda: any(c.object == "wall" for c in heard["collisions"]), "the wall")
        assert simulator.end() == 0, simulator.output
    assert "Traceback" not in simulator.output
    blow = next(c for c in heard["collisions"] if c.object == "wall")
    assert blow.peak_force > 1e4 and 0.0 < blow.z < 3.0 and abs(blow.y - 4.0) < 0.8
    texts = {m.text for array in heard["track_markers"] for m in array.markers}
    assert {"wall", "siding", "berm"} <= texts
    (entry,) = read_manifest(tmp_path / "own").runs
    struck = {row["name"]: row for row in entry.outcome["site"]["fixed"]}
    assert struck["wall"]["force_N"] == pytest.approx(
        max(c.peak_force for c in heard["collisions"] if c.object == "wall"), rel=1e-6
    )
    assert entry.outcome["standing_cars"] == 1 and entry.outcome["standing_moved"] == []
    assert main(["replay", str(tmp_path / "own")]) == 0
    assert "differ" not in capsys.readouterr().out
