"""The example of a detector on board: how many cars it saves."""

from __future__ import annotations

import signal

import pytest

pytest.importorskip("rclpy")
pytest.importorskip("derail_msgs")

from tests.nodes.graph import Graph, Process, graph

pytestmark = pytest.mark.ros

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


def detector(made: Graph) -> Process:
    """The example as a process that listens."""
    process = made.start("examples.derailment_detector", car=5)
    count = made.node.count_subscribers
    made.until(lambda: count("/car_5/imu_front_truck"), "the detector listens", process)
    return process


def test_a_detector_saves_cars(tmp_path) -> None:
    """Undetected, the train drags its truck over the break; detected, it stops before or on it."""
    with graph(tmp_path) as made:
        # at low rates: each message takes computing time, and the run must keep its speed
        sensors = {"imu": "5:front_truck", "imu_rate": 25.0, "imu_noise": 0.05}
        made.simulator(scenario="", state_rate=10.0, pipe_pressure="5", **sensors)
        made.listen("outcome")
        without = derailed(made, speed_factor=0.0)
        process = detector(made)
        with_it = derailed(made, speed_factor=4.0)
        assert process.end(signal.SIGTERM) == 0, process.output
    assert "nobody brakes" in process.output
    # Cars behind the break's first victims are saved; the numbers are told by pytest -rP.
    print(f"derailed: {without} cars without, {with_it} with the detector")
    assert without == 6
    assert with_it <= 3


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_example_ends_at_a_signal(tmp_path, number) -> None:
    """Alone, too, when nothing comes in that could wake it."""
    with graph(tmp_path) as made:
        process = detector(made)
        assert process.end(number) == 0, process.output
        assert "Traceback" not in process.output
