"""Where in a train hazardous cars are least at risk.

Any car may be the first one involved, each as likely. From it on the train runs with drawn
constants over a broken rail. A run gives for each place in the train whether the car there
derails, and the probability that it releases, were it a tank car of a single shell: the mean of
the three rules of ``release``, as nobody knows which is right. The means over runs are the risk of
a place. That of an arrangement is the sum over its places: moving a car is taken not to change
the pile.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from derail_ros.predict import release
from derail_ros.predict.runs import members, run
from derail_ros.predict.trains import consist_params
from derail_ros.review.drawing import BLUE, VERMILION, dress, heading, place, sheet, styled
from derail_ros.scenario.calibrated import Calibrated
from derail_ros.studies.ensemble import Job, Progress, run_many
from derail_ros.vocabulary.params import TrainParams
from derail_ros.vocabulary.words import finite

if TYPE_CHECKING:
    from matplotlib.figure import Figure

F64 = NDArray[np.float64]


@dataclass(frozen=True)
class Placement:
    """Risks by place, of (runs, cars): 1 where the car derailed, and probability of release."""

    derailed: F64
    releases: F64
    free: tuple[int, ...]  # numbers of the cars that may be exchanged: no locomotives

    def by_place(self, what: F64) -> tuple[F64, F64]:
        """Mean over runs of each place, and its standard error."""
        return what.mean(axis=0), what.std(axis=0) / math.sqrt(len(what))

    def blocks(self, n: int) -> list[tuple[int, ...]]:
        """Every ``n`` places that follow each other in the train."""
        return [self.free[i : i + n] for i in range(len(self.free) - n + 1)]

    def of(self, cars: Sequence[int]) -> dict[str, Any]:
        """Result of an arrangement: cars derailed and released, with bands over accidents."""
        at = np.array(cars) - 1
        p = self.releases[:, at]
        rng = np.random.default_rng(0)
        expected = p.sum(axis=1)
        return {
            "cars": [int(c) for c in cars],
            "derailed": release.counts(self.derailed[:, at].sum(axis=1)),
            "released": release.counts((rng.random(p.shape) < p).sum(axis=1)),
            "expected_releases": finite(float(expected.mean()), 4),
            "standard_error": finite(float(expected.std() / math.sqrt(len(p))), 4),
        }

    def as_dict(self, n: int) -> dict[str, Any]:
        """The best and the worst block of ``n`` cars, any places, and the risk of each place."""
        blocks = self.blocks(n)
        risk = self.releases.mean(axis=0)
        ranked = sorted(blocks, key=lambda cars: float(risk[np.array(cars) - 1].sum()))
        best, worst = ranked[0], ranked[-1]
        apart = (self.releases[:, np.array(worst) - 1] - self.releases[:, np.array(best) - 1]).sum(
            axis=1
        )
        error = float(apart.std() / math.sqrt(len(apart)))
        derails, releases = (self.by_place(v) for v in (self.derailed, self.releases))
        return {
            "hazardous": n,
            "runs": len(self.releases),
            "best": self.of(best),
            "worst": self.of(worst),
            "anywhere": finite(float(n * risk[np.array(self.free) - 1].mean()), 4),
            "worst_less_best": finite(float(apart.mean()), 4),
            "worst_less_best_within": finite(1.96 * error, 4),
            "by_place": {
                "derails": [finite(float(x), 4) for x in derails[0]],
                "releases": [finite(float(x), 5) for x in releases[0]],
                "releases_error": [finite(float(x), 5) for x in releases[1]],
            },
        }


def words(found: dict[str, Any]) -> list[str]:
    """The placement in sentences."""
    best, worst = found["best"], found["worst"]

    def cars(one: dict[str, Any]) -> str:
        return f"cars {one['cars'][0]} to {one['cars'][-1]}"

    apart, within = found["worst_less_best"], found["worst_less_best_within"]
    sure = "" if apart > within else " These runs cannot tell the two apart."
    return [
        f"{found['hazardous']} tank cars together are least at risk as {cars(best)}: "
        f"{best['derailed']['mean']:.1f} of them derail on average (nine of ten accidents: "
        f"{best['derailed']['q05']:.0f} to {best['derailed']['q95']:.0f}), and "
        f"{best['expected_releases']:.3f} release.",
        f"They are most at risk as {cars(worst)}: {worst['derailed']['mean']:.1f} derail "
        f"({worst['derailed']['q05']:.0f} to {worst['derailed']['q95']:.0f}) and "
        f"{worst['expected_releases']:.3f} release, {apart:.3f} ± {within:.3f} more. "
        f"On average over all places {found['anywhere']:.3f} release.{sure}",
    ]


def placement(
    params: TrainParams, constants: Calibrated, cause: str, *, draws: int, seed: int = 0,
    jobs: int | None = None, progress: Progress | None = None,
) -> Placement:  # fmt: skip
    """Run accidents that begin at any car of a train.

    Runs in which few cars derail need no engine: those behind the first one are off, unstruck.
    """
    cars, speed = params.cars[: params.n_train], params.initiation.speed
    n = len(cars)
    rng = np.random.default_rng([seed, draws, 1])
    first = np.floor(n * (rng.permutation(draws) + rng.random(draws)) / draws).astype(int)
    derailed, releases = np.zeros((2, draws, n))
    drawn = [
        members(constants, cause, speed, n - int(f), draws, seed)[i] for i, f in enumerate(first)
    ]

    def task(job: Job, stop: Any) -> Any:
        f, m = int(first[job.key]), drawn[job.key]
        simulation = run(partial(consist_params, cars[f:], speed, m.draw), m.draw, 0, stop)
        off = np.array(simulation.outcome().derailed_cars, dtype=int) - 1
        known = len(simulation.params.cars)
        p = release.probability(simulation.outcome().car_peak_force)
        for rule in ("energy", "approach"):
            p = p + release.by_blows(simulation.collisions, known, "single_shell", rule)
        return f + off, p[off] / 3.0

    good = np.ones(draws, dtype=bool)
    for i in np.flatnonzero([m.few > 0 for m in drawn]):
        derailed[i, first[i] : first[i] + drawn[i].few] = 1.0
    piles = [Job(params, key=int(i)) for i in np.flatnonzero([m.few == 0 for m in drawn])]
    with closing(run_many(piles, jobs=jobs, task=task)) as results:
        for done, result in enumerate(results, 1):
            i = result.job.key
            if result.error is not None:
                good[i] = False
            else:
                at, p = result.value
                derailed[i, at], releases[i, at] = 1.0, p
            if progress is not None:
                progress(done, len(piles))
    free = tuple(i for i, car in enumerate(cars, 1) if not car.locomotives and car.represents == 1)
    return Placement(derailed[good], releases[good], free)


@styled
def picture(found: dict[str, Any], title: str) -> Figure:
    """The risk of each place, and the best and the worst block."""
    page = sheet(7.2, 5.2)
    heading(page, title, "risk by place in the train; any car may be the first one involved",
            left=0.3, fits=52)  # fmt: skip
    by = found["by_place"]
    x = np.arange(1, len(by["derails"]) + 1)
    for k, (key, words_, colour) in enumerate(
        (("derails", "derails", BLUE), ("releases", "releases, a tank car of a single shell",
                                        VERMILION))
    ):  # fmt: skip
        axes = place(page, 0.75, 1.15 + 2.05 * k, 6.2, 1.35)
        y = 100.0 * np.array(by[key])
        axes.bar(x, y, width=0.9, color=colour)
        if key == "releases":
            axes.errorbar(x, y, 100.0 * np.array(by["releases_error"]), fmt="none", ecolor="#555",
                          lw=0.7)  # fmt: skip
        for which, shade in (("best", "#cfe8d5"), ("worst", "#f5d5c8")):
            cars = found[which]["cars"]
            axes.axvspan(cars[0] - 0.5, cars[-1] + 0.5, color=shade, zorder=0)
            axes.text(np.mean(cars), 1.02, which, size=11, ha="center", va="bottom",
                      transform=axes.get_xaxis_transform())  # fmt: skip
        axes.set_title(f"{words_}, % of accidents\n", loc="left", size=12, weight="bold")
        axes.tick_params(labelsize=11)
        dress(axes, "y")
    axes.set_xlabel("car", size=11)
    return page
