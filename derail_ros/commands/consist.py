"""``derail consist``: a scenario from a railway's consist list."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from derail_ros.commands import common
from derail_ros.commands.common import OK, CommandFailure, note
from derail_ros.commands.options import Json, written


def run(
    file: Annotated[Path, typer.Argument(help="A consist list: CSV, units in its headings.")],
    output: Annotated[Path | None, written("Write the scenario there.", "FILE")] = None,
    as_json: Json = False,
) -> int:
    """Make a scenario from a railway's consist list; print what was assumed."""
    from derail_ros.scenario.consist_list import read_consist_list

    found = read_consist_list(file)
    scenario = found.to_scenario()
    text = found.to_yaml()
    if output is not None:
        _write(output, text, file, found.content)
    if as_json:
        common.print_json(
            "consist",
            {
                "file": found.file,
                "output": None if output is None else str(output),
                "train": scenario.totals.record,
                "assumed": found.assumed,
                "warnings": list(scenario.warnings),
            },
        )
    elif output is None:
        print(text, end="")
    note(f"derail: {found.file}: {scenario.totals.text}")
    for sentence in found.assumed:
        note(f"derail: assumed: {sentence}")
    for warning in scenario.warnings:
        note(f"derail: warning: {warning}")
    if output is not None:
        note(
            f"derail: {output} written; set speed and cause in it, then: derail simulate {output}"
        )
    return OK


def _write(output: Path, text: str, file: Path, content: bytes) -> None:
    """Write the scenario, and a copy of the list beside it, with which it travels."""
    if output.suffix not in (".yaml", ".yml"):
        raise CommandFailure(f"{output}: the name of a scenario ends in .yaml")
    if output.exists():
        raise CommandFailure(f"{output}: exists already")
    beside = output.parent / file.name
    with common.refusing(OSError, at=output):
        if not beside.exists():
            beside.write_bytes(content)
        elif beside.read_bytes() != content:
            raise CommandFailure(f"{beside}: exists already, with another content")
        output.write_text(text, encoding="utf-8")
