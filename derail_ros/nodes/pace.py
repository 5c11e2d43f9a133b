"""When ticks, clock and markers are due, in wall time."""

from __future__ import annotations

import math
from collections.abc import Callable

from derail_ros.nodes.parameters import Settings

EARLY = 0.002
"""What is due this soon goes out with what is due now, s: waking up costs more than a message."""
SLACK = 0.010
"""Lateness of a tick that is made up for, s; beyond it, the run falls behind instead."""
IDLE_MARKERS = 1.0
"""Wall time between markers while nothing moves, s: for late subscribers."""


class Pace:
    """Wall times at which a run's ticks, the clock and the markers are due.

    A run that cannot keep up falls behind and stays behind: it never takes a longer tick and
    never hurries to catch up.

    Attributes
    ----------
    tick_length : simulation time of a tick of the present run, s
    tick : wall time at which the next tick is due, s
    changed : wall time at which the run began to play or its speed factor changed, s
    overruns : how often the run has fallen behind
    """

    def __init__(self, settings: Settings, wall: Callable[[], float]) -> None:
        self.settings = settings
        self.wall = wall
        self.tick_length = 0.0
        self.tick = 0.0
        self.changed = wall()
        self.overruns = 0
        self._factor = settings.speed_factor
        self._unfinished = False
        self._left = math.inf
        self._clock_told = 0.0
        self._clock = 0.0
        self._clock_shift = 0.0
        self._markers = 0.0
        self._idle_markers = 0.0

    @property
    def period(self) -> float:
        """Wall time of a tick, s; 0 when the run is as fast as possible."""
        factor = self.settings.speed_factor
        return self.tick_length / factor if factor > 0.0 else 0.0

    @property
    def share(self) -> float:
        """Share of the present tick that has passed, of a run that is not as fast as possible."""
        return 1.0 - (self.tick - self.wall()) / self.period

    def begin(self, tick_length: float) -> None:
        """Take up a new run."""
        self.tick_length, self._left = tick_length, math.inf

    def pause(self) -> None:
        """Stop playing; the rest of the present tick is kept."""
        self._left = max(self.tick - self.wall(), 0.0)

    def play(self) -> None:
        """Start playing; the next tick is due after a period, or after the rest of one."""
        self.changed = self.wall()
        self.tick = self.changed + min(self.period, self._left)
        self._left = math.inf
        self._unfinished = False
        self._align_clock()

    def change(self) -> None:
        """Take up changed rates.

        Nothing becomes due later than it was: a client that changes parameters all the time (a
        slider) must not hold up the run.
        """
        now, settings = self.wall(), self.settings
        if settings.speed_factor != self._factor:
            if settings.speed_factor > 0.0 and self.tick > now:
                # What is left of the tick is simulation time.
                self.tick = now + (self.tick - now) * self._factor / settings.speed_factor
            self._factor, self.changed = settings.speed_factor, now
        # A tick that is later than this was not waited for: the run had no pace.
        tick = self.tick if now - self.tick <= SLACK else now
        self.tick = min(tick, now + self.period)
        self._clock = min(self._clock, now + 1.0 / settings.clock_rate)
        self._align_clock()
        if settings.marker_rate > 0.0:
            self._markers = min(self._markers, now + 1.0 / settings.marker_rate)

    # --- ticks -------------------------------------------------------------------------------

    def tick_due(self, now: float) -> bool:
        """Whether the next tick is due. One that is too late moves all that follow."""
        if now < self.tick:
            return False
        if not self._unfinished and now - self.tick > SLACK:
            self.tick = now
            self._align_clock()
            self.overruns += 1
        return True

    def tick_computed(self, whole: bool, paced: bool) -> None:
        """Note that a tick was computed, or a part of it."""
        self._unfinished = not whole
        if whole and paced:
            self.tick += self.period

    # --- clock -------------------------------------------------------------------------------

    def _align_clock(self) -> None:
        """Put the clock in phase with the ticks, so that the loop wakes up once for both.

        Each message moves by half a period at most, and all by the same time: the rate stays the
        same, however often the ticks fall behind.
        """
        period = 1.0 / self.settings.clock_rate
        off = self.tick - self._clock
        self._clock_shift = (off + 0.5 * period) % period - 0.5 * period

    @property
    def next_clock(self) -> float:
        """Wall time at which the next clock message is due, s; if that is near, with the tick."""
        due = self._clock + self._clock_shift
        return self.tick if abs(due - self.tick) < 2.0 * EARLY else due

    def clock_sent(self) -> None:
        """Note that a clock message goes out."""
        self._clock_told = self.wall()

    def clock_due(self, now: float) -> bool:
        """Whether a clock message is due, and none has just gone out; the caller sends it."""
        due = self.next_clock
        if now < due - (EARLY if due != self.tick else 0.0):
            return False
        period = 1.0 / self.settings.clock_rate
        just = now - self._clock_told < 0.5 * period
        self._clock += period
        late = now - (self._clock + 0.5 * period)
        if late > 0.0:
            # Missed messages are left out; the phase stays.
            self._clock += period * math.ceil(late / period)
        return not just

    # --- markers -----------------------------------------------------------------------------

    def markers_due(self, now: float, fresh: bool) -> bool:
        """Whether markers are due, ``fresh`` or not; the caller sends them."""
        if now < self._markers - self._marker_tolerance:
            return False
        if not fresh and now < self._idle_markers:
            return False
        self._markers = max(self._markers + 1.0 / self.settings.marker_rate, now)
        self._idle_markers = now + IDLE_MARKERS
        return True

    def next_markers(self, fresh: bool) -> float:
        """Wall time at which the loop has to wake up for markers, s."""
        late = self._marker_tolerance if self._with_clock else 0.0
        return (self._markers if fresh else self._idle_markers) + late

    @property
    def _with_clock(self) -> bool:
        """Whether markers go out with the nearest clock message, without a waking of their own."""
        return self.settings.publish_clock and (
            self.settings.clock_rate >= self.settings.marker_rate
        )

    @property
    def _marker_tolerance(self) -> float:
        return 0.5 / self.settings.clock_rate if self._with_clock else EARLY
