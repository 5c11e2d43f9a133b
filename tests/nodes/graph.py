"""A ROS graph for a test: a domain of its own, processes, a listening node. No fixed sleeps."""

from __future__ import annotations

import contextlib
import itertools
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import rclpy
from rcl_interfaces.srv import DescribeParameters, GetParameters, SetParameters
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions

from derail_msgs import srv
from derail_ros.nodes.client import PATIENCE
from derail_ros.nodes.domain import free_domain
from msg_adapters.topics import LIVE_TOPICS, STATE_TOPICS, TOPICS, rclpy_class, rclpy_qos
from tests.nodes.forks import Fork, parent

LIMIT = 120.0
"""Wall time after which a test gives up waiting, s: generous, for machines that are busy."""

LIMIT_COMPILING = 280.0
"""The same for the first simulator of a version, which compiles its kernels, s."""

SERVICES = {
    "load_consist": srv.LoadConsist,
    "inject_rail_break": srv.InjectRailBreak,
    "trigger_emergency_brake": srv.TriggerEmergencyBrake,
    "set_simulation_state": srv.SetSimulationState,
    "step_simulation": srv.StepSimulation,
    "reset_simulation": srv.ResetSimulation,
    "get_events": srv.GetEvents,
}
MOVED = ("set_simulation_state", "step_simulation", "reset_simulation")


def service_path(service: str) -> str:
    """Name of a service of derail_msgs below its node's: three left theirs to the standard."""
    return f"derail/{service}" if service in MOVED else service


STOPPED, PLAYING, PAUSED, QUITTING = range(4)

DEEP = {f"qos_overrides./{topic}.publisher.depth": 1000 for topic in STATE_TOPICS}
"""Parameters of a simulator whose states nobody misses, however busy the machine is: with this
depth none is overwritten before it has arrived."""

_domains = itertools.count(os.getpid() * 13)


def ros_value(value: Any) -> str:
    """A parameter's value as the command line of a node wants it."""
    if value == "":
        return '""'
    return str(value).lower() if isinstance(value, bool) else str(value)


class Process:
    """A node as a process of its own; ``forked`` without a cold start, see ``forks``."""

    def __init__(
        self, module: str, env: dict[str, str], log: Path, *arguments: str, forked: bool = False
    ) -> None:
        self.log = log
        self.process: subprocess.Popen[bytes] | Fork
        if forked:
            log.touch()
            self.process = parent().fork(module, list(arguments), env, str(log))
            return
        with log.open("wb") as stream:
            self.process = subprocess.Popen(
                [sys.executable, "-m", module, *arguments],
                stdout=stream,
                stderr=subprocess.STDOUT,
                env=env,
            )

    @property
    def output(self) -> str:
        return self.log.read_text(errors="replace")

    def wait(self, seconds: float = LIMIT) -> int:
        """Wait for the process to end by itself; gives its exit code."""
        try:
            return self.process.wait(seconds)
        except subprocess.TimeoutExpired:
            # With PYTHONFAULTHANDLER it says where it was.
            self.process.send_signal(signal.SIGABRT)
            self.process.wait(20)
            raise AssertionError(f"the process did not end:\n{self.output}") from None

    def end(self, number: int = signal.SIGINT) -> int:
        """Tell the process to end; gives its exit code."""
        if self.process.poll() is None:
            self.process.send_signal(number)
        return self.wait()


class Ear(Process):
    """A subscriber in a process of its own, which can be held up or killed; see ``ear.py``."""

    def signal(self, number: int) -> None:
        self.process.send_signal(number)

    def heard(self) -> set[tuple[str, str]]:
        """What it has heard of which run: topics, and what is special about a message."""
        lines = [line.split("\t") for line in self.output.splitlines() if "\t" in line]
        return {(line[0], line[1]) for line in lines}


class Graph:
    """A domain of its own with processes and one node that listens and asks."""

    def __init__(self, folder: Path, domain: int | None = None) -> None:
        self.folder = folder
        self._claim = contextlib.ExitStack()
        if domain is None:
            domain = self._claim.enter_context(free_domain(next(_domains)))
        self.domain = domain
        self.env = os.environ | {
            "ROS_DOMAIN_ID": str(self.domain),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "ROS_PYTHON_CHECK_FIELDS": "1",
            "ROS_LOG_DIR": str(folder / "ros_log"),
            "PYTHONUNBUFFERED": "1",
            "PYTHONFAULTHANDLER": "1",
            "RCUTILS_LOGGING_BUFFERED_STREAM": "0",
        }
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
        self.processes: list[Process] = []
        self.context = rclpy.Context()
        rclpy.init(
            context=self.context,
            domain_id=self.domain,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        # The executor looks at each service and event handler in each round: it has none to see.
        self.node = rclpy.create_node(
            "listener", context=self.context, start_parameter_services=False
        )
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.heard: dict[str, list[Any]] = {}
        self._clients: dict[tuple[str, str], Any] = {}
        self._sought: dict[tuple[str, str], float] = {}

    # --- processes ---------------------------------------------------------------------------

    def start(
        self, module: str, *arguments: str, fresh: bool = False, **parameters: Any
    ) -> Process:
        """Start a node as a process: one of this package, or a module by its full name.

        One of this package is forked unless the test is about its start (``fresh``).
        """
        given = ["--ros-args", *arguments]
        for name, value in parameters.items():
            given += ["-p", f"{name}:={ros_value(value)}"]
        log = self.folder / f"{module}-{len(self.processes)}.log"
        own = "." not in module
        module = f"derail_ros.nodes.{module}" if own else module
        process = Process(module, self.env, log, *given, forked=own and not fresh)
        self.processes.append(process)
        return process

    def simulator(
        self, *arguments: str, ready: bool = True, module: str = "simulator", **parameters: Any
    ) -> Process:
        """Start a simulator, and wait until it serves."""
        process = self.start(module, *arguments, **parameters)
        if ready:
            self.until(
                lambda: self.found("get_events"),
                "the simulator serves",
                process,
                LIMIT_COMPILING,
            )
        return process

    def ear(self, *topics: str) -> Ear:
        """Start a subscriber in a process of its own, and wait until it hears."""
        log = self.folder / f"ear-{len(self.processes)}.log"
        before = {topic: self.node.count_subscribers(topic) for topic in topics}
        ear = Ear("tests.nodes.ear", self.env, log, *topics)
        self.processes.append(ear)
        self.until(
            lambda: all(self.node.count_subscribers(t) > n for t, n in before.items()),
            "the ear listens",
        )
        return ear

    def close(self) -> None:
        for process in reversed(self.processes):
            with contextlib.suppress(AssertionError):
                process.end()
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)
        self._claim.close()

    # --- listening ---------------------------------------------------------------------------

    def spin(self, seconds: float = 0.05) -> None:
        self.executor.spin_once(timeout_sec=seconds)

    def until(
        self,
        done: Callable[[], Any],
        what: str,
        process: Process | None = None,
        limit: float = LIMIT,
    ) -> Any:
        """Spin until something is true."""
        end = time.monotonic() + limit
        while True:
            result = done()
            if result:
                return result
            for each in self.processes:
                gone = each.process.poll()
                if gone if each is not process else gone is not None:
                    raise AssertionError(f"a process ended before {what}:\n{each.output}")
            if time.monotonic() > end:
                told = "".join(f"\n--- {p.log.name}\n{p.output[-4000:]}" for p in self.processes)
                raise AssertionError(f"waited in vain: {what}{told}")
            self.spin()

    def listen(self, *names: str, namespace: str = "") -> dict[str, list[Any]]:
        """Subscribe to topics of the table and wait until each has a publisher."""
        for name in names:
            topic = (TOPICS | LIVE_TOPICS)[name]
            messages = self.heard.setdefault(name, [])
            full = name if name.startswith("/") else f"{namespace}/{name}".lstrip("/")
            full = full if namespace == "" or full.startswith("/") else f"/{full}"
            self.node.create_subscription(
                rclpy_class(topic.msgtype),
                full,
                messages.append,
                rclpy_qos(topic, max(1000, topic.depth)),
                event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
            )
            self.until(lambda f=full: self.node.count_publishers(f), f"{full} has a publisher")
        return self.heard

    def of_run(self, topic: str, run_id: str) -> list[Any]:
        """Messages of one run. Those of a run before may come late: a listener can lag behind."""
        return [m for m in self.heard[topic] if m.run_id == run_id]

    def goes_on(self, run_id: str, seconds: float = 0.2) -> None:
        """Wait until a run has gone on for a while."""
        self.until(lambda: self.of_run("train_state", run_id), "a state of the run")
        at = self.of_run("train_state", run_id)[-1].time
        self.reaches(run_id, at + seconds)

    def reaches(self, run_id: str, seconds: float) -> None:
        """Wait until a run has reached a run time."""
        self.until(
            lambda: any(m.time >= seconds - 1e-9 for m in self.of_run("train_state", run_id)),
            f"the run reaches {seconds} s",
        )

    # --- asking ------------------------------------------------------------------------------

    def client(self, service: str, node: str = "/simulator") -> Any:
        key = (service, node)
        if key not in self._clients:
            self._clients[key] = self.node.create_client(
                SERVICES[service], f"{node}/{service_path(service)}"
            )
        return self._clients[key]

    def found(self, service: str, node: str = "/simulator") -> Any:
        """A client that has found its service, or None; see PATIENCE."""
        client, key = self.client(service, node), (service, node)
        if client.service_is_ready():
            return client
        now = time.monotonic()
        if now > self._sought.setdefault(key, now) + PATIENCE:
            self.node.destroy_client(self._clients.pop(key))
            del self._sought[key]
        return None

    def ask(self, service: str, node: str = "/simulator", **fields: Any) -> Any:
        """Call a service and wait for the answer."""
        client = self.until(lambda: self.found(service, node), f"{service} is there")
        future = client.call_async(SERVICES[service].Request(**fields))
        self.until(future.done, f"{service} answers")
        return future.result()

    def _parameters(self, kind: Any, name: str, request: Any) -> Any:
        client = self.node.create_client(kind, f"/simulator/{name}")
        self.until(client.service_is_ready, f"{name} is there")
        future = client.call_async(request)
        self.until(future.done, f"{name} answers")
        self.node.destroy_client(client)
        return future.result()

    def set_parameter(self, name: str, value: Any) -> Any:
        message = Parameter(name, value=value).to_parameter_msg()
        request = SetParameters.Request(parameters=[message])
        return self._parameters(SetParameters, "set_parameters", request).results[0]

    def get_parameter(self, name: str) -> Any:
        from rclpy.parameter import parameter_value_to_python

        request = GetParameters.Request(names=[name])
        return parameter_value_to_python(
            self._parameters(GetParameters, "get_parameters", request).values[0]
        )

    def describe_parameter(self, name: str) -> Any:
        request = DescribeParameters.Request(names=[name])
        return self._parameters(DescribeParameters, "describe_parameters", request).descriptors[0]


@contextlib.contextmanager
def graph(folder: Path, domain: int | None = None) -> Iterator[Graph]:
    """A graph for a while; with a domain given, another listener there."""
    made = Graph(folder, domain)
    try:
        yield made
    finally:
        made.close()
