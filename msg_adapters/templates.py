"""Messages of which only the time and some numbers change: their bytes, patched in place."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from msg_adapters.common import NANOSECONDS, SENTINEL, SENTINEL_SECONDS, SentinelContext
from msg_adapters.definitions import message_class, serialize

if TYPE_CHECKING:
    from numpy.typing import NDArray

MARKED = SentinelContext("", 0, "")


def marked_header(frame_id: str) -> Any:
    """A header whose time a :class:`Template` renews."""
    return message_class("std_msgs/msg/Header")(MARKED.header(0.0).stamp, frame_id)


def vector(*values: float) -> Any:
    """``geometry_msgs/Vector3``; without values it is renewed."""
    return message_class("geometry_msgs/msg/Vector3")(*(values or (SENTINEL,) * 3))


def quaternion(*values: float) -> Any:
    """``geometry_msgs/Quaternion``; without values it is renewed."""
    return message_class("geometry_msgs/msg/Quaternion")(*(values or (SENTINEL,) * 4))


class Template:
    """The bytes of a message: marked times and doubles (``SENTINEL``) are renewed in each call."""

    def __init__(self, message: Any) -> None:
        data = serialize(message)
        self._size = len(data)
        self._data = bytearray(data + bytes(-(len(data) - 4) % 8))
        # After the encapsulation of 4 bytes doubles are aligned to 8.
        self._doubles = np.frombuffer(self._data, "<f8", offset=4)
        self._words = np.frombuffer(self._data, "<u4", offset=4)
        self._places = np.flatnonzero(self._doubles == SENTINEL)
        self._seconds = np.flatnonzero(self._words == SENTINEL_SECONDS)

    def __call__(self, stamp: int, values: NDArray[np.float64]) -> bytes:
        """CDR bytes at a time (ns), with the doubles in the order of the message."""
        self._words[self._seconds], self._words[self._seconds + 1] = divmod(stamp, NANOSECONDS)
        self._doubles[self._places] = values
        return bytes(memoryview(self._data)[: self._size])
