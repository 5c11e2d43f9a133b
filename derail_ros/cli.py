"""The command line, ``derail``.

Only options are declared here; what a command does is in ``derail_ros.commands`` and imported
when it runs, so that ``derail --help`` does not wait for numpy, numba or matplotlib.

Exit codes: 0 done, 2 bad input, 3 the simulation failed, 130 interrupted.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
import typer.core

app = typer.Typer(
    name="derail",
    help="Simulate train derailments.",
    no_args_is_help=False,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

Json = Annotated[bool, typer.Option("--json", help="Print one JSON object instead of a table.")]
Jobs = Annotated[
    int | None,
    typer.Option("--jobs", "-j", min=1, help="Runs at a time; one per core by default."),
]
Seed = Annotated[int, typer.Option("--seed", min=0, help="Seed of the ensemble's variation.")]


def _version(asked: bool) -> None:
    if asked:
        from derail_ros import __version__

        print(f"derail_ros {__version__}")
        raise typer.Exit


@app.callback()
def root(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_version, is_eager=True, help="Print the version."),
    ] = False,
) -> None:
    """Simulate train derailments."""


@app.command()
def simulate(
    scenario: Annotated[str, typer.Argument(help="Name of a scenario, or a YAML file.")],
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="PATH=VALUE", help="Change a value, e.g. train.speed_kmh=60."
        ),
    ] = None,
    ensemble: Annotated[
        int | None,
        typer.Option(
            "--ensemble",
            "-n",
            min=1,
            help="Runs with the lateral force varied by up to 4 %; the first is the scenario.",
        ),
    ] = None,
    seed: Seed = 0,
    jobs: Jobs = None,
    as_json: Json = False,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            metavar="DIR",
            help="Write a recording (rosbag2), figures, outcomes and a manifest.",
        ),
    ] = None,
    model: Annotated[
        str | None,
        typer.Option(
            "--model",
            "-m",
            help="planar (the default), or an earlier model: yang-manos, anderson, "
            "roorda-gracie, blockage, bar-1, bar-2 or bar-3 (also bar-2-corrected, "
            "bar-3-corrected); docs/baselines.md.",
        ),
    ] = None,
    roll: Annotated[
        bool,
        typer.Option("--roll", help="Estimate how far free cars roll (planar and anderson)."),
    ] = False,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="Show the quality of the computation too.")
    ] = False,
) -> int:
    """Run a scenario to rest, without a ROS graph, and report what came of it.

    The earlier models write no recording.
    """
    from derail_ros.models import names
    from derail_ros.vocabulary.params import PLANAR

    if model == "toma":  # its name before 0.2
        model = PLANAR
    if roll or (model is not None and model not in names()):
        from derail_ros.commands import models as other

        return other.run(
            model or PLANAR, scenario, settings or [], ensemble, seed, jobs, roll, as_json, output
        )
    from derail_ros.commands import simulate as command

    chosen = [] if model is None else [f"model={model}"]
    given = [*chosen, *(settings or [])]
    return command.run(scenario, given, ensemble, seed, jobs, as_json, output, verbose)


@app.command()
def scenarios(as_json: Json = False) -> int:
    """List the scenarios."""
    from derail_ros.commands import scenarios as command

    return command.run(as_json)


@app.command()
def estimate(
    name: Annotated[str, typer.Argument(help="bar-1, bar-2 or bar-3.")],
    form: Annotated[
        str | None, typer.Option(help="published or corrected (bar-2 and bar-3).")
    ] = None,
    speed_kmh: Annotated[float | None, typer.Option(help="Speed of the train.")] = None,
    mu1: Annotated[
        float | None, typer.Option(help="Friction on the rails; bar-3: of the braked train.")
    ] = None,
    mu2: Annotated[float | None, typer.Option(help="Friction on the ground.")] = None,
    cars: Annotated[
        str, typer.Option(help="Numbers of cars: 60, or 20,40,60, or first:last:step.")
    ] = "10:100:10",
    car_length: Annotated[float, typer.Option(help="Length of a car, m.")] = 15.0,
    as_json: Json = False,
) -> int:
    """Estimate the cars derailed: the train as a bar that slides onto the ground.

    Without options: the parameters of the published figures.
    """
    from derail_ros.commands import estimate as command

    return command.run(name, form, speed_kmh, mu1, mu2, cars, car_length, as_json)


@app.command("compare-models")
def compare_models(
    scenario: Annotated[str, typer.Argument(help="Name of a scenario, or a YAML file.")],
    settings: Annotated[
        list[str] | None, typer.Option("--set", metavar="PATH=VALUE", help="Change a value.")
    ] = None,
    models: Annotated[
        list[str] | None, typer.Option("--model", "-m", help="Only these; all by default.")
    ] = None,
    speeds: Annotated[
        str | None, typer.Option(help="At these speeds, km/h, e.g. 30,48,60,72,90.")
    ] = None,
    as_json: Json = False,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="DIR", help="Write the table and a figure."),
    ] = None,
) -> int:
    """Run this model and the earlier ones on one train."""
    from derail_ros.commands import models as command

    return command.compare_models(scenario, settings or [], models or [], speeds, as_json, output)


@app.command()
def accidents(
    reports: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Files of accident reports (CSV, FRA form 54); the shipped averages without."
        ),
    ] = None,
    broken_rail: Annotated[
        bool, typer.Option("--broken-rail", help="Only reports whose cause is a broken rail.")
    ] = False,
    causes: Annotated[
        list[str] | None, typer.Option("--cause", help="Only this code of a cause, e.g. T207.")
    ] = None,
    behind: Annotated[
        int, typer.Option(min=1, help="Only with so many cars from the first one involved on.")
    ] = 1,
    loaded: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Only with this share of the cars loaded.")
    ] = 0.0,
    models: Annotated[
        list[str] | None,
        typer.Option(
            "--model",
            "-m",
            help="Run the trains of the reports with it; without files their mean trains.",
        ),
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="PATH=VALUE", help="Change the base train, e.g. brakes.delay_s=10."
        ),
    ] = None,
    report: Annotated[
        str | None,
        typer.Option(metavar="NUMBER", help="Print the train of this report as a scenario."),
    ] = None,
    most: Annotated[
        int, typer.Option(min=1, help="Trains run of each class of speed, at most.")
    ] = 100,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the choice of trains.")] = 0,
    jobs: Jobs = None,
    as_json: Json = False,
) -> int:
    """Show the cars derailed in reported accidents; run models on the same trains."""
    from derail_ros.commands import accidents as command

    chosen = command.Chosen(broken_rail, tuple(causes or ()), behind, loaded)
    if report is not None:
        more = chosen != command.Chosen() or bool(models) or as_json
        return command.print_scenario(reports or [], report, settings or [], more)
    return command.run(
        reports or [], chosen, models or [], settings or [], most, seed, jobs, as_json
    )


@app.command("joint-velocities")
def joint_velocities(
    scenario: Annotated[
        str | None, typer.Argument(help="A scenario's train; equal bars without.")
    ] = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", metavar="PATH=VALUE", help="Change a value.")
    ] = None,
    cars: Annotated[int, typer.Option(help="Number of equal bars.")] = 6,
    train_mass: Annotated[
        float, typer.Option(help="Mass of all equal bars, kg; Johnson's train by default.")
    ] = 450e3,
    length: Annotated[float, typer.Option(help="Length of an equal bar, m.")] = 15.0,
    impulse: Annotated[float, typer.Option(help="Transverse impulse on the head, N s.")] = 1000.0,
    as_json: Json = False,
) -> int:
    """Joint velocities of a train at rest after a blow across its head (Johnson, Guran)."""
    from derail_ros.commands import models as command

    return command.joint_velocities(
        scenario, settings or [], cars, train_mass, length, impulse, as_json
    )


@app.command()
def validate(
    members: Annotated[int, typer.Option("--ensemble", "-n", min=2, help="Runs a case.")] = 20,
    seed: Seed = 0,
    jobs: Jobs = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="PATH=VALUE", help="Change a value in all cases."),
    ] = None,
    as_json: Json = False,
) -> int:
    """Compare ensembles with the published runs."""
    from derail_ros.commands import validate as command

    return command.run(members, seed, jobs, settings or [], as_json)


Bag = Annotated[str, typer.Argument(help="A recording: its folder, or a file of it.")]
RunOption = Annotated[
    str | None,
    typer.Option(
        "--run", help="Which run of several: number, or beginning of its identity; default: last."
    ),
]
Namespace = Annotated[
    str | None, typer.Option("--namespace", help="Of the topics, where several were recorded.")
]


@app.command()
def review(
    bag: Bag,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Empty folder.")],
    run: RunOption = None,
    namespace: Namespace = None,
    figures: Annotated[bool, typer.Option(help="Draw the figures.")] = True,
    replay: Annotated[bool, typer.Option(help="Write the replay page.")] = True,
    as_json: Json = False,
) -> int:
    """Tell what happened in a recording: summary, figures and a replay page."""
    from derail_ros.commands import review as command

    return command.run(bag, output, run, namespace, figures, replay, as_json)


@app.command()
def export(
    bag: Bag,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Empty folder.")],
    form: Annotated[str, typer.Option("--format", help="csv or parquet.")] = "csv",
    run: RunOption = None,
    namespace: Namespace = None,
) -> int:
    """Write the histories of the cars in a recording as tables, with units."""
    from derail_ros.commands import export as command

    return command.run(bag, output, form, run, namespace)


@app.command()
def compare(
    first: Bag,
    second: Bag,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="DIR", help="Write the scenes and JSON there."),
    ] = None,
    as_json: Json = False,
) -> int:
    """Compare two recordings: measures, scenes and events."""
    from derail_ros.commands import compare as command

    return command.run(first, second, output, as_json)


@app.command()
def animate(
    bag: Bag,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="FILE", help="A name in .mp4 or .gif.")
    ],
    run: RunOption = None,
    namespace: Namespace = None,
    fps: Annotated[
        int | None, typer.Option(min=1, max=60, help="Pictures a second [20; GIF 8].")
    ] = None,
    rate: Annotated[
        float | None, typer.Option(help="Recorded time per time of the film [1; GIF 2].")
    ] = None,
    width: Annotated[
        int | None, typer.Option(min=320, max=3840, help="Pixels [960; GIF 640].")
    ] = None,
    start: Annotated[float | None, typer.Option(help="From this time on, s.")] = None,
    end: Annotated[float | None, typer.Option(help="Up to this time, s.")] = None,
) -> int:
    """Make a film of a recording, seen from above."""
    from derail_ros.commands import animate as command

    return command.run(bag, output, run, namespace, fps, rate, width, start, end)


@app.command()
def play(
    bag: Bag,
    rate: Annotated[float, typer.Option(help="Recorded time per wall time.")] = 1.0,
    start: Annotated[float, typer.Option(help="Begin so long after the beginning, s.")] = 0.0,
    loop: Annotated[bool, typer.Option("--loop", help="Begin again at the end.")] = False,
    paused: Annotated[bool, typer.Option("--paused", help="Wait for resume.")] = False,
    clock: Annotated[bool, typer.Option(help="Publish /clock.")] = True,
) -> int:
    """Publish a recording on a ROS 2 graph: the node player."""
    from derail_ros.commands import play as command

    return command.run(bag, rate, start, loop, paused, clock)


@app.command()
def repair(
    bag: Bag,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="DIR", help="New folder; default: BAG_repaired."),
    ] = None,
) -> int:
    """Make a recording whole whose recorder was killed: a new one, with index and metadata."""
    from derail_ros.commands import repair as command

    return command.run(bag, output)


@app.command()
def replay(
    bag: Annotated[
        str, typer.Argument(help="A recording: its folder, a file of it, or its manifest.json.")
    ],
    as_json: Json = False,
) -> int:
    """Compute recorded runs again, with their commands, and compare to the bit.

    Exit code 3 if anything differs.
    """
    from derail_ros.commands import replay as command

    return command.run(bag, as_json)


@app.command()
def sensitivity(
    members: Annotated[
        int, typer.Option("--ensemble", "-n", min=2, help="Runs a case and change.")
    ] = 20,
    seed: Seed = 0,
    jobs: Jobs = None,
    cases: Annotated[
        list[str] | None,
        typer.Option("--case", help="A published case, or all; five of them by default."),
    ] = None,
    constants: Annotated[
        list[str] | None, typer.Option("--only", help="A constant; all by default.")
    ] = None,
    as_json: Json = False,
) -> int:
    """Vary each reconstructed constant and form about its default."""
    from derail_ros.commands import sensitivity as command

    return command.run(members, seed, jobs, cases or [], constants or [], as_json)


class _StudyGroup(typer.core.TyperGroup):
    """``derail study STUDY`` is ``derail study run STUDY``."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if args and args[0] not in self.commands and args[0] not in ("-h", "--help"):
            args = ["run", *args]
        return super().parse_args(ctx, args)


study = typer.Typer(
    cls=_StudyGroup,
    help="Run a study: derail study STUDY, the name of a shipped one or a YAML file.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
app.add_typer(study, name="study")


@study.command("run")
def study_run(
    name: Annotated[
        str, typer.Argument(metavar="STUDY", help="Name of a shipped study, or a YAML file.")
    ],
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="PATH=VALUE", help="Change a value of the base scenario."),
    ] = None,
    ensemble: Annotated[
        int | None, typer.Option("--ensemble", "-n", min=1, help="Runs a point.")
    ] = None,
    points: Annotated[
        int | None, typer.Option(min=2, help="Points of a sampled design; N of sobol.")
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed.")] = None,
    jobs: Jobs = None,
    dask: Annotated[
        str | None, typer.Option(metavar="tcp://...", help="Run it on this Dask cluster.")
    ] = None,
    table: Annotated[str, typer.Option(help="parquet or csv.")] = "parquet",
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="DIR", help="Results; runs/study_NAME by default."),
    ] = None,
    check: Annotated[bool, typer.Option("--check", help="Check every point, run none.")] = False,
    as_json: Json = False,
) -> int:
    """Run a study, or what is missing of it, and say what it shows.

    Interrupted, the same command goes on from the runs that are finished.
    """
    from derail_ros.commands import study as command

    return command.run(
        name, settings or [], ensemble, points, seed, jobs, dask, table, output, check, as_json
    )


Results = Annotated[Path, typer.Argument(help="Folder of results.")]


@study.command("show")
def study_show(results: Results, as_json: Json = False) -> int:
    """Print what results say: means with their uncertainty, and sentences."""
    from derail_ros.commands import study as command

    return command.show(results, as_json)


@study.command("report")
def study_report(
    results: Results,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="Folder of the page.")
    ],
) -> int:
    """Write a page (HTML) with figures and tables, the figures (PNG) and the tables (CSV)."""
    from derail_ros.commands import study as command

    return command.report(results, output)


@study.command("list")
def study_list(as_json: Json = False) -> int:
    """List the studies that ship."""
    from derail_ros.commands import study as command

    return command.listing(as_json)


@app.command()
def spread(
    names: Annotated[
        list[str] | None,
        typer.Argument(help="Scenarios; Mississauga and the base train by default."),
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="PATH=VALUE", help="Change a value in all of them."),
    ] = None,
    members: Annotated[int, typer.Option("--ensemble", "-n", min=2, help="Runs each.")] = 200,
    seed: Seed = 0,
    jobs: Jobs = None,
    as_json: Json = False,
) -> int:
    """Show the distributions of outcomes over many runs of a scenario."""
    from derail_ros.commands import spread as command

    return command.run(names or [], settings or [], members, seed, jobs, as_json)


@app.command()
def convergence(
    names: Annotated[
        list[str] | None,
        typer.Argument(help="Scenarios; Mississauga and the base train by default."),
    ] = None,
    members: Annotated[
        int, typer.Option("--ensemble", "-n", min=3, help="Runs a tolerance.")
    ] = 40,
    seed: Seed = 0,
    jobs: Jobs = None,
    tolerances: Annotated[
        list[float] | None,
        typer.Option("--rtol", help="A tolerance; 1e-2 to 1e-7 by default."),
    ] = None,
    as_json: Json = False,
) -> int:
    """Compare ensembles at several tolerances with the tightest."""
    from derail_ros.commands import convergence as command

    return command.run(names or [], members, seed, jobs, tolerances or [], as_json)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; its exit code. Errors are one line on stderr."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    # A supervisor's SIGTERM ends a command as cleanly as Ctrl-C does.
    signal.signal(signal.SIGTERM, _interrupt)
    try:
        code = app(args=arguments or ["--help"], prog_name="derail", standalone_mode=False)
    except KeyboardInterrupt:
        return _fail("interrupted", 130)
    except BrokenPipeError:
        # The reader of stdout has gone; keep the interpreter from complaining at its exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except Exception as error:
        return _explain(error)
    if code == 130:  # some versions of typer catch Ctrl-C themselves
        return _fail("interrupted", 130)
    return code if isinstance(code, int) else 0


def _interrupt(*_: object) -> None:
    raise KeyboardInterrupt


def _explain(error: Exception) -> int:
    """Turn what is the user's to mend into a line; anything else is a defect and raised."""
    if type(error).__name__ == "Abort":  # typer's own name for Ctrl-C
        return _fail("interrupted", 130)
    if hasattr(error, "format_message") and hasattr(error, "exit_code"):  # usage
        return _fail(error.format_message(), 2)
    from derail_ros.commands.common import CommandFailure
    from derail_ros.scenario.errors import ScenarioError

    if isinstance(error, CommandFailure):
        return _fail(str(error), error.code)
    if isinstance(error, ScenarioError):
        return _fail(str(error), 2)
    raise error


def _fail(message: str, code: int) -> int:
    line = " ".join(message.split())
    print(f"derail: {line}", file=sys.stderr, flush=True)
    return code


if __name__ == "__main__":
    sys.exit(main())
