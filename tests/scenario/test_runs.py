"""The shipped scenarios run."""

import math

import pytest

from derail_ros.scenario import list_scenarios, load_scenario

FEW = {"dugald_2009": 0, "brighton_2009": 2}
"""Trains that part without derailing, or of which few cars leave the rails (docs/accidents.md)."""


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name, _ in list_scenarios()])
def test_runs_to_rest(name):
    from derail_ros.engine import PlanarSimulation

    outcome = PlanarSimulation(load_scenario(name).to_params()).run()
    assert outcome.status == "at rest"
    if name in FEW:
        assert outcome.cars_derailed == FEW[name]
    else:
        assert outcome.cars_derailed >= 5
    assert math.isfinite(outcome.duration)
