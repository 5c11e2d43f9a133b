"""The definitions of all messages, with and without an installed ROS.

Messages are built and serialised by ``rosbags`` from the ``.msg`` texts of ``derail_msgs``. A copy
of these texts travels with this package (``definitions.json``), so that a run can be recorded
where no ROS is installed; ``python -m msg_adapters.definitions`` renews the copy, and a test holds
it equal to the files.
"""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

COPY = Path(__file__).resolve().with_name("definitions.json")
FORMER = Path(__file__).resolve().with_name("definitions_1.json")
"""Definitions of version 1 of the messages, for recordings that hold them."""
VERSION = 2
SOURCE = Path(__file__).resolve().parent.parent / "derail_msgs" / "msg"
PACKAGE = "derail_msgs"


def read_sources() -> dict[str, str]:
    """The ``.msg`` files of ``derail_msgs``: type name -> text."""
    return {
        f"{PACKAGE}/msg/{path.stem}": path.read_text(encoding="utf-8")
        for path in sorted(SOURCE.glob("*.msg"))
    }


@functools.cache
def read_copy(version: int = VERSION) -> dict[str, str]:
    """The texts that travel with this package: type name -> text."""
    path = COPY if version == VERSION else FORMER
    texts: dict[str, str] = json.loads(path.read_text(encoding="utf-8"))
    return texts


@functools.cache
def typestore(version: int = VERSION) -> Any:
    """Type store with the messages of ROS 2 Kilted and of a version of ``derail_msgs``.

    The messages used here (geometry, visualization, diagnostics) are the same in every
    distribution since Humble.
    """
    store = get_typestore(Stores.ROS2_KILTED)
    types: dict[str, Any] = {}
    for name, text in read_copy(version).items():
        types.update(get_types_from_msg(text, name))
    store.register(types)
    return store


@functools.cache
def message_class(typename: str) -> Any:
    """Class of a message, for example ``derail_msgs/msg/TrainState``."""
    return typestore().types[typename]


def serialize(message: Any) -> bytes:
    """CDR bytes of a message, as they go over the wire and into a recording."""
    return bytes(typestore().serialize_cdr(message, message.__msgtype__))


def deserialize(data: bytes, typename: str, version: int = VERSION) -> Any:
    """Message of the given type from its CDR bytes; one of version 1 comes as one of today."""
    message = typestore(version).deserialize_cdr(data, typename)
    if version == VERSION or not typename.startswith(f"{PACKAGE}/"):
        return message
    from msg_adapters.version_1 import upgraded

    return upgraded(message)


def type_hash(typename: str, version: int = VERSION) -> str:
    """REP 2011 hash of a type, as recordings and graphs give it: ``RIHS01_...``."""
    return str(typestore(version).hash_rihs01(typename))


def field_names(typename: str) -> list[str]:
    """Names of the fields of a message, in order."""
    return [name for name, _ in typestore().fielddefs[typename][1]]


@functools.cache
def fields_of(typename: str) -> tuple[tuple[str, str], ...]:
    """Names and types of the fields of a message, in order: ``float64``, ``float64[]``, ...

    For messages of numbers, texts, other messages and sequences of these.
    """
    found = []
    for name, (kind, what) in typestore().fielddefs[typename][1]:
        if kind is Nodetype.NAME:
            found.append((name, str(what)))
        elif kind is Nodetype.BASE:
            found.append((name, str(what[0])))
        else:
            inner, of = what[0]
            found.append((name, f"{of if inner is Nodetype.NAME else of[0]}[]"))
    return tuple(found)


def main() -> None:
    """Renew the copy from the files."""
    COPY.write_text(json.dumps(read_sources(), indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
