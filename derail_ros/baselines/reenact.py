"""Models run on the trains of accident reports.

A report gives speed, cars, their weight and the place of the first one involved. The train that
is run begins with that car: as many equal cars as followed it, of the reported mean mass, at the
reported speed, the rail broken under the first. What a report does not give (lengths, couplers,
brakes, the start) is that of the base train. No constant is fitted to the reports.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from derail_ros.baselines.models import run_job
from derail_ros.studies.accidents import SOURCE, Report, SpeedClass, error_of_mean, in_classes
from derail_ros.studies.ensemble import Job, Progress, gather
from derail_ros.studies.tables import Table
from derail_ros.vocabulary.words import count

if TYPE_CHECKING:
    from derail_ros.scenario import Scenario
    from derail_ros.vocabulary.params import TrainParams


@dataclass(frozen=True)
class Way:
    """A model and the changes to the base train with which it runs."""

    label: str
    model: str
    settings: Mapping[str, Any]


GIVEN = ("train.speed_kmh", "train.consist.0.count", "train.consist.0.mass_kg")
"""What a report says of its train, as paths of the base train."""


def scenario_of(base: Scenario, report: Report) -> Scenario:
    """The train of a report from its first car involved on, as a scenario.

    Parameters
    ----------
    base : a train of equal cars: gives the car, its brake, the ground and the start
    report : gives the speed, the number of cars (``behind``) and their mass; the yaw inertia is
        in proportion to the mass

    Raises
    ------
    ValueError
        The report has no mass.
    """
    if report.mass_kg is None:
        raise ValueError(f"{report.railroad} {report.number}: the mass of a car is not known")
    values = (report.speed_kmh, report.behind, report.mass_kg)
    return base.with_overrides(dict(zip(GIVEN, values, strict=True)))


def real_base_train(settings: Mapping[str, Any] | None = None) -> Scenario:
    """The base train as a real train: its bodies do not pass through each other."""
    from derail_ros.scenario import load_scenario

    return load_scenario("base_train").with_overrides(
        {"contact.inside": "held", **(settings or {})}
    )


def train_of(base: Scenario, report: Report) -> TrainParams:
    """Parameters of :func:`scenario_of`."""
    return scenario_of(base, report).to_params()


def told_scenario(base: Scenario, report: Report) -> Scenario:
    """:func:`scenario_of` with the report in its title and description."""
    first = f"car {report.first} the first one involved"
    if not report.placed:
        first = "the first one involved not given (here: car 1)"
    return scenario_of(base, report).with_overrides(
        {
            "title": f"{report.railroad} {report.number}, {report.year}: "
            f"{report.cars} cars at {report.speed_kmh:.0f} km/h",
            "description": (
                f"The train of an accident report (FRA form 54), cause "
                f"{report.cause or 'not given'}: {report.cars} freight cars, {report.loaded} of "
                f"them loaded, {first}; {count(report.derailed, 'car')} derailed. The train "
                "here begins with that car. "
                "Lengths, couplers, brakes and the start are not reported: those of base_train."
            ),
            "source": SOURCE,
        }
    )


def mean_report(one: SpeedClass) -> Report:
    """The mean train of a class of speed, as a report; its cars derailed rounded."""
    cars = round(one.behind)
    return Report(
        "", "mean", 0, one.speed_kmh, cars, cars, max(round(one.mean), 1), 1, one.mass_kg, ""
    )


def sample(reports: Iterable[Report], most: int, seed: int = 0) -> list[Report]:
    """Reports with a mass, at most ``most`` of each class of speed, drawn at random."""
    rng = np.random.default_rng(seed)
    found: list[Report] = []
    for _, _, chosen in in_classes(r for r in reports if r.mass_kg is not None):
        if len(chosen) > most:
            chosen = [chosen[i] for i in sorted(rng.permutation(len(chosen))[:most])]
        found += chosen
    return found


Counts = dict[str, list[float | None]]
"""Label of a way -> cars derailed of the train of each report; None where the run failed."""


def reenact(
    reports: Sequence[Report],
    ways: Sequence[Way],
    *,
    jobs: int | None = None,
    progress: Progress | None = None,
) -> Counts:
    """Run the train of each report once in each way; reports must have a mass."""
    bases = [real_base_train(way.settings) for way in ways]

    def runs() -> Iterator[Job]:
        for k, report in enumerate(reports):
            for w in range(len(ways)):
                yield Job(train_of(bases[w], report), key=(k, w))

    def task(job: Job, stop: Callable[[], bool]) -> float:
        return float(run_job(ways[job.key[1]].model, job, stop).record["cars_derailed"])

    found = gather(runs(), jobs=jobs, task=task, progress=progress)
    return {
        way.label: [found[k, w][0].value for k in range(len(reports))]
        for w, way in enumerate(ways)
    }


def failed_runs(counts: Counts) -> int:
    """Number of runs that failed."""
    return sum(value is None for values in counts.values() for value in values)


@dataclass(frozen=True)
class MeanCount:
    """Cars derailed over some trains: mean (nan: none), its standard error, failed runs."""

    mean: float
    error: float
    failed: int = 0

    @classmethod
    def of(cls, values: Sequence[float | None]) -> MeanCount:
        """Over the runs that did not fail."""
        good = [v for v in values if v is not None]
        mean = float(np.mean(good)) if good else math.nan
        return cls(mean, error_of_mean(good), len(values) - len(good))

    def __str__(self) -> str:
        """Mean and standard error; the mean alone where there is no error, a dash without both."""
        if math.isnan(self.mean):
            return "-"
        return f"{self.mean:.1f} ± {self.error:.1f}" if self.error else f"{self.mean:.1f}"


ClassMeans = tuple[int, float, MeanCount, dict[str, MeanCount]]


def averages(reports: Sequence[Report], counts: Counts) -> list[ClassMeans]:
    """For each class of speed: reports, mean speed (km/h), reported cars, those of each way."""
    place = {id(r): k for k, r in enumerate(reports)}
    rows = []
    for _, _, chosen in in_classes(reports):
        at = [place[id(r)] for r in chosen]
        means = {label: MeanCount.of([values[k] for k in at]) for label, values in counts.items()}
        speed = float(np.mean([r.speed_kmh for r in chosen]))
        rows.append((len(chosen), speed, MeanCount.of([r.derailed for r in chosen]), means))
    return rows


def averages_table(reports: Sequence[Report], counts: Counts) -> Table:
    """Reported cars and those of the models, over the classes of speed."""
    found = averages(reports, counts)
    rows = [
        ["trains", *(str(n) for n, *_ in found)],
        ["*reported*", *(str(own) for _, _, own, _ in found)],
        *([label, *(str(means[label]) for *_, means in found)] for label in counts),
    ]
    return Table(["cars derailed, mean", *(f"{s:.0f} km/h" for _, s, *_ in found)], rows)


# Single trains --------------------------------------------------------------------------------


def rank_correlation(reports: Sequence[Report], values: Sequence[float]) -> float:
    """Spearman's of values with the reported counts.

    nan where there is none: of fewer than two reports, and where all are equal.
    """
    from scipy.stats import spearmanr

    own = [r.derailed for r in reports]
    if len(set(own)) < 2 or len(set(values)) < 2:
        return math.nan
    return float(spearmanr(own, values).statistic)


@dataclass(frozen=True)
class Agreement:
    """How counts of single trains agree with the reported ones; nan where nothing can be said."""

    trains: int  # that have a count
    ratio: float  # of the means, counted over reported
    rms: float  # root mean square of the differences, cars
    rank: float  # Spearman's correlation
    within: float  # share of trains within a factor of two


def agreement(reports: Sequence[Report], values: Sequence[float | None]) -> Agreement:
    """How a way's counts of single trains agree with the reported ones."""
    pairs = [(r, v) for r, v in zip(reports, values, strict=True) if v is not None]
    if not pairs:
        return Agreement(0, math.nan, math.nan, math.nan, math.nan)
    trains = [r for r, _ in pairs]
    own, theirs = np.array([r.derailed for r in trains]), np.array([v for _, v in pairs])
    return Agreement(
        len(pairs),
        float(theirs.sum() / own.sum()),
        float(np.sqrt(np.mean((theirs - own) ** 2))),
        rank_correlation(trains, theirs.tolist()),
        float(np.mean((theirs <= 2.0 * own) & (own <= 2.0 * theirs))),
    )


def means_of_classes(reports: Sequence[Report]) -> list[float | None]:
    """For each report the mean reported count of its class of speed; None outside of all.

    The best that can be said of a train from its class alone: what a model has to surpass.
    """
    means = {
        id(r): float(np.mean([other.derailed for other in chosen]))
        for *_, chosen in in_classes(reports)
        for r in chosen
    }
    return [means.get(id(r)) for r in reports]


def agreement_table(reports: Sequence[Report], counts: Counts) -> Table:
    """:func:`agreement` of each way, and what the speed tells without a model."""

    def text(value: float, form: str) -> str:
        return "-" if math.isnan(value) else format(value, form).replace("%", " %")

    ways = {**counts, "reported, mean of the class": means_of_classes(reports)}
    rows = []
    for label, values in ways.items():
        a = agreement(reports, values)
        cells = ((a.ratio, ".2f"), (a.rms, ".1f"), (a.rank, ".2f"), (a.within, ".0%"))
        rows.append([label, *(text(*c) for c in cells)])
    alone = rank_correlation(reports, [r.speed_kmh for r in reports])
    rows.append(["the speed alone", "-", "-", text(alone, ".2f"), "-"])
    heads = ["single trains", "of reported cars", "rms difference, cars", "rank correlation",
             "within a factor of two"]  # fmt: skip
    return Table(heads, rows)
