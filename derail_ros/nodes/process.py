"""What a node's process needs: signals, a clean beginning and a clean end."""

from __future__ import annotations

import contextlib
import gc
import os
import re
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import Any

try:
    import fcntl
except ImportError:  # no POSIX, and no shared memory of this kind
    fcntl = None  # type: ignore[assignment]


SERVICE_DEPTH = 100
"""Requests of a service that may wait, and answers that may be on their way. With the usual depth
of 10 the middleware drops the others without a word."""


def service_qos() -> Any:
    """The quality of service of a node's services."""
    from rclpy.qos import QoSProfile

    return QoSProfile(depth=SERVICE_DEPTH)


class Stop:
    """A request to end, set by SIGINT or SIGTERM.

    The handlers of ``rclpy`` shut the context down in the middle of a callback; with these a node
    ends between two rounds of its loop.
    """

    def __init__(self) -> None:
        self.asked = False
        self.interrupts = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._handle)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.asked = True
        if self.interrupts:
            raise Interrupted

    def during(self, work: Callable[[], Any]) -> Any:
        """Do work that takes long and may be broken off by a signal.

        Raises
        ------
        Interrupted
            If a signal came before or meanwhile.
        """
        self.interrupts = True
        try:
            if self.asked:
                raise Interrupted
            return work()
        finally:
            self.interrupts = False


class StartError(Exception):
    """A node cannot start, for a reason that the user can mend."""


@contextlib.contextmanager
def starting() -> Iterator[None]:
    """What goes wrong in here is told in a line instead of a traceback."""
    try:
        yield
    except (ValueError, RuntimeError, OSError) as error:
        raise StartError(str(error)) from error


class Interrupted(BaseException):
    """A signal came during work that may be broken off."""


SHARED_MEMORY = Path("/dev/shm")
SEGMENT_LOCK = re.compile(r"(fastdds_[0-9a-f]{16})_el")
YOUNG = 5.0
"""A segment of shared memory is left alone for so long: its process may be about to lock it, s."""


def sweep_shared_memory(folder: Path = SHARED_MEMORY) -> int:
    """Remove what killed processes have left of Fast DDS; returns the number of segments.

    Each process holds the lock of its segment (half a megabyte) until it ends, whatever ends it;
    a segment whose lock is free belongs to nobody. Fast DDS removes it only if another process
    that has known it lives on.
    """
    if fcntl is None or not folder.is_dir():
        return 0
    removed = 0
    for lock in folder.iterdir():
        found = SEGMENT_LOCK.fullmatch(lock.name)
        if found is None:
            continue
        # Somebody else's, or gone meanwhile: not ours to tidy.
        with contextlib.suppress(OSError), lock.open("rb") as stream:
            if time.time() - os.fstat(stream.fileno()).st_mtime < YOUNG:
                continue
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            (folder / found[1]).unlink(missing_ok=True)
            lock.unlink()
            removed += 1
    return removed


def run_node(
    run: Callable[[Stop, Sequence[str]], int], argv: Sequence[str] | None, usage: Callable[[], str]
) -> int:
    """Run a node's main function; returns the exit code of the process."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if {"-h", "--help"} & set(arguments):
        print(usage())
        return 0
    stop = Stop()
    sweep_shared_memory()
    try:
        return run(stop, arguments)
    except Interrupted:
        return 0
    except StartError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    finally:
        # Whatever happened, nothing of DDS stays behind in shared memory. What the node held is
        # let go while the interpreter is whole, not when it is half taken down.
        gc.collect()
        rclpy = sys.modules.get("rclpy")
        if rclpy is not None:
            rclpy.try_shutdown()
