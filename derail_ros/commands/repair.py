"""``derail repair``: a recording whose recorder was killed, made whole."""

from __future__ import annotations

from pathlib import Path

from derail_ros.commands.common import OK, note
from derail_ros.commands.review import bag_errors, warn


def run(bag: str, output: Path | None) -> int:
    """Repair a recording; the exit code."""
    from derail_ros.review.repair import repair

    with bag_errors():
        done = repair(bag, output)
    warn(done.warnings, Path(bag))
    if done.was_whole:
        note(f"derail: {bag}: index and metadata were there; this is a copy")
    total = sum(done.counts.values())
    print(
        f"{done.path}: {total} messages on {len(done.counts)} topics,"
        f" {done.first * 1e-9:.2f} s to {done.last * 1e-9:.2f} s"
    )
    return OK
