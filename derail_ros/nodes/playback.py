"""What the ``player`` node does with a recording and the time; no ROS in here."""

from __future__ import annotations

import bisect
import itertools
import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Protocol

from derail_ros.recording.channels import Channel
from derail_ros.recording.decoding import present_bytes
from derail_ros.recording.storage import BagError, open_bag
from msg_adapters.common import NANOSECONDS

IDLE = 0.1
"""Wall time after which the player looks around even if nothing is due, s."""
SLICE = 0.01
"""Wall time after which it looks for requests while much is due, s."""
STALL = 0.5
"""Wall time by which it may be late; what is later is not made up for, s."""
LOOK_BACK = 2 * NANOSECONDS
"""How far back a seek looks for the last state of everything, ns."""
OWN_CLOCK = ("/clock",)
"""Topics that the player makes itself."""

Item = tuple[int, str, bytes]
"""Time (ns), topic and CDR bytes."""


class Output(Protocol):
    """Where messages go."""

    def publish(self, topic: str, data: bytes) -> None:
        """Send a message."""

    def renew(self) -> None:
        """Forget the latched messages sent so far."""


class Playback:
    """A recording that is played.

    Parameters
    ----------
    path
        Of the recording; it must be whole.
    output
        Where messages go; may be set later.
    wall
        The wall time, s.

    Raises
    ------
    BagError
        If it cannot be played.
    """

    def __init__(
        self,
        path: str | Path,
        output: Output | None = None,
        wall: Callable[[], float] = time.monotonic,
    ) -> None:
        self.bag = open_bag(path)
        if not self.bag.intact:
            raise BagError(f"{path}: cut off; `derail repair {path}` makes it whole")
        self.output = output
        self.wall = wall
        self.loop = False
        self.stopped = False
        self.laps = 0
        span = self.bag.span()
        if span is None:
            raise BagError(f"{self.bag.path}: no message in it")
        self.start, self.end = span
        self.channels = [c for c in self.bag.channels if c.topic not in OWN_CLOCK]
        self._latched_names = {c.topic for c in self.channels if c.latched}
        self._latched: list[Item] = [
            (stamp, channel.topic, present_bytes(channel, data))
            for channel, stamp, data in self.bag.messages(self._is_latched)
        ]
        self._latched_times = [stamp for stamp, _, _ in self._latched]
        self._rate = 1.0
        self._paused = True
        self._now = self.start
        self._anchor = wall()
        self._next: Item | None = None
        self._items: Iterator[Item] = iter(())
        self._begin(self.start)

    def _is_latched(self, channel: Channel) -> bool:
        return channel.topic in self._latched_names

    def _is_played(self, channel: Channel) -> bool:
        return channel.topic not in OWN_CLOCK

    def close(self) -> None:
        """Close the recording."""
        self._items = iter(())

    # --- time ----------------------------------------------------------------------------------

    @property
    def now(self) -> int:
        """Recorded time, ns."""
        if self._paused:
            return self._now
        elapsed = (self.wall() - self._anchor) * self._rate * NANOSECONDS
        return min(self._now + int(elapsed), self.end)

    def _set(self, now: int) -> None:
        self._now, self._anchor = now, self.wall()

    @property
    def paused(self) -> bool:
        """Whether it stands still."""
        return self._paused

    @property
    def rate(self) -> float:
        """Recorded time per wall time."""
        return self._rate

    @property
    def finished(self) -> bool:
        """Whether everything has been played."""
        return self._next is None

    def pause(self) -> None:
        """Stand still."""
        self._set(self.now)
        self._paused = True

    def resume(self) -> None:
        """Go on; from the beginning, if the end had been reached."""
        if self.finished:
            self.seek(self.start)
        if self._paused:
            self._paused = False
            self._anchor = self.wall()

    def set_rate(self, rate: float) -> bool:
        """Play at another rate; refused unless it is above zero and finite."""
        if not math.isfinite(rate) or rate <= 0.0:
            return False
        self._set(self.now)
        self._rate = float(rate)
        return True

    def seek(self, stamp: int) -> bool:
        """Go on from another moment; refused outside the recording.

        Listeners get anew what is latched at that moment, and the last state before it.
        """
        if not self.start <= stamp <= self.end:
            return False
        self._set(stamp)
        self._begin(stamp)
        if stamp > self.start:
            self._show(stamp)
        return True

    def _begin(self, stamp: int) -> None:
        """Have the messages from ``stamp`` on ready."""
        if self.output is not None:
            self.output.renew()
        self._items = (
            (when, channel.topic, present_bytes(channel, data))
            for channel, when, data in self.bag.messages(self._is_played, start=stamp)
            # Those latched until now are shown at once.
            if not (stamp > self.start and when <= stamp and self._is_latched(channel))
        )
        self._next = next(self._items, None)

    def _show(self, stamp: int) -> None:
        """Publish what is latched at a moment, and the last state before it."""
        if self.output is None:
            return
        for _, topic, data in self._latched[: bisect.bisect_right(self._latched_times, stamp)]:
            self.output.publish(topic, data)
        last: dict[str, bytes] = {}
        early = max(self.start, stamp - LOOK_BACK)
        for channel, _, data in self.bag.messages(self._is_played, start=early, stop=stamp):
            if not self._is_latched(channel):
                last[channel.topic] = present_bytes(channel, data)
        for topic, data in last.items():
            self.output.publish(topic, data)

    # --- playing -------------------------------------------------------------------------------

    def work(self) -> float:
        """Publish what is due; gives the wall time until which nothing is."""
        began = self.wall()
        if self._paused:
            return began + IDLE
        if self._next is None:
            return self._at_end(began)
        late = (self.now - self._next[0]) / NANOSECONDS / self._rate
        if late > STALL:
            # The machine stood still: go on from here, without a burst.
            self._set(self._next[0])
        while self._next is not None and self._next[0] <= self.now:
            self._send()
            if self.wall() - began > SLICE:
                return began
        if self._next is None:
            return self._at_end(began)
        wait = (self._next[0] - self.now) / NANOSECONDS / self._rate
        return self.wall() + min(wait, IDLE)

    def _at_end(self, began: float) -> float:
        if not self.loop:
            self.pause()
            return began + IDLE
        self.laps += 1
        self.seek(self.start)
        return began

    def _send(self) -> None:
        if self._next is None:
            return
        _, topic, data = self._next
        if self.output is not None:
            self.output.publish(topic, data)
        self._next = next(self._items, None)

    def send_present(self) -> None:
        """Publish what belongs to the present moment, without going on."""
        while self._next is not None and self._next[0] <= self.now:
            self._send()

    def play_next(self) -> bool:
        """Publish the next message; only while paused, and not at the end."""
        if not self._paused or self._next is None:
            return False
        self._set(self._next[0])
        self._send()
        return True

    def burst(self, count: int) -> int:
        """Publish so many messages at once, 0 for all that are left; only while paused."""
        steps = itertools.count() if count == 0 else range(count)
        return sum(1 for _ in itertools.takewhile(lambda _: self.play_next(), steps))
