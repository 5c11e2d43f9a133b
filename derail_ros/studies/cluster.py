"""The runs of a study on a Dask cluster.

A runner like :func:`derail_ros.studies.ensemble.run_many`: it takes runs and yields results as
they finish. A worker that dies loses what it was computing; the scheduler gives those runs to the
others, and each run gives one result, whichever worker computed it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING, Any

from derail_ros.studies.ensemble import Job, JobResult, Task, attempt, compute, never

if TYPE_CHECKING:
    from distributed import Client, Future

PER_THREAD = 3
"""Runs given to the cluster at a time, for each thread of its workers."""

CONNECT_S = 10.0
"""How long to wait for the scheduler and its first worker, s."""


LOST = "--dask: lost the connection to the cluster"


class ClusterError(Exception):
    """The cluster cannot be used; the message is one line."""


def remote(index: int, job: Job, task: Task, engine: str) -> JobResult | str:
    """Compute a run on a worker; its engine's hash instead if that is another one."""
    from derail_ros.models import engine_hash

    if engine_hash() != engine:
        return engine_hash()
    return attempt(index, job, task, never)


def on_cluster(address: str) -> Callable[..., Iterator[JobResult]]:
    """The runner that sends its runs to the scheduler at ``address``."""

    def run(
        runs: Iterable[Job], *, jobs: int | None = None, task: Task = compute
    ) -> Iterator[JobResult]:
        client = _connect(address)
        try:
            yield from _run(client, runs, jobs, task)
        finally:
            client.close()

    return run


def _connect(address: str) -> Client:
    from distributed import Client

    try:
        client = Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        text = " ".join(str(error).split())
        raise ClusterError(f"--dask: no scheduler answers at {address}: {text}") from None
    try:
        client.wait_for_workers(1, timeout=CONNECT_S)
    except TimeoutError:
        client.close()
        raise ClusterError(f"--dask: the cluster at {address} has no workers") from None
    return client


def _run(client: Client, runs: Iterable[Job], jobs: int | None, task: Task) -> Iterator[JobResult]:
    from distributed import CancelledError, as_completed
    from distributed.scheduler import KilledWorker

    from derail_ros.models import engine_hash

    engine = engine_hash()
    numbered = iter(enumerate(runs))
    sent: dict[str, tuple[int, Job]] = {}

    def submit() -> Future | None:
        item = next(numbered, None)
        if item is None:
            return None
        # the future is dropped with its result: nothing stays in the cluster's memory
        future = client.submit(remote, *item, task, engine, pure=False)
        sent[future.key] = item
        return future

    first = [f for f in (submit() for _ in range(_width(client, jobs))) if f is not None]
    flying = as_completed(first, client.loop, with_results=True, raise_errors=False)
    for future, value in flying:
        index, job = sent.pop(future.key)
        if future.status == "cancelled" or isinstance(value, CancelledError):
            raise ClusterError(LOST)
        if future.status == "error":
            error = value[1] if isinstance(value, tuple) else value
            if not isinstance(error, KilledWorker):
                raise ClusterError(f"--dask: a worker cannot compute runs: {_line(error)}")
            # a run that takes its worker with it, again and again, is a failed run
            value = JobResult(index, job, None, f"KilledWorker: {_line(error)}", 0.0)
        if isinstance(value, str):
            raise ClusterError(
                f"--dask: a worker has another version of the engine ({value[:12]}, "
                f"not {engine[:12]}): install the same version on the workers"
            )
        # what comes back has a copy of the job: give the caller its own
        yield JobResult(index, job, value.value, value.error, value.wall_s)
        future.release()
        # workers may have come or gone since
        while len(sent) < _width(client, jobs):
            following = submit()
            if following is None:
                break
            flying.add(following)


def _width(client: Client, jobs: int | None) -> int:
    if jobs is not None:
        return jobs
    workers: dict[str, Any] | None = client.scheduler_info(n_workers=-1).get("workers")
    if workers is None:  # what a client says that has just lost its scheduler
        raise ClusterError(LOST)
    threads = sum(int(w["nthreads"]) for w in workers.values())
    return max(1, PER_THREAD * threads)


def _line(error: Any) -> str:
    return " ".join(str(error).split())[:300]
