"""Topics of a recording and their messages, whatever its storage."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rosbags.interfaces import Qos, QosDurability
from rosbags.rosbag2.metadata import parse_qos

from msg_adapters.topics import MANIFEST


@dataclass(frozen=True)
class Channel:
    """A topic of a recording."""

    topic: str
    msgtype: str  # for example ``derail_msgs/msg/TrainState``
    definition: str = ""  # text of the message definition, "" if the recording has none
    qos: tuple[Qos, ...] = ()  # of its publishers
    digest: str = ""  # hash of the type description, "" if unknown

    @property
    def namespace(self) -> str:
        """The topic's name without its last part."""
        return self.topic.rpartition("/")[0]

    @property
    def name(self) -> str:
        """Last part of the topic's name."""
        return self.topic.rpartition("/")[2]

    @property
    def kind(self) -> str:
        """Last part of the type's name."""
        return self.msgtype.rpartition("/")[2]

    @property
    def is_manifest(self) -> bool:
        """Whether its messages are manifests."""
        return self.name == MANIFEST.name and self.msgtype == MANIFEST.msgtype

    @property
    def latched(self) -> bool:
        """Whether a late subscriber gets the last messages."""
        return any(profile.durability == QosDurability.TRANSIENT_LOCAL for profile in self.qos)


Message = tuple[Channel, int, bytes]
"""Channel, time (ns) and CDR bytes."""
Span = tuple[int, int]
"""First and last time, ns."""
Wanted = Callable[[Channel], bool]
"""Whether the messages of a channel are asked for."""


def parse_profiles(text: str) -> tuple[Qos, ...]:
    """Profiles as a recording writes them; none where this rosbags does not know them."""
    try:
        return tuple(parse_qos(text))
    except Exception:  # rosbags raises several kinds
        return ()


def one_line(error: BaseException | Any) -> str:
    """The text of an error in one line."""
    return " ".join(str(error).split()).rstrip(".") or type(error).__name__
