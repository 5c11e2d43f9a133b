"""Models side by side on one train: a table of measures, and a figure of the final scenes."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from derail_ros.baselines.models import MODELS, ModelRun, run_model
from derail_ros.baselines.train import ModelError
from derail_ros.vocabulary.measures import Record

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from derail_ros.review.scene import Scene
    from derail_ros.vocabulary.params import TrainParams

MEASURES: tuple[tuple[str, str, float, int], ...] = (
    ("cars derailed", "cars_derailed", 1.0, 1),
    ("duration (s)", "duration_s", 1.0, 1),
    ("peak force (MN)", "peak_force_N", 1e-6, 1),
    ("scene length (m)", "scene_length_m", 1.0, 1),
    ("scene width (m)", "scene_width_m", 1.0, 1),
    ("wall time (s)", "wall_s", 1.0, 3),
)
"""Heading, key of the record, factor, digits."""


@dataclass(frozen=True)
class Entry:
    """A model's answer, or why there is none."""

    model: str
    run: ModelRun | None
    error: str | None = None

    @property
    def record(self) -> Record | None:
        """The outcome."""
        return None if self.run is None else self.run.record


def compare(
    params: TrainParams,
    models: Sequence[str] = tuple(MODELS),
    progress: Callable[[str, int], None] | None = None,
) -> list[Entry]:
    """Put models to work on a train; one that cannot is an entry with the reason.

    ``progress`` is told the model that comes next and how many are done.
    """
    from derail_ros.vocabulary.errors import DerailError

    entries = []
    for done, name in enumerate(models):
        if progress is not None:
            progress(name, done)
        try:
            entries.append(Entry(name, run_model(name, params)))
        except (ModelError, DerailError) as error:
            entries.append(Entry(name, None, " ".join(str(error).split())))
    return entries


def cell(record: Mapping[str, Any] | None, key: str, factor: float, digits: int) -> str:
    """A measure as text; ``-`` where the model does not know it."""
    value = None if record is None else record.get(key)
    if value is None:
        return "-"
    if isinstance(value, int):
        return str(value)
    return f"{value * factor:.{digits}f}"


def rows(entries: Sequence[Entry]) -> list[list[str]]:
    """One row of texts a model: name, the measures, remark."""
    out = []
    for entry in entries:
        record = entry.record
        remark = entry.error or ""
        if record is not None and record["status"] != "at rest":
            remark = record["status"]
        out.append([entry.model, *(cell(record, key, f, d) for _, key, f, d in MEASURES), remark])
    return out


def markdown(entries: Sequence[Entry]) -> str:
    """The table for a page."""
    headings = ["model", *(m[0] for m in MEASURES), ""]
    lines = [
        "| " + " | ".join(headings) + " |",
        "|---|" + "---:|" * len(MEASURES) + "---|",
    ]
    for row in rows(entries):
        lines.append("| " + " | ".join([f"`{row[0]}`", *row[1:]]) + " |")
    return "\n".join(lines) + "\n"


# Figure ---------------------------------------------------------------------------------------


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
    import matplotlib

    from derail_ros.review.drawing import STYLE

    with matplotlib.rc_context(STYLE):
        return _figure(title, entries, counts, published)


def _window(scene: Scene) -> tuple[float, float, float, float]:
    corners = scene.corners()[scene.derailed & (scene.represents == 1)].reshape(-1, 2)
    if not len(corners):
        corners = scene.corners()[:3].reshape(-1, 2)
    low, high = corners.min(axis=0), corners.max(axis=0)
    return float(low[0]), float(high[0]), float(low[1]), float(high[1])


def _figure(
    title: str,
    entries: Sequence[Entry],
    means: Mapping[str, float] | None,
    published: float | None,
) -> Figure:
    import numpy as np
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.collections import LineCollection, PolyCollection
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    from derail_ros.review.drawing import BLUE, FAINT, INK, RAIL, STATES, VERMILION

    scenes = [(e, e.run.scene) for e in entries if e.run is not None and e.run.scene is not None]
    counts = [e for e in entries if e.record and e.record["cars_derailed"] is not None]
    windows = [_window(s) for _, s in scenes]
    margin = 10.0
    x0 = min((w[0] for w in windows), default=0.0) - margin
    x1 = max((w[1] for w in windows), default=1.0) + margin
    tall = [max(w[3] - w[2] + 8.0, 16.0) for w in windows]

    left, right, width = 0.25, 3.55, 12.0
    inner = width - left - right - 0.2
    scale = inner / (x1 - x0)
    heading, gap, foot = 0.75, 0.36, 0.5
    panels = [t * scale for t in tall]
    height = max(heading + sum(panels) + gap * len(panels) + foot, 3.2)
    page = Figure(figsize=(width, height), facecolor="white")
    FigureCanvasAgg(page)
    page.text(left / width, 1.0 - 0.25 / height, title, size=13, weight="bold", va="center")

    top = height - heading
    for (entry, scene), window, panel in zip(scenes, windows, panels, strict=True):
        assert entry.record is not None
        axes = page.add_axes((left / width, (top - panel) / height, inner / width, panel / height))
        middle = 0.5 * (window[2] + window[3])
        half = 0.5 * panel / scale
        axes.set_xlim(x0, x1)
        axes.set_ylim(middle - half, middle + half)
        axes.set_xticks([])
        axes.set_yticks([])
        line = scene.track
        if scene.straight:
            line = np.array([[x0, line[0, 1]], [x1, line[0, 1]]])
        axes.plot(line[:, 0], line[:, 1], color=RAIL, lw=1.2, zorder=1)
        for x, y, psi in scene.breaks:
            n = 4.0 * np.array([-math.sin(psi), math.cos(psi)])
            axes.plot([x - n[0], x + n[0]], [y - n[1], y + n[1]], color=VERMILION, lw=2, zorder=6)
        state = np.where(scene.free, 2, np.where(scene.derailed, 1, 0))
        corners = scene.outlines()
        real = scene.represents == 1
        for k, (_, fill, hatch) in enumerate(STATES):
            chosen = real & (state == k)
            if chosen.any():
                axes.add_collection(
                    PolyCollection(
                        list(corners[chosen]),
                        facecolors=fill,
                        edgecolors=INK,
                        linewidths=0.5,
                        hatch=hatch or None,
                        alpha=None if k == 0 else 0.85,
                        zorder=4,
                    )
                )
        pivots, faces = scene.pivots(), scene.faces()
        shanks = np.stack([pivots, faces], axis=2)[real].reshape(-1, 2, 2)
        axes.add_collection(LineCollection(list(shanks), colors=INK, linewidths=0.7, zorder=3))
        record = entry.record
        words = f"{entry.model}:  {cell(record, 'cars_derailed', 1.0, 1)} cars"
        if record["duration_s"] is not None:
            words += f",  {record['duration_s']:.1f} s"
        words += f",  {record['scene_length_m']:.0f} x {record['scene_width_m']:.0f} m"
        if record["peak_force_N"] is not None:
            words += f",  {record['peak_force_N'] * 1e-6:.1f} MN"
        if record["status"] != "at rest":
            words += f",  {record['status']}"
        page.text(left / width, (top + 0.11) / height, words, size=9.5, va="center")
        top -= panel + gap
    if scenes:
        bar = 50.0 if x1 - x0 > 150.0 else 20.0
        axes = page.add_axes((left / width, 0.08 / height, inner / width, 0.36 / height))
        axes.set_axis_off()
        axes.set_xlim(0.0, inner)
        axes.set_ylim(0.0, 0.36)
        axes.plot([0.05, 0.05 + bar * scale], [0.2, 0.2], color=INK, lw=2.5)
        axes.text(0.12 + bar * scale, 0.2, f"{bar:g} m", va="center", size=8.5)
        handles = [
            Patch(fc=fill, ec=INK, hatch=hatch or None, lw=0.6, label=label)
            for label, fill, hatch in STATES
        ]
        axes.legend(
            handles=handles, loc="center right", ncol=3, frameon=False, fontsize=8.5,
            borderaxespad=0.0, handlelength=1.6, columnspacing=1.2,
        )  # fmt: skip

    tall_bars = min(0.36 * len(counts), height - heading - 0.75)
    axes = page.add_axes(
        (
            1.0 - (right - 1.35) / width,
            (height - heading - tall_bars) / height,
            (right - 1.35 - 0.55) / width,
            tall_bars / height,
        )
    )
    values = [float(e.record["cars_derailed"]) for e in counts if e.record]
    if means is not None:
        values = [means.get(e.model, value) for e, value in zip(counts, values, strict=True)]
    place = np.arange(len(counts))
    plane = {e.model for e, _ in scenes}
    colours = [
        BLUE if e.model == "toma" else ("#7cc3ee" if e.model in plane else "#c9c9c9")
        for e in counts
    ]
    axes.barh(place, values, color=colours, edgecolor=INK, linewidth=0.6, height=0.68)
    longest = max([*values, published or 0.0, 1.0])
    for y, value in zip(place, values, strict=True):
        text = f"{value:.0f}" if value == round(value) else f"{value:.1f}"
        axes.text(1.24 * longest, y, text, va="center", ha="right", size=8.5)
    axes.set_yticks(place, [e.model for e in counts], size=8.5)
    axes.set_ylim(len(counts) - 0.5, -0.5)
    axes.set_xlim(0.0, 1.25 * longest)
    if published is not None:
        axes.axvline(published, color=VERMILION, lw=1.4, ls=(0, (4, 2)))
    axes.tick_params(length=0)
    axes.set_xticks([])
    for side in ("top", "right", "bottom"):
        axes.spines[side].set_visible(False)
    page.text(
        1.0 - (right - 1.35) / width, (height - heading + 0.11) / height,
        "cars derailed" if means is None else "cars derailed, mean", size=9.5, va="center",
    )  # fmt: skip
    remarks = [("grey: models without a plane", FAINT)]
    if published is not None:
        remarks.append((f"dashed: published, {published:g}", VERMILION))
    for k, (words, colour) in enumerate(remarks):
        at = (height - heading - tall_bars - 0.16 - 0.2 * k) / height
        page.text(1.0 - (right - 1.35) / width, at, words, size=8, color=colour, va="center")
    return page


# Over the speed -------------------------------------------------------------------------------


def by_speed_markdown(speeds: Sequence[float], runs: Sequence[Sequence[Entry]]) -> str:
    """Cars derailed and duration of each model (rows) at each speed (columns, km/h)."""
    heads = [f"{v:g} km/h" for v in speeds]
    lines = [
        "| model | " + " | ".join(heads) + " |",
        "|---|" + "---:|" * len(speeds),
    ]
    for row in by_speed_rows(runs):
        lines.append(f"| `{row[0]}` | " + " | ".join(row[1:]) + " |")
    return "\n".join(lines) + "\n"


def by_speed_rows(runs: Sequence[Sequence[Entry]]) -> list[list[str]]:
    """One row of texts a model: name, then ``cars, duration s`` at each speed."""
    out = []
    for k, entry in enumerate(runs[0]):
        texts = [entry.model]
        for entries in runs:
            record = entries[k].record
            cars = cell(record, "cars_derailed", 1.0, 1)
            texts.append(f"{cars}, {cell(record, 'duration_s', 1.0, 1)} s")
        out.append(texts)
    return out


def _apart(places: Sequence[float], room: float) -> list[float]:
    """Rising places moved as little as needed to be ``room`` apart, groups about their middle."""
    groups: list[tuple[float, int]] = []  # lowest place of a group, members
    for place in places:
        low, n = place, 1
        while groups and groups[-1][0] + groups[-1][1] * room > low:
            below, m = groups.pop()
            low = (m * below + n * (low - m * room)) / (m + n)
            n += m
        groups.append((low, n))
    return [low + k * room for low, n in groups for k in range(n)]


LINES: dict[str, tuple[str, str, str]] = {
    "toma": ("#0072b2", "-", "o"),
    "yang-manos": ("#e69f00", "-", "s"),
    "anderson": ("#009e73", "-", "^"),
    "roorda-gracie": ("#cc79a7", "-", "D"),
    "blockage": ("#222222", "--", "v"),
    "bar-1": ("#8a8a8a", ":", "x"),
    "bar-2": ("#8a8a8a", "--", "+"),
    "bar-2-corrected": ("#8a8a8a", "-.", "1"),
    "bar-3": ("#d55e00", "--", "2"),
    "bar-3-corrected": ("#d55e00", ":", "3"),
}
"""Colour, line and mark of each model."""


def by_speed_figure(
    title: str,
    speeds: Sequence[float],
    runs: Sequence[Sequence[Entry]],
    published: Sequence[tuple[float, float]] = (),
    lines: Sequence[tuple[str, Sequence[tuple[float, float]]]] = (),
    measured: tuple[str, Sequence[tuple[float, float, float]]] | None = None,
) -> Figure:
    """Cars derailed over the speed, one line a model, named at its end.

    ``published`` are points (km/h, cars); ``lines`` up to two further curves with their names;
    ``measured`` points with bars (km/h, cars, half of the bar) and their name.
    """
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from derail_ros.review.drawing import FAINT, INK, STYLE, VERMILION

    with matplotlib.rc_context(STYLE):
        page = Figure(figsize=(9.0, 5.2), facecolor="white")
        FigureCanvasAgg(page)
        axes = page.add_axes((0.07, 0.11, 0.73, 0.78))
        ends = []
        curves = []
        for k, entry in enumerate(runs[0]):
            found = [
                (v, float(entries[k].record["cars_derailed"]))  # type: ignore[index]
                for v, entries in zip(speeds, runs, strict=True)
                if entries[k].record is not None
            ]
            if found:
                curves.append((entry.model, found, *LINES[entry.model]))
        dashes = [(0, (1, 2)), (0, (6, 2, 1, 2))]
        curves += [
            (name, list(points), FAINT, dash, "")
            for (name, points), dash in zip(lines, dashes, strict=False)
        ]
        for name, found, colour, line, mark in curves:
            axes.plot(
                *zip(*found, strict=True), color=colour, ls=line, marker=mark, ms=6,
                lw=2.2 if name == "toma" else 1.4,
            )  # fmt: skip
            ends.append((found[-1][1], found[-1][0], name, colour))
        if published:
            axes.plot(
                *zip(*published, strict=True), ls="", marker="*", ms=15, mfc="white",
                mec=VERMILION, mew=1.6, zorder=6, label="published",
            )  # fmt: skip
        if measured is not None:
            x, y, bar = zip(*measured[1], strict=True)
            axes.errorbar(x, y, bar, color=INK, ls="", marker="o", ms=6, capsize=3, lw=1.4,
                          zorder=5, label=f"{measured[0]}, ± 2 standard errors")  # fmt: skip
        if published or measured is not None:
            axes.legend(loc="upper left", frameon=False, fontsize=9)
        low, high = axes.get_ylim()
        axes.set_ylim(0.0, high)
        # Names at the ends of the lines, moved apart where they would lie on each other.
        ends.sort()
        room = 0.042 * high
        places = _apart([end[0] for end in ends], room)
        right = max(speeds)
        for end, at in zip(ends, places, strict=True):
            axes.annotate(
                end[2], (right * 1.003, end[0]), (right * 1.05, at), color=end[3], size=9,
                va="center", annotation_clip=False,
                arrowprops={"arrowstyle": "-", "color": end[3], "lw": 0.6,
                            "shrinkA": 1, "shrinkB": 3},
            )  # fmt: skip
        axes.set_xlabel("speed, km/h")
        axes.set_ylabel("cars derailed")
        axes.grid(color="#ececec", lw=0.8)
        axes.set_axisbelow(True)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
        page.text(0.07, 0.94, title, size=12, weight="bold", color=INK)
    return page
