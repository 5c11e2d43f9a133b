"""The parameters of the nodes: one table for declarations, checks, defaults and documentation.

`python -m research parameters` writes ``config/simulator.yaml`` and ``docs/parameters.md`` from
it; a test compares them. No ROS in here: ``declaration.py`` declares the table to ``rclpy``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

Value = bool | int | float | str | list[str]


@dataclass(frozen=True)
class Parameter:
    """A parameter of a node.

    Attributes
    ----------
    name : its name
    default : its default value, which also decides its type (bool, int, float, str, list of str)
    description : what it does
    unit : unit of its value, "" without one
    limits : smallest and largest value allowed, of a number
    choices : the values allowed, of a text that has only a few
    read_only : it can be set only when the node starts
    """

    name: str
    default: Value
    description: str
    unit: str = ""
    limits: tuple[float, float] | None = None
    choices: tuple[str, ...] = ()
    read_only: bool = False

    @property
    def type_name(self) -> str:
        """Name of the type, as ROS 2 writes it."""
        names = {
            bool: "bool",
            int: "integer",
            float: "double",
            str: "string",
            list: "string_array",
        }
        return names[type(self.default)]

    @property
    def range(self) -> str:
        """The values allowed, in words; "" if all values of the type are."""
        if self.limits is not None:
            return f"{self.limits[0]:g} to {self.limits[1]:g}"
        return ", ".join(self.choices)

    def check(self, value: Any) -> Value:
        """The value in the parameter's type; a whole number is accepted for a double.

        Every value that a node uses has passed through here.

        Raises
        ------
        ValueError
            With the name of the parameter and the reason.
        """
        if isinstance(self.default, float) and type(value) is int:
            value = float(value)
        if isinstance(self.default, list):
            fits = isinstance(value, (list, tuple)) and all(isinstance(v, str) for v in value)
            value = list(value) if fits else value
        else:
            fits = type(value) is type(self.default)
        if not fits:
            raise ValueError(f"{self.name} must be of type {self.type_name}, got {value!r}")
        if self.choices and value not in self.choices:
            raise ValueError(f"{self.name} must be one of {self.range}, got {value!r}")
        # False for NaN, too.
        if self.limits is not None and not self.limits[0] <= value <= self.limits[1]:
            unit = f" {self.unit}" if self.unit not in ("", "1") else ""
            raise ValueError(f"{self.name} must be {self.range}{unit}, got {value:g}")
        return value  # type: ignore[no-any-return]


PUBLISH_CLOCK = Parameter(
    "publish_clock", True, "publish `/clock`, unless another node does", read_only=True
)
CLOCK_RATE = Parameter(
    "clock_rate", 100.0, "clock messages per second of wall time", "Hz", (1.0, 1000.0)
)
AWAIT_LISTENERS = Parameter(
    "await_listeners",
    0,
    "start when the state topics have this many subscribers, or after 10 s; a recorder then gets "
    "the run from its first message",
    "1",
    (0, 100),
    read_only=True,
)
STORAGE = Parameter(
    "storage", "mcap", "storage of the recording", choices=("mcap", "sqlite3"), read_only=True
)

SIMULATOR = (
    Parameter(
        "scenario",
        "mississauga",
        "name of the scenario to load; set while the node runs, it loads that scenario as "
        "`~/load_consist` does; empty: no scenario at the start",
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
        "simulation time per wall time; 0: as fast as possible",
        "1",
        (0.0, 1000.0),
    ),
    Parameter(
        "state_rate",
        50.0,
        "state messages per second of simulation time; a change takes effect with the next load "
        "or reset",
        "Hz",
        (1.0, 1000.0),
    ),
    Parameter(
        "marker_rate",
        15.0,
        "marker messages per second: of wall time when live, of simulation time in the "
        "recording; 0: none",
        "Hz",
        (0.0, 100.0),
    ),
    PUBLISH_CLOCK,
    Parameter(
        "publish_tf",
        False,
        "publish the frames `car_1`, `car_2`, ... on `/tf` at each tick; needs tf2_msgs",
        read_only=True,
    ),
    CLOCK_RATE,
    Parameter("start_paused", False, "load the first scenario paused, not playing"),
    AWAIT_LISTENERS,
    Parameter("auto_exit", False, "end the node when the run has ended"),
    Parameter("allow_quit", False, "let `~/set_simulation_state` end the node"),
    Parameter(
        "record",
        "",
        "folder of the lossless recording that the simulator writes; it must not exist; "
        "empty: no recording",
        read_only=True,
    ),
    dataclasses.replace(STORAGE, name="record_storage", description="storage of that recording"),
    Parameter("frame_id", "map", "inertial frame of all messages", read_only=True),
)


def _fixed(*parameters: Parameter) -> tuple[Parameter, ...]:
    """Parameters that can be set only when the node starts."""
    return tuple(dataclasses.replace(parameter, read_only=True) for parameter in parameters)


RECORDER = _fixed(
    Parameter("path", "derail_bag", "folder of the recording; it must not exist"),
    STORAGE,
    Parameter(
        "topics",
        [],
        "topics to record, by their names in the table of the simulator; empty: all but `/clock`",
    ),
    Parameter("stop_when_final", False, "end when the final outcome of the run has been recorded"),
    Parameter(
        "settle",
        0.5,
        "wall time without messages after the final outcome before the recorder ends",
        "s",
        (0.0, 60.0),
    ),
    Parameter(
        "depth", 1000, "messages of a topic that may wait for the recorder", "1", (1, 100_000)
    ),
)

PLAYER = _fixed(
    Parameter("path", "", "the recording: its folder, or a file of it; required"),
    Parameter(
        "rate",
        1.0,
        "recorded time per wall time at the start; `~/set_rate` changes it",
        "1",
        (1e-3, 1000.0),
    ),
    Parameter("start_offset", 0.0, "recorded time to skip at the start", "s", (0.0, 1e9)),
    Parameter("loop", False, "start again at the end"),
    Parameter("start_paused", False, "wait for `~/resume`"),
    Parameter(
        "auto_exit", True, "end the node when everything has been played; otherwise it pauses"
    ),
    PUBLISH_CLOCK,
    CLOCK_RATE,
    AWAIT_LISTENERS,
)

NODES = {"simulator": SIMULATOR, "recorder": RECORDER, "player": PLAYER}


class Settings:
    """The parameters of a simulator as attributes, and where it runs.

    ``namespace`` and ``name`` are those of the node, ``state_dir`` is the folder for the state of
    a failed run.
    """

    namespace: str = ""
    name: str = "simulator"
    state_dir: str = ""

    def __init__(self, **given: Any) -> None:
        defaults = {parameter.name: parameter.default for parameter in SIMULATOR}
        unknown = [key for key in given if key not in defaults and not hasattr(Settings, key)]
        if unknown:
            raise TypeError(f"no such setting: {', '.join(unknown)}")
        self.update(defaults | given)

    def update(self, values: Mapping[str, Any]) -> None:
        """Take new values, which have been checked."""
        vars(self).update(values)
