"""The node ``recorder``: hears a simulator's topics and writes a rosbag2 recording."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from typing import Any

from derail_ros.nodes import parameters as table
from derail_ros.nodes.process import Stop, run_node, starting
from derail_ros.recording.listener import Listener
from derail_ros.vocabulary.words import count
from msg_adapters.topics import TOPICS, Topic, check_interfaces, rclpy_class, rclpy_qos

GONE = 3.0
"""Wall time without any publisher after which the simulator is taken to have ended, s."""
ROUND = 0.1
"""Wall time after which the loop looks around even if nothing came, s."""


def chosen_topics(names: Sequence[str]) -> list[Topic]:
    """Topics by their names in the table; none: all but the clock.

    A player makes a clock of its own, so a recorded one would only be in its way.
    """
    if not names:
        return [topic for topic in TOPICS.values() if topic.name != "/clock"]
    known = {topic.name.lstrip("/"): topic for topic in TOPICS.values()}
    topics = []
    for name in names:
        topic = known.get(name.rpartition("/")[2])
        if topic is None:
            raise ValueError(f"topics: no topic {name!r}; there are {', '.join(known)}")
        topics.append(topic)
    return topics


def make_node_class() -> Any:
    """The node's class; made when it is needed, so that this module imports without ROS."""
    import rclpy.node

    class RecorderNode(rclpy.node.Node):  # type: ignore[misc]
        """Subscriptions that hand their bytes to a :class:`Listener`."""

        def __init__(self) -> None:
            super().__init__("recorder")
            values = table.declare(self, table.RECORDER)
            self.stop_when_final = bool(values["stop_when_final"])
            self.settle = float(values["settle"])  # type: ignore[arg-type]
            depth = int(values["depth"])  # type: ignore[arg-type]
            topics = chosen_topics(values["topics"])  # type: ignore[arg-type]
            names = {self.resolve_topic_name(topic.name): topic for topic in topics}
            self.listener = Listener(str(values["path"]), str(values["storage"]), names)
            self._subscribed = []
            self._seen = time.monotonic()
            for name, topic in names.items():
                subscription = self.create_subscription(
                    rclpy_class(topic.msgtype),
                    topic.name,
                    self._taker(name),
                    rclpy_qos(topic, max(depth, topic.depth)),
                    raw=True,
                )
                self._subscribed.append((name, subscription))
            self.get_logger().info(f"recording {len(names)} topics to {values['path']}")

        def _taker(self, name: str) -> Any:
            # rclpy looks at the signature to decide whether to pass the second argument.
            def take(data: bytes, info: Any) -> None:
                self.listener.take(name, data, info)

            return take

        def abandoned(self) -> bool:
            """Whether there was a simulator, and for a while has been none."""
            now = time.monotonic()
            names = [n for n, _ in self._subscribed]
            # Another simulator elsewhere publishes those of the whole graph too.
            own = [n for n in names if n not in ("/clock", "/diagnostics")] or names
            if self.listener.empty or any(self.count_publishers(n) for n in own):
                self._seen = now
            return now > self._seen + GONE

        def drain(self) -> int:
            """Take everything that waits, without a round of the executor for each message."""
            taken = 0
            for name, subscription in self._subscribed:
                with subscription.handle:
                    while True:
                        item = subscription.handle.take_message(subscription.msg_type, True)
                        if item is None:
                            break
                        self.listener.take(name, item[0], item[1])
                        taken += 1
            return taken

        def tell(self) -> None:
            """Report what was heard and what was missed."""
            for path, report in zip(self.listener.closed, self.listener.reports):
                self.get_logger().info(f"recording closed: {path}")
                received = sum(counts["received"] for counts in report.values())
                missed = {n: c for n, c in report.items() if c["lost"] or c["gaps"]}
                self.get_logger().info(
                    f"{count(received, 'message')} received"
                    + ("" if missed else ", no message missed")
                )
                for name, counts in missed.items():
                    self.get_logger().warning(
                        f"{name}: {count(counts['lost'], 'message')} missed by their numbers, "
                        f"{counts['gaps']} by their times"
                    )

    return RecorderNode


def _run(stop: Stop, arguments: Sequence[str]) -> int:
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.signals import SignalHandlerOptions

    with starting():
        rclpy.init(args=list(arguments), signal_handler_options=SignalHandlerOptions.NO)
        check_interfaces()
        executor = SingleThreadedExecutor()
        node = make_node_class()()
    executor.add_node(node)
    try:
        while not stop.asked:
            executor.spin_once(timeout_sec=ROUND)
            node.drain()
            node.listener.release()
            if node.stop_when_final:
                if node.listener.complete(node.settle):
                    break
                if node.abandoned():
                    node.get_logger().warning("the simulator is gone, without a final outcome")
                    break
        node.drain()
    finally:
        node.listener.close()
        node.tell()
        executor.shutdown()
        node.destroy_node()
    return 0


def usage() -> str:
    """Help on the command line."""
    return table.usage("recorder", "[--ros-args -p NAME:=VALUE ...]", table.RECORDER)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node until it is told to end; returns the exit code."""
    return run_node(_run, argv, usage)


if __name__ == "__main__":
    sys.exit(main())
