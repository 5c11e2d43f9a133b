"""Convergence in tolerance, of single runs and of their distribution.

A tighter tolerance gives the same run up to the first contact and a while beyond it. Later any
difference, however small, grows until another car is struck. What can converge after that is the
distribution of outcomes. Ensembles of the same members are run at each tolerance and compared
with the tightest one in two ways: member by member (when do the two runs part, and how far apart
are their outcomes?) and as distributions (difference of the means with its 95 % confidence, and
SciPy's two-sample Kolmogorov-Smirnov test; with ties, as counts have, its p-value errs to the
large side).

The differences of two members of the *same* tolerance are given beside them: if a run at another
tolerance differs from its twin by as much as from any other member, tolerance is only one more
way to draw from the distribution.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from derail_ros.studies.ensemble import Job, ScenarioLike, Stopped, ensemble_jobs, gather
from derail_ros.studies.records import Distribution, plain
from derail_ros.studies.tables import Strong, Table
from derail_ros.vocabulary.measures import MEASURES

if TYPE_CHECKING:
    from derail_ros.vocabulary.outcome import Outcome

F64 = NDArray[np.float64]

TOLERANCES = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7)
SCENARIOS = ("mississauga_published", "base_train")
REFERENCE = ("rkf45", 1e-5)
"""Integrator of the source and a tolerance for it, run beside the others."""

KEYS = ("cars_derailed", "duration_s", "peak_force_N", "scene_length_m", "scene_width_m")
"""Measures that are compared."""

INTERVAL = 0.1
"""Time between two looks at the positions, s."""

APART = 0.01
"""Distance between the places of a car in two runs from which they have parted, m."""

Z95 = 1.959964
"""97.5 % point of the normal distribution."""


@dataclass(frozen=True)
class Trace:
    """The trace kept of a run."""

    path: F64  # (T, N, 2) mass centres every :data:`INTERVAL`, m
    outcome: Outcome
    first_contact: float  # s; inf without


def trace(job: Job, stop: Callable[[], bool]) -> Trace:
    """Compute a run and keep where its cars went."""
    from derail_ros import models

    simulation = models.build(job.params())
    path = []
    t = 0.0
    while True:
        path.append(simulation.sample(t).pose[:, :2].astype(np.float64))
        if simulation.ended:
            break
        t = INTERVAL * len(path)
        simulation.advance_to(t)
        if simulation.ended:
            t = max(t, simulation.time)
        if stop():
            raise Stopped
    contact = min((c.start for c in simulation.collisions), default=math.inf)
    return Trace(np.array(path), simulation.outcome(), contact)


def parted(a: F64, b: F64, distance: float = APART) -> float:
    """Time from which two paths are further apart than ``distance``, s; inf if never."""
    n = min(len(a), len(b))
    away = np.linalg.norm(a[:n] - b[:n], axis=2).max(axis=1) > distance
    return float(np.argmax(away)) * INTERVAL if away.any() else math.inf


@dataclass(frozen=True)
class Comparison:
    """One measure at one tolerance against the tightest, SI units."""

    mean: float
    mean_95: float  # half width of its 95 % confidence
    difference: float  # of the mean from that at the tightest
    difference_95: float
    ks_distance: float  # Kolmogorov-Smirnov
    ks_p: float
    median_difference_of_twins: float  # of members from themselves at the tightest
    median_difference_of_members: float  # of two members of the tightest

    @property
    def agrees(self) -> bool:
        """The confidence interval of the difference contains zero."""
        return abs(self.difference) <= self.difference_95 + 1e-12


def compare(key: str, values: F64, tightest: F64) -> Comparison:
    """Compare two ensembles of the same members."""
    from scipy.stats import ks_2samp

    if not len(values):
        return Comparison(*[math.nan] * 8)
    here, there = (Distribution(MEASURES[key], x) for x in (values, tightest))
    test = ks_2samp(values, tightest)
    return Comparison(
        mean=here.mean,
        mean_95=Z95 * here.error,
        difference=here.mean - there.mean,
        difference_95=Z95 * math.hypot(here.error, there.error),
        ks_distance=float(test.statistic),
        ks_p=float(test.pvalue),
        median_difference_of_twins=float(np.median(np.abs(values - tightest))),
        median_difference_of_members=there.apart,
    )


@dataclass(frozen=True)
class Tolerance:
    """An ensemble at one tolerance, compared with the tightest."""

    rtol: float
    method: str | None  # integrator; None for the scenario's own
    members: int  # runs that count, here and at the tightest
    steps: float  # median number
    largest_constraint_error_m: float  # of all members, as is the residual
    largest_energy_residual: float
    parted_s: list[float]  # when each member parts from itself at the tightest; inf: never
    first_contact_s: list[float]  # of each member; inf without
    measures: dict[str, Comparison]  # by key

    @property
    def label(self) -> str:
        """The tolerance, with the integrator if it is another."""
        return f"{self.method} {power(self.rtol)}" if self.method else power(self.rtol)


@dataclass(frozen=True)
class Convergence:
    """A scenario at all tolerances, the loosest first."""

    scenario: str
    title: str
    method: str  # of the scenario
    default_rtol: float
    tolerances: list[Tolerance]  # of this integrator, the loosest first
    reference: Tolerance | None = None  # another integrator

    @property
    def tightest(self) -> Tolerance:
        """The level with which the others are compared."""
        return self.tolerances[-1]

    @property
    def all(self) -> list[Tolerance]:
        """With the reference."""
        return [*self.tolerances, *([self.reference] if self.reference else [])]

    @property
    def compared(self) -> list[Tolerance]:
        """All but the tightest."""
        return [t for t in self.all if t is not self.tightest]

    def as_dict(self) -> dict[str, Any]:
        """As plain data."""
        return plain(asdict(self))


def convergence(
    scenario: ScenarioLike,
    members: int = 40,
    seed: int = 0,
    *,
    tolerances: Sequence[float] = TOLERANCES,
    reference: tuple[str, float] | None = REFERENCE,
    **how: Any,
) -> Convergence:
    """Run an ensemble at each tolerance and compare with the tightest.

    Parameters
    ----------
    members : runs a tolerance
    seed : of the variation of the lateral force
    tolerances : of the scenario's integrator
    reference : another integrator and its tolerance
    how : ``jobs``, ``run``, ``task`` and ``progress`` of
        :func:`derail_ros.studies.ensemble.gather`

    Raises
    ------
    RuntimeError
        A run failed, or fewer than three members are left to compare.
    """
    rtols = sorted(set(tolerances), reverse=True)
    if len(rtols) < 2:
        raise ValueError("tolerances: must be at least two")
    if members < 3:
        raise ValueError(f"members must be at least 3, got {members}")
    integration = scenario.to_params().integration
    wanted: list[tuple[float, str | None]] = [(rtol, None) for rtol in rtols]
    if reference is not None and reference[0] != integration.method:
        wanted.append((reference[1], reference[0]))

    def runs() -> Iterator[Job]:
        for rtol, method in wanted:
            settings: dict[str, Any] = {"integration.rtol": rtol}
            if method:
                settings["integration.method"] = method
            yield from ensemble_jobs(
                scenario, members, seed=seed, overrides=settings, key=(rtol, method)
            )

    found = gather(runs(), **{"task": trace, **how})
    for (rtol, _), results in found.items():
        for result in results:
            if result.error is not None:
                raise RuntimeError(f"member {result.job.member} at rtol {rtol:g}: {result.error}")
    traces = {key: [result.value for result in results] for key, results in found.items()}
    levels = [_tolerance(*key, traces[key], traces[rtols[-1], None]) for key in wanted]
    return Convergence(
        getattr(scenario, "name", ""),
        getattr(scenario, "title", ""),
        integration.method,
        integration.rtol,
        levels[: len(rtols)],
        levels[-1] if len(levels) > len(rtols) else None,
    )


def _tolerance(
    rtol: float, method: str | None, traces: Sequence[Trace], tightest: Sequence[Trace]
) -> Tolerance:
    both = [
        (a, b)
        for a, b in zip(traces, tightest, strict=True)
        if not a.outcome.void and not b.outcome.void
    ]
    if len(both) < 3:
        raise RuntimeError(f"only {len(both)} runs at rtol {rtol:g} are not void")
    here = [a.outcome for a, _ in both]
    measures = {}
    for key in KEYS:
        of = MEASURES[key].of
        values = np.array([[float(of(t.outcome)) for t in pair] for pair in both])
        measures[key] = compare(key, *values[np.isfinite(values).all(axis=1)].T)
    return Tolerance(
        rtol=rtol,
        method=method,
        members=len(both),
        steps=float(np.median([o.steps for o in here])),
        largest_constraint_error_m=max(max(o.max_coupler_gap, o.max_truck_offset) for o in here),
        largest_energy_residual=max(o.energy_residual for o in here),
        parted_s=[parted(a.path, b.path) for a, b in both],
        first_contact_s=[a.first_contact for a, _ in both],
        measures=measures,
    )


# Words and tables --------------------------------------------------------------------------


def median_time(times: Sequence[float]) -> str:
    """Median of times; infinite means never."""
    middle = float(np.median(times)) if np.isfinite(times).any() else math.inf
    return f"{middle:.1f}" if math.isfinite(middle) else "never"


def power(rtol: float) -> str:
    """A tolerance as it is written: 1e-4."""
    mantissa, exponent = f"{rtol:.0e}".split("e")
    return f"{mantissa}e{int(exponent)}"


def shown(key: str, value: float) -> str:
    """A mean; that of a count with one digit more."""
    m = MEASURES[key]
    return m.shown(value, int(m.whole))


def mean_table(study: Convergence) -> Table:
    """Steps, when runs part, and the means with their 95 % confidence."""
    rows = []
    for level in study.all:
        cells = []
        for key, c in level.measures.items():
            text = f"{shown(key, c.mean)} ± {shown(key, c.mean_95)}"
            cells.append(text if c.agrees else Strong(text))
        when = "" if level is study.tightest else median_time(level.parted_s)
        rows.append([level.label, f"{level.steps:.0f}", when, *cells])
    heads = ["rtol", "steps", "parted (s)", *(MEASURES[key].title for key in KEYS)]
    return Table(heads, rows, study.title)
