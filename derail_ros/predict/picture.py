"""The picture of a prediction."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.patches import Rectangle

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
             lw=0.0, label="a few cars, dragged along (learned share)")  # fmt: skip
    axes.bar(k, share * pile, width=0.9, bottom=share * less, color=BLUE, label="a pile-up")
    dress(axes, "y")
    axes.set_ylabel("share of such accidents, %")
    axes.set_xlim(0.0, top)
    axes.legend(frameon=False, fontsize=9, loc="upper right")

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
    page.text(0.105, 0.012, "An accident is one draw from this.", size=8.5, color=SUBTLE)
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
    windows = [drawing.window_of(s.corners()[s.derailed & s.real], 5.0) for s in scenes]
    wide = max([w[1] - w[0] for w in windows] + [np.nan_to_num(length) + 10.0])
    tall = max([w[3] - w[2] for w in windows] + [np.nan_to_num(width) + 10.0])
    each = 6.7 * tall / wide
    top = 5.1
    page = sheet(7.2, top + len(scenes) * (each + 0.4))
    heading(page, found.evidence.title, "", left=0.25, fits=52)
    told = ", ".join(f"{k.replace('_', ' ')} {v:g} ± {e:g}" for k, (v, e) in known.items())
    put(page, 0.25, 0.62, f"known: {told}", size=min(11.0, 11.0 * 74 / max(len(told), 1)))
    values = found.quantities()
    axes = drawing.grid_of(page, 4, 2, (0.45, 0.25, 1.4, page.get_figheight() - 4.45, 0.5, 0.95))
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
    put(page, 0.25, 0.88, "grey: before, blue: with the evidence", size=11)
    dashed = "; dashed: the known extent" if length > 0.0 and width > 0.0 else ""
    put(page, 0.25, top - 0.05, f"The likeliest scenes{dashed}", size=12)
    for k, (scene, window) in enumerate(zip(scenes, windows, strict=True)):
        at = top + k * (each + 0.4)
        one = place(page, 0.25, at + 0.35, 6.7, each)
        middle = 0.5 * (window[0] + window[1]), 0.5 * (window[2] + window[3])
        shown = (middle[0] - 0.5 * wide, middle[0] + 0.5 * wide, middle[1] - 0.5 * tall,
                 middle[1] + 0.5 * tall)  # fmt: skip
        drawing.show(one, shown)
        drawing.draw_track(one, scene, shown, 6.7 * 72.0 / wide)
        drawing.draw_bodies(one, scene, 0.7)
        if np.isfinite(length) and np.isfinite(width):
            corner = middle[0] - 0.5 * length, middle[1] - 0.5 * width
            one.add_patch(Rectangle(corner, length, width, fill=False, ec=VERMILION, lw=1.6,
                                    ls=(0, (5, 3)), zorder=12))  # fmt: skip
        drawing.scale_inside(one, shown, 0.2, 1.2)
        put(page, 0.25, at + 0.18, scene.subtitle, size=11)
    return page
