r"""How much each reconstructed constant and form matters.

The surviving copy of the source lost equations and constants; what stands in for them is a
choice. Each choice (``data/constants.yaml``) is changed, one at a time, and the published cases
are run again as ensembles. The same members (the same lateral forces) are run with the default
and with the change, and for each measure the differences of the pairs are averaged:

- change of a case: mean over its members, standard error ``sd / sqrt(n)`` of the differences;
- change over all cases: mean over the cases, standard errors added in quadrature.

Counts and durations are compared by their difference, forces and lengths by the ratio of
geometric means.

Outcomes are chaotic, and varying one force by a few percent does not bring out all of that: in
some cases all members derail the same number of cars. Controls are changes that mean nothing (the
mirror image, a tighter tolerance, another integrator). An influence below the largest change by a
control cannot be told from chance.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import numpy as np

from derail_ros.scenario import load_scenario
from derail_ros.studies.ensemble import Job, ScenarioLike, ensemble_jobs
from derail_ros.studies.published import Published, PublishedCase, load_published
from derail_ros.studies.records import Ensemble, ensembles, plain
from derail_ros.studies.tables import Strong, Table
from derail_ros.studies.validation import CaseResult, Goal, goals
from derail_ros.vocabulary import params as engine_params
from derail_ros.vocabulary.measures import MEASURES, Record, counted

if TYPE_CHECKING:
    from derail_ros.vocabulary.params import Car, TrainParams

REDUCED = ("mississauga", "instant_traction", "base_30", "base_60", "base_90")
"""The cases that are run unless others are asked for."""

CONTROL = "Controls: changes that mean nothing"
"""The group of the controls."""


@dataclass(frozen=True)
class Compared:
    """A measure that is compared, and how."""

    key: str
    ratio: bool = False  # changes are ratios of geometric means, shown in percent

    @property
    def unit(self) -> str:
        """Unit in which changes are given."""
        return "%" if self.ratio else MEASURES[self.key].unit or "cars"

    @property
    def title(self) -> str:
        """Words with the unit."""
        return f"{MEASURES[self.key].words} ({self.unit})"


COMPARED = (
    Compared("cars_derailed"),
    Compared("duration_s"),
    Compared("peak_force_N", True),
    Compared("scene_length_m", True),
    Compared("scene_width_m", True),
)


# What is changed ---------------------------------------------------------------------------

Edit = Callable[["TrainParams"], "TrainParams"]


def _cars(change: Callable[[Car], Car]) -> Edit:
    return lambda params: replace(params, cars=tuple(change(car) for car in params.cars))


def cylinder_radius(radius: float) -> Edit:
    """Yaw inertia of all cars as that of cylinders of another radius, m."""
    from derail_ros.scenario.resolve import CYLINDER_RADIUS

    more = 0.25 * (radius**2 - CYLINDER_RADIUS**2)
    return _cars(lambda car: replace(car, inertia=car.inertia + more * car.mass))


def coupler_mass(mass: float) -> Edit:
    """Part of each car's mass, kg a coupler, moved from the body to the two coupler pivots."""

    def change(car: Car) -> Car:
        body = (car.mass - 2.0 * mass) / car.mass
        pivots = 2.0 * mass * car.pivot_distance**2
        return replace(car, inertia=body * car.inertia + pivots)

    return _cars(change)


def shoes(kind: str) -> Edit:
    """Brake shoes of all cars."""
    return _cars(lambda car: replace(car, brakes=tuple(replace(u, shoe=kind) for u in car.brakes)))


EDITS: Mapping[str, Callable[[Any], Edit]] = {
    "cylinder_radius": cylinder_radius,
    "coupler_mass": coupler_mass,
    "shoes": shoes,
}


@dataclass(frozen=True)
class Change:
    """Another value, or another form."""

    value: str  # in words
    side: int  # -1 below the default, 1 above it, 0 another form
    settings: Mapping[str, Any] = field(default_factory=dict)  # dotted path -> value
    edit: Edit | None = None  # change of the engine's parameters where no path leads

    def params(self, scenario: ScenarioLike) -> TrainParams:
        """The engine's parameters with the change."""
        if self.settings:
            scenario = scenario.with_overrides(self.settings)
        params = scenario.to_params()
        return params if self.edit is None else self.edit(params)


@dataclass(frozen=True)
class Constant:
    """A constant or form with the changes that are tried."""

    name: str  # short, for ``--only``
    label: str
    default: str
    group: str  # heading
    changes: tuple[Change, ...]  # in rising order, other forms last
    only: tuple[str, ...] = ()  # names of the cases in which it matters; empty: all


def _constant(group: str, entry: dict[str, Any]) -> Constant:
    changes, default = [], entry.get("default", "")
    if "of" in entry:
        owner, name = entry["of"].split(".")
        scale = float(entry.get("scale", 1.0))
        (found,) = (f for f in fields(getattr(engine_params, owner)) if f.name == name)
        default = f"{found.default / scale:g}"
        for value in entry["values"]:
            v = value * scale
            if v != found.default:
                side = -1 if v < found.default else 1
                changes.append(Change(f"{value:g}", side, {entry["path"]: v}))
    for change in entry.get("changes", ()):
        edits = [EDITS[name](value) for name, value in change.get("edit", {}).items()]
        changes.append(
            Change(change["value"], change.get("side", 0), change.get("set", {}), *edits)
        )
    only = tuple(entry.get("only", ()))
    return Constant(entry["name"], entry["label"], default, group, tuple(changes), only)


@lru_cache(maxsize=1)
def load_constants() -> tuple[Constant, ...]:
    """All that is varied, read from ``data/constants.yaml``."""
    import yaml

    text = (files("derail_ros.studies") / "data" / "constants.yaml").read_text(encoding="utf-8")
    return tuple(
        _constant(group, entry)
        for group, entries in yaml.safe_load(text).items()
        for entry in entries
    )


# Results -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Difference:
    """A measure with a change less that without it."""

    mean: float  # natural logarithm of a ratio where the measure is compared by ratios
    error: float  # standard error of the mean
    pairs: int  # members compared

    @property
    def known(self) -> bool:
        """There were pairs to compare."""
        return self.pairs > 0

    def shown_in(self, compared: Compared) -> tuple[float, float]:
        """Mean and standard error in the unit of the comparison."""
        if not compared.ratio:
            return self.mean, self.error
        ratio = math.exp(self.mean) if self.known else math.nan
        return 100.0 * (ratio - 1.0), 100.0 * ratio * self.error


UNKNOWN = Difference(math.nan, math.nan, 0)


def difference(
    changed: Sequence[Record], default: Sequence[Record], compared: Compared
) -> Difference:
    """Paired difference of two ensembles of records, members in the same order."""
    found = []
    for a, b in zip(changed, default, strict=True):
        if not (counted(a) and counted(b)):
            continue
        x, y = a[compared.key], b[compared.key]
        if x is None or y is None or (compared.ratio and not (x > 0.0 and y > 0.0)):
            continue
        found.append(math.log(x / y) if compared.ratio else float(x) - float(y))
    if not found:
        return UNKNOWN
    values = np.array(found)
    error = float(values.std(ddof=1) / math.sqrt(len(values))) if len(values) > 1 else math.nan
    return Difference(float(values.mean()), error, len(values))


def over_cases(differences: Iterable[Difference]) -> Difference:
    """Mean over the cases that have the measure."""
    known = [d for d in differences if d.known]
    if not known:
        return UNKNOWN
    mean = sum(d.mean for d in known) / len(known)
    error = math.sqrt(sum(d.error**2 for d in known)) / len(known)
    return Difference(mean, error, sum(d.pairs for d in known))


def _as_dict(differences: Mapping[str, Difference]) -> dict[str, Any]:
    found = {}
    for c in COMPARED:
        d = differences[c.key]
        change, error = d.shown_in(c)
        found[c.key] = {"unit": c.unit, "change": change, "standard_error": error,
                        "pairs": d.pairs}  # fmt: skip
    return plain(found)


@dataclass(frozen=True)
class Effect:
    """The effect of a change."""

    constant: Constant
    change: Change
    cases: Mapping[str, Mapping[str, Difference]]  # name of case -> key of measure -> difference
    overall: Mapping[str, Difference]  # key of measure -> difference, over the cases
    reached: tuple[Goal, ...]  # how the changed model compares with the published runs
    ensemble: Ensemble  # all runs with the change

    def as_dict(self) -> dict[str, Any]:
        """As plain data; ratios in percent."""
        return {
            "constant": self.constant.name,
            "label": self.constant.label,
            "default": self.constant.default,
            "value": self.change.value,
            "settings": dict(self.change.settings),
            "overall": _as_dict(self.overall),
            "cases": {name: _as_dict(d) for name, d in self.cases.items()},
            "published": {g.name: g.value for g in self.reached},
            **self.ensemble.counts(),
        }


@dataclass(frozen=True)
class Sensitivity:
    """All effects."""

    members: int
    seed: int
    cases: tuple[PublishedCase, ...]
    default: tuple[Goal, ...]  # how the model as it is compares with the published runs
    effects: tuple[Effect, ...]  # in the order of the constants
    runs: int  # number of all runs
    failed: int

    @property
    def floor(self) -> dict[str, float]:
        """Largest size of a change by the controls, by measure; 0 without controls."""
        controls = [e.overall for e in self.effects if e.constant.group == CONTROL]
        return {
            c.key: max((abs(o[c.key].mean) for o in controls if o[c.key].known), default=0.0)
            for c in COMPARED
        }

    def as_dict(self) -> dict[str, Any]:
        """As plain data."""
        floor = self.floor
        return {
            "members": self.members,
            "seed": self.seed,
            "cases": [c.name for c in self.cases],
            "published_default": {g.name: g.value for g in self.default},
            "control_floor": {
                c.key: Difference(floor[c.key], 0.0, 1).shown_in(c)[0] for c in COMPARED
            },
            "effects": [e.as_dict() for e in self.effects],
            "runs": self.runs,
            "failed": self.failed,
        }


def choose_cases(published: Published, names: Sequence[str]) -> tuple[PublishedCase, ...]:
    """Cases by name; ``all`` are all that count in the comparison, none the reduced set.

    Raises
    ------
    ValueError
        Naming what there is.
    """
    if list(names) == ["all"]:
        return published.cases
    known = {c.name: c for c in (*published.cases, *published.beside)}
    for name in names:
        if name not in known:
            raise ValueError(f"unknown case {name!r}; choose all or some of {', '.join(known)}")
    return tuple(known[n] for n in (dict.fromkeys(names) or REDUCED))


def choose_constants(names: Sequence[str]) -> tuple[Constant, ...]:
    """Constants by name, in the order of the list; all without names."""
    known = [c.name for c in load_constants()]
    for name in names:
        if name not in known:
            raise ValueError(f"unknown constant {name!r}; choose some of {', '.join(known)}")
    return tuple(c for c in load_constants() if not names or c.name in names)


def sensitivity(
    members: int = 20,
    seed: int = 0,
    *,
    cases: Sequence[str] = (),
    constants: Sequence[str] = (),
    **how: Any,
) -> Sensitivity:
    """Run everything and compare.

    Parameters
    ----------
    members : runs a case and change; the first has the case's own lateral force
    seed : of the variation of the lateral force
    cases, constants : names; by default :data:`REDUCED` and all constants
    how : ``jobs``, ``run`` and ``progress`` of :func:`derail_ros.studies.ensemble.gather`
    """
    if members < 2:
        raise ValueError(f"members must be at least 2, got {members}")
    published = load_published()
    chosen = choose_cases(published, cases)
    scenarios = {c.name: load_scenario(c.scenario).with_overrides(c.overrides) for c in chosen}
    # The default and each change, on the cases in which it matters.
    tried = [(None, Change("", 0), list(scenarios))]
    for constant in choose_constants(constants):
        names = [n for n in scenarios if not constant.only or n in constant.only]
        if names:
            tried += [(constant, change, names) for change in constant.changes]
    # All of them before the first run: a mistake is reported at once.
    params = {
        (number, name): change.params(scenarios[name])
        for number, (_, change, names) in enumerate(tried)
        for name in names
    }

    def runs() -> Iterator[Job]:
        for key, built in params.items():
            yield from ensemble_jobs(built, members, seed=seed, key=key)

    found = ensembles(runs(), **how)
    default = {name: found[0, name] for name in scenarios}

    def reached(of: Mapping[str, Ensemble]) -> tuple[Goal, ...]:
        # Where a constant does not matter the comparison takes the default.
        return tuple(
            goals([CaseResult(c, {**default, **of}[c.name]) for c in chosen], published.goals)
        )

    effects = []
    for number, (constant, change, names) in enumerate(tried):
        if constant is None:
            continue
        mine = {name: found[number, name] for name in names}
        by_case = {
            name: {c.key: difference(e.records, default[name].records, c) for c in COMPARED}
            for name, e in mine.items()
        }
        overall = {c.key: over_cases(d[c.key] for d in by_case.values()) for c in COMPARED}
        everything = Ensemble(tuple(r for e in mine.values() for r in e.records))
        effects.append(Effect(constant, change, by_case, overall, reached(mine), everything))
    return Sensitivity(
        members=members,
        seed=seed,
        cases=chosen,
        default=reached({}),
        effects=tuple(effects),
        runs=members * len(params),
        failed=sum(e.failed for e in found.values()),
    )


# Tables ------------------------------------------------------------------------------------


def shown(d: Difference, compared: Compared) -> str:
    """A change with its standard error."""
    if not d.known:
        return "-"
    mean, error = d.shown_in(compared)
    digits = 1 if compared.ratio else 2
    text = f"{mean:+.{digits}f}"
    if float(text) == 0.0:
        text = text.replace("-", "+")
    return text if math.isnan(error) else f"{text} ± {error:.{digits}f}"


def stands_out(d: Difference, compared: Compared, floor: Mapping[str, float]) -> bool:
    """A change is larger than two standard errors and than the changes by the controls."""
    return d.known and abs(d.mean) > max(2.0 * d.error, floor[compared.key], 1e-12)


def effect_table(study: Sensitivity, group: str | None = None) -> Table:
    """Changes over the cases, of one group of constants or of all."""
    floor = study.floor
    rows = []
    for effect in study.effects:
        if group not in (None, effect.constant.group):
            continue
        cells = []
        for c in COMPARED:
            d = effect.overall[c.key]
            text = shown(d, c)
            cells.append(Strong(text) if stands_out(d, c, floor) else text)
        rows.append([effect.constant.label, effect.constant.default, effect.change.value, *cells])
    heads = ["constant", "default", "changed to", *(c.title for c in COMPARED)]
    return Table(heads, rows, group or "", texts=3)
