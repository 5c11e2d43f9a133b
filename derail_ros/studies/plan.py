"""Study files: a base scenario, its varied parameters, the design, the number of runs.

The reader is that of scenarios (strict YAML; every mistake is one line with file, line, field and
reason). All points of a study are checked before its first run: a misspelt path is reported
before a night of runs, not after it.
"""

from __future__ import annotations

import copy
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path as FilePath
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, StringConstraints
from pydantic_core import PydanticCustomError

from derail_ros.config_path import config_dir
from derail_ros.scenario import Scenario, ScenarioError, load_scenario
from derail_ros.scenario import files as scenario_files
from derail_ros.scenario.distributions import mistake
from derail_ros.scenario.messages import did_you_mean, validated
from derail_ros.scenario.schema import (
    Distribution,
    Integer,
    Label,
    Number,
    Scalar,
    Section,
    Switch,
    Text,
    Title,
)
from derail_ros.scenario.strict_yaml import Document, parse
from derail_ros.studies.orders import is_order
from derail_ros.studies.study_measures import (
    DEFAULT_MEASURES,
    RELATIVE_SEVERITY,
    measure_names,
    measure_of,
)
from derail_ros.vocabulary.measures import MEASURES

FORMAT_VERSION = 1
"""Version of the study format."""

MAX_RUNS = 10_000_000
"""Largest number of runs of a study."""

Name = Annotated[str, StringConstraints(strict=True, pattern=r"^[A-Za-z][A-Za-z0-9_]{0,39}$")]


def _measure_key(name: str) -> str:
    """The key of a measure; a former name is still read."""
    try:
        return measure_of(name).key
    except KeyError:
        hint = did_you_mean(name, measure_names()).lstrip("; ")
        text = f"must be a measure ({hint})" if hint else "must be a measure"
        raise PydanticCustomError("measure", text) from None  # type: ignore[arg-type]


MeasureName = Annotated[str, AfterValidator(_measure_key)]
DesignName = Literal["one_at_a_time", "grid", "latin_hypercube", "sobol", "cases"]
RANDOM = ("latin_hypercube", "sobol")
"""Designs that draw their points from ranges and distributions."""


# --- the format -------------------------------------------------------------------------------


class Column(Section):
    """A column of the list of cases."""

    label: Label | None = None
    unit: Label = ""


class Parameter(Column):
    """A varied parameter and its values.

    What: a dotted ``path`` of the scenario, or ``set`` (several paths; the text ``$value``
    stands for the value). Over what, exactly one of: ``values``, ``percent`` (of the base
    scenario's value), ``range`` (with ``steps`` where levels are needed), ``distribution``,
    ``settings`` (named sets of overrides, such as whole consists) and ``order`` (of the cars).
    """

    path: str | None = Field(None, max_length=200)
    set: dict[str, Any] | None = None
    values: tuple[Scalar, ...] | None = Field(None, min_length=1, max_length=10_000)
    percent: tuple[Number, ...] | None = Field(None, min_length=1, max_length=1000)
    range: tuple[Number, ...] | None = Field(None, min_length=2, max_length=2)
    steps: Integer | None = Field(None, ge=2, le=10_000)
    whole: Switch = False
    distribution: Distribution | None = None
    settings: dict[Label, dict[str, Any]] | None = Field(None, min_length=1, max_length=1000)
    order: tuple[str, ...] | None = Field(None, min_length=1, max_length=1000)
    cars: tuple[Integer, ...] | None = Field(None, min_length=2, max_length=2)
    base: Scalar | None = None


class Case(Section):
    """A point given in full: its values in the columns, and what it changes."""

    at: dict[str, Scalar] = Field(min_length=1)
    set: dict[str, Any] = {}
    order: str | None = None


class FigureSpec(Section):
    """A figure: a measure over a column, a line for each series, a panel for each panel value."""

    x: str
    y: MeasureName
    series: str | None = None
    panels: str | None = None
    title: Title | None = None


class StudyModel(Section):
    """A study."""

    version: Literal[1]
    title: Title
    description: Text = ""
    scenario: str = Field(min_length=1, max_length=400)
    overrides: dict[str, Any] = {}
    design: DesignName
    points: Integer | None = Field(None, ge=2, le=MAX_RUNS)
    ensemble: Integer = Field(20, ge=1, le=100_000)
    seed: Integer = Field(0, ge=0, le=2**63)
    variation: Number = Field(0.04, ge=0, lt=1)
    parameters: dict[Name, Parameter] = {}
    columns: dict[Name, Column] = {}
    cases: tuple[Case, ...] = Field((), max_length=100_000)
    base: dict[str, Scalar] | None = None
    measures: tuple[MeasureName, ...] = Field(DEFAULT_MEASURES, min_length=1)
    figures: tuple[FigureSpec, ...] = Field((), max_length=20)


# --- a study that was read --------------------------------------------------------------------


@dataclass(frozen=True)
class Study:
    """A study whose own text is in order; ``design.make`` checks the rest."""

    name: str  # what it was loaded as
    model: StudyModel
    scenario: Scenario  # the base scenario, its overrides carried out
    document: Document  # its text, for the places of mistakes

    def error(self, path: tuple[str | int, ...], reason: str) -> ScenarioError:
        """The error that names the place of ``path`` in the study's file."""
        return self.document.error(path, reason)

    def words(self, column: str) -> str:
        """A column in words."""
        return self._owner(column).label or column.replace("_", " ")

    def label(self, column: str) -> str:
        """A column in words, with its unit."""
        unit = self._owner(column).unit
        return f"{self.words(column)} ({unit})" if unit else self.words(column)

    def value(self, column: str, value: Any) -> str:
        """A value of a column in words, with its unit."""
        return f"{shown_value(value)} {self._owner(column).unit}".rstrip()

    def values(self, columns: Mapping[str, Any]) -> str:
        """A point's values in words: ``speed 72 km/h, brake delay 10 s``."""
        return ", ".join(f"{self.words(k)} {self.value(k, v)}" for k, v in columns.items())

    def _owner(self, column: str) -> Column:
        known: Mapping[str, Column] = {**self.model.parameters, **self.model.columns}
        return known.get(column) or Column()

    def changed(self, **changes: Any) -> Study:
        """The same study with other ``ensemble``, ``seed``, ``variation`` or ``points``."""
        given = {key: value for key, value in changes.items() if value is not None}
        if not given:
            return self
        document = replace(self.document, data={**self.document.data, **given})
        return replace(self, model=_validate(document), document=document)

    def with_overrides(self, overrides: Mapping[str, Any]) -> Study:
        """The same study about another base scenario: ``overrides`` come on top of its own."""
        if not overrides:
            return self
        return replace(self, scenario=self.scenario.with_overrides(overrides))


def load_study(name_or_path: str | os.PathLike[str]) -> Study:
    """Load a study by the name of a shipped one, or from a file.

    Raises
    ------
    ScenarioError
        With the first mistake.
    """
    text = os.fspath(name_or_path)
    if scenario_files.is_path(text):
        path: FilePath | None = FilePath(text)
    else:
        path = scenario_files.find(text, (studies_dir(),))
    if path is None:
        known = [path.stem for path in shipped()]
        raise ScenarioError(text, None, "", f"unknown study{did_you_mean(text, known)}")
    content = scenario_files.read_text(path)
    return _study(path.stem, parse(content, str(path)), path.parent)


def study_from(data: Mapping[str, Any], name: str = "study") -> Study:
    """A study from plain data, as a notebook writes it; version and title may be left out."""
    given = {"version": FORMAT_VERSION, "title": name, **copy.deepcopy(dict(data))}
    return _study(name, Document(given, f"<{name}>"), None)


def studies_dir() -> FilePath:
    """Folder of the shipped studies."""
    return config_dir() / "studies"


def shipped() -> list[FilePath]:
    """Files of the shipped studies."""
    return sorted(studies_dir().glob("*.yaml"))


def study_of_data(name: str, document: Document, scenario: Scenario) -> Study:
    """A study that was checked before, about a scenario that is there."""
    return Study(name, _validate(document), scenario, document)


def _study(name: str, document: Document, folder: FilePath | None) -> Study:
    if document.data.get("version") != FORMAT_VERSION:
        reason = f"must be {FORMAT_VERSION}, the version of the study format that is read here"
        raise document.error(("version",), reason)
    model = _validate(document)
    scenario = _base_scenario(model, document, folder)
    _check(model, document)
    return Study(name, model, scenario, document)


def _validate(document: Document) -> StudyModel:
    with document.refusals():
        return validated(StudyModel, document.data)


def _base_scenario(model: StudyModel, document: Document, folder: FilePath | None) -> Scenario:
    name = model.scenario
    try:
        if scenario_files.is_path(name):
            scenario = load_scenario(folder / name if folder else name)
        else:
            scenario = load_scenario(name, (folder,) if folder else ())
    except ScenarioError as error:
        raise document.error(("scenario",), str(error)) from None
    if not model.overrides:
        return scenario
    try:
        return scenario.with_overrides(model.overrides)
    except ScenarioError as error:
        if error.field in model.overrides:
            raise document.error(("overrides", error.field), error.reason) from None
        raise document.error(("overrides",), f"{error.field}: {error.reason}") from None


# --- what takes several fields to judge -------------------------------------------------------

SOURCES = ("values", "percent", "range", "distribution", "settings", "order")


def _check(model: StudyModel, document: Document) -> None:
    def refuse(path: tuple[str | int, ...], reason: str) -> None:
        raise document.error(path, reason)

    if model.design == "cases":
        if not model.cases or not model.columns:
            refuse(("design",), "cases needs a list of cases and the columns they fill")
        if model.parameters:
            refuse(("parameters",), "cannot be used with the design cases")
    else:
        if not model.parameters:
            refuse(("parameters",), "is required: the study must vary something")
        if model.cases or model.columns:
            refuse(("cases" if model.cases else "columns",), "needs the design cases")
    if model.design in RANDOM and model.points is None:
        refuse(("points",), f"is required by the design {model.design}")
    if model.design not in RANDOM and model.points is not None:
        refuse(("points",), f"cannot be used with the design {model.design}: levels make them")
    if model.design == "sobol" and model.points is not None and model.points & (model.points - 1):
        refuse(("points",), f"must be a power of two for the design sobol, is {model.points}")

    columns = {*model.parameters, *model.columns}
    reserved = {*RESERVED, *MEASURES, RELATIVE_SEVERITY.key}
    reserved |= {former for m in MEASURES.values() for former in m.former}
    for name in columns & reserved:
        place = "parameters" if name in model.parameters else "columns"
        refuse((place, name), "is reserved: every table has a column of this name")
    for name, parameter in model.parameters.items():
        _check_parameter(model, name, parameter, refuse)
    _check_paths(model, refuse)
    for i, case in enumerate(model.cases):
        if set(case.at) != set(model.columns):
            names = ", ".join(model.columns)
            refuse(("cases", i, "at"), f"must give exactly the columns {names}")
        if case.order is not None and not is_order(case.order):
            refuse(("cases", i, "order"), f"unknown order {case.order!r}")
    relative = RELATIVE_SEVERITY.key
    if relative in model.measures and model.design != "one_at_a_time" and model.base is None:
        refuse(("measures",), f"{relative} needs base, the point to compare with")
    for name in model.base or {}:
        if name not in columns:
            refuse(("base", name), f"unknown parameter{did_you_mean(name, columns)}")
    if model.base is not None and model.design in RANDOM:
        refuse(("base",), f"cannot be used with the design {model.design}")
    for i, figure in enumerate(model.figures):
        for key in ("x", "series", "panels"):
            column = getattr(figure, key)
            if column is not None and column not in columns:
                hint = did_you_mean(column, columns)
                refuse(("figures", i, key), f"unknown parameter {column!r}{hint}")


RESERVED = frozenset(
    (
        *("point", "member", "varied", "measure", "runs", "share", "n", "mean", "mean_low"),
        *("mean_high", "sd", "q05", "q25", "median", "q75", "q95", "least", "most", "void"),
        *("failed", "relative", "relative_low", "relative_high", "error", "lateral_factor"),
    )
)
"""Names of other columns of the tables."""


def _check_parameter(model: StudyModel, name: str, p: Parameter, refuse: Any) -> None:
    place = ("parameters", name)
    given = [source for source in SOURCES if getattr(p, source) is not None]
    if len(given) != 1:
        words = "one of " + ", ".join(SOURCES)
        only = f"must have only one of {', '.join(given)}"
        refuse(place, only if given else f"needs {words}")
    source = given[0]
    targets = [target for target in ("path", "set") if getattr(p, target) is not None]
    if source in ("settings", "order"):
        if targets:
            refuse((*place, targets[0]), f"cannot be used with {source}")
    elif len(targets) != 1:
        refuse(place, "needs either path or set: what the values are for")
    if source == "percent" and p.path is None:
        refuse((*place, "percent"), "needs a path: the base scenario's value there is 0 %")
    if p.range is not None and not p.range[0] < p.range[1]:
        low, high = p.range
        refuse((*place, "range"), f"must rise, got {low:g} to {high:g}")
    if p.steps is not None and p.range is None:
        refuse((*place, "steps"), "needs range")
    if p.whole and source not in ("range", "distribution", "percent"):
        refuse((*place, "whole"), f"cannot be used with {source}")
    if p.cars is not None and (p.order is None or not 1 <= p.cars[0] < p.cars[1]):
        refuse((*place, "cars"), "must be the first and the last car to reorder")
    if p.set is not None and fill(p.set, 0) == fill(p.set, 1):
        refuse((*place, "set"), "must contain $value")
    for key in ("values", "percent", "order"):
        items = getattr(p, key) or ()
        if len({(type(item) is bool, item) for item in items}) != len(items):
            refuse((*place, key), "contains a value twice")
    if p.values is not None and len({_kind(v) for v in p.values}) > 1:
        refuse((*place, "values"), "must be all numbers, all texts or all true and false")
    for i, order in enumerate(p.order or ()):
        if not is_order(order):
            refuse((*place, "order", i), f"unknown order {order!r}")
    if p.distribution is not None and (wrong := mistake(p.distribution)):
        refuse((*place, "distribution", *wrong[0]), wrong[1])
    if model.design in ("one_at_a_time", "grid"):
        if source == "distribution":
            refuse((*place, source), f"the design {model.design} needs levels; give values")
        if source == "range" and p.steps is None:
            refuse((*place, "steps"), f"is required by the design {model.design}")
    elif p.steps is not None:
        refuse((*place, "steps"), f"cannot be used with the design {model.design}")
    if model.design == "one_at_a_time" and p.set is not None and p.base is None:
        refuse((*place, "base"), "is required with set: the value that the base scenario has")
    if p.base is not None and (p.set is None or model.design != "one_at_a_time"):
        refuse((*place, "base"), "needs set and the design one_at_a_time")


def _check_paths(model: StudyModel, refuse: Any) -> None:
    """No path is varied by two parameters: which would count?"""
    owner: dict[str, str] = {}
    for name, p in model.parameters.items():
        paths = {p.path} if p.path is not None else set(p.set or ())
        for setting in (p.settings or {}).values():
            paths |= set(setting)
        if p.order is not None:
            paths.add("train.consist")
        for path in paths:
            if path in owner:
                reason = f"varies {path}, which parameter {owner[path]!r} varies too"
                refuse(("parameters", name), reason)
        owner.update(dict.fromkeys(paths, name))


def _kind(value: Scalar) -> str:
    if isinstance(value, bool):
        return "switch"
    return "text" if isinstance(value, str) else "number"


VALUE = "$value"


def fill(template: Any, value: Scalar) -> Any:
    """A template with the value in the places of ``$value``."""
    if isinstance(template, Mapping):
        return {key: fill(v, value) for key, v in template.items()}
    if isinstance(template, (list, tuple)):
        return [fill(v, value) for v in template]
    return value if template == VALUE else template


def shown_value(value: Any) -> str:
    """A parameter's value in a sentence or table."""
    value = value.item() if hasattr(value, "item") else value
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}" if abs(value) < 1e6 or value != int(value) else f"{value:.0f}"
    return str(value)
