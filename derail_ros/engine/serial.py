"""States as bytes: a checksum, a JSON header and raw arrays; nothing executable."""

from __future__ import annotations

import hashlib
import json
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from derail_ros.vocabulary.errors import StateFormatError

MAGIC = b"derail-state\0"
VERSION = 1
_DIGEST = 32


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
