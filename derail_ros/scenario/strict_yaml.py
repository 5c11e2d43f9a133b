"""A strict YAML reader: plain data, and the line of every key and item.

A scenario may come from a stranger (a ROS service takes its text), so the reader works on the
parser's events and refuses what a description of a train does not need: anchors and aliases (and
with them alias bombs), tags, several documents, duplicate keys, keys that are not text, and more
than :data:`MAX_BYTES` or :data:`MAX_DEPTH`. Plain scalars follow YAML 1.2: ``1e6`` is a number,
``010`` is ten, and ``yes``, ``1:30`` and dates are text.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import yaml

from derail_ros.scenario.errors import Refusal, ScenarioError

MAX_BYTES = 512 * 1024
"""Largest text that is read, bytes of UTF-8."""

MAX_DEPTH = 32
"""Deepest nesting of mappings and lists."""

Path = tuple[str | int, ...]

# libyaml is about 20 times faster, which matters for a consist of 1000 cars; the loader in
# Python is there for a PyYAML built without it.
FAST_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)

_INT = re.compile(r"[-+]?[0-9]{1,18}\Z")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?\Z")
_SPECIAL = re.compile(r"((?P<inf>[-+]?\.(inf|Inf|INF))|\.(nan|NaN|NAN))\Z")
_WORDS = {"": None, "~": None, "null": None, "Null": None, "NULL": None} | {
    "true": True,
    "True": True,
    "TRUE": True,
    "false": False,
    "False": False,
    "FALSE": False,
}
_UNPRINTABLE = re.compile("[^\t\n\r\x20-\x7e\x85\xa0-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
_PLAIN_STEP = re.compile(r"[\w-]+\Z")


class Mark(NamedTuple):
    """Where a value was written: file and line (``None`` for an override)."""

    file: str
    line: int | None


@dataclass
class Document:
    """Plain data (dicts, lists, scalars) and the place of each of its keys and items.

    ``files`` are the files that it was read from: name -> content, this one first. ``written``
    has the keys that were given in another unit than that of their field: path of the field ->
    key. ``notes`` are warnings.
    """

    data: dict[str, Any]
    file: str
    marks: dict[Path, Mark] = field(default_factory=dict)
    files: dict[str, bytes] = field(default_factory=dict)
    written: dict[Path, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def mark(self, path: Path) -> Mark:
        """Place of the value at ``path``, or of the nearest thing around it."""
        for n in range(len(path), -1, -1):
            if path[:n] in self.marks:
                return self.marks[path[:n]]
        return Mark(self.file, None)

    def error(self, path: Path, reason: str) -> ScenarioError:
        """The error that names the place of ``path``."""
        key = self.written.get(path)
        if key is not None:
            reason, path = f"{reason} (as {path[-1]})", (*path[:-1], key)
        mark = self.mark(path)
        return ScenarioError(mark.file, mark.line, dotted(path), reason)

    @contextmanager
    def refusals(self) -> Iterator[None]:
        """Raise the error that names the place of each refusal within the block."""
        try:
            yield
        except Refusal as refusal:
            raise self.error(refusal.path, refusal.reason) from None


def dotted(path: Path) -> str:
    """``("train", "consist", 0)`` as ``"train.consist.0"``; odd keys are shown quoted."""
    return ".".join(_shown_step(step) for step in path)


def _shown_step(step: str | int) -> str:
    text = str(step)
    return text if _PLAIN_STEP.match(text) else repr(text[:40])


def plain_scalar(text: str) -> Any:
    """Value of an unquoted scalar: null, true, false, a number, or else the text itself."""
    if text in _WORDS:
        return _WORDS[text]
    if _INT.match(text):
        return int(text)
    if _FLOAT.match(text):
        # an integer too long for the first pattern lands here too: "999...9" may be infinite
        return float(text)
    special = _SPECIAL.match(text)
    if special:
        return float(text.replace(".", "")) if special["inf"] else float("nan")
    return text


def parse(text: str, file: str, loader: Any = FAST_LOADER) -> Document:
    """Read one YAML document whose top level is a mapping.

    Parameters
    ----------
    text
        The YAML text, at most :data:`MAX_BYTES` long.
    file
        What the errors call it.
    loader
        PyYAML loader class whose parser is used.

    Raises
    ------
    ScenarioError
        With the line of the first mistake.
    """
    reader = _Reader(file)
    value = reader.read(text, loader)
    if not isinstance(value, dict):
        reason = "is empty" if value is None else "must be a mapping of keys to values"
        raise ScenarioError(file, 1, "", reason)
    return Document(value, file, reader.marks)


def parse_value(text: str, file: str, name: str) -> Any:
    """Read a single value (a scalar, or a list or mapping in flow style)."""
    try:
        return _Reader(file).read(text, FAST_LOADER)
    except ScenarioError as error:
        raise ScenarioError(file, None, name, error.reason) from None


class _Reader:
    """Builds plain data from the parser's events and notes where everything stands."""

    def __init__(self, file: str) -> None:
        self.file = file
        self.marks: dict[Path, Mark] = {}

    def read(self, text: str, loader: Any) -> Any:
        self._check_text(text)
        try:
            events = yaml.parse(text, Loader=loader)
            return self._document(events)
        except yaml.MarkedYAMLError as error:
            mark = error.problem_mark or error.context_mark
            line = mark.line + 1 if mark else None
            reason = error.problem or error.context or "cannot be read"
            raise ScenarioError(self.file, line, "", f"not valid YAML: {reason}") from None
        except (yaml.YAMLError, UnicodeError) as error:
            reason = " ".join(str(error).split())
            raise ScenarioError(self.file, None, "", f"not valid YAML: {reason}") from None

    def _check_text(self, text: str) -> None:
        bad = _UNPRINTABLE.search(text)
        if bad:
            line = text.count("\n", 0, bad.start()) + 1
            reason = f"character U+{ord(bad[0]):04X} is not allowed"
            raise ScenarioError(self.file, line, "", reason)
        size = len(text.encode())
        if size > MAX_BYTES:
            reason = f"is {size // 1024 + 1} KB long, the limit is {MAX_BYTES // 1024} KB"
            raise ScenarioError(self.file, None, "", reason)

    def _document(self, events: Iterator[Any]) -> Any:
        value = None
        documents = 0
        for event in events:
            if isinstance(event, yaml.DocumentStartEvent):
                documents += 1
                if documents > 1:
                    raise self._error(event, (), "holds more than one YAML document")
            elif isinstance(event, yaml.NodeEvent):
                value = self._node(event, events, ())
        return value

    def _node(self, event: Any, events: Iterator[Any], path: Path) -> Any:
        if isinstance(event, yaml.AliasEvent) or event.anchor is not None:
            raise self._error(event, path, "YAML anchors and aliases are not allowed")
        if event.tag is not None:
            raise self._error(event, path, "YAML tags are not allowed")
        if len(path) > MAX_DEPTH:
            reason = f"nested deeper than {MAX_DEPTH} levels"
            raise self._error(event, path[:4], reason)
        self.marks.setdefault(path, Mark(self.file, event.start_mark.line + 1))
        if isinstance(event, yaml.ScalarEvent):
            # implicit[0]: written without quotes
            return plain_scalar(event.value) if event.implicit[0] else event.value
        if isinstance(event, yaml.SequenceStartEvent):
            return self._sequence(events, path)
        return self._mapping(events, path)

    def _sequence(self, events: Iterator[Any], path: Path) -> list[Any]:
        items: list[Any] = []
        for event in events:
            if isinstance(event, yaml.SequenceEndEvent):
                break
            items.append(self._node(event, events, (*path, len(items))))
        return items

    def _mapping(self, events: Iterator[Any], path: Path) -> dict[str, Any]:
        items: dict[str, Any] = {}
        for event in events:
            if isinstance(event, yaml.MappingEndEvent):
                break
            if isinstance(event, yaml.AliasEvent) or event.anchor is not None:
                raise self._error(event, path, "YAML anchors and aliases are not allowed")
            if not isinstance(event, yaml.ScalarEvent) or event.tag is not None:
                raise self._error(event, path, "keys must be plain text")
            key = event.value
            place = (*path, key)
            if key in items:
                first = self.marks[place].line
                raise self._error(event, place, f"duplicate key, first given on line {first}")
            start: Any = event.start_mark
            self.marks[place] = Mark(self.file, start.line + 1)
            items[key] = self._node(next(events), events, place)
        return items

    def _error(self, event: Any, path: Path, reason: str) -> ScenarioError:
        return ScenarioError(self.file, event.start_mark.line + 1, dotted(path), reason)


class _Dumper(yaml.SafeDumper):
    """Writes what :func:`parse` reads back as the same values."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def _represent_text(dumper: _Dumper, text: str) -> yaml.ScalarNode:
    # PyYAML thinks in YAML 1.1 and would leave "1e6" without quotes
    style = None if isinstance(plain_scalar(text), str) else "'"
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style=style)


def _represent_list(dumper: _Dumper, items: list[Any]) -> yaml.SequenceNode:
    flow = not any(isinstance(item, dict) for item in items)
    return dumper.represent_sequence("tag:yaml.org,2002:seq", items, flow_style=flow)


_Dumper.add_representer(str, _represent_text)
_Dumper.add_representer(list, _represent_list)


def flow(data: Any) -> str:
    """YAML text of a value in one line."""
    text: str = yaml.dump(
        data,
        Dumper=_Dumper,
        sort_keys=False,
        allow_unicode=True,
        default_flow_style=True,
        width=1e9,
    )
    return text.removesuffix("...\n").strip()


def dump(data: dict[str, Any]) -> str:
    """YAML text of plain data, keys in their order."""
    text: str = yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=99)
    return text
