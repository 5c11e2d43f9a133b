"""The commands that test the model: validate, sensitivity, spread, convergence."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

import typer

from derail_ros.commands import common
from derail_ros.commands.common import FAILED, OK, CommandFailure
from derail_ros.commands.options import Jobs, Json, ScenarioNames, Seed, Texts, changes, runs

if TYPE_CHECKING:
    from derail_ros.studies.spread import Spread


def validate(
    members: Annotated[int, runs("Runs per case.")] = 20,
    seed: Seed = 0,
    jobs: Jobs = None,
    settings: Annotated[Texts, changes("a value in all cases")] = None,
    numerics: Annotated[
        str,
        typer.Option(
            help="shipped, or source: RKF45, Baumgarte stabilization, tests at ends of steps."
        ),
    ] = "shipped",
    as_json: Json = False,
) -> int:
    """Compare ensembles with the published runs."""
    from derail_ros.studies import validation as v
    from derail_ros.studies.records import with_status

    if numerics not in v.NUMERICS:
        known = " or ".join(v.NUMERICS)
        raise CommandFailure(f"--numerics must be {known}, got {numerics!r}")
    overrides = common.overrides(settings)
    with common.counting_runs("validate") as progress:
        result = v.validate(
            members, seed, settings=overrides, numerics=numerics, jobs=jobs, progress=progress
        )
    if as_json:
        common.print_json("validation", result.as_dict())
    else:
        doubt = [v.doubt_table(result)] if result.doubtful else []
        said = [v.pair_table(result), v.statement_table(result), v.goal_table(result)]
        common.print_tables(*v.measure_tables(result), *said, *doubt)
    return common.exit_code(*with_status(result.ensembles))


def sensitivity(
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

    with common.refusing(ValueError):
        s.choose_cases(load_published(), cases or [])
        s.choose_constants(constants or [])
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


def spread(
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


def convergence(
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
    common.need_extra("derail convergence", "studies", "scipy")
    from derail_ros.studies import convergence as c

    rtols = sorted(set(tolerances or c.TOLERANCES), reverse=True)
    if len(rtols) < 2:
        raise CommandFailure("--rtol: must name at least two tolerances")
    for rtol in rtols:
        if not 1e-12 <= rtol <= 0.1:
            raise CommandFailure(f"--rtol: must be 1e-12 to 0.1, got {rtol:g}")
    studies = []
    for scenario in [common.load(name) for name in (names or c.SCENARIOS)]:
        with (
            common.refusing(RuntimeError, at=scenario.name, code=FAILED),
            common.counting_runs(scenario.name) as progress,
        ):
            studies.append(
                c.convergence(
                    scenario, members, seed, tolerances=rtols, jobs=jobs, progress=progress
                )
            )
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
