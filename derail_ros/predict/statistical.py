"""Statistical models of the number of cars derailed, refitted on accident reports.

Covariates ``x`` of a train: 1, ln speed (m/s), ln cars behind, ln mean mass (t), share of loaded
cars. ``y`` is the number of cars derailed, from 1 to the cars behind, ``n``.

- Truncated geometric (Saccomanno and El-Hage 1989; Anderson 2005):
  ``P(y) = p (1 - p)^(y-1) / (1 - (1 - p)^n)``, ``logit p = x b``.
- Zero-truncated negative binomial (Liu, Saat, Qin and Barkan 2013):
  ``P(y) = NB(y; mu, a) / (1 - NB(0; mu, a))``, ``ln mu = x b``, variance ``mu + a mu^2``; here
  cut off at ``n`` as well.
- Quantile regression (Koenker and Bassett 1978): each quantile of ln y is linear in x.

The printed coefficients are of other reports; these are fitted to those of ``accidents``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.optimize import linprog, minimize
from scipy.special import gammaln

F64 = NDArray[np.float64]

LEVELS = np.array([0.025, 0.05, *np.arange(0.1, 0.91, 0.1), 0.95, 0.975])
"""Levels of the regressed quantiles."""


def covariates(speed: F64, behind: F64, mass: F64, loaded: F64) -> F64:
    """``x`` of trains: (n, 5), from m/s, cars, kg and a share."""
    return np.column_stack(
        [np.ones_like(speed), np.log(speed), np.log(behind), np.log(mass / 1e3), loaded]
    )


def _log_geometric(b: F64, x: F64, y: F64, n: F64) -> F64:
    eta = np.clip(x @ b, -12.0, 12.0)
    log_p, log_q = -np.log1p(np.exp(-eta)), -np.log1p(np.exp(eta))
    return log_p + (y - 1.0) * log_q - np.log(-np.expm1(n * log_q))


def _log_nb(b: F64, x: F64, y: F64) -> F64:
    mu = np.exp(np.clip(x @ b[:-1], -5.0, 7.0))
    r = math.exp(-b[-1])
    return (
        gammaln(y + r) - gammaln(r) - gammaln(y + 1.0)
        + r * np.log(r / (r + mu)) + y * np.log(mu / (r + mu))
    )  # fmt: skip


def _pmf(log_p: F64) -> F64:
    p = np.exp(log_p - log_p.max())
    return p / p.sum()


@dataclass(frozen=True)
class Statistical:
    """A fitted model: ``kind``, its coefficients."""

    kind: str
    coefficients: F64

    def pmf(self, x: F64, n: int) -> F64:
        """Probability of 1 to ``n`` cars of a train with covariates ``x`` (5,)."""
        y = np.arange(1.0, n + 1.0)
        rows = np.broadcast_to(x, (n, len(x)))
        if self.kind == "geometric":
            return _pmf(_log_geometric(self.coefficients, rows, y, np.full(n, float(n))))
        if self.kind == "negative_binomial":
            return _pmf(_log_nb(self.coefficients, rows, y))
        q = np.sort(self.coefficients @ x)  # quantiles may cross: put in order
        low, high = 2.0 * q[0] - q[2], 2.0 * q[-1] - q[-3]
        places = np.concatenate([[min(low, q[0])], q, [max(high, q[-1])]])
        cdf = np.interp(
            np.log(np.arange(0.5, n + 1.0)),
            places + 1e-9 * np.arange(len(places)),
            np.concatenate([[0.0], LEVELS, [1.0]]),
        )
        p = np.diff(cdf)
        p[0] += cdf[0]
        p[-1] += 1.0 - cdf[-1]
        return p / p.sum()


KINDS = ("geometric", "negative_binomial", "quantile")
WORDS = {
    "geometric": "truncated geometric",
    "negative_binomial": "zero-truncated negative binomial",
    "quantile": "quantile regression",
}


def fit(kind: str, x: F64, y: F64, n: F64) -> Statistical:
    """Fit a model of :data:`KINDS` by maximum likelihood (the last: by its check function)."""
    if kind == "quantile":
        return Statistical(kind, np.array([_quantile(x, np.log(y), t) for t in LEVELS]))
    start = np.zeros(x.shape[1] + (kind == "negative_binomial"))
    if kind == "geometric":

        def loss(b: F64) -> float:
            return -float(_log_geometric(b, x, y, n).mean()) + 1e-6 * float(b @ b)
    else:
        start[0] = math.log(y.mean())
        start[-1] = -1.0

        def loss(b: F64) -> float:
            zero = _log_nb(b, x, np.zeros_like(y))
            lp = _log_nb(b, x, y) - np.log(-np.expm1(zero))
            return -float(lp.mean()) + 1e-6 * float(b @ b)

    return Statistical(kind, minimize(loss, start, method="BFGS").x)


def _quantile(x: F64, y: F64, level: float) -> F64:
    """Coefficients of a quantile: least ``sum(u (level - [u < 0]))`` of ``u = y - x b``."""
    m, k = x.shape
    costs = np.concatenate([np.zeros(k), np.full(m, level), np.full(m, 1.0 - level)])
    rows = sparse.hstack([sparse.csr_matrix(x), sparse.eye(m), -sparse.eye(m)]).tocsc()
    free: Sequence[tuple[float | None, float | None]] = [(None, None)] * k + [(0.0, None)] * 2 * m
    return linprog(costs, A_eq=rows, b_eq=y, bounds=free, method="highs").x[:k]
