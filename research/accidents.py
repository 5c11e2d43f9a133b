"""``docs/accidents.md``, its figures, and the averages of reports that come with the package."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from derail_ros.baselines.reenact import (
    Counts,
    MeanCount,
    Way,
    agreement_table,
    averages,
    averages_table,
    failed_runs,
    reenact,
    sample,
)
from derail_ros.commands.common import CommandFailure, counting_runs, note
from derail_ros.review.drawing import BLUE, FAINT, GREEN, INK, dress, place, sheet, styled
from derail_ros.studies import accidents as data
from derail_ros.studies.accidents import (
    CLASSES_TEXT,
    GROUPS,
    SOURCE,
    AccidentFileError,
    Group,
    Report,
    Statistics,
    by_speed,
    read_reports,
)
from derail_ros.studies.drawing import ORANGE, with_bars
from derail_ros.studies.ensemble import Progress
from derail_ros.studies.tables import Table
from derail_ros.vocabulary.words import count
from research.pages import Options, fill, with_places

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LATE = (5.0, 10.0, 30.0)
"""Delays of the brakes, s. With the last two the thesis' model reached statistics of accidents:
10 s at 48 km/h, 30 s at 24 km/h."""

PARTED = {"brakes.signal_source": "none", "brakes.vent_on_parting": True}
"""Brakes that begin where a coupling parts, not with the derailment."""

WAYS: tuple[Way, ...] = (
    Way("`planar`", "planar", {}),
    *(Way(f"`planar`, brakes {s:g} s late", "planar", {"brakes.delay_s": s}) for s in LATE),
    Way("`planar`, brakes from parting", "planar", PARTED),
    Way("`yang-manos`", "yang-manos", {}),
)


@dataclass(frozen=True)
class Scope:
    """What the page shows; a smaller one is for tests."""

    group: Group = GROUPS["broken_rail_long"]  # reports whose trains are all run, in all ways
    most: int = 1000  # of its reports in a class of speed
    # reports of all causes run, of a class of speed, in the first and the last way
    every: int = 200
    ways: tuple[Way, ...] = WAYS
    matched: str = "`planar`, brakes 10 s late"  # label of the way whose single trains are drawn


@dataclass(frozen=True)
class Reenactment:
    """The trains that were run, and their counts."""

    scope: Scope
    statistics: Statistics
    reports: tuple[Report, ...]
    counts: Counts
    every: tuple[Report, ...]
    every_counts: Counts


def write(options: Options, scope: Scope | None = None) -> None:
    """Run what the page shows; write it, its figures and the shipped averages."""
    from derail_ros.models import engine_hash

    scope = scope or Scope()
    if not options.names:
        raise CommandFailure("name the files of the accident reports")
    options.images()
    text = with_places(options.page, NAMES)
    try:
        reports = read_reports([Path(name) for name in options.names])
        with counting_runs("accidents") as progress:
            found = compute(reports, scope, options.seed, jobs=options.jobs, progress=progress)
    except (AccidentFileError, ValueError) as error:
        raise CommandFailure(f"{', '.join(options.names)}: {error}") from None
    first, last = found.statistics.years
    outside = len(reports) - sum(c.reports for c in found.statistics.groups["all"])
    about = (
        f"<sub>`python -m research accidents FILES` with {count(len(options.names), 'file')} of "
        f"{first} to {last}: {len(reports)} freight trains derailed on main track, {outside} of "
        f"them at speeds outside {CLASSES_TEXT}, which are in no table. One run a train and "
        f"model, no ensemble; of all causes at most {scope.every} trains of a class of speed, "
        f"drawn with seed {options.seed}. Mean ± its standard error. Engine "
        f"{engine_hash()[:16]}.</sub>"
    )
    options.write(fill(text, blocks(found, about)), figures(found))
    shipped = Path(data.__file__).parent / "data" / data.SHIPPED
    shipped.write_text(statistics_yaml(found.statistics), encoding="utf-8")
    note(f"research: wrote {shipped}")
    failed = failed_runs(found.counts) + failed_runs(found.every_counts)
    if failed:
        note(f"research: {count(failed, 'run')} failed")


def statistics_of(reports: Sequence[Report]) -> Statistics:
    """Averages of the shipped groups.

    Raises
    ------
    ValueError
        There is no report.
    """
    if not reports:
        raise ValueError("there is no freight train derailed on a main track among the reports")
    years = [r.year for r in reports]
    groups = {
        name: tuple(by_speed(r for r in reports if r in group)) for name, group in GROUPS.items()
    }
    return Statistics(SOURCE, (min(years), max(years)), groups)


def statistics_yaml(statistics: Statistics) -> str:
    """The file of the shipped statistics."""
    import yaml

    def rounded(value: Any) -> Any:
        if isinstance(value, float):
            return round(value, 3)
        if isinstance(value, dict):
            return {k: rounded(v) for k, v in value.items()}
        return [rounded(v) for v in value] if isinstance(value, list) else value

    head = (
        "# Averages of accident reports, written by `python -m research accidents FILES`.\n"
        "# Freight cars derailed of freight trains derailed on main track, by classes of speed.\n"
    )
    values = rounded(statistics.as_dict())
    return head + yaml.safe_dump(values, sort_keys=False, default_flow_style=None, width=120)


def compute(
    reports: Sequence[Report],
    scope: Scope,
    seed: int = 0,
    *,
    jobs: int | None = None,
    progress: Progress | None = None,
) -> Reenactment:
    """Run all that the page shows.

    Raises
    ------
    ValueError
        There is no report of the group.
    """
    statistics = statistics_of(reports)
    mine = sample((r for r in reports if r in scope.group), scope.most, seed)
    if not mine:
        raise ValueError(f"there is no report with a mass of: {scope.group.words}")
    every = sample(reports, scope.every, seed)
    ends = (scope.ways[0], scope.ways[-1])
    first, total = len(mine) * len(scope.ways), len(every) * len(ends)

    def shown(before: int) -> Progress:
        return lambda done, _: progress and progress(before + done, first + total)

    counts = reenact(mine, scope.ways, jobs=jobs, progress=shown(0))
    every_counts = reenact(every, ends, jobs=jobs, progress=shown(first))
    return Reenactment(scope, statistics, tuple(mine), counts, tuple(every), every_counts)


# Tables ---------------------------------------------------------------------------------------


def statistics_table(statistics: Statistics) -> Table:
    """Cars derailed in the reports of each group over the speed."""
    groups = statistics.groups
    limits = sorted({(c.low_kmh, c.high_kmh) for classes in groups.values() for c in classes})
    rows = []
    for name, classes in groups.items():
        known = {c.low_kmh: f"{MeanCount(c.mean, c.error)} ({c.reports})" for c in classes}
        rows.append([GROUPS[name].words, *(known.get(low, "-") for low, _ in limits)])
    every = {c.low_kmh: c for c in groups["all"]}
    at = [every[low] for low, _ in limits]
    masses = ["-" if c.mass_kg is None else f"{c.mass_kg / 1e3:.0f}" for c in at]
    rows += [
        ["all causes: median, 90 % quantile", *(f"{c.median:g}, {c.q90:g}" for c in at)],
        ["all causes: cars behind, t a car",
         *(f"{c.behind:.0f}, {m}" for c, m in zip(at, masses, strict=True))],
    ]  # fmt: skip
    heads = ["cars derailed, mean (reports)", *(f"{a:.0f} to {b:.0f} km/h" for a, b in limits)]
    return Table(heads, rows)


def reenacted(reports: Sequence[Report], counts: Counts) -> str:
    """Counts over the classes of speed, and how many runs failed."""
    failed = {label: sum(v is None for v in values) for label, values in counts.items()}
    words = [f"{label}: {count(n, 'run')} failed" for label, n in failed.items() if n]
    text = averages_table(reports, counts).markdown()
    return f"{text}\n\n{'; '.join(words)}." if words else text


MASSES = (("below 50 t a car", 0.0, 50e3), ("50 to 90 t", 50e3, 90e3), ("above 90 t", 90e3, 1e9))


def mass_table(reports: Sequence[Report], counts: Counts, labels: Sequence[str]) -> Table:
    """Counts of light, middling and heavy trains."""
    columns = []
    for _, low, high in MASSES:
        own = [k for k, r in enumerate(reports) if r.mass_kg and low < r.mass_kg <= high]
        if not own:
            columns.append(["-"] * (3 + len(labels)))
            continue
        values = [[reports[k].derailed for k in own]]
        values += [[counts[label][k] for k in own] for label in labels]  # type: ignore[misc]
        speed = f"{np.mean([reports[k].speed_kmh for k in own]):.0f}"
        columns.append([str(len(own)), speed, *(str(MeanCount.of(v)) for v in values)])
    names = ["trains", "speed, mean (km/h)", "*reported*", *labels]
    rows = [[name, *cells] for name, cells in zip(names, zip(*columns, strict=True), strict=True)]
    return Table(["cars derailed, mean", *(name for name, *_ in MASSES)], rows)


NAMES = ("about", "statistics", "broken_rail", "agreement", "mass", "all_causes")
"""Results of the page."""


def blocks(found: Reenactment, about: str) -> dict[str, str | Table]:
    """All results of the page by their names."""
    labels = [found.scope.ways[0].label, found.scope.matched]
    return {
        "about": about,
        "statistics": statistics_table(found.statistics),
        "broken_rail": reenacted(found.reports, found.counts),
        "agreement": agreement_table(found.reports, found.counts),
        "mass": mass_table(found.reports, found.counts, labels),
        "all_causes": reenacted(found.every, found.every_counts),
    }


# Figures --------------------------------------------------------------------------------------


def figures(found: Reenactment) -> dict[str, Figure]:
    """The page's figures by the names of their files."""
    return {"accidents_speed.png": _over_speed(found), "accidents_trains.png": _trains(found)}


@styled
def _over_speed(found: Reenactment) -> Figure:
    page = sheet(11.0, 4.6)
    sides = (
        ("Broken rail, 50 or more cars behind", found.reports, found.counts),
        ("All causes", found.every, found.every_counts),
    )
    for k, (title, reports, counts) in enumerate(sides):
        axes = place(page, 0.66 + 5.5 * k, 0.55, 4.62, 3.5)
        rows = averages(reports, counts)
        speed = [s for _, s, _, _ in rows]
        for label in counts:
            colour, line = _look(label)
            axes.plot(speed, [c[label].mean for *_, c in rows], color=colour, ls=line, lw=1.6,
                      label=label.replace("`", ""), zorder=2)  # fmt: skip
        own = [o for _, _, o, _ in rows]
        with_bars(axes, speed, [o.mean for o in own], [2.0 * o.error for o in own], color=INK,
                  ls="", marker="o", ms=6, capsize=3, lw=1.4, zorder=4,
                  label="reported, ± 2 standard errors")  # fmt: skip
        for n, s, o, _ in rows:
            if n < 10:
                axes.annotate(count(n, "report"), (s, o.mean + 2.0 * o.error), (0, 4),
                              textcoords="offset points", ha="center", size=7.5)  # fmt: skip
        dress(axes)
        axes.set_title(title, loc="left", size=11, weight="bold")
        axes.set_xlabel("speed, km/h")
        axes.set_ylabel("cars derailed, mean")
        axes.set_ylim(bottom=0.0)
        axes.set_xlim(left=0.0)
        axes.legend(loc="upper left", frameon=False, fontsize=8)
    return page


def _look(label: str) -> tuple[str, Any]:
    """Colour and line of a way."""
    if "yang" in label:
        return ORANGE, "-"
    if "parting" in label:
        return GREEN, (0, (6, 2, 1, 2))
    late: dict[str, Any] = {" 5 s": (0, (7, 1.5)), " 10 s": (0, (4, 2)), " 30 s": (0, (1, 2))}
    line = next((style for text, style in late.items() if f"{text} late" in label), "-")
    return BLUE, line


@styled
def _trains(found: Reenactment) -> Figure:
    page = sheet(11.0, 4.9)
    labels = (found.scope.ways[0].label, found.scope.matched)
    most = max(max(v or 0.0 for v in found.counts[label]) for label in labels)
    top = 1.05 * max(most, *(r.derailed for r in found.reports))
    rng = np.random.default_rng(0)  # whole numbers lie on each other
    for k, label in enumerate(labels):
        axes = place(page, 0.66 + 4.95 * k, 0.59, 4.07, 3.72)
        known = [(r, v) for r, v in zip(found.reports, found.counts[label], strict=True)
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
        axes.spines[["top", "right"]].set_visible(False)
    bar = place(page, 10.34, 0.59, 0.13, 3.72)
    page.colorbar(marks, cax=bar)
    bar.set_title("km/h", size=8.5, loc="left")
    return page
