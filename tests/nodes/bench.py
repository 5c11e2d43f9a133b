"""A simulator without a graph, and a wall clock that moves when it is told to."""

from __future__ import annotations

import math
import time
from typing import Any

from derail_ros.nodes.commands import Answer
from derail_ros.nodes.core import SimulatorCore
from derail_ros.nodes.loop import Loop
from derail_ros.nodes.parameters import Settings
from msg_adapters.definitions import deserialize
from msg_adapters.topics import TOPICS, Topic
from tests.nodes.support import SMALL

BAD: list[tuple[str, dict[str, Any], str]] = [
    ("load_consist", {"scenario_name": "nowhere"}, "unknown scenario"),
    ("load_consist", {"scenario_name": "/etc/passwd"}, "not a scenario name"),
    ("load_consist", {"scenario_name": "../engine/params"}, "not a scenario name"),
    ("load_consist", {}, "neither scenario_name nor scenario_yaml is given"),
    ("load_consist", {"scenario_name": "small", "scenario_yaml": SMALL}, "are both given"),
    (
        "load_consist",
        {"scenario_yaml": SMALL, "speed_kmh": math.nan},
        "speed_kmh must be a finite",
    ),
    ("load_consist", {"scenario_yaml": "version: 1\ntitle: [\n"}, "<inline>:"),
    ("load_consist", {"scenario_yaml": SMALL.replace("80", "-5")}, "train.speed_kmh"),
    ("load_consist", {"scenario_yaml": SMALL.replace("80", "fast")}, "train.speed_kmh"),
    ("load_consist", {"scenario_yaml": "a: &b [1]\nc: *b\n"}, "<inline>:1"),
    ("load_consist", {"scenario_yaml": "a: !!python/name:os.system ''\n"}, "<inline>:1"),
    ("load_consist", {"scenario_yaml": "#" * (512 * 1024 + 1)}, "over 512 KB"),
    ("load_consist", {"scenario_yaml": SMALL.replace("10}", "1001}")}, "count"),
    ("load_consist", {"scenario_yaml": SMALL, "speed_kmh": -1.0}, "speed_kmh must be"),
    ("load_consist", {"scenario_yaml": SMALL, "speed_kmh": math.inf}, "speed_kmh must be"),
    ("load_consist", {"scenario_yaml": SMALL, "speed_kmh": 1e6}, "train.speed_kmh"),
    ("inject_rail_break", {"track_coordinate": math.nan}, "must be a finite number, got nan"),
    ("inject_rail_break", {"track_coordinate": math.inf}, "must be a finite number, got inf"),
    ("inject_rail_break", {"track_coordinate": 1e12}, "track_coordinate: 1e+12 m lies outside"),
    ("inject_rail_break", {"car": 77}, "car must be 1 to 3, the cars of the train, got 77"),
    ("inject_rail_break", {"track_coordinate": math.nan, "car": 2}, "must be a finite number"),
    ("inject_rail_break", {"track_coordinate": math.inf, "car": 2}, "must be a finite number"),
    ("inject_rail_break", {"track_coordinate": 5.0, "car": 3}, "5 m and car 3 are two places"),
    ("trigger_emergency_brake", {"mode": 7}, "mode must be 0 to 3, got 7"),
    ("trigger_emergency_brake", {"source": 7}, "source must be 0 to 3, got 7"),
    ("trigger_emergency_brake", {"source": 3}, "source 3 (car) needs the field car"),
    ("trigger_emergency_brake", {"source": 3, "car": 9}, "car must be 1 to 3"),
    ("trigger_emergency_brake", {"car": 2}, "car 2 is allowed only with source 3"),
    ("trigger_emergency_brake", {"delay_s": -1.0}, "delay_s must be a finite number from 0 up"),
    ("trigger_emergency_brake", {"delay_s": math.nan}, "delay_s must be a finite number"),
    ("set_simulation_state", {"state": 9}, "state must be 0 to 3, got 9"),
    ("set_simulation_state", {"state": 3}, "the parameter allow_quit is false"),
    ("step_simulation", {"ticks": 1}, "the state must be paused, it is playing"),
    ("reset_simulation", {"mode": 5}, "mode must be 0 to 1, got 5"),
]
"""Requests that are refused while a run of three cars plays, with a part of the reason."""


class Wall:
    """A clock that moves when it is told to."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


class Heard:
    """Output and logger that remember."""

    def __init__(self) -> None:
        self.raw: list[tuple[str, bytes]] = []
        self.runs = 0
        self.unheard: set[str] = set()
        self.offered: dict[str, str] = {}
        self.listening: dict[str, int] = {}
        self.logs: list[tuple[str, str]] = []

    def publish(self, topic: str, data: bytes) -> None:
        self.raw.append((topic, data))

    def renew(self) -> None:
        self.runs += 1

    def offer(self, topic: Topic) -> bool:
        self.offered[topic.name] = topic.msgtype
        return True

    def wanted(self, name: str) -> bool:
        return name not in self.unheard

    def subscribers(self, name: str) -> int:
        return self.listening.get(name, 0)

    def info(self, text: str) -> None:
        self.logs.append(("info", text))

    def warning(self, text: str) -> None:
        self.logs.append(("warning", text))

    def error(self, text: str) -> None:
        self.logs.append(("error", text))

    def of(self, topic: str) -> list[Any]:
        return [
            deserialize(data, TOPICS[topic].msgtype) for name, data in self.raw if name == topic
        ]

    def last(self, topic: str) -> Any:
        return self.of(topic)[-1]


class Simulator:
    """A simulator without a graph: its core, its loop, and what is heard of them."""

    def __init__(self, wall: Any = time.monotonic, **settings: Any) -> None:
        self.heard = Heard()
        self.core = SimulatorCore(Settings(**settings), self.heard, self.heard, wall)
        self.loop = Loop(self.core, self.heard, wall)

    def ask(self, service: str, caller: str = "", **fields: Any) -> Answer:
        """Call a service as a client does: fields left out are zero, false or empty."""
        core = self.core
        if service == "load_consist":
            request = {"scenario_name": "", "scenario_yaml": "", "start_paused": False} | fields
            speed = fields.get("speed_kmh", 0.0)
            prepared: Any
            try:
                prepared = core.prepare(request["scenario_name"], request["scenario_yaml"], speed)
            except ValueError as error:
                prepared = error
            return core.load(prepared, request, caller)
        if service == "inject_rail_break":
            return core.inject_rail_break(
                fields.get("track_coordinate", 0.0), fields.get("car", 0), caller
            )
        if service == "trigger_emergency_brake":
            numbers = [fields.get(name, 0) for name in ("mode", "source", "car", "delay_s")]
            return core.trigger_emergency_brake(*numbers, caller)
        if service == "set_simulation_state":
            return core.set_state(fields.get("state", 0), caller)
        if service == "reset_simulation":
            return core.reset(fields.get("mode", 0), caller)
        (answer,) = self.step(fields.get("ticks", 0))
        return answer

    def step(self, ticks: int) -> list[Answer]:
        """Ask for ticks, and work until they are answered."""
        answers: list[Answer] = []
        self.core.step_simulation(ticks, answers.append)
        while self.core.stepping:
            self.loop.work()
        return answers
