"""The runner: independence of jobs, failures as results, bounded memory, clean stops."""

import itertools
import threading
import time
from contextlib import closing
from types import SimpleNamespace

import numpy as np
import pytest

from derail_ros.studies.ensemble import (
    Job,
    Stopped,
    advance,
    describe,
    ensemble_jobs,
    gather,
    member_factor,
    run_many,
    vary,
)


def factor_task(run, stop):
    assert run.factor == member_factor(run.seed, run.member)
    return run.factor


def nap_task(run, stop):
    time.sleep(0.001 * ((run.member * 7) % 5))
    return factor_task(run, stop)


def runs(n, **kwargs):
    return (Job(None, member=i, seed=3, key=("point", i), **kwargs) for i in range(n))


def sorted_results(results):
    return sorted(results, key=lambda r: r.index)


# Members -----------------------------------------------------------------------------------


def test_member_0_is_the_scenario_itself():
    assert member_factor(5, 0) == 1.0


def test_members_depend_on_seed_and_number_alone():
    a = [member_factor(5, i) for i in range(100)]
    assert a == [member_factor(5, i) for i in range(100)]
    assert member_factor(6, 7) != a[7]
    assert len(set(a)) == 100


def test_members_fill_the_range_evenly():
    x = np.array([member_factor(0, i) for i in range(1, 4001)])
    assert 0.96 <= x.min() < 0.9605
    assert 1.0395 < x.max() <= 1.04
    counts, _ = np.histogram(x, bins=8, range=(0.96, 1.04))
    assert (np.abs(counts - 500) < 100).all()


def test_negative_seed_is_refused():
    with pytest.raises(ValueError, match="seed"):
        member_factor(-1, 1)


def test_vary_scales_all_lateral_forces_and_nothing_else():
    from derail_ros.vocabulary.params import InitiationParams, LateralForce, TrainParams

    params = TrainParams(
        cars=(),
        initiation=InitiationParams(
            speed=25.0, lateral_forces=(LateralForce(), LateralForce(force=-1e4, car=3))
        ),
    )
    varied = vary(params, 1.02)
    assert [f.force for f in varied.initiation.lateral_forces] == [51_000.0, -10_200.0]
    assert varied.initiation.lateral_forces[1].car == 3
    assert vary(params, 1.0) is params
    assert params.initiation.lateral_forces[0].force == 50_000.0


# Running -----------------------------------------------------------------------------------


@pytest.mark.parametrize("jobs", [1, 2, 5])
def test_results_do_not_depend_on_the_number_of_jobs(jobs):
    results = sorted_results(run_many(runs(40), jobs=jobs, task=nap_task))
    assert [r.index for r in results] == list(range(40))
    assert [r.job.key for r in results] == [("point", i) for i in range(40)]
    assert [r.outcome for r in results] == [member_factor(3, i) for i in range(40)]


def test_results_come_as_they_finish():
    def task(run, stop):
        time.sleep(0.3 if run.member == 0 else 0.0)

    order = [r.index for r in run_many(runs(6), jobs=2, task=task)]
    assert sorted(order) == list(range(6))
    assert order[-1] == 0


@pytest.mark.parametrize("jobs", [1, 3])
def test_a_failure_is_a_result(jobs):
    def task(run, stop):
        if run.member % 3 == 1:
            raise RuntimeError("the step fell\n below its floor")
        return run.member

    results = sorted_results(run_many(runs(9), jobs=jobs, task=task))
    assert [r.error for r in results[:3]] == [
        None,
        "RuntimeError: the step fell below its floor",
        None,
    ]
    with pytest.raises(RuntimeError, match="run 1 failed"):
        _ = results[1].outcome


def test_an_endless_list_of_runs_is_taken_from_slowly():
    taken = itertools.count()
    last = 0

    def endless():
        nonlocal last
        for last in taken:
            yield Job(None, member=last)

    with closing(run_many(endless(), jobs=2, task=factor_task)) as results:
        for _ in range(50):
            next(results)
    assert last < 60


def test_memory_does_not_grow_with_the_number_of_runs():
    import tracemalloc

    def sweep(n):
        for result in run_many(runs(n), jobs=2, task=lambda run, stop: np.zeros(1000)):
            del result

    sweep(200)
    tracemalloc.start()
    sweep(3000)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 1_000_000  # 24 MB if the results were kept


def test_closing_stops_runs_at_their_next_look_and_drops_the_rest():
    begun, given_up = [], []

    def task(run, stop):
        begun.append(run.member)
        while run.member > 0:
            time.sleep(0.01)
            if stop():
                given_up.append(run.member)
                raise Stopped

    with closing(run_many(runs(100), jobs=2, task=task)) as results:
        assert next(results).index == 0
    assert sorted(given_up) == sorted(begun[1:])
    assert len(begun) <= 4
    assert not [t for t in threading.enumerate() if t.name.startswith("derail-run")]


def test_gather_gives_the_results_of_each_key_in_the_order_of_members():
    told = []
    listed = [Job(None, member=m, key=k) for m in (2, 0, 1) for k in "ba"]
    found = gather(
        listed, jobs=3, task=lambda job, stop: job.member, progress=lambda *x: told.append(x)
    )
    assert {k: [r.value for r in results] for k, results in found.items()} == {
        "b": [0, 1, 2],
        "a": [0, 1, 2],
    }
    assert told == [(n, 6) for n in range(1, 7)]


def test_bad_number_of_jobs_is_refused():
    with pytest.raises(ValueError, match="jobs"):
        list(run_many(runs(1), task=factor_task, jobs=0))


def test_ensemble_jobs_builds_the_parameters_once():
    built = []

    class Scenario:
        def to_params(self):
            built.append(1)
            return "params"

        def with_overrides(self, overrides):
            assert overrides == {"speed_kmh": 60}
            return self

    members = list(ensemble_jobs(Scenario(), 5, seed=9, overrides={"speed_kmh": 60}))
    assert [r.member for r in members] == [0, 1, 2, 3, 4]
    assert {r.seed for r in members} == {9}
    assert len(built) == 1


# One run -----------------------------------------------------------------------------------


class FakeSimulation:
    def __init__(self, end=9.3):
        self.time, self.end, self.ended = 0.0, end, False
        self.asked = []

    def advance_to(self, t):
        self.asked.append(t)
        self.time = min(t + 0.003, self.end)
        self.ended = self.time >= self.end
        return []

    def outcome(self):
        return SimpleNamespace(duration=self.time)


def test_advance_runs_to_the_end_in_slices_and_reports():
    simulation, seen = FakeSimulation(), []
    outcome = advance(simulation, progress=lambda s: seen.append(s.time), slice_s=2.0)
    assert outcome.duration == 9.3
    assert len(seen) == 5
    assert all(b > a for a, b in itertools.pairwise(simulation.asked))


def test_advance_gives_up_when_told():
    with pytest.raises(Stopped):
        advance(FakeSimulation(), stop=lambda: True)


def test_describe_is_one_line():
    assert describe(ValueError("a\n  b")) == "ValueError: a b"
    assert describe(KeyboardInterrupt()) == "KeyboardInterrupt"
