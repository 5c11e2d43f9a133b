"""Release by force, energy and approach of blows, against numbers by hand."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from derail_ros.predict import release
from derail_ros.predict.runs import OUTPUTS


def blow(striking: int, struck: int, angle: float = 90.0, speed: float = 5.0, energy: float = 1e6):
    """A corner of one car on the wall of another."""
    return SimpleNamespace(
        car_a=min(striking, struck), car_b=max(striking, struck), corner_car=striking,
        angle=math.radians(angle), closing_speed=speed, energy_lost=energy,
    )  # fmt: skip


@pytest.mark.parametrize("rule", release.TESTS)
def test_the_tests_are_the_5_and_95_percent_points(rule: str) -> None:
    low, high = release.TESTS[rule]
    assert release.probability(low, rule=rule) == pytest.approx(0.05, abs=1e-4)
    assert release.probability(high, rule=rule) == pytest.approx(0.95, abs=1e-4)
    for value in (low, high):
        strong = release.probability(value, "double_shell", rule)
        assert 0.0 < strong < release.probability(value, rule=rule)


def test_a_car_holds_if_it_holds_each_blow() -> None:
    """The car whose wall is struck counts, not the one whose corner strikes."""
    median = math.sqrt(1.27e6 * 2.64e6)
    blows = [blow(2, 3, energy=median), blow(4, 3, energy=median), blow(3, 1, energy=median)]
    p = release.by_blows(blows, 4, "single_shell", "energy")
    assert p == pytest.approx([0.5, 0.0, 0.75, 0.0])
    slow, fast = math.sqrt(4.34 * 6.26), 30.0
    blows = [blow(1, 2, speed=slow), blow(1, 3, angle=29.0, speed=fast), blow(1, 4, speed=fast)]
    p = release.by_blows(blows, 4, "single_shell", "approach")
    assert p == pytest.approx([0.0, 0.5, 0.0, 1.0], abs=1e-9)


def test_a_fixed_thing_is_no_tank_car() -> None:
    wall = SimpleNamespace(car_a=1, car_b=0, corner_car=1, angle=1.5, closing_speed=30.0,
                           energy_lost=1e8)  # fmt: skip
    assert release.by_blows([wall], 2, "single_shell", "energy").tolist() == [0.0, 0.0]


def test_shares_and_cars_of_runs() -> None:
    """Ten cars off; five expected to release by energy: half of them, and 2 of 4 among ten."""
    row = np.zeros((400, len(OUTPUTS)))
    row[:, OUTPUTS.index("derailed")] = 10.0
    row[:, OUTPUTS.index("energy_single_shell")] = 5.0
    found = release.of_runs(row, 10, hazardous=4)
    assert found["single_shell"]["by_energy"]["share_of_derailed"] == 0.5
    assert found["single_shell"]["by_energy"]["cars"]["mean"] == pytest.approx(2.0, abs=0.15)
    assert found["single_shell"]["share_of_derailed"] == 0.0
