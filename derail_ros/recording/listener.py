"""What the ``recorder`` node does with what it hears; no ROS in here.

A listener can miss messages, unlike the simulator's own recording. It counts what it missed in
two ways: by the numbers that the middleware gives to the messages of each publisher, and by the
regular times of the state messages.
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from derail_ros.recording.manifest import Manifest, RunEntry
from derail_ros.recording.recorder import RunRecorder
from msg_adapters.common import NANOSECONDS, stamp_of, stamp_of_bytes
from msg_adapters.definitions import deserialize
from msg_adapters.topics import MANIFEST, STATE_TOPICS, Topic

HOLD = 2.0
"""Wall time for which other messages wait for the latched ones, s."""
BACKWARD = NANOSECONDS
"""Simulation time that jumps back further than this (ns) has begun anew."""
STOPPED = 5
IDLE_TOPICS = ("/diagnostics", "/clock", "markers")
"""Topics that go on while nothing happens."""


def message_stamp(topic: Topic, data: bytes, otherwise: int) -> int:
    """Simulation time of a serialised message, ns."""
    if topic.msgtype == "visualization_msgs/msg/MarkerArray":
        # A count, then markers that begin with a header.
        return stamp_of_bytes(data[4:16]) if len(data) > 24 else otherwise
    if topic is MANIFEST:
        return otherwise
    return stamp_of_bytes(data)


@dataclass
class Heard:
    """What was heard of a topic.

    Attributes
    ----------
    received : messages
    lost : messages that the middleware's numbers show to be missing
    stamps : times of the messages, ns (state topics)
    numbers : last number of each publisher
    """

    received: int = 0
    lost: int = 0
    stamps: list[int] = field(default_factory=list)
    numbers: dict[bytes, int] = field(default_factory=dict)

    def gaps(self, start: int | None = None) -> int:
        """Messages missing by their regular times: between others, and since ``start`` (ns)."""
        pairs = [b - a for a, b in zip(self.stamps[:-1], self.stamps[1:]) if b > a]
        if not pairs:
            return 0
        interval = min(pairs)
        before = 0 if start is None else max(0, round((self.stamps[0] - start) / interval))
        return before + sum(round(pair / interval) - 1 for pair in pairs)


class Listener:
    """Puts the messages of a simulator into recordings.

    Parameters
    ----------
    path, storage
        Of the recording; when simulation time begins anew a second one gets the suffix ``_1``.
    topics
        Absolute name -> topic.
    """

    def __init__(
        self, path: str | os.PathLike[str], storage: str, topics: Mapping[str, Topic]
    ) -> None:
        self.path = Path(path)
        self.storage = storage
        self.topics = dict(topics)
        self.closed: list[Path] = []
        self.final = False
        self._names = {topic.name: name for name, topic in self.topics.items()}
        self._begin()

    def _begin(self) -> None:
        path = self.path
        if self.closed:
            path = path.with_name(f"{path.name}_{len(self.closed)}")
        manifest_name = self._manifest_name()
        self.recorder = RunRecorder(path, self.storage, {manifest_name: MANIFEST, **self.topics})
        self.manifest = Manifest(settings={"recorded_by": "listener", "storage": self.storage})
        self.heard = {name: Heard() for name in self.topics}
        self.last_stamp = 0
        self.last_time = time.monotonic()
        self.final_stamp: int | None = None
        self.final_time = 0.0
        self._held: list[tuple[str, int, bytes]] | None = []
        self._hold_until: float | None = None

    def _manifest_name(self) -> str:
        name = next(iter(self.topics), "/x")
        return f"{name.rpartition('/')[0]}/{MANIFEST.name}"

    # --- messages ----------------------------------------------------------------------------

    def take(self, name: str, data: bytes, info: Mapping[str, Any]) -> None:
        """Take a message as it came: topic, CDR bytes, what the middleware says of it."""
        topic = self.topics[name]
        stamp = message_stamp(topic, data, self.last_stamp)
        if topic.name in STATE_TOPICS and stamp < self.last_stamp - BACKWARD:
            self._roll()
        heard = self.heard[name]
        heard.received += 1
        self._count(heard, info)
        if topic.name in STATE_TOPICS:
            heard.stamps.append(stamp)
            self.last_stamp = max(self.last_stamp, stamp)
        now = time.monotonic()
        if topic.name not in IDLE_TOPICS:
            self.last_time = now
        self._note(topic.name, data)
        if self._held is None:
            self.recorder.write(name, stamp, data)
            return
        if self._hold_until is None:
            self._hold_until = now + HOLD
        self._held.append((name, stamp, data))
        self.release()

    @staticmethod
    def _count(heard: Heard, info: Mapping[str, Any]) -> None:
        number = info.get("publication_sequence_number")
        publisher = info.get("publisher_gid") or {}
        if not number:
            return
        key = bytes(publisher.get("data", b"")) if isinstance(publisher, Mapping) else b""
        last = heard.numbers.get(key)
        if last is not None and number > last + 1:
            heard.lost += number - last - 1
        heard.numbers[key] = number

    def release(self) -> None:
        """Write what was held back, latched topics first, once they have come or time is up."""
        if self._held is None or self._hold_until is None:
            return
        seen = {name for name, _, _ in self._held}
        awaited = {self._names[n] for n in ("consist", "track") if n in self._names}
        if awaited <= seen or time.monotonic() >= self._hold_until:
            held, self._held = self._held, None
            for name, stamp, data in sorted(held, key=lambda m: not self.topics[m[0]].latched):
                self.recorder.write(name, stamp, data)

    def _roll(self) -> None:
        """Simulation time has begun anew: go on in a new recording.

        Latched messages of the new run may have come already; they belong into the new one.
        """
        self.close()
        self._begin()

    # --- what the manifest wants to know ------------------------------------------------------

    def _note(self, name: str, data: bytes) -> None:
        if name == "consist":
            message = deserialize(data, "derail_msgs/msg/Consist")
            self.manifest.software |= {
                "derail_ros": message.software_version,
                "engine_hash": message.engine_hash,
            }
            self.manifest.runs.append(
                RunEntry(
                    run_id=message.run_id,
                    scenario_name=message.scenario_name,
                    scenario_hash=message.scenario_hash,
                    scenario=yaml.safe_load(message.scenario_yaml) or {},
                    start_time=stamp_of(message),
                )
            )
        elif name == "command_log":
            message = deserialize(data, "derail_msgs/msg/CommandLog")
            for run in self.manifest.runs:
                if run.run_id == message.run_id:
                    entry = {
                        "command": message.command,
                        "request": message.request_json,
                        "step": int(message.step),
                        "time": float(message.time),
                    }
                    if message.accepted:
                        run.commands.append(entry)
                    else:
                        run.refused.append(entry | {"reason": message.message})
        elif name == "outcome":
            message = deserialize(data, "derail_msgs/msg/Outcome")
            self.final = bool(message.is_final) and message.status != STOPPED
            self.final_stamp = stamp_of(message) if self.final else None
            self.final_time = time.monotonic()
            for run in self.manifest.runs:
                if run.run_id == message.run_id:
                    run.status = message.status_name
                    run.time, run.steps = float(message.time), int(message.step)
                    run.outcome = {
                        "cars_derailed": int(message.cars_derailed),
                        "derailed_cars": message.derailed_cars.tolist(),
                        "duration": float(message.duration),
                        "peak_force": float(message.peak_corner_force),
                        "peak_force_pair": [int(message.peak_car_a), int(message.peak_car_b)],
                        "scene_length": float(message.scene_length),
                        "scene_width": float(message.scene_width),
                    }

    def complete(self, settle: float) -> bool:
        """Whether the final outcome is there, and the last states, and nothing more comes."""
        if self.final_stamp is None:
            return False
        quiet = time.monotonic() - self.last_time
        reached = all(
            not heard.stamps or heard.stamps[-1] >= self.final_stamp
            for name, heard in self.heard.items()
            if self.topics[name].name in STATE_TOPICS
        )
        # Markers go on while nothing moves, so what counts is that the states have come.
        waited = time.monotonic() - self.final_time
        return reached and waited >= settle or quiet >= 4.0 * settle

    # --- the end -----------------------------------------------------------------------------

    def report(self) -> dict[str, dict[str, int]]:
        """Messages received and missed, by topic."""
        start = self.manifest.runs[0].start_time if self.manifest.runs else None
        return {
            name: {"received": h.received, "lost": h.lost, "gaps": h.gaps(start)}
            for name, h in self.heard.items()
        }

    def close(self) -> None:
        """Close the recording whole."""
        if self.recorder.path in self.closed:
            return
        if self._held:
            self._hold_until = 0.0
            self.release()
        self.manifest.settings["missed"] = self.report()
        self.recorder.close(self.manifest)
        self.closed.append(self.recorder.path)
