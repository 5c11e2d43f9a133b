r"""Comparison with the published runs.

Outcomes are chaotic: a change of the lateral force by a few percent can make other cars collide,
or one more derail. A published run is one draw, so each is compared with an ensemble. For every
measure: mean, standard deviation of single runs (n - 1) and the 90 % band, the 5 % and 95 %
quantiles of the ensemble (linear between the runs).

The source's forces scatter by some 8 % themselves: bands of forces are widened by that.

Goals, over the cases that have the measure; p published, m mean, median or band of an ensemble:

- count: ``sqrt(mean((m - p)^2))`` in cars; duration the same in s;
- peak force: the share of cases with p inside the band, and the median of ``|ln(p / median)|``;
- scene length and width: ``sqrt(mean((m / p - 1)^2))``;
- pair of the largest force, whichever of the two struck: cases whose ensemble has the published
  one, the mean share of runs that have it, and the share of pairs two cars apart.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from derail_ros.scenario import load_scenario
from derail_ros.studies.doubt import doubtful_jobs
from derail_ros.studies.ensemble import Job, compute, ensemble_jobs, gather
from derail_ros.studies.published import Published, PublishedCase, load_published
from derail_ros.studies.records import Distribution, Ensemble, pair_text, record_of
from derail_ros.studies.statements import (
    SCALES,
    Statement,
    TraceKey,
    ground_jobs,
    judge,
    trace,
    traced_jobs,
)
from derail_ros.studies.tables import Strong, Table
from derail_ros.vocabulary.measures import MEASURES

NUMERICS: dict[str, dict[str, Any]] = {
    "shipped": {},
    "source": {
        "integration.method": "rkf45",
        "integration.rtol": 1e-4,
        "integration.stabilization": "baumgarte",
        "integration.locate_crossings": False,
    },
}
"""Numerics of a comparison -> its settings: as shipped, or as the source computed."""

KEYS = (
    "cars_derailed",
    "duration_s",
    "peak_force_N",
    "scene_length_m",
    "scene_width_m",
    "scene_area_m2",
    "cars_above_10MN",
)
"""Measures that are compared."""

BASE = "base_60"
"""The case of the base train as it is."""


@dataclass(frozen=True)
class CaseResult:
    """A published case with its ensemble."""

    case: PublishedCase
    ensemble: Ensemble

    @cached_property
    def distributions(self) -> dict[str, Distribution]:
        """Key of a measure -> its distribution beside the published value."""
        return {key: self.case.distribution(self.ensemble, key) for key in KEYS}

    @property
    def pairs(self) -> dict[str, int]:
        """Pair of cars with the largest force -> number of runs, the most frequent first."""
        return {pair: n for pair, n in self.ensemble.pairs.items() if pair != "none"}

    @property
    def pair_share(self) -> float | None:
        """Share of runs whose hardest pair is the published one, whichever struck."""
        pair = self.case.pair
        if pair is None or not self.ensemble.good:
            return None
        return self._share(lambda found: set(found) == set(pair))

    @property
    def two_apart_share(self) -> float | None:
        """Share of runs whose hardest pair is two cars apart."""
        return self._share(lambda f: abs(f[0] - f[1]) == 2) if self.ensemble.good else None

    def _share(self, of: Callable[[Sequence[int]], bool]) -> float:
        pairs = [r["peak_force_pair"] for r in self.ensemble.good]
        return sum(pair is not None and of(pair) for pair in pairs) / len(pairs)

    def as_dict(self) -> dict[str, Any]:
        """As plain data."""
        return {
            "case": self.case.name,
            "title": self.case.title,
            "scenario": self.case.scenario,
            "overrides": dict(self.case.overrides),
            "source": self.case.source,
            **self.ensemble.counts(),
            "measures": {key: d.as_dict() for key, d in self.distributions.items()},
            "published_peak_pair": self.case.pair,
            "peak_pairs": self.pairs,
            "published_pair_share": self.pair_share,
            "two_apart_share": self.two_apart_share,
        }


@dataclass(frozen=True)
class Goal:
    """A goal, what was reached, and the scatter of single runs beside it.

    The scatter is the same for a single run of the ensemble against the ensemble's mean: what
    chaos alone would give if the model were exact.
    """

    name: str
    text: str
    limits: Mapping[str, float]  # at_least, at_most, or both
    value: float | None  # None without a case that has the measure
    cases: int  # that were compared
    scatter: float | None = None  # None where it is not known

    @property
    def met(self) -> bool:
        """Whether the goal is reached."""
        if self.value is None:
            return False
        low, high = self.limits.get("at_least", -math.inf), self.limits.get("at_most", math.inf)
        return low <= self.value <= high

    @property
    def asked(self) -> str:
        """Its limits in words."""
        return ", ".join(f"{k.replace('_', ' ')} {v:g}" for k, v in self.limits.items())

    def as_dict(self) -> dict[str, Any]:
        """As plain data."""
        return {
            "goal": self.name,
            "text": self.text,
            **self.limits,
            "value": self.value,
            "scatter_of_single_runs": self.scatter,
            "cases": self.cases,
            "met": self.met,
        }


def _rms(values: Iterable[float]) -> float | None:
    squares = [v * v for v in values if not math.isnan(v)]
    return math.sqrt(sum(squares) / len(squares)) if squares else None


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None


def known(results: Iterable[CaseResult], key: str) -> list[Distribution]:
    """The distributions that have runs and a published value."""
    found = [r.distributions[key] for r in results]
    return [d for d in found if d.inside is not None]


def goals(results: Sequence[CaseResult], limits: Mapping[str, Mapping[str, float]]) -> list[Goal]:
    """The values that the comparison reached."""

    def rms(name: str, key: str, text: str, relative: bool) -> Goal:
        of = known(results, key)
        scale = [d.published if relative else 1.0 for d in of]
        off = _rms((d.mean - d.published) / s for d, s in zip(of, scale, strict=True))  # type: ignore
        scatter = _rms(d.sd / d.mean if relative else d.sd for d in of)
        return Goal(name, text, limits[name], off, len(of), scatter)

    def share(name: str, text: str, of: Sequence[float], scatter: float | None = None) -> Goal:
        return Goal(name, text, limits[name], _mean(of), len(of), scatter)

    peaks = known(results, "peak_force_N")
    positive = [d for d in peaks if d.published > 0.0 and d.quantile(0.5) > 0.0]  # type: ignore
    ratios = [abs(math.log(d.published / d.quantile(0.5))) for d in positive]  # type: ignore
    # median |ln| of a draw: half the interquartile range, from the 5 to 95 % one
    widths = [
        0.6745 / 3.29 * math.log(high / low)
        for low, high in (d.band for d in positive)
        if low > 0.0
    ]
    pairs = [r.pair_share for r in results if r.pair_share is not None]
    apart = [r.two_apart_share for r in results if r.pair_share is not None]
    base = [r.pair_share for r in results if r.case.name == BASE and r.pair_share is not None]
    return [
        rms("count_rms", "cars_derailed", "cars derailed, rms difference (cars)", False),
        rms("duration_rms_s", "duration_s", "duration, rms difference (s)", False),
        rms("length_rms", "scene_length_m", "scene length, rms relative difference", True),
        rms("width_rms", "scene_width_m", "scene width, rms relative difference", True),
        share("peak_inside_share",
              "peak force, share of cases with the published one in the 90 % band",
              [float(bool(d.inside)) for d in peaks], 0.9),
        Goal("peak_log_ratio", "peak force, median size of ln(published / median)",
             limits["peak_log_ratio"], float(np.median(ratios)) if ratios else None,
             len(positive), float(np.median(widths)) if widths else None),
        Goal("pair_cases", "cases whose ensemble has the published pair of the largest force",
             limits["pair_cases"], float(sum(s > 0.0 for s in pairs)) if pairs else None,
             len(pairs)),
        share("pair_share", "published pair, mean share of runs", pairs),
        share("two_apart_share", "pair of the largest force two cars apart, share of runs",
              [s for s in apart if s is not None]),
        share("base_pair_share", "published pair in the base train, share of runs", base),
    ]  # fmt: skip


@dataclass(frozen=True)
class Validation:
    """The whole comparison.

    Attributes
    ----------
    members, seed : of the ensembles
    settings : dotted path -> value that was changed in all cases
    numerics : how the runs were integrated, a key of :data:`NUMERICS`
    cases : the published runs
    doubtful : the same with the reconstructed constants drawn as well; empty with settings
    beside : what is shown and counts in no goal
    goals : what the cases reached
    statements : what the source says of its runs in words
    others : ensembles of the statements, and their runs that failed
    """

    members: int
    seed: int
    settings: Mapping[str, Any]
    numerics: str
    cases: tuple[CaseResult, ...]
    doubtful: tuple[CaseResult, ...]
    beside: tuple[CaseResult, ...]
    goals: tuple[Goal, ...]
    statements: tuple[Statement, ...]
    others: tuple[Ensemble, ...] = ()

    @property
    def ensembles(self) -> list[Ensemble]:
        """All ensembles."""
        cases = (*self.cases, *self.doubtful, *self.beside)
        return [*(c.ensemble for c in cases), *self.others]

    @property
    def passed(self) -> bool:
        """All goals are reached and no run failed."""
        return not any(e.failed for e in self.ensembles) and all(g.met for g in self.goals)

    def as_dict(self) -> dict[str, Any]:
        """As plain data."""
        parts = {
            name: [part.as_dict() for part in getattr(self, name)]
            for name in ("cases", "doubtful", "beside", "goals", "statements")
        }
        return {
            "members": self.members,
            "seed": self.seed,
            "settings": dict(self.settings),
            "numerics": self.numerics,
            **parts,
            "passed": self.passed,
        }


def _task(job: Job, stop: Callable[[], bool]) -> Any:
    return (trace if isinstance(job.key, TraceKey) else compute)(job, stop)


def validate(
    members: int = 20,
    seed: int = 0,
    *,
    settings: Mapping[str, Any] | None = None,
    numerics: str = "shipped",
    published: Published | None = None,
    **how: Any,
) -> Validation:
    """Run the ensembles of all published cases and compare.

    Parameters
    ----------
    members : runs a case; the first is the case itself
    seed : of the variation of the lateral force
    settings : dotted path -> value for all cases
    numerics : a key of :data:`NUMERICS`
    published : cases; those that come with the package by default
    how : ``jobs``, ``run`` and ``progress`` of :func:`derail_ros.studies.ensemble.gather`
    """
    published = published or load_published()
    everything = (*published.cases, *published.beside)
    changed = {**NUMERICS[numerics], **(settings or {})}
    # All of them before the first run: a mistake is reported at once.
    scenarios = [
        load_scenario(case.scenario).with_overrides({**case.overrides, **changed})
        for case in everything
    ]
    doubtful = () if changed else published.cases

    def runs() -> Iterator[Job]:
        for key, scenario in enumerate(scenarios):
            yield from ensemble_jobs(scenario, members, seed=seed, key=key)
        for key, scenario in enumerate(scenarios[: len(doubtful)], len(everything)):
            yield from doubtful_jobs(scenario, members, seed=seed, key=key)

    def everything_else() -> Iterator[Job]:
        yield from ground_jobs(published.text, members, seed, changed)
        yield from traced_jobs(published.text, members, seed, changed)

    gathered = gather((*runs(), *everything_else()), task=_task, **how)
    traces = {
        key: [r.value for r in results if r.error is None]
        for key, results in gathered.items()
        if isinstance(key, TraceKey)
    }
    found = {
        key: Ensemble(tuple(map(record_of, results)))
        for key, results in gathered.items()
        if key not in traces
    }
    failed = [record_of(r) for key in traces for r in gathered[key] if r.error is not None]
    results = [CaseResult(c, found[k]) for k, c in enumerate((*everything, *doubtful))]
    split, end = len(published.cases), len(everything)
    said: list[Statement] = []
    if published.text:
        cases = {r.case.name: r.ensemble for r in results[:split]}
        said = judge(published.text, traces, cases, {s: found["ground", s] for s in SCALES})
    return Validation(
        members=members,
        seed=seed,
        settings=settings or {},
        numerics=numerics,
        cases=tuple(results[:split]),
        doubtful=tuple(results[end:]),
        beside=tuple(results[split:end]),
        goals=tuple(goals(results[:split], published.goals)),
        statements=tuple(said),
        others=(
            *(found[k] for k in found if k not in range(len(results))),
            Ensemble(tuple(failed)),
        ),
    )


# Tables ------------------------------------------------------------------------------------


def verdict(d: Distribution) -> str:
    """A measure of a case in words: whether and how far the ensemble is off."""
    if d.published is None:
        return ""
    if d.inside is None:
        return "no runs"
    if d.inside:
        return "in the band"
    off = d.mean - d.published
    return f"mean {d.measure.shown(abs(off))} {'above' if off > 0.0 else 'below'}"


def measure_tables(validation: Validation) -> Iterator[Table]:
    """A table for each measure: the cases with a published value."""
    for key in KEYS:
        rows = []
        for result in (*validation.cases, *validation.beside):
            d = result.distributions[key]
            shown = d.measure.shown
            if d.published is not None:
                cells = [shown(v) for v in (d.published, d.mean, d.sd)]
                rows.append([result.case.title, *cells, d.shown_band(), verdict(d)])
        if rows:
            heads = ["case", "published", "mean", "sd", "90 % band", ""]
            yield Table(heads, rows, MEASURES[key].title)


def goal_table(validation: Validation) -> Table:
    """The goals and what was reached."""

    def two(value: float | None) -> str:
        return "-" if value is None else f"{value:.2f}"

    rows = [
        [g.text, str(g.cases), g.asked,
         two(g.value), "met" if g.met else Strong("missed"), two(g.scatter)]
        for g in validation.goals
    ]  # fmt: skip
    heads = ["measure", "cases", "goal", "reached", "", "scatter of single runs"]
    return Table(heads, rows, "goals")


def pair_table(validation: Validation) -> Table:
    """The pair of the largest force: published, in the ensembles, and how often."""
    rows = []
    for r in (*validation.cases, *validation.beside):
        share = "-" if r.pair_share is None else f"{r.pair_share:.2f}"
        apart = "-" if r.two_apart_share is None else f"{r.two_apart_share:.2f}"
        found = ", ".join(f"{pair} ({n})" for pair, n in list(r.pairs.items())[:4])
        of = r.ensemble
        pair = pair_text(r.case.pair) if r.case.pair else "-"
        rows.append([r.case.title, pair, found, share, apart, f"{of.void}, {of.failed}"])
    heads = ["case", "published", "ensemble (runs)", "share", "two apart", "void, failed"]
    return Table(heads, rows, "pair of the largest force", texts=3)


def statement_table(validation: Validation) -> Table:
    """The statements of the source, kept or not."""
    rows = [
        [s.text, s.tolerance, s.found, "kept" if s.kept else Strong("not kept")]
        for s in validation.statements
    ]
    return Table(["the source says", "judged by", "found", ""], rows, "statements", texts=4)


def doubt_table(validation: Validation) -> Table:
    """How many published values lie in the band, without and with doubtful constants."""
    rows = []
    for key in KEYS[:5]:
        of = known(validation.cases, key)
        inside = [sum(bool(d.inside) for d in known(results, key))
                  for results in (validation.cases, validation.doubtful)]  # fmt: skip
        rows.append([MEASURES[key].title, *(f"{n} of {len(of)}" for n in inside)])
    heads = ["measure", "with chance alone", "constants in doubt too"]
    return Table(heads, rows, "published values in the 90 % band")
