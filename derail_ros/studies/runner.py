"""Runs a study into a folder, continues an interrupted one, writes table and manifest.

The folder holds ``runs.journal`` (each finished run, for going on after an interruption),
``manifest.json`` and, when all runs are there, ``runs.parquet`` or ``runs.csv``: a row for each
point and member in this order. The file has the same bytes however often the study was
interrupted and whatever computed it.
"""

from __future__ import annotations

import datetime
import hashlib
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

from derail_ros.studies.design import Design, check, make, scenario_at
from derail_ros.studies.ensemble import Job, JobResult, Runner, compute, run_many
from derail_ros.studies.journal import Journal, JournalError, Row, failed_row, row_of
from derail_ros.studies.plan import Study
from derail_ros.studies.results import (
    FORMAT,
    MANIFEST,
    TABLES,
    VERSION,
    StudyError,
    read_manifest,
    with_points,
    write_manifest,
    write_table,
)
from derail_ros.studies.study_measures import measure_names, measure_of
from derail_ros.vocabulary.words import count

Progress = Callable[[str, int, int], None]

PACKAGES = ("scipy", "SALib", "pandas", "pyarrow", "distributed")
"""What studies depend on beside the engine."""


def default_folder(name: str) -> Path:
    """Where results of a study go unless another folder is named."""
    return Path("runs") / f"study_{name}"


def study_task(job: Job, stop: Callable[[], bool]) -> Row:
    """Compute a run of a study: its row in the table."""
    return row_of(compute(job, stop), job)


def pending_jobs(design: Design, journal: Journal) -> Iterator[Job]:
    """The runs that are not there yet, point by point; what a point needs is built once."""
    model = design.study.model
    for point in design:
        members = [m for m in range(model.ensemble) if not journal.done[point.index, m]]
        if members:
            params = scenario_at(design, point).to_params()
        for m in members:
            yield Job(
                params, member=m, seed=model.seed, variation=model.variation, key=(point.index, m)
            )


def run_study(
    study: Study,
    folder: str | os.PathLike[str],
    *,
    jobs: int | None = None,
    table: str = "parquet",
    run: Runner = run_many,
    progress: Progress | None = None,
) -> Path:
    """Run a study into a folder; runs that are there already are kept.

    Parameters
    ----------
    study : the study
    folder : of the results; made if it is not there
    jobs : runs at a time, one per core by default
    table : parquet or csv
    run : runner
    progress : called with ``(phase, done, total)``; the phases are ``check`` and ``run``

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    ScenarioError
        The study cannot be run; nothing was written.
    StudyError
        The folder holds something else.
    """
    if table not in TABLES:
        raise ValueError(f"table must be parquet or csv, got {table!r}")
    folder = Path(folder)
    design = make(study)
    points, members = len(design), study.model.ensemble
    tell = progress or (lambda *_: None)
    identity = _identity(check(design, lambda done: tell("check", done, points)))
    before = _prepare(folder, identity, study)
    manifest = _manifest(design, identity, before)
    if before is not None and before["complete"] and (folder / before["table"]["file"]).is_file():
        # the runs are those of this study; its words, measures and figures may be new
        new = {k: manifest[k] for k in ("name", "title", "study", "labels", "measures")}
        write_manifest(folder, before | new)
        return folder

    began = time.monotonic()
    try:
        with Journal(folder, points, members) as journal:
            write_manifest(folder, manifest)
            total = points * members
            tell("run", total - journal.missing, total)
            pending = pending_jobs(design, journal)
            with closing(run(pending, jobs=jobs, task=study_task)) as finished:
                for result in finished:
                    if journal.write(*result.job.key, _row(result)):
                        tell("run", total - journal.missing, total)
            journal.sync()
            if journal.missing:
                raise StudyError(
                    f"{count(journal.missing, 'run')} did not come back; run the study again"
                )
            runs = with_points(design, journal.table())
            manifest |= {
                "wall_s": round(manifest["wall_s"] + time.monotonic() - began, 3),
                "complete": True,
                "finished": _now(),
                "runs_failed": int((runs["status"] == "failed").sum()),
                "runs_void": int((runs["status"] == "void").sum()),
                "table": write_table(runs, folder / TABLES[table]),
            }
            write_manifest(folder, manifest)
            journal.path.unlink()
    except JournalError as error:
        raise StudyError(str(error)) from None
    except OSError as error:  # the disk is full, the folder was taken away
        raise StudyError(f"{folder}: {error.strerror or error}") from None
    return folder


def _row(result: JobResult) -> Row:
    return result.value if result.error is None else failed_row(result.error, result.job)


def _identity(runs: str) -> str:
    """What the results depend on: the runs, and the physics that computes them."""
    from derail_ros.models import engine_hash

    return hashlib.sha256(f"{runs} {engine_hash()} {VERSION}".encode()).hexdigest()


SIZE = ("ensemble", "points", "seed")
"""What makes another set of runs of the same study."""

RUNS = ("overrides", "design", "variation", "parameters", "columns", "cases")
"""What the runs are."""


def _difference(manifest: Mapping[str, Any], study: Study) -> str:
    """How the study whose results are in a folder differs from ``study``, in words."""
    ours = study.model.model_dump(mode="json")
    try:
        theirs = type(study.model).model_validate(manifest["study"]).model_dump(mode="json")
    except ValueError:
        return "another study"
    same = manifest["scenario_hash"] == study.scenario.hash
    sizes = [key for key in SIZE if ours[key] != theirs[key]]
    if not sizes or not same or any(ours[key] != theirs[key] for key in RUNS):
        return "another study"
    words = ", ".join(f"{key} {theirs[key]} where {ours[key]} is asked for" for key in sizes)
    return f"this study with {words}"


def _prepare(folder: Path, identity: str, study: Study) -> dict[str, Any] | None:
    """Make the folder; the manifest of the same study, if that is in it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        files = {p.name for p in folder.iterdir()}
    except OSError as error:
        raise StudyError(f"{folder}: {error.strerror or error}") from None
    if not files:
        return None
    if MANIFEST not in files:
        raise StudyError(f"{folder}: is not empty; choose another folder or empty it")
    manifest = read_manifest(folder)
    if manifest["identity"] != identity:
        from derail_ros.models import engine_hash

        same = manifest["software"].get("engine_hash") == engine_hash()
        reason = _difference(manifest, study) if same else "another version of the engine"
        raise StudyError(f"{folder}: holds results of {reason}; choose another folder")
    return manifest


def _manifest(design: Design, identity: str, before: Mapping[str, Any] | None) -> dict[str, Any]:
    from derail_ros.recording.manifest import software_versions

    study = design.study
    return {
        "format": FORMAT,
        "version": VERSION,
        "name": study.name,
        "title": study.model.title,
        "identity": identity,
        "complete": False,
        "study": study.model.model_dump(mode="json", exclude_defaults=True) | {"version": 1},
        "scenario_name": study.scenario.name,
        "scenario_hash": study.scenario.hash,
        "scenario": study.scenario.resolved(),
        "size": design.size(),
        "points": len(design),
        "ensemble": study.model.ensemble,
        "runs": design.runs,
        "seed": study.model.seed,
        "variation": study.model.variation,
        "columns": list(design.columns),
        "labels": {name: study.label(name) for name in design.columns},
        "measures": {key: measure_of(key).title for key in measure_names()},
        "software": software_versions(*PACKAGES),
        "started": before["started"] if before else _now(),
        "wall_s": before["wall_s"] if before else 0.0,
    }


def _now() -> str:
    return datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds")
