"""The figure of convergence in tolerance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from derail_ros.review.figures import BLUE, FAINT, STYLE, VERMILION
from derail_ros.studies.convergence import APART, MEASURES, Convergence, power

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LOOKS = ((BLUE, "o"), (VERMILION, "s"), ("#009e73", "^"), ("#222222", "D"))
"""Colour and marker of each scenario."""

SHOWN = ("cars_derailed", "duration", "peak_force", "scene_length", "scene_width")


def convergence_figure(studies: Sequence[Convergence], members: int) -> Figure:
    """Draw when twins part, and the means of the ensembles, over the tolerance."""
    with matplotlib.rc_context(STYLE):
        return _figure(studies, members)


def _figure(studies: Sequence[Convergence], members: int) -> Figure:
    width, height = 12.0, 6.9
    figure = Figure(figsize=(width, height), facecolor="white")
    FigureCanvasAgg(figure)
    left, right, top, bottom, gap_x, gap_y = 0.65, 0.2, 1.3, 0.55, 0.62, 0.85
    wide = (width - left - right - 2.0 * gap_x) / 3.0
    tall = (height - top - bottom - gap_y) / 2.0
    panels = []
    for k in range(6):
        row, column = divmod(k, 3)
        panels.append(
            figure.add_axes(
                (
                    (left + column * (wide + gap_x)) / width,
                    (height - top - tall - row * (tall + gap_y)) / height,
                    wide / width,
                    tall / height,
                )
            )
        )
    _partings(panels[0], studies)
    for axes, name in zip(panels[1:], SHOWN, strict=True):
        _means(axes, studies, name)
    figure.text(
        0.3 / width,
        1.0 - 0.3 / height,
        "Convergence in tolerance: runs part, distributions agree",
        size=14,
        weight="bold",
        va="center",
    )
    figure.text(
        0.3 / width,
        1.0 - 0.57 / height,
        f"Ensembles of the same {members} lateral forces at each tolerance. Whiskers: 95 % "
        "confidence of the mean. Band: that of the tightest. The default is ringed.",
        size=9.5,
        color="#555555",
        va="center",
    )
    handles, labels = panels[1].get_legend_handles_labels()
    figure.legend(
        handles,
        labels,
        loc="upper left",
        bbox_to_anchor=(0.3 / width, 1.0 - 0.72 / height),
        ncol=len(handles),
        frameon=False,
        fontsize=9,
        borderaxespad=0.0,
        borderpad=0.0,
        columnspacing=1.8,
    )
    return figure


def _prepare(axes: Axes, studies: Sequence[Convergence]) -> None:
    axes.set_xscale("log")
    rtols = [level.rtol for level in studies[0].levels]
    axes.set_xticks(rtols, [power(r) for r in rtols], size=8)
    axes.set_xticks([], minor=True)
    axes.set_xlim(rtols[0] * 2.2, rtols[-1] / 2.2)
    axes.tick_params(length=3, color="#c8c8c8")
    axes.set_xlabel("relative tolerance")
    axes.grid(axis="y", color="#ececec", lw=0.8, zorder=0)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def _partings(axes: Axes, studies: Sequence[Convergence]) -> None:
    _prepare(axes, studies)
    last = 0.0
    for study, (colour, marker) in zip(studies, LOOKS, strict=False):
        levels = study.levels[:-1]
        ends = max(float(level.measures["duration"].mean) for level in study.levels)
        last = max(last, ends)
        for level in levels:
            times = np.where(np.isfinite(level.partings), level.partings, ends)
            axes.plot(
                np.full(len(times), level.rtol),
                times,
                ls="",
                marker=marker,
                ms=3,
                color=colour,
                alpha=0.25,
                zorder=2,
            )
        x = [level.rtol for level in levels]
        y = [float(np.median(np.minimum(level.partings, ends))) for level in levels]
        axes.plot(x, y, color=colour, marker=marker, ms=6, lw=1.2, mec="white", zorder=4)
        contact = float(np.median(study.levels[-1].contacts))
        axes.axhline(contact, color=colour, lw=0.9, ls=(0, (4, 3)), zorder=1)
    axes.text(
        0.99,
        float(np.median(studies[0].levels[-1].contacts)),
        "first contact",
        transform=axes.get_yaxis_transform(),
        ha="right",
        va="bottom",
        size=7.5,
        color=FAINT,
    )
    axes.set_ylim(0.0, None)
    axes.set_ylabel(f"part from the tightest at, s ({100 * APART:g} cm)")
    axes.set_title("Single runs: member and twin", size=9.5, loc="left", weight="bold")


def _means(axes: Axes, studies: Sequence[Convergence], name: str) -> None:
    _prepare(axes, studies)
    (measure,) = (m for m in MEASURES if m.name == name)
    for k, (study, (colour, marker)) in enumerate(zip(studies, LOOKS, strict=False)):
        shift = 10.0 ** (0.12 * (k - 0.5 * (len(studies) - 1)))
        x = np.array([level.rtol for level in study.levels]) * shift
        mean = np.array([level.measures[name].mean for level in study.levels])
        half = np.array([level.measures[name].half for level in study.levels])
        axes.axhspan(mean[-1] - half[-1], mean[-1] + half[-1], color=colour, alpha=0.13, lw=0)
        axes.errorbar(
            x,
            mean,
            half,
            ls="",
            marker=marker,
            ms=5.5,
            color=colour,
            mec="white",
            mew=0.6,
            elinewidth=1.1,
            capsize=2.5,
            zorder=4,
            label=study.title,
        )
        for level, place, value in zip(study.levels, x, mean, strict=True):
            if level.rtol == study.default_rtol:
                axes.plot(place, value, "o", ms=11, mfc="none", mec=colour, mew=1.0, zorder=5)
    axes.margins(y=0.15)
    axes.yaxis.set_major_locator(MaxNLocator(5))
    axes.set_ylabel(f"{measure.label}, {measure.unit}")
    axes.set_title(f"Ensembles: mean {measure.label}", size=9.5, loc="left", weight="bold")
