"""States as bytes: a checksum, a JSON header and raw arrays; nothing executable."""

from __future__ import annotations

import collections.abc
import dataclasses
import hashlib
import json
import struct
import types
import typing
from typing import Any

import numpy as np
from numpy.typing import NDArray

from derail_ros.vocabulary.errors import StateFormatError

MAGIC = b"derail-state\0"
VERSION = 1
_DIGEST = 32


def to_plain(value: Any) -> Any:
    """Dataclasses and tuples as dictionaries and lists, for JSON.

    A field marked ``left_out_at_default`` came later than the format: at its default it is left
    out, so that states keep their bytes and older ones are read.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {
            f.name: to_plain(getattr(value, f.name))
            for f in dataclasses.fields(value)
            if not (_may_lack(f) and getattr(value, f.name) == _default(f))
        }
    if isinstance(value, (tuple, list)):
        return [to_plain(v) for v in value]
    if isinstance(value, dict):
        return {str(k): to_plain(v) for k, v in value.items()}
    if isinstance(value, (np.integer, np.floating)):
        return value.item()
    if isinstance(value, int) and not isinstance(value, bool):
        return int(value)
    return value


def _may_lack(f: dataclasses.Field[Any]) -> bool:
    return bool(f.metadata.get("left_out_at_default", False))


def _default(f: dataclasses.Field[Any]) -> Any:
    return f.default_factory() if callable(f.default_factory) else f.default


def from_plain(kind: Any, value: Any) -> Any:
    """The inverse of `to_plain` for an annotated type."""
    origin = typing.get_origin(kind)
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        hints = typing.get_type_hints(kind)
        names = {f.name for f in dataclasses.fields(kind)}
        if isinstance(value, dict):
            later = {f.name: f for f in dataclasses.fields(kind) if _may_lack(f)}
            missing = {k: to_plain(_default(f)) for k, f in later.items() if k not in value}
            value = {**value, **missing}
        if not isinstance(value, dict) or set(value) != names:
            raise StateFormatError(f"fields of {kind.__name__} do not match this version")
        return kind(**{name: from_plain(hints[name], value[name]) for name in names})
    if origin is tuple:
        args = typing.get_args(kind)
        if len(args) == 2 and args[1] is Ellipsis:
            return tuple(from_plain(args[0], v) for v in value)
        return tuple(from_plain(a, v) for a, v in zip(args, value, strict=True))
    if origin in (typing.Union, types.UnionType):
        return value
    if origin in (dict, collections.abc.Mapping) or kind is object:
        return value
    return kind(value) if isinstance(kind, type) else value


def pack(header: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> bytes:
    """Header and arrays as bytes; the same content gives the same bytes."""
    table = []
    parts = []
    for name, array in arrays.items():
        data = np.ascontiguousarray(array)
        table.append([name, data.dtype.str, list(data.shape)])
        parts.append(data.tobytes())
    text = json.dumps(
        {"version": VERSION, "header": header, "arrays": table}, sort_keys=True
    ).encode()
    body = struct.pack("<Q", len(text)) + text + b"".join(parts)
    return MAGIC + hashlib.sha256(body).digest() + body


def unpack(data: bytes) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """The inverse of `pack`; raises `StateFormatError` for anything else."""
    if not isinstance(data, (bytes, bytearray)) or not data.startswith(MAGIC):
        raise StateFormatError("these bytes are not a saved simulation state")
    at = len(MAGIC) + _DIGEST
    # Checked before anything is believed: kernels index by what the arrays say.
    if hashlib.sha256(data[at:]).digest() != data[len(MAGIC) : at]:
        raise StateFormatError("the saved state is damaged (its checksum does not match)")
    try:
        (length,) = struct.unpack_from("<Q", data, at)
        at += 8
        top = json.loads(bytes(data[at : at + length]))
        version = top["version"]
        if version != VERSION:
            raise StateFormatError(f"state version {version}; this engine reads {VERSION}")
        at += length
        arrays = {}
        for name, dtype, shape in top["arrays"]:
            kind = np.dtype(dtype)
            if kind.kind not in "fiu":
                raise StateFormatError(f"array {name} has the type {dtype}")
            count = int(np.prod(shape, dtype=np.int64))
            array = np.frombuffer(data, dtype=kind, count=count, offset=at)
            arrays[name] = array.reshape(shape).copy()
            at += count * kind.itemsize
    except StateFormatError:
        raise
    except (KeyError, ValueError, TypeError, struct.error) as error:
        raise StateFormatError(f"the saved state is damaged ({error})") from error
    if at != len(data):
        raise StateFormatError("the saved state is damaged (bytes are left over)")
    return top["header"], arrays
