"""What the end of a test run says."""

from __future__ import annotations

from typing import Any

UNCHECKED = "THE REPLAY PAGE IS NOT CHECKED"
"""Beginning of the reason for skipping a test that needs a browser."""


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Say where nobody can overlook it what was left out for lack of a browser."""
    reasons = [str(report.longrepr[2]) for report in terminalreporter.stats.get("skipped", [])]
    missing = [reason.split(f"{UNCHECKED}: ")[1] for reason in reasons if UNCHECKED in reason]
    if missing:
        terminalreporter.section("THE REPLAY PAGE WAS NOT CHECKED", sep="!", red=True, bold=True)
        terminalreporter.line(f"{missing[0]}; `make verify` fails without it.", red=True)
