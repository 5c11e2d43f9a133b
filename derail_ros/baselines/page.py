"""The results of ``docs/baselines.md``: ensembles of all models, as tables and figures.

The page's paragraphs are written by hand; what is between its markers is made anew by ``derail
compare-models --write``. Models that know the push that starts the motion are run as ensembles
(the push varied by a few percent), the others once: nothing in them varies.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from derail_ros.baselines.comparison import (
    MEASURES,
    Entry,
    by_speed_figure,
    cell,
    figure,
)
from derail_ros.baselines.models import MODELS, VARIED, ModelRun, run_model
from derail_ros.studies.ensemble import Result, Run, Stopped, member_factor, run_many, vary
from derail_ros.studies.records import summarize
from derail_ros.vocabulary.measures import Record, failed_record

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from derail_ros.studies.accidents import SpeedClass
    from derail_ros.vocabulary.params import TrainParams

BEGIN = "<!-- results: {} -->"
END = "<!-- end of results -->"

PUBLISHED = {
    "cars_derailed": ("cars_derailed", 1.0),
    "duration_s": ("duration_s", 1.0),
    "peak_force_N": ("peak_force_MN", 1e6),
    "scene_length_m": ("scene_length_m", 1.0),
    "scene_width_m": ("scene_width_m", 1.0),
}
"""Key of a record -> key of a published run, factor."""

PLANE = ("toma", "yang-manos", "anderson", "roorda-gracie")
"""Models with a final scene."""


@dataclass(frozen=True)
class Job:
    """One model on one train: an ensemble, or a single run where nothing varies.

    Attributes
    ----------
    case : part of the page it belongs to
    label : name within the case
    model : of ``MODELS``
    scenario, overrides : the train
    constants : of the model itself
    members : of an ensemble
    repeats : of each run, for the least wall time
    """

    case: str
    label: str
    model: str
    scenario: str
    overrides: Mapping[str, Any] = field(default_factory=dict)
    constants: Mapping[str, float] = field(default_factory=dict)
    members: int = 1
    repeats: int = 1

    @property
    def words(self) -> str:
        """What is run, in words."""
        text = self.scenario
        if "train.speed_kmh" in self.overrides:
            text += f" at {self.overrides['train.speed_kmh']:g} km/h"
        text += f", `{self.model}`"
        return text if self.label == self.model else f"{text} ({self.label})"


@dataclass(frozen=True)
class Ensemble:
    """What came of a job.

    Attributes
    ----------
    records : one a member, in their order
    notes : what the model told beyond the keys of a record, one a member that did not fail
    first : the run of the scenario itself; None if it failed
    """

    job: Job
    records: tuple[Record, ...]
    notes: tuple[Mapping[str, Any], ...]
    first: ModelRun | None

    @property
    def mean(self) -> Record:
        """Means over the members that count."""
        return summarize(self.records).mean()

    @property
    def sd(self) -> Record:
        """Standard deviations of single runs (N - 1)."""
        return summarize(self.records).sd()

    def entry(self) -> Entry:
        """The run of the scenario itself, as an entry of a comparison."""
        error = next((r["error"] for r in self.records if "error" in r), None)
        return Entry(self.job.model, self.first, error if self.first is None else None)

    def mean_entry(self) -> Entry:
        """The means, as an entry of a comparison."""
        mean = self.mean
        if not mean:
            return Entry(self.job.model, None, "no run")
        return Entry(self.job.model, ModelRun(self.job.model, mean))

    def as_dict(self) -> dict[str, Any]:
        """As plain data."""
        moments = summarize(self.records)
        return {
            "case": self.job.case,
            "label": self.job.label,
            "model": self.job.model,
            "scenario": self.job.scenario,
            "overrides": dict(self.job.overrides),
            "constants": dict(self.job.constants),
            "members": self.job.members,
            "void": moments.void,
            "failed": moments.failed,
            "mean": moments.mean(),
            "sd": moments.sd(),
            "wall_s_least": min(r["wall_s"] for r in self.records),
        }


@dataclass(frozen=True)
class Plan:
    """What the page shows; a smaller one is for tests.

    Attributes
    ----------
    speeds : of the base train, all models, km/h
    scene_speed : the one whose final scenes are drawn, km/h
    fast : further speeds of the main model and Yang and Manos's, km/h
    classes : classes of speed of the reported accidents that are shown, from the fastest down
    choice_speeds : of Yang and Manos's base case with other choices, km/h
    trains : scenarios shown with all models
    limits : forces at which Anderson's springs are removed, N
    frictions : of Roorda and Gracie
    tuned_speeds : of the base train with them, km/h
    models : those shown
    shared : changes to every train
    """

    speeds: tuple[float, ...] = (30.0, 48.0, 60.0, 72.0, 90.0)
    scene_speed: float = 90.0
    fast: tuple[float, ...] = (96.0, 105.0, 112.0, 120.0, 130.0, 145.0)
    classes: int = 7
    choice_speeds: tuple[float, ...] = (65.0, 96.0, 120.0)
    trains: tuple[str, ...] = ("mississauga", "yang_manos_base")
    limits: tuple[float, ...] = (3e6, 5e6, 10e6, 20e6)
    frictions: tuple[float, ...] = (1.0, 1.5, 2.0)
    tuned_speeds: tuple[float, ...] = (60.0, 90.0, 105.0)
    models: tuple[str, ...] = tuple(MODELS)
    shared: Mapping[str, Any] = field(default_factory=dict)


REPEATS = 3
"""Runs of a model in which nothing varies: its wall time is the least of them."""

CONSTANT_GROUND = {"ground.c_s": 1.0, "ground.c_d": 1.0, "ground.c_v_s_per_m": 0.0}
"""The ground law as Coulomb friction of 1.0."""

CHOICES: tuple[tuple[str, str, Mapping[str, Any], Mapping[str, float]], ...] = (
    ("as configured", "yang-manos", {}, {}),
    ("friction 1.5", "yang-manos", {}, {"friction": 1.5}),
    ("friction 2.0", "yang-manos", {}, {"friction": 2.0}),
    ("the thesis' dead band", "yang-manos", {}, {"widening": 0.0}),
    ("dead band wider by 0.8 rad", "yang-manos", {}, {"widening": 0.8}),
    ("brakes of 25 kN a car", "yang-manos", {"brakes.force_N": 25e3}, {}),
    ("no brakes", "yang-manos", {"brakes.force_N": 0.0}, {}),
    ("the main model", "toma", {}, {}),
    ("the main model, constant friction 1.0", "toma", CONSTANT_GROUND, {}),
    ("the main model, brakes of 25 kN a car", "toma", {"brakes.force_N": 25e3}, {}),
    ("the main model, no brakes", "toma", {"brakes.force_N": 0.0}, {}),
)
"""What the account of Yang and Manos's model leaves open: label, model, train, constants."""

TITLES = {
    "mississauga": "Mississauga 1979, all 74 cars modelled",
    "yang_manos_base": "Base case of Yang and Manos: 61 cars of 72.6 t, 65 km/h, friction 1.0",
}


def speed_case(v: float) -> str:
    """Name of the base train at a speed (km/h) as a case."""
    return f"base_{v:g}"


def reported(plan: Plan) -> list[SpeedClass]:
    """Classes of speed of the reported accidents that the page shows."""
    from derail_ros.studies.accidents import load_statistics

    return list(load_statistics().groups["all"][-plan.classes :])


def class_speed(one: SpeedClass) -> float:
    """Speed at which the base train stands for a class, km/h."""
    return round(one.speed_kmh, 1)


def jobs_of(plan: Plan, members: int) -> list[Job]:
    """All that the page needs, in the order in which it is run."""
    few = max(2, members // 4)

    def n(model: str, many: int) -> int:
        return many if model in VARIED else 1

    def base(case: str, label: str, model: str, v: float, many: int, **constants: float) -> Job:
        train = {"train.speed_kmh": v, **plan.shared}
        times = REPEATS if model not in VARIED and label == model else 1
        return Job(case, label, model, "base_train", train, constants, n(model, many), times)

    found = [base(speed_case(v), m, m, v, members) for v in plan.speeds for m in plan.models]
    found += [
        Job(
            name,
            m,
            m,
            name,
            dict(plan.shared),
            {},
            n(m, members),
            1 if m in VARIED else REPEATS,
        )
        for name in plan.trains
        for m in plan.models
    ]
    both = [m for m in ("toma", "yang-manos") if m in plan.models]
    found += [base(speed_case(v), m, m, v, members) for v in plan.fast for m in both]
    if len(both) == 2:
        speeds = [class_speed(one) for one in reported(plan)]
        found += [base(speed_case(v), m, m, v, members) for v in speeds for m in both]
        found += [
            Job(
                f"choice_{v:g}", label, model, "yang_manos_base",
                {"train.speed_kmh": v, **plan.shared, **settings}, constants, few,
            )
            for v in plan.choice_speeds
            for label, model, settings, constants in CHOICES
        ]  # fmt: skip
    if "anderson" in plan.models:
        for limit in plan.limits:
            label = f"{limit * 1e-6:g} MN"
            v = plan.scene_speed
            found.append(base("limit_base", label, "anderson", v, few, force_limit=limit))
            found += [
                Job(
                    f"limit_{name}", label, "anderson", name, dict(plan.shared),
                    {"force_limit": limit}, few,
                )
                for name in plan.trains[:1]
            ]  # fmt: skip
    if "roorda-gracie" in plan.models:
        found += [
            base(f"tuned_{v:g}", f"friction {mu:g}", "roorda-gracie", v, 1, friction=mu)
            for v in plan.tuned_speeds
            for mu in plan.frictions
        ]
    return found


Cases = dict[str, dict[str, Ensemble]]
"""Case -> label -> what came of it."""


def compute(
    jobs: Sequence[Job],
    seed: int = 0,
    *,
    at_a_time: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Cases:
    """Run all jobs; a run that fails is a record with an error."""
    from derail_ros.scenario import load_scenario

    trains = [
        load_scenario(job.scenario).with_overrides(job.overrides).to_params() for job in jobs
    ]

    def runs() -> Iterator[Run]:
        for k, job in enumerate(jobs):
            for member in range(job.members):
                yield Run(trains[k], member=member, seed=seed, key=k)

    def task(run: Run, stop: Callable[[], bool]) -> ModelRun:
        def look(_t: float, _derailed: int) -> None:
            if stop():
                raise Stopped

        job = jobs[run.key]
        params: TrainParams = vary(run.scenario, member_factor(seed, run.member))  # type: ignore[arg-type]
        done = run_model(job.model, params, constants=job.constants, progress=look)
        for _ in range(job.repeats - 1):
            again = run_model(job.model, params, constants=job.constants, progress=look)
            done.record["wall_s"] = min(done.record["wall_s"], again.record["wall_s"])
        return done if run.member == 0 else replace(done, scene=None)

    total = sum(job.members for job in jobs)
    results: list[dict[int, Result]] = [{} for _ in jobs]
    with closing(run_many(runs(), jobs=at_a_time, task=task)) as stream:
        for count, result in enumerate(stream, 1):
            results[result.run.key][result.run.member] = result
            if progress is not None:
                progress(count, total)
    cases: Cases = {}
    for job, found in zip(jobs, results, strict=True):
        ordered = [found[member] for member in sorted(found)]
        good = [r.value for r in ordered if r.error is None]
        records = tuple(
            r.value.record if r.error is None else failed_record(r.error, r.wall_s)
            for r in ordered
        )
        notes = tuple(run.notes for run in good)
        first = ordered[0].value if ordered[0].error is None else None
        ensemble = Ensemble(job, records, notes, first)
        cases.setdefault(job.case, {})[job.label] = ensemble
    return cases


# Published ------------------------------------------------------------------------------------


def published_run(scenario: str, speed: float | None = None) -> Record:
    """A published run as a record; empty if there is none."""
    from derail_ros.studies.validation import load_published

    name = scenario if speed is None else speed_case(speed)
    for case in load_published().cases:
        if case.name == name:
            return {
                key: case.published[own] * factor
                for key, (own, factor) in PUBLISHED.items()
                if case.published.get(own) is not None
            }
    return {}


def power_law(speeds: Sequence[float], counts: Sequence[float]) -> tuple[float, float]:
    """``a`` and ``b`` of ``count = a speed^b``, least squares of the logarithms."""
    b, a = np.polyfit(np.log(speeds), np.log(counts), 1)
    return math.exp(float(a)), float(b)


def series(plan: Plan) -> tuple[list[float], list[float]]:
    """Speeds (km/h) and counts of the published speed series, as far as the page shows it."""
    known = [(v, published_run("base_train", v).get("cars_derailed")) for v in plan.speeds]
    return [v for v, c in known if c is not None], [float(c) for _, c in known if c is not None]


# Tables ---------------------------------------------------------------------------------------


def as_printed(record: Mapping[str, Any], key: str, factor: float) -> str:
    """A published value with the digits that it has; ``-`` if there is none."""
    value = record.get(key)
    return "-" if value is None else f"{value * factor:.4g}"


def with_spread(ensemble: Ensemble, key: str, factor: float = 1.0, digits: int = 1) -> str:
    """Mean and standard deviation of a measure; the mean alone of a single run; ``-``: unknown."""
    if len(ensemble.records) == 1:
        return cell(ensemble.records[0], key, factor, digits)
    mean, sd = ensemble.mean.get(key), ensemble.sd.get(key)
    if mean is None:
        return "-"
    text = f"{mean * factor:.{digits}f}"
    return text if sd is None else f"{text} ± {sd * factor:.{digits}f}"


def measure(ensemble: Ensemble, key: str, factor: float, digits: int) -> str:
    """A measure in a table: wall times are the least, for whatever else runs lengthens them."""
    if key == "wall_s":
        return f"{min(r['wall_s'] for r in ensemble.records):.{digits}f}"
    return with_spread(ensemble, key, factor, digits)


def heading(title: str, key: str) -> str:
    """Heading of a measure's column."""
    return title.replace("wall time", "wall time, least") if key == "wall_s" else title


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    ruler = "|---|" + "---:|" * (len(heads) - 1)
    return [_row(heads), ruler, *map(_row, rows)]


def _name(model: str) -> str:
    return f"`{model}`"


def _left_out(ensembles: Sequence[Ensemble]) -> list[str]:
    """Runs that do not count, in a line each."""
    lines = []
    for e in ensembles:
        failed = [r["error"] for r in e.records if "error" in r]
        void = sum(bool(r.get("void")) for r in e.records if "error" not in r)
        where = e.job.words
        if failed:
            lines.append(f"- {where}: {len(failed)} of {len(e.records)} failed ({failed[0]}).")
        if void:
            lines.append(f"- {where}: {void} of {len(e.records)} void.")
        whole = sum(r.get("status") == "whole train derailed" for r in e.records)
        if whole:
            lines.append(f"- {where}: the whole train derails in {whole} of {len(e.records)}.")
    return ["", *lines] if lines else []


def speed_tables(cases: Cases, plan: Plan) -> str:
    """The base train at several speeds: one table for each measure."""
    heads = [f"{v:g} km/h" for v in plan.speeds]
    published = [published_run("base_train", v) for v in plan.speeds]
    lines: list[str] = []
    for title, key, factor, digits in MEASURES:
        if key in ("scene_length_m", "scene_width_m"):
            continue
        rows = [
            ["*published*", *(as_printed(p, key, factor) for p in published)],
        ]
        for m in plan.models:
            cells = [measure(cases[speed_case(v)][m], key, factor, digits) for v in plan.speeds]
            if any(c != "-" for c in cells):
                rows.append([_name(m), *cells])
        if key == "wall_s":
            rows = rows[1:]
        lines += [*_table([heading(title, key), *heads], rows), ""]
        if key == "peak_force_N":
            lines += [*_scenes(cases, plan, published, heads), ""]
    every = [e for v in plan.speeds for e in cases[speed_case(v)].values()]
    return "\n".join(lines[:-1] + _left_out(every))


def _scenes(
    cases: Cases, plan: Plan, published: Sequence[Record], heads: Sequence[str]
) -> list[str]:
    def box(record: Mapping[str, Any]) -> str:
        sides = (record.get("scene_length_m"), record.get("scene_width_m"))
        return "-" if None in sides else f"{sides[0]:.0f} x {sides[1]:.0f}"

    rows = [["*published*", *map(box, published)]]
    for m in plan.models:
        if m in PLANE:
            rows.append([_name(m), *(box(cases[speed_case(v)][m].mean) for v in plan.speeds)])
    return _table(["scene, length x width (m), means", *heads], rows)


def train_table(cases: Cases, plan: Plan, name: str) -> str:
    """All models on one train."""
    from derail_ros.studies.spread import ACCIDENTS

    rows = []
    for title, record in (
        ("*published*", published_run(name)),
        ("*the accident*", dict(ACCIDENTS.get(name, {}))),
    ):
        if record:
            rows.append([title, *(as_printed(record, key, f) for _, key, f, _ in MEASURES)])
    for m in plan.models:
        rows.append([_name(m), *(measure(cases[name][m], k, f, d) for _, k, f, d in MEASURES)])
    lines = _table(["model", *(heading(title, key) for title, key, *_ in MEASURES)], rows)
    return "\n".join(lines + _left_out(list(cases[name].values())))


def fast_table(cases: Cases, plan: Plan) -> str:
    """Yang and Manos's model and the main one over the speed."""
    heads = ["speed (km/h)", "published", "published, carried on", "`toma`", "`yang-manos`",
             "share of the train", "couplings parted", "zig-zag"]  # fmt: skip
    a, b = power_law(*series(plan))
    rows = []
    for v in sorted({*plan.speeds, *plan.fast}):
        case = cases[speed_case(v)]
        ours, theirs = case["toma"], case["yang-manos"]
        size = len(theirs.first.scene.numbers) if theirs.first and theirs.first.scene else 0
        mean = theirs.mean.get("cars_derailed")
        share = "-" if mean is None or not size else f"{100.0 * mean / size:.0f} %"
        rows.append(
            [
                f"{v:g}",
                as_printed(published_run("base_train", v), "cars_derailed", 1.0),
                f"{a * v**b:.1f}",
                with_spread(ours, "cars_derailed"),
                with_spread(theirs, "cars_derailed"),
                share,
                f"{max(int(n['couplings_parted']) for n in theirs.notes)}",
                f"{min(float(n['zigzag']) for n in theirs.notes):g}",
            ]
        )
    return "\n".join(
        [
            *_table(heads, rows),
            "",
            f"Carried on: `{a:.3g} v^{b:.2f}`, the power law through the published counts. "
            "Couplings parted: the most in any run. Zig-zag: the least share, in any run, of "
            "neighbouring derailed cars that are turned to opposite sides.",
        ]
    )


def accident_table(cases: Cases, plan: Plan) -> str:
    """Yang and Manos's model and the main one beside reported accidents."""
    from derail_ros.studies.accidents import GROUPS, load_statistics

    heads = ["speed, mean (km/h)", "reports", "reported, all causes", "`yang-manos`",
             "of the reported", "`toma`", GROUPS["broken_rail_long"].words]  # fmt: skip
    statistics = load_statistics()
    long = {c.low_kmh: c for c in statistics.groups["broken_rail_long"]}
    rows = []
    for one in reported(plan):
        case = cases[speed_case(class_speed(one))]
        mean = case["yang-manos"].mean.get("cars_derailed")
        other = long.get(one.low_kmh)
        rows.append(
            [
                f"{class_speed(one):g}",
                f"{one.reports}",
                f"{one.mean:.1f} ± {one.error:.1f}",
                with_spread(case["yang-manos"], "cars_derailed"),
                "-" if mean is None else f"{100.0 * mean / one.mean:.0f} %",
                with_spread(case["toma"], "cars_derailed"),
                "-" if other is None
                else f"{other.mean:.1f} ± {other.error:.1f} ({other.reports})",
            ]
        )  # fmt: skip
    first, last = statistics.years
    return "\n".join(
        [
            *_table(heads, rows),
            "",
            f"Reported: {statistics.source}, {first} to {last}, freight trains derailed on main "
            "track; mean ± standard error of the freight cars derailed (number of reports, where "
            "it is another one).",
        ]
    )


def choice_table(cases: Cases, plan: Plan) -> str:
    """Yang and Manos's base case, other choices where the account leaves one."""
    rows = [
        [label, *(with_spread(cases[f"choice_{v:g}"][label], "cars_derailed")
                  for v in plan.choice_speeds)]
        for label, *_ in CHOICES
    ]  # fmt: skip
    every = [e for v in plan.choice_speeds for e in cases[f"choice_{v:g}"].values()]
    heads = ["cars derailed of 61", *(f"{v:g} km/h" for v in plan.choice_speeds)]
    return "\n".join(_table(heads, rows) + _left_out(every))


def limit_table(cases: Cases, plan: Plan) -> str:
    """Anderson's model over the force at which a spring is removed."""
    found = [("limit_base", f"base train, {plan.scene_speed:g} km/h")]
    found += [(f"limit_{name}", name.capitalize()) for name in plan.trains[:1]]
    rows = []
    for case, title in found:
        rows.append(
            [f"{title}: cars derailed",
             *(with_spread(e, "cars_derailed") for e in cases[case].values())]
        )  # fmt: skip
        removed = [
            f"{np.mean([n['couplings_parted'] for n in e.notes]):.1f}" if e.notes else "-"
            for e in cases[case].values()
        ]
        rows.append([f"{title}: springs removed, mean", *removed])
    every = [e for case, _ in found for e in cases[case].values()]
    heads = ["limiting force", *cases["limit_base"]]
    return "\n".join(_table(heads, rows) + _left_out(every))


def friction_table(cases: Cases, plan: Plan) -> str:
    """Roorda and Gracie's model over its friction."""
    rows = []
    for mu in plan.frictions:
        label = f"friction {mu:g}"
        runs = [cases[f"tuned_{v:g}"][label] for v in plan.tuned_speeds]
        rows.append([label, *(with_spread(run, "cars_derailed") for run in runs)])
    every = [e for v in plan.tuned_speeds for e in cases[f"tuned_{v:g}"].values()]
    heads = ["cars derailed", *(f"{v:g} km/h" for v in plan.tuned_speeds)]
    return "\n".join(_table(heads, rows) + _left_out(every))


def joints_table() -> str:
    """Johnson's equal bars, and a train, after a blow."""
    from derail_ros.baselines.joints import joint_velocities
    from derail_ros.baselines.train import take_apart
    from derail_ros.scenario import load_scenario

    equal = joint_velocities(np.full(6, 75e3), np.full(6, 15.0))
    cars = take_apart(load_scenario("mississauga").to_params().cars)
    train = joint_velocities(
        np.array([c.mass for c in cars]),
        np.array([2.0 * c.pivot_distance + c.front.length + c.rear.length for c in cars]),
        inertia=np.array([c.inertia for c in cars]),
    )
    heads = ["velocity of a joint, relative to the head", *(str(i + 1) for i in range(6))]
    rows = [
        ["six equal bars, 450 t", *(f"{v:.3f}" for v in equal.relative[:6])],
        ["Mississauga", *(f"{v:.3f}" for v in train.relative[:6])],
    ]
    return "\n".join(_table(heads, rows))


def many_trains(n: int = 10_000) -> str:
    """Many trains through the blockage model at once, timed."""
    from derail_ros.baselines.blockage import blockage

    rng = np.random.default_rng(0)
    speed, cars = rng.uniform(10.0 / 3.6, 120.0 / 3.6, n), rng.integers(10, 151, n)
    began = time.perf_counter()
    answer = blockage(speed, cars)
    taken = time.perf_counter() - began
    return (
        f"{n} trains of 10 to 150 cars at 10 to 120 km/h through the blockage model at once: "
        f"{taken:.1f} s; {float(np.mean(answer.cars_derailed)):.1f} cars derailed in the mean."
    )


def blocks(cases: Cases, plan: Plan, about: str) -> dict[str, str]:
    """All results of the page by their names."""
    found = {"base_train": speed_tables(cases, plan)}
    found |= {name: train_table(cases, plan, name) for name in plan.trains}
    found["yang_manos_speed"] = fast_table(cases, plan)
    found["yang_manos_accidents"] = accident_table(cases, plan)
    found["yang_manos_choices"] = choice_table(cases, plan)
    found["anderson_limit"] = limit_table(cases, plan)
    found["roorda_gracie_friction"] = friction_table(cases, plan)
    found["joints"] = joints_table()
    found["many_trains"] = many_trains()
    found["about"] = about
    return found


def missing_markers(page: str, names: Sequence[str]) -> list[str]:
    """Results for which a page has no place."""
    return [
        name
        for name in names
        if not re.search(re.escape(BEGIN.format(name)) + r".*?" + re.escape(END), page, re.DOTALL)
    ]


NAMES = (
    "base_train", "mississauga", "yang_manos_base", "yang_manos_speed", "yang_manos_accidents",
    "yang_manos_choices", "anderson_limit", "roorda_gracie_friction", "joints", "many_trains",
    "about",
)  # fmt: skip
"""Results of the page."""


def fill(page: str, found: Mapping[str, str]) -> str:
    """A page with the results between its markers made anew.

    Raises
    ------
    ValueError
        The page has no place for one of them.
    """
    if missing := missing_markers(page, list(found)):
        raise ValueError(f"has no place for the results {', '.join(missing)}")
    for name, text in found.items():
        begin = BEGIN.format(name)
        before, _, rest = page.partition(begin)
        _, _, after = rest.partition(END)
        page = f"{before}{begin}\n\n{text}\n\n{END}{after}"
    return page


def bare(images: Mapping[str, str]) -> str:
    """A page with nothing but places for the results, and the figures."""
    lines = ["# Earlier models beside the main one", ""]
    for name in NAMES:
        lines += [f"## {name.replace('_', ' ')}", "", BEGIN.format(name), END, ""]
    lines += [f"![{title}]({place})\n" for title, place in images.items()]
    return "\n".join(lines)


# Figures --------------------------------------------------------------------------------------


def figures(cases: Cases, plan: Plan) -> dict[str, Figure]:
    """The page's figures by the names of their files."""
    speeds, counts = series(plan)
    published = list(zip(speeds, counts, strict=True))
    by_speed = [[cases[speed_case(v)][m].mean_entry() for m in plan.models] for v in plan.speeds]
    drawn = {
        "models_speed.png": by_speed_figure(
            "Base train: cars derailed over the speed, means", plan.speeds, by_speed, published
        )
    }
    scenes = {speed_case(plan.scene_speed): f"Base train, 60 cars at {plan.scene_speed:g} km/h"}
    scenes |= {name: TITLES.get(name, name) for name in plan.trains}
    for name, title in scenes.items():
        case = cases[name]
        means = {m: e.mean["cars_derailed"] for m, e in case.items()
                 if m in plan.models and e.mean.get("cars_derailed") is not None}  # fmt: skip
        known = published_run(name).get("cars_derailed")
        entries = [case[m].entry() for m in plan.models]
        drawn[f"models_{name}.png"] = figure(title, entries, means, known)
    a, b = power_law(speeds, counts)
    known = [class_speed(one) for one in reported(plan)]
    all_speeds = sorted({*plan.speeds, *plan.fast, *known})
    law = [(v, a * v**b) for v in np.linspace(all_speeds[0], all_speeds[-1], 60)]
    told = [(one.speed_kmh, one.mean, 2.0 * one.error) for one in reported(plan)]
    both = [
        [cases[speed_case(v)][m].mean_entry() for m in ("toma", "yang-manos")] for v in all_speeds
    ]
    drawn["models_yang_manos_speed.png"] = by_speed_figure(
        "Yang and Manos beside the main model: base train, 60 cars", all_speeds, both, published,
        [("published, carried on", law)], ("reported accidents, all causes", told),
    )  # fmt: skip
    return drawn
