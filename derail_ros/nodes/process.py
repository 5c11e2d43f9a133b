"""The process of a node: start, signals, the loop, the end, the exit code."""

from __future__ import annotations

import contextlib
import gc
import importlib
import os
import signal
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from types import FrameType
from typing import Any

from derail_ros.nodes.shared_memory import sweep

OK = 0
"""Exit code: the node has ended as it was told to."""
FAILED = 1
"""Exit code: the node could not start, its run has failed, or a recording is not whole."""

PROGRAMS = {
    "simulator": ("simulator_node", "Simulator"),
    "recorder": ("recorder_node", "Recorder"),
    "player": ("player_node", "Player"),
}
"""Node -> module and class of its program. They are imported once signals are heeded: importing
takes a second or two, and a signal meanwhile must end the process quietly."""


AGAIN = 0.02
"""Wall time after which a signal that came at a bad moment comes again, s."""


class NodeError(Exception):
    """A node cannot start, or has not done all it was asked to; the text is one line."""


class Interrupted(BaseException):
    """A signal arrived during work that may be interrupted."""


@contextlib.contextmanager
def starting() -> Iterator[None]:
    """Report errors of a start in one line, without a traceback."""
    try:
        yield
    except (ValueError, RuntimeError, OSError) as error:
        raise NodeError(str(error)) from error


def _in_compiler(frame: FrameType | None) -> bool:
    """Whether LLVM has called back: it swallows an exception, and its traceback is printed."""
    while frame is not None:
        if frame.f_globals.get("__name__", "").startswith("llvmlite.binding"):
            return True
        frame = frame.f_back
    return False


class Stop:
    """A request to end, set by SIGINT or SIGTERM.

    ``rclpy``'s own handlers shut the context down in the middle of a callback. These let a node
    end between two rounds of its loop.
    """

    def __init__(self) -> None:
        self.asked = False
        self._raises = False
        self._leaves = False
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGALRM):
            signal.signal(number, self._handle)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.asked = True
        if self._leaves:
            os._exit(OK)
        if self._raises and _in_compiler(frame):
            signal.setitimer(signal.ITIMER_REAL, AGAIN)
        elif self._raises:
            raise Interrupted

    def importing(self, module: str) -> Any:
        """Import a module; a signal meanwhile ends the process at once, for nothing is open yet.

        An exception in the middle of an import would surface as a traceback of whatever is
        imported just then.
        """
        self._leaves = True
        try:
            return importlib.import_module(module)
        finally:
            self._leaves = False

    def during(self, work: Callable[[], Any]) -> Any:
        """Do long work; a signal before or meanwhile raises :class:`Interrupted`."""
        self._raises = True
        others = sys.unraisablehook
        sys.unraisablehook = lambda told: self._lost(told, others)
        try:
            if self.asked:
                raise Interrupted
            return work()
        finally:
            self._raises = False
            sys.unraisablehook = others

    @staticmethod
    def _lost(told: Any, others: Callable[[Any], object]) -> None:
        """Take an exception from where none can go on, as in the callback of a weak reference.

        The interpreter drops such an :class:`Interrupted`; the signal comes again.
        """
        if isinstance(told.exc_value, Interrupted):
            signal.setitimer(signal.ITIMER_REAL, AGAIN)
        else:
            others(told)


class Program(ABC):
    """What a node does; :func:`run_node` makes it with a node of ``rclpy`` and drives it."""

    fault = ""
    """Why something that was asked for is not whole: told at the end, which is a failure."""

    def __init__(self, node: Any) -> None:
        self.node = node
        self.log = node.get_logger()

    @abstractmethod
    def start(self, stop: Stop) -> None:
        """Finish the start; the node is on the graph."""

    @abstractmethod
    def work(self) -> float:
        """Do the work that is due; return the wall time (s) of the next work."""

    def wait(self, executor: Any, due: float) -> None:
        """Serve requests and messages until something is due (wall time, s)."""
        executor.spin_once(timeout_sec=max(0.0, due - time.monotonic()))

    @property
    @abstractmethod
    def exit_code(self) -> int | None:
        """Exit code if the node should end by itself, else None."""

    @abstractmethod
    def close(self) -> None:
        """Finish; called once, however the node ends."""


def run_node(name: str, argv: Sequence[str] | None = None) -> int:
    """Run a node until it ends or is told to; returns the exit code of the process."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    stop = Stop()
    if {"-h", "--help"} & set(arguments):
        print(stop.importing("derail_ros.nodes.declaration").usage(name))
        return OK
    try:
        _check_arguments(arguments, stop.importing("rclpy.utilities"))
        stop.importing("rclpy.executors")
        module, program = PROGRAMS[name]
        make = getattr(stop.importing(f"derail_ros.nodes.{module}"), program)
        sweep()
        return _drive(name, make, arguments, stop)
    except Interrupted:
        return OK
    except NodeError as error:
        print(f"error: {error}", file=sys.stderr)
        return FAILED
    finally:
        # Collect the node while the interpreter is whole; DDS must leave nothing in shared memory.
        gc.collect()
        rclpy = sys.modules.get("rclpy")
        if rclpy is not None:
            rclpy.try_shutdown()


def _check_arguments(arguments: list[str], utilities: Any) -> None:
    """Refuse what no node looks at: a scenario or a parameter given in another way."""
    with starting():
        left = utilities.remove_ros_args(["", *arguments])[1:]
    if left:
        raise NodeError(
            f"unknown argument {left[0]}; parameters are given as --ros-args -p NAME:=VALUE"
        )


def _drive(name: str, make: Callable[[Any], Program], arguments: list[str], stop: Stop) -> int:
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.signals import SignalHandlerOptions

    with starting():
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
        executor = SingleThreadedExecutor()
        node = rclpy.create_node(name)
        program = make(node)
    executor.add_node(node)
    code = None
    try:
        program.start(stop)
        while not stop.asked:
            due = program.work()
            code = program.exit_code
            if code is not None:
                break
            program.wait(executor, due)
        for _ in range(3):  # answers that are ready
            executor.spin_once(timeout_sec=0.0)
    finally:
        program.close()
        executor.shutdown()
        node.destroy_node()
    if program.fault:
        raise NodeError(program.fault)
    return OK if code is None else code
