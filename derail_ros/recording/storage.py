"""Recordings on disk: found at a path, opened whole or damaged, their messages as bytes.

A recording is a rosbag2 folder or a file of one (MCAP or SQLite, also compressed with zstd). A
recording whose writer was killed has neither index nor metadata; its files are then read from
their beginning.
"""

from __future__ import annotations

import sqlite3
import tempfile
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import Any

import yaml
import zstandard

from derail_ros.recording import mcap_file, sqlite_file
from derail_ros.recording.channels import Channel, Message, Span, Wanted, one_line
from derail_ros.vocabulary.words import count

__all__ = [
    "BagError",
    "BagVersionError",
    "Channel",
    "Message",
    "NotABagError",
    "OtherTopicsError",
    "RawBag",
    "check_version",
    "open_bag",
    "topics_of",
]

METADATA = "metadata.yaml"
SUFFIXES = (".mcap", ".db3")
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


class BagError(Exception):
    """A recording cannot be read; the text is one line for people."""


class NotABagError(BagError):
    """There is no recording at the place given."""


class OtherTopicsError(BagError):
    """A recording, but not of a derailment simulator."""


class BagVersionError(BagError):
    """A recording of messages that this version does not know."""


@dataclass
class RawBag:
    """A recording that was found and can be read.

    Attributes
    ----------
    path
        Folder or file.
    storage
        ``"mcap"`` or ``"sqlite3"``.
    files
        Its files in order; of compressed ones the unpacked copies.
    size
        Bytes on disk.
    channels
        Its topics.
    intact
        Index and metadata are there.
    compressed_messages
        Each message is compressed by itself (rosbag2's ``compression_mode: message``).
    warnings
        What is wrong with it; grows while it is read.
    """

    path: Path
    storage: str
    files: list[Path]
    size: int
    channels: list[Channel] = field(default_factory=list)
    intact: bool = True
    compressed_messages: bool = False
    warnings: list[str] = field(default_factory=list)
    _unpacked: Any = None

    def warn(self, text: str) -> None:
        """Note something once."""
        if text not in self.warnings:
            self.warnings.append(text)

    def messages(
        self,
        wanted: Wanted = lambda _: True,
        start: int | None = None,
        stop: int | None = None,
    ) -> Iterator[Message]:
        """All messages of the wanted topics, of an intact recording between two times.

        An intact recording gives them in order of time, a damaged one all in the order in which
        they were written.

        Parameters
        ----------
        wanted
            Which topics.
        start, stop
            From ``start`` to before ``stop``, ns.
        """
        read = 0
        for file in self.files:
            try:
                for channel, stamp, data in self._read(file, wanted, start, stop):
                    if self.compressed_messages:
                        data = zstandard.ZstdDecompressor().decompressobj().decompress(data)
                    yield channel, stamp, data
                    read += 1
            except Exception as error:  # damage makes the libraries raise anything
                before = f"{count(read, 'message')} before that could be read"
                self.warn(f"damaged: {one_line(error)}; {before}")
                if self.intact:
                    return

    def _read(
        self, file: Path, wanted: Wanted, start: int | None, stop: int | None
    ) -> Iterator[Message]:
        if self.storage == "sqlite3":
            return sqlite_file.messages(file, wanted, start, stop, by_time=self.intact)
        if self.intact:
            return mcap_file.indexed_messages(file, wanted, start, stop)
        return mcap_file.scanned_messages(file, wanted, self.warn)

    def span(self) -> Span | None:
        """First and last time of an intact recording (ns), ``None`` if it holds no message.

        Raises
        ------
        BagError
            If it is damaged.
        """
        read = mcap_file.indexed_span if self.storage == "mcap" else sqlite_file.span
        try:
            spans = [found for file in self.files if (found := read(file)) is not None]
        except Exception as error:  # damage makes the libraries raise anything
            raise BagError(f"{self.path}: {one_line(error)}") from None
        if not spans:
            return None
        return min(first for first, _ in spans), max(last for _, last in spans)


# --- finding -----------------------------------------------------------------------------------


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
    if path.name == METADATA:
        return _open_folder(path.parent)
    if not _is_recording(path):
        raise NotABagError(f"{path}: neither an MCAP nor an SQLite recording")
    try:
        metadata = _Metadata(path.parent)
        if metadata.files == [path.name]:
            return _open_files(path.parent, [path], metadata=metadata)
    except ValueError:
        pass
    return _open_files(path, [path])


class _Metadata:
    """What ``metadata.yaml`` says of a recording's files.

    Raises
    ------
    ValueError
        If it is not there or cannot be read, with the reason.
    """

    def __init__(self, folder: Path) -> None:
        try:
            text = (folder / METADATA).read_text(encoding="utf-8")
        except OSError:
            raise ValueError(f"no {METADATA}: the recorder did not end") from None
        try:
            loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
            info = yaml.load(text, Loader=loader)["rosbag2_bagfile_information"]
            self.files = [PurePath(name).name for name in info["relative_file_paths"]]
            self.compressed_messages = str(info.get("compression_mode", "")).lower() == "message"
        except (yaml.YAMLError, KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"{METADATA} cannot be read: {one_line(error)}") from None
        missing = [name for name in self.files if not (folder / name).exists()]
        if missing:
            raise ValueError(f"{', '.join(missing)} of {METADATA} not found")


def _head(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(16)
    except OSError as error:
        raise NotABagError(f"{path}: {error.strerror}") from None


def _storage(path: Path) -> str | None:
    """Kind of recording that a file is, by its first bytes."""
    head = _head(path)
    if head.startswith(mcap_file.MAGIC):
        return "mcap"
    return "sqlite3" if head == sqlite_file.MAGIC else None


def _is_recording(path: Path) -> bool:
    return _storage(path) is not None or _head(path).startswith(ZSTD_MAGIC)


def _files_in(folder: Path) -> list[Path]:
    """Files of a folder that are named like those of recordings."""
    found = (f for f in folder.iterdir() if f.name.removesuffix(".zstd").endswith(SUFFIXES))
    return sorted((f for f in found if f.is_file()), key=lambda f: (len(f.name), f.name))


def _open_folder(path: Path) -> RawBag:
    files = _files_in(path)
    if not files and not (path / METADATA).exists():
        inner = [f for f in sorted(path.iterdir()) if f.is_dir()]
        inner = [f for f in inner if (f / METADATA).exists() or _files_in(f)]
        if len(inner) == 1:
            return _open_folder(inner[0])
        if inner:
            names = ", ".join(f.name for f in inner[:5])
            raise NotABagError(f"{path}: holds several recordings ({names}): name one")
        raise NotABagError(f"{path}: no recording in this folder")
    try:
        metadata = _Metadata(path)
        return _open_files(path, [path / name for name in metadata.files], metadata=metadata)
    except ValueError as error:
        reason = str(error)
    recordings = [f for f in files if _is_recording(f)]
    if not recordings:
        raise NotABagError(f"{path}: {reason}, and no file in it is a recording")
    bag = _open_files(path, recordings, reason)
    for file in files:
        if file not in recordings:
            bag.warn(f"{file.name} is no recording: left out")
    return bag


def _open_files(
    path: Path, files: list[Path], reason: str = "", metadata: _Metadata | None = None
) -> RawBag:
    """Open files of one recording; ``reason`` says why it is known not to be whole."""
    size = sum(file.stat().st_size for file in files)
    files, folder = _unpack(files)
    kinds = {_storage(file) for file in files}
    storage = kinds.pop() if len(kinds) == 1 else None
    if storage is None:
        raise NotABagError(f"{path}: its files are not recordings of one storage")
    bag = RawBag(path, storage, files, size, _unpacked=folder)
    bag.compressed_messages = metadata is not None and metadata.compressed_messages
    found: dict[tuple[str, str], Channel] = {}
    for file in files:
        channels, fault = _mcap_channels(file) if storage == "mcap" else _sqlite_channels(file)
        reason = reason or fault
        for channel in channels:
            found.setdefault((channel.topic, channel.msgtype), channel)
    bag.channels = list(found.values())
    if not found:
        raise NotABagError(f"{path}: a recording without anything in it")
    if reason:
        bag.intact = False
        bag.warn(f"incomplete ({reason}): what is there was read; derail repair makes it whole")
    return bag


def _unpack(files: list[Path]) -> tuple[list[Path], Any]:
    """The files, those compressed as a whole unpacked into a folder that goes with the result."""
    packed = [file for file in files if _head(file).startswith(ZSTD_MAGIC)]
    if not packed:
        return files, None
    folder = tempfile.TemporaryDirectory(prefix="derail_")
    places = {file: Path(folder.name) / file.name.removesuffix(".zstd") for file in packed}
    for source, target in places.items():
        with source.open("rb") as stream, target.open("wb") as unpacked:
            try:
                zstandard.ZstdDecompressor().copy_stream(stream, unpacked)
            except zstandard.ZstdError as error:
                raise NotABagError(f"{source}: {one_line(error)}") from None
    return [places.get(file, file) for file in files], folder


def _mcap_channels(file: Path) -> tuple[list[Channel], str]:
    """The topics of a file, and why it is not whole."""
    try:
        channels = mcap_file.indexed_channels(file)
        if channels is not None:
            return channels, ""
    except Exception:  # whatever a damaged file makes mcap raise
        return mcap_file.scanned_channels(file), "no index"
    return mcap_file.scanned_channels(file), ""


def _sqlite_channels(file: Path) -> tuple[list[Channel], str]:
    journal = "the recorder did not end" if sqlite_file.companions(file) else ""
    try:
        return sqlite_file.channels(file), journal
    except sqlite3.Error as error:
        raise NotABagError(f"{file}: {one_line(error)}") from None


# --- what it holds -----------------------------------------------------------------------------

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
            own_part = channel.definition.split("\n====", 1)[0]
            constants, fields = get_types_from_msg(own_part, channel.msgtype)[channel.msgtype]
        except Exception as error:  # rosbags raises several kinds
            raise BagVersionError(
                f"{bag.path}: the definition of {channel.msgtype} in it cannot be read"
                f" ({one_line(error)})"
            ) from None
        version = next((value for name, _, value in constants if name == "INTERFACE_VERSION"), 0)
        expected = typestore().fielddefs[channel.msgtype][1]
        if version != KNOWN_VERSION or [f[0] for f in fields] != field_names(channel.msgtype):
            raise BagVersionError(
                f"{bag.path}: {channel.msgtype} in it is of version {version} with"
                f" {len(fields)} fields; this derail_ros reads version {KNOWN_VERSION} with"
                f" {len(expected)}"
            )


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
