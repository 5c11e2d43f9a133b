"""A subscriber for tests: `python -m tests.nodes.ear TOPIC ...` writes a line for each message."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions

from derail_ros.nodes.process import Stop
from msg_adapters.topics import TOPICS, rclpy_class, rclpy_qos

DEPTH = 10
"""What docs/ros2.md advises for the latched topics."""


def teller(topic: str) -> Callable[[Any], None]:
    """A callback that writes the topic, or what is special about a message, and the run."""

    def tell(message: Any) -> None:
        run = getattr(message, "run_id", "")
        print(topic, run, sep="\t")
        if topic == "outcome" and message.is_final:
            print("final outcome", run, sep="\t")
        if topic == "events":
            print(message.kind_name, run, sep="\t")

    return tell


def main() -> None:
    stop = Stop()
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("ear")
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    for name in sys.argv[1:]:
        topic = TOPICS[name]
        node.create_subscription(
            rclpy_class(topic.msgtype),
            name,
            teller(name),
            rclpy_qos(topic, max(DEPTH, topic.depth)),
        )
    while not stop.asked:
        executor.spin_once(timeout_sec=0.1)
    executor.shutdown()
    node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main()
