"""Shared by all figures: style, colours, sheets, and drawing of a train and its track.

Figures are matplotlib ``Figure`` objects; pyplot, its global state and displays are not touched.
Colours are from Okabe and Ito's palette. No figure relies on colour alone: states of cars also
differ in hatch, forces in marks.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PathCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.path import Path as Outline
from matplotlib.text import Text
from numpy.typing import NDArray

from derail_ros.vocabulary.shapes import HALF_GAUGE
from derail_ros.vocabulary.status import CERTAIN_RUPTURE_FORCE, RUPTURE_FORCE

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from derail_ros.review.scene import Scene

INK = "#222222"
SUBTLE = "#555555"
FAINT = "#8a8a8a"
RAIL = "#9a9a9a"
TICKS = "#c8c8c8"
GRID = "#ececec"
STAND_IN = "#f3f3f3"
VERMILION = "#d55e00"
BLUE = "#0072b2"
GREEN = "#009e73"

STATES: tuple[tuple[str, str, str], ...] = (
    ("on the rails", "#e3e6ea", ""),
    ("derailed, coupled", "#7cc3ee", "////"),
    ("derailed, uncoupled", "#f0b13c", "...."),
)
"""Label, fill and hatch of the states of a car."""

STYLE: dict[str, Any] = {
    "font.family": ["DejaVu Sans"],
    "font.size": 9.0,
    "axes.edgecolor": TICKS,
    "axes.linewidth": 0.8,
    "axes.labelcolor": INK,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "hatch.linewidth": 0.5,
    "path.simplify": False,
}

styled = matplotlib.rc_context(STYLE)
"""Decorator: draw in :data:`STYLE`, whatever settings the caller has."""

WIDTH = 12.0
"""Width of the figures of a run, inches."""

LEGEND: dict[str, Any] = {
    "frameon": False,
    "fontsize": 8.5,
    "handleheight": 1.1,
    "columnspacing": 1.6,
    "borderaxespad": 0.0,
    "borderpad": 0.0,
}
"""Look of all legends."""

Window = tuple[float, float, float, float]
"""What a picture shows: x from, x to, y from, y to, m."""


# --- sheets ----------------------------------------------------------------------------------


def sheet(width: float, height: float, **more: Any) -> Figure:
    """An empty figure, inches."""
    figure = Figure(figsize=(width, height), facecolor="white", **more)
    FigureCanvasAgg(figure)
    return figure


@styled
def save(figure: Figure, path: str | Path, dpi: int = 150) -> Path:
    """Write a figure, the kind of file taken from the name, and return its path."""
    path = Path(path)
    figure.savefig(path, dpi=dpi, metadata={"Software": "derail_ros"})
    return path


def place(figure: Figure, left: float, top: float, wide: float, tall: float) -> Axes:
    """Axes whose upper left corner is ``left`` and ``top`` from that of the figure, inches."""
    width, height = figure.get_size_inches()
    return figure.add_axes(
        (left / width, 1.0 - (top + tall) / height, wide / width, tall / height)
    )


def grid_of(figure: Figure, n: int, columns: int, margins: Sequence[float]) -> list[Axes]:
    """``n`` axes in rows of ``columns``.

    ``margins``: left, right, top, bottom, gap between columns, gap between rows, inches.
    """
    left, right, top, bottom, gap_x, gap_y = margins
    width, height = figure.get_size_inches()
    rows = -(-n // columns)
    wide = (width - left - right - (columns - 1) * gap_x) / columns
    tall = (height - top - bottom - (rows - 1) * gap_y) / rows
    return [
        place(figure, left + k % columns * (wide + gap_x), top + k // columns * (tall + gap_y),
              wide, tall)
        for k in range(n)
    ]  # fmt: skip


def inches(figure: Figure) -> Axes:
    """Axes over the whole figure whose units are inches from its lower left corner."""
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    width, height = figure.get_size_inches()
    axes.set_xlim(0.0, width)
    axes.set_ylim(0.0, height)
    return axes


def put(figure: Figure, left: float, top: float, text: str, **look: Any) -> Text:
    """A text whose middle is ``top`` below the upper edge of the figure, inches."""
    width, height = figure.get_size_inches()
    look = {"va": "center", "size": 9.5, "color": SUBTLE} | look
    return figure.text(left / width, 1.0 - top / height, text, **look)


def heading(figure: Figure, title: str, note: str = "", left: float = 0.5, fits: int = 80) -> None:
    """The title of a figure and a line below it; of more letters than fit, smaller ones."""
    size = 14.0 * min(1.0, fits / max(len(title), 1))
    put(figure, left, 0.3, title, size=size, weight="bold", color=INK)
    put(figure, left, 0.57, note)


def legend(figure: Figure, left: float, top: float, handles: Sequence[Any], **more: Any) -> None:
    """A legend in one row whose upper left corner is there, inches."""
    width, height = figure.get_size_inches()
    look = LEGEND | {"ncol": len(handles), "loc": "upper left"} | more
    figure.legend(handles=handles, bbox_to_anchor=(left / width, 1.0 - top / height), **look)


def legend_above(axes: Axes, handles: Sequence[Any], ncol: int, **more: Any) -> None:
    """A legend in rows over the axes, flush left."""
    look = LEGEND | {"loc": "lower left", "bbox_to_anchor": (0.0, 1.0), "borderpad": 0.2} | more
    axes.legend(handles=handles, ncol=ncol, **look)


def dress(axes: Axes, grid: Any = "both", without: Sequence[str] = ("top", "right")) -> None:
    """A pale grid behind the data, short ticks, no frame on some sides."""
    axes.grid(axis=grid, color=GRID, lw=0.8, zorder=0)
    axes.set_axisbelow(True)
    axes.tick_params(length=3, color=TICKS)
    axes.spines[list(without)].set_visible(False)


def label(axes: Axes, text: str, xy: Any, offset: Any = (0.0, 0.0), **look: Any) -> Any:
    """A text on white, ``offset`` (points) from a place."""
    box = {"boxstyle": "square,pad=0.12", "fc": "white", "ec": "none", "alpha": 0.85}
    look = {"ha": "center", "va": "center", "size": 8.5, "zorder": 12, "bbox": box} | look
    return axes.annotate(text, xy=xy, xytext=offset, textcoords="offset points", **look)


def arrow(axes: Axes, start: Any, end: Any, head: float = 0.4, **look: Any) -> Any:
    """An arrow between two places; ``head`` is the length of its head."""
    shape = {"arrowstyle": f"-|>,head_width={0.5 * head},head_length={head}"}
    more = {"zorder": look.pop("zorder", 13), "annotation_clip": False}
    style = shape | {"color": INK, "lw": 1.0, "shrinkA": 0, "shrinkB": 0} | look
    return axes.annotate("", xy=end, xytext=start, arrowprops=style, **more)


def hatched(text: str, fill: str, hatch: str = "", **look: Any) -> Patch:
    """An entry of a legend: a filled and hatched patch."""
    return Patch(fc=fill, hatch=hatch or None, label=text, **({"ec": INK, "lw": 0.8} | look))


def mark(text: str, **look: Any) -> Line2D:
    """An entry of a legend: a mark, without a line unless one is asked for."""
    return Line2D([], [], label=text, **({"ls": "", "ms": 5} | look))


DIAMOND: dict[str, Any] = {"marker": "D", "ls": "", "mfc": VERMILION, "mec": "white"}
"""Look of the mark of a hard collision."""


# --- windows and scales ----------------------------------------------------------------------


def window_of(points: NDArray, margin: float) -> Window:
    """Window around points (..., 2), m."""
    flat = points.reshape(-1, 2)
    (x0, y0), (x1, y1) = flat.min(axis=0) - margin, flat.max(axis=0) + margin
    return float(x0), float(x1), float(y0), float(y1)


def fit(window: Window, aspect: float) -> Window:
    """Widen a window about its middle to a ratio of height to width."""
    x0, x1, y0, y1 = window
    wide = max(x1 - x0, (y1 - y0) / aspect)
    tall = wide * aspect
    xm, ym = 0.5 * (x0 + x1), 0.5 * (y0 + y1)
    return xm - 0.5 * wide, xm + 0.5 * wide, ym - 0.5 * tall, ym + 0.5 * tall


def within(window: Window, x: float, y: float) -> bool:
    """A place lies in a window."""
    return window[0] < x < window[1] and window[2] < y < window[3]


MARGIN = 7.0
"""Around what is shown, m."""


def site(scene: Scene, margin: float = MARGIN, reach: float = 40.0, cars: int = 8) -> Window:
    """Window around the derailed cars, the breaks near them and the front half of the next car.

    Parameters
    ----------
    margin, reach : around the cars, and how far a break may be from them, m
    cars : how many of the first cars are shown if none derailed
    """
    astray = scene.derailed & scene.real
    shown = astray & scene.own
    if not shown.any():
        shown = scene.real & (np.arange(len(shown)) < cars)
    corners = scene.corners()
    points = corners[shown | astray].reshape(-1, 2)
    low, high = points.min(axis=0) - reach, points.max(axis=0) + reach
    places = scene.breaks[:, :2]
    near = places[((places > low) & (places < high)).all(axis=1)]
    k = int(np.flatnonzero(shown)[-1]) + 1
    if k < len(shown) and scene.real[k] and scene.own[k]:
        points = np.concatenate([points, corners[k, :2], scene.pose[k : k + 1, :2]])
    return window_of(np.concatenate([points, near]), margin)


def stage(scene: Scene) -> Window:
    """Window of films and pages about the end of a run; all cars of a train on the rails."""
    return site(scene, margin=9.0, reach=120.0, cars=len(scene.pose))


def with_areas(window: Window, scene: Scene) -> Window:
    """The window grown to the areas beside it: cars in none of them is an answer too.

    An area further away than the window is long, or than 100 m, is left out, and of one that
    reaches further only its near edge is taken in.
    """
    x0, x1, y0, y1 = window
    reach = max(x1 - x0, y1 - y0, 100.0)
    far = (x0 - reach, x1 + reach, y0 - reach, y1 + reach)
    middle = np.array([0.5 * (x0 + x1), 0.5 * (y0 + y1)])
    taken = [np.array([[x0, y0], [x1, y1]])]
    for shape in scene.site:
        if shape.role != "area":
            continue
        if all(within(far, *p) for p in shape.points):
            taken += [shape.points - MARGIN, shape.points + MARGIN]
        elif len(near := _seen(shape.points, far)) and not len(_seen(shape.points, window)):
            apart = np.linalg.norm(near - middle, axis=1)
            taken += [near[[apart.argmin()]] - MARGIN, near[[apart.argmin()]] + MARGIN]
    return window_of(np.concatenate(taken), 0.0)


def show(axes: Axes, window: Window) -> None:
    """Prepare axes for a picture to scale."""
    axes.set_xlim(window[0], window[1])
    axes.set_ylim(window[2], window[3])
    axes.set_aspect("equal", adjustable="box")
    axes.set_xticks([])
    axes.set_yticks([])
    axes.set_facecolor("white")


def metres(value: float) -> str:
    """A length: ``14.3 m``, ``120 m``."""
    return f"{value:.0f} m" if value >= 100.0 else f"{value:.1f} m"


def nice(value: float) -> float:
    """Largest of 1, 2, 5 times a power of ten that is not above ``value``."""
    power = 10.0 ** math.floor(math.log10(value))
    return max(m * power for m in (1.0, 2.0, 5.0) if m * power <= value * (1.0 + 1e-9))


TRAVEL = "direction of travel"


def draw_scale(figure: Figure, window: Window, travel: tuple[float, float] | None) -> None:
    """Scale bar and direction of travel, at the right of the title of a figure of a run."""
    width, height = figure.get_size_inches()
    per_metre = (width - 1.0) / (window[1] - window[0])
    bar = nice(1.7 / per_metre)
    axes = inches(figure)
    left, level = width - 0.62 - bar * per_metre, height - 0.42
    half = 0.5 * bar * per_metre
    for k, fill in enumerate((INK, "white")):
        axes.add_patch(
            Rectangle((left + k * half, level), half, 0.07, fc=fill, ec=INK, lw=0.8, zorder=11)
        )
    for k, text in enumerate(("0", f"{0.5 * bar:g}", f"{bar:g} m")):
        axes.text(left + k * half, level + 0.11, text, ha="center", va="bottom", size=8)
    if travel is not None:
        draw_travel(axes, (left - 0.55, level + 0.035), travel)


def draw_travel(axes: Axes, middle: tuple[float, float], travel: tuple[float, float]) -> None:
    """The direction of travel, named, on axes in inches."""
    axes.text(middle[0] - 0.34, middle[1], TRAVEL, size=8.5, va="center", ha="right")
    draw_direction(axes, middle, travel, 0.25)


def draw_direction(
    axes: Axes, middle: Any, travel: tuple[float, float], half: float, scale: float = 1.0
) -> None:
    """An arrow along the track about a place, ``half`` of its length to each side."""
    at, along = np.asarray(middle), half * np.asarray(travel)
    arrow(axes, at - along, at + along, lw=scale, mutation_scale=10.0 * scale)


def bodies_at(scene: Scene) -> NDArray:
    """Places (K, 2) all over the bodies, by which a picture finds what is free, m."""
    share = np.linspace(0.0, 1.0, 13)[:, None, None, None]
    corners = scene.outlines()
    along = (1.0 - share) * corners[:, :2] + share * corners[:, [3, 2]]
    return np.concatenate([along, along.mean(axis=2, keepdims=True)], axis=2).reshape(-1, 2)


def per_point(axes: Axes, window: Window) -> float:
    """Metres of a point of print."""
    inches = axes.get_position().width * axes.get_figure().get_size_inches()[0]
    return (window[1] - window[0]) / (72.0 * inches)


def freest(places: Sequence[Any], half: Any, taken: NDArray) -> Any:
    """Of places, the first about which a box of half sizes ``half`` holds the fewest points."""
    inside = [(np.abs(taken - at) < half).all(axis=1).sum() for at in places]
    return places[int(np.argmin(inside))]


FREE_CORNERS = ("lower right", "lower left", "upper right", "upper left")


def scale_inside(
    axes: Axes, window: Window, share: float, scale: float = 1.0, scene: Scene | None = None,
    corners: Sequence[str] = FREE_CORNERS,
) -> None:  # fmt: skip
    """A scale bar on white, about a share of the width long.

    It is in the first of the ``corners`` that has the fewest bodies and labels of the scene.
    """
    x0, x1, y0, y1 = window
    wide, point = x1 - x0, per_point(axes, window)
    bar, tall = nice(share * wide), 17.0 * scale * point
    edge = 0.025 * wide
    half = np.array([0.5 * bar + 6.0 * point, 0.5 * tall + 2.0 * point])
    middles = []
    for corner in corners:
        x = x0 + edge + 0.5 * bar if "left" in corner else x1 - edge - 0.5 * bar
        y = y0 + edge + 0.5 * tall if "lower" in corner else y1 - edge - 0.5 * tall
        middles.append(np.array([x, y]))
    taken = np.zeros((0, 2))
    if scene is not None:
        taken = np.concatenate([bodies_at(scene), break_labels(axes, scene, window)[1]])
    x, y = freest(middles, half, taken)
    box = (x - half[0], y - half[1])
    axes.add_patch(Rectangle(box, *(2.0 * half), fc="white", ec="none", alpha=0.85, zorder=14))
    y -= 0.5 * tall - 2.0 * point
    ends = [x - 0.5 * bar, x + 0.5 * bar]
    axes.plot(ends, [y, y], color=INK, lw=2.5 * scale, solid_capstyle="butt", zorder=15)
    label(axes, f"{bar:g} m", (x, y), (0, 3), va="bottom", size=8.5 * scale, zorder=15)


def break_labels(axes: Axes, scene: Scene, window: Window) -> tuple[list[Any], NDArray]:
    """Places of the labels of the rail breaks in a window, and places all over them.

    They go to the lower or upper edge, whichever is freer, and stay within the picture.
    """
    point = per_point(axes, window)
    half = np.array([32.0, 9.0]) * point
    margin = 0.035 * (window[3] - window[2])
    taken, found = bodies_at(scene), []
    for x, y, _ in scene.breaks:
        if within(window, x, y):
            at = min(max(x, window[0] + half[0]), window[1] - half[0])
            found.append(freest([(at, window[2] + margin), (at, window[3] - margin)], half, taken))
    mesh = np.stack(np.meshgrid(np.linspace(-1, 1, 9), (-1, 0, 1)), axis=-1).reshape(-1, 2)
    return found, np.concatenate([np.zeros((0, 2)), *(at + mesh * half for at in found)])


# --- track -----------------------------------------------------------------------------------

ZONE_FILL = "#efe6d2"
FIXED_FILL = "#6b6259"
AREA_LINE = "#3a7d44"


def draw_site(axes: Axes, scene: Scene, window: Window) -> None:
    """Zones of the ground, areas, and fixed bodies, with their names where they can be seen."""
    taken, point = bodies_at(scene), per_point(axes, window)
    for shape in scene.site:
        x, y = shape.points.T
        look: dict[str, Any] = {"color": AREA_LINE, "lw": 1.2, "ls": (0, (5, 2)), "zorder": 0.4}
        if shape.role == "track":
            look = {"color": FAINT, "lw": 1.1, "zorder": 1}
            for line in beside(shape.points, (-HALF_GAUGE, HALF_GAUGE)):
                axes.plot(*line.T, **look)
        elif shape.role == "zone":
            axes.fill(x, y, facecolor=ZONE_FILL, edgecolor="#c9b88f", lw=0.8, zorder=0.2)
            look["color"] = "#7a6a3f"
        elif shape.role == "fixed":
            look = {"color": FIXED_FILL, "lw": 2.4, "zorder": 3.0, "solid_capstyle": "butt"}
            if shape.closed:
                axes.fill(x, y, facecolor=FIXED_FILL, edgecolor=INK, lw=0.6, zorder=3.0)
            else:
                axes.plot(x, y, **look)
        else:
            ends = np.append(x, x[0]), np.append(y, y[0])
            axes.plot(*(ends if shape.closed else (x, y)), **look)
        kept = np.array([within(window, *p) for p in shape.points])
        seen = shape.points[kept] if kept.any() else _seen(shape.points, window)
        if len(seen):
            middle = len(seen) // 2
            order = [*seen[middle:], *seen[:middle][::-1]]
            if shape.closed:
                centre = seen.mean(axis=0)
                order = [centre, *(0.5 * (centre + p) for p in seen)]
            elif len(seen) > 1:
                steps = np.diff(seen, axis=0)
                order += [*(seen[:-1] + 0.5 * steps), *(seen[:-1] + 0.25 * steps)]
            half = np.array([0.32 * 7.5 * len(shape.name), 6.0]) * point
            at = tuple(seen[0] if shape.role == "track" else freest(order, half, taken))
            across = (at[0] - window[0]) / (window[1] - window[0])
            side = "left" if across < 0.1 else "right" if across > 0.9 else "center"
            above = (0.0, 9.0) if shape.role == "track" else (0.0, 0.0)  # cars stand on it
            label(axes, shape.name, at, above, color=look["color"], size=7.5, ha=side)


def beside(line: NDArray, offsets: Sequence[float]) -> list[NDArray]:
    """Lines (M, 2) that run so far to the left of a line, m."""
    tangent = np.gradient(line, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=-1)
    return [line + offset * normal for offset in offsets]


def _seen(points: NDArray, window: Window) -> NDArray:
    """Places on the edges of an outline that lie in the window."""
    share = np.linspace(0.0, 1.0, 101)[:, None]
    dense = np.concatenate(
        [a + share * (b - a) for a, b in zip(points, np.roll(points, -1, axis=0), strict=True)]
    )
    return dense[[within(window, *p) for p in dense]]


def draw_track(axes: Axes, scene: Scene, window: Window, points_per_metre: float) -> None:
    """Rails, ties where they can be seen, and breaks; what stands beside them."""
    draw_site(axes, scene, window)
    line = scene.track
    for rail in beside(line, (-HALF_GAUGE, HALF_GAUGE)):
        axes.plot(rail[:, 0], rail[:, 1], color=RAIL, lw=1.1, zorder=1)
    if points_per_metre > 4.0:
        step = np.linalg.norm(np.diff(line, axis=0), axis=1)
        arc = np.concatenate([[0.0], np.cumsum(step)])
        at = np.arange(0.0, arc[-1], 1.2)
        ends = [
            np.stack([np.interp(at, arc, edge[:, k]) for k in (0, 1)], axis=-1)
            for edge in beside(line, (-1.25, 1.25))
        ]
        ties = np.stack(ends, axis=1)
        axes.add_collection(LineCollection(ties, colors="#d9d4cd", linewidths=1.4, zorder=0.5))
    labels, _ = break_labels(axes, scene, window)
    for x, y, heading in scene.breaks:
        n = np.array([-math.sin(heading), math.cos(heading)])
        ends = np.array([[x, y] - 2.6 * n, [x, y] + 2.6 * n])
        axes.plot(ends[:, 0], ends[:, 1], color=VERMILION, lw=2.6, zorder=6, solid_capstyle="butt")
        if not within(window, x, y):
            continue
        at = labels.pop(0)
        axes.plot([x, x], [y, at[1]], color=VERMILION, lw=1.0, ls=(0, (1, 2)), zorder=2)
        label(axes, "rail break", at, color=VERMILION, size=8, weight="bold")


# --- cars ------------------------------------------------------------------------------------


def state_handles() -> list[Patch]:
    """Entries of a legend for the states of a car."""
    return [hatched(*state) for state in STATES]


class Bodies:
    """The cars by their state, and a wide edge around those that are not of the train.

    No body that stands for many. The hatch of all cars of a state is one path: drawn car by car it
    takes ten times as long.
    """

    def __init__(self, scene: Scene, lw: float, zorder: float, with_hatch: bool) -> None:
        edge = {"edgecolors": GREEN, "linewidths": 3.5 * lw, "facecolors": "none"}
        look: dict[str, Any] = {"edgecolors": INK, "zorder": zorder}
        self.around = PolyCollection([], zorder=zorder - 0.1, **edge)
        self.fills = [
            PolyCollection([], facecolors=fill, linewidths=lw, **look) for _, fill, _ in STATES
        ]
        self.hatches = {
            k: PathCollection([], facecolors="none", linewidths=0.0, hatch=hatch, **look)
            for k, (*_, hatch) in enumerate(STATES)
            if hatch and with_hatch
        }
        self.artists = [self.around, *self.fills, *self.hatches.values()]
        self.move(scene)

    def move(self, scene: Scene) -> None:
        """Move the cars to where they are in a scene."""
        outlines = scene.outlines()
        self.around.set_verts(list(outlines[~scene.own]))
        for k, fill in enumerate(self.fills):
            verts = outlines[scene.real & (scene.state == k)]
            fill.set_verts(list(verts))
            if k in self.hatches:
                paths = [Outline(polygon) for polygon in verts]
                self.hatches[k].set_paths([Outline.make_compound_path(*paths)] if paths else [])


def draw_bodies(
    axes: Axes, scene: Scene, lw: float, zorder: float = 4.0, with_hatch: bool = True
) -> Bodies:
    """Draw the cars of a scene."""
    bodies = Bodies(scene, lw, zorder, with_hatch)
    for artist in bodies.artists:
        axes.add_collection(artist)
    return bodies


def draw_fronts(axes: Axes, scene: Scene) -> PolyCollection:
    """The front end of each car, dark."""
    fronts = list(scene.fronts()[scene.real])
    return axes.add_collection(PolyCollection(fronts, facecolors=INK, zorder=4.5))


def draw_stand_ins(axes: Axes, scene: Scene, lw: float, zorder: float) -> None:
    """The bodies that stand for many cars."""
    axes.add_collection(
        PolyCollection(
            list(scene.outlines()[~scene.real]),
            facecolors=STAND_IN,
            edgecolors=FAINT,
            linestyles="--",
            linewidths=lw,
            zorder=zorder,
        )
    )


def draw_cars(
    axes: Axes, scene: Scene, window: Window, points_per_metre: float, forces: bool = True
) -> None:
    """Couplers, bodies and numbers of the cars; diamonds below those that were struck hard."""
    draw_couplers(axes, scene, points_per_metre)
    draw_bodies(axes, scene, 0.9)
    draw_fronts(axes, scene)
    draw_stand_ins(axes, scene, 0.9, 3)
    size = float(np.clip(0.62 * 2.6 * points_per_metre, 5.0, 10.0))
    pad = {"boxstyle": "round,pad=0.12", "fc": "white", "ec": "none", "alpha": 0.85}
    places = number_places(scene, 2.4 * size / points_per_metre)
    for i, (x, y) in enumerate(places):
        if not scene.real[i]:
            # In the middle of what can be seen of it, if that is not too little.
            seen = np.clip(scene.corners()[i, :, 0], window[0], window[1])
            if np.ptp(seen) > 5.0:
                text = f"{scene.represents[i]} cars"
                middle = 0.5 * (seen.min() + seen.max())
                axes.text(middle, y, text, size=7, ha="center", va="center")
            continue
        if not within(window, x, y):
            continue
        look: dict[str, Any] = {"ha": "center", "zorder": 10, "bbox": pad}
        number = str(scene.numbers[i])
        axes.text(x, y, number, size=size, weight="bold", va="center_baseline", **look)
        marks = sum(scene.peak_force[i] >= f for f in (RUPTURE_FORCE, CERTAIN_RUPTURE_FORCE))
        if marks and forces:
            look = {"color": VERMILION, "size": 0.75 * size, "zorder": 11}
            look["bbox"] = pad | {"boxstyle": "round,pad=0.05"}
            diamonds = "\N{BLACK DIAMOND}" * marks
            label(axes, diamonds, (x, y), (0, -0.95 * size), annotation_clip=True, **look)


def number_places(scene: Scene, apart: float) -> NDArray:
    """Places of the numbers, (N, 2): the middle of the car, or along it where another is there.

    ``apart`` is the distance at which two numbers do not touch, m.
    """
    places = scene.pose[:, :2].copy()
    axis = np.stack([np.cos(scene.pose[:, 2]), np.sin(scene.pose[:, 2])], axis=-1)
    for i in range(len(places)):
        others = places[:i]
        best, room = places[i], -1.0
        for share in (0.0, 0.2, -0.2, 0.32, -0.32):
            there = scene.pose[i, :2] + share * scene.length[i] * axis[i]
            near = float(np.linalg.norm(others - there, axis=1).min(initial=np.inf))
            if near > room:
                best, room = there, near
            if near >= apart:
                best = there
                break
        places[i] = best
    return places


def draw_couplers(axes: Axes, scene: Scene, points_per_metre: float) -> None:
    """Couplers, mated ones with a dot, parted ones with a cross."""
    pivots, faces = scene.pivots(), scene.faces()
    shanks = np.stack([pivots, faces], axis=2)[scene.real].reshape(-1, 2, 2)
    width = float(np.clip(0.25 * points_per_metre, 0.8, 2.2))
    axes.add_collection(LineCollection(list(shanks), colors=INK, linewidths=width, zorder=3.5))
    dot = float(np.clip(0.55 * points_per_metre, 1.5, 4.5))
    for i in range(len(scene.pose) - 1):
        if scene.coupled[i]:
            x, y = faces[i, 1] if scene.real[i] else faces[i + 1, 0]
            axes.plot(x, y, "o", ms=dot, mfc=INK, mec="white", mew=0.4, zorder=7)
        elif scene.parted[i]:
            for x, y in (faces[i, 1], faces[i + 1, 0]):
                axes.plot(x, y, "x", ms=dot + 1.0, mec=VERMILION, mew=1.5, zorder=8)


def draw_box(axes: Axes, scene: Scene) -> None:
    """The box of the derailed cars with its dimensions."""
    derailed = scene.derailed & scene.real & scene.own
    if not derailed.any() or not scene.straight:
        return
    points = scene.corners()[derailed].reshape(-1, 2)
    low, high = points.min(axis=0), points.max(axis=0)
    look: dict[str, Any] = {"fill": False, "ec": BLUE, "lw": 0.9, "ls": (0, (5, 4)), "zorder": 2}
    axes.add_patch(Rectangle(tuple(low), *(high - low), **look))
    long = scene.scene_length if math.isfinite(scene.scene_length) else high[0] - low[0]
    wide = scene.scene_width if math.isfinite(scene.scene_width) else high[1] - low[1]
    # Clear of the cars and of the couplers at their ends, at any scale.
    ahead, top = np.maximum(high, scene.faces()[derailed].reshape(-1, 2).max(axis=0))
    middle = 0.5 * (low + high)
    look = {"color": BLUE, "size": 9, "zorder": 11}
    label(axes, metres(long), (middle[0], top), (0, 4), va="bottom", **look)
    label(axes, metres(wide), (ahead, middle[1]), (5, 0), ha="left", rotation=90, **look)


def draw_key(
    figure: Figure, scenes: Sequence[Scene], left: float, top: float, window: Window | None
) -> None:
    """Explain what is in one or several scenes; of one, how many cars of each kind.

    A body for many cars is explained if it reaches into the window; without one all is shown.
    """
    handles: list[Any] = []
    one = len(scenes) == 1
    for k, (text, fill, hatch) in enumerate(STATES):
        count = sum(int((s.real & s.own & (s.state == k)).sum()) for s in scenes)
        if count:
            handles.append(hatched(f"{text} ({count})" if one else text, fill, hatch))
    standing = sum(int((~s.own).sum()) for s in scenes)
    if standing:
        text = f"not of the train ({standing})" if one else "not of the train"
        handles.append(hatched(text, "white", ec=GREEN, lw=2.5))
    bodies = [
        int(n)
        for s in scenes
        for n, corners in zip(s.represents[~s.real], s.corners()[~s.real])
        if window is None or _overlap(window_of(corners, 0.0), window)
    ]
    if bodies:
        text = f"one body for {sum(bodies)} cars" if one else "one body for many cars"
        handles.append(hatched(text, STAND_IN, ec=FAINT, ls="--"))
    if any(s.coupled.any() for s in scenes):
        look: dict[str, Any] = {"ls": "-", "color": INK, "mec": "white", "ms": 4.5}
        handles.append(mark("coupled", marker="o", **look))
    if any(s.parted.any() for s in scenes):
        handles.append(mark("parted", marker="x", mec=VERMILION, mew=1.5, ms=5.5))
    if any(np.any(s.peak_force >= RUPTURE_FORCE) for s in scenes):
        handles.append(mark("struck above 5 MN, two: 10 MN", **DIAMOND))
    legend(figure, left, top, handles, handlelength=1.8)


def _overlap(a: Window, b: Window) -> bool:
    return a[1] > b[0] and a[0] < b[1] and a[3] > b[2] and a[2] < b[3]
