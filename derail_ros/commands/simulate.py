"""``derail simulate``: a run or an ensemble of a scenario, without a ROS graph."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import closing
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from derail_ros.commands import common, results
from derail_ros.commands.common import FAILED, CommandFailure, note
from derail_ros.studies.ensemble import VARIATION, advance, describe, ensemble_jobs, run_many
from derail_ros.studies.records import record_of
from derail_ros.vocabulary.measures import Record, failed_record, outcome_record
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
    members = 1 if ensemble is None else ensemble
    if members > 1 and not params.initiation.lateral_forces:
        note(f"{scenario.name} has no lateral force to vary: all members are the same run")
    if output is not None:
        output = common.output_directory(output)
    common.warm_up(params.model)
    try:
        simulation = models.build(params)
    except ParameterError as error:
        raise CommandFailure(f"{scenario.name}: {error}") from None

    records: list[Record] = []
    with common.progress(*_columns(members)) as bars:
        task = bars.add_task(scenario.name, total=members if members > 1 else None, state="")
        if members == 1 or output is not None:
            records.append(_first(simulation, scenario, output, bars, task))
            bars.update(task, advance=1)
        if len(records) < members:
            runs = islice(ensemble_jobs(params, members, seed=seed), len(records), None)
            done = {}  # records and not outcomes: there may be thousands
            with closing(run_many(runs, jobs=jobs)) as found:
                for result in found:
                    done[result.job.member] = record_of(result)
                    bars.update(task, advance=1)
            records += [done[member] for member in sorted(done)]
    late = late_break(params, records[0])
    report = results.report_of(
        scenario,
        params.model,
        None if ensemble is None else seed,
        records,
        notes={},
        warnings=[] if late is None else [late],
    )
    if output is not None:
        if "error" not in records[0]:
            _draw(output, scenario.title, simulation)
        results.write(output, scenario, settings, report, variation=VARIATION, commands=[])
    return results.finish(report, output, as_json, verbose)


def late_break(params: TrainParams, record: Record) -> str | None:
    """A warning for a run whose push ends before it can turn a car.

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
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn

    if members > 1:
        return common.counting_columns()
    text = TextColumn("{task.description}")
    return [text, BarColumn(), TextColumn("{task.fields[state]}"), TimeElapsedColumn()]


def _first(
    simulation: Simulation, scenario: Scenario, output: Path | None, bars: Any, task: Any
) -> Record:
    """Run the scenario itself, recorded if there is an output folder."""
    from derail_ros.recording import RecordingError, record_run
    from derail_ros.vocabulary.errors import SimulationError

    def show(running: Simulation) -> None:
        cars = count(running.outcome().cars_derailed, "car")
        bars.update(task, state=f"{running.time:.1f} s, {cars} derailed")

    began = time.perf_counter()
    try:
        if output is None:
            outcome = advance(simulation, progress=show, slice_s=0.5)
        else:
            record_run(simulation, scenario, output / "recording", progress=show)
            outcome = simulation.outcome()
    except SimulationError as error:
        if output is not None:
            (output / "failed_state.bin").write_bytes(simulation.to_bytes())
        return failed_record(describe(error), time.perf_counter() - began)
    except (RecordingError, OSError) as error:
        raise CommandFailure(f"{output}/recording: {error}", FAILED) from None
    return outcome_record(outcome, time.perf_counter() - began)


def _draw(output: Path, title: str, simulation: Simulation) -> None:
    """The final scene and the peak forces of a finished run."""
    from derail_ros.review.figures import save_outcome
    from derail_ros.review.scene import scene_from_simulation

    outcome = simulation.outcome()
    save_outcome(scene_from_simulation(simulation, title, outcome.text), outcome, output)
