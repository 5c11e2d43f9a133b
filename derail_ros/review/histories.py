"""Histories of the cars as tables: every recorded state, every quantity, units in the names.

The tables hold what the source model writes: coordinates, velocities, accelerations and the
coupler error; brake, ground, striker, knuckle and collision forces; force, gap and closing speed
at each corner. Rows are written as the
recording is read, so a long recording needs no more memory than a short one.
"""

from __future__ import annotations

import csv
import functools
import json
import math
import re
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from derail_ros.recording.decoding import PACKAGE, decode
from derail_ros.recording.recorded_run import RecordedRun
from derail_ros.recording.storage import BagError, open_bag
from derail_ros.review.summary import by_severity, fields_of
from derail_ros.vocabulary.status import CORNERS
from msg_adapters.definitions import read_copy

FORMATS = ("csv", "parquet")

RENAMED = {
    "truck_status_front": "truck_front_on_rails",
    "truck_status_rear": "truck_rear_on_rails",
    "constraint_force_x": "coupler_force_x",
    "constraint_force_y": "coupler_force_y",
    "gap_error": "coupler_error",
}
"""Fields of messages whose column has another name."""

Row = dict[str, Any]


@functools.cache
def columns_of(kind: str, size: str) -> dict[str, str]:
    """Arrays of a message and their columns: field -> its name with the unit of the definition.

    Parameters
    ----------
    kind : a message of ``derail_msgs``
    size : ``"N"``, ``"N-1"`` or ``"4 N"``, as the definition gives it; of ``"4 N"`` (one entry a
        corner) the name has a place for the corner
    """
    pattern = rf"^\w+\[\] (\w+) +# \[(.*?)\].*\({size}\)$"
    found = re.findall(pattern, read_copy()[f"{PACKAGE}{kind}"], re.MULTILINE)
    columns = {}
    for field, unit in found:
        name = RENAMED.get(field, field) + ("_{}" if size == "4 N" else "")
        plain = re.fullmatch(r"(?:rad|kg|[msNJ]|[ /^2])+", unit)
        columns[field] = f"{name}_{re.sub('[ /]', '_', unit.replace('^', ''))}" if plain else name
    return columns


# --- writing ---------------------------------------------------------------------------------


class _Csv:
    def __init__(self, path: Path) -> None:
        self.path = path.with_suffix(".csv")
        self.file = self.path.open("w", newline="", encoding="utf-8")
        self.writer: Any = None

    def write(self, columns: Row) -> None:
        if self.writer is None:
            self.writer = csv.writer(self.file)
            self.writer.writerow(columns)
        self.writer.writerows(zip(*(_plain(values) for values in columns.values())))

    def close(self) -> None:
        self.file.close()


def _plain(values: Any) -> list[Any]:
    """Numbers in the fewest digits that give them back; an empty cell where there is none."""
    rows = values.tolist() if isinstance(values, np.ndarray) else list(values)
    return [
        "" if v is None or (isinstance(v, float) and math.isnan(v)) else _cell(v) for v in rows
    ]


def _cell(value: Any) -> Any:
    # A text that a spreadsheet would take for a formula is kept a text.
    if isinstance(value, str) and value.startswith(("=", "+", "-", "@", "\t", "\r")):
        return "'" + value
    return value


class _Parquet:
    """Rows gathered into groups, so that files are small and quick to read."""

    GROUP = 200_000

    def __init__(self, path: Path) -> None:
        self.path = path.with_suffix(".parquet")
        self.writer: Any = None
        self.held: list[Row] = []
        self.rows = 0

    def write(self, columns: Row) -> None:
        self.held.append(columns)
        self.rows += len(next(iter(columns.values())))
        if self.rows >= self.GROUP:
            self._flush()

    def _flush(self) -> None:
        import pyarrow
        import pyarrow.parquet

        if not self.held:
            return
        joined: Row = {}
        for name in self.held[0]:
            parts = [block[name] for block in self.held]
            if isinstance(parts[0], np.ndarray):
                joined[name] = np.concatenate(parts)
            else:
                joined[name] = [value for part in parts for value in part]
        table = pyarrow.table(joined)
        if self.writer is None:
            self.writer = pyarrow.parquet.ParquetWriter(
                self.path, table.schema, compression="zstd"
            )
        self.writer.write_table(table)
        self.held, self.rows = [], 0

    def close(self) -> None:
        self._flush()
        if self.writer is not None:
            self.writer.close()


# --- tables ----------------------------------------------------------------------------------


def _table(m: Any, kind: str, size: str, n: int, **first: Any) -> Row:
    """The arrays of one size of a message as columns, after time and what ``first`` gives."""
    columns: Row = {"time_s": np.full(n, float(m.time)), **first}
    for field, name in columns_of(kind, size).items():
        columns[name] = _whole(np.asarray(getattr(m, field)))
    return columns


def _whole(values: Any) -> Any:
    return values.astype(np.int64) if values.dtype.kind == "u" else values


def _more(m: Any) -> Row:
    """Further quantities of a message, by name."""
    return {quantity.key: np.array(quantity.values) for quantity in m.more}


def state_rows(m: Any) -> Row:
    """A state message as columns, one row a car."""
    n = len(m.x)
    columns = _table(m, "TrainState", "N", n, car=np.arange(1, n + 1))
    for axis in ("x", "y"):
        parts = (columns[f"ground_force_{part}_{axis}_N"] for part in ("front", "rear", "body"))
        columns[f"ground_force_total_{axis}_N"] = sum(parts)
    for field, name in columns_of("TrainState", "4 N").items():
        values = _whole(np.asarray(getattr(m, field)).reshape(n, len(CORNERS)))
        for k, corner in enumerate(CORNERS):
            column = name.format(corner.replace(" ", "_"))
            columns[column] = np.ascontiguousarray(values[:, k])
    return columns | _more(m)


def striker_rows(m: Any) -> Row:
    """Striker forces of a coupler message as columns, one row a car."""
    n = len(m.striker_force_front)
    return _table(m, "CouplerStates", "N", n, car=np.arange(1, n + 1))


def coupling_rows(m: Any) -> Row:
    """A coupler message as columns, one row a coupling."""
    n = len(m.coupled)
    cars = {"car_ahead": np.arange(1, n + 1), "car_behind": np.arange(2, n + 2)}
    return _table(m, "CouplerStates", "N-1", n, **cars) | _more(m)


def energy_rows(m: Any) -> Row:
    """An energy message as columns, one row."""
    entries = {f"{q.key}_J": np.array(q.values[:1]) for q in m.entries}
    return {"time_s": np.array([float(m.time)])} | entries


STREAMS: dict[str, tuple[tuple[str, Callable[[Any], Row]], ...]] = {
    "TrainState": (("cars", state_rows),),
    "CouplerStates": (("strikers", striker_rows), ("couplings", coupling_rows)),
    "EnergyLedger": (("energy", energy_rows),),
}
"""Message -> tables written from it while the recording is read."""


def _columns(rows: list[Row]) -> Row:
    return {name: [row[name] for row in rows] for name in rows[0]} if rows else {"id": []}


def collision_rows(run: RecordedRun) -> Row:
    """The collisions as columns, the hardest first."""
    return _columns([fields_of(c) | {"touch": c.touch} for c in by_severity(run)])


def event_rows(run: RecordedRun) -> Row:
    """The events as columns, in order of time."""
    return _columns(
        [
            {"sequence": k}
            | fields_of(e)
            | {
                "kind": e.kind.word,
                "cars": " ".join(map(str, e.cars)),
                "value_unit": e.value_unit,
                "more": json.dumps(dict(e.more)) if e.more else "",
                "text": e.text,
            }
            for k, e in enumerate(run.events)
        ]
    )


def consist_rows(run: RecordedRun) -> Row:
    """The train as columns, one row a car."""
    cars, outcome = run.cars, run.outcome
    return {
        "car": np.arange(1, len(cars) + 1),
        "name": list(cars.name),
        "type": list(cars.kind),
        "contents": list(cars.contents),
        "mass_kg": cars.mass,
        "length_m": cars.length,
        "width_m": cars.width,
        "pivot_distance_m": cars.pivot,
        "truck_distance_m": cars.truck,
        "represents_cars": cars.represents,
        "derailed_at_s": outcome.derail_time,
        "derailed_speed_m_s": outcome.derail_speed,
        "peak_force_N": outcome.car_peak_force,
        "peak_force_time_s": outcome.car_peak_time,
        "peak_force_from": outcome.car_peak_other,
    }


def file_rows(run: RecordedRun) -> Row:
    """What the scenario was made from: files by name."""
    return {
        "name": list(run.files),
        "bytes": [len(data) for data in run.files.values()],
        "sha256": [sha256(data).hexdigest() for data in run.files.values()],
    }


def export(run: RecordedRun, folder: Path, form: str = "csv") -> dict[str, int]:
    """Write the tables of a run; returns their files and numbers of rows.

    Raises
    ------
    ValueError
        If the format is neither ``csv`` nor ``parquet``.
    BagError
        If a state cannot be made into rows.
    """
    if form not in FORMATS:
        raise ValueError(f"format must be csv or parquet, got {form!r}")
    kind = _Csv if form == "csv" else _Parquet
    counts: dict[str, int] = {}
    with ExitStack() as stack:
        writers: dict[str, Any] = {}

        def put(name: str, columns: Row) -> None:
            rows = len(next(iter(columns.values())))
            if name not in writers:
                if rows == 0:
                    return
                writers[name] = kind(folder / name)
                stack.callback(writers[name].close)
                counts[writers[name].path.name] = 0
            writers[name].write(columns)
            counts[writers[name].path.name] += rows

        put("files", file_rows(run))
        put("consist", consist_rows(run))
        put("events", event_rows(run))
        put("collisions", collision_rows(run))
        for message, kind_name in _stream(run):
            for name, rows in STREAMS[kind_name]:
                put(name, rows(message))
    return counts


def _stream(run: RecordedRun) -> Iterator[tuple[Any, str]]:
    """The state messages of a run, each moment once."""
    bag = open_bag(run.path)
    wanted = {f"{PACKAGE}{name}": name for name in STREAMS}
    prefix = run.prefix
    seen: dict[str, float] = {}
    for channel, _, data in bag.messages(
        lambda c: c.msgtype in wanted and c.topic.rpartition("/")[0] == prefix
    ):
        try:
            message = decode(channel, data)
        except Exception as error:  # whatever bytes that are no message make rosbags raise
            raise BagError(f"{run.path}: a message of {channel.topic} cannot be read") from error
        name = wanted[channel.msgtype]
        if message.run_id != run.run_id or message.time <= seen.get(name, -math.inf):
            continue
        seen[name] = message.time
        yield message, name
