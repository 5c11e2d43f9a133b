"""``derail sensitivity``: what the reconstructed constants do."""

from __future__ import annotations

from typing import Annotated

import typer

from derail_ros.commands import common
from derail_ros.commands.common import CommandFailure
from derail_ros.commands.options import Jobs, Json, Seed, Texts, runs


def run(
    members: Annotated[int, runs("Runs per case and change.")] = 20,
    seed: Seed = 0,
    jobs: Jobs = None,
    cases: Annotated[
        Texts, typer.Option("--case", help="A published case, or all; default: five of them.")
    ] = None,
    constants: Annotated[Texts, typer.Option("--only", help="Vary only this constant.")] = None,
    as_json: Json = False,
) -> int:
    """Vary each reconstructed constant and form about its default."""
    from derail_ros.studies import sensitivity as s
    from derail_ros.studies.published import load_published

    try:
        s.choose_cases(load_published(), cases or [])
        s.choose_constants(constants or [])
    except ValueError as error:
        raise CommandFailure(str(error)) from None
    with common.counting_runs("sensitivity") as progress:
        study = s.sensitivity(
            members,
            seed,
            cases=cases or [],
            constants=constants or [],
            jobs=jobs,
            progress=progress,
        )
    if as_json:
        common.print_json("sensitivity", study.as_dict())
    else:
        common.print_tables(s.effect_table(study))
        common.out().print(
            "Mean change against the default with its standard error; bold: more than two of "
            "them and more than any control.",
            style="dim",
        )
    errors = {text for e in study.effects for text in e.ensemble.errors}
    return common.exit_code(study.failed, errors)
