"""The journal of a study: one line a finished run; an interrupted study continues from it.

A line is a JSON object: point, member and the columns of the table of runs. It is written and
flushed when its run is done. If the process ends, the line that was being written is lost at
most, and its run with it: a torn end is cut off when the journal is opened again.
"""

from __future__ import annotations

import contextlib
import json
import os
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from derail_ros.studies.study_measures import columns

if TYPE_CHECKING:
    import pandas

    from derail_ros.studies.ensemble import Job
    from derail_ros.vocabulary.outcome import Outcome

FILE = "runs.journal"
TEXTS = ("status", "error", "peak_force_pair")
"""Columns of text, before those of numbers."""

Row = dict[str, Any]


class JournalError(Exception):
    """The journal cannot be used; the reason is a sentence."""


# --- the columns of a run ---------------------------------------------------------------------


def row_of(outcome: Outcome, job: Job) -> Row:
    """The columns of a run that did not fail; those without a value are left out."""
    pair = outcome.peak_force_pair
    row: Row = {
        "status": outcome.status,
        "error": "",
        "peak_force_pair": "" if pair is None else "{}-{}".format(*pair),
        "lateral_factor": job.factor,
    }
    for key, m in columns().items():
        value = m.number(m.value(outcome))
        if value is not None:
            row[key] = int(value) if m.whole else value
    return row


def failed_row(error: str, job: Job) -> Row:
    """The columns of a run that failed."""
    return {
        "status": "failed",
        "error": error,
        "peak_force_pair": "",
        "lateral_factor": job.factor,
    }


# --- the file ---------------------------------------------------------------------------------


class Journal:
    """The journal file of a study that runs.

    Parameters
    ----------
    folder : folder of the results
    points, members : size of the study

    Attributes
    ----------
    done : (points, members) runs that are there
    """

    def __init__(self, folder: Path, points: int, members: int) -> None:
        self.path = folder / FILE
        self.done = np.zeros((points, members), dtype=bool)
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

    @property
    def missing(self) -> int:
        """Number of runs that are not there yet."""
        return int(self.done.size - np.count_nonzero(self.done))

    def _lock(self) -> None:
        """Keep a second process from writing into the same study."""
        try:
            import fcntl
        except ImportError:  # not on this platform
            return
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise JournalError("another process is writing to this folder") from None

    def _read(self) -> None:
        self._file.seek(0)
        good = 0
        for line in self._file:
            if not line.endswith(b"\n"):
                break
            try:
                row = json.loads(line)
                self._mark(row["point"], row["member"])
            except (ValueError, TypeError, KeyError) as error:
                raise JournalError(
                    f"{self.path}: cannot read a line ({error}); delete the folder to begin anew"
                ) from None
            good += len(line)
        # what follows is a line that was not finished
        self._file.truncate(good)
        self._file.seek(good)

    def _mark(self, point: int, member: int) -> bool:
        """Note that a run is there; False if it was before."""
        points, members = self.done.shape
        if not (0 <= point < points and 0 <= member < members):
            raise JournalError(
                f"{self.path}: contains run {point}.{member}, which the study does not have"
            )
        if self.done[point, member]:
            return False
        self.done[point, member] = True
        return True

    def write(self, point: int, member: int, row: Row) -> bool:
        """Keep a run; False if it was there already."""
        if not self._mark(point, member):
            return False
        line = {"point": point, "member": member, **row}
        text = json.dumps(line, ensure_ascii=False, allow_nan=False)
        self._file.write(text.encode() + b"\n")
        self._file.flush()
        return True

    def sync(self) -> None:
        """Wait until the file is on the disk."""
        with contextlib.suppress(OSError):
            os.fsync(self._file.fileno())

    def table(self) -> pandas.DataFrame:
        """All runs that are there, in the order of points and members."""
        import pandas as pd
        import pyarrow as pa
        from pyarrow import json as arrow

        whole, number = pa.int64(), pa.float64()
        schema = pa.schema(
            [
                ("point", whole),
                ("member", whole),
                *((name, pa.string()) for name in TEXTS),
                ("lateral_factor", number),
                *((key, whole if m.whole else number) for key, m in columns().items()),
            ]
        )
        if not self.done.any():
            found = schema.empty_table()
        else:
            options = arrow.ParseOptions(
                explicit_schema=schema, unexpected_field_behavior="ignore"
            )
            found = arrow.read_json(self.path, parse_options=options)
            found = found.sort_by([("point", "ascending"), ("member", "ascending")])
        frame = found.to_pandas(types_mapper={whole: pd.Int64Dtype()}.get)
        return frame.astype({"point": np.int64, "member": np.int64})
