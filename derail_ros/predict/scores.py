"""Scores of predicted distributions of whole numbers.

A distribution is an array ``p`` with the probability of 1, 2, ... cars. All scores are proper, or
say how calibrated a band is:

- CRPS: ``sum over k of (F(k) - [y <= k])^2``, cars (Gneiting and Raftery 2007).
- Log score: ``-ln P(y)``.
- PIT: ``F(y-1) + u P(y)``, u uniform in 0 to 1 (Czado, Gneiting and Held 2009): uniform if
  calibrated. A band of share s holds y if its PIT lies within (1 - s)/2 to (1 + s)/2, which for
  whole numbers is the randomized coverage.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

F64 = NDArray[np.float64]


def of_samples(samples: F64, n: int, weights: F64 | None = None) -> F64:
    """The distribution of counts drawn, over 1 to ``n`` cars."""
    k = np.clip(np.rint(samples).astype(int), 1, n)
    return np.bincount(k - 1, weights=weights, minlength=n) / (
        len(k) if weights is None else float(weights.sum())
    )


def quantile(p: F64, level: float) -> int:
    """Least count with ``F(k) >= level``."""
    return int(np.searchsorted(np.cumsum(p), level - 1e-12)) + 1


def mean(p: F64) -> float:
    """Mean count."""
    return float(p @ np.arange(1, len(p) + 1))


@dataclass(frozen=True)
class Scores:
    """Scores over reports; ``bias`` is the mean predicted over the mean reported, less 1."""

    reports: int
    crps: float
    log: float
    mae: float  # of the median
    bias: float
    bias_error: float  # standard error
    within_50: float
    within_90: float

    @classmethod
    def of(cls, predicted: Sequence[F64], reported: Sequence[int], seed: int = 0) -> Scores:
        """Score distributions against the reports."""
        y = np.array(reported, dtype=float)
        pit = pits(predicted, reported, seed)
        means = np.array([mean(p) for p in predicted])
        medians = np.array([quantile(p, 0.5) for p in predicted])
        return cls(
            len(y),
            float(np.mean([crps(p, k) for p, k in zip(predicted, reported, strict=True)])),
            float(np.mean([log_score(p, k) for p, k in zip(predicted, reported, strict=True)])),
            float(np.mean(np.abs(medians - y))),
            float(means.mean() / y.mean() - 1.0),
            float(np.std(means - y) / math.sqrt(len(y)) / y.mean()),
            float(np.mean(np.abs(pit - 0.5) <= 0.25)),
            float(np.mean(np.abs(pit - 0.5) <= 0.45)),
        )

    @classmethod
    def of_samples(cls, drawn: Sequence[F64], reported: Sequence[int], seed: int = 0) -> Scores:
        """Score counts that were drawn, few of them too.

        CRPS is the fair one, ``E|X - y| - sum |X_i - X_j| / (2 n (n - 1))`` (Ferro 2014), whose
        mean does not depend on n. PIT is the randomized rank of the report among the draws,
        over n + 1: even for any n. The log score takes draws smoothed by :func:`smoothed`.
        """
        y = np.array(reported, dtype=float)
        u = np.random.default_rng(seed).random(len(y))
        pit = np.array(
            [((x < k).sum() + v * ((x == k).sum() + 1)) / (len(x) + 1)
             for x, k, v in zip(drawn, y, u, strict=True)]
        )  # fmt: skip
        means = np.array([x.mean() for x in drawn])
        medians = np.array([np.quantile(x, 0.5, method="inverted_cdf") for x in drawn])
        return cls(
            len(y),
            float(np.mean([fair_crps(x, k) for x, k in zip(drawn, y, strict=True)])),
            float(np.mean([log_score(smoothed(x, int(max(x.max(), k))), int(k))
                           for x, k in zip(drawn, y, strict=True)])),
            float(np.mean(np.abs(medians - y))),
            float(means.mean() / y.mean() - 1.0),
            float(np.std(means - y) / math.sqrt(len(y)) / y.mean()),
            float(np.mean(np.abs(pit - 0.5) <= 0.25)),
            float(np.mean(np.abs(pit - 0.5) <= 0.45)),
        )  # fmt: skip

    def row(self, name: str) -> list[str]:
        """A row of a table of scores."""
        return [
            name, str(self.reports), f"{self.within_50:.3f}", f"{self.within_90:.3f}",
            f"{100 * self.bias:+.1f} ± {100 * self.bias_error:.1f}", f"{self.crps:.2f}",
            f"{self.log:.3f}", f"{self.mae:.2f}",
        ]  # fmt: skip


def fair_crps(x: F64, y: float) -> float:
    """CRPS of draws as if there were infinitely many, cars."""
    n = len(x)
    ranked = np.sort(x)
    spread = float((2.0 * np.arange(1, n + 1) - n - 1.0) @ ranked) / (n * (n - 1.0))
    return float(np.abs(x - y).mean()) - spread


def smoothed(x: F64, n: int) -> F64:
    """Distribution over 1 to ``n`` cars: draws with a log-normal kernel of Silverman's width."""
    ln = np.log(np.maximum(x, 1.0))
    width = max(0.9 * float(ln.std()) * len(x) ** -0.2, 0.05)
    edges = np.log(np.arange(0.5, n + 1.0))
    cdf = ndtr((edges[None, :] - ln[:, None]) / width).mean(axis=0)
    cdf[0] = 0.0
    return np.diff(cdf)


def crps(p: F64, y: int) -> float:
    """Continuous ranked probability score of one distribution, cars."""
    steps = np.cumsum(p) - (np.arange(1, len(p) + 1) >= y)
    return float(np.sum(steps**2)) + max(0, y - len(p))


def log_score(p: F64, y: int) -> float:
    """``-ln P(y)``, with P at least 1e-4: drawn counts leave gaps."""
    return -math.log(max(float(p[y - 1]) if y <= len(p) else 0.0, 1e-4))


def pits(predicted: Sequence[F64], reported: Sequence[int], seed: int = 0) -> F64:
    """Randomized probability integral transforms."""
    u = np.random.default_rng(seed).random(len(reported))
    found = []
    for p, y, v in zip(predicted, reported, u, strict=True):
        total = np.concatenate([[0.0], np.cumsum(p)])
        k = min(y, len(p))
        found.append(total[k - 1] + v * (total[k] - total[k - 1]))
    return np.array(found)
