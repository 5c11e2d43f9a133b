"""``derail convergence``: ensembles at several tolerances."""

from __future__ import annotations

from typing import Annotated

import typer

from derail_ros.commands import common
from derail_ros.commands.common import FAILED, OK, CommandFailure
from derail_ros.commands.options import Jobs, Json, ScenarioNames, Seed, runs


def run(
    names: ScenarioNames = None,
    members: Annotated[int, runs("Runs per tolerance.", 3)] = 40,
    seed: Seed = 0,
    jobs: Jobs = None,
    tolerances: Annotated[
        list[float] | None, typer.Option("--rtol", help="A tolerance; default: 1e-2 to 1e-7.")
    ] = None,
    as_json: Json = False,
) -> int:
    """Compare ensembles at several tolerances with the tightest."""
    common.need_extra("derail convergence", "scipy")
    from derail_ros.studies import convergence as c

    rtols = sorted(set(tolerances or c.TOLERANCES), reverse=True)
    if len(rtols) < 2:
        raise CommandFailure("--rtol: at least two tolerances are compared")
    for rtol in rtols:
        if not 1e-12 <= rtol <= 0.1:
            raise CommandFailure(f"--rtol: must be 1e-12 to 0.1, got {rtol:g}")
    studies = []
    for scenario in [common.load(name) for name in (names or c.SCENARIOS)]:
        try:
            with common.counting_runs(scenario.name) as progress:
                studies.append(
                    c.convergence(
                        scenario, members, seed, tolerances=rtols, jobs=jobs, progress=progress
                    )
                )
        except RuntimeError as error:
            raise CommandFailure(f"{scenario.name}: {error}", FAILED) from None
    if as_json:
        values = {"members": members, "seed": seed, "studies": [s.as_dict() for s in studies]}
        common.print_json("convergence", values)
        return OK
    common.print_tables(*map(c.mean_table, studies))
    common.out().print(
        "Mean with its 95 % confidence; bold: the difference from the tightest is larger than the "
        "95 % confidence of that difference.",
        style="dim",
    )
    return OK
