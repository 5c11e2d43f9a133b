"""The command line, ``derail``.

Only options are declared here. What a command does is in ``derail_ros.commands`` and imported
when it runs, so that ``derail --help`` does not wait for numpy, numba or matplotlib.

Exit codes: 0 done, 2 bad input, 3 the simulation failed, 130 interrupted.
"""

from __future__ import annotations

import importlib
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

# Options that several commands have ----------------------------------------------------------


def _set(what: str = "a value, e.g. train.speed_kmh=60") -> Any:
    return typer.Option("--set", metavar="PATH=VALUE", help=f"Change {what}.")


def _runs(what: str, least: int = 2) -> Any:
    return typer.Option("--ensemble", "-n", min=least, help=what)


def _output(what: str, kind: str = "DIR") -> Any:
    return typer.Option("-o", "--output", metavar=kind, help=what)


def _model(what: str) -> Any:
    return typer.Option("--model", "-m", help=what)


Texts = list[str] | None
ScenarioName = Annotated[str, typer.Argument(help="Name of a scenario, or a YAML file.")]
ScenarioNames = Annotated[
    Texts, typer.Argument(help="Scenarios; Mississauga and the base train by default.")
]
Settings = Annotated[Texts, _set()]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object instead of a table.")]
Jobs = Annotated[
    int | None, typer.Option("--jobs", "-j", min=1, help="Parallel runs; one per core by default.")
]
Seed = Annotated[int, typer.Option("--seed", min=0, help="Seed of the random variation.")]
Bag = Annotated[str, typer.Argument(help="A recording: its folder, or a file of it.")]
WhichRun = Annotated[
    str | None,
    typer.Option("--run", help="Number of a run, or the first letters of its id; default: last."),
]
Namespace = Annotated[
    str | None, typer.Option("--namespace", help="Namespace of the topics, if there are several.")
]
NewDir = Annotated[Path, _output("New or empty folder for the results.")]
Results = Annotated[Path, typer.Argument(help="Folder with the results of a study.")]


def _call(module: str, *arguments: Any, function: str = "run") -> int:
    """Run a command; its module is imported only now."""
    code = getattr(importlib.import_module(f"derail_ros.commands.{module}"), function)(*arguments)
    return int(code)


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


# Runs ----------------------------------------------------------------------------------------


@app.command()
def simulate(
    scenario: ScenarioName,
    settings: Settings = None,
    ensemble: Annotated[
        int | None, _runs("Runs; all but the first vary the lateral force by up to 4 %.", 1)
    ] = None,
    seed: Seed = 0,
    jobs: Jobs = None,
    as_json: Json = False,
    output: Annotated[
        Path | None, _output("Write a recording, figures, outcomes and a manifest there.")
    ] = None,
    model: Annotated[
        str | None, _model("Name of a model, see `derail models`; default: planar.")
    ] = None,
    roll: Annotated[
        bool, typer.Option("--roll", help="Estimate how far uncoupled cars roll over.")
    ] = False,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="Show the numerical quality too.")
    ] = False,
) -> int:
    """Run a scenario until the train is at rest, and show the outcome. Needs no ROS."""
    from derail_ros.models import names
    from derail_ros.vocabulary.params import PLANAR

    if model == "toma":  # its name before 0.2
        model = PLANAR
    given = settings or []
    if roll or (model is not None and model not in names()):
        name = model or PLANAR
        return _call(
            "models", name, scenario, given, ensemble, seed, jobs, roll, as_json, output, verbose
        )
    chosen = [] if model is None else [f"model={model}"]
    return _call(
        "simulate", scenario, chosen + given, ensemble, seed, jobs, as_json, output, verbose
    )


@app.command()
def scenarios(as_json: Json = False) -> int:
    """List the scenarios."""
    return _call("lists", as_json, function="scenarios")


@app.command()
def models(as_json: Json = False) -> int:
    """List the models: the engines, and the earlier models."""
    return _call("lists", as_json, function="models")


# Earlier models ------------------------------------------------------------------------------


@app.command()
def estimate(
    name: Annotated[str, typer.Argument(help="bar-1, bar-2 or bar-3.")],
    form: Annotated[
        str | None, typer.Option(help="published or corrected (bar-2 and bar-3).")
    ] = None,
    speed_kmh: Annotated[float | None, typer.Option(help="Speed of the train, km/h.")] = None,
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
    """Estimate the cars derailed: the train is a bar that slides onto the ground.

    The defaults are the parameters of the published figures.
    """
    return _call("estimate", name, form, speed_kmh, mu1, mu2, cars, car_length, as_json)


@app.command("compare-models")
def compare_models(
    scenario: ScenarioName,
    settings: Settings = None,
    models: Annotated[Texts, _model("Run only this model (repeat for more).")] = None,
    speeds: Annotated[
        str | None, typer.Option(help="Run at these speeds, km/h, e.g. 30,48,60,72,90.")
    ] = None,
    as_json: Json = False,
    output: Annotated[Path | None, _output("Write the table and a figure there.")] = None,
) -> int:
    """Run this model and the earlier ones on one train."""
    given = (scenario, settings or [], models or [], speeds, as_json, output)
    return _call("models", *given, function="compare_models")


@app.command()
def accidents(
    reports: Annotated[
        list[Path] | None,
        typer.Argument(help="Accident reports (CSV, FRA form 54); default: shipped averages."),
    ] = None,
    broken_rail: Annotated[
        bool, typer.Option("--broken-rail", help="Only reports whose cause is a broken rail.")
    ] = False,
    causes: Annotated[
        Texts, typer.Option("--cause", help="Only this cause code, e.g. T207.")
    ] = None,
    behind: Annotated[
        int, typer.Option(min=1, help="Only trains with this many cars behind the first derailed.")
    ] = 1,
    loaded: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Only trains with this share of loaded cars.")
    ] = 0.0,
    models: Annotated[
        Texts, _model("Run this model on the trains (without files: on their mean trains).")
    ] = None,
    settings: Annotated[Texts, _set("the base train, e.g. brakes.delay_s=10")] = None,
    report: Annotated[
        str | None,
        typer.Option(metavar="NUMBER", help="Print the train of this report as a scenario."),
    ] = None,
    most: Annotated[
        int, typer.Option(min=1, help="Most trains to run in a class of speed.")
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
    given = (scenario, settings or [], cars, train_mass, length, impulse, as_json)
    return _call("models", *given, function="joint_velocities")


# Recordings ----------------------------------------------------------------------------------


@app.command()
def review(
    bag: Bag,
    output: NewDir,
    run: WhichRun = None,
    namespace: Namespace = None,
    figures: Annotated[bool, typer.Option(help="Draw the figures.")] = True,
    replay: Annotated[bool, typer.Option(help="Write the replay page.")] = True,
    as_json: Json = False,
) -> int:
    """Summarize a recording: text, JSON, figures and a replay page."""
    return _call("review", bag, output, run, namespace, figures, replay, as_json)


@app.command()
def export(
    bag: Bag,
    output: NewDir,
    form: Annotated[str, typer.Option("--format", help="csv or parquet.")] = "csv",
    run: WhichRun = None,
    namespace: Namespace = None,
) -> int:
    """Write the histories of the cars in a recording as tables."""
    return _call("export", bag, output, form, run, namespace)


@app.command()
def compare(
    first: Bag,
    second: Bag,
    output: Annotated[Path | None, _output("Write text, JSON and both scenes there.")] = None,
    as_json: Json = False,
) -> int:
    """Compare two recordings: measures, scenes and events."""
    return _call("compare", first, second, output, as_json)


@app.command()
def animate(
    bag: Bag,
    output: Annotated[Path, _output("Film to write; its name ends in .mp4 or .gif.", "FILE")],
    run: WhichRun = None,
    namespace: Namespace = None,
    fps: Annotated[
        int | None, typer.Option(min=1, max=60, help="Pictures per second [20; GIF: 8].")
    ] = None,
    rate: Annotated[
        float | None, typer.Option(help="Recorded time per time of the film [1; GIF: 2].")
    ] = None,
    width: Annotated[
        int | None, typer.Option(min=320, max=3840, help="Width, pixels [960; GIF: 640].")
    ] = None,
    start: Annotated[float | None, typer.Option(help="Begin at this time, s.")] = None,
    end: Annotated[float | None, typer.Option(help="End at this time, s.")] = None,
) -> int:
    """Make a film of a recording, seen from above."""
    return _call("animate", bag, output, run, namespace, fps, rate, width, start, end)


@app.command()
def play(
    bag: Bag,
    rate: Annotated[float, typer.Option(help="Recorded time per wall time.")] = 1.0,
    start: Annotated[float, typer.Option(help="Begin this long after the beginning, s.")] = 0.0,
    loop: Annotated[bool, typer.Option("--loop", help="Start again at the end.")] = False,
    paused: Annotated[bool, typer.Option("--paused", help="Wait for the service resume.")] = False,
    clock: Annotated[bool, typer.Option(help="Publish /clock.")] = True,
) -> int:
    """Publish a recording on a ROS 2 graph, with the node player."""
    return _call("play", bag, rate, start, loop, paused, clock)


@app.command()
def repair(
    bag: Bag,
    output: Annotated[
        Path | None, _output("New folder for the repaired recording; default: BAG_repaired.")
    ] = None,
) -> int:
    """Write a whole recording from one whose recorder was killed."""
    return _call("repair", bag, output)


@app.command()
def replay(
    bag: Annotated[
        str, typer.Argument(help="A recording: its folder, a file of it, or its manifest.json.")
    ],
    as_json: Json = False,
) -> int:
    """Compute recorded runs again, with their commands, and compare them to the bit.

    The exit code is 3 if anything differs.
    """
    return _call("replay", bag, as_json)


# Studies -------------------------------------------------------------------------------------


@app.command()
def validate(
    members: Annotated[int, _runs("Runs per case.")] = 20,
    seed: Seed = 0,
    jobs: Jobs = None,
    settings: Annotated[Texts, _set("a value in all cases")] = None,
    as_json: Json = False,
) -> int:
    """Compare ensembles with the published runs."""
    return _call("validate", members, seed, jobs, settings or [], as_json)


@app.command()
def sensitivity(
    members: Annotated[int, _runs("Runs per case and change.")] = 20,
    seed: Seed = 0,
    jobs: Jobs = None,
    cases: Annotated[
        Texts, typer.Option("--case", help="A published case, or all; default: five of them.")
    ] = None,
    constants: Annotated[Texts, typer.Option("--only", help="Vary only this constant.")] = None,
    as_json: Json = False,
) -> int:
    """Vary each reconstructed constant and form about its default."""
    return _call("sensitivity", members, seed, jobs, cases or [], constants or [], as_json)


@app.command()
def spread(
    names: ScenarioNames = None,
    settings: Annotated[Texts, _set("a value in all of them")] = None,
    members: Annotated[int, _runs("Runs per scenario.")] = 200,
    seed: Seed = 0,
    jobs: Jobs = None,
    as_json: Json = False,
) -> int:
    """Show the distributions of outcomes over many runs of a scenario."""
    return _call("spread", names or [], settings or [], members, seed, jobs, as_json)


@app.command()
def convergence(
    names: ScenarioNames = None,
    members: Annotated[int, _runs("Runs per tolerance.", 3)] = 40,
    seed: Seed = 0,
    jobs: Jobs = None,
    tolerances: Annotated[
        list[float] | None, typer.Option("--rtol", help="A tolerance; default: 1e-2 to 1e-7.")
    ] = None,
    as_json: Json = False,
) -> int:
    """Compare ensembles at several tolerances with the tightest."""
    return _call("convergence", names or [], members, seed, jobs, tolerances or [], as_json)


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
    settings: Annotated[Texts, _set("a value of the base scenario")] = None,
    ensemble: Annotated[int | None, _runs("Runs per point.", 1)] = None,
    points: Annotated[
        int | None, typer.Option(min=2, help="Points of a sampled design; N of sobol.")
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of the study.")] = None,
    jobs: Jobs = None,
    dask: Annotated[
        str | None, typer.Option(metavar="tcp://...", help="Run on this Dask cluster.")
    ] = None,
    table: Annotated[str, typer.Option(help="Format of the table: parquet or csv.")] = "parquet",
    output: Annotated[
        Path | None, _output("Folder for the results; default: runs/study_NAME.")
    ] = None,
    check: Annotated[bool, typer.Option("--check", help="Check all points and run none.")] = False,
    as_json: Json = False,
) -> int:
    """Run a study, or what is missing of it, and say what it shows.

    After an interruption the same command goes on from the runs that are finished.
    """
    given = (name, settings or [], ensemble, points, seed, jobs, dask, table, output, check)
    return _call("study", *given, as_json)


@study.command("show")
def study_show(results: Results, as_json: Json = False) -> int:
    """Print the results: means with their uncertainty, and sentences."""
    return _call("study", results, as_json, function="show")


@study.command("report")
def study_report(
    results: Results, output: Annotated[Path, _output("Folder for the page.")]
) -> int:
    """Write a page (HTML) with figures and tables, the figures (PNG) and the tables (CSV)."""
    return _call("study", results, output, function="report")


@study.command("list")
def study_list(as_json: Json = False) -> int:
    """List the shipped studies."""
    return _call("study", as_json, function="listing")


# Errors --------------------------------------------------------------------------------------


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code. Errors are one line on stderr."""
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
    """Report an error of the user in one line; anything else is a defect and raised again."""
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
