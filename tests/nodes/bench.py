"""A simulator without a graph, and a wall clock that moves when it is told to."""

from __future__ import annotations

import time
from typing import Any

from derail_ros.nodes.commands import Answer
from derail_ros.nodes.core import SimulatorCore
from derail_ros.nodes.loop import Loop
from derail_ros.nodes.parameters import Settings
from msg_adapters.definitions import deserialize
from msg_adapters.topics import TOPICS


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
        self.logs: list[tuple[str, str]] = []

    def publish(self, topic: str, data: bytes) -> None:
        self.raw.append((topic, data))

    def renew(self) -> None:
        self.runs += 1

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

    def step(self, ticks: int) -> list[Answer]:
        """Ask for ticks, and work until they are answered."""
        answers: list[Answer] = []
        self.core.step_simulation(ticks, answers.append)
        while self.core.stepping:
            self.loop.work()
        return answers
