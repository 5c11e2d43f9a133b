"""Running a study: each run exactly once, the same table however it came about."""

import json
from contextlib import suppress

import numpy as np
import pandas as pd
import pytest

from derail_ros.api import StudyAnswers as StudyResults
from derail_ros.scenario import ScenarioError
from derail_ros.studies.ensemble import run_many
from derail_ros.studies.journal import FILE, Journal, JournalError
from derail_ros.studies.results import StudyError
from derail_ros.studies.runner import run_study


class Interrupt(Exception):
    """Stands for whatever ends a process."""


def stopping_after(n):
    """A runner that is interrupted after ``n`` runs."""

    def run(runs, *, jobs=None, task=None):
        for i, result in enumerate(run_many(runs, jobs=1, task=task)):
            if i == n:
                raise Interrupt
            yield result

    return run


def test_the_table_has_each_point_and_member_once(load, folder):
    place = run_study(load(), folder / "out")
    results = StudyResults(place)
    table = results.table
    assert list(zip(table["point"], table["member"], strict=True)) == [
        (p, m) for p in range(4) for m in range(2)
    ]
    assert list(table["speed"]) == [10, 10, 10, 10, 15, 15, 15, 15]
    assert list(table["ground"]) == [0.8, 0.8, 1.2, 1.2] * 2
    assert set(table["status"]) == {"at rest"}
    assert (table["train_cars"] == 5).all()
    assert (table["lateral_factor"] == 1.0).tolist() == [True, False] * 4
    manifest = json.loads((place / "manifest.json").read_text())
    assert manifest["complete"] and manifest["table"]["rows"] == 8
    assert manifest["software"]["engine_hash"] and manifest["scenario"]["title"] == "A short train"
    assert sorted(p.name for p in place.iterdir()) == ["manifest.json", "runs.parquet"]


def test_a_row_is_the_outcome_of_its_run(load, folder):
    from derail_ros import simulate

    table = StudyResults(run_study(load(), folder / "out")).table
    row = table.iloc[5]
    overrides = {"train.speed_kmh": 15, "ground.scale": 0.8}
    outcome = simulate(folder / "small.yaml", overrides, member=1)
    assert row["cars_derailed"] == outcome.cars_derailed
    assert row["duration_s"] == outcome.duration
    assert row["scene_area_m2"] == outcome.scene_area
    assert row["peak_force_N"] == outcome.peak_force
    assert row["cars_above_5MN"] == len(outcome.cars_above_5MN)
    assert row["first_derailed"] == 1


def test_the_same_bytes_whatever_was_interrupted(load, folder):
    study = load()
    whole = run_study(study, folder / "whole", jobs=2) / "runs.parquet"
    place = folder / "pieces"
    for n in (3, 0, 2):
        with pytest.raises(Interrupt):
            run_study(study, place, run=stopping_after(n))
    lines = (place / FILE).read_text().splitlines()
    assert len(lines) == 5
    assert not StudyResults(place).complete
    assert len(StudyResults(place).table) == 5
    told = []
    run_study(study, place, jobs=1, progress=lambda *args: told.append(args))
    assert [t for t in told if t[0] == "run"] == [("run", n, 8) for n in (5, 6, 7, 8)]
    assert (place / "runs.parquet").read_bytes() == whole.read_bytes()


def test_finished_runs_are_not_repeated(load, folder, invented):
    def some(point, member):
        return {"cars_derailed": point}

    study, place = load(), folder / "out"
    first = invented(some)
    with pytest.raises(StudyError, match="5 runs did not come back"):
        run_study(study, place, run=lambda runs, **k: (r for r, _ in zip(first(runs), "abc")))
    rest = invented(some)
    run_study(study, place, run=rest)
    keys = rest.seen.keys
    assert keys == [(1, 1), (2, 0), (2, 1), (3, 0), (3, 1)]
    again = invented(some)
    run_study(study, place, run=again)
    assert again.seen.keys == []


def test_finished_runs_serve_other_measures_and_words(load, folder, invented):
    runner = invented(lambda p, m: {"cars_derailed": p, "scene_width_m": 1.0 * m})
    place = run_study(load(), folder / "out", run=runner)
    text = (folder / "study.yaml").read_text().replace("A small study", "Another title")
    run_study(load(text + "measures: [scene_width_m]\n"), place, run=runner)
    assert len(runner.seen.keys) == 8
    results = StudyResults(place)
    assert results.measures == ("scene_width_m",)
    assert results.manifest["title"] == "Another title"
    assert results.complete


def test_a_run_that_comes_twice_counts_once(load, folder, invented):
    runner = invented(lambda point, member: {"cars_derailed": 10 * point + member})

    def twice(runs, **kwargs):
        for result in runner(runs):
            yield result
            yield result

    table = StudyResults(run_study(load(), folder / "out", run=twice)).table
    assert list(table["cars_derailed"]) == [0, 1, 10, 11, 20, 21, 30, 31]


def test_a_torn_line_is_cut_off(load, folder):
    study, place = load(), folder / "out"
    with pytest.raises(Interrupt):
        run_study(study, place, run=stopping_after(4))
    journal = place / FILE
    journal.write_bytes(journal.read_bytes()[:-20])
    run_study(study, place)
    whole = run_study(study, folder / "whole")
    assert (place / "runs.parquet").read_bytes() == (whole / "runs.parquet").read_bytes()


def test_a_failed_run_is_a_row_with_its_error(load, folder, invented):
    def some(point, member):
        if (point, member) == (2, 1):
            raise ValueError("step below\nthe floor")
        return {"cars_derailed": 3, "duration_s": 5.0}

    results = StudyResults(run_study(load(), folder / "out", run=invented(some)))
    row = results.table.iloc[5]
    assert (row["status"], row["error"]) == ("failed", "ValueError: step below the floor")
    assert pd.isna(row["cars_derailed"]) and np.isnan(row["duration_s"])
    assert row["lateral_factor"] != 1.0
    summary = results.summary()
    cell = summary[(summary["point"] == 2) & (summary["measure"] == "duration_s")].iloc[0]
    assert (cell["n"], cell["runs"], cell["failed"]) == (1, 2, 1)
    assert "1 run failed and is left out." in results.statements()


def test_csv_and_parquet_hold_the_same(load, folder, invented):
    def some(point, member):
        if point == 3:
            raise ValueError("no")
        return {"cars_derailed": point, "duration_s": 0.1 * point, "peak_force_pair": "2-1"}

    study = load()
    a = StudyResults(run_study(study, folder / "a", run=invented(some), table="parquet")).table
    b = StudyResults(run_study(study, folder / "b", run=invented(some), table="csv")).table
    assert list(a.columns) == list(b.columns)
    for name in a:
        x, y = (
            (t[name].astype(str if t[name].dtype == object else float) for t in (a, b))
            if (name not in ("status", "error", "peak_force_pair"))
            else (a[name], b[name])
        )
        assert x.equals(y), name


def test_another_study_is_not_mixed_in(load, folder, invented):
    runner = invented(lambda p, m: {})
    place = run_study(load(), folder / "out", run=runner)
    with pytest.raises(StudyError, match="this study with seed 0 where 5 is asked for"):
        run_study(load().changed(seed=5), place, run=runner)
    with pytest.raises(StudyError, match="another study"):
        run_study(load().with_overrides({"train.speed_kmh": 11}), place, run=runner)
    other = folder / "other"
    other.mkdir()
    (other / "notes.txt").write_text("mine")
    with pytest.raises(StudyError, match="not empty"):
        run_study(load(), other, run=runner)
    with pytest.raises(StudyError, match=r"manifest\.json"):
        StudyResults(other)


def test_another_engine_is_not_mixed_in(load, folder, invented):
    place = run_study(load(), folder / "out", run=invented(lambda p, m: {}))
    manifest = json.loads((place / "manifest.json").read_text())
    manifest["software"]["engine_hash"] = "0" * 64
    manifest["identity"] = "0" * 64
    (place / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(StudyError, match="another version of the engine"):
        run_study(load(), place)


def test_nothing_is_written_for_a_bad_study(load, folder):
    text = """\
version: 1
title: T
scenario: small
design: grid
parameters:
  p: {path: train.speed_kmh, values: [10, 20, 501]}
"""
    with pytest.raises(ScenarioError, match="501"):
        run_study(load(text), folder / "out")
    assert not (folder / "out").exists()


def test_two_processes_do_not_write_the_same_results(folder):
    with Journal(folder, 1, 1), pytest.raises(JournalError, match="another process"):
        Journal(folder, 1, 1)


def test_a_journal_of_something_else_is_refused(folder):
    for text in (b"[0, 0]\n", b"no json\n", b"{}\n", b'{"point": 7, "member": 0}\n'):
        (folder / FILE).write_bytes(text)
        with pytest.raises(JournalError):
            Journal(folder, 1, 1)


def test_the_work_beside_the_runs_is_in_proportion_to_their_number(load, folder, invented, calls):
    runner = invented(lambda p, m: {"cars_derailed": m % 7, "duration_s": 0.1 * m})

    def work(members):
        study = load().changed(ensemble=members)
        return calls(lambda: run_study(study, folder / f"out{members}", run=runner))

    work(1)  # what is imported and read once
    assert work(400) < 6 * work(100)


@pytest.mark.slow
def test_100_000_runs_take_less_than_1_GB(folder):
    """10 000 points x 10 runs in a process of its own, which says what it needed at most."""
    import subprocess
    import sys

    code = f"""
import resource, sys
from derail_ros.api import StudyAnswers
from derail_ros.studies.ensemble import JobResult
from derail_ros.studies.study_measures import columns
from derail_ros.studies.plan import study_from
from derail_ros.studies.runner import run_study

row = {{k: 1 if m.whole else 1.25 for k, m in columns().items()}}
row |= {{"status": "at rest", "error": "", "peak_force_pair": "3-2", "lateral_factor": 1.0}}

def run(runs, *, jobs=None, task=None):
    for i, one in enumerate(runs):
        values = row | {{"cars_derailed": i % 30, "peak_force_pair": f"{{i % 60}}-{{i % 59}}"}}
        yield JobResult(i, one, values, None, 0.0)

study = study_from({{
    "scenario": {str(folder / "small.yaml")!r}, "design": "latin_hypercube", "points": 10000,
    "ensemble": 10,
    "parameters": {{"a": {{"path": "train.speed_kmh", "range": [10, 20]}},
                   "b": {{"path": "ground.scale", "range": [0.5, 1.5]}}}},
}})
results = StudyAnswers(run_study(study, {str(folder / "out")!r}, run=run))
assert len(results.table) == 100000
results.report({str(folder / "page")!r})
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert answer.returncode == 0, answer.stderr
    assert int(answer.stdout) < 1024 * 1024  # KB


def test_tables_of_unfinished_studies_can_be_read(load, folder):
    place = folder / "out"
    with suppress(Interrupt):
        run_study(load(), place, run=stopping_after(3))
    table = StudyResults(place).table
    assert list(zip(table["point"], table["member"], strict=True)) == [(0, 0), (0, 1), (1, 0)]
