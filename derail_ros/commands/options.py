"""Options shared by several commands."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer


def changes(what: str = "a value, e.g. train.speed_kmh=60") -> Any:
    """``--set``: what it changes."""
    return typer.Option("--set", metavar="PATH=VALUE", help=f"Change {what}.")


def runs(what: str, least: int = 2) -> Any:
    """``--ensemble``: number of runs."""
    return typer.Option("--ensemble", "-n", min=least, help=what)


def written(what: str, kind: str = "DIR") -> Any:
    """``--output``: where results go."""
    return typer.Option("-o", "--output", metavar=kind, help=what)


def of_model(what: str) -> Any:
    """``--model``."""
    return typer.Option("--model", "-m", help=what)


Texts = list[str] | None
ScenarioName = Annotated[str, typer.Argument(help="Name of a scenario, or a YAML file.")]
ScenarioNames = Annotated[
    Texts, typer.Argument(help="Scenarios; Mississauga and the base train by default.")
]
Settings = Annotated[Texts, changes()]
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
NewDir = Annotated[Path, written("New or empty folder for the results.")]
