"""The functions for notebooks: one run, one study."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from derail_ros.studies.results import StudyResults

if TYPE_CHECKING:
    import pandas

    from derail_ros.scenario import Scenario
    from derail_ros.studies.plan import Study
    from derail_ros.vocabulary.outcome import Outcome


def simulate(
    scenario: str | os.PathLike[str] | Scenario,
    overrides: Mapping[str, Any] | None = None,
    *,
    member: int = 0,
    seed: int = 0,
) -> Outcome:
    """Run a scenario to rest.

    Parameters
    ----------
    scenario : a scenario, its name, or the path of its file
    overrides : new values of fields, by their dotted paths
    member : number of the run in an ensemble; 0 is the scenario itself, in the others the lateral
        force is varied by up to 4 %
    seed : seed of that variation

    Returns
    -------
    Outcome
        Cars derailed, duration (s), forces (N), extents (m) and other results.

    Raises
    ------
    ScenarioError
        The scenario has an error; the message names file, line and field.
    SimulationError
        The run failed.
    """
    from derail_ros.scenario import Scenario, load_scenario
    from derail_ros.studies.ensemble import Job, compute

    base = scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
    return compute(Job(base, overrides or {}, member=member, seed=seed))


class StudyAnswers(StudyResults):
    """Results of a study (``table``, ``runs``, ``manifest``) and their statistics."""

    def summary(self) -> pandas.DataFrame:
        """Each measure at each point: mean with its interval, spread, quantiles; SI units."""
        return self._of("summary")

    def counts(self) -> pandas.DataFrame:
        """Distribution of the number of cars derailed at each point."""
        return self._of("counts")

    def effects(self) -> pandas.DataFrame:
        """The effect of each parameter on each measure; the columns depend on the design."""
        return self._of("effects")

    def sobol(self) -> pandas.DataFrame:
        """Sobol indices of each measure (design sobol)."""
        return self._of("sobol")

    def _of(self, name: str) -> pandas.DataFrame:
        from derail_ros.studies import statistics

        return getattr(statistics, name)(self)

    def findings(self) -> list[tuple[str, list[str]]]:
        """Findings of the study as sentences, by measure; they also say what it cannot tell."""
        from derail_ros.studies.sentences import findings

        return findings(self)

    def statements(self) -> list[str]:
        """The findings, each a sentence that names its measure."""
        from derail_ros.studies.sentences import statements

        return statements(self)

    def report(self, folder: str | os.PathLike[str]) -> Path:
        """Write the page with figures and tables, and return its path."""
        from derail_ros.studies.page import write_report

        return write_report(self, Path(folder))


def study(
    what: str | os.PathLike[str] | Mapping[str, Any] | Study,
    folder: str | os.PathLike[str] | None = None,
    *,
    overrides: Mapping[str, Any] | None = None,
    ensemble: int | None = None,
    points: int | None = None,
    seed: int | None = None,
    jobs: int | None = None,
    dask: str | None = None,
    table: str = "parquet",
) -> StudyAnswers:
    """Run a study; runs that its folder already holds are not repeated.

    Parameters
    ----------
    what : a study, the name of a shipped one, the path of its file, or the content of such a
        file as a mapping
    folder : folder of the results, ``runs/study_NAME`` by default
    overrides : new values of the base scenario's fields, by their dotted paths
    ensemble : number of runs at each point, instead of the study's own
    points : number of points, instead of the study's own
    seed : seed, instead of the study's own
    jobs : number of runs at a time, one per core by default
    dask : address of a Dask scheduler that computes the runs
    table : format of the table of runs, ``parquet`` or ``csv``

    Returns
    -------
    StudyAnswers
        ``table``, ``summary()``, ``counts()``, ``effects()`` (data frames), ``statements()`` and
        ``report(folder)``.

    Raises
    ------
    ScenarioError
        The study or its scenario has an error; found before the first run.
    StudyError, ClusterError
        The folder or the cluster cannot be used.
    """
    from derail_ros.studies.cluster import on_cluster
    from derail_ros.studies.ensemble import run_many
    from derail_ros.studies.plan import Study, load_study, study_from
    from derail_ros.studies.runner import default_folder, run_study

    if isinstance(what, Study):
        plan = what
    else:
        plan = study_from(what) if isinstance(what, Mapping) else load_study(what)
    plan = plan.changed(ensemble=ensemble, points=points, seed=seed)
    plan = plan.with_overrides(overrides or {})
    place = default_folder(plan.name) if folder is None else folder
    runner = on_cluster(dask) if dask else run_many
    run_study(plan, place, jobs=jobs, table=table, run=runner)
    return StudyAnswers(place)
