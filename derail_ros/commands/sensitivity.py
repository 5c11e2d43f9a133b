"""``derail sensitivity``: what the reconstructed constants do."""

from __future__ import annotations

from collections.abc import Sequence

from derail_ros.commands import common
from derail_ros.commands.common import CommandFailure


def run(
    members: int,
    seed: int,
    jobs: int | None,
    cases: Sequence[str],
    constants: Sequence[str],
    as_json: bool,
) -> int:
    """Vary and report; the exit code tells whether runs failed."""
    from derail_ros.studies import sensitivity as s
    from derail_ros.studies.published import load_published

    try:
        s.choose_cases(load_published(), cases)
        s.choose_constants(constants)
    except ValueError as error:
        raise CommandFailure(str(error)) from None
    with common.counting_runs("sensitivity") as progress:
        study = s.sensitivity(
            members, seed, jobs=jobs, cases=cases, constants=constants, progress=progress
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
