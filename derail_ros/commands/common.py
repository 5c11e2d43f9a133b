"""Shared by the commands: errors, output, progress."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from derail_ros.vocabulary.params import PLANAR
from derail_ros.vocabulary.words import count

if TYPE_CHECKING:
    from rich.console import Console

    from derail_ros.scenario import Scenario
    from derail_ros.studies.tables import Table

OK = 0
BAD_INPUT = 2
FAILED = 3
INTERRUPTED = 130


class CommandFailure(Exception):
    """The command ends with this one line on stderr and this exit code."""

    def __init__(self, message: str, code: int = BAD_INPUT) -> None:
        super().__init__(message)
        self.code = code


@contextmanager
def refusing(*kinds: type[Exception], at: object = "", code: int = BAD_INPUT) -> Iterator[None]:
    """Report errors of these kinds in one line, behind ``at``, the place of the mistake."""
    try:
        yield
    except kinds as error:
        text = (isinstance(error, OSError) and error.strerror) or str(error)
        raise CommandFailure(f"{at}: {text}" if at else text, code) from None


def err() -> Console:
    """Console for messages beside the answer."""
    from rich.console import Console

    return Console(stderr=True, highlight=False)


def out() -> Console:
    """Console for the answer, wide enough to keep tables whole in files and pipes."""
    from rich.console import Console

    console = Console(highlight=False)
    if not console.is_terminal:
        console.width = max(console.width, 120)
    return console


def note(message: str) -> None:
    """A line on stderr beside the answer."""
    print(message, file=sys.stderr, flush=True)


def print_json(name: str, value: Mapping[str, Any], version: int = 1) -> None:
    """Print one JSON object, with the name and version of its schema unless it has them.

    NaN and infinity are a defect and never printed.
    """
    print(_json({"schema": f"derail_ros/{name}", "schema_version": version, **value}))


def _json(value: Mapping[str, Any]) -> str:
    return json.dumps(value, allow_nan=False, ensure_ascii=False, indent=2)


def overrides(settings: Sequence[str] | None) -> dict[str, Any]:
    """``path=value`` settings: path -> value."""
    from derail_ros.scenario import parse_set

    return dict(parse_set(text) for text in settings or ())


def load(name_or_file: str, settings: Sequence[str] | None = None) -> Scenario:
    """Load a scenario and apply ``path=value`` settings.

    Raises
    ------
    ScenarioError
        Naming file, line and field.
    """
    from derail_ros.scenario import load_scenario

    scenario = load_scenario(name_or_file)
    return scenario.with_overrides(overrides(settings)) if settings else scenario


def warm_up(model: str = PLANAR) -> None:
    """Have the engine's kernels ready, saying so if they must be compiled first."""
    from derail_ros import models

    models.engine(model).warm_up(lambda text: note(f"derail: {text}"))


PLAIN_S = 10.0
"""Between two lines of progress where there is no terminal, s."""


@contextmanager
def progress(*columns: Any) -> Iterator[Any]:
    """A rich progress display on stderr; where that is no terminal, a line now and then."""
    from rich.progress import Progress

    console = err()
    if not console.is_terminal:
        yield PlainProgress()
        return
    with Progress(*columns, console=console, transient=True) as bars:
        yield bars


class PlainProgress:
    """Progress for files and pipes: a line every :data:`PLAIN_S`, none for what is quick."""

    def __init__(self) -> None:
        self._tasks: list[dict[str, Any]] = []
        self._said = time.monotonic()

    def add_task(
        self,
        description: str,
        *,
        total: float | None = None,
        completed: float = 0,
        state: str = "",
    ) -> int:
        """Begin a task; its number."""
        self._tasks.append(
            {"name": description, "total": total, "completed": completed, "state": state,
             "began": time.monotonic(), "before": completed}
        )  # fmt: skip
        return len(self._tasks) - 1

    def update(self, task: int, *, advance: float = 0, **now: Any) -> None:
        """Take in how far a task is, and say so if nothing was said for long."""
        it = self._tasks[task]
        it |= {("name" if key == "description" else key): value for key, value in now.items()}
        it["completed"] += advance
        moment = time.monotonic()
        if moment - self._said < PLAIN_S:
            return
        self._said = moment
        done = "" if it["total"] is None else f"{it['completed']:g} of {it['total']:g}"
        words = (done, it["state"], _left(it, moment))
        note(f"derail: {it['name']}: {', '.join(w for w in words if w)}")


def _left(task: Mapping[str, Any], moment: float) -> str:
    """About how long a task goes on, by what was done since it began; "" at its end or before."""
    done = task["completed"] - task["before"]
    if task["total"] is None or done <= 0.0 or task["completed"] >= task["total"]:
        return ""
    left = (task["total"] - task["completed"]) * (moment - task["began"]) / done
    return f"about {left / 60.0:.0f} min left" if left >= 90.0 else f"about {left:.0f} s left"


def counting_columns() -> list[Any]:
    """Columns of a progress display that counts runs."""
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    return [
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    ]


def spinner_columns() -> list[Any]:
    """Columns of a progress display of something whose end is not known."""
    from rich.progress import SpinnerColumn, TextColumn, TimeElapsedColumn

    text = TextColumn("{task.description} {task.fields[state]}")
    return [SpinnerColumn(), text, TimeElapsedColumn()]


@contextmanager
def counting_runs(title: str) -> Iterator[Callable[[int, int], None]]:
    """Have the engine ready; gives what shows ``(runs done, runs in all)``."""
    warm_up()
    with progress(*counting_columns()) as bars:
        task = bars.add_task(title, total=None)
        yield lambda done, total: bars.update(task, completed=done, total=total)


def print_tables(*tables: Table) -> None:
    """Print tables, an empty line after each; they stay whole in files and pipes."""
    console = out()
    for table in tables:
        if table.title:
            console.print(table.title, style="italic", markup=False, soft_wrap=True)
        shown = table.rich()
        if not console.is_terminal:
            console.width = max(console.width, console.measure(shown).maximum)
        console.print(shown)
        console.print()


def exit_code(failed: int, errors: Iterable[str]) -> int:
    """The exit code of a command of many runs; reports the runs that failed."""
    if failed:
        note(f"derail: {count(failed, 'run')} failed: {'; '.join(sorted(set(errors)))}")
    return FAILED if failed else OK


def need_extra(what: str, extra: str, *modules: str) -> None:
    """Refuse to go on without the packages of an extra."""
    import importlib.util

    for module in modules:
        if importlib.util.find_spec(module) is None:
            raise CommandFailure(
                f"{what} needs the extra '{extra}': pip install 'derail_ros[{extra}]' "
                f"({module} is missing)"
            )


def write_json(path: Path, value: Mapping[str, Any]) -> None:
    """Write one JSON object to a file."""
    path.write_text(_json(value) + "\n", encoding="utf-8")


def output_directory(path: Path) -> Path:
    """Make a folder for results; one with something in it is refused, results are not mixed."""
    with refusing(OSError, at=path):
        path.mkdir(parents=True, exist_ok=True)
        if any(path.iterdir()):
            raise CommandFailure(f"{path}: is not empty; choose another folder or empty it")
    return path
