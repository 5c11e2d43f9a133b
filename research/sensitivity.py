"""``docs/sensitivity.md`` and its figure: a tornado for each measure, side by side."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from derail_ros.commands.common import counting_runs
from derail_ros.review.drawing import (
    BLUE,
    FAINT,
    GRID,
    INK,
    TICKS,
    VERMILION,
    legend,
    place,
    put,
    sheet,
    styled,
)
from derail_ros.studies.ensemble import VARIATION
from derail_ros.studies.sensitivity import (
    COMPARED,
    CONTROL,
    Compared,
    Constant,
    Difference,
    Effect,
    Sensitivity,
    effect_table,
    sensitivity,
)
from derail_ros.studies.tables import Table
from derail_ros.studies.validation import Goal
from research.pages import PALE, Options, document, picture, written_by

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FIGURE = "sensitivity.png"

GOALS = {
    "count_rms": "count, rms (cars)",
    "duration_rms_s": "duration, rms (s)",
    "peak_inside_share": "peak in the band",
    "peak_log_ratio": "peak, median size of ln",
    "length_rms": "length, rms",
    "width_rms": "width, rms",
    "pair_share": "published pair, share",
}


def write(options: Options) -> None:
    """Vary everything (on the cases that are named), write the page and its figure."""
    options.images()
    with counting_runs("sensitivity") as progress:
        study = sensitivity(
            options.members or 20,
            options.seed,
            jobs=options.jobs,
            cases=options.names,
            progress=progress,
        )
    options.write(page(study), {FIGURE: tornado(study)})


def _goals(reached: Sequence[Goal]) -> list[str]:
    values = {g.name: g.value for g in reached}
    return ["-" if values[name] is None else f"{values[name]:.2f}" for name in GOALS]


def page(study: Sensitivity) -> str:
    """The text of the page."""
    reading = (
        "Numbers are the mean change against the default over the cases, in pairs of runs with "
        "the same lateral force, with its standard error. Forces and lengths are compared by the "
        "ratio of geometric means. Bold: more than two standard errors and more than any "
        "control. The controls are changes without meaning. A chaotic outcome changes with "
        "them too, so a smaller effect cannot be told from chance."
    )
    if any(d.known and math.isnan(d.error) for e in study.effects for d in e.overall.values()):
        reading += " No error is given where void runs left a case with a single pair."
    parts: list[str | Table] = [
        "# Sensitivity: what the reconstructed constants do",
        written_by("sensitivity"),
        "The surviving copy of the source lost equations and constants. "
        "[model.md](model.md#reconstructed-parts) gives the reason for each replacement; this "
        "page measures how much it matters. One at a time is changed, and these published "
        f"cases are run again as ensembles of {study.members} (lateral force varied by up to "
        f"{100 * VARIATION:g} %, seed {study.seed}): {'; '.join(c.title for c in study.cases)}. "
        f"That is {study.runs} runs.",
        reading,
        picture(FIGURE, "Change of outcome by each constant"),
    ]
    for group, _ in groupby(study.effects, key=lambda e: e.constant.group):
        parts += [f"## {group}", effect_table(study, group)]
    rows = [["**default**", "", *_goals(study.default)]]
    rows += [[e.constant.label, e.change.value, *_goals(e.reached)] for e in study.effects]
    parts += [
        "## Agreement with the published runs",
        "The goals of [validation.md](validation.md) over the cases above, for the default and "
        "for every change. These are fewer cases than there, so a small gain here is no reason "
        "to change a default.",
        Table(["constant", "value", *GOALS.values()], rows, texts=2),
    ]
    left_out = [
        [e.constant.label, e.change.value, str(e.ensemble.void), str(e.ensemble.failed)]
        for e in study.effects
        if e.ensemble.void or e.ensemble.failed
    ]
    if left_out:
        parts += [
            "## Runs left out",
            "Void: the body that stands for the cars behind reached the break.",
            Table(["constant", "value", "void", "failed"], left_out, texts=2),
        ]
    return document(*parts)


# The figure --------------------------------------------------------------------------------

LOOKS: dict[int, tuple[str, str, str]] = {
    -1: ("v", BLUE, "smaller value"),
    1: ("^", VERMILION, "larger value"),
    0: ("D", INK, "other form"),
}
"""Marker, colour and words by the side of a change."""

LINSCALE = 1.0
"""Length of half of an axis' linear part, in decades of its logarithmic one."""

PANEL, LETTER, GAP = 1.6, 0.065, 0.05
"""Least width of a panel, width of a letter of a number on its axis, least gap, inches."""

LINEAR = {"cars_derailed": 1.0, "duration_s": 1.0}
"""Size up to which an axis is linear, beyond it logarithmic; 20 for what is not named."""

Row = tuple["Constant | str", list[Effect]]


def _influence(effects: Sequence[Effect], floor: Mapping[str, float]) -> float:
    """Largest change of any measure, in units of the largest change by a control."""
    return max(
        (
            abs(e.overall[c.key].mean) / max(floor[c.key], 1e-3)
            for e in effects
            for c in COMPARED
            if e.overall[c.key].known
        ),
        default=0.0,
    )


def _rows(study: Sensitivity) -> list[Row]:
    """Headings (texts) and constants with their effects, from the top down."""
    floor = study.floor
    rows: list[Row] = []
    for group, members in groupby(study.effects, key=lambda e: e.constant.group):
        rows.append((group, []))
        by_constant = [list(e) for _, e in groupby(members, key=lambda e: e.constant.name)]
        by_constant.sort(key=lambda e: -_influence(e, floor))
        rows += [(effects[0].constant, effects) for effects in by_constant]
    return rows


def _values(constant: Constant, effects: Sequence[Effect]) -> str:
    lower, upper, other = (
        [e.change.value for e in effects if e.change.side == side] for side in (-1, 1, 0)
    )
    middle = f"[{constant.default}]"
    return "  ".join([*lower, middle, *upper, *([" | ".join(other)] if other else [])])


@styled
def tornado(study: Sensitivity) -> Figure:
    """Draw what each change does to each measure, the constants within a group by influence."""
    rows = _rows(study)
    row, top, bottom = 0.27, 1.0, 0.75
    tall = row * max(len(rows), 1)
    height = top + bottom + tall
    width, left, names = 15.0, 0.25, 5.15
    figure = sheet(width, height)
    panel = (width - left - names - 0.25) / len(COMPARED)
    floor = study.floor
    for k, compared in enumerate(COMPARED):
        axes = place(figure, left + names + k * panel, top, panel - 0.14, tall)
        _panel(axes, compared, rows, floor[compared.key])
    for k, (constant, effects) in enumerate(rows):
        y = top + row * (k + 0.5)
        if isinstance(constant, str):
            put(figure, left, y + 0.04, constant, size=9, weight="bold", color=INK)
        else:
            put(figure, left + 0.12, y, constant.label, color=INK)
            put(figure, left + names - 0.12, y, _values(constant, effects), ha="right", size=7.5)
    title = "What the reconstructed constants do"
    put(figure, left, 0.27, title, size=14, weight="bold", color=INK)
    put(
        figure, left, 0.53,
        f"Change against the default [in brackets], mean over {len(study.cases)} cases of "
        f"{study.members} runs each; whiskers: two standard errors; ticks: single cases",
    )  # fmt: skip
    put(
        figure, width - 0.25, height - 0.1,
        "Scales are linear up to the first number on either side of zero and logarithmic beyond",
        ha="right",
    )  # fmt: skip
    handles = [
        Line2D([], [], ls="", marker=m, color=c, ms=6, label=words) for m, c, words in
        LOOKS.values()
    ]  # fmt: skip
    handles.append(Line2D([], [], ls="", marker="|", color=FAINT, ms=7, label="one case"))
    handles.append(Patch(fc="#e9e9e9", ec="none", label="largest change by a control"))  # type: ignore
    legend(figure, left, 0.72, handles, handletextpad=0.4)
    return figure


def _panel(axes: Axes, compared: Compared, rows: Sequence[Row], floor: float) -> None:
    linear = LINEAR.get(compared.key, 20.0)
    axes.set_xscale("symlog", linthresh=linear, linscale=LINSCALE)
    reach = linear
    if floor > 0.0:
        low, high = (Difference(s * floor, 0.0, 1).shown_in(compared)[0] for s in (-1, 1))
        axes.axvspan(low, high, color="#e9e9e9", lw=0, zorder=0)
    for k, (constant, effects) in enumerate(rows):
        y = -k
        if isinstance(constant, str):
            axes.axhspan(y - 0.5, y + 0.5, color="white", lw=0, zorder=0.6)
            continue
        axes.axhline(y, color=GRID, lw=0.6, zorder=0.5)
        means = []
        for side, (marker, colour, _) in LOOKS.items():
            mine = [e for e in effects if e.change.side == side]
            if side < 0:
                mine.reverse()  # from the default outwards
            for step, effect in enumerate(mine):
                d = effect.overall[compared.key]
                if not d.known:
                    continue
                mean, error = d.shown_in(compared)
                means.append(mean)
                single = [one[compared.key] for one in effect.cases.values()]
                at = [one.shown_in(compared)[0] for one in single if one.known]
                reach = max([reach, *np.abs(at)])
                axes.plot(at, [y] * len(at), ls="", marker="|", ms=6, mew=0.7, color=colour,
                          alpha=0.45, zorder=2)  # fmt: skip
                if math.isfinite(error) and error > 0.0:
                    ends = [mean - 2.0 * error, mean + 2.0 * error]
                    axes.plot(ends, [y, y], color=colour, lw=1.0, zorder=4)
                size = 4.2 + 1.3 * step if side else 5.0
                axes.plot(mean, y, marker=marker, ms=size, mfc=colour, mec="white", mew=0.5,
                          zorder=5)  # fmt: skip
        if means:
            low, high = min(0.0, *means), max(0.0, *means)
            colour = TICKS if constant.group == CONTROL else PALE
            axes.barh(y, high - low, left=low, height=0.5, color=colour, lw=0, zorder=1)
    axes.axvline(0.0, color=INK, lw=0.9, zorder=3)
    axes.set_ylim(-len(rows) + 0.5, 0.5)
    axes.set_yticks([])
    axes.set_xlim(-1.15 * reach, 1.15 * reach)
    places = ticks(linear, 1.15 * reach)
    axes.set_xticks(places, [f"{t:+g}" if t else "0" for t in places], size=7.5)
    axes.set_xticks([], minor=True)
    axes.tick_params(length=3, color=TICKS)
    axes.set_xlabel(compared.title)
    axes.spines[["top", "left", "right"]].set_visible(False)


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
