"""Scenarios: loaded by name, from a file or from text, overridden, resolved, written out.

A file may say ``extends: NAME`` (a scenario's name, never a path) and give only what differs:
mappings are merged key by key, anything else is replaced. Its ``overrides`` (dotted path: value)
come last. Errors point to the file and line the offending value came from.
"""

from __future__ import annotations

import copy
import hashlib
import json
import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path as FilePath
from typing import Any, NamedTuple, TypeVar

from derail_ros.scenario import files, uncertain
from derail_ros.scenario.calibrated import Draw, load_calibrated
from derail_ros.scenario.constants import FIELDS, chosen, filled, values_of
from derail_ros.scenario.errors import Refusal, ScenarioError
from derail_ros.scenario.messages import did_you_mean, model_at, shown, validated
from derail_ros.scenario.plausibility import doubts
from derail_ros.scenario.resolve import (
    DEFAULT_WIDTH,
    Block,
    Resolved,
    coupler_types,
    derailed_trucks,
    resolve,
    train_params,
)
from derail_ros.scenario.rolling_stock import RollingStock, load_rolling_stock
from derail_ros.scenario.schema import FORMAT_VERSION, TITLE_LENGTH, ScenarioModel, Section
from derail_ros.scenario.site import add_alignment, add_features
from derail_ros.scenario.strict_yaml import (
    MAX_DEPTH,
    Document,
    Mark,
    Path,
    dotted,
    dump,
    parse,
    parse_value,
)
from derail_ros.scenario.units import canonical, field_of
from derail_ros.vocabulary.params import PLANAR, CouplerType, TrainParams
from derail_ros.vocabulary.train import TrainTotals, train_totals

V = TypeVar("V")
Dirs = Iterable["str | os.PathLike[str]"] | None

MAX_EXTENDS = 8
"""Longest chain of ``extends``."""


class ScenarioInfo(NamedTuple):
    """An entry in a list of scenarios; if one cannot be read, its title says why."""

    name: str
    title: str


@dataclass(frozen=True, eq=False)
class Scenario:
    """A valid scenario; two are equal if their names and their resolved contents are.

    Attributes
    ----------
    name : what it was loaded as; not part of its content
    model : its fields as they were given, with all defaults, in the units of their names
    """

    name: str
    model: ScenarioModel
    _resolved: Resolved = field(repr=False)
    _document: Document = field(repr=False)
    _stock: RollingStock = field(repr=False)
    _origin: Scenario | None = field(default=None, repr=False)
    _changes: frozenset[str] = field(default=frozenset(), repr=False)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Scenario):
            return NotImplemented
        return (self.name, self.hash) == (other.name, other.hash)

    def __hash__(self) -> int:
        return hash((self.name, self.hash))

    @property
    def title(self) -> str:
        """Title, with the settings that :meth:`with_overrides` changed."""
        return self.model.title

    @property
    def description(self) -> str:
        """Longer description."""
        return self.model.description

    @property
    def source(self) -> str:
        """Source of the numbers."""
        return self.model.source

    @property
    def files(self) -> dict[str, bytes]:
        """Content of the files it was read from, by name: its own, then those it extends."""
        return self._document.files

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings of possible but unlikely values, a sentence each."""
        return (*self._document.notes, *doubts(self._resolved))

    @property
    def totals(self) -> TrainTotals:
        """Totals of the train: cars, loads, length, mass."""
        params = self.to_params()
        return train_totals(params.cars[: params.n_train])

    @property
    def car_types(self) -> tuple[str, ...]:
        """Type of rolling stock of each car; "" for a car that was given by its numbers.

        The cars of the train come first, then those standing on second tracks.
        """
        cuts = self.model.site.standing if self.model.site else ()
        blocks = [*self.model.train.consist, *(block for cut in cuts for block in cut.consist)]
        entries = (*self._resolved.entries, *self._resolved.cut_entries)
        bodies = (sum(b.count for b in entry) for entry in entries)
        return tuple(b.car or "" for b, n in zip(blocks, bodies) for _ in range(n))

    @property
    def n_cars(self) -> int:
        """Number of cars, those within the virtual body included."""
        return self._resolved.n_cars

    @property
    def hash(self) -> str:
        """SHA-256 (hex) of the canonical JSON of :meth:`resolved`."""
        return self._hash

    @cached_property
    def _hash(self) -> str:
        text = json.dumps(self.resolved(), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()

    @cached_property
    def _known(self) -> dict[str, Any]:
        return {"model": self.model.model, **self.resolved()}

    def coupler_types(self) -> dict[str, CouplerType]:
        """Coupler types by name: the library's and the scenario's own."""
        return coupler_types(self.model, self._stock)

    def to_params(self) -> TrainParams:
        """Parameters for the engine, in SI units."""
        return train_params(self._resolved)

    @property
    def constants(self) -> str:
        """Set of constants: ``published`` or ``calibrated``."""
        return self.model.constants or "published"

    @property
    def draws(self) -> bool:
        """Whether each member of an ensemble draws values of its own."""
        return bool(self.model.drawn or self.model.uncertain)

    def drawn_scenario(self, values: Mapping[str, Any]) -> Scenario:
        """A copy in which the uncertain fields have the given values."""
        with self._document.refusals():
            changes = uncertain.overrides(self, dict(values))
        return self.with_overrides({"title": self.title, "uncertain": {}, **changes})

    def varied(self, member: int, seed: int = 0) -> Scenario:
        """The scenario of a member of an ensemble with its draws; member 0 is unchanged."""
        if member == 0 or not self.model.uncertain:
            return self
        return self.drawn_scenario(uncertain.drawn(self, member, seed))

    def member_params(self, member: int, seed: int = 0) -> TrainParams:
        """Parameters of a member of an ensemble; member 0 has no draw."""
        one = self.varied(member, seed)
        if member == 0 or not one.model.drawn:
            return one.to_params()
        return one.drawn_params(load_calibrated().draw(member - 1, seed))

    def member_inputs(self, member: int, seed: int = 0) -> dict[str, Any]:
        """Draws of a member of an ensemble: dotted path -> value, or factor if relative."""
        found = uncertain.drawn(self, member, seed)
        one = self.varied(member, seed)
        if not one.model.drawn:
            return found
        known = load_calibrated()
        draw = known.draw(member - 1, seed) if member else known.central
        for section, values in values_of(one._resolved, one.model.drawn, draw).items():
            found |= {f"{section}.{key}": value for key, value in values.items()}
        return found

    def given(self, path: str) -> Any:
        """Value that the file gives at a dotted path, or None."""
        return _get(self._document.data, path)

    def own_value(self, path: str) -> Any:
        """Value of a field at a dotted path, given or default; None if there is no single one."""
        steps = path.split(".")
        if steps[:2] == ["train", "consist"] and len(steps) > 3:
            entries = self._resolved.entries
            i = int(steps[2])
            if i >= len(entries) or len(entries[i]) > 1:
                return None
            steps[2] = str(sum(map(len, entries[:i])))
        return _get(self._known, ".".join(steps))

    def drawn_params(self, draw: Draw) -> TrainParams:
        """Parameters with a draw of the calibrated constants; a published scenario draws all."""
        names = self.model.drawn or tuple(FIELDS)
        return train_params(filled(self._resolved, names, draw))

    def resolved(self) -> dict[str, Any]:
        """All fields with defaults and types filled in, as plain data for JSON.

        The result is a self-contained scenario with the same train and the same dotted paths.
        """
        return _resolved_data(self._resolved)

    def to_yaml(self) -> str:
        """The resolved scenario as YAML text; it loads without a library of car types."""
        return dump(_compact(self.resolved()))

    def with_overrides(self, overrides: Mapping[str, Any]) -> Scenario:
        """A copy with other values at the given dotted paths.

        Where the mass of a car changes (``train.consist.N.mass_kg`` or ``.load``) and its yaw
        inertia was given for the mass before, the inertia changes in proportion, unless it is
        overridden too.

        The title of the copy names the settings that differ, for example ``Base train
        (train.speed_kmh = 30)``, unless ``overrides`` gives a title.

        Parameters
        ----------
        overrides
            Dotted path -> value; lists and mappings are replaced as a whole.

        Raises
        ------
        ScenarioError
            Naming the path.
        """
        given: Any = overrides
        if not isinstance(given, Mapping):
            reason = f"must be a mapping of dotted paths to values, got {type(overrides).__name__}"
            raise ScenarioError(self.name, None, "overrides", reason)
        marks = {path: Mark(self.name, None) for path in overrides}
        changed = self._with(overrides, marks)
        if "title" in overrides:
            return changed
        origin, paths = (
            self._origin or self,
            self._changes | {_field_path(p, marks[p]) for p in overrides},
        )
        title = _title_with(origin, changed, sorted(paths))
        model = changed.model.model_copy(update={"title": title})
        changed._document.data["title"] = title
        resolved = replace(changed._resolved, model=model)
        return replace(changed, model=model, _resolved=resolved, _origin=origin, _changes=paths)

    def _with(self, overrides: Mapping[str, Any], marks: Mapping[str, Mark]) -> Scenario:
        old = self._document
        document = Document(copy.deepcopy(old.data), old.file, dict(old.marks), old.files)
        document.notes = list(old.notes)
        values: dict[str, Any] = {}
        steps: dict[str, Path] = {}
        given: dict[Path, str] = {}
        for text in overrides:
            plain = _plain(overrides[text], text, marks[text])
            path, values[text] = _canonical_step(
                _split(text, marks[text]), plain, text, marks, given
            )
            if path in steps.values():
                raise _bad_path(path, marks[text], "is given twice, in two units")
            steps[text] = path
        overridden = set(steps.values())
        document.written = {**_without(old.written, overridden), **given}
        for text, path in steps.items():
            if any(path[:n] in overridden for n in range(1, len(path))):
                reason = "overlaps with another override"
                raise _bad_path(path, marks[text], reason)
            _put(document.data, path, values[text], marks[text])
        _settle_masses(document, overridden)
        _settle_drawn(document, overridden)
        document.marks = _without(document.marks, overridden)
        document.marks.update({path: marks[text] for text, path in steps.items()})
        document.marks.update({_split(text, mark): mark for text, mark in marks.items()})
        before = self._resolved.entries
        changed = _build(self.name, document, self._stock)
        if _scale_inertia(document, overridden, before, changed._resolved.entries):
            changed = _build(self.name, document, self._stock)
        return changed


# --- loading ----------------------------------------------------------------------------------


def load_scenario(name_or_path: str | os.PathLike[str], dirs: Dirs = None) -> Scenario:
    """Load a scenario by its name or from a file.

    Parameters
    ----------
    name_or_path
        A text with a path separator or ending in ``.yaml`` is a path, anything else a name.
    dirs
        Folders searched for names before the shipped ones.

    Raises
    ------
    ScenarioError
        The scenario has an error; the message names file, line and field.
    """
    text = os.fspath(name_or_path)
    if FilePath(text).suffix.lower() not in files.SUFFIXES and FilePath(text).is_file():
        raise ScenarioError(text, None, "", _not_a_scenario(FilePath(text)))
    if not files.is_path(text):
        return load_scenario_by_name(text, dirs)
    path = FilePath(text)
    # what it extends may lie beside it
    folders = (path.parent, *files.search_dirs(dirs))
    return _load(files.read_text(path), str(path), path.stem, folders, (path.resolve(),))


def _not_a_scenario(path: FilePath) -> str:
    if path.suffix.lower() in (".csv", ".tsv", ".txt"):
        made = path.with_suffix(".yaml").name
        return (
            f"is no scenario: if it is a consist list, `derail consist {path} -o {made}` makes "
            f"one of it, then `derail simulate {made}`"
        )
    return "is no scenario: those are YAML files, their names end in .yaml"


def load_scenario_by_name(name: str, dirs: Dirs = None) -> Scenario:
    """Load a scenario by its name; the name is never opened as a path."""
    folders = files.search_dirs(dirs)
    path = files.find(name, folders)
    if path is None:
        reason = f"unknown scenario{_near_names(name, folders)}"
        if not files.is_name(name):
            reason = "not a scenario name: letters, digits, '_', '-' and '.' only"
        raise ScenarioError(name if files.is_name(name) else shown(name), None, "", reason)
    return _load(files.read_text(path), str(path), name, folders, (path.resolve(),))


def loads_scenario(text: str, name: str = "<inline>", dirs: Dirs = None) -> Scenario:
    """Load a scenario from YAML text.

    Parameters
    ----------
    text
        The YAML text.
    name
        What errors call it, and the name of the scenario.
    dirs
        Folders searched, before the shipped ones, for the scenario that it extends.
    """
    return _load(text, name, name, files.search_dirs(dirs))


def list_scenarios(dirs: Dirs = None) -> list[ScenarioInfo]:
    """Name and title of every scenario that can be loaded by name, sorted by name."""
    found = []
    for name, path in files.all_files(files.search_dirs(dirs)):
        try:
            title = parse(files.read_text(path), str(path)).data.get("title")
            title = title if isinstance(title, str) else "(no title)"
        except ScenarioError as error:
            title = f"(cannot be read: {error})"
        found.append(ScenarioInfo(name, title))
    return sorted(found)


def parse_set(text: str) -> tuple[str, Any]:
    """Read ``path=value`` as given on a command line.

    Returns
    -------
    tuple
        Dotted path and value; the value is read as YAML (``1e6``, ``true``, ``null``, ``[1, 2]``).
    """
    path, equals, value = text.partition("=")
    path = path.strip()
    if not equals or not path:
        raise ScenarioError("--set", None, "", f"must be PATH=VALUE, got {shown(text)}")
    return path, parse_value(value, "--set", path)


def _load(
    text: str,
    file: str,
    name: str,
    folders: tuple[FilePath, ...],
    seen: tuple[FilePath, ...] = (),
) -> Scenario:
    """Read a text, and before it the scenarios that it extends (``seen``: those on the way)."""
    document = parse(text, file)
    document.files = {f"{name}.yaml": text.encode()}
    _check_version(document)
    overrides, marks = _take_overrides(document)
    with document.refusals():
        document.data = canonical(document.data, ScenarioModel, (), document.written)
    if "extends" in document.data:
        base = _base(document, folders, seen)
        _merge_below(document, base)
        document.files = {**document.files, **base.files}
    _read_site(document, seen[-1].parent if seen else None)
    scenario = _build(name, document, load_rolling_stock())
    if seen:
        _add_inputs(scenario, seen[-1].parent)
    return scenario._with(overrides, marks) if overrides else scenario


def _read_site(document: Document, folder: FilePath | None) -> None:
    """Read the files of track and place, which lie in ``folder`` (None: there is none)."""
    for key, add in (("track", add_alignment), ("site", add_features)):
        section = document.data.get(key)
        if not isinstance(section, dict) or section.get("file") is None:
            continue
        name = section.pop("file")
        place: Path = (key, "file")
        if not isinstance(name, str) or "/" in name or "\\" in name or name in (".", ".."):
            reason = f"must be the name of a file beside it, got {shown(name)}"
            raise document.error(place, reason)
        if folder is None:
            reason = "only goes with a scenario in a file: give its content here"
            raise document.error(place, reason)
        content = files.read_text(folder / name).encode()
        with document.refusals():
            document.notes += add(document.data, name, content)
        document.files = {**document.files, name: content}


def _add_inputs(scenario: Scenario, folder: FilePath) -> None:
    """Add the files that a scenario was made from, if they lie beside it as they were."""
    document = scenario._document
    for wanted in scenario.model.inputs:
        path = folder / wanted.file
        try:  # a scenario that this one extends has brought its own
            content = document.files.get(wanted.file) or path.read_bytes()
        except OSError:
            document.notes.append(f"{path}: not found: recordings will not hold it")
            continue
        if hashlib.sha256(content).hexdigest() != wanted.sha256:
            document.notes.append(f"{path}: has changed since {scenario.name} was made from it")
            continue
        document.files = {**document.files, wanted.file: content}


def _check_version(document: Document) -> None:
    if "version" not in document.data:
        raise document.error(("version",), f"is required: the format has version {FORMAT_VERSION}")
    version = document.data["version"]
    if type(version) is not int or version != FORMAT_VERSION:
        reason = f"must be {FORMAT_VERSION}, the version of the format, got "
        is_float = isinstance(version, float)
        raise document.error(
            ("version",), reason + (repr(version) if is_float else shown(version))
        )


def _take_overrides(document: Document) -> tuple[dict[str, Any], dict[str, Mark]]:
    """Take ``overrides`` out of a document, with the place of each."""
    if "overrides" not in document.data:
        return {}, {}
    place: Path = ("overrides",)
    if "extends" not in document.data:
        raise document.error(place, "only goes with extends")
    values = document.data.pop("overrides")
    if not isinstance(values, dict):
        reason = "must be a mapping of dotted paths to values"
        raise document.error(place, f"{reason}, got {shown(values)}")
    return values, {text: document.mark((*place, text)) for text in values}


def _base(
    document: Document, folders: tuple[FilePath, ...], seen: tuple[FilePath, ...]
) -> Document:
    """The document of the scenario that ``document`` extends, its overrides carried out."""
    name = document.data.pop("extends")
    place: Path = ("extends",)
    if not isinstance(name, str) or not files.is_name(name):
        raise document.error(place, f"must be the name of a scenario, got {shown(name)}")
    path = files.find(name, folders)
    if path is None:
        raise document.error(place, f"unknown scenario {name!r}{_near_names(name, folders)}")
    real = path.resolve()
    if real in seen:
        raise document.error(place, f"goes round in a circle: {name!r} is on the way already")
    if len(seen) >= MAX_EXTENDS:
        raise document.error(place, f"a chain of more than {MAX_EXTENDS} scenarios")
    return _load(files.read_text(path), str(path), name, folders, (*seen, real))._document


def _near_names(name: str, folders: tuple[FilePath, ...]) -> str:
    return did_you_mean(name, [known for known, _ in files.all_files(folders)])


def _merge_below(document: Document, base: Document) -> None:
    """Put the base below a document: mappings are merged key by key, the rest is replaced."""

    def merge(below: dict[str, Any], top: dict[str, Any], path: Path) -> dict[str, Any]:
        merged = dict(below)
        for key, value in top.items():
            old = merged.get(key)
            if isinstance(old, dict) and isinstance(value, dict):
                merged[key] = merge(old, value, (*path, key))
            else:
                merged[key] = value
                replaced.add((*path, key))
        return merged

    # a title that was not written for the variant would mislead
    inherited = {k: v for k, v in base.data.items() if k not in ("title", "description")}
    replaced: set[Path] = {("title",), ("description",)}
    document.data = merge(inherited, document.data, ())
    document.marks = _without(base.marks, replaced) | document.marks
    document.written = _without(base.written, replaced) | document.written


def _without(marks: dict[Path, V], replaced: set[Path]) -> dict[Path, V]:
    """Notes by path but for those at or below the replaced paths."""
    return {
        path: mark
        for path, mark in marks.items()
        if not any(path[:n] in replaced for n in range(1, len(path) + 1))
    }


def _build(name: str, document: Document, stock: RollingStock) -> Scenario:
    """Validate a document."""
    with document.refusals():
        resolved = chosen(resolve(validated(ScenarioModel, document.data), stock))
        scenario = Scenario(name, resolved.model, resolved, document, stock)
        uncertain.check(scenario)
    return scenario


# --- overrides --------------------------------------------------------------------------------

_FIXED = ("version", "extends", "overrides")


def _field_path(text: str, mark: Mark) -> str:
    """The dotted path of the field that an override sets, whatever its unit."""
    path = _split(text, mark)
    owner = model_at(ScenarioModel, path[:-1]) if len(path) > 1 else ScenarioModel
    if owner is None or path[-1] in owner.model_fields:
        return text
    found = field_of(str(path[-1]), owner)
    return text if found is None else dotted((*path[:-1], found[0]))


def _canonical_step(
    path: Path, value: Any, text: str, marks: Mapping[str, Mark], written: dict[Path, str]
) -> tuple[Path, Any]:
    """An override's path and value in the units of the fields."""
    owner = model_at(ScenarioModel, path[:-1]) if len(path) > 1 else ScenarioModel
    if owner is None:
        return path, value
    try:
        if isinstance(path[-1], int):
            return path, canonical(value, owner, path, written)
        ((name, plain),) = canonical({path[-1]: value}, owner, path[:-1], written).items()
    except Refusal as refusal:
        raise _bad_path(refusal.path, marks[text], refusal.reason) from None
    return (*path[:-1], name), plain


_INDEX = re.compile(r"(0|[1-9][0-9]{0,5})\Z")


def _split(text: str, mark: Mark) -> Path:
    steps = str(text).split(".")
    if not isinstance(text, str) or not all(steps) or len(steps) > MAX_DEPTH:
        place = dotted(tuple(steps[:MAX_DEPTH]))
        raise ScenarioError(mark.file, mark.line, place, "is not a dotted path")
    path = tuple(int(step) if _INDEX.match(step) else step for step in steps)
    if path[0] in _FIXED:
        raise ScenarioError(mark.file, mark.line, text, "cannot be overridden")
    return path


def _plain(value: Any, text: str, mark: Mark, depth: int = 0) -> Any:
    """A value as YAML would give it; numbers of numpy become Python's."""
    if depth > MAX_DEPTH:
        raise ScenarioError(mark.file, mark.line, text, f"nested deeper than {MAX_DEPTH} levels")
    if value is None or type(value) in (bool, int, float, str):
        return value
    if isinstance(value, Mapping):
        return {str(k): _plain(v, text, mark, depth + 1) for k, v in value.items()}
    if hasattr(value, "tolist"):  # numpy scalars and arrays
        return _plain(value.tolist(), text, mark, depth + 1)
    if isinstance(value, (list, tuple)):
        return [_plain(v, text, mark, depth + 1) for v in value]
    reason = f"a {type(value).__name__} cannot stand in a scenario"
    raise ScenarioError(mark.file, mark.line, text, reason)


def _put(data: dict[str, Any], path: Path, value: Any, mark: Mark) -> None:
    """Set the value at a path, making the mappings on the way that are not given."""
    here: Any = data
    for n, step in enumerate(path):
        last = n == len(path) - 1
        if isinstance(here, list):
            if not isinstance(step, int) or step >= len(here):
                n_here = len(here)
                entries = "1 entry" if n_here == 1 else f"{n_here} entries"
                size = f"it has {entries}, numbered from 0"
                raise _bad_path(path, mark, f"no entry {step!r}: {size}")
        elif isinstance(here, dict) and isinstance(step, str):
            if not last and here.get(step) is None:
                if isinstance(path[n + 1], int):
                    raise _bad_path(path, mark, f"no entry {path[n + 1]}: the list is empty")
                here[step] = {}
        else:
            raise _bad_path(path, mark, f"{dotted(path[:n])} has no field {step!r}")
        if last:
            here[step] = value
        else:
            here = here[step]


def _title_with(origin: Scenario, changed: Scenario, paths: Iterable[str]) -> str:
    """The title of ``origin`` and the values at ``paths`` that differ from it, if they fit."""
    settings = []
    for path in paths:
        before, now = (_get(s._document.data, path) for s in (origin, changed))
        if now == (_get(origin._known, path) if before is None else before):
            continue
        short = now is None or isinstance(now, (bool, int, float, str))
        value = now if isinstance(now, str) else shown(now)
        settings.append(f"{path} = {value}" if short else f"{path} changed")
    for n in range(len(settings), 0, -1):
        more = [f"{len(settings) - n} more"] if n < len(settings) else []
        title = f"{origin.title} ({', '.join([*settings[:n], *more])})"
        if len(title) <= TITLE_LENGTH:
            return title
    number = f" ({len(settings)} changed)" if settings else ""
    return origin.title[: TITLE_LENGTH - len(number)] + number


def _get(data: Any, path: str) -> Any:
    """The value at a dotted path of plain data; None where there is none."""
    for step in path.split("."):
        if isinstance(data, list):
            data = data[int(step)] if step.isdigit() and int(step) < len(data) else None
        else:
            data = data.get(step) if isinstance(data, dict) else None
    return data


def _bad_path(path: Path, mark: Mark, reason: str) -> ScenarioError:
    return ScenarioError(mark.file, mark.line, dotted(path), reason)


def _touched(overridden: set[Path], block: int) -> set[Path]:
    """Overridden paths within a block of the consist, relative to it."""
    place: Path = ("train", "consist", block)
    return {path[3:] for path in overridden if path[:3] == place}


def _settle_drawn(document: Document, overridden: set[Path]) -> None:
    """What is given by an override is drawn no more."""
    if "drawn" in document.data:
        given = {path for path in overridden if len(path) > 1}
        document.data["drawn"] = [
            name
            for name in document.data["drawn"]
            if not any((FIELDS[name][0], key) in given for key in FIELDS[name][1])
        ]


def _settle_masses(document: Document, overridden: set[Path]) -> None:
    """Of load and mass, which exclude each other, the overridden one counts."""
    for path in overridden:
        if path[:2] != ("train", "consist") or len(path) != 4:
            continue
        entry = document.data["train"]["consist"][path[2]]
        other = {"mass_kg": "load", "load": "mass_kg"}.get(str(path[3]))
        if other and entry[path[3]] is not None and (*path[:3], other) not in overridden:
            entry.pop(other, None)


def _scale_inertia(
    document: Document,
    overridden: set[Path],
    before: tuple[tuple[Block, ...], ...],
    after: tuple[tuple[Block, ...], ...],
) -> bool:
    """Scale inertias that were given for the mass before an override; whether any was."""
    scaled = False
    for i in range(min(len(before), len(after))):
        touched = _touched(overridden, i)
        if not touched & {("mass_kg",), ("load",)} or touched & {("inertia_kg_m2",), ("car",), ()}:
            continue
        entry = document.data["train"]["consist"][i]
        if entry.get("inertia_kg_m2") is not None and before[i][0].mass != after[i][0].mass:
            old, new = before[i][0], after[i][0]
            entry["inertia_kg_m2"] = old.inertia * (new.mass / old.mass)
            scaled = True
    return scaled


# --- writing ----------------------------------------------------------------------------------


def _without_later(section: Section, data: dict[str, Any]) -> None:
    """Take out of a section's plain data the fields that came later and have their default."""
    for name, info in type(section).model_fields.items():
        value, extra = getattr(section, name), info.json_schema_extra
        if isinstance(extra, dict) and extra.get("later") and value == info.default:
            del data[name]
        elif isinstance(value, Section):
            _without_later(value, data[name])
        elif isinstance(value, tuple):
            for part, plain in zip(value, data[name], strict=True):
                if isinstance(part, Section):
                    _without_later(part, plain)


def _resolved_data(resolved: Resolved) -> dict[str, Any]:
    model = resolved.model
    if model.constants == "published":  # came later: the hashes of older scenarios stay
        model = model.model_copy(update={"constants": None})
    data: dict[str, Any] = model.model_dump(mode="json")
    if data["model"] == PLANAR:  # came later too
        del data["model"]
    _without_later(model, data)
    data["train"]["consist"] = [_block_data(block) for block in resolved.blocks]
    data["train"]["car_types"] = {}
    for j, cut in enumerate(resolved.cuts):
        blocks = [_block_data(block) for entry in cut for block in entry]
        data["site"]["standing"][j]["consist"] = blocks
    couplers = data["couplers"]
    couplers["k2_N_per_m"] = None
    couplers["damping_N_s_per_m"] = None
    couplers["types"] = {
        name: {
            "head": kind.head,
            "pivot_to_face_m": kind.length,
            "pivot_to_striker_m": kind.striker_arm,
            "striker_opening_m": kind.striker_opening,
            "k1_N_per_m": kind.k1,
            "k2_N_per_m": kind.k2,
            "damping_N_s_per_m": kind.damping,
        }
        for name, kind in resolved.couplers.items()
    }
    data["track"]["alignment"] = [
        {key: value for key, value in piece.items() if value is not None}
        for piece in data["track"]["alignment"]
    ]
    data["initiation"]["derailed_trucks"] = [
        {"car": car, "truck": truck} for car, truck in derailed_trucks(resolved.model)
    ]
    return data


def _masses(block: Block) -> dict[str, Any]:
    """What says the mass of a car and how it is loaded, so that reading it gives both again."""
    spans = {"empty_mass_kg": block.empty, "loaded_mass_kg": block.loaded}
    known = {key: mass for key, mass in spans.items() if mass is not None}
    if len(known) == 1 and block.load is not None:
        return {"load": block.load, **known}
    return {"mass_kg": block.mass, **known}


def _block_data(block: Block) -> dict[str, Any]:
    same = block.front == block.rear
    ends = {"front_coupler": block.front, "rear_coupler": block.rear}
    return {
        "count": block.count,
        "name": block.name,
        "contents": block.contents,
        **_masses(block),
        "inertia_kg_m2": block.inertia,
        "length_m": block.length,
        "width_m": block.width,
        "coupler_pivots_m": block.pivots,
        "truck_centres_m": block.trucks,
        **({"coupler": block.front} if same else ends),
        "coupler_inertia_kg_m2": block.coupler_inertia,
        "brake": {
            "shoe": block.shoe,
            "scale": block.scale,
            "delay_s": block.delay,
            **{k: v for k, v in list(block.brake)[3:] if v is not None},
        },
        **({"locomotive": True} if block.locomotive else {}),
        **_along(block),
    }


def _along(block: Block) -> dict[str, Any]:
    """What a car needs for the forces along the track."""
    curves = {
        "tractive_effort_kmh_kN": block.tractive_effort,
        "dynamic_brake_kmh_kN": block.dynamic_brake,
    }
    told: dict[str, Any] = {key: [[*point] for point in c] for key, c in curves.items() if c}
    return {**told, **({"axles": block.axles} if block.axles else {})}


def _compact(data: dict[str, Any]) -> dict[str, Any]:
    """Resolved data with the cars' commonplaces left out, so that 1000 cars stay readable."""
    left_out = {
        "count": 1,
        "name": "",
        "contents": "",
        "width_m": DEFAULT_WIDTH,
        "coupler_inertia_kg_m2": data["couplers"]["inertia_kg_m2"],
        "brake": {"shoe": "composition", "scale": 1.0, "delay_s": 0.0},
    }
    consist = [
        {key: value for key, value in entry.items() if left_out.get(key) != value}
        for entry in data["train"]["consist"]
    ]
    return {**data, "train": {**data["train"], "consist": consist}}
