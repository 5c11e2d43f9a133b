"""What the figures of studies add to those of a run: series, grids of panels, error bars."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from derail_ros.review.drawing import BLUE, GREEN, INK, VERMILION, place

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PALE = "#cfe3f1"
BAND = "#9ecae9"
ORANGE = "#e69f00"

SERIES: tuple[tuple[str, str, Any], ...] = (
    (BLUE, "o", "-"),
    (VERMILION, "s", (0, (5, 1.5))),
    (GREEN, "^", (0, (1.5, 1.2))),
    ("#9a5b86", "D", (0, (6, 1.5, 1.5, 1.5))),
    ("#b07a00", "v", "-"),
    (INK, "P", (0, (3, 1))),
    ("#3d8ec0", "X", (0, (1, 2))),
)
"""Colour, mark and dashes of the series of a figure."""


def grid_of(figure: Figure, n: int, columns: int, margins: Sequence[float]) -> list[Axes]:
    """``n`` axes in rows of ``columns``.

    ``margins``: left, right, top, bottom, gap between columns, gap between rows, inches.
    """
    left, right, top, bottom, gap_x, gap_y = margins
    width, height = figure.get_size_inches()
    rows = -(-n // columns)
    wide = (width - left - right - (columns - 1) * gap_x) / columns
    tall = (height - top - bottom - (rows - 1) * gap_y) / rows
    return [
        place(figure, left + k % columns * (wide + gap_x), top + k // columns * (tall + gap_y),
              wide, tall)
        for k in range(n)
    ]  # fmt: skip


def with_bars(axes: Axes, x: Any, y: Any, half: Any, **look: Any) -> None:
    """Points with bars of half length ``half`` (nan: none)."""
    look = {"capsize": 2.5, "elinewidth": 1.0, "zorder": 3, "ms": 5, "lw": 1.6} | look
    axes.errorbar(x, y, np.nan_to_num(np.asarray(half, dtype=float)), **look)
