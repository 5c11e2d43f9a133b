"""The time of a recording, from its messages, not from its log.

``ros2 bag record`` logs the wall time at which a message came; the messages bear simulation time.
A player that sent `/clock` from the log and messages as they are would give its listeners two
times that are decades apart.
"""

from __future__ import annotations

import bisect
from collections.abc import Iterable, Iterator

import numpy as np

from derail_ros.recording.channels import Channel
from derail_ros.recording.decoding import is_known
from derail_ros.recording.storage import RawBag
from msg_adapters.common import NANOSECONDS, stamp_of_bytes
from msg_adapters.definitions import typestore

CLOCK_TYPE = "rosgraph_msgs/msg/Clock"
HEADER = "std_msgs/msg/Header"
APART = NANOSECONDS
"""Log and headers that differ by more than this have two times, ns: messages wait up to half a
second for earlier ones."""


def bears_a_time(channel: Channel) -> bool:
    """Whether the messages of a channel begin with a header."""
    fields = typestore().fielddefs.get(channel.msgtype, (None, []))[1]
    own = not channel.msgtype.startswith("derail_msgs/") or is_known(channel)
    return own and bool(fields) and str(fields[0][1][1]) == HEADER


class TimeBase:
    """Simulation time over the time of the log, both ns: straight lines between pairs.

    Without pairs the two are the same. Before the first pair and after the last one simulation
    time stands still.
    """

    def __init__(self, pairs: Iterable[tuple[int, int]] = ()) -> None:
        found = np.array(list(pairs), dtype=np.int64).reshape(-1, 2)
        self._log, self._time = found[:, 0], found[:, 1]

    def time(self, log: int) -> int:
        """Simulation time at a time of the log."""
        if not len(self._log):
            return log
        i = bisect.bisect_right(self._log, log)
        if i in (0, len(self._log)):
            return int(self._time[min(i, len(self._log) - 1)])
        (a, b), (s, t) = self._log[i - 1 : i + 1].tolist(), self._time[i - 1 : i + 1].tolist()
        # Where time begins anew there is nothing between.
        return s if t < s else s + (t - s) * (log - a) // (b - a)

    def log(self, time: int) -> int | None:
        """First time of the log at which simulation time has got as far; None if it never does."""
        if not len(self._log):
            return time
        reached = np.flatnonzero(self._time >= time)
        if not len(reached) or time < self._time.min():
            return None
        i = int(reached[0])
        if i == 0:
            return int(self._log[0])
        (a, b), (s, t) = self._log[i - 1 : i + 1].tolist(), self._time[i - 1 : i + 1].tolist()
        return a + -(-(time - s) * (b - a) // (t - s))


def _increasing(pairs: Iterator[tuple[int, int]]) -> Iterator[tuple[int, int]]:
    """Those whose time of the log is later than the one before."""
    last = -1
    for log, time in pairs:
        if log > last:
            last = log
            yield log, time


def time_base(bag: RawBag) -> TimeBase:
    """The time of a recording: its clock, else the headers if they differ from the log."""
    clocks = [c for c in bag.channels if c.msgtype == CLOCK_TYPE and c.topic == "/clock"]
    if clocks:
        ticks = bag.messages(lambda c: c in clocks)
        found = ((log, stamp_of_bytes(data)) for _, log, data in ticks)
        base = list(_increasing(found))
        if base:
            return TimeBase(base)
    for topic in sorted(filter(bears_a_time, bag.channels), key=lambda c: c.name != "train_state"):
        found = [
            (log, stamp_of_bytes(data))
            for _, log, data in bag.messages(lambda c, wanted=topic: c == wanted)
        ]
        if found:
            same = abs(found[0][0] - found[0][1]) <= APART
            return TimeBase(() if same else _increasing(iter(found)))
    return TimeBase()
