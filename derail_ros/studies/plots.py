"""Figures of a study.

Series differ in marks and dashes as well as in colour; a caption says what bars and shades are.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator, PercentFormatter

from derail_ros.review.drawing import (
    BLUE,
    FAINT,
    INK,
    SUBTLE,
    VERMILION,
    dress,
    mark,
    sheet,
    styled,
)
from derail_ros.studies import statistics
from derail_ros.studies.design import LatinHypercube, OneAtATime, Sobol
from derail_ros.studies.drawing import SERIES, with_bars
from derail_ros.studies.plan import FigureSpec, shown_value
from derail_ros.studies.results import StudyResults
from derail_ros.studies.sentences import shown
from derail_ros.studies.study_measures import RELATIVE_SEVERITY, measure_of
from derail_ros.vocabulary.words import capital, count

if TYPE_CHECKING:
    import pandas as pd

WIDTH = 6.6
MOST_SERIES = 7
MOST_PANELS = 9
MOST_ROWS = 60
"""Most points in a figure that has a row for each."""
DOTS = "#8fb9d6"
SHADE = "#dcebf5"


@dataclass(frozen=True)
class Drawn:
    """A figure with its words."""

    name: str  # of its file
    title: str  # heading
    caption: str  # what is drawn and how
    alt: str  # for a reader who cannot see it
    figure: Figure


@styled
def draw(results: StudyResults) -> list[Drawn]:
    """All figures of a study."""
    design = results.design
    found: list[Drawn | None] = []
    if isinstance(design, OneAtATime):
        found += [_relative(results), _tornado(results)]
    elif isinstance(design, Sobol):
        found.append(_sobol(results))
    if isinstance(design, (LatinHypercube, Sobol)):
        found += [_scatter(results, measure) for measure in results.measures[:2]]
    else:
        specs = list(results.study.model.figures) or _default_specs(results)
        found += [
            _over(results, spec, i) for i, spec in enumerate(specs) if spec.y in results.runs
        ]
        if not specs and not isinstance(design, OneAtATime):
            found.append(_rows(results))
        found.append(_counts(results))
    return [d for d in found if d is not None]


def _default_specs(results: StudyResults) -> list[FigureSpec]:
    """On a grid with numbers: over the longest of them, the others as series and panels."""
    if results.study.model.design != "grid":
        return []
    axes = sorted(results.design.axes, key=lambda a: -len(a.levels))
    over = next((a for a in axes if a.numeric and len(a.levels) > 2), None)
    if over is None or len(axes) > 3:
        return []
    rest = [a for a in reversed(axes) if a is not over]
    if any(len(a.levels) > most for a, most in zip(rest, (MOST_SERIES, MOST_PANELS))):
        return []
    series, panels = [*(a.name for a in rest), None, None][:2]
    return [
        FigureSpec(x=over.name, y=measure, series=series, panels=panels)
        for measure in results.measures[:2]
    ]


# --- panels -----------------------------------------------------------------------------------


def _figure(height: float) -> Figure:
    figure = sheet(WIDTH, height, layout="constrained")
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.set(h_pad=0.09, w_pad=0.06)  # type: ignore[call-arg]
    return figure


def _panels(
    n: int, extra: float, row: float, most: int = 2, **shared: Any
) -> tuple[Figure, list[Axes]]:
    """A figure of n panels, so many in a row at most; its height is ``extra + row * rows``."""
    columns = min(most, n)
    rows = -(-n // columns)
    figure = _figure(extra + row * rows)
    grid = figure.subplots(rows, columns, sharey=True, squeeze=False, **shared).ravel()
    for axes in grid[n:]:
        axes.set_visible(False)
    for axes in grid[:n]:
        dress(axes)
    return figure, list(grid[:n])


def _label(panels: Sequence[Axes], x: str | None, y: str | None) -> None:
    """Labels below the lowest and left of the first panels."""
    for axes in panels:
        at = axes.get_subplotspec()
        if x and at is not None and at.is_last_row():
            axes.set_xlabel(x)
        if y and at is not None and at.is_first_col():
            axes.set_ylabel(y)


def _title(axes: Axes, text: str) -> None:
    axes.set_title(text, size=10.5, weight="bold", loc="left")


def _legend(figure: Figure, handles: Sequence[Any], ncol: int = 3, **more: Any) -> None:
    look = {"loc": "outside upper left", "ncol": ncol, "frameon": False, "fontsize": 9.5}
    figure.legend(handles=handles, **look, **more)


def _series(names: Iterable[str]) -> list[Any]:
    """Entries of a legend for series."""
    return [
        mark(name, color=colour, marker=shape, ls=dash)
        for name, (colour, shape, dash) in zip(names, SERIES)
    ]


def _floats(table: pd.DataFrame, *names: str) -> list[np.ndarray]:
    return [table[name].to_numpy(dtype=float) for name in names]


def _ensemble(results: StudyResults) -> str:
    return f"{count(results.manifest['ensemble'], 'run')} a point"


# --- one at a time ----------------------------------------------------------------------------


def _relative(results: StudyResults) -> Drawn | None:
    """A panel for each parameter: all measures relative to the base, over the parameter."""
    table = statistics.summary(results).set_index(["measure", "point"])
    study = results.study
    measures = [
        m
        for m in results.measures
        if m != RELATIVE_SEVERITY.key and table.loc[m, "relative"].notna().any()
    ][:MOST_SERIES]
    lines = [line for line in statistics.lines(results) if len(line.points) > 1][:MOST_PANELS]
    if not measures or not lines:
        return None
    figure, panels = _panels(len(lines), 0.5, 2.75)
    most = 1.0
    for axes, line in zip(panels, lines, strict=True):
        name = line.column or ""
        x, labels = _places(results, line)
        axes.axhline(1.0, color=FAINT, lw=0.8, zorder=1)
        for measure, (colour, shape, dash) in zip(measures, SERIES, strict=False):
            at = table.loc[[(measure, p) for p in line.points]]
            y, low, high = _floats(at, "relative", "relative_low", "relative_high")
            known = np.isfinite(y)
            with_bars(axes, x[known], y[known], np.array([y - low, high - y])[:, known],
                      color=colour, marker=shape, ls=dash, ms=4.5, lw=1.5, capsize=2,
                      elinewidth=0.9)  # fmt: skip
            most = max(most, float(np.nanmax(np.fmax(y, high))))
        axes.set_xticks(x, labels)
        _title(axes, study.words(name))
        base = study.value(name, results.design.point(0).columns[name])
        axes.set_title(f"base: {base}", size=8.5, color=SUBTLE, loc="right")
    panels[0].set_ylim(0.0, 1.05 * most)
    _label(panels, None, "mean, base = 1")
    words = [measure_of(m).words for m in measures]
    _legend(figure, _series(words))
    return Drawn(
        "relative",
        "Outcomes relative to the base",
        f"Means relative to that of the base point, {_ensemble(results)}; bars are 95 % "
        "intervals. Below each panel the value of its parameter, all others as in the base.",
        f"Small line charts of {', '.join(words)}, relative to the base, over "
        f"{', '.join(study.words(line.column or '') for line in lines)}. The numbers are in the "
        "table of means.",
        figure,
    )


def _places(results: StudyResults, line: statistics.Line) -> tuple[np.ndarray, list[str]]:
    """Places and labels: numbers where they lie, anything else side by side."""
    if not line.numeric:
        return np.arange(float(len(line.values))), [str(v) for v in line.values]
    name = line.column or ""
    x = np.array([float(v) for v in line.values])
    base = results.design.point(0).columns[name]
    if results.study.model.parameters[name].percent is not None and base:
        shares = 100.0 * (x / float(base) - 1.0)
        return x, [f"{s:+.0f} %" if abs(s) > 0.05 else "base" for s in shares]
    return x, [shown_value(v) for v in line.values]


def _tornado(results: StudyResults) -> Drawn | None:
    """A bar for each parameter: how far it moves a measure, the largest first."""
    relative = RELATIVE_SEVERITY.key
    measure = relative if relative in results.measures else results.measures[0]
    summary, study = statistics.summary(results), results.study
    table = summary[summary["measure"] == measure].set_index("point")["relative"]
    bars = []
    for line in statistics.lines(results):
        at = [(float(table[p]), v) for v, p in zip(line.values, line.points, strict=True)]
        at = sorted(((y, v) for y, v in at if math.isfinite(y)), key=lambda a: a[0])
        if len(at) > 1:
            bars.append((line.column or "", at))
    if not bars:
        return None
    bars.sort(key=lambda bar: bar[1][-1][0] - bar[1][0][0])
    figure = _figure(0.9 + 0.48 * len(bars))
    axes = figure.subplots()
    dress(axes, "x")
    lowest, highest = min(at[0][0] for _, at in bars), max(at[-1][0] for _, at in bars)
    reach = max(highest - lowest, 0.1)
    for k, (name, at) in enumerate(bars):
        low, high = at[0][0], at[-1][0]
        axes.barh(k, high - low, left=low, height=0.55, color="#a9cfe6", ec=BLUE, lw=0.9)
        axes.plot([y for y, _ in at], [k] * len(at), ls="", marker="|", ms=9, color=INK)
        for (y, v), side, shift in ((at[0], "right", -1), (at[-1], "left", 1)):
            text = f" {study.value(name, v)} "
            axes.text(y + shift * 0.008 * reach, k, text, va="center", ha=side, size=9)
    axes.axvline(1.0, color=FAINT, lw=1.0, zorder=1)
    axes.set_yticks(range(len(bars)), [study.words(name) for name, _ in bars], size=10)
    axes.set_xlim(lowest - 0.22 * reach, highest + 0.22 * reach)
    label = "relative severity" if measure == relative else measure_of(measure).words
    axes.set_xlabel(f"mean {label}, base = 1")
    ranked = ", ".join(
        f"{study.words(n)} {at[0][0]:.2f} to {at[-1][0]:.2f}" for n, at in reversed(bars)
    )
    return Drawn(
        "ranking",
        f"Which parameter moves the {label} most",
        f"From the least to the largest mean {label} over each parameter's range; that of the "
        "base is 1 (the line). Ticks are the points; the values at both ends stand beside the "
        "bar.",
        f"Bar chart of the range of the mean {label}, base = 1: {ranked}.",
        figure,
    )


# --- a measure over a column ------------------------------------------------------------------


def _over(results: StudyResults, spec: FigureSpec, number: int) -> Drawn | None:
    summary, study, measure = statistics.summary(results), results.study, measure_of(spec.y)
    table = summary[(summary["measure"] == spec.y) & (summary["n"] > 0)]
    if not len(table):
        return None

    def groups(column: str | None, most: int) -> list[Any]:
        return [None] if column is None else list(dict.fromkeys(table[column]))[:most]

    panels, series = groups(spec.panels, MOST_PANELS), groups(spec.series, MOST_SERIES)
    figure, grid = _panels(
        len(panels),
        0.55,
        3.5 if len(panels) <= 3 else 3.0,
        sharex=True,
    )
    numbers = statistics.is_numeric(table[spec.x])
    values = list(dict.fromkeys(table[spec.x]))
    places = {v: float(v) if numbers else float(i) for i, v in enumerate(values)}
    spread = len(series) == 1
    # small shifts keep the bars of several series from covering each other
    gaps = np.diff(sorted(set(places.values())))
    step = 0.06 * float(gaps.min()) if len(gaps) else 0.0
    offset = step * (np.arange(len(series)) - 0.5 * (len(series) - 1))
    for axes, panel in zip(grid, panels, strict=True):
        part = table if panel is None else table[table[spec.panels] == panel]
        for value, shift, (colour, shape, dash) in zip(series, offset, SERIES):
            line = part if value is None else part[part[spec.series] == value]
            line = line.assign(x=[places[v] + shift for v in line[spec.x]]).sort_values("x")
            x, y, y_low, low, high = _floats(line, "x", "mean", "mean_low", "q05", "q95")
            if spread:
                axes.fill_between(x, low, high, color=SHADE, lw=0, zorder=1)
            with_bars(
                axes, x, y, y - y_low, color=colour, marker=shape, ls=dash if numbers else ""
            )
        if panel is not None:
            _title(
                axes, f"{study.words(spec.panels or '')} {study.value(spec.panels or '', panel)}"
            )
        if not numbers:
            axes.set_xticks(
                list(places.values()), [str(v) for v in places], rotation=20, ha="right"
            )
    _label(grid, study.label(spec.x), f"{measure.title}, mean")
    for axes in grid:
        axes.yaxis.set_major_formatter(lambda y, _: f"{y * measure.scale:.6g}")
    bottom, top = grid[0].get_ylim()
    if float(table["mean"].min()) >= 0.0 and bottom < 0.45 * top:
        grid[0].set_ylim(0.0, top)
    note = "bars are 95 % intervals of the mean"
    if spread:
        note += ", the shade holds 5 to 95 % of the runs"
        shade = Patch(fc=SHADE, label="5 to 95 % of the runs")
        _legend(figure, [mark("mean, 95 % interval", color=BLUE, marker="o", ls="-"), shade])
    else:
        handles = _series(study.value(spec.series or "", v) for v in series)
        title = study.words(spec.series or "")
        _legend(figure, handles, title=title, alignment="left", title_fontsize=9.5)
    also = [study.words(c) for c in (spec.series, spec.panels) if c is not None]
    ends = " to ".join(shown(spec.y, m) for m in (table["mean"].min(), table["mean"].max()))
    words = f"{capital(measure.words)} over {study.words(spec.x)}"
    return Drawn(
        f"{spec.y}_over_{spec.x}_{number}" if number else f"{spec.y}_over_{spec.x}",
        spec.title or words,
        f"{_ensemble(results)}; {note}.",
        f"Line chart of the mean {measure.title} over {study.words(spec.x)}"
        + (f", by {' and '.join(also)}" if also else "")
        + f". Means range from {ends}. The numbers are in the table of means.",
        figure,
    )


# --- a row for each point ---------------------------------------------------------------------


def _rows(results: StudyResults) -> Drawn | None:
    """A panel for each measure, a row for each point: runs, mean and interval."""
    n = len(results.design)
    if n > MOST_ROWS:
        return None
    summary, base = statistics.summary(results), results.base
    keys = results.measures[:6]
    figure, panels = _panels(len(keys), 0.85, 0.65 + 0.27 * n)
    for axes, key in zip(panels, keys, strict=True):
        m = measure_of(key)
        for point, values in results.values(key).items():
            shift = 0.34 * (((np.arange(len(values)) * 0.618) % 1.0) * 2.0 - 1.0)
            axes.plot(values * m.scale, point + shift, ls="", marker=".", ms=3.5, color=DOTS)
        known = summary[(summary["measure"] == key) & (summary["n"] > 0)].set_index("point")
        mean, low = (m.scale * x for x in _floats(known, "mean", "mean_low"))
        axes.errorbar(mean, known.index, xerr=np.nan_to_num(mean - low), ls="", marker="D",
                      ms=4.5, color=INK, elinewidth=1.4, capsize=3, zorder=3)  # fmt: skip
        if base is not None and base in known.index:
            axes.axvline(m.scale * known.loc[base, "mean"], color=VERMILION, lw=1.0, ls=":")
        axes.set_xlabel(m.title)
        axes.xaxis.set_major_locator(MaxNLocator(5, integer=m.whole))
        if axes.get_xlim()[0] > 0.0:  # no measure of a part as if it were the whole
            axes.set_xlim(left=0.0)
        axes.set_ylim(n - 0.5, -0.5)
        axes.set_yticks(range(n), list(results.labels))
    handles = [
        mark("a run", marker=".", color=DOTS),
        mark("mean, 95 % interval", marker="D", color=INK, ls="-", ms=4.5),
    ]
    if base is not None:
        handles.append(mark("mean of the base", color=VERMILION, ls=":"))
    title = results.manifest["title"].replace("$", r"\$")
    look = {"size": 13, "weight": "bold"}
    _legend(figure, handles, 3, title=title, title_fontproperties=look, alignment="left")
    first = summary[summary["measure"] == keys[0]].sort_values("mean")
    said = "; ".join(
        f"{results.labels[int(r['point'])]}: {shown(keys[0], r['mean'])}"
        for r in first.to_dict("records")
    )
    return Drawn(
        "settings",
        "The settings side by side",
        f"{_ensemble(results)}, each a dot; diamonds are means with their 95 % interval.",
        f"Dot plots of {', '.join(measure_of(k).words for k in keys)} for each setting. "
        f"Mean {measure_of(keys[0]).words}: {said}.",
        figure,
    )


def _counts(results: StudyResults) -> Drawn | None:
    """Distribution of the number of cars derailed, a row for each point."""
    n = len(results.design)
    counts = statistics.counts(results)
    if n > MOST_ROWS or not len(counts) or results.manifest["ensemble"] < 2:
        return None
    k = counts["cars_derailed"].to_numpy(dtype=int)
    first, last = int(k.min()), int(k.max())
    shares = np.zeros((n, last - first + 1))
    shares[counts["point"].to_numpy(dtype=int), k - first] = counts["share"].to_numpy(dtype=float)
    figure = _figure(1.1 + 0.24 * n)
    axes = figure.subplots()
    picture = axes.imshow(
        np.ma.masked_equal(shares, 0.0),
        aspect="auto",
        cmap=matplotlib.colormaps["Blues"],
        vmin=0.0,
        vmax=1.0,
        extent=(first - 0.5, last + 0.5, n - 0.5, -0.5),
        interpolation="nearest",
    )
    axes.set_yticks(range(n), list(results.labels))
    axes.set_yticks(np.arange(0.5, n), minor=True)
    axes.xaxis.set_major_locator(MaxNLocator(12, integer=True))
    axes.set_xlabel("cars derailed")
    axes.tick_params(length=3, color="#c8c8c8")
    axes.tick_params(which="minor", length=0)
    axes.grid(which="minor", axis="y", color="#ececec", lw=0.8)
    bar = figure.colorbar(picture, ax=axes, shrink=min(1.0, 3.5 / (0.24 * n)), aspect=18)
    bar.set_label("share of the runs")
    bar.ax.yaxis.set_major_formatter(PercentFormatter(1.0))
    return Drawn(
        "counts",
        "Distribution of the number of cars derailed",
        "Share of the runs of each point with each number; white: none.",
        "Chart of how the runs of each point spread over numbers of cars derailed, "
        f"{first} to {last}. The numbers are in the table counts.csv.",
        figure,
    )


# --- designs that draw their points -----------------------------------------------------------


def _sobol(results: StudyResults) -> Drawn | None:
    table = statistics.sobol(results)
    if not len(table):
        return None
    words = results.study.words
    table = table[table["S1"].notna()]
    measures = list(dict.fromkeys(table["measure"]))[:6]
    names = [axis.name for axis in results.design.axes]
    figure, panels = _panels(len(measures), 0.5, 0.9 + 0.42 * len(names), sharex=True)
    kinds: tuple[tuple[str, str, float, str, str], ...] = (
        ("S1", "alone (S1)", -0.18, "#a9cfe6", ""),
        ("ST", "with all others (ST)", 0.18, "#f4c9a8", "////"),
    )
    for axes, measure in zip(panels, measures, strict=True):
        axes.grid(False, axis="y")
        part = table[table["measure"] == measure].set_index("parameter").loc[names]
        for key, _, shift, fill, hatch in kinds:
            y, low = _floats(part, key, f"{key}_low")
            axes.barh(np.arange(len(names)) + shift, y, height=0.34, xerr=y - low, color=fill,
                      ec=INK, lw=0.7, hatch=hatch,
                      error_kw={"elinewidth": 1.0, "capsize": 2})  # fmt: skip
        axes.axvline(0.0, color=FAINT, lw=0.8)
        axes.set_yticks(range(len(names)), [words(name) for name in names])
        _title(axes, measure_of(measure).words)
    _label(panels, "share of the variance", None)
    panels[0].invert_yaxis()
    handles = [Patch(fc=f, ec=INK, lw=0.7, hatch=h, label=label) for _, label, _, f, h in kinds]
    _legend(figure, handles, 2)
    ranked = table[table["measure"] == measures[0]].sort_values("ST", ascending=False)
    said = ", ".join(f"{words(r['parameter'])} {r['ST']:.2f}" for r in ranked.to_dict("records"))
    return Drawn(
        "sobol",
        "Sobol indices",
        f"Share of the variance that comes from each parameter; {results.manifest['size']}; bars "
        "are 95 % intervals by resampling.",
        f"Bar charts of Sobol indices. Total indices of {measure_of(measures[0]).words}: {said}.",
        figure,
    )


def _scatter(results: StudyResults, measure: str) -> Drawn | None:
    """Each parameter against a measure: runs, and means of equal shares of the points."""
    names = [axis.name for axis in results.design.axes][:MOST_PANELS]
    runs, m = results.runs.dropna(subset=[measure]), measure_of(measure)
    if not len(runs):
        return None
    figure, panels = _panels(len(names), 0.5, 2.6)
    y = m.scale * runs[measure].to_numpy(dtype=float)
    thin = max(1, len(y) // 3000)
    for axes, name in zip(panels, names, strict=True):
        column = runs[name]
        axes.xaxis.set_major_locator(MaxNLocator(4))
        if statistics.is_numeric(column):
            x = column.to_numpy(dtype=float)
        else:
            values = list(dict.fromkeys(column))
            x = np.array([float(values.index(v)) for v in column])
            axes.set_xticks(range(len(values)), [str(v) for v in values])
        axes.plot(x[::thin], y[::thin], ls="", marker=".", ms=3, color=DOTS, zorder=2)
        order = np.argsort(x, kind="stable")
        parts = [p for p in np.array_split(order, min(8, max(2, len(y) // 10))) if len(p) > 2]
        means = [statistics.describe(y[p]) for p in parts]
        with_bars(axes, [float(x[p].mean()) for p in parts], [d["mean"] for d in means],
                  [d["mean"] - d["mean_low"] for d in means], color=INK, marker="D", ms=4,
                  lw=1.4)  # fmt: skip
        axes.set_xlabel(results.study.label(name))
    _label(panels, None, m.title)
    return Drawn(
        f"{measure}_over_all",
        f"{capital(m.words)} over each parameter",
        "Each dot is a run; diamonds are means of equal numbers of runs with their 95 % interval.",
        f"Scatter plots of {m.words} over {', '.join(map(results.study.words, names))}.",
        figure,
    )
