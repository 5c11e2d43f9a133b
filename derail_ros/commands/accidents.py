"""``derail accidents``: reported accidents, and the models on the same trains."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from derail_ros.commands import common
from derail_ros.commands.common import FAILED, OK, CommandFailure, note
from derail_ros.commands.models import known_model
from derail_ros.commands.options import Jobs, Json, Texts, changes, of_model
from derail_ros.vocabulary.words import capital, count, finite

if TYPE_CHECKING:
    from derail_ros.baselines.reenact import Counts, Way
    from derail_ros.studies.accidents import Group, Report, SpeedClass, Statistics
    from derail_ros.studies.tables import Table


def run(
    reports: Annotated[
        list[Path] | None,
        typer.Argument(help="Accident reports (CSV, FRA form 54); default: shipped averages."),
    ] = None,
    broken_rail: Annotated[
        bool, typer.Option("--broken-rail", help="Only reports whose cause is a broken rail.")
    ] = False,
    causes: Annotated[
        Texts, typer.Option("--cause", help="Only this cause code, e.g. T207.")
    ] = None,
    behind: Annotated[
        int, typer.Option(min=1, help="Only trains with this many cars behind the first derailed.")
    ] = 1,
    loaded: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Only trains with this share of loaded cars.")
    ] = 0.0,
    models: Annotated[
        Texts, of_model("Run this model on the trains (without files: on their mean trains).")
    ] = None,
    settings: Annotated[Texts, changes("the base train, e.g. brakes.delay_s=10")] = None,
    report: Annotated[
        str | None,
        typer.Option(metavar="NUMBER", help="Print the train of this report as a scenario."),
    ] = None,
    most: Annotated[
        int, typer.Option(min=1, help="Most trains to run in a class of speed.")
    ] = 100,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the choice of trains.")] = 0,
    jobs: Jobs = None,
    as_json: Json = False,
) -> int:
    """Show the cars derailed in reported accidents; run models on the same trains."""
    from derail_ros.baselines.reenact import mean_report, sample
    from derail_ros.studies.accidents import (
        BROKEN_RAIL,
        CLASSES_TEXT,
        Group,
        by_speed,
        load_statistics,
    )

    if broken_rail and causes:
        raise CommandFailure("--broken-rail and --cause: give one of them")
    if "" in (causes or []):
        raise CommandFailure("--cause: is empty")
    chosen = BROKEN_RAIL if broken_rail else tuple(c.upper() for c in causes or [])
    group = Group(chosen, behind, loaded)
    paths, settings = reports or [], settings or []
    if report is not None:
        if group != Group() or models or as_json:
            raise CommandFailure("--report: takes no other option than --set")
        return _print_scenario(paths, report, settings)
    if settings and not models:
        raise CommandFailure("--set: changes the trains that --model runs; name a model")
    names = [known_model(name) for name in models or []]
    if not paths:
        statistics = load_statistics()
        if names:
            classes = _with_mass(statistics, group)
            trains = [mean_report(c) for c in classes]
            return _run_models(trains, classes, group, names, settings, jobs, as_json)
        if group != Group():
            raise CommandFailure(
                "options that choose reports need files of reports (docs/accidents.md says where "
                "to get them)"
            )
        return _shipped(statistics, as_json)
    found = [r for r in read(paths) if r in group]
    files = ", ".join(map(str, paths))
    if not found:
        raise CommandFailure(f"{files}: no freight train derailed on main track: {group.words}")
    classes = by_speed(found)
    if not classes:
        raise CommandFailure(f"{files}: no report of a speed of {CLASSES_TEXT}: {group.words}")
    if names:
        trains = sample(found, most, seed)
        if not trains:
            raise CommandFailure(f"{files}: no report has a plausible weight: {group.words}")
        return _run_models(trains, (), group, names, settings, jobs, as_json)
    outside = len(found) - sum(c.reports for c in classes)
    if as_json:
        common.print_json(
            "accidents",
            {"group": group.words, "reports": len(found), "outside": outside,
             "classes": [asdict(c) for c in classes]}
        )  # fmt: skip
    else:
        common.print_tables(_class_table(group, classes, outside))
    return OK


def read(paths: Sequence[Path]) -> list[Report]:
    """Read reports; a file that cannot be read ends the command with one line."""
    from derail_ros.studies.accidents import AccidentFileError, read_reports

    with common.refusing(AccidentFileError):
        return read_reports(paths)


def _print_scenario(paths: Sequence[Path], number: str, settings: Sequence[str]) -> int:
    """Print the train of a report as a scenario."""
    from derail_ros.baselines.reenact import real_base_train, told_scenario

    if not paths:
        raise CommandFailure("--report: name the files of the reports")
    found = [r for r in read(paths) if r.number.casefold() == number.strip().casefold()]
    if len(found) != 1:
        where = ", ".join(f"{r.railroad} {r.year}, {count(r.cars, 'car')}" for r in found)
        raise CommandFailure(
            f"--report: {len(found)} freight trains derailed on main track have the number "
            f"{number!r}" + (f": {where}" if found else "")
        )
    _ways([], settings)
    with common.refusing(ValueError, at="--report"):
        scenario = told_scenario(real_base_train(common.overrides(settings)), found[0])
    print(scenario.to_yaml(), end="")
    return OK


def _ways(models: Sequence[str], settings: Sequence[str]) -> list[Way]:
    """Each model with these settings; a mistake in them is reported before the first run."""
    from derail_ros.baselines.reenact import GIVEN, Way, real_base_train

    overrides = common.overrides(settings)
    for path in overrides:
        if any(given == path or given.startswith(f"{path}.") for given in GIVEN):
            raise CommandFailure(f"--set: {path} is given by each report")
    real_base_train(overrides)
    return [Way(name, name, overrides) for name in dict.fromkeys(models)]


def _run_models(
    trains: Sequence[Report],
    classes: Sequence[SpeedClass],
    group: Group,
    models: Sequence[str],
    settings: list[str],
    jobs: int | None,
    as_json: bool,
) -> int:
    """Run trains of reports, or the mean trains of ``classes``; the exit code."""
    from derail_ros.baselines.reenact import failed_runs, reenact
    from derail_ros.vocabulary.errors import ParameterError

    ways = _ways(models, settings)
    with (
        common.refusing(ParameterError, at="base_train"),
        common.counting_runs("accidents") as progress,
    ):
        counts = reenact(trains, ways, jobs=jobs, progress=progress)
    if as_json:
        found = _mean_trains(trains, classes, counts) if classes else _agreement(trains, counts)
        common.print_json("accidents", {"group": group.words, "settings": settings, **found})
    else:
        what = "of mean trains" if classes else f"means of {count(len(trains), 'train')}"
        tables = _tables(trains, classes, counts)
        title = ", ".join([f"Cars derailed, {what}: {group.words}", *settings])
        common.print_tables(replace(tables[0], title=title), *tables[1:])
    failed = failed_runs(counts)
    if failed:
        note(f"derail: {count(failed, 'run')} failed")
    return FAILED if failed else OK


def _tables(
    trains: Sequence[Report], classes: Sequence[SpeedClass], counts: Counts
) -> list[Table]:
    from derail_ros.baselines import reenact as r
    from derail_ros.studies.tables import Table

    if not classes:
        return [r.averages_table(trains, counts), r.agreement_table(trains, counts)]
    rows = []
    for k, (c, t) in enumerate(zip(classes, trains, strict=True)):
        numbers = [f"{t.speed_kmh:.0f}", str(t.cars), f"{(t.mass_kg or 0.0) * 1e-3:.0f}"]
        reported = [str(c.reports), str(r.MeanCount(c.mean, c.error))]
        theirs = ["-" if v[k] is None else f"{v[k]:.0f}" for v in counts.values()]
        rows.append([*numbers, *reported, *theirs])
    heads = ["speed, km/h", "cars", "t a car", "reports", "reported", *counts]
    return [Table(heads, rows, texts=0)]


def _mean_trains(
    trains: Sequence[Report], classes: Sequence[SpeedClass], counts: Counts
) -> dict[str, Any]:
    """The counts of mean trains, for JSON."""
    rows = [
        {
            "cars": t.cars,
            "mass_kg": t.mass_kg,
            "speed_kmh": t.speed_kmh,
            "reported": {"mean": c.mean, "error": c.error, "reports": c.reports},
            "models": {label: values[k] for label, values in counts.items()},
        }
        for k, (c, t) in enumerate(zip(classes, trains, strict=True))
    ]
    return {"mean_trains": rows}


def _agreement(trains: Sequence[Report], counts: Counts) -> dict[str, Any]:
    """How counts of single trains agree with the reported ones, for JSON."""
    from derail_ros.baselines import reenact as r

    classes = [
        {
            "trains": n,
            "speed_kmh": speed,
            "reported": {"mean": own.mean, "error": own.error},
            "models": {label: _plain(c) for label, c in means.items()},
        }
        for n, speed, own, means in r.averages(trains, counts)
    ]
    return {
        "classes": classes,
        "agreement": {label: _plain(r.agreement(trains, v)) for label, v in counts.items()},
        "class_mean": _plain(r.agreement(trains, r.means_of_classes(trains))),
        "rank_speed": finite(r.rank_correlation(trains, [t.speed_kmh for t in trains])),
    }


def _plain(value: Any) -> dict[str, float | int | None]:
    """Of a dataclass of numbers, for JSON."""
    return {
        key: None if isinstance(x, float) and math.isnan(x) else x
        for key, x in asdict(value).items()
    }


def _with_mass(statistics: Statistics, group: Group) -> list[SpeedClass]:
    """The shipped averages of a group of which a mass is known."""
    from derail_ros.studies.accidents import GROUPS

    for name, known in GROUPS.items():
        if known == group:
            return [c for c in statistics.groups[name] if c.mass_kg is not None]
    raise CommandFailure(
        f"no averages are shipped for: {group.words}. There are: "
        f"{'; '.join(g.words for g in GROUPS.values())}. For others, name files of reports"
    )


def _shipped(statistics: Statistics, as_json: bool) -> int:
    from derail_ros.studies.accidents import GROUPS

    if as_json:
        common.print_json("accidents", statistics.as_dict())
        return OK
    first, last = statistics.years
    common.out().print(
        "Freight cars derailed of freight trains derailed on main track in the United States, "
        f"{first} to {last}.\n{statistics.source}.\n",
        soft_wrap=True,
    )
    common.print_tables(*(_class_table(GROUPS[n], c) for n, c in statistics.groups.items()))
    return OK


def _class_table(group: Group, classes: Sequence[SpeedClass], outside: int = 0) -> Table:
    from derail_ros.studies.tables import Table

    title = f"{group.words}: {count(sum(c.reports for c in classes), 'report')}"
    if outside:
        title += f", and {outside} of other speeds"
    rows = [
        [f"{c.low_kmh:.0f} to {c.high_kmh:.0f}", str(c.reports), f"{c.mean:.1f}",
         f"{c.error:.1f}" if c.reports > 1 else "-", f"{c.median:.0f}", f"{c.q90:.0f}"]
        for c in classes
    ]  # fmt: skip
    heads = ["speed, km/h", "reports", "cars, mean", "its error", "median", "90 %"]
    return Table(heads, rows, capital(title), texts=0)
