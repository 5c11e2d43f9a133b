"""Parameters, events and commands as plain data for JSON, and back."""

from __future__ import annotations

import collections.abc
import dataclasses
import types
import typing
from typing import Any

import numpy as np

from derail_ros.vocabulary.errors import StateFormatError


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
