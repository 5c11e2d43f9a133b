r"""How much each reconstructed constant and form matters.

The surviving copy of the source lost equations and constants; what stands in for them is a
choice. Here every such choice is changed, one at a time, and the published cases are run again as
ensembles. The same members (the same lateral forces) are run with the default and with the
change, and for each measure the differences of the pairs are averaged:

- change of a case: mean over its members, standard error ``sd / sqrt(n)`` of the differences;
- change over all cases: mean over the cases, standard errors added in quadrature.

Counts and durations are compared as they are, forces and lengths by the ratio of geometric means.

Outcomes are chaotic, and varying one force by a few percent does not wake all of that: in some
cases all members derail the same number of cars. So there are controls too: changes that mean
nothing (the mirror image, a tighter tolerance, another integrator). What they move is the size
below which no influence can be told from chance.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from derail_ros.scenario.resolve import CYLINDER_RADIUS
from derail_ros.studies.ensemble import (
    VARIATION,
    Result,
    Run,
    ScenarioLike,
    ensemble_runs,
    run_many,
)
from derail_ros.studies.validation import (
    Case,
    Goal,
    Loader,
    Published,
    evaluate,
    goals,
    load_published,
)
from derail_ros.vocabulary.measures import counted, failed_record, outcome_record
from derail_ros.vocabulary.params import (
    BrakeParams,
    Car,
    ContactParams,
    CouplerType,
    DerailmentParams,
    GroundParams,
    IntegrationParams,
)

if TYPE_CHECKING:
    from derail_ros.vocabulary.params import TrainParams

Edit = Callable[["TrainParams"], "TrainParams"]

REDUCED = ("mississauga", "instant_traction", "base_30", "base_60", "base_90")
"""The cases that are run unless others are asked for."""


@dataclass(frozen=True)
class Measure:
    """What is compared.

    Attributes
    ----------
    name, record : key here, key of the outcome's record
    label, unit : words
    ratio : changes are ratios of geometric means, shown in percent
    """

    name: str
    record: str
    label: str
    unit: str
    ratio: bool = False


MEASURES = (
    Measure("cars_derailed", "cars_derailed", "cars derailed", "cars"),
    Measure("duration", "duration_s", "duration", "s"),
    Measure("peak_force", "peak_force_N", "peak force", "%", True),
    Measure("scene_length", "scene_length_m", "scene length", "%", True),
    Measure("scene_width", "scene_width_m", "scene width", "%", True),
)


# What is changed ---------------------------------------------------------------------------


def _cars(change: Callable[[Car], Car]) -> Edit:
    def edit(params: TrainParams) -> TrainParams:
        return replace(params, cars=tuple(change(car) for car in params.cars))

    return edit


def cylinder_radius(radius: float) -> Edit:
    """Yaw inertia of all cars as that of cylinders of another radius, m."""
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


@dataclass(frozen=True)
class Change:
    """Another value, or another form.

    Attributes
    ----------
    value : in words
    side : -1 below the default, 1 above it, 0 another form
    settings : dotted path -> value
    edit : change of the engine's parameters where no path leads
    """

    value: str
    side: int
    settings: Mapping[str, Any] = field(default_factory=dict)
    edit: Edit | None = None

    def params(self, scenario: ScenarioLike) -> TrainParams:
        """The engine's parameters with the change."""
        if self.settings:
            scenario = scenario.with_overrides(self.settings)
        params = scenario.to_params()
        return params if self.edit is None else self.edit(params)


@dataclass(frozen=True)
class Constant:
    """A constant or form with the changes that are tried.

    Attributes
    ----------
    name : short, for ``--only``
    label, default : words
    group : heading
    changes : in rising order, other forms last
    only : names of the cases in which it plays a part; empty: all
    """

    name: str
    label: str
    default: str
    group: str
    changes: tuple[Change, ...]
    only: tuple[str, ...] = ()


def _default(owner: type[Any], name: str) -> float:
    (found,) = (f for f in fields(owner) if f.name == name)
    return float(found.default)  # type: ignore[arg-type]


def _values(
    path: str, default: float, values: Iterable[float], scale: float = 1.0
) -> tuple[Change, ...]:
    """Changes of a number, the default left out; shown in units of ``scale``."""
    return tuple(
        Change(f"{v / scale:g}", -1 if v < default else 1, {path: float(v)})
        for v in sorted(values)
        if v != default
    )


def _number(
    name: str,
    label: str,
    group: str,
    path: str,
    owner: type[Any],
    attribute: str,
    values: Iterable[float],
    scale: float = 1.0,
) -> Constant:
    """A constant whose default is that of a parameter class of the engine."""
    default = _default(owner, attribute)
    return Constant(
        name, label, f"{default / scale:g}", group, _values(path, default, values, scale)
    )


def _baumgarte(velocity: float, position: float) -> Change:
    return Change(
        f"Baumgarte {velocity:g}, {position:g}",
        0,
        {
            "integration.stabilization": "baumgarte",
            "integration.baumgarte_velocity_per_s": velocity,
            "integration.baumgarte_position_per_s2": position,
        },
    )


CONTROL = "Controls: changes that mean nothing"

SQUARED = "\N{SUPERSCRIPT TWO}"
COUPLERS, CARS, BRAKES, GROUND = "Couplers", "Cars", "Brakes", "Ground"
COLLISIONS, REMOVAL, END = "Collisions", "Leaving the rails", "End of the run"


def _form(
    name: str, label: str, default: str, group: str, value: str, path: str, new: Any
) -> Constant:
    """A choice of two."""
    return Constant(name, label, default, group, (Change(value, 0, {path: new}),))


def _constants() -> Iterator[Constant]:
    yield _number(
        "k2", "striker stiffness k2 (MN/m)", COUPLERS, "couplers.k2_N_per_m",
        CouplerType, "k2", (10e6, 50e6, 500e6, 5e9, 50e9), 1e6,
    )  # fmt: skip
    yield _number(
        "coupler_inertia", f"coupler inertia I_c (t m{SQUARED})", COUPLERS,
        "couplers.inertia_kg_m2", Car, "coupler_inertia", (2e3,), 1e3,
    )  # fmt: skip
    yield Constant(
        "coupler_mass", "mass of the couplers", "in the body", COUPLERS,
        (Change("500 kg each at the pivots", 0, edit=coupler_mass(500.0)),),
    )  # fmt: skip
    yield Constant(
        "radius", "radius r of the yaw inertia (m)", f"{CYLINDER_RADIUS:g}", CARS,
        (
            Change("0", -1, edit=cylinder_radius(0.0)),
            Change("2.5", 1, edit=cylinder_radius(2.5)),
        ),
    )  # fmt: skip
    yield _number(
        "F0", "brake force F0 (kN)", BRAKES, "brakes.force_N",
        BrakeParams, "force", (20e3, 35e3, 50e3, 64e3, 70e3), 1e3,
    )  # fmt: skip
    yield Constant(
        "shoe", "brake shoe", "composition", BRAKES,
        (Change("cast iron", 0, edit=shoes("cast_iron")),),
    )  # fmt: skip
    yield Constant(
        "mu_t", "traction coefficient in the brake tests", "0.16", BRAKES,
        _values("brakes.traction_coefficient", 0.16, (0.1, 0.2, 0.3)),
        ("traction", "instant_traction"),
    )  # fmt: skip
    for name, label, path, attribute, values in (
        ("c_v", "growth with speed c_v (s/m)", "c_v_s_per_m", "c_v",
         (0.0, 0.015, 0.03, 0.045, 0.06)),
        ("c_d", "dynamic coefficient c_d", "c_d", "c_d", (0.5, 0.6, 0.7, 0.8, 1.0)),
        ("c_s", "static coefficient c_s", "c_s", "c_s", (0.7, 0.8, 1.2)),
        ("eps", "smoothing at rest eps (m/s)", "eps_m_per_s", "eps",
         (0.003, 0.01, 0.03, 0.1)),
    ):  # fmt: skip
        yield _number(name, label, GROUND, f"ground.{path}", GroundParams, attribute, values)
    yield _form(
        "gap_law", "gap law", "Gaussian", COLLISIONS, "Lorentzian", "contact.gap_law",
        "lorentzian",
    )  # fmt: skip
    yield _number(
        "F_max", "force at contact F_max (MN)", COLLISIONS, "contact.force_max_N",
        ContactParams, "force_max", (1.5e6, 2e6, 2.4e6, 3e6, 4.5e6), 1e6,
    )  # fmt: skip
    for name, label, path, attribute, values in (
        ("d_c", "gap of half the force d_c (m)", "half_distance_m", "half_distance",
         (0.04, 0.08, 0.16, 0.3)),
        ("d_b", "buffer d_b (m)", "buffer_m", "buffer", (0.4, 0.8, 1.2)),
        ("c1", f"quadratic term c1 (s{SQUARED}/m{SQUARED})", "c1_s2_per_m2", "c1",
         (0.0, 0.0125, 0.025, 0.05)),
        ("c2", "linear term c2 (s/m)", "c2_s_per_m", "c2", (0.0, 0.05, 0.1, 0.2, 0.4)),
    ):  # fmt: skip
        yield _number(name, label, COLLISIONS, f"contact.{path}", ContactParams, attribute, values)
    begin, end = _default(ContactParams, "begin_force"), _default(ContactParams, "end_force")
    yield Constant(
        "event", "a collision begins, ends at (kN)", f"{begin / 1e3:g}, {end / 1e3:g}",
        COLLISIONS,
        tuple(
            Change(
                f"{factor * begin / 1e3:g}, {factor * end / 1e3:g}",
                -1 if factor < 1.0 else 1,
                {"contact.begin_force_N": factor * begin, "contact.end_force_N": factor * end},
            )
            for factor in (0.1, 10.0)
        ),
    )  # fmt: skip
    quotient = _number(
        "LV", "derailment quotient LV", REMOVAL, "derailment.lv_limit",
        DerailmentParams, "lv_limit", (1.0, 1.5, 2.0, 4.0),
    )  # fmt: skip
    none = Change("none", 1, {"derailment.lv_limit": 1e6})
    yield replace(quotient, changes=(*quotient.changes, none))
    yield _form(
        "break_follows", "a lateral derailment breaks the rail", "no", REMOVAL, "yes",
        "derailment.break_follows_lateral", True,
    )  # fmt: skip
    yield _form(
        "locate", "breaks and couplings tested", "within steps", REMOVAL, "at their ends",
        "integration.locate_crossings", False,
    )  # fmt: skip
    for name, label, path, attribute, values in (
        ("rest_speed", "at rest below (m/s)", "rest_speed_m_per_s", "rest_speed",
         (0.05, 0.1, 0.3, 0.5)),
        ("rest_yaw", "at rest below (rad/s)", "rest_yaw_rate_rad_per_s", "rest_yaw_rate",
         (0.01, 0.05, 0.1)),
        ("rest_hold", "at rest for (s)", "rest_hold_s", "rest_hold", (0.1, 0.5, 2.0)),
    ):  # fmt: skip
        yield _number(
            name, label, END, f"integration.{path}", IntegrationParams, attribute, values
        )
    yield Constant(
        "stabilization", "constraints kept by", "projection", CONTROL,
        (_baumgarte(30.0, 50.0), _baumgarte(10.0, 25.0)),
    )  # fmt: skip
    yield _form(
        "mirror", "lateral force", "to the left", CONTROL, "to the right",
        "initiation.lateral_force_N", -50e3,
    )  # fmt: skip
    rtol = _default(IntegrationParams, "rtol")
    yield Constant(
        "rtol", "tolerance", f"{rtol:g}", CONTROL,
        (Change(f"{0.1 * rtol:g}", 0, {"integration.rtol": 0.1 * rtol}),),
    )  # fmt: skip
    method = IntegrationParams().method
    yield Constant(
        "method", "integrator", method, CONTROL,
        tuple(
            Change(name, 0, {"integration.method": name, "integration.rtol": own})
            for name, own in (("rkf45", 1e-4), ("row", 1e-3))
            if name != method
        ),
    )  # fmt: skip


CONSTANTS: tuple[Constant, ...] = tuple(_constants())
"""All that is varied."""


# Results -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Difference:
    """A measure with a change less that without it.

    Attributes
    ----------
    mean, error : mean and its standard error; natural logarithms of ratios where the measure
        is compared so
    pairs : members compared
    """

    mean: float
    error: float
    pairs: int

    @property
    def known(self) -> bool:
        """There were pairs to compare."""
        return self.pairs > 0


def difference(
    changed: Sequence[Mapping[str, Any]],
    default: Sequence[Mapping[str, Any]],
    measure: Measure,
) -> Difference:
    """Paired difference of two ensembles of records, members in the same order."""
    found = []
    for a, b in zip(changed, default, strict=True):
        if not (counted(a) and counted(b)):
            continue
        x, y = a[measure.record], b[measure.record]
        if x is None or y is None or (measure.ratio and not (x > 0.0 and y > 0.0)):
            continue
        found.append(math.log(x / y) if measure.ratio else float(x) - float(y))
    if not found:
        return Difference(math.nan, math.nan, 0)
    values = np.array(found)
    error = float(values.std(ddof=1) / math.sqrt(len(values))) if len(values) > 1 else math.nan
    return Difference(float(values.mean()), error, len(values))


def over_cases(differences: Sequence[Difference]) -> Difference:
    """Mean over the cases that have the measure."""
    known = [d for d in differences if d.known]
    if not known:
        return Difference(math.nan, math.nan, 0)
    mean = sum(d.mean for d in known) / len(known)
    error = math.sqrt(sum(d.error**2 for d in known)) / len(known)
    return Difference(mean, error, sum(d.pairs for d in known))


def percent(d: Difference, measure: Measure) -> tuple[float, float]:
    """Mean and standard error in the unit of the measure."""
    if not measure.ratio:
        return d.mean, d.error
    ratio = math.exp(d.mean) if d.known else math.nan
    return 100.0 * (ratio - 1.0), 100.0 * ratio * d.error


@dataclass(frozen=True)
class Effect:
    """What a change does.

    Attributes
    ----------
    constant, change : what was changed
    cases : name of case -> name of measure -> difference
    overall : name of measure -> difference, over the cases
    reached : how the changed model compares with the published runs
    void, failed : runs with the change that are left out
    """

    constant: Constant
    change: Change
    cases: Mapping[str, Mapping[str, Difference]]
    overall: Mapping[str, Difference]
    reached: tuple[Goal, ...]
    void: int
    failed: int
    errors: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """As plain data; ratios in percent."""

        def plain(differences: Mapping[str, Difference]) -> dict[str, Any]:
            values = {}
            for m in MEASURES:
                mean, error = percent(differences[m.name], m)
                values[m.name] = {
                    "unit": m.unit,
                    "change": mean if math.isfinite(mean) else None,
                    "standard_error": error if math.isfinite(error) else None,
                    "pairs": differences[m.name].pairs,
                }
            return values

        return {
            "constant": self.constant.name,
            "label": self.constant.label,
            "default": self.constant.default,
            "value": self.change.value,
            "settings": dict(self.change.settings),
            "overall": plain(self.overall),
            "cases": {name: plain(d) for name, d in self.cases.items()},
            "published": {g.name: g.value for g in self.reached},
            "void": self.void,
            "failed": self.failed,
            "errors": list(self.errors),
        }


@dataclass(frozen=True)
class Sensitivity:
    """The whole study.

    Attributes
    ----------
    members, seed : of the ensembles
    cases : that were run
    default : how the model as it is compares with the published runs
    effects : in the order of :data:`CONSTANTS`
    runs, void, failed : all of them; those left out
    """

    members: int
    seed: int
    cases: tuple[Case, ...]
    default: tuple[Goal, ...]
    effects: tuple[Effect, ...]
    runs: int
    failed: int

    @property
    def floor(self) -> dict[str, float]:
        """Largest size of a change by the controls, by measure; 0 without controls."""
        return {
            m.name: max(
                (
                    abs(e.overall[m.name].mean)
                    for e in self.effects
                    if e.constant.group == CONTROL and e.overall[m.name].known
                ),
                default=0.0,
            )
            for m in MEASURES
        }

    def as_dict(self) -> dict[str, Any]:
        """As plain data."""
        return {
            "members": self.members,
            "seed": self.seed,
            "cases": [c.name for c in self.cases],
            "published_default": {g.name: g.value for g in self.default},
            "control_floor": {
                m.name: percent(Difference(self.floor[m.name], 0.0, 1), m)[0] for m in MEASURES
            },
            "effects": [e.as_dict() for e in self.effects],
            "runs": self.runs,
            "failed": self.failed,
        }


def choose_cases(published: Published, names: Sequence[str]) -> tuple[Case, ...]:
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
            raise ValueError(f"there is no case {name!r}; there are all, {', '.join(known)}")
    return tuple(known[n] for n in (dict.fromkeys(names) or REDUCED))


def choose_constants(names: Sequence[str]) -> tuple[Constant, ...]:
    """Constants by name, in the order of :data:`CONSTANTS`; all without names."""
    known = {c.name for c in CONSTANTS}
    for name in names:
        if name not in known:
            there = ", ".join(c.name for c in CONSTANTS)
            raise ValueError(f"there is no constant {name!r}; there are {there}")
    return tuple(c for c in CONSTANTS if not names or c.name in names)


Key = tuple[int, int]
Record = Mapping[str, Any]


def _record(result: Result) -> Record:
    if result.error is not None:
        return failed_record(result.error, result.wall_s)
    return outcome_record(result.outcome, result.wall_s)


def sensitivity(
    members: int = 20,
    seed: int = 0,
    *,
    jobs: int | None = None,
    cases: Sequence[str] = (),
    constants: Sequence[str] = (),
    published: Published | None = None,
    load: Loader | None = None,
    progress: Callable[[int, int], None] | None = None,
    run: Callable[..., Iterator[Result]] = run_many,
) -> Sensitivity:
    """Run everything and compare.

    Parameters
    ----------
    members : runs a case and change; the first has the case's own lateral force
    seed : of the variation of the lateral force
    jobs : runs at a time
    cases, constants : names; by default :data:`REDUCED` and all of :data:`CONSTANTS`
    published : cases; those that come with the package by default
    load : scenario by name; ``derail_ros.scenario.load_scenario`` by default
    progress : told ``(done, total)`` after each run
    run : runner of runs
    """
    if members < 2:
        raise ValueError(f"members: must be at least 2, not {members}")
    if published is None:
        published = load_published()
    if load is None:
        from derail_ros.scenario import load_scenario as load

    chosen = choose_cases(published, cases)
    scenarios = [load(c.scenario).with_overrides(c.overrides) for c in chosen]
    # Ensemble 0 is the default; the others are changes. Those without a case are left out.
    default = Change("", 0)
    tried: list[tuple[Constant | None, Change, tuple[int, ...]]] = [
        (None, default, tuple(range(len(chosen))))
    ]
    for constant in choose_constants(constants):
        places = tuple(
            i for i, c in enumerate(chosen) if not constant.only or c.name in constant.only
        )
        if places:
            tried += [(constant, change, places) for change in constant.changes]
    # All of them before the first run: a mistake is not found after minutes.
    params: dict[Key, TrainParams] = {
        (number, place): change.params(scenarios[place])
        for number, (_, change, places) in enumerate(tried)
        for place in places
    }
    records: dict[Key, list[Any]] = {key: [None] * members for key in params}
    total, done = members * len(params), 0
    with closing(run(_runs(params, members, seed), jobs=jobs)) as results:
        for result in results:
            records[result.run.key][result.run.member] = _record(result)
            done += 1
            if progress is not None:
                progress(done, total)

    limits = published.goals
    effects = []
    for number, (constant, change, places) in enumerate(tried):
        if constant is not None:
            mine = {p: records[number, p] for p in places}
            effects.append(_effect(constant, change, chosen, mine, records, limits))
    default_results = [evaluate(c, records[0, i]) for i, c in enumerate(chosen)]
    return Sensitivity(
        members=members,
        seed=seed,
        cases=chosen,
        default=tuple(goals(default_results, limits)),
        effects=tuple(effects),
        runs=total,
        failed=sum("error" in r for ensemble in records.values() for r in ensemble),
    )


def _runs(params: Mapping[Key, TrainParams], members: int, seed: int) -> Iterator[Run]:
    for key, built in params.items():
        yield from ensemble_runs(built, members, seed=seed, key=key)


def _effect(
    constant: Constant,
    change: Change,
    cases: Sequence[Case],
    mine: Mapping[int, Sequence[Record]],
    records: Mapping[Key, Sequence[Record]],
    limits: Mapping[str, float],
) -> Effect:
    by_case = {
        cases[p].name: {m.name: difference(r, records[0, p], m) for m in MEASURES}
        for p, r in mine.items()
    }
    # Where a constant plays no part nothing changes, so the comparison takes the default there.
    results = [evaluate(c, mine.get(p, records[0, p])) for p, c in enumerate(cases)]
    everything = [r for ensemble in mine.values() for r in ensemble]
    failed = [r for r in everything if "error" in r]
    return Effect(
        constant=constant,
        change=change,
        cases=by_case,
        overall={m.name: over_cases([d[m.name] for d in by_case.values()]) for m in MEASURES},
        reached=tuple(goals(results, limits)),
        void=sum(not counted(r) for r in everything) - len(failed),
        failed=len(failed),
        errors=tuple(sorted({r["error"] for r in failed})),
    )


# Words -------------------------------------------------------------------------------------

GOALS = (
    ("count_rms", "count, rms (cars)"),
    ("duration_rms_s", "duration, rms (s)"),
    ("peak_inside_share", "peak in the band"),
    ("peak_log_ratio", "peak, median size of ln"),
    ("length_rms", "length, rms"),
    ("width_rms", "width, rms"),
)


def shown(d: Difference, measure: Measure) -> str:
    """A change with its standard error."""
    if not d.known:
        return "-"
    mean, error = percent(d, measure)
    digits = {"cars": 2, "s": 2}.get(measure.unit, 1)
    text = f"{mean:+.{digits}f}"
    if float(text) == 0.0:
        text = text.replace("-", "+")
    return text if math.isnan(error) else f"{text} ± {error:.{digits}f}"


def stands_out(d: Difference, measure: Measure, floor: Mapping[str, float]) -> bool:
    """A change is larger than two standard errors and than what the controls move."""
    return d.known and abs(d.mean) > max(2.0 * d.error, floor[measure.name], 1e-12)


def _goal_cells(reached: Sequence[Goal]) -> str:
    values = {g.name: g.value for g in reached}
    return " | ".join("-" if values[name] is None else f"{values[name]:.2f}" for name, _ in GOALS)


def markdown(study: Sensitivity, image: str) -> str:
    """The page ``docs/sensitivity.md``; ``image`` is the figure's path from there."""
    floor = study.floor
    intro = (
        "The surviving copy of the source lost equations and constants. What stands in for them "
        "is argued in [model.md](model.md#reconstructed-parts); here is how much each choice "
        "matters. One at a time it is changed and these published cases are run again as "
        f"ensembles of {study.members} (lateral force varied by up to {100 * VARIATION:g} %, "
        f"seed {study.seed}): {'; '.join(c.title for c in study.cases)}. That is "
        f"{study.runs} runs."
    )
    reading = (
        "Numbers are the mean change against the default over the cases, in pairs of runs with "
        "the same lateral force, with its standard error. Forces and lengths are compared by the "
        "ratio of geometric means. Bold: more than two standard errors and more than any "
        "control. The controls are changes that mean nothing; a chaotic outcome moves with them "
        "all the same, and what they move is the least that can be told from chance."
    )
    if any(d.known and math.isnan(d.error) for e in study.effects for d in e.overall.values()):
        reading += " Without an error: void runs left some case with a single pair."
    lines = [
        "# Sensitivity: what the reconstructed constants do",
        "",
        "Written by `derail sensitivity --write`; do not edit.",
        "",
        *textwrap.wrap(intro, 99),
        "",
        *textwrap.wrap(reading, 99),
        "",
        f"![Change of outcome by each constant]({image})",
    ]
    group = ""
    for effect in study.effects:
        if effect.constant.group != group:
            group = effect.constant.group
            heads = " | ".join(f"{m.label} ({m.unit})" for m in MEASURES)
            lines += [
                "",
                f"## {group}",
                "",
                f"| constant | default | changed to | {heads} |",
                "|---|---|---|" + "---|" * len(MEASURES),
            ]
        cells = []
        for m in MEASURES:
            d = effect.overall[m.name]
            text = shown(d, m)
            cells.append(f"**{text}**" if stands_out(d, m, floor) else text)
        lines.append(
            f"| {effect.constant.label} | {effect.constant.default} | {effect.change.value} | "
            + " | ".join(cells)
            + " |"
        )
    explained = (
        "Would another value agree better with the published runs? The goals of "
        "[validation.md](validation.md) over the cases above, for the default and for every "
        "change. They are fewer cases than there, so a small gain here is not yet a reason to "
        "change a default."
    )
    lines += [
        "",
        "## Agreement with the published runs",
        "",
        *textwrap.wrap(explained, 99),
        "",
        "| constant | value | " + " | ".join(label for _, label in GOALS) + " |",
        "|---|---|" + "---|" * len(GOALS),
        f"| **default** | | {_goal_cells(study.default)} |",
    ]
    for effect in study.effects:
        lines.append(
            f"| {effect.constant.label} | {effect.change.value} | {_goal_cells(effect.reached)} |"
        )
    left_out = [e for e in study.effects if e.void or e.failed]
    if left_out:
        lines += [
            "",
            "## Runs left out",
            "",
            "Void: the body that stands for the cars behind reached the break.",
            "",
            "| constant | value | void | failed |",
            "|---|---|---|---|",
        ]
        lines += [
            f"| {e.constant.label} | {e.change.value} | {e.void} | {e.failed} |" for e in left_out
        ]
    lines.append("")
    return "\n".join(lines)
