"""Messages of one MCAP file: by its index, or record by record where it is damaged.

The parts of the format are read by ``mcap``. Its readers stop at the first damage; the scan here
leaves out a broken chunk, goes on at the next one that an index names, and ends where the file is
cut off.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import zstandard
from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]
from mcap import records as parts
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.stream_reader import get_chunk_data_stream

from derail_ros.recording.channels import Channel, Message, Span, Wanted, one_line, parse_profiles

MAGIC = b"\x89MCAP0\r\n"
LARGEST_RECORD = 1 << 29
"""A record that claims to be larger than this is taken for damage, bytes."""


@dataclass
class Index:
    """The content of a file's index."""

    # by their numbers in the file, as are the channels
    schemas: dict[int, parts.Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: list[int] = field(default_factory=list)  # where they begin, bytes
    span: Span | None = None


def read_index(file: Path) -> Index | None:
    """The index of a file, ``None`` if it was written without.

    Raises
    ------
    Exception
        Of any kind, if the file is damaged or cut off.
    """
    with file.open("rb") as stream:
        summary = _reader(stream).get_summary()
    if summary is None:
        return None
    if summary.chunk_indexes and not summary.channels:
        raise ValueError("an index without topics")
    found = summary.statistics
    return Index(
        schemas=summary.schemas,
        channels={k: _channel(c, summary.schemas) for k, c in summary.channels.items()},
        chunks=sorted(chunk.chunk_start_offset for chunk in summary.chunk_indexes),
        span=(found.message_start_time, found.message_end_time)
        if found is not None and found.message_count
        else None,
    )


def indexed_messages(
    file: Path, wanted: Wanted, start: int | None, stop: int | None
) -> Iterator[Message]:
    """Messages in order of time, from ``start`` to before ``stop`` (ns).

    Raises
    ------
    Exception
        Of any kind, where the file is damaged.
    """
    index = read_index(file) or Index()
    channels = dict(index.channels)
    topics = {c.topic for c in channels.values() if wanted(c)} if channels else None
    with file.open("rb") as stream:
        for schema, raw, message in _reader(stream).iter_messages(
            topics, starting_at=start, ending_before=stop
        ):
            if raw.id not in channels:
                channels[raw.id] = _channel(raw, {raw.schema_id: schema})
            if wanted(channels[raw.id]):
                yield channels[raw.id], message.log_time, message.data


def _reader(stream: BinaryIO) -> SeekingReader:
    return SeekingReader(stream, validate_crcs=True, record_size_limit=LARGEST_RECORD)


def _channel(channel: parts.Channel, schemas: dict[int, Any]) -> Channel:
    schema = schemas.get(channel.schema_id)
    return Channel(
        topic=channel.topic,
        msgtype="" if schema is None else schema.name,
        definition="" if schema is None else schema.data.decode("utf-8", "replace"),
        qos=parse_profiles(channel.metadata.get("offered_qos_profiles", "")),
        digest=channel.metadata.get("topic_type_hash", ""),
    )


# --- without trust in the index ----------------------------------------------------------------


class Scan:
    """A walk over all records that are left of a file; ``warn`` takes what is wrong with it."""

    def __init__(self, file: Path, warn: Callable[[str], None] = lambda _: None) -> None:
        self._file = file
        self._warn = warn
        self._index = Index()
        with suppress(Exception):  # it may be damaged as well
            self._index = read_index(file) or Index()

    def channels(self) -> list[Channel]:
        """The topics."""
        for op, data in self._records():
            self._announced(op, data)
        return list(self._index.channels.values())

    def messages(self, wanted: Wanted) -> Iterator[Message]:
        """Messages in the order in which they were written."""
        chosen: dict[int, bool] = {}
        for op, data in self._records():
            if op != Opcode.MESSAGE:
                self._announced(op, data)
                continue
            key, _, stamp = struct.unpack_from("<HIQ", data)
            channel = self._index.channels.get(key)
            if channel is not None and chosen.setdefault(key, wanted(channel)):
                yield channel, stamp, data[22:]

    def _announced(self, op: int, data: bytes) -> None:
        """Keep a schema or a channel."""
        try:
            if op == Opcode.SCHEMA:
                schema = parts.Schema.read(ReadDataStream(BytesIO(data)))
                self._index.schemas[schema.id] = schema
            elif op == Opcode.CHANNEL:
                raw = parts.Channel.read(ReadDataStream(BytesIO(data)))
                self._index.channels.setdefault(raw.id, _channel(raw, self._index.schemas))
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
                onward = [chunk for chunk in self._index.chunks if chunk > place]
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
                self._warn(f"skipped a damaged part ({one_line(error)})")
            return
        yield from ((op, content) for op, content, complete in _walk(BytesIO(inner)) if complete)


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
