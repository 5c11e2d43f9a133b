"""Runs of one train with drawn constants, and the values kept of each."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from derail_ros.predict.trains import Train, limited, on_grade, start_few, train_params
from derail_ros.scenario.calibrated import Calibrated, Draw
from derail_ros.studies.accidents import BROKEN_RAIL
from derail_ros.studies.ensemble import Job, Progress, complete, run_many
from derail_ros.vocabulary.params import TrainParams

if TYPE_CHECKING:
    from derail_ros.vocabulary.simulation import Simulation

LEVELS = (1.0e6, 2.2e6, 3.3e6, 4.45e6, 5.0e6, 7.0e6, 10.0e6, 15.0e6)
"""Largest forces (N) above which struck cars are counted."""

OUTPUTS = ("derailed", "void", "duration", "peak_force", "scene_length", "scene_width", "left",
           "rear_place", "first_parting", "cars_modelled", "wall_s",
           *(f"above_{level / 1e6:g}MN" for level in LEVELS), "energy_single_shell",
           "energy_double_shell", "approach_single_shell", "approach_double_shell")  # fmt: skip
"""What is kept of a run; ``left``: derailed cars whose centre lies left of the track; the last
four: expected releases if all were tank cars, by the rules of ``release``."""

CAUSES = {
    "broken_rail": "broken rail",
    "track": "track, other than a broken rail",
    "equipment": "equipment",
    "human": "human factors",
    "signal": "signals",
    "other": "miscellaneous",
}
"""Groups of causes -> their words."""

_LETTERS = {"T": "track", "E": "equipment", "H": "human", "S": "signal", "M": "other"}


def group_of(cause: str) -> str:
    """Group of a code of the FRA's: its first letter, and broken rails by themselves."""
    return "broken_rail" if cause in BROKEN_RAIL else _LETTERS.get(cause[:1], "other")


def summary(simulation: Simulation, wall: float) -> list[float]:
    """:data:`OUTPUTS` of a run that has ended."""
    from derail_ros.predict import release

    outcome, cars = simulation.outcome(), len(simulation.params.cars)
    off = np.array(outcome.derailed_cars, dtype=int) - 1
    left = float(np.sum(outcome.pose[off, 1] > 0.0))
    parted = outcome.parted[0].time if outcome.parted else math.nan
    collisions = simulation.collisions
    return [
        outcome.cars_derailed, float(outcome.void), outcome.duration, outcome.peak_force,
        outcome.scene_length, outcome.scene_width, left, outcome.rear_part_coordinate, parted,
        cars, wall, *(len(outcome.cars_above(level)) for level in LEVELS),
        *(float(release.by_blows(collisions, cars, kind, rule).sum())
          for rule in ("energy", "approach") for kind in release.STRENGTH),
    ]  # fmt: skip


def run(
    build: Callable[[], TrainParams], draw: Draw, few: int = 0, stop: Any = None
) -> Simulation:
    """A run at its end.

    Cars that cannot derail are one body; if it meets the break after all, every car is modelled.
    ``few`` cars are off at the start and no others meet a break; 0: a pile.
    """
    whole = build()
    if few:
        whole = start_few(whole, few)
    small = limited(whole, draw, few)
    simulation = complete(small, stop)
    if simulation.outcome().void and len(small.cars) < len(whole.cars):
        simulation = complete(whole, stop)
    return simulation


class Drawable(Protocol):
    """A scenario whose constants can be drawn."""

    def to_params(self) -> TrainParams: ...
    def varied(self, member: int) -> Drawable: ...
    def drawn_params(self, draw: Draw) -> TrainParams: ...


@dataclass(frozen=True)
class Member:
    """The draw of a run."""

    draw: Draw
    few: int  # cars off at the start; 0: a pile
    order: int  # seed of the order of loaded and empty cars


def members(
    constants: Calibrated, group: str, speed: float, behind: int, n: int, seed: int = 0
) -> list[Member]:
    """Draws of ``n`` runs of an accident of a group of causes, at a speed in m/s.

    The share of few is drawn evenly: as many of ``n`` as are expected, to within one.
    """
    mixture = constants.few[group]
    rng = np.random.default_rng([seed, n])
    share = mixture.share(speed, behind)
    ranks = (rng.permutation(n) + rng.random()) / n
    r = 1.0 / mixture.dispersion
    found = []
    for i in range(n):
        k = 0
        if ranks[i] < share:
            k = behind + 1
            for _ in range(1000):  # those of a train of so many cars
                k = 1 + int(rng.negative_binomial(r, r / (r + mixture.mean)))
                if k <= behind:
                    break
            k = min(k, behind)
        found.append(Member(constants.draw(i, seed), k, int(rng.integers(2**31))))
    return found


def runs_of(
    subject: Train | Drawable | Callable[[int], Drawable],
    chosen: Sequence[Member],
    *,
    jobs: int | None = None,
    progress: Progress | None = None,
    into: NDArray[np.float64] | None = None,
) -> NDArray[np.float64]:
    """:data:`OUTPUTS` of each member that did not fail, (n, len(OUTPUTS)); nan of those that did.

    Parameters
    ----------
    subject : a train of a report, a scenario, or what gives the scenario of each member
    into : array of nan that takes them as they come, for a caller who may be interrupted
    """

    def task(job: Job, stop: Any) -> list[float]:
        m = chosen[job.key]
        began = time.perf_counter()

        def build() -> TrainParams:
            if isinstance(subject, Train):
                return train_params(subject, m.draw, m.order)
            one = subject(job.key) if callable(subject) else subject.varied(job.key + 1)
            return on_grade(one.drawn_params(m.draw), m.draw)

        simulation = run(build, m.draw, m.few, stop)
        return summary(simulation, time.perf_counter() - began)

    found = np.full((len(chosen), len(OUTPUTS)), math.nan) if into is None else into
    queue = (Job(subject, key=i) for i in range(len(chosen)))  # type: ignore[arg-type]
    with closing(run_many(queue, jobs=jobs, task=task)) as results:
        for done, result in enumerate(results, 1):
            if result.error is None:
                found[result.job.key] = result.value
            if progress is not None:
                progress(done, len(chosen))
    return found
