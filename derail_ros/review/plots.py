"""Figures of a recorded run: collisions about to happen, speeds, energy, space and time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon
from matplotlib.ticker import MaxNLocator

from derail_ros.review import drawing
from derail_ros.review.drawing import (
    BLUE,
    DIAMOND,
    FAINT,
    INK,
    SUBTLE,
    VERMILION,
    WIDTH,
    Window,
    hatched,
    label,
    mark,
    styled,
)
from derail_ros.review.scene import scene_at
from derail_ros.review.summary import NOTABLE, by_severity
from derail_ros.vocabulary import words
from derail_ros.vocabulary.events import EventKind
from derail_ros.vocabulary.ledger import (
    ENERGY_ENTRIES,
    NO_ENERGY,
    PUT,
    available,
    entries,
    percentages,
)
from derail_ros.vocabulary.status import RUPTURE_FORCE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from derail_ros.recording.recorded_run import RecordedRun
    from derail_ros.review.scene import Scene
    from derail_ros.vocabulary.events import Collision

MOTION = "#e3e6ea"
BAND = "#b9bec4"

ENERGY_LOOK: dict[str, tuple[str, str]] = {
    "brakes": ("#56b4e9", ""),
    "ground_trucks": ("#e69f00", ""),
    "ground_body": ("#f0e442", "////"),
    "collisions": ("#d55e00", "xxxx"),
}
"""Fill and hatch of entries of the ledger; all others are drawn together in :data:`REST`."""
REST = ("draft gear, parted couplers, springs", "#cc79a7", "")

MARKS: dict[EventKind, tuple[str, dict[str, Any]]] = {
    EventKind.TRUCK_DERAILED: ("leaves the rails", {"marker": "v", "mfc": "#e69f00", "mec": INK}),
    EventKind.COUPLER_PARTED: ("coupling parts", {"marker": "x", "mec": INK, "mew": 1.3}),
    EventKind.CAR_AT_REST: ("comes to rest", {"marker": "s", "mfc": "white", "mec": INK}),
}
"""What is marked in figures over time."""


def car_colours() -> ListedColormap:
    """Colours for car numbers: cividis without its palest end, readable on white."""
    return ListedColormap(matplotlib.colormaps["cividis"](np.linspace(0.0, 0.86, 256)))


# --- collisions ------------------------------------------------------------------------------

BEFORE = 0.25
"""How long before the contact its scene is drawn, s."""


MOST_COLLISIONS = 4
"""Collisions that are drawn."""


def main_collisions(run: RecordedRun) -> list[Collision]:
    """The hardest collisions, of each pair of cars one; the hardest first."""
    chosen: dict[frozenset[int], Collision] = {}
    for c in by_severity(run):
        if min(c.car_a, c.car_b) >= 1 and max(c.car_a, c.car_b) <= run.n:
            chosen.setdefault(frozenset((c.car_a, c.car_b)), c)
    return list(chosen.values())[:MOST_COLLISIONS]


@styled
def collision(run: RecordedRun, contact: Collision) -> Figure:
    """Draw a collision: just before the cars touch, and at the peak of the force."""
    times = (max(float(run.time[0]), contact.start - BEFORE), contact.peak_time)
    scenes = [scene_at(run, time) for time in times]
    window = _around(scenes, contact)
    gap = 0.35
    inner = (WIDTH - 1.0 - gap) / 2.0
    tall = inner * (window[3] - window[2]) / (window[1] - window[0])
    top = 1.02
    figure = drawing.sheet(WIDTH, top + tall + 0.62)
    heads = (
        f"{contact.start - times[0]:.2f} s before the cars touch",
        f"at the peak: {words.force(contact.peak_force)}",
    )
    points = inner * 72.0 / (window[1] - window[0])
    for k, (time, head, scene) in enumerate(zip(times, heads, scenes)):
        axes = drawing.place(figure, 0.5 + k * (inner + gap), top, inner, tall)
        drawing.show(axes, window)
        drawing.draw_track(axes, scene, window, points)
        drawing.draw_cars(axes, scene, window, points, forces=False)
        _draw_velocities(axes, run, time, window)
        outlines = scene.outlines()
        for car in (contact.car_a, contact.car_b):
            look = {"fill": False, "ec": VERMILION, "lw": 2.2, "zorder": 9}
            axes.add_patch(Polygon(outlines[car - 1], closed=True, **look))
        if k == 1:
            at = np.array([contact.x, contact.y])
            normal = np.array([contact.normal_x, contact.normal_y])
            long = 0.14 * (window[1] - window[0])
            drawing.arrow(axes, at, at + long * normal, 0.7, color=VERMILION, lw=3.0)
            axes.plot(*at, ms=17, zorder=14, **STAR)
        axes.set_title(f"{time:.2f} s   {head}", loc="left", fontsize=10, weight="bold", pad=5)
        drawing.scale_inside(axes, window, 0.2, scene=scene)
    note = (
        f"{run.title}.  {words.capital(contact.touch)}; {contact.approach},"
        f" {math.degrees(contact.angle):.0f}° between the cars;"
        f" {words.energy(contact.energy_lost)} taken out of them."
    )
    drawing.heading(figure, f"Car {contact.car_a} strikes car {contact.car_b}", note)
    velocity = {"ls": "-", "color": BLUE, "lw": 1.6, "marker": ">"}
    handles = [
        *drawing.state_handles(),
        hatched("the two cars", "none", ec=VERMILION, lw=2.2),
        mark("velocity, 1 m for 2 m/s", **velocity),
        mark("contact and force on the striking car", **(STAR | {"ms": 13})),
    ]
    drawing.legend(figure, 0.5, top + tall + 0.25, handles, columnspacing=1.4)
    return figure


STAR: dict[str, Any] = {"marker": "*", "ls": "", "mfc": VERMILION, "mec": "white", "mew": 1.0}


def _around(scenes: Sequence[Scene], contact: Collision) -> Window:
    """Window around both cars at both times, at least 50 m wide."""
    pair = [contact.car_a - 1, contact.car_b - 1]
    window = drawing.window_of(np.stack([scene.corners()[pair] for scene in scenes]), 8.0)
    x0, x1, y0, y1 = window
    aspect = float(np.clip((y1 - y0) / (x1 - x0), 0.62, 1.05))
    x0, x1, y0, y1 = drawing.fit(window, aspect)
    if x1 - x0 < 50.0:
        middle = 0.5 * (x0 + x1)
        return drawing.fit((middle - 25.0, middle + 25.0, y0, y1), aspect)
    return x0, x1, y0, y1


def _draw_velocities(axes: Axes, run: RecordedRun, time: float, window: Window) -> None:
    places, velocities = run.pose_at(time)[:, :2], run.velocity[run.at(time), :, :2]
    for k in np.flatnonzero(run.cars.real & (np.hypot(*velocities.T) >= 1.5)):
        if drawing.within(window, *places[k]):
            end = places[k] + 0.5 * velocities[k]
            look = {"color": BLUE, "lw": 1.6, "shrinkA": 7, "zorder": 12}
            drawing.arrow(axes, places[k], end, 0.5, **look).set_clip_on(True)


# --- over time -------------------------------------------------------------------------------


def _sheet(height: float, right: float, title: str, note: str) -> tuple[Figure, Axes]:
    """A figure with one plot over time; ``right`` inches beside it are left free."""
    figure = drawing.sheet(WIDTH, height)
    axes = drawing.place(figure, 0.8, 0.95, WIDTH - 0.8 - right, height - 1.55)
    drawing.heading(figure, title, note, left=0.8)
    drawing.dress(axes)
    axes.set_xlabel("time, s")
    return figure, axes


def _time_axis(axes: Axes, start: float, end: float) -> None:
    """Set the ends of a time axis, also of a run of a single moment."""
    axes.set_xlim(start, end if end > start else start + 0.1)


def _active(run: RecordedRun) -> list[int]:
    """Indices of the cars that derailed, parted or were struck."""
    found = {int(i) for i in np.flatnonzero(run.derailed.any(axis=0) & run.cars.real)}
    for c in run.collisions:
        found |= {car - 1 for car in (c.car_a, c.car_b) if 1 <= car <= run.n}
    return sorted(found)


def _colour_bar(figure: Figure, axes: Axes, norm: Normalize) -> None:
    """A colour bar of car numbers at the right of the plot."""
    box = axes.get_position()
    bar = figure.add_axes((box.x1 + 0.012, box.y0, 0.011, box.height))
    ticks = MaxNLocator(integer=True, nbins=8)
    scale = figure.colorbar(ScalarMappable(norm=norm, cmap=car_colours()), cax=bar, ticks=ticks)
    scale.ax.invert_yaxis()
    scale.outline.set_visible(False)  # type: ignore[operator]
    scale.ax.tick_params(length=2, labelsize=8)
    scale.set_label("car", size=8.5)


KMH = (20, 40, 60, 80, 100, 120)


@styled
def speeds(run: RecordedRun) -> Figure:
    """Draw the speed of each car over time, with its events."""
    active = _active(run)
    calm = [i for i in range(run.n) if i not in active]
    notes = []
    if calm:
        notes.append("The band holds the cars that stayed on the rails.")
    if len(active) > 1:
        notes.append(f"{'The others' if calm else 'Cars'} are coloured by their number.")
    figure, axes = _sheet(5.6, 1.15, f"{run.title}: speed of each car", " ".join(notes))
    speed = run.speed
    handles: list[Any] = []
    if calm:
        low, high = speed[:, calm].min(axis=1), speed[:, calm].max(axis=1)
        axes.fill_between(run.time, low, high, color=BAND, lw=1.6, zorder=2)
        text = f"{words.cars([i + 1 for i in calm])}, on the rails"
        handles.append(Patch(fc=BAND, label=text))
    norm = Normalize(active[0] + 1, active[-1] + 1) if active else Normalize(1, 2)
    colours = car_colours()
    if len(active) == 1:
        handles.append(Line2D([], [], color=colours(0.0), label=f"car {active[0] + 1}"))
    for i in active:
        axes.plot(run.time, speed[:, i], color=colours(norm(i + 1)), lw=1.15, zorder=3)

    def put(car: int, time: float, **look: Any) -> None:
        at = np.interp(time, run.time, speed[:, car - 1])
        axes.plot(time, at, **({"ls": "", "ms": 5} | look))

    for kind in (EventKind.TRUCK_DERAILED, EventKind.COUPLER_PARTED):
        text, look = MARKS[kind]
        found = [e for e in run.events if e.kind == kind and e.cars and e.cars[0] <= run.n]
        if kind == EventKind.TRUCK_DERAILED:
            text = f"first truck {text}"
            found = list({e.cars[0]: e for e in reversed(found)}.values())
        for e in found:
            put(e.cars[0], e.time, zorder=5, **look)
        if found:
            handles.append(mark(text, **look))
    hard = [c for c in run.collisions if c.peak_force >= RUPTURE_FORCE]
    for c in hard:
        for car in (c.car_a, c.car_b):
            if 1 <= car <= run.n:
                put(car, c.start, zorder=6, **DIAMOND)
    if hard:
        handles.append(mark("struck above 5 MN", **DIAMOND))
    _time_axis(axes, float(run.time[0]), float(run.time[-1]))
    axes.set_ylim(0.0, float(speed.max()) * 1.05 + 0.1)
    axes.set_ylabel("speed, m/s")
    drawing.legend_above(axes, handles, 4)
    kmh = axes.secondary_yaxis("right", functions=(lambda v: v * 3.6, lambda v: v / 3.6))
    kmh.tick_params(length=3, color=drawing.TICKS, labelsize=8, direction="in", pad=-4)
    kmh.spines["right"].set_visible(False)
    kmh.set_yticks(KMH, [f"{v} km/h" if v == KMH[0] else f"{v}" for v in KMH], ha="right")
    for tick in kmh.get_yticklabels():
        tick.set_color(FAINT)
    if len(active) > 1:
        _colour_bar(figure, axes, norm)
    return figure


def energy_parts(energy: dict[str, NDArray], shown: Sequence[str]) -> list[tuple[str, NDArray]]:
    """What has become of the energy put in: motion, some takers, and in "" all the rest.

    Parameters
    ----------
    energy : entry of the ledger -> (E,) J
    shown : takers that are told apart
    """
    zero = np.zeros_like(energy["initial"])
    parts = [("kinetic", energy["kinetic"])]
    parts += [(entry, np.maximum(energy.get(entry, zero), 0.0)) for entry in shown]
    came = sum((energy.get(e.key, zero) for e in entries(PUT)), energy["initial"])
    came = came - np.minimum(energy.get("potential", zero), 0.0)
    rest = came - sum(values for _, values in parts)
    return [*parts, ("", np.maximum(rest, 0.0))]


@styled
def energy_over_time(run: RecordedRun) -> Figure | None:
    """Draw where the energy has gone, over time; None without a ledger."""
    if not run.energy:
        return None
    initial = available(run.ledger())
    unit, size = ("GJ", 1e9) if initial >= 1e9 else ("MJ", 1e6)
    title = f"{run.title}: what stopped the train"
    note = f"Where the {words.energy(initial)} went, over time."
    if initial == run.energy["initial"][0]:
        note = f"Where the {words.energy(initial)} at the start went, over time."
    figure, axes = _sheet(5.2, 2.75, title, note)
    time = run.energy_time
    parts = energy_parts(dict(run.energy), list(ENERGY_LOOK))
    least = max(NO_ENERGY, 1e-6 * initial)  # as little as the ledger leaves unexplained
    drawn = [(key, part) for key, part in parts if key == "kinetic" or part.max() >= least]
    ends = [float(part[-1]) for _, part in drawn]
    shares = [end / initial if initial > 0.0 else 0.0 for end in ends]
    below = np.zeros_like(time)
    places: list[tuple[float, str]] = []
    for (key, part), end, share, percent in zip(drawn, ends, shares, percentages(shares)):
        above = below + part / size
        if key == "kinetic":
            name, fill, hatch = "still motion", MOTION, ""
            axes.fill_between(time, below, above, color=fill, lw=0.0, zorder=2)
            axes.plot(time, above, color=INK, lw=1.4, zorder=4)
        else:
            name, fill, hatch = _energy_look(key)
            look = {"facecolor": fill, "edgecolor": INK, "hatch": hatch or None, "lw": 0.5}
            axes.fill_between(time, below, above, zorder=3, **look)
        if key != "kinetic" or share >= 0.005:
            number = f"{percent} %" if share >= 0.005 else f"{100.0 * share:.1f} %"
            middle = 0.5 * float(below[-1] + above[-1])
            places.append((middle, f"{name}\n{words.energy(end)}, {number}"))
        below = above
    top = max(float(below.max()), initial / size) * 1.03
    _time_axis(axes, float(time[0]), float(time[-1]))
    axes.set_ylim(0.0, top)
    axes.set_ylabel(f"energy, {unit}")
    _side_labels(axes, places, 0.105 * top, 1.05, limit=top)
    kinetic = parts[0][1] / size
    high = np.flatnonzero(kinetic > 0.22 * top)
    if len(high):  # under the curve, where it is high enough
        t = float(time[0] + 0.45 * (time[high[-1]] - time[0]))
        at = (t, 0.42 * float(np.interp(t, time, kinetic)))
        axes.text(*at, "energy of motion", ha="center", va="center", size=10, zorder=6)
    return figure


def _energy_look(key: str) -> tuple[str, str, str]:
    """Name, fill and hatch of a part of the energy."""
    if not key:
        return REST
    return (ENERGY_ENTRIES[key].words.removeprefix("the "), *ENERGY_LOOK[key])


def _side_labels(
    axes: Axes,
    places: Sequence[tuple[float, str]],
    gap: float,
    beside: float,
    limit: float = math.inf,
    **look: Any,
) -> None:
    """Labels at the right edge, moved apart so that none covers another.

    Parameters
    ----------
    places : level on the axis and text of each
    gap : least distance of two labels, in units of the axis
    beside : where they begin, 1 is the right edge
    limit : upper end of the axis
    """
    if not places:
        return
    places = sorted(places)
    at = apart([level for level, _ in places], gap)
    at[-1] = min(at[-1], limit - 0.4 * gap)
    for k in range(len(at) - 2, -1, -1):
        at[k] = min(at[k], at[k + 1] - gap)
    line = {"arrowstyle": "-", "color": FAINT, "lw": 0.6, "shrinkA": 1, "shrinkB": 0}
    for (real, text), level in zip(places, at):
        axes.annotate(
            text,
            xy=(1.0, real),
            xytext=(beside, level),
            xycoords=("axes fraction", "data"),
            textcoords=("axes fraction", "data"),
            va="center",
            arrowprops=line | {"relpos": (0.0, 0.5)},
            annotation_clip=False,
            **({"size": 8.5, "linespacing": 1.25} | look),
        )


def apart(at: list[float], gap: float) -> list[float]:
    """Rising places moved as little as possible until all are ``gap`` apart."""
    groups: list[tuple[float, int]] = []  # middle and number of those side by side
    for place in at:
        groups.append((place, 1))
        while len(groups) > 1:
            (a, m), (b, n) = groups[-2], groups[-1]
            if b - a >= 0.5 * (m + n) * gap:
                break
            groups[-2:] = [((a * m + b * n) / (m + n), m + n)]
    return [m + (k - 0.5 * (n - 1)) * gap for m, n in groups for k in range(n)]


MOST_STATES = 900
"""States of which a line in space and time is drawn."""
LABELLED = 6
"""Collisions whose force is written."""


@styled
def space_time(run: RecordedRun) -> Figure:
    """Draw where each car was at each time along the track, with the events."""
    active = _active(run)
    shown = list(range(min(run.n, (active[-1] if active else 0) + 6)))
    title = f"{run.title}: the train in space and time"
    note = "Each line is the middle of a car: its place along the track over time."
    figure, axes = _sheet(7.4, 0.45, title, note)
    index = some(len(run.time), MOST_STATES)
    time, end = run.time[index], float(run.time[-1])
    flat = run.pose[index][:, shown, :2]
    s, _ = run.line.locate_all(flat[..., 0].ravel(), flat[..., 1].ravel())
    s = s.reshape(len(index), len(shown))
    off = run.derailed[index][:, shown]
    for k in range(len(shown)):
        axes.plot(time, s[:, k], color="#9aa0a6", lw=0.9, zorder=2)
        axes.plot(time, np.where(off[:, k], s[:, k], np.nan), color=BLUE, lw=1.5, zorder=3)
    handles = [
        Line2D([], [], color="#9aa0a6", lw=1.2, label="on the rails"),
        Line2D([], [], color=BLUE, lw=1.6, label="derailed"),
    ]
    for kind, (text, look) in MARKS.items():
        found = [
            (e.time, np.interp(e.time, time, s[:, shown.index(e.cars[0] - 1)]))
            for e in run.events
            if e.kind == kind and e.cars and e.cars[0] - 1 in shown
        ]
        if found:
            size = 4 if kind != EventKind.CAR_AT_REST else 3.2
            axes.plot(*zip(*found), ls="", ms=size, zorder=5, **look)
            handles.append(mark(text, **look))
    if _draw_collisions(axes, run):
        handles.append(mark("collision above 1 MN, by force", ms=6, **DIAMOND))
    for s_break, *_, opened in run.line.breaks:
        axes.plot([opened, end], [s_break, s_break], color=INK, lw=1.2, ls=(0, (6, 3)))
        right: dict[str, Any] = {"ha": "right", "va": "bottom", "zorder": 8}
        right |= {"xycoords": ("axes fraction", "data")}
        label(axes, "rail break", (1.0, s_break), (-4, 4), **right)
    _time_axis(axes, float(time[0]), end)
    low = min(float(s[-1].min()), float(run.line.breaks[:, 0].min(initial=np.inf)))
    bottom, top = low - 35.0, float(s.max()) + 15.0
    axes.set_ylim(bottom, top)
    ends = [(s[-1, k], str(i + 1)) for k, i in enumerate(shown) if bottom < s[-1, k] < top]
    _side_labels(axes, ends, 0.0165 * (top - bottom), 1.018, size=6.5, color=SUBTLE)
    axes.set_ylabel("place along the track, m")
    drawing.legend_above(axes, handles, 6, columnspacing=1.4)
    return figure


def _draw_collisions(axes: Axes, run: RecordedRun) -> bool:
    """Diamonds at the collisions that are notable, the hardest with their force."""
    hard = [c for c in by_severity(run) if c.peak_force >= NOTABLE]
    places, _ = run.line.locate_all(np.array([c.x for c in hard]), np.array([c.y for c in hard]))
    near = 0.07 * (run.time[-1] - run.time[0])
    labelled: list[float] = []
    for c, where in zip(hard, places):
        size = 3.5 + 6.0 * math.sqrt(min(c.peak_force / 25e6, 1.0))
        axes.plot(c.peak_time, where, ms=size, mew=0.6, zorder=6, **DIAMOND)
        clear = all(abs(c.peak_time - t) >= near for t in labelled)
        if c.peak_force >= RUPTURE_FORCE and clear and len(labelled) < LABELLED:
            labelled.append(c.peak_time)
            text = f"{c.peak_force * 1e-6:.1f} MN"
            left: dict[str, Any] = {"ha": "left", "va": "bottom", "size": 8, "zorder": 8}
            label(axes, text, (c.peak_time, where), (8, 7), **left)
    return bool(hard)


def some(count: int, most: int) -> NDArray[np.int64]:
    """Indices of about ``most`` of ``count`` entries at most, the first and the last too."""
    step = max(1, math.ceil(count / most))
    return np.unique(np.append(np.arange(0, count, step), count - 1))
