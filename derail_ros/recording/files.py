"""Files of recordings, field by field as rosbag2's own recorder writes them.

``rosbags`` writes the files; what it leaves out is added here: checksums of chunks and summary,
hashes of the types in the file itself, and the definitions with their comments.
"""

from __future__ import annotations

import functools
import os
import struct
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.rosbag2.storage_mcap import McapWriter, write_channel

from msg_adapters.definitions import VERSION, read_copy, type_hash, typestore

STORAGE = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}
METADATA_VERSION: Literal[8] = 8
"""The newest that rosbag2 of every distribution since Humble reads: in version 9 the profiles of
a topic are no longer one text, at which those before Jazzy stop."""

RECORD_HEAD = 9
"""Bytes of an MCAP record before its content: operation code and length."""
CHUNK_CRC = RECORD_HEAD + 24
"""Place of the checksum in a chunk, after its times and size."""
FOOTER = RECORD_HEAD + 20
MAGIC = 8


class _McapFile(McapWriter):
    """An MCAP file with checksums, so that damage inside a chunk is noticed."""

    def add_connection(self, connection: Any, offered_qos_profiles: str) -> None:
        """Announce a topic; the hash of its type is part of what the file says of it."""
        place = self.chunk.bio.tell()
        super().add_connection(connection, offered_qos_profiles)
        channel = self.channels[-1]
        more = b"".join(
            struct.pack("<I", len(text)) + text
            for text in (b"topic_type_hash", str(connection.digest).encode())
        )
        self.channels[-1] = channel._replace(metadata=channel.metadata + more)
        self.chunk.bio.seek(place)
        self.chunk.bio.truncate()
        write_channel(self.chunk.bio, self.channels[-1], self.schemas)

    def close_chunk(self) -> None:
        """Write the chunk, and its checksum into it."""
        crc = zlib.crc32(self.chunk.bio.getvalue())
        place = self.bio.tell()
        super().close_chunk()
        end = self.bio.tell()
        self.bio.seek(place + CHUNK_CRC)
        self.bio.write(struct.pack("<I", crc))
        self.bio.seek(end)

    def close(self, version: int, metadata: str) -> None:
        """Write index and summary, and the checksum of the summary into the footer."""
        super().close(version, metadata)
        with self.path.open("r+b") as file:
            footer = file.seek(-(FOOTER + MAGIC), os.SEEK_END)
            (start,) = struct.unpack("<Q", file.read(RECORD_HEAD + 8)[RECORD_HEAD:])
            file.seek(start)
            # All up to the checksum itself, which ends the footer.
            crc = zlib.crc32(file.read(footer + FOOTER - 4 - start))
            file.write(struct.pack("<I", crc))


class _Writer(Writer):
    STORAGE_PLUGINS: Mapping[StoragePlugin, Any] = {
        **Writer.STORAGE_PLUGINS,
        StoragePlugin.MCAP: _McapFile,
    }


def bag_writer(path: str | os.PathLike[str], storage: str) -> Writer:
    """A writer of ``"mcap"`` or ``"sqlite3"``, not open yet.

    Raises
    ------
    WriterError
        If there is something at ``path``.
    """
    writer = _Writer(Path(path), version=METADATA_VERSION, storage_plugin=STORAGE[storage])
    if storage == "mcap":
        # Chunks compressed with zstd: a seventh of the size, and no more time.
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    return writer


def add_topic(
    writer: Writer,
    topic: str,
    msgtype: str,
    profiles: Sequence[Any],
    version: int = VERSION,
) -> Any:
    """Announce a topic of a type known here; the connection to write its messages to."""
    return writer.add_connection(
        topic,
        msgtype,
        msgdef=full_text(msgtype, version),
        rihs01=type_hash(msgtype, version),
        offered_qos_profiles=profiles,
    )


@functools.cache
def full_text(msgtype: str, version: int = VERSION) -> str:
    """The definition of a message and of those it uses, ours with what each field means."""
    text, _ = typestore(version).generate_msgdef(msgtype, ros_version=2)
    rule = "=" * 80 + "\nMSG: "
    own, *others = text.split(rule)
    comments = read_copy(version)
    parts = [comments.get(msgtype, own)]
    for part in others:
        name, _, body = part.partition("\n")
        package, _, message = name.rpartition("/")
        parts.append(f"{rule}{name}\n" + comments.get(f"{package}/msg/{message}", body))
    return "\n".join(parts)
