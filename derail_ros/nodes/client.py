"""A client of a running simulator: load, break the rail, brake, step, wait for the end."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from types import TracebackType
from typing import Any

from derail_ros.vocabulary.events import Event
from derail_ros.vocabulary.status import BRAKE_MODES, BRAKE_SOURCES
from msg_adapters.reports import event_from_message

DEPTH = 100
"""Answers that may wait: Fast DDS brings those of all clients of a service to each of them."""
EVENTS_DEPTH = 5000
PATIENCE = 20.0
"""Wall time after which a client that has found no service is made anew, s: on a machine that is
far behind, Fast DDS now and then never brings the two together."""


class SimulatorClientError(RuntimeError):
    """The simulator has refused a request, or does not answer; the text is the reason."""


class SimulatorClient:
    """Talks to a simulator from a node of its own, in the calling thread.

    >>> with SimulatorClient() as simulator:
    ...     simulator.load("base_train", paused=True)
    ...     simulator.break_rail(car=20)
    ...     simulator.play()
    ...     outcome = simulator.wait_for_end()

    Parameters
    ----------
    simulator : name of its node, with the namespace; its topics are in that namespace
    timeout : wall time after which an answer is given up, s
    name : name of the client's node, and what the log of commands calls it

    Raises
    ------
    SimulatorClientError
        By each method, if the request is refused or not answered in time.
    """

    def __init__(
        self,
        simulator: str = "/simulator",
        *,
        timeout: float = 60.0,
        name: str = "simulator_client",
    ) -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.signals import SignalHandlerOptions

        from derail_msgs.msg import Outcome, TrainEvent
        from msg_adapters.topics import TOPICS, rclpy_qos

        self.simulator, self.timeout = f"/{simulator.strip('/')}", timeout
        self.run_id = ""
        self._name = name
        self._context = rclpy.Context()
        # The program's own handlers of signals stay.
        rclpy.init(context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        self.node = rclpy.create_node(name, context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        # Path of a service -> its client, and when it was made (wall time, s).
        self._clients: dict[str, tuple[Any, float]] = {}
        self._events: list[Any] = []
        self._outcomes: dict[str, Any] = {}
        namespace = self.simulator.rpartition("/")[0]
        for topic, kind, take, depth in (
            ("events", TrainEvent, self._events.append, EVENTS_DEPTH),
            ("outcome", Outcome, self._take_outcome, 10),
        ):
            qos = rclpy_qos(TOPICS[topic], depth)
            self.node.create_subscription(kind, f"{namespace}/{topic}", take, qos)

    def _take_outcome(self, message: Any) -> None:
        self._outcomes[message.run_id] = message

    # --- requests ----------------------------------------------------------------------------

    def load(
        self,
        scenario: str = "",
        *,
        yaml: str = "",
        speed_kmh: float = 0.0,
        paused: bool = False,
    ) -> str:
        """Load a scenario by its name or as YAML text; gives the ``run_id`` of its run."""
        answer = self._ask(
            "LoadConsist",
            scenario_name=scenario,
            scenario_yaml=yaml,
            speed_kmh=float(speed_kmh),
            start_paused=paused,
        )
        self.run_id = answer.run_id
        return self.run_id

    def break_rail(self, coordinate: float | None = None, *, car: int = 0) -> float:
        """Break the rail at a track coordinate (m) or ahead of a car; gives the coordinate."""
        if (coordinate is None) == (car == 0):
            raise SimulatorClientError("give either coordinate or car")
        place = 0.0 if coordinate is None else float(coordinate)
        answer = self._ask("InjectRailBreak", track_coordinate=place, car=car)
        return float(answer.track_coordinate)

    def brake(
        self,
        mode: str = "conventional",
        source: str = "front",
        *,
        car: int = 0,
        delay: float = 0.0,
    ) -> None:
        """Make an emergency application: ``status.BRAKE_MODES``, ``BRAKE_SOURCES``; delay in s."""
        for name, value, known in (("mode", mode, BRAKE_MODES), ("source", source, BRAKE_SOURCES)):
            if value not in known:
                raise SimulatorClientError(
                    f"{name} must be one of {', '.join(known)}, got {value}"
                )
        self._ask(
            "TriggerEmergencyBrake",
            mode=BRAKE_MODES.index(mode),
            source=BRAKE_SOURCES.index(source),
            car=car,
            delay_s=float(delay),
        )

    def step(self, ticks: int = 1) -> None:
        """Advance a paused run by ticks of 1/``state_rate``; returns when they are done."""
        self._ask("StepSimulation", "derail/step_simulation", ticks=ticks)

    def play(self) -> None:
        """Go on."""
        self._set_state(1)

    def pause(self) -> None:
        """Stand still."""
        self._set_state(2)

    def stop(self) -> None:
        """Go back to the start."""
        self._set_state(0)

    def _set_state(self, state: int) -> None:
        self._ask("SetSimulationState", "derail/set_simulation_state", state=state)

    def reset(self, *, time_to_zero: bool = False) -> str:
        """Begin the run again; gives its new ``run_id``."""
        mode = int(time_to_zero)
        self.run_id = self._ask("ResetSimulation", "derail/reset_simulation", mode=mode).run_id
        return self.run_id

    def _ask(self, kind: str, service: str = "", **fields: Any) -> Any:
        """Call a service of the simulator and wait for its answer."""
        from derail_msgs import srv
        from derail_ros.nodes.serving import snake

        path = f"{self.simulator}/{service or snake(kind)}"
        types = getattr(srv, kind)
        self.until(lambda: self._found(types, path), f"{path} is not there")
        future = self._clients[path][0].call_async(types.Request(caller=self._name, **fields))
        self.until(future.done, f"{path} does not answer")
        answer = future.result()
        if not answer.success:
            raise SimulatorClientError(f"{path}: {answer.message}")
        return answer

    def _found(self, types: Any, path: str) -> bool:
        """Whether the client of a service has found it."""
        from rclpy.qos import QoSProfile

        now = time.monotonic()
        if path not in self._clients:
            client = self.node.create_client(types, path, qos_profile=QoSProfile(depth=DEPTH))
            self._clients[path] = client, now
        client, made = self._clients[path]
        found = bool(client.service_is_ready())
        if not found and now > made + PATIENCE:
            self.node.destroy_client(self._clients.pop(path)[0])
        return found

    # --- what comes of it --------------------------------------------------------------------

    def until(self, done: Callable[[], Any], otherwise: str, timeout: float | None = None) -> None:
        """Take in messages until something is true; ``otherwise`` is the error if it is not."""
        seconds = self.timeout if timeout is None else timeout
        end = time.monotonic() + seconds
        while not done():
            if time.monotonic() > end:
                raise SimulatorClientError(f"{otherwise} (waited {seconds:g} s)")
            self._executor.spin_once(timeout_sec=0.05)

    @property
    def outcome(self) -> Any:
        """Last ``derail_msgs/Outcome`` of the run that came so far, None without one."""
        return self._outcomes.get(self.run_id)

    @property
    def events(self) -> list[Event]:
        """Events of the run that came so far, in their order."""
        mine = {m.sequence: m for m in self._events if m.run_id == self.run_id}
        return [event_from_message(mine[number]) for number in sorted(mine)]

    def wait_for_end(self, timeout: float = math.inf) -> Any:
        """Wait for the end of the run, at most so long (s); gives its ``derail_msgs/Outcome``."""
        self.until(
            lambda: self.outcome is not None and self.outcome.is_final,
            f"the run {self.run_id} has not ended",
            timeout,
        )
        return self.outcome

    # --- the end -----------------------------------------------------------------------------

    def close(self) -> None:
        """Leave the graph."""
        if self._context.ok():
            self._executor.shutdown()
            self.node.destroy_node()
            self._context.shutdown()

    def __enter__(self) -> SimulatorClient:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
