"""``derail repair``: a recording whose recorder was killed, made whole."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from derail_ros.commands.common import OK
from derail_ros.commands.options import Bag, written
from derail_ros.commands.review import bag_errors, warn
from derail_ros.vocabulary.words import count


def run(
    bag: Bag,
    output: Annotated[
        Path | None, written("New folder for the repaired recording; default: BAG_repaired.")
    ] = None,
) -> int:
    """Write a whole recording from one whose recorder was killed."""
    from derail_ros.recording.repair import repair

    with bag_errors():
        done = repair(bag, output)
    warn(done.warnings, Path(bag))
    total = sum(done.counts.values())
    if done.was_whole:
        print(
            f"{done.path}: whole, with {count(total, 'message')}: "
            "nothing to repair, nothing written"
        )
        return OK
    print(
        f"{done.path}: {count(total, 'message')} on {count(len(done.counts), 'topic')},"
        f" {done.span[0] * 1e-9:.2f} s to {done.span[1] * 1e-9:.2f} s"
    )
    return OK
