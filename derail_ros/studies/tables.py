"""One table of texts, written as Markdown, as HTML or on a terminal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import rich.table


class Strong(str):
    """The text of a cell that is printed in bold."""


@dataclass(frozen=True)
class Table:
    """A table."""

    heads: Sequence[str]
    rows: Sequence[Sequence[str]]
    title: str = ""
    # leading columns of text, aligned left as those without a heading; others are numbers
    texts: int = 1

    def _is_text(self, column: int) -> bool:
        return column < self.texts or not self.heads[column]

    def markdown(self) -> str:
        """As lines of Markdown, without the title."""
        rule = ["---" if self._is_text(i) else "---:" for i in range(len(self.heads))]
        rows = [[f"**{c}**" if isinstance(c, Strong) else c for c in row] for row in self.rows]
        return "\n".join("| " + " | ".join(cells) + " |" for cells in (self.heads, rule, *rows))

    def rich(self) -> rich.table.Table:
        """For a rich console, without the title."""
        from rich.markup import escape as literal
        from rich.table import Table as RichTable

        table = RichTable(box=None, pad_edge=False)
        for i, head in enumerate(self.heads):
            text = self._is_text(i)
            table.add_column(literal(head), justify="left" if text else "right", no_wrap=i == 0)
        for row in self.rows:
            cells = [
                f"[bold]{literal(c)}[/]" if isinstance(c, Strong) else literal(c) for c in row
            ]
            table.add_row(*cells)
        return table

    def html(self) -> str:
        """As HTML; the leading columns of text are headings of their rows."""
        title = escape(self.title)

        def cell(i: int, text: str, head: bool) -> str:
            row_head = not head and i < self.texts
            tag = "th" if head or row_head else "td"
            scope = ' scope="col"' if head else ' scope="row"' if row_head else ""
            kind = ' class="text"' if i < self.texts else ""
            return f"<{tag}{scope}{kind}>{escape(text)}</{tag}>"

        def line(cells: Sequence[str], head: bool = False) -> str:
            return "<tr>" + "".join(cell(i, c, head) for i, c in enumerate(cells)) + "</tr>"

        return (
            f'<div class="scroll" role="region" tabindex="0" aria-label="{title}">'
            f"<table><caption>{title}</caption><thead>{line(self.heads, True)}</thead>"
            f"<tbody>{''.join(map(line, self.rows))}</tbody></table></div>"
        )
