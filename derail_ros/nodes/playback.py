"""Playback of a recording for the node ``player``, without ROS."""

from __future__ import annotations

import bisect
import fnmatch
import itertools
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path

from derail_ros.nodes.outputs import Output
from derail_ros.nodes.time_base import time_base
from derail_ros.recording.channels import Channel
from derail_ros.recording.decoding import present_bytes
from derail_ros.recording.storage import BagError, open_bag
from msg_adapters.common import NANOSECONDS

IDLE = 0.1
"""Wall time after which the player goes round even if nothing is due, s."""
SLICE = 0.01
"""Wall time of publishing after which requests are served, s."""
STALL = 0.5
"""Lateness that is made up for, s."""
LOOK_BACK = 2 * NANOSECONDS
"""How far back a seek looks for the last state of everything, ns."""
RATES = (1e-3, 1000.0)
"""Rates that can be set."""
OWN_CLOCK = ("/clock",)
"""Topics that the player makes itself."""

Item = tuple[int, str, bytes]
"""Time (ns), topic and CDR bytes."""


class Playback:
    """A recording that is played; it must be whole. ``output`` may be set later.

    ``topics`` are those to play, ``exclude`` those not to: names as in the recording, or patterns
    as of a shell. Without ``topics`` all are played.

    Attributes
    ----------
    start, end : times of the log of the first and last message, ns
    base : simulation time over the times of the log
    channels : the topics that are played
    unmatched : names and patterns of ``exclude`` that the recording has no topic of
    rate : recorded time per wall time
    paused : time stands still
    loop : start again at the end
    moved : called when a seek has changed the time, before anything of the new time is published
    laps : how often it has started again
    stopped : a client has stopped the player

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
        topics: Sequence[str] = (),
        exclude: Sequence[str] = (),
    ) -> None:
        self.bag = open_bag(path)
        if not self.bag.intact:
            raise BagError(f"{path}: the recording is cut off; repair it: derail repair {path}")
        self.output = output
        self.loop = False
        self.moved: Callable[[], None] = lambda: None
        self.stopped = False
        self.laps = 0
        span = self.bag.span()
        if next(self.bag.messages(lambda c: not c.is_manifest), None) is None:
            span = None
        if span is None:
            raise BagError(f"{self.bag.path}: no message in it")
        self.start, self.end = span
        self.base = time_base(self.bag)
        self.unmatched: list[str] = []
        self.channels = self._chosen(topics, exclude)
        self._names = {c.topic for c in self.channels}
        self._latched_names = {c.topic for c in self.channels if c.latched}
        self._latched: list[Item] = [
            (stamp, channel.topic, present_bytes(channel, data))
            for channel, stamp, data in self.bag.messages(self._is_latched)
        ]
        self._wall = wall
        self.rate = 1.0
        self.paused = True
        self._now = self.start
        self._anchor = wall()
        self._next: Item | None = None
        self._items: Iterator[Item] = iter(())
        self._begin(self.start)

    def _is_latched(self, channel: Channel) -> bool:
        return channel.topic in self._latched_names

    def _is_played(self, channel: Channel) -> bool:
        return channel.topic in self._names

    def _chosen(self, topics: Sequence[str], exclude: Sequence[str]) -> list[Channel]:
        """The topics that are played."""
        known = [c.topic for c in self.bag.channels if c.topic not in OWN_CLOCK]

        def named(patterns: Sequence[str], unmatched: list[str]) -> set[str]:
            found: set[str] = set()
            for pattern in patterns:
                matches = fnmatch.filter(known, f"/{pattern.lstrip('/')}")
                if not matches:
                    unmatched.append(pattern)
                found |= set(matches)
            return found

        missing: list[str] = []
        wanted = named(topics, missing)
        if missing:
            have = ", ".join(known)
            raise BagError(f"topics: no topic {missing[0]} in {self.bag.path}; it has {have}")
        names = (wanted or set(known)) - named(exclude, self.unmatched)
        if not names:
            raise BagError(f"exclude: nothing of {self.bag.path} is left to play")
        return [c for c in self.bag.channels if c.topic in names]

    def close(self) -> None:
        """Close the recording."""
        self._items = iter(())

    # --- time --------------------------------------------------------------------------------

    @property
    def now(self) -> int:
        """Time of the log, ns."""
        if self.paused:
            return self._now
        elapsed = (self._wall() - self._anchor) * self.rate * NANOSECONDS
        return min(self._now + int(elapsed), self.end)

    @property
    def clock(self) -> int:
        """Simulation time, ns."""
        return self.base.time(self.now)

    def _set(self, now: int) -> None:
        self._now, self._anchor = now, self._wall()

    @property
    def finished(self) -> bool:
        """Whether everything has been played."""
        return self._next is None

    def pause(self) -> None:
        """Let time stand still."""
        self._set(self.now)
        self.paused = True

    def resume(self) -> None:
        """Go on, from the start if the end had been reached."""
        if self.finished:
            self.seek(self.start)
        if self.paused:
            self.paused = False
            self._anchor = self._wall()

    def set_rate(self, rate: float) -> bool:
        """Play at another rate; refused outside of :data:`RATES`."""
        if not RATES[0] <= rate <= RATES[1]:
            return False
        self._set(self.now)
        self.rate = float(rate)
        return True

    def seek_time(self, time: int) -> bool:
        """Go on from another simulation time (ns); refused outside the recording."""
        stamp = self.base.log(time)
        return stamp is not None and self.seek(stamp)

    def seek(self, stamp: int) -> bool:
        """Go on from another time of the log (ns); refused outside the recording.

        Subscribers get again what is latched at that moment, and the last state before it.
        """
        if not self.start <= stamp <= self.end:
            return False
        self._set(stamp)
        self.moved()
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
            # A seek shows those that are latched until then.
            if not (stamp > self.start and when <= stamp and self._is_latched(channel))
        )
        self._next = next(self._items, None)

    def _show(self, stamp: int) -> None:
        """Publish what is latched at a moment, and the last state before it."""
        if self.output is None:
            return
        shown = bisect.bisect_right(self._latched, stamp, key=lambda item: item[0])
        for _, topic, data in self._latched[:shown]:
            self.output.publish(topic, data)
        for topic, data in self._last(stamp).items():
            self.output.publish(topic, data)

    def show_again(self, topics: Collection[str]) -> None:
        """Publish the last message until now of topics that are not latched."""
        for topic, data in self._last(self.now + 1).items():
            if topic in topics and self.output is not None:
                self.output.publish(topic, data)

    def _last(self, stamp: int) -> dict[str, bytes]:
        """The last message before a moment of each topic that is not latched."""
        last: dict[str, bytes] = {}
        early = max(self.start, stamp - LOOK_BACK)
        for channel, _, data in self.bag.messages(self._is_played, start=early, stop=stamp):
            if not self._is_latched(channel):
                last[channel.topic] = present_bytes(channel, data)
        return last

    # --- playing -----------------------------------------------------------------------------

    def work(self) -> float:
        """Publish what is due; return the wall time of the next message."""
        began = self._wall()
        if self.paused:
            return began + IDLE
        if self._next is not None and self._seconds_to(self._next) < -STALL:
            # The machine stood still: go on from here, without a burst.
            self._set(self._next[0])
        while self._next is not None and self._next[0] <= self.now:
            self._send()
            if self._wall() - began > SLICE:
                return began
        if self._next is not None:
            return self._wall() + min(self._seconds_to(self._next), IDLE)
        if not self.loop:
            self.pause()
            return began + IDLE
        self.laps += 1
        self.seek(self.start)
        return began

    def _seconds_to(self, item: Item) -> float:
        """Wall time until a message is due, s."""
        return (item[0] - self.now) / NANOSECONDS / self.rate

    def _send(self) -> None:
        if self._next is None:
            return
        if self.output is not None:
            self.output.publish(*self._next[1:])
        self._next = next(self._items, None)

    def send_present(self) -> None:
        """Publish what belongs to the present moment, without going on."""
        while self._next is not None and self._next[0] <= self.now:
            self._send()

    def play_next(self) -> bool:
        """Publish the next message; only while paused, and not at the end."""
        if not self.paused or self._next is None:
            return False
        self._set(self._next[0])
        self._send()
        return True

    def burst(self, count: int) -> int:
        """Publish this many messages at once, 0 for all that are left; only while paused."""
        steps = itertools.count() if count == 0 else range(count)
        return sum(1 for _ in itertools.takewhile(lambda _: self.play_next(), steps))
