"""The figure of convergence in tolerance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from derail_ros.review.drawing import BLUE, FAINT, STYLE, VERMILION
from derail_ros.studies.convergence import APART, MEASURES, Convergence

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
        f"The same {members} lateral forces at each tolerance. Whiskers: 95 % confidence of the "
        "mean; band: that of the tightest; ring: the default. Twins that never part: end of run.",
        size=8.5,
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
    labels = [level.label.replace(" ", "\n") for level in studies[0].all]
    axes.set_xticks(range(len(labels)), labels, size=8)
    axes.set_xlim(-0.5, len(labels) - 0.5)
    axes.tick_params(length=3, color="#c8c8c8")
    axes.grid(axis="y", color="#ececec", lw=0.8, zorder=0)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    if studies[0].reference is not None:
        axes.axvline(len(labels) - 1.5, color=FAINT, lw=0.7, ls=(0, (1, 2)))


def _partings(axes: Axes, studies: Sequence[Convergence]) -> None:
    _prepare(axes, studies)
    for k, (study, (colour, marker)) in enumerate(zip(studies, LOOKS, strict=False)):
        # Two runs that never part are drawn at the end of the run.
        end = study.levels[-1].measures["duration"].mean
        middle = []
        for place, level in enumerate(study.all):
            if level is study.levels[-1]:
                continue
            times = np.minimum(level.partings, end)
            middle.append((place, float(np.median(times))))
            axes.plot(
                np.full(len(times), place + _shift(k, studies)),
                times,
                ls="",
                marker=marker,
                ms=3,
                color=colour,
                alpha=0.25,
                zorder=2,
            )
        own = [m for m in middle if m[0] < len(study.levels)]
        axes.plot(*zip(*own, strict=True), color=colour, lw=1.2, zorder=3)
        axes.plot(
            *zip(*middle, strict=True), ls="", color=colour, marker=marker, ms=6, mec="white",
            zorder=4,
        )  # fmt: skip
        contact = float(np.median(study.levels[-1].contacts))
        axes.axhline(contact, color=colour, lw=0.9, ls=(0, (4, 3)), zorder=1)
        axes.text(
            0.99,
            contact,
            "first contact",
            transform=axes.get_yaxis_transform(),
            ha="right",
            va="bottom",
            size=7.5,
            color=colour,
        )
    axes.set_ylim(0.0, None)
    axes.set_ylabel(f"{100 * APART:g} cm from the tightest at, s")
    axes.set_title("Single runs: member and twin", size=9.5, loc="left", weight="bold")


def _shift(k: int, studies: Sequence[Convergence]) -> float:
    return 0.16 * (k - 0.5 * (len(studies) - 1))


def _means(axes: Axes, studies: Sequence[Convergence], name: str) -> None:
    _prepare(axes, studies)
    (measure,) = (m for m in MEASURES if m.name == name)
    seen: list[float] = []
    for k, (study, (colour, marker)) in enumerate(zip(studies, LOOKS, strict=False)):
        x = np.arange(len(study.all)) + _shift(k, studies)
        mean = np.array([level.measures[name].mean for level in study.all])
        half = np.array([level.measures[name].half for level in study.all])
        tight = study.levels[-1].measures[name]
        axes.axhspan(tight.mean - tight.half, tight.mean + tight.half, color=colour, alpha=0.13,
                     lw=0)  # fmt: skip
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
        for level, place, value in zip(study.levels, x, mean, strict=False):
            if level.rtol == study.default_rtol:
                axes.plot(place, value, "o", ms=11, mfc="none", mec=colour, mew=1.0, zorder=5)
        # A loose tolerance may be far off: the scale is that of the others.
        seen += [*(mean[1:] - half[1:]), *(mean[1:] + half[1:])]
    low, high = min(seen), max(seen)
    margin = 0.15 * (high - low) or 1.0
    axes.set_ylim(low - margin, high + margin)
    axes.yaxis.set_major_locator(MaxNLocator(5))
    axes.set_ylabel(f"{measure.label}, {measure.unit}")
    axes.set_title(f"Ensembles: mean {measure.label}", size=9.5, loc="left", weight="bold")
