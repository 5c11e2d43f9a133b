"""Shared by the pages: options, folders, paragraphs, and results between marks."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from derail_ros.commands.common import CommandFailure, note
from derail_ros.review.drawing import save
from derail_ros.studies.tables import Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
DPI = 100
"""Of the figures: sharp enough to read, small enough to keep in git."""

PALE = "#cfe3f1"
BAND = "#9ecae9"
"""Colours of bands: the middle 90 %, the middle half."""

BEGIN = "<!-- results: {} -->"
END = "<!-- end of results -->"


@dataclass(frozen=True)
class Options:
    """What the command line gives."""

    page: Path
    names: tuple[str, ...] = ()  # what else is named: scenarios, studies, files
    members: int | None = None  # runs each; None: the page's own number
    seed: int = 0
    jobs: int | None = None  # runs at a time
    results: Path | None = None  # folder of results that are there (studies, bank)
    check: bool = False  # calibration: compare this engine with the bank's

    def images(self) -> Path:
        """The folder ``images`` beside the page, made if it is not there."""
        if not self.page.parent.is_dir():
            raise CommandFailure(f"{self.page}: there is no folder {self.page.parent}")
        folder = self.page.parent / "images"
        folder.mkdir(exist_ok=True)
        return folder

    def write(self, text: str, figures: Mapping[str, Figure], dpi: int = DPI) -> None:
        """Write the page and its figures."""
        for name, figure in figures.items():
            save(figure, self.images() / name, dpi=dpi)
        self.page.write_text(text, encoding="utf-8")
        note(f"research: wrote {self.page} and {len(figures)} figures in {self.images()}")


def document(*parts: str | Table) -> str:
    """A page: headings, pictures and tables as they are, paragraphs wrapped."""
    blocks = []
    for part in parts:
        if isinstance(part, Table):
            blocks.append(part.markdown())
        elif part.startswith(("#", "![", "|")):
            blocks.append(part)
        else:
            blocks.append("\n".join(textwrap.wrap(part, 99, break_on_hyphens=False)))
    return "\n\n".join(blocks) + "\n"


def picture(name: str, words: str) -> str:
    """A figure of the page."""
    return f"![{words}](images/{name})"


def written_by(name: str) -> str:
    """The line that says what writes the page."""
    return f"Written by `python -m research {name}`; do not edit."


# Results between marks ---------------------------------------------------------------------


def _place(name: str) -> re.Pattern[str]:
    return re.compile(f"({re.escape(BEGIN.format(name))}).*?({re.escape(END)})", re.DOTALL)


def missing_markers(page: str, names: Sequence[str]) -> list[str]:
    """Results for which a page has no place."""
    return [name for name in names if not _place(name).search(page)]


def with_places(path: Path, names: Sequence[str]) -> str:
    """The text of a page that has a place for all results.

    Raises
    ------
    CommandFailure
        There is no such page, or it has no place for one of them.
    """
    if not path.is_file():
        raise CommandFailure(f"{path}: there is no such page")
    text = path.read_text(encoding="utf-8")
    if missing := missing_markers(text, names):
        raise CommandFailure(f"{path}: has no place for the results {', '.join(missing)}")
    return text


def fill(page: str, found: Mapping[str, Any]) -> str:
    """A page with the results between its marks made anew.

    Raises
    ------
    ValueError
        The page has no place for one of them.
    """
    if missing := missing_markers(page, list(found)):
        raise ValueError(f"has no place for the results {', '.join(missing)}")
    for name, text in found.items():
        text = text.markdown() if isinstance(text, Table) else text
        page = _place(name).sub(lambda m, text=text: f"{m[1]}\n\n{text}\n\n{m[2]}", page, 1)
    return page
