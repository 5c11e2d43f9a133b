"""Models put to work on the trains of accident reports, and ``docs/accidents.md``.

A report gives speed, cars, their weight and the place of the first one involved. The train that
is run begins with that car: as many equal cars as followed it, of the reported mean mass, at the
reported speed, the rail broken under the first. What a report does not give (lengths, couplers,
brakes, the start) is that of the base train. No constant is fitted to the reports.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from derail_ros.baselines.models import run_model
from derail_ros.studies.accidents import (
    GROUPS,
    SOURCE,
    Group,
    Report,
    SpeedClass,
    Statistics,
    error_of_mean,
    in_classes,
    statistics_of,
)
from derail_ros.studies.ensemble import Run, Stopped, run_many
from derail_ros.vocabulary.words import count

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from derail_ros.scenario import Scenario
    from derail_ros.vocabulary.params import TrainParams


@dataclass(frozen=True)
class Way:
    """A model and the changes to the base train with which it runs."""

    label: str
    model: str
    settings: Mapping[str, Any]


LATE = (5.0, 10.0, 30.0)
"""Delays of the brakes, s. With the last two the thesis' model reached statistics of accidents:
10 s at 48 km/h, 30 s at 24 km/h."""

PARTED = {"brakes.signal_source": "none", "brakes.vent_on_parting": True}
"""Brakes that begin where a coupling parts, not with the derailment."""

WAYS: tuple[Way, ...] = (
    Way("`toma`", "toma", {}),
    *(Way(f"`toma`, brakes {s:g} s late", "toma", {"brakes.delay_s": s}) for s in LATE),
    Way("`toma`, brakes from parting", "toma", PARTED),
    Way("`yang-manos`", "yang-manos", {}),
)


GIVEN = ("train.speed_kmh", "train.consist.0.count", "train.consist.0.mass_kg")
"""What a report says of its train, as paths of the base train."""


def scenario_of(base: Scenario, report: Report) -> Scenario:
    """The train of a report from its first car involved on, as a scenario.

    Parameters
    ----------
    base : a train of equal cars: gives the car, its brake, the ground and the start
    report : gives the speed, the number of cars (``behind``) and their mass; the yaw inertia is
        in proportion to the mass

    Raises
    ------
    ValueError
        The report has no mass.
    """
    if report.mass_kg is None:
        raise ValueError(f"{report.railroad} {report.number}: has no mass of a car")
    values = (report.speed_kmh, report.behind, report.mass_kg)
    return base.with_overrides(dict(zip(GIVEN, values, strict=True)))


def train_of(base: Scenario, report: Report) -> TrainParams:
    """Parameters of :func:`scenario_of`."""
    return scenario_of(base, report).to_params()


def told_scenario(base: Scenario, report: Report) -> Scenario:
    """:func:`scenario_of` with the report in its title and description."""
    return scenario_of(base, report).with_overrides(
        {
            "title": f"{report.railroad} {report.number}, {report.year}: "
            f"{report.cars} cars at {report.speed_kmh:.0f} km/h",
            "description": (
                f"The train of an accident report (FRA form 54), cause "
                f"{report.cause or 'not given'}: {report.cars} freight cars, {report.loaded} of "
                f"them loaded, car {report.first} the first one involved; "
                f"{count(report.derailed, 'car')} derailed. The train here begins with that car. "
                "Lengths, couplers, brakes and the start are not reported: those of base_train."
            ),
            "source": SOURCE,
        }
    )


def mean_report(one: SpeedClass) -> Report:
    """The mean train of a class of speed, as a report; its cars derailed rounded."""
    cars = round(one.behind)
    return Report(
        "", "mean", 0, one.speed_kmh, cars, cars, max(round(one.mean), 1), 1, one.mass_kg, ""
    )


def sample(reports: Iterable[Report], most: int, seed: int = 0) -> list[Report]:
    """Reports with a mass, at most ``most`` of each class of speed, drawn without regard."""
    rng = np.random.default_rng(seed)
    found: list[Report] = []
    for _, _, chosen in in_classes(r for r in reports if r.mass_kg is not None):
        if len(chosen) > most:
            chosen = [chosen[i] for i in sorted(rng.permutation(len(chosen))[:most])]
        found += chosen
    return found


Counts = dict[str, list[float | None]]
"""Label of a way -> cars derailed of the train of each report; None where the run failed."""


def reenact(
    reports: Sequence[Report],
    ways: Sequence[Way] = WAYS[:1],
    *,
    jobs: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Counts:
    """Run the train of each report once in each way; reports must have a mass."""
    from derail_ros.scenario import load_scenario

    base = load_scenario("base_train")
    bases = [base.with_overrides(way.settings) for way in ways]

    def runs() -> Iterator[Run]:
        for k, report in enumerate(reports):
            for w in range(len(ways)):
                yield Run(train_of(bases[w], report), key=(k, w))

    def task(run: Run, stop: Callable[[], bool]) -> float:
        def look(_t: float, _derailed: int) -> None:
            if stop():
                raise Stopped

        done = run_model(ways[run.key[1]].model, run.params(), progress=look)
        return float(done.record["cars_derailed"])

    counts: Counts = {way.label: [None] * len(reports) for way in ways}
    total = len(reports) * len(ways)
    with closing(run_many(runs(), jobs=jobs, task=task)) as stream:
        for done, result in enumerate(stream, 1):
            k, w = result.run.key
            counts[ways[w].label][k] = result.value
            if progress is not None:
                progress(done, total)
    return counts


@dataclass(frozen=True)
class Cell:
    """A way in a class of speed: mean count, its standard error, failed runs."""

    mean: float
    error: float
    failed: int


def averages(
    reports: Sequence[Report], counts: Counts
) -> list[tuple[float, float, Cell, dict[str, Cell]]]:
    """For each class of speed: reports, mean speed (km/h), reported cars, those of each way."""
    place = {id(r): k for k, r in enumerate(reports)}
    rows = []
    for _, _, chosen in in_classes(reports):
        own = [r.derailed for r in chosen]
        cells = {}
        for label, values in counts.items():
            good = [v for r in chosen if (v := values[place[id(r)]]) is not None]
            cells[label] = Cell(
                float(np.mean(good)) if good else float("nan"),
                error_of_mean(good), len(chosen) - len(good),
            )  # fmt: skip
        speed = float(np.mean([r.speed_kmh for r in chosen]))
        rows.append((len(chosen), speed, Cell(float(np.mean(own)), error_of_mean(own), 0), cells))
    return rows


# Page -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Plan:
    """What the page shows; a smaller one is for tests.

    Attributes
    ----------
    group : reports whose trains are all run, in all ways
    most : of its reports in a class of speed
    every : reports of all causes run, of a class of speed, in the first and the last way
    ways : in which the trains are run
    matched : label of the way whose single trains are drawn
    """

    group: Group = GROUPS["broken_rail_long"]
    most: int = 1000
    every: int = 200
    ways: tuple[Way, ...] = WAYS
    matched: str = "`toma`, brakes 10 s late"


@dataclass(frozen=True)
class Results:
    """What came of a plan."""

    plan: Plan
    statistics: Statistics
    reports: tuple[Report, ...]
    counts: Counts
    every: tuple[Report, ...]
    every_counts: Counts


def compute(
    reports: Sequence[Report],
    plan: Plan,
    seed: int = 0,
    *,
    jobs: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Results:
    """Run all that the page shows.

    Raises
    ------
    ValueError
        There is no report of the plan's group.
    """
    statistics = statistics_of(reports)
    mine = sample((r for r in reports if r in plan.group), plan.most, seed)
    if not mine:
        raise ValueError(f"there is no report with a mass of: {plan.group.words}")
    every = sample(reports, plan.every, seed)
    ends = (plan.ways[0], plan.ways[-1])
    total = len(mine) * len(plan.ways) + len(every) * len(ends)
    before = 0

    def show(done: int, _total: int) -> None:
        if progress is not None:
            progress(before + done, total)

    counts = reenact(mine, plan.ways, jobs=jobs, progress=show)
    before = len(mine) * len(plan.ways)
    every_counts = reenact(every, ends, jobs=jobs, progress=show)
    return Results(plan, statistics, tuple(mine), counts, tuple(every), every_counts)


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    return "\n".join([_row(heads), "|---|" + "---:|" * (len(heads) - 1), *map(_row, rows)])


def with_error(mean: float, error: float) -> str:
    """A mean and its standard error; the mean alone where there is none, a dash without both."""
    if math.isnan(mean):
        return "-"
    return f"{mean:.1f} ± {error:.1f}" if error else f"{mean:.1f}"


def statistics_table(statistics: Statistics) -> str:
    """Cars derailed in the reports of each group over the speed."""
    groups = statistics.groups
    limits = sorted({(c.low_kmh, c.high_kmh) for classes in groups.values() for c in classes})
    heads = ["cars derailed, mean (reports)", *(f"{a:.0f} to {b:.0f} km/h" for a, b in limits)]
    rows = []
    for name, classes in groups.items():
        known = {c.low_kmh: c for c in classes}
        cells = []
        for low, _ in limits:
            c = known.get(low)
            cells.append("-" if c is None else f"{with_error(c.mean, c.error)} ({c.reports})")
        rows.append([GROUPS[name].words, *cells])
    every = {c.low_kmh: c for c in groups["all"]}
    rows.append(
        ["all causes: median, 90 % quantile",
         *(f"{every[low].median:g}, {every[low].q90:g}" for low, _ in limits)]
    )  # fmt: skip
    rows.append(
        ["all causes: cars behind, t a car",
         *(f"{every[low].behind:.0f}, {or_dash((every[low].mass_kg or math.nan) / 1e3, '.0f')}"
           for low, _ in limits)]
    )  # fmt: skip
    return _table(heads, rows)


def reenacted_table(reports: Sequence[Report], counts: Counts) -> str:
    """Reported cars and those of the models, over the classes of speed."""
    rows = averages(reports, counts)
    heads = ["cars derailed, mean", *(f"{speed:.0f} km/h" for _, speed, _, _ in rows)]
    lines = [
        ["trains", *(str(n) for n, *_ in rows)],
        ["*reported*", *(with_error(own.mean, own.error) for _, _, own, _ in rows)],
    ]
    lines += [
        [label, *(with_error(cells[label].mean, cells[label].error) for *_, cells in rows)]
        for label in counts
    ]
    failed = {label: sum(v is None for v in values) for label, values in counts.items()}
    words = [f"{label}: {count(n, 'run')} failed" for label, n in failed.items() if n]
    return _table(heads, lines) + ("\n\n" + "; ".join(words) + "." if words else "")


def rank_correlation(reports: Sequence[Report], values: Sequence[float]) -> float:
    """Spearman's of values with the reported counts.

    NaN where there is none: of fewer than two reports, and where all are equal.
    """
    from scipy.stats import spearmanr

    own = [r.derailed for r in reports]
    if len(set(own)) < 2 or len(set(values)) < 2:
        return math.nan
    return float(spearmanr(own, values).statistic)


@dataclass(frozen=True)
class Agreement:
    """How counts of single trains go with the reported ones; NaN where nothing can be said.

    Attributes
    ----------
    trains : number of those that have a count
    ratio : of the means, counted over reported
    rms : root mean square of the differences, cars
    rank : Spearman's correlation
    within : share of trains within a factor of two
    """

    trains: int
    ratio: float
    rms: float
    rank: float
    within: float


def agreement(reports: Sequence[Report], values: Sequence[float | None]) -> Agreement:
    """How a way's counts of single trains go with the reported ones."""
    pairs = [(r, v) for r, v in zip(reports, values, strict=True) if v is not None]
    if not pairs:
        return Agreement(0, math.nan, math.nan, math.nan, math.nan)
    trains, theirs = [r for r, _ in pairs], [v for _, v in pairs]
    inside = [v <= 2.0 * r.derailed and r.derailed <= 2.0 * v for r, v in pairs]
    squares = [(v - r.derailed) ** 2 for r, v in pairs]
    return Agreement(
        len(pairs),
        sum(theirs) / sum(r.derailed for r in trains),
        math.sqrt(sum(squares) / len(squares)),
        rank_correlation(trains, theirs),
        sum(inside) / len(inside),
    )


def means_of_classes(reports: Sequence[Report]) -> list[float | None]:
    """For each report the mean reported count of its class of speed; None outside of all.

    The best that can be said of a train from its class alone: what a model has to surpass.
    """
    means = {
        id(r): float(np.mean([other.derailed for other in chosen]))
        for *_, chosen in in_classes(reports)
        for r in chosen
    }
    return [means.get(id(r)) for r in reports]


AGREEMENT = ("", "of reported cars", "rms difference, cars", "rank correlation",
             "within a factor of two")  # fmt: skip
"""What is told of each way, see :class:`Agreement`."""


def agreement_rows(reports: Sequence[Report], counts: Counts) -> list[list[str]]:
    """:func:`agreement` of each way, and what the speed tells without a model."""
    ways = {**counts, "reported, mean of the class": means_of_classes(reports)}
    found = {label: agreement(reports, values) for label, values in ways.items()}
    rows = [
        [label, or_dash(a.ratio, ".2f"), or_dash(a.rms, ".1f"), or_dash(a.rank, ".2f"),
         or_dash(a.within, ".0%")]
        for label, a in found.items()
    ]  # fmt: skip
    alone = rank_correlation(reports, [r.speed_kmh for r in reports])
    return [*rows, ["the speed alone", "-", "-", or_dash(alone, ".2f"), "-"]]


def or_dash(value: float, form: str) -> str:
    """A number, or a dash in the place of NaN."""
    return "-" if math.isnan(value) else format(value, form).replace("%", " %")


def mass_table(reports: Sequence[Report], counts: Counts, labels: Sequence[str]) -> str:
    """Counts of light, middling and heavy trains."""
    classes = (
        ("below 50 t a car", 0.0, 50e3),
        ("50 to 90 t", 50e3, 90e3),
        ("above 90 t", 90e3, 1e9),
    )
    heads = ["cars derailed, mean", *(name for name, *_ in classes)]
    rows: list[list[str]] = [["trains"], ["speed, mean (km/h)"], ["*reported*"]]
    rows += [[label] for label in labels]
    for _, low, high in classes:
        own = [k for k, r in enumerate(reports) if r.mass_kg and low < r.mass_kg <= high]
        if not own:
            for row in rows:
                row.append("-")
            continue
        rows[0].append(str(len(own)))
        rows[1].append(f"{np.mean([reports[k].speed_kmh for k in own]):.0f}")
        derailed = [reports[k].derailed for k in own]
        rows[2].append(with_error(float(np.mean(derailed)), error_of_mean(derailed)))
        for row, label in zip(rows[3:], labels, strict=True):
            good = [v for k in own if (v := counts[label][k]) is not None]
            row.append(with_error(float(np.mean(good)), error_of_mean(good)) if good else "-")
    return _table(heads, rows)


NAMES = ("about", "statistics", "broken_rail", "agreement", "mass", "all_causes")
"""Results of the page."""


def blocks(results: Results, about: str) -> dict[str, str]:
    """All results of the page by their names."""
    plan = results.plan
    return {
        "about": about,
        "statistics": statistics_table(results.statistics),
        "broken_rail": reenacted_table(results.reports, results.counts),
        "agreement": _table(AGREEMENT, agreement_rows(results.reports, results.counts)),
        "mass": mass_table(results.reports, results.counts, [plan.ways[0].label, plan.matched]),
        "all_causes": reenacted_table(results.every, results.every_counts),
    }


# Figures --------------------------------------------------------------------------------------


def figures(results: Results) -> dict[str, Figure]:
    """The page's figures by the names of their files."""
    import matplotlib

    from derail_ros.review.drawing import STYLE

    with matplotlib.rc_context(STYLE):
        return {
            "accidents_speed.png": _over_speed(results),
            "accidents_trains.png": _trains(results),
        }


def _over_speed(results: Results) -> Figure:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from derail_ros.review.drawing import INK

    page = Figure(figsize=(11.0, 4.6), facecolor="white")
    FigureCanvasAgg(page)
    sides = (
        ("Broken rail, 50 or more cars behind", results.reports, results.counts,
         [w.label for w in results.plan.ways]),
        ("All causes", results.every, results.every_counts, list(results.every_counts)),
    )  # fmt: skip
    for k, (title, reports, counts, labels) in enumerate(sides):
        axes = page.add_axes((0.06 + 0.5 * k, 0.12, 0.42, 0.76))
        rows = averages(reports, counts)
        speed = [s for _, s, _, _ in rows]
        for label in labels:
            colour, line = _look(label)
            axes.plot(speed, [c[label].mean for *_, c in rows], color=colour, ls=line, lw=1.6,
                      label=label.replace("`", ""), zorder=2)  # fmt: skip
        axes.errorbar(
            speed, [own.mean for _, _, own, _ in rows],
            [2.0 * own.error for _, _, own, _ in rows], color=INK, ls="", marker="o", ms=6,
            capsize=3, lw=1.4, label="reported, ± 2 standard errors", zorder=4,
        )  # fmt: skip
        for n, s, own, _ in rows:
            if n < 10:
                axes.annotate(count(n, "report"), (s, own.mean + 2.0 * own.error), (0, 4),
                              textcoords="offset points", ha="center", size=7.5)  # fmt: skip
        axes.set_title(title, loc="left", size=11, weight="bold")
        axes.set_xlabel("speed, km/h")
        axes.set_ylabel("cars derailed, mean")
        axes.set_ylim(bottom=0.0)
        axes.set_xlim(left=0.0)
        axes.grid(color="#ececec", lw=0.8)
        axes.set_axisbelow(True)
        axes.legend(loc="upper left", frameon=False, fontsize=8)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
    return page


def _look(label: str) -> tuple[str, Any]:
    """Colour and line of a way."""
    if "yang" in label:
        return "#e69f00", "-"
    if "parting" in label:
        return "#009e73", (0, (6, 2, 1, 2))
    late: dict[str, Any] = {
        " 5 s": (0, (7, 1.5)), " 10 s": (0, (4, 2)), " 30 s": (0, (1, 2))
    }  # fmt: skip
    line = next((style for text, style in late.items() if f"{text} late" in label), "-")
    return "#0072b2", line


def _trains(results: Results) -> Figure:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from derail_ros.review.drawing import FAINT, INK

    page = Figure(figsize=(11.0, 4.9), facecolor="white")
    FigureCanvasAgg(page)
    labels = (results.plan.ways[0].label, results.plan.matched)
    top = 1.05 * max(
        max(r.derailed for r in results.reports),
        max((v or 0.0) for label in labels for v in results.counts[label]),
    )
    rng = np.random.default_rng(0)  # whole numbers lie on each other
    marks = None
    for k, label in enumerate(labels):
        axes = page.add_axes((0.06 + 0.45 * k, 0.12, 0.37, 0.76))
        known = [(r, v) for r, v in zip(results.reports, results.counts[label], strict=True)
                 if v is not None]  # fmt: skip
        x = np.array([v for _, v in known]) + rng.uniform(-0.35, 0.35, len(known))
        y = np.array([r.derailed for r, _ in known]) + rng.uniform(-0.35, 0.35, len(known))
        marks = axes.scatter(x, y, c=[r.speed_kmh for r, _ in known], cmap="viridis", s=16,
                             alpha=0.8, lw=0, vmin=0.0, vmax=115.0)  # fmt: skip
        for factor, line in ((1.0, "-"), (2.0, ":"), (0.5, ":")):
            axes.plot([0.0, top], [0.0, factor * top], color=INK if factor == 1.0 else FAINT,
                      ls=line, lw=1.0, zorder=0)  # fmt: skip
        axes.set_xlim(0.0, top)
        axes.set_ylim(0.0, top)
        axes.set_aspect("equal")
        axes.set_title(label.replace("`", ""), loc="left", size=11, weight="bold")
        axes.set_xlabel("cars derailed, model")
        axes.set_ylabel("cars derailed, reported")
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
    bar = page.add_axes((0.94, 0.12, 0.012, 0.76))
    page.colorbar(marks, cax=bar)
    bar.set_title("km/h", size=8.5, loc="left")
    return page
