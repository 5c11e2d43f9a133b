"""Figures of models side by side: final scenes with counts, and counts over the speed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.patches import Patch

from derail_ros.baselines.comparison import Entry, cell
from derail_ros.review.drawing import (
    BLUE,
    FAINT,
    GREEN,
    INK,
    RAIL,
    STATES,
    VERMILION,
    draw_bodies,
    dress,
    place,
    put,
    sheet,
    styled,
)
from derail_ros.review.plots import apart
from derail_ros.studies.drawing import ORANGE, with_bars
from derail_ros.vocabulary.measures import MEASURES
from derail_ros.vocabulary.params import PLANAR
from derail_ros.vocabulary.status import AT_REST

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from derail_ros.review.scene import Scene

LINES: dict[str, tuple[str, str, str]] = {
    PLANAR: (BLUE, "-", "o"),
    "yang-manos": (ORANGE, "-", "s"),
    "anderson": (GREEN, "-", "^"),
    "roorda-gracie": ("#cc79a7", "-", "D"),
    "blockage": (INK, "--", "v"),
    "bar-1": (FAINT, ":", "x"),
    "bar-2": (FAINT, "--", "+"),
    "bar-2-corrected": (FAINT, "-.", "1"),
    "bar-3": (VERMILION, "--", "2"),
    "bar-3-corrected": (VERMILION, ":", "3"),
}
"""Colour, line and mark of each model."""


def _window(scene: Scene) -> tuple[float, float, float, float]:
    corners = scene.corners()[scene.derailed & (scene.represents == 1)].reshape(-1, 2)
    if not len(corners):
        corners = scene.corners()[:3].reshape(-1, 2)
    low, high = corners.min(axis=0), corners.max(axis=0)
    return float(low[0]), float(high[0]), float(low[1]), float(high[1])


def _words(entry: Entry) -> str:
    """A model's outcome above its scene."""
    record = entry.record
    assert record is not None
    parts = [f"{cell(record, 'cars_derailed')} cars"]
    for key, form in (("duration_s", "{:.1f} s"), ("peak_force_N", "{:.1f} MN")):
        if record[key] is not None:
            parts.append(form.format(record[key] * MEASURES[key].scale))
    parts.insert(2, f"{record['scene_length_m']:.0f} x {record['scene_width_m']:.0f} m")
    if record["status"] != AT_REST:
        parts.append(record["status"])
    return f"{entry.model}:  {',  '.join(parts)}"


@styled
def figure(
    title: str,
    entries: Sequence[Entry],
    counts: Mapping[str, float] | None = None,
    published: float | None = None,
) -> Figure:
    """Final scenes to one scale, one above the other, and the counts of all models beside.

    ``counts`` are shown instead of those of the entries (means of ensembles); a ``published``
    count is a line across them.
    """
    scenes = [(e, e.run.scene) for e in entries if e.run is not None and e.run.scene is not None]
    counted = [e for e in entries if e.record and e.record["cars_derailed"] is not None]
    windows = [_window(s) for _, s in scenes]
    x0 = min((w[0] for w in windows), default=0.0) - 10.0
    x1 = max((w[1] for w in windows), default=1.0) + 10.0
    left, right, width = 0.25, 3.55, 12.0
    inner = width - left - right - 0.2
    scale = inner / (x1 - x0)
    top, gap, foot = 0.75, 0.36, 0.5
    tall = [max(w[3] - w[2] + 8.0, 16.0) * scale for w in windows]
    height = max(top + sum(tall) + gap * len(tall) + foot, 3.2)
    page = sheet(width, height)
    put(page, left, 0.25, title, size=13, weight="bold", color=INK)
    upper = top
    for (entry, scene), window, panel in zip(scenes, windows, tall, strict=True):
        axes = place(page, left, upper, inner, panel)
        middle, half = 0.5 * (window[2] + window[3]), 0.5 * panel / scale
        _draw_scene(axes, scene, (x0, x1, middle - half, middle + half))
        put(page, left, upper - 0.11, _words(entry), size=9.5, color=INK)
        upper += panel + gap
    if scenes:
        bar = 50.0 if x1 - x0 > 150.0 else 20.0
        axes = place(page, left, height - 0.44, inner, 0.36)
        axes.set_axis_off()
        axes.set_xlim(0.0, inner)
        axes.set_ylim(0.0, 0.36)
        axes.plot([0.05, 0.05 + bar * scale], [0.2, 0.2], color=INK, lw=2.5)
        axes.text(0.12 + bar * scale, 0.2, f"{bar:g} m", va="center", size=8.5)
        handles = [
            Patch(fc=fill, ec=INK, hatch=hatch or None, lw=0.6, label=label)
            for label, fill, hatch in STATES
        ]
        axes.legend(handles=handles, loc="center right", ncol=3, frameon=False, fontsize=8.5,
                    borderaxespad=0.0, handlelength=1.6, columnspacing=1.2)  # fmt: skip
    beside = width - right + 1.35
    high = min(0.36 * len(counted), height - top - 0.75)
    axes = place(page, beside, top, right - 1.35 - 0.55, high)
    known = {e.model: float(e.record["cars_derailed"]) for e in counted if e.record}
    _draw_counts(axes, known | {m: n for m, n in (counts or {}).items() if m in known},
                 {e.model for e, _ in scenes}, published)  # fmt: skip
    words = "cars derailed" if counts is None else "cars derailed, mean"
    put(page, beside, top - 0.11, words, size=9.5, color=INK)
    put(page, beside, top + high + 0.16, "grey: models without a plane", size=8, color=FAINT)
    if published is not None:
        text = f"dashed: published, {published:g}"
        put(page, beside, top + high + 0.36, text, size=8, color=VERMILION)
    return page


def _draw_scene(axes: Axes, scene: Scene, window: tuple[float, float, float, float]) -> None:
    x0, x1, *_ = window
    axes.set_xlim(*window[:2])
    axes.set_ylim(*window[2:])
    axes.set_xticks([])
    axes.set_yticks([])
    line = scene.track
    if scene.straight:
        line = np.array([[x0, line[0, 1]], [x1, line[0, 1]]])
    axes.plot(line[:, 0], line[:, 1], color=RAIL, lw=1.2, zorder=1)
    for x, y, psi in scene.breaks:
        n = 4.0 * np.array([-np.sin(psi), np.cos(psi)])
        axes.plot([x - n[0], x + n[0]], [y - n[1], y + n[1]], color=VERMILION, lw=2, zorder=6)
    draw_bodies(axes, scene, 0.5)
    shanks = np.stack([scene.pivots(), scene.faces()], axis=2)[scene.represents == 1]
    shanks = shanks.reshape(-1, 2, 2)
    axes.add_collection(LineCollection(list(shanks), colors=INK, linewidths=0.7, zorder=3))


def _draw_counts(
    axes: Axes, counts: Mapping[str, float], plane: set[str], published: float | None
) -> None:
    at = np.arange(len(counts))
    colours = [BLUE if m == PLANAR else ("#7cc3ee" if m in plane else "#c9c9c9") for m in counts]
    axes.barh(at, list(counts.values()), color=colours, edgecolor=INK, linewidth=0.6, height=0.68)
    longest = max([*counts.values(), published or 0.0, 1.0])
    for y, value in zip(at, counts.values(), strict=True):
        text = f"{value:.0f}" if value == round(value) else f"{value:.1f}"
        axes.text(1.24 * longest, y, text, va="center", ha="right", size=8.5)
    axes.set_yticks(at, list(counts), size=8.5)
    axes.set_ylim(len(counts) - 0.5, -0.5)
    axes.set_xlim(0.0, 1.25 * longest)
    if published is not None:
        axes.axvline(published, color=VERMILION, lw=1.4, ls=(0, (4, 2)))
    axes.tick_params(length=0)
    axes.set_xticks([])
    axes.spines[["top", "right", "bottom"]].set_visible(False)


# Over the speed -------------------------------------------------------------------------------


Points = Sequence[tuple[float, float]]


@styled
def by_speed_figure(
    title: str,
    speeds: Sequence[float],
    runs: Sequence[Sequence[Entry]],
    published: Points = (),
    lines: Sequence[tuple[str, Points]] = (),
    measured: tuple[str, Sequence[tuple[float, float, float]]] | None = None,
) -> Figure:
    """Cars derailed over the speed, one line a model, named at its end.

    ``published`` are points (km/h, cars); ``lines`` up to two further curves with their names;
    ``measured`` points with bars (km/h, cars, half of the bar) and their name.
    """
    page = sheet(9.0, 5.2)
    axes = place(page, 0.63, 0.57, 6.57, 4.06)
    curves: list[tuple[str, Points, str, Any, str]] = []
    for k, entry in enumerate(runs[0]):
        found = [
            (v, float(record["cars_derailed"]))
            for v, entries in zip(speeds, runs, strict=True)
            if (record := entries[k].record) is not None
        ]
        if found:
            curves.append((entry.model, found, *LINES[entry.model]))
    dashes = [(0, (1, 2)), (0, (6, 2, 1, 2))]
    for (name, points), dash in zip(lines, dashes, strict=False):
        curves.append((name, points, FAINT, dash, ""))
    for name, points, colour, line, mark in curves:
        thick = 2.2 if name == PLANAR else 1.4
        axes.plot(*zip(*points, strict=True), color=colour, ls=line, marker=mark, ms=6, lw=thick)
    if published:
        axes.plot(*zip(*published, strict=True), ls="", marker="*", ms=15, mfc="white",
                  mec=VERMILION, mew=1.6, zorder=6, label="published")  # fmt: skip
    if measured is not None:
        with_bars(axes, *zip(*measured[1], strict=True), color=INK, ls="", marker="o", ms=6,
                    capsize=3, lw=1.4, zorder=5,
                    label=f"{measured[0]}, ± 2 standard errors")  # fmt: skip
    if published or measured is not None:
        axes.legend(loc="upper left", frameon=False, fontsize=9)
    high = axes.get_ylim()[1]
    axes.set_ylim(0.0, high)
    # Names at the ends of the lines, moved apart where they would overlap.
    ends = sorted(
        (points[-1][1], points[-1][0], name, colour) for name, points, colour, *_ in curves
    )
    right = max(speeds)
    for (y, _, name, colour), at in zip(ends, apart([e[0] for e in ends], 0.042 * high),
                                        strict=True):  # fmt: skip
        axes.annotate(
            name, (right * 1.003, y), (right * 1.05, at), color=colour, size=9, va="center",
            annotation_clip=False,
            arrowprops={"arrowstyle": "-", "color": colour, "lw": 0.6, "shrinkA": 1, "shrinkB": 3,
                        "relpos": (0.0, 0.5)},
        )  # fmt: skip
    axes.set_xlabel("speed, km/h")
    axes.set_ylabel("cars derailed")
    dress(axes)
    put(page, 0.63, 0.31, title, size=12, weight="bold", color=INK)
    return page
