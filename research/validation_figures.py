"""Figures of the comparison with the published runs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from derail_ros.review.drawing import (
    BLUE,
    FAINT,
    INK,
    RAIL,
    STATES,
    SUBTLE,
    VERMILION,
    draw_bodies,
    draw_fronts,
    dress,
    heading,
    legend,
    place,
    put,
    sheet,
    styled,
)
from derail_ros.studies.ensemble import VARIATION
from derail_ros.studies.validation import KEYS, CaseResult, Validation
from derail_ros.vocabulary.measures import MEASURES
from derail_ros.vocabulary.words import capital, number_list
from research.mississauga import Details, PublishedDetails
from research.pages import BAND, PALE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from derail_ros.review.scene import Scene


def _diamond(label: str, **look: Any) -> Line2D:
    look = {"ls": "", "marker": "D", "mec": VERMILION, "mew": 1.3, "ms": 5.5} | look
    return Line2D([], [], label=label, **look)


# Published against computed ----------------------------------------------------------------


@styled
def published_against_computed(validation: Validation) -> Figure:
    """Draw every measure of every case: the ensemble's mean and band, the published value."""
    results = [*validation.cases, *validation.beside]
    keys = [k for k in KEYS if any(r.distributions[k].published is not None for r in results)]
    columns = 4
    lines = math.ceil((len(keys) + 1) / columns)
    names, top, under = 2.95, 0.98, 0.62
    tall = 0.255 * len(results)
    width = 14.4
    figure = sheet(width, top + lines * (tall + under) - 0.22)
    wide = (width - names - 0.15) / columns

    def corner(k: int) -> tuple[float, float]:
        return names + k % columns * wide, top + k // columns * (tall + under)

    for k, key in enumerate(keys):
        axes = place(figure, *corner(k), wide - 0.22, tall)
        _measure(axes, results, key, len(validation.cases))
        if k % columns == 0:
            axes.set_yticks(range(0, -len(results), -1), [r.case.title for r in results], size=8.5)
    heading(
        figure,
        "Published runs and ensembles",
        f"{validation.members} runs a case, the lateral force varied by up to "
        f"{100 * VARIATION:g} %",
    )
    left, upper = corner(len(keys))
    handles = [
        Line2D([], [], color=BAND, lw=7.5, solid_capstyle="butt", label="90 % band of the runs"),
        Line2D([], [], ls="", marker="o", color=BLUE, mec="white", ms=6, label="their mean"),
        _diamond("published, in the band", mfc=VERMILION),
        _diamond("published, outside", mfc="white"),
    ]
    legend(figure, left, upper, handles, ncol=1, fontsize=9, labelspacing=0.6)
    if validation.beside:
        text = "Below the dotted line: shown beside,\ncounts in no goal."
        put(figure, left, upper + 1.15, text, va="top")
    return figure


def _measure(axes: Axes, results: Sequence[CaseResult], key: str, counted: int) -> None:
    scale = MEASURES[key].scale
    most = 0.0
    for k, result in enumerate(results):
        d = result.distributions[key]
        if d.published is None:
            continue
        y, published = -k, d.published * scale
        if len(d.values):
            (low, high), mean = (scale * np.array(d.band)), d.mean * scale
            axes.plot([low, high], [y, y], color=BAND, lw=7.5, solid_capstyle="butt", zorder=2)
            axes.plot(mean, y, "o", ms=5, color=BLUE, mec="white", mew=0.6, zorder=4)
            axes.plot([mean, published], [y, y], color=FAINT, lw=0.8, ls=(0, (2, 2)), zorder=1.5)
            most = max(most, high)
        fill = VERMILION if d.inside else "white"
        axes.plot(published, y, "D", ms=5.5, mfc=fill, mec=VERMILION, mew=1.3, zorder=5)
        most = max(most, published)
    if counted < len(results):
        axes.axhline(-counted + 0.5, color=FAINT, lw=0.7, ls=(0, (1, 2)))
    dress(axes, "x", ("top", "right", "left"))
    axes.set_ylim(-len(results) + 0.5, 0.5)
    axes.set_yticks([])
    axes.set_xlim(0.0, 1.06 * most)
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.tick_params(length=0, labelsize=8)
    axes.set_title(MEASURES[key].title, size=9.5, loc="left", pad=4)


# Peak force on each car --------------------------------------------------------------------


@styled
def peaks_by_car(details: Details, published: PublishedDetails, title: str) -> Figure:
    """Draw the ensemble's peak force on each car beside what is published of it."""
    force = details.force * 1e-6
    known = published.by_car
    struck = np.flatnonzero(force.max(axis=0) > 0.0)
    last = max([int(struck[-1]) + 1 if len(struck) else 1, *published.above])
    force = force[:, :last]
    cars = np.arange(1, last + 1)
    figure = sheet(12.0, 5.4)
    axes = place(figure, 0.65, 1.35, 11.15, 3.5)
    low, quarter, middle, three, high = np.quantile(force, [0.05, 0.25, 0.5, 0.75, 0.95], axis=0)
    axes.bar(cars, high - low, bottom=low, width=0.34, color=PALE, lw=0, zorder=2)
    axes.bar(cars, three - quarter, bottom=quarter, width=0.62, color=BAND, lw=0, zorder=3)
    axes.plot(cars, middle, ls="", marker="_", ms=15, mew=2.0, color=BLUE, zorder=4)
    for car in cars:
        if car in known:
            look = {"marker": "D", "ms": 7, "mfc": VERMILION, "mec": "white", "mew": 0.8}
            axes.plot(car, known[car] * 1e-6, zorder=6, **look)
        else:
            y, mark = (10.6, "^") if car in published.above else (9.4, "v")
            axes.plot(car, y, mark, ms=8, mfc="white", mec=VERMILION, mew=1.5, zorder=6)
    dress(axes, "y")
    axes.axhline(10.0, color=INK, lw=1.0, ls=(0, (6, 3)), zorder=1)
    top = 1.12 * max(float(high.max()), max(known.values()) * 1e-6)
    axes.set_ylim(0.0, top)
    axes.set_xlim(0.3, last + 0.7)
    axes.set_xticks(cars)
    axes.set_xlabel("car")
    axes.set_ylabel("largest force at a corner, MN")
    share = details.share_above_10MN()[:last]
    for car in cars:
        above = car in published.above
        axes.text(
            car, 0.985 * top, f"{100 * share[car - 1]:.0f}", ha="center", va="top", size=8,
            weight="bold" if above else "normal", color=VERMILION if above else SUBTLE,
            bbox={"boxstyle": "square,pad=0.1", "fc": "white", "ec": "none", "alpha": 0.8},
        )  # fmt: skip
    pairs = "; ".join(
        f"{p.pair[0]} into {p.pair[1]} {p.force * 1e-6:.2f}" for p in published.peaks
    )
    heading(
        figure,
        f"{title}: peak force on each car",
        f"{len(force)} runs. At the top: the share of them (%) in which the car is struck above "
        "10 MN, bold where it is in the published run.",
    )
    put(figure, 0.3, 0.8, f"Published largest forces, MN: {pairs}.", size=9.5)
    hollow = {"mfc": "white", "ms": 8, "mew": 1.5}
    handles = [
        Line2D([], [], ls="", marker="_", mew=2.0, ms=12, color=BLUE, label="median"),
        Patch(fc=BAND, label="middle half"),
        Patch(fc=PALE, label="middle 90 %"),
        _diamond("published", mfc=VERMILION, mec="white", ms=7),
        _diamond("published only as above 10 MN", marker="^", **hollow),
        _diamond("below 10 MN", marker="v", **hollow),
    ]
    legend(figure, 0.65, 0.99, handles, columnspacing=1.5)
    return figure


# Scenes ------------------------------------------------------------------------------------

STANDING = 1.0
"""A car slower than this stands, m/s."""


@styled
def scene_series(details: Details, published: PublishedDetails, title: str) -> Figure:
    """Draw the scenes one above the other in the same window, with the cars' velocities."""
    times = sorted(details.scenes)
    points = np.concatenate(
        [
            s.corners()[s.derailed & (s.represents == 1)].reshape(-1, 2)
            for s, _ in details.scenes.values()
        ]
    )
    # the derailed cars of all scenes and a car length behind them
    low, high = points.min(axis=0) - (22.0, 5.0), points.max(axis=0) + (6.0, 5.0)
    columns, caption, top = 2, 0.5, 0.85
    width = 13.0
    wide = (width - 0.6 - 0.25) / columns
    tall = wide * (high[1] - low[1]) / (high[0] - low[0])
    lines = math.ceil(len(times) / columns)
    figure = sheet(width, top + lines * (tall + caption) + 0.45)
    for k, t in enumerate(times):
        scene, velocity = details.scenes[t]
        left, upper = 0.3 + k % columns * (wide + 0.25), top + k // columns * (tall + caption)
        axes = place(figure, left, upper + caption, wide, tall)
        _scene(axes, scene, velocity, (low, high), 72.0 * wide / (high[0] - low[0]))
        speed = np.hypot(velocity[:, 0], velocity[:, 1])
        standing = np.flatnonzero((speed < STANDING) & scene.derailed) + 1
        at = upper + caption
        put(figure, left, at - 0.3, f"{t:.1f} s", size=11, weight="bold", color=INK)
        cars = number_list(standing.tolist())
        put(figure, left + 0.62, at - 0.3, f"standing here: {cars}", color=INK)
        text = f"published: {published.scenes[t]}"
        put(figure, left + 0.62, at - 0.12, text, color=VERMILION)
    heading(
        figure,
        f"{title}: the pile grows",
        f"The run itself. Arrows: velocity, 1 m for 1 m/s; a car without an arrow stands (below "
        f"{STANDING:g} m/s). The dark end is the front.",
    )
    handles = [
        Patch(fc=fill, ec=INK, hatch=hatch or None, lw=0.8, label=capital(label))
        for label, fill, hatch in STATES
    ]
    legend(figure, 0.3, top + lines * (tall + caption) + 0.15, handles, handleheight=1.1)
    return figure


def _scene(
    axes: Axes,
    scene: Scene,
    velocity: NDArray[np.float64],
    window: tuple[NDArray[np.float64], NDArray[np.float64]],
    points_per_metre: float,
) -> None:
    low, high = window
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_xticks([])
    axes.set_yticks([])
    for side in (-0.72, 0.72):
        axes.axhline(side, color=RAIL, lw=0.8, zorder=0.5)
    for x, _, _ in scene.breaks:
        axes.plot([x, x], [-2.6, 2.6], color=VERMILION, lw=2.2, zorder=6, solid_capstyle="butt")
    draw_bodies(axes, scene, 0.7)
    draw_fronts(axes, scene)
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    size = float(np.clip(0.6 * 2.6 * points_per_metre, 4.5, 8.0))
    for i in np.flatnonzero(scene.represents == 1):
        at = scene.pose[i, :2]
        if not (low < at).all() or not (at < high).all():
            continue
        if speed[i] >= STANDING:
            arrow = {"arrowstyle": "-|>", "color": BLUE, "lw": 1.2, "shrinkA": 0, "shrinkB": 0}
            axes.annotate("", at + velocity[i], at, arrowprops={**arrow, "mutation_scale": 8},
                          zorder=8, annotation_clip=True)  # fmt: skip
        axes.text(
            *at, str(scene.numbers[i]), size=size, weight="bold", ha="center",
            va="center_baseline", zorder=10, clip_on=True,
            bbox={"boxstyle": "round,pad=0.1", "fc": "white", "ec": "none", "alpha": 0.85},
        )  # fmt: skip
    x0, y0, bar = low[0] + 3.0, low[1] + 2.5, 20.0
    axes.plot([x0, x0 + bar], [y0, y0], color=INK, lw=2.0, solid_capstyle="butt", zorder=11)
    axes.text(x0 + 0.5 * bar, y0 + 0.8, f"{bar:g} m", ha="center", va="bottom", size=7.5)
