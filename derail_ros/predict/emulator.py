"""A regression that replaces the engine where a thousand runs are too many.

The logarithm of a pile's count is quadratic in features of train and constants; what is left
is the chaos of single runs, normal. Fitted to a bank of runs (``research.bank``).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln, ndtr

from derail_ros.predict.trains import Train
from derail_ros.scenario.calibrated import NAMES, Calibrated, Few

F64 = NDArray[np.float64]

LOG = ("brake_distance", "brake_time", "brake_force", "ground", "push", "push_distance",
       "contact_force", "length")  # fmt: skip
"""Constants whose logarithm is normal."""

PRIOR: dict[str, tuple[float, float]] = {
    "brake_distance": (np.log(50.0), 1.2),
    "brake_time": (np.log(2.0), 0.8),
    "brake_force": (0.0, 0.2),
    "ground": (np.log(0.7), 0.5),
    "push": (np.log(50e3), 0.8),
    "push_distance": (np.log(5.0), 1.0),
    "contact_force": (np.log(3.0e6), 0.2),
    "contact_even": (0.0, 1.0),  # even above 0
    "grade": (0.0, 0.006),
    "length": (np.log(1.07), 0.1),
}
"""Mean and standard deviation of each constant or its logarithm before any report is read.

Brake force: net braking ratios of loaded cars 0.085 to 0.14 (two deviations). Length: 17.5 m over
couplers, current cars 13 to 21 m. Grade: main tracks, 0.6 %. The others are wide: not known.
"""


PRIOR_MEAN = np.array([PRIOR[n][0] for n in NAMES])
PRIOR_SD = np.array([PRIOR[n][1] for n in NAMES])


def _features(train: F64, z: F64) -> F64:
    """What the emulator is quadratic in: (..., k) of trains (..., 4) and constants (..., 10)."""
    speed, behind, mass, loaded = np.moveaxis(train, -1, 0)
    u = (z - PRIOR_MEAN) / PRIOR_SD
    at = {n: u[..., i] for i, n in enumerate(NAMES)}
    delay = np.exp(z[..., 0]) / speed + np.exp(z[..., 1])
    even = (z[..., NAMES.index("contact_even")] > 0.0).astype(float)
    slowing = 0.5 * np.exp(z[..., 2]) * (1.2 - 0.3 * np.log(mass / 1e5)) + 9.81 * z[..., 8]
    way = speed * (delay + 5.0) + speed**2 / (2.0 * np.maximum(slowing, 0.1))
    columns = [np.log(speed / 12.0), np.log(behind / 80.0), np.log(mass / 1e5), loaded - 0.7,
               np.log(delay / 10.0), np.log(way / 300.0), at["brake_force"], at["ground"],
               at["push"], at["push_distance"], at["contact_force"], even, at["grade"],
               at["length"]]  # fmt: skip
    return np.stack(np.broadcast_arrays(*columns), axis=-1)


def _terms(f: F64) -> F64:
    """1, all features, their products, and cubes of the first six."""
    k = f.shape[-1]
    i, j = np.triu_indices(k)
    return np.concatenate(
        [np.ones((*f.shape[:-1], 1)), f, f[..., i] * f[..., j], f[..., :6] ** 3], axis=-1
    )


@dataclass(frozen=True)
class Emulator:
    """ln of the count of a pile: regression and deviation of what is left (chaos)."""

    coefficients: F64
    spread: F64  # of ln sd over the fitted ln count: constant, slope
    residual: float  # rms over the bank

    @classmethod
    def of(cls, train: F64, z: F64, counts: F64) -> Emulator:
        """Fit to the runs of a bank, by ridge regression."""
        terms = _terms(_features(train, z))
        y = np.log(np.maximum(counts, 0.5))
        scale = terms.std(axis=0)
        scale[0] = 1.0
        a = terms / np.where(scale > 0, scale, 1.0)
        ridge = 1e-3 * len(y) * np.eye(a.shape[1])
        ridge[0, 0] = 0.0
        b = np.linalg.solve(a.T @ a + ridge, a.T @ y) / np.where(scale > 0, scale, 1.0)
        fitted = terms @ b
        left = np.abs(y - fitted) / np.sqrt(2.0 / np.pi)
        slope = np.polyfit(fitted, left, 1)
        return cls(b, np.array([slope[1], slope[0]]), float(np.std(y - fitted)))

    def __call__(self, train: F64, z: F64) -> tuple[F64, F64]:
        """Mean and deviation of the logarithm of the count."""
        f = _features(train, z)
        k = f.shape[-1]
        pairs = np.zeros((k, k))
        pairs[np.triu_indices(k)] = self.coefficients[1 + k : 1 + k + k * (k + 1) // 2]
        mean = self.coefficients[0] + f @ self.coefficients[1 : 1 + k]
        mean += ((f @ pairs) * f).sum(axis=-1) + f[..., :6] ** 3 @ self.coefficients[-6:]
        return mean, np.maximum(self.spread[0] + self.spread[1] * mean, 0.07)

    @classmethod
    def shipped(cls, constants: Calibrated) -> Emulator:
        """That of the shipped set."""
        e = constants.emulator
        return cls(np.array(e["coefficients"]), np.array(e["spread"]), e["residual"])


def logarithms(draws: F64) -> F64:
    """Constants as the emulator has them: logarithms where :data:`LOG`, even as 1 or -1."""
    z = draws.copy()
    for i, name in enumerate(NAMES):
        if name in LOG:
            z[..., i] = np.log(draws[..., i])
        elif name == "contact_even":
            z[..., i] = np.where(draws[..., i] >= 0.5, 1.0, -1.0)
    return z


def log_few(y: F64, mean: float, dispersion: float) -> F64:
    """ln probability of ``y`` cars of the few: 1 + a negative binomial number."""
    r = 1.0 / dispersion
    k = y - 1.0
    return (
        gammaln(k + r) - gammaln(r) - gammaln(k + 1.0)
        + r * np.log(r / (r + mean)) + k * np.log(mean / (r + mean))
    )  # fmt: skip


def mixed(pile: F64, share: float, mean: float, dispersion: float) -> F64:
    """Distribution over 1, 2, ... cars of piles and few together."""
    few = np.exp(log_few(np.arange(1.0, len(pile) + 1.0), mean, dispersion))
    return (1.0 - share) * pile + share * few / few.sum()


def pile_pmf(mean: F64, sd: F64, n: int) -> F64:
    """Probability of 1 to ``n`` cars: log-normal about each of ``mean``, taken together."""
    edges = np.log(np.arange(0.5, n + 1.0))
    cdf = ndtr((edges[None, :] - mean[:, None]) / sd[:, None]).mean(axis=0)
    cdf[0], cdf[-1] = 0.0, 1.0
    return np.diff(cdf)


def quick_distribution(constants: Calibrated, cause: str, train: Train) -> F64:
    """Distribution of the cars derailed, without a run."""
    row = np.array([train.speed, train.behind, train.mass, train.loaded], dtype=float)
    mean, sd = Emulator.shipped(constants)(row[None, :], logarithms(np.array(constants.draws)))
    few: Few = constants.few[cause]
    share = few.share(train.speed, train.behind)
    return mixed(pile_pmf(mean, sd, train.behind), share, few.mean, few.dispersion)
