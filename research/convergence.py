"""``docs/convergence.md`` and its figure."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.ticker import MaxNLocator

from derail_ros.commands import common
from derail_ros.commands.common import counting_runs
from derail_ros.review.drawing import (
    BLUE,
    FAINT,
    GREEN,
    INK,
    VERMILION,
    dress,
    grid_of,
    heading,
    legend,
    sheet,
    styled,
)
from derail_ros.studies.convergence import (
    APART,
    KEYS,
    SCENARIOS,
    Comparison,
    Convergence,
    convergence,
    median_time,
    power,
    shown,
)
from derail_ros.studies.ensemble import VARIATION
from derail_ros.studies.tables import Strong, Table
from derail_ros.vocabulary.measures import MEASURES
from research.pages import Options, document, picture, written_by

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FIGURE = "convergence.png"
LOOKS = ((BLUE, "o"), (VERMILION, "s"), (GREEN, "^"), (INK, "D"))
"""Colour and marker of each scenario."""


def write(options: Options) -> None:
    """Run the ensembles, write the page and its figure."""
    options.images()
    members, seed = options.members or 40, options.seed
    studies = []
    for scenario in [common.load(name) for name in options.names or SCENARIOS]:
        with counting_runs(scenario.name) as progress:
            studies.append(
                convergence(scenario, members, seed, jobs=options.jobs, progress=progress)
            )
    figure = convergence_figure(studies, members)
    options.write(page(studies, members, seed), {FIGURE: figure})


def _table(study: Convergence, cell: Callable[[str, Comparison], str]) -> Table:
    """A row a tolerance but the tightest, a column a measure."""
    rows = [
        [level.label, *(cell(key, level.measures[key]) for key in KEYS)]
        for level in study.compared
    ]
    return Table(["rtol", *(MEASURES[key].title for key in KEYS)], rows)


def _difference(key: str, c: Comparison) -> str:
    sign = "" if shown(key, c.difference).startswith("-") else "+"
    text = f"{sign}{shown(key, c.difference)} ± {shown(key, c.difference_95)} ({c.ks_p:.2f})"
    return text if c.agrees else Strong(text)


def page(studies: Sequence[Convergence], members: int, seed: int) -> str:
    """The text of the page."""
    parts: list[str | Table] = [
        "# Convergence in tolerance",
        written_by("convergence"),
        "Each scenario is run as an ensemble at each tolerance, always with the same "
        f"{members} lateral forces (varied by up to {100 * VARIATION:g} %, seed {seed}), and "
        "compared with the tightest tolerance. Single runs do not converge for long after cars "
        f"have collided: a member and its twin at another tolerance part (here: by "
        f"{100 * APART:g} cm), and a tighter tolerance only delays that. The distributions "
        "converge.",
        picture(FIGURE, "Convergence in tolerance"),
    ]
    for study in studies:
        tight = power(study.tightest.rtol)
        contact = float(np.median(study.tightest.first_contact_s))
        steps = [
            [level.label, f"{level.steps:.0f}",
             "" if level is study.tightest else median_time(level.parted_s),
             f"{level.largest_constraint_error_m:.1e}", f"{level.largest_energy_residual:.1e}"]
            for level in study.all
        ]  # fmt: skip
        heads = ["rtol", "steps", "parted at (s)", "largest constraint error (m)",
                 "energy residual"]  # fmt: skip
        twins = _table(study, lambda key, c: shown(key, c.median_difference_of_twins))
        strangers = [
            shown(key, study.tightest.measures[key].median_difference_of_members) for key in KEYS
        ]
        parts += [
            f"## {study.title}",
            f"`{study.scenario}`, integrator `{study.method}`, default tolerance "
            f"{power(study.default_rtol)}; first contact at {contact:.1f} s (median).",
            Table(heads, steps),
            f"Difference of the ensemble's mean from that at {tight} with its 95 % confidence; "
            "in parentheses the p-value of the Kolmogorov-Smirnov test that both are draws from "
            "one distribution. Bold: the confidence interval does not contain zero; by chance "
            "this happens once in twenty.",
            _table(study, _difference),
            f"Median difference of a member from its twin at {tight}; in the last row, of two "
            "different members. Where the two are similar, another tolerance amounts to another "
            "draw from the distribution.",
            Table(twins.heads, [*twins.rows, ["other members", *strangers]]),
        ]
    return document(*parts)


@styled
def convergence_figure(studies: Sequence[Convergence], members: int) -> Figure:
    """Draw when twins part, and the means of the ensembles, over the tolerance."""
    figure = sheet(12.0, 6.9)
    panels = grid_of(figure, 6, 3, (0.65, 0.2, 1.3, 0.55, 0.62, 0.85))
    for axes in panels:
        labels = [level.label.replace(" ", "\n") for level in studies[0].all]
        dress(axes, "y")
        axes.set_xticks(range(len(labels)), labels, size=8)
        axes.set_xlim(-0.5, len(labels) - 0.5)
        if studies[0].reference is not None:
            axes.axvline(len(labels) - 1.5, color=FAINT, lw=0.7, ls=(0, (1, 2)))
    _partings(panels[0], studies)
    for axes, key in zip(panels[1:], KEYS, strict=True):
        _means(axes, studies, key)
    heading(
        figure,
        "Convergence in tolerance: runs part, distributions agree",
        f"The same {members} lateral forces at each tolerance. Whiskers: 95 % confidence of the "
        "mean; band: that of the tightest; ring: the default. Twins that never part: end of run.",
    )
    handles, _ = panels[1].get_legend_handles_labels()
    legend(figure, 0.3, 0.76, handles, fontsize=9, columnspacing=1.8)
    return figure


def _partings(axes: Axes, studies: Sequence[Convergence]) -> None:
    for k, (study, (colour, marker)) in enumerate(zip(studies, LOOKS, strict=False)):
        # Two runs that never part are drawn at the end of the run.
        end = study.tightest.measures["duration_s"].mean
        middle = []
        for at, level in enumerate(study.all):
            if level is study.tightest:
                continue
            times = np.minimum(level.parted_s, end)
            middle.append((at, float(np.median(times))))
            places = np.full(len(times), at + _shift(k, studies))
            axes.plot(places, times, ls="", marker=marker, ms=3, color=colour, alpha=0.25,
                      zorder=2)  # fmt: skip
        own = [m for m in middle if m[0] < len(study.tolerances)]
        axes.plot(*zip(*own, strict=True), color=colour, lw=1.2, zorder=3)
        axes.plot(*zip(*middle, strict=True), ls="", color=colour, marker=marker, ms=6,
                  mec="white", zorder=4)  # fmt: skip
        contact = float(np.median(study.tightest.first_contact_s))
        axes.axhline(contact, color=colour, lw=0.9, ls=(0, (4, 3)), zorder=1)
        axes.text(0.99, contact, "first contact", transform=axes.get_yaxis_transform(),
                  ha="right", va="bottom", size=7.5, color=colour)  # fmt: skip
    axes.set_ylim(0.0, None)
    axes.set_ylabel(f"{100 * APART:g} cm from the tightest at, s")
    axes.set_title("Single runs: member and twin", size=9.5, loc="left", weight="bold")


def _shift(k: int, studies: Sequence[Convergence]) -> float:
    return 0.16 * (k - 0.5 * (len(studies) - 1))


def _means(axes: Axes, studies: Sequence[Convergence], key: str) -> None:
    m = MEASURES[key]
    seen: list[float] = []
    for k, (study, (colour, marker)) in enumerate(zip(studies, LOOKS, strict=False)):
        x = np.arange(len(study.all)) + _shift(k, studies)
        mean, half = (
            m.scale * np.array([getattr(level.measures[key], name) for level in study.all])
            for name in ("mean", "mean_95")
        )
        last = len(study.tolerances) - 1
        axes.axhspan(mean[last] - half[last], mean[last] + half[last], color=colour, alpha=0.13,
                     lw=0)  # fmt: skip
        axes.errorbar(x, mean, half, ls="", marker=marker, ms=5.5, color=colour, mec="white",
                      mew=0.6, elinewidth=1.1, capsize=2.5, zorder=4,
                      label=study.title)  # fmt: skip
        for level, at, value in zip(study.tolerances, x, mean, strict=False):
            if level.rtol == study.default_rtol:
                axes.plot(at, value, "o", ms=11, mfc="none", mec=colour, mew=1.0, zorder=5)
        # A loose tolerance may be far off: the scale is that of the others.
        seen += [*(mean[1:] - half[1:]), *(mean[1:] + half[1:])]
    low, high = min(seen), max(seen)
    margin = 0.15 * (high - low) or 1.0
    axes.set_ylim(low - margin, high + margin)
    axes.yaxis.set_major_locator(MaxNLocator(5))
    axes.set_ylabel(m.title)
    axes.set_title(f"Ensembles: mean {m.words}", size=9.5, loc="left", weight="bold")
