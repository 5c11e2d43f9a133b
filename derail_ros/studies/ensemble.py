"""The one runner of many runs: ensembles, studies, validation.

A :class:`Run` says what to compute (a scenario, overrides, the member of an ensemble), a
:class:`Result` what came of it. :func:`run_many` takes any iterable of runs, keeps no more than a
few in flight and none afterwards, and yields results as they finish, so that the number of runs
is bounded by patience alone; a caller that wants to resume leaves out the runs that it has. A run
that fails is a result with an error.

What a run computes depends on the run alone: not on the number of jobs, the order or the backend.

Runs go to threads of one process: the engine's kernels release the interpreter's lock for whole
stretches of a run. Two threads spend the same processor time on a run as one (24 Mississauga
runs: 11.7 s against 11.6 s), without the seconds and the 200 MB a worker process takes to start,
and there is nothing left behind when the command is stopped.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

if TYPE_CHECKING:
    from derail_ros.vocabulary.outcome import Outcome
    from derail_ros.vocabulary.params import TrainParams
    from derail_ros.vocabulary.simulation import Simulation

VARIATION = 0.04
"""Half width of the variation of the lateral force over an ensemble, relative."""

SLICE = 2.0
"""Simulated time between two looks at the stop flag and at progress, s. It does not change the
results: the engine takes its own steps whatever it is asked for."""


class ScenarioLike(Protocol):
    """What the runner needs of a scenario."""

    def with_overrides(self, overrides: Mapping[str, Any]) -> ScenarioLike: ...
    def to_params(self) -> TrainParams: ...


class Stopped(Exception):
    """A run was given up because its runner was told to stop."""


def member_factor(seed: int, member: int, variation: float = VARIATION) -> float:
    """Factor on the lateral forces of a member of an ensemble.

    Member 0 is the scenario itself (1). The others are uniform in ``1 +/- variation``, drawn from
    a Philox stream of their own that is keyed on ``(seed, member)``: the same for any number of
    members, jobs and any order.
    """
    if seed < 0:
        raise ValueError(f"seed: must be zero or positive, not {seed}")
    if member == 0:
        return 1.0
    sequence = np.random.SeedSequence(entropy=seed, spawn_key=(member,))
    stream = np.random.Generator(np.random.Philox(sequence))
    return 1.0 + variation * float(stream.uniform(-1.0, 1.0))


@dataclass(frozen=True)
class Run:
    """One run of a study.

    Attributes
    ----------
    scenario : the scenario, or the engine's parameters themselves
    overrides : dotted path -> value, applied to the scenario
    member : number within its ensemble, from 0
    seed : seed of the ensemble
    variation : half width of the lateral force's variation, relative
    key : the caller's name for this run; given back with the result
    """

    scenario: ScenarioLike | TrainParams
    overrides: Mapping[str, Any] = field(default_factory=dict)
    member: int = 0
    seed: int = 0
    variation: float = VARIATION
    key: Any = None

    def params(self) -> TrainParams:
        """The engine's parameters of this run."""
        if hasattr(self.scenario, "to_params"):
            scenario = self.scenario
            if self.overrides:
                scenario = scenario.with_overrides(self.overrides)
            params = scenario.to_params()
        elif self.overrides:
            raise TypeError("overrides need a scenario, not the engine's parameters")
        else:
            params = self.scenario
        return vary(params, member_factor(self.seed, self.member, self.variation))


def vary(params: TrainParams, factor: float) -> TrainParams:
    """The same run with all its lateral forces scaled by ``factor``."""
    if factor == 1.0:
        return params
    forces = tuple(replace(f, force=f.force * factor) for f in params.initiation.lateral_forces)
    return replace(params, initiation=replace(params.initiation, lateral_forces=forces))


@dataclass(frozen=True)
class Result:
    """What came of a run.

    Attributes
    ----------
    index : place of the run among those given, from 0
    run : the run
    value : its outcome (or what another ``task`` gave back); None if it failed
    error : why it failed, one line; None if it did not
    wall_s : time it took, s
    """

    index: int
    run: Run
    value: Any
    error: str | None
    wall_s: float

    @property
    def outcome(self) -> Outcome:
        """The outcome of a run that did not fail."""
        if self.error is not None:
            raise RuntimeError(f"run {self.index} failed: {self.error}")
        return self.value


def advance(
    simulation: Simulation,
    stop: Callable[[], bool] | None = None,
    progress: Callable[[Simulation], None] | None = None,
    slice_s: float = SLICE,
) -> Outcome:
    """Run a simulation to its end in slices of simulated time and return its outcome.

    ``stop`` is asked and ``progress`` told between slices.

    Raises
    ------
    Stopped
        When ``stop`` said so.
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


def compute(run: Run, stop: Callable[[], bool] | None = None) -> Outcome:
    """Compute one run: the default task of :func:`run_many`."""
    from derail_ros import models

    return advance(models.build(run.params()), stop)


Task = Callable[[Run, Callable[[], bool]], Any]


def describe(error: BaseException) -> str:
    """An exception in one line."""
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def attempt(index: int, run: Run, task: Task, stop: Callable[[], bool]) -> Result:
    """Compute a run; what goes wrong is its result's error, all but :class:`Stopped`."""
    began = time.perf_counter()
    try:
        value, error = task(run, stop), None
    except Stopped:
        raise
    except Exception as exception:  # whatever goes wrong in a run is that run's result
        value, error = None, describe(exception)
    return Result(index, run, value, error, time.perf_counter() - began)


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
    runs: Iterable[Run],
    *,
    jobs: int | None = None,
    task: Task = compute,
) -> Iterator[Result]:
    """Compute runs and yield their results as they finish.

    Parameters
    ----------
    runs : any iterable; taken from as results are taken away
    jobs : runs at a time; None for one per processor
    task : ``task(run, stop) -> value``; ``stop()`` turns true when the runner is closed

    Closing the iterator (also by an exception such as KeyboardInterrupt in the loop around it)
    drops runs that have not begun and stops those that have.
    """
    jobs = default_jobs() if jobs is None else jobs
    if jobs < 1:
        raise ValueError(f"jobs: must be at least 1, not {jobs}")
    numbered = iter(enumerate(runs))
    if jobs == 1:
        for index, run in numbered:
            yield attempt(index, run, task, never)
        return

    stopping = threading.Event()
    executor = ThreadPoolExecutor(jobs, thread_name_prefix="derail-run")
    # A spare run per worker keeps all busy while the caller looks at a result.
    pending: set[Future[Result]] = set()
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


def ensemble_runs(
    scenario: ScenarioLike | TrainParams,
    members: int,
    *,
    seed: int = 0,
    variation: float = VARIATION,
    overrides: Mapping[str, Any] | None = None,
    key: Any = None,
) -> Iterator[Run]:
    """The members 0 to ``members - 1`` of an ensemble."""
    if members < 1:
        raise ValueError(f"members: must be at least 1, not {members}")
    member_factor(seed, 0)
    base = scenario
    if overrides:
        base = scenario.with_overrides(overrides)  # type: ignore[union-attr]
    # Built once: reading a scenario costs more than varying its parameters.
    params = base.to_params() if hasattr(base, "to_params") else base
    for member in range(members):
        yield Run(params, member=member, seed=seed, variation=variation, key=key)


def in_order(results: Iterable[Result]) -> list[Result]:
    """All results in the order of their runs."""
    return sorted(results, key=lambda result: result.index)
