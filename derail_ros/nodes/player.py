"""The node ``player``: plays a recording on a ROS 2 graph.

Its services have the names and fields of those of rosbag2's player.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Sequence
from typing import Any

from derail_ros.nodes import parameters as table
from derail_ros.nodes.playback import Playback
from derail_ros.nodes.process import StartError, Stop, run_node, service_qos, starting
from derail_ros.nodes.simulator import CLOCK_GRACE, ClockGuard
from derail_ros.recording.channels import Channel
from derail_ros.recording.storage import BagError
from msg_adapters.common import NANOSECONDS
from msg_adapters.reports import clock
from msg_adapters.topics import TOPICS, rclpy_class, rclpy_qos

LISTENERS_WAIT = 10.0
"""Wall time for which playback waits for listeners (parameter await_listeners), s."""
FIRST_WAIT = 5.0
"""Wall time for which playback waits until its first messages have arrived, s."""
EXIT_WAIT = 2.0
"""Wall time for which the end waits until everything has arrived, s."""


def channel_qos(channel: Channel) -> Any:
    """Quality of service of a topic: as it was recorded; reliable where nothing is known."""
    from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

    profile = channel.qos[0] if channel.qos else None
    name = getattr(getattr(profile, "durability", None), "name", "")
    reliable = getattr(getattr(profile, "reliability", None), "name", "") != "BEST_EFFORT"
    depth = int(getattr(profile, "depth", 0) or 10)
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=(
            DurabilityPolicy.TRANSIENT_LOCAL
            if name == "TRANSIENT_LOCAL"
            else DurabilityPolicy.VOLATILE
        ),
    )


class NodeOutput:
    """Publishers for the topics of a recording; messages go out as the bytes they are."""

    def __init__(self, node: Any, channels: Sequence[Channel]) -> None:
        self.node = node
        self.publishers: dict[str, Any] = {}
        self._channels: dict[str, Channel] = {}
        self._kinds: dict[str, Any] = {}
        self._retired: list[Any] = []
        self._clock: Any = None
        for channel in channels:
            try:
                self._kinds[channel.topic] = rclpy_class(channel.msgtype)
            except (ImportError, AttributeError, ValueError):
                node.get_logger().warning(
                    f"{channel.topic} is left out: {channel.msgtype} is not installed"
                )
                continue
            self._channels[channel.topic] = channel
            self.publishers[channel.topic] = self._publisher(channel)

    def _publisher(self, channel: Channel) -> Any:
        from rclpy.qos_overriding_options import QoSOverridingOptions

        return self.node.create_publisher(
            self._kinds[channel.topic],
            channel.topic,
            channel_qos(channel),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )

    def publish(self, topic: str, data: bytes) -> None:
        """Send a message."""
        publisher = self.publishers.get(topic)
        if publisher is not None:
            publisher.publish(data)

    def renew(self) -> None:
        """New publishers for the latched topics: who comes late gets nothing of the old ones."""
        for publisher in self._retired:
            self.node.destroy_publisher(publisher)
        self._retired = []
        for topic, channel in self._channels.items():
            if channel.latched:
                old = self.publishers[topic]
                expected = old.get_subscription_count()
                self.publishers[topic] = new = self._publisher(channel)
                self._retired.append(old)
                self._await(new, expected)

    @staticmethod
    def _await(publisher: Any, expected: int) -> None:
        """Wait, for a moment, until those who listened to the old one listen to the new one."""
        end = time.monotonic() + 0.5
        while publisher.get_subscription_count() < expected and time.monotonic() < end:
            time.sleep(0.005)

    def listeners(self) -> int:
        """Subscribers of the topic of states, or of that which has most of them."""
        counts = {t: p.get_subscription_count() for t, p in self.publishers.items()}
        states = [n for t, n in counts.items() if t.rpartition("/")[2] == "train_state"]
        return max(states or list(counts.values()) or [0])

    def others(self) -> list[str]:
        """Topics that another node publishes as well."""
        own = (self.node.get_name(), self.node.get_namespace())
        return [
            topic
            for topic in self.publishers
            if any(
                (info.node_name, info.node_namespace) != own
                for info in self.node.get_publishers_info_by_topic(topic)
            )
        ]

    # --- the clock, as ClockGuard wants it -----------------------------------------------------

    def open_clock(self) -> None:
        """Begin to publish the clock."""
        topic = TOPICS["/clock"]
        self._clock = self.node.create_publisher(
            rclpy_class(topic.msgtype), topic.name, rclpy_qos(topic)
        )

    def close_clock(self) -> None:
        """Stop publishing the clock."""
        if self._clock is not None:
            self.node.destroy_publisher(self._clock)
            self._clock = None

    def tick(self, stamp: int) -> None:
        """Publish the time (ns)."""
        if self._clock is not None:
            self._clock.publish(clock(stamp))

    def settle(self, seconds: float) -> None:
        """Wait until everything sent has arrived, for at most so long."""
        from rclpy.duration import Duration

        end = time.monotonic() + seconds
        for publisher in self.publishers.values():
            left = max(0.0, end - time.monotonic())
            publisher.wait_for_all_acked(Duration(nanoseconds=int(left * NANOSECONDS)))


def make_node_class() -> Any:
    """The node's class; made when it is needed, so that this module imports without ROS."""
    import rclpy.node

    from derail_msgs.srv import (
        Burst,
        GetRate,
        IsPaused,
        Pause,
        PlayNext,
        Resume,
        Seek,
        SetRate,
        Stop,
        TogglePaused,
    )

    class PlayerNode(rclpy.node.Node):  # type: ignore[misc]
        """Services, topics and the clock around a :class:`Playback`."""

        def __init__(self) -> None:
            super().__init__("player")
            values = table.declare(self, table.PLAYER)
            if not values["path"]:
                raise ValueError("path: name the recording, -p path:=FOLDER")
            self.playback = Playback(str(values["path"]))
            self.output = NodeOutput(self, self.playback.channels)
            self.playback.output = self.output
            self.playback.loop = bool(values["loop"])
            self.playback.set_rate(float(values["rate"]))  # type: ignore[arg-type]
            offset = int(float(values["start_offset"]) * NANOSECONDS)  # type: ignore[arg-type]
            if offset > self.playback.end - self.playback.start:
                length = (self.playback.end - self.playback.start) / NANOSECONDS
                raise ValueError(f"start_offset: the recording lasts {length:.2f} s")
            self._offset = offset
            self.auto_exit = bool(values["auto_exit"])
            self.guard = ClockGuard(self, self.output, bool(values["publish_clock"]))
            self._paused = bool(values["start_paused"])
            self._listeners = int(values["await_listeners"])  # type: ignore[call-overload]
            self._clock_interval = 1.0 / float(values["clock_rate"])  # type: ignore[arg-type]
            self._clock_due = 0.0
            self._look_at = 0.0
            self._began = time.monotonic()
            self.playing = False
            for name, kind, callback in (
                ("pause", Pause, self._pause),
                ("resume", Resume, self._resume),
                ("toggle_paused", TogglePaused, self._toggle),
                ("is_paused", IsPaused, self._is_paused),
                ("get_rate", GetRate, self._get_rate),
                ("set_rate", SetRate, self._set_rate),
                ("play_next", PlayNext, self._play_next),
                ("burst", Burst, self._burst),
                ("seek", Seek, self._seek),
                ("stop", Stop, self._stop),
            ):
                self.create_service(kind, f"~/{name}", callback, qos_profile=service_qos())

        # --- the loop ------------------------------------------------------------------------

        def work(self) -> float:
            """Do what is due; returns the wall time until which nothing is."""
            self.guard.look()
            now = time.monotonic()
            if not self.playing and not self._begin(now):
                return now + 0.02
            self._look_for_others(now)
            due = self.playback.work()
            if self.guard.publishing:
                now = time.monotonic()
                if now >= self._clock_due:
                    self.output.tick(self.playback.now)
                    late = now > self._clock_due + self._clock_interval
                    self._clock_due = (now if late else self._clock_due) + self._clock_interval
                due = min(due, self._clock_due)
            return due

        def _look_for_others(self, now: float) -> None:
            """Warn once, in the first seconds, if someone else publishes the same topics."""
            if now < self._look_at:
                return
            self._look_at = now + 0.5
            others = self.output.others()
            if others:
                self.get_logger().warning(
                    f"another node publishes {', '.join(others[:3])} as well: both will mix"
                )
            if others or now > self._began + LISTENERS_WAIT:
                self._look_at = math.inf

        def _begin(self, now: float) -> bool:
            """Begin when the graph has been looked at and those who want to listen do."""
            waited = now - self._began
            if waited < CLOCK_GRACE:
                return False
            missing = self.output.listeners() < self._listeners
            if missing and waited < LISTENERS_WAIT:
                return False
            if missing:
                self.get_logger().warning("await_listeners: they did not come")
            self.playing = True
            if self._offset:
                self.playback.seek(self.playback.start + self._offset)
            elif self._paused:
                self.playback.seek(self.playback.start)
            if not self._paused:
                if self._listeners and not missing:
                    # Matched here, a subscriber may not have matched there yet: its first
                    # messages come again until it has, but only as many as the depth.
                    self.playback.send_present()
                    self.output.settle(FIRST_WAIT)
                self.playback.resume()
            self.get_logger().info("paused" if self._paused else "playing")
            return True

        @property
        def done(self) -> bool:
            """Whether the node shall end."""
            ended = self.playing and self.playback.finished and not self.playback.loop
            return self.playback.stopped or (self.auto_exit and ended)

        def close(self) -> None:
            """Wait until all has arrived, and close the recording."""
            self.output.settle(EXIT_WAIT)
            self.playback.close()
            self.destroy_node()

        # --- services ------------------------------------------------------------------------

        def _pause(self, request: Any, response: Any) -> Any:
            self._paused = True
            self.playback.pause()
            return response

        def _resume(self, request: Any, response: Any) -> Any:
            self._paused = False
            if self.playing:
                self.playback.resume()
            return response

        def _toggle(self, request: Any, response: Any) -> Any:
            paused = self.playback.paused if self.playing else self._paused
            return (self._resume if paused else self._pause)(request, response)

        def _is_paused(self, request: Any, response: Any) -> Any:
            response.paused = self.playback.paused if self.playing else self._paused
            return response

        def _get_rate(self, request: Any, response: Any) -> Any:
            response.rate = float(self.playback.rate)
            return response

        def _set_rate(self, request: Any, response: Any) -> Any:
            response.success = self.playback.set_rate(request.rate)
            return response

        def _play_next(self, request: Any, response: Any) -> Any:
            response.success = self.playing and self.playback.play_next()
            return response

        def _burst(self, request: Any, response: Any) -> Any:
            response.actually_burst = (
                self.playback.burst(int(request.num_messages)) if self.playing else 0
            )
            return response

        def _seek(self, request: Any, response: Any) -> Any:
            stamp = request.time.sec * NANOSECONDS + request.time.nanosec
            response.success = self.playing and self.playback.seek(stamp)
            if response.success:
                self.output.tick(self.playback.now)
            return response

        def _stop(self, request: Any, response: Any) -> Any:
            response.return_code = 1 if self.playback.stopped else 0
            response.error_string = "stopped already" if self.playback.stopped else ""
            self.playback.stopped = True
            return response

    return PlayerNode


def _run(stop: Stop, arguments: Sequence[str]) -> int:
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.signals import SignalHandlerOptions

    with starting():
        rclpy.init(args=list(arguments), signal_handler_options=SignalHandlerOptions.NO)
        executor = SingleThreadedExecutor()
        try:
            node = make_node_class()()
        except BagError as error:
            raise StartError(str(error)) from None
    executor.add_node(node)
    playback = node.playback
    node.get_logger().info(
        f"{playback.bag.path}: {playback.start / NANOSECONDS:.2f} s to"
        f" {playback.end / NANOSECONDS:.2f} s, {len(node.output.publishers)} topics"
    )
    try:
        while not stop.asked and not node.done:
            due = node.work()
            executor.spin_once(timeout_sec=max(0.0, due - time.monotonic()))
        # Answers that are ready still go out.
        for _ in range(3):
            executor.spin_once(timeout_sec=0.0)
    finally:
        node.close()
        executor.shutdown()
    return 0


def usage() -> str:
    """Help on the command line."""
    return table.usage("player", "--ros-args -p path:=FOLDER [-p NAME:=VALUE ...]", table.PLAYER)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node until it is told to end; returns the exit code."""
    return run_node(_run, argv, usage)


if __name__ == "__main__":
    sys.exit(main())
