"""A short derailment to run."""

import pytest

SMALL = """\
version: 1
constants: published
title: A short train
train:
  speed_kmh: 25
  consist:
    - {car: source_base_car, count: 6}
track:
  rail_breaks: [0]
initiation:
  position_m: 0
  derailed_trucks:
    - {car: 1, truck: both}
  lateral_force_N: 50e3
  lateral_force_car: 1
  lateral_force_place: front
  lateral_force_duration_s: 1.0
"""


@pytest.fixture
def small(tmp_path):
    """Path of a scenario that takes a moment to run."""
    path = tmp_path / "small.yaml"
    path.write_text(SMALL, encoding="utf-8")
    return str(path)
