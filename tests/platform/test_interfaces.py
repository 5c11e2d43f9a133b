"""The definitions of derail_msgs: complete, commented, listed for the build, and importable."""

import importlib
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "derail_msgs"
DEFINITIONS = sorted([*FOLDER.glob("msg/*.msg"), *FOLDER.glob("srv/*.srv")])
MESSAGES = sorted(FOLDER.glob("msg/*.msg"))
STATES = {"TrainState", "CouplerStates", "EnergyLedger"}
SIMULATOR_SERVICES = {
    "LoadConsist",
    "InjectRailBreak",
    "TriggerEmergencyBrake",
    "SetSimulationState",
    "StepSimulation",
    "ResetSimulation",
    "GetEvents",
}
FIELD = re.compile(
    r"^(?P<type>[\w/]+)(?P<array>\[\])? +(?P<name>\w+)(?P<constant>=\S+)? *(# (?P<comment>.+))?$"
)
PLAIN = {"string", "bool"}  # need no unit


def fields(path: Path) -> list[re.Match]:
    """Return the fields and constants of a definition, and fail on a line it cannot read."""
    found = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        if not line.strip() or line.startswith("#") or line == "---":
            continue
        match = FIELD.match(line)
        assert match is not None, f"{path.name}:{number} has another form: {line}"
        found.append(match)
    return found


def names(path: Path) -> dict[str, str]:
    """Return the fields (no constants) of a definition, name to type."""
    return {f["name"]: f["type"] + (f["array"] or "") for f in fields(path) if not f["constant"]}


@pytest.mark.parametrize("path", DEFINITIONS, ids=lambda path: path.stem)
def test_every_field_has_an_explanation_and_every_number_a_unit(path):
    for field in fields(path):
        assert field["comment"], f"{path.name}: {field['name']} has no comment"
        number = re.fullmatch(r"u?int\d+|float\d+", field["type"])
        if number and not field["constant"]:
            unit = re.match(r"\[[^\]]+\]", field["comment"])
            assert unit, f"{path.name}: {field['name']} has no unit in brackets"


@pytest.mark.parametrize("path", DEFINITIONS, ids=lambda path: path.stem)
def test_every_definition_begins_with_its_purpose(path):
    assert re.match(r"# [A-Z].+", path.read_text(encoding="utf-8"))


PARTS = {"Quantity", "InputFile"}
"""Messages that are parts of others."""


@pytest.mark.parametrize(
    "path", [p for p in MESSAGES if p.stem not in PARTS], ids=lambda path: path.stem
)
def test_every_message_says_when_and_of_which_run(path):
    found = names(path)
    assert list(found)[:2] == ["header", "run_id"]
    assert found["header"] == "std_msgs/Header"
    assert found["run_id"] == "string"
    assert "uint8 INTERFACE_VERSION=2 " in path.read_text(encoding="utf-8")
    if path.stem in STATES:
        assert (found["step"], found["time"]) == ("uint64", "float64")


@pytest.mark.parametrize("service", sorted(SIMULATOR_SERVICES))
def test_every_answer_of_the_simulator_has_the_same_beginning(service):
    request, _, answer = (
        (FOLDER / "srv" / f"{service}.srv").read_text(encoding="utf-8").partition("\n---\n")
    )
    found = re.findall(r"^(\S+) +(\w+) +#", answer, re.MULTILINE)
    assert found[:4] == [
        ("bool", "success"),
        ("string", "message"),
        ("builtin_interfaces/Time", "applied_at"),
        ("uint64", "step"),
    ]
    if service != "GetEvents":
        assert re.search(r"^string caller ", request, re.MULTILINE)


def test_the_build_lists_every_definition_once():
    text = (FOLDER / "CMakeLists.txt").read_text(encoding="utf-8")
    listed = re.findall(r'^  "((?:msg|srv)/\w+\.(?:msg|srv))"$', text, re.MULTILINE)
    there = [path.relative_to(FOLDER).as_posix() for path in DEFINITIONS]
    assert listed == sorted(there)


def test_the_package_versions_agree():
    manifest = (FOLDER / "package.xml").read_text(encoding="utf-8")
    wheel = (FOLDER / "pyproject.toml").read_text(encoding="utf-8")
    version = re.search(r"<version>(.+)</version>", manifest)[1]
    assert re.search(rf'^version = "{re.escape(version)}"$', wheel, re.MULTILINE)
    assert version.split(".")[0] == "2"  # INTERFACE_VERSION


PLAYBACK = {  # as in rosbag2_interfaces
    "Pause": ([], []),
    "Resume": ([], []),
    "TogglePaused": ([], []),
    "IsPaused": ([], ["paused"]),
    "GetRate": ([], ["rate"]),
    "SetRate": (["rate"], ["success"]),
    "Seek": (["time"], ["success"]),
    "PlayNext": ([], ["success"]),
    "Burst": (["num_messages"], ["actually_burst"]),
    "Stop": ([], ["return_code", "error_string"]),
}


@pytest.mark.parametrize("service", sorted(PLAYBACK))
def test_playback_services_mirror_rosbag2(service):
    text = (FOLDER / "srv" / f"{service}.srv").read_text(encoding="utf-8")
    halves = text.split("---\n")
    found = tuple(re.findall(r"^[\w/]+ +(\w+) +#", half, re.MULTILINE) for half in halves)
    assert found == PLAYBACK[service]


# With ROS ----------------------------------------------------------------------------------


@pytest.mark.ros
@pytest.mark.parametrize("path", DEFINITIONS, ids=lambda path: path.stem)
def test_built_interfaces_have_the_fields_of_the_files(path):
    """The installed derail_msgs is that of this tree."""
    pytest.importorskip("rclpy")  # without ROS, derail_msgs is but the folder of that name
    module = importlib.import_module(f"derail_msgs.{path.parent.name}")
    built = getattr(module, path.stem)
    if path.suffix == ".msg":
        assert list(built.get_fields_and_field_types()) == list(names(path))
        return
    request, _, answer = path.read_text(encoding="utf-8").partition("---\n")
    for half, kind in ((request, built.Request), (answer, built.Response)):
        expected = re.findall(r"^[\w/]+(?:\[\])? +(\w+) +#", half, re.MULTILINE)
        assert list(kind.get_fields_and_field_types()) == expected


@pytest.mark.ros
def test_a_filled_state_survives_serialisation():
    """Bytes on the wire and back, arrays of numbers as arrays."""
    import array

    serialization = pytest.importorskip("rclpy.serialization")
    msg = importlib.import_module("derail_msgs.msg")
    state = msg.TrainState()
    state.run_id = "run"
    state.step = 7
    for number, (name, kind) in enumerate(state.get_fields_and_field_types().items()):
        if kind == "sequence<double>":
            setattr(state, name, array.array("d", [number + 0.5, float("inf"), -0.0]))
        elif kind == "sequence<uint8>":
            setattr(state, name, array.array("B", [1, 0, 1]))
    back = serialization.deserialize_message(
        serialization.serialize_message(state), msg.TrainState
    )
    assert back == state
    assert isinstance(back.x, array.array)
