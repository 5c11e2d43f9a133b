"""The same study on a Dask cluster."""

import subprocess
import sys
import threading

import pytest

from derail_ros.api import StudyAnswers as StudyResults
from derail_ros.studies import cluster as cluster_module
from derail_ros.studies.cluster import ClusterError, on_cluster
from derail_ros.studies.runner import run_study


def test_no_scheduler_is_said(load, folder, monkeypatch):
    monkeypatch.setattr("derail_ros.studies.cluster.CONNECT_S", 0.5)
    with pytest.raises(ClusterError, match="no scheduler answers at tcp://127.0.0.1:9"):
        run_study(load(), folder / "out", run=on_cluster("tcp://127.0.0.1:9"))


STUDY = """\
version: 1
title: A study for a cluster
scenario: small
design: grid
ensemble: 10
parameters:
  speed: {path: train.speed_kmh, values: [15, 20, 25]}
  ground: {path: ground.scale, values: [0.8, 1.2]}
"""


@pytest.fixture
def cluster():
    from distributed import LocalCluster

    with LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        processes=True,
        dashboard_address=None,
        host="127.0.0.1",
    ) as cluster:
        yield cluster


@pytest.mark.slow
def test_a_worker_is_killed_midway(load, folder, cluster):
    study = load(STUDY)
    here = run_study(study, folder / "here") / "runs.parquet"

    killed = threading.Event()
    first = next(iter(cluster.workers.values()))

    def show(phase, done, total):
        if phase == "run" and done >= 10 and not killed.is_set():
            killed.set()
            first.process.process._process.kill()

    place = run_study(
        study, folder / "there", run=on_cluster(cluster.scheduler_address), progress=show
    )
    assert killed.is_set()
    assert (place / "runs.parquet").read_bytes() == here.read_bytes()
    table = StudyResults(place).table
    assert not table.duplicated(["point", "member"]).any()
    assert (table["status"] == "at rest").all()


@pytest.mark.slow
def test_the_command_on_a_cluster(folder, cluster):
    arguments = ["study", str(folder / "study.yaml"), "-o", str(folder / "out")]
    answer = subprocess.run(
        [sys.executable, "-m", "derail_ros.cli", *arguments, "--dask", cluster.scheduler_address],
        capture_output=True,
        text=True,
        timeout=280,
    )
    assert answer.returncode == 0, answer.stderr
    assert "on the cluster at tcp://" in answer.stderr
    assert len(StudyResults(folder / "out").table) == 8


@pytest.mark.slow
@pytest.mark.parametrize("moment", [0, 1, 3])
def test_the_scheduler_goes_away_between_two_runs(load, folder, cluster, monkeypatch, moment):
    asked = []

    def width(client, jobs):
        asked.append(client)
        if len(asked) == moment + 1:
            cluster.close()
        return known(client, jobs)

    known = cluster_module._width
    monkeypatch.setattr(cluster_module, "_width", width)
    with pytest.raises(ClusterError, match="lost the connection to the cluster"):
        run_study(load(STUDY), folder / "out", run=on_cluster(cluster.scheduler_address))
    assert len(asked) > moment


@pytest.mark.slow
@pytest.mark.timeout(300)  # the end is noticed; nothing waits for the cluster to come back
def test_the_cluster_goes_away(load, folder, cluster):
    def show(phase, done, total):
        if phase == "run" and done == 5:
            cluster.close()

    with pytest.raises(ClusterError):
        run_study(
            load(STUDY), folder / "out", run=on_cluster(cluster.scheduler_address), progress=show
        )
    kept = len(StudyResults(folder / "out").table)
    assert kept >= 5
    run_study(load(STUDY), folder / "out")
    assert len(StudyResults(folder / "out").table) == 60
