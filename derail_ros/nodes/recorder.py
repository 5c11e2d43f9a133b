"""The node ``recorder``: records the topics of a simulator in a rosbag2 recording."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

from derail_ros.nodes.declaration import declare
from derail_ros.nodes.process import OK, Program, Stop, run_node
from derail_ros.recording.listener import Listener
from derail_ros.vocabulary.words import count
from msg_adapters.topics import TOPICS, Topic, check_interfaces, rclpy_class, rclpy_qos

GONE = 3.0
"""Wall time without any publisher after which the simulator is regarded as gone, s."""
ROUND = 0.1
"""Wall time after which the loop goes round even if nothing has arrived, s."""


def chosen_topics(names: Sequence[str]) -> list[Topic]:
    """Topics by their names in the table; without names all but the clock.

    A player publishes a clock of its own, which a recorded one would disturb.

    Raises
    ------
    ValueError
        If there is no such topic.
    """
    if not names:
        return [topic for topic in TOPICS.values() if topic.name != "/clock"]
    known = {topic.name.lstrip("/"): topic for topic in TOPICS.values()}
    topics = []
    for name in names:
        topic = known.get(name.rpartition("/")[2])
        if topic is None:
            raise ValueError(f"topics must be among {', '.join(known)}, got {name!r}")
        topics.append(topic)
    return topics


class Recorder(Program):
    """Subscriptions that hand their bytes to a :class:`Listener`."""

    def __init__(self, node: Any) -> None:
        super().__init__(node)
        check_interfaces()
        values: dict[str, Any] = declare(node, "recorder")
        self._stop_when_final = values["stop_when_final"]
        self._settle = values["settle"]
        self._path = values["path"]
        topics = {node.resolve_topic_name(t.name): t for t in chosen_topics(values["topics"])}
        self._listener = Listener(self._path, values["storage"], topics)
        self._subscriptions = {
            name: node.create_subscription(
                rclpy_class(topic.msgtype),
                topic.name,
                self._taker(name),
                rclpy_qos(topic, max(values["depth"], topic.depth)),
                raw=True,
            )
            for name, topic in topics.items()
        }
        self._published = time.monotonic()

    def _taker(self, name: str) -> Callable[[bytes, Any], None]:
        # rclpy looks at the signature to decide whether to pass the second argument.
        def take(data: bytes, info: Any) -> None:
            self._listener.take(name, data, info)

        return take

    def start(self, stop: Stop) -> None:
        """Say what is recorded."""
        self.log.info(f"recording {len(self._subscriptions)} topics to {self._path}")

    def work(self) -> float:
        """Record what has arrived."""
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
                    self._listener.take(name, item[0], item[1])

    @property
    def exit_code(self) -> int | None:
        """Set when the run is recorded whole, or when its simulator is gone."""
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
        own = [n for n in self._subscriptions if n not in ("/clock", "/diagnostics")]
        own = own or list(self._subscriptions)
        if self._listener.empty or any(self.node.count_publishers(n) for n in own):
            self._published = now
        return now > self._published + GONE

    def close(self) -> None:
        """Close the recording and report what was received and missed."""
        self._drain()
        self._listener.close()
        for path, report in zip(self._listener.closed, self._listener.reports):
            self.log.info(f"recording closed: {path}")
            received = sum(counts["received"] for counts in report.values())
            missed = {name: c for name, c in report.items() if c["lost"] or c["gaps"]}
            nothing = "" if missed else ", no message missed"
            self.log.info(f"{count(received, 'message')} received{nothing}")
            for name, counts in missed.items():
                self.log.warning(
                    f"{name}: {count(counts['lost'], 'message')} missed by their sequence "
                    f"numbers, {counts['gaps']} by their times"
                )


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node until it is told to end; returns the exit code."""
    return run_node("recorder", Recorder, argv)


if __name__ == "__main__":
    sys.exit(main())
