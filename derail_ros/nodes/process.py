"""What a node's process needs: signals, a clean beginning and a clean end."""

from __future__ import annotations

import contextlib
import gc
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from types import FrameType
from typing import Any


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


def run_node(
    run: Callable[[Stop, Sequence[str]], int], argv: Sequence[str] | None, usage: Callable[[], str]
) -> int:
    """Run a node's main function; returns the exit code of the process."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if {"-h", "--help"} & set(arguments):
        print(usage())
        return 0
    stop = Stop()
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
