"""The node ``simulator``: :class:`derail_ros.nodes.core.SimulatorCore` on a ROS 2 graph.

One thread does everything: a slice of physics, then a request if there is one. Requests are thus
served between steps, and no lock is needed. Only scenarios are read and built in a thread of
their own.
"""

from __future__ import annotations

import concurrent.futures
import gc
import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from derail_ros.nodes import parameters as table
from derail_ros.nodes.core import Answer, Level, Settings, SimulatorCore
from derail_ros.nodes.process import Stop, run_node, service_qos, starting
from derail_ros.recording.session import Prepared, prepare
from msg_adapters.common import NANOSECONDS
from msg_adapters.topics import (
    STATE_TOPICS,
    TOPICS,
    TRANSFORMS,
    Topic,
    check_interfaces,
    rclpy_class,
    rclpy_qos,
)

CLOCK_GRACE = 0.6
"""Wall time in which another publisher of the clock may show itself, s."""
CLOCK_PATIENCE = 3.0
"""How long a young publisher of /clock waits for another young one to give way, s."""
CLOCK_PROBATION = 30.0
"""Wall time in which one of two that began together gives way, s."""
PER_RUN = tuple(topic.name for topic in TOPICS.values() if topic.latched)
"""Topics that begin anew with each run: with one publisher for all runs the last outcome of a run
that a command ends (depth 1) would be overwritten by the first one of the next run before a
subscriber that is held up has got it, and so would train and track."""
MATCH_WAIT = 1.0
"""Wall time for which a new run's first events wait for their subscribers, s."""
RETIRE_WAIT = 8.0
"""Wall time for which the publisher of an old run waits until everything has arrived, s. What was
dropped on the way is sent again with the next heartbeat, every 3 s."""
RETIRED_MOST = 8
"""Publishers of old runs that a topic keeps at most, for subscribers that never answer."""
LISTENERS_WAIT = 10.0
"""Wall time for which the first run waits for listeners (parameter await_listeners), s."""
QUIET = 0.015
"""Wall time for which the loop does not look for requests after it has waited for one in vain,
unless it has nothing else to do, s."""
SERVE = 0.004
"""Wall time for which requests are served before the run goes on, s."""
ROUND = 1.0
"""Wall time between two rounds of the executor in which nothing has come, s."""
FIRST_WAIT = 5.0
"""Wall time for which the first run waits until its first messages have arrived, s."""
EXIT_WAIT = 5.0
"""Wall time for which the end waits until everything has arrived, s."""


@dataclass
class _Retired:
    """The publisher of an old run, and who has to get what it sent."""

    publisher: Any
    expected: int
    until: float


@dataclass
class _Channel:
    """A publisher; and, of a topic that begins anew with each run, those before it."""

    topic: Topic
    publisher: Any
    retired: list[_Retired] = field(default_factory=list)
    waiting: list[bytes] = field(default_factory=list)
    expected: int = 0
    until: float = 0.0


class NodeOutput:
    """Publishes the core's messages; they come serialised, as they go into a recording."""

    def __init__(self, node: Any) -> None:
        self.node = node
        self.channels = {
            name: _Channel(topic, self._publisher(topic))
            for name, topic in TOPICS.items()
            if name != "/clock"
        }

    def _publisher(self, topic: Topic) -> Any:
        from rclpy.event_handler import PublisherEventCallbacks
        from rclpy.qos_overriding_options import QoSOverridingOptions

        # Without handlers that tell of QoS which does not match: the executor looks at each of
        # them in each round, half of its cost. Subscribers are told on their side.
        return self.node.create_publisher(
            rclpy_class(topic.msgtype),
            topic.name,
            rclpy_qos(topic),
            event_callbacks=PublisherEventCallbacks(use_default_callbacks=False),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )

    def open_clock(self) -> None:
        """Begin to publish the clock."""
        self.channels["/clock"] = _Channel(TOPICS["/clock"], self._publisher(TOPICS["/clock"]))

    def open_transforms(self) -> None:
        """Publish the frames of the cars.

        Raises
        ------
        ValueError
            If tf2_msgs is not installed.
        """
        try:
            publisher = self._publisher(TRANSFORMS)
        except ImportError as error:
            raise ValueError(f"publish_tf: {error}") from error
        self.channels[TRANSFORMS.name] = _Channel(TRANSFORMS, publisher)

    def close_clock(self) -> None:
        """Stop publishing the clock."""
        channel = self.channels.pop("/clock", None)
        if channel is not None:
            self.node.destroy_publisher(channel.publisher)

    def publish(self, topic: str, data: bytes) -> None:
        """Send a message."""
        channel = self.channels.get(topic)
        if channel is None:
            return
        if channel.waiting or channel.until:
            channel.waiting.append(data)
            self._release(channel)
        else:
            channel.publisher.publish(data)

    def begin_run(self) -> None:
        """Begin the topics of a run anew: who comes late gets those of the present run only.

        The new publisher waits until it has matched as many subscribers as the old one had.
        """
        for name in PER_RUN:
            channel = self.channels[name]
            now = time.monotonic()
            old = channel.publisher
            for data in channel.waiting:
                old.publish(data)
            channel.waiting.clear()
            # One that began a moment ago may not have matched all of them yet.
            count = old.get_subscription_count()
            channel.expected = max(count, channel.expected) if channel.until else count
            channel.publisher = self._publisher(channel.topic)
            channel.until = now + MATCH_WAIT
            channel.retired.append(_Retired(old, channel.expected, now + RETIRE_WAIT))
            while len(channel.retired) > RETIRED_MOST:
                self.node.destroy_publisher(channel.retired.pop(0).publisher)

    def listeners(self, topics: Sequence[str]) -> int:
        """Number of subscribers that each of the topics has at least."""
        return min(self.channels[t].publisher.get_subscription_count() for t in topics)

    def pump(self) -> bool:
        """Release what waits; whether anything still does."""
        busy = False
        for channel in self.channels.values():
            if channel.until:
                self._release(channel)
            if channel.retired:
                channel.retired = [each for each in channel.retired if not self._retire(each)]
            busy = busy or bool(channel.until) or bool(channel.retired)
        return busy

    def _release(self, channel: _Channel) -> None:
        matched = channel.publisher.get_subscription_count() >= channel.expected
        if matched or time.monotonic() >= channel.until:
            channel.until = 0.0
            for data in channel.waiting:
                channel.publisher.publish(data)
            channel.waiting.clear()

    def _retire(self, retired: _Retired) -> bool:
        """Destroy the publisher of an old run once everything has arrived."""
        publisher = retired.publisher
        arrived = publisher.get_subscription_count() >= retired.expected and _acknowledged(
            publisher, 0.0
        )
        if not arrived and time.monotonic() < retired.until:
            return False
        self.node.destroy_publisher(publisher)
        return True

    def settle(self, seconds: float) -> None:
        """Wait until everything sent has arrived, for at most so long."""
        end = time.monotonic() + seconds
        while self.pump() and time.monotonic() < end:
            time.sleep(0.01)
        for channel in self.channels.values():
            if channel.topic.name not in ("/clock", "/diagnostics", "markers"):
                _acknowledged(channel.publisher, max(0.0, end - time.monotonic()))

    def log(self, level: Level, text: str) -> None:
        """Tell the user."""
        # One call a level: rclpy ties a level to the place of the call.
        if level == Level.OK:
            self.node.get_logger().info(text)
        elif level == Level.WARN:
            self.node.get_logger().warning(text)
        else:
            self.node.get_logger().error(text)


def _acknowledged(publisher: Any, seconds: float) -> bool:
    """Whether all subscribers have got everything, waiting at most so long."""
    from rclpy.duration import Duration

    return bool(publisher.wait_for_all_acked(Duration(nanoseconds=int(seconds * NANOSECONDS))))


class LaterService:
    """A service whose answer may be given after its callback has returned.

    A coroutine would do the same in ``rclpy``, but its executor polls coroutines, and while one
    waits it serves nothing else.
    """

    def __init__(
        self,
        node: Any,
        kind: Any,
        name: str,
        callback: Callable[[Any, Any, Callable[[], None]], None],
    ) -> None:
        self._callback = callback
        self._service = node.create_service(kind, name, self._call, qos_profile=service_qos())
        self._send = self._service.send_response
        self._service.send_response = self._returned
        self._headers: dict[int, Any] = {}
        self._finished: set[int] = set()

    def _call(self, request: Any, response: Any) -> Any:
        def finish() -> None:
            header = self._headers.pop(id(response), None)
            if header is None:
                self._finished.add(id(response))
            else:
                self._send(response, header)

        self._callback(request, response, finish)
        return response

    def _returned(self, response: Any, header: Any) -> None:
        if id(response) in self._finished:
            self._finished.discard(id(response))
            self._send(response, header)
        else:
            self._headers[id(response)] = header


class ClockGuard:
    """Decides whether this node may publish ``/clock``: never as the second one.

    It takes over when the other one is gone: that of a node that was killed is announced for as
    long as the middleware takes to notice, some 20 s.
    """

    def __init__(self, node: Any, output: Any, wanted: bool) -> None:
        self.node = node
        self.output = output
        self.publishing = False
        self.wanted = wanted
        self.yielded = False
        self.warned = False
        self.beside: float | None = None
        self.began = time.monotonic()
        self.looked = self.began
        self.taken = self.began

    def look(self) -> None:
        """Look around, a few times a second while it matters."""
        now = time.monotonic()
        young = now < self.began + CLOCK_PROBATION
        if not self.wanted or now < self.looked + (0.1 if young else 1.0):
            return
        self.looked = now
        others = self.node.count_publishers("/clock") - int(self.publishing)
        if others == 0 or not self.publishing:
            self.beside = None
        elif self.beside is None:
            self.beside = now
        if others > 0 and (not self.publishing or (young and self._gives_way())):
            self._yield(now)
        elif others > 0 and not young and not self.warned:
            self.warned = True
            self.node.get_logger().warning("another node has begun to publish /clock as well")
        elif not self.publishing and now > self.taken + CLOCK_GRACE:
            self.output.open_clock()
            self.publishing = True
            if self.yielded:
                self.node.get_logger().info("the other node is gone: publishing /clock")
                # As at the start: another one may have seen that at the same time.
                self.began, self.yielded = now, False

    def _yield(self, now: float) -> None:
        self.taken = now
        self.output.close_clock()
        self.publishing = False
        if not self.yielded:
            self.yielded = True
            self.node.get_logger().warning(
                "another node publishes /clock: this one does not (parameter publish_clock)"
            )

    def _gives_way(self) -> bool:
        """Of two that began at the same time the one with the larger identity gives way.

        One that has not done so after a while began long before: it stays, whatever its identity.
        """
        if self.beside is not None and time.monotonic() > self.beside + CLOCK_PATIENCE:
            return True
        mine, others = [], []
        for info in self.node.get_publishers_info_by_topic("/clock"):
            own = (info.node_name, info.node_namespace) == (
                self.node.get_name(),
                self.node.get_namespace(),
            )
            (mine if own else others).append(bytes(info.endpoint_gid))
        return bool(mine and others) and min(mine) > min(others)


def make_node_class() -> Any:
    """The node's class; made when it is needed, so that this module imports without ROS."""
    import rclpy.node
    from rcl_interfaces.msg import SetParametersResult
    from rclpy.logging import get_logging_directory

    from derail_msgs.srv import (
        GetEvents,
        InjectRailBreak,
        LoadConsist,
        ResetSimulation,
        SetSimulationState,
        StepSimulation,
        TriggerEmergencyBrake,
    )

    class SimulatorNode(rclpy.node.Node):  # type: ignore[misc]
        """Services, parameters and topics around the core."""

        def __init__(self) -> None:
            super().__init__("simulator")
            self.woken = self.create_guard_condition(lambda: None)
            values = table.declare(self, table.SIMULATOR)
            self.auto_exit = bool(values["auto_exit"])
            self.output = NodeOutput(self)
            if values["publish_tf"]:
                self.output.open_transforms()
            self.core = SimulatorCore(self._settings(values), self.output)
            self.guard = ClockGuard(self, self.output, bool(values["publish_clock"]))
            self._pool = concurrent.futures.ThreadPoolExecutor(1, "scenario")
            self._loads: list[tuple[concurrent.futures.Future[Prepared], Any]] = []
            self._prepared: Prepared | None = None
            self._events: list[Any] = []
            self._events_of = ""
            self._first: Callable[[], None] | None = None
            self._first_at = math.inf
            self._listeners = int(values["await_listeners"])
            self._start_paused = bool(values["start_paused"])
            self._scenario = None
            if values["scenario"]:
                # A mistake in here is told before the kernels are compiled.
                self._scenario = self.core.read(str(values["scenario"]), "")

        def serve(self) -> None:
            """Offer the services and get the first scenario ready; the kernels are compiled."""
            if self._scenario is not None:
                self._prepare_first(self._scenario)
            self.add_on_set_parameters_callback(self._check_parameters)
            self.add_post_set_parameters_callback(self._apply_parameters)
            self._later = [
                LaterService(self, LoadConsist, "~/load_consist", self._load_consist),
                LaterService(self, StepSimulation, "~/step_simulation", self._step),
            ]
            for name, kind, callback in (
                ("inject_rail_break", InjectRailBreak, self._inject_rail_break),
                ("trigger_emergency_brake", TriggerEmergencyBrake, self._trigger_brake),
                ("set_simulation_state", SetSimulationState, self._set_state),
                ("reset_simulation", ResetSimulation, self._reset),
                ("get_events", GetEvents, self._get_events),
            ):
                self.create_service(kind, f"~/{name}", callback, qos_profile=service_qos())

        def _settings(self, values: dict[str, Any]) -> Settings:
            return Settings(
                scenario_dirs=tuple(values["scenario_dirs"]),
                speed_factor=values["speed_factor"],
                state_rate=values["state_rate"],
                marker_rate=values["marker_rate"],
                publish_clock=values["publish_clock"],
                publish_tf=values["publish_tf"],
                clock_rate=values["clock_rate"],
                allow_quit=values["allow_quit"],
                frame_id=values["frame_id"],
                record=values["record"],
                record_storage=values["record_storage"],
                namespace=self.get_namespace(),
                name=self.get_name(),
                state_dir=str(get_logging_directory()),
            )

        def _prepare_first(self, scenario: Any) -> None:
            prepared = prepare(scenario)
            request = {"scenario_name": scenario.name, "start_paused": self._start_paused}

            def load() -> None:
                if self.core.session is None:
                    self.core.load(
                        prepared,
                        request,
                        start_paused=self._start_paused,
                        caller="parameter scenario",
                    )

            self._first = load
            self._first_at = time.monotonic() + LISTENERS_WAIT

        def _begin_first(self) -> None:
            """Load the first scenario when those who want to hear it do."""
            if self._first is None:
                return
            missing = self.output.listeners(STATE_TOPICS) < self._listeners
            if missing and time.monotonic() < self._first_at:
                return
            if missing:
                self.get_logger().warning("await_listeners: they did not come")
            load, self._first = self._first, None
            load()
            if self._listeners and not missing:
                # Matched here, a subscriber may not have matched there yet: its first messages
                # come again until it has, but only as many as the depth. So the run waits.
                self.output.settle(FIRST_WAIT)
                self.core.pace_changed()

        # --- the loop ------------------------------------------------------------------------

        def work(self) -> float:
            """Do what is due; returns the wall time until which nothing is."""
            self.guard.look()
            self._begin_first()
            while self._loads and self._loads[0][0].done():
                work, begin = self._loads.pop(0)
                error = work.exception()
                if error is not None and not isinstance(error, ValueError):
                    raise error
                begin(work.result() if error is None else error)
            due = self.core.work()
            if self._first is not None:
                due = min(due, time.monotonic() + 0.02)
            if self.output.pump():
                due = min(due, time.monotonic() + 0.005)
            return due

        def close(self) -> None:
            """End the run, close the recording, wait until all has arrived."""
            self.core.close()
            self.output.settle(EXIT_WAIT)
            self._pool.shutdown(cancel_futures=True)
            self.destroy_node()

        # --- parameters ----------------------------------------------------------------------

        def _check_parameters(self, changes: list[Any]) -> Any:
            try:
                values = table.check_change(changes, table.SIMULATOR)
                if values.get("scenario"):
                    # Read once here, so that a refusal reaches whoever sets it.
                    self._prepared = self.core.prepare(str(values["scenario"]), "")
            except ValueError as error:
                return SetParametersResult(successful=False, reason=str(error))
            return SetParametersResult(successful=True)

        def _apply_parameters(self, changes: list[Any]) -> None:
            values = table.check_change(changes, table.SIMULATOR)
            settings = self.core.settings
            for name in ("speed_factor", "state_rate", "marker_rate", "clock_rate", "allow_quit"):
                if name in values:
                    setattr(settings, name, values[name])
            self.auto_exit = bool(values.get("auto_exit", self.auto_exit))
            self.core.pace_changed()
            if values.get("scenario") and self._prepared is not None:
                paused = bool(self.get_parameter("start_paused").value)
                request = {"scenario_name": values["scenario"], "start_paused": paused}
                prepared, self._prepared = self._prepared, None
                self.core.load(prepared, request, start_paused=paused, caller="parameter scenario")

        # --- services ------------------------------------------------------------------------

        @staticmethod
        def _fill(response: Any, answer: Answer) -> Any:
            response.success = answer.success
            response.message = answer.message
            seconds, rest = divmod(answer.stamp, NANOSECONDS)
            response.applied_at.sec, response.applied_at.nanosec = seconds, rest
            response.step = answer.step
            return response

        def _load_consist(self, request: Any, response: Any, finish: Callable[[], None]) -> None:
            asked = {
                "scenario_name": request.scenario_name,
                "scenario_yaml": request.scenario_yaml,
                "speed_kmh": request.speed_kmh,
                "start_paused": request.start_paused,
            }

            def begin(prepared: Prepared | ValueError) -> None:
                answer = self.core.load(
                    prepared, asked, start_paused=request.start_paused, caller=request.caller
                )
                response.run_id = answer.run_id if answer.success else ""
                self._fill(response, answer)
                finish()

            work = self._pool.submit(
                self.core.prepare, request.scenario_name, request.scenario_yaml, request.speed_kmh
            )
            self._loads.append((work, begin))
            work.add_done_callback(lambda _: self.woken.trigger())

        def _inject_rail_break(self, request: Any, response: Any) -> Any:
            answer = self.core.inject_rail_break(
                request.track_coordinate, request.car, request.caller
            )
            response.track_coordinate = answer.value if answer.success else math.nan
            return self._fill(response, answer)

        def _trigger_brake(self, request: Any, response: Any) -> Any:
            answer = self.core.trigger_emergency_brake(
                request.mode, request.source, request.car, request.delay_s, request.caller
            )
            return self._fill(response, answer)

        def _set_state(self, request: Any, response: Any) -> Any:
            answer = self.core.set_state(request.state, request.caller)
            response.state = int(self.core.state)
            return self._fill(response, answer)

        def _step(self, request: Any, response: Any, finish: Callable[[], None]) -> None:
            def done(answer: Answer) -> None:
                self._fill(response, answer)
                finish()

            self.core.step_simulation(request.ticks, done, request.caller)

        def _reset(self, request: Any, response: Any) -> Any:
            answer = self.core.reset(request.mode, request.caller)
            response.run_id = answer.run_id if answer.success else ""
            return self._fill(response, answer)

        def _get_events(self, request: Any, response: Any) -> Any:
            from rclpy.serialization import deserialize_message

            core = self.core
            session = core.session
            seconds, rest = divmod(core.stamp, NANOSECONDS)
            response.applied_at.sec, response.applied_at.nanosec = seconds, rest
            response.step = core.step
            response.run_id = core.run_id
            if session is None:
                response.message = "no run is loaded"
                return response
            if self._events_of != core.run_id:
                self._events, self._events_of = [], core.run_id
            kind = rclpy_class("derail_msgs/msg/TrainEvent")
            for data in session.event_messages[len(self._events) :]:
                self._events.append(deserialize_message(data, kind))
            response.success = True
            response.message = f"{len(self._events)} events"
            response.events = self._events
            return response

    return SimulatorNode


class Requests:
    """Waits for requests, and has the executor serve them.

    A round of rclpy's executor takes as long as publishing a whole tick: it collects all entities
    and makes a wait set of them. Here the wait set is made once, and the executor comes only when
    there is something to serve, and once a second for whatever else there may be. The node's guard
    condition ``woken`` ends the waiting, from any thread.
    """

    def __init__(self, node: Any, executor: Any) -> None:
        self._node = node
        self._executor = executor
        self._quiet = 0.0
        self._round = 0.0
        self._collect()

    def _collect(self) -> None:
        """Make the wait set."""
        from rclpy.impl.implementation_singleton import rclpy_implementation

        node = self._node
        self._services = [service.handle for service in node.services]
        self._subscriptions = [subscription.handle for subscription in node.subscriptions]
        counts = (len(self._subscriptions), 1, 0, 0, len(self._services), 0)
        self._set = rclpy_implementation.WaitSet(*counts, node.context.handle)

    def wait(self, due: float) -> None:
        """Serve what comes until something is due (wall time, s)."""
        now = time.monotonic()
        if now < due <= self._quiet:
            time.sleep(due - now)
        elif self._ready(max(0.0, due - now)):
            self._serve(self._ready)
        elif now >= self._round:
            self._serve(lambda: False)
            self._round = now + ROUND
        elif due > now:
            self._quiet = time.monotonic() + QUIET

    def _serve(self, more: Callable[[], bool]) -> None:
        end = time.monotonic() + SERVE
        while True:
            self._executor.spin_once(timeout_sec=0.0)
            # What the node has may have changed: the parameter use_sim_time brings a subscription.
            self._collect()
            if time.monotonic() >= end or not more():
                break

    def _ready(self, seconds: float = 0.0) -> bool:
        """Whether there is a request or a message, waiting at most so long."""
        ready = self._set
        ready.clear_entities()
        for handle in self._services:
            ready.add_service(handle)
        for handle in self._subscriptions:
            ready.add_subscription(handle)
        ready.add_guard_condition(self._node.woken.handle)
        ready.wait(int(seconds * NANOSECONDS))
        return bool(
            ready.get_ready_entities("service") or ready.get_ready_entities("subscription")
        )


def _run(stop: Stop, arguments: Sequence[str]) -> int:
    def warm_up() -> None:
        from derail_ros import models

        models.engine().warm_up()

    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.signals import SignalHandlerOptions

    with starting():
        rclpy.init(args=list(arguments), signal_handler_options=SignalHandlerOptions.NO)
        check_interfaces()
        executor = SingleThreadedExecutor()
        node = make_node_class()()
    executor.add_node(node)
    requests = Requests(node, executor)
    code = 0
    try:
        node.get_logger().info("loading the kernels (they are compiled once a version)")
        stop.during(warm_up)
        with starting():
            node.serve()
        # What is loaded stays: the collector need not walk through compiled kernels again.
        gc.collect()
        gc.freeze()
        node.get_logger().info("ready")
        while not stop.asked:
            due = node.work()
            core = node.core
            if core.state.name == "QUITTING":
                break
            if node.auto_exit and core.finished:
                code = 1 if core.session.failure else 0
                break
            requests.wait(due)
        # Answers that are ready still go out.
        for _ in range(3):
            executor.spin_once(timeout_sec=0.0)
    finally:
        node.close()
        executor.shutdown()
    return code


def usage() -> str:
    """Help on the command line."""
    return table.usage(
        "simulator", "[--ros-args -p NAME:=VALUE ... --params-file FILE]", table.SIMULATOR
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node until it is told to end; returns the exit code."""
    return run_node(_run, argv, usage)


if __name__ == "__main__":
    sys.exit(main())
