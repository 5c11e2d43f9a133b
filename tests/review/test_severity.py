"""The composite severity against hand-worked numbers."""

import numpy as np
import pytest

from derail_ros.vocabulary.severity import severity, severity_index


def test_mean_of_three_ratios():
    found = severity_index(12, 38e6, 3460.0, 24, 19e6, 3460.0)
    assert float(found) == pytest.approx(3.5 / 3.0)


def test_vectorised():
    s = severity_index([24, 0], [19e6, 0.0], [3460.0, 0.0], 24, 19e6, 3460.0)
    np.testing.assert_allclose(s, [1.0, 0.0])


@pytest.mark.parametrize("base", [(0, 1.0, 1.0), (1, 0.0, 1.0), (1, 1.0, float("nan"))])
def test_base_without_a_measure_is_refused(base):
    with pytest.raises(ValueError, match="base_"):
        severity_index(1, 1.0, 1.0, *base)


def test_without_a_base_the_source_s_base_train_counts_as_one():
    class BaseTrain:
        cars_derailed = 14
        peak_force = 9.47e6
        scene_area = 1721.0

    assert severity(BaseTrain()) == pytest.approx(1.0)
