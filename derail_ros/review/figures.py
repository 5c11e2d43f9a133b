"""Figures of a run: the final scene from above and the peak force on each car.

Drawn on matplotlib ``Figure`` objects of their own: pyplot, its global state and displays are not
touched. Colours are from Okabe and Ito's palette, and nothing is told by colour alone: states
also differ in hatch, forces in marks.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from derail_ros.review.scene import Scene

INK = "#222222"
FAINT = "#8a8a8a"
RAIL = "#9a9a9a"
GROUND = "#ffffff"
STAND_IN = "#f3f3f3"
VERMILION = "#d55e00"
BLUE = "#0072b2"

STATES: tuple[tuple[str, str, str], ...] = (
    ("on the rails", "#e3e6ea", ""),
    ("derailed, coupled", "#7cc3ee", "////"),
    ("derailed, uncoupled", "#f0b13c", "...."),
)
"""Label, fill and hatch of the states of a car."""

RUPTURE = 5.0e6
"""Force known to rupture a tank car, N."""

RUPTURE_CONSERVATIVE = 10.0e6
"""The source's own conservative limit, N."""

STYLE: dict[str, Any] = {
    "font.family": ["DejaVu Sans"],
    "font.size": 9.0,
    "axes.edgecolor": "#c8c8c8",
    "axes.linewidth": 0.8,
    "axes.labelcolor": INK,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "hatch.linewidth": 0.5,
    "path.simplify": False,
}

WIDTH = 12.0
"""Width of the figures, inches."""


def _figure(height: float) -> Figure:
    figure = Figure(figsize=(WIDTH, height), facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def save(figure: Figure, path: str | Path, dpi: int = 150) -> Path:
    """Write a figure, the kind of file taken from the name, and return its path."""
    path = Path(path)
    with matplotlib.rc_context(STYLE):
        figure.savefig(path, dpi=dpi, metadata={"Software": "derail_ros"})
    return path


def _headline(figure: Figure, x: float, y: float, text: str, fits: int) -> None:
    """A title; smaller if it has more letters than fit."""
    size = 14.0 * min(1.0, fits / max(len(text), 1))
    figure.text(x, y, text, size=size, weight="bold", va="center")


# The scene ---------------------------------------------------------------------------------


def final_scene(scene: Scene) -> Figure:
    """Draw the scene to scale from above, the pile-up large, the whole train in a strip below."""
    with matplotlib.rc_context(STYLE):
        return _final_scene(scene)


def _final_scene(scene: Scene) -> Figure:
    window = _pile_up(scene)
    inner = WIDTH - 1.0
    aspect = (window[3] - window[2]) / (window[1] - window[0])
    main_height = float(np.clip(inner * aspect, 3.2, 8.0))
    window = _fit(window, main_height / inner)

    everything = _whole_train(scene)
    span = everything[1] - everything[0]
    strip = span > 2.0 * (window[1] - window[0])
    strip_aspect = (everything[3] - everything[2]) / span
    strip_height = float(np.clip(inner * strip_aspect, 0.42, 2.4)) if strip else 0.0
    everything = _fit(everything, strip_height / inner) if strip else everything

    top, legend, gap = 0.78, 0.42, 0.26
    height = top + main_height + legend + (gap + strip_height + 0.15 if strip else 0.0)
    figure = _figure(height)
    left = 0.5 / WIDTH

    def box(bottom: float, tall: float) -> tuple[float, float, float, float]:
        return left, bottom / height, inner / WIDTH, tall / height

    bottom = height - top - main_height
    axes = figure.add_axes(box(bottom, main_height))
    _prepare(axes, window)
    points_per_metre = inner * 72.0 / (window[1] - window[0])
    _draw_track(axes, scene, window, points_per_metre)
    _draw_cars(axes, scene, window, points_per_metre)
    _draw_box(axes, scene)
    _draw_scale(figure, height, window, scene.travel)

    _headline(figure, left, 1.0 - 0.3 / height, scene.title, 60)
    figure.text(left, 1.0 - 0.56 / height, scene.subtitle, size=9.5, color="#555555", va="center")
    _draw_key(figure, [scene], left, (bottom - 0.12) / height, None if strip else window)

    if strip:
        below = figure.add_axes(box(0.15, strip_height))
        _prepare(below, everything)
        _draw_strip(below, scene, window, everything, inner)
        figure.text(
            left,
            (0.15 + strip_height + 0.07) / height,
            f"Whole train, {_metres(span)} shown; the frame is the picture above",
            size=8,
            color="#555555",
            va="bottom",
        )
    return figure


Window = tuple[float, float, float, float]


def _pile_up(scene: Scene) -> Window:
    """Window around the derailed cars, the breaks near them and the next cars on the rails."""
    corners = scene.corners()
    real = scene.represents == 1
    shown = scene.derailed & real
    if not shown.any():
        shown = real & (np.arange(len(real)) < 8)
    last = int(np.flatnonzero(shown)[-1])
    points = corners[shown].reshape(-1, 2)
    margin = 7.0
    low, high = points.min(axis=0) - margin, points.max(axis=0) + margin
    for x, y, _ in scene.breaks:
        if low[0] - 40.0 < x < high[0] + 40.0 and low[1] - 40.0 < y < high[1] + 40.0:
            low = np.minimum(low, [x - margin, y - margin])
            high = np.maximum(high, [x + margin, y + margin])
    if last + 1 < len(real) and real[last + 1]:
        # The front half of the next car shows where the standing part begins.
        front = corners[last + 1, :2].mean(axis=0)
        centre = scene.pose[last + 1, :2]
        low = np.minimum(low, np.minimum(front, centre) - 2.0)
        high = np.maximum(high, np.maximum(front, centre) + 2.0)
    return float(low[0]), float(high[0]), float(low[1]), float(high[1])


def _whole_train(scene: Scene) -> Window:
    points = scene.corners().reshape(-1, 2)
    low, high = points.min(axis=0) - 8.0, points.max(axis=0) + 8.0
    return float(low[0]), float(high[0]), float(low[1]), float(high[1])


def _fit(window: Window, aspect: float) -> Window:
    """Widen a window about its middle to a ratio of height to width."""
    x0, x1, y0, y1 = window
    wide = max(x1 - x0, (y1 - y0) / aspect)
    tall = wide * aspect
    xm, ym = 0.5 * (x0 + x1), 0.5 * (y0 + y1)
    return xm - 0.5 * wide, xm + 0.5 * wide, ym - 0.5 * tall, ym + 0.5 * tall


def _prepare(axes: Axes, window: Window) -> None:
    axes.set_xlim(window[0], window[1])
    axes.set_ylim(window[2], window[3])
    axes.set_aspect("equal", adjustable="box")
    axes.set_xticks([])
    axes.set_yticks([])
    axes.set_facecolor(GROUND)


GAUGE = 1.435


def _normals(line: NDArray) -> NDArray:
    tangent = (
        np.gradient(line, axis=0)
        if len(line) > 2
        else np.repeat((line[1] - line[0])[None], 2, axis=0)
    )
    tangent = tangent / np.linalg.norm(tangent, axis=1, keepdims=True)
    return np.stack([-tangent[:, 1], tangent[:, 0]], axis=-1)


def _draw_track(axes: Axes, scene: Scene, window: Window, points_per_metre: float) -> None:
    line = scene.track
    normal = _normals(line)
    for side in (-0.5, 0.5):
        rail = line + side * GAUGE * normal
        axes.plot(rail[:, 0], rail[:, 1], color=RAIL, lw=1.1, zorder=1)
    if points_per_metre > 4.0:
        step = np.linalg.norm(np.diff(line, axis=0), axis=1)
        arc = np.concatenate([[0.0], np.cumsum(step)])
        at = np.arange(0.0, arc[-1], 1.2)
        middle = np.stack([np.interp(at, arc, line[:, k]) for k in (0, 1)], axis=-1)
        across = np.stack([np.interp(at, arc, normal[:, k]) for k in (0, 1)], axis=-1)
        ties = np.stack([middle - 1.25 * across, middle + 1.25 * across], axis=1)
        axes.add_collection(LineCollection(ties, colors="#d9d4cd", linewidths=1.4, zorder=0.5))
    for x, y, heading in scene.breaks:
        n = np.array([-math.sin(heading), math.cos(heading)])
        ends = np.array([[x, y] - 2.6 * n, [x, y] + 2.6 * n])
        axes.plot(ends[:, 0], ends[:, 1], color=VERMILION, lw=2.6, zorder=6, solid_capstyle="butt")
        if not (window[0] < x < window[1] and window[2] < y < window[3]):
            continue
        # The label goes to the edge, clear of the cars, and stays within the picture.
        edge = window[2] + 0.035 * (window[3] - window[2])
        wide = axes.get_position().width * axes.get_figure().get_size_inches()[0]
        half = 0.45 * (window[1] - window[0]) / wide
        axes.plot([x, x], [y, edge], color=VERMILION, lw=1.0, ls=(0, (1, 2)), zorder=2)
        axes.text(
            min(max(x, window[0] + half), window[1] - half),
            edge,
            "rail break",
            ha="center",
            va="center",
            color=VERMILION,
            size=8,
            weight="bold",
            zorder=12,
            bbox={"boxstyle": "square,pad=0.2", "fc": "white", "ec": "none"},
        )


def _state(scene: Scene) -> NDArray[np.int64]:
    return np.where(scene.free, 2, np.where(scene.derailed, 1, 0))


def legend_above(axes: Axes, handles: Sequence[Any], ncol: int, **more: Any) -> None:
    """A legend in rows over the axes, flush left."""
    look: dict[str, Any] = {
        "loc": "lower left",
        "bbox_to_anchor": (0.0, 1.0),
        "frameon": False,
        "fontsize": 8.5,
        "borderaxespad": 0.0,
        "borderpad": 0.2,
        "columnspacing": 1.6,
    }
    axes.legend(handles=handles, ncol=ncol, **(look | more))


def draw_bodies(
    axes: Axes, scene: Scene, lw: float, zorder: float = 4.0, hatched: bool = True
) -> None:
    """The cars by their state; no body that stands for many."""
    corners = scene.outlines()
    state = _state(scene)
    real = scene.represents == 1
    for k, (_, fill, hatch) in enumerate(STATES):
        chosen = real & (state == k)
        if chosen.any():
            axes.add_collection(
                PolyCollection(
                    list(corners[chosen]),
                    facecolors=fill,
                    edgecolors=INK,
                    linewidths=lw,
                    hatch=(hatch or None) if hatched else None,
                    zorder=zorder,
                )
            )


def draw_fronts(axes: Axes, scene: Scene) -> None:
    """The front end of each car, dark."""
    corners = scene.outlines()
    front = corners.copy()
    share = np.minimum(0.7 / scene.length, 0.5)[:, None]
    front[:, 3] = corners[:, 0] + share * (corners[:, 3] - corners[:, 0])
    front[:, 2] = corners[:, 1] + share * (corners[:, 2] - corners[:, 1])
    real = scene.represents == 1
    axes.add_collection(PolyCollection(list(front[real]), facecolors=INK, zorder=4.5))


def _draw_stand_ins(axes: Axes, scene: Scene, lw: float, zorder: float) -> None:
    """The bodies that stand for many cars."""
    many = scene.represents != 1
    if many.any():
        axes.add_collection(
            PolyCollection(
                list(scene.outlines()[many]),
                facecolors=STAND_IN,
                edgecolors=FAINT,
                linestyles="--",
                linewidths=lw,
                zorder=zorder,
            )
        )


def _draw_cars(axes: Axes, scene: Scene, window: Window, points_per_metre: float) -> None:
    corners = scene.corners()
    real = scene.represents == 1
    _draw_couplers(axes, scene, points_per_metre)
    draw_bodies(axes, scene, 0.9)
    draw_fronts(axes, scene)
    _draw_stand_ins(axes, scene, 0.9, 3)
    size = float(np.clip(0.62 * 2.6 * points_per_metre, 5.0, 10.0))
    places = _label_places(scene, 2.4 * size / points_per_metre)
    for i, (x, y) in enumerate(places):
        if not real[i]:
            # In the middle of what can be seen of it, if that is not too little.
            seen = np.clip(corners[i, :, 0], window[0], window[1])
            if np.ptp(seen) > 5.0:
                text = f"{scene.represents[i]} cars"
                axes.text(
                    0.5 * (seen.min() + seen.max()), y, text, size=7, ha="center", va="center"
                )
            continue
        if not (window[0] < x < window[1] and window[2] < y < window[3]):
            continue
        axes.text(
            x,
            y,
            str(scene.numbers[i]),
            size=size,
            weight="bold",
            ha="center",
            va="center_baseline",
            zorder=10,
            bbox={"boxstyle": "round,pad=0.12", "fc": "white", "ec": "none", "alpha": 0.85},
        )
        force = scene.peak_force[i]
        marks = int(force >= RUPTURE) + int(force >= RUPTURE_CONSERVATIVE)
        if marks:
            axes.annotate(
                "\N{BLACK DIAMOND}" * marks,
                xy=(x, y),
                xytext=(0, -0.95 * size),
                textcoords="offset points",
                ha="center",
                va="center",
                color=VERMILION,
                size=0.75 * size,
                zorder=11,
                bbox={"boxstyle": "round,pad=0.05", "fc": "white", "ec": "none", "alpha": 0.85},
                annotation_clip=True,
            )


def _label_places(scene: Scene, apart: float) -> NDArray:
    """Places of the numbers, (N, 2): the middle of the car, or along it where another is there.

    ``apart`` is the distance at which two numbers do not touch, m.
    """
    places = scene.pose[:, :2].copy()
    axis = np.stack([np.cos(scene.pose[:, 2]), np.sin(scene.pose[:, 2])], axis=-1)
    for i in range(len(places)):
        others = places[:i]
        best, room = places[i], -1.0
        for share in (0.0, 0.2, -0.2, 0.32, -0.32):
            place = scene.pose[i, :2] + share * scene.length[i] * axis[i]
            near = float(np.linalg.norm(others - place, axis=1).min(initial=np.inf))
            if near > room:
                best, room = place, near
            if near >= apart:
                best = place
                break
        places[i] = best
    return places


def _draw_couplers(axes: Axes, scene: Scene, points_per_metre: float) -> None:
    pivots, faces = scene.pivots(), scene.faces()
    n = len(scene.pose)
    real = scene.represents == 1
    shanks = np.stack([pivots, faces], axis=2)[real].reshape(-1, 2, 2)
    width = float(np.clip(0.25 * points_per_metre, 0.8, 2.2))
    axes.add_collection(LineCollection(list(shanks), colors=INK, linewidths=width, zorder=3.5))
    dot = float(np.clip(0.55 * points_per_metre, 1.5, 4.5))
    for i in range(n - 1):
        if scene.coupled[i]:
            x, y = faces[i, 1] if real[i] else faces[i + 1, 0]
            axes.plot(x, y, "o", ms=dot, mfc=INK, mec="white", mew=0.4, zorder=7)
        else:
            for x, y in (faces[i, 1], faces[i + 1, 0]):
                axes.plot(x, y, "x", ms=dot + 1.0, mec=VERMILION, mew=1.5, zorder=8)


def _draw_box(axes: Axes, scene: Scene) -> None:
    """The bounding box of the derailed cars with its dimensions."""
    derailed = scene.derailed & (scene.represents == 1)
    if not derailed.any() or not scene.straight:
        return
    points = scene.corners()[derailed].reshape(-1, 2)
    low, high = points.min(axis=0), points.max(axis=0)
    axes.add_patch(
        Rectangle(
            tuple(low),
            *(high - low),
            fill=False,
            ec=BLUE,
            lw=0.9,
            ls=(0, (5, 4)),
            zorder=2,
        )
    )
    label: dict[str, Any] = {
        "color": BLUE,
        "size": 9,
        "zorder": 11,
        "bbox": {"boxstyle": "square,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.85},
    }
    long = scene.scene_length if math.isfinite(scene.scene_length) else high[0] - low[0]
    wide = scene.scene_width if math.isfinite(scene.scene_width) else high[1] - low[1]
    # Clear of the cars and of the couplers at their ends, at any scale.
    ahead, top = np.maximum(high, scene.faces()[derailed].reshape(-1, 2).max(axis=0))
    middle = 0.5 * (low + high)
    label |= {"textcoords": "offset points"}
    axes.annotate(
        _metres(long), xy=(middle[0], top), xytext=(0, 4), ha="center", va="bottom", **label
    )
    axes.annotate(
        _metres(wide),
        xy=(ahead, middle[1]),
        xytext=(5, 0),
        ha="left",
        va="center",
        rotation=90,
        **label,
    )


def _metres(value: float) -> str:
    return f"{value:.0f} m" if value >= 100.0 else f"{value:.1f} m"


def _nice(value: float) -> float:
    """Largest of 1, 2, 5 times a power of ten that is not above ``value``."""
    power = 10.0 ** math.floor(math.log10(value))
    return max(m * power for m in (1.0, 2.0, 5.0) if m * power <= value * (1.0 + 1e-9))


def _draw_scale(
    figure: Figure, height: float, window: Window, travel: tuple[float, float] | None
) -> None:
    """Scale bar and direction of travel, at the right of the title."""
    per_metre = (WIDTH - 1.0) / (window[1] - window[0])
    bar = _nice(1.7 / per_metre)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    axes.set_xlim(0.0, WIDTH)
    axes.set_ylim(0.0, height)
    left, level = WIDTH - 0.62 - bar * per_metre, height - 0.42
    half = 0.5 * bar * per_metre
    for k, fill in enumerate((INK, "white")):
        axes.add_patch(
            Rectangle((left + k * half, level), half, 0.07, fc=fill, ec=INK, lw=0.8, zorder=11)
        )
    for k, text in enumerate(("0", f"{0.5 * bar:g}", f"{bar:g} m")):
        axes.text(left + k * half, level + 0.11, text, ha="center", va="bottom", size=8)
    if travel is not None:
        _draw_travel(axes, (left - 0.55, level + 0.035), travel)


TRAVEL = "direction of travel"


def _draw_travel(axes: Axes, middle: tuple[float, float], travel: tuple[float, float]) -> None:
    """The arrow and before it what it says, on axes in inches."""
    axes.text(middle[0] - 0.34, middle[1], TRAVEL, size=8.5, va="center", ha="right")
    _draw_arrow(axes, middle, travel, 0.25, 1.0)


def _draw_arrow(
    axes: Axes, middle: tuple[float, float], travel: tuple[float, float], half: float, scale: float
) -> None:
    """An arrow along the track: its middle and half its length in the units of the axes."""
    x, y = half * travel[0], half * travel[1]
    axes.annotate(
        "",
        xy=(middle[0] + x, middle[1] + y),
        xytext=(middle[0] - x, middle[1] - y),
        arrowprops={
            "arrowstyle": "-|>",
            "color": INK,
            "lw": scale,
            "mutation_scale": 10.0 * scale,
            "shrinkA": 0,
            "shrinkB": 0,
        },
        zorder=13,
    )


def _reaches(corners: NDArray, window: Window) -> bool:
    """Whether the box around some corners overlaps a window."""
    (x0, y0), (x1, y1) = corners.min(axis=0), corners.max(axis=0)
    return bool(x1 > window[0] and x0 < window[1] and y1 > window[2] and y0 < window[3])


def _draw_key(
    figure: Figure, scenes: Sequence[Scene], left: float, top: float, window: Window | None
) -> None:
    """Explain what is in one or several scenes; of one, how many cars of each kind.

    A body for many cars is explained if it reaches into the window; without one all is shown.
    """
    handles: list[Any] = []
    for k, (label, fill, hatch) in enumerate(STATES):
        count = sum(int(((s.represents == 1) & (_state(s) == k)).sum()) for s in scenes)
        if count:
            text = f"{label} ({count})" if len(scenes) == 1 else label
            handles.append(Patch(fc=fill, ec=INK, hatch=hatch or None, lw=0.8, label=text))
    bodies = [
        int(n)
        for s in scenes
        for n, corners in zip(s.represents, s.corners())
        if n != 1 and (window is None or _reaches(corners, window))
    ]
    if bodies:
        text = f"one body for {sum(bodies)} cars" if len(scenes) == 1 else "one body for many cars"
        handles.append(Patch(fc=STAND_IN, ec=FAINT, ls="--", label=text))
    if any(s.coupled.any() for s in scenes):
        look: dict[str, Any] = {"marker": "o", "mfc": INK, "mec": "white", "ms": 4.5}
        handles.append(Line2D([], [], ls="-", color=INK, **look, label="coupled"))
    if not all(s.coupled.all() for s in scenes):
        handles.append(
            Line2D([], [], ls="", marker="x", mec=VERMILION, mew=1.5, ms=5.5, label="parted")
        )
    diamond: dict[str, Any] = {"ls": "", "marker": "D", "mfc": VERMILION, "mec": "white", "ms": 5}
    if any(np.any(s.peak_force >= RUPTURE) for s in scenes):
        handles.append(Line2D([], [], **diamond, label="struck above 5 MN, two: 10 MN"))
    figure.legend(
        handles=handles,
        loc="upper left",
        bbox_to_anchor=(left, top),
        bbox_transform=figure.transFigure,
        ncol=len(handles),
        frameon=False,
        fontsize=8.5,
        handlelength=1.8,
        handleheight=1.1,
        columnspacing=1.6,
        borderaxespad=0.0,
        borderpad=0.0,
    )


def _draw_strip(
    axes: Axes, scene: Scene, window: Window, everything: Window, inches: float
) -> None:
    axes.plot(scene.track[:, 0], scene.track[:, 1], color=RAIL, lw=0.8, zorder=1)
    real = scene.represents == 1
    draw_bodies(axes, scene, 0.4, zorder=3, hatched=False)
    _draw_stand_ins(axes, scene, 0.6, 2)
    x0, x1, y0, y1 = window
    y0, y1 = max(y0, everything[2]), min(y1, everything[3])
    axes.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, ec=BLUE, lw=1.2, zorder=5))
    points_per_metre = inches * 72.0 / (everything[1] - everything[0])
    every = max(1, math.ceil(44.0 / (points_per_metre * float(np.median(scene.length)))))
    every = next((e for e in (1, 2, 5, 10, 20, 50, 100) if e >= every), every)
    for i in np.flatnonzero(real & ~scene.derailed):
        if scene.numbers[i] % every == 0:
            axes.annotate(
                str(scene.numbers[i]),
                xy=(scene.pose[i, 0], scene.pose[i, 1]),
                xytext=(0, 4),
                textcoords="offset points",
                ha="center",
                va="bottom",
                size=6.5,
                color="#555555",
            )


# Peak forces -------------------------------------------------------------------------------

LEVELS: tuple[tuple[str, str, str], ...] = (
    ("below 5 MN", "#9ecae9", ""),
    ("5 to 10 MN", "#f0b13c", "////"),
    ("above 10 MN", "#d55e00", "xxxx"),
)


def peak_forces(
    peak_force: ArrayLike,
    opposing: ArrayLike,
    *,
    time: ArrayLike | None = None,
    derailed: Sequence[int] = (),
    title: str = "",
) -> Figure:
    """Draw the largest corner force on each car, with the car on the other side of it.

    Parameters
    ----------
    peak_force : (N,) N
    opposing : (N,) car number, 0 without
    time : (N,) when, s; not shown without
    derailed : car numbers, from 1
    title : what ran
    """
    with matplotlib.rc_context(STYLE):
        return _peak_forces(
            np.asarray(peak_force, dtype=float),
            np.asarray(opposing, dtype=int),
            None if time is None else np.asarray(time, dtype=float),
            derailed,
            title,
        )


def _peak_forces(
    force: NDArray,
    other: NDArray,
    time: NDArray | None,
    derailed: Sequence[int],
    title: str,
) -> Figure:
    n = len(force)
    force = np.where(np.isfinite(force), force, 0.0) * 1e-6
    struck = np.flatnonzero(force > 0.0)
    involved = [*(struck + 1).tolist(), *derailed] or [1, min(n, 10)]
    first, last = max(1, min(involved) - 2), min(n, max(involved) + 2)
    first = 1 if first < 8 else first
    shown = last - first + 1
    height = 4.9
    figure = _figure(height)
    left = 0.75 / WIDTH
    axes = figure.add_axes(
        (left, 0.6 / height, 1.0 - left - 0.95 / WIDTH, 1.0 - (0.6 + 0.95) / height)
    )
    top = max(float(force.max(initial=0.0)) * 1.16, 11.5)
    cars = np.arange(first, last + 1)
    here = force[first - 1 : last]
    level = np.digitize(here, [RUPTURE * 1e-6, RUPTURE_CONSERVATIVE * 1e-6])
    handles: list[Any] = []
    for k, (label, fill, hatch) in enumerate(LEVELS):
        chosen = (level == k) & (here > 0.0)
        axes.bar(
            cars[chosen],
            here[chosen],
            width=0.74,
            color=fill,
            edgecolor=INK,
            linewidth=0.7,
            hatch=hatch or None,
            zorder=3,
        )
        if len(struck):
            text = f"{label} ({chosen.sum()})"
            handles.append(Patch(fc=fill, ec=INK, hatch=hatch or None, lw=0.7, label=text))
    lines = (
        (RUPTURE * 1e-6, "5 MN\nhas ruptured\ntank cars"),
        (RUPTURE_CONSERVATIVE * 1e-6, "10 MN\nconservative\ncount"),
    )
    for value, text in lines:
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
    small = shown > 28
    for i in struck:
        text = f"{other[i]}"
        if time is not None and not small:
            text += f"\n{time[i]:.1f} s"
        label = axes.annotate(
            text,
            xy=(i + 1, force[i]),
            xytext=(0, 2),
            textcoords="offset points",
            ha="center",
            va="bottom",
            size=6.5 if shown > 45 else 8,
            linespacing=1.05,
            zorder=5,
        )
        label.set_bbox({"boxstyle": "square,pad=0.08", "fc": "white", "ec": "none", "alpha": 0.7})
    axes.set_xlim(first - 0.7, last + 0.7)
    axes.set_ylim(0.0, top)
    axes.yaxis.set_major_locator(MaxNLocator(8, steps=[1, 2, 5, 10]))
    every = next(e for e in (1, 2, 5, 10, 20, 50, 100) if shown / e <= 45)
    axes.set_xticks([c for c in cars if c % every == 0])
    axes.tick_params(length=3, color="#c8c8c8")
    axes.set_xlabel("car")
    axes.set_ylabel("largest force at a corner, MN")
    axes.grid(axis="y", color="#ececec", lw=0.8, zorder=0)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    if derailed:
        axes.plot(
            list(derailed),
            np.zeros(len(derailed)),
            ls="",
            marker="s",
            ms=5,
            mfc=INK,
            mec=INK,
            clip_on=False,
            zorder=6,
        )
        handles.append(Line2D([], [], ls="", marker="s", ms=5, color=INK, label="derailed"))
    if not len(struck):
        axes.text(
            0.5, 0.5, "no collisions", transform=axes.transAxes, ha="center", size=12, color=FAINT
        )
    legend_above(axes, handles, 4, handleheight=1.1)
    heading = f"{title}: peak force on each car" if title else "Peak force on each car"
    _headline(figure, left, 1.0 - 0.27 / height, heading, 80)
    note = "No car was struck."
    if len(struck):
        note = "Above each bar: the car on the other side" + (
            " and the time of the peak." if time is not None and not small else "."
        )
    spans = [(a, b) for a, b in ((1, first - 1), (last + 1, n)) if a <= b]
    if spans and len(struck):
        words = " and ".join(str(a) if a == b else f"{a} to {b}" for a, b in spans)
        one = sum(b - a + 1 for a, b in spans) == 1
        note += f" Not struck and not shown: car{'' if one else 's'} {words}."
    figure.text(
        left,
        1.0 - 0.53 / height,
        note,
        size=9.5,
        color="#555555",
        va="center",
    )
    return figure
