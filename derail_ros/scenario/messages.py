"""One clear sentence from pydantic's list of errors."""

from __future__ import annotations

import difflib
import typing
from collections.abc import Iterable
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from derail_ros.scenario.errors import Refusal
from derail_ros.scenario.strict_yaml import Path

M = TypeVar("M", bound=BaseModel)

_KINDS = {
    "float_type": "must be a number",
    "int_type": "must be a whole number",
    "bool_type": "must be true or false",
    "string_type": "must be text",
    "tuple_type": "must be a list",
    "dict_type": "must be a mapping of keys to values",
    "model_type": "must be a mapping of keys to values",
    "finite_number": "must be a finite number",
}
_LIMITS = {
    "greater_than": ("gt", "must be above"),
    "greater_than_equal": ("ge", "must be at least"),
    "less_than": ("lt", "must be below"),
    "less_than_equal": ("le", "must be at most"),
}


def validated(model: type[M], data: Any) -> M:
    """Plain data as a model.

    Raises
    ------
    Refusal
        With the first mistake: a misspelt key explains a missing one, not the reverse.
    """
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise _first_mistake(error, model) from None


def _first_mistake(error: ValidationError, model: type[BaseModel]) -> Refusal:
    errors = error.errors(include_url=False, include_context=True)
    order = {"extra_forbidden": 0, "missing": 2}
    chosen = min(errors, key=lambda e: order.get(e["type"], 1))
    path = tuple(step for step in chosen["loc"] if step != "[key]")
    return Refusal(path, _reason(dict(chosen), path, model))


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """``"; did you mean 'x'?"`` for the nearest of the known words, or nothing."""
    names = list(known)
    near = difflib.get_close_matches(word, names, n=1, cutoff=0.6)
    if not near:
        # speed -> speed_kmh: the unit was left out
        near = [name for name in names if name.startswith(f"{word}_")][:1]
    return f"; did you mean {near[0]!r}?" if near else ""


def shown(value: Any) -> str:
    """A value as it is shown in a message: short, and printable whatever it is."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, dict):
        return "a mapping"
    if isinstance(value, (list, tuple)):
        return "a list"
    if isinstance(value, str):
        return repr(value if len(value) <= 40 else value[:40] + "...")
    if isinstance(value, float):
        return f"{value:.10g}"
    return repr(value)[:40]


def _reason(error: dict[str, Any], path: Path, model: type[BaseModel]) -> str:
    kind = error["type"]
    context = error.get("ctx", {})
    value = error["input"]
    if kind == "extra_forbidden":
        owner = model_at(model, path[:-1])
        known = owner.model_fields if owner else ()
        return f"unknown key{did_you_mean(str(path[-1]), known)}"
    if kind == "missing":
        return "is required"
    if kind in _KINDS:
        return f"{_KINDS[kind]}, got {shown(value)}"
    if kind in _LIMITS:
        name, words = _LIMITS[kind]
        return f"{words} {shown(context[name])}, got {shown(value)}"
    if kind == "literal_error":
        hint = did_you_mean(value, _choices(context)) if isinstance(value, str) else ""
        return f"must be {context['expected']}, got {shown(value)}{hint}"
    if kind == "too_short":
        least = context["min_length"]
        return f"must have at least {'one entry' if least == 1 else f'{least} entries'}"
    if kind == "too_long":
        return f"has more than {context['max_length']} entries"
    if kind == "string_too_long":
        return f"is longer than {context['max_length']} characters"
    if kind == "string_too_short":
        return "must not be empty"
    if kind == "string_pattern_mismatch":
        return f"must be a name of letters, digits, '_' and '-', got {shown(value)}"
    return f"{error['msg'].lower()}, got {shown(value)}"


def _choices(context: dict[str, Any]) -> list[str]:
    return [word for word in context["expected"].split("'") if word.strip(" ,or")]


def model_at(model: type[BaseModel], path: Path) -> type[BaseModel] | None:
    """The model that describes the value at ``path`` below ``model``."""
    current: Any = model
    for step in path:
        inner = _model_in(current)
        if isinstance(step, str) and inner is not None and inner is current:
            info = inner.model_fields.get(step)
            if info is None:
                return None
            current = info.annotation
        else:  # an item of a list, or a key of a free mapping
            current = inner
        if current is None:
            return None
        # lists and mappings keep their annotation for one more step
        if not _is_container(current):
            current = _model_in(current)
    return _model_in(current)


def _is_container(annotation: Any) -> bool:
    return typing.get_origin(annotation) in (tuple, dict)


def _model_in(annotation: Any) -> type[BaseModel] | None:
    """The first model class within an annotation."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for part in typing.get_args(annotation):
        found = _model_in(part)
        if found is not None:
            return found
    return None
