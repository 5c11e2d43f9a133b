"""The parameters of the nodes: one table for declarations, checks, defaults and documentation.

`python -m research parameters` writes ``config/simulator.yaml`` and ``docs/parameters.md`` from
it; a test compares them. No ROS in here: ``declaration.py`` declares the table to ``rclpy``.
"""

from __future__ import annotations

import dataclasses
import os
import re
from collections.abc import Iterator, Mapping
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
    form : what a text must look like: a regular expression, and the same in words
    path : a file or folder, or a list of them, in which ``~`` and ``$NAME`` are replaced: what
        comes from a launch file or a parameter file has not passed through a shell
    numeric : a text that may be a number, which then comes as one
    places : what may stand after a colon in the text
    """

    name: str
    default: Value
    description: str
    unit: str = ""
    limits: tuple[float, float] | None = None
    choices: tuple[str, ...] = ()
    read_only: bool = False
    form: tuple[str, str] | None = None
    path: bool = False
    numeric: bool = False
    places: tuple[str, ...] = ()

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
        return self.form[1] if self.form else ", ".join(self.choices)

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
        if self.numeric and type(value) is int:
            value = str(value)
        if isinstance(self.default, list):
            fits = isinstance(value, (list, tuple)) and all(isinstance(v, str) for v in value)
            value = list(value) if fits else value
        else:
            fits = type(value) is type(self.default)
        if not fits:
            raise ValueError(f"{self.name} must be of type {self.type_name}, got {value!r}")
        if self.choices and value not in self.choices:
            raise ValueError(f"{self.name} must be one of {self.range}, got {value!r}")
        for place in re.findall(r":([^\s,]*)", value) if self.places else ():
            if place not in self.places:
                known = ", ".join(self.places)
                raise ValueError(f"{self.name}: there is no place {place!r}; places are {known}")
        if self.form and not re.fullmatch(self.form[0], value):
            raise ValueError(f"{self.name} must be {self.range}, got {value!r}")
        if self.path:
            try:
                return (
                    [_expanded(v) for v in value] if isinstance(value, list) else _expanded(value)
                )
            except ValueError as error:
                raise ValueError(f"{self.name}: {error}") from None
        # False for NaN, too.
        if self.limits is not None and not self.limits[0] <= value <= self.limits[1]:
            unit = f" {self.unit}" if self.unit not in ("", "1") else ""
            raise ValueError(f"{self.name} must be {self.range}{unit}, got {value:g}")
        return value  # type: ignore[no-any-return]


def _expanded(path: str) -> str:
    found = os.path.expandvars(os.path.expanduser(path))
    if unknown := re.match(r"~[^/]*", found) or re.search(r"\$(\w+|\{[^}]*\})", found):
        raise ValueError(f"there is nothing to put for {unknown[0]} in {path}")
    return found


FRAME = r"[A-Za-z0-9_.-]+(/[A-Za-z0-9_.-]+)*"
"""A name of a frame that tf2 and RViz take."""

NAMESPACE = "namespace"
"""The frame prefix that stands for the namespace of the node."""

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

CARS = r"(all|[1-9]\d{0,3}(-[1-9]\d{0,3})?)"
SENSORS: dict[str, dict[str, Any]] = {
    "odometry": {
        "what": "pose and velocity (nav_msgs/Odometry); the noise is that of the position",
        "rate": 50.0,
        "unit": "m",
    },
    "imu": {
        "what": "acceleration and angular rates (sensor_msgs/Imu) at a place of the car, such as "
        "`20:front_truck`; places: `body` (the default), `front_truck`, `rear_truck`",
        "rate": 200.0,
        "unit": "m/s^2",
        "places": ("body", "front_truck", "rear_truck"),
    },
    "navsat": {
        "what": "place on the Earth (sensor_msgs/NavSatFix), of scenarios with `site.datum`",
        "rate": 5.0,
        "unit": "m",
    },
    "wheel_speed": {
        "what": "speed by the wheels of the front truck (geometry_msgs/TwistStamped)",
        "rate": 20.0,
        "unit": "m/s",
    },
    "pipe_pressure": {
        "what": "pressure of the brake pipe (sensor_msgs/FluidPressure)",
        "rate": 20.0,
        "unit": "Pa",
    },
}
"""Sensors that cars can have, each with the topic `car_N/...` of its own."""


def _sensor(
    name: str, *, what: str, rate: float, unit: str = "", places: tuple[str, ...] = ()
) -> Iterator[Parameter]:
    """The parameters of a kind of sensor: which cars have it, its rate and its noise."""
    one = f"{CARS}(:({'|'.join(places)}))?" if places else CARS
    yield Parameter(
        name,
        "",
        f"cars with this sensor, such as `1 20-25` or `all`: {what}",
        read_only=True,
        numeric=True,
        places=places,
        form=(f"\\s*({one}([\\s,]+{one})*)?\\s*", "car numbers, ranges a-b, or all"),
    )
    yield Parameter(
        f"{name}_rate", rate, "messages per second of run time", "Hz", (0.1, 5000.0),
        read_only=True,
    )  # fmt: skip
    if unit:
        yield Parameter(
            f"{name}_noise", 0.0, "standard deviation of the noise", unit, (0.0, 1e9),
            read_only=True,
        )  # fmt: skip


SIMULATOR = (
    Parameter(
        "scenario",
        "mississauga",
        "name of the scenario to load; set while the node runs, it loads that scenario as "
        "`~/load_consist` does; empty: no scenario at the start",
    ),
    Parameter(
        "model",
        "",
        "model that computes the runs, in place of the scenario's; empty: the scenario's",
        read_only=True,
    ),
    Parameter(
        "scenario_dirs",
        [],
        "folders searched for scenarios before the shipped ones",
        read_only=True,
        path=True,
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
        True,
        "publish the frames of cars and couplers on `/tf` at each tick, and those of trucks and "
        "coupler heads on `/tf_static`",
        read_only=True,
    ),
    Parameter(
        "frame_prefix",
        NAMESPACE,
        f"prefix of the names of the train's frames and joints; `{NAMESPACE}`: the node's "
        "namespace, so that trains in different namespaces have different frames",
        read_only=True,
        form=(f"({FRAME}/?)?", "the beginning of a frame's name, such as north/"),
    ),
    CLOCK_RATE,
    Parameter("start_paused", False, "load the first scenario paused, not playing"),
    AWAIT_LISTENERS,
    Parameter("auto_exit", False, "end the node when the run has ended"),
    Parameter("allow_quit", False, "let `~/set_simulation_state` end the node"),
    Parameter(
        "legacy_service_names",
        False,
        "offer `~/set_simulation_state`, `~/step_simulation` and `~/reset_simulation` with the "
        "types of derail_msgs, as in earlier versions, in place of the standard's",
        read_only=True,
    ),
    Parameter(
        "standard_namespace",
        "",
        "namespace of the standard's services and action: `/` for `/get_entities`, as clients of "
        "other simulators call it; empty: `~/get_entities`",
        read_only=True,
        form=(
            "/?|/?[A-Za-z][A-Za-z0-9_]*(/[A-Za-z][A-Za-z0-9_]*)*",
            "a namespace, such as / or sim",
        ),
    ),
    Parameter(
        "record",
        "",
        "folder of the lossless recording that the simulator writes; it must not exist; "
        "empty: no recording",
        read_only=True,
        path=True,
    ),
    Parameter(
        "record_all",
        False,
        "the recording also holds `/tf`, `/tf_static`, `joint_states`, `robot_description` and "
        "the sensors",
        read_only=True,
    ),
    *(parameter for sensor in SENSORS for parameter in _sensor(sensor, **SENSORS[sensor])),
    Parameter(
        "odometry_speed_noise",
        0.0,
        "standard deviation of the noise of the velocity",
        "m/s",
        (0.0, 1e3),
        read_only=True,
    ),
    Parameter(
        "imu_turn_noise",
        0.0,
        "standard deviation of the noise of the angular rates",
        "rad/s",
        (0.0, 10.0),
        read_only=True,
    ),
    Parameter(
        "sensor_seed", 0, "seed of the noise of the sensors", "1", (0, 2**31), read_only=True
    ),
    dataclasses.replace(STORAGE, name="record_storage", description="storage of that recording"),
    Parameter(
        "frame_id",
        "map",
        "inertial frame of all messages",
        read_only=True,
        form=(FRAME, "the name of a frame: letters, digits, _ . - and / between them"),
    ),
)


def _fixed(*parameters: Parameter) -> tuple[Parameter, ...]:
    """Parameters that can be set only when the node starts."""
    return tuple(dataclasses.replace(parameter, read_only=True) for parameter in parameters)


RECORDER = _fixed(
    Parameter(
        "path",
        "derail_bag",
        "folder of the recording; it must not exist",
        path=True,
        form=(".+", "the name of a folder"),
    ),
    STORAGE,
    Parameter(
        "topics",
        [],
        "topics to record, by their names in the table of the simulator, such as `/tf` or "
        "`car_5/odometry`; `all`: all of them and the sensors of all cars, without `/clock`, "
        "which is recorded only by name; empty: those that `record` holds, and `/diagnostics`",
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
    Parameter("path", "", "the recording: its folder, or a file of it; required", path=True),
    Parameter(
        "rate",
        1.0,
        "recorded time per wall time at the start; `~/set_rate` changes it",
        "1",
        (1e-3, 1000.0),
    ),
    Parameter("start_offset", 0.0, "recorded time to skip at the start", "s", (0.0, 1e9)),
    Parameter("loop", False, "start again at the end"),
    Parameter(
        "topics",
        [],
        "topics to play, by their names in the recording or patterns of them; empty: all",
    ),
    Parameter("exclude", [], "topics not to play, in the same way"),
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

    @property
    def prefix(self) -> str:
        """Prefix of the names of the train's frames."""
        if self.frame_prefix != NAMESPACE:
            return str(self.frame_prefix)
        return f"{self.namespace.strip('/')}/".lstrip("/")

    def check_frames(self) -> None:
        """Refuse an inertial frame that has the name of a frame of a train.

        Raises
        ------
        ValueError
        """
        if re.fullmatch(rf"{re.escape(self.prefix)}car_\d+(/.*)?", self.frame_id):
            raise ValueError(f"frame_id must not be a frame of the train, got {self.frame_id!r}")

    @property
    def records_all(self) -> bool:
        """Whether the recording holds frames, joints and sensors too."""
        return bool(self.record and self.record_all)

    @property
    def full_name(self) -> str:
        """Name of the node with its namespace, without the first slash."""
        return f"{self.namespace.strip('/')}/{self.name}".lstrip("/")

    def update(self, values: Mapping[str, Any]) -> None:
        """Take new values, which have been checked."""
        vars(self).update(values)
