"""Recordings made whole: all messages that can still be read, in a new recording."""

from __future__ import annotations

import dataclasses
import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from derail_ros.recording.files import add_topic, bag_writer
from derail_ros.recording.gathered import TELLING, gathered
from derail_ros.recording.manifest import CUSTOM_DATA, FILE_NAME
from derail_ros.recording.storage import BagError, Channel, RawBag, open_bag
from msg_adapters.definitions import deserialize, typestore
from msg_adapters.reports import jsonable
from msg_adapters.topics import MANIFEST, TOPICS, bag_qos


@dataclass(frozen=True)
class Repaired:
    """What a repair has done.

    Attributes
    ----------
    path : the new recording; the old one if there was nothing to repair
    counts : messages by topic
    first, last : their first and last time, ns
    warnings : what could not be read
    was_whole : there was nothing to repair: nothing was written
    """

    path: Path
    counts: dict[str, int]
    first: int
    last: int
    warnings: tuple[str, ...]
    was_whole: bool


def repair(bag: str | Path, output: Path | None = None) -> Repaired:
    """Write all that can be read of a recording into a new one; the old one stays as it is.

    Raises
    ------
    BagError
        If there is nothing to read, or the new one cannot be written.
    """
    from rosbags.rosbag2 import WriterError

    found = open_bag(bag)
    # Without index and metadata nothing that the file holds is left out.
    raw = dataclasses.replace(found, intact=False)
    if found.intact and (whole := _whole(raw)) is not None:
        return whole
    folder = raw.path
    if folder.is_file():
        folder = folder.with_name(folder.name.removesuffix(".zstd")).with_suffix("")
    target = folder.with_name(f"{folder.name}_repaired") if output is None else output
    if target.exists():
        raise BagError(f"{target}: exists already; name another folder with -o")
    try:
        writer = bag_writer(target, raw.storage)
        writer.open()
    except (WriterError, OSError) as error:
        raise BagError(f"{target}: {error}") from None
    counts: Counter[str] = Counter()
    manifest: dict[str, Any] | None = None
    telling: list[tuple[Channel, int, bytes]] = []
    first, last = 2**63 - 1, 0
    connections = {(c.topic, c.msgtype): _connect(writer, c) for c in raw.channels}
    try:
        for channel, stamp, data in raw.messages():
            key = (channel.topic, channel.msgtype)
            if key not in connections:
                connections[key] = _connect(writer, channel)
            writer.write(connections[key], stamp, data)
            counts[channel.topic] += 1
            first, last = min(first, stamp), max(last, stamp)
            if channel.name == MANIFEST.name and channel.msgtype == MANIFEST.msgtype:
                manifest = _manifest(data) or manifest
            if channel.msgtype in TELLING:
                telling.append((channel, stamp, data))
        if not counts:
            raise BagError(f"{raw.path}: no message in it can be read")
        if manifest is None and (runs := gathered(telling)).runs:
            manifest = dataclasses.asdict(runs)
        if manifest is not None:
            manifest.setdefault("settings", {})["repaired"] = True
            manifest["messages"] = dict(counts)
            manifest = jsonable(manifest)  # Python reads the NaN that JSON does not have
            writer.set_custom_data(CUSTOM_DATA, json.dumps(manifest, indent=1, allow_nan=False))
        writer.close()
    except BaseException:
        writer.abort()
        raise
    if manifest is not None:
        text = json.dumps(manifest, indent=1, allow_nan=False)
        (target / FILE_NAME).write_text(text + "\n", encoding="utf-8")
    warnings = tuple(w for w in raw.warnings if "derail repair" not in w)
    return Repaired(target, dict(counts), first, last, warnings, False)


def _whole(raw: RawBag) -> Repaired | None:
    """The account of a recording with index and metadata, ``None`` if it is damaged inside."""
    counts: Counter[str] = Counter()
    first, last = 2**63 - 1, 0
    for channel, stamp, _ in raw.messages():
        counts[channel.topic] += 1
        first, last = min(first, stamp), max(last, stamp)
    if raw.warnings or not counts:
        return None
    return Repaired(raw.path, dict(counts), first, last, (), True)


def _manifest(data: bytes) -> dict[str, Any] | None:
    try:
        value = json.loads(deserialize(data, MANIFEST.msgtype).data)
    except Exception:  # a damaged manifest is no reason to lose the rest
        return None
    return value if isinstance(value, dict) else None


def _connect(writer: Any, channel: Channel) -> Any:
    """Announce a topic as it was; what the recording does not say comes from our own table."""
    qos = list(channel.qos)
    known = TOPICS.get(channel.name) or (MANIFEST if channel.name == MANIFEST.name else None)
    if not qos and known is not None:
        qos = [bag_qos(known)]
    if channel.msgtype in typestore().fielddefs:
        return add_topic(writer, channel.topic, channel.msgtype, qos)
    return writer.add_connection(
        channel.topic,
        channel.msgtype,
        msgdef=channel.definition,
        rihs01=channel.digest,
        offered_qos_profiles=qos,
    )
