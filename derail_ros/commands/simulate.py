"""``derail simulate``: a run or an ensemble of a scenario, without a ROS graph."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from derail_ros.commands import common, models
from derail_ros.commands.common import FAILED, CommandFailure, note
from derail_ros.commands.options import (
    Jobs,
    Json,
    ScenarioName,
    Seed,
    Settings,
    of_model,
    runs,
    written,
)
from derail_ros.vocabulary.params import PLANAR
from derail_ros.vocabulary.words import count

if TYPE_CHECKING:
    from derail_ros.review.scene import Scene
    from derail_ros.scenario import Scenario
    from derail_ros.vocabulary.measures import Record
    from derail_ros.vocabulary.params import TrainParams
    from derail_ros.vocabulary.simulation import Simulation


def run(
    scenario: ScenarioName,
    settings: Settings = None,
    ensemble: Annotated[
        int | None,
        runs("Runs; all but the first draw what is uncertain, or vary the push by 4 %.", 1),
    ] = None,
    seed: Seed = 0,
    jobs: Jobs = None,
    as_json: Json = False,
    output: Annotated[
        Path | None,
        written("Write recording, figures, outcomes, all members and a manifest there."),
    ] = None,
    model: Annotated[
        str | None, of_model("Name of a model, see `derail models`; default: planar.")
    ] = None,
    roll: Annotated[
        bool, typer.Option("--roll", help="Estimate how far uncoupled cars roll over.")
    ] = False,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="Show the numerical quality too.")
    ] = False,
) -> int:
    """Run a scenario until the train is at rest, and show the outcome. Needs no ROS."""
    from derail_ros import models as engines
    from derail_ros.commands import results
    from derail_ros.studies import ensemble as ensembles
    from derail_ros.studies.ensemble import VARIATION, JobResult, compute
    from derail_ros.vocabulary.errors import ParameterError

    if model == "toma":  # its name before 0.2
        model = PLANAR
    earlier = roll or (model is not None and model not in engines.names())
    if model is not None and not earlier:
        settings = [f"model={model}", *(settings or [])]
    loaded = common.load(scenario, settings)
    if earlier:
        return models.run(
            model or PLANAR, loaded, settings or [], ensemble, seed, jobs, roll, as_json, output,
            verbose,
        )  # fmt: skip
    params = loaded.to_params()
    members = ensemble or 1
    if members > 1 and not params.initiation.lateral_forces and not loaded.draws:
        note(f"{loaded.name} has no lateral force to vary: all members are the same run")
    if output is not None:
        output = common.output_directory(output)
    common.warm_up(params.model)
    with common.refusing(ParameterError, at=loaded.name):
        simulation = engines.build(params)

    records: list[Record] = []
    kept = None
    if output is not None and members > 1:
        from derail_ros.studies.members import Members

        kept = Members()

    def keep(result: JobResult) -> None:
        bars.update(task, advance=1)
        if kept is not None and result.error is None:
            kept.add(result.job.member, result.value, result.job.params().cars)

    with common.progress(*_columns(members)) as bars:
        task = bars.add_task(loaded.name, total=members if members > 1 else None, state="")
        if members == 1 or output is not None:
            records.append(_first(simulation, loaded, output, bars, task))
            bars.update(task, advance=1)
        done = len(records)
        records += results.members(loaded, done, members, seed, jobs, compute, keep)
    told = (late_break(params, records[0]), unbraked(params, records[0]))
    report = results.report_of(
        loaded,
        params.model,
        None if ensemble is None else seed,
        records,
        notes={},
        warnings=list(filter(None, told)),
        limits=_limits(simulation, records),
        inputs=[] if members == 1 else ensembles.inputs(loaded, members, seed),
    )
    if output is not None:
        if "error" not in records[0]:
            scene = _draw(output, loaded.title, simulation)
            if kept is not None:
                from derail_ros.studies.members import write

                kept.add(0, simulation.outcome(), params.cars)
                write(output, kept, loaded, scene, records, report["inputs"])
        results.write(output, loaded, settings or [], report, variation=VARIATION, commands=[])
    about = [report["one_draw"]] if members == 1 and report["one_draw"] else []
    return results.finish(report, output, as_json, verbose, about)


def _limits(simulation: Simulation, records: Sequence[Record]) -> list[str]:
    """Limits of the first run, and of the forces in the train of all of them."""
    from derail_ros.vocabulary.limits import late_brakes, limits, train_force_limits
    from derail_ros.vocabulary.measures import counted

    found = []
    if "error" not in records[0]:
        found = limits(simulation.outcome(), simulation.track) + late_brakes(simulation.events)
    good = [record for record in records if counted(record)]
    forces = ([r[key] or math.nan for r in good] for key in ("max_draft_N", "max_buff_N"))
    return found + train_force_limits(*forces, simulation.params.couplings.breaks)


def unbraked(params: TrainParams, record: Record) -> str | None:
    """A warning for a train that rolled without a brake to the end."""
    if record.get("braked") is not False or not any(car.brakes for car in params.cars):
        return None
    why = "no emergency was made (brakes.signal_source, brakes.triggers)"
    if params.brakes.triggers:
        why = "the signal reached no car with a working brake while the train moved"
    elif not params.brakes.vent_on_parting:
        why += " and a parted coupling makes none (brakes.vent_on_parting)"
    else:
        why += " and no coupling parted"
    return f"the train was never braked: {why}; the outcome is that of a train that rolls freely"


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
    from derail_ros.studies.ensemble import advance, describe
    from derail_ros.vocabulary.errors import SimulationError
    from derail_ros.vocabulary.measures import failed_record, outcome_record

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


def _draw(output: Path, title: str, simulation: Simulation) -> Scene:
    """The final scene of a finished run, drawn with its peak forces."""
    from derail_ros.review.figures import save_outcome
    from derail_ros.review.scene import scene_from_simulation

    outcome = simulation.outcome()
    scene = scene_from_simulation(simulation, title, outcome.text)
    save_outcome(scene, outcome, output)
    return scene
