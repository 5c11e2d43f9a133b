"""Publishers of a node. Messages are bytes; latched topics can get a new publisher."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from msg_adapters.common import NANOSECONDS
from msg_adapters.topics import Topic, rclpy_class, rclpy_qos

MATCH_WAIT = 1.0
"""Wall time for which the first messages of a renewed topic wait for its subscribers, s."""
RETIRE_WAIT = 8.0
"""Wall time for which a replaced publisher waits until everything has arrived, s. What was lost on
the way is sent again with the next heartbeat, every 3 s."""
RETIRED_MOST = 8
"""Replaced publishers that a topic keeps at most, for subscribers that never answer."""
LISTENERS_WAIT = 10.0
"""Wall time for which a node waits for listeners (parameter await_listeners), s."""
FIRST_WAIT = 5.0
"""Wall time for which it then waits until its first messages have arrived, s."""
TWINS_EVERY = 1.0
"""Wall time between two looks for other publishers of the same topics, s."""
PRESENT = (0.0, 1.0, 3.0, 8.0)
"""Wall times after which a new subscriber gets the present state, s."""
NOT_AWAITED = ("clock", "diagnostics", "markers")
"""Topics whose last message nobody needs: the end does not wait for them."""


class Output(Protocol):
    """Where messages go; :class:`Outputs` on a graph."""

    def publish(self, name: str, data: bytes) -> None:
        """Send a message."""

    def renew(self) -> None:
        """Forget the latched messages: late subscribers get nothing older than this."""

    def subscribers(self, name: str) -> int:
        """Number of matched subscribers of a topic; 0 if it is not open."""

    def wanted(self, name: str) -> bool:
        """Whether anybody listens to a topic."""

    def offer(self, topic: Topic) -> bool:
        """Publish a topic, unless it is published already; whether its type is installed."""


def make_publisher(node: Any, name: str, msgtype: str, qos: Any) -> Any:
    """A publisher whose QoS can be overridden by parameters."""
    from rclpy.event_handler import PublisherEventCallbacks
    from rclpy.qos_overriding_options import QoSOverridingOptions

    # Without the handlers of incompatible QoS: the executor looks at each of them in each round,
    # which is half of its cost. Subscribers are told on their side.
    return node.create_publisher(
        rclpy_class(msgtype),
        name,
        qos,
        event_callbacks=PublisherEventCallbacks(use_default_callbacks=False),
        qos_overriding_options=QoSOverridingOptions.with_default_policies(),
    )


def acknowledged(publisher: Any, seconds: float) -> bool:
    """Whether all subscribers have everything, after waiting for at most this long."""
    from rclpy.duration import Duration

    return bool(publisher.wait_for_all_acked(Duration(nanoseconds=int(seconds * NANOSECONDS))))


@dataclass
class _Retired:
    """A replaced publisher, and the number of subscribers that have to get what it sent."""

    publisher: Any
    expected: int
    until: float


@dataclass
class _Channel:
    """The publisher of a topic; for a latched one also those that it has replaced."""

    make: Callable[[], Any]
    latched: bool
    publisher: Any
    retired: list[_Retired] = field(default_factory=list)
    waiting: list[bytes] = field(default_factory=list)
    expected: int = 0
    until: float = 0.0


class Outputs:
    """Publishers by the names of their topics.

    Latched topics can be renewed. With one publisher for all runs, the last outcome of a run that
    a command ends (depth 1) would be overwritten by the first one of the next run before a slow
    subscriber has received it; the same holds for the train and the track.
    """

    def __init__(self, node: Any) -> None:
        self._node = node
        self._channels: dict[str, _Channel] = {}
        self._absent: set[str] = set()
        self._busy = False

    def open(self, name: str, make: Callable[[], Any], latched: bool = False) -> None:
        """Publish a topic; ``make`` makes its publisher."""
        self._channels[name] = _Channel(make, latched, make())

    def wanted(self, name: str) -> bool:
        """Whether anybody listens to a topic."""
        return self.subscribers(name) > 0

    def offer(self, topic: Topic) -> bool:
        """Publish a topic, unless it is published already.

        False, and said once, if its type is not installed.
        """
        name = topic.name
        if name in self._channels or name in self._absent:
            return name in self._channels
        try:
            rclpy_class(topic.msgtype)
        except (ImportError, AttributeError) as error:
            self._absent.add(name)
            self._node.get_logger().warning(f"no {name}: {error}")
            return False
        qos = rclpy_qos(topic)
        self.open(
            name, lambda: make_publisher(self._node, name, topic.msgtype, qos), topic.latched
        )
        return True

    def close(self, name: str) -> None:
        """Publish a topic no longer."""
        self._node.destroy_publisher(self._channels.pop(name).publisher)

    def __iter__(self) -> Iterator[str]:
        return iter(self._channels)

    def publish(self, name: str, data: bytes) -> None:
        """Send a message; nothing happens if the topic is not open."""
        channel = self._channels.get(name)
        if channel is None:
            return
        if channel.until:
            channel.waiting.append(data)
            self._release(channel)
        else:
            channel.publisher.publish(data)

    def subscribers(self, name: str) -> int:
        """Number of matched subscribers of a topic; 0 if it is not open."""
        channel = self._channels.get(name)
        return int(channel.publisher.get_subscription_count()) if channel else 0

    # --- renewal -----------------------------------------------------------------------------

    def renew(self) -> None:
        """Replace the publishers of latched topics: late subscribers get nothing older.

        A new publisher waits until it has matched as many subscribers as the old one had.
        """
        now, self._busy = time.monotonic(), True
        for channel in self._channels.values():
            if not channel.latched:
                continue
            old = channel.publisher
            for data in channel.waiting:
                old.publish(data)
            channel.waiting.clear()
            # A publisher that is young itself may not have matched all of them yet.
            count = old.get_subscription_count()
            channel.expected = max(count, channel.expected) if channel.until else count
            channel.publisher = channel.make()
            channel.until = now + MATCH_WAIT
            channel.retired.append(_Retired(old, channel.expected, now + RETIRE_WAIT))
            while len(channel.retired) > RETIRED_MOST:
                self._node.destroy_publisher(channel.retired.pop(0).publisher)

    def pump(self) -> bool:
        """Send what waits and destroy what is done; returns whether anything is left to do."""
        if not self._busy:
            return False
        self._busy = False
        for channel in self._channels.values():
            if channel.until:
                self._release(channel)
            if channel.retired:
                channel.retired = [each for each in channel.retired if not self._retire(each)]
            self._busy = self._busy or bool(channel.until) or bool(channel.retired)
        return self._busy

    def _release(self, channel: _Channel) -> None:
        matched = channel.publisher.get_subscription_count() >= channel.expected
        if matched or time.monotonic() >= channel.until:
            channel.until = 0.0
            for data in channel.waiting:
                channel.publisher.publish(data)
            channel.waiting.clear()

    def _retire(self, retired: _Retired) -> bool:
        """Destroy a replaced publisher once everything has arrived; whether it is gone."""
        publisher = retired.publisher
        matched = publisher.get_subscription_count() >= retired.expected
        if not (matched and acknowledged(publisher, 0.0)) and time.monotonic() < retired.until:
            return False
        self._node.destroy_publisher(publisher)
        return True

    def settle(self, seconds: float) -> None:
        """Wait until everything sent has arrived, for at most this long (s)."""
        end = time.monotonic() + seconds
        while self.pump() and time.monotonic() < end:
            time.sleep(0.01)
        for name, channel in self._channels.items():
            if name.rpartition("/")[2] not in NOT_AWAITED:
                acknowledged(channel.publisher, max(0.0, end - time.monotonic()))


class Latecomers:
    """Finds the topics that have new subscribers while nothing moves.

    They get the present state several times, at :data:`PRESENT`: who has matched here may match
    on its side long after, and then misses what was sent before.
    """

    def __init__(self) -> None:
        self._heard_by: dict[str, int] = {}
        self._due: dict[str, list[float]] = {}

    def reset(self, counts: Mapping[str, int]) -> None:
        """Begin anew; the subscribers there are have the present state."""
        self._heard_by, self._due = dict(counts), {}

    def due(self, counts: Mapping[str, int], now: float) -> set[str]:
        """Topics on which to send, by the numbers of subscribers and the wall time (s).

        A topic that has not been counted before has no new ones.
        """
        for name, count in counts.items():
            if count > self._heard_by.get(name, count):
                self._due[name] = [now + after for after in PRESENT]
        self._heard_by = dict(counts)
        found = {name for name, times in self._due.items() if times and now >= times[0]}
        for name in found:
            self._due[name].pop(0)
        return found


class TwinWatch:
    """Notices when another node publishes the same topics: subscribers then get both.

    Names cannot tell: a twin has the name of this node. A topic that is watched must not be
    latched, for then this node has one publisher of it and every further one is another's.
    """

    def __init__(self, node: Any, topics: Sequence[str], log: Any) -> None:
        self._node, self._log = node, log
        self._topics = {name: node.resolve_topic_name(name) for name in topics}
        self._twins: list[str] = []
        self._due = 0.0

    def look(self) -> list[str]:
        """Topics that another node publishes as well; looks once a second, warns of each time."""
        now = time.monotonic()
        if now >= self._due:
            self._due = now + TWINS_EVERY
            before = self._twins
            self._twins = [
                name
                for name, full in self._topics.items()
                if self._node.count_publishers(full) > 1
            ]
            if self._twins and not before:
                self._log.warning(
                    f"another node publishes {', '.join(self._twins[:3])} as well: subscribers "
                    f"get both{self._same_name()}"
                )
        return self._twins

    def _same_name(self) -> str:
        """A warning of a node with the name of this one."""
        own = (self._node.get_name(), self._node.get_namespace())
        if self._node.get_node_names_and_namespaces().count(own) < 2:
            return ""
        name = self._node.get_fully_qualified_name()
        return f"; it has the name of this one, {name}: either may answer a service call"


class ListenerWait:
    """Holds back the first message until enough nodes listen (parameter ``await_listeners``).

    A subscriber that has matched here may not have matched there yet: its first messages are sent
    again until it has, but only as many as the depth. So a node that has waited for listeners
    sends its first messages, lets them settle for ``FIRST_WAIT`` and then goes on.
    """

    def __init__(self, count: Callable[[], int], wanted: int, log: Any) -> None:
        self.came = False
        self._count, self._wanted, self._log = count, wanted, log
        self._until = time.monotonic() + LISTENERS_WAIT

    def over(self) -> bool:
        """Whether the wait is over: the listeners are there, or time is up."""
        count = self._count()
        if count >= self._wanted:
            self.came = self._wanted > 0
            return True
        if time.monotonic() < self._until:
            return False
        found = f"only {count} of {self._wanted}" if count else "no"
        self._log.warning(
            f"{found} subscribers appeared within {LISTENERS_WAIT:.0f} s; starting anyway"
        )
        return True
