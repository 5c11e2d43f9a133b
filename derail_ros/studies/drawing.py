"""Drawing for the figures of studies: series, error bars."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from derail_ros.review.drawing import BLUE, GREEN, INK, VERMILION

if TYPE_CHECKING:
    from matplotlib.axes import Axes

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


def with_bars(axes: Axes, x: Any, y: Any, half: Any, **look: Any) -> None:
    """Points with bars of half length ``half`` (nan: none)."""
    look = {"capsize": 2.5, "elinewidth": 1.0, "zorder": 3, "ms": 5, "lw": 1.6} | look
    axes.errorbar(x, y, np.nan_to_num(np.asarray(half, dtype=float)), **look)
