"""An articulated car on the track: it runs through a curve and keeps its energy."""

import pytest

from derail_ros.engine.planar import PlanarSimulation
from derail_ros.scenario import loads_scenario

TEXT = """
version: 1
title: articulated cars in a curve
train:
  speed_kmh: 30
  consist: [{{car: {}, count: 2}}, {{car: boxcar_50ft_286k, load: empty}}]
track:
  start_coordinate_m: -400
  start_x_m: -400
  alignment:
    - tangent: {{length_m: 400}}
    - curve: {{length_m: 200, radius_m: 200, turn: left}}
    - tangent: {{length_m: 400}}
initiation: {{position_m: -20, await_command: true, lateral_force_N: 0}}
brakes: {{signal_source: none}}
"""


@pytest.mark.parametrize("car", ["spine_car_53ft_5_unit", "well_car_53ft_3_unit"])
def test_it_runs_through_a_curve(car):
    run = PlanarSimulation(loads_scenario(TEXT.format(car)).to_params())
    run.advance_to(20.0)
    outcome = run.outcome()
    assert outcome.derailed_cars == ()
    assert run.sample().coupled.all()
    # nothing brakes or pulls: the speed is what it was, and the ledger closes
    assert run.sample().velocity[0, 0] ** 2 + run.sample().velocity[0, 1] ** 2 == pytest.approx(
        (30.0 / 3.6) ** 2, rel=5e-3
    )
    assert outcome.energy_residual < 1e-3
