"""What is wrong with an MCAP file, by the rules that checkers of the format go by."""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from pathlib import Path

from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    Message,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.stream_reader import StreamReader, breakup_chunk

MAGIC = b"\x89MCAP0\r\n"


def faults(path: Path) -> list[str]:
    """Everything that is not as the format says, or that it leaves out; empty if all is well."""
    raw = path.read_bytes()
    found: list[str] = []

    def expect(truth: bool, text: str) -> None:
        if not truth:
            found.append(text)

    expect(raw.startswith(MAGIC) and raw.endswith(MAGIC), "magic")
    places = {}  # offset -> operation code and length of the record there
    at = len(MAGIC)
    while at < len(raw) - len(MAGIC):
        op, length = struct.unpack_from("<BQ", raw, at)
        places[at] = (op, 9 + length)
        at += 9 + length
    expect(at == len(raw) - len(MAGIC), "records do not fill the file")

    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    summary: list[object] = []
    chunks: dict[int, Chunk] = {}
    indexed: dict[int, dict[int, list[tuple[int, int]]]] = {}
    counts: Counter[int] = Counter()
    times: list[int] = []
    current = 0
    ended = False
    with path.open("rb") as stream:
        records = list(StreamReader(stream, emit_chunks=True, validate_crcs=True).records)
    for place, record in zip(sorted(places), records):
        if ended:
            summary.append(record)
            continue
        if isinstance(record, Header):
            expect(record.profile == "ros2" and bool(record.library), "header")
        elif isinstance(record, Chunk):
            current = place
            chunks[place] = record
            indexed[place] = {}
            expect(record.uncompressed_crc != 0, f"chunk at {place}: no checksum")
            inside = breakup_chunk(record, validate_crc=True)
            stamps = []
            for one in inside:
                if isinstance(one, Schema):
                    expect(one.id != 0 and one.id not in schemas, f"schema {one.id}")
                    expect(one.encoding == "ros2msg" and bool(one.data), f"schema {one.name}")
                    schemas[one.id] = one
                elif isinstance(one, Channel):
                    expect(one.id not in channels, f"channel {one.id} twice")
                    expect(one.schema_id in schemas, f"channel {one.topic}: no schema")
                    expect(one.message_encoding == "cdr", f"channel {one.topic}: encoding")
                    channels[one.id] = one
                elif isinstance(one, Message):
                    expect(one.channel_id in channels, "a message before its channel")
                    expect(not times or one.log_time >= times[-1], f"order at {one.log_time}")
                    counts[one.channel_id] += 1
                    times.append(one.log_time)
                    stamps.append(one.log_time)
                else:
                    found.append(f"{one!r} in a chunk")
            if stamps:
                expect(record.message_start_time == min(stamps), f"chunk at {place}: start")
                expect(record.message_end_time == max(stamps), f"chunk at {place}: end")
        elif isinstance(record, MessageIndex):
            indexed[current][record.channel_id] = record.records
        elif isinstance(record, DataEnd):
            ended = True
        else:
            expect(isinstance(record, Metadata), f"{type(record).__name__} among the data")
    expect(ended, "no end of the data")

    # The indexes point to what is there.
    for place, chunk in chunks.items():
        inner = _inner(chunk)
        expect(zlib.crc32(inner) == chunk.uncompressed_crc, f"chunk at {place}: checksum")
        for key, entries in indexed[place].items():
            for stamp, offset in entries:
                op, _, channel, _, log_time = struct.unpack_from("<BQHIQ", inner, offset)
                expect((op, channel, log_time) == (5, key, stamp), f"index of chunk at {place}")
    expect(
        sum(len(e) for chunk in indexed.values() for e in chunk.values()) == len(times),
        "messages that no index names",
    )
    by_kind = {kind: [r for r in summary if isinstance(r, kind)] for kind in SUMMARY}
    expect({s.id: s for s in by_kind[Schema]} == schemas, "schemas of the summary")
    expect({c.id: c for c in by_kind[Channel]} == channels, "channels of the summary")
    expect({i.chunk_start_offset for i in by_kind[ChunkIndex]} == set(chunks), "chunk indexes")
    for index in by_kind[ChunkIndex]:
        chunk = chunks[index.chunk_start_offset]
        expect(
            (
                places[index.chunk_start_offset] == (6, index.chunk_length)
                and index.message_start_time == chunk.message_start_time
                and index.message_end_time == chunk.message_end_time
                and index.compression == chunk.compression
                and index.compressed_size == len(chunk.data)
                and index.uncompressed_size == chunk.uncompressed_size
                and set(index.message_index_offsets) == set(indexed[index.chunk_start_offset])
                and all(places[o][0] == 7 for o in index.message_index_offsets.values())
            ),
            f"index of the chunk at {index.chunk_start_offset}",
        )
    for index in by_kind[MetadataIndex]:
        expect(places.get(index.offset) == (0x0C, index.length), "index of the metadata")
    for offset in by_kind[SummaryOffset]:
        kinds = {op for at, (op, _) in places.items() if _within(at, offset)}
        expect(kinds == {offset.group_opcode}, f"summary offset of {offset.group_opcode}")
    expect(len(by_kind[Statistics]) == 1, "statistics")
    for statistics in by_kind[Statistics]:
        expect(statistics.message_count == len(times), "count of the messages")
        expect(statistics.chunk_count == len(chunks), "count of the chunks")
        expect(statistics.schema_count == len(schemas), "count of the schemas")
        expect(statistics.channel_count == len(channels), "count of the channels")
        expect(statistics.metadata_count == len(by_kind[MetadataIndex]), "count of metadata")
        got = {k: n for k, n in statistics.channel_message_counts.items() if n}
        expect(got == dict(counts), "counts of the channels")
        if times:
            expect(statistics.message_start_time == min(times), "first time")
            expect(statistics.message_end_time == max(times), "last time")
    (footer,) = by_kind[Footer] or [None]
    expect(footer is not None, "no footer")
    if footer is not None:
        end = max(places)
        expect(places[end][0] == 2, "the footer is not the last record")
        crc = zlib.crc32(raw[footer.summary_start : end + 9 + 16])
        expect(footer.summary_crc == crc, "checksum of the summary")
    return found


SUMMARY = (Schema, Channel, ChunkIndex, MetadataIndex, Statistics, SummaryOffset, Footer)


def _within(at: int, offset: SummaryOffset) -> bool:
    return offset.group_start <= at < offset.group_start + offset.group_length


def _inner(chunk: Chunk) -> bytes:
    if chunk.compression == "":
        return chunk.data
    import zstandard

    assert chunk.compression == "zstd"
    return zstandard.decompress(chunk.data, chunk.uncompressed_size)
