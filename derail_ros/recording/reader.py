"""A recording as plain numpy arrays.

:func:`read_bag` reads one run of a recording: the train, the track, the states car by car, the
events, the collisions and the outcome. It bears with recordings that are cut off, damaged or
incomplete, says so in ``warnings``, and works out from what is there what is missing.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from derail_ros.recording.soundness import ENERGY_ENTRIES, believable
from derail_ros.recording.storage import (
    BagError,
    BagVersionError,
    NotABagError,
    OtherTopicsError,
    RawBag,
    check_version,
    open_bag,
    topics_of,
)
from derail_ros.review.scene import Scene
from derail_ros.vocabulary.words import count
from msg_adapters.definitions import deserialize, read_copy

__all__ = [
    "BagError",
    "BagVersionError",
    "Contact",
    "Happening",
    "NotABagError",
    "OtherTopicsError",
    "Result",
    "Run",
    "read_bag",
]

F64 = NDArray[np.float64]
Bool = NDArray[np.bool_]
Int = NDArray[np.int64]

BUDGET = 120_000_000
"""Memory for the states of a run; of longer ones every second, fourth ... state is kept, bytes."""

STATUS = ("running", "at rest", "time limit", "void", "failed", "stopped")
CUT_OFF = "cut off"
CORNERS = ("front left", "front right", "rear left", "rear right")
WALLS = {0: "front end", 1: "left side", 2: "rear end", 3: "right side", 4: "corner"}
ENDS = ("", "front", "rear")


@dataclass(frozen=True)
class Happening:
    """An event of a run, with the fields of ``derail_msgs/TrainEvent``."""

    sequence: int
    time: float
    step: int
    kind: str
    cars: tuple[int, ...]
    end: str
    cause: str
    x: float
    y: float
    track_coordinate: float
    speed: float
    value: float
    value_unit: str
    before: str
    after: str
    text: str


@dataclass(frozen=True)
class Contact:
    """A collision of a run, with the fields of ``derail_msgs/Collision``."""

    id: int
    final: bool
    car_a: int
    car_b: int
    corner_car: int
    corner: int
    wall: int
    start: float
    end: float
    peak_force: float
    peak_time: float
    peak_resultant: float
    peak_resultant_time: float
    closing_speed: float
    x: float
    y: float
    normal_x: float
    normal_y: float
    angle: float
    energy_lost: float

    @property
    def other_car(self) -> int:
        """The car whose wall was struck by the corner."""
        return self.car_b if self.corner_car == self.car_a else self.car_a

    @property
    def touch(self) -> str:
        """What touched what, in words."""
        wall = WALLS.get(self.wall)
        place = "" if wall is None else f", {wall}"
        corner = CORNERS[self.corner] if self.corner < len(CORNERS) else "a"
        return f"{corner} corner of car {self.corner_car} on car {self.other_car}{place}"


@dataclass(frozen=True)
class Cars:
    """The train, N cars; SI units, index 0 is car 1.

    Attributes
    ----------
    name, kind, contents : (N,) label, type of rolling stock, load; "" if unknown
    mass, length, width : (N,) kg, m, m
    pivot, truck : (N,) centre to coupler pivot and to truck, m
    coupler : (N, 2) length of the couplers, front and rear, m
    coupler_kind : (N,) front and rear type, for example ("E60", "F79")
    angle_limit : (N-1,) relative angle at which a coupling parts, rad
    represents : (N,) cars that a body stands for
    """

    name: tuple[str, ...]
    kind: tuple[str, ...]
    contents: tuple[str, ...]
    mass: F64
    length: F64
    width: F64
    pivot: F64
    truck: F64
    coupler: F64
    coupler_kind: tuple[tuple[str, str], ...]
    angle_limit: F64
    represents: Int

    def __len__(self) -> int:
        return len(self.mass)

    @property
    def real(self) -> Bool:
        """(N,) the body stands for itself only."""
        return self.represents == 1


@dataclass(frozen=True)
class Line:
    """The track: s, x, y (m), heading (rad), curvature (1/m) of M points, and K breaks.

    ``breaks`` are rows of track coordinate, x, y (m), heading (rad) and time of opening (s).
    """

    s: F64
    x: F64
    y: F64
    heading: F64
    curvature: F64
    breaks: F64

    @property
    def straight(self) -> bool:
        """The track is straight along +X."""
        return len(self.y) == 0 or bool(np.ptp(self.y) < 1e-6)


@dataclass(frozen=True)
class Result:
    """What came of a run; ``nan`` and 0 where a quantity does not exist.

    Attributes
    ----------
    status : how it ended, "running" or "cut off" if it is not known
    final : the recording holds the end of the run
    void : not a valid run: more cars must be modelled
    time, duration : run time and time to rest (nan: it did not come to rest), s
    steps, rejected : integration steps
    derailed : car numbers
    derail_time, derail_speed : (N,) s, m/s
    peak_force, peak_pair, peak_time, peak_resultant : N, (a, b), s, N
    car_peak, car_peak_other, car_peak_time : (N,) N, car number, s
    above_5MN, above_10MN : car numbers
    length, width, area : of the scene, m, m, m^2
    rear_car, rear_stop : first car still on the rails behind and its track coordinate, m
    max_gap, max_offset : largest errors of the constraints, m
    residual : largest imbalance of the energy, share of the initial energy
    severity : against the source's base train
    """

    status: str
    final: bool
    void: bool
    time: float
    duration: float
    steps: int
    rejected: int
    derailed: tuple[int, ...]
    derail_time: F64
    derail_speed: F64
    peak_force: float
    peak_pair: tuple[int, int]
    peak_time: float
    peak_resultant: float
    car_peak: F64
    car_peak_other: Int
    car_peak_time: F64
    above_5MN: tuple[int, ...]
    above_10MN: tuple[int, ...]
    length: float
    width: float
    area: float
    rear_car: int
    rear_stop: float
    max_gap: float
    max_offset: float
    residual: float
    severity: float


@dataclass(frozen=True)
class Run:
    """One run of a recording: T states of N cars.

    Attributes
    ----------
    path, storage, size : where it was read from, "mcap" or "sqlite3", bytes
    prefix : namespace of the topics
    warnings : what is missing or wrong
    run_id, run_ids : this run and all of the recording
    name, title, scenario, scenario_hash, software : where the run comes from
    initial_speed : m/s
    manifest : of the recording, {} without
    cars, line, events, contacts, result : see there
    commands : applied and refused commands
    time : (T,) run time, s
    stamp0 : simulation time at which the run began, s
    pose, velocity : (T, N, 3) x, y, yaw and their rates; m, rad, m/s, rad/s
    coupler : (T, N, 2) absolute angles of the couplers, rad
    truck_on : (T, N, 2) trucks on the rails
    coupled : (T, N-1) couplings that hold
    brake : (T, N) brake force, N
    contact_force : (T, N) largest force at a corner at that moment, N
    thinned : every so many states of the recording were kept
    energy_time, energy : (E,) s, and entry -> (E,) J
    """

    path: Path
    storage: str
    size: int
    prefix: str
    warnings: tuple[str, ...]
    run_id: str
    run_ids: tuple[str, ...]
    name: str
    title: str
    scenario: dict[str, Any]
    scenario_hash: str
    software: str
    initial_speed: float
    manifest: dict[str, Any]
    cars: Cars
    line: Line
    events: tuple[Happening, ...]
    contacts: tuple[Contact, ...]
    commands: tuple[dict[str, Any], ...]
    result: Result
    time: F64
    stamp0: float
    pose: F64
    velocity: F64
    coupler: F64
    truck_on: Bool
    coupled: Bool
    brake: NDArray[np.float32]
    contact_force: NDArray[np.float32]
    thinned: int
    energy_time: F64
    energy: dict[str, F64] = field(default_factory=dict)

    @property
    def n(self) -> int:
        """Number of bodies."""
        return len(self.cars)

    @property
    def speed(self) -> F64:
        """(T, N) speed of the mass centres, m/s."""
        return np.hypot(self.velocity[..., 0], self.velocity[..., 1])

    @property
    def derailed(self) -> Bool:
        """(T, N) a truck is off the rails."""
        return ~self.truck_on.all(axis=-1)

    def at(self, time: float) -> int:
        """Index of the last state at or before a time (s)."""
        return int(np.clip(np.searchsorted(self.time, time + 1e-9) - 1, 0, len(self.time) - 1))

    def pose_at(self, time: float) -> F64:
        """(N, 3) pose at a time (s), between states linearly interpolated."""
        i = self.at(time)
        j = min(i + 1, len(self.time) - 1)
        span = self.time[j] - self.time[i]
        w = float(np.clip((time - self.time[i]) / span, 0.0, 1.0)) if span > 0.0 else 0.0
        return (1.0 - w) * self.pose[i] + w * self.pose[j]

    def peaks_until(self, time: float) -> F64:
        """(N,) largest corner force on each car up to a time (s), N."""
        peak = np.zeros(self.n)
        for c in self.contacts:
            if c.peak_time <= time + 1e-9:
                for car in (c.car_a, c.car_b):
                    peak[car - 1] = max(peak[car - 1], c.peak_force)
        return peak

    def scene(self, time: float, title: str = "", subtitle: str = "") -> Scene:
        """The scene at a time (s)."""
        i = self.at(time)
        pose = self.pose_at(time)
        last = i == len(self.time) - 1 and self.result.final
        length, width, area = scene_box(self.cars, pose, self.derailed[i], self.line)
        if last and math.isfinite(self.result.length):
            length, width, area = self.result.length, self.result.width, self.result.area
        line, breaks = _scene_track(self.line, pose, time)
        return Scene(
            pose=pose,
            length=self.cars.length,
            width=self.cars.width,
            pivot=self.cars.pivot,
            truck_on=self.truck_on[i],
            coupled=self.coupled[i],
            represents=self.cars.represents,
            coupler=self.coupler[i],
            coupler_length=self.cars.coupler,
            peak_force=self.peaks_until(time),
            track=line,
            breaks=breaks,
            scene_length=length,
            scene_width=width,
            scene_area=area,
            straight=self.line.straight,
            title=title,
            subtitle=subtitle,
        )


def _scene_track(line: Line, pose: F64, time: float) -> tuple[F64, F64]:
    """The part of the centre line around the cars, and the breaks there are."""
    open_ = line.breaks[:, 4] <= time + 1e-9
    breaks = line.breaks[open_][:, 1:4]
    margin = 60.0
    low, high = pose[:, :2].min(axis=0) - margin, pose[:, :2].max(axis=0) + margin
    if line.straight or len(line.s) < 3:
        return np.array([[low[0], 0.0], [high[0], 0.0]]), breaks
    s = np.arange(line.s[0], line.s[-1], 2.0)
    points = np.stack([np.interp(s, line.s, line.x), np.interp(s, line.s, line.y)], axis=-1)
    inside = ((points > low) & (points < high)).all(axis=1)
    if inside.sum() < 2:
        return points, breaks
    first, last = np.flatnonzero(inside)[[0, -1]]
    return points[first : last + 1], breaks


def scene_box(cars: Cars, pose: F64, derailed: Bool, line: Line) -> tuple[float, float, float]:
    """Length, width (m) and area (m^2) of the box around the derailed cars, along the track."""
    chosen = derailed & cars.real
    if not chosen.any():
        return 0.0, 0.0, 0.0
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    along = np.array([1.0, 1.0, -1.0, -1.0]) * 0.5 * cars.length[:, None]
    across = np.array([1.0, -1.0, -1.0, 1.0]) * 0.5 * cars.width[:, None]
    x = (pose[:, :1] + along * c[:, None] - across * s[:, None])[chosen].ravel()
    y = (pose[:, 1:2] + along * s[:, None] + across * c[:, None])[chosen].ravel()
    if not line.straight and len(line.s) > 2:
        x, y = along_track(line, x, y)
    long, wide = float(np.ptp(x)), float(np.ptp(y))
    return long, wide, long * wide


def along_track(line: Line, x: F64, y: F64) -> tuple[F64, F64]:
    """Track coordinate and offset to the left (m) of points, by the nearest piece of the line."""
    if line.straight:
        offset = float(line.s[0] - line.x[0]) if len(line.s) else 0.0
        return x + offset, y - (float(line.y[0]) if len(line.y) else 0.0)
    a = np.stack([line.x[:-1], line.y[:-1]], axis=-1)
    d = np.stack([np.diff(line.x), np.diff(line.y)], axis=-1)
    size = np.einsum("kj,kj->k", d, d)
    s, off = np.empty(len(x)), np.empty(len(x))
    for i, p in enumerate(np.stack([x, y], axis=-1)):
        w = np.clip(np.einsum("kj,kj->k", p - a, d) / size, 0.0, 1.0)
        gap = p - a - w[:, None] * d
        k = int(np.argmin(np.einsum("kj,kj->k", gap, gap)))
        s[i] = line.s[k] + w[k] * (line.s[k + 1] - line.s[k])
        off[i] = (d[k, 0] * gap[k, 1] - d[k, 1] * gap[k, 0]) / math.sqrt(size[k])
    return s, off


# --- reading ---------------------------------------------------------------------------------


class _Series:
    """Rows of a state topic, never more than a budget of memory: then every second one goes."""

    def __init__(self) -> None:
        self.rows: list[tuple[Any, ...]] = []
        self.every = 1
        self.count = 0
        self.last: tuple[Any, ...] | None = None
        self.limit = 0

    def add(self, row: tuple[Any, ...], budget: int = BUDGET) -> None:
        if not self.limit:
            size = sum(a.nbytes if isinstance(a, np.ndarray) else 8 for a in row) + 1200
            self.limit = max(200, budget // size)
        if self.count % self.every == 0:
            self.rows.append(row)
            if len(self.rows) > self.limit:
                del self.rows[1::2]
                self.every *= 2
        self.last = row
        self.count += 1

    def columns(self) -> list[Any]:
        """Columns in order of the first one, each time once."""
        rows = self.rows
        if self.last is not None and rows[-1] is not self.last:
            rows = [*rows, self.last]
        times = np.array([row[0] for row in rows])
        _, order = np.unique(times[::-1], return_index=True)  # of equal times the later one
        rows = [rows[len(rows) - 1 - k] for k in order]
        return [np.array(column) for column in zip(*rows)]


def read_bag(path: str | Path, run: int | str | None = None, namespace: str | None = None) -> Run:
    """Read a run of a recording.

    Parameters
    ----------
    path
        The recording's folder, a file of it, or a folder with one recording in it.
    run
        Which run, where the recording holds several: its number from 1, negative from the end,
        or the beginning of its identity. Default: the last.
    namespace
        Of the topics, where several trains were recorded. Default: the first.

    Raises
    ------
    BagError
        If there is nothing that can be reviewed; the kinds of it tell why.
    """
    bag = open_bag(path)
    check_version(bag)
    prefix, namespaces = topics_of(bag.channels, namespace)
    if namespace is None and len(namespaces) > 1:
        others = ", ".join(f"{n or '/'}" for n in namespaces[1:])
        bag.warn(f"several trains: {prefix or '/'} is read, not {others}")
    return _Reader(bag, prefix, run).read()


WANTED = (
    "Consist",
    "Track",
    "TrainEvent",
    "Collision",
    "Outcome",
    "CommandLog",
    "TrainState",
    "CouplerStates",
    "EnergyLedger",
)


@dataclass
class _Collected:
    consist: Any = None
    track: Any = None
    outcome: Any = None
    events: dict[int, Happening] = field(default_factory=dict)
    contacts: dict[int, Contact] = field(default_factory=dict)
    commands: dict[int, dict[str, Any]] = field(default_factory=dict)
    states: _Series = field(default_factory=_Series)
    couplings: _Series = field(default_factory=_Series)
    energy: _Series = field(default_factory=_Series)


class _Reader:
    def __init__(self, bag: RawBag, prefix: str, run: int | str | None) -> None:
        self.bag = bag
        self.prefix = prefix
        self.run = run
        self.manifest: dict[str, Any] = {}
        self.broken = 0
        self.absurd = 0

    def read(self) -> Run:
        run_ids = self._run_ids()
        run_id = self._choose(run_ids)
        collected = self._collect(run_id)
        return self._assemble(run_id, run_ids, collected)

    def _mine(self, channel: Any) -> bool:
        return channel.topic.rpartition("/")[0] == self.prefix

    def _decode(self, data: bytes, msgtype: str) -> Any:
        try:
            return deserialize(data, msgtype)
        except Exception:  # whatever bytes that are no message make rosbags raise
            self.broken += 1
            return None

    def _run_ids(self) -> list[str]:
        """Identities of the runs in order, from the rare messages only."""
        short = ("Consist", "Outcome", "TrainEvent")
        seen: dict[str, bool] = {}

        def wanted(channel: Any) -> bool:
            return self._mine(channel) and (
                channel.name == "manifest" or channel.msgtype.rpartition("/")[2] in short
            )

        for channel, _, data in self.bag.messages(wanted):
            if channel.name == "manifest":
                if channel.msgtype == "std_msgs/msg/String":
                    self._take_manifest(data)
                continue
            message = self._decode(data, channel.msgtype)
            if message is not None:
                seen.setdefault(message.run_id, True)
        self.broken = 0
        return list(seen)

    def _take_manifest(self, data: bytes) -> None:
        message = self._decode(data, "std_msgs/msg/String")
        try:
            manifest = json.loads(message.data)
            if isinstance(manifest, dict):
                self.manifest = manifest
        except (AttributeError, ValueError):
            self.bag.warn("its manifest cannot be read")

    def _choose(self, run_ids: list[str]) -> str:
        if not run_ids:
            # Only states may be left; the first of them tells.
            for channel, _, data in self.bag.messages(
                lambda c: self._mine(c) and c.msgtype.endswith("/TrainState")
            ):
                message = self._decode(data, channel.msgtype)
                if message is not None:
                    run_ids.append(message.run_id)
                    break
        if not run_ids:
            raise OtherTopicsError(f"{self.bag.path}: a recording without a run in it")
        if self.run is None:
            if len(run_ids) > 1:
                self.bag.warn(f"{len(run_ids)} runs: the last one is reviewed")
            return run_ids[-1]
        if isinstance(self.run, int) or self.run.lstrip("-").isdigit():
            number = int(self.run)
            index = number - 1 if number > 0 else number + len(run_ids)
            if number == 0 or not 0 <= index < len(run_ids):
                raise OtherTopicsError(
                    f"{self.bag.path}: no run {number}; there are {len(run_ids)}"
                )
            return run_ids[index]
        found = [r for r in run_ids if r.startswith(self.run)]
        if len(found) != 1:
            many = f"{len(found)} runs begin" if found else "no run begins"
            raise OtherTopicsError(
                f"{self.bag.path}: {many} with {self.run!r};"
                f" there are {', '.join(r[:8] for r in run_ids)}"
            )
        return found[0]

    def _collect(self, run_id: str) -> _Collected:
        got = _Collected()
        known = read_copy()

        def wanted(channel: Any) -> bool:
            return (
                self._mine(channel)
                and channel.msgtype in known
                and channel.msgtype.rpartition("/")[2] in WANTED
            )

        for channel, _, data in self.bag.messages(wanted):
            message = self._decode(data, channel.msgtype)
            if message is None or message.run_id != run_id:
                continue
            self._take(got, channel.msgtype.rpartition("/")[2], message)
        if self.broken:
            self.bag.warn(f"{count(self.broken, 'message')} cannot be read")
        if self.absurd:
            self.bag.warn(f"{count(self.absurd, 'message')} with impossible numbers left out")
        return got

    def _alike(self, got: _Collected, kind: str, m: Any) -> bool:
        """Whether a state is of as many cars as the first one."""
        if kind == "TrainState":
            return not got.states.count or len(m.x) == len(got.states.rows[0][1])
        if kind == "CouplerStates":
            return not got.couplings.count or len(m.coupled) == len(got.couplings.rows[0][1])
        return True

    def _take(self, got: _Collected, kind: str, m: Any) -> None:
        if not believable(kind, m) or not self._alike(got, kind, m):
            self.absurd += 1
            return
        if kind == "TrainState":
            got.states.add(
                (
                    float(m.time),
                    np.stack([m.x, m.y, m.yaw], axis=-1),
                    np.stack([m.vx, m.vy, m.yaw_rate], axis=-1),
                    np.stack([m.coupler_angle_front, m.coupler_angle_rear], axis=-1),
                    np.stack([m.truck_status_front, m.truck_status_rear], axis=-1) == 1,
                    m.brake_force.astype(np.float32),
                    m.largest_corner_force.astype(np.float32),
                    int(m.header.stamp.sec) + 1e-9 * int(m.header.stamp.nanosec),
                )
            )
        elif kind == "CouplerStates":
            got.couplings.add((float(m.time), m.coupled == 1))
        elif kind == "EnergyLedger":
            got.energy.add((float(m.time), np.array([getattr(m, e) for e in ENERGY_ENTRIES])))
        elif kind == "TrainEvent":
            got.events[int(m.sequence)] = happening(m)
        elif kind == "Collision":
            old = got.contacts.get(int(m.id))
            if old is None or not old.final:
                got.contacts[int(m.id)] = contact(m)
        elif kind == "Outcome":
            if got.outcome is None or not got.outcome.is_final or m.is_final:
                got.outcome = m
        elif kind == "CommandLog":
            got.commands[int(m.sequence)] = {
                "command": m.command,
                "request": m.request_json,
                "caller": m.caller,
                "accepted": bool(m.accepted),
                "message": m.message,
                "time": float(m.time),
                "step": int(m.step),
            }
        elif kind == "Consist":
            got.consist = m
        elif kind == "Track":
            got.track = m

    # --- putting together ---------------------------------------------------------------------

    def _assemble(self, run_id: str, run_ids: list[str], got: _Collected) -> Run:
        bag = self.bag
        left = (
            f"; {count(self.absurd, 'message')} with impossible numbers left out"
            if self.absurd
            else ""
        )
        if got.consist is None:
            raise OtherTopicsError(
                f"{bag.path}: no consist of run {run_id[:8]}: without it the cars are not known"
                + left
            )
        cars = cars_of(got.consist)
        n = len(cars)
        if not got.states.count:
            raise OtherTopicsError(
                f"{bag.path}: no states of run {run_id[:8]} (train_state){left}"
            )
        time, pose, velocity, coupler, trucks, brake, force, stamp = got.states.columns()
        if pose.shape[1] != n:
            raise OtherTopicsError(
                f"{bag.path}: states of {count(pose.shape[1], 'car')}, but a consist of {n}"
            )
        if got.track is None:
            bag.warn("no track: a straight one is assumed")
        line = line_of(got.track)
        self._only_cars(got, n, int(cars.represents.sum()))
        events = tuple(sorted(got.events.values(), key=lambda e: (e.time, e.sequence)))
        lost = (max(got.events) + 1 - len(got.events)) if got.events else 0
        if lost:
            bag.warn(_missing(lost, "event"))
        coupled = self._coupled(got, events, time, n)
        if got.couplings.count == 0 and n > 1:
            bag.warn("no coupler states: couplings are known from the events only")
        contacts = tuple(sorted(got.contacts.values(), key=lambda c: c.id))
        lost = (max(got.contacts) + 1 - len(got.contacts)) if got.contacts else 0
        if lost:
            bag.warn(_missing(lost, "collision"))
        if got.states.every > 1:
            bag.warn(f"long: of the states every {got.states.every}th is shown")
        self._gaps(time, got.states.every)
        scenario = scenario_of(got.consist.scenario_yaml, bag)
        energy: dict[str, F64] = {}
        energy_time = np.zeros(0)
        if got.energy.count:
            energy_time, table = got.energy.columns()
            energy = {name: table[:, k] for k, name in enumerate(ENERGY_ENTRIES)}
        else:
            bag.warn("no energy ledger")
        manifest = self._manifest()
        run = Run(
            path=bag.path,
            storage=bag.storage,
            size=bag.size,
            prefix=self.prefix,
            warnings=(),
            run_id=run_id,
            run_ids=tuple(run_ids),
            name=str(got.consist.scenario_name),
            title=str(scenario.get("title") or got.consist.scenario_name or "train"),
            scenario=scenario,
            scenario_hash=str(got.consist.scenario_hash),
            software=str(got.consist.software_version),
            initial_speed=float(got.consist.initial_speed),
            manifest=manifest,
            cars=cars,
            line=line,
            events=events,
            contacts=contacts,
            commands=tuple(got.commands[k] for k in sorted(got.commands)),
            result=_EMPTY,
            time=time,
            stamp0=float(stamp[0] - time[0]),
            pose=pose,
            velocity=velocity,
            coupler=coupler,
            truck_on=trucks,
            coupled=coupled,
            brake=brake,
            contact_force=force,
            thinned=got.states.every,
            energy_time=energy_time,
            energy=energy,
        )
        result = result_of(got.outcome, run)
        if not result.final:
            bag.warn(
                f"the end of the run is not in it: it stands as at {result.time:.2f} s,"
                " the last moment recorded"
            )
        return replace(run, result=result, warnings=tuple(bag.warnings))

    def _only_cars(self, got: _Collected, n: int, real: int) -> None:
        """Leave out what is told of cars that the train does not have.

        Events also tell of the cars that the last body stands for.
        """
        for e in [e for e in got.events.values() if any(not 1 <= c <= real for c in e.cars)]:
            del got.events[e.sequence]
        for c in [c for c in got.contacts.values() if not _pair(c.car_a, c.car_b, n)]:
            del got.contacts[c.id]
        m = got.outcome
        if m is not None and m.peak_car_a and not _pair(m.peak_car_a, m.peak_car_b, n):
            got.outcome = None

    def _coupled(self, got: _Collected, events: Sequence[Happening], time: F64, n: int) -> Bool:
        if got.couplings.count:
            when, table = got.couplings.columns()
            if table.ndim == 2 and table.shape[1] == n - 1:
                index = np.clip(np.searchsorted(when, time + 1e-9) - 1, 0, len(when) - 1)
                return np.asarray(table[index], dtype=bool)
        held = np.ones((len(time), n - 1), dtype=bool)
        for event in events:
            if event.kind == "coupler_parted" and event.cars and event.cars[0] < n:
                held[time >= event.time - 1e-9, min(event.cars) - 1] = False
        return held

    def _gaps(self, time: F64, every: int) -> None:
        steps = np.diff(time)
        if len(steps) < 3 or every > 1:
            return
        usual = float(np.median(steps))
        missing = int(np.maximum(np.round(steps / usual) - 1, 0).sum()) if usual > 0.0 else 0
        if missing:
            bag_share = missing / (missing + len(time))
            self.bag.warn(f"{_missing(missing, 'state')} ({100.0 * bag_share:.1f} %)")

    def _manifest(self) -> dict[str, Any]:
        if self.manifest:
            return self.manifest
        folder = self.bag.path if self.bag.path.is_dir() else self.bag.path.parent
        try:
            value = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
            return value if isinstance(value, dict) else {}
        except (OSError, ValueError):
            return {}


def _missing(n: int, noun: str) -> str:
    return f"{count(n, noun)} {'is' if n == 1 else 'are'} missing"


def _pair(a: int, b: int, n: int) -> bool:
    """Two different cars of a train of ``n``."""
    return 1 <= a <= n and 1 <= b <= n and a != b


def happening(m: Any) -> Happening:
    """An event from its message."""
    return Happening(
        sequence=int(m.sequence),
        time=float(m.time),
        step=int(m.step),
        kind=str(m.kind_name),
        cars=tuple(int(c) for c in m.cars),
        end=ENDS[m.end] if m.end < len(ENDS) else "",
        cause=str(m.cause),
        x=float(m.x),
        y=float(m.y),
        track_coordinate=float(m.track_coordinate),
        speed=float(m.speed),
        value=float(m.value),
        value_unit=str(m.value_unit),
        before=str(m.before),
        after=str(m.after),
        text=str(m.text),
    )


def contact(m: Any) -> Contact:
    """A collision from its message."""
    return Contact(
        id=int(m.id),
        final=bool(m.is_final),
        car_a=int(m.car_a),
        car_b=int(m.car_b),
        corner_car=int(m.corner_car),
        corner=int(m.corner),
        wall=int(m.struck_wall),
        start=float(m.start_time),
        end=float(m.end_time),
        peak_force=float(m.peak_corner_force),
        peak_time=float(m.peak_corner_force_time),
        peak_resultant=float(m.peak_resultant_force),
        peak_resultant_time=float(m.peak_resultant_force_time),
        closing_speed=float(m.closing_speed),
        x=float(m.x),
        y=float(m.y),
        normal_x=float(m.normal_x),
        normal_y=float(m.normal_y),
        angle=float(m.angle),
        energy_lost=float(m.energy_taken_out),
    )


def cars_of(m: Any) -> Cars:
    """The train from its message."""
    return Cars(
        name=tuple(m.car_name),
        kind=tuple(m.car_type),
        contents=tuple(m.contents),
        mass=np.array(m.mass),
        length=np.array(m.length),
        width=np.array(m.width),
        pivot=np.array(m.pivot_distance),
        truck=np.array(m.truck_distance),
        coupler=np.stack([m.coupler_length_front, m.coupler_length_rear], axis=-1),
        coupler_kind=tuple(zip(m.coupler_type_front, m.coupler_type_rear)),
        angle_limit=np.array(m.coupling_angle_limit),
        represents=np.array(m.represents_cars, dtype=np.int64),
    )


def line_of(m: Any) -> Line:
    """The track from its message; without one the straight along +X."""
    if m is None:
        empty = np.zeros(0)
        return Line(empty, empty, empty, empty, empty, np.zeros((0, 5)))
    heading = np.interp(m.rail_break_coordinate, m.s, m.heading) if len(m.s) else 0.0
    breaks = np.stack(
        [
            m.rail_break_coordinate,
            m.rail_break_x,
            m.rail_break_y,
            np.broadcast_to(heading, np.shape(m.rail_break_x)),
            m.rail_break_time,
        ],
        axis=-1,
    )
    return Line(
        *(np.array(getattr(m, k)) for k in ("s", "x", "y", "heading", "curvature")),
        breaks.reshape(-1, 5),
    )


def scenario_of(text: str, bag: RawBag) -> dict[str, Any]:
    """The scenario as plain data, {} where it cannot be read."""
    import yaml

    try:
        loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
        value = yaml.load(text, Loader=loader)
    except yaml.YAMLError:
        bag.warn("its scenario cannot be read")
        return {}
    return value if isinstance(value, dict) else {}


# --- the outcome -----------------------------------------------------------------------------

_EMPTY = Result(
    status="",
    final=False,
    void=False,
    time=math.nan,
    duration=math.nan,
    steps=0,
    rejected=0,
    derailed=(),
    derail_time=np.zeros(0),
    derail_speed=np.zeros(0),
    peak_force=0.0,
    peak_pair=(0, 0),
    peak_time=math.nan,
    peak_resultant=0.0,
    car_peak=np.zeros(0),
    car_peak_other=np.zeros(0, dtype=np.int64),
    car_peak_time=np.zeros(0),
    above_5MN=(),
    above_10MN=(),
    length=math.nan,
    width=math.nan,
    area=math.nan,
    rear_car=0,
    rear_stop=math.nan,
    max_gap=math.nan,
    max_offset=math.nan,
    residual=math.nan,
    severity=math.nan,
)


def rest_time(m: Any) -> float:
    """Time to rest, s; nan where a run ended without: its outcome gives the run time there."""
    return float(m.duration) if m.status_name == "at rest" else math.nan


def result_of(m: Any, run: Run) -> Result:
    """The outcome as recorded at the end, or worked out from what was recorded before."""
    if m is not None and m.is_final and len(m.car_peak_force) == run.n:
        return Result(
            status=str(m.status_name),
            final=True,
            void=bool(m.is_void),
            time=float(m.time),
            duration=rest_time(m),
            steps=int(m.step),
            rejected=int(m.rejected_steps),
            derailed=tuple(int(c) for c in m.derailed_cars),
            derail_time=np.array(m.derailment_time),
            derail_speed=np.array(m.derailment_speed),
            peak_force=float(m.peak_corner_force),
            peak_pair=(int(m.peak_car_a), int(m.peak_car_b)),
            peak_time=float(m.peak_corner_force_time),
            peak_resultant=float(m.peak_resultant_force),
            car_peak=np.array(m.car_peak_force),
            car_peak_other=np.array(m.car_peak_other_car, dtype=np.int64),
            car_peak_time=np.array(m.car_peak_time),
            above_5MN=tuple(int(c) for c in m.cars_above_5mn),
            above_10MN=tuple(int(c) for c in m.cars_above_10mn),
            length=float(m.scene_length),
            width=float(m.scene_width),
            area=float(m.scene_area),
            rear_car=int(m.rear_part_first_car),
            rear_stop=float(m.rear_part_track_coordinate),
            max_gap=float(m.max_coupler_gap),
            max_offset=float(m.max_truck_offset),
            residual=float(m.energy_residual_relative),
            severity=float(m.severity),
        )
    return _derived(m, run)


def _derived(m: Any, run: Run) -> Result:
    n = run.n
    derail_time, derail_speed = np.full(n, np.nan), np.full(n, np.nan)
    for event in run.events:
        if event.kind == "truck_derailed" and event.cars and event.cars[0] <= n:
            i = event.cars[0] - 1
            if math.isnan(derail_time[i]):
                derail_time[i], derail_speed[i] = event.time, event.speed
    peak, other, when = np.zeros(n), np.zeros(n, dtype=np.int64), np.full(n, np.nan)
    for c in run.contacts:
        for i, j in ((c.car_a, c.car_b), (c.car_b, c.car_a)):
            if c.peak_force > peak[i - 1]:
                peak[i - 1], other[i - 1], when[i - 1] = c.peak_force, j, c.peak_time
    hardest = max(run.contacts, key=lambda c: c.peak_force, default=None)
    derailed = run.derailed[-1] & run.cars.real
    box = scene_box(run.cars, run.pose[-1], derailed, run.line)
    ended = next((e for e in reversed(run.events) if e.kind.startswith("run_ended")), None)
    status = CUT_OFF if ended is None else "stopped" if ended.cause == "command" else ended.cause
    residual = run.energy.get("residual")
    initial = float(run.energy["initial"][0]) if run.energy else 0.0
    return replace(
        _EMPTY,
        status=status,
        void=any(e.kind == "run_void" for e in run.events),
        time=float(run.time[-1]),
        duration=ended.value if ended is not None and ended.cause == "at rest" else math.nan,
        steps=int(m.step) if m is not None else 0,
        rejected=int(m.rejected_steps) if m is not None else 0,
        derailed=tuple(int(i) + 1 for i in np.flatnonzero(derailed)),
        derail_time=derail_time,
        derail_speed=derail_speed,
        peak_force=float(peak.max(initial=0.0)),
        peak_pair=(0, 0) if hardest is None else (hardest.car_a, hardest.car_b),
        peak_time=math.nan if hardest is None else hardest.peak_time,
        peak_resultant=max((c.peak_resultant for c in run.contacts), default=0.0),
        car_peak=peak,
        car_peak_other=other,
        car_peak_time=when,
        above_5MN=tuple(int(i) + 1 for i in np.flatnonzero(peak > 5e6)),
        above_10MN=tuple(int(i) + 1 for i in np.flatnonzero(peak > 10e6)),
        length=box[0],
        width=box[1],
        area=box[2],
        max_gap=float(m.max_coupler_gap) if m is not None else math.nan,
        max_offset=float(m.max_truck_offset) if m is not None else math.nan,
        residual=(
            float(np.abs(residual).max()) / initial
            if residual is not None and initial > 0.0
            else math.nan
        ),
    )
