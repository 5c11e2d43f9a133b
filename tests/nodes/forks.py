"""Node processes without a cold start: forks of one that has imported them and has the kernels.

Starting Python, importing numba and loading the kernels is most of what a short test of a node
costs. Tests about starts and signals start Python itself (``Graph.start(fresh=True)``).
"""

from __future__ import annotations

import atexit
import contextlib
import faulthandler
import functools
import gc
import importlib
import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

NODES = ("simulator", "recorder", "player")


class Fork:
    """A forked process, with the part of ``subprocess.Popen`` that tests use."""

    def __init__(self, parent: Parent, pid: int) -> None:
        self._parent, self.pid = parent, pid

    def poll(self) -> int | None:
        self._parent.read(0.0)
        return self._parent.codes.get(self.pid)

    def wait(self, timeout: float = 1e9) -> int:
        end = time.monotonic() + timeout
        while (code := self.poll()) is None:
            if time.monotonic() > end:
                raise subprocess.TimeoutExpired(f"fork {self.pid}", timeout)
            self._parent.read(0.1)
        return code

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


class Parent:
    """The process whose forks the nodes are; it ends with its last user's input."""

    def __init__(self) -> None:
        self.codes: dict[int, int] = {}
        self._made: list[int] = []
        self._process = subprocess.Popen(
            [sys.executable, "-u", "-m", "tests.nodes.forks"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0,
        )  # fmt: skip
        atexit.register(self.close)

    def close(self) -> None:
        """Let the process end."""
        if self._process.stdin is not None:
            self._process.stdin.close()
        self._process.wait(20)

    def read(self, seconds: float) -> None:
        """Take in what the process has told, waiting for at most this long for it."""
        out: Any = self._process.stdout
        while select.select([out], [], [], seconds)[0]:
            line = out.readline()
            assert line, "the process that nodes are forked from is gone"
            told = json.loads(line)
            if "code" in told:
                self.codes[told["pid"]] = told["code"]
            else:
                self._made.append(told["pid"])
            seconds = 0.0

    def fork(self, module: str, arguments: list[str], env: dict[str, str], log: str) -> Fork:
        """Run the ``main`` of a module in a process of its own."""
        stdin: Any = self._process.stdin
        request = {"module": module, "arguments": arguments, "env": env, "log": log}
        stdin.write(json.dumps(request).encode() + b"\n")
        stdin.flush()
        while not self._made:
            self.read(10.0)
        return Fork(self, self._made.pop())


@functools.cache
def parent() -> Parent:
    """The one of this test process."""
    return Parent()


# --- in the process itself -------------------------------------------------------------------


def become(request: dict[str, Any]) -> Callable[[], int]:
    """In a fork: take over environment and output; gives the node's main function."""
    for stream, number in ((sys.stdin, 0), (sys.stdout, 1), (sys.stderr, 2)):
        stream.flush()
        flags = os.O_RDONLY if number == 0 else os.O_WRONLY | os.O_CREAT | os.O_APPEND
        opened = os.open(os.devnull if number == 0 else request["log"], flags)
        os.dup2(opened, number)
        os.close(opened)
    os.environ.clear()
    os.environ.update(request["env"])
    faulthandler.enable()
    main = importlib.import_module(request["module"]).main
    return lambda: int(main(request["arguments"]))


def main() -> int:
    from derail_ros.nodes import loading

    for module in ("rclpy.executors", *(f"derail_ros.nodes.{node}_node" for node in NODES)):
        importlib.import_module(module)
    loading.warm_up("planar")
    gc.collect()
    gc.freeze()  # the collector of a fork need not walk through what was there before
    heard, woken = os.pipe()
    os.set_blocking(woken, False)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.set_wakeup_fd(woken)
    # Ctrl-C at the terminal is for the tests, which end their processes.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    while True:
        ready = select.select([0, heard], [], [])[0]
        if heard in ready:
            os.read(heard, 1000)
            with contextlib.suppress(ChildProcessError):
                while (ended := os.waitpid(-1, os.WNOHANG))[0]:
                    code = os.waitstatus_to_exitcode(ended[1])
                    print(json.dumps({"pid": ended[0], "code": code}), flush=True)
        if 0 in ready:
            line = sys.stdin.readline()
            if not line:
                return 0
            pid = os.fork()
            if pid == 0:
                signal.set_wakeup_fd(-1)
                signal.signal(signal.SIGCHLD, signal.SIG_DFL)
                for number in (signal.SIGINT, signal.SIGTERM):  # as derail_ros.nodes begins
                    signal.signal(number, lambda *_: os._exit(0))
                return become(json.loads(line))()
            print(json.dumps({"pid": pid}), flush=True)


if __name__ == "__main__":
    sys.exit(main())
