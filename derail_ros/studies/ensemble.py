"""Running many runs: ensembles, studies, comparisons.

A :class:`Job` says what to compute (a scenario, overrides, the member of an ensemble), a
:class:`JobResult` what came of it. :func:`run_many` takes any iterable of jobs, keeps a few of
them in flight and none afterwards, and yields results as they finish. The number of jobs is not
bounded by memory. A caller that resumes leaves out the jobs that are done. A job that fails gives
a result with an error.

A result depends on its job alone: not on the number of threads, the order or the backend.

Jobs go to threads of one process: the engine's kernels release the interpreter's lock for whole
stretches of a run. Two threads spend the same processor time on a run as one (24 Mississauga
runs: 11.7 s against 11.6 s). A worker process would take seconds and 200 MB to start.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import closing
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from derail_ros.vocabulary.params import TrackSegment

if TYPE_CHECKING:
    from derail_ros.vocabulary.outcome import Outcome
    from derail_ros.vocabulary.params import TrainParams
    from derail_ros.vocabulary.simulation import Simulation

VARIATION = 0.04
"""Half width of the variation of the lateral force over an ensemble, relative."""

SLICE = 2.0
"""Simulated time between two checks of the stop flag, s. It does not change the results: the
engine takes its own steps."""


class ScenarioLike(Protocol):
    """The interface of a scenario for the runner."""

    def with_overrides(self, overrides: Mapping[str, Any]) -> ScenarioLike: ...
    def to_params(self) -> TrainParams: ...


@dataclass(frozen=True)
class Member:
    """A member of an ensemble of a scenario that draws; built where it is run."""

    scenario: Any
    member: int
    seed: int

    def to_params(self) -> TrainParams:
        """The engine's parameters with its draw."""
        return self.scenario.member_params(self.member, self.seed)


class Stopped(Exception):
    """A run ended because its runner was told to stop."""


def member_factor(seed: int, member: int, variation: float = VARIATION) -> float:
    """Factor on the lateral forces of a member of an ensemble.

    Member 0 is the scenario itself (1). The others are uniform in ``1 +/- variation``, drawn from
    a Philox stream that is keyed on ``(seed, member)``: the same for any number of members, of
    threads and any order.
    """
    if seed < 0:
        raise ValueError(f"seed must be zero or positive, got {seed}")
    if member == 0:
        return 1.0
    sequence = np.random.SeedSequence(entropy=seed, spawn_key=(member,))
    stream = np.random.Generator(np.random.Philox(sequence))
    return 1.0 + variation * float(stream.uniform(-1.0, 1.0))


@dataclass(frozen=True)
class Job:
    """One run to compute."""

    scenario: ScenarioLike | Member | TrainParams
    # dotted path -> value, applied to the scenario
    overrides: Mapping[str, Any] = field(default_factory=dict)
    member: int = 0  # number within its ensemble, from 0
    seed: int = 0  # of the ensemble
    variation: float = VARIATION  # half width of the lateral force's variation, relative
    key: Any = None  # the caller's name for this job; given back with the result

    @property
    def factor(self) -> float:
        """Factor on the lateral forces."""
        return member_factor(self.seed, self.member, self.variation)

    def params(self) -> TrainParams:
        """The engine's parameters of this run."""
        scenario: Any = self.scenario
        if hasattr(scenario, "to_params"):
            if self.overrides:
                scenario = scenario.with_overrides(self.overrides)
            scenario = scenario.to_params()
        elif self.overrides:
            raise TypeError("overrides need a scenario, not the engine's parameters")
        return vary(scenario, self.factor)


def vary(params: TrainParams, factor: float) -> TrainParams:
    """The same run with all its lateral forces scaled by ``factor``."""
    if factor == 1.0:
        return params
    forces = tuple(replace(f, force=f.force * factor) for f in params.initiation.lateral_forces)
    return replace(params, initiation=replace(params.initiation, lateral_forces=forces))


@dataclass(frozen=True)
class JobResult:
    """Result of a job."""

    index: int  # place of the job among those given, from 0
    job: Job
    value: Any  # outcome (or what another ``task`` gave back); None if it failed
    error: str | None  # why it failed, one line; None if it did not
    wall_s: float

    @property
    def outcome(self) -> Outcome:
        """The outcome of a job that did not fail."""
        if self.error is not None:
            raise RuntimeError(f"run {self.index} failed: {self.error}")
        return self.value


Task = Callable[[Job, Callable[[], bool]], Any]
"""Computes a job: ``task(job, stop)``; ``stop()`` becomes true when the runner is closed."""

Runner = Callable[..., Iterator[JobResult]]
""":func:`run_many` or another like it."""

Progress = Callable[[int, int], None]
"""Called with the number of jobs done and the number of all."""


def advance(
    simulation: Simulation,
    stop: Callable[[], bool] | None = None,
    progress: Callable[[Simulation], None] | None = None,
    slice_s: float = SLICE,
) -> Outcome:
    """Run a simulation to its end in slices of simulated time and return its outcome.

    ``stop`` and ``progress`` are called between slices.

    Raises
    ------
    Stopped
        ``stop`` returned true.
    SimulationError
        From the engine.
    """
    until = simulation.time
    while not simulation.ended:
        until = max(until, simulation.time) + slice_s
        simulation.advance_to(until)
        if progress is not None:
            progress(simulation)
        if stop is not None and stop():
            raise Stopped
    return simulation.outcome()


def compute(job: Job, stop: Callable[[], bool] | None = None) -> Outcome:
    """Compute one job: the default task of :func:`run_many`."""
    params = job.params()
    simulation = complete(params, stop)
    outcome = simulation.outcome()
    if simulation.params is params:
        return outcome
    track, sample = params.track, simulation.sample()
    end = track.start_coordinate + sum(s.length for s in track.segments)
    place = sample.truck_coordinate[sample.truck_on.astype(bool)]
    beyond = float(np.max(place, initial=end)) - end
    return replace(outcome, values={**outcome.values, "beyond_track_m": beyond})


MORE_TRACK = 5000.0
"""Straight that is added to an alignment on which a run ran out of track, m."""


def complete(params: TrainParams, stop: Callable[[], bool] | None = None) -> Simulation:
    """A run at its end; if a truck leaves the end of the alignment, again with a straight there.

    Without that the longest runs of an ensemble would be the ones that fail.
    """
    from derail_ros import models
    from derail_ros.vocabulary.errors import TrackEndError

    simulation = models.build(params)
    try:
        advance(simulation, stop)
    except TrackEndError:
        segments = (*params.track.segments, TrackSegment(MORE_TRACK))
        longer = replace(params, track=replace(params.track, segments=segments))
        simulation = models.build(longer)
        advance(simulation, stop)
    return simulation


def describe(error: BaseException) -> str:
    """An exception in one line."""
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def attempt(index: int, job: Job, task: Task, stop: Callable[[], bool]) -> JobResult:
    """Compute a job; an exception is its result's error, except :class:`Stopped`."""
    began = time.perf_counter()
    try:
        value, error = task(job, stop), None
    except Stopped:
        raise
    except Exception as exception:  # whatever goes wrong in a run is the result of that run
        value, error = None, describe(exception)
    return JobResult(index, job, value, error, time.perf_counter() - began)


def never() -> bool:
    """A stop flag that is never set."""
    return False


def default_jobs() -> int:
    """Number of processors this process may use."""
    try:
        return max(1, len(os.sched_getaffinity(0)))
    except AttributeError:  # not on this platform
        return os.cpu_count() or 1


def run_many(
    runs: Iterable[Job], *, jobs: int | None = None, task: Task = compute
) -> Iterator[JobResult]:
    """Compute jobs and yield their results as they finish.

    Parameters
    ----------
    runs : any iterable; taken from as results are taken away
    jobs : number at a time; None for one per processor
    task : what computes each

    Closing the iterator (also by an exception such as KeyboardInterrupt in the loop around it)
    drops jobs that have not begun and stops those that have.
    """
    jobs = default_jobs() if jobs is None else jobs
    if jobs < 1:
        raise ValueError(f"jobs must be at least 1, got {jobs}")
    numbered = iter(enumerate(runs))
    if jobs == 1:
        for index, job in numbered:
            yield attempt(index, job, task, never)
        return

    stopping = threading.Event()
    executor = ThreadPoolExecutor(jobs, thread_name_prefix="derail-run")
    # A spare job per worker keeps all busy while the caller handles a result.
    pending: set[Future[JobResult]] = set()
    try:
        more = True
        while more or pending:
            while more and len(pending) < 2 * jobs:
                item = next(numbered, None)
                if item is None:
                    more = False
                else:
                    pending.add(executor.submit(attempt, *item, task, stopping.is_set))
            if pending:
                done, pending = wait(pending, return_when=FIRST_COMPLETED)
                for future in done:
                    yield future.result()
    finally:
        stopping.set()
        executor.shutdown(wait=True, cancel_futures=True)


def ensemble_jobs(
    scenario: ScenarioLike | TrainParams,
    members: int,
    *,
    seed: int = 0,
    variation: float = VARIATION,
    overrides: Mapping[str, Any] | None = None,
    key: Any = None,
) -> Iterator[Job]:
    """The members 0 to ``members - 1`` of an ensemble.

    Those of a scenario with uncertain fields or calibrated constants each have a draw of them;
    others differ in the lateral force alone.
    """
    if members < 1:
        raise ValueError(f"members must be at least 1, got {members}")
    member_factor(seed, 0)
    base: Any = scenario
    if overrides:
        base = base.with_overrides(overrides)
    if getattr(base, "draws", False):
        for member in range(members):
            yield Job(Member(base, member, seed), member=member, seed=seed, variation=0.0, key=key)
        return
    # Built once: reading a scenario costs more than varying its parameters.
    params = base.to_params() if hasattr(base, "to_params") else base
    for member in range(members):
        yield Job(params, member=member, seed=seed, variation=variation, key=key)


def inputs(scenario: Any, members: int, seed: int = 0) -> list[dict[str, Any]]:
    """What each member of an ensemble draws: dotted path -> value or factor; {} of member 0."""
    if scenario.draws:
        return [scenario.member_inputs(member, seed) for member in range(members)]
    return [{}] + [{"lateral_factor": member_factor(seed, m)} for m in range(1, members)]


def gather(
    runs: Iterable[Job],
    *,
    jobs: int | None = None,
    task: Task = compute,
    run: Runner = run_many,
    progress: Progress | None = None,
) -> dict[Any, list[JobResult]]:
    """Compute all jobs: key of the jobs -> their results in the order of the members.

    Parameters
    ----------
    runs, jobs, task : as of :func:`run_many`
    run : runner
    progress : called after each result
    """
    listed = list(runs)
    found: dict[Any, dict[int, JobResult]] = {job.key: {} for job in listed}
    with closing(run(listed, jobs=jobs, task=task)) as results:
        for done, result in enumerate(results, 1):
            found[result.job.key][result.job.member] = result
            if progress is not None:
                progress(done, len(listed))
    return {key: [by[m] for m in sorted(by)] for key, by in found.items()}
