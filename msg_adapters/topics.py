"""The topics of the simulator: one table for publishers, recordings and documentation."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Any

from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)


@dataclass(frozen=True)
class Topic:
    """A topic of the simulator.

    Attributes
    ----------
    name : relative topic name (absolute for those that belong to the whole graph)
    msgtype : type of its messages
    depth : depth of its history
    latched : transient local: a late subscriber gets the last ``depth`` messages
    when : when it is sent
    recorded : part of a recording made by the simulator itself
    """

    name: str
    msgtype: str
    depth: int
    latched: bool
    when: str
    recorded: bool = True


STATE_RATE = "`state_rate`, 50 Hz of simulation time"

TOPICS: dict[str, Topic] = {
    topic.name: topic
    for topic in (
        # Latched ones first: in a recording they then come before what they explain.
        Topic("consist", "derail_msgs/msg/Consist", 1, True, "on load and reset"),
        Topic("track", "derail_msgs/msg/Track", 1, True, "on load, reset and a new break"),
        Topic(
            "track_markers",
            "visualization_msgs/msg/MarkerArray",
            1,
            True,
            "on load, reset and a new break",
        ),
        Topic("events", "derail_msgs/msg/TrainEvent", 5000, True, "as they happen, in order"),
        Topic(
            "collisions",
            "derail_msgs/msg/Collision",
            5000,
            True,
            "at the peak and, final, at the end of each contact",
        ),
        Topic(
            "outcome", "derail_msgs/msg/Outcome", 1, True, "1 Hz of simulation time, at the end"
        ),
        Topic("car_poses", "geometry_msgs/msg/PoseArray", 10, False, STATE_RATE),
        Topic("train_state", "derail_msgs/msg/TrainState", 10, False, STATE_RATE),
        Topic("coupler_states", "derail_msgs/msg/CouplerStates", 10, False, STATE_RATE),
        Topic("energy", "derail_msgs/msg/EnergyLedger", 10, False, STATE_RATE),
        Topic("command_log", "derail_msgs/msg/CommandLog", 100, False, "on each command"),
        Topic(
            "markers",
            "visualization_msgs/msg/MarkerArray",
            1,
            False,
            "`marker_rate`, 15 Hz: wall time when live, simulation time in recordings",
        ),
        Topic(
            "/clock",
            "rosgraph_msgs/msg/Clock",
            1,
            False,
            "`clock_rate`, 100 Hz of wall time, also while paused; not by a second simulator",
            recorded=False,
        ),
        Topic(
            "/diagnostics",
            "diagnostic_msgs/msg/DiagnosticArray",
            10,
            False,
            "1 Hz of wall time",
            recorded=False,
        ),
    )
}

EVERYWHERE = ("/clock", "/diagnostics", "/parameter_events", "/rosout", "/tf", "/tf_static")
"""Topics that belong to the whole graph."""

STATE_TOPICS = ("car_poses", "train_state", "coupler_states", "energy")
"""Topics sent at each tick."""

MANIFEST = Topic("manifest", "std_msgs/msg/String", 1, True, "first and last in a recording")
"""Topic of a recording, not of the node: where it comes from, as JSON."""


TRANSFORMS = Topic(
    "/tf", "tf2_msgs/msg/TFMessage", 100, False, f"{STATE_RATE}; with `publish_tf`", False
)
ON_MAP = Topic(
    "geojson",
    "foxglove_msgs/msg/GeoJSON",
    1,
    True,
    "on load and reset, and at the end; from the first scenario with `site.datum` on",
    False,
)
LIVE_TOPICS = {
    topic.name: topic
    for topic in (
        Topic("robot_description", "std_msgs/msg/String", 1, True, "on load and reset", False),
        Topic("/tf_static", "tf2_msgs/msg/TFMessage", 1, True, "on load and reset", False),
        Topic("joint_states", "sensor_msgs/msg/JointState", 10, False, STATE_RATE, False),
        TRANSFORMS,
        ON_MAP,
    )
}
"""Topics that recordings of the simulator hold only if asked, for they follow from those above."""
SENSOR_TOPICS = {
    name: Topic(f"car_N/{name}", msgtype, 100, False, f"`{kind}_rate`; cars of `{kind}`", False)
    for name, msgtype, kind in (
        ("odometry", "nav_msgs/msg/Odometry", "odometry"),
        ("imu_body", "sensor_msgs/msg/Imu", "imu"),
        ("imu_front_truck", "sensor_msgs/msg/Imu", "imu"),
        ("imu_rear_truck", "sensor_msgs/msg/Imu", "imu"),
        ("fix", "sensor_msgs/msg/NavSatFix", "navsat"),
        ("wheel_speed", "geometry_msgs/msg/TwistStamped", "wheel_speed"),
        ("brake_pipe_pressure", "sensor_msgs/msg/FluidPressure", "pipe_pressure"),
    )
}
"""Topics of the sensors of car N by their last names; recordings hold them only if asked. The
depth is half a second of the fastest usual ones."""


def topic_named(name: str) -> Topic | None:
    """A topic of the simulator by its relative name, such as ``car_5/odometry``, or None."""
    known = TOPICS.get(name) or LIVE_TOPICS.get(name)
    found = re.fullmatch(r"car_[1-9]\d*/(\w+)", name)
    if known is None and found is not None and (sensor := SENSOR_TOPICS.get(found[1])):
        return replace(sensor, name=name)
    return known


def bag_qos(topic: Topic) -> Qos:
    """What a recording says of the topic's quality of service, so that a player latches it."""
    unlimited = QosTime(9223372036, 854775807)  # RMW_DURATION_INFINITE
    return Qos(
        QosHistory.KEEP_LAST,
        topic.depth,
        QosReliability.RELIABLE,
        QosDurability.TRANSIENT_LOCAL if topic.latched else QosDurability.VOLATILE,
        unlimited,
        unlimited,
        QosLiveliness.AUTOMATIC,
        unlimited,
        False,
    )


def rclpy_qos(topic: Topic, depth: int | None = None) -> Any:
    """The quality of service as ``rclpy`` wants it."""
    from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=topic.depth if depth is None else depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=(
            DurabilityPolicy.TRANSIENT_LOCAL if topic.latched else DurabilityPolicy.VOLATILE
        ),
    )


def rclpy_class(msgtype: str) -> Any:
    """The class of a message type in the installed ROS."""
    import importlib

    package, kind, name = msgtype.split("/")
    return getattr(importlib.import_module(f"{package}.{kind}"), name)


def check_interfaces() -> None:
    """Hold the installed ROS messages against the definitions that messages are made from.

    Raises
    ------
    RuntimeError
        If ``derail_msgs`` is missing or of another version.
    """
    from msg_adapters.definitions import field_names

    for topic in TOPICS.values():
        try:
            installed = list(rclpy_class(topic.msgtype).get_fields_and_field_types())
        except (ImportError, AttributeError) as error:
            raise RuntimeError(f"{topic.msgtype} is not installed: {error}") from error
        if installed != field_names(topic.msgtype):
            raise RuntimeError(
                f"the installed {topic.msgtype} is of another version: build derail_msgs again"
            )
