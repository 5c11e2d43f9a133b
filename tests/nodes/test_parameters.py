"""One table: what is declared, checked, shipped and documented is the same."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import yaml

from derail_ros.nodes.declaration import descriptor, without_effect
from derail_ros.nodes.parameters import NODES, RECORDER, SIMULATOR, Parameter, Settings
from research.parameters import page, parameter_file, parameter_table

ROOT = Path(__file__).resolve().parents[2]
BY_NAME = {p.name: p for p in SIMULATOR}


def test_the_generated_files_are_current() -> None:
    for path, text in (
        ("config/simulator.yaml", parameter_file("simulator")),
        ("docs/parameters.md", page()),
    ):
        assert (ROOT / path).read_text() == text, "run: python -m research parameters"


def test_the_parameter_file_sets_every_default() -> None:
    data = yaml.safe_load((ROOT / "config" / "simulator.yaml").read_text())
    values = data["/**"]["ros__parameters"]
    expected = {p.name: p.default for p in SIMULATOR if p.default != []}
    assert values == expected
    assert {name: type(value) for name, value in values.items()} == {
        name: type(value) for name, value in expected.items()
    }


@pytest.mark.parametrize("node", NODES)
def test_every_parameter_is_documented_and_its_default_allowed(node) -> None:
    names = [p.name for p in NODES[node]]
    assert len(set(names)) == len(names)
    table = parameter_table(node)
    for parameter in NODES[node]:
        assert parameter.check(parameter.default) == parameter.default
        assert parameter.description and f"`{parameter.name}`" in table
        if parameter.type_name in ("double", "integer"):
            assert parameter.unit and parameter.limits


class _Node:
    """What :func:`without_effect` asks of a node."""

    def __init__(self, **given: str) -> None:
        self._parameter_overrides = {name.replace("__", "."): v for name, v in given.items()}

    def has_parameter(self, name: str) -> bool:
        return name in ("topics", "use_sim_time")


def test_what_has_no_effect_is_told(tmp_path) -> None:
    values = {p.name: p.default for p in RECORDER}
    node = _Node(topcis="x", topics="y", use_sim_time="z", speed_factor="of the simulator")
    assert list(without_effect(node, values)) == [
        "there is no parameter topcis; ignored; did you mean 'topics'?"
    ]
    assert list(without_effect(_Node(qos_overrides__a="x", nosuch="y"), values)) == [
        "there is no parameter nosuch; ignored"
    ]
    folders = {"scenario_dirs": [str(tmp_path), str(tmp_path / "nope")]}
    (said,) = without_effect(_Node(), folders)
    assert said == f"scenario_dirs: there is no folder {tmp_path / 'nope'}"


@pytest.mark.ros
def test_a_misspelt_parameter_is_warned_of_by_each_node(tmp_path) -> None:
    pytest.importorskip("rclpy")
    pytest.importorskip("derail_msgs")
    from tests.nodes.graph import graph

    with graph(tmp_path) as made:
        recorder = made.start("recorder", path=tmp_path / "bag", topcis="[events]")
        simulator = made.simulator(
            scenario="", nosuch=3, sped_factor=2.0, scenario_dirs=f"['{tmp_path}/nope']"
        )
        made.until(lambda: "recording 13 topics" in recorder.output, "it records", recorder)
        assert recorder.end() == 0 and simulator.end() == 0
    assert "there is no parameter topcis; ignored; did you mean 'topics'?" in recorder.output
    for said in (
        "no parameter nosuch",
        "did you mean 'speed_factor'",
        f"no folder {tmp_path}/nope",
    ):
        assert said in simulator.output, said
    assert simulator.output.count("there is no parameter") == 2


def test_the_interface_asks_for_at_least_these() -> None:
    wanted = {
        "scenario",
        "scenario_dirs",
        "speed_factor",
        "state_rate",
        "marker_rate",
        "publish_clock",
        "clock_rate",
        "start_paused",
        "auto_exit",
        "allow_quit",
        "record",
        "frame_id",
    }
    assert wanted <= set(BY_NAME)
    assert all(BY_NAME[n].read_only for n in ("scenario_dirs", "record", "frame_id"))
    assert BY_NAME["allow_quit"].default is False


def test_settings_are_the_parameters() -> None:
    settings = Settings(state_rate=20.0, name="other")
    assert (settings.state_rate, settings.name, settings.namespace) == (20.0, "other", "")
    given = {name: getattr(settings, name) for name in BY_NAME} | {"state_rate": 50.0}
    assert given == {p.name: p.default for p in SIMULATOR}
    with pytest.raises(TypeError, match="no such setting: sped_factor"):
        Settings(sped_factor=2.0)


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("speed_factor", -0.1, "speed_factor must be 0 to 1000, got -0.1"),
        ("speed_factor", math.nan, "speed_factor must be 0 to 1000, got nan"),
        ("speed_factor", True, "speed_factor must be of type double, got True"),
        ("speed_factor", "1", "speed_factor must be of type double, got '1'"),
        ("state_rate", 0, "state_rate must be 1 to 1000 Hz, got 0"),
        ("auto_exit", 1, "auto_exit must be of type bool, got 1"),
        ("scenario", 3, "scenario must be of type string, got 3"),
        ("scenario_dirs", "x", "scenario_dirs must be of type string_array"),
        ("scenario_dirs", [1], "scenario_dirs must be of type string_array"),
        ("record_storage", "hdf5", "record_storage must be one of mcap, sqlite3"),
        ("await_listeners", 1.5, "await_listeners must be of type integer"),
    ],
)
def test_a_value_that_will_not_do_is_refused_with_its_reason(name, value, reason) -> None:
    with pytest.raises(ValueError) as caught:
        BY_NAME[name].check(value)
    assert reason in str(caught.value)


def test_a_whole_number_is_a_double_too() -> None:
    value = BY_NAME["speed_factor"].check(3)
    assert value == 3.0 and type(value) is float


def test_ranges_in_words() -> None:
    assert Parameter("x", 1.0, "d", limits=(0.0, 2.0)).range == "0 to 2"
    assert Parameter("x", "a", "d", choices=("a", "b")).range == "a, b"
    assert Parameter("x", True, "d").range == ""


@pytest.mark.ros
def test_descriptors_carry_the_table() -> None:
    pytest.importorskip("rcl_interfaces")
    for parameter in (*SIMULATOR, *RECORDER):
        told = descriptor(parameter)
        assert told.name == parameter.name and told.read_only == parameter.read_only
        ranges = [*told.floating_point_range, *told.integer_range]
        assert len(ranges) == (parameter.type_name in ("double", "integer"))
        for limits in ranges:
            assert (limits.from_value, limits.to_value) == parameter.limits
