"""Messages of a rosbag2 recording as bytes, whole bags and damaged ones alike.

Intact recordings are read with ``rosbags``. A recording whose writer was killed has neither
index nor metadata; its messages are found by going through the file from its beginning (MCAP) or
by asking the database directly (SQLite).
"""

from __future__ import annotations

import io
import shutil
import sqlite3
import struct
import tempfile
import zlib
from collections.abc import Callable, Collection, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

from derail_ros.vocabulary.words import count

MCAP_MAGIC = b"\x89MCAP0\r\n"
SQLITE_MAGIC = b"SQLite format 3\0"
LARGEST_RECORD = 1 << 29
"""No record of a recording is larger than this: a larger one is damage, bytes."""


class BagError(Exception):
    """A recording cannot be read; the text is one line for people."""


class NotABagError(BagError):
    """There is no recording at the place given."""


class OtherTopicsError(BagError):
    """A recording, but not of a derailment simulator."""


class BagVersionError(BagError):
    """A recording of messages that this version does not know."""


@dataclass(frozen=True)
class Channel:
    """A topic of a recording.

    Attributes
    ----------
    topic, msgtype : its name and type, for example ``derail_msgs/msg/TrainState``
    definition : text of the message definition, "" where the recording has none
    qos : what the recording says of its quality of service (``rosbags.interfaces.Qos``)
    digest : hash of the type description, "" if unknown
    """

    topic: str
    msgtype: str
    definition: str = ""
    qos: tuple[Any, ...] = ()
    digest: str = ""

    @property
    def name(self) -> str:
        """Last part of the topic's name."""
        return self.topic.rpartition("/")[2]


Message = tuple[Channel, int, bytes]
"""Channel, time (ns) and CDR bytes."""


@dataclass
class RawBag:
    """A recording that was found and can be read.

    Attributes
    ----------
    path : folder or file
    storage : "mcap" or "sqlite3"
    files : its files, in order
    channels : its topics; of a recording without index those found at the beginning
    intact : index and metadata are there
    warnings : what is wrong with it, grows while it is read
    """

    path: Path
    storage: str
    files: list[Path]
    channels: list[Channel] = field(default_factory=list)
    intact: bool = True
    warnings: list[str] = field(default_factory=list)

    @property
    def size(self) -> int:
        """Bytes on disk."""
        return sum(file.stat().st_size for file in self.files)

    def warn(self, text: str) -> None:
        """Note something once."""
        if text not in self.warnings:
            self.warnings.append(text)

    def messages(self, wanted: Callable[[Channel], bool] = lambda _: True) -> Iterator[Message]:
        """All messages of the wanted topics.

        An intact recording gives them in order of time, a damaged one in the order in which they
        were written.
        """
        if self.intact:
            yield from self._indexed(wanted)
        else:
            for file in self.files:
                scan = _scan_mcap if self.storage == "mcap" else _scan_sqlite
                yield from scan(file, wanted, self.warn)

    def _indexed(self, wanted: Callable[[Channel], bool]) -> Iterator[Message]:
        from rosbags.rosbag2 import Reader

        read = 0
        try:
            with Reader(self.path) as reader:
                channels = {c.id: _channel(c) for c in reader.connections}
                chosen = [c for c in reader.connections if wanted(channels[c.id])]
                # Without connections rosbags would give all messages.
                for connection, stamp, data in reader.messages(chosen) if chosen else ():
                    yield channels[connection.id], stamp, data
                    read += 1
        except GeneratorExit:
            raise
        except Exception as error:  # whatever a damaged file makes rosbags raise
            self.warn(
                f"damaged: {_line(error)}; {count(read, 'message')} before that could be read"
            )


def _line(error: BaseException) -> str:
    return " ".join(str(error).split()).rstrip(".") or type(error).__name__


def _channel(connection: Any) -> Channel:
    definition = getattr(connection.msgdef, "data", "") or ""
    return Channel(
        topic=str(connection.topic),
        msgtype=str(connection.msgtype),
        definition=definition,
        qos=tuple(getattr(connection.ext, "offered_qos_profiles", ()) or ()),
        digest=str(connection.digest or ""),
    )


# --- finding ---------------------------------------------------------------------------------


def open_bag(path: str | Path) -> RawBag:
    """Find the recording at a place: its folder, a file of it, or a folder with one in it.

    Raises
    ------
    NotABagError
        If there is none.
    """
    path = Path(path)
    if not path.exists():
        raise NotABagError(f"{path}: no such file or folder")
    if path.is_dir():
        return _open_folder(path)
    if path.name == "metadata.yaml":
        return _open_folder(path.parent)
    storage = storage_of(path)
    if storage is None:
        raise NotABagError(f"{path}: neither an MCAP nor an SQLite recording")
    if (path.parent / "metadata.yaml").exists():
        whole = _open_folder(path.parent)
        if whole.intact and whole.files == [path]:
            return whole
    # A file by itself: not every rosbags opens one, but there is the way from its beginning.
    alone = _open_indexed(path, [path])
    return alone if isinstance(alone, RawBag) else _open_files(path, [path], storage)


def storage_of(path: Path) -> str | None:
    """Kind of recording that a file is, told by its first bytes."""
    try:
        with path.open("rb") as file:
            head = file.read(16)
    except OSError as error:
        raise NotABagError(f"{path}: {error.strerror}") from None
    if head.startswith(MCAP_MAGIC):
        return "mcap"
    return "sqlite3" if head == SQLITE_MAGIC else None


def _open_folder(path: Path) -> RawBag:
    metadata = path / "metadata.yaml"
    files = sorted(
        (f for f in path.iterdir() if f.suffix in (".mcap", ".db3") and f.is_file()),
        key=lambda f: (len(f.name), f.name),
    )
    if not files and not metadata.exists():
        inner = [f for f in sorted(path.iterdir()) if f.is_dir() and _looks_like_bag(f)]
        if len(inner) == 1:
            return _open_folder(inner[0])
        if inner:
            names = ", ".join(f.name for f in inner[:5])
            raise NotABagError(f"{path}: holds several recordings ({names}): name one")
        raise NotABagError(f"{path}: no recording in this folder")
    if metadata.exists():
        bag = _open_indexed(path, files)
        if isinstance(bag, RawBag):
            return bag
        reason = bag
    else:
        reason = "no metadata.yaml: the recorder did not end"
    kinds = {storage_of(f) for f in files} - {None}
    if len(kinds) != 1:
        raise NotABagError(f"{path}: {reason}, and no file in it is a recording")
    storage = str(kinds.pop())
    sound = [f for f in files if storage_of(f) == storage]
    bag = _open_files(path, sound, storage, reason)
    for file in files:
        if file not in sound:
            bag.warn(f"{file.name} is no recording: left out")
    return bag


def _looks_like_bag(path: Path) -> bool:
    return (path / "metadata.yaml").exists() or any(path.glob("*.mcap")) or any(path.glob("*.db3"))


def _open_indexed(path: Path, files: list[Path]) -> RawBag | str:
    """The recording, or why ``rosbags`` cannot open it."""
    from rosbags.rosbag2 import Reader

    try:
        with Reader(path) as reader:
            channels = [_channel(c) for c in reader.connections]
            storage = storage_of(files[0]) if files else None
            # A journal beside a database is the trace of a writer that was killed.
            if any(_journal(f) for f in files):
                return "the recorder did not end"
            return RawBag(path, storage or "mcap", files, channels)
    except Exception as error:  # whatever a damaged file makes rosbags raise
        return _line(error)


def _open_files(path: Path, files: list[Path], storage: str, reason: str = "") -> RawBag:
    bag = RawBag(path, storage, files, intact=False)
    scan = _channels_mcap if storage == "mcap" else _channels_sqlite
    found: dict[tuple[str, str], Channel] = {}
    for file in files:
        for channel in scan(file, bag.warn):
            found.setdefault((channel.topic, channel.msgtype), channel)
    bag.channels = list(found.values())
    if not found:
        raise NotABagError(f"{path}: a recording without anything in it")
    if reason:
        bag.warn(f"incomplete ({reason}): what is there was read; derail repair makes it whole")
    elif storage == "mcap" and not _ends_well(files[-1]):
        bag.warn("incomplete (no index): what is there was read; derail repair makes it whole")
    return bag


def _ends_well(file: Path) -> bool:
    with file.open("rb") as stream:
        stream.seek(max(0, file.stat().st_size - len(MCAP_MAGIC)))
        return stream.read() == MCAP_MAGIC and file.stat().st_size > len(MCAP_MAGIC)


# --- MCAP from its beginning -----------------------------------------------------------------


def _zstd() -> Any:
    """The module that rosbags brings, which depends on its version and Python's."""
    try:
        from compression import zstd  # type: ignore[import-not-found,unused-ignore]
    except ImportError:
        try:
            from backports import zstd  # type: ignore[no-redef,unused-ignore]
        except ImportError:
            import zstandard as zstd  # type: ignore[no-redef,unused-ignore]
    return zstd


def _decompress(kind: str, data: bytes) -> bytes:
    """What compressed data hold; of data that are cut off, what can still be had."""
    if kind == "":
        return data
    decompressor: Any
    if kind == "lz4":
        from lz4.frame import LZ4FrameDecompressor

        decompressor = LZ4FrameDecompressor()
    elif kind == "zstd":
        zstd = _zstd()
        decompressor = zstd.ZstdDecompressor()
        if hasattr(decompressor, "decompressobj"):
            decompressor = decompressor.decompressobj()
    else:
        raise ValueError(f"unknown compression {kind!r}")
    return bytes(decompressor.decompress(data))


class _CutOff(Exception):
    """A record is cut off: what there is of it."""

    def __init__(self, op: int = 0, data: bytes = b"") -> None:
        super().__init__()
        self.op = op
        self.data = data


def _records(stream: BinaryIO, end: int) -> Iterator[tuple[int, bytes]]:
    """Operation code and content of the records up to ``end``; stops where one is cut off."""
    while stream.tell() + 9 <= end:
        head = stream.read(9)
        op, size = head[0], struct.unpack_from("<Q", head, 1)[0]
        if size > LARGEST_RECORD:
            raise _CutOff
        if stream.tell() + size > end:
            raise _CutOff(op, stream.read(end - stream.tell()))
        yield op, stream.read(size)
    if stream.tell() != end:
        raise _CutOff


def _text(data: bytes, at: int) -> tuple[str, int]:
    (size,) = struct.unpack_from("<I", data, at)
    at += 4
    if at + size > len(data):
        raise ValueError("a text is cut off")
    return data[at : at + size].decode("utf-8", "replace"), at + size


class _Tables:
    """Schemas and channels as they come."""

    def __init__(self) -> None:
        self.schemas: dict[int, tuple[str, str]] = {}
        self.channels: dict[int, Channel] = {}

    def take(self, op: int, data: bytes) -> Channel | None:
        """Note a schema or channel; the channel if it is a new one."""
        if op == 0x03:
            (key,) = struct.unpack_from("<H", data)
            name, at = _text(data, 2)
            _, at = _text(data, at)
            self.schemas[key] = (name, _text(data, at)[0])
        elif op == 0x04:
            key, schema = struct.unpack_from("<HH", data)
            topic, at = _text(data, 4)
            _, at = _text(data, at)
            name, definition = self.schemas.get(schema, ("", ""))
            metadata: dict[str, str] = {}
            (size,) = struct.unpack_from("<I", data, at)
            at += 4
            end = at + size
            while at < end:
                k, at = _text(data, at)
                metadata[k], at = _text(data, at)
            if key not in self.channels:
                self.channels[key] = Channel(
                    topic,
                    name,
                    definition,
                    _qos(metadata.get("offered_qos_profiles", "")),
                    metadata.get("topic_type_hash", ""),
                )
                return self.channels[key]
        return None


def _qos(text: str) -> tuple[Any, ...]:
    if not text:
        return ()
    from rosbags.rosbag2.metadata import parse_qos

    try:
        return tuple(parse_qos(text))
    except Exception:  # a profile that this rosbags does not know is one we do without
        return ()


def _mcap(
    file: Path, warn: Callable[[str], None], tables: _Tables
) -> Iterator[tuple[int, bytes, int]]:
    """Records in and outside chunks, each with the offset of its chunk."""
    size = file.stat().st_size
    with file.open("rb") as stream:
        stream.seek(len(MCAP_MAGIC))
        end = size - len(MCAP_MAGIC) if _ends_well(file) else size
        try:
            for op, data in _records(stream, end):
                if op == 0x06:
                    try:
                        inner = _chunk(data)
                    except Exception as error:  # damage may take any form
                        warn(f"a damaged part was left out ({_line(error)})")
                        continue
                    for record in _records(io.BytesIO(inner), len(inner)):
                        yield *record, stream.tell()
                elif op in (0x03, 0x04, 0x05):
                    yield op, data, stream.tell()
                elif op == 0x0F:  # end of the data; what follows repeats
                    return
        except _CutOff as cut:
            warn(f"{file.name} is cut off at its end")
            if cut.op == 0x06:
                for record in _rest(cut.data):
                    yield *record, size


def _rest(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Records of a chunk that is cut off."""
    with suppress(Exception):  # it may end anywhere, also in the middle of what tells its form
        inner = _chunk(data, whole=False)
        yield from _records(io.BytesIO(inner), len(inner))


def _chunk(data: bytes, whole: bool = True) -> bytes:
    _, _, size, crc = struct.unpack_from("<QQQI", data)
    if size > LARGEST_RECORD:
        raise ValueError(f"of {size} bytes")
    kind, at = _text(data, 28)
    (packed,) = struct.unpack_from("<Q", data, at)
    inner = _decompress(kind, data[at + 8 : at + 8 + packed])
    if not whole:
        return inner[:size]
    if len(inner) != size:
        raise ValueError("its size is wrong")
    if crc and zlib.crc32(inner) != crc:
        raise ValueError("its checksum is wrong")
    return inner


def _scan_mcap(
    file: Path, wanted: Callable[[Channel], bool], warn: Callable[[str], None]
) -> Iterator[Message]:
    tables = _Tables()
    chosen: dict[int, bool] = {}
    for op, data, _ in _mcap(file, warn, tables):
        if op != 0x05:
            tables.take(op, data)
            continue
        key, _, stamp = struct.unpack_from("<HIQ", data)
        channel = tables.channels.get(key)
        if channel is None:
            continue
        if key not in chosen:
            chosen[key] = wanted(channel)
        if chosen[key]:
            yield channel, stamp, data[22:]


def _channels_mcap(file: Path, warn: Callable[[str], None]) -> list[Channel]:
    """The channels of a file: all of them come before the first messages of our recordings."""
    tables = _Tables()
    first = None
    for op, data, place in _mcap(file, lambda _: None, tables):
        if op != 0x05:
            tables.take(op, data)
        elif first is None:
            first = place
        elif place > first + (1 << 22):
            break
    return list(tables.channels.values())


# --- SQLite without metadata -----------------------------------------------------------------


def _journal(file: Path) -> bool:
    journal = file.with_name(file.name + "-journal")
    return journal.exists() and journal.stat().st_size > 0


class _Database:
    """A connection to a recording that never writes to it.

    With the journal of a killed writer beside it, SQLite must roll back before it can read: this
    is done on a copy.
    """

    def __init__(self, file: Path) -> None:
        self._copy: tempfile.TemporaryDirectory[str] | None = None
        place = file
        companions = [
            file.with_name(file.name + s) for s in ("-journal", "-wal") if _exists(file, s)
        ]
        if companions:
            self._copy = tempfile.TemporaryDirectory(prefix="derail_")
            place = Path(self._copy.name) / file.name
            shutil.copyfile(file, place)
            for companion in companions:
                shutil.copyfile(companion, place.with_name(companion.name))
        mode = "rw" if companions else "ro"
        self.connection = sqlite3.connect(f"{place.resolve().as_uri()}?mode={mode}", uri=True)
        self.connection.text_factory = lambda b: b.decode("utf-8", "replace")

    def __enter__(self) -> sqlite3.Connection:
        return self.connection

    def __exit__(self, *_: object) -> None:
        self.connection.close()
        if self._copy is not None:
            self._copy.cleanup()


def _exists(file: Path, suffix: str) -> bool:
    companion = file.with_name(file.name + suffix)
    return companion.exists() and companion.stat().st_size > 0


def _sqlite_channels(database: sqlite3.Connection) -> dict[int, Channel]:
    columns = {row[1] for row in database.execute("PRAGMA table_info(topics)")}
    qos = "offered_qos_profiles" if "offered_qos_profiles" in columns else "''"
    digest = "type_description_hash" if "type_description_hash" in columns else "''"
    definitions: dict[str, str] = {}
    with suppress(sqlite3.Error):
        definitions = dict(
            database.execute(
                "SELECT topic_type, encoded_message_definition FROM message_definitions"
            ).fetchall()
        )
    return {
        key: Channel(topic, kind, definitions.get(kind, ""), _qos(profile), hashed or "")
        for key, topic, kind, profile, hashed in database.execute(
            f"SELECT id, name, type, {qos}, {digest} FROM topics"
        )
    }


def _channels_sqlite(file: Path, warn: Callable[[str], None]) -> list[Channel]:
    try:
        with _Database(file) as database:
            return list(_sqlite_channels(database).values())
    except sqlite3.Error as error:
        raise NotABagError(f"{file}: {_line(error)}") from None


def _scan_sqlite(
    file: Path, wanted: Callable[[Channel], bool], warn: Callable[[str], None]
) -> Iterator[Message]:
    try:
        with _Database(file) as database:
            channels = {k: c for k, c in _sqlite_channels(database).items() if wanted(c)}
            query = "SELECT topic_id, timestamp, data FROM messages ORDER BY id"
            with closing(database.execute(query)) as rows:
                for key, stamp, data in rows:
                    if key in channels:
                        yield channels[key], stamp, data
    except sqlite3.Error as error:
        warn(f"damaged: {_line(error)}")


# --- what it holds ---------------------------------------------------------------------------

PACKAGE = "derail_msgs/msg/"
KNOWN_VERSION = 1


def check_version(bag: RawBag) -> None:
    """Hold the definitions inside the recording against those that this version reads.

    Raises
    ------
    OtherTopicsError
        If nothing in it is of a derailment simulator.
    BagVersionError
        If its messages are others.
    """
    from rosbags.typesys import get_types_from_msg

    from msg_adapters.definitions import field_names, read_copy, typestore

    ours = [c for c in bag.channels if c.msgtype.startswith(PACKAGE)]
    if not ours:
        names = ", ".join(sorted(c.topic for c in bag.channels)[:4]) or "none"
        raise OtherTopicsError(
            f"{bag.path}: a recording, but not of a derailment (its topics: {names})"
        )
    known = read_copy()
    for channel in ours:
        if channel.msgtype not in known:
            if channel.definition:
                bag.warn(f"{channel.topic} is left out: {channel.msgtype} is not known here")
            continue
        if not channel.definition:
            continue
        try:
            types = get_types_from_msg(_own_part(channel.definition), channel.msgtype)
            constants, fields = types[channel.msgtype]
        except Exception as error:  # rosbags raises several kinds
            raise BagVersionError(
                f"{bag.path}: the definition of {channel.msgtype} in it cannot be read"
                f" ({_line(error)})"
            ) from None
        version = next((value for name, _, value in constants if name == "INTERFACE_VERSION"), 0)
        expected = typestore().fielddefs[channel.msgtype][1]
        if version != KNOWN_VERSION or [f[0] for f in fields] != field_names(channel.msgtype):
            raise BagVersionError(
                f"{bag.path}: {channel.msgtype} in it is of version {version} with"
                f" {len(fields)} fields; this derail_ros reads version {KNOWN_VERSION} with"
                f" {len(expected)}"
            )


def _own_part(definition: str) -> str:
    """A definition without those of the messages it uses."""
    return definition.split("\n====", 1)[0]


def topics_of(channels: Collection[Channel], namespace: str | None) -> tuple[str, list[str]]:
    """The namespace to read, and all there are in a recording.

    Raises
    ------
    OtherTopicsError
        If the namespace asked for is not in it.
    """
    found = sorted(
        {c.topic.rpartition("/")[0] for c in channels if c.msgtype == f"{PACKAGE}TrainState"}
        or {c.topic.rpartition("/")[0] for c in channels if c.msgtype.startswith(PACKAGE)}
    )
    if namespace is None:
        return found[0], found
    wanted = "/" + namespace.strip("/") if namespace.strip("/") else ""
    if wanted not in found:
        there = ", ".join(f"{n or '/'}" for n in found)
        raise OtherTopicsError(f"no train in namespace {wanted or '/'}; there are: {there}")
    return wanted, found
