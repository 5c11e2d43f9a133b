"""Small pieces that every message needs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from msg_adapters.definitions import message_class

NANOSECONDS = 1_000_000_000
TIME_ZERO = NANOSECONDS
"""Simulation time at which the first run begins, and one after a reset of time, ns. Above zero,
which for clocks, transforms and recorders of ROS means that a time is not set."""


def nanoseconds(seconds: float) -> int:
    """Time in whole nanoseconds, rounded to the nearest."""
    return round(seconds * NANOSECONDS)


def time_message(stamp: int) -> Any:
    """``builtin_interfaces/Time`` of a time in nanoseconds."""
    return message_class("builtin_interfaces/msg/Time")(*divmod(stamp, NANOSECONDS))


def header(stamp: int, frame_id: str) -> Any:
    """``std_msgs/Header`` at a time in nanoseconds."""
    return message_class("std_msgs/msg/Header")(time_message(stamp), frame_id)


def stamp_of(message: Any) -> int:
    """Time of a message's header in nanoseconds."""
    stamp = message.header.stamp
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)


def stamp_of_bytes(data: bytes) -> int:
    """Time in nanoseconds of a serialised message that begins with a header or a time."""
    order: Literal["little", "big"] = "little" if data[1] & 1 else "big"
    return int.from_bytes(data[4:8], order, signed=True) * NANOSECONDS + int.from_bytes(
        data[8:12], order
    )


SENTINEL = 1.2345678912345e200
SENTINEL_SECONDS = 0x7A5C3E12
"""Mark, in a template of a message, the places that are renewed; nothing else looks like them."""


@dataclass(frozen=True)
class RunContext:
    """What all messages of a run carry, and how run time becomes simulation time.

    Attributes
    ----------
    run_id : identity of the run
    base : simulation time at which the run began, ns
    frame_id : inertial frame
    """

    run_id: str
    base: int = TIME_ZERO
    frame_id: str = "map"

    def stamp(self, time: float) -> int:
        """Simulation time in nanoseconds of the run time ``time`` (s)."""
        return self.base + nanoseconds(time)

    def header(self, time: float) -> Any:
        """Header of a message at the run time ``time`` (s)."""
        return header(self.stamp(time), self.frame_id)


class SentinelContext(RunContext):
    """Marks the time stamps of a template."""

    def stamp(self, time: float) -> int:
        """A time that nothing else has."""
        return SENTINEL_SECONDS * NANOSECONDS
