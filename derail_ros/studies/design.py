"""Designs: from what a study varies to its points, each a set of overrides.

A point is made from its number alone when it is asked for. The memory that a study needs is that
of its values in the parameters, also with 100 000 points.
"""

from __future__ import annotations

import hashlib
import json
import math
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from derail_ros.scenario import Scenario, ScenarioError
from derail_ros.scenario.distributions import quantile_of
from derail_ros.studies.orders import reorder
from derail_ros.studies.plan import (
    MAX_RUNS,
    Parameter,
    Study,
    fill,
    load_study,
    shipped,
)
from derail_ros.vocabulary.words import count

Place = tuple[str | int, ...]


@dataclass(frozen=True)
class Level:
    """A value of a parameter."""

    value: Any  # as in the table
    overrides: Mapping[str, Any]  # what it changes in the scenario
    place: Place  # where it stands in the study


@dataclass(frozen=True)
class Axis:
    """A parameter: its levels, or what turns a share of the probability into a level."""

    name: str
    levels: tuple[Level, ...]
    sample: Callable[[float], Level] | None = None
    base: Level | None = None

    @property
    def numeric(self) -> bool:
        """Whether its values are numbers."""
        if not self.levels:
            return True
        return all(type(level.value) in (int, float) for level in self.levels)

    def at(self, u: float) -> Level:
        """The level below which a share ``u`` of the probability lies."""
        if self.sample is not None:
            return self.sample(u)
        return self.levels[min(int(u * len(self.levels)), len(self.levels) - 1)]


@dataclass(frozen=True)
class Point:
    """A point of a design."""

    index: int  # from 0
    columns: Mapping[str, Any]  # parameter -> value
    overrides: Mapping[str, Any]  # what it changes in the base scenario
    varied: str  # one at a time: the parameter that differs from the base; "" otherwise
    place: Place  # where it stands in the study, for mistakes


class Design(Sequence[Point]):
    """The points of a study."""

    def __init__(self, study: Study, axes: Sequence[Axis]) -> None:
        self.study = study
        self.axes = tuple(axes)

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the parameters."""
        if self.study.model.design == "cases":
            return tuple(self.study.model.columns)
        return tuple(axis.name for axis in self.axes)

    @property
    def runs(self) -> int:
        """Number of runs."""
        return len(self) * self.study.model.ensemble

    @cached_property
    def base(self) -> int | None:
        """Number of the point that others are compared with; None without."""
        base = self.study.model.base
        if base is None:
            return None
        for point in self:
            if all(point.columns[name] == value for name, value in base.items()):
                return point.index
        return None

    def size(self) -> str:
        """The number of runs in words."""
        n, e = len(self), self.study.model.ensemble
        return f"{n} points x {count(e, 'run')} = {self.runs} runs"

    def words(self, point: Point) -> str:
        """A point in a few words."""
        return self.study.values(point.columns)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self.point(i) for i in range(*index.indices(len(self)))]
        if not -len(self) <= index < len(self):
            raise IndexError(index)
        return self.point(index % len(self))

    @abstractmethod
    def __len__(self) -> int: ...

    @abstractmethod
    def point(self, index: int) -> Point:
        """The point with a number."""

    def _join(self, index: int, levels: Sequence[Level]) -> Point:
        columns = {axis.name: level.value for axis, level in zip(self.axes, levels, strict=True)}
        overrides: dict[str, Any] = {}
        for level in levels:
            overrides |= level.overrides
        place: Place = levels[0].place if len(levels) == 1 else ("parameters",)
        return Point(index, columns, overrides, "", place)


class OneAtATime(Design):
    """The base, then each other level of each parameter with the rest as in the base."""

    def __init__(self, study: Study, axes: Sequence[Axis]) -> None:
        super().__init__(study, axes)
        self._bases = [axis.base or axis.levels[0] for axis in self.axes]
        self._others = [
            (i, level)
            for i, axis in enumerate(self.axes)
            for level in axis.levels
            if level.value != self._bases[i].value
        ]

    def __len__(self) -> int:
        return 1 + len(self._others)

    @cached_property
    def base(self) -> int | None:
        """The base scenario itself."""
        return 0

    def point(self, index: int) -> Point:
        """Point 0 is the base scenario itself."""
        levels = list(self._bases)
        if index == 0:
            point = self._join(0, levels)
            return Point(0, point.columns, {}, "", ("scenario",))
        axis, level = self._others[index - 1]
        levels[axis] = level
        columns = self._join(index, levels).columns
        return Point(index, columns, level.overrides, self.axes[axis].name, level.place)

    def words(self, point: Point) -> str:
        """Differences from the base."""
        if not point.varied:
            return "base"
        return self.study.values({point.varied: point.columns[point.varied]})


class Grid(Design):
    """All combinations of the levels; the last parameter changes fastest."""

    def __len__(self) -> int:
        return math.prod(len(axis.levels) for axis in self.axes)

    def point(self, index: int) -> Point:
        """The combination with a number."""
        levels = []
        rest = index
        for axis in reversed(self.axes):
            rest, i = divmod(rest, len(axis.levels))
            levels.append(axis.levels[i])
        return self._join(index, levels[::-1])


class Sampled(Design):
    """Points of a unit cube, each coordinate the probability below a parameter's value."""

    def __init__(self, study: Study, axes: Sequence[Axis], unit: NDArray[np.float64]) -> None:
        super().__init__(study, axes)
        self.unit = unit

    def __len__(self) -> int:
        return len(self.unit)

    def point(self, index: int) -> Point:
        """The point with a number."""
        row = self.unit[index]
        return self._join(
            index, [axis.at(float(u)) for axis, u in zip(self.axes, row, strict=True)]
        )


class LatinHypercube(Sampled):
    """Each parameter's range in as many equal shares as there are points, one point in each."""


class Sobol(Sampled):
    """Saltelli's points: N (2 D + 2) for N base points and D parameters."""

    def size(self) -> str:
        """The number of runs in words, with where it comes from."""
        n, d, e = self.study.model.points, len(self.axes), self.study.model.ensemble
        return (
            f"N (2 D + 2) = {n} x (2 x {d} + 2) = {len(self)} points"
            f" x {count(e, 'run')} = {self.runs} runs"
        )


class Cases(Design):
    """The list of cases."""

    def __len__(self) -> int:
        return len(self.study.model.cases)

    def point(self, index: int) -> Point:
        """The case with a number."""
        model = self.study.model
        case = model.cases[index]
        overrides = dict(case.set)
        place: Place = ("cases", index)
        if case.order is not None:
            scenario = self.study.scenario
            # blocks given with the case are put in order as they are resolved
            if any(path.split(".")[0] == "train" for path in case.set):
                train = {p: v for p, v in case.set.items() if p.split(".")[0] == "train"}
                scenario = _overridden(self.study, scenario, train, (*place, "set"))
                overrides = {p: v for p, v in overrides.items() if p not in train}
                overrides |= _other_train_fields(train)
            consist = scenario.resolved()["train"]["consist"]
            overrides["train.consist"] = reorder(consist, case.order, None, model.seed)
        columns = {name: case.at[name] for name in model.columns}
        return Point(index, columns, overrides, "", place)

    def words(self, point: Point) -> str:
        """Texts as they are, numbers with their names."""
        return ", ".join(
            v if isinstance(v, str) else self.study.values({k: v})
            for k, v in point.columns.items()
        )


def _other_train_fields(train: Mapping[str, Any]) -> dict[str, Any]:
    return {p: v for p, v in train.items() if not p.startswith("train.consist")}


# --- making -----------------------------------------------------------------------------------


def list_studies() -> list[tuple[str, str, str]]:
    """Name, title and size of every shipped study."""
    found = []
    for path in shipped():
        try:
            design = make(load_study(path))
            found.append((path.stem, design.study.model.title, design.size()))
        except ScenarioError as error:
            found.append((path.stem, f"(cannot be read: {error})", ""))
    return found


def make(study: Study) -> Design:
    """The design of a study.

    Raises
    ------
    ScenarioError
        Naming the field of the study.
    """
    model = study.model
    axes = [_axis(study, name, parameter) for name, parameter in model.parameters.items()]
    design: Design
    if model.design == "cases":
        design = Cases(study, [])
    elif model.design == "grid":
        design = Grid(study, axes)
    elif model.design == "one_at_a_time":
        design = OneAtATime(study, axes)
    else:
        assert model.points is not None
        d = len(axes)
        per_point = 2 * d + 2 if model.design == "sobol" else 1
        if model.points * per_point * model.ensemble > MAX_RUNS:
            raise study.error(("points",), f"makes more than {MAX_RUNS} runs")
        if model.design == "sobol":
            design = Sobol(study, axes, saltelli(model.points, d, model.seed))
        else:
            from scipy.stats import qmc

            unit = qmc.LatinHypercube(d, rng=_stream(model.seed)).random(model.points)
            design = LatinHypercube(study, axes, unit)
    if design.runs > MAX_RUNS:
        raise study.error(("design",), f"makes more than {MAX_RUNS} runs: {design.runs}")
    if len(design) < 2:
        raise study.error(("design",), "must give at least two points")
    if study.model.base is not None and design.base is None:
        raise study.error(("base",), "must be a point of the study")
    return design


def _stream(seed: int) -> np.random.Generator:
    return np.random.Generator(np.random.Philox(np.random.SeedSequence(seed)))


def saltelli(n: int, d: int, seed: int) -> NDArray[np.float64]:
    """Saltelli's N (2 D + 2) points of the unit cube, in SALib's order."""
    from SALib.sample import sobol

    problem = {"num_vars": d, "names": [f"x{i}" for i in range(d)], "bounds": [[0.0, 1.0]] * d}
    # SALib takes 32 bits
    state = int(np.random.SeedSequence(seed).generate_state(1)[0] >> 1)
    return np.asarray(sobol.sample(problem, n, calc_second_order=True, seed=state))


def _axis(study: Study, name: str, p: Parameter) -> Axis:
    place: Place = ("parameters", name)

    def level(value: Any, *at: str | int) -> Level:
        overrides = {p.path: value} if p.path is not None else fill(p.set, value)
        return Level(value, overrides, (*place, *at))

    def number(value: float) -> float | int:
        return int(round(value)) if p.whole else float(value)

    if p.settings is not None:
        levels = [
            Level(key, dict(changes), (*place, "settings", key))
            for key, changes in p.settings.items()
        ]
        return Axis(name, tuple(levels), base=levels[0])
    if p.order is not None:
        return _order_axis(study, name, p)
    base = None
    if study.model.design == "one_at_a_time" or p.percent is not None:
        base = _base_level(study, p, place)
    if p.values is not None:
        levels = [level(value, "values", i) for i, value in enumerate(p.values)]
        return Axis(name, tuple(levels), base=base)
    if p.percent is not None:
        assert base is not None
        levels = [
            _percent_level(study, p, base.value, percent, (*place, "percent", i))
            for i, percent in enumerate(p.percent)
        ]
        return Axis(name, tuple(levels), base=base)
    if p.range is not None:
        low, high = p.range
        if p.steps is not None:
            at = np.linspace(low, high, p.steps)
            values = list(dict.fromkeys(number(float(x)) for x in at))
            return Axis(name, tuple(level(v, "range") for v in values), base=base)
        if p.whole:  # each of the whole numbers has the same share
            first, last = math.ceil(low), math.floor(high)
            if first > last:
                raise study.error((*place, "range"), "contains no whole number")
            size = last - first + 1
            return Axis(name, (), lambda u: level(min(first + int(u * size), last), "range"))
        return Axis(name, (), lambda u: level(low + (high - low) * u, "range"))
    assert p.distribution is not None
    quantile = quantile_of(p.distribution)
    return Axis(name, (), lambda u: level(number(quantile(u)), "distribution"))


def _order_axis(study: Study, name: str, p: Parameter) -> Axis:
    consist = study.scenario.resolved()["train"]["consist"]
    levels = []
    for i, order in enumerate(p.order or ()):
        place = ("parameters", name, "order", i)
        try:
            cars = reorder(consist, order, p.cars, study.model.seed)
        except ValueError as error:
            raise study.error(("parameters", name, "cars"), str(error)) from None
        levels.append(Level(order, {"train.consist": cars}, place))
    return Axis(name, tuple(levels), base=levels[0])


def _base_level(study: Study, p: Parameter, place: Place) -> Level:
    """The level that leaves the base scenario as it is."""
    if p.path is None:
        return Level(p.base, {}, (*place, "base"))
    here: Any = study.scenario.resolved()
    for step in p.path.split("."):
        try:
            here = here[int(step) if isinstance(here, list) else step]
        except (KeyError, IndexError, ValueError, TypeError):
            # the scenario says best what is wrong with the path; any value will do for that
            probe = p.values[0] if p.values else 1.0
            _overridden(study, study.scenario, {p.path: probe}, (*place, "path"))
            raise study.error((*place, "path"), f"the base has no value at {p.path}") from None
    if isinstance(here, (dict, list)) or here is None:
        raise study.error((*place, "path"), f"the base has no single value at {p.path}")
    return Level(here, {}, (*place, "path"))


def _percent_level(study: Study, p: Parameter, base: Any, percent: float, place: Place) -> Level:
    if isinstance(base, (bool, str)):
        raise study.error(place[:-1], f"{p.path} must be a number, got {base!r}")
    if percent == 0.0:
        return Level(base, {}, place)
    value: Any = base * (1.0 + percent / 100.0)
    # 60 cars and 20 % more are 72, a whole number as before
    value = int(round(value)) if isinstance(base, int) or p.whole else float(f"{value:.12g}")
    return Level(value, {p.path or "": value}, place)


# --- checking ---------------------------------------------------------------------------------


def _overridden(
    study: Study, scenario: Scenario, overrides: Mapping[str, Any], place: Place, at: str = ""
) -> Scenario:
    """A scenario with overrides; an error names ``place``, or the parameter whose path it is."""
    try:
        return scenario.with_overrides(overrides)
    except ScenarioError as error:
        text = at + (f"{error.field}: {error.reason}" if error.field else error.reason)
        if at:
            for name, p in study.model.parameters.items():
                if p.path is not None and error.field.startswith(p.path):
                    place = ("parameters", name)
        raise study.error(place, text) from None


def scenario_at(design: Design, point: Point) -> Scenario:
    """The scenario of a point.

    Raises
    ------
    ScenarioError
        Naming the field of the study and that of the scenario.
    """
    study = design.study
    if not point.overrides:
        return study.scenario
    several = point.place == ("parameters",)
    at = f"at {study.values(point.columns)}: " if several else ""
    return _overridden(study, study.scenario, point.overrides, point.place, at)


ENGINE_CHECKS = 200
"""Points of which the engine's own checks are asked too: they take longer than the scenario's."""


def check(design: Design, tell: Callable[[int], None] | None = None) -> str:
    """Check every point of a design before its first run.

    Returns
    -------
    str
        SHA-256 (hex) of what the runs compute: the base scenario, the points, ensemble and seed.

    Raises
    ------
    ScenarioError
        For the first point that cannot be run, naming the field.
    """
    from derail_ros import models
    from derail_ros.vocabulary.errors import ParameterError

    model = design.study.model
    digest = hashlib.sha256()
    head = [design.study.scenario.hash, model.ensemble, model.seed, model.variation, model.design]
    digest.update(json.dumps(head).encode())
    every = max(1, -(-len(design) // ENGINE_CHECKS))
    for point in design:
        scenario = scenario_at(design, point)
        entry = [point.columns, point.overrides]
        digest.update(json.dumps(entry, sort_keys=True, default=str).encode())
        if point.index % every == 0:
            try:
                models.build(scenario.to_params())
            except ParameterError as error:
                text = f"at {design.study.values(point.columns)}: {error}"
                raise design.study.error(point.place, text) from None
        if tell is not None:
            tell(point.index + 1)
    return digest.hexdigest()
