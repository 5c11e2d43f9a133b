"""The command line, ``derail``.

A command is a function of ``derail_ros.commands``; its parameters are its options. It imports
what it needs when it runs, so that ``derail --help`` does not wait for numpy, numba or
matplotlib.

Exit codes: 0 done, 2 bad input, 3 the simulation failed, 130 interrupted.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Sequence
from typing import Annotated, Any

import typer
import typer.core

from derail_ros.commands import (
    accidents,
    consist,
    estimate,
    figures,
    lists,
    look,
    model_studies,
    models,
    predict,
    reconstruct,
    recordings,
    simulate,
    study,
)

app = typer.Typer(
    name="derail",
    help="Simulate train derailments.",
    no_args_is_help=False,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


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


class _StudyGroup(typer.core.TyperGroup):
    """``derail study STUDY`` is ``derail study run STUDY``."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if args and args[0] not in self.commands and args[0] not in ("-h", "--help"):
            args = ["run", *args]
        return super().parse_args(ctx, args)


studies = typer.Typer(
    cls=_StudyGroup,
    help="Run a study: derail study STUDY, the name of a shipped one or a YAML file.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)

for name, command in {
    "simulate": simulate.run,
    "look": look.run,
    "predict": predict.run,
    "reconstruct": reconstruct.run,
    "consist": consist.run,
    "scenarios": lists.scenarios,
    "models": lists.models,
    "estimate": estimate.run,
    "compare-models": models.compare_models,
    "accidents": accidents.run,
    "joint-velocities": models.joint_velocities,
    "review": recordings.review,
    "export": recordings.export,
    "compare": recordings.compare,
    "animate": recordings.animate,
    "view3d": recordings.view3d,
    "export-world": recordings.export_world,
    "play": recordings.play,
    "repair": recordings.repair,
    "replay": recordings.replay,
    "validate": model_studies.validate,
    "figures": figures.run,
    "sensitivity": model_studies.sensitivity,
    "spread": model_studies.spread,
    "convergence": model_studies.convergence,
}.items():
    app.command(name)(command)
app.add_typer(studies, name="study")
for name, command in {
    "run": study.run,
    "show": study.show,
    "report": study.report,
    "list": study.listing,
}.items():
    studies.command(name)(command)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code. Errors are one line on stderr."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    # A supervisor's SIGTERM ends a command as cleanly as Ctrl-C does.
    signal.signal(signal.SIGTERM, _interrupt)
    signal.signal(signal.SIGINT, _interrupt)
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
