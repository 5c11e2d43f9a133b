"""``make run``: the Mississauga derailment of 1979 in a real ROS 2 node, recorded.

Simulator and recorder run as processes of their own and talk over a ROS 2 graph; this process
listens to them, shows how the run goes, and in the end reads the recording back.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from derail_ros.nodes.domain import free_domain
from derail_ros.recording.reader import read_bag
from derail_ros.studies.published import load_published
from derail_ros.vocabulary.measures import MEASURES, outcome_record
from derail_ros.vocabulary.outcome import Outcome, ending

SCENARIO = "mississauga"
SPEED_FACTOR = 3.0
LATEST = 8
"""Events shown."""
INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells have it."""
GIVE_UP = 300.0
"""Wall time after which the demonstration gives up, s."""

KEYS = (
    "cars_derailed",
    "scene_length_m",
    "scene_width_m",
    "duration_s",
    "peak_force_N",
    "peak_force_pair",
)
"""Measures that are compared."""


@dataclass
class Heard:
    """What the graph has told so far."""

    time: float = 0.0
    derailed: int = 0
    peak: float = 0.0
    status: str = "waiting for the simulator; the first time its kernels are compiled"
    final: bool = False
    events: deque[tuple[float, str]] = field(default_factory=lambda: deque(maxlen=LATEST))


def environment(domain: int) -> dict[str, str]:
    """Environment of a graph of its own, on this machine only."""
    return os.environ | {
        "ROS_DOMAIN_ID": str(domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "PYTHONUNBUFFERED": "1",
    }


def ros_value(value: Any) -> str:
    """A parameter's value on a command line of ROS."""
    return str(value).lower() if isinstance(value, bool) else str(value)


def start(
    module: str, parameters: dict[str, Any], log: Path, env: dict[str, str]
) -> subprocess.Popen[bytes]:
    """Start a node as a process, its output going to a file."""
    command = [sys.executable, "-m", module, "--ros-args"]
    for name, value in parameters.items():
        command += ["-p", f"{name}:={ros_value(value)}"]
    with log.open("wb") as stream:
        return subprocess.Popen(command, stdout=stream, stderr=subprocess.STDOUT, env=env)


@contextlib.contextmanager
def ended(processes: Sequence[subprocess.Popen[bytes]]) -> Iterator[None]:
    """See to it that processes end, in the order given, whatever happens."""
    try:
        yield
    finally:
        for process in processes:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
            try:
                process.wait(timeout=15)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


@contextlib.contextmanager
def listening(heard: Heard, env: dict[str, str]) -> Iterator[Any]:
    """Listen to the graph; gives a function that waits for what comes."""
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.signals import SignalHandlerOptions

    from msg_adapters.reports import outcome_from_message
    from msg_adapters.topics import TOPICS, rclpy_class, rclpy_qos

    os.environ.update(env)
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("demonstration")
    executor = SingleThreadedExecutor()
    executor.add_node(node)

    def on_clock(message: Any) -> None:
        heard.time = message.clock.sec + 1e-9 * message.clock.nanosec

    def on_event(message: Any) -> None:
        heard.events.append((message.time, message.text))
        heard.derailed += message.kind_name == "truck_derailed" and message.before != "derailed"

    def on_outcome(message: Any) -> None:
        outcome = outcome_from_message(message)
        heard.derailed = outcome.cars_derailed
        heard.peak = outcome.peak_force
        heard.status, heard.final = outcome.status, outcome.final
        heard.time = max(heard.time, message.time)

    for name, callback in (
        ("/clock", on_clock),
        ("events", on_event),
        ("outcome", on_outcome),
    ):
        topic = TOPICS[name]
        node.create_subscription(
            rclpy_class(topic.msgtype), topic.name, callback, rclpy_qos(topic)
        )
    try:
        yield lambda seconds: executor.spin_once(timeout_sec=seconds)
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown()


def picture(heard: Heard, began: float) -> Any:
    """What is shown while the run goes on."""
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    line = Text.assemble(
        ("t = ", "dim"),
        (f"{heard.time:5.1f} s", "bold"),
        ("   cars derailed ", "dim"),
        (f"{heard.derailed:2d}", "bold"),
        ("   peak force ", "dim"),
        (f"{heard.peak / 1e6:4.1f} MN", "bold"),
        (f"   {heard.status}   (wall {time.monotonic() - began:.0f} s)", "dim"),
    )
    table = Table.grid(padding=(0, 1))
    for moment, text in heard.events:
        table.add_row(Text(f"{moment:7.2f} s", style="dim"), text)
    return Group(line, table)


# --- afterwards ------------------------------------------------------------------------------


def comparison(outcome: Outcome, scenario: str) -> Any:
    """Table of the outcome, for Mississauga beside the accident and the published model."""
    from rich.table import Table

    columns: dict[str, Any] = {"this run": outcome_record(outcome)}
    if scenario.startswith(SCENARIO):
        known = load_published()
        (case,) = (c for c in known.beside if c.scenario == SCENARIO)
        columns |= {"the accident": known.accident(scenario), "published model": case.published}
    table = Table("", *columns, title=f"{scenario}: {ending(outcome)}")
    for m in (MEASURES[key] for key in KEYS):
        table.add_row(m.title, *(m.shown(record.get(m.key)) for record in columns.values()))
    return table


def show_log(log: Path) -> None:
    """Print the end of a node's log."""
    print(f"--- {log}", file=sys.stderr)
    for line in log.read_text(errors="replace").splitlines()[-20:]:
        print(line, file=sys.stderr)


def watch(
    heard: Heard, processes: Sequence[subprocess.Popen[bytes]], env: dict[str, str], began: float
) -> None:
    """Show the run until both nodes have ended, or one of them has failed."""
    from rich.live import Live

    with listening(heard, env) as spin, Live(refresh_per_second=8) as live:
        shown = 0.0
        while any(process.poll() is None for process in processes):
            spin(0.1)
            now = time.monotonic()
            if now >= shown + 0.1:
                shown = now
                live.update(picture(heard, began))
            if any(process.poll() not in (None, 0) for process in processes):
                return
            if now - began > GIVE_UP:
                return
        live.update(picture(heard, began))


def run(scenario: str, speed_factor: float, output: Path | None, domain: int) -> int:
    """Run the demonstration in a ROS domain; returns the exit code."""
    from rich.console import Console

    console = Console()
    began = time.monotonic()
    stamp = datetime.now().strftime("%Y-%m-%d_%H%M%S")
    folder = (output or Path("runs") / f"{scenario}_{stamp}").resolve()
    folder.mkdir(parents=True, exist_ok=False)
    bag = folder / "bag"
    env = environment(domain)
    heard = Heard()
    recorder_log, simulator_log = folder / "recorder.log", folder / "simulator.log"
    recorder = start(
        "derail_ros.nodes.recorder",
        {"path": bag, "stop_when_final": True},
        recorder_log,
        env,
    )
    simulator = start(
        "derail_ros.nodes.simulator",
        {
            "scenario": scenario,
            "speed_factor": float(speed_factor),
            "await_listeners": 1,
            "auto_exit": True,
        },
        simulator_log,
        env,
    )
    console.print(
        f"[bold]{scenario}[/bold] at {speed_factor:g} times real time: "
        "nodes [bold]simulator[/bold] and [bold]recorder[/bold], "
        f"ROS_DOMAIN_ID {env['ROS_DOMAIN_ID']}"
    )
    with ended([simulator, recorder]):
        try:
            watch(heard, [simulator, recorder], env, began)
        except KeyboardInterrupt:
            console.print("interrupted")
            return INTERRUPTED
    if simulator.returncode != 0 or recorder.returncode != 0 or not heard.final:
        for process, log in ((simulator, simulator_log), (recorder, recorder_log)):
            if process.returncode != 0 or not heard.final:
                show_log(log)
        return 1
    from derail_ros.review.figures import save_outcome
    from derail_ros.review.scene import final_scene

    run = read_bag(bag)
    console.print(comparison(run.outcome, scenario))
    figures = save_outcome(final_scene(run), run.outcome, folder)
    for line in recorder_log.read_text(errors="replace").splitlines():
        if "missed" in line:
            console.print(f"recorder: {line.rpartition(': ')[2]}", highlight=False)
    console.print(f"recording: {bag}", highlight=False)
    for path in figures:
        console.print(f"figure:    {path}", highlight=False)
    console.print(f"({time.monotonic() - began:.0f} s)", highlight=False)
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """Command line of the demonstration."""
    parser = argparse.ArgumentParser(prog="python -m derail_ros.demo", description=__doc__)
    parser.add_argument("scenario", nargs="?", default=SCENARIO)
    parser.add_argument("--speed-factor", type=float, default=SPEED_FACTOR)
    parser.add_argument("--output", type=Path, help="folder to make (default: in ./runs)")
    arguments = parser.parse_args(argv)
    try:
        import rclpy  # noqa: F401
    except ImportError:
        print("The demonstration needs ROS 2 (rclpy). Without it: derail simulate mississauga")
        return 1
    with contextlib.ExitStack() as held:
        try:
            domain = held.enter_context(free_domain(os.getpid()))
        except RuntimeError as error:
            print(f"error: {error}", file=sys.stderr)
            return 1
        return run(arguments.scenario, arguments.speed_factor, arguments.output, domain)


if __name__ == "__main__":
    sys.exit(main())
