"""Services whose answers take a while, and a cheap way to wait for requests."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from typing import Any

from msg_adapters.common import NANOSECONDS

SERVICE_DEPTH = 100
"""Requests of a service that may wait, and answers that may be under way. With the usual depth of
10 the middleware drops the rest silently."""
QUIET = 0.015
"""Wall time for which the loop does not look for requests after it has waited for one in vain,
unless it has nothing else to do, s."""
SERVE = 0.004
"""Wall time for which requests are served before the run goes on, s."""
ROUND = 1.0
"""Wall time between two rounds of the executor when no request arrives, s."""


def service_qos() -> Any:
    """Quality of service of a node's services."""
    from rclpy.qos import QoSProfile

    return QoSProfile(depth=SERVICE_DEPTH)


def snake(name: str) -> str:
    """Name of the service of a type: ``GetEntities`` -> ``get_entities``."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower()


class DeferredService:
    """A service whose answer may be given after its callback has returned.

    The callback takes request, response and a function that sends the response. ``rclpy`` offers
    coroutines for that, but its executor polls them, and serves nothing else while one waits.
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


class RequestWaiter:
    """Waits for requests, and has the executor serve them.

    A round of ``rclpy``'s executor costs as much as publishing a whole tick: it collects all
    entities and makes a wait set of them. Here the wait set is made once, and the executor runs
    only when there is something to serve, and once a second for everything else. The guard
    condition ``woken`` ends the waiting from any thread.
    """

    def __init__(self, node: Any, woken: Any) -> None:
        self._node = node
        self._woken = woken
        self._quiet = 0.0
        self._round = 0.0
        self._collect()

    def _collect(self) -> None:
        """Make the wait set."""
        from rclpy.impl.implementation_singleton import rclpy_implementation

        node = self._node
        self._services = [service.handle for service in node.services]
        self._subscriptions = [subscription.handle for subscription in node.subscriptions]
        self._waitables = list(node.waitables)
        more = [w.get_num_entities() for w in self._waitables]
        counts = (
            len(self._subscriptions) + sum(n.num_subscriptions for n in more),
            1 + sum(n.num_guard_conditions for n in more),
            sum(n.num_timers for n in more),
            sum(n.num_clients for n in more),
            len(self._services) + sum(n.num_services for n in more),
            sum(n.num_events for n in more),
        )
        self._set = rclpy_implementation.WaitSet(*counts, node.context.handle)

    def wait(self, executor: Any, due: float) -> None:
        """Serve what arrives until something is due (wall time, s)."""
        now = time.monotonic()
        if now < due <= self._quiet:
            time.sleep(due - now)
        elif self._ready(max(0.0, due - now)):
            self._serve(executor, self._ready)
        elif now >= self._round:
            self._serve(executor, lambda: False)
            self._round = now + ROUND
        elif due > now:
            self._quiet = time.monotonic() + QUIET

    def _serve(self, executor: Any, more: Callable[[], bool]) -> None:
        end = time.monotonic() + SERVE
        while True:
            executor.spin_once(timeout_sec=0.0)
            # Entities may have changed: the parameter use_sim_time adds a subscription.
            self._collect()
            if time.monotonic() >= end or not more():
                break

    def _ready(self, seconds: float = 0.0) -> bool:
        """Whether there is a request or a message, after waiting for at most this long."""
        ready = self._set
        ready.clear_entities()
        for handle in self._services:
            ready.add_service(handle)
        for handle in self._subscriptions:
            ready.add_subscription(handle)
        for waitable in self._waitables:
            waitable.add_to_wait_set(ready)
        ready.add_guard_condition(self._woken.handle)
        ready.wait(int(seconds * NANOSECONDS))
        return bool(
            ready.get_ready_entities("service")
            or ready.get_ready_entities("subscription")
            or any(waitable.is_ready(ready) for waitable in self._waitables)
        )
