"""Messages of a recording as objects, for each version of the interface."""

from __future__ import annotations

import functools
from collections.abc import Collection
from typing import Any

from rosbags.typesys import get_types_from_msg

from derail_ros.recording.channels import Channel, one_line
from derail_ros.recording.storage import BagVersionError, OtherTopicsError, RawBag
from msg_adapters.definitions import (
    VERSION,
    deserialize,
    read_copy,
    serialize,
    type_hash,
    typestore,
)

PACKAGE = "derail_msgs/msg/"
VERSIONS = (VERSION, 1)
"""Versions of the messages that are read, the present one first."""


@functools.cache
def version_of(channel: Channel) -> int | None:
    """Version of a channel's messages; ``None`` if the recording does not say.

    Raises
    ------
    BagVersionError
        If it is none that is read here.
    """
    known = [v for v in VERSIONS if channel.msgtype in read_copy(v)]
    if not channel.definition:
        same = (v for v in known if channel.digest == type_hash(channel.msgtype, v))
        return next(same, None)
    try:
        own_part = channel.definition.split("\n====", 1)[0]
        constants, fields = get_types_from_msg(own_part, channel.msgtype)[channel.msgtype]
    except Exception as error:  # rosbags raises several kinds
        raise BagVersionError(
            f"the definition of {channel.msgtype} in it cannot be read ({one_line(error)})"
        ) from None
    version = next((value for name, _, value in constants if name == "INTERFACE_VERSION"), 0)
    names = [name for name, _ in fields]
    for v in known:
        if v == version and names == [n for n, _ in typestore(v).fielddefs[channel.msgtype][1]]:
            return v
    raise BagVersionError(
        f"{channel.msgtype} in it is of version {version} with {len(fields)} fields; this"
        f" derail_ros reads versions {' and '.join(str(v) for v in sorted(VERSIONS))}"
    )


def decode(channel: Channel, data: bytes) -> Any:
    """A message from its CDR bytes; one of an earlier version as one of the present.

    Raises
    ------
    Exception
        Of any kind, if the bytes are no such message.
    """
    if not channel.msgtype.startswith(PACKAGE):
        return deserialize(data, channel.msgtype)
    version = version_of(channel)
    if version is not None:
        return deserialize(data, channel.msgtype, version)
    try:
        return deserialize(data, channel.msgtype)
    except Exception:  # bytes of the other version are too few or too many
        return deserialize(data, channel.msgtype, 1)


def present_bytes(channel: Channel, data: bytes) -> bytes:
    """CDR bytes of a message as the present version has it.

    Raises
    ------
    Exception
        Of any kind, if the bytes are no such message.
    """
    if not is_known(channel) or version_of(channel) == VERSION:
        return data
    return serialize(decode(channel, data))


def check_version(bag: RawBag) -> None:
    """Check that a recording is of a derailment, in messages that are read here.

    Raises
    ------
    OtherTopicsError
        If no topic of it is of a derailment simulator.
    BagVersionError
        If its messages are of another version.
    """
    ours = [c for c in bag.channels if c.msgtype.startswith(PACKAGE)]
    if not ours:
        names = ", ".join(sorted(c.topic for c in bag.channels)[:4]) or "none"
        raise OtherTopicsError(
            f"{bag.path}: a recording, but not of a derailment (its topics: {names})"
        )
    for channel in ours:
        if not is_known(channel):
            bag.warn(f"{channel.topic} was skipped: unknown type {channel.msgtype}")
            continue
        try:
            version_of(channel)
        except BagVersionError as error:
            raise BagVersionError(f"{bag.path}: {error}") from None


def is_known(channel: Channel) -> bool:
    """Whether messages of a channel's type are read here."""
    return any(channel.msgtype in read_copy(v) for v in VERSIONS)


def namespace_of(channels: Collection[Channel], namespace: str | None) -> tuple[str, list[str]]:
    """The namespace to read, and all there are in a recording.

    Raises
    ------
    OtherTopicsError
        If the namespace asked for is not in it.
    """
    found = sorted(
        {c.namespace for c in channels if c.msgtype == f"{PACKAGE}TrainState"}
        or {c.namespace for c in channels if c.msgtype.startswith(PACKAGE)}
    )
    if namespace is None:
        return found[0], found
    wanted = "/" + namespace.strip("/") if namespace.strip("/") else ""
    if wanted not in found:
        there = ", ".join(f"{n or '/'}" for n in found)
        raise OtherTopicsError(f"no train in namespace {wanted or '/'}; found: {there}")
    return wanted, found
