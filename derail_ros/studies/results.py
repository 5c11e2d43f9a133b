"""Results of a study, read and asked."""

from __future__ import annotations

import os
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from derail_ros.scenario import loads_scenario
from derail_ros.scenario.strict_yaml import Document, dump
from derail_ros.studies import statistics
from derail_ros.studies.design import Design, Sobol, base_index, make
from derail_ros.studies.plan import Study, StudyModel, label_of
from derail_ros.studies.runner import read_manifest, read_table
from derail_ros.vocabulary.severity import severity_index

if TYPE_CHECKING:
    import pandas

BASE_MEASURES = ("cars_derailed", "peak_force_MN", "scene_area_m2")


def study_of(manifest: Mapping[str, Any]) -> Study:
    """The study that a manifest belongs to, about the scenario as it was then."""
    name = manifest["name"]
    scenario = loads_scenario(dump(manifest["scenario"]), manifest["scenario_name"])
    document = Document(dict(manifest["study"]), name)
    return Study(name, StudyModel.model_validate(document.data), scenario, document)


class StudyResults:
    """Results of a study.

    Parameters
    ----------
    folder : where :func:`derail_ros.studies.runner.run_study` put them
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder)
        self.manifest = read_manifest(self.folder)
        self._tables: dict[str, pandas.DataFrame] = {}

    def __repr__(self) -> str:
        state = "" if self.complete else ", unfinished"
        return f"<StudyResults {self.manifest['title']!r}: {self.manifest['size']}{state}>"

    @property
    def complete(self) -> bool:
        """All runs are there."""
        return bool(self.manifest["complete"])

    @cached_property
    def study(self) -> Study:
        """The study."""
        return study_of(self.manifest)

    @cached_property
    def design(self) -> Design:
        """Its points."""
        return make(self.study)

    @cached_property
    def table(self) -> pandas.DataFrame:
        """A row for each run: point, member, parameters, measures."""
        return read_table(self.folder)

    @cached_property
    def base(self) -> int | None:
        """Number of the point that others are compared with; None without."""
        return base_index(self.design)

    @cached_property
    def runs(self) -> pandas.DataFrame:
        """The runs that count (neither failed nor void), with their severity if there is a base.

        Severity compares with the means of the base point: cars derailed, peak force, area.
        """
        table = self.table[~self.table["status"].isin(["failed", "void"])].copy()
        if self.base is None:
            return table
        n, f, a = (table[key].to_numpy(dtype=float, na_value=np.nan) for key in BASE_MEASURES)
        base = (table["point"] == self.base).to_numpy()
        means = [float(v[base].mean()) if base.any() else np.nan for v in (n, f, a)]
        if all(np.isfinite(means)) and min(means) > 0.0:
            table["severity"] = severity_index(n, f, a, *means)
        return table

    @property
    def measures(self) -> tuple[str, ...]:
        """The measures that the study asks for."""
        return tuple(m for m in self.study.model.measures if m in self.runs)

    def summary(self) -> pandas.DataFrame:
        """Each measure at each point: mean with its interval, spread, quantiles."""
        return self._kept("summary")

    def counts(self) -> pandas.DataFrame:
        """Distribution of the number of cars derailed at each point."""
        return self._kept("counts")

    def effects(self) -> pandas.DataFrame:
        """What each parameter does to each measure; the columns depend on the design."""
        return self._kept("effects")

    def sobol(self) -> pandas.DataFrame:
        """Sobol indices of each measure (design sobol)."""
        return self._kept("effects" if isinstance(self.design, Sobol) else "sobol")

    def _kept(self, name: str) -> pandas.DataFrame:
        """A table of the statistics: computed once, given as a copy."""
        if name not in self._tables:
            self._tables[name] = getattr(statistics, name)(self)
        return self._tables[name].copy()

    @cached_property
    def labels(self) -> tuple[str, ...]:
        """Each point in a few words."""
        words = []
        for point in self.design:
            if point.varied:
                words.append(label_of({point.varied: point.columns[point.varied]}, self.study))
            elif self.study.model.design == "one_at_a_time":
                words.append("base")
            elif self.study.model.design == "cases":
                words.append(", ".join(self._case_word(k, v) for k, v in point.columns.items()))
            else:
                words.append(label_of(point.columns, self.study))
        return tuple(words)

    def _case_word(self, column: str, value: Any) -> str:
        return value if isinstance(value, str) else label_of({column: value}, self.study)

    def findings(self) -> list[tuple[str, list[str]]]:
        """What the study says, and where it cannot tell: sentences under a measure's name."""
        from derail_ros.studies.sentences import findings

        return findings(self)

    def statements(self) -> list[str]:
        """The findings, each a sentence that names its measure."""
        return [
            f"{heading}: {line}" if heading else line
            for heading, lines in self.findings()
            for line in lines
        ]

    def report(self, folder: str | os.PathLike[str]) -> Path:
        """Write the page with figures and tables; its path."""
        from derail_ros.studies.page import write_report

        return write_report(self, Path(folder))
