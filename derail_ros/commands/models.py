"""``derail simulate --model``, ``derail compare-models`` and ``derail joint-velocities``."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from derail_ros.commands import common
from derail_ros.commands.common import FAILED, OK, CommandFailure, note
from derail_ros.commands.options import Json, ScenarioName, Settings, Texts, of_model, written
from derail_ros.vocabulary.words import count, finite

if TYPE_CHECKING:
    from derail_ros.baselines.models import ModelRun
    from derail_ros.scenario import Scenario
    from derail_ros.vocabulary.measures import Record


def known_model(name: str) -> str:
    """The name of a model; a former one is still read, an unknown one refused."""
    from derail_ros.baselines.models import FORMER, MODELS

    name = FORMER.get(name, name)
    if name not in MODELS:
        raise CommandFailure(f"--model: unknown model {name!r}; choose one of {', '.join(MODELS)}")
    return name


def run(
    model: str,
    scenario: Scenario,
    settings: Sequence[str],
    ensemble: int | None,
    seed: int,
    jobs: int | None,
    roll: bool,
    as_json: bool,
    output: Path | None,
    verbose: bool,
) -> int:
    """Run a scenario with one of the models; the exit code."""
    from derail_ros.baselines.models import MODELS, ModelError, run_job, run_model
    from derail_ros.commands import results
    from derail_ros.vocabulary.errors import ParameterError, SimulationError
    from derail_ros.vocabulary.measures import failed_record

    model = known_model(model)
    if roll and not MODELS[model].rolls:
        raise CommandFailure(f"--roll: couplings never part in {model}, so no car is free to roll")
    params = scenario.to_params()
    members = ensemble or 1
    if members > 1 and not MODELS[model].varied:
        raise CommandFailure(f"--ensemble: {model} has no lateral force to vary")
    if output is not None:
        output = common.output_directory(output)
    if MODELS[model].kernels:
        common.warm_up()
    records: list[Record] = []
    first: ModelRun | None = None
    with common.progress(*common.spinner_columns()) as bars:
        task = bars.add_task(f"{scenario.name}, {model}", total=None, state="")

        def show(t: float, derailed: int) -> None:
            bars.update(task, state=f"{t:.1f} s, {count(derailed, 'car')} derailed")

        began = time.perf_counter()
        try:
            first = run_model(model, params, roll=roll, progress=show)
            records.append(first.record)
        except (ModelError, ParameterError) as error:
            raise CommandFailure(f"{scenario.name}: {error}") from None
        except SimulationError as error:
            text = " ".join(str(error).split())
            records.append(failed_record(text, time.perf_counter() - began))
        bars.update(task, completed=1, total=members, state="")
        records += results.members(
            params, 1, members, seed, jobs, lambda job, stop: run_job(model, job, stop).record,
            lambda _: bars.update(task, advance=1),
        )  # fmt: skip
    notes = {} if first is None else first.notes
    report = results.report_of(scenario, model, None if ensemble is None else seed, records, notes)
    if output is not None:
        if first is not None and first.scene is not None:
            from derail_ros.review import drawing, figures

            scene = dataclasses.replace(
                first.scene, title=scenario.title, subtitle=f"model: {model}"
            )
            drawing.save(figures.final_scene(scene), output / "final_scene.png")
        results.write(output, scenario, settings, report)
    about = [f"model {model}: {MODELS[model].words}", *_noted(notes)]
    return results.finish(report, output, as_json, verbose, about)


def _noted(notes: Record) -> list[str]:
    """What a model tells beside the outcome, in lines."""
    lines = [
        f"{key.replace('_', ' ')}: {value}"
        for key, value in notes.items()
        if value is not None and not (isinstance(value, list) and len(value) > 2)
    ]
    rolls = notes.get("roll_deg")
    if rolls is not None:
        rolled = [f"{i + 1} ({r:.0f})" for i, r in enumerate(rolls) if r]
        lines.append(f"roll estimate (degrees), cars: {', '.join(rolled) or 'none'}")
    return lines


def parse_speeds(text: str) -> list[float]:
    """``30,48,60`` as speeds, km/h."""
    try:
        speeds = [float(part) for part in text.split(",")]
    except ValueError:
        raise CommandFailure(f"--speeds: must be like 30,48,60, got {text!r}") from None
    if not all(0.0 < v < 720.0 for v in speeds) or speeds != sorted(set(speeds)):
        raise CommandFailure("--speeds: must be positive and rising, below 720")
    return speeds


def compare_models(
    scenario: ScenarioName,
    settings: Settings = None,
    models: Annotated[Texts, of_model("Run only this model (repeat for more).")] = None,
    speeds: Annotated[
        str | None, typer.Option(help="Run at these speeds, km/h, e.g. 30,48,60,72,90.")
    ] = None,
    as_json: Json = False,
    output: Annotated[Path | None, written("Write the table and a figure there.")] = None,
) -> int:
    """Run this model and the earlier ones on one train."""
    from derail_ros.baselines import comparison
    from derail_ros.baselines.models import MODELS

    chosen = [known_model(name) for name in models or []] or list(MODELS)
    base = common.load(scenario, settings)
    series = None if speeds is None else parse_speeds(speeds)
    if output is not None:
        output = common.output_directory(output)
    if any(MODELS[name].kernels for name in chosen):
        common.warm_up()
    if "anderson" in chosen:
        from derail_ros.baselines.anderson import warm_up

        warm_up()
    trains = [
        base if v is None else base.with_overrides({"train.speed_kmh": v})
        for v in (series or [None])
    ]
    runs: list[Any] = []
    with common.progress(*common.counting_columns()) as bars:
        task = bars.add_task(base.name, total=len(trains) * len(chosen))

        def show(name: str, done: int) -> None:
            done += len(runs) * len(chosen)
            bars.update(task, description=f"{base.name}, {name}", completed=done)

        for train in trains:
            runs.append(comparison.compare(train.to_params(), chosen, progress=show))
    answers = [{e.model: e.as_dict() for e in entries} for entries in runs]
    report: dict[str, Any] = {
        "schema": "derail_ros/model_comparison",
        "schema_version": 1,
        "scenario": base.name,
        "title": base.title,
        "hash": base.hash,
        "settings": settings or [],
    }
    if series is None:
        report["models"] = answers[0]
        table = comparison.comparison_table(runs[0])
    else:
        report |= {"speeds_kmh": series, "models_by_speed": answers}
        table = comparison.by_speed_table(series, runs)
    if output is not None:
        from derail_ros.baselines import figures
        from derail_ros.review.drawing import save

        common.write_json(output / "comparison.json", report)
        (output / "comparison.md").write_text(table.markdown() + "\n", encoding="utf-8")
        if series is None:
            page = figures.figure(base.title, runs[0])
        else:
            title = f"{base.name}: cars derailed over the speed"
            page = figures.by_speed_figure(title, series, runs)
        save(page, output / "comparison.png", dpi=80)
    if as_json:
        common.print_json("model_comparison", report)
    else:
        from rich.markup import escape

        console = common.out()
        console.print(f"[bold]{escape(base.name)}[/bold]  {escape(base.title)}")
        remarks = []
        if series is None:  # a remark may be long: below the table
            remarks = [f"{row[0]}: {row[-1]}" for row in table.rows if row[-1]]
            rows = [row[:-1] for row in table.rows]
            table = dataclasses.replace(table, heads=table.heads[:-1], rows=rows)
        common.print_tables(table)
        for remark in remarks:
            console.print(escape(remark), soft_wrap=True)
        if output is not None:
            note(f"results in {output}")
    return OK if any(e.run is not None for entries in runs for e in entries) else FAILED


MOST_BARS = 12
"""Bars that are printed; --json gives all."""


def joint_velocities(
    scenario: Annotated[
        str | None, typer.Argument(help="Scenario whose train is struck; default: equal bars.")
    ] = None,
    settings: Settings = None,
    cars: Annotated[int, typer.Option(help="Number of equal bars.")] = 6,
    train_mass: Annotated[
        float, typer.Option(help="Mass of all equal bars, kg; default: Johnson's train.")
    ] = 450e3,
    length: Annotated[float, typer.Option(help="Length of an equal bar, m.")] = 15.0,
    impulse: Annotated[float, typer.Option(help="Transverse impulse on the head, N s.")] = 1000.0,
    as_json: Json = False,
) -> int:
    """Compute the joint velocities of a standing train after a blow on its head."""
    import numpy as np

    from derail_ros.baselines.joints import joint_velocities as solve
    from derail_ros.baselines.joints import train_bars
    from derail_ros.studies.tables import Table

    if scenario is None:
        if settings:
            raise CommandFailure("--set: needs a scenario")
        if cars < 1:
            raise CommandFailure("--cars: must be at least 1")
        name, inertia = f"{cars} equal bars", None
        mass, lengths = np.full(cars, train_mass / cars), np.full(cars, length)
    else:
        loaded = common.load(scenario, settings)
        name = loaded.title
        mass, lengths, inertia = train_bars(loaded.to_params())
    with common.refusing(ValueError):
        answer = solve(mass, lengths, inertia=inertia, impulse=impulse)
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
            "joint_velocities",
            {
                "train": name,
                "impulse_N_s": impulse,
                "bars": bars,
                "tail_m_per_s": finite(answer.joint[-1]),
                "tail_relative": finite(answer.relative[-1]),
                "energy_J": finite(answer.energy),
            },
        )
        return OK
    from rich.markup import escape

    console = common.out()
    console.print(f"[bold]{escape(name)}[/bold], {mass.sum() * 1e-3:.0f} t at rest")
    console.print(f"transverse impulse of {impulse:g} N s on the head of the first")
    rows = [
        [str(i + 1), f"{mass[i] * 1e-3:.1f}", f"{answer.joint[i]:.4g}",
         f"{answer.relative[i]:.4g}", f"{answer.yaw_rate[i]:.4g}"]
        for i in range(min(len(mass), MOST_BARS))
    ]  # fmt: skip
    if len(rows) == len(mass):
        rows.append(["tail", "", f"{answer.joint[-1]:.4g}", f"{answer.relative[-1]:.4g}", ""])
    heads = ["joint ahead of bar", "mass (t)", "velocity (m/s)", "relative to the head",
             "yaw rate of the bar (rad/s)"]  # fmt: skip
    common.print_tables(Table(heads, rows, texts=0))
    if len(mass) > MOST_BARS:
        console.print(f"and {len(mass) - MOST_BARS} more; --json gives all")
    return OK
