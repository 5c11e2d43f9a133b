"""Messages of one MCAP file: by its index, or record by record where it is damaged.

The parts of the format are read by ``mcap``. Its readers stop at the first damage; :func:`records`
walks over a file without an index, leaves out a broken chunk and ends where the file is cut off.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import zstandard
from lz4.frame import LZ4FrameDecompressor
from mcap import records as parts
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.stream_reader import get_chunk_data_stream
from mcap.summary import Summary

from derail_ros.recording.channels import Channel, Message, Span, Wanted, one_line, parse_profiles

MAGIC = b"\x89MCAP0\r\n"
LARGEST_RECORD = 1 << 29
"""A record that claims to be larger than this is taken for damage, bytes."""

Warn = Callable[[str], None]


def indexed_channels(file: Path) -> list[Channel] | None:
    """The topics by the index, ``None`` for a file without one.

    Raises
    ------
    Exception
        Of any kind, for a damaged file.
    """
    with file.open("rb") as stream:
        summary = _reader(stream).get_summary()
        if summary is None:
            return None
        if summary.chunk_indexes and not summary.channels:
            raise ValueError("an index without topics")
        return list(_channels(summary).values())


def indexed_messages(
    file: Path, wanted: Wanted, start: int | None = None, stop: int | None = None
) -> Iterator[Message]:
    """Messages in order of time, from ``start`` to before ``stop`` (ns).

    Raises
    ------
    Exception
        Of any kind, for a damaged file.
    """
    with file.open("rb") as stream:
        reader = _reader(stream)
        summary = reader.get_summary()
        channels = {} if summary is None else _channels(summary)
        topics = {c.topic for c in channels.values() if wanted(c)} if channels else None
        for schema, raw, message in reader.iter_messages(
            topics, starting_at=start, ending_before=stop
        ):
            if raw.id not in channels:
                channels[raw.id] = _channel(raw, {raw.schema_id: schema})
            if wanted(channels[raw.id]):
                yield channels[raw.id], message.log_time, message.data


def indexed_span(file: Path) -> Span | None:
    """First and last time (ns) by the index, ``None`` if there are no messages."""
    with file.open("rb") as stream:
        summary = _reader(stream).get_summary()
    statistics = None if summary is None else summary.statistics
    if statistics is None:
        times = [stamp for _, stamp, _ in indexed_messages(file, lambda _: True)]
        return (min(times), max(times)) if times else None
    if not statistics.message_count:
        return None
    return statistics.message_start_time, statistics.message_end_time


def scanned_channels(file: Path) -> list[Channel]:
    """The topics, from all that is left of a file."""
    return _Scan(file, lambda _: None).channels()


def scanned_messages(file: Path, wanted: Wanted, warn: Warn) -> Iterator[Message]:
    """All messages that are left of a file, in the order in which they were written."""
    return _Scan(file, warn).messages(wanted)


def _reader(stream: BinaryIO) -> SeekingReader:
    return SeekingReader(stream, validate_crcs=True, record_size_limit=LARGEST_RECORD)


def _channels(summary: Summary) -> dict[int, Channel]:
    return {key: _channel(c, summary.schemas) for key, c in summary.channels.items()}


def _channel(channel: parts.Channel, schemas: dict[int, Any]) -> Channel:
    schema = schemas.get(channel.schema_id)
    return Channel(
        topic=channel.topic,
        msgtype="" if schema is None else schema.name,
        definition="" if schema is None else schema.data.decode("utf-8", "replace"),
        qos=parse_profiles(channel.metadata.get("offered_qos_profiles", "")),
        digest=channel.metadata.get("topic_type_hash", ""),
    )


# --- without the index -------------------------------------------------------------------------


class _Scan:
    """One walk over the records of a file."""

    def __init__(self, file: Path, warn: Warn) -> None:
        self._file = file
        self._warn = warn
        self._schemas: dict[int, parts.Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._chunks: list[int] = []
        with suppress(Exception), file.open("rb") as stream:  # the index may be damaged as well
            if (summary := _reader(stream).get_summary()) is not None:
                self._schemas = summary.schemas
                self._channels = _channels(summary)
                self._chunks = sorted(c.chunk_start_offset for c in summary.chunk_indexes)

    def channels(self) -> list[Channel]:
        for op, data in self._records():
            self._announced(op, data)
        return list(self._channels.values())

    def messages(self, wanted: Wanted) -> Iterator[Message]:
        chosen: dict[int, bool] = {}
        for op, data in self._records():
            if op != Opcode.MESSAGE:
                self._announced(op, data)
                continue
            key, _, stamp = struct.unpack_from("<HIQ", data)
            channel = self._channels.get(key)
            if channel is not None and chosen.setdefault(key, wanted(channel)):
                yield channel, stamp, data[22:]

    def _announced(self, op: int, data: bytes) -> None:
        """Keep a schema or a channel."""
        try:
            if op == Opcode.SCHEMA:
                schema = parts.Schema.read(ReadDataStream(BytesIO(data)))
                self._schemas[schema.id] = schema
            elif op == Opcode.CHANNEL:
                channel = parts.Channel.read(ReadDataStream(BytesIO(data)))
                self._channels.setdefault(channel.id, _channel(channel, self._schemas))
        except Exception as error:  # damage may take any form
            self._warn(f"the description of a topic is damaged ({one_line(error)})")

    def _records(self) -> Iterator[tuple[int, bytes]]:
        """Whole records in and outside chunks."""
        with self._file.open("rb") as stream:
            place = len(MAGIC)
            while True:
                stream.seek(place)
                for op, data, whole in _walk(stream):
                    if op == Opcode.DATA_END and whole:
                        return  # what follows repeats
                    if whole:
                        place = stream.tell()
                    if op == Opcode.CHUNK:
                        yield from self._chunk(data, whole)
                    elif whole:
                        yield op, data
                onward = [chunk for chunk in self._chunks if chunk > place]
                if not onward:
                    self._warn(f"{self._file.name} is cut off at its end")
                    return
                self._warn(f"{self._file.name} is damaged at byte {place}")
                place = onward[0]

    def _chunk(self, data: bytes, whole: bool) -> Iterator[tuple[int, bytes]]:
        """Whole records of a chunk."""
        try:
            inner = _unpacked(data, whole)
        except Exception as error:  # damage may take any form
            if whole:
                self._warn(f"a damaged part was left out ({one_line(error)})")
            return
        for op, content, complete in _walk(BytesIO(inner)):
            if complete:
                yield op, content


def _walk(stream: BinaryIO) -> Iterator[tuple[int, bytes, bool]]:
    """Operation code and content of each record, and whether all of the content is there."""
    while len(head := stream.read(9)) == 9:
        op, size = struct.unpack("<BQ", head)
        if size > LARGEST_RECORD:
            return
        data = stream.read(size)
        yield op, data, len(data) == size


def _unpacked(data: bytes, whole: bool) -> bytes:
    """The records of a chunk; of one that is cut off, those that can still be had."""
    chunk = parts.Chunk.read(ReadDataStream(BytesIO(data)))
    if chunk.uncompressed_size > LARGEST_RECORD:
        raise ValueError(f"a chunk of {chunk.uncompressed_size} bytes")
    if whole:
        stream, size = get_chunk_data_stream(chunk, validate_crc=True)
        return stream.read(size)
    if chunk.compression == "zstd":
        return zstandard.ZstdDecompressor().decompressobj().decompress(chunk.data)
    if chunk.compression == "lz4":
        return bytes(LZ4FrameDecompressor().decompress(chunk.data))
    return chunk.data
