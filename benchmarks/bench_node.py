"""What the simulator node costs and keeps: load, rates, service times, recorders at speed.

Prints the tables of docs/ros2.md. Needs ROS 2. Everything runs on one machine: simulator, recorder
and client are processes of their own.
"""

from __future__ import annotations

import math
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # the graph of the tests

from benchmarks.bench_performance import fixed_kernel
from derail_ros.engine import PlanarSimulation, warm_up
from derail_ros.recording import read_manifest
from derail_ros.scenario import loads_scenario
from msg_adapters.topics import LIVE_TOPICS, rclpy_class

CARS = 110
SCENARIO = f"""\
version: 1
title: {CARS} cars
train:
  speed_kmh: 60
  consist: [{{car: source_base_car, count: {CARS}}}]
track: {{rail_breaks: [0]}}
"""
WINDOW = (2.0, 22.0)
"""Simulation time over which load and rates are measured, s."""
REPEATS = 3
"""Measurements of load: what else the machine does adds to it, so the least is given too."""
FACTORS = (1.0, 2.0, 5.0, 10.0, 20.0, 0.0)
CALLS = 200


def processor_time(pid: int) -> float:
    """Processor time that all threads of a process have used, s."""
    total = 0
    for task in Path(f"/proc/{pid}/task").iterdir():
        total += int((task / "schedstat").read_text().split()[0])
    return 1e-9 * total


def physics(pace: float) -> float:
    """Share of a core that the engine alone needs at real time, with a sample at each tick.

    With pace 1 it sleeps between ticks, as in the node, and finds its caches cold when it wakes
    up; with pace 0 it computes in one go.
    """
    simulation = PlanarSimulation(loads_scenario(SCENARIO).to_params())
    simulation.advance_to(WINDOW[0])
    used, began = time.process_time(), time.monotonic()
    for tick in range(int(50 * WINDOW[0]), int(50 * WINDOW[1])):
        simulation.advance_to(tick / 50.0)
        simulation.sample(tick / 50.0)
        due = began + pace * (tick / 50.0 - WINDOW[0])
        time.sleep(max(0.0, due - time.monotonic()))
    return (time.process_time() - used) / (WINDOW[1] - WINDOW[0])


def node_parameters(folder: Path, **more: Any) -> dict[str, Any]:
    """Parameters of a simulator of the long train."""
    return {"scenario": "long", "scenario_dirs": f"['{folder}']", **more}


def load(folder: Path, number: int, frames: bool) -> dict[str, float]:
    """Load and rates at real time, with a recorder on all topics, and a listener of the frames."""
    from tests.nodes.graph import graph

    place = folder / f"load_{number}"
    with graph(folder) as made:
        recorder = made.start("recorder", path=place)
        simulator = made.simulator(ready=False, **node_parameters(folder, await_listeners=1))
        clocks = made.listen("/clock")["/clock"]
        for name in ("/tf", "joint_states") if frames else ():  # as RViz listens
            kind = rclpy_class(LIVE_TOPICS[name].msgtype)
            made.node.create_subscription(kind, name, lambda _: None, 100, raw=True)
        diagnostics = made.listen("/diagnostics")["/diagnostics"]
        pid = simulator.process.pid

        def reached(seconds: float) -> bool:
            return bool(clocks) and clocks[-1].clock.sec >= seconds

        made.until(lambda: reached(WINDOW[0]), "the run begins", simulator)
        used, began, count = processor_time(pid), time.monotonic(), len(clocks)
        made.until(lambda: reached(WINDOW[1]), "the run goes on", simulator)
        wall = time.monotonic() - began
        share = (processor_time(pid) - used) / wall
        clock_rate = (len(clocks) - count) / wall
        values = {v.key: v.value for v in diagnostics[-1].status[0].values}
        recorder.end()
    manifest = read_manifest(place)
    missed = manifest.settings["missed"]
    seconds = (manifest.messages["/train_state"] - 1) / 50.0
    paced, at_once = physics(1.0), physics(0.0)
    found = {
        "node, share of a core, %": 100 * share,
        "engine alone at the same pace, %": 100 * paced,
        "engine alone in one go, %": 100 * at_once,
        "node without the engine at the same pace, %": 100 * (share - paced),
        "node without the engine in one go, %": 100 * (share - at_once),
        "real-time factor (diagnostics)": float(values["real_time_factor"]),
        "times behind by over 10 ms (diagnostics)": float(values["overruns"]),
    }
    for name in ("train_state", "car_poses", "coupler_states", "energy"):
        found[f"`{name}`, Hz"] = manifest.messages[f"/{name}"] / (seconds + 0.02)
        found[f"`{name}`, missed"] = missed[f"/{name}"]["lost"] + missed[f"/{name}"]["gaps"]
    found["`markers`, Hz"] = manifest.messages["/markers"] / seconds
    found["`/clock`, Hz"] = clock_rate
    return found


def loads(folder: Path, frames: bool) -> None:
    """Print least and largest of several measurements."""
    found = [load(folder, 2 * number + frames, frames) for number in range(REPEATS)]
    span = WINDOW[1] - WINDOW[0]
    what = ", frames listened to" if frames else ""
    print(f"| {CARS} cars at real time{what}, {REPEATS} times {span:.0f} s | least | largest |")
    print("| --- | --- | --- |")
    for name in found[0]:
        values = [each[name] for each in found]
        print(f"| {name} | {min(values):.2f} | {max(values):.2f} |")
    print()


def services(folder: Path) -> None:
    """Times from request to answer, of a client in a process of its own."""
    from tests.nodes.graph import STOPPED, graph

    print("| services, 110 cars, ms | median | 95th percentile | worst |")
    print("| --- | --- | --- | --- |")
    with graph(folder) as made:
        simulator = made.simulator(**node_parameters(folder))
        for factor in (1.0, 0.0):
            made.set_parameter("speed_factor", factor)
            for service, fields in (
                ("get_events", {}),
                ("inject_rail_break", {"track_coordinate": math.nan}),
                ("trigger_emergency_brake", {"source": 3, "car": 100, "delay_s": 1000.0}),
            ):
                assert made.ask("load_consist", scenario_name="long").success
                times = []
                for k in range(CALLS):
                    if k % 50 == 0:  # at full speed a run is soon over
                        assert made.ask("reset_simulation").success
                        made.ask("set_simulation_state", state=1)
                    began = time.perf_counter()
                    made.ask(service, **fields)
                    times.append(1e3 * (time.perf_counter() - began))
                speed = f"speed factor {factor:g}"
                print(
                    f"| `{service}`, {speed} | {statistics.median(times):.1f} | "
                    f"{statistics.quantiles(times, n=20)[-1]:.1f} | {max(times):.1f} |"
                )
        made.ask("set_simulation_state", state=STOPPED)
        simulator.end()
    print()


def following(folder: Path) -> None:
    """State messages that a recorder misses, by the speed factor."""
    from tests.nodes.graph import graph

    print("| speed factor | got | state messages sent | missed by a recorder |")
    print("| --- | --- | --- | --- |")
    for factor in FACTORS:
        place = folder / f"factor_{factor:g}"
        with graph(folder) as made:
            recorder = made.start("recorder", path=place, stop_when_final=True)
            simulator = made.simulator(
                ready=False,
                scenario="mississauga",
                speed_factor=factor,
                await_listeners=1,
                auto_exit=True,
            )
            clocks = made.listen("/clock")["/clock"]
            made.until(lambda c=clocks: c and c[-1].clock.nanosec, "it begins", simulator)
            began, at = time.monotonic(), clocks[-1].clock
            simulator.wait(300.0)
            wall = time.monotonic() - began
            recorder.wait(300.0)
        manifest = read_manifest(place)
        end = manifest.run.time
        missed = manifest.settings["missed"]
        topics = ("/train_state", "/car_poses", "/coupler_states", "/energy")
        lost = sum(max(missed[t]["lost"], missed[t]["gaps"]) for t in topics)
        sent = sum(missed[t]["received"] for t in topics) + lost
        got = (end - at.sec - 1e-9 * at.nanosec) / wall
        print(f"| {f'{factor:g}' if factor else '0 (free)'} | {got:.1f} | {sent} | {lost} |")


def main() -> None:
    """Measure and print."""
    try:
        import rclpy  # noqa: F401
    except ImportError:
        print("bench_node: needs ROS 2 (rclpy)")
        return
    warm_up()
    before = fixed_kernel()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "long.yaml").write_text(SCENARIO, encoding="utf-8")
        loads(folder, frames=False)
        loads(folder, frames=True)
        services(folder)
        following(folder)
    print(f"\nfixed kernel {before:.2f} ms before and {fixed_kernel():.2f} ms after")


if __name__ == "__main__":
    main()
