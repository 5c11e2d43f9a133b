"""Scores of distributions and the refitted statistical models, against known answers."""

import math

import numpy as np
import pytest

from derail_ros.predict import scores
from derail_ros.predict.statistical import KINDS, Statistical, covariates, fit

RNG = np.random.default_rng(3)


def test_scores_of_small_distributions() -> None:
    """CRPS equals E|X - y| - E|X - X'|/2, computed by brute force."""
    p = np.array([0.1, 0.2, 0.4, 0.2, 0.1])
    k = np.arange(1, 6)
    for y in range(1, 6):
        direct = p @ np.abs(k - y) - 0.5 * p @ np.abs(k[:, None] - k[None, :]) @ p
        assert scores.crps(p, y) == pytest.approx(direct)
    assert scores.log_score(p, 3) == pytest.approx(-math.log(0.4))
    assert scores.mean(p) == pytest.approx(3.0)
    assert [scores.quantile(p, q) for q in (0.05, 0.1, 0.5, 0.95)] == [1, 1, 3, 5]
    assert scores.of_samples(np.array([1.0, 3.0, 3.0, 9.0]), 5).tolist() == [0.25, 0, 0.5, 0, 0.25]


def test_bands_of_the_right_distribution_hold_their_share() -> None:
    """Counts drawn from what is predicted: coverage 0.5 and 0.9, no bias; too narrow ones fail."""
    predicted, y = [], []
    for _ in range(3000):
        p = RNG.dirichlet(np.ones(12))
        predicted.append(p)
        y.append(int(RNG.choice(12, p=p)) + 1)
    s = scores.Scores.of(predicted, y)
    assert s.within_50 == pytest.approx(0.5, abs=0.03)
    assert s.within_90 == pytest.approx(0.9, abs=0.02)
    assert abs(s.bias) < 3.0 * s.bias_error
    narrow = [np.eye(12)[scores.quantile(p, 0.5) - 1] for p in predicted]
    assert scores.Scores.of(narrow, y).within_90 < 0.5


def made_up(n: int, draw) -> tuple:
    speed, behind = RNG.uniform(4.0, 30.0, n), RNG.integers(30, 120, n).astype(float)
    mass, loaded = RNG.uniform(40e3, 130e3, n), RNG.uniform(0.0, 1.0, n)
    x = covariates(speed, behind, mass, loaded)
    y = np.clip(np.array([draw(row) for row in x]), 1, behind)
    return x, y, behind


def test_a_geometric_model_finds_its_own_coefficients() -> None:
    b = np.array([-0.5, -0.5, 0.0, 0.0, 0.3])
    x, y, n = made_up(6000, lambda r: RNG.geometric(1.0 / (1.0 + math.exp(-(r @ b)))))
    found = fit("geometric", x, y, n)
    at = covariates(*(np.array([v]) for v in (15.0, 80.0, 90e3, 0.5)))[0]
    true = Statistical("geometric", b).pmf(at, 80)
    assert scores.mean(found.pmf(at, 80)) == pytest.approx(scores.mean(true), rel=0.05)


@pytest.mark.parametrize("kind", KINDS)
def test_models_are_distributions_and_follow_log_normal_counts(kind: str) -> None:
    """ln y = 0.8 ln v + noise of 0.4: medians of the flexible two are right, all sum to 1."""
    x, y, n = made_up(1500, lambda r: round(math.exp(0.8 * r[1] + 0.4 * RNG.standard_normal())))
    found = fit(kind, x, y, n)
    for speed in (8.0, 25.0):
        at = covariates(*(np.array([v]) for v in (speed, 80.0, 90e3, 0.5)))[0]
        p = found.pmf(at, 80)
        assert p.sum() == pytest.approx(1.0)
        assert np.all(p >= 0.0)
        if kind != "geometric":
            assert scores.quantile(p, 0.5) == pytest.approx(speed**0.8, rel=0.15)


def test_few_draws_do_not_flatter() -> None:
    """Twelve draws of the right distribution: bands hold their share, CRPS is that of the law."""
    rng = np.random.default_rng(9)
    law = np.diff(np.concatenate([[0.0], np.cumsum(np.full(20, 0.05))]))
    y = rng.integers(1, 21, 6000)
    drawn = [rng.integers(1, 21, 12).astype(float) for _ in y]
    s = scores.Scores.of_samples(drawn, y.tolist())
    exact = scores.Scores.of([law] * len(y), y.tolist())
    assert s.within_50 == pytest.approx(0.5, abs=0.025)
    assert s.within_90 == pytest.approx(0.9, abs=0.015)
    assert s.crps == pytest.approx(exact.crps, rel=0.03)
    assert exact.log < s.log < exact.log + 0.5  # smoothing costs, and never helps
    few = scores.Scores.of([scores.of_samples(x, 20) for x in drawn], y.tolist())
    assert few.within_90 < s.within_90 and few.crps > s.crps


def test_reports_are_spread_over_the_speeds() -> None:
    """Of 511 reports the first 40 hold 8 of each fifth of the speeds, to within 2."""
    from research.engine_scores import order_of

    speed = RNG.uniform(3.0, 30.0, 511)
    order = order_of(speed)
    assert sorted(order) == list(range(511))
    fifth = np.searchsorted(np.quantile(speed, (0.2, 0.4, 0.6, 0.8)), speed[order[:40]])
    assert np.all(np.abs(np.bincount(fifth, minlength=5) - 8) <= 2)
