"""``make run``: the Mississauga derailment of 1979 in a real ROS 2 node, recorded.

Simulator and recorder run as processes of their own and talk over a ROS 2 graph; this process
listens to them, shows how the run goes, on the terminal and on a page, and in the end reads
the recording back.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from derail_ros.look.board import Board, Refused
from derail_ros.look.server import serving
from derail_ros.nodes.domain import free_domain
from derail_ros.recording.reader import read_bag
from derail_ros.recording.recorded_run import Cars, SampledLine
from derail_ros.studies.published import load_published
from derail_ros.vocabulary.events import Event, EventKind
from derail_ros.vocabulary.ledger import stopped_by
from derail_ros.vocabulary.measures import MEASURES, outcome_record
from derail_ros.vocabulary.outcome import Outcome, ending
from derail_ros.vocabulary.words import capital

if TYPE_CHECKING:
    from derail_ros.nodes.client import SimulatorClient

SCENARIO = "mississauga"
SPEED_FACTOR = 3.0
STATE_EVERY = 0.05
"""Wall time between two states on the page, s."""
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
    """The messages received so far."""

    time: float = 0.0
    derailed: int = 0
    peak: float = 0.0
    status: str = "waiting for the simulator; the first time its kernels are compiled"
    final: bool = False
    events: deque[tuple[float, str]] = field(default_factory=lambda: deque(maxlen=LATEST))


class Page:
    """The page of the run (:mod:`derail_ros.look`), from the messages of the graph."""

    def __init__(self) -> None:
        self.board = Board(self.act, ("break", "brake"))
        self._consist: Any = None
        self._line: SampledLine | None = None
        self._breaks = 0
        self._coupled = np.ones(0, dtype=int)
        self._shown = 0.0
        self._early: list[Event] = []
        self._client: SimulatorClient | None = None
        self._lock = threading.Lock()

    def on_consist(self, m: Any) -> None:
        """The train is known."""
        self._consist = m
        self._coupled = np.ones(max(len(m.mass) - 1, 0), dtype=int)

    def on_track(self, m: Any) -> None:
        """The track, again with each break."""
        self._line = SampledLine.of_message(m)

    def on_event(self, event: Event) -> None:
        """Something happened."""
        if self._shown:
            self.board.event(event)
        else:
            self._early.append(event)
        if event.kind == EventKind.COUPLER_PARTED and event.cars:
            self._coupled[min(event.cars) - 1] = 0

    def on_state(self, m: Any) -> None:
        """A state; not each is shown."""
        now, first = time.monotonic(), self._shown == 0.0
        if self._consist is None or self._line is None or now < self._shown + STATE_EVERY:
            return
        self._shown = now
        if first:
            cars, name = Cars.of_message(self._consist), self._consist.scenario_name
            self.board.begin(name, name, cars, self._line, np.array(m.x))
            for event in self._early:
                self.board.event(event)
        for b in self._line.breaks[self._breaks :]:
            self.board.rail_break(*(float(v) for v in b[1:]))
        self._breaks = len(self._line.breaks)
        on = np.stack([m.truck_status_front, m.truck_status_rear], axis=-1) == m.TRUCK_ON_RAILS
        self.board.state(
            m.time,
            np.stack([m.x, m.y, m.z, m.roll, m.pitch, m.yaw], axis=-1),
            np.stack([m.vx, m.vy], axis=-1),
            np.stack([m.coupler_angle_front, m.coupler_angle_rear], axis=-1),
            on,
            self._coupled,
        )

    def act(self, name: str, arguments: dict[str, Any]) -> str:
        """Have the simulator carry out a command."""
        from derail_ros.nodes.client import SimulatorClient, SimulatorClientError

        with self._lock:
            try:
                if self._client is None:
                    self._client = SimulatorClient(timeout=10.0, name="page")
                if name == "brake":
                    self._client.brake()
                    return "Emergency brakes, from the front of the train."
                place = None
                if arguments.get("x") is not None and self._line is not None:
                    place, _ = self._line.locate(float(arguments["x"]), float(arguments["y"]))
                car = int(arguments.get("car") or 0)
                place = self._client.break_rail(place, car=car)
            except SimulatorClientError as error:
                raise Refused(str(error)) from None
            return f"The rail is broken at {place:.1f} m."

    def close(self) -> None:
        """Leave the graph."""
        with self._lock:
            if self._client is not None:
                self._client.close()


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


@contextlib.contextmanager
def started(
    module: str, parameters: dict[str, Any], log: Path, env: dict[str, str]
) -> Iterator[subprocess.Popen[bytes]]:
    """Have a node as a process, its output in a file; it is told to end, whatever happens."""
    command = [sys.executable, "-m", module, "--ros-args"]
    for name, value in parameters.items():
        command += ["-p", f"{name}:={ros_value(value)}"]
    with (
        log.open("wb") as stream,
        subprocess.Popen(command, stdout=stream, stderr=subprocess.STDOUT, env=env) as process,
    ):
        try:
            yield process
        finally:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
            try:
                process.wait(timeout=15)
            except subprocess.TimeoutExpired:
                process.kill()
            except KeyboardInterrupt:
                process.kill()
                raise


@contextlib.contextmanager
def listening(heard: Heard, page: Page, env: dict[str, str]) -> Iterator[Any]:
    """Listen to the graph; gives a function that waits for what comes."""
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.signals import SignalHandlerOptions

    from msg_adapters.reports import (
        collision_from_message,
        event_from_message,
        outcome_from_message,
    )
    from msg_adapters.topics import TOPICS, rclpy_class, rclpy_qos

    os.environ.update(env)
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("demonstration")
    executor = SingleThreadedExecutor()
    executor.add_node(node)

    def on_clock(message: Any) -> None:
        heard.time = message.clock.sec + 1e-9 * message.clock.nanosec

    def on_event(message: Any) -> None:
        page.on_event(event_from_message(message))
        heard.events.append((message.time, message.text))
        heard.derailed += message.kind_name == "truck_derailed" and message.before != "derailed"

    def on_outcome(message: Any) -> None:
        outcome = outcome_from_message(message)
        heard.derailed = outcome.cars_derailed
        heard.peak = outcome.peak_force
        heard.status, heard.final = outcome.status, outcome.final
        heard.time = max(heard.time, message.time)
        if outcome.final:
            page.board.end(f"{capital(outcome.text)}.", stopped_by(outcome.energy))

    for name, callback, depth in (
        ("/clock", on_clock, None),
        ("events", on_event, None),
        ("outcome", on_outcome, None),
        ("consist", page.on_consist, None),
        ("track", page.on_track, None),
        ("collisions", lambda m: page.board.contact(collision_from_message(m)), None),
        ("train_state", page.on_state, 1),
    ):
        topic = TOPICS[name]
        node.create_subscription(
            rclpy_class(topic.msgtype), topic.name, callback, rclpy_qos(topic, depth)
        )
    try:
        yield lambda seconds: executor.spin_once(timeout_sec=seconds)
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown()


def picture(heard: Heard, began: float) -> Any:
    """The screen during the run."""
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
    heard: Heard,
    page: Page,
    processes: Sequence[subprocess.Popen[bytes]],
    env: dict[str, str],
    began: float,
) -> None:
    """Show the run until both nodes have ended, or one of them has failed."""
    from rich.live import Live

    with listening(heard, page, env) as spin, Live(refresh_per_second=8) as live:
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
    console.print(
        f"[bold]{scenario}[/bold] at {speed_factor:g} times real time: "
        "nodes [bold]simulator[/bold] and [bold]recorder[/bold], "
        f"ROS_DOMAIN_ID {env['ROS_DOMAIN_ID']}"
    )
    page = Page()
    with (
        contextlib.closing(page),
        serving(page.board) as server,
        started(
            "derail_ros.nodes.recorder", {"path": bag, "stop_when_final": True}, recorder_log, env
        ) as recorder,
        started(
            "derail_ros.nodes.simulator",
            {
                "scenario": scenario,
                "speed_factor": float(speed_factor),
                "await_listeners": 1,
                "auto_exit": True,
            },
            simulator_log,
            env,
        ) as simulator,
    ):
        console.print(f"page: {server.addresses[0]}  (live, while it runs)", highlight=False)
        watch(heard, page, [simulator, recorder], env, began)
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
    # A supervisor's SIGTERM ends the nodes as Ctrl-C does.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with contextlib.ExitStack() as held:
        try:
            domain = held.enter_context(free_domain(os.getpid()))
        except RuntimeError as error:
            print(f"error: {error}", file=sys.stderr)
            return 1
        try:
            return run(arguments.scenario, arguments.speed_factor, arguments.output, domain)
        except KeyboardInterrupt:
            print("interrupted")
            return INTERRUPTED


if __name__ == "__main__":
    sys.exit(main())
