"""Running a study: into a folder, from where it was left, to a table and a manifest.

The folder holds ``runs.journal`` (each finished run, for going on after an interruption),
``manifest.json`` and, when all runs are there, ``runs.parquet`` or ``runs.csv``: a row for each
point and member in this order, the same bytes however often the study was interrupted and
whatever computed it.
"""

from __future__ import annotations

import datetime
import hashlib
import json
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from derail_ros.studies.design import Design, Point, check, make, scenario_at
from derail_ros.studies.ensemble import Result, Run, compute, member_factor, run_many
from derail_ros.studies.journal import Journal, JournalError, Results
from derail_ros.studies.measures import FIELDS, MEASURES, TEXTS, Row, failed_row, row
from derail_ros.studies.plan import Study
from derail_ros.vocabulary.words import count

if TYPE_CHECKING:
    import pandas

FORMAT = "derail_ros/study"
VERSION = 1
MANIFEST = "manifest.json"
TABLES = {"parquet": "runs.parquet", "csv": "runs.csv"}

Runner = Callable[..., Iterator[Result]]
Progress = Callable[[str, int, int], None]


class StudyError(Exception):
    """A study could not be run or read; the message is one line."""


def study_task(run: Run, stop: Callable[[], bool]) -> Row:
    """Compute a run of a study: its row in the table."""
    params = run.params()
    outcome = compute(Run(params), stop)
    return row(outcome, params, member_factor(run.seed, run.member, run.variation))


def pending_runs(design: Design, results: Results) -> Iterator[Run]:
    """The runs that are not there yet, point by point; what a point needs is built once."""
    model = design.study.model
    for index in range(len(design)):
        members = [m for m in range(model.ensemble) if not results.has(index, m)]
        if not members:
            continue
        params = scenario_at(design, design.point(index)).to_params()
        for member in members:
            yield Run(
                params,
                member=member,
                seed=model.seed,
                variation=model.variation,
                key=(index, member),
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
    """Run a study into a folder, or what is missing of it there.

    Parameters
    ----------
    study : the study
    folder : of the results; made if it is not there
    jobs : runs at a time, one per core by default
    table : parquet or csv
    run : what runs the runs: :func:`derail_ros.studies.ensemble.run_many` or another like it
    progress : told ``(phase, done, total)``; the phases are ``check`` and ``run``

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
        raise ValueError(f"table: must be parquet or csv, not {table!r}")
    folder = Path(folder)
    design = make(study)
    total = len(design)
    tell = None if progress is None else (lambda done: progress("check", done, total))
    identity = _identity(check(design, tell))
    before = _prepare(folder, identity, study)
    if before is not None and before["complete"] and (folder / before["table"]["file"]).is_file():
        # the runs are those of this study; its words, measures and figures may be new
        now = _manifest(design, identity, before)
        words = {k: now[k] for k in ("name", "title", "study", "labels", "measures")}
        _write_manifest(folder, before | words)
        return folder

    manifest = _manifest(design, identity, before)
    results = Results(total, study.model.ensemble)
    began = time.monotonic()
    try:
        with Journal(folder, results) as journal:
            _write_manifest(folder, manifest)
            if progress is not None:
                progress("run", len(results) - results.missing, len(results))
            done = len(results) - results.missing
            pending = pending_runs(design, results)
            with closing(run(pending, jobs=jobs, task=study_task)) as finished:
                for result in finished:
                    point, member = result.run.key
                    if journal.write(point, member, _row(result)):
                        done += 1
                        if progress is not None:
                            progress("run", done, len(results))
            journal.sync()
            if results.missing:
                raise StudyError(
                    f"{count(results.missing, 'run')} did not come back; run it again"
                )
            path = folder / TABLES[table]
            write_table(frame(design, results), path)
            manifest["wall_s"] = round(manifest["wall_s"] + time.monotonic() - began, 3)
            manifest |= {
                "complete": True,
                "finished": _now(),
                "runs_failed": results.count("failed"),
                "runs_void": results.count("void"),
                "table": {
                    "file": path.name,
                    "rows": len(results),
                    "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
                },
            }
            _write_manifest(folder, manifest)
            journal.path.unlink()
    except JournalError as error:
        raise StudyError(str(error)) from None
    except OSError as error:  # the disk is full, the folder was taken away
        raise StudyError(f"{folder}: {error.strerror or error}") from None
    return folder


def _row(result: Result) -> Row:
    if result.error is None:
        return result.value
    run = result.run
    return failed_row(result.error, member_factor(run.seed, run.member, run.variation))


def _identity(runs: str) -> str:
    """What the results depend on: the runs, and the physics that computes them."""
    from derail_ros.models import engine_hash

    return hashlib.sha256(f"{runs} {engine_hash()} {VERSION}".encode()).hexdigest()


SIZE = ("ensemble", "points", "seed")
"""What makes another set of runs of the same study."""

RUNS = ("overrides", "design", "variation", "parameters", "columns", "cases")
"""What the runs are."""


def _difference(manifest: Mapping[str, Any], study: Study) -> str:
    """What the results in a folder are of, seen from a study that they are not of."""
    ours = study.model.model_dump(mode="json")
    try:
        there = type(study.model).model_validate_json(json.dumps(manifest["study"]))
    except ValueError:
        return "another study"
    theirs = there.model_dump(mode="json")
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
        names = sorted(p.name for p in folder.iterdir())
    except OSError as error:
        raise StudyError(f"{folder}: {error.strerror or error}") from None
    if not names:
        return None
    if MANIFEST not in names:
        raise StudyError(f"{folder}: is not empty; choose another folder or empty it")
    manifest = read_manifest(folder)
    if manifest["identity"] != identity:
        from derail_ros.models import engine_hash

        ours = manifest["software"].get("engine_hash") == engine_hash()
        reason = _difference(manifest, study) if ours else "another version of the engine"
        raise StudyError(f"{folder}: holds results of {reason}; choose another folder")
    return manifest


def read_manifest(folder: str | os.PathLike[str]) -> dict[str, Any]:
    """The manifest of a folder of results.

    Raises
    ------
    StudyError
        If there is none that this version reads.
    """
    path = Path(folder) / MANIFEST
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise StudyError(f"{path}: {error.strerror or error}") from None
    except ValueError:
        raise StudyError(f"{path}: is not the manifest of a study") from None
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise StudyError(f"{path}: is not the manifest of a study")
    if data.get("version") != VERSION:
        raise StudyError(f"{path}: has version {data.get('version')}, {VERSION} is read here")
    return data


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
        "measures": {key: m.title for key, m in MEASURES.items()},
        "software": software_versions() | _study_packages(),
        "started": before["started"] if before else _now(),
        "wall_s": before["wall_s"] if before else 0.0,
    }


def _study_packages() -> dict[str, str]:
    import importlib.metadata

    found = {}
    for package in ("scipy", "SALib", "pandas", "pyarrow", "distributed"):
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def _now() -> str:
    return datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds")


def _write_manifest(folder: Path, manifest: Mapping[str, Any]) -> None:
    """Write it whole or not at all."""
    text = json.dumps(manifest, allow_nan=False, ensure_ascii=False, indent=1)
    draft = folder / f"{MANIFEST}.new"
    draft.write_text(text + "\n", encoding="utf-8")
    draft.replace(folder / MANIFEST)


# --- the table --------------------------------------------------------------------------------


def frame(design: Design, results: Results) -> pandas.DataFrame:
    """The tidy table: a row a run, in the order of points and members."""
    import numpy as np
    import pandas as pd

    members = design.study.model.ensemble
    columns: dict[str, Any] = {
        "point": np.repeat(np.arange(len(design)), members),
        "member": np.tile(np.arange(members), len(design)),
    }
    points = [_short(design.point(i)) for i in range(len(design))]
    if design.study.model.design == "one_at_a_time":
        columns["varied"] = np.repeat(np.array([varied for _, varied in points]), members)
    for k, name in enumerate(design.columns):
        values = [values[k] for values, _ in points]
        columns[name] = np.repeat(_array(values), members)
    for name in FIELDS:
        if name in TEXTS:
            columns[name] = np.array(results.text(name))
            continue
        numbers = results.number(name)
        whole = name == "train_cars" or (name in MEASURES and MEASURES[name].whole)
        if whole:
            columns[name] = pd.array(
                [None if np.isnan(v) else int(v) for v in numbers], dtype="Int64"
            )
        else:
            columns[name] = numbers
    return pd.DataFrame(columns)


def _short(point: Point) -> tuple[list[Any], str]:
    return list(point.columns.values()), point.varied


def _array(values: list[Any]) -> Any:
    import numpy as np

    if all(isinstance(v, bool) for v in values):
        return np.array(values, dtype=bool)
    if all(type(v) is int for v in values):
        return np.array(values, dtype=np.int64)
    if all(type(v) in (int, float) for v in values):
        return np.array(values, dtype=float)
    return np.array([str(v) for v in values])


def write_table(table: pandas.DataFrame, path: Path) -> None:
    """Write a table as Parquet or CSV, by the name's ending, whole or not at all."""
    draft = path.with_name(path.name + ".new")
    if path.suffix == ".csv":
        table.to_csv(draft, index=False, lineterminator="\n")
    else:
        table.to_parquet(draft, index=False, compression="zstd")
    draft.replace(path)


def read_table(folder: str | os.PathLike[str]) -> pandas.DataFrame:
    """The table of a folder of results, of an unfinished study as far as it is.

    Raises
    ------
    StudyError
        If there is none.
    """
    import pandas as pd

    folder = Path(folder)
    manifest = read_manifest(folder)
    if not manifest["complete"]:
        from derail_ros.studies.results import study_of

        design = make(study_of(manifest))
        results = Results(manifest["points"], manifest["ensemble"])
        try:
            with Journal(folder, results):
                table = frame(design, results)
        except JournalError as error:
            raise StudyError(str(error)) from None
        return table[results.done].reset_index(drop=True)
    path = folder / manifest["table"]["file"]
    try:
        if path.suffix == ".csv":
            table = pd.read_csv(path, keep_default_na=False, na_values=[""], dtype=None)
        else:
            table = pd.read_parquet(path)
    except (OSError, ValueError) as error:
        raise StudyError(f"{path}: cannot be read: {error}") from None
    for name in (*TEXTS, "varied"):
        if name in table:
            table[name] = table[name].astype(object).where(table[name].notna(), "").astype(str)
    return table
