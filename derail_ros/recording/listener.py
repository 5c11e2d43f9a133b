"""How the node ``recorder`` handles the messages it receives, without ROS.

A subscriber can miss messages, unlike the simulator's own recording. The listener counts what it
missed in two ways: by the sequence numbers that the middleware gives to the messages of each
publisher, and by the regular times of the state messages.
"""

from __future__ import annotations

import functools
import math
import os
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from derail_ros.recording.channels import Channel
from derail_ros.recording.manifest import Manifest
from derail_ros.recording.recorder import RunRecorder
from derail_ros.recording.run_messages import Collector
from msg_adapters.common import NANOSECONDS, stamp_of, stamp_of_bytes
from msg_adapters.definitions import deserialize, fields_of
from msg_adapters.topics import EVERYWHERE, MANIFEST, STATE_TOPICS, Topic

HOLD = 2.0
"""Longest wall time for which other messages wait for the train and the track, s."""
STRAGGLERS = 2.0
"""Wall time for which an old recording stays open for late messages, s."""
BACKWARD = NANOSECONDS
"""Simulation time that jumps back by more than this has begun anew, ns."""
FOREIGN = 10 * NANOSECONDS
"""Other nodes stamp what they send on topics of the whole graph with wall time, ns."""
TIMED = ("std_msgs/msg/Header", "builtin_interfaces/msg/Time")
STOPPED = 5
"""Status in ``derail_msgs/Outcome`` of a run that a command has ended."""
DESCRIBING = ("consist", "command_log", "outcome")
"""Topics that the manifest is derived from."""
IDLE_TOPICS = ("/diagnostics", "/clock", "markers")
"""Topics that are published while nothing happens."""
SILENCE = 1.25
"""Wall time without a message after which a process is regarded as gone, s: a simulator sends
diagnostics every second. Another one then takes its place; before, the two publish at once."""
PARTICIPANT = 12
"""Bytes of a publisher's identity that those of one process share (DDSI-RTPS 2.5, 9.3.1)."""


def message_stamp(topic: Topic, data: bytes, otherwise: int) -> int:
    """Simulation time of a serialised message, ns; ``otherwise`` if it carries none.

    On a topic of the whole graph a time that is far from ``otherwise``, if that is known, is that
    of another node.
    """
    where = _where_time_is(topic.msgtype)
    # After the encapsulation a time, or a count and then messages that begin with one.
    if where == "none" or (where == "array" and len(data) <= 24):
        return otherwise
    stamp = stamp_of_bytes(data if where == "first" else data[:4] + data[8:16])
    return otherwise if otherwise > 0 and is_foreign(topic, stamp, otherwise) else stamp


def is_foreign(topic: Topic, stamp: int, now: int) -> bool:
    """Whether a time (ns) is none of the simulator, whose time is about ``now``."""
    return topic.name in EVERYWHERE and abs(stamp - now) > FOREIGN


@functools.cache
def _where_time_is(msgtype: str) -> str:
    """Where in a message its time is: ``first``, first in an ``array``, or ``none``."""
    kind = fields_of(msgtype)[0][1]
    if kind in TIMED:
        return "first"
    array = kind.endswith("[]") and "/" in kind and fields_of(kind[:-2])[0][1] in TIMED
    return "array" if array else "none"


def message_run(topic: Topic, data: bytes) -> str:
    """Identity of the run that a serialised message belongs to, "" if it has none."""
    if not topic.msgtype.startswith("derail_msgs/"):
        return ""
    order: Literal["little", "big"] = "little" if data[1] & 1 else "big"
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
class TopicCount:
    """Messages of one topic."""

    received: int = 0
    lost: int = 0  # missing by the middleware's sequence numbers
    # process -> times of its messages, ns (state topics only)
    stamps: dict[bytes, list[int]] = field(default_factory=dict)

    def gaps(self, starts: Mapping[bytes, int]) -> int:
        """Messages missing by their regular times: between others, and since a run's start.

        ``starts`` : process -> start of its first run, ns
        """
        missing = 0
        for process, stamps in self.stamps.items():
            pairs = [b - a for a, b in zip(stamps[:-1], stamps[1:]) if b > a]
            if not pairs:
                continue
            interval = min(pairs)
            start = starts.get(process, stamps[0])
            missing += max(0, round((stamps[0] - start) / interval))
            missing += sum(round(pair / interval) - 1 for pair in pairs)
        return missing

    @property
    def last(self) -> int | None:
        """Largest of the times, ns; None without any."""
        return max((stamps[-1] for stamps in self.stamps.values()), default=None)


class _OpenRecording:
    """One recording being written, and the runs in it."""

    def __init__(self, path: Path, storage: str, topics: Mapping[str, Topic]) -> None:
        first = next(iter(topics), "/")
        manifest_topic = f"{first.rpartition('/')[0]}/{MANIFEST.name}"
        self.topics = topics
        # Stamps do not bound how late a message may arrive: order by wall time alone.
        self.recorder = RunRecorder(
            path, storage, {manifest_topic: MANIFEST, **topics}, late=math.inf
        )
        self.manifest = Manifest(settings={"recorded_by": "listener", "storage": storage})
        self._collector = Collector()
        self.counts = {name: TopicCount() for name in topics}
        self.runs: set[str] = set()
        self.last_stamps: dict[bytes, int] = {}
        self.last_of: dict[tuple[str, bytes], int] = {}
        self._starts: dict[bytes, int] = {}
        self._awaited = {n for n, t in topics.items() if t.name in ("consist", "track")}
        self._held: list[tuple[str, int, bytes]] | None = []
        self._hold_until = math.inf

    @property
    def moment(self) -> int:
        """Simulation time of what carries none, ns; 0 before any is known."""
        return max([self.last_stamp, *self._starts.values()])

    def add(self, name: str, topic: Topic) -> None:
        """Take one more topic."""
        self.recorder.add(name, topic)
        self.counts[name] = TopicCount()

    @property
    def last_stamp(self) -> int:
        """Latest simulation time of all states, ns."""
        return max(self.last_stamps.values(), default=0)

    def write(self, name: str, stamp: int, data: bytes, now: float, process: bytes = b"") -> None:
        """Write a message, or hold it until the train and the track have arrived."""
        topic = self.topics[name]
        counted = self.counts[name]
        counted.received += 1
        if topic.name in STATE_TOPICS and self.last_of.get((topic.name, process)) == stamp:
            return  # sent again while the run stands still, for others
        self.last_of[topic.name, process] = stamp
        if topic.name in STATE_TOPICS:
            counted.stamps.setdefault(process, []).append(stamp)
            self.last_stamps[process] = max(self.last_stamps.get(process, 0), stamp)
        if topic.name == "consist":
            self._starts.setdefault(process, stamp)
        if topic.name in DESCRIBING:
            self._collector.take(Channel(name, topic.msgtype), data)
        if self._held is None:
            self.recorder.write(name, stamp, data)
            return
        self._hold_until = min(self._hold_until, now + HOLD)
        self._held.append((name, stamp, data))
        self.release(now)

    def release(self, now: float) -> None:
        """Write held messages whose wait has ended, by time, of equal times latched ones first."""
        if self._held is None:
            return
        if now >= self._hold_until or self._awaited <= {name for name, _, _ in self._held}:
            own = [s for n, s, _ in self._held if s and self.topics[n].name not in EVERYWHERE]
            first = min(own, default=0)
            held = [
                (n, first if s == 0 or (own and is_foreign(self.topics[n], s, first)) else s, data)
                for n, s, data in self._held
            ]
            for message in sorted(held, key=lambda m: (m[1], not self.topics[m[0]].latched)):
                self.recorder.write(*message)
            self._held = None

    def report(self) -> dict[str, dict[str, int]]:
        """Messages received and missed, by topic."""
        return {
            name: {"received": c.received, "lost": c.lost, "gaps": c.gaps(self._starts)}
            for name, c in self.counts.items()
        }

    def close(self) -> None:
        """Write the rest, the index and the manifest."""
        self.release(math.inf)
        derived = self._collector.derived_manifest()
        self.manifest.runs = derived.runs
        self.manifest.software |= derived.software
        self.manifest.settings["missed"] = self.report()
        self.recorder.close(self.manifest)


class Listener:
    """Puts the messages of a simulator into recordings.

    Parameters
    ----------
    path, storage : of the recording; when simulation time begins anew a second one gets the suffix
        ``_1``
    topics : absolute name -> topic

    Attributes
    ----------
    closed : folders of the recordings that are closed
    reports : of each closed recording: messages received and missed, by topic
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
        self._alive: dict[bytes, float] = {}
        self._opened = 0
        self._current = self._open()
        self._old: _OpenRecording | None = None
        self._old_until = 0.0

    def _open(self) -> _OpenRecording:
        path = self.path
        if self._opened:
            path = path.with_name(f"{path.name}_{self._opened}")
        self._opened += 1
        return _OpenRecording(path, self.storage, self.topics)

    def add(self, name: str, topic: Topic) -> None:
        """Take one more topic, under its absolute name, from now on."""
        self.topics[name] = topic
        for recording in filter(None, (self._current, self._old)):
            recording.add(name, topic)

    # --- messages ----------------------------------------------------------------------------

    def take(self, name: str, data: bytes, info: Mapping[str, Any]) -> None:
        """Take a message: topic, CDR bytes, what the middleware says of it."""
        topic = self.topics[name]
        now = time.monotonic()
        publisher = info.get("publisher_gid")
        identity = bytes(publisher.get("data", b"") if isinstance(publisher, Mapping) else b"")
        process = identity[:PARTICIPANT]
        stamp = message_stamp(topic, data, self._current.moment)
        recording = self._recording_of(topic, message_run(topic, data), stamp, now, process)
        self._alive[process] = now
        number = info.get("publication_sequence_number") or 0
        recording.counts[name].lost += self._missing(name, identity, number)
        recording.write(name, stamp, data, now, process)
        if topic.name not in IDLE_TOPICS:
            self.last_time = now
        if topic.name == "outcome" and recording is self._current:
            message = deserialize(data, topic.msgtype)
            final = message.is_final and message.status != STOPPED
            self.final_stamp = stamp_of(message) if final else None
            self.final_time = now

    def _recording_of(
        self, topic: Topic, run_id: str, stamp: int, now: float, process: bytes
    ) -> _OpenRecording:
        """The recording that a message belongs to; a new one when time has begun anew.

        Topics arrive in no order among each other: a message of the old run may arrive after the
        first one of the new. Two simulators that publish at once have their times each; they do
        not make each other's time begin anew.
        """
        current, old = self._current, self._old
        last = current.last_stamps.get(process)
        if last is None:
            others = (p for p, when in self._alive.items() if now < when + SILENCE)
            last = 0 if any(p in current.last_stamps for p in others) else current.last_stamp
        anew = stamp < last - BACKWARD
        if run_id:
            if run_id in current.runs:
                return current
            if old is not None and run_id in old.runs:
                return old
            if anew and current.runs:
                current = self._begin_anew(now, process, stamp)
            current.runs.add(run_id)
        elif topic.name in (*STATE_TOPICS, "markers"):
            if process in current.last_stamps:
                # Fast runs bring topics seconds apart; each topic by itself is in order.
                own = current.last_of.get((topic.name, process), 0)
                anew = stamp < own - BACKWARD
            if anew:
                return self._begin_anew(now, process, stamp)
            before = math.inf if old is None else old.last_of.get((topic.name, process), math.inf)
            if old is not None and stamp > last + BACKWARD and stamp >= before:
                return old
        return current

    def _begin_anew(self, now: float, process: bytes, stamp: int) -> _OpenRecording:
        """Go on in a new recording."""
        self._close_old()
        self._old, self._old_until = self._current, now + STRAGGLERS
        self._current = self._open()
        self._current.last_stamps[process] = stamp
        self.final_stamp = None
        return self._current

    def _missing(self, name: str, identity: bytes, number: int) -> int:
        """Number of messages that a publisher has sent since its last one that arrived."""
        if not number:
            return 0
        key = (name, identity)
        last = self._numbers.get(key, number)
        self._numbers[key] = number
        return max(0, number - last - 1)

    def release(self) -> None:
        """Write held messages and close an old recording when their time has come."""
        now = time.monotonic()
        self._current.release(now)
        if now >= self._old_until:
            self._close_old()

    # --- the end -----------------------------------------------------------------------------

    @property
    def empty(self) -> bool:
        """Whether no message has arrived so far."""
        return self._opened == 1 and not any(c.received for c in self._current.counts.values())

    def complete(self, settle: float) -> bool:
        """Whether the final outcome and the last states are there, and nothing more arrives.

        Parameters
        ----------
        settle : wall time without a new message after which nothing more is expected, s
        """
        if self.final_stamp is None:
            return False
        now = time.monotonic()
        reached = all(
            counted.last is None or counted.last >= self.final_stamp
            for counted in self._current.counts.values()
        )
        # The states of a failed run never reach its outcome: then quiet decides.
        return (reached and now >= self.final_time + settle) or (
            now >= self.last_time + 4.0 * settle
        )

    def _finish(self, recording: _OpenRecording) -> None:
        recording.close()
        self.closed.append(recording.recorder.path)
        self.reports.append(recording.report())

    def _close_old(self) -> None:
        if self._old is not None:
            self._finish(self._old)
            self._old = None

    def close(self) -> None:
        """Close all recordings."""
        self._close_old()
        if self._current.recorder.path not in self.closed:
            self._finish(self._current)
