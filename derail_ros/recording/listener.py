"""What the ``recorder`` node does with what it hears; no ROS in here.

A listener can miss messages, unlike the simulator's own recording. It counts what it missed in
two ways: by the numbers that the middleware gives to the messages of each publisher, and by the
regular times of the state messages.
"""

from __future__ import annotations

import heapq
import math
import os
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from derail_ros.recording.gathered import gather
from derail_ros.recording.manifest import Manifest
from derail_ros.recording.recorder import RunRecorder
from msg_adapters.common import NANOSECONDS, stamp_of, stamp_of_bytes
from msg_adapters.definitions import deserialize
from msg_adapters.topics import MANIFEST, STATE_TOPICS, Topic

HOLD = 2.0
"""Wall time for which other messages wait for the latched ones, s."""
ORDER = 0.25
"""Wall time for which messages wait for earlier ones of other topics, s."""
STRAGGLERS = 2.0
"""Wall time for which an old recording stays open for what comes late, s."""
BACKWARD = NANOSECONDS
"""Simulation time that jumps back further than this (ns) has begun anew."""
STOPPED = 5
"""Status of an outcome (``derail_msgs/Outcome``) that a command has ended."""
IDLE_TOPICS = ("/diagnostics", "/clock", "markers")
"""Topics that go on while nothing happens."""


def message_stamp(topic: Topic, data: bytes, otherwise: int) -> int:
    """Simulation time of a serialised message, ns."""
    if topic.msgtype == "visualization_msgs/msg/MarkerArray":
        # After the encapsulation a count, then markers that begin with a header.
        return stamp_of_bytes(data[:4] + data[8:16]) if len(data) > 24 else otherwise
    if topic is MANIFEST:
        return otherwise
    return stamp_of_bytes(data)


def message_run(topic: Topic, data: bytes) -> str:
    """Identity of the run that a serialised message belongs to, "" if it does not say."""
    if not topic.msgtype.startswith("derail_msgs/"):
        return ""
    order = "little" if data[1] & 1 else "big"
    # After the encapsulation: header (8 bytes of time, then frame_id), run_id; texts are aligned
    # to 4 and end with a zero.
    at = 12
    for _ in range(2):
        at += -at % 4
        length = int.from_bytes(data[at : at + 4], order)
        text = data[at + 4 : at + 3 + length]
        at += 4 + length
    return text.decode()


@dataclass
class Heard:
    """What was heard of a topic.

    Attributes
    ----------
    received : messages
    lost : messages that the middleware's numbers show to be missing
    stamps : times of the messages, ns (state topics)
    """

    received: int = 0
    lost: int = 0
    stamps: list[int] = field(default_factory=list)

    def gaps(self, start: int | None = None) -> int:
        """Messages missing by their regular times: between others, and since ``start`` (ns)."""
        pairs = [b - a for a, b in zip(self.stamps[:-1], self.stamps[1:]) if b > a]
        if not pairs:
            return 0
        interval = min(pairs)
        before = 0 if start is None else max(0, round((self.stamps[0] - start) / interval))
        return before + sum(round(pair / interval) - 1 for pair in pairs)


class _Bag:
    """One recording and what is known of its runs."""

    def __init__(self, path: Path, storage: str, topics: Mapping[str, Topic]) -> None:
        first = next(iter(topics), "/")
        manifest_topic = f"{first.rpartition('/')[0]}/{MANIFEST.name}"
        self.topics = topics
        self.recorder = RunRecorder(path, storage, {manifest_topic: MANIFEST, **topics}, 0)
        self.manifest = Manifest(settings={"recorded_by": "listener", "storage": storage})
        self.heard = {name: Heard() for name in topics}
        self.runs: set[str] = set()
        self.last_stamp = 0
        self._awaited = {n for n, t in topics.items() if t.name in ("consist", "track")}
        self._held: list[tuple[str, int, bytes]] | None = []
        self._hold_until: float | None = None
        self._waiting: list[tuple[int, int, float, str, bytes]] = []
        self._taken = 0

    def write(self, name: str, stamp: int, data: bytes, now: float) -> None:
        """Write a message, or hold it back until the latched topics have come."""
        topic = self.topics[name]
        heard = self.heard[name]
        heard.received += 1
        if topic.name in STATE_TOPICS:
            heard.stamps.append(stamp)
            self.last_stamp = max(self.last_stamp, stamp)
        gather(self.manifest, topic.msgtype, data)
        if self._held is None:
            # Taking is quick, so that no publisher runs ahead; writing is done in release.
            self._queue(name, stamp, data, now)
            return
        if self._hold_until is None:
            self._hold_until = now + HOLD
        self._held.append((name, stamp, data))
        self.release(now)

    def release(self, now: float) -> None:
        """Write what has waited long enough: first the latched topics, then by time."""
        held, until = self._held, self._hold_until
        if (
            held is not None
            and until is not None
            and (now >= until or self._awaited <= {name for name, _, _ in held})
        ):
            self._held = None
            for message in sorted(held, key=lambda m: not self.topics[m[0]].latched):
                self._queue(*message, now)
        self._write_until(now - ORDER)

    def _queue(self, name: str, stamp: int, data: bytes, now: float) -> None:
        """Put a message in its place; those of equal times stay in the order they came in."""
        self._taken += 1
        heapq.heappush(self._waiting, (stamp, self._taken, now, name, data))

    def _write_until(self, moment: float) -> None:
        """Write what came before a moment (wall time), and what is earlier than that."""
        while self._waiting and self._waiting[0][2] <= moment:
            stamp, _, _, name, data = heapq.heappop(self._waiting)
            self.recorder.write(name, stamp, data)

    def report(self) -> dict[str, dict[str, int]]:
        """Messages received and missed, by topic."""
        start = self.manifest.runs[0].start_time if self.manifest.runs else None
        return {
            name: {"received": h.received, "lost": h.lost, "gaps": h.gaps(start)}
            for name, h in self.heard.items()
        }

    def close(self) -> None:
        """Close the recording whole."""
        if self._held:
            self._hold_until = 0.0
            self.release(0.0)
        self._write_until(math.inf)
        self.manifest.settings["missed"] = self.report()
        self.recorder.close(self.manifest)


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
        self.reports: list[dict[str, dict[str, int]]] = []
        self.last_time = time.monotonic()
        self.final_stamp: int | None = None
        self.final_time = 0.0
        self._numbers: dict[tuple[str, bytes], int] = {}
        self._bags = 0
        self._bag = self._open()
        self._old: tuple[_Bag, float] | None = None

    def _open(self) -> _Bag:
        path = self.path
        if self._bags:
            path = path.with_name(f"{path.name}_{self._bags}")
        self._bags += 1
        return _Bag(path, self.storage, self.topics)

    # --- messages ----------------------------------------------------------------------------

    def take(self, name: str, data: bytes, info: Mapping[str, Any]) -> None:
        """Take a message as it came: topic, CDR bytes, what the middleware says of it."""
        topic = self.topics[name]
        now = time.monotonic()
        stamp = message_stamp(topic, data, self._bag.last_stamp)
        bag = self._bag_of(topic, message_run(topic, data), stamp, now)
        bag.heard[name].lost += self._missing(name, info)
        bag.write(name, stamp, data, now)
        if topic.name not in IDLE_TOPICS:
            self.last_time = now
        if topic.name == "outcome" and bag is self._bag:
            self._look_for_the_end(data, now)

    def _bag_of(self, topic: Topic, run_id: str, stamp: int, now: float) -> _Bag:
        """The recording that a message belongs to; a new one when time has begun anew.

        Topics come in no order among each other: a message of the old run may come after the
        first one of the new.
        """
        bag = self._bag
        anew = stamp < bag.last_stamp - BACKWARD
        if run_id:
            if run_id in bag.runs:
                return bag
            if self._old is not None and run_id in self._old[0].runs:
                return self._old[0]
            if anew and bag.runs:
                bag = self._roll(now)
            bag.runs.add(run_id)
            return bag
        if topic.name in (*STATE_TOPICS, "markers"):
            if anew:
                return self._roll(now)
            if self._old is not None and stamp > bag.last_stamp + BACKWARD:
                return self._old[0]
        return bag

    def _roll(self, now: float) -> _Bag:
        """Simulation time has begun anew: go on in a new recording."""
        self._close_old()
        self._old = (self._bag, now + STRAGGLERS)
        self._bag = self._open()
        self.final_stamp = None
        return self._bag

    def _missing(self, name: str, info: Mapping[str, Any]) -> int:
        """Number of messages that a publisher has sent since its last one that came."""
        number = info.get("publication_sequence_number")
        if not number:
            return 0
        publisher = info.get("publisher_gid")
        identity = publisher.get("data", b"") if isinstance(publisher, Mapping) else b""
        key = (name, bytes(identity))
        last = self._numbers.get(key)
        self._numbers[key] = number
        return 0 if last is None else max(0, number - last - 1)

    def release(self) -> None:
        """Do what time has come for: held messages, an old recording."""
        now = time.monotonic()
        self._bag.release(now)
        if self._old is not None and now >= self._old[1]:
            self._close_old()

    # --- the end -----------------------------------------------------------------------------

    @property
    def empty(self) -> bool:
        """Whether nothing has come so far."""
        return self._bags == 1 and not any(h.received for h in self._bag.heard.values())

    def _look_for_the_end(self, data: bytes, now: float) -> None:
        message = deserialize(data, "derail_msgs/msg/Outcome")
        final = message.is_final and message.status != STOPPED
        self.final_stamp = stamp_of(message) if final else None
        self.final_time = now

    def complete(self, settle: float) -> bool:
        """Whether the final outcome is there, and the last states, and nothing more comes."""
        if self.final_stamp is None:
            return False
        now = time.monotonic()
        reached = all(
            not heard.stamps or heard.stamps[-1] >= self.final_stamp
            for name, heard in self._bag.heard.items()
            if self.topics[name].name in STATE_TOPICS
        )
        # The states of a failed run never reach its outcome: then quiet decides.
        return (reached and now >= self.final_time + settle) or (
            now >= self.last_time + 4.0 * settle
        )

    def _finish(self, bag: _Bag) -> None:
        bag.close()
        self.closed.append(bag.recorder.path)
        self.reports.append(bag.report())

    def _close_old(self) -> None:
        if self._old is not None:
            self._finish(self._old[0])
            self._old = None

    def close(self) -> None:
        """Close the recordings whole."""
        self._close_old()
        if self._bag.recorder.path not in self.closed:
            self._finish(self._bag)
