"""The journal of a study: each finished run as a line, from which an interrupted study goes on.

A line is written and flushed when its run is done. Whatever happens to the process, at most the
line that was being written is lost, and its run with it: a torn end is cut off when the journal is
opened again. Runs lie in arrays of the size of the study from the beginning, a few hundred bytes
each, whatever the order in which they come.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import numpy as np

from derail_ros.studies.measures import FIELDS, TEXTS, Row

FILE = "runs.journal"
NUMBERS = tuple(name for name in FIELDS if name not in TEXTS)


class JournalError(Exception):
    """The journal cannot be used; the reason is a sentence."""


class Results:
    """What all runs of a study gave, by point and member.

    Parameters
    ----------
    points, members : size of the study
    """

    def __init__(self, points: int, members: int) -> None:
        self.points = points
        self.members = members
        size = points * members
        self.done = np.zeros(size, dtype=bool)
        self.numbers = np.full((size, len(NUMBERS)), np.nan)
        # few texts, and most of them alike: kept once each
        self.texts = np.zeros((size, len(TEXTS)), dtype=np.int32)
        self._known: dict[str, int] = {"": 0}
        self._words: list[str] = [""]

    def __len__(self) -> int:
        return len(self.done)

    @property
    def missing(self) -> int:
        """Number of runs that are not there yet."""
        return int(len(self.done) - np.count_nonzero(self.done))

    def has(self, point: int, member: int) -> bool:
        """Whether a run is there."""
        return bool(self.done[point * self.members + member])

    def put(self, point: int, member: int, row: Row) -> bool:
        """Take a run in; False if it was there already, then nothing changes."""
        if not (0 <= point < self.points and 0 <= member < self.members):
            raise JournalError(f"run {point}.{member} is none of this study")
        at = point * self.members + member
        if self.done[at]:
            return False
        values = dict(zip(FIELDS, row, strict=True))
        self.numbers[at] = [np.nan if values[k] is None else values[k] for k in NUMBERS]
        self.texts[at] = [self._code(values[k] or "") for k in TEXTS]
        self.done[at] = True
        return True

    def _code(self, text: str) -> int:
        code = self._known.get(text)
        if code is None:
            code = self._known[text] = len(self._words)
            self._words.append(text)
        return code

    def number(self, name: str) -> np.ndarray:
        """A column of numbers, all runs in the order of points and members."""
        return self.numbers[:, NUMBERS.index(name)]

    def text(self, name: str) -> list[str]:
        """A column of texts."""
        return [self._words[code] for code in self.texts[:, TEXTS.index(name)]]

    def count(self, status: str) -> int:
        """Number of runs that ended so."""
        code = self._known.get(status)
        if code is None:
            return 0
        return int(np.count_nonzero(self.texts[:, TEXTS.index("status")] == code))


class Journal:
    """The journal file of a study that runs.

    Parameters
    ----------
    folder : folder of the results
    results : what the lines that are there already are put into
    """

    def __init__(self, folder: Path, results: Results) -> None:
        self.path = folder / FILE
        self.results = results
        self._file: IO[bytes] = open(self.path, "a+b")  # noqa: SIM115
        try:
            self._lock()
            self._read()
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def _lock(self) -> None:
        """Keep a second process from writing into the same study."""
        try:
            import fcntl
        except ImportError:  # not on this platform
            return
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise JournalError("another process is writing these results") from None

    def _read(self) -> None:
        self._file.seek(0)
        good = 0
        for line in self._lines():
            try:
                point, member, *row = json.loads(line)
                self.results.put(point, member, row)
            except (ValueError, TypeError) as error:
                raise JournalError(
                    f"{self.path}: a line in it cannot be read ({error}); "
                    "delete the folder to begin anew"
                ) from None
            good += len(line)
        # what follows is a line that was not finished
        self._file.truncate(good)
        self._file.seek(good)

    def _lines(self) -> Iterator[bytes]:
        for line in self._file:
            if line.endswith(b"\n"):
                yield line

    def write(self, point: int, member: int, row: Row) -> bool:
        """Keep a run; False if it was there already."""
        if not self.results.put(point, member, row):
            return False
        line = json.dumps([point, member, *row], ensure_ascii=False, allow_nan=False)
        self._file.write(line.encode() + b"\n")
        self._file.flush()
        return True

    def sync(self) -> None:
        """Wait until the file is on the disk."""
        with contextlib.suppress(OSError):
            os.fsync(self._file.fileno())
