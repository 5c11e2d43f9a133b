"""``derail validate``: ensembles against the published runs."""

from __future__ import annotations

from typing import Annotated

from derail_ros.commands import common
from derail_ros.commands.options import Jobs, Json, Seed, Texts, changes, runs


def run(
    members: Annotated[int, runs("Runs per case.")] = 20,
    seed: Seed = 0,
    jobs: Jobs = None,
    settings: Annotated[Texts, changes("a value in all cases")] = None,
    as_json: Json = False,
) -> int:
    """Compare ensembles with the published runs."""
    from derail_ros.studies import validation as v
    from derail_ros.studies.records import with_status

    overrides = common.overrides(settings)
    with common.counting_runs("validate") as progress:
        result = v.validate(members, seed, jobs=jobs, settings=overrides, progress=progress)
    if as_json:
        common.print_json("validation", result.as_dict())
    else:
        doubt = [v.doubt_table(result)] if result.doubtful else []
        common.print_tables(*v.measure_tables(result), v.goal_table(result), *doubt)
    return common.exit_code(*with_status(result.ensembles))
