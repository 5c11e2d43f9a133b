"""The distribution of outcomes of a scenario: how much a single run tells.

A scenario is run many times with the lateral force varied by a few percent, less than the
accuracy to which it is known. The outcomes are a distribution. A published run, an accident and
any single run are draws from it at best.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from derail_ros.studies.ensemble import ScenarioLike, ensemble_jobs
from derail_ros.studies.records import Distribution, Ensemble, ensembles, pair_text
from derail_ros.studies.tables import Table
from derail_ros.vocabulary.words import count

DEFAULT = ("mississauga", "base_train")

KEYS = (
    "cars_derailed",
    "duration_s",
    "peak_force_N",
    "scene_length_m",
    "scene_width_m",
    "cars_above_10MN",
)
"""Measures that are shown."""


@dataclass(frozen=True)
class Spread:
    """The ensemble of a scenario."""

    name: str
    title: str
    seed: int
    ensemble: Ensemble
    distributions: Mapping[str, Distribution]  # by key of the measure
    published_pair: str | None  # with the largest force in the published run; None without

    @property
    def counted(self) -> int:
        """Runs that count."""
        return len(self.ensemble.good)

    @property
    def above(self) -> NDArray[np.float64]:
        """(N,) share of runs in which each car was struck above 10 MN."""
        struck = [c - 1 for r in self.ensemble.good for c in r["cars_above_10MN"]]
        return np.bincount(np.array(struck, dtype=int)) / max(self.counted, 1)

    def as_dict(self) -> dict[str, Any]:
        """As plain data."""
        return {
            "scenario": self.name,
            "title": self.title,
            "members": len(self.ensemble),
            "seed": self.seed,
            **self.ensemble.counts(),
            "measures": {key: d.as_dict() for key, d in self.distributions.items()},
            "pairs": self.ensemble.pairs,
            "published_pair": self.published_pair,
            "share_above_10MN": {
                str(car): float(share) for car, share in enumerate(self.above, 1) if share
            },
        }


def spread(
    scenario: ScenarioLike,
    members: int = 200,
    seed: int = 0,
    *,
    published: Mapping[str, Any] | None = None,
    accident: Mapping[str, float] | None = None,
    **how: Any,
) -> Spread:
    """Run a scenario many times.

    Parameters
    ----------
    members : number of runs; the first is the scenario itself
    seed : of the variation of the lateral force
    published, accident : key of a measure -> value to show beside it, SI units
    how : ``jobs``, ``run`` and ``progress`` of :func:`derail_ros.studies.ensemble.gather`
    """
    published, accident = published or {}, accident or {}
    runs = ensemble_jobs(scenario, members, seed=seed)
    (ensemble,) = ensembles(runs, **how).values()
    pair = published.get("peak_force_pair")
    return Spread(
        name=getattr(scenario, "name", ""),
        title=getattr(scenario, "title", ""),
        seed=seed,
        ensemble=ensemble,
        distributions={
            key: ensemble.distribution(key, published.get(key), accident.get(key)) for key in KEYS
        },
        published_pair=None if pair is None else pair_text(pair),
    )


def sentence(s: Spread) -> str:
    """How much a single run tells, in a sentence."""

    def band(key: str) -> str:
        d = s.distributions[key]
        unit = d.measure.shown_unit or d.measure.unit
        low, high = (d.measure.shown(v) for v in d.band)
        return f"{low if low == high else f'{low} to {high}'} {unit}".rstrip()

    top, times = next(iter(s.ensemble.pairs.items()), ("none", 0))
    return (
        f"In nine of ten runs {band('cars_derailed')} cars derail within "
        f"{band('duration_s')}; the largest force is {band('peak_force_N')}, the scene "
        f"{band('scene_length_m')} long and {band('scene_width_m')} wide. The largest force is "
        f"between {count(len(s.ensemble.pairs), 'pair')} of cars, most often {top} "
        f"({100.0 * times / max(s.counted, 1):.0f} %)."
    )


def spread_table(s: Spread) -> Table:
    """Mean, deviation and quantiles of each measure, and the published values."""

    def reference(d: Distribution, value: float | None) -> str:
        text = d.measure.shown(value)
        if value is None or not len(d.values):
            return text
        return f"{text} (at {100.0 * d.below(value):.0f} %)"

    rows = []
    for d in s.distributions.values():
        numbers = (d.mean, d.sd, *(d.quantile(q) for q in (0.05, 0.5, 0.95)), d.apart)
        cells = [d.measure.shown(v) for v in numbers]
        beside = [reference(d, v) for v in (d.published, d.accident)]
        rows.append([d.measure.title, *cells, *beside])
    heads = ["measure", "mean", "sd", "5 %", "median", "95 %", "two differ by", "published",
             "accident"]  # fmt: skip
    return Table(heads, rows, s.title)
