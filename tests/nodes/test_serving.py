"""Waiting for requests must not keep a node from ending."""

from __future__ import annotations

import sys
import threading
import time
from types import SimpleNamespace

import pytest

pytest.importorskip("rclpy")
pytest.importorskip("derail_msgs")

from derail_ros.nodes import serving
from derail_ros.nodes.serving import RequestWaiter
from tests.nodes.graph import LIMIT, graph

pytestmark = pytest.mark.ros


@pytest.mark.parametrize("before", [0, 1])
def test_the_waiter_closes_after_an_error_in_a_callback(tmp_path, before) -> None:
    """In the first round, in which its thread begins, and in the one after."""
    fails = SimpleNamespace(spin_once=lambda timeout_sec: 1 // 0, create_task=None)
    with graph(tmp_path) as made:
        waiter = RequestWaiter(made.node, made.node.create_guard_condition(lambda: None))
        for _ in range(before):
            waiter.wait(made.executor, 0.0)
        with pytest.raises(ZeroDivisionError):
            waiter.wait(fails, time.monotonic() + LIMIT)
        closing = threading.Thread(target=waiter.close, daemon=True)
        closing.start()
        closing.join(LIMIT)
        assert not closing.is_alive()


def test_the_waiter_closes_before_its_thread_has_run(tmp_path) -> None:
    """A request to quit is served, and the node closes before the thread gets the processor."""
    interval = sys.getswitchinterval()
    with graph(tmp_path) as made:
        waiter = RequestWaiter(made.node, made.node.create_guard_condition(lambda: None))

        def serve_and_close() -> None:
            waiter.wait(made.executor, 0.0)
            waiter.close()

        closing = threading.Thread(target=serve_and_close, daemon=True)
        sys.setswitchinterval(LIMIT)  # no thread is interrupted
        try:
            closing.start()
            closing.join(LIMIT)
        finally:
            sys.setswitchinterval(interval)
        assert not closing.is_alive()


def test_tasks_of_the_executor_do_not_wait_for_a_request(tmp_path, monkeypatch) -> None:
    """The result of an action takes two: one after the other, and no message wakes the waiter."""
    monkeypatch.setattr(serving, "ROUND", 2.0 * LIMIT)
    with graph(tmp_path) as made:
        waiter = RequestWaiter(made.node, made.node.create_guard_condition(lambda: None))
        waiter.wait(made.executor, 0.0)
        carried_out: list[str] = []

        def first() -> None:
            carried_out.append("first")
            made.executor.create_task(carried_out.append, "second")

        made.executor.create_task(first)
        end = time.monotonic() + LIMIT
        while len(carried_out) < 2 and time.monotonic() < end:
            waiter.wait(made.executor, end)
        waiter.close()
        assert carried_out == ["first", "second"]
