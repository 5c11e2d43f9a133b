"""``derail accidents``: reported accidents, and the models on the same trains."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from derail_ros.commands import common
from derail_ros.commands.common import FAILED, OK, CommandFailure, note
from derail_ros.vocabulary.words import count

if TYPE_CHECKING:
    from derail_ros.baselines.reenact import Way
    from derail_ros.studies.accidents import Group, Report, SpeedClass, Statistics


@dataclass(frozen=True)
class Chosen:
    """Which reports, as the options say."""

    broken_rail: bool = False
    causes: tuple[str, ...] = ()
    behind: int = 1
    loaded: float = 0.0

    def group(self) -> Group:
        """As a group of reports."""
        from derail_ros.studies.accidents import BROKEN_RAIL, Group

        if self.broken_rail and self.causes:
            raise CommandFailure("--broken-rail and --cause: give one of them")
        if "" in self.causes:
            raise CommandFailure("--cause: is empty")
        causes = BROKEN_RAIL if self.broken_rail else tuple(c.upper() for c in self.causes)
        return Group(causes, self.behind, self.loaded)


def read(paths: Sequence[Path]) -> list[Report]:
    """Read reports; a file that cannot be read ends the command with one line."""
    from derail_ros.studies.accidents import AccidentFileError, read_reports

    try:
        return read_reports(paths)
    except AccidentFileError as error:
        raise CommandFailure(str(error)) from None


def run(
    paths: Sequence[Path],
    chosen: Chosen,
    models: Sequence[str],
    settings: Sequence[str],
    most: int,
    seed: int,
    jobs: int | None,
    as_json: bool,
) -> int:
    """Print averages of reports, and of the models if asked; the exit code."""
    from derail_ros.studies.accidents import CLASSES_TEXT, by_speed, load_statistics

    group = chosen.group()
    if settings and not models:
        raise CommandFailure("--set: is for the trains that --model runs")
    from derail_ros.commands.models import _check_model

    for name in models:
        _check_model(name)
    if not paths:
        statistics = load_statistics()
        if models:
            return _run_mean_trains(statistics, group, models, settings, jobs, as_json)
        if chosen != Chosen():
            raise CommandFailure(
                "choosing reports needs the reports: name their files (docs/accidents.md says "
                "where to get them)"
            )
        return _shipped(statistics, as_json)
    reports = [r for r in read(paths) if r in group]
    names = ", ".join(map(str, paths))
    if not reports:
        raise CommandFailure(f"{names}: no freight train derailed on main track: {group.words}")
    classes = by_speed(reports)
    if not classes:
        raise CommandFailure(f"{names}: no report of a speed of {CLASSES_TEXT}: {group.words}")
    if models:
        from derail_ros.baselines.reenact import sample

        trains = sample(reports, most, seed)
        if not trains:
            raise CommandFailure(
                f"{names}: no report has a weight that can be right: {group.words}"
            )
        return _run_models(trains, group, models, settings, jobs, as_json)
    outside = len(reports) - sum(c.reports for c in classes)
    if as_json:
        common.print_json(
            {"group": group.words, "reports": len(reports), "outside": outside,
             "classes": [asdict(c) for c in classes]}
        )  # fmt: skip
        return OK
    _print_classes(group, classes, outside)
    return OK


def print_scenario(paths: Sequence[Path], number: str, settings: Sequence[str], more: bool) -> int:
    """Print the train of a report as a scenario; the exit code."""
    from derail_ros.baselines.reenact import told_scenario

    if more:
        raise CommandFailure("--report: prints a scenario, with no other choice than --set")
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
    try:
        scenario = told_scenario(common.load("base_train", settings), found[0])
    except ValueError as error:
        raise CommandFailure(f"--report: {error}") from None
    print(scenario.to_yaml(), end="")
    return OK


def _ways(models: Sequence[str], settings: Sequence[str]) -> list[Way]:
    """Each model with these settings; a mistake in them is told here, before the first run."""
    from derail_ros.baselines.reenact import GIVEN, Way
    from derail_ros.scenario import parse_set

    overrides = dict(parse_set(text) for text in settings)
    for path in overrides:
        if any(given == path or given.startswith(f"{path}.") for given in GIVEN):
            raise CommandFailure(f"--set: {path}: is that of each report")
    common.load("base_train", settings)
    return [Way(name, name, overrides) for name in dict.fromkeys(models)]


def _run_models(
    trains: Sequence[Report],
    group: Group,
    models: Sequence[str],
    settings: Sequence[str],
    jobs: int | None,
    as_json: bool,
) -> int:
    from derail_ros.baselines import reenact as r
    from derail_ros.vocabulary.errors import ParameterError

    ways = _ways(models, settings)
    common.warm_up()
    with common.progress(*common.counting_columns()) as bars:
        task = bars.add_task("accidents", total=len(trains) * len(ways))
        try:
            counts = r.reenact(
                trains, ways, jobs=jobs,
                progress=lambda done, _total: bars.update(task, completed=done),
            )  # fmt: skip
        except ParameterError as error:
            raise CommandFailure(f"base_train: {error}") from None
    rows = r.averages(trains, counts)
    speeds = [train.speed_kmh for train in trains]
    failed = sum(value is None for values in counts.values() for value in values)
    if as_json:
        common.print_json(
            {
                "group": group.words,
                "settings": list(settings),
                "classes": [
                    {
                        "trains": n,
                        "speed_kmh": speed,
                        "reported": {"mean": own.mean, "error": own.error},
                        "models": {label: _plain(c) for label, c in cells.items()},
                    }
                    for n, speed, own, cells in rows
                ],
                "agreement": {
                    label: _plain(r.agreement(trains, values)) for label, values in counts.items()
                },
                "class_mean": _plain(r.agreement(trains, r.means_of_classes(trains))),
                "rank_speed": _or_none(r.rank_correlation(trains, speeds)),
            }
        )
    else:
        _print_models(group, settings, rows, trains, counts)
    if failed:
        note(f"derail: {count(failed, 'run')} failed")
    return FAILED if failed else OK


def _run_mean_trains(
    statistics: Statistics,
    group: Group,
    models: Sequence[str],
    settings: Sequence[str],
    jobs: int | None,
    as_json: bool,
) -> int:
    """Run the mean trains of the shipped averages."""
    from rich.table import Table

    from derail_ros.baselines import reenact as r
    from derail_ros.studies.accidents import GROUPS

    name = next((name for name, known in GROUPS.items() if known == group), None)
    if name is None:
        raise CommandFailure(
            f"there are no averages of: {group.words}; there are those of: "
            f"{'; '.join(g.words for g in GROUPS.values())}. For others name the files of reports"
        )
    ways = _ways(models, settings)
    classes = [c for c in statistics.groups[name] if c.mass_kg is not None]
    trains = [r.mean_report(c) for c in classes]
    common.warm_up()
    counts = r.reenact(trains, ways, jobs=jobs)
    failed = sum(value is None for values in counts.values() for value in values)
    if as_json:
        common.print_json(
            {
                "group": group.words,
                "settings": list(settings),
                "mean_trains": [
                    {"cars": t.cars, "mass_kg": t.mass_kg, "speed_kmh": t.speed_kmh,
                     "reported": {"mean": c.mean, "error": c.error, "reports": c.reports},
                     "models": {label: values[k] for label, values in counts.items()}}
                    for k, (c, t) in enumerate(zip(classes, trains, strict=True))
                ],
            }
        )  # fmt: skip
        return FAILED if failed else OK
    console = common.out()
    words = f", {', '.join(settings)}" if settings else ""
    console.print(f"Cars derailed of mean trains: {group.words}{words}", soft_wrap=True)
    table = Table(box=None, pad_edge=False)
    for heading in ("speed, km/h", "cars", "t a car", "reports", "reported", *counts):
        table.add_column(heading, justify="right")
    for k, (c, t) in enumerate(zip(classes, trains, strict=True)):
        table.add_row(
            f"{t.speed_kmh:.0f}", str(t.cars), f"{(t.mass_kg or 0.0) * 1e-3:.0f}",
            str(c.reports), r.with_error(c.mean, c.error),
            *("-" if v is None else f"{v:.0f}" for v in (values[k] for values in counts.values())),
        )  # fmt: skip
    console.print(table)
    if failed:
        note(f"derail: {count(failed, 'run')} failed")
    return FAILED if failed else OK


def _print_models(
    group: Group,
    settings: Sequence[str],
    rows: Sequence[Any],
    trains: Sequence[Report],
    counts: Any,
) -> None:
    from rich.table import Table

    from derail_ros.baselines import reenact as r

    console = common.out()
    words = f", {', '.join(settings)}" if settings else ""
    title = f"Cars derailed, means of {count(len(trains), 'train')}: {group.words}{words}"
    console.print(title, soft_wrap=True)
    table = Table(box=None, pad_edge=False)
    for heading in ("speed, km/h", "trains", "reported", *counts):
        table.add_column(heading, justify="right")
    for n, speed, own, cells in rows:
        table.add_row(
            f"{speed:.0f}", str(n), r.with_error(own.mean, own.error),
            *(r.with_error(c.mean, c.error) for c in cells.values()),
        )  # fmt: skip
    console.print(table)
    console.print()
    table = Table(box=None, pad_edge=False)
    for heading in r.AGREEMENT:
        table.add_column(heading, justify="right" if heading else "left")
    for row in r.agreement_rows(trains, counts):
        table.add_row(*row)
    console.print(table)


def _or_none(value: float) -> float | None:
    return None if math.isnan(value) else value


def _plain(value: Any) -> dict[str, float | None]:
    """Of a dataclass of numbers, for JSON."""
    return {key: _or_none(x) for key, x in asdict(value).items()}


def _shipped(statistics: Any, as_json: bool) -> int:
    from derail_ros.studies.accidents import GROUPS

    if as_json:
        common.print_json(statistics.as_dict())
        return OK
    first, last = statistics.years
    common.out().print(
        "Freight cars derailed of freight trains derailed on main track in the United States, "
        f"{first} to {last}.\n{statistics.source}.\n",
        soft_wrap=True,
    )
    for name, classes in statistics.groups.items():
        _print_classes(GROUPS[name], classes)
    return OK


def _print_classes(group: Group, classes: Sequence[SpeedClass], outside: int = 0) -> None:
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for heading in ("speed, km/h", "reports", "cars, mean", "its error", "median", "90 %"):
        table.add_column(heading, justify="right")
    for c in classes:
        table.add_row(
            f"{c.low_kmh:.0f} to {c.high_kmh:.0f}", str(c.reports), f"{c.mean:.1f}",
            f"{c.error:.1f}" if c.reports > 1 else "-", f"{c.median:.0f}", f"{c.q90:.0f}",
        )  # fmt: skip
    console = common.out()
    title = f"{group.words}: {count(sum(c.reports for c in classes), 'report')}"
    if outside:
        title += f", and {outside} of other speeds"
    console.print(title[0].upper() + title[1:], soft_wrap=True)
    console.print(table)
    console.print()


def write_page(paths: Sequence[Path], page: Path, seed: int, jobs: int | None, more: bool) -> int:
    """Run what ``docs/accidents.md`` shows; write it, its figures and the shipped averages."""
    from derail_ros.baselines import reenact as r
    from derail_ros.baselines.page import fill, missing_markers
    from derail_ros.models import engine_hash
    from derail_ros.review import drawing
    from derail_ros.studies import accidents as a

    if more:
        raise CommandFailure("--write is for the page's own cases, without other choices")
    if not paths:
        raise CommandFailure("--write: name the files of the reports")
    images = common.image_beside(page, "accidents.png").parent
    if not page.is_file():
        raise CommandFailure(f"{page}: there is no such page")
    text = page.read_text(encoding="utf-8")
    if missing := missing_markers(text, r.NAMES):
        raise CommandFailure(f"{page}: has no place for the results {', '.join(missing)}")
    reports = read(paths)
    common.warm_up()
    plan = r.Plan()
    with common.progress(*common.counting_columns()) as bars:
        task = bars.add_task("accidents", total=None)
        try:
            results = r.compute(
                reports, plan, seed, jobs=jobs,
                progress=lambda done, total: bars.update(task, completed=done, total=total),
            )  # fmt: skip
        except ValueError as error:
            raise CommandFailure(f"{', '.join(map(str, paths))}: {error}") from None
    first, last = results.statistics.years
    outside = len(reports) - sum(c.reports for c in results.statistics.groups["all"])
    about = (
        f"<sub>`derail accidents FILES --write` with the {len(paths)} files of {first} to {last}: "
        f"{len(reports)} freight trains derailed on main track, {outside} of them at speeds "
        f"outside {a.CLASSES_TEXT}, which are in no table. One run a train and model, no "
        f"ensemble; of all causes at most {plan.every} trains of a class of speed, drawn with "
        f"seed {seed}. Mean ± its standard error. Engine {engine_hash()[:16]}.</sub>"
    )
    for name, figure in r.figures(results).items():
        drawing.save(figure, images / name, dpi=common.IMAGE_DPI)
    page.write_text(fill(text, r.blocks(results, about)), encoding="utf-8")
    shipped = Path(a.__file__).parent / "data" / a.SHIPPED
    try:
        shipped.write_text(a.statistics_yaml(results.statistics), encoding="utf-8")
    except OSError as error:
        raise CommandFailure(f"{shipped}: {error.strerror or error}") from None
    note(f"derail: wrote {page}, its figures in {images}, and {shipped}")
    failed = sum(
        value is None
        for counts in (results.counts, results.every_counts)
        for values in counts.values()
        for value in values
    )
    if failed:
        note(f"derail: {count(failed, 'run')} failed")
    return FAILED if failed else OK
