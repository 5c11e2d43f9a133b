"""Convergence in tolerance, of single runs and of their distribution.

A tighter tolerance gives the same run up to the first contact and a while beyond it; later any
difference, however small, grows until another car is struck. What can converge after that is the
distribution of outcomes. So ensembles of the same members are run at each tolerance, and
compared with the tightest one in two ways: member by member (when do the two runs part, and how
far are their outcomes apart?) and as distributions (difference of the means with its 95 %
confidence, and the two-sample Kolmogorov-Smirnov test).

Beside them stands what two members of the *same* tolerance differ by: if a run at another
tolerance differs from its twin by as much as from any other member, tolerance is only one more
way to draw from the distribution.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from derail_ros.studies.ensemble import (
    VARIATION,
    Result,
    Run,
    ScenarioLike,
    Stopped,
    ensemble_runs,
    run_many,
)

if TYPE_CHECKING:
    from derail_ros.vocabulary.outcome import Outcome

F64 = NDArray[np.float64]

TOLERANCES = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7)
SCENARIOS = ("mississauga_published", "base_train")
REFERENCE = ("rkf45", 1e-5)
"""Integrator of the source and a tolerance for it, run beside the others."""

INTERVAL = 0.1
"""Time between two looks at the positions, s."""

APART = 0.01
"""Distance between the places of a car in two runs from which they have parted, m."""

Z95 = 1.959964
"""97.5 % point of the normal distribution."""


@dataclass(frozen=True)
class Measure:
    """What is compared: name, words, unit, digits, how it is read from an outcome."""

    name: str
    label: str
    unit: str
    digits: int
    read: Callable[[Outcome], float]


MEASURES = (
    Measure("cars_derailed", "cars derailed", "cars", 2, lambda o: o.cars_derailed),
    Measure("duration", "duration", "s", 2, lambda o: o.duration),
    Measure("peak_force", "peak force", "MN", 2, lambda o: o.peak_force * 1e-6),
    Measure("scene_length", "scene length", "m", 1, lambda o: o.scene_length),
    Measure("scene_width", "scene width", "m", 1, lambda o: o.scene_width),
)


@dataclass(frozen=True)
class Trace:
    """What is kept of a run.

    Attributes
    ----------
    path : (T, N, 2) places of the mass centres every :data:`INTERVAL`, m
    values : by measure; None for a run that is void
    steps : accepted steps
    gap : largest constraint error, m
    residual : largest imbalance of the energy, relative
    """

    path: F64
    values: Mapping[str, float] | None
    steps: int
    gap: float
    residual: float
    first_contact: float


def trace(run: Run, stop: Callable[[], bool]) -> Trace:
    """Compute a run and keep where its cars went."""
    from derail_ros import models

    simulation = models.build(run.params())
    path = []
    t = 0.0
    while True:
        path.append(simulation.sample(t).q[:, :2].astype(np.float64))
        if simulation.ended:
            break
        t = INTERVAL * len(path)
        simulation.advance_to(t)
        if simulation.ended:
            t = max(t, simulation.time)
        if stop():
            raise Stopped
    outcome = simulation.outcome()
    collisions = simulation.collisions
    return Trace(
        path=np.array(path),
        values=None if outcome.void else {m.name: float(m.read(outcome)) for m in MEASURES},
        steps=outcome.steps,
        gap=max(outcome.max_coupler_gap, outcome.max_truck_offset),
        residual=outcome.energy_residual,
        first_contact=min((c.start for c in collisions), default=math.inf),
    )


def parted(a: F64, b: F64, distance: float = APART) -> float:
    """Time from which two paths are further apart than ``distance``, s; inf if never."""
    n = min(len(a), len(b))
    away = np.linalg.norm(a[:n] - b[:n], axis=2).max(axis=1) > distance
    return float(np.argmax(away)) * INTERVAL if away.any() else math.inf


def ks_two_sample(a: F64, b: F64) -> tuple[float, float]:
    """Largest distance of two empirical distributions, and its asymptotic p-value.

    With ties, as counts have, the p-value errs to the safe side (too large).
    """
    points = np.concatenate([a, b])
    low = np.searchsorted(np.sort(a), points, side="right") / len(a)
    high = np.searchsorted(np.sort(b), points, side="right") / len(b)
    d = float(np.abs(low - high).max())
    n = len(a) * len(b) / (len(a) + len(b))
    x = (math.sqrt(n) + 0.12 + 0.11 / math.sqrt(n)) * d
    if x < 0.2:
        return d, 1.0
    p = 2.0 * sum((-1) ** (k - 1) * math.exp(-2.0 * k * k * x * x) for k in range(1, 101))
    return d, min(max(p, 0.0), 1.0)


@dataclass(frozen=True)
class Comparison:
    """One measure at one tolerance against the tightest.

    Attributes
    ----------
    mean, half : mean at this tolerance, half width of its 95 % confidence
    difference, difference_half : of the mean from that at the tightest, and its 95 % confidence
    distance, p : Kolmogorov-Smirnov
    twins : median difference of a member from itself at the tightest tolerance
    strangers : median difference of two members of the tightest
    """

    mean: float
    half: float
    difference: float
    difference_half: float
    distance: float
    p: float
    twins: float
    strangers: float

    @property
    def agrees(self) -> bool:
        """The confidence interval of the difference holds zero."""
        return abs(self.difference) <= self.difference_half + 1e-12


def compare(values: F64, tightest: F64, twins: F64) -> Comparison:
    """Compare two ensembles; ``twins`` are the differences member by member."""

    def error(x: F64) -> float:
        return float(x.std(ddof=1) / math.sqrt(len(x)))

    i, j = np.triu_indices(len(tightest), 1)
    distance, p = ks_two_sample(values, tightest)
    return Comparison(
        mean=float(values.mean()),
        half=Z95 * error(values),
        difference=float(values.mean() - tightest.mean()),
        difference_half=Z95 * math.hypot(error(values), error(tightest)),
        distance=distance,
        p=p,
        twins=float(np.median(np.abs(twins))),
        strangers=float(np.median(np.abs(tightest[i] - tightest[j]))),
    )


@dataclass(frozen=True)
class Level:
    """An ensemble at one tolerance.

    Attributes
    ----------
    rtol : tolerance
    method : integrator; "" for the scenario's own
    members : runs that count, here and at the tightest
    steps : median number
    gap, residual : largest constraint error (m) and energy imbalance of all
    partings : (members,) when each parts from itself at the tightest tolerance, s
    contacts : (members,) first contact, s
    measures : by name
    """

    rtol: float
    method: str
    members: int
    steps: float
    gap: float
    residual: float
    partings: F64
    contacts: F64
    measures: Mapping[str, Comparison]

    @property
    def label(self) -> str:
        """The tolerance, with the integrator if it is another."""
        return f"{self.method} {power(self.rtol)}" if self.method else power(self.rtol)

    def as_dict(self) -> dict[str, Any]:
        """As plain data."""
        return {
            "rtol": self.rtol,
            "method": self.method or None,
            "members": self.members,
            "steps": self.steps,
            "largest_constraint_error_m": self.gap,
            "largest_energy_residual": self.residual,
            "parted_s": [t if math.isfinite(t) else None for t in self.partings.tolist()],
            "first_contact_s": [t if math.isfinite(t) else None for t in self.contacts.tolist()],
            "measures": {
                name: {
                    "mean": c.mean,
                    "mean_95": c.half,
                    "difference": c.difference,
                    "difference_95": c.difference_half,
                    "ks_distance": c.distance,
                    "ks_p": c.p,
                    "median_difference_of_twins": c.twins,
                    "median_difference_of_members": c.strangers,
                }
                for name, c in self.measures.items()
            },
        }


@dataclass(frozen=True)
class Convergence:
    """A scenario at all tolerances, the loosest first.

    Attributes
    ----------
    name, title : of the scenario
    method, default_rtol : of the scenario
    levels : of its own integrator
    reference : another integrator
    """

    name: str
    title: str
    method: str
    default_rtol: float
    levels: tuple[Level, ...]
    reference: Level | None = None

    @property
    def all(self) -> tuple[Level, ...]:
        """With the reference."""
        return self.levels if self.reference is None else (*self.levels, self.reference)

    @property
    def compared(self) -> tuple[Level, ...]:
        """All but the tightest."""
        return tuple(level for level in self.all if level is not self.levels[-1])

    def as_dict(self) -> dict[str, Any]:
        """As plain data."""
        return {
            "scenario": self.name,
            "title": self.title,
            "method": self.method,
            "default_rtol": self.default_rtol,
            "tolerances": [level.as_dict() for level in self.levels],
            "reference": None if self.reference is None else self.reference.as_dict(),
        }


def convergence(
    scenario: ScenarioLike,
    members: int = 40,
    seed: int = 0,
    *,
    tolerances: Sequence[float] = TOLERANCES,
    reference: tuple[str, float] | None = REFERENCE,
    jobs: int | None = None,
    progress: Callable[[int, int], None] | None = None,
    run: Callable[..., Iterator[Result]] = run_many,
    task: Callable[[Run, Callable[[], bool]], Trace] = trace,
) -> Convergence:
    """Run an ensemble at each tolerance and compare with the tightest.

    Raises
    ------
    RuntimeError
        A run failed, or fewer than three members are left to compare.
    """
    rtols = sorted(set(tolerances), reverse=True)
    if len(rtols) < 2:
        raise ValueError("tolerances: at least two are compared")
    if members < 3:
        raise ValueError(f"members: must be at least 3, not {members}")
    integration = scenario.to_params().integration
    wanted: list[tuple[float, str]] = [(rtol, "") for rtol in rtols]
    if reference is not None and reference[0] != integration.method:
        wanted.append((reference[1], reference[0]))
    total, done = members * len(wanted), 0
    traces: list[list[Any]] = [[None] * members for _ in wanted]

    def runs() -> Iterator[Run]:
        for key, (rtol, method) in enumerate(wanted):
            overrides: dict[str, Any] = {"integration.rtol": rtol}
            if method:
                overrides["integration.method"] = method
            yield from ensemble_runs(scenario, members, seed=seed, overrides=overrides, key=key)

    with closing(run(runs(), jobs=jobs, task=task)) as results:
        for result in results:
            if result.error is not None:
                rtol = wanted[result.run.key][0]
                raise RuntimeError(f"member {result.run.member} at rtol {rtol:g}: {result.error}")
            traces[result.run.key][result.run.member] = result.value
            done += 1
            if progress is not None:
                progress(done, total)
    tightest = traces[len(rtols) - 1]
    levels = [_level(*w, t, tightest) for w, t in zip(wanted, traces, strict=True)]
    return Convergence(
        name=getattr(scenario, "name", ""),
        title=getattr(scenario, "title", ""),
        method=integration.method,
        default_rtol=integration.rtol,
        levels=tuple(levels[: len(rtols)]),
        reference=levels[-1] if len(levels) > len(rtols) else None,
    )


def _level(rtol: float, method: str, traces: Sequence[Trace], tightest: Sequence[Trace]) -> Level:
    both = [
        (a, b)
        for a, b in zip(traces, tightest, strict=True)
        if a.values is not None and b.values is not None
    ]
    if len(both) < 3:
        raise RuntimeError(f"only {len(both)} runs at rtol {rtol:g} are not void")
    measures = {}
    for m in MEASURES:
        values = np.array([a.values[m.name] for a, _ in both])  # type: ignore[index]
        other = np.array([b.values[m.name] for _, b in both])  # type: ignore[index]
        measures[m.name] = compare(values, other, values - other)
    return Level(
        rtol=rtol,
        method=method,
        members=len(both),
        steps=float(np.median([a.steps for a, _ in both])),
        gap=max(a.gap for a, _ in both),
        residual=max(a.residual for a, _ in both),
        partings=np.array([parted(a.path, b.path) for a, b in both]),
        contacts=np.array([a.first_contact for a, _ in both]),
        measures=measures,
    )


# Words -------------------------------------------------------------------------------------


def median_time(times: F64) -> str:
    """Median of times of which some may be infinite (never)."""
    middle = float(np.median(times)) if np.isfinite(times).any() else math.inf
    return f"{middle:.1f}" if math.isfinite(middle) else "never"


def power(rtol: float) -> str:
    """A tolerance as it is written: 1e-4."""
    mantissa, exponent = f"{rtol:.0e}".split("e")
    return f"{mantissa}e{int(exponent)}"


def markdown(studies: Sequence[Convergence], members: int, seed: int, image: str) -> str:
    """The page ``docs/convergence.md``; ``image`` is the figure's path from there."""
    intro = (
        "Each scenario is run as an ensemble at each tolerance, always with the same "
        f"{members} lateral forces (varied by up to {100 * VARIATION:g} %, seed {seed}), and "
        "compared with the tightest. Single runs cannot converge for long after cars have "
        f"collided: a member and its twin at another tolerance part, here by {100 * APART:g} cm, "
        "and go their own ways; a tighter tolerance only puts that off. What converges is the "
        "distribution."
    )
    lines = [
        "# Convergence in tolerance",
        "",
        "Written by `derail convergence --write`; do not edit.",
        "",
        *textwrap.wrap(intro, 99),
        "",
        f"![Convergence in tolerance]({image})",
    ]
    for study in studies:
        tight = study.levels[-1].rtol
        contact = float(np.median(study.levels[-1].contacts))
        lines += [
            "",
            f"## {study.title}",
            "",
            *textwrap.wrap(
                f"`{study.name}`, integrator `{study.method}`, default tolerance "
                f"{power(study.default_rtol)}; first contact at {contact:.1f} s (median).",
                99,
            ),
            "",
            "| rtol | steps | parted at (s) | largest constraint error (m) | energy residual |",
            "|---|---|---|---|---|",
        ]
        for level in study.all:
            when = "" if level is study.levels[-1] else median_time(level.partings)
            lines.append(
                f"| {level.label} | {level.steps:.0f} | {when} | {level.gap:.1e} | "
                f"{level.residual:.1e} |"
            )
        note = (
            f"Difference of the ensemble's mean from that at {power(tight)} with its 95 % "
            "confidence; in parentheses the p-value of the Kolmogorov-Smirnov test that both "
            "are draws from one distribution. Bold: the confidence interval does not hold zero; "
            "by chance one in twenty does not."
        )
        heads = " | ".join(f"{m.label} ({m.unit})" for m in MEASURES)
        lines += [
            "",
            *textwrap.wrap(note, 99),
            "",
            f"| rtol | {heads} |",
            "|---|" + "---|" * len(MEASURES),
        ]
        for level in study.compared:
            cells = []
            for m in MEASURES:
                c = level.measures[m.name]
                text = (
                    f"{c.difference:+.{m.digits}f} ± {c.difference_half:.{m.digits}f} ({c.p:.2f})"
                )
                cells.append(text if c.agrees else f"**{text}**")
            lines.append(f"| {level.label} | " + " | ".join(cells) + " |")
        note = (
            f"Median difference of a member from its twin at {power(tight)}; in the last row of "
            "two different members. Where they are alike, the tolerance is one more way to draw "
            "from the distribution."
        )
        lines += [
            "",
            *textwrap.wrap(note, 99),
            "",
            f"| rtol | {heads} |",
            "|---|" + "---|" * len(MEASURES),
        ]
        for level in study.compared:
            cells = [f"{level.measures[m.name].twins:.{m.digits}f}" for m in MEASURES]
            lines.append(f"| {level.label} | " + " | ".join(cells) + " |")
        cells = [f"{study.levels[-1].measures[m.name].strangers:.{m.digits}f}" for m in MEASURES]
        lines.append("| other members | " + " | ".join(cells) + " |")
    lines.append("")
    return "\n".join(lines)
