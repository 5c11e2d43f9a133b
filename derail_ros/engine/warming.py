"""Compile all kernels, or load them from the cache, before they are needed.

Kernels are compiled once for a machine and a version of the sources (see ``jit``), which takes
half a minute. Whoever builds the first run does it for all: other processes wait for a file lock
and then load the cache. A marker in the cache folder says that it is complete.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from derail_ros.engine.jit import CACHE_DIR, CAN_KEEP, FOLDER_PREFIX, lock
from derail_ros.vocabulary.params import (
    BrakeUnit,
    Car,
    CouplerType,
    InitiationParams,
    TrainParams,
)

COMPLETE = "complete"
STALE_AFTER = 14 * 86400.0
"""Cache folders of other versions go when they have not been used for this long, s."""

_state = threading.local()
_mutex = threading.Lock()
_ready = threading.Event()
_use: IO[bytes] | None = None


def _say(text: str) -> None:
    print(f"derail_ros: {text}", file=sys.stderr, flush=True)


@contextmanager
def _only_one(folder: Path, say: Callable[[str], None]) -> Iterator[None]:
    """Hold the folder's lock: one process compiles, the others wait."""
    try:
        file = open(folder / "lock", "wb")
    except OSError:  # a folder that cannot be written: each for itself
        yield
        return
    with file:
        if not lock(file, shared=False, wait=False):
            say("another process is compiling the kernels; waiting for it")
            lock(file, shared=False, wait=True)
        yield


def _hold(folder: Path) -> None:
    """Show for as long as this process lives that the folder is in use."""
    global _use
    try:
        _use = open(folder / "use", "wb")
        lock(_use, shared=True, wait=False)
        os.utime(folder / COMPLETE)
    except OSError:
        pass  # a cache that is only read


def remove_stale(root: Path, keep: Path, older_than: float = STALE_AFTER) -> list[Path]:
    """Remove cache folders of other versions that no process uses and none has for a while."""
    removed = []
    for folder in root.glob(f"{FOLDER_PREFIX}*"):
        if folder == keep or not folder.is_dir():
            continue
        try:
            marker = folder / COMPLETE
            last = (marker if marker.exists() else folder).stat().st_mtime
            if time.time() - last < older_than:
                continue
            with open(folder / "use", "ab") as use, open(folder / "lock", "ab") as held:
                if not lock(use, shared=False, wait=False):
                    continue
                if not lock(held, shared=False, wait=False):
                    continue
                shutil.rmtree(folder, ignore_errors=True)
                removed.append(folder)
        except OSError:
            continue
    return removed


def _small_train() -> TrainParams:
    coupler = CouplerType("F79", "F", 1.092, 0.788, 0.170, 3.15e6)
    cars = tuple(
        Car(
            mass=80e3,
            inertia=1e6,
            length=12.0,
            width=2.6,
            pivot_distance=5.9,
            truck_distance=4.8,
            front=coupler,
            rear=coupler,
            brakes=(BrakeUnit(distance=14.0 * i, weight=80e3),),
        )
        for i in range(3)
    )
    return TrainParams(cars=cars, initiation=InitiationParams(speed=10.0))


def _exercise(before_steps: Callable[[], object] = lambda: None) -> None:
    """Run a train of three cars for a moment, through every kernel a run uses."""
    from derail_ros.engine.simulation import PlanarSimulation

    run = PlanarSimulation(_small_train())
    before_steps()
    run.advance_to(0.01)
    run.sample()
    run.sample(0.5 * (run.previous_time + run.time))
    run.outcome()


def _types() -> tuple[Any, Any, Any]:
    """Types of the arrays of a run, as the kernels see them."""
    from numba import typeof

    from derail_ros.engine.arrays import make_work
    from derail_ros.engine.build import build_model, initial_state
    from derail_ros.engine.track import Track

    params = _small_train()
    track = Track(params.track)
    model = build_model(params, track)
    state = initial_state(params, model, track)
    work = make_work(len(params.cars), len(state.pairs), 64, False)
    return typeof(model), typeof(state), typeof(work)


def stepping() -> list[tuple[Any, tuple[Any, ...]]]:
    """The parts of ``advance`` that evaluate no forces, each with the types of its arguments."""
    from numba import float64, int64

    from derail_ros.engine import (
        contacts,
        energy,
        events,
        interpolation,
        neighbours,
        runge_kutta,
        stepper,
    )

    m, s, w = _types()
    table, row = float64[:, ::1], float64[::1]
    return [
        # first, for the stages want its friction, which is then in the cache
        (stepper.plan_step, (m, s, w)),
        (contacts.track_contacts, (m, s, w, float64, float64)),
        (events.remove_constraints, (m, s, w)),
        (runge_kutta.step_error, (m, s, w, float64, int64)),
        (events.note_progress, (m, s, w)),
        (stepper.locate_moment, (m, s, w)),
        (neighbours.refresh_active, (m, s, w)),
        (stepper.locate_overload, (m, s, w)),
        (stepper.take_over, (m, s, w)),
        (stepper.reject, (m, s, w, int64)),
        (energy.energy_residual, (m, s)),
        (interpolation.interpolate, (s, float64, table, table, table)),
        (interpolation.interpolate_energy, (s, float64, row)),
    ]


def compile_stepping() -> None:
    """Compile the parts of ``advance`` that evaluate no forces."""
    for kernel, types in stepping():
        kernel.compile(types)


def compile_stages() -> None:
    """Compile the stages of a step, which evaluate forces."""
    from numba import float64

    from derail_ros.engine import runge_kutta

    runge_kutta.take_stages.compile((*_types(), float64))


def be_second_process() -> None:
    """Compile the stepping, and end at once if the process that asked for it is gone."""

    def watch() -> None:
        os.read(0, 1)  # nothing is written there: it ends with its writer
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
    _ready.set()
    compile_stepping()


@contextmanager
def _second_process() -> Iterator[Callable[[], object]]:
    """Compile the stepping beside the forces; gives what waits for it.

    The second process leaves what it compiled in the cache. What it did not is compiled here.
    """
    if (os.cpu_count() or 1) < 2:
        yield lambda: None
        return
    code = (
        f"import sys; sys.path[:] = {sys.path!r}\n"
        "from derail_ros.engine import warming\n"
        "warming.be_second_process()"
    )
    try:
        process = subprocess.Popen(
            [sys.executable, "-c", code],
            stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
    except OSError:
        yield lambda: None
        return
    try:
        yield process.wait
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()
        if process.stdin is not None:
            process.stdin.close()


def _compile(say: Callable[[str], None]) -> None:
    marker = CACHE_DIR / COMPLETE
    if not CAN_KEEP:
        say(
            f"{CACHE_DIR} cannot be written: the kernels are compiled at each start (about half a "
            "minute); set DERAIL_CACHE_DIR to a folder that can"
        )
        _exercise()
        return
    with _only_one(CACHE_DIR, say):
        if marker.exists():
            return
        say(f"compiling the kernels for this machine, once (about half a minute; {CACHE_DIR})")
        began = time.perf_counter()
        with _second_process() as wait:

            def before_steps() -> None:
                compile_stages()
                wait()

            _exercise(before_steps)
        say(f"compiled in {time.perf_counter() - began:.0f} s")
        try:
            marker.touch()
        except OSError:
            return
        remove_stale(CACHE_DIR.parent, CACHE_DIR)


def ensure_compiled(say: Callable[[str], None] | None = None) -> None:
    """Compile the kernels unless the cache holds them; ``say`` gets messages if so.

    Every run calls this when it is built; after the first time it costs nothing. Messages go to
    the standard error if nobody asks for them.
    """
    if _ready.is_set() or getattr(_state, "inside", False):
        return
    with _mutex:
        if _ready.is_set():
            return
        _state.inside = True
        try:
            if not (CAN_KEEP and (CACHE_DIR / COMPLETE).exists()):
                _compile(say or _say)
            _hold(CACHE_DIR)
            _ready.set()
        finally:
            _state.inside = False


def warm_up(callback: Callable[[str], Any] | None = None) -> None:
    """Compile all kernels, or load them from the cache.

    ``callback`` is told, in a sentence, when compiling begins and ends; nothing is said when the
    cache is complete. Without one the messages go to the standard error.
    """
    ensure_compiled(callback)
    _exercise()
