"""The node ``simulator``: :class:`derail_ros.nodes.core.SimulatorCore` on a ROS 2 graph.

One thread does everything: a slice of computing, then a request if there is one. Requests are
thus served between steps, and no lock is needed. Only scenarios are read and built in a thread of
their own.
"""

from __future__ import annotations

import gc
import math
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from derail_ros import models
from derail_ros.nodes import loading
from derail_ros.nodes.clock_guard import CLOCK, ClockGuard
from derail_ros.nodes.commands import Answer
from derail_ros.nodes.core import NO_RUN, SimulatorCore, State
from derail_ros.nodes.declaration import check_change, declare
from derail_ros.nodes.loop import Loop
from derail_ros.nodes.outputs import (
    FIRST_WAIT,
    ListenerWait,
    Outputs,
    TwinWatch,
)
from derail_ros.nodes.parameters import Settings
from derail_ros.nodes.process import FAILED, OK, Program, Stop, starting
from derail_ros.nodes.serving import DeferredService, RequestWaiter, service_qos
from derail_ros.nodes.standard import StandardInterface
from derail_ros.recording.session import Prepared
from msg_adapters.common import NANOSECONDS
from msg_adapters.topics import (
    LIVE_TOPICS,
    ON_MAP,
    STATE_TOPICS,
    TOPICS,
    check_interfaces,
    rclpy_class,
)

EXIT_WAIT = 5.0
"""Wall time for which the end waits until everything has arrived, s."""
LOOK_EVERY = 0.02
"""Wall time between two looks at the graph, s."""
PUMP_EVERY = 0.005
"""Wall time between two looks at renewed publishers, s."""


def fill(response: Any, answer: Answer) -> Any:
    """Put an answer into the fields that every response of the simulator has."""
    response.success = answer.success
    response.message = answer.message
    response.applied_at.sec, response.applied_at.nanosec = divmod(answer.stamp, NANOSECONDS)
    response.step = answer.step
    return response


class Simulator(Program):
    """Services, parameters and topics around the core."""

    def __init__(self, node: Any) -> None:
        from rclpy.logging import get_logging_directory

        super().__init__(node)
        check_interfaces()
        self.settings = settings = Settings(
            **declare(node, "simulator"),
            namespace=node.get_namespace(),
            name=node.get_name(),
            state_dir=str(get_logging_directory()),
        )
        settings.check_frames()
        self.outputs = Outputs(node)
        for topic in (*TOPICS.values(), *LIVE_TOPICS.values()):
            transforms = topic.name.startswith("/tf")
            if topic not in (TOPICS[CLOCK], ON_MAP) and (settings.publish_tf or not transforms):
                self.outputs.offer(topic)
        self.core = SimulatorCore(settings, self.outputs, self.log, time.monotonic)
        self._loop = Loop(self.core, self.outputs, time.monotonic)
        self._guard = ClockGuard(
            node,
            lambda: self.outputs.offer(TOPICS[CLOCK]),
            lambda: self.outputs.close(CLOCK),
            settings.publish_clock,
        )
        self._woken = node.create_guard_condition(lambda: None)
        self._waiter = RequestWaiter(node, self._woken)
        self._pool = ThreadPoolExecutor(1, "scenario")
        self._loads: list[tuple[Future[Prepared], Callable[[Prepared | ValueError], None]]] = []
        self._first: Prepared | None = None
        self._listeners: ListenerWait | None = None
        self._from_parameter: Prepared | None = None
        self._events: list[Any] = []
        self._events_of = ""
        self._twins = TwinWatch(node, STATE_TOPICS, self.log)
        self._naming = False
        self._look = 0.0
        self._model = settings.model or models.names()[0]
        if self._model not in models.names():
            known = ", ".join(models.names())
            raise ValueError(f"model must be one of {known}, got {self._model!r}")
        if settings.scenario:
            # A mistake in the scenario is reported before kernels are compiled.
            scenario = loading.read(settings.scenario, "", settings.scenario_dirs, settings.model)
            self._model = scenario.model.model

    def start(self, stop: Stop) -> None:
        """Compile or load the kernels, make the first scenario ready, offer the services."""
        self.log.info(f"loading the model {self._model} (compiled once per version)")
        stop.during(lambda: loading.warm_up(self._model))
        with starting():
            if self.settings.scenario:
                self._first = self.core.prepare(self.settings.scenario, "")
        self._listeners = ListenerWait(
            lambda: min(self.outputs.subscribers(topic) for topic in STATE_TOPICS),
            self.settings.await_listeners,
            self.log,
        )
        self.node.add_on_set_parameters_callback(self._check_parameters)
        self.node.add_post_set_parameters_callback(self._apply_parameters)
        self._offer_services()
        # What is loaded stays: the collector need not walk through compiled kernels again.
        gc.collect()
        gc.freeze()
        self.log.info("ready")

    # --- the loop ----------------------------------------------------------------------------

    def work(self) -> float:
        """Do the work that is due; return the wall time of the next work."""
        now = time.monotonic()
        if now >= self._look:
            self._look = now + LOOK_EVERY
            self._guard.look()
            self.core.twins = self._twins.look()
            self._begin_first()
        while self._loads and self._loads[0][0].done():
            future, begin = self._loads.pop(0)
            error = future.exception()
            if error is not None and not isinstance(error, ValueError):
                raise error
            begin(future.result() if error is None else error)
        due = self._loop.work()
        if self._first is not None:
            due = min(due, time.monotonic() + LOOK_EVERY)
        if self.outputs.pump():
            due = min(due, time.monotonic() + PUMP_EVERY)
        return due

    def _begin_first(self) -> None:
        """Load the first scenario once its listeners are there."""
        if self._first is None or self._listeners is None or not self._listeners.over():
            return
        prepared, self._first = self._first, None
        if self.core.session is None:
            self._load_parameter(prepared, self.settings.scenario)
            if self._listeners.came:
                self.outputs.settle(FIRST_WAIT)
                self.core.pace.change()

    def _load_parameter(self, prepared: Prepared, name: str) -> None:
        request = {"scenario_name": name, "start_paused": self.settings.start_paused}
        self.core.load(prepared, request, "parameter scenario")

    def wait(self, executor: Any, due: float) -> None:
        """Serve requests until something is due (wall time, s)."""
        self._waiter.wait(executor, due)

    @property
    def exit_code(self) -> int | None:
        """Set when the simulation quits, or when the run has ended and nothing else is wanted."""
        core = self.core
        if core.state == State.QUITTING:
            return OK
        if self.settings.auto_exit and core.finished:
            return FAILED if core.failure else OK
        return None

    def close(self) -> None:
        """End the run, close the recording, wait until everything has arrived."""
        self._waiter.close()
        self.core.close()
        self.fault = self.core.recording.error
        self.outputs.settle(EXIT_WAIT)
        self._pool.shutdown(cancel_futures=True)

    # --- parameters --------------------------------------------------------------------------

    def _check_parameters(self, changes: list[Any]) -> Any:
        from rcl_interfaces.msg import SetParametersResult

        try:
            values = check_change(changes, "simulator")
            told = "scenario" in values and not self._naming
            if told and not values["scenario"] and self.settings.scenario:
                raise ValueError("scenario is what is loaded; ~/unload_world unloads it")
            if told and values["scenario"]:
                # Read it here, so that a refusal reaches the client.
                self._from_parameter = self.core.prepare(str(values["scenario"]), "")
        except ValueError as error:
            names = ", ".join(parameter.name for parameter in changes)
            self.log.warning(f"change of {names} refused: {error}")
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply_parameters(self, changes: list[Any]) -> None:
        values = check_change(changes, "simulator")
        self.settings.update(values)
        self.core.pace.change()
        prepared, self._from_parameter = self._from_parameter, None
        if values.get("scenario") and prepared is not None:
            self._load_parameter(prepared, self.settings.scenario)

    def _name_scenario(self, name: str) -> None:
        """Have the parameter ``scenario`` name what is loaded: a dump and a restart run it again.

        What came as text has no name: a restart then waits for a scenario.
        """
        from rclpy.parameter import Parameter

        self._naming = True
        self.node.set_parameters([Parameter("scenario", value=name)])
        self._naming = False

    # --- services ----------------------------------------------------------------------------

    def _offer_services(self) -> None:
        from derail_msgs import srv

        node = self.node
        self._deferred = [
            DeferredService(node, srv.LoadConsist, "~/load_consist", self._load_consist)
        ]
        legacy = self.settings.legacy_service_names
        for name, kind, callback in (
            ("inject_rail_break", srv.InjectRailBreak, self._inject_rail_break),
            ("trigger_emergency_brake", srv.TriggerEmergencyBrake, self._trigger_brake),
            ("get_events", srv.GetEvents, self._get_events),
            *(
                (f"{folder}{name}", kind, callback)
                for folder in ("derail/", *([""] if legacy else []))
                for name, kind, callback in (
                    ("set_simulation_state", srv.SetSimulationState, self._set_state),
                    ("step_simulation", srv.StepSimulation, self._step),
                    ("reset_simulation", srv.ResetSimulation, self._reset),
                )
            ),
        ):
            if kind is srv.StepSimulation:
                self._deferred.append(DeferredService(node, kind, f"~/{name}", callback))
            else:
                node.create_service(kind, f"~/{name}", callback, qos_profile=service_qos())
        try:
            self._standard = StandardInterface(
                node,
                self.core,
                self._prepare,
                lambda: bool(self._loads) or self._first is not None,
                self._name_scenario,
                namespace=self.settings.standard_namespace,
                legacy=legacy,
            )
        except ImportError as error:
            self.log.warning(f"no standard services: {error}")

    def _prepare(
        self, name: str, text: str, begin: Callable[[Prepared | ValueError], None], *speed: float
    ) -> None:
        """Make a scenario ready in a thread of its own; ``begin`` gets it in this one."""
        work = self._pool.submit(self.core.prepare, name, text, *speed)
        self._loads.append((work, begin))
        work.add_done_callback(lambda _: self._woken.trigger())

    def _load_consist(self, request: Any, response: Any, finish: Callable[[], None]) -> None:
        fields = {
            name: getattr(request, name)
            for name in ("scenario_name", "scenario_yaml", "speed_kmh", "start_paused")
        }

        def begin(prepared: Prepared | ValueError) -> None:
            answer = self.core.load(prepared, fields, request.caller)
            response.run_id = answer.run_id if answer.success else ""
            if answer.success:
                self._name_scenario(fields["scenario_name"])
            fill(response, answer)
            finish()

        self._prepare(request.scenario_name, request.scenario_yaml, begin, request.speed_kmh)

    def _inject_rail_break(self, request: Any, response: Any) -> Any:
        answer = self.core.inject_rail_break(request.track_coordinate, request.car, request.caller)
        response.track_coordinate = answer.value if answer.success else math.nan
        return fill(response, answer)

    def _trigger_brake(self, request: Any, response: Any) -> Any:
        answer = self.core.trigger_emergency_brake(
            request.mode, request.source, request.car, request.delay_s, request.caller
        )
        return fill(response, answer)

    def _set_state(self, request: Any, response: Any) -> Any:
        answer = self.core.set_state(request.state, request.caller)
        response.state = int(self.core.state)
        return fill(response, answer)

    def _step(self, request: Any, response: Any, finish: Callable[[], None]) -> None:
        def done(answer: Answer) -> None:
            fill(response, answer)
            finish()

        self.core.step_simulation(request.ticks, done, request.caller)

    def _reset(self, request: Any, response: Any) -> Any:
        answer = self.core.reset(request.mode, request.caller)
        response.run_id = answer.run_id if answer.success else ""
        return fill(response, answer)

    def _get_events(self, request: Any, response: Any) -> Any:
        """All events of the present run; those given out before are kept."""
        from rclpy.serialization import deserialize_message

        core, session = self.core, self.core.session
        if self._events_of != core.run_id:
            self._events, self._events_of = [], core.run_id
        if session is not None:
            kind = rclpy_class(TOPICS["events"].msgtype)
            for data in session.event_messages[len(self._events) :]:
                self._events.append(deserialize_message(data, kind))
        message = NO_RUN if session is None else f"{len(self._events)} events"
        response.events, response.run_id = self._events, core.run_id
        return fill(response, Answer(session is not None, message, core.stamp, core.step))
