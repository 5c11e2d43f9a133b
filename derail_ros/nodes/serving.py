"""Services with late answers, and a cheap way to wait for requests."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable
from typing import Any

from msg_adapters.common import NANOSECONDS

SERVICE_DEPTH = 100
"""Requests of a service that may wait, and answers that may be under way. With the usual depth of
10 the middleware drops the rest silently."""
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
    """Waits for requests in a thread of its own, and has the executor serve them in the caller's.

    A round of ``rclpy``'s executor costs as much as publishing a whole tick, and a wait of the
    middleware with all services in it a third of that. Here one wait goes on until there is
    something to serve, or for a second, and the loop of the node sleeps on a lock. The guard
    condition ``woken`` ends the wait from any thread. While the executor runs, no wait goes on: it
    may change what there is to wait for. Tasks of the executor, which an action needs for its
    result, do not show in a wait: each new one ends it.
    """

    def __init__(self, node: Any, woken: Any) -> None:
        self._node = node
        self._woken = woken
        self._thread = threading.Thread(target=self._watch, name="requests", daemon=True)
        self._bell, self._again = threading.Lock(), threading.Lock()
        self._bell.acquire()
        self._again.acquire()
        self._closed = False
        self._tasks: list[Any] = []

    def _note_tasks(self, executor: Any) -> None:
        """Learn of each task that the executor gets."""
        create = executor.create_task

        def create_task(*args: Any, **kwargs: Any) -> Any:
            task = create(*args, **kwargs)
            self._tasks.append(task)
            self._woken.trigger()
            return task

        executor.create_task = create_task

    def _busy(self) -> bool:
        """Whether a task of the executor is left."""
        self._tasks = [task for task in self._tasks if not task.done()]
        return bool(self._tasks)

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
        if self._thread.ident is None:
            self._note_tasks(executor)
            self._collect()
            self._thread.start()
            self._serve(executor)
        elif self._bell.acquire(timeout=max(0.0, due - time.monotonic())):
            self._serve(executor)

    def close(self) -> None:
        """End the thread."""
        self._closed = True
        if self._thread.ident is not None:
            self._woken.trigger()
            self._bell.acquire()
            self._again.release()
            self._thread.join()

    def _watch(self) -> None:
        while True:
            self._again.acquire()
            try:
                if self._closed:
                    return
                self._ready(ROUND)
            finally:
                self._bell.release()  # whoever has the turn rings once, at the end too

    def _serve(self, executor: Any) -> None:
        end = time.monotonic() + SERVE
        try:
            while True:
                executor.spin_once(timeout_sec=0.0)
                # Entities may have changed: the parameter use_sim_time adds a subscription.
                self._collect()
                if time.monotonic() >= end or not (self._busy() or self._ready()):
                    break
        finally:
            if self._busy():
                self._woken.trigger()
            self._again.release()  # after an error, too: closing waits for the thread

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
