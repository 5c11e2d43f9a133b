"""Figures of a run: the final scene from above and the peak force on each car."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator

from derail_ros.review import drawing
from derail_ros.review.drawing import (
    BLUE,
    FAINT,
    INK,
    RAIL,
    SUBTLE,
    WIDTH,
    Window,
    hatched,
    mark,
    styled,
)
from derail_ros.vocabulary.limits import KNUCKLE, SILL
from derail_ros.vocabulary.status import CERTAIN_RUPTURE_FORCE, RUPTURE_FORCE
from derail_ros.vocabulary.words import cars

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from derail_ros.review.scene import Scene
    from derail_ros.vocabulary.outcome import Outcome

# The scene ---------------------------------------------------------------------------------


@styled
def final_scene(scene: Scene) -> Figure:
    """Draw the scene to scale from above, the pile-up large, the whole train in a strip below."""
    window = drawing.with_areas(drawing.site(scene), scene)
    inner = WIDTH - 1.0
    aspect = (window[3] - window[2]) / (window[1] - window[0])
    tall = float(np.clip(inner * aspect, 3.2, 8.0))
    window = drawing.fit(window, tall / inner)

    everything = drawing.window_of(scene.corners(), 8.0)
    span = everything[1] - everything[0]
    strip = span > 2.0 * (window[1] - window[0])
    strip_tall = 0.0
    if strip:
        strip_tall = float(np.clip(inner * (everything[3] - everything[2]) / span, 0.42, 2.4))
        everything = drawing.fit(everything, strip_tall / inner)

    top, key = 0.78, 0.42
    height = top + tall + key + (strip_tall + 0.41 if strip else 0.0)
    figure = drawing.sheet(WIDTH, height)
    axes = drawing.place(figure, 0.5, top, inner, tall)
    drawing.show(axes, window)
    points_per_metre = inner * 72.0 / (window[1] - window[0])
    drawing.draw_track(axes, scene, window, points_per_metre)
    drawing.draw_cars(axes, scene, window, points_per_metre)
    drawing.draw_box(axes, scene)
    drawing.draw_scale(figure, window, scene.travel)
    drawing.heading(figure, scene.title, scene.subtitle, fits=60)
    drawing.draw_key(figure, [scene], 0.5, top + tall + 0.12, None if strip else window)
    if strip:
        below = drawing.place(figure, 0.5, height - 0.15 - strip_tall, inner, strip_tall)
        drawing.show(below, everything)
        _draw_strip(below, scene, window, everything, inner)
        note = f"Whole train, {drawing.metres(span)} shown; the frame is the picture above"
        drawing.put(figure, 0.5, height - strip_tall - 0.22, note, size=8, va="bottom")
    return figure


EVERY = (1, 2, 5, 10, 20, 50, 100)
"""Every so many cars are numbered."""


def _draw_strip(
    axes: Axes, scene: Scene, window: Window, everything: Window, inches: float
) -> None:
    for line in (scene.track, *(part.points for part in scene.site if part.role == "track")):
        axes.plot(line[:, 0], line[:, 1], color=RAIL, lw=0.8, zorder=1)
    drawing.draw_bodies(axes, scene, 0.4, zorder=3, with_hatch=False)
    drawing.draw_stand_ins(axes, scene, 0.6, 2)
    x0, x1, y0, y1 = window
    y0, y1 = max(y0, everything[2]), min(y1, everything[3])
    axes.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, ec=BLUE, lw=1.2, zorder=5))
    points_per_metre = inches * 72.0 / (everything[1] - everything[0])
    every = max(1, math.ceil(44.0 / (points_per_metre * float(np.median(scene.length)))))
    every = next((e for e in EVERY if e >= every), every)
    for i in np.flatnonzero(scene.real & ~scene.derailed):
        if scene.numbers[i] % every == 0:
            axes.annotate(
                str(scene.numbers[i]),
                xy=tuple(scene.pose[i, :2]),
                xytext=(0, 4),
                textcoords="offset points",
                ha="center",
                va="bottom",
                size=6.5,
                color=SUBTLE,
            )


# Peak forces -------------------------------------------------------------------------------

LEVELS: tuple[tuple[str, str, str], ...] = (
    ("below 5 MN", "#9ecae9", ""),
    ("5 to 10 MN", "#f0b13c", "////"),
    ("above 10 MN", "#d55e00", "xxxx"),
)
LIMITS = (
    (RUPTURE_FORCE * 1e-6, "5 MN\nhas ruptured\ntank cars"),
    (CERTAIN_RUPTURE_FORCE * 1e-6, "10 MN\ncertain\nrupture"),
)


@styled
def peak_forces(outcome: Outcome, title: str = "") -> Figure:
    """Draw the largest corner force on each car, with the car on the other side of it.

    ``title`` is what ran.
    """
    force = np.nan_to_num(outcome.car_peak_force) * 1e-6
    derailed = (*outcome.derailed_cars, *outcome.standing.derailed)
    n = len(force)
    struck = np.flatnonzero(force > 0.0)
    involved = [*(struck + 1).tolist(), *derailed] or [1, min(n, 10)]
    first, last = max(1, min(involved) - 2), min(n, max(involved) + 2)
    first = 1 if first < 8 else first
    shown = last - first + 1
    figure = drawing.sheet(WIDTH, 4.9)
    axes = drawing.place(figure, 0.75, 0.95, WIDTH - 1.7, 3.35)
    drawing.dress(axes, grid="y")
    numbers = np.arange(first, last + 1)
    here = force[first - 1 : last]
    level = np.digitize(here, [limit for limit, _ in LIMITS])
    handles: list[Any] = []
    for k, (label, fill, hatch) in enumerate(LEVELS):
        chosen = (level == k) & (here > 0.0)
        look = {"color": fill, "edgecolor": INK, "linewidth": 0.7, "hatch": hatch or None}
        axes.bar(numbers[chosen], here[chosen], width=0.74, zorder=3, **look)
        if len(struck):
            handles.append(hatched(f"{label} ({chosen.sum()})", fill, hatch, lw=0.7))
    for value, text in LIMITS:
        axes.axhline(value, color=INK, lw=1.0, ls=(0, (6, 3)), zorder=2)
        axes.annotate(
            text,
            xy=(1.0, value),
            xycoords=("axes fraction", "data"),
            xytext=(6, 0),
            textcoords="offset points",
            va="center",
            size=8,
            annotation_clip=False,
        )
    with_time = shown <= 28
    size = 6.5 if shown > 45 else 8
    for i in struck:
        text = f"{outcome.car_peak_other[i]}"
        text += f"\n{outcome.car_peak_time[i]:.1f} s" if with_time else ""
        look = {"va": "bottom", "size": size, "linespacing": 1.05, "zorder": 5}
        drawing.label(axes, text, (i + 1, force[i]), (0, 2), **look)
    axes.set_xlim(first - 0.7, last + 0.7)
    axes.set_ylim(0.0, max(float(force.max(initial=0.0)) * 1.16, 11.5))
    axes.yaxis.set_major_locator(MaxNLocator(8, steps=[1, 2, 5, 10]))
    every = next(e for e in EVERY if shown / e <= 45)
    axes.set_xticks([c for c in numbers if c % every == 0])
    axes.set_xlabel("car")
    axes.set_ylabel("largest force at a corner, MN")
    own = n - outcome.standing.cars
    if last > own:
        axes.axvspan(own + 0.5, last + 0.7, color=drawing.GREEN, alpha=0.12, zorder=0)
        handles.append(hatched("not of the train", "#e0f1ec", "", lw=0.0))
    if derailed:
        square: dict[str, Any] = {"ls": "", "marker": "s", "ms": 5, "color": INK}
        axes.plot(list(derailed), np.zeros(len(derailed)), clip_on=False, zorder=6, **square)
        handles.append(mark("derailed", **square))
    note = "No car was struck."
    if len(struck):
        note = "Above each bar: the car on the other side"
        note += " and the time of the peak." if with_time else "."
        hidden = [c for c in range(1, n + 1) if not first <= c <= last]
        if hidden:
            note += f" Not struck and not shown: {cars(hidden)}."
    else:
        middle = {"transform": axes.transAxes, "ha": "center"}
        axes.text(0.5, 0.5, "no collisions", size=12, color=FAINT, **middle)
    drawing.legend_above(axes, handles, 5)
    heading = f"{title}: peak force on each car" if title else "Peak force on each car"
    drawing.heading(figure, heading, note, left=0.75)
    return figure


# Forces in the train -----------------------------------------------------------------------

DRAFT, BUFF = (BLUE, "largest draft (tension)"), ("#e69f00", "largest buff (compression)")


@styled
def in_train_forces(outcome: Outcome, title: str = "") -> Figure:
    """Draw the largest draft and buff force of each coupling over the train."""
    draft, buff = (
        np.nan_to_num(outcome.of_train(outcome.couplings[f"max_{which}_N"])) * 1e-6
        for which in ("draft", "buff")
    )
    numbers = np.arange(1, len(draft) + 1)
    figure = drawing.sheet(WIDTH, 4.3)
    axes = drawing.place(figure, 0.75, 0.95, WIDTH - 1.7, 2.75)
    drawing.dress(axes, grid="y")
    axes.axhline(0.0, color=INK, lw=0.8, zorder=4)
    handles: list[Any] = []
    for values, sign, (fill, name) in ((draft, 1.0, DRAFT), (buff, -1.0, BUFF)):
        axes.bar(numbers, sign * values, width=0.84, color=fill, zorder=3)
        handles.append(hatched(name, fill, "", lw=0.0))
    borne = ((draft, KNUCKLE, 1.0, "knuckles\nbreak"), (buff, SILL, -1.0, "cars are\ntested to"))
    for values, level, sign, text in borne:
        if values.max(initial=0.0) > level * 1e-6:
            at = sign * level * 1e-6
            axes.axhline(at, color=INK, lw=1.0, ls=(0, (6, 3)), zorder=5)
            beside = {"xycoords": ("axes fraction", "data"), "textcoords": "offset points"}
            axes.annotate(f"{level * 1e-6:.2f} MN\n{text}", xy=(1.0, at), xytext=(6, 0),
                          va="center", size=8, annotation_clip=False, **beside)  # fmt: skip
    parted = [p.coupling for p in outcome.parted]
    if parted:
        cross: dict[str, Any] = {"ls": "", "marker": "x", "ms": 7, "mew": 1.6, "color": INK}
        axes.plot(parted, np.zeros(len(parted)), zorder=6, **cross)
        handles.append(mark("parted", **cross))
    axes.set_xlim(0.3, len(draft) + 0.7)
    most = max(draft.max(initial=0.1), buff.max(initial=0.1))
    axes.set_ylim(-1.15 * max(buff.max(initial=0.0), 0.1 * most),
                  1.15 * max(draft.max(initial=0.0), 0.1 * most))  # fmt: skip
    axes.xaxis.set_major_locator(MaxNLocator(12, integer=True))
    axes.set_xlabel("coupling (behind the car of that number)")
    axes.set_ylabel("force, MN")
    parts = []
    for which in ("draft", "buff"):
        force, coupling, time = outcome.largest(which)
        if coupling:
            parts.append(f"{which} {force * 1e-6:.2f} MN in coupling {coupling} at {time:.1f} s")
    note = f"Largest: {'; '.join(parts)}." if parts else "No coupling carried a force."
    drawing.legend_above(axes, handles, 3)
    heading = f"{title}: forces in the train" if title else "Forces in the train"
    drawing.heading(figure, heading, note, left=0.75)
    return figure


def save_outcome(scene: Scene, outcome: Outcome, folder: Path) -> list[Path]:
    """Write the figures of every run: final scene, peak forces, forces in the train."""
    figures = {
        "final_scene": final_scene(scene),
        "peak_forces": peak_forces(outcome, scene.title),
    }
    if outcome.couplings and len(outcome.couplings["max_draft_N"]):
        figures["in_train_forces"] = in_train_forces(outcome, scene.title)
    return [drawing.save(drawn, folder / f"{name}.png") for name, drawn in figures.items()]
