"""Repairs recordings: writes all messages that can still be read."""

from __future__ import annotations

import dataclasses
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from derail_ros.recording.channels import Channel, Span
from derail_ros.recording.decoding import version_of
from derail_ros.recording.files import add_topic, bag_writer
from derail_ros.recording.manifest import CUSTOM_DATA, FILE_NAME
from derail_ros.recording.recomputation import is_needed
from derail_ros.recording.run_messages import Collector
from derail_ros.recording.storage import BagError, RawBag, open_bag, repaired_name
from msg_adapters.definitions import VERSION, typestore
from msg_adapters.topics import MANIFEST, TOPICS, bag_qos


@dataclass(frozen=True)
class Repaired:
    """Result of a repair."""

    path: Path  # the new recording; the old one if it was whole
    counts: dict[str, int]  # messages by topic
    span: Span  # first and last time, ns
    warnings: tuple[str, ...]  # what could not be read
    was_whole: bool  # there was nothing to repair and nothing was written


class _Tally:
    """Counts the messages that pass through."""

    def __init__(self, raw: RawBag) -> None:
        self.raw = raw
        self.counts: Counter[str] = Counter()
        self.first, self.last = 2**63 - 1, 0

    def __iter__(self) -> Any:
        for message in self.raw.messages():
            channel, stamp, _ = message
            self.counts[channel.topic] += 1
            self.first, self.last = min(self.first, stamp), max(self.last, stamp)
            yield message

    def result(self, path: Path, was_whole: bool = False) -> Repaired:
        warnings = tuple(w for w in self.raw.warnings if "derail repair" not in w)
        return Repaired(path, dict(self.counts), (self.first, self.last), warnings, was_whole)


def repair(bag: str | Path, output: Path | None = None) -> Repaired:
    """Write all that can be read of a recording into a new one; the old one is not changed.

    Raises
    ------
    BagError
        If no message can be read, or the new recording cannot be written.
    """
    from rosbags.rosbag2 import WriterError

    found = open_bag(bag)
    # Reading without index and metadata leaves out nothing that the files hold.
    raw = dataclasses.replace(found, intact=False)
    if found.intact:
        whole = _Tally(raw)
        for _ in whole:
            pass
        if not raw.warnings and whole.counts:
            return whole.result(raw.path, was_whole=True)
    target = raw.path.with_name(repaired_name(raw.path)) if output is None else output
    if target.exists():
        raise BagError(f"{target}: exists already; name another folder with -o")
    try:
        writer = bag_writer(target, raw.storage)
        writer.open()
    except (WriterError, OSError) as error:
        raise BagError(f"{target}: {error}") from None
    tally = _Tally(raw)
    try:
        text = _copy(tally, writer)
        if text is not None:
            writer.set_custom_data(CUSTOM_DATA, text)
        writer.close()
    except BaseException:
        writer.abort()
        raise
    if text is not None:
        (target / FILE_NAME).write_text(text + "\n", encoding="utf-8")
    return tally.result(target)


def _copy(tally: _Tally, writer: Any) -> str | None:
    """Write all messages; the manifest as JSON, ``None`` if neither it nor a run is left."""
    collector = Collector()
    connections = {(c.topic, c.msgtype): _connect(writer, c) for c in tally.raw.channels}
    for channel, stamp, data in tally:
        key = (channel.topic, channel.msgtype)
        if key not in connections:
            connections[key] = _connect(writer, channel)
        writer.write(connections[key], stamp, data)
        if is_needed(channel):
            collector.take(channel, data)
    if not tally.counts:
        raise BagError(f"{tally.raw.path}: no message in it can be read")
    manifest = collector.manifest()
    if not manifest.runs:
        return None
    manifest.settings["repaired"] = True
    manifest.messages = dict(tally.counts)
    return manifest.to_json()


def _connect(writer: Any, channel: Channel) -> Any:
    """Announce a topic as it was; our own table says what the recording does not."""
    qos = list(channel.qos)
    known = MANIFEST if channel.is_manifest else TOPICS.get(channel.name)
    if not qos and known is not None:
        qos = [bag_qos(known)]
    if not channel.definition and channel.msgtype in typestore().fielddefs:
        version = version_of(channel) or VERSION
        return add_topic(writer, channel.topic, channel.msgtype, qos, version)
    return writer.add_connection(
        channel.topic,
        channel.msgtype,
        msgdef=channel.definition,
        rihs01=channel.digest,
        offered_qos_profiles=qos,
    )
