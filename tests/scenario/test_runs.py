"""The shipped scenarios run."""

import math

import pytest

from derail_ros.scenario import list_scenarios, load_scenario


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name, _ in list_scenarios()])
def test_runs_to_rest(name):
    from derail_ros.engine import PlanarSimulation

    outcome = PlanarSimulation(load_scenario(name).to_params()).run()
    assert outcome.status == "at rest"
    assert outcome.cars_derailed >= 5
    assert math.isfinite(outcome.duration)
