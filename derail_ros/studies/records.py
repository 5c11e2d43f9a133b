"""Records of an ensemble: which count, the distribution of each measure, means."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from derail_ros.studies.ensemble import Job, JobResult, gather
from derail_ros.vocabulary.measures import (
    MEASURES,
    Measure,
    Record,
    counted,
    failed_record,
    outcome_record,
    record_numbers,
)
from derail_ros.vocabulary.words import finite

F64 = NDArray[np.float64]

QUANTILES = (0.0, 0.05, 0.25, 0.5, 0.75, 0.95, 1.0)


@dataclass(frozen=True)
class Distribution:
    """A measure over the runs of an ensemble that count, SI units.

    Attributes
    ----------
    measure : what is measured
    values : (n,) in the order of the members
    published, accident : of the published run and of the accident itself; None: not known
    noise : scatter of the published value itself, relative: the band is widened by it
    """

    measure: Measure
    values: F64
    published: float | None = None
    accident: float | None = None
    noise: float = 0.0

    @property
    def mean(self) -> float:
        """Mean; nan without runs."""
        return float(self.values.mean()) if len(self.values) else math.nan

    @property
    def sd(self) -> float:
        """Standard deviation of single runs (n - 1); nan for fewer than two."""
        return float(self.values.std(ddof=1)) if len(self.values) > 1 else math.nan

    @property
    def error(self) -> float:
        """Standard error of the mean; nan for fewer than two runs."""
        return self.sd / math.sqrt(len(self.values)) if len(self.values) > 1 else math.nan

    def quantile(self, share: float) -> float:
        """Quantile, linear between the runs; nan without runs."""
        return float(np.quantile(self.values, share)) if len(self.values) else math.nan

    @property
    def band(self) -> tuple[float, float]:
        """The 90 % band: quantiles 5 and 95 %; nan without runs."""
        return self.quantile(0.05), self.quantile(0.95)

    @property
    def inside(self) -> bool | None:
        """Whether the published value lies in the 90 % band, widened by its noise."""
        if self.published is None or not len(self.values):
            return None
        low, high = self.band
        return low * (1.0 - self.noise) <= self.published <= high * (1.0 + self.noise)

    @property
    def apart(self) -> float:
        """Median difference of two runs taken by chance; nan for fewer than two."""
        i, j = np.triu_indices(len(self.values), 1)
        return float(np.median(np.abs(self.values[i] - self.values[j]))) if len(i) else math.nan

    def below(self, value: float) -> float:
        """Share of runs below ``value``; runs equal to it count half."""
        x = self.values
        return float(((x < value).sum() + 0.5 * (x == value).sum()) / len(x))

    def shown_band(self, between: str = " to ") -> str:
        """The 90 % band in the unit in which the measure is shown."""
        low, high = (self.measure.shown(v) for v in self.band)
        return low if low == "-" else f"{low}{between}{high}"

    def as_dict(self) -> dict[str, Any]:
        """As plain data, SI units."""
        found = {
            "unit": self.measure.unit,
            "mean": self.mean,
            "sd": self.sd,
            "median": self.quantile(0.5),
            "band_90": self.band if len(self.values) else None,
            "quantiles": {f"{100 * q:g} %": self.quantile(q) for q in QUANTILES},
            "median_difference_of_two_runs": self.apart,
            "published": self.published,
            "published_noise": self.noise,
            "inside_band": self.inside,
            "accident": self.accident,
            "values": self.values.tolist(),
        }
        return plain(found)


@dataclass(frozen=True)
class Ensemble:
    """The records of an ensemble, in the order of its members."""

    records: tuple[Record, ...]

    def __len__(self) -> int:
        return len(self.records)

    @cached_property
    def good(self) -> list[Record]:
        """The records that count: neither failed nor void."""
        return [r for r in self.records if counted(r)]

    @property
    def failed(self) -> int:
        """Number of runs that failed."""
        return sum("error" in r for r in self.records)

    @property
    def void(self) -> int:
        """Number of void runs."""
        return len(self) - len(self.good) - self.failed

    @property
    def errors(self) -> list[str]:
        """Why runs failed, each reason once."""
        return sorted({r["error"] for r in self.records if "error" in r})

    def distribution(
        self, key: str, published: float | None = None, accident: float | None = None
    ) -> Distribution:
        """A measure over the runs that count."""
        m = MEASURES[key]
        numbers = [m.number(r[key]) for r in self.good]
        values = np.array([x for x in numbers if x is not None], dtype=float)
        return Distribution(m, values, published, accident)

    @cached_property
    def pairs(self) -> dict[str, int]:
        """Pair of cars with the largest force (``none``: no collision) -> number of runs.

        The most frequent comes first.
        """
        found = Counter(pair_text(r["peak_force_pair"]) for r in self.good)
        return dict(sorted(found.items(), key=lambda item: (-item[1], item[0])))

    @cached_property
    def numbers(self) -> dict[str, F64]:
        """Measure -> its values over the runs that have it; ``energy_J.brakes`` for entries."""
        found: dict[str, list[float]] = {}
        for record in self.good:
            for key, value in record_numbers(record).items():
                found.setdefault(key, []).append(value)
        return {key: np.array(values) for key, values in found.items()}

    def mean(self) -> Record:
        """Means over the runs that have the measure, nested as the records are."""
        return _nest({k: float(v.mean()) for k, v in self.numbers.items()})

    def sd(self) -> Record:
        """Standard deviations (n - 1); None for a single run."""
        return _nest(
            {k: float(v.std(ddof=1)) if len(v) > 1 else None for k, v in self.numbers.items()}
        )

    def site(self) -> dict[str, Any]:
        """Runs in which bodies were struck, and in which cars reached areas or stay in them.

        For each its share of the runs and the :func:`interval` of that share.
        """
        runs = [r["site"] for r in self.good if r.get("site")]
        keys = {"fixed": ("struck_by",), "inside": ("cars_ever", "cars_at_rest")}
        first = runs[0] if runs else {part: [] for part in keys}

        def told(part: str, name: str) -> Record:
            found: Record = {"name": name, "runs": len(runs)}
            for key in keys[part]:
                k = sum(bool(e[key]) for r in runs for e in r[part] if e["name"] == name)
                found |= {f"share_{key}": k / len(runs), f"runs_{key}": k}
                found[f"interval_{key}"] = [finite(x, 4) for x in interval(k, len(runs))]
            return found

        return {part: [told(part, e["name"]) for e in first[part]] for part in keys}

    def counts(self) -> dict[str, Any]:
        """Numbers of runs and the reasons of failed ones, as plain data."""
        return {
            "runs": len(self),
            "void": self.void,
            "failed": self.failed,
            "errors": self.errors,
        }


LEVEL = 0.9
"""Level of the interval of a share."""


def interval(k: int, n: int) -> tuple[float, float]:
    """Limits of a probability by ``k`` of ``n`` runs, of the level :data:`LEVEL`.

    Clopper and Pearson: under each limit what was seen, or what is further off, has a probability
    of 5 %.
    """
    from scipy.special import betaincinv

    half = 0.5 * (1.0 - LEVEL)
    low = 0.0 if k == 0 else float(betaincinv(k, n - k + 1, half))
    high = 1.0 if k == n else float(betaincinv(k + 1, n - k, 1.0 - half))
    return low, high


def plain(value: Any) -> Any:
    """Plain data for JSON: None for numbers that are not finite."""
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    return finite(value) if isinstance(value, float) else value


def pair_text(pair: Iterable[int] | None) -> str:
    """``11-9`` for the pair (11, 9); ``none`` without one."""
    return "none" if pair is None else "-".join(map(str, pair))


def _nest(flat: Mapping[str, float | None]) -> Record:
    nested: Record = {}
    for key, value in flat.items():
        outer, dot, inner = key.partition(".")
        if dot:
            nested.setdefault(outer, {})[inner] = value
        else:
            nested[key] = value
    return nested


def record_of(result: JobResult, whole: bool = False) -> Record:
    """The record of a job whose value is an outcome, or a record itself.

    Without the forces of each coupling unless it shall be ``whole``: there may be thousands.
    """
    if result.error is not None:
        return failed_record(result.error, result.wall_s)
    value: Any = result.value
    if isinstance(value, dict):
        return value
    record = outcome_record(value, result.wall_s)
    if not whole:
        record["in_train"].pop("couplings")
    return record


def ensembles(runs: Iterable[Job], **how: Any) -> dict[Any, Ensemble]:
    """Compute all jobs (``how``: see :func:`gather`): key of the jobs -> their ensemble."""
    found = gather(runs, **how)
    return {key: Ensemble(tuple(map(record_of, results))) for key, results in found.items()}


def with_status(found: Iterable[Ensemble]) -> tuple[int, list[str]]:
    """Number of failed runs of several ensembles, and the reasons, each once."""
    listed = list(found)
    return sum(e.failed for e in listed), sorted({text for e in listed for text in e.errors})
