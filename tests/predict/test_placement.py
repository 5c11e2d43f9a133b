"""Placement by risk: a train whose answer is known, and runs that begin at any car."""

import numpy as np
import pytest

from derail_ros.predict.placement import Placement, placement, words
from derail_ros.scenario import loads_scenario
from derail_ros.scenario.calibrated import load_calibrated


def always(n: int, m: int, chance: float) -> Placement:
    """``m`` cars derail from the first one on, which is any of ``n`` in turn."""
    derailed = np.array([[1.0 if f <= k < f + m else 0.0 for k in range(n)] for f in range(n)])
    return Placement(derailed, chance * derailed, tuple(range(2, n + 1)))


def test_the_front_is_best_where_a_fixed_number_follows_the_first() -> None:
    """Car k derails if the first one is among the ``m`` up to it: ``min(k, m) / n``."""
    n, m = 30, 8
    found = always(n, m, 0.25).as_dict(4)
    exact = np.minimum(np.arange(1, n + 1), m) / n
    assert found["by_place"]["derails"] == pytest.approx(exact, abs=1e-4)
    assert found["best"]["cars"] == [2, 3, 4, 5]  # car 1 is a locomotive
    assert found["best"]["derailed"]["mean"] == pytest.approx(exact[1:5].sum(), abs=1e-3)
    assert found["best"]["expected_releases"] == pytest.approx(0.25 * exact[1:5].sum(), abs=1e-4)
    assert found["worst"]["expected_releases"] == pytest.approx(0.25 * 4 * m / n, abs=1e-4)
    assert found["anywhere"] == pytest.approx(0.25 * 4 * exact[1:].mean(), abs=1e-4)
    assert "least at risk as cars 2 to 5" in words(found)[0]


def test_places_that_no_run_tells_apart_are_said_to_be() -> None:
    same = np.tile([[1.0, 0.0], [0.0, 1.0]], (20, 1))
    found = Placement(same, same, (1, 2)).as_dict(1)
    assert found["worst_less_best"] == 0.0
    assert "cannot tell the two apart" in words(found)[1]


def test_runs_begin_at_any_car_and_leave_those_ahead_alone() -> None:
    scenario = loads_scenario(
        "version: 1\ntitle: Eight\n"
        "train: {speed_kmh: 30, consist: [{car: tank_dot_111, count: 8}]}\n"
        "track: {rail_breaks: [10]}\n"
    )
    params = scenario.to_params()
    found = placement(params, load_calibrated(), "broken_rail", draws=8, jobs=1)
    first = found.derailed.argmax(axis=1)
    assert sorted(first) == list(range(8))
    for row, f in zip(found.derailed, first, strict=True):
        k = int(row.sum())
        assert row[f : f + k].all() and row.sum() == k  # one group from the first car on
    assert np.all(found.releases <= found.derailed)
    again = placement(params, load_calibrated(), "broken_rail", draws=8, jobs=2)
    assert np.array_equal(again.derailed, found.derailed)
