"""Recordings on disk: found at a path, opened whole or damaged, their messages as bytes.

A recording is a rosbag2 folder or a file of one (MCAP or SQLite, also compressed with zstd). A
recording whose writer was killed has neither index nor metadata; its files are then read from
their beginning.
"""

from __future__ import annotations

import sqlite3
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import Any

import yaml
import zstandard

from derail_ros.recording import mcap_file, sqlite_file
from derail_ros.recording.channels import Channel, Message, Span, Wanted, one_line
from derail_ros.vocabulary.words import count

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
    """A recording that was found and can be read."""

    path: Path  # folder or file
    storage: str  # "mcap" or "sqlite3"
    files: list[Path]  # in order; of compressed ones the unpacked copies
    size: int  # bytes on disk
    channels: list[Channel] = field(default_factory=list)
    # first and last time of each file with an index, ns
    spans: list[Span] = field(default_factory=list)
    intact: bool = True  # index and metadata are there
    compressed_messages: bool = False  # each message by itself
    # what is wrong with it; grows while it is read
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
        """Messages of the wanted topics.

        An intact recording gives those from ``start`` to before ``stop`` (ns) in order of time, a
        damaged one all that are left in the order in which they were written.
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
        return mcap_file.Scan(file, self.warn).messages(wanted)

    def span(self) -> Span | None:
        """First and last time of all messages, ns; ``None`` if there are none."""
        if len(self.spans) == len(self.files):
            times = [time for span in self.spans for time in span]
        else:
            times = [stamp for _, stamp, _ in self.messages()]
        return (min(times), max(times)) if times else None


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
    except ValueError:
        return _open_files(path, [path])
    if metadata.files == [path.name]:
        return _open_files(path.parent, [path], metadata=metadata)
    return _open_files(path, [path])


class _Metadata:
    """What ``metadata.yaml`` says about a recording's files.

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
            self.compressed_messages = str(info.get("compression_mode")).lower() == "message"
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


def repaired_name(path: Path) -> str:
    """Name of the folder in which ``derail repair`` makes a recording whole."""
    name = path.name.removesuffix(".zstd")
    return f"{Path(name).stem if name.endswith(SUFFIXES) else name}_repaired"


def _open_folder(path: Path) -> RawBag:
    files = _files_in(path)
    if not (path / METADATA).exists():
        inner = [f for f in sorted(path.iterdir()) if f.is_dir()]
        inner = [f for f in inner if (f / METADATA).exists() or _files_in(f)]
        whole = {f.name: f for f in inner}
        damaged = [f for f in [*files, *inner] if repaired_name(f) in whole]
        if damaged and len(files) + len(inner) == 2:
            bag = _open_folder(whole[repaired_name(damaged[0])])
            bag.warn(f"read in place of {damaged[0].name}, from which it was repaired")
            return bag
        if not files and len(inner) == 1:
            return _open_folder(inner[0])
        if not files and inner:
            names = ", ".join(f.name for f in inner[:5])
            raise NotABagError(f"{path}: contains several recordings ({names}): name one")
        if not files:
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
            bag.warn(f"{file.name} is not a recording and was skipped")
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
        raise NotABagError(f"{path}: its files use different storage formats")
    bag = RawBag(path, storage, files, size, _unpacked=folder)
    bag.compressed_messages = metadata is not None and metadata.compressed_messages
    found: dict[tuple[str, str], Channel] = {}
    for file in files:
        fault = _open_mcap(bag, file) if storage == "mcap" else _open_sqlite(bag, file)
        reason = reason or fault
    for channel in bag.channels:
        found.setdefault((channel.topic, channel.msgtype), channel)
    bag.channels = list(found.values())
    if not found:
        raise NotABagError(f"{path}: the recording is empty")
    if reason:
        bag.intact = False
        bag.warn(f"incomplete ({reason}): reading what is there; derail repair completes it")
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


def _open_mcap(bag: RawBag, file: Path) -> str:
    """Take the topics of a file; why it is not whole, or ""."""
    fault = ""
    try:
        index = mcap_file.read_index(file)
    except Exception:  # whatever a damaged file makes mcap raise
        index, fault = None, "no index"
    if index is None:
        bag.channels += mcap_file.Scan(file).channels()
        return fault
    bag.channels += index.channels.values()
    bag.spans += [] if index.span is None else [index.span]
    return ""


def _open_sqlite(bag: RawBag, file: Path) -> str:
    """Take the topics of a file; why it is not whole, or ""."""
    try:
        bag.channels += sqlite_file.channels(file)
        span = sqlite_file.span(file)
    except sqlite3.Error as error:
        raise NotABagError(f"{file}: {one_line(error)}") from None
    bag.spans += [] if span is None else [span]
    return "the recorder did not end" if sqlite_file.companions(file) else ""
