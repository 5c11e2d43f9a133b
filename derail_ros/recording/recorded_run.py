"""A recorded run as numpy arrays: train, track, states, events, collisions and outcome."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from derail_ros.vocabulary.events import Collision, Event
from derail_ros.vocabulary.outcome import Outcome
from derail_ros.vocabulary.site import SiteParams
from derail_ros.vocabulary.train import TRAIN_COUNTS, TrainTotals
from msg_adapters.reports import CUT, GRAVITY_HEIGHT

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
Bool = NDArray[np.bool_]
Int = NDArray[np.int64]


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
    totals : of the train; without loads, empties and locomotives in older recordings
    cut : (N,) number of its cut of standing cars, from 1; 0 for the train's own, which come first
    gravity_height : (N,) of the mass centre over the rail at rest, m; nan if it is not told
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
    totals: TrainTotals
    cut: Int
    gravity_height: F64

    @classmethod
    def of_message(cls, m: Any) -> Cars:
        """From ``derail_msgs/Consist``."""
        pivot = np.array(m.pivot_distance)
        coupler = np.stack([m.coupler_length_front, m.coupler_length_rear], axis=-1)
        told = {q.key: np.array(q.values) for q in m.more}
        length = told.get("length_over_couplers_m", 2.0 * pivot + coupler.sum(axis=-1))
        cut = told.get(CUT, np.zeros(len(pivot))).astype(np.int64)
        own = cut == 0
        totals = TrainTotals(
            int(np.array(m.represents_cars)[own].sum()),
            **{key: int(told[key][own].sum()) for key in TRAIN_COUNTS if key in told},
            length=math.fsum(length[own]),
            mass=math.fsum(np.array(m.mass)[own]),
        )
        return cls(
            name=tuple(m.car_name),
            kind=tuple(m.car_type),
            contents=tuple(m.contents),
            mass=np.array(m.mass),
            length=np.array(m.length),
            width=np.array(m.width),
            pivot=pivot,
            truck=np.array(m.truck_distance),
            coupler=coupler,
            coupler_kind=tuple(zip(m.coupler_type_front, m.coupler_type_rear)),
            angle_limit=np.array(m.coupling_angle_limit),
            represents=np.array(m.represents_cars, dtype=np.int64),
            totals=totals,
            cut=cut,
            gravity_height=told.get(GRAVITY_HEIGHT, np.full(len(pivot), math.nan)),
        )

    def __len__(self) -> int:
        return len(self.mass)

    @property
    def own(self) -> int:
        """Number of the train's own bodies."""
        return int((self.cut == 0).sum())

    @property
    def real(self) -> Bool:
        """(N,) the body stands for itself only."""
        return self.represents == 1


@dataclass(frozen=True)
class SampledLine:
    """The centre line of the track at M points (a ``vocabulary.scene.Line``), and K breaks.

    Without points it is the straight along +X.

    Attributes
    ----------
    s, x, y, heading, curvature : (M,) track coordinate and place, m; rad; 1/m
    breaks : (K, 5) track coordinate, x, y (m), heading (rad) and run time of opening (s)
    """

    s: F64 = field(default_factory=lambda: np.zeros(0))
    x: F64 = field(default_factory=lambda: np.zeros(0))
    y: F64 = field(default_factory=lambda: np.zeros(0))
    heading: F64 = field(default_factory=lambda: np.zeros(0))
    curvature: F64 = field(default_factory=lambda: np.zeros(0))
    breaks: F64 = field(default_factory=lambda: np.zeros((0, 5)))

    @classmethod
    def of_message(cls, m: Any) -> SampledLine:
        """From ``derail_msgs/Track``."""
        place = np.array(m.rail_break_coordinate)
        heading = np.interp(place, m.s, m.heading) if len(m.s) else np.zeros(len(place))
        breaks = [place, m.rail_break_x, m.rail_break_y, heading, m.rail_break_time]
        points = {k: np.array(getattr(m, k)) for k in ("s", "x", "y", "heading", "curvature")}
        return cls(**points, breaks=np.stack(breaks, axis=-1))

    @property
    def start(self) -> float:
        """Track coordinate of the first point, m; -inf without points."""
        return float(self.s[0]) if len(self.s) else -math.inf

    @property
    def end(self) -> float:
        """Track coordinate of the last point, m; inf without points."""
        return float(self.s[-1]) if len(self.s) else math.inf

    @property
    def straight(self) -> bool:
        """It is straight along +X."""
        return len(self.y) == 0 or bool(np.ptp(self.y) < 1e-6)

    def point(self, s: float) -> tuple[float, float, float, float]:
        """Place x, y (m), heading (rad) and curvature (1/m) at a track coordinate (m)."""
        if not len(self.s):
            return s, 0.0, 0.0, 0.0
        x, y, heading, curvature = (
            float(np.interp(s, self.s, values))
            for values in (self.x, self.y, self.heading, self.curvature)
        )
        return x, y, heading, curvature

    def locate(self, x: float, y: float, hint: float | None = None) -> tuple[float, float]:
        """Track coordinate of the foot point and offset to the left (m) of a place."""
        s, offset = self.locate_all(np.array([x]), np.array([y]))
        return float(s[0]), float(offset[0])

    def locate_all(self, x: F64, y: F64) -> tuple[F64, F64]:
        """Track coordinates and offsets to the left (m) of places, by the nearest piece."""
        if self.straight:
            shift = self.s[0] - self.x[0] if len(self.s) else 0.0
            return x + shift, y - (self.y[0] if len(self.y) else 0.0)
        a = np.stack([self.x[:-1], self.y[:-1]], axis=-1)
        d = np.stack([np.diff(self.x), np.diff(self.y)], axis=-1)
        size = np.einsum("kj,kj->k", d, d)
        s, offset = np.empty(len(x)), np.empty(len(x))
        for i, p in enumerate(np.stack([x, y], axis=-1)):
            w = np.clip(np.einsum("kj,kj->k", p - a, d) / size, 0.0, 1.0)
            gap = p - a - w[:, None] * d
            k = int(np.argmin(np.einsum("kj,kj->k", gap, gap)))
            s[i] = self.s[k] + w[k] * (self.s[k + 1] - self.s[k])
            offset[i] = (d[k, 0] * gap[k, 1] - d[k, 1] * gap[k, 0]) / math.sqrt(size[k])
        return s, offset


@dataclass(frozen=True)
class RecordedRun:
    """One run of a recording: T states of N cars. Index 0 is car 1; coupling i joins i and i + 1.

    Attributes
    ----------
    path, storage, size : where it was read from, "mcap" or "sqlite3", bytes
    prefix : namespace of the topics
    warnings : what is missing or wrong
    run_id, run_ids : this run and all of the recording
    name, title, scenario, scenario_hash, model, software : where the run comes from
    files : what the scenario was made from, name -> content
    initial_speed : m/s
    manifest : of the recording, {} without
    cars, line, events, collisions, outcome : see there
    commands : applied and refused commands
    time : (T,) run time, s
    stamp0 : simulation time at which the run began, s
    pose, velocity : (T, N, 6) x, y, z (m), roll, pitch, yaw (rad) of the mass centres; rates
    coupler_yaw : (T, N, 2) absolute yaw angles of the couplers, front and rear, rad
    truck_on : (T, N, 2) trucks on the rails
    coupled : (T, N-1) couplings that hold
    brake_force : (T, N) N
    corner_force : (T, N) largest force at a corner of each car at that moment, N
    thinned : every so many states of the recording were kept
    energy_time, energy : (E,) s, and ledger entry -> (E,) J
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
    model: str
    software: str
    files: Mapping[str, bytes]
    initial_speed: float
    manifest: dict[str, Any]
    cars: Cars
    line: SampledLine
    events: tuple[Event, ...]
    collisions: tuple[Collision, ...]
    commands: tuple[dict[str, Any], ...]
    outcome: Outcome
    time: F64
    stamp0: float
    pose: F64
    velocity: F64
    coupler_yaw: F64
    truck_on: Bool
    coupled: Bool
    brake_force: F32
    corner_force: F32
    thinned: int
    energy_time: F64
    energy: Mapping[str, F64]

    @property
    def n(self) -> int:
        """Number of bodies."""
        return len(self.cars)

    @cached_property
    def site(self) -> SiteParams:
        """The place of its scenario."""
        from derail_ros.scenario.schema import Ground, Site
        from derail_ros.scenario.site import site_of

        given = self.scenario.get("site")
        if given is None:
            return SiteParams()
        ground = Ground.model_validate(self.scenario.get("ground", {}))
        return site_of(Site.model_validate(given), ground)

    @property
    def plane(self) -> F64:
        """(T, N, 3) x, y (m), yaw (rad): the poses seen from above."""
        return self.pose[..., [0, 1, 5]]

    @property
    def speed(self) -> F64:
        """(T, N) speed of the mass centres, m/s."""
        return np.asarray(np.linalg.norm(self.velocity[..., :3], axis=-1))

    @property
    def derailed(self) -> Bool:
        """(T, N) a truck is off the rails."""
        return np.asarray(~self.truck_on.all(axis=-1))

    @property
    def own_coupled(self) -> Bool:
        """(T, n - 1) couplings of the train's own cars that hold."""
        return self.coupled[:, : max(self.cars.own - 1, 0)]

    def at(self, time: float) -> int:
        """Index of the last state at or before a time (s)."""
        return int(np.clip(np.searchsorted(self.time, time + 1e-9) - 1, 0, len(self.time) - 1))

    def pose_at(self, time: float) -> F64:
        """(N, 6) poses at a time (s), linearly interpolated between states."""
        i = self.at(time)
        j = min(i + 1, len(self.time) - 1)
        span = self.time[j] - self.time[i]
        w = float(np.clip((time - self.time[i]) / span, 0.0, 1.0)) if span > 0.0 else 0.0
        return (1.0 - w) * self.pose[i] + w * self.pose[j]

    def ledger(self, index: int = -1) -> dict[str, float]:
        """The energy ledger at one of :attr:`energy_time`: entry -> J; {} without."""
        return {entry: float(values[index]) for entry, values in self.energy.items()}

    def peaks_until(self, time: float) -> F64:
        """(N,) largest corner force on each car up to a time (s), N."""
        peak = np.zeros(self.n)
        for c in self.collisions:
            if c.peak_time <= time + 1e-9 and not c.object:
                for car in (c.car_a, c.car_b):
                    if car:
                        peak[car - 1] = max(peak[car - 1], c.peak_force)
        return peak
