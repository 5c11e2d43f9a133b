"""Histories of the cars as tables: every recorded state, every quantity, units in the names.

The tables hold what the source model writes: coordinates, velocities, accelerations and the
coupler error; brake, ground, striker, knuckle and collision forces; force, gap and closing speed
at each corner. Rows are written as the
recording is read, so a long recording needs no more memory than a short one.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from derail_ros.recording.decoding import decode
from derail_ros.recording.recorded_run import RecordedRun
from derail_ros.recording.storage import BagError, open_bag
from derail_ros.review.summary import by_severity

FORMATS = ("csv", "parquet")

STATE_COLUMNS: tuple[tuple[str, str], ...] = (
    ("x", "x_m"),
    ("y", "y_m"),
    ("z", "z_m"),
    ("roll", "roll_rad"),
    ("pitch", "pitch_rad"),
    ("yaw", "yaw_rad"),
    ("coupler_angle_front", "coupler_angle_front_rad"),
    ("coupler_angle_rear", "coupler_angle_rear_rad"),
    ("vx", "vx_m_s"),
    ("vy", "vy_m_s"),
    ("vz", "vz_m_s"),
    ("roll_rate", "roll_rate_rad_s"),
    ("pitch_rate", "pitch_rate_rad_s"),
    ("yaw_rate", "yaw_rate_rad_s"),
    ("coupler_rate_front", "coupler_rate_front_rad_s"),
    ("coupler_rate_rear", "coupler_rate_rear_rad_s"),
    ("ax", "ax_m_s2"),
    ("ay", "ay_m_s2"),
    ("az", "az_m_s2"),
    ("roll_acceleration", "roll_acceleration_rad_s2"),
    ("pitch_acceleration", "pitch_acceleration_rad_s2"),
    ("yaw_acceleration", "yaw_acceleration_rad_s2"),
    ("coupler_acceleration_front", "coupler_acceleration_front_rad_s2"),
    ("coupler_acceleration_rear", "coupler_acceleration_rear_rad_s2"),
    ("truck_status_front", "truck_front_on_rails"),
    ("truck_status_rear", "truck_rear_on_rails"),
    ("track_coordinate_front", "track_coordinate_front_m"),
    ("track_coordinate_rear", "track_coordinate_rear_m"),
    ("rail_force_front", "rail_force_front_N"),
    ("rail_force_rear", "rail_force_rear_N"),
    ("brake_force", "brake_force_N"),
    ("ground_force_front_x", "ground_force_front_x_N"),
    ("ground_force_front_y", "ground_force_front_y_N"),
    ("ground_force_rear_x", "ground_force_rear_x_N"),
    ("ground_force_rear_y", "ground_force_rear_y_N"),
    ("ground_force_body_x", "ground_force_body_x_N"),
    ("ground_force_body_y", "ground_force_body_y_N"),
    ("ground_moment", "ground_moment_N_m"),
    ("collision_force_x", "collision_force_x_N"),
    ("collision_force_y", "collision_force_y_N"),
    ("collision_moment", "collision_moment_N_m"),
    ("largest_corner_force", "largest_corner_force_N"),
    ("external_force_x", "external_force_x_N"),
    ("external_force_y", "external_force_y_N"),
    ("external_moment", "external_moment_N_m"),
)
"""Field of ``derail_msgs/TrainState`` and name of its column."""

CORNERS = ("front_left", "front_right", "rear_left", "rear_right")
CORNER_COLUMNS: tuple[tuple[str, str], ...] = (
    ("corner_force", "corner_force_{}_N"),
    ("corner_gap", "corner_gap_{}_m"),
    ("corner_closing_speed", "corner_closing_speed_{}_m_s"),
    ("corner_other_car", "corner_other_car_{}"),
)
"""Corner field of ``derail_msgs/TrainState`` and name of its column at each of the corners."""

STRIKER_COLUMNS = (
    ("striker_force_front", "striker_force_front_N"),
    ("striker_force_rear", "striker_force_rear_N"),
)

COUPLING_COLUMNS: tuple[tuple[str, str], ...] = (
    ("coupled", "coupled"),
    ("relative_angle", "relative_angle_rad"),
    ("knuckle_moment", "knuckle_moment_N_m"),
    ("constraint_force_x", "coupler_force_x_N"),
    ("constraint_force_y", "coupler_force_y_N"),
    ("axial_force", "axial_force_N"),
    ("gap_error", "coupler_error_m"),
)
"""Field of ``derail_msgs/CouplerStates`` and name of its column: the coupling behind a car."""

INTEGERS = {"car", "car_ahead", "car_behind", "coupled", "step"} | {
    name for _, name in STATE_COLUMNS if name.endswith("_on_rails")
}

Row = dict[str, Any]


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


def state_rows(m: Any) -> Row:
    """A state message as columns, one row a car."""
    n = len(m.x)
    columns: Row = {"time_s": np.full(n, float(m.time)), "car": np.arange(1, n + 1)}
    for field, name in STATE_COLUMNS:
        values = np.asarray(getattr(m, field))
        columns[name] = values.astype(np.int64) if name in INTEGERS else values
    for axis in ("x", "y"):
        parts = (columns[f"ground_force_{part}_{axis}_N"] for part in ("front", "rear", "body"))
        columns[f"ground_force_total_{axis}_N"] = sum(parts)
    for field, name in CORNER_COLUMNS:
        corners = np.asarray(getattr(m, field)).reshape(n, len(CORNERS))
        for k, corner in enumerate(CORNERS):
            columns[name.format(corner)] = np.ascontiguousarray(corners[:, k])
    return columns | _more(m)


def _more(m: Any) -> Row:
    """Further quantities of a message, by name."""
    return {quantity.key: np.array(quantity.values) for quantity in m.more}


def striker_rows(m: Any) -> Row:
    """Striker forces of a coupler message as columns, one row a car."""
    n = len(m.striker_force_front)
    columns: Row = {"time_s": np.full(n, float(m.time)), "car": np.arange(1, n + 1)}
    return columns | {name: np.asarray(getattr(m, field)) for field, name in STRIKER_COLUMNS}


def coupling_rows(m: Any) -> Row:
    """A coupler message as columns, one row a coupling."""
    n = len(m.coupled)
    columns: Row = {
        "time_s": np.full(n, float(m.time)),
        "car_ahead": np.arange(1, n + 1),
        "car_behind": np.arange(2, n + 2),
    }
    for field, name in COUPLING_COLUMNS:
        values = np.asarray(getattr(m, field))
        columns[name] = values.astype(np.int64) if name in INTEGERS else values
    return columns | _more(m)


def energy_rows(m: Any) -> Row:
    """An energy message as columns, one row."""
    columns: Row = {"time_s": np.array([float(m.time)])}
    return columns | {f"{q.key}_J": np.array(q.values[:1]) for q in m.entries}


STREAMS: dict[str, tuple[tuple[str, Callable[[Any], Row]], ...]] = {
    "TrainState": (("cars", state_rows),),
    "CouplerStates": (("strikers", striker_rows), ("couplings", coupling_rows)),
    "EnergyLedger": (("energy", energy_rows),),
}
"""Message -> tables written from it while the recording is read."""


def _column(rows: Sequence[Any], get: Callable[[Any], Any]) -> list[Any]:
    return [get(row) for row in rows]


def collision_rows(run: RecordedRun) -> Row:
    """The collisions as columns, the hardest first."""
    rows = by_severity(run)
    columns: dict[str, Callable[[Any], Any]] = {
        "id": lambda c: c.id,
        "striking_car": lambda c: c.car_a,
        "struck_car": lambda c: c.car_b,
        "start_s": lambda c: c.start,
        "end_s": lambda c: c.end,
        "peak_corner_force_N": lambda c: c.peak_force,
        "peak_corner_force_time_s": lambda c: c.peak_time,
        "peak_resultant_force_N": lambda c: c.peak_resultant,
        "peak_resultant_force_time_s": lambda c: c.peak_resultant_time,
        "closing_speed_m_s": lambda c: c.closing_speed,
        "angle_rad": lambda c: c.angle,
        "x_m": lambda c: c.x,
        "y_m": lambda c: c.y,
        "normal_x": lambda c: c.normal_x,
        "normal_y": lambda c: c.normal_y,
        "corner_car": lambda c: c.corner_car,
        "touch": lambda c: c.touch,
        "energy_taken_out_J": lambda c: c.energy_lost,
    }
    return {name: _column(rows, get) for name, get in columns.items()}


def event_rows(run: RecordedRun) -> Row:
    """The events as columns, in order of time."""
    rows = run.events
    columns: dict[str, Callable[[Any], Any]] = {
        "time_s": lambda e: e.time,
        "step": lambda e: e.step,
        "kind": lambda e: e.kind.word,
        "cars": lambda e: " ".join(str(c) for c in e.cars),
        "end": lambda e: e.end,
        "cause": lambda e: e.cause,
        "x_m": lambda e: e.x,
        "y_m": lambda e: e.y,
        "track_coordinate_m": lambda e: e.track_coordinate,
        "speed_m_s": lambda e: e.speed,
        "value": lambda e: e.value,
        "value_unit": lambda e: e.value_unit,
        "before": lambda e: e.before,
        "after": lambda e: e.after,
        "text": lambda e: e.text,
    }
    return {name: _column(rows, get) for name, get in columns.items()}


def consist_rows(run: RecordedRun) -> Row:
    """The train as columns, one row a car."""
    cars = run.cars
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
        "derailed_at_s": run.outcome.derail_time,
        "derailed_speed_m_s": run.outcome.derail_speed,
        "peak_corner_force_N": run.outcome.car_peak_force,
        "peak_corner_force_time_s": run.outcome.car_peak_time,
        "peak_corner_force_other_car": run.outcome.car_peak_other,
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
        raise ValueError(f"format: csv or parquet, not {form!r}")
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
    wanted = {f"derail_msgs/msg/{name}": name for name in STREAMS}
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
