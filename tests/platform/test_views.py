"""Configurations of RViz and Foxglove show topics and fields that exist."""

import json
import re
from pathlib import Path

import pytest
import yaml

from derail_ros.vocabulary.ledger import ENERGY_ENTRIES
from msg_adapters.topics import LIVE_TOPICS, TOPICS

ROOT = Path(__file__).resolve().parents[2]
POLICIES = {True: "Transient Local", False: "Volatile"}
DISPLAYS = {
    "rviz_default_plugins/MarkerArray": "visualization_msgs/msg/MarkerArray",
    "rviz_default_plugins/PoseArray": "geometry_msgs/msg/PoseArray",
    "rviz_default_plugins/RobotModel": "std_msgs/msg/String",
}


def test_rviz_subscribes_as_the_simulator_publishes():
    text = (ROOT / "config" / "derail_ros.rviz").read_text(encoding="utf-8")
    manager = yaml.safe_load(text)["Visualization Manager"]
    parameters = yaml.safe_load((ROOT / "config" / "simulator.yaml").read_text(encoding="utf-8"))
    frame = parameters["/**"]["ros__parameters"]["frame_id"]
    assert manager["Global Options"]["Fixed Frame"] == frame
    shown = set()
    for display in manager["Displays"]:
        place = display.get("Topic") or display.get("Description Topic")
        if place is None:
            continue
        topic = (TOPICS | LIVE_TOPICS)[place["Value"].removeprefix("/")]
        assert topic.msgtype == DISPLAYS[display["Class"]]
        assert place["Durability Policy"] == POLICIES[topic.latched]
        shown.add(topic.name)
    assert shown >= {"markers", "track_markers", "robot_description"}


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
        keyed = re.fullmatch(r'entries\[:\]\{key=="(\w+)"\}\.values\[0\]', field)
        if keyed is not None:
            assert message == "EnergyLedger" and keyed[1] in ENERGY_ENTRIES, path
            continue
        field, index = re.fullmatch(r"(\w+)(\[\d+\])?", field).groups()
        array = r"\[\]" if index else ""
        assert re.search(rf"^\w+{array} +{field} +#", text, re.MULTILINE), path
    for panel in panels.values():
        for line in panel.get("paths", []):
            index = re.search(r"(?<!values)\[(\d+)\]", line["value"])
            assert index is None or line["label"] == f"car {int(index[1]) + 1}"


def test_foxglove_looks_from_above_with_the_train_going_right():
    """In Foxglove's 2D view an angle theta of 90 degrees would turn x upwards."""
    layout = json.loads((ROOT / "config" / "derail_ros.foxglove.json").read_text("utf-8"))
    camera = layout["configById"]["3D!scene"]["cameraState"]
    assert (camera["perspective"], camera["phi"], camera["thetaOffset"]) == (False, 0, 0)


# Settings that Lichtblick 1.28, an open fork of Foxglove, declares for its panels (RendererConfig
# and CameraState, PlotConfig and PlotPath, RawMessagesPanelConfig): a name with its type, or the
# values that it can have. Of a name that is not there it takes no notice.
NUMBER = (int, float)
TITLES = {"foxglovePanelTitle": str, "lichtblickPanelTitle": str}
SETTINGS = {
    "3D": {
        "cameraState": dict,
        "followTf": str,
        "followMode": {"follow-pose", "follow-position", "follow-none"},
        "scene": dict,
        "publish": dict,
        "transforms": dict,
        "topics": dict,
        "layers": dict,
        "imageMode": dict,
    },
    "Plot": {
        "paths": list,
        "showLegend": bool,
        "legendDisplay": {"floating", "top", "left", "none"},
        "showPlotValuesInLegend": bool,
        "showXAxisLabels": bool,
        "showYAxisLabels": bool,
        "isSynced": bool,
        "xAxisVal": {"timestamp", "index", "custom", "currentCustom"},
        "sidebarDimension": NUMBER,
    },
    "RawMessages": {
        "diffEnabled": bool,
        "diffMethod": {"custom", "previous message"},
        "diffTopicPath": str,
        "expansion": {"all", "none"},
        "showFullMessageForDiff": bool,
        "topicPath": str,
    },
}
CAMERA = {
    "distance": NUMBER,
    "perspective": bool,
    "phi": NUMBER,
    "thetaOffset": NUMBER,
    "target": 3,
    "targetOffset": 3,
    "targetOrientation": 4,
    "fovy": NUMBER,
    "near": NUMBER,
    "far": NUMBER,
}
GRID = {
    "layerId": {"foxglove.Grid"},
    "instanceId": str,
    "label": str,
    "visible": bool,
    "frameLocked": bool,
    "size": NUMBER,
    "divisions": int,
    "lineWidth": NUMBER,
    "color": str,
    "position": 3,
    "rotation": 3,
    "order": int,
}
LINE = {
    "value": str,
    "label": str,
    "enabled": bool,
    "timestampMethod": {"receiveTime", "headerStamp"},
    "showLine": bool,
}


def check_settings(found, declared):
    """Hold settings against the declared ones: names, types, values, lengths of vectors."""
    for name, value in found.items():
        kind = declared[name]
        if isinstance(kind, set):
            assert value in kind, name
        elif isinstance(kind, int):
            assert len(value) == kind and all(isinstance(v, NUMBER) for v in value), name
        else:
            assert isinstance(value, kind), name


def test_foxglove_knows_the_settings_of_its_panels():
    layout = json.loads((ROOT / "config" / "derail_ros.foxglove.json").read_text("utf-8"))
    assert set(layout) == {
        "configById",
        "globalVariables",
        "userNodes",
        "playbackConfig",
        "layout",
    }
    for name, panel in layout["configById"].items():
        check_settings(panel, SETTINGS[name.partition("!")[0]] | TITLES)
        assert panel["foxglovePanelTitle"] == panel["lichtblickPanelTitle"] != ""
        for line in panel.get("paths", []):
            check_settings(line, LINE)
    scene = layout["configById"]["3D!scene"]
    assert set(scene["cameraState"]) == set(CAMERA)
    check_settings(scene["cameraState"], CAMERA)
    for name, layer in scene["layers"].items():
        check_settings(layer, GRID)
        assert layer["instanceId"] == name
    assert all(settings.keys() == {"visible"} for settings in scene["topics"].values())

    def splits(node):
        if isinstance(node, dict):
            assert node["direction"] in ("row", "column") and 0 < node["splitPercentage"] < 100
            splits(node["first"])
            splits(node["second"])

    splits(layout["layout"])


def test_lines_over_header_stamps_are_of_messages_with_a_header():
    layout = json.loads((ROOT / "config" / "derail_ros.foxglove.json").read_text("utf-8"))
    for panel in layout["configById"].values():
        for line in panel.get("paths", []):
            package, _, message = TOPICS[line["value"][1:].partition(".")[0]].msgtype.split("/")
            text = (ROOT / package / "msg" / f"{message}.msg").read_text(encoding="utf-8")
            assert re.search(r"^std_msgs/Header +header\b", text, re.MULTILINE), message


def test_legends_stand_beside_the_lines_and_show_their_names():
    """As seen in Lichtblick: a floating legend lies on the lines, a narrow one cuts its names."""
    layout = json.loads((ROOT / "config" / "derail_ros.foxglove.json").read_text("utf-8"))
    plots = [p for name, p in layout["configById"].items() if name.startswith("Plot!")]
    assert len(plots) == 3
    for panel in plots:
        assert (panel["showLegend"], panel["legendDisplay"]) == (True, "left")
        # In pixels. Values would need more room; they are shown at the cursor.
        longest = max(len(line["label"]) for line in panel["paths"])
        assert panel["sidebarDimension"] >= 70 + 7 * longest
        assert panel["showPlotValuesInLegend"] is False
