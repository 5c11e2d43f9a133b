"""Figures of the comparison with the published runs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from derail_ros.review.drawing import (
    BLUE,
    FAINT,
    INK,
    RAIL,
    STATES,
    STYLE,
    VERMILION,
    draw_bodies,
    draw_fronts,
)
from derail_ros.studies.ensemble import VARIATION
from derail_ros.studies.mississauga import Details, PublishedRun
from derail_ros.studies.validation import MEASURES, CaseResult, Validation
from derail_ros.vocabulary.words import number_list

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from derail_ros.review.scene import Scene

BAND = "#9ecae9"


def _figure(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def _heading(figure: Figure, title: str, note: str, left: float = 0.3) -> None:
    width, height = figure.get_size_inches()
    figure.text(left / width, 1.0 - 0.3 / height, title, size=14, weight="bold", va="center")
    figure.text(left / width, 1.0 - 0.58 / height, note, size=9.5, color="#555555", va="center")


# Published against computed ----------------------------------------------------------------


def published_against_computed(validation: Validation) -> Figure:
    """Draw every measure of every case: the ensemble's mean and band, the published value."""
    with matplotlib.rc_context(STYLE):
        return _published_against_computed(validation)


def _published_against_computed(validation: Validation) -> Figure:
    results = [*validation.cases, *validation.beside]
    measures = [
        (name, label)
        for name, _, label, _ in MEASURES
        if any(r.spreads[name].published is not None for r in results)
    ]
    columns = 4
    lines = math.ceil((len(measures) + 1) / columns)
    row, names, top, under = 0.255, 2.95, 0.98, 0.62
    tall = row * len(results)
    width = 14.4
    height = top + lines * (tall + under) - 0.22
    figure = _figure(width, height)
    wide = (width - names - 0.15) / columns
    for k, (name, label) in enumerate(measures):
        line, column = divmod(k, columns)
        axes = figure.add_axes(
            (
                (names + column * wide) / width,
                (height - top - line * (tall + under) - tall) / height,
                (wide - 0.22) / width,
                tall / height,
            )
        )
        _measure(axes, results, name, label, len(validation.cases))
        if column == 0:
            axes.set_yticks(range(0, -len(results), -1), [r.case.title for r in results], size=8.5)
    _heading(
        figure,
        "Published runs and ensembles",
        f"{validation.members} runs a case, the lateral force varied by up to "
        f"{100 * VARIATION:g} %",
    )
    line, column = divmod(len(measures), columns)
    _comparison_key(
        figure,
        (names + column * wide) / width,
        (height - top - line * (tall + under)) / height,
        validation,
    )
    return figure


def _measure(
    axes: Axes, results: Sequence[CaseResult], name: str, label: str, counted: int
) -> None:
    n = len(results)
    axes.set_ylim(-n + 0.5, 0.5)
    axes.set_yticks([])
    most = 0.0
    for k, result in enumerate(results):
        s = result.spreads[name]
        if s.published is None:
            continue
        y = -k
        if s.low is not None and s.mean is not None and s.high is not None:
            axes.plot([s.low, s.high], [y, y], color=BAND, lw=7.5, solid_capstyle="butt", zorder=2)
            axes.plot(s.mean, y, "o", ms=5, color=BLUE, mec="white", mew=0.6, zorder=4)
            axes.plot(
                [s.mean, s.published], [y, y], color=FAINT, lw=0.8, ls=(0, (2, 2)), zorder=1.5
            )
            most = max(most, s.high)
        inside = bool(s.inside)
        axes.plot(
            s.published,
            y,
            "D",
            ms=5.5,
            mfc=VERMILION if inside else "white",
            mec=VERMILION,
            mew=1.3,
            zorder=5,
        )
        most = max(most, s.published)
    if counted < n:
        axes.axhline(-counted + 0.5, color=FAINT, lw=0.7, ls=(0, (1, 2)))
    axes.set_xlim(0.0, 1.06 * most)
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.grid(axis="x", color="#ececec", lw=0.8, zorder=0)
    axes.set_axisbelow(True)
    axes.tick_params(length=0, labelsize=8)
    for side in ("top", "right", "left"):
        axes.spines[side].set_visible(False)
    axes.set_title(label.replace("m2", "m\N{SUPERSCRIPT TWO}"), size=9.5, loc="left", pad=4)


def _comparison_key(figure: Figure, left: float, top: float, validation: Validation) -> None:
    diamond: dict[str, Any] = {"ls": "", "marker": "D", "mec": VERMILION, "mew": 1.3, "ms": 5.5}
    handles: list[Any] = [
        Line2D([], [], color=BAND, lw=7.5, solid_capstyle="butt", label="90 % band of the runs"),
        Line2D([], [], ls="", marker="o", color=BLUE, mec="white", ms=6, label="their mean"),
        Line2D([], [], **diamond, mfc=VERMILION, label="published, in the band"),
        Line2D([], [], **diamond, mfc="white", label="published, outside"),
    ]
    figure.legend(
        handles=handles,
        loc="upper left",
        bbox_to_anchor=(left, top),
        frameon=False,
        fontsize=9,
        borderaxespad=0.0,
        borderpad=0.0,
        labelspacing=0.6,
    )
    if validation.beside:
        figure.text(
            left,
            top - 1.15 / figure.get_size_inches()[1],
            "Below the dotted line: shown beside,\ncounts in no goal.",
            size=8.5,
            color="#555555",
            va="top",
        )


# Peak force on each car --------------------------------------------------------------------


def peaks_by_car(details: Details, published: PublishedRun, title: str) -> Figure:
    """Draw the ensemble's peak force on each car beside what is published of it."""
    with matplotlib.rc_context(STYLE):
        return _peaks_by_car(details, published, title)


def _peaks_by_car(details: Details, published: PublishedRun, title: str) -> Figure:
    force = details.force * 1e-6
    known = published.by_car
    struck = np.flatnonzero(force.max(axis=0) > 0.0)
    last = max([int(struck[-1]) + 1 if len(struck) else 1, *published.above])
    force = force[:, :last]
    cars = np.arange(1, last + 1)
    width, height = 12.0, 5.4
    figure = _figure(width, height)
    axes = figure.add_axes((0.65 / width, 0.55 / height, 1.0 - 0.85 / width, 1.0 - 1.9 / height))
    low, quarter, middle, three, high = np.quantile(force, [0.05, 0.25, 0.5, 0.75, 0.95], axis=0)
    axes.bar(cars, high - low, bottom=low, width=0.34, color="#cfe3f1", lw=0, zorder=2)
    axes.bar(cars, three - quarter, bottom=quarter, width=0.62, color=BAND, lw=0, zorder=3)
    axes.plot(cars, middle, ls="", marker="_", ms=15, mew=2.0, color=BLUE, zorder=4)
    for car in cars:
        if car in known:
            axes.plot(
                car, known[car] * 1e-6, "D", ms=7, mfc=VERMILION, mec="white", mew=0.8, zorder=6
            )
        elif car in published.above:
            axes.plot(car, 10.6, "^", ms=8, mfc="white", mec=VERMILION, mew=1.5, zorder=6)
        else:
            axes.plot(car, 9.4, "v", ms=8, mfc="white", mec=VERMILION, mew=1.5, zorder=6)
    axes.axhline(10.0, color=INK, lw=1.0, ls=(0, (6, 3)), zorder=1)
    top = 1.12 * max(float(high.max()), max(known.values()) * 1e-6)
    axes.set_ylim(0.0, top)
    axes.set_xlim(0.3, last + 0.7)
    axes.set_xticks(cars)
    axes.tick_params(length=3, color="#c8c8c8")
    axes.set_xlabel("car")
    axes.set_ylabel("largest force at a corner, MN")
    axes.grid(axis="y", color="#ececec", lw=0.8, zorder=0)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    share = details.share_above()[:last]
    for car in cars:
        axes.text(
            car,
            0.985 * top,
            f"{100 * share[car - 1]:.0f}",
            ha="center",
            va="top",
            size=8,
            weight="bold" if car in published.above else "normal",
            color=VERMILION if car in published.above else "#555555",
            bbox={"boxstyle": "square,pad=0.1", "fc": "white", "ec": "none", "alpha": 0.8},
        )
    pairs = "; ".join(
        f"{p.pair[0]} into {p.pair[1]} {p.force * 1e-6:.2f}" for p in published.peaks
    )
    _heading(
        figure,
        f"{title}: peak force on each car",
        f"{len(force)} runs. At the top: in how many percent of them the car is struck above "
        f"10 MN, bold where it is in the published run.",
    )
    figure.text(
        0.3 / width,
        1.0 - 0.8 / height,
        f"Published largest forces, MN: {pairs}.",
        size=9.5,
        color="#555555",
        va="center",
    )
    handles: list[Any] = [
        Line2D([], [], ls="", marker="_", mew=2.0, ms=12, color=BLUE, label="median"),
        Patch(fc=BAND, label="middle half"),
        Patch(fc="#cfe3f1", label="middle 90 %"),
        Line2D([], [], ls="", marker="D", ms=7, mfc=VERMILION, mec="white", label="published"),
        Line2D(
            [], [], ls="", marker="^", ms=8, mfc="white", mec=VERMILION, mew=1.5,
            label="published only as above 10 MN",
        ),
        Line2D(
            [], [], ls="", marker="v", ms=8, mfc="white", mec=VERMILION, mew=1.5,
            label="below 10 MN",
        ),
    ]  # fmt: skip
    figure.legend(
        handles=handles,
        loc="upper left",
        bbox_to_anchor=(0.65 / width, 1.0 - 0.99 / height),
        ncol=len(handles),
        frameon=False,
        fontsize=8.5,
        borderaxespad=0.0,
        borderpad=0.0,
        columnspacing=1.5,
    )
    return figure


# Scenes ------------------------------------------------------------------------------------

STANDING = 1.0
"""A car slower than this stands, m/s."""


def scene_series(details: Details, published: PublishedRun, title: str) -> Figure:
    """Draw the scenes one above the other in the same window, with the cars' velocities."""
    with matplotlib.rc_context(STYLE):
        return _scene_series(details, published, title)


def _scene_series(details: Details, published: PublishedRun, title: str) -> Figure:
    times = sorted(details.scenes)
    window = _window([details.scenes[t][0] for t in times])
    width = 13.0
    columns = 2
    wide = (width - 0.6 - 0.25) / columns
    tall = wide * (window[3] - window[2]) / (window[1] - window[0])
    caption, top, bottom = 0.5, 0.85, 0.45
    lines = math.ceil(len(times) / columns)
    height = top + lines * (tall + caption) + bottom
    figure = _figure(width, height)
    for k, t in enumerate(times):
        line, column = divmod(k, columns)
        scene, velocity = details.scenes[t]
        left = 0.3 + column * (wide + 0.25)
        low = height - top - (line + 1) * (tall + caption)
        axes = figure.add_axes((left / width, low / height, wide / width, tall / height))
        _scene(axes, scene, velocity, window, 72.0 * wide / (window[1] - window[0]))
        speed = np.hypot(velocity[:, 0], velocity[:, 1])
        standing = np.flatnonzero((speed < STANDING) & scene.derailed) + 1
        figure.text(
            left / width, (low + tall + 0.3) / height, f"{t:.1f} s", size=11, weight="bold",
            va="center",
        )  # fmt: skip
        figure.text(
            (left + 0.62) / width,
            (low + tall + 0.3) / height,
            f"here stand: {number_list(standing.tolist())}",
            size=8.5,
            va="center",
        )
        figure.text(
            (left + 0.62) / width,
            (low + tall + 0.12) / height,
            f"published: {published.scenes[t]}",
            size=8.5,
            color=VERMILION,
            va="center",
        )
    _heading(
        figure,
        f"{title}: the pile grows",
        f"The run itself. Arrows: velocity, 1 m for 1 m/s; without an arrow a car stands (below "
        f"{STANDING:g} m/s). The dark end is the front.",
    )
    handles: list[Any] = [
        Patch(fc=fill, ec=INK, hatch=hatch or None, lw=0.8, label=label)
        for label, fill, hatch in STATES
    ]
    figure.legend(
        handles=handles,
        loc="lower left",
        bbox_to_anchor=(0.3 / width, 0.1 / height),
        ncol=len(handles),
        frameon=False,
        fontsize=8.5,
        borderaxespad=0.0,
        borderpad=0.0,
        handleheight=1.1,
    )
    return figure


def _window(scenes: Sequence[Scene]) -> tuple[float, float, float, float]:
    """Holds the derailed cars of all scenes and a car length behind them."""
    points = np.concatenate(
        [s.corners()[s.derailed & (s.represents == 1)].reshape(-1, 2) for s in scenes]
    )
    (x0, y0), (x1, y1) = points.min(axis=0), points.max(axis=0)
    return float(x0) - 22.0, float(x1) + 6.0, float(y0) - 5.0, float(y1) + 5.0


def _scene(
    axes: Axes,
    scene: Scene,
    velocity: NDArray[np.float64],
    window: tuple[float, float, float, float],
    points_per_metre: float,
) -> None:
    axes.set_xlim(window[0], window[1])
    axes.set_ylim(window[2], window[3])
    axes.set_xticks([])
    axes.set_yticks([])
    for side in (-0.72, 0.72):
        axes.axhline(side, color=RAIL, lw=0.8, zorder=0.5)
    for x, _, _ in scene.breaks:
        axes.plot([x, x], [-2.6, 2.6], color=VERMILION, lw=2.2, zorder=6, solid_capstyle="butt")
    real = scene.represents == 1
    draw_bodies(axes, scene, 0.7)
    draw_fronts(axes, scene)
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    size = float(np.clip(0.6 * 2.6 * points_per_metre, 4.5, 8.0))
    for i in np.flatnonzero(real):
        x, y = scene.pose[i, :2]
        if not (window[0] < x < window[1] and window[2] < y < window[3]):
            continue
        if speed[i] >= STANDING:
            axes.annotate(
                "",
                xy=(x + velocity[i, 0], y + velocity[i, 1]),
                xytext=(x, y),
                arrowprops={"arrowstyle": "-|>", "color": BLUE, "lw": 1.2, "shrinkA": 0,
                            "shrinkB": 0, "mutation_scale": 8},
                zorder=8,
                annotation_clip=True,
            )  # fmt: skip
        axes.text(
            x,
            y,
            str(scene.numbers[i]),
            size=size,
            weight="bold",
            ha="center",
            va="center_baseline",
            zorder=10,
            bbox={"boxstyle": "round,pad=0.1", "fc": "white", "ec": "none", "alpha": 0.85},
            clip_on=True,
        )
    bar = 20.0
    x0, y0 = window[0] + 3.0, window[2] + 2.5
    axes.plot([x0, x0 + bar], [y0, y0], color=INK, lw=2.0, solid_capstyle="butt", zorder=11)
    axes.text(x0 + 0.5 * bar, y0 + 0.8, f"{bar:g} m", ha="center", va="bottom", size=7.5)
