"""Figures of a recorded run: collisions about to happen, speeds, energy, space and time.

They complete those of :mod:`derail_ros.review.figures` in the same manner: Okabe and Ito's
colours, and nothing told by colour alone.
"""

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

from derail_ros.review import figures, words
from derail_ros.review.figures import (
    FAINT,
    INK,
    RUPTURE,
    STATES,
    STYLE,
    VERMILION,
    WIDTH,
    legend_above,
)
from derail_ros.review.run_scene import scene_at
from derail_ros.review.summary import by_severity
from derail_ros.vocabulary.events import Collision, EventKind

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from derail_ros.recording.recorded_run import RecordedRun

SUBTLE = "#555555"
GREEN = "#009e73"
BLUE = "#0072b2"

ENERGY_LOOK: tuple[tuple[str, str, str, str], ...] = (
    ("brakes", "brakes", "#56b4e9", ""),
    ("ground_trucks", "ground, under derailed trucks", "#e69f00", ""),
    ("ground_body", "ground, under uncoupled cars", "#f0e442", "////"),
    ("collisions", "collisions", "#d55e00", "xxxx"),
    ("rest", "draft gear, parted couplers, springs", "#cc79a7", ""),
)
"""Entry of the ledger, label, fill and hatch."""


def car_colours() -> ListedColormap:
    """Colours for car numbers: cividis without its palest end, readable on white."""
    table = matplotlib.colormaps["cividis"](np.linspace(0.0, 0.86, 256))
    return ListedColormap(table)


# --- collisions ------------------------------------------------------------------------------

BEFORE = 0.25
"""How long before the contact its scene is drawn, s."""


def main_collisions(run: RecordedRun, count: int = 4) -> list[Collision]:
    """The hardest collisions, of each pair of cars one; the hardest first."""
    chosen: list[Collision] = []
    pairs: set[frozenset[int]] = set()
    for contact in by_severity(run):
        pair = frozenset((contact.car_a, contact.car_b))
        if pair not in pairs and max(pair) <= run.n:
            pairs.add(pair)
            chosen.append(contact)
        if len(chosen) == count:
            break
    return chosen


def collision(run: RecordedRun, contact: Collision) -> Figure:
    """Draw a collision: just before the cars touch, and at the peak of the force."""
    with matplotlib.rc_context(STYLE):
        return _collision(run, contact)


def _collision(run: RecordedRun, contact: Collision) -> Figure:
    times = (max(float(run.time[0]), contact.start - BEFORE), contact.peak_time)
    window = _around(run, contact, times)
    gap = 0.35
    inner = (WIDTH - 1.0 - gap) / 2.0
    tall = inner * (window[3] - window[2]) / (window[1] - window[0])
    top, bottom = 1.02, 0.62
    height = top + tall + bottom
    figure = figures._figure(height)
    heads = (
        f"{contact.start - times[0]:.2f} s before the cars touch",
        f"at the peak: {words.force(contact.peak_force)}",
    )
    for k, (time, head) in enumerate(zip(times, heads)):
        left = 0.5 + k * (inner + gap)
        axes = figure.add_axes(
            (left / WIDTH, bottom / height, inner / WIDTH, tall / height), zorder=1
        )
        figures._prepare(axes, window)
        scene = scene_at(run, time)
        points = inner * 72.0 / (window[1] - window[0])
        figures._draw_track(axes, scene, window, points)
        figures._draw_cars(axes, _without_forces(scene), window, points)
        _draw_velocities(axes, run, time, window)
        _draw_pair(axes, scene, contact)
        if k == 1:
            _draw_force(axes, contact, window)
        axes.set_title(f"{time:.2f} s   {head}", loc="left", fontsize=10, weight="bold", pad=5)
        _scale_inside(axes, window)
    x = 0.5 / WIDTH
    a, b = contact.car_a, contact.car_b
    figures._headline(figure, x, 1.0 - 0.28 / height, f"Car {a} strikes car {b}", 80)
    note = (
        f"{run.title}.  {_capital(contact.touch)}; closing at {contact.closing_speed:.1f} m/s,"
        f" {math.degrees(contact.angle):.0f}° between the cars;"
        f" {words.energy(contact.energy_lost)} taken out of them."
    )
    figure.text(x, 1.0 - 0.55 / height, note, size=9.5, color=SUBTLE, va="center")
    handles = [
        Patch(fc=fill, ec=INK, hatch=hatch or None, lw=0.8, label=label)
        for label, fill, hatch in STATES
    ]
    handles.append(Patch(fc="none", ec=VERMILION, lw=2.2, label="the two cars"))
    handles.append(
        Line2D([], [], color=BLUE, lw=1.6, marker=">", ms=5, label="velocity, 1 m for 2 m/s")
    )
    handles.append(
        Line2D(
            [],
            [],
            ls="",
            marker="*",
            ms=13,
            mfc=VERMILION,
            mec="white",
            label="contact and force on the striking car",
        )
    )
    figure.legend(
        handles=handles,
        loc="lower left",
        bbox_to_anchor=(x, 0.12 / height),
        ncol=6,
        frameon=False,
        fontsize=8.5,
        handleheight=1.1,
        columnspacing=1.4,
        borderaxespad=0.0,
        borderpad=0.0,
    )
    return figure


def _capital(line: str) -> str:
    return line[:1].upper() + line[1:]


def _without_forces(scene: Any) -> Any:
    from dataclasses import replace

    return replace(scene, peak_force=np.full(len(scene.pose), np.nan))


def _around(run: RecordedRun, contact: Collision, times: Sequence[float]) -> figures.Window:
    """Window around both cars at both times, at least 50 m wide."""
    points = []
    for time in times:
        corners = scene_at(run, time).corners()
        points += [corners[car - 1] for car in (contact.car_a, contact.car_b)]
    flat = np.concatenate(points)
    low, high = flat.min(axis=0) - 8.0, flat.max(axis=0) + 8.0
    window = (float(low[0]), float(high[0]), float(low[1]), float(high[1]))
    aspect = float(np.clip((high[1] - low[1]) / (high[0] - low[0]), 0.62, 1.05))
    x0, x1, y0, y1 = figures._fit(window, aspect)
    if x1 - x0 < 50.0:
        x0, x1 = 0.5 * (x0 + x1) - 25.0, 0.5 * (x0 + x1) + 25.0
        return figures._fit((x0, x1, y0, y1), aspect)
    return x0, x1, y0, y1


def _draw_velocities(axes: Axes, run: RecordedRun, time: float, window: figures.Window) -> None:
    i = run.at(time)
    pose = run.pose_at(time)
    for k in range(run.n):
        x, y = pose[k, :2]
        vx, vy = run.velocity[i, k, :2]
        inside = window[0] < x < window[1] and window[2] < y < window[3]
        if not inside or math.hypot(vx, vy) < 1.5 or run.cars.represents[k] > 1:
            continue
        axes.annotate(
            "",
            xy=(x + 0.5 * vx, y + 0.5 * vy),
            xytext=(x, y),
            arrowprops={
                "arrowstyle": "-|>,head_width=0.22,head_length=0.5",
                "color": BLUE,
                "lw": 1.6,
                "shrinkA": 7,
                "shrinkB": 0,
            },
            zorder=12,
            annotation_clip=False,
        ).set_clip_on(True)


def _draw_pair(axes: Axes, scene: Any, contact: Contact) -> None:
    corners = scene.outlines()
    for car in (contact.car_a, contact.car_b):
        axes.add_patch(
            Polygon(corners[car - 1], closed=True, fill=False, ec=VERMILION, lw=2.2, zorder=9)
        )


def _draw_force(axes: Axes, contact: Collision, window: figures.Window) -> None:
    long = 0.14 * (window[1] - window[0])
    n = np.array([contact.normal_x, contact.normal_y])
    at = np.array([contact.x, contact.y])
    axes.annotate(
        "",
        xy=tuple(at + long * n),
        xytext=tuple(at),
        arrowprops={
            "arrowstyle": "-|>,head_width=0.35,head_length=0.7",
            "color": VERMILION,
            "lw": 3.0,
            "shrinkA": 0,
            "shrinkB": 0,
        },
        zorder=13,
    )
    axes.plot(*at, marker="*", ms=17, mfc=VERMILION, mec="white", mew=1.0, zorder=14)


def _scale_inside(axes: Axes, window: figures.Window) -> None:
    """A scale bar in the lower right corner."""
    wide = window[1] - window[0]
    bar = figures._nice(0.2 * wide)
    x1, y = window[1] - 0.03 * wide, window[2] + 0.035 * wide
    axes.plot([x1 - bar, x1], [y, y], color=INK, lw=2.5, solid_capstyle="butt", zorder=15)
    axes.annotate(
        f"{bar:g} m",
        xy=(x1 - 0.5 * bar, y),
        xytext=(0, 3),
        textcoords="offset points",
        ha="center",
        va="bottom",
        size=8.5,
        zorder=15,
        bbox={"boxstyle": "square,pad=0.1", "fc": "white", "ec": "none", "alpha": 0.85},
    )


# --- over time -------------------------------------------------------------------------------


def _plain(axes: Axes) -> None:
    axes.grid(color="#ececec", lw=0.8, zorder=0)
    axes.set_axisbelow(True)
    axes.tick_params(length=3, color="#c8c8c8")
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def _sheet(height: float, right: float, title: str, note: str) -> tuple[Figure, Axes]:
    """A figure with one plot; ``right`` inches beside it are left free."""
    figure = figures._figure(height)
    left = 0.8
    axes = figure.add_axes(
        (
            left / WIDTH,
            0.6 / height,
            (WIDTH - left - right) / WIDTH,
            (height - 0.6 - 0.95) / height,
        )
    )
    figures._headline(figure, left / WIDTH, 1.0 - 0.28 / height, title, 80)
    figure.text(left / WIDTH, 1.0 - 0.55 / height, note, size=9.5, color=SUBTLE, va="center")
    _plain(axes)
    return figure, axes


def _end(run: RecordedRun) -> float:
    """Where the time axis ends, s."""
    return float(run.time[-1])


def _time_axis(axes: Axes, start: float, end: float) -> None:
    """Set the ends of a time axis, also of a run of a single moment."""
    axes.set_xlim(start, end if end > start else start + 0.1)


def _active(run: RecordedRun) -> list[int]:
    """Indices of the cars that derailed, parted or were struck."""
    found = {int(i) for i in np.flatnonzero(run.derailed.any(axis=0) & run.cars.real)}
    for c in run.collisions:
        found |= {car - 1 for car in (c.car_a, c.car_b) if car <= run.n}
    return sorted(found)


MARKS: tuple[tuple[EventKind, str, dict[str, Any]], ...] = (
    (EventKind.TRUCK_DERAILED, "leaves the rails", {"marker": "v", "mfc": "#e69f00", "mec": INK}),
    (
        EventKind.COUPLER_PARTED,
        "coupling parts",
        {"marker": "x", "mfc": INK, "mec": INK, "mew": 1.3},
    ),
    (EventKind.CAR_AT_REST, "comes to rest", {"marker": "s", "mfc": "white", "mec": INK}),
)


def _colour_bar(figure: Figure, axes: Axes, norm: Normalize, note: str) -> None:
    """A colour bar at the right of the plot."""
    box = axes.get_position()
    bar = figure.add_axes((box.x1 + 0.012, box.y0, 0.011, box.height))
    mapping = ScalarMappable(norm=norm, cmap=car_colours())
    scale = figure.colorbar(mapping, cax=bar)
    scale.ax.invert_yaxis()
    scale.outline.set_visible(False)  # type: ignore[operator]
    scale.ax.tick_params(length=2, labelsize=8)
    scale.set_label(note, size=8.5)
    scale.locator = MaxNLocator(integer=True, nbins=8)
    scale.update_ticks()


def speeds(run: RecordedRun) -> Figure:
    """Draw the speed of each car over time, with what happened to it."""
    with matplotlib.rc_context(STYLE):
        return _speeds(run)


def _speeds(run: RecordedRun) -> Figure:
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
        axes.fill_between(run.time, low, high, color="#b9bec4", lw=1.6, zorder=2)
        label = f"{words.cars([i + 1 for i in calm])}, on the rails"
        handles.append(Patch(fc="#b9bec4", label=label))
    norm = Normalize(active[0] + 1, active[-1] + 1) if active else Normalize(1, 2)
    if len(active) == 1:
        handles.append(Line2D([], [], color=car_colours()(0.0), label=f"car {active[0] + 1}"))
    colours = car_colours()
    for i in active:
        axes.plot(run.time, speed[:, i], color=colours(norm(i + 1)), lw=1.15, zorder=3)
    used = set()
    for kind, label, look in MARKS[:2]:
        for e in run.events:
            first = e.kind == kind and e.cars and e.cars[0] <= run.n
            if not first or (kind == EventKind.TRUCK_DERAILED and (e.cars[0], kind) in used):
                continue
            used.add((e.cars[0], kind))
            at = np.interp(e.time, run.time, speed[:, e.cars[0] - 1])
            axes.plot(e.time, at, ls="", ms=5, zorder=5, **look)
        if any(k == kind for _, k in used):
            text = "first truck leaves the rails" if kind == EventKind.TRUCK_DERAILED else label
            handles.append(Line2D([], [], ls="", ms=5, label=text, **look))
    hard = [c for c in run.collisions if c.peak_force >= RUPTURE]
    for c in hard:
        for car in (c.car_a, c.car_b):
            if car <= run.n:
                at = np.interp(c.start, run.time, speed[:, car - 1])
                axes.plot(
                    c.start, at, ls="", marker="D", ms=5, mfc=VERMILION, mec="white", zorder=6
                )
    if hard:
        handles.append(
            Line2D(
                [],
                [],
                ls="",
                marker="D",
                ms=5,
                mfc=VERMILION,
                mec="white",
                label="struck above 5 MN",
            )
        )
    _time_axis(axes, float(run.time[0]), _end(run))
    axes.set_ylim(0.0, float(speed.max()) * 1.05 + 0.1)
    axes.set_xlabel("time, s")
    axes.set_ylabel("speed, m/s")
    legend_above(axes, handles, 4)
    kmh = axes.secondary_yaxis(
        "right",
        functions=(_to_kmh, _from_kmh),
    )
    kmh.tick_params(length=3, color="#c8c8c8", labelsize=8, direction="in", pad=-22)
    kmh.spines["right"].set_visible(False)
    kmh.set_yticks([20, 40, 60, 80, 100, 120])
    kmh.set_yticklabels([f"{v} km/h" if v == 20 else f"{v}" for v in (20, 40, 60, 80, 100, 120)])
    for tick in kmh.get_yticklabels():
        tick.set_horizontalalignment("right")
        tick.set_color(FAINT)
    kmh.tick_params(pad=-4)
    if len(active) > 1:
        _colour_bar(figure, axes, norm, "car")
    return figure


def _to_kmh(value: NDArray) -> NDArray:
    return np.asarray(value) * 3.6


def _from_kmh(value: NDArray) -> NDArray:
    return np.asarray(value) / 3.6


def energy_over_time(run: RecordedRun) -> Figure | None:
    """Draw where the energy has gone, over time; None without a ledger."""
    if not run.energy:
        return None
    with matplotlib.rc_context(STYLE):
        return _energy(run)


def _energy(run: RecordedRun) -> Figure:
    initial = float(run.energy["initial"][0])
    unit, size = ("GJ", 1e9) if initial >= 1e9 else ("MJ", 1e6)
    taken = {entry: run.energy[entry] for entry, *_ in ENERGY_LOOK if entry != "rest"}
    kinetic = run.energy["kinetic"]
    outside = run.energy["external"]
    rest = np.maximum(initial + outside - kinetic - sum(taken.values()), 0.0)
    figure, axes = _sheet(
        5.2,
        2.75,
        f"{run.title}: what stopped the train",
        f"Where the {words.energy(initial)} of the start have gone, over time.",
    )
    below = kinetic / size
    time = run.energy_time
    axes.fill_between(time, 0.0, below, color="#e3e6ea", lw=0.0, zorder=2)
    axes.plot(time, below, color=INK, lw=1.4, zorder=4)
    places: list[tuple[float, str, str, str]] = []
    for entry, label, fill, hatch in ENERGY_LOOK:
        part = rest if entry == "rest" else np.maximum(taken[entry], 0.0)
        if float(part.max()) < max(words.NO_ENERGY, 1e-6 * initial):
            continue  # nothing, or as little as the ledger leaves unaccounted for
        above = below + part / size
        axes.fill_between(
            time,
            below,
            above,
            facecolor=fill,
            edgecolor=INK,
            hatch=hatch or None,
            lw=0.5,
            zorder=3,
        )
        share = 100.0 * float(part[-1]) / initial if initial > 0.0 else 0.0
        text = f"{label}\n{words.energy(float(part[-1]))}, {share:.0f} %"
        if share < 0.5:
            text = f"{label}\n{words.energy(float(part[-1]))}, {share:.1f} %"
        places.append((0.5 * float(below[-1] + above[-1]), text, fill, hatch))
        below = above
    left = float(kinetic[-1]) / size
    share = 100.0 * left * size / initial if initial > 0.0 else 0.0
    if share >= 0.5:
        text = f"still motion\n{words.energy(left * size)}, {share:.0f} %"
        places.insert(0, (0.5 * left, text, "#e3e6ea", ""))
    top = max(float(below.max()), initial / size) * 1.03
    _time_axis(axes, float(time[0]), float(time[-1]))
    axes.set_ylim(0.0, top)
    axes.set_xlabel("time, s")
    axes.set_ylabel(f"energy, {unit}")
    _side_labels(axes, places, top, 0.105 * top)
    middle = _inside(time, kinetic / size, top)
    if middle is not None:
        axes.text(*middle, "energy of motion", ha="center", va="center", size=10, zorder=6)
    return figure


def _inside(time: NDArray, height: NDArray, top: float) -> tuple[float, float] | None:
    """A place for a label under the curve, if it is high enough."""
    high = np.flatnonzero(height > 0.22 * top)
    if len(high) == 0:
        return None
    t = float(time[0] + 0.45 * (time[high[-1]] - time[0]))
    return t, 0.42 * float(np.interp(t, time, height))


def _side_labels(
    axes: Axes, places: Sequence[tuple[float, str, str, str]], top: float, apart: float
) -> None:
    """Labels at the right edge, pushed apart so that none covers another."""
    if not places:
        return
    order = sorted(range(len(places)), key=lambda k: places[k][0])
    at = _apart([places[k][0] for k in order], apart)
    at[-1] = min(at[-1], top - 0.4 * apart)
    for k in range(len(at) - 2, -1, -1):
        at[k] = min(at[k], at[k + 1] - apart)
    for k, level in zip(order, at):
        real, text, fill, hatch = places[k]
        axes.annotate(
            text,
            xy=(1.0, real),
            xytext=(1.05, level),
            xycoords=("axes fraction", "data"),
            textcoords=("axes fraction", "data"),
            va="center",
            ha="left",
            size=8.5,
            linespacing=1.25,
            arrowprops={
                "arrowstyle": "-",
                "color": FAINT,
                "lw": 0.8,
                "shrinkA": 2,
                "shrinkB": 0,
                "relpos": (0.0, 0.5),
            },
            annotation_clip=False,
        )


def space_time(run: RecordedRun) -> Figure:
    """Draw where each car was at each time along the track, with the events."""
    with matplotlib.rc_context(STYLE):
        return _space_time(run)


def _space_time(run: RecordedRun) -> Figure:
    active = _active(run)
    shown = list(range(min(run.n, (active[-1] if active else 0) + 6)))
    figure, axes = _sheet(
        7.4,
        0.45,
        f"{run.title}: the train in space and time",
        "Each line is the middle of a car, its place along the track over time.",
    )
    step = max(1, len(run.time) // 900)
    index = np.unique(np.append(np.arange(0, len(run.time), step), len(run.time) - 1))
    time = run.time[index]
    flat = run.pose[index][:, shown, :2]
    s, _ = run.line.locate_all(flat[..., 0].ravel(), flat[..., 1].ravel())
    s = s.reshape(len(index), len(shown))
    off = run.derailed[index][:, shown]
    for k in range(len(shown)):
        axes.plot(time, s[:, k], color="#9aa0a6", lw=0.9, zorder=2)
        gone = np.where(off[:, k], s[:, k], np.nan)
        axes.plot(time, gone, color=BLUE, lw=1.5, zorder=3)
    handles = [
        Line2D([], [], color="#9aa0a6", lw=1.2, label="on the rails"),
        Line2D([], [], color=BLUE, lw=1.6, label="derailed"),
    ]
    for kind, label, look in MARKS:
        points = _event_places(run, kind, shown, time, s)
        if len(points):
            size = 4 if kind != EventKind.CAR_AT_REST else 3.2
            axes.plot(points[:, 0], points[:, 1], ls="", ms=size, zorder=5, **look)
            handles.append(Line2D([], [], ls="", ms=5, label=label, **look))
    hard = [c for c in run.collisions if c.peak_force >= 1e6]
    if hard:
        place, _ = run.line.locate_all(
            np.array([c.x for c in hard]), np.array([c.y for c in hard])
        )
        for c, where in zip(hard, place):
            size = 3.5 + 6.0 * math.sqrt(min(c.peak_force / 25e6, 1.0))
            axes.plot(
                c.peak_time,
                where,
                ls="",
                marker="D",
                ms=size,
                mfc=VERMILION,
                mec="white",
                mew=0.6,
                zorder=6,
            )
        span = run.time[-1] - run.time[0]
        labelled: list[float] = []
        for c, where in sorted(zip(hard, place), key=lambda p: -p[0].peak_force):
            near = any(abs(c.peak_time - t) < 0.07 * span for t in labelled)
            if c.peak_force < RUPTURE or near or len(labelled) == 6:
                continue
            labelled.append(c.peak_time)
            axes.annotate(
                f"{c.peak_force * 1e-6:.1f} MN",
                xy=(c.peak_time, where),
                xytext=(8, 7),
                textcoords="offset points",
                size=8,
                zorder=8,
                bbox={"boxstyle": "square,pad=0.12", "fc": "white", "ec": "none", "alpha": 0.85},
            )
        handles.append(
            Line2D(
                [],
                [],
                ls="",
                marker="D",
                ms=6,
                mfc=VERMILION,
                mec="white",
                label="collision above 1 MN, by force",
            )
        )
    for row in run.line.breaks:
        axes.plot([row[4], _end(run)], [row[0], row[0]], color=INK, lw=1.2, ls=(0, (6, 3)))
        axes.annotate(
            "rail break",
            xy=(1.0, row[0]),
            xycoords=("axes fraction", "data"),
            xytext=(-4, 4),
            textcoords="offset points",
            ha="right",
            size=8.5,
            bbox={"boxstyle": "square,pad=0.12", "fc": "white", "ec": "none", "alpha": 0.85},
            zorder=8,
        )
    _time_axis(axes, float(time[0]), _end(run))
    low = min(float(s[-1].min()), float(run.line.breaks[:, 0].min(initial=np.inf)))
    bottom, top = low - 35.0, float(s.max()) + 15.0
    axes.set_ylim(bottom, top)
    _number_lines(axes, [(s[-1, k], str(i + 1)) for k, i in enumerate(shown)], bottom, top)
    axes.set_xlabel("time, s")
    axes.set_ylabel("place along the track, m")
    legend_above(axes, handles, 6, columnspacing=1.4)
    return figure


def _number_lines(
    axes: Axes, ends: Sequence[tuple[float, str]], bottom: float, top: float
) -> None:
    """Numbers at the right ends of lines, pushed apart so that each can be read."""
    ends = sorted((e for e in ends if bottom < e[0] < top), key=lambda e: e[0])
    at = _apart([e[0] for e in ends], 0.0165 * (top - bottom))
    for (real, text), level in zip(ends, at):
        axes.annotate(
            text,
            xy=(1.0, real),
            xytext=(1.018, level),
            xycoords=("axes fraction", "data"),
            textcoords=("axes fraction", "data"),
            va="center",
            size=6.5,
            color=SUBTLE,
            arrowprops={
                "arrowstyle": "-",
                "color": FAINT,
                "lw": 0.5,
                "shrinkA": 1,
                "shrinkB": 0,
                "relpos": (0.0, 0.5),
            },
            annotation_clip=False,
        )


def _apart(at: list[float], gap: float) -> list[float]:
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


def _event_places(
    run: RecordedRun, kind: str, shown: Sequence[int], time: NDArray, s: NDArray
) -> NDArray:
    rows = [
        (e.time, np.interp(e.time, time, s[:, shown.index(e.cars[0] - 1)]))
        for e in run.events
        if e.kind == kind and e.cars and e.cars[0] - 1 in shown
    ]
    return np.array(rows).reshape(-1, 2)


def peak_forces(run: RecordedRun) -> Figure:
    """Draw the largest force on each car."""
    r = run.outcome
    return figures.peak_forces(
        r.car_peak_force,
        r.car_peak_other,
        time=r.car_peak_time,
        derailed=r.derailed_cars,
        title=run.title,
    )
