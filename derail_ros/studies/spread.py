"""The spread of outcomes: what one run of a scenario tells, and what it does not.

A scenario is run many times with the lateral force varied by a few percent, far less than
anyone knows it. What comes out is a distribution; a published run, an accident and any single run
are draws from it at best.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from derail_ros.studies.ensemble import (
    VARIATION,
    Result,
    ScenarioLike,
    ensemble_runs,
    run_many,
)
from derail_ros.studies.validation import Published
from derail_ros.vocabulary.measures import counted, failed_record, outcome_record

if TYPE_CHECKING:
    from derail_ros.vocabulary.params import TrainParams

DEFAULT = ("mississauga", "base_train")


@dataclass(frozen=True)
class Measure:
    """What is looked at.

    Attributes
    ----------
    name : key here and of the published values
    record : key of the outcome's record
    factor : from the record's unit
    label, unit, digits : words
    whole : a whole number
    """

    name: str
    record: str
    factor: float
    label: str
    unit: str
    digits: int
    whole: bool = False


MEASURES = (
    Measure("cars_derailed", "cars_derailed", 1.0, "cars derailed", "", 0, True),
    Measure("duration_s", "duration_s", 1.0, "duration", "s", 1),
    Measure("peak_force_MN", "peak_force_N", 1e-6, "peak force", "MN", 1),
    Measure("scene_length_m", "scene_length_m", 1.0, "scene length", "m", 0),
    Measure("scene_width_m", "scene_width_m", 1.0, "scene width", "m", 0),
    Measure("cars_above_10MN", "cars_above_10MN", 1.0, "cars struck above 10 MN", "", 0, True),
)

ACCIDENTS: Mapping[str, Mapping[str, float]] = {
    "mississauga": {"cars_derailed": 24, "scene_length_m": 132, "scene_width_m": 39},
}
"""What is known of the accidents themselves, by scenario."""

SAME_TRAIN = {"mississauga_published": "mississauga"}
"""Scenarios of an accident that has another name."""


@dataclass(frozen=True)
class Distribution:
    """One measure over all runs.

    Attributes
    ----------
    values : in the order of the members, without void and failed runs
    published, accident : None where there is none
    """

    measure: Measure
    values: NDArray[np.float64]
    published: float | None
    accident: float | None

    def quantile(self, share: float) -> float:
        """Quantile, linear between the runs; nan without runs."""
        return float(np.quantile(self.values, share)) if len(self.values) else math.nan

    @property
    def mean(self) -> float:
        """Mean; nan without runs."""
        return float(self.values.mean()) if len(self.values) else math.nan

    @property
    def sd(self) -> float:
        """Standard deviation of single runs; nan for fewer than two."""
        return float(self.values.std(ddof=1)) if len(self.values) > 1 else math.nan

    @property
    def apart(self) -> float:
        """Median difference of two runs taken by chance; nan for fewer than two."""
        n = len(self.values)
        if n < 2:
            return math.nan
        i, j = np.triu_indices(n, 1)
        return float(np.median(np.abs(self.values[i] - self.values[j])))

    def below(self, value: float) -> float:
        """Share of runs below ``value``, runs equal to it counted half."""
        x = self.values
        return float(((x < value).sum() + 0.5 * (x == value).sum()) / len(x))

    def as_dict(self) -> dict[str, Any]:
        """As plain data."""

        def plain(value: float) -> float | None:
            return value if math.isfinite(value) else None

        return {
            "unit": self.measure.unit,
            "mean": plain(self.mean),
            "sd": plain(self.sd),
            "quantiles": {f"{100 * q:g} %": plain(self.quantile(q)) for q in QUANTILES},
            "median_difference_of_two_runs": plain(self.apart),
            "published": self.published,
            "accident": self.accident,
            "values": self.values.tolist(),
        }


QUANTILES = (0.0, 0.05, 0.25, 0.5, 0.75, 0.95, 1.0)


@dataclass(frozen=True)
class Spread:
    """All runs of a scenario.

    Attributes
    ----------
    name, title : of the scenario
    distributions : by measure
    pairs : who struck whom with the largest force -> number of runs, the most frequent first
    published_pair : of the published run
    above : (N,) share of runs in which each car was struck above 10 MN
    """

    name: str
    title: str
    members: int
    seed: int
    distributions: Mapping[str, Distribution]
    pairs: Mapping[str, int]
    published_pair: str | None
    above: NDArray[np.float64]
    void: int
    failed: int
    errors: tuple[str, ...]

    @property
    def counted(self) -> int:
        """Runs that count."""
        return self.members - self.void - self.failed

    def as_dict(self) -> dict[str, Any]:
        """As plain data."""
        return {
            "scenario": self.name,
            "title": self.title,
            "members": self.members,
            "seed": self.seed,
            "void": self.void,
            "failed": self.failed,
            "errors": list(self.errors),
            "measures": {name: d.as_dict() for name, d in self.distributions.items()},
            "pairs": dict(self.pairs),
            "published_pair": self.published_pair,
            "share_above_10MN": {
                str(car + 1): float(share) for car, share in enumerate(self.above) if share
            },
        }


def published_values(name: str, params: TrainParams, published: Published) -> Mapping[str, Any]:
    """The published run of a scenario at this speed; nothing if there is none."""
    from derail_ros.scenario import ScenarioError, load_scenario

    for case in (*published.beside, *published.cases):
        if case.scenario != name:
            continue
        try:
            own = load_scenario(case.scenario).with_overrides(case.overrides).to_params()
        except ScenarioError:
            continue
        if own.initiation.speed == params.initiation.speed:
            return case.published
    return {}


def spread(
    scenario: ScenarioLike,
    members: int = 200,
    seed: int = 0,
    *,
    jobs: int | None = None,
    published: Mapping[str, Any] | None = None,
    accident: Mapping[str, float] | None = None,
    progress: Callable[[int], None] | None = None,
    run: Callable[..., Iterator[Result]] = run_many,
) -> Spread:
    """Run a scenario many times.

    Parameters
    ----------
    members : number of runs; the first is the scenario itself
    seed : of the variation of the lateral force
    jobs : runs at a time
    published, accident : values to show beside it
    progress : told the number of runs done
    run : runner of runs
    """
    published = published or {}
    accident = accident or {}
    records: list[Any] = [None] * members
    done = 0
    with closing(run(ensemble_runs(scenario, members, seed=seed), jobs=jobs)) as results:
        for result in results:
            if result.error is None:
                record = outcome_record(result.outcome, result.wall_s)
            else:
                record = failed_record(result.error, result.wall_s)
            records[result.run.member] = record
            done += 1
            if progress is not None:
                progress(done)
    good = [r for r in records if counted(r)]
    failed = [r for r in records if "error" in r]
    distributions = {}
    for m in MEASURES:
        values = [len(v) if isinstance(v := r[m.record], list) else v for r in good]
        array = np.array([v * m.factor for v in values if v is not None], dtype=float)
        distributions[m.name] = Distribution(m, array, published.get(m.name), accident.get(m.name))
    pairs: dict[str, int] = {}
    for r in good:
        pair = "none" if r["peak_force_pair"] is None else "-".join(map(str, r["peak_force_pair"]))
        pairs[pair] = pairs.get(pair, 0) + 1
    last = max((c for r in good for c in r["cars_above_10MN"]), default=0)
    above = np.zeros(last)
    for r in good:
        for car in r["cars_above_10MN"]:
            above[car - 1] += 1.0
    above /= max(len(good), 1)
    pair = published.get("peak_force_pair")
    return Spread(
        name=getattr(scenario, "name", ""),
        title=getattr(scenario, "title", ""),
        members=members,
        seed=seed,
        distributions=distributions,
        pairs=dict(sorted(pairs.items(), key=lambda item: (-item[1], item[0]))),
        published_pair=None if pair is None else "-".join(map(str, pair)),
        above=above,
        void=members - len(good) - len(failed),
        failed=len(failed),
        errors=tuple(sorted({r["error"] for r in failed})),
    )


# Words -------------------------------------------------------------------------------------


def shown(value: float | None, digits: int) -> str:
    """A number in a table, ``-`` for none."""
    return "-" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"


def with_unit(measure: Measure) -> str:
    """A measure's words with its unit."""
    return f"{measure.label} ({measure.unit})" if measure.unit else measure.label


def sentence(s: Spread) -> str:
    """What a single run tells, in words."""
    d = s.distributions

    def band(name: str) -> str:
        x = d[name]
        digits = x.measure.digits
        unit = f" {x.measure.unit}" if x.measure.unit else ""
        low, high = shown(x.quantile(0.05), digits), shown(x.quantile(0.95), digits)
        return f"{low}{unit}" if low == high else f"{low} to {high}{unit}"

    top, times = next(iter(s.pairs.items()), ("none", 0))
    return (
        f"In nine of ten runs {band('cars_derailed')} cars derail within "
        f"{band('duration_s')}; the largest force is {band('peak_force_MN')}, the scene "
        f"{band('scene_length_m')} long and {band('scene_width_m')} wide. The largest force is "
        f"between {len(s.pairs)} different pairs of cars, most often {top} "
        f"({100.0 * times / max(s.counted, 1):.0f} %)."
    )


def section(s: Spread, image: str) -> list[str]:
    """One scenario of the page ``docs/spread.md``, as lines."""
    left_out = f"; {s.void} void and {s.failed} failed left out" if s.void or s.failed else ""
    lines = [
        f"## {s.title}",
        "",
        f"`{s.name}`, {s.members} runs, seed {s.seed}{left_out}.",
        "",
        *textwrap.wrap(sentence(s), 99),
        "",
        f"![Distributions of {s.title}]({image})",
        "",
        "| measure | mean | sd | 5 % | median | 95 % | two differ by | published | accident |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for x in s.distributions.values():
        more = x.measure.digits + (1 if x.measure.whole else 0)
        lines.append(
            f"| {with_unit(x.measure)} | {shown(x.mean, more)} | {shown(x.sd, more)} | "
            f"{shown(x.quantile(0.05), x.measure.digits)} | "
            f"{shown(x.quantile(0.5), x.measure.digits)} | "
            f"{shown(x.quantile(0.95), x.measure.digits)} | {shown(x.apart, more)} | "
            f"{_reference(x, x.published)} | {_reference(x, x.accident)} |"
        )
    pairs = ", ".join(f"{pair} ({n})" for pair, n in list(s.pairs.items())[:8])
    lines += [
        "",
        *textwrap.wrap(f"Pairs of the largest force, and in how many runs: {pairs}.", 99),
    ]
    return lines


def _reference(x: Distribution, value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:g} (at {100.0 * x.below(value):.0f} %)" if len(x.values) else f"{value:g}"


def markdown(spreads: Sequence[Spread], images: Sequence[str]) -> str:
    """The page ``docs/spread.md``; ``images`` are the figures' paths from there."""
    intro = (
        "A derailment is chaotic once cars collide. Here scenarios are run many times with "
        f"nothing changed but the force that starts the motion, by up to {100 * VARIATION:g} %, "
        "which is far less than anyone knows it. A single run is one draw from these "
        "distributions; so is a published run, if the model is right, and so was the accident. "
        '"Two differ by" is the median difference of two runs taken by chance; beside a '
        "published value stands the share of runs below it."
    )
    lines = [
        "# Spread: what a single run tells, and what it does not",
        "",
        "Written by `derail spread --write`; do not edit.",
        "",
        *textwrap.wrap(intro, 99),
    ]
    for s, image in zip(spreads, images, strict=True):
        lines += ["", *section(s, image)]
    lines.append("")
    return "\n".join(lines)
