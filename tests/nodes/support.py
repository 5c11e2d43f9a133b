"""Small trains for the tests of nodes, recordings and messages."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:  # processes that only want a text need not import numba
    from derail_ros.engine import PlanarSimulation
    from derail_ros.recording.session import Prepared
    from derail_ros.scenario import Scenario

SMALL = """\
version: 1
constants: published
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
constants: published
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

SIDING = """\
version: 1
constants: published
title: Four cars that derail into a siding
train:
  speed_kmh: 70
  consist:
    - {car: source_base_car, count: 4}
track:
  rail_breaks: [12]
initiation:
  lateral_force_N: 400000
site:
  datum: {latitude_deg: 43.5, longitude_deg: -79.5, azimuth_deg: 60}
  fixed: [{name: wall, outline_m: [[-40, -9], [150, -9]]}]
  tracks: [{name: siding, offset_m: 4, from_m: -150, to_m: 300}]
  standing:
    - track: siding
      position_m: 70
      consist: [{car: source_base_car, count: 3, contents: grain}]
"""
"""Cars that stand at the side on which the train derails."""

OFF_THE_TRACK = """\
version: 1
constants: published
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
    from derail_ros.scenario import loads_scenario

    return loads_scenario(text, name)


def ready(text: str = SMALL, name: str = "small") -> Prepared:
    """The same, made ready."""
    from derail_ros.recording.session import prepare

    return prepare(small(text, name))


def simulation(text: str = SMALL) -> PlanarSimulation:
    """A simulation at its start."""
    from derail_ros.engine import PlanarSimulation

    return PlanarSimulation(small(text).to_params())
