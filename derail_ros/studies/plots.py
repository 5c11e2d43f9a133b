"""Figures of a study.

As the figures of a run: matplotlib objects of their own, Okabe and Ito's colours, and nothing told
by colour alone (series differ in marks and dashes too). Bars and shades always say what they are.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator, PercentFormatter

from derail_ros.review.drawing import BLUE, FAINT, INK, STYLE, VERMILION
from derail_ros.studies import statistics
from derail_ros.studies.design import LatinHypercube, OneAtATime, Sobol
from derail_ros.studies.measures import MEASURES, shown
from derail_ros.studies.plan import FigureSpec, shown_value
from derail_ros.vocabulary.words import count

if TYPE_CHECKING:
    import pandas
    from matplotlib.axes import Axes

    from derail_ros.studies.results import StudyResults

SERIES: tuple[tuple[str, str, Any], ...] = (
    (BLUE, "o", "-"),
    (VERMILION, "s", (0, (5, 1.5))),
    ("#009e73", "^", (0, (1.5, 1.2))),
    ("#9a5b86", "D", (0, (6, 1.5, 1.5, 1.5))),
    ("#b07a00", "v", "-"),
    (INK, "P", (0, (3, 1))),
    ("#3d8ec0", "X", (0, (1, 2))),
)
"""Colour, mark and dashes of the series of a figure."""

WIDTH = 10.0
MOST_SERIES = 7
MOST_PANELS = 9
MOST_ROWS = 60
"""Most points in a figure that has a row for each."""


@dataclass(frozen=True)
class Drawn:
    """A figure with its words.

    Attributes
    ----------
    name : of its file
    title : heading
    caption : what is drawn and how
    alt : what a reader who cannot see it is told
    figure : the figure
    """

    name: str
    title: str
    caption: str
    alt: str
    figure: Figure


def draw(results: StudyResults) -> list[Drawn]:
    """All figures of a study."""
    with matplotlib.rc_context(STYLE):
        return [d for d in _all(results) if d is not None]


def _all(results: StudyResults) -> list[Drawn | None]:
    design = results.design
    found: list[Drawn | None] = []
    if isinstance(design, OneAtATime):
        found += [_relative(results), _tornado(results)]
    elif isinstance(design, Sobol):
        found.append(_sobol(results))
    if isinstance(design, (LatinHypercube, Sobol)):
        found += [_scatter(results, measure) for measure in results.measures[:2]]
        return found
    specs = list(results.study.model.figures) or _default_specs(results)
    found += [_over(results, spec, i) for i, spec in enumerate(specs) if spec.y in results.runs]
    if not specs and not isinstance(design, OneAtATime):
        found.append(_rows(results))
    found.append(_counts(results))
    return found


def _default_specs(results: StudyResults) -> list[FigureSpec]:
    """On a grid with numbers: over the longest of them, the others as series and panels."""
    if results.study.model.design != "grid":
        return []
    axes = sorted(results.design.axes, key=lambda a: -len(a.levels))
    over = next((a for a in axes if a.numeric and len(a.levels) > 2), None)
    if over is None or len(axes) > 3:
        return []
    rest = [a.name for a in sorted(axes, key=lambda a: len(a.levels)) if a is not over]
    series = rest[0] if rest else None
    panels = rest[1] if len(rest) > 1 else None
    for name, most in ((series, MOST_SERIES), (panels, MOST_PANELS)):
        if name and len(next(a for a in axes if a.name == name).levels) > most:
            return []
    return [
        FigureSpec(x=over.name, y=measure, series=series, panels=panels)
        for measure in results.measures[:2]
    ]


def _figure(height: float, width: float = WIDTH) -> Figure:
    figure = Figure(figsize=(width, height), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.set(h_pad=0.09, w_pad=0.06)  # type: ignore[call-arg]
    return figure


def _panels(
    n: int, extra: float, row: float, most: int = 3, width: float = WIDTH, **shared: Any
) -> tuple[Figure, list[Axes]]:
    """A figure of n panels, so many in a row at most; its height is ``extra + row * rows``."""
    columns = min(most, n)
    rows = -(-n // columns)
    figure = _figure(extra + row * rows, width)
    grid = figure.subplots(rows, columns, sharey=True, squeeze=False, **shared).ravel()
    for axes in grid[n:]:
        axes.set_visible(False)
    return figure, list(grid[:n])


def _first(axes: Axes) -> bool:
    """In the left column."""
    place = axes.get_subplotspec()
    return place is not None and place.is_first_col()


def _lowest(axes: Axes) -> bool:
    """In the last row."""
    place = axes.get_subplotspec()
    return place is not None and place.is_last_row()


def _lines(styles: Iterable[tuple[str, tuple[str, str, Any]]]) -> list[Line2D]:
    """Entries of a legend: label, and one of :data:`SERIES`."""
    return [
        Line2D([], [], color=colour, marker=mark, ls=dash, ms=5, label=label)
        for label, (colour, mark, dash) in styles
    ]


def _legend(figure: Figure, handles: Sequence[Any], ncol: int, **more: Any) -> None:
    figure.legend(
        handles=handles,
        loc="outside upper left",
        ncol=ncol,
        frameon=False,
        fontsize=9.5,
        **more,
    )


def _dress(axes: Axes, grid: str = "both") -> None:
    axes.grid(axis=grid, color="#ececec", lw=0.8, zorder=0)  # type: ignore[arg-type]
    axes.set_axisbelow(True)
    axes.tick_params(length=3, color="#c8c8c8")
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def _value(results: StudyResults, column: str, value: Any) -> str:
    owner = results.study.model.parameters.get(column) or results.study.model.columns.get(column)
    unit = f" {owner.unit}" if owner is not None and owner.unit else ""
    return shown_value(value.item() if hasattr(value, "item") else value) + unit


def _words(results: StudyResults, column: str) -> str:
    owner = results.study.model.parameters.get(column) or results.study.model.columns.get(column)
    return (owner.label if owner is not None else None) or column.replace("_", " ")


def _ensemble(results: StudyResults) -> str:
    return f"{count(results.manifest['ensemble'], 'run')} a point"


# --- one at a time ----------------------------------------------------------------------------


def _relative(results: StudyResults) -> Drawn | None:
    """A panel for each parameter: all measures relative to the base, over the parameter."""
    summary = results.summary()
    if "relative" not in summary:
        return None
    measures = [
        m
        for m in results.measures
        if m != "severity" and summary.loc[summary["measure"] == m, "relative"].notna().any()
    ][:MOST_SERIES]
    lines = [line for line in statistics.lines(results) if len(line.points) > 1][:MOST_PANELS]
    if not measures or not lines:
        return None
    figure, panels = _panels(len(lines), 0.5, 2.75)
    table = summary.set_index(["measure", "point"])
    most = 1.0
    for axes, line in zip(panels, lines, strict=True):
        _dress(axes)
        x, labels = _percent_axis(results, line)
        axes.axhline(1.0, color=FAINT, lw=0.8, zorder=1)
        for measure, (colour, mark, dash) in zip(measures, SERIES, strict=False):
            at = [table.loc[(measure, p)] for p in line.points]
            y = np.array([float(r["relative"]) for r in at])
            low = y - np.array([float(r["relative_low"]) for r in at])
            high = np.array([float(r["relative_high"]) for r in at]) - y
            known = np.isfinite(y)
            errors = np.nan_to_num(np.array([low, high]))
            axes.errorbar(
                x[known],
                y[known],
                errors[:, known],
                color=colour,
                marker=mark,
                ls=dash,
                ms=4.5,
                lw=1.5,
                capsize=2,
                elinewidth=0.9,
                zorder=3,
            )
            most = max(most, float(np.nanmax(y + np.nan_to_num(high))))
        axes.set_xticks(x)
        axes.set_xticklabels(labels)
        name = line.column or ""
        axes.set_title(_words(results, name), size=10.5, weight="bold", loc="left")
        at_base = _value(results, name, results.design.point(0).columns[name])
        axes.set_title(f"base: {at_base}", size=8.5, color="#555555", loc="right")
        if _first(axes):
            axes.set_ylabel("mean, base = 1")
    panels[0].set_ylim(0.0, 1.05 * most)
    _legend(figure, _lines(zip((MEASURES[m].label for m in measures), SERIES, strict=False)), 4)
    names = ", ".join(_words(results, line.column or "") for line in lines)
    return Drawn(
        "relative",
        "Outcomes relative to the base",
        f"Means relative to that of the base point, {_ensemble(results)}; bars are 95 % "
        "intervals. Below each panel the value of its parameter, all others as in the base.",
        f"Small line charts of {', '.join(MEASURES[m].label for m in measures)}, relative to the "
        f"base, over {names}. The numbers are in the table of means.",
        figure,
    )


def _percent_axis(results: StudyResults, line: statistics.Line) -> tuple[np.ndarray, list[str]]:
    """Places and labels: numbers where they lie, anything else side by side."""
    name = line.column or ""
    if all(isinstance(v, (int, float, np.number)) for v in line.values):
        x = np.array([float(v) for v in line.values])
        base = results.design.point(0).columns[name]
        given = results.study.model.parameters[name]
        if given.percent is not None and isinstance(base, (int, float)) and base:
            shares = 100.0 * (x / float(base) - 1.0)
            labels = [f"{s:+.0f} %" if abs(s) > 0.05 else "base" for s in shares]
            return x, labels
        return x, [shown_value(v.item() if hasattr(v, "item") else v) for v in line.values]
    return np.arange(float(len(line.values))), [str(v) for v in line.values]


def _tornado(results: StudyResults) -> Drawn | None:
    """A bar for each parameter: how far it moves a measure, the largest first."""
    summary = results.summary()
    if "relative" not in summary:
        return None
    measure = "severity" if "severity" in results.measures else results.measures[0]
    table = summary[summary["measure"] == measure].set_index("point")["relative"]
    bars = []
    for line in statistics.lines(results):
        at = [
            (float(table[p]), v)
            for v, p in zip(line.values, line.points, strict=True)
            if p in table.index and math.isfinite(table[p])
        ]
        if len(at) > 1:
            bars.append((line.column or "", at))
    if not bars:
        return None
    bars.sort(key=lambda bar: max(y for y, _ in bar[1]) - min(y for y, _ in bar[1]))
    figure = _figure(0.9 + 0.48 * len(bars))
    axes = figure.subplots()
    _dress(axes, "x")
    lowest = min(y for _, at in bars for y, _ in at)
    highest = max(y for _, at in bars for y, _ in at)
    reach = max(highest - lowest, 0.1)
    for k, (name, at) in enumerate(bars):
        low, high = min(at, key=lambda a: a[0]), max(at, key=lambda a: a[0])
        axes.barh(k, high[0] - low[0], left=low[0], height=0.55, color="#a9cfe6", ec=BLUE, lw=0.9)
        axes.plot([y for y, _ in at], [k] * len(at), ls="", marker="|", ms=9, color=INK)
        for (y, v), side, shift in ((low, "right", -1), (high, "left", 1)):
            axes.text(
                y + shift * 0.008 * reach,
                k,
                f" {_value(results, name, v)} ",
                va="center",
                ha=side,
                size=8,
            )
    axes.axvline(1.0, color=FAINT, lw=1.0, zorder=1)
    axes.set_yticks(range(len(bars)))
    axes.set_yticklabels([_words(results, name) for name, _ in bars], size=10)
    axes.set_xlim(lowest - 0.16 * reach, highest + 0.16 * reach)
    label = MEASURES[measure].label
    axes.set_xlabel(f"mean {label}, base = 1")
    ranked = ", ".join(
        f"{_words(results, n)} {min(y for y, _ in at):.2f} to {max(y for y, _ in at):.2f}"
        for n, at in reversed(bars)
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
    summary = results.summary()
    table = summary[(summary["measure"] == spec.y) & (summary["n"] > 0)]
    if not len(table):
        return None
    panels = [None] if spec.panels is None else list(dict.fromkeys(table[spec.panels]))
    series = [None] if spec.series is None else list(dict.fromkeys(table[spec.series]))
    panels, series = panels[:MOST_PANELS], series[:MOST_SERIES]
    figure, grid = _panels(
        len(panels),
        0.55,
        3.5 if len(panels) <= 3 else 3.0,
        width=6.6 if len(panels) == 1 else WIDTH,
        sharex=True,
    )
    numbers = all(isinstance(v, (int, float, np.number)) for v in table[spec.x])
    places = {
        v: float(v) if numbers else float(i) for i, v in enumerate(dict.fromkeys(table[spec.x]))
    }
    spread = len(series) == 1
    offset = _offsets(list(places.values()), len(series))
    for axes, panel in zip(grid, panels, strict=True):
        _dress(axes)
        part = table if panel is None else table[table[spec.panels] == panel]
        for i, value in enumerate(series):
            colour, mark, dash = SERIES[i]
            line = part if value is None else part[part[spec.series] == value]
            x = np.array([places[v] for v in line[spec.x]]) + offset[i]
            order = np.argsort(x)
            y = line["mean"].to_numpy(dtype=float)
            half = np.nan_to_num(y - line["mean_low"].to_numpy(dtype=float))
            if spread:
                low, high = (line[q].to_numpy(dtype=float)[order] for q in ("q05", "q95"))
                axes.fill_between(x[order], low, high, color="#dcebf5", lw=0, zorder=1)
            axes.errorbar(
                x[order],
                y[order],
                half[order],
                color=colour,
                marker=mark,
                ls=dash if numbers else "",
                ms=5,
                lw=1.6,
                capsize=2.5,
                elinewidth=1.0,
                zorder=3,
            )
        if panel is not None:
            title = (
                f"{_words(results, spec.panels or '')} {_value(results, spec.panels or '', panel)}"
            )
            axes.set_title(title, size=10.5, weight="bold", loc="left")
        if not numbers:
            axes.set_xticks(list(places.values()))
            axes.set_xticklabels([str(v) for v in places], rotation=20, ha="right")
        if _lowest(axes):
            axes.set_xlabel(results.study.label(spec.x))
        if _first(axes):
            axes.set_ylabel(f"{MEASURES[spec.y].title}, mean")
    bottom, top = grid[0].get_ylim()
    if float(table["mean"].min()) >= 0.0 and bottom < 0.45 * top:
        grid[0].set_ylim(0.0, top)
    names = (_value(results, spec.series or "", v) for v in series if v is not None)
    handles: list[Any] = _lines(zip(names, SERIES, strict=False))
    note = "bars are 95 % intervals of the mean"
    if spread:
        handles = [
            Line2D([], [], color=BLUE, marker="o", ms=5, label="mean, 95 % interval"),
            Patch(fc="#dcebf5", label="5 to 95 % of the runs"),
        ]
        note += ", the shade holds 5 to 95 % of the runs"
    _legend(
        figure,
        handles,
        4,
        title=None if spread else _words(results, spec.series or ""),
        alignment="left",
        title_fontsize=9.5,
    )
    label = MEASURES[spec.y].label
    title = spec.title or f"{label[0].upper()}{label[1:]} over {_words(results, spec.x)}"
    also = [_words(results, c) for c in (spec.series, spec.panels) if c is not None]
    ends = table.loc[[table["mean"].idxmin(), table["mean"].idxmax()]]
    said = " to ".join(shown(spec.y, m) for m in ends["mean"])
    return Drawn(
        f"{spec.y}_over_{spec.x}_{number}" if number else f"{spec.y}_over_{spec.x}",
        title,
        f"{_ensemble(results)}; {note}.",
        f"Line chart of the mean {MEASURES[spec.y].title} over {_words(results, spec.x)}"
        + (f", by {' and '.join(also)}" if also else "")
        + f". Means range from {said}. The numbers are in the table of means.",
        figure,
    )


def _offsets(places: Sequence[float], n: int) -> np.ndarray:
    """Small shifts that keep the bars of several series from covering each other."""
    gaps = np.diff(sorted(set(places)))
    step = 0.06 * float(gaps.min()) if len(gaps) else 0.0
    return step * (np.arange(n) - 0.5 * (n - 1))


# --- a row for each point ---------------------------------------------------------------------


def _rows(results: StudyResults) -> Drawn | None:
    """A panel for each measure, a row for each point: runs, mean and interval."""
    if len(results.design) > MOST_ROWS:
        return None
    summary = results.summary()
    measures = results.measures[:6]
    labels = list(results.labels)
    n = len(labels)
    figure, panels = _panels(len(measures), 0.85, 0.65 + 0.27 * n)
    for axes, measure in zip(panels, measures, strict=True):
        _dress(axes)
        table = summary[summary["measure"] == measure].set_index("point")
        for point, values in statistics.point_values(results, measure).items():
            shift = 0.34 * (((np.arange(len(values)) * 0.618) % 1.0) * 2.0 - 1.0)
            axes.plot(values, point + shift, ls="", marker=".", ms=3.5, color="#8fb9d6", zorder=2)
        known = table[table["n"] > 0]
        y = known["mean"].to_numpy(dtype=float)
        half = np.nan_to_num(y - known["mean_low"].to_numpy(dtype=float))
        axes.errorbar(
            y,
            known.index.to_numpy(dtype=float),
            xerr=half,
            ls="",
            marker="D",
            ms=4.5,
            color=INK,
            elinewidth=1.4,
            capsize=3,
            zorder=3,
        )
        if results.base is not None and results.base in known.index:
            axes.axvline(float(known.loc[results.base, "mean"]), color=VERMILION, lw=1.0, ls=":")
        axes.set_xlabel(MEASURES[measure].title)
        axes.xaxis.set_major_locator(MaxNLocator(5, integer=MEASURES[measure].whole))
        if axes.get_xlim()[0] > 0.0:  # no measure of a part as if it were the whole
            axes.set_xlim(left=0.0)
        axes.set_ylim(n - 0.5, -0.5)
        axes.set_yticks(range(n))
        axes.set_yticklabels(labels)
    handles = [
        Line2D([], [], ls="", marker=".", color="#8fb9d6", label="a run"),
        Line2D([], [], ls="-", marker="D", ms=4.5, color=INK, label="mean, 95 % interval"),
    ]
    if results.base is not None:
        handles.append(Line2D([], [], color=VERMILION, ls=":", label="mean of the base"))
    _legend(
        figure,
        handles,
        3,
        title=results.manifest["title"].replace("$", r"\$"),
        title_fontproperties={"size": 13, "weight": "bold"},
        alignment="left",
    )
    first = summary[summary["measure"] == measures[0]].sort_values("mean")
    said = "; ".join(
        f"{labels[int(r['point'])]}: {shown(measures[0], r['mean'])}"
        for r in first.to_dict("records")
    )
    return Drawn(
        "settings",
        "The settings side by side",
        f"{_ensemble(results)}, each a dot; diamonds are means with their 95 % interval.",
        f"Dot plots of {', '.join(MEASURES[m].label for m in measures)} for each setting. "
        f"Mean {MEASURES[measures[0]].label}: {said}.",
        figure,
    )


def _counts(results: StudyResults) -> Drawn | None:
    """Distribution of the number of cars derailed, a row for each point."""
    n = len(results.design)
    counts = results.counts()
    if n > MOST_ROWS or not len(counts) or results.manifest["ensemble"] < 2:
        return None
    k = counts["cars_derailed"].to_numpy(dtype=int)
    first, last = int(k.min()), int(k.max())
    shares = np.zeros((n, last - first + 1))
    shares[counts["point"].to_numpy(dtype=int), k - first] = counts["share"].to_numpy(dtype=float)
    figure = _figure(1.1 + 0.24 * n, 8.0)
    axes = figure.subplots()
    palette = matplotlib.colormaps["Blues"]
    picture = axes.imshow(
        np.ma.masked_equal(shares, 0.0),
        aspect="auto",
        cmap=palette,
        vmin=0.0,
        vmax=1.0,
        extent=(first - 0.5, last + 0.5, n - 0.5, -0.5),
        interpolation="nearest",
    )
    axes.set_yticks(range(n))
    axes.set_yticklabels(list(results.labels))
    axes.xaxis.set_major_locator(MaxNLocator(12, integer=True))
    axes.set_xlabel("cars derailed")
    axes.tick_params(length=3, color="#c8c8c8")
    axes.set_yticks(np.arange(0.5, n), minor=True)
    axes.grid(which="minor", axis="y", color="#ececec", lw=0.8)
    axes.tick_params(which="minor", length=0)
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
    table = results.sobol()
    if not len(table):
        return None
    table = table[table["S1"].notna()]
    measures = list(dict.fromkeys(table["measure"]))[:6]
    names = [axis.name for axis in results.design.axes]
    figure, panels = _panels(len(measures), 0.5, 0.9 + 0.42 * len(names), most=2, sharex=True)
    kinds: tuple[tuple[str, str, float, str, str], ...] = (
        ("S1", "alone (S1)", -0.18, "#a9cfe6", ""),
        ("ST", "with all others (ST)", 0.18, "#f4c9a8", "////"),
    )
    for axes, measure in zip(panels, measures, strict=True):
        _dress(axes, "x")
        part = table[table["measure"] == measure].set_index("parameter").loc[names]
        for key, _, shift, fill, hatch in kinds:
            y = part[key].to_numpy(dtype=float)
            half = y - part[f"{key}_low"].to_numpy(dtype=float)
            axes.barh(
                np.arange(len(names)) + shift,
                y,
                height=0.34,
                xerr=half,
                color=fill,
                ec=INK,
                lw=0.7,
                hatch=hatch,
                error_kw={"elinewidth": 1.0, "capsize": 2},
            )
        axes.axvline(0.0, color=FAINT, lw=0.8)
        axes.set_yticks(range(len(names)))
        axes.set_yticklabels([_words(results, name) for name in names])
        axes.set_title(MEASURES[measure].label, size=10.5, weight="bold", loc="left")
        if _lowest(axes):
            axes.set_xlabel("share of the variance")
    panels[0].invert_yaxis()
    handles = [Patch(fc=f, ec=INK, lw=0.7, hatch=h, label=label) for _, label, _, f, h in kinds]
    _legend(figure, handles, 2)
    ranked = table[table["measure"] == measures[0]].sort_values("ST", ascending=False)
    said = ", ".join(
        f"{_words(results, r['parameter'])} {r['ST']:.2f}" for r in ranked.to_dict("records")
    )
    return Drawn(
        "sobol",
        "Sobol indices",
        f"Share of the variance that comes from each parameter; {results.manifest['size']}; bars "
        "are 95 % intervals by resampling.",
        f"Bar charts of Sobol indices. Total indices of {MEASURES[measures[0]].label}: {said}.",
        figure,
    )


def _scatter(results: StudyResults, measure: str) -> Drawn | None:
    """Each parameter against a measure: runs, and means of equal shares of the points."""
    names = [axis.name for axis in results.design.axes][:MOST_PANELS]
    runs = results.runs.dropna(subset=[measure])
    if not len(runs):
        return None
    figure, panels = _panels(len(names), 0.5, 2.6)
    y = runs[measure].to_numpy(dtype=float)
    thin = max(1, len(y) // 3000)
    for axes, name in zip(panels, names, strict=True):
        _dress(axes)
        x, set_labels = _places(runs[name])
        axes.plot(x[::thin], y[::thin], ls="", marker=".", ms=3, color="#8fb9d6", zorder=2)
        order = np.argsort(x, kind="stable")
        parts = [p for p in np.array_split(order, min(8, max(2, len(y) // 10))) if len(p) > 2]
        described = [statistics.describe(y[p]) for p in parts]
        axes.errorbar(
            [float(x[p].mean()) for p in parts],
            [d["mean"] for d in described],
            [d["mean"] - d["mean_low"] for d in described],
            color=INK,
            marker="D",
            ms=4,
            lw=1.4,
            capsize=2.5,
            zorder=3,
        )
        axes.xaxis.set_major_locator(MaxNLocator(4))
        set_labels(axes)
        axes.set_xlabel(results.study.label(name))
        if _first(axes):
            axes.set_ylabel(MEASURES[measure].title)
    label = MEASURES[measure].label
    return Drawn(
        f"{measure}_over_all",
        f"{label[0].upper()}{label[1:]} over each parameter",
        "Each dot is a run; diamonds are means of equal numbers of runs with their 95 % interval.",
        f"Scatter plots of {label} over {', '.join(_words(results, n) for n in names)}.",
        figure,
    )


def _places(values: pandas.Series) -> tuple[np.ndarray, Callable[[Axes], None]]:
    if all(isinstance(v, (int, float, np.number)) for v in values):
        return values.to_numpy(dtype=float), lambda axes: None
    names = list(dict.fromkeys(values))

    def label(axes: Axes) -> None:
        axes.set_xticks(range(len(names)))
        axes.set_xticklabels([str(n) for n in names])

    return np.array([float(names.index(v)) for v in values]), label
