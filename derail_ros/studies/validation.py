r"""Comparison with the published runs.

Outcomes are chaotic: a change of the lateral force by a few percent can make other cars strike,
or one more derail. So each published run, which is one draw, is compared with an ensemble. For
every measure: mean, standard deviation of single runs (N - 1) and the 90 % band, the 5 % and 95 %
quantiles of the ensemble (linear between the runs).

Goals, over the cases that have the measure; p published, m mean, median or band of an ensemble:

- count: ``sqrt(mean((m - p)^2))`` in cars; duration the same in s;
- peak force: the share of cases with p inside the band, and the median of ``|ln(p / median)|``;
- scene length and width: ``sqrt(mean((m / p - 1)^2))``.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Any

import numpy as np

from derail_ros.studies.doubt import DOUBTS, doubtful_runs
from derail_ros.studies.ensemble import (
    VARIATION,
    Result,
    Run,
    ScenarioLike,
    ensemble_runs,
    run_many,
)
from derail_ros.studies.impact import STANDING, STRIKING, Impact, impacts, words
from derail_ros.vocabulary.measures import counted, failed_record, outcome_record, record_numbers

Loader = Callable[[str], ScenarioLike]

MEASURES: tuple[tuple[str, str, str, float], ...] = (
    ("cars_derailed", "cars_derailed", "cars derailed", 1.0),
    ("duration_s", "duration_s", "duration (s)", 1.0),
    ("peak_force_MN", "peak_force_N", "peak force (MN)", 1e-6),
    ("scene_length_m", "scene_length_m", "scene length (m)", 1.0),
    ("scene_width_m", "scene_width_m", "scene width (m)", 1.0),
    ("scene_area_m2", "scene_area_m2", "scene area (m2)", 1.0),
    ("cars_above_10MN", "cars_above_10MN", "cars struck above 10 MN", 1.0),
)
"""Key here, key of the outcome's record, label, factor."""


@dataclass(frozen=True)
class Case:
    """A published run."""

    name: str
    title: str
    scenario: str
    published: Mapping[str, Any]
    overrides: Mapping[str, Any] = field(default_factory=dict)
    source: str = ""


@dataclass(frozen=True)
class Published:
    """The published runs and what is asked of the comparison."""

    cases: tuple[Case, ...]
    beside: tuple[Case, ...]
    goals: Mapping[str, float]


def load_published() -> Published:
    """Read the published runs that come with the package."""
    import yaml

    text = (files("derail_ros.studies") / "data" / "published.yaml").read_text(encoding="utf-8")
    data = yaml.safe_load(text)
    return Published(
        tuple(Case(**case) for case in data["cases"]),
        tuple(Case(**case) for case in data["beside"]),
        data["goals"],
    )


@dataclass(frozen=True)
class Spread:
    """One measure of an ensemble beside its published value (None if there is none).

    Attributes
    ----------
    published : the published run's value
    mean, sd : of the ensemble; sd of single runs, with N - 1
    median, low, high : quantiles 50, 5 and 95 %
    inside : the published value lies in the band
    """

    published: float | None
    mean: float | None
    sd: float | None
    median: float | None
    low: float | None
    high: float | None

    @property
    def inside(self) -> bool | None:
        """Whether the published value lies in the 90 % band."""
        if self.published is None or self.low is None or self.high is None:
            return None
        return self.low <= self.published <= self.high

    def as_dict(self) -> dict[str, Any]:
        """As plain data."""
        return {
            "published": self.published,
            "mean": self.mean,
            "sd": self.sd,
            "median": self.median,
            "band_90": None if self.low is None else [self.low, self.high],
            "inside_band": self.inside,
        }


@dataclass(frozen=True)
class CaseResult:
    """A case with its ensemble."""

    case: Case
    spreads: Mapping[str, Spread]
    runs: int
    void: int
    failed: int
    errors: tuple[str, ...]
    pairs: Mapping[str, int]

    def as_dict(self) -> dict[str, Any]:
        """As plain data."""
        return {
            "case": self.case.name,
            "title": self.case.title,
            "scenario": self.case.scenario,
            "overrides": dict(self.case.overrides),
            "source": self.case.source,
            "runs": self.runs,
            "void": self.void,
            "failed": self.failed,
            "errors": list(self.errors),
            "measures": {name: spread.as_dict() for name, spread in self.spreads.items()},
            "published_peak_pair": self.case.published.get("peak_force_pair"),
            "peak_pairs": dict(self.pairs),
        }


@dataclass(frozen=True)
class Goal:
    """A goal, what was reached, and the scatter of single runs beside it.

    Attributes
    ----------
    name, text : key and words
    limit : what is asked
    value : what was reached; None without a case that has the measure
    at_least : the limit is a least value, not a largest
    cases : number of cases that went in
    scatter : the same measure for a single run of the ensemble against the ensemble's mean: what
        chaos alone would give if the model were exact
    """

    name: str
    text: str
    limit: float
    value: float | None
    at_least: bool
    cases: int
    scatter: float | None

    @property
    def met(self) -> bool:
        """Whether the goal is reached."""
        if self.value is None:
            return False
        return self.value >= self.limit if self.at_least else self.value <= self.limit

    def as_dict(self) -> dict[str, Any]:
        """As plain data."""
        return {
            "goal": self.name,
            "text": self.text,
            "limit": self.limit,
            "value": self.value,
            "scatter_of_single_runs": self.scatter,
            "cases": self.cases,
            "met": self.met,
        }


def spread(values: Sequence[float], published: float | None) -> Spread:
    """Statistics of an ensemble's values beside the published one."""
    x = np.asarray(values, dtype=float)
    if x.size == 0:
        return Spread(published, None, None, None, None, None)
    low, median, high = np.quantile(x, [0.05, 0.5, 0.95])
    sd = float(x.std(ddof=1)) if x.size > 1 else None
    return Spread(published, float(x.mean()), sd, float(median), float(low), float(high))


def evaluate(case: Case, records: Sequence[Mapping[str, Any]]) -> CaseResult:
    """Compare the records of a case's ensemble with the published run."""
    good = [r for r in records if counted(r)]
    flat = [record_numbers(r) for r in good]
    spreads = {}
    for name, key, _, factor in MEASURES:
        published = case.published.get(name)
        values = [r[key] * factor for r in flat if key in r]
        spreads[name] = spread(values, None if published is None else float(published))
    pairs: dict[str, int] = {}
    for record in good:
        if record["peak_force_pair"] is not None:
            pair = "-".join(str(c) for c in record["peak_force_pair"])
            pairs[pair] = pairs.get(pair, 0) + 1
    failed = [r for r in records if "error" in r]
    return CaseResult(
        case=case,
        spreads=spreads,
        runs=len(records),
        void=len(records) - len(good) - len(failed),
        failed=len(failed),
        errors=tuple(sorted({r["error"] for r in failed})),
        pairs=dict(sorted(pairs.items(), key=lambda item: (-item[1], item[0]))),
    )


def _rms(values: Sequence[float]) -> float | None:
    return math.sqrt(sum(v * v for v in values) / len(values)) if values else None


def _known(results: Sequence[CaseResult], name: str) -> list[Spread]:
    spreads = [r.spreads[name] for r in results]
    return [s for s in spreads if s.published is not None and s.mean is not None]


def goals(results: Sequence[CaseResult], limits: Mapping[str, float]) -> list[Goal]:
    """What the comparison reached."""
    found = []
    for key, name, text in (
        ("count_rms", "cars_derailed", "cars derailed, rms difference (cars)"),
        ("duration_rms_s", "duration_s", "duration, rms difference (s)"),
    ):
        known = _known(results, name)
        value = _rms([s.mean - s.published for s in known])  # type: ignore[operator]
        scatter = _rms([s.sd for s in known if s.sd is not None])
        found.append(Goal(key, text, limits[key], value, False, len(known), scatter))

    known = _known(results, "peak_force_MN")
    inside = [bool(s.inside) for s in known]
    share = sum(inside) / len(inside) if inside else None
    found.append(
        Goal(
            "peak_inside_share",
            "peak force, share of cases with the published one in the 90 % band",
            limits["peak_inside_share"],
            share,
            True,
            len(known),
            0.9,
        )
    )
    positive = [s for s in known if s.published > 0.0 and s.median > 0.0]  # type: ignore[operator]
    ratios = [abs(math.log(s.published / s.median)) for s in positive]  # type: ignore[operator]
    widths = [
        # median |ln| of a draw: half the interquartile range, from the 5 to 95 % one
        0.6745 / 3.29 * math.log(s.high / s.low)  # type: ignore[operator]
        for s in positive
        if s.low > 0.0  # type: ignore[operator]
    ]
    found.append(
        Goal(
            "peak_log_ratio",
            "peak force, median size of ln(published / median)",
            limits["peak_log_ratio"],
            float(np.median(ratios)) if ratios else None,
            False,
            len(positive),
            float(np.median(widths)) if widths else None,
        )
    )
    for key, name, text in (
        ("length_rms", "scene_length_m", "scene length, rms relative difference"),
        ("width_rms", "scene_width_m", "scene width, rms relative difference"),
    ):
        known = _known(results, name)
        value = _rms([s.mean / s.published - 1.0 for s in known])  # type: ignore[operator]
        scatter = _rms([s.sd / s.mean for s in known if s.sd is not None])  # type: ignore[operator]
        found.append(Goal(key, text, limits[key], value, False, len(known), scatter))
    return found


@dataclass(frozen=True)
class Validation:
    """The whole comparison.

    Attributes
    ----------
    members, seed : of the ensembles
    settings : dotted path -> value that was changed in all cases
    cases : the published runs
    doubtful : the same with the reconstructed constants drawn as well; empty with settings
    beside : what is shown and counts in no goal
    goals : what the cases reached
    impacts : the tank car impact tests by the collision law
    """

    members: int
    seed: int
    settings: Mapping[str, Any]
    cases: tuple[CaseResult, ...]
    doubtful: tuple[CaseResult, ...]
    beside: tuple[CaseResult, ...]
    goals: tuple[Goal, ...]
    impacts: tuple[Impact, ...]

    @property
    def passed(self) -> bool:
        """All goals are reached and no run failed."""
        failed = sum(c.failed for c in (*self.cases, *self.doubtful, *self.beside))
        return failed == 0 and all(g.met for g in self.goals)

    def as_dict(self) -> dict[str, Any]:
        """As plain data."""
        return {
            "members": self.members,
            "seed": self.seed,
            "settings": dict(self.settings),
            "cases": [c.as_dict() for c in self.cases],
            "doubtful": [c.as_dict() for c in self.doubtful],
            "beside": [c.as_dict() for c in self.beside],
            "goals": [g.as_dict() for g in self.goals],
            "impacts": [i.as_dict() for i in self.impacts],
            "passed": self.passed,
        }


def _runs(
    scenarios: Sequence[ScenarioLike], doubtful: int, members: int, seed: int
) -> Iterator[Run]:
    """Runs of all ensembles, then of the first ``doubtful`` ones with doubtful constants."""
    for number, scenario in enumerate(scenarios):
        yield from ensemble_runs(scenario, members, seed=seed, key=number)
    for number, scenario in enumerate(scenarios[:doubtful]):
        yield from doubtful_runs(scenario, members, seed=seed, key=len(scenarios) + number)


def _task_record(result: Result) -> dict[str, Any]:
    if result.error is not None:
        return failed_record(result.error, result.wall_s)
    return outcome_record(result.outcome, result.wall_s)


def validate(
    members: int = 20,
    seed: int = 0,
    *,
    jobs: int | None = None,
    settings: Mapping[str, Any] | None = None,
    published: Published | None = None,
    load: Loader | None = None,
    progress: Callable[[int, int], None] | None = None,
    run: Callable[..., Iterator[Result]] = run_many,
) -> Validation:
    """Run the ensembles of all published cases and compare.

    Parameters
    ----------
    members : runs a case; the first is the case itself
    seed : of the variation of the lateral force
    jobs : runs at a time
    settings : dotted path -> value for all cases, to see what another constant would do
    published : cases; those that come with the package by default
    load : scenario by name; ``derail_ros.scenario.load_scenario`` by default
    progress : told ``(done, total)`` after each run
    run : runner of runs
    """
    if published is None:
        published = load_published()
    if load is None:
        from derail_ros.scenario import load_scenario as load

    everything = (*published.cases, *published.beside)
    # All of them before the first run: a mistake is not found after minutes.
    scenarios = [
        load(case.scenario).with_overrides({**case.overrides, **(settings or {})})
        for case in everything
    ]
    doubtful = 0 if settings else len(published.cases)
    records: list[list[Any]] = [[None] * members for _ in range(len(everything) + doubtful)]
    total, done = members * len(records), 0
    with closing(run(_runs(scenarios, doubtful, members, seed), jobs=jobs)) as results:
        for result in results:
            records[result.run.key][result.run.member] = _task_record(result)
            done += 1
            if progress is not None:
                progress(done, total)
    compared = [
        evaluate(case, r)
        for case, r in zip((*everything, *published.cases[:doubtful]), records, strict=True)
    ]
    split = len(published.cases)
    contact = scenarios[0].to_params().contact if scenarios else None
    return Validation(
        members=members,
        seed=seed,
        settings=settings or {},
        cases=tuple(compared[:split]),
        doubtful=tuple(compared[len(everything) :]),
        beside=tuple(compared[split : len(everything)]),
        goals=tuple(goals(compared[:split], published.goals)),
        impacts=impacts(contact),
    )


# Words -------------------------------------------------------------------------------------

DIGITS = {
    "cars_derailed": 1,
    "duration_s": 1,
    "peak_force_MN": 2,
    "scene_length_m": 1,
    "scene_width_m": 1,
    "scene_area_m2": 0,
    "cars_above_10MN": 1,
}


def shown(value: float | None, digits: int) -> str:
    """A number in a table, ``-`` for none."""
    return "-" if value is None else f"{value:.{digits}f}"


def verdict(s: Spread, digits: int) -> str:
    """One measure of one case in words."""
    if s.published is None:
        return ""
    if s.mean is None:
        return "no runs"
    if s.inside:
        return "in the band"
    off = s.mean - s.published
    side = "above" if off > 0.0 else "below"
    return f"mean {abs(off):.{digits}f} {side}"


FIGURES: tuple[tuple[str, str, str], ...] = (
    ("validation.png", "", "Published values beside the ensembles"),
    ("validation_peaks.png", "Peak force on each car", "Peak force on each car"),
    ("validation_scenes.png", "The pile as it grows", "The scene at 5.7, 5.9, 8.0 and 8.6 s"),
    ("validation_final_scene.png", "The final scene", "The final scene of the Mississauga run"),
)
"""Files of the page's figures, headings within the section on Mississauga, what they show."""


def inside(results: Sequence[CaseResult], name: str) -> tuple[int, int]:
    """Cases whose published value lies in the band of their ensemble, and cases that have one."""
    known = _known(results, name)
    return sum(bool(s.inside) for s in known), len(known)


def _doubt_section(validation: Validation) -> Iterator[str]:
    yield from ("", "## With the constants in doubt", "")
    yield from textwrap.wrap(
        "Chance is not all that is unknown: constants of the source are lost. Here each run of an "
        "ensemble draws them too, all at once, uniformly from what is in doubt about them (k2 and "
        "d_c in their logarithm); run by run the same draw for every case.",
        99,
    )
    yield from ("", "| constant | drawn from | why |", "|---|---|---|")
    for d in DOUBTS:
        yield f"| {d.label} | {d.low:g} to {d.high:g} | {d.why} |"
    yield from (
        "",
        "Published values in the 90 % band:",
        "",
        "| measure | with chance alone | constants in doubt too |",
        "|---|---|---|",
    )
    for name, _, label, _ in MEASURES[:5]:
        (a, of), (b, _) = inside(validation.cases, name), inside(validation.doubtful, name)
        yield f"| {label} | {a} of {of} | {b} of {of} |"
    digits = DIGITS["peak_force_MN"]
    yield from (
        "",
        "Peak force (MN):",
        "",
        "| case | published | band of chance alone | constants in doubt too |",
        "|---|---|---|---|",
    )
    for plain, result in zip(validation.cases, validation.doubtful, strict=True):
        a, b = (r.spreads["peak_force_MN"] for r in (plain, result))
        yield (
            f"| {plain.case.title} | {shown(a.published, digits)} | {band(a, digits)} "
            f"| {band(b, digits)} |"
        )


def _impact_section(validation: Validation) -> Iterator[str]:
    yield from ("", "## Tank car impact tests", "")
    yield from textwrap.wrap(
        f"The collision law was set by tests in which a car of {STRIKING / 1e3:g} t ran into "
        f"standing cars of {STANDING / 1e3:g} t, and then made stiffer. "
        f"{words(validation.impacts)}",
        99,
    )
    yield from ("", "| speed (km/h) | peak force (MN) | duration (s) | parting speed (m/s) |")
    yield "|---|---|---|---|"
    for i in validation.impacts:
        yield (
            f"| {i.speed_kmh:g} | {i.peak_force_N / 1e6:.2f} | {i.duration_s:.3f} "
            f"| {i.parting_speed_mps:.2f} |"
        )


def band(s: Spread, digits: int) -> str:
    """The 90 % band in words."""
    return "-" if s.low is None else f"{shown(s.low, digits)} to {shown(s.high, digits)}"


ARGUED = (
    'The paragraph "Goals of the validation: why one is missed" of '
    "[decisions.md](decisions.md#engine) argues why."
)


def pairs_words(results: Sequence[CaseResult]) -> str:
    """In how many cases the ensemble has the published pair of the largest force."""
    known = [(r, r.case.published["peak_force_pair"]) for r in results
             if r.case.published.get("peak_force_pair")]  # fmt: skip
    found = [r.case.title for r, pair in known if "-".join(map(str, pair)) in r.pairs]
    if not known:
        return "No pair of cars with the largest force is published."
    text = (
        "The published pair of cars with the largest force is among those of the ensemble in "
        f"{len(found)} of {len(known)} cases"
    )
    if found:
        return f"{text} ({'; '.join(found)})."
    return f"{text}: which cars strike hardest is not reproduced."


def markdown(validation: Validation, images: str | None = None) -> str:
    """The page ``docs/validation.md``; ``images``: the folder of its figures as it writes it."""
    intro = (
        "The model restates that of E. E. Toma, *A Computer Model of a Derailment*, PhD thesis, "
        "Queen's University, 1998. Its published results are single runs, and outcomes are "
        "chaotic: once cars collide, a small change of the force that starts the motion grows "
        "until another car is struck, or one more derails. So each published run is compared "
        f"with an ensemble of {validation.members} runs, the lateral force varied uniformly by "
        f"up to {100 * VARIATION:g} % (seed {validation.seed}; the first member is the case "
        "itself). The band is that of the 5 % and 95 % quantiles; sd is the standard deviation "
        "of single runs. Runs that are void (the body that stands for the cars behind reached "
        "the break) are left out."
    )
    lines = [
        "# Validation: comparison with the published runs",
        "",
        "Written by `derail validate --write`; do not edit.",
        "",
        *textwrap.wrap(intro, 99),
        "",
        "## Goals",
        "",
        "The last column is what the scatter of single runs alone would give if the published run",
        "were one more draw from the ensemble.",
        "",
        "| measure | cases | goal | reached | | scatter of single runs |",
        "|---|---|---|---|---|---|",
    ]
    for g in validation.goals:
        sign = "at least" if g.at_least else "at most"
        lines.append(
            f"| {g.text} | {g.cases} | {sign} {g.limit:g} | {shown(g.value, 2)} | "
            f"{'met' if g.met else '**missed**'} | {shown(g.scatter, 2)} |"
        )
    missed = [g.text for g in validation.goals if not g.met]
    if missed:
        lines += ["", *textwrap.wrap(f"Missed: {'; '.join(missed)}. {ARGUED}", 99)]
    lines += ["", *textwrap.wrap(pairs_words(validation.cases), 99)]
    if images is not None:
        file, _, text = FIGURES[0]
        lines += ["", f"![{text}]({images}/{file})"]
    for name, _, label, _ in MEASURES:
        rows = [
            (r, r.spreads[name])
            for r in (*validation.cases, *validation.beside)
            if r.spreads[name].published is not None
        ]
        if not rows:
            continue
        digits = DIGITS[name]
        lines += [
            "",
            f"## {label[0].upper()}{label[1:]}",
            "",
            "| case | published | mean | sd | 90 % band | |",
            "|---|---|---|---|---|---|",
        ]
        for result, s in rows:
            lines.append(
                f"| {result.case.title} | {shown(s.published, digits)} | {shown(s.mean, digits)} "
                f"| {shown(s.sd, digits)} | {band(s, digits)} | {verdict(s, digits)} |"
            )
    if validation.doubtful:
        lines += _doubt_section(validation)
    lines += _impact_section(validation)
    lines += [
        "",
        "## Pairs of the largest force",
        "",
        "Striking and struck car, and how often among the runs.",
        "",
        "| case | published | ensemble | void | failed |",
        "|---|---|---|---|---|",
    ]
    for result in (*validation.cases, *validation.beside):
        pair = result.case.published.get("peak_force_pair")
        pairs = ", ".join(f"{p} ({n})" for p, n in list(result.pairs.items())[:4])
        lines.append(
            f"| {result.case.title} | {'-'.join(map(str, pair)) if pair else '-'} | {pairs} | "
            f"{result.void} | {result.failed} |"
        )
    if images is not None:
        lines += ["", "## Mississauga in detail"]
        for file, heading, text in FIGURES[1:]:
            lines += ["", f"### {heading}", "", f"![{text}]({images}/{file})"]
    lines += [
        "",
        "## What is compared",
        "",
        "| case | scenario | changed | published as |",
        "|---|---|---|---|",
    ]
    for result in (*validation.cases, *validation.beside):
        c = result.case
        changed = ", ".join(f"`{k}={v}`" for k, v in c.overrides.items())
        lines.append(f"| {c.title} | `{c.scenario}` | {changed} | {c.source} |")
    lines += [
        "",
        "The case with all 74 cars modelled is shown beside the others and counts in no goal: the",
        "published count of 24 equals the number of cars that were free to derail in that run.",
        "",
    ]
    return "\n".join(lines)
