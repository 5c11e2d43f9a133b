"""Writing of rosbag2 recordings, without ROS and without loss.

Messages are handed over as CDR bytes and written by a thread of their own. Chunks reach the disk
at least every second: of a recording whose writer was killed, everything up to then can be read
by a scan of the file.
"""

from __future__ import annotations

import contextlib
import heapq
import math
import os
import queue
import threading
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from rosbags.rosbag2 import WriterError

from derail_ros.recording.files import STORAGE, add_topic, bag_writer
from derail_ros.recording.manifest import CUSTOM_DATA, FILE_NAME, Manifest
from msg_adapters.common import NANOSECONDS
from msg_adapters.definitions import serialize
from msg_adapters.reports import string
from msg_adapters.topics import MANIFEST, TOPICS, Topic, bag_qos

FLUSH_EVERY = 1.0
"""Wall time after which what was handed over is on disk at the latest, s."""
LATE = NANOSECONDS // 4
"""Simulation time for which messages wait for earlier ones, ns: that a contact's peak is one is
known up to 0.17 s later (Mississauga)."""
LATE_WALL = 0.5 * FLUSH_EVERY
"""Wall time for which they wait at most, s."""
QUEUE_SIZE = 20_000
"""Messages that may wait; beyond, the caller waits: nothing is dropped."""

_CLOSE, _ADD = object(), object()


class RecordingError(RuntimeError):
    """A recording cannot be begun or continued."""


def absolute(name: str, namespace: str = "") -> str:
    """Absolute name of a topic in a namespace."""
    if name.startswith("/"):
        return name
    return "/".join(["", *filter(None, namespace.split("/")), name])


class RunRecorder:
    """A rosbag2 recording being written.

    Parameters
    ----------
    path : folder of the recording; it must not exist
    storage : ``"mcap"`` or ``"sqlite3"``
    topics : topics of the recording under the names that they have there: name -> topic. All are
        announced at the beginning, latched ones first, so a topic without messages is there too.
        Default: those that the simulator records.
    late : simulation time for which messages wait for earlier ones, so that the file is in order
        of time, ns. They wait no longer than half a second of wall time.

    Raises
    ------
    RecordingError
        If the recording cannot be begun.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        storage: str = "mcap",
        topics: dict[str, Topic] | None = None,
        late: float = LATE,
    ) -> None:
        if storage not in STORAGE:
            raise RecordingError(f"storage must be one of {', '.join(STORAGE)}, got {storage!r}")
        self.path = Path(path)
        self.storage = storage
        self.topics = recorded_topics() if topics is None else dict(topics)
        self.counts: dict[str, int] = dict.fromkeys(self.topics, 0)
        self._late = late
        self._last_stamp = 0
        try:
            self._writer = bag_writer(self.path, storage)
        except WriterError as error:
            raise RecordingError(str(error)) from error
        self._queue: queue.Queue[Any] = queue.Queue(QUEUE_SIZE)
        self._failure: BaseException | None = None
        self._closed = False
        self._ready = threading.Event()
        # The thread opens the bag too: an sqlite3 connection belongs to one thread.
        self._thread = threading.Thread(target=self._run, name="bag-writer", daemon=True)
        self._thread.start()
        self._ready.wait()
        self._check()

    def _check(self) -> None:
        if self._failure is not None:
            raise RecordingError(f"{self.path}: {self._failure}") from self._failure

    def add(self, name: str, topic: Topic) -> None:
        """Announce one more topic.

        Raises
        ------
        RecordingError
            If an earlier message could not be written.
        """
        self._check()
        self.topics[name], self.counts[name] = topic, 0
        self._put((_ADD, 0, (name, topic)))

    def write(self, topic: str, stamp: int, data: bytes) -> None:
        """Hand over a message: its topic's name, its time (ns) and its CDR bytes.

        Raises
        ------
        RecordingError
            If an earlier message could not be written.
        """
        self._check()
        if self._closed:
            raise RecordingError(f"{self.path} is closed")
        self.counts[topic] += 1
        self._last_stamp = max(self._last_stamp, stamp)
        self._put((topic, stamp, data))

    def write_manifest(self, manifest: Manifest, stamp: int) -> None:
        """Write the manifest as a message; the last one counts."""
        name = self._manifest_topic()
        if name is not None:
            self.write(name, stamp, serialize(string(manifest.to_json())))

    def _manifest_topic(self) -> str | None:
        return next((name for name, t in self.topics.items() if t is MANIFEST), None)

    def _put(self, item: Any) -> None:
        while True:
            try:
                self._queue.put(item, timeout=1.0)
                return
            except queue.Full:
                self._check()

    def close(self, manifest: Manifest | None = None) -> None:
        """Write what is left, index and metadata, and the manifest beside and inside.

        Raises
        ------
        RecordingError
            If not everything could be written.
        """
        if self._closed:
            return
        if manifest is not None and self._failure is None:
            name = self._manifest_topic()
            manifest.messages = dict(self.counts)
            if name is not None:
                manifest.messages[name] += 1
            self.write_manifest(manifest, self._last_stamp)
        self._closed = True
        text = None if manifest is None else manifest.to_json()
        if self._failure is None:
            self._put((_CLOSE, 0, text))
        self._thread.join()
        self._check()
        if text is not None:
            place = self.path / FILE_NAME
            temporary = place.with_suffix(".json.tmp")
            temporary.write_text(text + "\n", encoding="utf-8")
            temporary.replace(place)

    def __enter__(self) -> RunRecorder:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # --- the writer's thread -----------------------------------------------------------------

    def _run(self) -> None:
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._writer.open()
            connections = {
                name: self._announce(name, topic) for name, topic in ordered(self.topics)
            }
        except BaseException as error:
            self._failure = error
            self._ready.set()
            return
        self._ready.set()
        try:
            self._write_all(connections)
        except BaseException as error:
            self._failure = error
            with contextlib.suppress(Exception):  # what cannot be written cannot be closed well
                self._writer.abort()

    def _announce(self, name: str, topic: Topic) -> Any:
        return add_topic(self._writer, name, topic.msgtype, [bag_qos(topic)])

    def _write_all(self, connections: dict[str, Any]) -> None:
        flush_at: float | None = None
        # By time; those of equal times stay in the order in which they came.
        waiting: list[tuple[int, int, float, str, bytes]] = []
        newest = taken = 0

        def write_until(stamp: float, moment: float) -> None:
            while waiting and (waiting[0][0] <= stamp or waiting[0][2] <= moment):
                when, _, _, name, content = heapq.heappop(waiting)
                self._writer.write(connections[name], when, content)

        while True:
            wait = None if flush_at is None else max(0.0, flush_at - time.monotonic())
            try:
                topic, stamp, data = self._queue.get(timeout=wait)
            except queue.Empty:
                topic = None
            now = time.monotonic()
            if topic is _CLOSE:
                write_until(math.inf, now)
                if data is not None:
                    self._writer.set_custom_data(CUSTOM_DATA, data)
                self._writer.close()
                return
            if topic is _ADD:
                connections[data[0]] = self._announce(*data)
            elif topic is not None:
                taken += 1
                newest = max(newest, stamp)
                heapq.heappush(waiting, (stamp, taken, now, topic, data))
                flush_at = now + 0.4 * FLUSH_EVERY if flush_at is None else flush_at
            write_until(newest - self._late, now - LATE_WALL)
            if flush_at is not None and now >= flush_at:
                self._flush()
                flush_at = now + 0.4 * FLUSH_EVERY if waiting else None

    def _flush(self) -> None:
        """Bring to disk what the writer still holds."""
        storage: Any = self._writer.storage
        if self.storage == "mcap":
            if storage.chunk.msgs:
                storage.close_chunk()
            storage.bio.flush()
        else:
            storage.conn.commit()


def recorded_topics(namespace: str = "") -> dict[str, Topic]:
    """The topics of a recording that the simulator makes, by absolute name."""
    topics = {MANIFEST.name: MANIFEST} | {n: t for n, t in TOPICS.items() if t.recorded}
    return {absolute(name, namespace): topic for name, topic in topics.items()}


def ordered(topics: dict[str, Topic]) -> Iterable[tuple[str, Topic]]:
    """Topics with the latched ones first, otherwise in the given order."""
    return sorted(topics.items(), key=lambda item: not item[1].latched)
