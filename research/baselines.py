"""The results of ``docs/baselines.md``: ensembles of all models, as tables and figures.

The page's paragraphs are written by hand; what is between its marks is made anew. Models whose
outcome depends on the push that starts the motion are run as ensembles (the push varied by a few
percent), the others once.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from derail_ros.baselines.anderson import warm_up
from derail_ros.baselines.comparison import KEYS, WALL, Entry, cell, heading
from derail_ros.baselines.figures import by_speed_figure, figure
from derail_ros.baselines.models import MODELS, WHOLE_TRAIN, ModelRun, run_job
from derail_ros.commands.common import counting_runs
from derail_ros.studies.accidents import GROUPS, load_statistics
from derail_ros.studies.ensemble import Job, Progress, default_jobs, gather
from derail_ros.studies.published import load_published
from derail_ros.studies.records import Ensemble
from derail_ros.studies.tables import Table
from derail_ros.vocabulary.measures import MEASURES, Record, failed_record
from research.pages import BEGIN, END, Options, document, fill, picture, with_places

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from derail_ros.studies.accidents import SpeedClass

VARIED = tuple(name for name, model in MODELS.items() if model.varied)
PLANE = tuple(name for name, model in MODELS.items() if model.plane)


@dataclass(frozen=True)
class Trial:
    """One model on one train: an ensemble, or a single run where nothing varies."""

    case: str  # part of the page it belongs to
    label: str  # name within the case
    model: str  # of ``MODELS``
    scenario: str
    overrides: Mapping[str, Any] = field(default_factory=dict)
    constants: Mapping[str, float] = field(default_factory=dict)  # of the model itself
    members: int = 1
    repeats: int = 1  # of each run, for the least wall time

    @property
    def words(self) -> str:
        """What is run, in words."""
        text = self.scenario
        if "train.speed_kmh" in self.overrides:
            text += f" at {self.overrides['train.speed_kmh']:g} km/h"
        text += f", `{self.model}`"
        return text if self.label == self.model else f"{text} ({self.label})"


@dataclass(frozen=True)
class TrialResult:
    """What came of a trial."""

    trial: Trial
    ensemble: Ensemble
    notes: tuple[Mapping[str, Any], ...] = ()  # further results, one a member that did not fail
    first: ModelRun | None = None  # the run of the scenario itself; None if it failed

    @cached_property
    def mean(self) -> Record:
        """Means over the members that count."""
        return self.ensemble.mean()

    @cached_property
    def sd(self) -> Record:
        """Standard deviations of single runs (n - 1)."""
        return self.ensemble.sd()

    @property
    def wall(self) -> float:
        """The least wall time: whatever else runs on the machine lengthens the others, s."""
        return min(r["wall_s"] for r in self.ensemble.records)

    def entry(self) -> Entry:
        """The run of the scenario itself, as an entry of a comparison."""
        error = next(iter(self.ensemble.errors), None) if self.first is None else None
        return Entry(self.trial.model, self.first, error)

    def mean_entry(self) -> Entry:
        """The means, as an entry of a comparison."""
        run = ModelRun(self.trial.model, self.mean) if self.mean else None
        return Entry(self.trial.model, run, None if run else "no run")


@dataclass(frozen=True)
class Scope:
    """What the page shows; a smaller one is for tests."""

    # of the base train, all models, km/h
    speeds: tuple[float, ...] = (30.0, 48.0, 60.0, 72.0, 90.0)
    scene_speed: float = 90.0  # the one whose final scenes are drawn, km/h
    # further speeds of the main model and Yang and Manos's, km/h
    fast: tuple[float, ...] = (96.0, 105.0, 112.0, 120.0, 130.0, 145.0)
    classes: int = 7  # of speed of the reported accidents that are shown, from the fastest down
    # of Yang and Manos's base case with other choices, km/h
    choice_speeds: tuple[float, ...] = (65.0, 96.0, 120.0)
    trains: tuple[str, ...] = ("mississauga", "yang_manos_base")  # scenarios shown with all models
    # forces at which Anderson's springs are removed, N
    limits: tuple[float, ...] = (3e6, 5e6, 10e6, 20e6)
    frictions: tuple[float, ...] = (1.0, 1.5, 2.0)  # of Roorda and Gracie
    tuned_speeds: tuple[float, ...] = (60.0, 90.0, 105.0)  # of the base train with them, km/h
    models: tuple[str, ...] = tuple(MODELS)
    shared: Mapping[str, Any] = field(default_factory=dict)  # changes to every train


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
    ("the main model", "planar", {}, {}),
    ("the main model, constant friction 1.0", "planar", CONSTANT_GROUND, {}),
    ("the main model, brakes of 25 kN a car", "planar", {"brakes.force_N": 25e3}, {}),
    ("the main model, no brakes", "planar", {"brakes.force_N": 0.0}, {}),
)
"""What the account of Yang and Manos's model leaves open: label, model, train, constants."""

TITLES = {
    "mississauga": "Mississauga 1979, all 74 cars modelled",
    "yang_manos_base": "Base case of Yang and Manos: 61 cars of 72.6 t, 65 km/h, friction 1.0",
}


def write(options: Options) -> None:
    """Run all trials, fill the page and write its figures."""
    scope, members = Scope(), options.members or 20
    options.images()
    text = with_places(options.page, NAMES) if options.page.exists() else None
    with counting_runs("baselines") as progress:
        warm_up()
        results = compute(trials_of(scope, members), options.seed, jobs=options.jobs,
                          progress=progress)  # fmt: skip
    write_results(options, text, results, scope)


def write_results(options: Options, text: str | None, results: Cases, scope: Scope) -> None:
    """Fill the page and write its figures; a page that does not exist becomes a bare one."""
    from derail_ros.models import engine_hash

    drawn = figures(results, scope)
    members, jobs = options.members or 20, options.jobs or default_jobs()
    at = "one run at a time" if jobs == 1 else f"{jobs} runs at a time"
    about = (
        f"<sub>`python -m research baselines -n {members}`: {members} runs each for the models "
        "whose outcome depends on the push that starts the motion (it is varied by up to 4 %, "
        f"seed {options.seed}), {max(2, members // 4)} each for other choices of constants, one "
        "for the others; mean ± standard deviation of single runs. Scenes drawn are those of the "
        f"scenario itself. Wall times: the least of these runs or of {REPEATS}, {at}, kernels "
        f"compiled before. Engine {engine_hash()[:16]}.</sub>"
    )
    options.write(fill(text or bare(drawn), blocks(results, scope, about)), drawn, dpi=80)


def speed_case(v: float) -> str:
    """Name of the base train at a speed (km/h) as a case."""
    return f"base_{v:g}"


def reported(scope: Scope) -> list[SpeedClass]:
    """Classes of speed of the reported accidents that the page shows."""
    return list(load_statistics().groups["all"][-scope.classes :])


def class_speed(one: SpeedClass) -> float:
    """Speed at which the base train stands for a class, km/h."""
    return round(one.speed_kmh, 1)


def trials_of(scope: Scope, members: int) -> list[Trial]:
    """All that the page needs, in the order in which it is run."""
    few = max(2, members // 4)

    def n(model: str, many: int) -> int:
        return many if model in VARIED else 1

    def base(case: str, label: str, model: str, v: float, many: int, **constants: float) -> Trial:
        train = {"train.speed_kmh": v, **scope.shared}
        times = REPEATS if model not in VARIED and label == model else 1
        return Trial(case, label, model, "base_train", train, constants, n(model, many), times)

    found = [base(speed_case(v), m, m, v, members) for v in scope.speeds for m in scope.models]
    found += [
        Trial(
            name, m, m, name, dict(scope.shared), {}, n(m, members), 1 if m in VARIED else REPEATS
        )
        for name in scope.trains
        for m in scope.models
    ]
    both = [m for m in ("planar", "yang-manos") if m in scope.models]
    found += [base(speed_case(v), m, m, v, members) for v in scope.fast for m in both]
    if len(both) == 2:
        speeds = [class_speed(one) for one in reported(scope)]
        found += [base(speed_case(v), m, m, v, members) for v in speeds for m in both]
        for v in scope.choice_speeds:
            for label, model, settings, constants in CHOICES:
                train = {"train.speed_kmh": v, **scope.shared, **settings}
                case = f"choice_{v:g}"
                found.append(Trial(case, label, model, "yang_manos_base", train, constants, few))
    if "anderson" in scope.models:
        for limit in scope.limits:
            label, own = f"{limit * 1e-6:g} MN", {"force_limit": limit}
            found.append(base("limit_base", label, "anderson", scope.scene_speed, few, **own))
            found += [
                Trial(f"limit_{name}", label, "anderson", name, dict(scope.shared), own, few)
                for name in scope.trains[:1]
            ]
    if "roorda-gracie" in scope.models:
        found += [
            base(f"tuned_{v:g}", f"friction {mu:g}", "roorda-gracie", v, 1, friction=mu)
            for v in scope.tuned_speeds
            for mu in scope.frictions
        ]
    return found


Cases = dict[str, dict[str, TrialResult]]
"""Case -> label -> what came of it."""


def compute(
    trials: Sequence[Trial],
    seed: int = 0,
    *,
    jobs: int | None = None,
    progress: Progress | None = None,
) -> Cases:
    """Run all trials; a run that fails is a record with an error."""
    from derail_ros.scenario import load_scenario

    trains = [load_scenario(t.scenario).with_overrides(t.overrides).to_params() for t in trials]

    def runs() -> Iterator[Job]:
        for k, trial in enumerate(trials):
            for member in range(trial.members):
                yield Job(trains[k], member=member, seed=seed, key=k)

    def task(job: Job, stop: Callable[[], bool]) -> ModelRun:
        trial = trials[job.key]
        done = run_job(trial.model, job, stop, trial.constants)
        for _ in range(trial.repeats - 1):
            again = run_job(trial.model, job, stop, trial.constants)
            done.record["wall_s"] = min(done.record["wall_s"], again.record["wall_s"])
        return done if job.member == 0 else replace(done, scene=None)

    found = gather(runs(), jobs=jobs, task=task, progress=progress)
    cases: Cases = {}
    for k, trial in enumerate(trials):
        good = [r.value for r in found[k] if r.error is None]
        records = tuple(
            r.value.record if r.error is None else failed_record(r.error, r.wall_s)
            for r in found[k]
        )
        first = found[k][0].value
        notes = tuple(run.notes for run in good)
        result = TrialResult(trial, Ensemble(records), notes, first)
        cases.setdefault(trial.case, {})[trial.label] = result
    return cases


# Published ------------------------------------------------------------------------------------


def published_run(scenario: str, speed: float | None = None) -> Record:
    """A published run as a record; empty if there is none."""
    name = scenario if speed is None else speed_case(speed)
    for case in load_published().cases:
        if case.name == name:
            return {key: case.published[key] for key in KEYS if case.published.get(key)}
    return {}


def power_law(speeds: Sequence[float], counts: Sequence[float]) -> tuple[float, float]:
    """``a`` and ``b`` of ``count = a speed^b``, least squares of the logarithms."""
    b, a = np.polyfit(np.log(speeds), np.log(counts), 1)
    return math.exp(float(a)), float(b)


def series(scope: Scope) -> tuple[list[float], list[float]]:
    """Speeds (km/h) and counts of the published speed series, as far as the page shows it."""
    known = {v: published_run("base_train", v).get("cars_derailed") for v in scope.speeds}
    return [v for v, c in known.items() if c], [float(c) for c in known.values() if c]


# Tables ---------------------------------------------------------------------------------------


def as_printed(record: Mapping[str, Any], key: str) -> str:
    """A published value with the digits that it has; ``-`` if there is none."""
    value = record.get(key)
    return "-" if value is None else f"{value * MEASURES[key].scale:.4g}"


def with_spread(result: TrialResult, key: str = "cars_derailed") -> str:
    """Mean and standard deviation of a measure; the mean alone of a single run; ``-``: unknown."""
    if len(result.ensemble) == 1:
        return cell(result.ensemble.records[0], key)
    mean, sd = result.mean.get(key), result.sd.get(key)
    if mean is None:
        return "-"
    shown = MEASURES[key].shown_mean
    text = shown(mean)
    return text if sd is None else f"{text} ± {shown(sd)}"


def measure(result: TrialResult, key: str) -> str:
    """A measure in a table."""
    return f"{result.wall:.3f}" if key == WALL else with_spread(result, key)


def column(key: str) -> str:
    """Heading of a measure's column."""
    return heading(key).replace("wall time", "wall time, least")


def _left_out(results: Iterable[TrialResult]) -> str:
    """Runs that do not count, in a line each."""
    lines = []
    for r in results:
        e, n = r.ensemble, len(r.ensemble)
        if e.failed:
            lines.append(f"- {r.trial.words}: {e.failed} of {n} failed ({e.errors[0]}).")
        if e.void:
            lines.append(f"- {r.trial.words}: {e.void} of {n} void.")
        whole = sum(record.get("status") == WHOLE_TRAIN for record in e.records)
        if whole:
            lines.append(f"- {r.trial.words}: the whole train derails in {whole} of {n}.")
    return "\n".join(["\n", *lines]) if lines else ""


def speed_tables(cases: Cases, scope: Scope) -> str:
    """The base train at several speeds: one table for each measure."""
    heads = [f"{v:g} km/h" for v in scope.speeds]
    published = [published_run("base_train", v) for v in scope.speeds]
    at = [cases[speed_case(v)] for v in scope.speeds]
    tables = []
    for key in KEYS:
        if key in ("scene_length_m", "scene_width_m"):
            continue
        rows = []
        if key != WALL:
            rows.append(["*published*", *(as_printed(p, key) for p in published)])
        for m in scope.models:
            cells = [measure(case[m], key) for case in at]
            if any(c != "-" for c in cells):
                rows.append([f"`{m}`", *cells])
        tables.append(Table([column(key), *heads], rows).markdown())
        if key == "peak_force_N":
            boxes = [["*published*", *map(_box, published)]]
            boxes += [
                [f"`{m}`", *(_box(case[m].mean) for case in at)]
                for m in scope.models
                if m in PLANE
            ]
            title = "scene, length x width (m), means"
            tables.append(Table([title, *heads], boxes).markdown())
    return "\n\n".join(tables) + _left_out(r for case in at for r in case.values())


def _box(record: Mapping[str, Any]) -> str:
    sides = (record.get("scene_length_m"), record.get("scene_width_m"))
    return "-" if None in sides else f"{sides[0]:.0f} x {sides[1]:.0f}"


def train_table(cases: Cases, scope: Scope, name: str) -> str:
    """All models on one train."""
    accident = dict(load_published().accident(name))
    beside = {"*published*": published_run(name), "*the accident*": accident}
    rows = [
        [title, *(as_printed(record, key) if key != WALL else "-" for key in KEYS)]
        for title, record in beside.items()
        if record
    ]
    rows += [[f"`{m}`", *(measure(cases[name][m], k) for k in KEYS)] for m in scope.models]
    table = Table(["model", *map(column, KEYS)], rows)
    return table.markdown() + _left_out(cases[name].values())


def fast_table(cases: Cases, scope: Scope) -> str:
    """Yang and Manos's model and the main one over the speed."""
    heads = ["speed (km/h)", "published", "published, carried on", "`planar`", "`yang-manos`",
             "share of the train", "couplings parted", "zig-zag"]  # fmt: skip
    a, b = power_law(*series(scope))
    rows = []
    for v in sorted({*scope.speeds, *scope.fast}):
        ours, theirs = (cases[speed_case(v)][m] for m in ("planar", "yang-manos"))
        size = len(theirs.first.scene.numbers) if theirs.first and theirs.first.scene else 0
        mean = theirs.mean.get("cars_derailed")
        rows.append(
            [
                f"{v:g}",
                as_printed(published_run("base_train", v), "cars_derailed"),
                f"{a * v**b:.1f}",
                with_spread(ours),
                with_spread(theirs),
                "-" if mean is None or not size else f"{100.0 * mean / size:.0f} %",
                f"{max(int(n['couplings_parted']) for n in theirs.notes)}",
                f"{min(float(n['zigzag']) for n in theirs.notes):g}",
            ]
        )
    return (
        f"{Table(heads, rows).markdown()}\n\nCarried on: `{a:.3g} v^{b:.2f}`, the power law "
        "through the published counts. Couplings parted: the most in any run. Zig-zag: the least "
        "share, in any run, of neighbouring derailed cars that are turned to opposite sides."
    )


def accident_table(cases: Cases, scope: Scope) -> str:
    """Yang and Manos's model and the main one beside reported accidents."""
    heads = ["speed, mean (km/h)", "reports", "reported, all causes", "`yang-manos`",
             "of the reported", "`planar`", GROUPS["broken_rail_long"].words]  # fmt: skip
    statistics = load_statistics()
    long = {c.low_kmh: c for c in statistics.groups["broken_rail_long"]}
    rows = []
    for one in reported(scope):
        ours, theirs = (cases[speed_case(class_speed(one))][m] for m in ("planar", "yang-manos"))
        mean, other = theirs.mean.get("cars_derailed"), long.get(one.low_kmh)
        rows.append(
            [
                f"{class_speed(one):g}",
                f"{one.reports}",
                f"{one.mean:.1f} ± {one.error:.1f}",
                with_spread(theirs),
                "-" if mean is None else f"{100.0 * mean / one.mean:.0f} %",
                with_spread(ours),
                "-"
                if other is None
                else f"{other.mean:.1f} ± {other.error:.1f} ({other.reports})",
            ]
        )
    first, last = statistics.years
    return (
        f"{Table(heads, rows).markdown()}\n\nReported: {statistics.source}, {first} to {last}, "
        "freight trains derailed on main track; mean ± standard error of the freight cars "
        "derailed (number of reports, where it is another one)."
    )


def _over_speeds(
    cases: Cases, head: str, prefix: str, speeds: Sequence[float], labels: Iterable[str]
) -> str:
    """Cars derailed with each label at each speed."""
    at = [cases[f"{prefix}_{v:g}"] for v in speeds]
    rows = [[label, *(with_spread(case[label]) for case in at)] for label in labels]
    table = Table([head, *(f"{v:g} km/h" for v in speeds)], rows)
    return table.markdown() + _left_out(r for case in at for r in case.values())


def limit_table(cases: Cases, scope: Scope) -> str:
    """Anderson's model over the force at which a spring is removed."""
    found = {"limit_base": f"base train, {scope.scene_speed:g} km/h"}
    found |= {f"limit_{name}": name.capitalize() for name in scope.trains[:1]}
    rows = []
    for case, title in found.items():
        results = cases[case].values()
        rows.append([f"{title}: cars derailed", *map(with_spread, results)])
        removed = [
            f"{np.mean([n['couplings_parted'] for n in r.notes]):.1f}" if r.notes else "-"
            for r in results
        ]
        rows.append([f"{title}: springs removed, mean", *removed])
    table = Table(["limiting force", *cases["limit_base"]], rows)
    return table.markdown() + _left_out(r for case in found for r in cases[case].values())


def joints_table() -> Table:
    """Johnson's equal bars, and a train, after a blow."""
    from derail_ros.baselines.joints import joint_velocities, train_bars
    from derail_ros.scenario import load_scenario

    equal = joint_velocities(np.full(6, 75e3), np.full(6, 15.0))
    mass, length, inertia = train_bars(load_scenario("mississauga").to_params())
    train = joint_velocities(mass, length, inertia=inertia)
    heads = ["velocity of a joint, relative to the head", *(str(i + 1) for i in range(6))]
    found = {"six equal bars, 450 t": equal, "Mississauga": train}
    rows = [[name, *(f"{v:.3f}" for v in j.relative[:6])] for name, j in found.items()]
    return Table(heads, rows)


def gracie_table() -> Table:
    """Growth of an error in Gracie's model of 1991, over the increment of time."""
    from research.gracie import advance, growth, least_increment

    row, spring = np.full(10, 68e3), 3.15e6
    force = np.zeros(10)
    force[0] = 1e4
    rows = []
    for increment in (0.01, 0.05, 0.1, 0.5, 1.05 * least_increment(row, spring)):
        x = advance(row, spring, force, increment, 20)
        moved = [f"{np.abs(x[k]).max():.2g}" for k in (5, 10, 20)]
        rows.append([f"{increment:.2f}", f"{growth(row, spring, increment):.3g}", *moved])
    heads = ["increment (s)", "growth each", "m after 5", "after 10", "after 20 increments"]
    return Table(heads, rows)


def many_trains() -> str:
    """Many trains through the blockage model at once, timed."""
    from derail_ros.baselines.blockage import blockage

    n = 10_000
    rng = np.random.default_rng(0)
    speed, cars = rng.uniform(10.0 / 3.6, 120.0 / 3.6, n), rng.integers(10, 151, n)
    began = time.perf_counter()
    answer = blockage(speed, cars)
    taken = time.perf_counter() - began
    return (
        f"{n} trains of 10 to 150 cars at 10 to 120 km/h through the blockage model at once: "
        f"{taken:.1f} s; {float(np.mean(answer.cars_derailed)):.1f} cars derailed in the mean."
    )


def blocks(cases: Cases, scope: Scope, about: str) -> dict[str, Any]:
    """All results of the page by their names."""
    frictions = [f"friction {mu:g}" for mu in scope.frictions]
    labels = [label for label, *_ in CHOICES]
    return {
        "base_train": speed_tables(cases, scope),
        **{name: train_table(cases, scope, name) for name in scope.trains},
        "yang_manos_speed": fast_table(cases, scope),
        "yang_manos_accidents": accident_table(cases, scope),
        "yang_manos_choices": _over_speeds(
            cases, "cars derailed of 61", "choice", scope.choice_speeds, labels
        ),
        "anderson_limit": limit_table(cases, scope),
        "roorda_gracie_friction": _over_speeds(
            cases, "cars derailed", "tuned", scope.tuned_speeds, frictions
        ),
        "joints": joints_table(),
        "gracie": gracie_table(),
        "many_trains": many_trains(),
        "about": about,
    }


NAMES = (
    "base_train", "mississauga", "yang_manos_base", "yang_manos_speed", "yang_manos_accidents",
    "yang_manos_choices", "anderson_limit", "roorda_gracie_friction", "joints", "gracie",
    "many_trains", "about",
)  # fmt: skip
"""Results of the page."""


def bare(images: Iterable[str]) -> str:
    """A page with nothing but places for the results, and the figures."""
    parts = ["# Earlier models beside the main one"]
    for name in NAMES:
        parts += [f"## {name.replace('_', ' ')}", f"{BEGIN.format(name)} {END}"]
    return document(*parts, *(picture(name, name) for name in images))


# Figures --------------------------------------------------------------------------------------


def figures(cases: Cases, scope: Scope) -> dict[str, Figure]:
    """The page's figures by the names of their files."""
    speeds, counts = series(scope)
    published = list(zip(speeds, counts, strict=True))

    def means(models: Sequence[str], at: Sequence[float]) -> list[list[Entry]]:
        return [[cases[speed_case(v)][m].mean_entry() for m in models] for v in at]

    drawn = {
        "models_speed.png": by_speed_figure(
            "Base train: cars derailed over the speed, means",
            scope.speeds,
            means(scope.models, scope.speeds),
            published,
        )
    }
    scenes = {speed_case(scope.scene_speed): f"Base train, 60 cars at {scope.scene_speed:g} km/h"}
    scenes |= {name: TITLES.get(name, name) for name in scope.trains}
    for name, title in scenes.items():
        case = {m: cases[name][m] for m in scope.models}
        mean = {m: r.mean["cars_derailed"] for m, r in case.items() if "cars_derailed" in r.mean}
        known = published_run(name).get("cars_derailed")
        entries = [r.entry() for r in case.values()]
        drawn[f"models_{name}.png"] = figure(title, entries, mean, known)
    a, b = power_law(speeds, counts)
    all_speeds = sorted({*scope.speeds, *scope.fast, *map(class_speed, reported(scope))})
    law = [(v, a * v**b) for v in np.linspace(all_speeds[0], all_speeds[-1], 60)]
    told = [(one.speed_kmh, one.mean, 2.0 * one.error) for one in reported(scope)]
    drawn["models_yang_manos_speed.png"] = by_speed_figure(
        "Yang and Manos beside the main model: base train, 60 cars",
        all_speeds,
        means(("planar", "yang-manos"), all_speeds),
        published,
        [("published, carried on", law)],
        ("reported accidents, all causes", told),
    )
    return drawn
