"""``docs/spread.md`` and its histograms, with the published run and the accident."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.ticker import MaxNLocator

from derail_ros.commands.model_studies import spreads_of
from derail_ros.review.drawing import BLUE, VERMILION, dress, grid_of, heading, sheet, styled
from derail_ros.studies.ensemble import VARIATION
from derail_ros.studies.records import Distribution
from derail_ros.studies.spread import Spread, sentence, spread_table
from derail_ros.studies.tables import Table
from research.pages import BAND, Options, document, picture, written_by

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

OUTSIDE = "#dfe8ee"


def write(options: Options) -> None:
    """Run the scenarios, write the page and a figure each."""
    options.images()
    spreads = spreads_of(options.names, None, options.members or 200, options.seed, options.jobs)
    options.write(page(spreads), {image(s): histograms(s) for s in spreads})


def image(s: Spread) -> str:
    """File of the figure of a scenario."""
    return f"spread_{s.name}.png"


def page(spreads: Sequence[Spread]) -> str:
    """The text of the page."""
    parts: list[str | Table] = [
        "# Spread: how much a single run tells",
        written_by("spread"),
        "A derailment is chaotic once cars collide. Here scenarios are run many times, and only "
        f"the force that starts the motion changes, by up to {100 * VARIATION:g} %, which is less "
        "than its uncertainty. A single run is one draw from these distributions. So are a "
        "published run and the accident, if the model is right. "
        '"Two differ by" is the median difference of two random runs. The share beside a '
        "published value is that of the runs below it.",
    ]
    for s in spreads:
        e = s.ensemble
        left_out = f"; {e.void} void and {e.failed} failed left out" if e.void + e.failed else ""
        pairs = ", ".join(f"{pair} ({n})" for pair, n in list(e.pairs.items())[:8])
        parts += [
            f"## {s.title}",
            f"`{s.name}`, {len(e)} runs, seed {s.seed}{left_out}.",
            sentence(s),
            picture(image(s), f"Distributions of {s.title}"),
            spread_table(s),
            f"Pairs of the largest force, and in how many runs: {pairs}.",
        ]
    return document(*parts)


@styled
def histograms(s: Spread) -> Figure:
    """Draw the distribution of each measure, its 90 % band dark."""
    figure = sheet(12.0, 6.3)
    for k, (axes, d) in enumerate(
        zip(grid_of(figure, 6, 3, (0.6, 0.2, 1.12, 0.55, 0.5, 1.0)), s.distributions.values())
    ):
        _histogram(axes, d)
        if k % 3 == 0:
            axes.set_ylabel("runs")
    heading(
        figure,
        s.title,
        f"{s.counted} runs with nothing changed but the lateral force, by up to "
        f"{100 * VARIATION:g} %. Dark: the middle 90 %; below: mean and standard deviation.",
    )
    return figure


def _edges(x: np.ndarray, whole: bool) -> np.ndarray:
    low, high = float(x.min()), float(x.max())
    if whole:
        return np.arange(math.floor(low) - 0.5, math.ceil(high) + 1.0)
    # All in one place (no chaos yet): a bin that can be seen.
    step = max((high - low) / 22.0, 0.004 * max(abs(high), 1e-9))
    power = 10.0 ** math.floor(math.log10(step))
    step = next(m * power for m in (1.0, 2.0, 2.5, 5.0, 10.0) if m * power >= step * 0.999)
    return np.arange(math.floor(low / step), math.ceil(high / step) + 1.5) * step


def _histogram(axes: Axes, d: Distribution) -> None:
    m = d.measure
    axes.set_xlabel(f"{m.title}: {m.shown(d.mean)} ± {m.shown(d.sd)}")
    dress(axes, "y")
    if not len(d.values):
        axes.text(0.5, 0.5, "no runs", transform=axes.transAxes, ha="center")
        return
    values = d.values * m.scale
    edges = _edges(values, m.whole)
    counts, _ = np.histogram(values, edges)
    middle, half = 0.5 * (edges[1:] + edges[:-1]), 0.5 * (edges[1] - edges[0])
    low, high = (m.scale * q for q in d.band)
    dark = (middle + half >= low) & (middle - half <= high)
    if m.whole:
        dark = (middle >= math.floor(low)) & (middle <= math.ceil(high))
    axes.bar(middle, counts, width=(0.86 if m.whole else 1.0) * 2.0 * half, zorder=2,
             color=np.where(dark, BAND, OUTSIDE), edgecolor="white", linewidth=0.6)  # fmt: skip
    axes.set_ylim(0.0, 1.04 * float(counts.max()))
    axes.xaxis.set_major_locator(MaxNLocator(7, integer=m.whole))
    axes.yaxis.set_major_locator(MaxNLocator(4, integer=True))
    looks = {"published": (d.published, VERMILION, "-"), "accident": (d.accident, BLUE, "--")}
    marks = [(v * m.scale, name, *look) for name, (v, *look) in looks.items() if v is not None]
    low_x = min(edges[0], *(v for v, *_ in marks), edges[0])
    high_x = max(edges[-1], *(v for v, *_ in marks), edges[-1])
    pad = 0.03 * (high_x - low_x)
    axes.set_xlim(low_x - pad, high_x + pad)
    for k, (value, words, colour, dashes) in enumerate(marks):
        axes.axvline(value, color=colour, lw=1.8, ls=dashes, zorder=4)
        share = (value - low_x + pad) / (high_x - low_x + 2.0 * pad)
        axes.annotate(
            f"{words} {value:g}", xy=(value, 1.0), xycoords=("data", "axes fraction"),
            xytext=(0, 2 + 11 * k), textcoords="offset points", va="bottom", size=8,
            ha="left" if share < 0.2 else "right" if share > 0.8 else "center",
            color=colour, weight="bold", annotation_clip=False,
        )  # fmt: skip
