"""``derail spread``: distributions of the outcomes of a scenario."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

from derail_ros.commands import common
from derail_ros.commands.common import CommandFailure
from derail_ros.commands.options import Jobs, Json, ScenarioNames, Seed, Texts, changes, runs

if TYPE_CHECKING:
    from derail_ros.studies.spread import Spread


def run(
    names: ScenarioNames = None,
    settings: Annotated[Texts, changes("a value in all of them")] = None,
    members: Annotated[int, runs("Runs per scenario.")] = 200,
    seed: Seed = 0,
    jobs: Jobs = None,
    as_json: Json = False,
) -> int:
    """Show the distributions of outcomes over many runs of a scenario."""
    from derail_ros.studies.records import with_status
    from derail_ros.studies.spread import sentence, spread_table

    spreads = spreads_of(names, settings, members, seed, jobs)
    if as_json:
        common.print_json("spread", {"spreads": [one.as_dict() for one in spreads]})
    else:
        for one in spreads:
            common.print_tables(spread_table(one))
            common.out().print(sentence(one) + "\n")
    return common.exit_code(*with_status(one.ensemble for one in spreads))


def spreads_of(
    names: Sequence[str] | None,
    settings: Sequence[str] | None,
    members: int,
    seed: int,
    jobs: int | None,
) -> list[Spread]:
    """Run scenarios, beside what is published of them."""
    from derail_ros.studies import spread as s
    from derail_ros.studies.published import load_published

    scenarios = [common.load(name, settings) for name in (names or s.DEFAULT)]
    for scenario in scenarios:
        if not scenario.to_params().initiation.lateral_forces:
            raise CommandFailure(
                f"{scenario.name}: has no lateral force (initiation.lateral_force_N): all members "
                "of the ensemble would be the same"
            )
    if len({scenario.name for scenario in scenarios}) < len(scenarios):
        raise CommandFailure("a scenario is named twice")
    published = load_published()
    spreads = []
    for scenario in scenarios:
        with common.counting_runs(scenario.name) as progress:
            spreads.append(
                s.spread(
                    scenario,
                    members,
                    seed,
                    jobs=jobs,
                    published=published.of_run(scenario.name, scenario.to_params()),
                    accident={} if settings else published.accident(scenario.name),
                    progress=progress,
                )
            )
    return spreads
