"""The kept members of an ensemble: where their cars lie, and pictures of all of them."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from derail_ros.review import drawing, maps
from derail_ros.review.drawing import BLUE, INK, SUBTLE, VERMILION, dress, place, sheet, styled
from derail_ros.studies.records import Ensemble
from derail_ros.vocabulary.measures import MEASURES, Measure, Record
from derail_ros.vocabulary.place import datum_of
from derail_ros.vocabulary.scene import car_corners
from derail_ros.vocabulary.words import capital

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from derail_ros.review.scene import Scene
    from derail_ros.scenario import Scenario
    from derail_ros.vocabulary.outcome import Outcome
    from derail_ros.vocabulary.params import Car

F64 = NDArray[np.float64]

SHOWN = ("cars_derailed", "cars_above_5MN", "scene_length_m", "scene_width_m", "peak_force_N",
         "duration_s")  # fmt: skip
"""Measures that have a histogram."""

MOST_INPUTS = 6
"""Inputs that have a histogram."""

WIDE = 7.2
"""Width of the pictures, inches; their letters are large enough for a telephone."""

STEPS = (0.01, 0.05, 0.25, 0.5, 0.75, 0.95)
OFTEN = 0.05
"""The picture shows all places that are covered in so many of the runs, and member 0."""
FILLS = ("#e8f1f8", "#c6dcee", "#94c0e0", "#5a9ccb", "#2775b0", "#0b3f73")
"""Probabilities of being covered from which on a cell has the next fill."""


class Members:
    """Final poses of the members of an ensemble, by their number."""

    def __init__(self) -> None:
        self.poses: dict[int, F64] = {}
        self.derailed: dict[int, tuple[int, ...]] = {}
        self.outlines: dict[int, F64] = {}

    def add(self, member: int, outcome: Outcome, cars: Sequence[Car]) -> None:
        """Keep the result of a member; void runs are left out."""
        if outcome.void:
            return
        derailed = (*outcome.derailed_cars, *outcome.standing.derailed)
        off = [car - 1 for car in derailed]
        size = np.array([(car.length, car.width) for car in cars])[off].reshape(-1, 2)
        self.poses[member], self.derailed[member] = outcome.pose, derailed
        self.outlines[member] = car_corners(outcome.pose[off], *size.T)[:, maps.ROUND]

    def footprints(self) -> list[F64]:
        """Outlines (K, 4, 2) of the derailed cars of each member, m."""
        return [self.outlines[m] for m in sorted(self.outlines)]

    def write(self, path: Path) -> None:
        """Write ``pose`` (members, cars, 6) and ``derailed`` (members, cars) as arrays of numpy.

        Members that failed or are void have nan and False.
        """
        members = 1 + max(self.poses, default=-1)
        cars = max(map(len, self.poses.values()), default=0)
        pose = np.full((members, cars, 6), math.nan)
        derailed = np.zeros((members, cars), dtype=bool)
        for m, poses in self.poses.items():
            pose[m, : len(poses)] = poses
            derailed[m, np.array(self.derailed[m], dtype=int) - 1] = True
        np.savez_compressed(path, pose=pose, derailed=derailed)


def write(
    output: Path, kept: Members, scenario: Scenario, scene: Scene, records: Sequence[Record],
    inputs: Sequence[Mapping[str, Any]],
) -> None:  # fmt: skip
    """Write poses, the map of where cars lie (GeoJSON, picture), and the histograms."""
    kept.write(output / "poses.npz")
    footprints = kept.footprints()
    if any(map(len, footprints)):
        on = maps.Map(datum_of(scenario.resolved().get("site")))
        features = maps.cover_features(maps.covered(footprints), len(footprints), on)
        text = json.dumps(on.collection(features))
        (output / "covered.geojson").write_text(text, encoding="utf-8")
        drawing.save(cover(scene, footprints), output / "covered.png")
    drawing.save(histograms(scenario.title, records, inputs), output / "histograms.png")


# Where cars lie ----------------------------------------------------------------------------


@styled
def cover(scene: Scene, footprints: Sequence[F64]) -> Figure:
    """The probability that a derailed car lies at a place; outlines are those of one run.

    Parameters
    ----------
    scene : the end of the run whose cars are drawn
    footprints : of each run the outlines (K, 4, 2) of its derailed cars, m
    """
    low, probability = maps.raster(footprints)
    high = low + maps.CELL * np.array(probability.shape)
    often = low + maps.CELL * np.argwhere(probability >= OFTEN)
    off = scene.outlines()[scene.derailed & scene.real]
    window = drawing.window_of(np.concatenate([often, off.reshape(-1, 2)]), 10.0)
    window = drawing.with_areas(window, scene)
    inner = WIDE - 0.5
    aspect = float(np.clip((window[3] - window[2]) / (window[1] - window[0]), 0.3, 1.3))
    window = drawing.fit(window, aspect)
    corner = np.array(window).reshape(2, 2).T
    tall = inner * aspect
    page = sheet(WIDE, 1.55 + tall + 0.45)
    title = "Where derailed cars lie"
    drawing.put(page, 0.25, 0.28, title, size=16, weight="bold", color=INK)
    about = f"{len(footprints)} runs of: {scene.title}"
    drawing.put(page, 0.25, 0.62, about, size=min(12.0, 12.0 * 62 / max(len(about), 1)))
    axes = place(page, 0.25, 1.5, inner, tall)
    drawing.show(axes, window)
    per_metre = inner * 72.0 / (window[1] - window[0])
    if scene.straight:
        ends = np.array([[window[0], 0.0], [window[1], 0.0]])
        scene = dataclasses.replace(scene, track=ends)
    drawing.draw_track(axes, scene, window, per_metre)
    seldom = np.where(probability < STEPS[0], math.nan, probability)
    axes.imshow(
        seldom.T, origin="lower", extent=(low[0], high[0], low[1], high[1]),
        cmap=ListedColormap(list(FILLS)),
        norm=BoundaryNorm([*STEPS, 1.0001], len(FILLS)), zorder=0.8, interpolation="nearest",
        alpha=0.9,
    )  # fmt: skip
    drawing.show(axes, window)
    for outline in off:
        axes.fill(*outline.T, facecolor="none", edgecolor=INK, lw=0.7, zorder=5)
    drawing.scale_inside(axes, window, 0.2, 1.3, scene)
    keys = [
        Patch(fc=fill, ec=INK, lw=0.5, label=f"{100 * step:.0f} %")
        for step, fill in zip(STEPS, FILLS, strict=True)
    ]
    drawing.legend(page, 0.25, 0.88, keys, fontsize=12, columnspacing=1.1, handlelength=1.4)
    note = "covered in so many of the runs at least; outlines: member 0"
    drawing.put(page, 0.25, 1.33, note, size=11)
    drawing.put(page, 0.25, 1.5 + tall + 0.2, "direction of travel:", size=11)
    frame = drawing.inches(page)
    drawing.draw_direction(frame, (2.25, 0.3), scene.travel, 0.3, 1.2)
    beyond = sum(bool((f < corner[0]).any() or (f > corner[1]).any()) for f in footprints)
    if beyond:
        words = f"{100 * beyond / len(footprints):.0f} % of the runs reach beyond"
        drawing.put(page, WIDE - 0.25, 1.5 + tall + 0.2, words, size=11, ha="right")
    return page


# Histograms --------------------------------------------------------------------------------


@styled
def histograms(
    title: str, records: Sequence[Record], inputs: Sequence[Mapping[str, Any]]
) -> Figure:
    """Histograms of measures, and below them of what was drawn; the line is the median."""
    found = Ensemble(tuple(records))
    panels: list[tuple[Measure | str, F64 | list[Any]]] = [
        (MEASURES[key], found.distribution(key).values * MEASURES[key].scale)
        for key in SHOWN
        if len(found.distribution(key).values)
    ]
    drawn = [draw for draw in inputs if draw]
    # those that differ between the members
    names = [n for n in (drawn[0] if drawn else {}) if len({str(d.get(n)) for d in drawn}) > 1]
    for name in names[:MOST_INPUTS]:
        panels.append((name, [d[name] for d in drawn if name in d]))
    rows = -(-len(panels) // 2)
    page = sheet(WIDE, 0.9 + 2.3 * rows)
    drawing.put(page, 0.3, 0.28, title, size=16 * min(1.0, 55 / max(len(title), 1)),
                weight="bold", color=INK)  # fmt: skip
    counts = [f"{len(found.good)} runs"]
    counts += [f"{n} {what}" for n, what in ((found.void, "void"), (found.failed, "failed")) if n]
    drawing.put(page, 0.3, 0.62, f"{', '.join(counts)}; line: median", size=12)
    axes = drawing.grid_of(page, len(panels), 2, (0.75, 0.25, 1.35, 0.45, 0.85, 1.1))
    for one, (what, values) in zip(axes, panels, strict=True):
        _histogram(one, what, values)
    return page


def short(value: float) -> str:
    """A number with three digits: 53.9 k, 4.45 M."""
    for size, letter in ((1e6, " M"), (1e3, " k")):
        if abs(value) >= size:
            return f"{value / size:.3g}{letter}"
    return f"{value:.3g}"


def _histogram(axes: Axes, what: Measure | str, values: Any) -> None:
    """One panel: the share of runs."""
    drawn = isinstance(what, str)
    words = f"drawn: {what}" if isinstance(what, str) else capital(what.title)
    colour = "#8a8a8a" if drawn else BLUE
    if any(isinstance(v, (str, bool)) for v in values):
        names = sorted({str(v) for v in values})
        share = [100.0 * sum(str(v) == n for v in values) / len(values) for n in names]
        axes.bar(range(len(names)), share, width=0.7, color=colour)
        axes.set_xticks(range(len(names)), names)
        note = ""
    else:
        x = np.asarray(values, dtype=float)
        whole = isinstance(what, Measure) and what.whole
        if whole and np.ptp(x) <= 40:
            edges = np.arange(x.min() - 0.5, x.max() + 1.0)
        else:
            edges = np.histogram_bin_edges(x, min(25, max(6, round(math.sqrt(len(x))))))
        axes.hist(x, edges, weights=np.full(len(x), 100.0 / len(x)), color=colour,
                  edgecolor="white", lw=0.6)  # fmt: skip
        q05, q50, q95 = np.quantile(x, (0.05, 0.5, 0.95))
        axes.axvline(q50, color=VERMILION, lw=2.0)
        note = f"{short(q50)}; nine of ten {short(q05)} to {short(q95)}"
        axes.xaxis.set_major_locator(MaxNLocator(4, integer=whole))
        axes.xaxis.set_major_formatter(lambda v, _: short(v))
    axes.set_title(f"{words}\n", loc="left", size=12 * min(1.0, 27 / len(words)), weight="bold")
    axes.text(0.0, 1.04, note, size=11, color=SUBTLE, transform=axes.transAxes)
    axes.yaxis.set_major_locator(MaxNLocator(3))
    axes.yaxis.set_major_formatter(lambda v, _: f"{v:.0f} %")
    axes.tick_params(labelsize=11)
    dress(axes, "y")
