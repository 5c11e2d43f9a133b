"""``derail animate``: a film of a recording."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from derail_ros.commands import common
from derail_ros.commands.common import OK, CommandFailure
from derail_ros.commands.options import Bag, Namespace, WhichRun, written
from derail_ros.commands.review import bag_errors, read


def check_times(start: float | None, end: float | None, first: float, last: float) -> None:
    """Refuse a stretch of time that holds nothing of a recording from ``first`` to ``last``, s."""
    runs = f"the recording runs from {first:g} s to {last:g} s"
    if start is not None and not start < last:
        raise CommandFailure(f"--start: {start:g} s is not before its end: {runs}")
    if end is not None and not end > first:
        raise CommandFailure(f"--end: {end:g} s is not after its beginning: {runs}")
    if start is not None and end is not None and not start < end:
        raise CommandFailure(f"--end: {end:g} s is not after --start, {start:g} s")


def run(
    bag: Bag,
    output: Annotated[Path, written("Film to write; its name ends in .mp4 or .gif.", "FILE")],
    run: WhichRun = None,
    namespace: Namespace = None,
    fps: Annotated[
        int | None, typer.Option(min=1, max=60, help="Pictures per second [20; GIF: 8].")
    ] = None,
    rate: Annotated[
        float | None, typer.Option(help="Recorded time per time of the film [1; GIF: 2].")
    ] = None,
    width: Annotated[
        int | None, typer.Option(min=320, max=3840, help="Width, pixels [960; GIF: 640].")
    ] = None,
    start: Annotated[float | None, typer.Option(help="Begin at this time, s.")] = None,
    end: Annotated[float | None, typer.Option(help="End at this time, s.")] = None,
) -> int:
    """Make a film of a recording, seen from above."""
    from derail_ros.review.film import FilmError, film, kind_of

    try:
        kind_of(output)
        found = read(bag, run, namespace)
        check_times(start, end, float(found.time[0]), float(found.time[-1]))
        with bag_errors(), common.progress(*common.counting_columns()) as bars:
            output.parent.mkdir(parents=True, exist_ok=True)
            task = bars.add_task(output.name, total=None)

            def tell(done: int, total: int) -> None:
                bars.update(task, completed=done, total=total)

            count = film(found, output, fps, rate, width, start, end, tell)
    except FilmError as error:
        raise CommandFailure(str(error)) from None
    print(f"{output}: {count} pictures, {output.stat().st_size / 1e6:.1f} MB")
    return OK
