"""The node ``player``: plays a recording on a ROS 2 graph.

Its services have the names and fields of those of rosbag2's player.
"""

from __future__ import annotations

import time
from typing import Any

from derail_ros.nodes.clock_guard import CLOCK, GRACE, ClockGuard
from derail_ros.nodes.declaration import declare
from derail_ros.nodes.outputs import (
    FIRST_WAIT,
    Latecomers,
    ListenerWait,
    Outputs,
    TwinWatch,
    make_publisher,
)
from derail_ros.nodes.playback import RATES, Playback
from derail_ros.nodes.process import OK, Program, Stop
from derail_ros.nodes.serving import service_qos
from derail_ros.recording.channels import Channel
from derail_ros.recording.storage import BagError
from msg_adapters.common import NANOSECONDS
from msg_adapters.reports import clock
from msg_adapters.topics import EVERYWHERE, TOPICS, rclpy_qos

EXIT_WAIT = 2.0
"""Wall time for which the end waits until everything has arrived, s."""
LOOK_EVERY = 0.02
"""Wall time between two looks for listeners and at renewed publishers, s."""


def channel_qos(channel: Channel) -> Any:
    """Quality of service of a recorded topic; reliable where nothing is known."""
    from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

    profile = channel.qos[0] if channel.qos else None
    reliability = getattr(getattr(profile, "reliability", None), "name", "")
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=int(getattr(profile, "depth", 0) or 10),
        reliability=(
            ReliabilityPolicy.BEST_EFFORT
            if reliability == "BEST_EFFORT"
            else ReliabilityPolicy.RELIABLE
        ),
        durability=(
            DurabilityPolicy.TRANSIENT_LOCAL if channel.latched else DurabilityPolicy.VOLATILE
        ),
    )


class Player(Program):
    """Services, topics and the clock around a :class:`Playback`."""

    def __init__(self, node: Any) -> None:
        super().__init__(node)
        values: dict[str, Any] = declare(node, "player")
        if not values["path"]:
            raise ValueError("path must name a recording: -p path:=FOLDER")
        try:
            self.playback = playback = Playback(
                values["path"], topics=values["topics"], exclude=values["exclude"]
            )
        except BagError as error:
            raise ValueError(str(error)) from None
        for pattern in playback.unmatched:
            self.log.info(f"exclude: the recording has no topic {pattern}")
        self._offset = int(values["start_offset"] * NANOSECONDS)
        length = playback.end - playback.start
        if self._offset > length:
            raise ValueError(
                f"start_offset must be at most {length / NANOSECONDS:.2f} s, the length of the "
                f"recording, got {values['start_offset']:g}"
            )
        self.outputs = Outputs(node)
        self._topics = [c.topic for c in playback.channels if self._open(c)]
        playback.output = self.outputs
        playback.loop, playback.moved = values["loop"], self._publish_clock
        playback.set_rate(values["rate"])
        self._auto_exit = values["auto_exit"]
        self._guard = ClockGuard(
            node, self._open_clock, lambda: self.outputs.close(CLOCK), values["publish_clock"]
        )
        self._paused = values["start_paused"]
        self._listeners = ListenerWait(self._subscribers, values["await_listeners"], self.log)
        self._clock_period = 1.0 / values["clock_rate"]
        self._clock_due = 0.0
        watched = [c.topic for c in playback.channels if not (c.latched or c.topic in EVERYWHERE)]
        self._twins = TwinWatch(node, watched, self.log)
        self._late, self._look = Latecomers(), 0.0
        self._began = time.monotonic()
        self._playing = False
        self._offer_services()

    def _open(self, channel: Channel) -> bool:
        """Publish a topic of the recording, if its type is installed."""

        def make() -> Any:
            return make_publisher(self.node, channel.topic, channel.msgtype, channel_qos(channel))

        try:
            self.outputs.open(channel.topic, make, channel.latched)
        except (ImportError, AttributeError, ValueError):
            self.log.warning(f"{channel.topic} is left out: {channel.msgtype} is not installed")
            return False
        return True

    def _open_clock(self) -> None:
        topic = TOPICS[CLOCK]
        self.outputs.open(
            CLOCK, lambda: make_publisher(self.node, CLOCK, topic.msgtype, rclpy_qos(topic))
        )

    def _subscribers(self) -> int:
        """Subscribers of the state topic, or of the topic that has most of them."""
        counts = {topic: self.outputs.subscribers(topic) for topic in self._topics}
        states = [n for topic, n in counts.items() if topic.rpartition("/")[2] == "train_state"]
        return max(states or counts.values(), default=0)

    def start(self, stop: Stop) -> None:
        """Log what is played."""
        at, played = self.playback.base.time, self.playback
        first, last = (at(t) / NANOSECONDS for t in (played.start, played.end))
        self.log.info(
            f"{self.playback.bag.path}: {first:.2f} s to {last:.2f} s, {len(self._topics)} topics"
        )

    # --- the loop ----------------------------------------------------------------------------

    def work(self) -> float:
        """Do the work that is due; return the wall time of the next work."""
        self._guard.look()
        busy = self.outputs.pump()
        now = time.monotonic()
        if not self._playing and not self._begin(now):
            return now + LOOK_EVERY
        self._twins.look()
        due = min(self.playback.work(), self._work_clock())
        self._serve_late(now)
        return min(due, now + LOOK_EVERY) if busy else due

    def _serve_late(self, now: float) -> None:
        """While it is paused, send the present state to subscribers that have come since."""
        if now < self._look:
            return
        self._look = now + LOOK_EVERY
        counts = {topic: self.outputs.subscribers(topic) for topic in self._topics}
        if not self.playback.paused:
            self._late.reset(counts)
        elif due := self._late.due(counts, now):
            self.playback.show_again(due)

    def _work_clock(self) -> float:
        now = time.monotonic()
        if now >= self._clock_due:
            self._publish_clock()
            # What is missed by more than a period is left out.
            self._clock_due = max(self._clock_due + self._clock_period, now)
        return self._clock_due

    def _publish_clock(self) -> None:
        self.outputs.publish(CLOCK, clock(max(1, self.playback.clock)))

    def _begin(self, now: float) -> bool:
        """Begin once the graph has been looked at and the listeners are there."""
        if now < self._began + GRACE or not self._listeners.over():
            return False
        self._playing = True
        if self._offset or self._paused:
            self.playback.seek(self.playback.start + self._offset)
        if self._paused:
            self.playback.send_present()
        else:
            if self._listeners.came:
                self.playback.send_present()
                self.outputs.settle(FIRST_WAIT)
            self.playback.resume()
        self.log.info("paused" if self._paused else "playing")
        return True

    @property
    def exit_code(self) -> int | None:
        """Set when a client has stopped the player, or when everything has been played."""
        ended = self._playing and self.playback.finished and not self.playback.loop
        return OK if self.playback.stopped or (self._auto_exit and ended) else None

    def close(self) -> None:
        """Wait until everything has arrived, and close the recording."""
        self.outputs.settle(EXIT_WAIT)
        self.playback.close()

    # --- services ----------------------------------------------------------------------------

    def _offer_services(self) -> None:
        from derail_msgs import srv

        for name, kind, callback in (
            ("pause", srv.Pause, self._pause),
            ("resume", srv.Resume, self._resume),
            ("toggle_paused", srv.TogglePaused, self._toggle),
            ("is_paused", srv.IsPaused, self._is_paused),
            ("get_rate", srv.GetRate, self._get_rate),
            ("set_rate", srv.SetRate, self._set_rate),
            ("play_next", srv.PlayNext, self._play_next),
            ("burst", srv.Burst, self._burst),
            ("seek", srv.Seek, self._seek),
            ("stop", srv.Stop, self._stop),
        ):
            self.node.create_service(kind, f"~/{name}", callback, qos_profile=service_qos())

    @property
    def paused(self) -> bool:
        """Whether it is paused, or will be when it begins."""
        return self.playback.paused if self._playing else self._paused

    def _pause(self, request: Any, response: Any) -> Any:
        self._paused = True
        self.playback.pause()
        return response

    def _resume(self, request: Any, response: Any) -> Any:
        self._paused = False
        if self._playing:
            self.playback.resume()
        return response

    def _toggle(self, request: Any, response: Any) -> Any:
        return (self._resume if self.paused else self._pause)(request, response)

    def _is_paused(self, request: Any, response: Any) -> Any:
        response.paused = self.paused
        return response

    def _get_rate(self, request: Any, response: Any) -> Any:
        response.rate = float(self.playback.rate)
        return response

    def _set_rate(self, request: Any, response: Any) -> Any:
        response.success = self.playback.set_rate(request.rate)
        if not response.success:  # the type has no room for a reason
            low, high = RATES
            reason = f"rate must be {low:g} to {high:g}, got {request.rate:g}"
            self.log.warning(f"set_rate refused: {reason}")
        return response

    def _play_next(self, request: Any, response: Any) -> Any:
        response.success = self._playing and self.playback.play_next()
        return response

    def _burst(self, request: Any, response: Any) -> Any:
        number = int(request.num_messages)
        response.actually_burst = self.playback.burst(number) if self._playing else 0
        return response

    def _seek(self, request: Any, response: Any) -> Any:
        stamp = request.time.sec * NANOSECONDS + request.time.nanosec
        response.success = self._playing and self.playback.seek_time(stamp)
        if not response.success:
            at, played = self.playback.base.time, self.playback
            first, last = (at(t) / NANOSECONDS for t in (played.start, played.end))
            reason = f"time must be {first:.3f} to {last:.3f} s, got {stamp / NANOSECONDS:.3f}"
            if not self._playing:
                reason = "the player has not begun yet"
            self.log.warning(f"seek refused: {reason}")
        return response

    def _stop(self, request: Any, response: Any) -> Any:
        response.return_code = 1 if self.playback.stopped else 0
        response.error_string = "already stopped" if self.playback.stopped else ""
        self.playback.stopped = True
        return response
