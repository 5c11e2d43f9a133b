"""``derail review``: what happened in a recording, as text, figures and a replay page."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from derail_ros.commands import common
from derail_ros.commands.common import OK, CommandFailure, note
from derail_ros.commands.options import Bag, Json, Namespace, NewDir, WhichRun

if TYPE_CHECKING:
    from derail_ros.recording.recorded_run import RecordedRun


def read(path: str | Path, run: str | None = None, namespace: str | None = None) -> RecordedRun:
    """Read a recording; what is wrong with it goes to stderr.

    Raises
    ------
    CommandFailure
        If it cannot be read.
    """
    from derail_ros.recording.reader import read_bag

    with bag_errors():
        found = read_bag(path, run, namespace)
    warn(found.warnings, found.path)
    return found


@contextmanager
def bag_errors() -> Iterator[None]:
    """Turn what is wrong with a recording or a disk into a line for the user."""
    from derail_ros.recording.storage import BagError

    try:
        yield
    except BagError as error:
        raise CommandFailure(str(error)) from None
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        raise CommandFailure(f"{place}{error.strerror or error}") from None


def warn(warnings: Iterable[str], path: Path) -> None:
    """Print warnings on a recording."""
    for warning in warnings:
        note(f"derail: warning: {path}: {warning}")


def run(
    bag: Bag,
    output: NewDir,
    run: WhichRun = None,
    namespace: Namespace = None,
    figures: Annotated[bool, typer.Option(help="Draw the figures.")] = True,
    replay: Annotated[bool, typer.Option(help="Write the replay page.")] = True,
    as_json: Json = False,
) -> int:
    """Summarize a recording: text, JSON, figures and a replay page."""
    from derail_ros.review import summary

    found = read(bag, run, namespace)
    output = common.output_directory(output)
    facts = summary.findings(found)
    with bag_errors():
        common.write_json(output / "summary.json", facts)
        text = summary.text(found, facts)
        (output / "summary.txt").write_text(text, encoding="utf-8")
        written = ["summary.txt", "summary.json"]
        if replay:
            from derail_ros.review import replay_page as page

            page.write(found, output / "replay.html", facts)
            written.append("replay.html")
        if figures:
            written += write_figures(found, output)
    if as_json:
        common.print_json("review", facts)
        return OK
    print(found.title)
    for sentence in summary.headline(found):
        print(sentence)
    print(f"in {output}: {', '.join(written)}")
    return OK


def write_figures(found: RecordedRun, output: Path) -> list[str]:
    """Draw the figures of a run and return their names."""
    from derail_ros.review import drawing, figures, plots
    from derail_ros.review.scene import final_scene

    paths = figures.save_outcome(final_scene(found), found.outcome, output)
    drawn = {
        f"collision_{k}": plots.collision(found, c)
        for k, c in enumerate(plots.main_collisions(found), 1)
    }
    drawn["speeds"] = plots.speeds(found)
    drawn["energy"] = plots.energy_over_time(found)
    drawn["space_time"] = plots.space_time(found)
    paths += [drawing.save(f, output / f"{name}.png") for name, f in drawn.items() if f]
    return [path.name for path in paths]
