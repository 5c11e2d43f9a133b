"""``derail simulate --model``, ``derail compare-models`` and ``derail joint-velocities``."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from derail_ros.commands import common
from derail_ros.commands.common import FAILED, OK, CommandFailure, note
from derail_ros.vocabulary.words import count

if TYPE_CHECKING:
    from derail_ros.baselines.models import ModelRun
    from derail_ros.scenario import Scenario
    from derail_ros.vocabulary.measures import Record


def _check_model(name: str) -> None:
    from derail_ros.baselines.models import MODELS

    if name not in MODELS:
        raise CommandFailure(f"--model: there is no {name!r}; there are {', '.join(MODELS)}")


def _needs_kernels(name: str) -> bool:
    return name in ("toma", "yang-manos", "anderson")


def run(
    model: str,
    name_or_file: str,
    settings: Sequence[str],
    ensemble: int | None,
    seed: int,
    jobs: int | None,
    roll: bool,
    as_json: bool,
    output: Path | None,
) -> int:
    """Run a scenario with one of the models; the exit code."""
    from derail_ros.baselines.models import VARIED, ModelError, run_model
    from derail_ros.studies.ensemble import Run, Stopped, run_many
    from derail_ros.studies.records import Moments
    from derail_ros.vocabulary.errors import ParameterError, SimulationError
    from derail_ros.vocabulary.measures import failed_record

    _check_model(model)
    if roll and model not in ("toma", "anderson"):
        raise CommandFailure(f"--roll: {model} parts no coupling; no car of it comes free")
    scenario = common.load(name_or_file, settings)
    params = scenario.to_params()
    members = 1 if ensemble is None else ensemble
    if members > 1 and model not in VARIED:
        raise CommandFailure(f"--ensemble: {model} knows no lateral force to vary")
    if output is not None:
        output = common.output_directory(output)
    if _needs_kernels(model):
        common.warm_up()
    outcomes: list[Record] = []
    first: ModelRun | None = None
    from rich.progress import SpinnerColumn, TextColumn, TimeElapsedColumn

    columns: list[Any] = [
        SpinnerColumn(),
        TextColumn("{task.description} {task.fields[state]}"),
        TimeElapsedColumn(),
    ]
    with common.progress(*columns) as bars:
        task = bars.add_task(f"{scenario.name}, {model}", total=None, state="")

        def show(t: float, derailed: int) -> None:
            bars.update(task, state=f"{t:.1f} s, {derailed} cars derailed")

        began = time.perf_counter()
        try:
            first = run_model(model, params, roll=roll, progress=show)
            outcomes.append(first.record)
        except (ModelError, ParameterError) as error:
            raise CommandFailure(f"{scenario.name}: {error}") from None
        except SimulationError as error:
            text = " ".join(str(error).split())
            outcomes.append(failed_record(text, time.perf_counter() - began))

        def another(run: Run, stop: Callable[[], bool]) -> Record:
            def look(_t: float, _derailed: int) -> None:
                if stop():
                    raise Stopped

            return run_model(model, run.params(), progress=look).record

        others = (Run(params, member=m, seed=seed) for m in range(1, members))
        records: dict[int, Record] = {}
        with closing(run_many(others, jobs=jobs, task=another)) as results:
            for result in results:
                records[result.run.member] = (
                    result.value
                    if result.error is None
                    else failed_record(result.error, result.wall_s)
                )
                bars.update(task, state=f"{1 + len(records)} of {members} runs")
        outcomes += [records[m] for m in sorted(records)]
    moments = Moments()
    for record in outcomes:
        moments.add(record)
    report: Record = {
        "scenario": scenario.name,
        "title": scenario.title,
        "hash": scenario.hash,
        "seed": seed if ensemble is not None else None,
        "members": members,
        "void": moments.void,
        "failed": moments.failed,
        "outcomes": outcomes,
        "mean": moments.mean(),
        "sd": moments.sd(),
        "model": model,
        "notes": {} if first is None else first.notes,
        "warnings": [],
    }
    if output is not None:
        _write(output, scenario, settings, report, first)
    if as_json:
        common.print_json(report)
    else:
        _print(report, output)
    for i, record in enumerate(outcomes):
        if "error" in record:
            note(f"derail: member {i} failed: {record['error']}")
            break
    return FAILED if moments.failed == members else OK


def _write(
    output: Path,
    scenario: Scenario,
    settings: Sequence[str],
    report: Record,
    first: ModelRun | None,
) -> None:
    import dataclasses

    from derail_ros.commands.simulate import write_csv
    from derail_ros.recording.manifest import software_versions

    common.write_json(output / "outcomes.json", report)
    if report["members"] > 1:
        write_csv(output / "outcomes.csv", report["outcomes"])
    if first is not None and first.scene is not None:
        from derail_ros.review.drawing import save
        from derail_ros.review.figures import final_scene

        scene = dataclasses.replace(
            first.scene, title=scenario.title, subtitle=f"model: {report['model']}"
        )
        save(final_scene(scene), output / "final_scene.png")
    common.write_json(
        output / "manifest.json",
        {
            "format": "derail_ros/results",
            "version": 1,
            "command": "simulate",
            "model": report["model"],
            "scenario": scenario.resolved(),
            "scenario_name": scenario.name,
            "scenario_hash": scenario.hash,
            "settings": list(settings),
            "ensemble": report["members"],
            "seed": report["seed"],
            "software": software_versions(),
            "files": sorted(p.name for p in output.iterdir()) + ["manifest.json"],
        },
    )


def _print(report: Record, output: Path | None) -> None:
    from rich.markup import escape

    from derail_ros.baselines.models import MODELS
    from derail_ros.commands.simulate import _many, _one

    console = common.out()
    console.print(f"[bold]{escape(report['scenario'])}[/bold]  {escape(report['title'])}")
    console.print(f"model {report['model']}: {MODELS[report['model']]}")
    outcomes = report["outcomes"]
    console.print(_one(outcomes[0]) if report["members"] == 1 else _many(report))
    for key, value in report["notes"].items():
        if value is None or (isinstance(value, list) and len(value) > 2):
            continue
        console.print(f"{key.replace('_', ' ')}: {value}")
    rolls = report["notes"].get("roll_deg")
    if rolls is not None:
        rolled = [f"{i + 1} ({r:.0f})" for i, r in enumerate(rolls) if r]
        console.print("roll estimate (degrees), cars: " + (", ".join(rolled) or "none"))
    if output is not None:
        console.print(f"results in {escape(str(output))}", soft_wrap=True)


def parse_speeds(text: str) -> list[float]:
    """``30,48,60`` as speeds, km/h."""
    try:
        speeds = [float(part) for part in text.split(",")]
    except ValueError:
        raise CommandFailure(f"--speeds: must be like 30,48,60, not {text!r}") from None
    if not all(0.0 < v < 720.0 for v in speeds) or speeds != sorted(set(speeds)):
        raise CommandFailure("--speeds: must be positive and rise")
    return speeds


def write_page(
    path: Path, members: int, seed: int, jobs: int | None, as_json: bool, more: bool
) -> int:
    """Ensembles of all models on the cases of ``docs/baselines.md``, and the page from them.

    ``more``: something was said that belongs to a single comparison.
    """
    from derail_ros.baselines import page
    from derail_ros.studies.ensemble import default_jobs

    if more:
        raise CommandFailure(
            "--write is for the page's own cases as they are: without a scenario, --set, "
            "--model, --speeds and -o"
        )
    plan = page.Plan()
    images = common.image_beside(path, "models.png").parent
    text = path.read_text(encoding="utf-8") if path.exists() else None
    if text is not None and (missing := page.missing_markers(text, page.NAMES)):
        raise CommandFailure(f"{path}: has no place for the results {', '.join(missing)}")
    common.warm_up()
    _warm_anderson()
    tasks = page.jobs_of(plan, members)
    with common.progress(*common.counting_columns()) as bars:
        task = bars.add_task("compare-models", total=None)

        def show(done: int, total: int) -> None:
            bars.update(task, completed=done, total=total)

        cases = page.compute(tasks, seed, at_a_time=jobs, progress=show)
    write_results(path, text, images, cases, plan, members, seed, jobs or default_jobs())
    note(f"derail: wrote {path} and its figures in {images}")
    ensembles = [e for case in cases.values() for e in case.values()]
    failed = [r["error"] for e in ensembles for r in e.records if "error" in r]
    if as_json:
        common.print_json({"members": members, "seed": seed,
                           "ensembles": [e.as_dict() for e in ensembles]})  # fmt: skip
    if failed:
        note(f"derail: {count(len(failed), 'run')} failed: {'; '.join(sorted(set(failed)))}")
    return FAILED if failed else OK


def write_results(
    path: Path,
    text: str | None,
    images: Path,
    cases: Any,
    plan: Any,
    members: int,
    seed: int,
    at_a_time: int,
) -> None:
    """Fill the page and write its figures; a page that does not exist becomes a bare one."""
    from derail_ros.baselines import page
    from derail_ros.models import engine_hash
    from derail_ros.review.drawing import save

    drawn = page.figures(cases, plan)
    for name, figure in drawn.items():
        save(figure, images / name, dpi=80)
    few = max(2, members // 4)
    at = "one run at a time" if at_a_time == 1 else f"{at_a_time} runs at a time"
    about = (
        f"<sub>`derail compare-models --write -n {members}`: {members} runs each for the models "
        f"that know the push that starts the motion (it is varied by up to 4 %, seed {seed}), "
        f"{few} each for other choices of constants, one for the others; mean ± standard "
        "deviation of single runs. Scenes drawn are those of the scenario itself. Wall times: the "
        f"least of these runs or of {page.REPEATS}, {at}, kernels compiled before. "
        f"Engine {engine_hash()[:16]}.</sub>"
    )
    if text is None:
        text = page.bare({name: f"images/{name}" for name in drawn})
    path.write_text(page.fill(text, page.blocks(cases, plan, about)), encoding="utf-8")


def _warm_anderson() -> None:
    """Have Anderson's kernels compiled: its wall time shall not hold that."""
    from derail_ros.baselines.anderson import AndersonModel

    AndersonModel(common.load("base_train").to_params()).advance_to(0.01)


def compare_models(
    name_or_file: str | None,
    settings: Sequence[str],
    models: Sequence[str],
    speeds: str | None,
    members: int | None,
    as_json: bool,
    output: Path | None,
) -> int:
    """All models on one scenario, as a table and a figure; at several speeds if asked."""
    from derail_ros.baselines import comparison
    from derail_ros.baselines.models import MODELS

    if name_or_file is None:
        raise CommandFailure("name a scenario (derail scenarios), or --write for the page")
    if members is not None:
        raise CommandFailure("-n: only with --write; derail simulate --model has ensembles too")
    chosen = list(models) or list(MODELS)
    for name in chosen:
        _check_model(name)
    scenario = common.load(name_or_file, settings)
    series = None if speeds is None else parse_speeds(speeds)
    if output is not None:
        output = common.output_directory(output)
    if any(_needs_kernels(name) for name in chosen):
        common.warm_up()
        if "anderson" in chosen:
            _warm_anderson()
    trains = (
        [scenario]
        if series is None
        else [scenario.with_overrides({"train.speed_kmh": v}) for v in series]
    )
    runs = []
    with common.progress(*common.counting_columns()) as bars:
        task = bars.add_task(scenario.name, total=len(trains) * len(chosen))
        for train in trains:
            before = len(runs) * len(chosen)

            def show(name: str, done: int, before: int = before) -> None:
                bars.update(task, description=f"{scenario.name}, {name}", completed=before + done)

            runs.append(comparison.compare(train.to_params(), chosen, progress=show))
    title = scenario.title
    if settings:
        title += f" ({', '.join(settings)})"
    answers = [
        {
            e.model: {"error": e.error}
            if e.run is None
            else {"outcome": e.run.record, "notes": e.run.notes}
            for e in entries
        }
        for entries in runs
    ]
    report: dict[str, Any] = {
        "scenario": scenario.name,
        "title": scenario.title,
        "hash": scenario.hash,
        "settings": list(settings),
    }
    if series is None:
        report["models"] = answers[0]
        table = comparison.markdown(runs[0])
    else:
        report["speeds_kmh"] = series
        report["models_by_speed"] = answers
        table = comparison.by_speed_markdown(series, runs)
    if output is not None:
        from derail_ros.review.drawing import save

        common.write_json(output / "comparison.json", report)
        (output / "comparison.md").write_text(table, encoding="utf-8")
        if series is None:
            page = comparison.figure(title, runs[0])
        else:
            page = comparison.by_speed_figure(
                f"{scenario.name}: cars derailed over the speed", series, runs
            )
        save(page, output / "comparison.png", dpi=80)
    if as_json:
        common.print_json(report)
    else:
        _print_comparison(scenario, title, series, runs)
        if output is not None:
            note(f"results in {output}")
    return OK if any(e.run is not None for entries in runs for e in entries) else FAILED


def _print_comparison(
    scenario: Scenario,
    title: str,
    series: Sequence[float] | None,
    runs: Sequence[Sequence[Any]],
) -> None:
    from rich.markup import escape
    from rich.table import Table

    from derail_ros.baselines import comparison

    console = common.out()
    console.print(f"[bold]{escape(scenario.name)}[/bold]  {escape(title)}")
    table = Table(box=None, pad_edge=False)
    table.add_column("model", no_wrap=True)
    remarks: list[tuple[str, str]] = []
    if series is None:
        for heading, *_ in comparison.MEASURES:
            table.add_column(heading, justify="right")
        lines = [row[:-1] for row in comparison.rows(runs[0])]
        remarks = [(row[0], row[-1]) for row in comparison.rows(runs[0]) if row[-1]]
    else:
        for v in series:
            table.add_column(f"{v:g} km/h", justify="right")
        lines = comparison.by_speed_rows(runs)
    for line in lines:
        table.add_row(*(escape(text) for text in line))
    console.print(table)
    for name, remark in remarks:
        console.print(f"{name}: {escape(remark)}", soft_wrap=True)


def joint_velocities(
    scenario: str | None,
    settings: Sequence[str],
    cars: int,
    train_mass: float,
    length: float,
    impulse: float,
    as_json: bool,
) -> int:
    """Joint velocities of a train at rest after a blow across its head."""
    import numpy as np

    from derail_ros.baselines.joints import joint_velocities as solve
    from derail_ros.vocabulary.words import finite

    inertia = None
    if scenario is None:
        if settings:
            raise CommandFailure("--set: only with a scenario")
        if cars < 1:
            raise CommandFailure("--cars: must be at least 1")
        name = f"{cars} equal bars"
        mass = np.full(cars, train_mass / cars)
        lengths = np.full(cars, length)
    else:
        from derail_ros.baselines.train import take_apart

        loaded = common.load(scenario, settings)
        name = loaded.title
        bodies = take_apart(loaded.to_params().cars)
        mass = np.array([c.mass for c in bodies])
        lengths = np.array(
            [2.0 * c.pivot_distance + c.front.length + c.rear.length for c in bodies]
        )
        inertia = np.array([c.inertia for c in bodies])
    try:
        answer = solve(mass, lengths, inertia=inertia, impulse=impulse)
    except ValueError as error:
        raise CommandFailure(str(error)) from None
    bars = [
        {
            "bar": i + 1,
            "mass_kg": finite(mass[i]),
            "length_m": finite(lengths[i]),
            "front_joint_m_per_s": finite(answer.joint[i]),
            "front_joint_relative": finite(answer.relative[i]),
            "centre_m_per_s": finite(answer.centre[i]),
            "yaw_rate_rad_per_s": finite(answer.yaw_rate[i]),
        }
        for i in range(len(mass))
    ]
    if as_json:
        common.print_json(
            {
                "train": name,
                "impulse_N_s": impulse,
                "bars": bars,
                "tail_m_per_s": finite(answer.joint[-1]),
                "tail_relative": finite(answer.relative[-1]),
                "energy_J": finite(answer.energy),
            }
        )
        return OK
    from rich.markup import escape
    from rich.table import Table

    console = common.out()
    console.print(f"[bold]{escape(name)}[/bold], {mass.sum() * 1e-3:.0f} t at rest")
    console.print(f"transverse impulse of {impulse:g} N s on the head of the first")
    table = Table(box=None, pad_edge=False)
    headings = ("joint ahead of bar", "mass (t)", "velocity (m/s)", "relative to the head",
                "yaw rate of the bar (rad/s)")  # fmt: skip
    for heading in headings:
        table.add_column(heading, justify="right")
    shown = [b for b in bars if b["bar"] <= 12]
    for bar in shown:
        table.add_row(
            str(bar["bar"]),
            f"{bar['mass_kg'] * 1e-3:.1f}",
            f"{bar['front_joint_m_per_s']:.4g}",
            f"{bar['front_joint_relative']:.4g}",
            f"{bar['yaw_rate_rad_per_s']:.4g}",
        )
    if len(shown) == len(bars):
        table.add_row("tail", "", f"{answer.joint[-1]:.4g}", f"{answer.relative[-1]:.4g}", "")
    console.print(table)
    if len(shown) < len(bars):
        console.print(f"and {len(bars) - len(shown)} more; --json gives all")
    return OK
