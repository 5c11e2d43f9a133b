"""What a notebook needs: a run and a study, each in a call."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from derail_ros.scenario import Scenario
    from derail_ros.studies.plan import Study
    from derail_ros.studies.results import StudyResults
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
    overrides : dotted path -> value
    member, seed : which run of an ensemble: the lateral force is varied by up to 4 %; member 0 is
        the scenario itself

    Returns
    -------
    Outcome
        Cars derailed, duration (s), forces (N), extents (m) and what else came of it.

    Raises
    ------
    ScenarioError
        Naming file, line and field.
    SimulationError
        If the run failed.
    """
    from derail_ros.scenario import Scenario, load_scenario
    from derail_ros.studies.ensemble import Run, compute

    base = scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
    return compute(Run(base, overrides or {}, member=member, seed=seed))


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
) -> StudyResults:
    """Run a study, or what is missing of it in its folder.

    Parameters
    ----------
    what : a study, the name of a shipped one, the path of its file, or what would stand in the
        file as a mapping
    folder : of the results, ``runs/study_NAME`` by default
    overrides : dotted path -> value, for the base scenario
    ensemble, points, seed : instead of the study's own
    jobs : runs at a time, one per core by default
    dask : address of a Dask scheduler to run it on
    table : parquet or csv

    Returns
    -------
    StudyResults
        ``table``, ``summary()``, ``counts()``, ``effects()`` (data frames), ``statements()`` and
        ``report(folder)``.

    Raises
    ------
    ScenarioError
        Naming file, line and field; before the first run.
    StudyError, ClusterError
        The folder or the cluster cannot be used.
    """
    from derail_ros.commands.study import default_folder
    from derail_ros.studies.cluster import on_cluster
    from derail_ros.studies.ensemble import run_many
    from derail_ros.studies.plan import Study, load_study, study_from
    from derail_ros.studies.results import StudyResults
    from derail_ros.studies.runner import run_study

    if isinstance(what, Study):
        plan = what
    else:
        plan = study_from(what) if isinstance(what, Mapping) else load_study(what)
    plan = plan.changed(ensemble=ensemble, points=points, seed=seed)
    plan = plan.with_overrides(overrides or {})
    place = default_folder(plan.name) if folder is None else folder
    runner = on_cluster(dask) if dask else run_many
    run_study(plan, place, jobs=jobs, table=table, run=runner)
    return StudyResults(place)
