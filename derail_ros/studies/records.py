"""Means of records of outcomes."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

from derail_ros.vocabulary.measures import Record, record_numbers


class Moments:
    """Mean and standard deviation of records, one at a time (Welford), without keeping them."""

    def __init__(self) -> None:
        self.count = 0
        self.void = 0
        self.failed = 0
        self._n: dict[str, int] = {}
        self._mean: dict[str, float] = {}
        self._m2: dict[str, float] = {}

    def add(self, record: Mapping[str, Any]) -> None:
        """Take a record in; void and failed ones are only counted."""
        if "error" in record:
            self.failed += 1
            return
        if record.get("void", False):
            self.void += 1
            return
        self.count += 1
        for key, value in record_numbers(record).items():
            n = self._n.get(key, 0) + 1
            mean = self._mean.get(key, 0.0)
            delta = value - mean
            mean += delta / n
            self._n[key] = n
            self._mean[key] = mean
            self._m2[key] = self._m2.get(key, 0.0) + delta * (value - mean)

    def mean(self) -> Record:
        """Means over the runs that have the measure, nested as the records are."""
        return _nest(self._mean)

    def sd(self) -> Record:
        """Standard deviations, with N - 1; None for a single run."""
        return _nest(
            {
                k: math.sqrt(max(m2, 0.0) / (self._n[k] - 1)) if self._n[k] > 1 else None
                for k, m2 in self._m2.items()
            }
        )


def _nest(flat: Mapping[str, float | None]) -> Record:
    nested: Record = {}
    for key, value in flat.items():
        outer, dot, inner = key.partition(".")
        if dot:
            nested.setdefault(outer, {})[inner] = value
        else:
            nested[key] = value
    return nested


def summarize(records: Iterable[Mapping[str, Any]]) -> Moments:
    """Moments of all records, in the order given: sums depend on it in the last digit."""
    moments = Moments()
    for record in records:
        moments.add(record)
    return moments
