"""The example of a detector on board: how many cars it saves."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("rclpy")
pytest.importorskip("derail_msgs")

from tests.nodes.graph import Graph, graph

pytestmark = pytest.mark.ros

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "derailment_detector.py"
DRAGGED = """\
version: 1
constants: published
title: Thirty cars drag a derailed truck towards a broken rail
train:
  speed_kmh: 60
  consist:
    - {car: source_base_car, count: 30}
track:
  rail_breaks: [300]
initiation:
  lateral_force_N: 0
  derailed_trucks: [{car: 5, truck: rear}]
brakes:
  signal_source: none
  vent_on_parting: false
"""


def derailed(made: Graph, speed_factor: float) -> int:
    """Cars that have derailed at the end of a run."""
    assert made.set_parameter("speed_factor", speed_factor).successful
    loaded = made.ask("load_consist", scenario_yaml=DRAGGED, start_paused=True)
    assert loaded.success, loaded.message
    assert made.ask("set_simulation_state", state=1).success
    final = lambda: [m for m in made.of_run("outcome", loaded.run_id) if m.is_final]  # noqa: E731
    return len(made.until(final, "the end")[0].derailed_cars)


def test_a_detector_saves_cars(tmp_path) -> None:
    """Undetected, the train drags its truck over the break; detected, it stops before or on it."""
    with graph(tmp_path) as made:
        made.simulator(scenario="", imu="5:front_truck", imu_noise=0.05, pipe_pressure="5")
        made.listen("outcome")
        without = derailed(made, speed_factor=0.0)
        log = (tmp_path / "detector.log").open("wb")
        process = subprocess.Popen(
            [sys.executable, str(EXAMPLE), "--ros-args", "-p", "car:=5"],
            env=made.env, stdout=log, stderr=log,
        )  # fmt: skip
        count = made.node.count_subscribers
        made.until(lambda: count("/car_5/imu_front_truck"), "the detector listens")
        with_it = derailed(made, speed_factor=4.0)
        process.terminate()
        process.wait(60)
    assert "nobody brakes" in (tmp_path / "detector.log").read_text()
    # Cars behind the break's first victims are saved; the numbers are told by pytest -rP.
    print(f"derailed: {without} cars without, {with_it} with the detector")
    assert without == 6
    assert with_it <= 3
