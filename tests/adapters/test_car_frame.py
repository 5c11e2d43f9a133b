"""The frame of a car: one place and one motion in transforms, poses, odometry and sensors."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from derail_ros.vocabulary.params import GRAVITY
from derail_ros.vocabulary.place import Datum
from derail_ros.vocabulary.sample import Sample
from msg_adapters import common, sensors
from msg_adapters.car_frame import axes, heights, motion, places
from msg_adapters.definitions import deserialize
from msg_adapters.frames import TransformEncoder
from msg_adapters.state import PoseEncoder
from tests.nodes.support import simulation

CONTEXT = common.RunContext("run-1", base=7_000_000_000, frame_id="map")
HEIGHT = np.array([1.8, 2.2])
SWING = np.array(
    [[3.0, -1.0, 0.4, 1.2, 0.3, 2.0], [0.5, 2.0, -0.3, -1.9, -0.4, -0.8]]
)  # amplitudes
PACE = np.array([0.7, 1.1, 1.9, 1.3, 2.3, 0.9])


def moving(t: float) -> Sample:
    """Two cars that turn about all axes at once: every coordinate swings as a sine."""
    sin, cos = np.sin(PACE * t), np.cos(PACE * t)
    return Sample.make(
        t, 0, SWING * sin, velocity=SWING * PACE * cos, acceleration=-SWING * PACE**2 * sin
    )


def lying() -> Sample:
    """Cars at rest, the first one on its left side."""
    run = simulation()
    pose = run.sample().pose.copy()
    pose[0] = (50.7, -1.5, -0.6, np.radians(-91.0), 0.02, 0.3)
    return Sample.make(3.0, 0, pose)


def read(sensor: sensors.Sensor, sample: Sample):
    return deserialize(sensor(sample), sensor.msgtype)


def xyz(part) -> list[float]:
    return [part.x, part.y, part.z]


def xyzw(part) -> list[float]:
    return [part.x, part.y, part.z, part.w]


def test_the_motion_is_the_change_of_the_place() -> None:
    t, h = 0.8, 1e-5
    before, now, after = (motion(moving(at), HEIGHT) for at in (t - h, t, t + h))
    assert (after.place - before.place) / (2 * h) == pytest.approx(now.velocity, abs=1e-6)
    growth = (after.velocity - before.velocity) / (2 * h)
    assert growth == pytest.approx(now.acceleration, abs=1e-6)
    assert (after.spin - before.spin) / (2 * h) == pytest.approx(now.spin_growth, abs=1e-6)
    # dR/dt = w x R, column by column
    turned = (after.axes - before.axes) / (2 * h)
    for k in range(3):
        assert np.cross(now.spin, now.axes[:, :, k]) == pytest.approx(turned[:, :, k], abs=1e-6)


def test_the_axes_are_those_of_the_quaternions() -> None:
    sample = moving(0.8)
    for turn, (x, y, z, w) in zip(axes(sample.pose), sample.quaternions):
        u = np.array([x, y, z])
        for k, vector in enumerate(np.eye(3)):
            turned = vector + 2.0 * np.cross(u, np.cross(u, vector) + w * vector)
            assert turn[:, k] == pytest.approx(turned, abs=1e-12)


def test_the_mass_centre_stands_over_the_origin_in_the_car() -> None:
    sample = moving(0.8)
    up, level = np.array([0.0, 0.0, 1.0]), HEIGHT
    centre = places(sample.pose, HEIGHT) + HEIGHT[:, None] * axes(sample.pose)[:, :, 2]
    assert centre == pytest.approx(sample.pose[:, :3] + level[:, None] * up)
    ahead = places(sample.pose, HEIGHT, 0.9, np.array([4.0, 5.0]))
    local = np.einsum("nji,nj->ni", axes(sample.pose), ahead - places(sample.pose, HEIGHT))
    assert local == pytest.approx(np.array([[4.0, 0.0, 0.9], [5.0, 0.0, 0.9]]))


def test_in_the_plane_nothing_changes() -> None:
    run = simulation()
    run.advance_to(3.0)
    sample, params = run.sample(), run.params
    assert (places(sample.pose, heights(params.cars)) == sample.pose[:, :3]).all()
    for i in range(run.n_cars):
        yaw, rate, growth = (a[i, 5] for a in (sample.pose, sample.velocity, sample.acceleration))
        c, s, along = np.cos(yaw), np.sin(yaw), params.cars[i].truck_distance
        turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        felt = turn @ sample.acceleration[i, :3] + [-(rate**2) * along, growth * along, GRAVITY]
        imu = read(sensors.Imu(sensors.Mount(i, params, CONTEXT), "front_truck"), sample)
        assert xyz(imu.linear_acceleration) == pytest.approx(felt, rel=1e-12, abs=1e-12)
        assert xyz(imu.angular_velocity) == [0.0, 0.0, rate]
        odometry = read(sensors.Odometry(sensors.Mount(i, params, CONTEXT)), sample)
        assert xyz(odometry.pose.pose.position) == sample.pose[i, :3].tolist()
        speed = turn @ sample.velocity[i, :3]
        assert xyz(odometry.twist.twist.linear) == pytest.approx(speed, rel=1e-12, abs=1e-12)


def test_poses_transforms_odometry_and_fixes_agree_of_a_car_on_its_side() -> None:
    params, sample = simulation().params, lying()
    data = TransformEncoder(params, CONTEXT)(sample)
    frames = {t.child_frame_id: t.transform for t in
              deserialize(data, "tf2_msgs/msg/TFMessage").transforms}  # fmt: skip
    poses = deserialize(PoseEncoder(params, CONTEXT)(sample), "geometry_msgs/msg/PoseArray").poses
    datum = Datum(43.5, -79.5, 0.0, 1.0)
    for i, pose in enumerate(poses):
        frame = frames[f"car_{i + 1}"]
        odometry = read(sensors.Odometry(sensors.Mount(i, params, CONTEXT)), sample)
        assert odometry.child_frame_id == f"car_{i + 1}"
        for other in (pose, odometry.pose.pose):
            assert xyz(other.position) == xyz(frame.translation)
            assert xyzw(other.orientation) == xyzw(frame.rotation)
        fix = read(sensors.NavSat(sensors.Mount(i, params, CONTEXT), datum), sample)
        there = datum.fix(*xyz(frame.translation))
        assert (fix.latitude, fix.longitude, fix.altitude) == tuple(there)
    # The origin lies beside the mass centre now: on the side of the wheels.
    assert abs(poses[0].position.y - sample.pose[0, 1]) > 1.0


def test_a_car_on_its_side_feels_its_weight_across() -> None:
    params, sample = simulation().params, lying()
    imu = read(sensors.Imu(sensors.Mount(0, params, CONTEXT)), sample)
    weight = GRAVITY * axes(sample.pose)[0].T @ [0.0, 0.0, 1.0]
    assert xyz(imu.linear_acceleration) == pytest.approx(weight)
    assert imu.linear_acceleration.y == pytest.approx(-GRAVITY, abs=0.02)
    assert abs(imu.linear_acceleration.z) < 0.2


def test_rates_of_turn_are_about_the_axes_of_the_car() -> None:
    run = simulation()
    pose, velocity = run.sample().pose.copy(), run.sample().velocity.copy()
    pose[0, 3:] = (np.pi / 2, 0.0, 0.7)
    velocity[0, 3:] = (0.0, 0.0, 0.4)  # yaws while on its side
    sample = dataclasses.replace(Sample.make(3.0, 0, pose), velocity=velocity)
    for name, kind in (("imu", sensors.Imu), ("odometry", sensors.Odometry)):
        message = read(kind(sensors.Mount(0, run.params, CONTEXT)), sample)
        rates = message.angular_velocity if name == "imu" else message.twist.twist.angular
        assert xyz(rates) == pytest.approx([0.0, 0.4, 0.0], abs=1e-12)
