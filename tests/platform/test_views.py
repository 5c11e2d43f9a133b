"""Configurations of RViz and Foxglove show topics and fields that exist."""

import json
import re
from pathlib import Path

import pytest
import yaml

from msg_adapters.topics import TOPICS

ROOT = Path(__file__).resolve().parents[2]
POLICIES = {True: "Transient Local", False: "Volatile"}
DISPLAYS = {
    "rviz_default_plugins/MarkerArray": "visualization_msgs/msg/MarkerArray",
    "rviz_default_plugins/PoseArray": "geometry_msgs/msg/PoseArray",
}


def test_rviz_subscribes_as_the_simulator_publishes():
    text = (ROOT / "config" / "derail_ros.rviz").read_text(encoding="utf-8")
    manager = yaml.safe_load(text)["Visualization Manager"]
    parameters = yaml.safe_load((ROOT / "config" / "simulator.yaml").read_text(encoding="utf-8"))
    frame = parameters["/**"]["ros__parameters"]["frame_id"]
    assert manager["Global Options"]["Fixed Frame"] == frame
    shown = set()
    for display in manager["Displays"]:
        if "Topic" not in display:
            continue
        topic = TOPICS[display["Topic"]["Value"].removeprefix("/")]
        assert topic.msgtype == DISPLAYS[display["Class"]]
        assert display["Topic"]["Durability Policy"] == POLICIES[topic.latched]
        shown.add(topic.name)
    assert shown >= {"markers", "track_markers"}


def test_foxglove_shows_fields_that_exist():
    layout = json.loads((ROOT / "config" / "derail_ros.foxglove.json").read_text("utf-8"))
    panels = layout["configById"]

    def leaves(node):
        return {node} if isinstance(node, str) else leaves(node["first"]) | leaves(node["second"])

    assert leaves(layout["layout"]) == set(panels)
    paths = list(panels["3D!scene"]["topics"])
    for panel in panels.values():
        paths += [line["value"] for line in panel.get("paths", [])]
        paths += [panel["topicPath"]] if "topicPath" in panel else []
    assert len(paths) > 10
    for path in paths:
        name, _, field = path.removeprefix("/").partition(".")
        package, _, message = TOPICS[name].msgtype.split("/")
        if not field:
            continue
        if package != "derail_msgs":
            pytest.fail(f"{path}: only fields of derail_msgs are known here")
        text = (ROOT / package / "msg" / f"{message}.msg").read_text(encoding="utf-8")
        field, index = re.fullmatch(r"(\w+)(\[\d+\])?", field).groups()
        array = r"\[\]" if index else ""
        assert re.search(rf"^\w+{array} +{field} +#", text, re.MULTILINE), path
    for panel in panels.values():
        for line in panel.get("paths", []):
            index = re.search(r"\[(\d+)\]", line["value"])
            assert index is None or line["label"] == f"car {int(index[1]) + 1}"


def test_foxglove_looks_from_above_with_the_train_going_right():
    """In Foxglove's 2D view an angle theta of 90 degrees would turn x upwards."""
    layout = json.loads((ROOT / "config" / "derail_ros.foxglove.json").read_text("utf-8"))
    camera = layout["configById"]["3D!scene"]["cameraState"]
    assert (camera["perspective"], camera["phi"], camera["thetaOffset"]) == (False, 0, 0)
