"""The result of a run, from an engine or rebuilt from a recording."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from derail_ros.vocabulary.events import Event, EventKind
from derail_ros.vocabulary.site import SiteOutcome
from derail_ros.vocabulary.status import (
    AT_REST,
    CERTAIN_RUPTURE_FORCE,
    RUPTURE_FORCE,
    STATUSES,
    VOID,
)
from derail_ros.vocabulary.train import TrainTotals
from derail_ros.vocabulary.words import count, force

F64 = NDArray[np.float64]


COUPLING_VALUES = ("max_draft_N", "max_draft_time_s", "max_buff_N", "max_buff_time_s")
"""Keys of :attr:`Outcome.couplings`."""

PARTED_CAUSES = ("initial", "angle", "knuckle broke", "coupler body broke", "vertical slip")
"""Causes of a parted coupling, by their numbers in messages."""


@dataclass(frozen=True)
class Parted:
    """A coupling that parted: ``coupling`` i joins cars i and i + 1.

    ``time`` in s, ``cause`` as of the event; ``force`` at which it broke, N, 0 for other causes.
    """

    coupling: int
    time: float
    cause: str
    force: float = 0.0


MOVED = 0.1
"""Displacement of the mass centre from which a standing car counts as moved, m."""


@dataclass(frozen=True)
class StandingOutcome:
    """Result for the cars on second tracks: the last ``cars`` bodies, apart from the train.

    Attributes
    ----------
    cars : their number
    struck : numbers of the cars in a collision with any car
    moved : numbers of the cars whose mass centre moved by more than ``MOVED``
    derailed : numbers of the cars with a truck off the rails
    """

    cars: int = 0
    struck: tuple[int, ...] = ()
    moved: tuple[int, ...] = ()
    derailed: tuple[int, ...] = ()

    @classmethod
    def of(cls, own: int, **flags: NDArray[np.bool_]) -> StandingOutcome:
        """From flags (N,) of all bodies, of which the first ``own`` are the train's."""
        n = len(flags["derailed"])
        if own >= n:
            return cls()
        found = {k: np.flatnonzero(v) for k, v in flags.items()}
        told = {k: tuple(int(i) + 1 for i in v if i >= own) for k, v in found.items()}
        return cls(n - own, **told)

    @property
    def record(self) -> dict[str, Any]:
        """As plain data."""
        lists = {key: list(getattr(self, key)) for key in ("struck", "moved", "derailed")}
        return {"cars": self.cars, **lists}

    @property
    def text(self) -> str:
        """The same in words."""
        parts = [len(self.struck), len(self.moved), len(self.derailed)]
        return "{} standing: {} struck, {} moved, {} derailed".format(
            count(self.cars, "car"), *parts
        )


@dataclass(frozen=True, repr=False)
class Outcome:
    """Result of a run. ``nan`` or ``None`` for a quantity that does not exist.

    Attributes
    ----------
    status : a key of ``status.STATUSES``
    time : run time: at the end, or now while the run goes on, s
    duration : time to rest, s; nan unless the train came to rest
    steps, rejected_steps : accepted and rejected steps
    derailed_cars : car numbers, from 1; car 1 leads
    peak_force : largest force at a single corner, N
    peak_force_pair : (a, b): a struck b; None without a collision
    peak_force_time : s
    peak_resultant : largest resultant between a pair, N
    car_peak_force, car_peak_time : (N,) largest single-corner force on each car, N; time, s
    car_peak_other : (N,) car number of the opposing car, 0 without
    scene_length, scene_width, scene_area : box of all corners of the derailed cars along and
        across the track (arc length and offset), m, m, m^2 (0 without)
    max_coupler_gap, max_truck_offset : largest constraint errors over all accepted steps, m
    derail_time, derail_speed : (N,) first derailment of each car, s, m/s (nan without)
    pose : (N, 6) x, y, z (m), roll, pitch, yaw (rad) of the mass centres
    rear_part_first_car : first car on the rails behind the derailed ones, 0 without
    rear_part_coordinate : track coordinate of its front truck, m (nan without)
    energy : ledger entry (``ledger.ENERGY_ENTRIES``) -> J now
    energy_residual : largest |imbalance| of the ledger over the run / initial energy
    train : totals of the train
    couplings : largest draft and buff force of each coupling and when (``COUPLING_VALUES``):
        key -> (N-1,), both >= 0; {} where they are not known
    parted : couplings that parted, in the order of time
    values, car_values : further numbers by name, unit in the name; the latter (N,)
    site : results for the place; None without zones, fixed bodies and areas
    standing : results for cars on second tracks, whose rows are the last ones of (N,) arrays;
        all else counts the train's own cars, and forces between two cars of which one is its own
    """

    status: str
    time: float
    duration: float
    steps: int
    rejected_steps: int
    derailed_cars: tuple[int, ...]
    peak_force: float
    peak_force_pair: tuple[int, int] | None
    peak_force_time: float
    peak_resultant: float
    car_peak_force: F64
    car_peak_time: F64
    car_peak_other: NDArray[np.int64]
    scene_length: float
    scene_width: float
    scene_area: float
    max_coupler_gap: float
    max_truck_offset: float
    derail_time: F64
    derail_speed: F64
    pose: F64
    rear_part_first_car: int
    rear_part_coordinate: float
    energy: Mapping[str, float]
    energy_residual: float
    train: TrainTotals = TrainTotals()
    couplings: Mapping[str, F64] = field(default_factory=dict)
    parted: tuple[Parted, ...] = ()
    values: Mapping[str, float] = field(default_factory=dict)
    car_values: Mapping[str, F64] = field(default_factory=dict)
    site: SiteOutcome | None = None
    standing: StandingOutcome = StandingOutcome()

    @classmethod
    def nothing(cls, pose: F64, status: str, time: float, steps: int = 0) -> Outcome:
        """An outcome in which nothing derailed and nothing collided: a base for ``replace``."""
        n = len(pose)
        return cls(
            status=status,
            time=time,
            duration=time if status == AT_REST else math.nan,
            steps=steps,
            rejected_steps=0,
            derailed_cars=(),
            peak_force=0.0,
            peak_force_pair=None,
            peak_force_time=math.nan,
            peak_resultant=0.0,
            car_peak_force=np.zeros(n),
            car_peak_time=np.full(n, math.nan),
            car_peak_other=np.zeros(n, dtype=np.int64),
            scene_length=0.0,
            scene_width=0.0,
            scene_area=0.0,
            max_coupler_gap=math.nan,
            max_truck_offset=math.nan,
            derail_time=np.full(n, math.nan),
            derail_speed=np.full(n, math.nan),
            pose=np.asarray(pose, dtype=float),
            rear_part_first_car=0,
            rear_part_coordinate=math.nan,
            energy={},
            energy_residual=math.nan,
            train=TrainTotals(cars=n),
        )

    def __repr__(self) -> str:
        """The outcome in a line; a notebook shows this."""
        return f"<Outcome: {self.text}>"

    @property
    def text(self) -> str:
        """The outcome in a line."""
        text = f"{derailed(self.cars_derailed)}, {ending(self)}"
        if self.peak_force_pair is not None and self.peak_force > 0.0:
            a, b = self.peak_force_pair
            text += (
                f"; largest force {force(self.peak_force)}, car {a} into car {b}"
                f" at {self.peak_force_time:.2f} s"
            )
        if self.derailed_cars and math.isfinite(self.scene_length):
            text += f"; scene {self.scene_length:.1f} m \N{MULTIPLICATION SIGN} "
            text += f"{self.scene_width:.1f} m"
        return f"{text}; {self.standing.text}" if self.standing.cars else text

    def of_train(self, rows: F64) -> F64:
        """The rows of the train, of an array with one row a body or coupling."""
        return rows[: len(rows) - self.standing.cars]

    @property
    def final(self) -> bool:
        """Whether the run has ended."""
        return STATUSES[self.status].ended

    @property
    def void(self) -> bool:
        """A virtual body reached a break: not a valid run, model more cars and run again."""
        return self.status == VOID

    @property
    def cars_derailed(self) -> int:
        """Number of derailed cars."""
        return len(self.derailed_cars)

    def cars_above(self, level: float) -> tuple[int, ...]:
        """Car numbers whose largest single-corner force is above a level (N)."""
        return tuple(
            int(i) + 1 for i in np.flatnonzero(self.of_train(self.car_peak_force) > level)
        )

    @property
    def cars_above_5MN(self) -> tuple[int, ...]:
        """Cars struck above ``status.RUPTURE_FORCE``."""
        return self.cars_above(RUPTURE_FORCE)

    @property
    def cars_above_10MN(self) -> tuple[int, ...]:
        """Cars struck above ``status.CERTAIN_RUPTURE_FORCE``."""
        return self.cars_above(CERTAIN_RUPTURE_FORCE)

    def largest(self, which: str) -> tuple[float, int, float]:
        """Largest "draft" or "buff" force (N), its coupling and when (s); nan, 0, nan without."""
        none = np.zeros(self.standing.cars)
        forces = self.of_train(self.couplings.get(f"max_{which}_N", none))
        if not np.any(forces > 0.0):
            return math.nan, 0, math.nan
        k = int(np.nanargmax(forces))
        return float(forces[k]), k + 1, float(self.couplings[f"max_{which}_time_s"][k])

    @property
    def rear_stop(self) -> float:
        """Track coordinate at which the rear part stopped, m; nan unless the train is at rest."""
        return self.rear_part_coordinate if self.status == AT_REST else math.nan

    @property
    def first_derailment(self) -> float:
        """Run time at which the first truck left the rails, s; nan without."""
        times = self.of_train(self.derail_time)
        times = times[np.isfinite(times)]
        return float(times.min()) if len(times) else math.nan


def parted_couplings(events: Iterable[Event], own: int) -> tuple[Parted, ...]:
    """Couplings of a train of ``own`` bodies that parted, by their events."""
    return tuple(
        Parted(min(e.cars), e.time, e.cause, e.value if e.cause.endswith("broke") else 0.0)
        for e in events
        if e.kind == EventKind.COUPLER_PARTED and e.cars and min(e.cars) < own
    )


def derailed(n: int) -> str:
    """``no car derailed``, ``1 car derailed``, ``24 cars derailed``."""
    return "no car derailed" if n == 0 else f"{count(n, 'car')} derailed"


def ending(outcome: Outcome) -> str:
    """How a run ended: ``at rest after 25.3 s``, ``ended by its time limit ... at 120.0 s``."""
    at = outcome.duration if outcome.status == AT_REST else outcome.time
    return f"{STATUSES[outcome.status].words} {at:.1f} s"
