"""Compile all kernels, or load them from the cache, before they are needed.

Kernels are compiled once for a machine and a version of the sources (see ``jit``), which takes
about a minute. Whoever builds the first run does it for all: other processes wait for a file lock
and then load the cache. A marker in the cache folder says that it is complete.
"""

from __future__ import annotations

import os
import shutil
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


def small_train() -> TrainParams:
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


def _exercise() -> None:
    """Run a train of three cars for a moment, through every kernel a run uses."""
    from derail_ros.engine.simulation import PlanarSimulation

    run = PlanarSimulation(small_train())
    run.advance_to(0.01)
    run.sample()
    run.sample(0.5 * (run.previous_time + run.time))
    run.outcome()


def _compile(say: Callable[[str], None]) -> None:
    marker = CACHE_DIR / COMPLETE
    if not CAN_KEEP:
        say(
            f"{CACHE_DIR} cannot be written: the kernels are compiled at each start (about a "
            "minute); set DERAIL_CACHE_DIR to a folder that can"
        )
        _exercise()
        return
    with _only_one(CACHE_DIR, say):
        if marker.exists():
            return
        say(f"compiling the kernels for this machine, once (about a minute; {CACHE_DIR})")
        began = time.perf_counter()
        _exercise()
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
