"""What it costs to make, send and record the messages of a train of 110 cars.

Prints the table of docs/decisions.md. The rows "rclpy" build the same messages as objects of
rclpy, which needs ROS 2; without it they are left out.
"""

from __future__ import annotations

import array
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from derail_ros.engine import PlanarSimulation
from derail_ros.recording import RunRecorder
from derail_ros.scenario import loads_scenario
from msg_adapters.common import RunContext
from msg_adapters.definitions import serialize
from msg_adapters.markers import MarkerEncoder
from msg_adapters.state import StateEncoder
from msg_adapters.topics import TOPICS, rclpy_class

CARS = 110
SCENARIO = f"""\
version: 1
title: {CARS} cars
train:
  speed_kmh: 60
  consist: [{{car: source_base_car, count: {CARS}}}]
track: {{rail_breaks: [0]}}
"""


def measure(work: Callable[[], object], repeats: int = 7) -> float:
    """Median time of a call, us."""
    work()
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        for _ in range(50):
            work()
        times.append((time.perf_counter() - began) / 50)
    return 1e6 * statistics.median(times)


def row(what: str, microseconds: float, size: int | None = None) -> None:
    """Print a row of the table."""
    share = 100.0 * microseconds * 1e-6 * 50.0
    print(f"| {what} | {microseconds:.0f} | {'' if size is None else size} | {share:.2f} |")


def main() -> None:
    """Measure and print."""
    simulation = PlanarSimulation(loads_scenario(SCENARIO).to_params())
    simulation.advance_to(5.0)
    sample = simulation.sample()
    context = RunContext("0" * 32)
    encoder = StateEncoder(simulation.params, context)
    marker_encoder = MarkerEncoder(simulation.params, context)
    peak = np.zeros(CARS)
    print(f"| message of {CARS} cars | us | bytes | % of a core at 50 Hz |")
    print("| --- | ---: | ---: | ---: |")
    makers: dict[str, Callable[[], bytes]] = {
        "car_poses": lambda: encoder.poses(sample),
        "train_state": lambda: serialize(encoder.train_state(sample)),
        "coupler_states": lambda: serialize(encoder.coupler_states(sample)),
        "energy": lambda: serialize(encoder.energy(sample)),
        "markers": lambda: marker_encoder(sample, peak),
    }
    for name, make in makers.items():
        row(f"`{name}`: made and serialised", measure(make), len(make()))
    size = sum(len(data) for _, data in encoder.encode(sample))
    row("the four of a tick, patched in place", measure(lambda: encoder.encode(sample)), size)
    row("the engine's sample for them", measure(simulation.sample))
    record(makers["train_state"]())
    try:
        import rclpy
    except ImportError:
        return
    compare_with_rclpy(rclpy, encoder.train_state(sample), makers)


def record(data: bytes) -> None:
    """Time of handing a message to a recording, and of everything until it is closed."""
    number = 2000
    with tempfile.TemporaryDirectory() as folder:
        for storage in ("mcap", "sqlite3"):
            began = time.perf_counter()
            with RunRecorder(Path(folder) / storage, storage) as recorder:
                for k in range(number):
                    recorder.write("/train_state", k, data)
            whole = time.perf_counter() - began
            row(f"`train_state`: recorded ({storage})", 1e6 * whole / number, len(data))


def compare_with_rclpy(rclpy: object, state: object, makers: dict) -> None:
    """The same with message objects of rclpy."""
    rclpy.init()  # type: ignore[attr-defined]
    node = rclpy.create_node("bench")  # type: ignore[attr-defined]
    try:
        publishers = {
            name: node.create_publisher(rclpy_class(TOPICS[name].msgtype), name, 10)
            for name in ("train_state", "car_poses")
        }
        fields = {
            name: array.array("d", getattr(state, name))
            for name in state.__dataclass_fields__  # type: ignore[attr-defined]
            if isinstance(getattr(state, name), np.ndarray)
            and getattr(state, name).dtype == np.float64
        }
        message = rclpy_class("derail_msgs/msg/TrainState")()

        def train_state() -> None:
            for name, values in fields.items():
                setattr(message, name, values)
            publishers["train_state"].publish(message)

        poses = rclpy_class("geometry_msgs/msg/PoseArray")()
        pose = rclpy_class("geometry_msgs/msg/Pose")
        poses.poses = [pose() for _ in range(CARS)]

        def car_poses() -> None:
            for each in poses.poses:
                each.position.x = 1.0
                each.position.y = 1.0
                each.orientation.z = 0.0
                each.orientation.w = 1.0
            publishers["car_poses"].publish(poses)

        raw = {name: makers[name]() for name in publishers}
        row("rclpy: `train_state` reused and published", measure(train_state))
        row(
            "rclpy: `train_state` published from its bytes",
            measure(lambda: publishers["train_state"].publish(raw["train_state"])),
        )
        row("rclpy: `car_poses` reused and published", measure(car_poses))
        row(
            "rclpy: `car_poses` published from its bytes",
            measure(lambda: publishers["car_poses"].publish(raw["car_poses"])),
        )
    finally:
        node.destroy_node()
        rclpy.shutdown()  # type: ignore[attr-defined]


if __name__ == "__main__":
    main()
