"""Results of a study in a folder, as data only."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from derail_ros.scenario import loads_scenario
from derail_ros.scenario.strict_yaml import Document, dump
from derail_ros.studies.design import Design, make
from derail_ros.studies.journal import TEXTS, Journal, JournalError
from derail_ros.studies.plan import Study, study_of_data
from derail_ros.studies.study_measures import with_relative_severity

if TYPE_CHECKING:
    import pandas

FORMAT = "derail_ros/study"
VERSION = 2
"""Of manifest and table; 1 had forces in MN and energies in MJ."""
MANIFEST = "manifest.json"
TABLES = {"parquet": "runs.parquet", "csv": "runs.csv"}


class StudyError(Exception):
    """A study could not be run or read; the message is one line."""


# --- manifest and table -----------------------------------------------------------------------


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
        raise StudyError(f"{path}: version must be {VERSION}, got {data.get('version')}")
    return data


def write_manifest(folder: Path, manifest: Mapping[str, Any]) -> None:
    """Write it whole or not at all."""
    text = json.dumps(manifest, allow_nan=False, ensure_ascii=False, indent=1)
    draft = folder / f"{MANIFEST}.new"
    draft.write_text(text + "\n", encoding="utf-8")
    draft.replace(folder / MANIFEST)


def with_points(design: Design, runs: pandas.DataFrame) -> pandas.DataFrame:
    """The table of runs with the values of the parameters, after point and member."""
    import pandas as pd

    points = [(list(p.columns.values()), p.varied) for p in design]
    columns: dict[str, Any] = {}
    if any(varied for _, varied in points):
        columns["varied"] = [varied for _, varied in points]
    for k, name in enumerate(design.columns):
        columns[name] = [values[k] for values, _ in points]
    at = runs["point"].to_numpy()
    for place, (name, values) in enumerate(columns.items(), 2):
        series = pd.Series(values)
        if series.dtype == object:
            series = series.astype(str)
        runs.insert(place, name, series.to_numpy()[at])
    return runs


def write_table(table: pandas.DataFrame, path: Path) -> dict[str, Any]:
    """Write a table as Parquet or CSV, by the name's ending, whole or not at all; what it is."""
    draft = path.with_name(path.name + ".new")
    if path.suffix == ".csv":
        table.to_csv(draft, index=False, lineterminator="\n")
    else:
        table.to_parquet(draft, index=False, compression="zstd")
    draft.replace(path)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    return {"file": path.name, "rows": len(table), "sha256": digest}


# --- results ----------------------------------------------------------------------------------


class StudyResults:
    """Results of a study.

    Parameters
    ----------
    folder : where :func:`derail_ros.studies.runner.run_study` put them

    Attributes
    ----------
    manifest : as it stands in the folder
    tables : tables computed from the runs, kept by the functions that compute them
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder)
        self.manifest = read_manifest(self.folder)
        self.tables: dict[str, pandas.DataFrame] = {}

    def __repr__(self) -> str:
        state = "" if self.complete else ", unfinished"
        return f"<StudyResults {self.manifest['title']!r}: {self.manifest['size']}{state}>"

    @property
    def complete(self) -> bool:
        """All runs are there."""
        return bool(self.manifest["complete"])

    @cached_property
    def study(self) -> Study:
        """The study, about the scenario as it was then."""
        m = self.manifest
        scenario = loads_scenario(dump(m["scenario"]), m["scenario_name"])
        return study_of_data(m["name"], Document(dict(m["study"]), m["name"]), scenario)

    @cached_property
    def design(self) -> Design:
        """Its points."""
        return make(self.study)

    @cached_property
    def table(self) -> pandas.DataFrame:
        """A row for each run: point, member, parameters, measures; as far as there are runs.

        Raises
        ------
        StudyError
            If it cannot be read.
        """
        import pandas as pd

        m = self.manifest
        if not self.complete:
            try:
                with Journal(self.folder, m["points"], m["ensemble"]) as journal:
                    return with_points(self.design, journal.table())
            except JournalError as error:
                raise StudyError(str(error)) from None
        path = self.folder / m["table"]["file"]
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

    @property
    def first(self) -> pandas.DataFrame:
        """The first row of each point, by the number of the point."""
        return self.table.drop_duplicates("point").set_index("point")

    @property
    def base(self) -> int | None:
        """Number of the point that others are compared with; None without."""
        return self.design.base

    @cached_property
    def runs(self) -> pandas.DataFrame:
        """The runs that count (neither failed nor void), with the severity relative to a base."""
        counts = ~self.table["status"].isin(["failed", "void"])
        return with_relative_severity(self.table[counts].copy(), self.base)

    @property
    def measures(self) -> tuple[str, ...]:
        """The measures that the study asks for."""
        return tuple(m for m in self.study.model.measures if m in self.runs)

    @cached_property
    def labels(self) -> tuple[str, ...]:
        """Each point in a few words."""
        return tuple(map(self.design.words, self.design))

    def values(self, measure: str) -> dict[int, np.ndarray]:
        """Point -> the measure's values over its runs; points without any are left out."""
        runs = self.runs[["point", measure]].dropna()
        groups = runs.groupby("point")[measure]
        return {int(point): v.to_numpy(dtype=float) for point, v in groups}
