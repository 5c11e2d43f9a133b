"""A client that waits for one answer: `python -m tests.nodes.waiter step_simulation TICKS`."""

from __future__ import annotations

import sys

import rclpy

from tests.nodes.graph import SERVICES, service_path


def main() -> None:
    service, ticks = sys.argv[1], int(sys.argv[2])
    rclpy.init()
    node = rclpy.create_node("waiter")
    client = node.create_client(SERVICES[service], f"/simulator/{service_path(service)}")
    client.wait_for_service()
    future = client.call_async(SERVICES[service].Request(ticks=ticks))
    rclpy.spin_until_future_complete(node, future)
    print(future.result().message)


if __name__ == "__main__":
    main()
