"""The parameters of the nodes: one table for declaration, validation, file and documentation.

``python -m derail_ros.nodes.parameters`` renews ``config/simulator.yaml`` and
``docs/parameters.md``; a test holds them equal to the table.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import derail_ros
from derail_ros.scenario.messages import did_you_mean

Value = bool | int | float | str | list[str]


@dataclass(frozen=True)
class Parameter:
    """A parameter of a node.

    Attributes
    ----------
    name : its name
    default : its default; decides the type (bool, int, float, str, list of str)
    description : what it does
    unit : of its value, "" without one
    low, high : smallest and largest value allowed
    choices : the values allowed, where they are few
    read_only : can be set only when the node starts
    """

    name: str
    default: Value
    description: str
    unit: str = ""
    low: float = -math.inf
    high: float = math.inf
    choices: tuple[str, ...] = ()
    read_only: bool = False

    @property
    def type_name(self) -> str:
        """Name of the type as ROS has it."""
        if isinstance(self.default, list):
            return "string_array"
        names = {bool: "bool", int: "integer", float: "double", str: "string"}
        return names[type(self.default)]

    @property
    def range(self) -> str:
        """The values allowed, in words."""
        if self.choices:
            return ", ".join(self.choices)
        if math.isinf(self.low) and math.isinf(self.high):
            return ""
        if math.isinf(self.high):
            return f"from {self.low:g} up"
        return f"{self.low:g} to {self.high:g}"

    def check(self, value: Any) -> Value:
        """The value in the parameter's type.

        Raises
        ------
        ValueError
            With the reason why it cannot be.
        """
        kind = self.type_name
        unit = f" {self.unit}" if self.unit not in ("", "1") else ""
        if kind == "string_array":
            if isinstance(value, (list, tuple)) and all(isinstance(v, str) for v in value):
                return list(value)
            raise ValueError(f"{self.name}: must be a list of strings, not {value!r}")
        if kind == "double" and isinstance(value, int) and not isinstance(value, bool):
            value = float(value)  # 3 is as good as 3.0
        wanted = {"bool": bool, "integer": int, "double": float, "string": str}[kind]
        if type(value) is not wanted:
            raise ValueError(f"{self.name}: must be of type {kind}, not {value!r}")
        if self.choices and value not in self.choices:
            raise ValueError(f"{self.name}: must be one of {self.range}, not {value!r}")
        if kind in ("integer", "double"):
            if not math.isfinite(value):
                raise ValueError(f"{self.name}: must be a finite number, not {value}")
            if not self.low <= value <= self.high:
                raise ValueError(f"{self.name}: must be {self.range}{unit}, not {value:g}")
        return value  # type: ignore[no-any-return]


SIMULATOR = (
    Parameter(
        "scenario",
        "mississauga",
        "name of the scenario to load; set while running, it loads that scenario as "
        "`~/load_consist` does; empty: none at the start",
    ),
    Parameter(
        "scenario_dirs",
        [],
        "folders searched for scenarios before the shipped ones",
        read_only=True,
    ),
    Parameter(
        "speed_factor",
        1.0,
        "simulation time per wall time; 0 is as fast as possible",
        unit="1",
        low=0.0,
        high=1000.0,
    ),
    Parameter(
        "state_rate",
        50.0,
        "state messages per second of simulation time; takes effect with the next load or reset",
        unit="Hz",
        low=1.0,
        high=1000.0,
    ),
    Parameter(
        "marker_rate",
        15.0,
        "marker messages per second: of wall time when live, of simulation time in the "
        "recording; 0: none",
        unit="Hz",
        low=0.0,
        high=100.0,
    ),
    Parameter(
        "publish_clock",
        True,
        "publish `/clock`, unless another node does already",
        read_only=True,
    ),
    Parameter(
        "publish_tf",
        False,
        "publish the frames `car_1`, `car_2`, ... on `/tf` at each tick; needs tf2_msgs",
        read_only=True,
    ),
    Parameter(
        "clock_rate",
        100.0,
        "clock messages per second of wall time",
        unit="Hz",
        low=1.0,
        high=1000.0,
    ),
    Parameter(
        "start_paused", False, "load the first scenario paused instead of running it at once"
    ),
    Parameter(
        "await_listeners",
        0,
        "the first run begins when each state topic has so many subscribers, or after 10 s: "
        "a recorder then gets it from its first message",
        unit="1",
        low=0,
        high=100,
        read_only=True,
    ),
    Parameter("auto_exit", False, "end the node when the run has ended"),
    Parameter("allow_quit", False, "let `~/set_simulation_state` end the node"),
    Parameter(
        "record",
        "",
        "folder of a lossless recording that the simulator writes; it must not exist; empty: none",
        read_only=True,
    ),
    Parameter(
        "record_storage",
        "mcap",
        "storage of that recording",
        choices=("mcap", "sqlite3"),
        read_only=True,
    ),
    Parameter("frame_id", "map", "inertial frame of all messages", read_only=True),
)

RECORDER = (
    Parameter("path", "derail_bag", "folder of the recording; it must not exist", read_only=True),
    Parameter(
        "storage", "mcap", "storage of the recording", choices=("mcap", "sqlite3"), read_only=True
    ),
    Parameter(
        "topics",
        [],
        "topics to record, by their names in the table of the simulator; empty: all but `/clock`",
        read_only=True,
    ),
    Parameter(
        "stop_when_final",
        False,
        "end when the run's final outcome has been recorded",
        read_only=True,
    ),
    Parameter(
        "settle",
        0.5,
        "wall time without messages after the final outcome before the recorder ends",
        unit="s",
        low=0.0,
        high=60.0,
        read_only=True,
    ),
    Parameter(
        "depth",
        1000,
        "messages of a topic that may wait for the recorder",
        unit="1",
        low=1,
        high=100_000,
        read_only=True,
    ),
)

PLAYER = (
    Parameter("path", "", "the recording: its folder, or a file of it", read_only=True),
    Parameter(
        "rate",
        1.0,
        "recorded time per wall time at the start; later `~/set_rate`",
        unit="1",
        low=1e-3,
        high=1000.0,
        read_only=True,
    ),
    Parameter(
        "start_offset",
        0.0,
        "begin so long after the beginning of the recording",
        unit="s",
        low=0.0,
        high=1e9,
        read_only=True,
    ),
    Parameter("loop", False, "begin again at the end", read_only=True),
    Parameter("start_paused", False, "wait for `~/resume`", read_only=True),
    Parameter(
        "auto_exit",
        True,
        "end when everything has been played; otherwise stay, paused",
        read_only=True,
    ),
    Parameter(
        "publish_clock",
        True,
        "publish `/clock`, unless another node does already",
        read_only=True,
    ),
    Parameter(
        "clock_rate",
        100.0,
        "clock messages per second of wall time",
        unit="Hz",
        low=1.0,
        high=1000.0,
        read_only=True,
    ),
    Parameter(
        "await_listeners",
        0,
        "begin when the states have so many subscribers, or after 10 s",
        unit="1",
        low=0,
        high=100,
        read_only=True,
    ),
)

NODES = {"simulator": SIMULATOR, "recorder": RECORDER, "player": PLAYER}


# --- rclpy -----------------------------------------------------------------------------------


def usage(node: str, arguments: str, parameters: Iterable[Parameter]) -> str:
    """Help on the command line of a node."""
    lines = [
        f"{node} of derail_ros {derail_ros.__version__}: a ROS 2 node",
        "",
        f"usage: {node} {arguments}",
        "",
    ]
    for p in parameters:
        lines.append(f"  {p.name} ({p.type_name}, default {p.default!r}): {p.description}")
    return "\n".join(lines)


def descriptor(parameter: Parameter) -> Any:
    """``rcl_interfaces/ParameterDescriptor`` of a parameter."""
    from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor

    unit = f" [{parameter.unit}]" if parameter.unit else ""
    result = ParameterDescriptor(
        name=parameter.name,
        description=parameter.description.replace("`", "") + unit,
        additional_constraints=", ".join(parameter.choices),
        read_only=parameter.read_only,
        # An integer is accepted where a double is asked for; check() does the rest.
        dynamic_typing=parameter.type_name == "double",
    )
    bounded = math.isfinite(parameter.low) and math.isfinite(parameter.high)
    if bounded and parameter.type_name == "double":
        result.floating_point_range = [
            FloatingPointRange(from_value=float(parameter.low), to_value=float(parameter.high))
        ]
    elif bounded and parameter.type_name == "integer":
        result.integer_range = [
            IntegerRange(from_value=int(parameter.low), to_value=int(parameter.high), step=1)
        ]
    return result


def declare(node: Any, table: Iterable[Parameter]) -> dict[str, Value]:
    """Declare the parameters of a node and give their values.

    Raises
    ------
    ValueError
        With the name of the parameter and the reason.
    """
    from rclpy.exceptions import ParameterException

    values: dict[str, Value] = {}
    for parameter in table:
        default: Any = parameter.default
        if default == []:
            # An empty list has no type in ROS, and one parameter without a value makes
            # `ros2 param dump` come out empty.
            default = [""]
        overrides = getattr(node, "_parameter_overrides", {})
        given = overrides.get(parameter.name)
        if given is not None:
            parameter.check(_plain(given.value))
        try:
            declared = node.declare_parameter(parameter.name, default, descriptor(parameter))
        except ParameterException as error:
            raise ValueError(f"{parameter.name}: {error}") from error
        value = _plain(declared.value)
        values[parameter.name] = parameter.default if value is None else parameter.check(value)
    for warning in ignored(node, values):
        node.get_logger().warning(warning)
    return values


def ignored(node: Any, values: Mapping[str, Value]) -> Iterator[str]:
    """What was given to a node and has no effect, in words.

    A file for all nodes (``/**``) gives each of them those of the others too.
    """
    known = {parameter.name for table in NODES.values() for parameter in table}
    for name in getattr(node, "_parameter_overrides", {}):
        # Publishers and subscribers declare the overrides of their QoS when they are made.
        if not (name in known or node.has_parameter(name) or name.startswith("qos_overrides.")):
            yield f"{name}: no such parameter, ignored{did_you_mean(name, values)}"
    for folder in values.get("scenario_dirs", []):  # type: ignore[union-attr]
        if not Path(folder).is_dir():
            yield f"scenario_dirs: there is no folder {folder}"


def _plain(value: Any) -> Any:
    """A value without the array types of ``rclpy``; a list without empty texts."""
    if hasattr(value, "__iter__") and not isinstance(value, str):
        return [entry for entry in value if entry != ""]
    return value


def check_change(parameters: Iterable[Any], table: Iterable[Parameter]) -> dict[str, Value]:
    """Checked values of a change that a client asks for.

    Raises
    ------
    ValueError
        With the name of the parameter and the reason; nothing is changed then.
    """
    known = {parameter.name: parameter for parameter in table}
    return {p.name: known[p.name].check(_plain(p.value)) for p in parameters if p.name in known}


# --- file and documentation ------------------------------------------------------------------


def _yaml(value: Value) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, list):
        return "[" + ", ".join(_yaml(v) for v in value) + "]"
    return str(value)


def parameter_file(node: str = "simulator") -> str:
    """Text of ``config/<node>.yaml``: every parameter with its default."""
    lines = [
        f"# Parameters of the node `{node}` with their defaults:",
        f"#   ros2 run derail_ros {node} --ros-args --params-file config/{node}.yaml",
        "# Generated from derail_ros/nodes/parameters.py; make a copy to change values.",
        "",
        "/**:",
        "  ros__parameters:",
    ]
    for parameter in NODES[node]:
        notes = [
            note
            for note in (
                parameter.unit and f"[{parameter.unit}]",
                parameter.range,
                "read-only" if parameter.read_only else "",
            )
            if note
        ]
        text = parameter.description.replace("`", "")
        if notes:
            text += f" ({', '.join(notes)})"
        lines += _comment(text, "    # ")
        if parameter.default == []:
            # An empty list has no type in a parameter file.
            lines.append(f'    # {parameter.name}: ["..."]')
        else:
            lines.append(f"    {parameter.name}: {_yaml(parameter.default)}")
    return "\n".join(lines) + "\n"


def _comment(text: str, prefix: str) -> list[str]:
    import textwrap

    return textwrap.wrap(text, 95, initial_indent=prefix, subsequent_indent=prefix)


def parameter_table(node: str) -> str:
    """Markdown table of a node's parameters."""
    lines = [
        "| name | type | default | unit | range | can change | what it does |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for p in NODES[node]:
        change = "at start only" if p.read_only else "any time"
        lines.append(
            f"| `{p.name}` | {p.type_name} | `{_yaml(p.default)}` | {p.unit} | {p.range} | "
            f"{change} | {p.description} |"
        )
    return "\n".join(lines) + "\n"


def topic_table() -> str:
    """Markdown table of the simulator's topics."""
    from msg_adapters.topics import TOPICS

    lines = ["| name | type | QoS | when |", "| --- | --- | --- | --- |"]
    for topic in TOPICS.values():
        durability = "transient local" if topic.latched else "volatile"
        lines.append(
            f"| `{topic.name}` | `{topic.msgtype}` | reliable, {durability}, {topic.depth} | "
            f"{topic.when} |"
        )
    return "\n".join(lines) + "\n"


def document() -> str:
    """Text of ``docs/parameters.md``."""
    return f"""# Parameters and topics of the nodes

Generated from `derail_ros/nodes/parameters.py` and `msg_adapters/topics.py`
(`python -m derail_ros.nodes.parameters`).

A whole number is accepted where a double is asked for. A value that is refused leaves everything
as it was, and the answer says why.

## `simulator`

{parameter_table("simulator")}
### Topics of the simulator

Relative names are in the node's namespace and can be remapped.

{topic_table()}
## `recorder`

{parameter_table("recorder")}
## `player`

{parameter_table("player")}"""


def generated(root: Path) -> dict[Path, str]:
    """Files that are generated from the tables, and their texts."""
    return {
        root / "config" / "simulator.yaml": parameter_file("simulator"),
        root / "docs" / "parameters.md": document(),
    }


def main() -> None:
    """Renew the generated files."""
    for path, text in generated(Path(__file__).resolve().parents[2]).items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
