"""The loop of a simulator: ticks, clock, markers and diagnostics when they are due."""

from __future__ import annotations

import math
from collections.abc import Callable

from derail_ros.nodes.core import SimulatorCore
from derail_ros.nodes.diagnostics import Diagnostics
from derail_ros.nodes.outputs import Latecomers, Output
from derail_ros.recording.session import Session
from derail_ros.vocabulary.errors import SimulationError

SLICE = 0.008
"""Wall time of computing after which requests are served, s."""
IDLE = 0.1
"""Wall time after which the loop goes round even if nothing is due, s."""
LOOK_EVERY = 0.05
"""Wall time between two looks for new subscribers, s."""
CLEARS = 3
"""Marker messages of a new run that clear the view: one (depth 1) could be overwritten."""


class Loop:
    """Advances a simulator's run and sends what is due; ``wall`` is the steady clock (s)."""

    def __init__(self, core: SimulatorCore, output: Output, wall: Callable[[], float]) -> None:
        self._core = core
        self._output = output
        self._wall = wall
        self._diagnostics = Diagnostics(core, wall())
        self._shown: Session | None = None
        self._fresh = False
        self._clears = 0
        self._still: Session | None = None
        self._sent = 0
        self._look = 0.0
        self._late = Latecomers()

    def work(self) -> float:
        """Do what is due, for about a slice at most.

        Returns
        -------
        float
            Wall time (s) until which nothing is due; if it has passed, there is more to do.
        """
        now = self._wall()
        if self._core.active:
            # Compute before sending: what is due in this slice then goes out fresh.
            self._advance(now)
            now = self._wall()
        due = min(
            now + IDLE,
            self._send_clock(now),
            self._send_markers(now),
            self._send_diagnostics(now),
        )
        self._send_present(now)
        if self._core.active:
            due = min(due, self._core.pace.tick if self._core.paced else now)
        return due

    def _advance(self, now: float) -> None:
        """Advance the run by what is due within a slice."""
        core, session = self._core, self._core.session
        if session is None:
            return
        end = now + SLICE
        while True:
            paced = core.paced
            if paced and not core.pace.tick_due(now):
                return
            before = session.time
            try:
                reached = session.advance(max(end - now, 0.0))
            except SimulationError:
                core.fail(session)
                return
            now = self._wall()
            core.pace.tick_computed(reached, paced)
            if reached:
                self._fresh = True
                self._diagnostics.simulated += session.time - before
                if core.tick_done(session):
                    return
            if now >= end:
                return

    def _send_clock(self, now: float) -> float:
        core = self._core
        if not core.settings.publish_clock:
            return math.inf
        if core.pace.clock_due(now):
            core.send_clock(core.now)
        return core.pace.next_clock

    def _send_markers(self, now: float) -> float:
        """Send markers if there are new ones, and sometimes for late subscribers."""
        pace, session = self._core.pace, self._core.session
        if session is not self._shown:
            self._shown, self._fresh, self._clears = session, True, CLEARS
        if session is None or self._core.settings.marker_rate <= 0.0:
            return math.inf
        if pace.markers_due(now, self._fresh):
            self._output.publish("markers", session.markers(reset=self._clears > 0))
            self._clears = max(0, self._clears - 1)
            self._fresh = False
        return pace.next_markers(self._fresh)

    def _send_present(self, now: float) -> None:
        """While nothing moves, send the state to subscribers that have come since."""
        core, session = self._core, self._core.session
        if session is None or (session is self._still and now < self._look):
            return
        self._look = now + LOOK_EVERY
        counts = core.listening()
        if session is not self._still or core.active:
            # Those of a run that begins paused listened to its first tick.
            self._still, self._sent = session, 0
            self._late.reset(counts if core.active else core.listened)
        due = self._late.due(counts, now)
        if due:
            # A nanosecond later each time: tf2 complains of a time that it has already.
            self._sent += 1
            core.tell_time(session.stamp + self._sent)
            for name, data in session.present(self._sent):
                if name in due:
                    self._output.publish(name, data)

    def _send_diagnostics(self, now: float) -> float:
        if now >= self._diagnostics.due:
            self._output.publish("/diagnostics", self._diagnostics.message(now))
        return self._diagnostics.due
