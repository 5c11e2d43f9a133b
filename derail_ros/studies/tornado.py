"""The figure of the sensitivity study: a tornado for each measure, side by side."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import groupby
from typing import TYPE_CHECKING, Any

import matplotlib
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from derail_ros.review.drawing import BLUE, FAINT, INK, STYLE, VERMILION
from derail_ros.studies.sensitivity import (
    CONTROL,
    MEASURES,
    Constant,
    Effect,
    Measure,
    Sensitivity,
    percent,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LOOKS: dict[int, tuple[str, str, str]] = {
    -1: ("v", BLUE, "smaller value"),
    1: ("^", VERMILION, "larger value"),
    0: ("D", "#222222", "other form"),
}
"""Marker, colour and words by the side of a change."""

LINSCALE = 1.0
"""Length of half of an axis' linear part, in decades of its logarithmic one."""

PANEL, LETTER, GAP = 1.6, 0.065, 0.05
"""Least width of a panel, width of a letter of a number on its axis, least gap, inches."""

LINEAR = {"cars_derailed": 1.0, "duration": 1.0, "peak_force": 20.0}
"""Size up to which an axis is linear, beyond it logarithmic; 20 for what is not named."""


def tornado(study: Sensitivity) -> Figure:
    """Draw what each change does to each measure, the constants within a group by influence."""
    with matplotlib.rc_context(STYLE):
        return _tornado(study)


def _influence(effects: Sequence[Effect], floor: dict[str, float]) -> float:
    """Largest change of any measure, in units of what the controls move."""
    return max(
        (
            abs(e.overall[m.name].mean) / max(floor[m.name], 1e-3)
            for e in effects
            for m in MEASURES
            if e.overall[m.name].known
        ),
        default=0.0,
    )


def _rows(study: Sensitivity) -> list[tuple[Constant | str, list[Effect]]]:
    """Headings (texts) and constants with their effects, from the top down."""
    floor = study.floor
    rows: list[tuple[Constant | str, list[Effect]]] = []
    for group, members in groupby(study.effects, key=lambda e: e.constant.group):
        rows.append((group, []))
        by_constant = [list(e) for _, e in groupby(members, key=lambda e: e.constant.name)]
        by_constant.sort(key=lambda e: -_influence(e, floor))
        rows += [(effects[0].constant, effects) for effects in by_constant]
    return rows


def _label(constant: Constant, effects: Sequence[Effect]) -> str:
    lower = [e.change.value for e in effects if e.change.side < 0]
    upper = [e.change.value for e in effects if e.change.side > 0]
    other = [e.change.value for e in effects if e.change.side == 0]
    middle = f"[{constant.default}]"
    if other:
        return f"{middle}  {' | '.join(other)}"
    return "  ".join([*lower, middle, *upper])


def _tornado(study: Sensitivity) -> Figure:
    rows = _rows(study)
    row, top, bottom = 0.27, 1.0, 0.75
    height = top + bottom + row * max(len(rows), 1)
    width, left, names, gap = 15.0, 0.25, 5.15, 0.14
    figure = Figure(figsize=(width, height), facecolor="white")
    FigureCanvasAgg(figure)
    panel = (width - left - names - 0.25) / len(MEASURES)
    floor = study.floor
    y_of = {id(effects): -k for k, (_, effects) in enumerate(rows)}

    for k, measure in enumerate(MEASURES):
        axes = figure.add_axes(
            (
                (left + names + k * panel) / width,
                bottom / height,
                (panel - gap) / width,
                row * len(rows) / height,
            )
        )
        _panel(axes, study, measure, rows, y_of, floor[measure.name])

    for k, (constant, effects) in enumerate(rows):
        y = (bottom + row * (len(rows) - k - 0.5)) / height
        if isinstance(constant, str):
            figure.text(left / width, y - 0.04 / height, constant, weight="bold", va="center")
            continue
        figure.text((left + 0.12) / width, y, constant.label, va="center", size=8.5)
        figure.text(
            (left + names - 0.12) / width,
            y,
            _label(constant, effects),
            va="center",
            ha="right",
            size=7.5,
            color="#555555",
        )
    cases = ", ".join(c.title for c in study.cases)
    figure.text(
        left / width,
        1.0 - 0.27 / height,
        "What the reconstructed constants do",
        size=14,
        weight="bold",
        va="center",
    )
    figure.text(
        1.0 - 0.25 / width,
        0.1 / height,
        "Scales are linear up to the first number on either side of zero and logarithmic beyond",
        size=8.5,
        color="#555555",
        va="center",
        ha="right",
    )
    figure.text(
        left / width,
        1.0 - 0.53 / height,
        f"Change against the default [in brackets], mean over {len(study.cases)} cases of "
        f"{study.members} runs each ({cases}); whiskers: two standard errors; ticks: single "
        "cases",
        size=8.5,
        color="#555555",
        va="center",
    )
    _key(figure, left / width, 1.0 - 0.72 / height)
    return figure


def _key(figure: Figure, left: float, top: float) -> None:
    sides = [LOOKS[s] for s in (-1, 1, 0)]
    handles: list[Any] = [
        Line2D([], [], ls="", marker=m, color=c, ms=6, label=f"{words}") for m, c, words in sides
    ]
    handles.append(Line2D([], [], ls="", marker="|", color=FAINT, ms=7, label="one case"))
    handles.append(Patch(fc="#e9e9e9", ec="none", label="as much as the controls move"))
    figure.legend(
        handles=handles,
        loc="upper left",
        bbox_to_anchor=(left, top),
        ncol=len(handles),
        frameon=False,
        fontsize=8.5,
        borderaxespad=0.0,
        borderpad=0.0,
        handletextpad=0.4,
        columnspacing=1.6,
    )


def _panel(
    axes: Axes,
    study: Sensitivity,
    measure: Measure,
    rows: Sequence[tuple[Constant | str, list[Effect]]],
    y_of: dict[int, int],
    floor: float,
) -> None:
    axes.set_ylim(-len(rows) + 0.5, 0.5)
    axes.set_yticks([])
    linear = LINEAR.get(measure.name, 20.0)
    axes.set_xscale("symlog", linthresh=linear, linscale=LINSCALE)
    reach = linear
    if floor > 0.0:
        low, high = (
            100.0 * (math.exp(s * floor) - 1.0) if measure.ratio else s * floor for s in (-1, 1)
        )
        axes.axvspan(low, high, color="#e9e9e9", lw=0, zorder=0)
    for constant, effects in rows:
        y = y_of[id(effects)]
        if isinstance(constant, str):
            axes.axhspan(y - 0.5, y + 0.5, color="white", lw=0, zorder=0.6)
            continue
        axes.axhline(y, color="#ececec", lw=0.6, zorder=0.5)
        means = []
        for side in (-1, 1, 0):
            mine = [e for e in effects if e.change.side == side]
            if side < 0:
                mine.reverse()  # from the default outwards
            marker, colour, _ = LOOKS[side]
            for step, effect in enumerate(mine):
                d = effect.overall[measure.name]
                if not d.known:
                    continue
                mean, error = percent(d, measure)
                means.append(mean)
                size = 4.2 + 1.3 * step if side else 5.0
                for by_case in effect.cases.values():
                    one = by_case[measure.name]
                    if one.known:
                        at = percent(one, measure)[0]
                        reach = max(reach, abs(at))
                        axes.plot(
                            at, y, marker="|", ms=6, mew=0.7, color=colour, alpha=0.45, zorder=2
                        )
                if math.isfinite(error) and error > 0.0:
                    axes.plot(
                        [mean - 2.0 * error, mean + 2.0 * error],
                        [y, y],
                        color=colour,
                        lw=1.0,
                        zorder=4,
                    )
                axes.plot(
                    mean, y, marker=marker, ms=size, mfc=colour, mec="white", mew=0.5, zorder=5
                )
        if means:
            low, high = min(0.0, *means), max(0.0, *means)
            control = constant.group == CONTROL
            axes.barh(
                y,
                high - low,
                left=low,
                height=0.5,
                color="#c9c9c9" if control else "#cfe3f1",
                lw=0,
                zorder=1,
            )
    axes.axvline(0.0, color=INK, lw=0.9, zorder=3)
    axes.set_xlim(-1.15 * reach, 1.15 * reach)
    places = ticks(linear, 1.15 * reach)
    axes.set_xticks(places, [f"{t:+g}" if t else "0" for t in places], size=7.5)
    axes.set_xticks([], minor=True)
    axes.tick_params(length=3, color="#c8c8c8")
    axes.set_xlabel(f"{measure.label} ({measure.unit})")
    for side in ("top", "left", "right"):
        axes.spines[side].set_visible(False)


def ticks(linear: float, reach: float) -> list[float]:
    """Zero, the linear part's ends, and those round numbers beyond whose labels have room."""
    inches = 0.5 * PANEL / _place(reach, linear)
    sizes = [linear]
    for factor in (3.0, 10.0, 30.0, 100.0):
        size = linear * factor
        if size > reach:
            break
        apart = inches * (_place(size, linear) - _place(sizes[-1], linear))
        letters = 0.5 * (len(f"{size:+g}") + len(f"{sizes[-1]:+g}"))
        if apart >= LETTER * letters + GAP:
            sizes.append(size)
    return [*(-s for s in reversed(sizes)), 0.0, *sizes]


def _place(size: float, linear: float) -> float:
    """Where a size lies on matplotlib's symlog axis, in decades from its zero."""
    straight = LINSCALE / 0.9
    return straight * size / linear if size <= linear else straight + math.log10(size / linear)
