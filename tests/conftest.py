"""What the end of a test run says, and signals for the processes that tests start."""

from __future__ import annotations

import cProfile
import signal
from collections.abc import Callable
from typing import Any

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
