"""The picture of a prediction."""

from __future__ import annotations

from textwrap import wrap
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.patches import Polygon

from derail_ros.predict import scores
from derail_ros.predict.prediction import BANDS, Prediction, of_distribution, of_values
from derail_ros.predict.runs import CAUSES
from derail_ros.predict.statistical import WORDS
from derail_ros.review import drawing
from derail_ros.review.drawing import (
    BLUE,
    INK,
    SUBTLE,
    VERMILION,
    dress,
    heading,
    place,
    put,
    sheet,
    styled,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from derail_ros.predict.reconstruct import Reconstruction
    from derail_ros.review.scene import Scene

PALE, FEW_COLOUR, GREY = "#9ecae9", "#f0b13c", "#8a8a8a"


@styled
def picture(found: Prediction, title: str) -> Figure:
    """How often how many cars derail, and the bands of the engine and of statistics."""
    page = sheet(7.2, 6.6)
    t = found.train
    heading(
        page, title,
        f"{t.speed * 3.6:.0f} km/h, {t.behind} cars from the break to the end, "
        f"{t.mass / 1e3:.0f} t a car, {CAUSES[found.cause]}; constants: {found.constants}",
        fits=52,
    )  # fmt: skip
    counts = found.output("derailed")
    few = np.array([m.few > 0 for m in found.drawn])
    good = np.isfinite(counts)
    top = int(max(counts[good].max(), *(scores.quantile(p, 0.97) for p in
                                        found.statistical.values()))) + 2  # fmt: skip
    axes = place(page, 0.75, 0.95, 6.2, 2.75)
    edges = np.arange(0.5, top + 1.0)
    share = 100.0 / good.sum()
    pile, _ = np.histogram(counts[good & ~few], edges)
    less, _ = np.histogram(counts[good & few], edges)
    k = np.arange(1, top + 1)[: len(pile)]
    axes.bar(k, share * less, width=0.9, color=FEW_COLOUR, hatch="....", edgecolor="white",
             lw=0.0, label="dragged along in line, no pile-up")  # fmt: skip
    axes.bar(k, share * pile, width=0.9, bottom=share * less, color=BLUE, label="a pile-up")
    dress(axes, "y")
    axes.set_ylabel("share of such accidents, %")
    axes.set_xlim(0.0, top)
    drawing.legend_above(axes, axes.containers[:2], 2, fontsize=9)

    bands = place(page, 0.75, 4.25, 6.2, 1.5)
    rows = [("this model", of_values(counts), BLUE)]
    rows += [(WORDS[kind], of_distribution(p), GREY) for kind, p in found.statistical.items()]
    for i, (words, d, colour) in enumerate(rows):
        v = {key: float(d[key] or 0.0) for key in (*BANDS, "mean")}
        bands.barh(-i, v["q95"] - v["q05"], left=v["q05"], height=0.24, color=colour, alpha=0.35)
        bands.barh(-i, v["q75"] - v["q25"], left=v["q25"], height=0.24, color=colour)
        bands.plot([v["q50"]] * 2, [-i - 0.16, -i + 0.16], color="white", lw=1.8)
        bands.text(v["q05"], -i + 0.2, words, size=8.5, va="bottom", color=INK)
    bands.set_ylim(-len(rows) + 0.5, 0.75)
    bands.set_yticks([])
    bands.set_xlim(0.0, top)
    bands.set_xlabel("cars derailed (bands: 50 and 90 %, line: median)")
    dress(bands, "x", ("top", "right", "left"))
    page.text(0.105, 0.012, "One accident is like one of these runs.", size=8.5, color=SUBTLE)
    return page


QUANTITIES = {
    "speed_kmh": "speed, km/h",
    "brake_delay_s": "brake delay, s",
    "brake_force_factor": "brake force (factor)",
    "ground_factor": "ground reaction (factor)",
}


@styled
def reconstruction_picture(found: Reconstruction, scenes: Sequence[Scene]) -> Figure:
    """The inferred quantities, before and after, and the likeliest scenes beside the evidence."""
    known = found.evidence.known
    length, width = (known.get(f"scene_{k}_m", (np.nan, 0.0))[0] for k in ("length", "width"))
    boxes = [_known_extent(s, length, width) for s in scenes]
    windows = [
        drawing.window_of(np.concatenate([_derailed(s), b]), 5.0)
        for s, b in zip(scenes, boxes, strict=True)
    ]
    wide = max((w[1] - w[0] for w in windows), default=1.0)
    tall = max((w[3] - w[2] for w in windows), default=1.0)
    each = 6.7 * tall / wide
    more = " (taken as ± {:.3g})" if found.widened > 1.0 else ""
    told = "\n".join(
        f"{k.replace('_', ' ').removesuffix(' m').removesuffix(' s')}: {v:.4g} ± {e:.3g}"
        + (" m" if k.endswith("_m") else " s" if k.endswith("_s") else "")
        + more.format(e * found.widened)
        for k, (v, e) in known.items()
    )
    said = "\n".join(line for text in found.warnings() for line in wrap(text, 76))
    step = 0.18
    head = 0.55
    lines = [(said, VERMILION, "bold"), (told, INK, "normal")]
    height = sum(step * (text.count("\n") + 1) + 0.08 for text, *_ in lines if text)
    top = 4.25 + head + height
    page = sheet(7.2, top + len(scenes) * (each + 0.4))
    heading(page, found.evidence.title, "", left=0.25, fits=52)
    for text, colour, weight in lines:
        if text:
            put(page, 0.25, head, text, size=10.5 if weight == "bold" else 11, va="top",
                color=colour, weight=weight, linespacing=1.15)  # fmt: skip
            head += step * (text.count("\n") + 1) + 0.08
    values = found.quantities()
    below = page.get_figheight() - top + 0.65
    axes = drawing.grid_of(page, 4, 2, (0.45, 0.25, head + 0.6, below, 0.5, 0.95))
    for one, (key, words) in zip(axes, QUANTITIES.items(), strict=True):
        x = values[key]
        edges = np.linspace(x.min(), np.quantile(x, 0.99), 16)
        even = np.full(len(x), 100.0 / len(x))
        one.hist(x, edges, weights=even, color="#c9c9c9")
        one.hist(x, edges, weights=100.0 * found.weights, histtype="step", color=BLUE, lw=2.2)
        one.set_title(words, loc="left", size=12, weight="bold")
        one.tick_params(labelsize=11)
        one.set_yticks([])
        dress(one, "x", ("top", "right", "left"))
    put(page, 0.25, head + 0.1, "grey: before, blue: with the evidence", size=11)
    dashed = "; dashed: the known extent" if length > 0.0 and width > 0.0 else ""
    if scenes:
        put(page, 0.25, top - 0.05, f"The likeliest scenes{dashed}", size=12)
    for k, (scene, window, box) in enumerate(zip(scenes, windows, boxes, strict=True)):
        at = top + k * (each + 0.4)
        one = place(page, 0.25, at + 0.35, 6.7, each)
        middle = 0.5 * (window[0] + window[1]), 0.5 * (window[2] + window[3])
        shown = (middle[0] - 0.5 * wide, middle[0] + 0.5 * wide, middle[1] - 0.5 * tall,
                 middle[1] + 0.5 * tall)  # fmt: skip
        drawing.show(one, shown)
        drawing.draw_track(one, scene, shown, 6.7 * 72.0 / wide)
        drawing.draw_bodies(one, scene, 0.7)
        if len(box):
            one.add_patch(Polygon(box, fill=False, ec=VERMILION, lw=1.6, ls=(0, (5, 3)),
                                  zorder=12))  # fmt: skip
        drawing.scale_inside(one, shown, 0.2, 1.2, scene)
        put(page, 0.25, at + 0.18, scene.subtitle, size=11)
    return page


def _derailed(scene: Scene) -> NDArray[np.float64]:
    """Corners of the derailed cars, of all if there are none, (n, 2)."""
    off = scene.derailed & scene.real
    return scene.corners()[off if off.any() else scene.real].reshape(-1, 2)


def _known_extent(scene: Scene, length: float, width: float) -> NDArray[np.float64]:
    """Outline of a known extent about the derailed cars by the track, (n, 2); empty without one.

    Along a curve its long sides run with the track, as the computed extent is measured.
    """
    if not (length > 0.0 and width > 0.0):
        return np.zeros((0, 2))
    points = _derailed(scene)
    a, along = scene.track[:-1], np.diff(scene.track, axis=0)
    size = np.linalg.norm(along, axis=1)
    start = np.concatenate([[0.0], np.cumsum(size)])
    unit = along / size[:, None]
    away = points[:, None] - a
    s = np.clip((away * unit).sum(axis=2), 0.0, size)
    gap = np.linalg.norm(away - s[..., None] * unit, axis=2)
    k, n = gap.argmin(axis=1), np.arange(len(points))
    place = start[k] + s[n, k]
    normal = np.stack([-unit[:, 1], unit[:, 0]], axis=1)
    side = (away[n, k] * normal[k]).sum(axis=1)
    middle, across = 0.5 * (place.min() + place.max()), 0.5 * (side.min() + side.max())
    line = np.linspace(middle - 0.5 * length, middle + 0.5 * length, 41)
    j = np.clip(np.searchsorted(start, line, "right") - 1, 0, len(size) - 1)
    at = a[j] + (line - start[j])[:, None] * unit[j]
    sides = drawing.beside(at, (across + 0.5 * width, across - 0.5 * width))
    return np.concatenate([sides[0], sides[1][::-1]])
