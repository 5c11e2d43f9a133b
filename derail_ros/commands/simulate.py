"""``derail simulate``: a run or an ensemble of a scenario, without a ROS graph."""

from __future__ import annotations

import csv
import time
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from derail_ros.commands import common
from derail_ros.commands.common import FAILED, OK, CommandFailure, note
from derail_ros.studies.ensemble import (
    VARIATION,
    advance,
    describe,
    ensemble_jobs,
    run_many,
)
from derail_ros.studies.records import Ensemble, record_of
from derail_ros.vocabulary.ledger import SMALL_SHARE, percentages, shares
from derail_ros.vocabulary.measures import (
    HEADLINE,
    MEASURES,
    NUMERICS,
    SCHEMA,
    SCHEMA_VERSION,
    Measure,
    Record,
    counted,
    failed_record,
    outcome_record,
    record_numbers,
)
from derail_ros.vocabulary.status import TIME_LIMIT, VOID
from derail_ros.vocabulary.words import count

if TYPE_CHECKING:
    from derail_ros.scenario import Scenario
    from derail_ros.vocabulary.params import TrainParams
    from derail_ros.vocabulary.simulation import Simulation


def run(
    name_or_file: str,
    settings: Sequence[str],
    ensemble: int | None,
    seed: int,
    jobs: int | None,
    as_json: bool,
    output: Path | None,
    verbose: bool = False,
) -> int:
    """Simulate and report; the exit code."""
    from derail_ros import models
    from derail_ros.vocabulary.errors import ParameterError

    scenario = common.load(name_or_file, settings)
    params = scenario.to_params()
    if ensemble is not None and ensemble > 1 and not params.initiation.lateral_forces:
        note(f"{scenario.name} has no lateral force to vary: all members are the same run")
    if output is not None:
        output = common.output_directory(output)
    common.warm_up(params.model)
    try:
        simulation = models.build(params)
    except ParameterError as error:
        raise CommandFailure(f"{scenario.name}: {error}") from None

    members = 1 if ensemble is None else ensemble
    records: list[Record | None] = [None] * members
    with common.progress(*_columns(members)) as bars:
        task = bars.add_task(scenario.name, total=members if members > 1 else None, state="")
        if members == 1 or output is not None:
            records[0] = _first(simulation, scenario, output, bars, task)
            bars.update(task, advance=1)
        if members > 1:
            done = records[0] is not None
            runs = ensemble_jobs(params, members, seed=seed)
            if done:
                next(runs)
            with closing(run_many(runs, jobs=jobs)) as results:
                for result in results:
                    records[result.index + done] = record_of(result)
                    bars.update(task, advance=1)
    outcomes = [r for r in records if r is not None]
    warnings = [w for w in (late_break(params, outcomes[0]),) if w is not None]
    report = report_of(scenario, params.model, None if ensemble is None else seed, outcomes)
    report["warnings"] = warnings
    if output is not None:
        write_outcomes(output, report)
        if "error" not in outcomes[0]:
            write_figures(output, scenario.title, simulation)
        write_manifest(
            output, scenario, settings, report, seed=seed, variation=VARIATION, commands=[]
        )
    if as_json:
        common.print_json(report)
    else:
        _print(report, output, verbose)
    for warning in warnings:
        note(f"derail: warning: {warning}")
    return exit_code(report)


def report_of(scenario: Scenario, model: str, seed: int | None, outcomes: list[Record]) -> Record:
    """What ``--json`` prints of a run (without a seed) or of an ensemble."""
    found = Ensemble(tuple(outcomes))
    return {
        "schema": SCHEMA,
        "schema_version": SCHEMA_VERSION,
        "scenario": scenario.name,
        "title": scenario.title,
        "hash": scenario.hash,
        "seed": seed,
        "members": len(outcomes),
        "void": found.void,
        "failed": found.failed,
        "outcomes": outcomes,
        "mean": found.mean(),
        "sd": found.sd(),
        "model": model,
        "notes": {},
        "warnings": [],
    }


def exit_code(report: Record) -> int:
    """The exit code; the first failure is printed."""
    failures = [(i, r["error"]) for i, r in enumerate(report["outcomes"]) if "error" in r]
    for i, error in failures[:1]:
        note(f"derail: member {i} failed: {error}")
    return FAILED if len(failures) == report["members"] else OK


def late_break(params: TrainParams, record: Record) -> str | None:
    """What to say of a run whose push was over before it could turn a car.

    The rails hold a car against the push as long as its trucks are on them. That is for straight
    track with a break ahead: on a curve cars turn by themselves.
    """
    forces = [f for f in params.initiation.lateral_forces if f.force != 0.0]
    curved = any(s.curvature_start or s.curvature_end for s in params.track.segments)
    if not forces or curved or not params.track.rail_breaks or "error" in record:
        return None
    end = max(f.start + f.duration for f in forces)
    first = record["first_derailment_s"]
    if first is None or first < end:
        return None
    return (
        f"the push ends at {end:.2f} s, before the first truck leaves the rails at {first:.2f} s: "
        "it cannot turn a car; begin it later (initiation.lateral_force_start_s) or break the "
        "rail nearer to the train (track.rail_breaks)"
    )


def _columns(members: int) -> list[Any]:
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns: list[Any] = [TextColumn("{task.description}"), BarColumn()]
    if members > 1:
        columns += [MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn()]
    else:
        columns += [TextColumn("{task.fields[state]}"), TimeElapsedColumn()]
    return columns


def _first(
    simulation: Simulation, scenario: Scenario, output: Path | None, bars: Any, task: Any
) -> Record:
    """Run the scenario itself, recorded if there is an output folder."""

    def show(running: Simulation) -> None:
        derailed = len(running.outcome().derailed_cars)
        bars.update(task, state=f"{running.time:.1f} s, {count(derailed, 'car')} derailed")

    began = time.perf_counter()
    from derail_ros.vocabulary.errors import SimulationError

    try:
        if output is not None:
            _record_run(simulation, scenario, output / "recording", show)
            outcome = simulation.outcome()
        else:
            outcome = advance(simulation, progress=show, slice_s=0.5)
    except SimulationError as error:
        if output is not None:
            (output / "failed_state.bin").write_bytes(simulation.to_bytes())
        return failed_record(describe(error), time.perf_counter() - began)
    return outcome_record(outcome, time.perf_counter() - began)


def _record_run(simulation: Simulation, scenario: Scenario, path: Path, progress: Any) -> None:
    from derail_ros.recording import RecordingError, record_run

    try:
        record_run(simulation, scenario, path, progress=progress)
    except (RecordingError, OSError) as error:
        raise CommandFailure(f"{path}: {error}", FAILED) from None


# Files -------------------------------------------------------------------------------------


def write_outcomes(output: Path, report: Record) -> None:
    """The report, and the outcomes of an ensemble as a table."""
    common.write_json(output / "outcomes.json", report)
    if report["members"] > 1:
        write_csv(output / "outcomes.csv", report["outcomes"])


def write_manifest(
    output: Path, scenario: Scenario, settings: Sequence[str], report: Record, **more: Any
) -> None:
    """What the results are of; written last: it lists the files."""
    from derail_ros.recording.manifest import software_versions

    manifest = {
        "format": "derail_ros/results",
        "version": 1,
        "command": "simulate",
        "scenario": scenario.resolved(),
        "scenario_name": scenario.name,
        "scenario_hash": scenario.hash,
        "settings": list(settings),
        "ensemble": report["members"],
        "software": software_versions(),
        "files": sorted(p.name for p in output.iterdir()) + ["manifest.json"],
    }
    common.write_json(output / "manifest.json", manifest | more)


def write_figures(output: Path, title: str, simulation: Simulation) -> None:
    """The final scene and the peak forces of a finished run."""
    from derail_ros.review.figures import save_outcome
    from derail_ros.review.scene import scene_from_simulation

    outcome = simulation.outcome()
    save_outcome(scene_from_simulation(simulation, title, outcome.text), outcome, output)


def write_csv(path: Path, records: Sequence[Record]) -> None:
    """One row a member: its measures, lists of cars as their number."""
    rows = []
    for i, record in enumerate(records):
        row: dict[str, Any] = {"member": i}
        row["status"] = record.get("status", "")
        row["void"] = int(bool(record.get("void", False)))
        row["error"] = record.get("error", "")
        pair = record.get("peak_force_pair")
        row["peak_force_pair"] = "" if pair is None else f"{pair[0]}-{pair[1]}"
        row |= record_numbers(record)
        rows.append(row)
    names = list(dict.fromkeys(name for row in rows for name in row))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, names, restval="")
        writer.writeheader()
        writer.writerows(rows)


# Words and tables --------------------------------------------------------------------------


NOT_AT_REST = "the run ended at its time limit, not at rest (integration.time_limit_s)"


def stopped_by(record: Record) -> str:
    """What share of the energy at the start went where."""
    ledger = {k: v for k, v in (record.get("energy_J") or {}).items() if v is not None}
    ranked = [(e.words, share) for e, _, share in shares(ledger)]
    large = [(words, share) for words, share in ranked if share >= SMALL_SHARE]
    numbers = percentages([share for _, share in large])
    return ", ".join(f"{words} {n} %" for (words, _), n in zip(large, numbers))


def _print(report: Record, output: Path | None, verbose: bool) -> None:
    from rich.markup import escape

    console = common.out()
    console.print(f"[bold]{escape(report['scenario'])}[/bold]  {escape(report['title'])}")
    outcomes = report["outcomes"]
    if report["members"] == 1:
        console.print(one_run(outcomes[0], verbose))
    else:
        console.print(many_runs(report, verbose))
    if output is not None:
        console.print(f"results in {escape(str(output))}{_of_which(report)}", soft_wrap=True)


def _of_which(report: Record) -> str:
    """Which run of an ensemble was recorded and drawn."""
    if report["members"] == 1:
        return ""
    return (
        f": outcomes of all {report['members']} runs; recording and figures of member 0, the "
        "scenario itself"
    )


def _table() -> Any:
    from rich.table import Table

    return Table(box=None, pad_edge=False, show_header=True, header_style="bold")


def _rows(verbose: bool) -> list[Measure]:
    """The measures of the table."""
    groups = (HEADLINE, NUMERICS) if verbose else (HEADLINE,)
    return [m for m in MEASURES.values() if m.group in groups]


def one_run(record: Record, verbose: bool = False) -> Any:
    table = _table()
    table.add_column("outcome")
    table.add_column("")
    if "error" in record:
        table.add_row("failed", record["error"])
        return table
    status = record["status"]
    why = {VOID: VOID_WORDS, TIME_LIMIT: f": {NOT_AT_REST}"}.get(status, "")
    table.add_row("status", status + why)
    for m in _rows(verbose):
        table.add_row(m.title, m.shown(record.get(m.key)))
    if words := stopped_by(record):
        table.add_row("stopped by", words)
    return table


VOID_WORDS = ": the body that stands for the cars behind reached a break; model more cars"


def many_runs(report: Record, verbose: bool = False) -> Any:

    table = _table()
    table.add_column("ensemble")
    for heading in ("mean", "sd", "least", "most", "member 0"):
        table.add_column(heading, justify="right")
    good = [record_numbers(r) for r in report["outcomes"] if counted(r)]
    first = record_numbers(report["outcomes"][0])
    for m in _rows(verbose):
        values = [r[m.key] for r in good if m.key in r]
        if not values:
            continue
        mean, sd = report["mean"].get(m.key), report["sd"].get(m.key)
        ends = (min(values), max(values), first.get(m.key))
        table.add_row(m.title, m.shown(mean, 1), m.shown(sd, 1), *(m.shown(v) for v in ends))
    counts = count(report["members"], "run")
    if report["void"]:
        counts += f", {report['void']} void and left out"
    if report["failed"]:
        counts += f", {report['failed']} failed"
    cut_off = sum(r["status"] == TIME_LIMIT for r in report["outcomes"])
    if cut_off:
        counts += f", {cut_off} ended at the time limit, not at rest"
    table.caption = counts
    table.caption_justify = "left"
    return table
