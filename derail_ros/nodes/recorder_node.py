"""The node ``recorder``: records the topics of a simulator in a rosbag2 recording."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from derail_ros.nodes.declaration import declare
from derail_ros.nodes.outputs import TwinWatch
from derail_ros.nodes.process import FAILED, OK, Program, Stop
from derail_ros.recording.listener import Listener
from derail_ros.recording.recorder import RecordingError
from derail_ros.vocabulary.words import count
from msg_adapters.topics import (
    EVERYWHERE,
    LIVE_TOPICS,
    ON_MAP,
    SENSOR_TOPICS,
    STATE_TOPICS,
    TOPICS,
    Topic,
    check_interfaces,
    rclpy_class,
    rclpy_qos,
    topic_named,
)

GONE = 3.0
"""Wall time without any publisher after which the simulator is regarded as gone, s."""
LOOK_EVERY = 0.5
"""Wall time between two looks at what the publishers offer, s."""
RARE = ("collisions", "command_log")
"""Topics on which a run may well send nothing."""
ROUND = 0.1
"""Wall time after which the loop goes round even if nothing has arrived, s."""
ALL = "all"
"""What stands for all topics of the simulator."""
NEVER = ("/clock", ON_MAP.name)
"""Topics recorded only by name, or not at all: a player publishes a clock of its own, which a
recorded one would disturb, and rosbag2's refuses a recording with a type it does not know."""


def chosen_topics(names: Sequence[str]) -> list[Topic]:
    """Topics by their names in the table; without names those of the simulator's own recording.

    ``all`` adds frames, joints and the train's description.

    Raises
    ------
    ValueError
        If there is no such topic.
    """
    usual = [topic for topic in TOPICS.values() if topic.name not in NEVER]
    live = [topic for topic in LIVE_TOPICS.values() if topic.name not in NEVER]
    found = {} if names else {topic.name: topic for topic in usual}
    for name in names:
        if name == ALL:
            found |= {topic.name: topic for topic in (*usual, *live)}
            continue
        last = name.rpartition("/")[2]
        sensor = re.search(r"car_\d+/\w+$", name)
        topic = topic_named(sensor[0] if sensor else last) or topic_named(f"/{last}")
        if topic is None or topic == ON_MAP:
            known = [ALL, *(t.name.lstrip("/") for t in (*TOPICS.values(), *live))]
            sensors = ", ".join(t.name for t in SENSOR_TOPICS.values())
            raise ValueError(f"topics must be among {', '.join(known)}, {sensors}, got {name!r}")
        found[topic.name] = topic
    return list(found.values())


class Recorder(Program):
    """Subscriptions that hand their bytes to a :class:`Listener`."""

    def __init__(self, node: Any) -> None:
        super().__init__(node)
        check_interfaces()
        values: dict[str, Any] = declare(node, "recorder")
        self._stop_when_final = values["stop_when_final"]
        self._settle = values["settle"]
        self._path = values["path"]
        self._topics = {
            node.resolve_topic_name(t.name): t for t in chosen_topics(values["topics"])
        }
        self._with_sensors = ALL in values["topics"]
        for name in [name for name, t in self._topics.items() if not self._installed(t)]:
            del self._topics[name]
        self._depth = values["depth"]
        self._listener = Listener(self._path, values["storage"], self._topics)
        self._subscriptions: dict[str, Any] = {}
        for name in self._topics:
            self._subscribe(name)
        self._offered: set[str] = set()
        self._looked = 0.0
        self._published = time.monotonic()
        own = [name for name, topic in self._topics.items() if topic.name in STATE_TOPICS]
        self._twins = TwinWatch(node, own, self.log)

    def _installed(self, topic: Topic) -> bool:
        try:
            rclpy_class(topic.msgtype)
        except (ImportError, AttributeError) as error:
            self.log.warning(f"{topic.name} is left out: {error}")
            return False
        return True

    def _find_sensors(self) -> None:
        """Take up the sensors of cars that have come; only who publishes knows which."""
        own = f"{self.node.get_namespace().rstrip('/')}/"
        for name, kinds in self.node.get_topic_names_and_types():
            if name in self._topics or not name.startswith(f"{own}car_"):
                continue
            topic = topic_named(name.removeprefix(own))
            if topic is not None and kinds == [topic.msgtype]:
                self._topics[name] = topic
                self._listener.add(name, topic)
                self._subscribe(name)

    def _taker(self, name: str) -> Callable[[bytes, Any], None]:
        # rclpy looks at the signature to decide whether to pass the second argument.
        def take(data: bytes, info: Any) -> None:
            self._take(name, data, info)

        return take

    def _take(self, name: str, data: bytes, info: Any) -> None:
        try:
            self._listener.take(name, data, info)
        except RecordingError as error:
            self.fault = f"recording failed: {error}"

    def _subscribe(self, name: str, **policies: Any) -> None:
        """Subscribe to a topic as the table has it, with some other policies."""
        topic = self._topics[name]
        qos = rclpy_qos(topic, max(self._depth, topic.depth))
        for policy, value in policies.items():
            setattr(qos, policy, value)
        before = self._subscriptions.get(name)
        if before is not None:
            self._drain()
            self.node.destroy_subscription(before)
        self._subscriptions[name] = self.node.create_subscription(
            rclpy_class(topic.msgtype), topic.name, self._taker(name), qos, raw=True
        )

    def _follow(self) -> None:
        """Take up what the publishers offer: a subscriber that asks for more hears nothing."""
        from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

        now = time.monotonic()
        if now < self._looked + LOOK_EVERY:
            return
        self._looked = now
        if self._with_sensors:
            self._find_sensors()
        for name, topic in self._topics.items():
            offers = [p.qos_profile for p in self.node.get_publishers_info_by_topic(name)]
            if not offers:
                continue
            self._offered.add(name)
            wanted = {"reliability": ReliabilityPolicy.RELIABLE}
            if any(o.reliability == ReliabilityPolicy.BEST_EFFORT for o in offers):
                wanted["reliability"] = ReliabilityPolicy.BEST_EFFORT
            if topic.latched and any(o.durability == DurabilityPolicy.VOLATILE for o in offers):
                wanted["durability"] = DurabilityPolicy.VOLATILE
            present = self._subscriptions[name].qos_profile
            if any(getattr(present, policy) != value for policy, value in wanted.items()):
                self._subscribe(name, **wanted)

    def start(self, stop: Stop) -> None:
        """Log what is recorded, and what is not."""
        missing = [
            t.name
            for t in (*TOPICS.values(), *LIVE_TOPICS.values())
            if t not in self._topics.values()
        ]
        missing += [] if self._with_sensors else ["the sensors"]
        self.log.info(
            f"recording {count(len(self._subscriptions), 'topic')} to {self._path}; "
            f"not recorded: {', '.join(missing)}"
        )

    def work(self) -> float:
        """Record what has arrived."""
        self._follow()
        self._twins.look()
        self._drain()
        self._listener.release()
        return time.monotonic() + ROUND

    def _drain(self) -> None:
        """Take all messages that wait, without a round of the executor for each of them."""
        for name, subscription in self._subscriptions.items():
            with subscription.handle:
                while True:
                    item = subscription.handle.take_message(subscription.msg_type, True)
                    if item is None:
                        break
                    self._take(name, item[0], item[1])

    def _silent(self, report: Mapping[str, Mapping[str, int]]) -> list[str]:
        """Topics on which nothing came and something should have, with the reason if known."""
        silent = [name for name, counts in report.items() if not counts["received"]]
        unknown = [name for name in silent if name not in self._offered]
        if len(unknown) == len(self._topics):
            return ["any topic (no node publishes them)"]
        return [
            f"{name} ({'no node publishes it' if name in unknown else 'a node publishes it'})"
            for name in silent
            if name in unknown or self._topics[name].name not in RARE
        ]

    @property
    def exit_code(self) -> int | None:
        """Set when the run is recorded whole, or when its simulator is gone."""
        if self.fault:
            return FAILED
        if not self._stop_when_final:
            return None
        if self._listener.complete(self._settle):
            return OK
        if self._abandoned():
            self.log.warning("the simulator is gone; there is no final outcome")
            return OK
        return None

    def _abandoned(self) -> bool:
        """Whether there was a simulator, and for a while has been none."""
        now = time.monotonic()
        # A simulator elsewhere publishes the topics of the whole graph too.
        own = [n for n in self._subscriptions if n not in EVERYWHERE]
        own = own or list(self._subscriptions)
        if self._listener.empty or any(self.node.count_publishers(n) for n in own):
            self._published = now
        return now > self._published + GONE

    def close(self) -> None:
        """Close the recording and report what was received and missed."""
        self._drain()
        try:
            self._listener.close()
        except RecordingError as error:
            self.fault = f"recording failed: {error}"
        for path, report in zip(self._listener.closed, self._listener.reports):
            self.log.info(f"recording closed: {path}")
            received = sum(counts["received"] for counts in report.values())
            missed = {name: c for name, c in report.items() if c["lost"] or c["gaps"]}
            silent = self._silent(report)
            nothing = "" if missed or silent else ", no message missed"
            topics = count(sum(counts["received"] > 0 for counts in report.values()), "topic")
            self.log.info(f"{count(received, 'message')} of {topics} received{nothing}")
            if silent:
                self.log.warning(f"nothing came on {', '.join(silent)}")
            for name, counts in missed.items():
                self.log.warning(
                    f"{name}: {count(counts['lost'], 'message')} missed by their sequence "
                    f"numbers, {counts['gaps']} by their times"
                )
