"""Gracie's model of 1991: its instability, against its own recurrence and a closed form."""

import math

import numpy as np
import pytest

from derail_ros.baselines.train import ModelError
from research.gracie import advance, frequencies, growth, least_increment

CAR, SPRING = 68e3, 3.15e6
ROW = np.full(6, CAR)


def test_frequencies_of_a_row_held_at_one_end():
    # omega_j = 2 sqrt(k/m) sin((2j - 1) pi / (2 (2n + 1)))
    j = np.arange(1, 7)
    expected = 2.0 * math.sqrt(SPRING / CAR) * np.sin((2 * j - 1) * math.pi / 26.0)
    assert frequencies(ROW, SPRING) == pytest.approx(expected)


@pytest.mark.parametrize("increment", [0.02, 0.1, 0.5])
def test_an_error_grows_as_the_recurrence_says(increment):
    x = advance(ROW, SPRING, np.array([1e4, 0, 0, 0, 0, 0.0]), increment, 60)
    size = np.abs(x).max(axis=1)
    assert size[41] / size[40] == pytest.approx(growth(ROW, SPRING, increment), rel=1e-6)
    assert growth(ROW, SPRING, increment) > 1.0


def test_shorter_increments_are_worse():
    factors = [growth(ROW, SPRING, dt) for dt in (0.5, 0.2, 0.1, 0.05)]
    assert factors == sorted(factors)
    s = 1.0 / (frequencies(ROW, SPRING)[0] * 0.01) ** 2
    assert growth(ROW, SPRING, 0.01) == pytest.approx(s, rel=0.01)


def test_the_limit_of_stability():
    limit = least_increment(ROW, SPRING)
    assert growth(ROW, SPRING, 0.999 * limit) > 1.0
    assert growth(ROW, SPRING, 1.001 * limit) < 1.0
    force = np.zeros(6)
    force[0] = 1e4
    # beyond it, the row goes to its static answer: the same force in each coupling
    x = advance(ROW, SPRING, force, 3.0 * limit, 400)
    assert x[-1] == pytest.approx(1e4 / SPRING * np.arange(6, 0, -1))


@pytest.mark.parametrize(("name", "values"), [
    ("mass", (0.0 * ROW, SPRING, 0.1)), ("stiffness", (ROW, -1.0, 0.1)),
    ("increment", (ROW, SPRING, math.nan)),
])  # fmt: skip
def test_what_is_refused(name, values):
    mass, stiffness, increment = values
    with pytest.raises(ModelError, match=name):
        advance(mass, stiffness, 0.0 * ROW, increment, 5)
