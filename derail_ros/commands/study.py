"""``derail study``: run a study, show its findings, write its page."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from derail_ros.commands import common
from derail_ros.commands.common import FAILED, INTERRUPTED, OK, CommandFailure, note
from derail_ros.commands.options import Jobs, Json, Texts, changes, runs, written
from derail_ros.vocabulary.words import count

if TYPE_CHECKING:
    from derail_ros.studies.results import StudyResults


Results = Annotated[Path, typer.Argument(help="Folder with the results of a study.")]


def _need_extra() -> None:
    common.need_extra("derail study", "studies", "pandas", "pyarrow", "scipy", "SALib")


def run(
    name: Annotated[
        str, typer.Argument(metavar="STUDY", help="Name of a shipped study, or a YAML file.")
    ],
    settings: Annotated[Texts, changes("a value of the base scenario")] = None,
    ensemble: Annotated[int | None, runs("Runs per point.", 1)] = None,
    points: Annotated[
        int | None, typer.Option(min=2, help="Points of a sampled design; N of sobol.")
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of the study.")] = None,
    jobs: Jobs = None,
    dask: Annotated[
        str | None, typer.Option(metavar="tcp://...", help="Run on this Dask cluster.")
    ] = None,
    table: Annotated[str, typer.Option(help="Format of the table: parquet or csv.")] = "parquet",
    output: Annotated[
        Path | None, written("Folder for the results; default: runs/study_NAME.")
    ] = None,
    check_only: Annotated[
        bool, typer.Option("--check", help="Check all points and run none.")
    ] = False,
    as_json: Json = False,
) -> int:
    """Run a study, or its missing runs, and print the findings.

    After an interruption the same command goes on from the runs that are finished.
    """
    _need_extra()
    from derail_ros.studies.cluster import ClusterError, on_cluster
    from derail_ros.studies.design import check, make
    from derail_ros.studies.ensemble import default_jobs, run_many
    from derail_ros.studies.plan import load_study
    from derail_ros.studies.results import TABLES, StudyError
    from derail_ros.studies.runner import default_folder, run_study

    if table not in TABLES:
        raise CommandFailure(f"--table: must be parquet or csv, got {table!r}")
    study = load_study(name)
    study = study.changed(ensemble=ensemble, seed=seed, points=points)
    study = study.with_overrides(common.overrides(settings))
    design = make(study)
    where = f"the cluster at {dask}" if dask else count(jobs or default_jobs(), "core")
    if check_only:
        check(design)
        print(f"{study.name}: {design.size()}; every point can be run")
        return OK
    folder = default_folder(study.name) if output is None else output
    note(f"derail: {study.name}: {design.size()}, on {where}, into {folder}")
    if not dask:
        common.warm_up()
    try:
        with common.progress(*common.counting_columns()) as bars:
            tasks: dict[str, Any] = {}

            def show(phase: str, done: int, total: int) -> None:
                if phase not in tasks:
                    words = {"check": "checking the points", "run": study.name}[phase]
                    tasks[phase] = bars.add_task(words, total=total, completed=done)
                    # what an earlier call computed says nothing about the time left
                    return
                bars.update(tasks[phase], completed=done)

            runner = on_cluster(dask) if dask else run_many
            run_study(study, folder, jobs=jobs, table=table, run=runner, progress=show)
    except (StudyError, ClusterError) as error:
        raise CommandFailure(str(error)) from None
    except KeyboardInterrupt:
        raise CommandFailure(
            f"interrupted; finished runs are kept in {folder}; the same command continues",
            INTERRUPTED,
        ) from None
    return _answer(folder, as_json)


def show(results: Results, as_json: Json = False) -> int:
    """Print the results: means with their uncertainty, and sentences."""
    _need_extra()
    return _answer(results, as_json)


def report(results: Results, output: Annotated[Path, written("Folder for the page.")]) -> int:
    """Write a page (HTML) with figures and tables, the figures (PNG) and the tables (CSV)."""
    _need_extra()
    from derail_ros.studies.page import write_report

    found = _results(results)
    with common.refusing(OSError, at=output):
        output.mkdir(parents=True, exist_ok=True)
        page = write_report(found, output)
    print(page)
    return OK


def listing(as_json: Json = False) -> int:
    """List the shipped studies."""
    _need_extra()
    from derail_ros.studies.design import list_studies

    studies = list_studies()
    if as_json:
        keys = ("name", "title", "size")
        rows = [dict(zip(keys, s, strict=True)) for s in studies]
        common.print_json("studies", {"studies": rows})
        return OK
    from derail_ros.studies.tables import Table

    common.print_tables(Table(["name", "title", "size"], [list(s) for s in studies], texts=3))
    return OK


def _results(folder: Path) -> StudyResults:
    from derail_ros.studies.results import StudyError, StudyResults

    with common.refusing(StudyError):
        results = StudyResults(folder)
        if not len(results.table):
            raise StudyError(f"{folder}: no run is finished yet")
    return results


def _answer(folder: Path, as_json: bool) -> int:
    results = _results(folder)
    failed = int((results.table["status"] == "failed").sum())
    if as_json:
        common.print_json("study", answer(results))
    else:
        _print(results)
    if failed:
        row = results.table[results.table["status"] == "failed"].iloc[0]
        note(
            f"derail: {count(failed, 'run')} failed; the first, point {row['point']} member "
            f"{row['member']}: {row['error']}"
        )
    return FAILED if failed == len(results.table) else OK


def answer(results: StudyResults) -> dict[str, Any]:
    """What results say, as plain data."""
    from derail_ros.studies import statistics
    from derail_ros.studies.page import records
    from derail_ros.studies.sentences import statements

    manifest = results.manifest
    return {
        "study": manifest["name"],
        "title": manifest["title"],
        "size": manifest["size"],
        "complete": manifest["complete"],
        "folder": str(results.folder),
        "statements": statements(results),
        "summary": records(statistics.summary(results)),
        "effects": records(statistics.effects(results)),
        "counts": records(statistics.counts(results)),
    }


MOST_POINTS = 60
"""Longest table that is printed whole."""


def _print(results: StudyResults) -> None:
    from rich.markup import escape

    from derail_ros.studies.page import mean_table
    from derail_ros.studies.sentences import findings

    console = common.out()
    console.print(f"[bold]{escape(results.manifest['title'])}[/bold]: {results.manifest['size']}")
    n = len(results.first)
    for measure in results.measures:
        common.print_tables(mean_table(results, measure, MOST_POINTS))
        if n > MOST_POINTS:
            console.print(f"... {n - MOST_POINTS} more points in the table of the results\n")
    for heading, lines in findings(results):
        if heading:
            console.print(f"[bold]{escape(heading)}[/bold]")
        for line in lines:
            console.print(f"- {escape(line)}", soft_wrap=True)
    console.print(f"results in {escape(str(results.folder))}", soft_wrap=True)
