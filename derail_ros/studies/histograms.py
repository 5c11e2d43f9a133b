"""The figure of the spread of outcomes: histograms with the published run and the accident."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from derail_ros.review.drawing import BLUE, STYLE, VERMILION
from derail_ros.studies.ensemble import VARIATION
from derail_ros.studies.spread import Distribution, Spread, shown, with_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FILL = "#9ecae9"
OUTSIDE = "#dfe8ee"


def histograms(spread: Spread) -> Figure:
    """Draw the distribution of each measure, its 90 % band dark."""
    with matplotlib.rc_context(STYLE):
        return _histograms(spread)


def _histograms(s: Spread) -> Figure:
    width, height = 12.0, 6.3
    figure = Figure(figsize=(width, height), facecolor="white")
    FigureCanvasAgg(figure)
    left, right, top, bottom, gap_x, gap_y = 0.6, 0.2, 1.12, 0.55, 0.5, 1.0
    wide = (width - left - right - 2.0 * gap_x) / 3.0
    tall = (height - top - bottom - gap_y) / 2.0
    for k, distribution in enumerate(s.distributions.values()):
        row, column = divmod(k, 3)
        axes = figure.add_axes(
            (
                (left + column * (wide + gap_x)) / width,
                (height - top - tall - row * (tall + gap_y)) / height,
                wide / width,
                tall / height,
            )
        )
        _histogram(axes, distribution)
        if column == 0:
            axes.set_ylabel("runs")
    figure.text(0.3 / width, 1.0 - 0.3 / height, s.title, size=14, weight="bold", va="center")
    figure.text(
        0.3 / width,
        1.0 - 0.58 / height,
        f"{s.counted} runs with nothing changed but the lateral force, by up to "
        f"{100 * VARIATION:g} %. Dark: the middle 90 %; below: mean and standard deviation.",
        size=9.5,
        color="#555555",
        va="center",
    )
    return figure


def _edges(d: Distribution) -> np.ndarray:
    x = d.values
    low, high = float(x.min()), float(x.max())
    if d.measure.whole:
        return np.arange(math.floor(low) - 0.5, math.ceil(high) + 1.0)
    # All in one place (no chaos yet): a bin that can be seen.
    step = max((high - low) / 22.0, 0.004 * max(abs(high), 1e-9))
    power = 10.0 ** math.floor(math.log10(step))
    step = next(m * power for m in (1.0, 2.0, 2.5, 5.0, 10.0) if m * power >= step * 0.999)
    return np.arange(math.floor(low / step), math.ceil(high / step) + 1.5) * step


def _histogram(axes: Axes, d: Distribution) -> None:
    more = 1 if d.measure.whole else d.measure.digits
    axes.set_xlabel(f"{with_unit(d.measure)}: {shown(d.mean, more)} ± {shown(d.sd, more)}")
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    axes.tick_params(length=3, color="#c8c8c8")
    if not len(d.values):
        axes.text(0.5, 0.5, "no runs", transform=axes.transAxes, ha="center")
        return
    edges = _edges(d)
    counts, _ = np.histogram(d.values, edges)
    middle = 0.5 * (edges[1:] + edges[:-1])
    low, high = d.quantile(0.05), d.quantile(0.95)
    half = 0.5 * (edges[1] - edges[0])
    dark = (middle + half >= low) & (middle - half <= high)
    if d.measure.whole:
        dark = (middle >= math.floor(low)) & (middle <= math.ceil(high))
    axes.bar(
        middle,
        counts,
        width=(0.86 if d.measure.whole else 1.0) * 2.0 * half,
        color=np.where(dark, FILL, OUTSIDE),
        edgecolor="white",
        linewidth=0.6,
        zorder=2,
    )
    axes.set_ylim(0.0, 1.04 * float(counts.max()))
    axes.grid(axis="y", color="#ececec", lw=0.8, zorder=0)
    axes.set_axisbelow(True)
    axes.xaxis.set_major_locator(MaxNLocator(7, integer=d.measure.whole))
    axes.yaxis.set_major_locator(MaxNLocator(4, integer=True))
    marks = [(d.published, "published", VERMILION, "-"), (d.accident, "accident", BLUE, "--")]
    places = [(v, *look) for v, *look in marks if v is not None]
    for value, _, colour, dashes in places:
        axes.axvline(value, color=colour, lw=1.8, ls=dashes, zorder=4)
    low_x = min(edges[0], *(v for v, *_ in places)) if places else edges[0]
    high_x = max(edges[-1], *(v for v, *_ in places)) if places else edges[-1]
    pad = 0.03 * (high_x - low_x)
    axes.set_xlim(low_x - pad, high_x + pad)
    for k, (value, words, colour, _) in enumerate(places):
        share = (value - low_x + pad) / (high_x - low_x + 2.0 * pad)
        axes.annotate(
            f"{words} {value:g}",
            xy=(value, 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(0, 2 + 11 * k),
            textcoords="offset points",
            ha="left" if share < 0.2 else "right" if share > 0.8 else "center",
            va="bottom",
            size=8,
            color=colour,
            weight="bold",
            annotation_clip=False,
        )
