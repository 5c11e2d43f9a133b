"""Decides whether a node may publish ``/clock``: never as the second one."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

CLOCK = "/clock"
GRACE = 0.6
"""Wall time in which another publisher of the clock may appear before this one starts, s."""
PATIENCE = 3.0
"""Wall time for which a young publisher waits for another one to give way, s."""
PROBATION = 30.0
"""Wall time during which a publisher is young: of two young ones, one gives way, s."""


class ClockGuard:
    """Opens the publisher of the clock when no other node has one, and closes it otherwise.

    It also takes over when the other node is gone; the middleware announces a killed node for
    another 20 s or so. ``open`` and ``close`` make and destroy the publisher.
    """

    def __init__(
        self, node: Any, open: Callable[[], None], close: Callable[[], None], wanted: bool
    ) -> None:
        self.publishing = False
        self._node = node
        # Two simulators with clocks of other names do not hinder each other.
        self._topic = node.resolve_topic_name(CLOCK)
        self._open, self._close = open, close
        self._wanted = wanted
        self._yielded = False
        self._warned = False
        self._beside: float | None = None
        self._began = self._looked = self._taken = time.monotonic()

    def look(self) -> None:
        """Look at the graph, if it is time to; call this in each round of the loop."""
        now = time.monotonic()
        young = now < self._began + PROBATION
        if not self._wanted or now < self._looked + (0.1 if young else 1.0):
            return
        self._looked = now
        others = self._node.count_publishers(self._topic) - int(self.publishing)
        if others == 0 or not self.publishing:
            self._beside = None
        elif self._beside is None:
            self._beside = now
        if others > 0 and (not self.publishing or (young and self._gives_way(now))):
            self._yield(now)
        elif others > 0 and not young and not self._warned:
            self._warned = True
            self._node.get_logger().warning(f"another node now publishes {CLOCK} as well")
        elif not self.publishing and now > self._taken + GRACE:
            self._open()
            self.publishing = True
            if self._yielded:
                self._node.get_logger().info(f"the other node is gone: publishing {CLOCK}")
                # A third node may take over at the same moment: young again.
                self._began, self._yielded = now, False

    def _yield(self, now: float) -> None:
        self._taken = now
        if self.publishing:
            self._close()
            self.publishing = False
        if not self._yielded:
            self._yielded = True
            self._node.get_logger().warning(
                f"another node publishes {self._topic}: this one does not (parameter "
                "publish_clock). Each has a time of its own, and nodes with use_sim_time follow "
                "that of the other one"
            )

    def _gives_way(self, now: float) -> bool:
        """Whether this one, being young, gives way to another publisher.

        Of two that started at the same time the one with the larger identity does. One that has
        not given way for a while is old: it stays, whatever its identity.
        """
        if self._beside is not None and now > self._beside + PATIENCE:
            return True
        node = self._node
        own = (node.get_name(), node.get_namespace())
        mine, others = [], []
        for info in node.get_publishers_info_by_topic(self._topic):
            same = (info.node_name, info.node_namespace) == own
            (mine if same else others).append(bytes(info.endpoint_gid))
        return bool(mine and others) and min(mine) > min(others)
