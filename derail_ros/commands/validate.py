"""``derail validate``: ensembles against the published runs."""

from __future__ import annotations

from collections.abc import Sequence

from derail_ros.commands import common


def run(members: int, seed: int, jobs: int | None, settings: Sequence[str], as_json: bool) -> int:
    """Compare and report; the exit code tells whether runs failed, not whether goals were met."""
    from derail_ros.scenario import parse_set
    from derail_ros.studies import validation as v
    from derail_ros.studies.records import with_status

    overrides = dict(parse_set(text) for text in settings)
    with common.counting_runs("validate") as progress:
        result = v.validate(members, seed, jobs=jobs, settings=overrides, progress=progress)
    if as_json:
        common.print_json("validation", result.as_dict())
    else:
        doubt = [v.doubt_table(result)] if result.doubtful else []
        common.print_tables(*v.measure_tables(result), v.goal_table(result), *doubt)
    return common.exit_code(*with_status(result.ensembles))
