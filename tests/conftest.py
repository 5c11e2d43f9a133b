"""What the end of a test run says, and signals for the processes that tests start."""

from __future__ import annotations

import cProfile
import gc
import json
import signal
from collections.abc import Callable
from typing import Any, NamedTuple

import pytest

# A shell makes what it runs in the background ignore Ctrl-C, and so would every process that the
# tests start and interrupt.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

UNCHECKED = "NOT CHECKED: "
"""Beginning of the reason for skipping a test that needs what is not installed here."""
BROWSER = "the replay page"
"""What is not checked without a browser."""


@pytest.fixture
def calls() -> Callable[[Callable[[], Any]], int]:
    """Return a counter of the function calls that a piece of work takes.

    The count measures work on any machine and under any load, which a time does not.
    """

    def count(work: Callable[[], Any]) -> int:
        profile = cProfile.Profile()
        profile.runcall(work)
        return sum(entry.callcount for entry in profile.getstats())

    return count


class Answer(NamedTuple):
    """What a command answered."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        """The answer to ``--json``."""
        return json.loads(self.out)


@pytest.fixture
def derail(capsys: pytest.CaptureFixture[str]) -> Callable[..., Answer]:
    """The command line as a function of its arguments."""
    from derail_ros.cli import main

    def call(*arguments: object) -> Answer:
        capsys.readouterr()
        code = main([str(a) for a in arguments])
        return Answer(code, *capsys.readouterr())

    return call


def pytest_collection_finish() -> None:
    """Spare the garbage collector what was imported: a tenth of the tests' processor time."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 20)


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Say where nobody can overlook it what was left out for lack of a tool."""
    reasons = [str(report.longrepr[2]) for report in terminalreporter.stats.get("skipped", [])]
    missing = {reason.split(UNCHECKED, 1)[1] for reason in reasons if UNCHECKED in reason}
    if not missing:
        return
    terminalreporter.section("NOT CHECKED HERE", sep="!", red=True, bold=True)
    for text in sorted(missing):
        verify = " (`make verify` fails without it)" if text.startswith(BROWSER) else ""
        terminalreporter.line(f"{text[0].upper()}{text[1:]}{verify}", red=True)
