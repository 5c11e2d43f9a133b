"""Finding and reading scenario files: names and paths are kept apart."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

from derail_ros.config_path import config_dir
from derail_ros.scenario.errors import ScenarioError
from derail_ros.scenario.strict_yaml import MAX_BYTES

_NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9_.-]{0,99}\Z")
SUFFIXES = (".yaml", ".yml")


def is_name(text: str) -> bool:
    """Whether a text may name a scenario: it has no path separator and no leading dot."""
    return bool(_NAME.match(text))


def is_path(text: str) -> bool:
    """Whether a text is meant as the path of a file: it has a separator or ends in .yaml."""
    return os.sep in text or text.endswith(SUFFIXES)


def search_dirs(dirs: Iterable[str | os.PathLike[str]] | None) -> tuple[Path, ...]:
    """Folders in which names are looked up: the given ones first, then the shipped one."""
    return (*map(Path, dirs or ()), config_dir() / "scenarios")


def find(name: str, folders: Iterable[Path]) -> Path | None:
    """File of the scenario ``name`` in the first folder that has one."""
    if not is_name(name):
        return None
    for folder in folders:
        for suffix in SUFFIXES:
            path = folder / f"{name}{suffix}"
            if path.is_file():
                return path
    return None


def all_files(folders: Iterable[Path]) -> Iterator[tuple[str, Path]]:
    """Every scenario file with a valid name, the one that is found first for each name."""
    seen: set[str] = set()
    for folder in folders:
        for path in sorted(folder.glob("*")) if folder.is_dir() else ():
            if path.suffix in SUFFIXES and is_name(path.stem) and path.stem not in seen:
                found = find(path.stem, folders)
                if found is not None:
                    seen.add(path.stem)
                    yield path.stem, found


def read_text(path: Path) -> str:
    """Text of a file of at most 512 KB.

    Raises
    ------
    ScenarioError
        If it is not a readable text file, or too long.
    """
    name = str(path)
    try:
        is_file, exists = path.is_file(), path.exists()
        data = b""
        if is_file:
            with path.open("rb") as stream:
                data = stream.read(MAX_BYTES + 1)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise ScenarioError(name, None, "", f"cannot be read: {reason}") from None
    if not is_file:
        raise ScenarioError(name, None, "", "is not a file" if exists else "no such file")
    if len(data) > MAX_BYTES:
        raise ScenarioError(name, None, "", f"is over the limit of {MAX_BYTES // 1024} KB")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise ScenarioError(name, line, "", "is not UTF-8 text") from None
