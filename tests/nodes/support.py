"""Small trains for the tests of nodes, recordings and messages."""

from __future__ import annotations

from derail_ros.engine import PlanarSimulation
from derail_ros.recording.session import Prepared, prepare
from derail_ros.scenario import Scenario, loads_scenario

SMALL = """\
version: 1
title: Ten cars over a broken rail
train:
  speed_kmh: 80
  consist:
    - {car: source_base_car, count: 10}
track:
  rail_breaks: [12]
"""

ENDLESS = """\
version: 1
title: Three cars that roll on
train:
  speed_kmh: 70
  consist:
    - {car: source_base_car, count: 3}
initiation:
  lateral_force_N: 0
  await_command: true
brakes:
  signal_source: none
integration:
  time_limit_s: 3600
"""

OFF_THE_TRACK = """\
version: 1
title: Two cars and not enough track
train:
  speed_kmh: 72
  consist:
    - {car: source_base_car, count: 2}
track:
  start_coordinate_m: -100
  start_x_m: -100
  alignment:
    - tangent: {length_m: 130}
initiation:
  lateral_force_N: 0
  await_command: true
"""


def small(text: str = SMALL, name: str = "small") -> Scenario:
    """A scenario that takes a moment to run."""
    return loads_scenario(text, name)


def ready(text: str = SMALL, name: str = "small") -> Prepared:
    """The same, made ready."""
    return prepare(small(text, name))


def simulation(text: str = SMALL) -> PlanarSimulation:
    """A simulation at its start."""
    return PlanarSimulation(small(text).to_params())
