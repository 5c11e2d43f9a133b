"""Orders of the cars of a train."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

Block = Mapping[str, Any]

NAMES = (
    "as_given",
    "reversed",
    "light_first",
    "heavy_first",
    "light_middle",
    "heavy_middle",
    "light_heavy_alternating",
    "short_first",
    "long_first",
    "short_middle",
    "long_middle",
    "short_long_alternating",
)
_SHUFFLED = re.compile(r"shuffled_([0-9]{1,6})\Z")


def is_order(name: str) -> bool:
    """Whether there is an order of this name: one of :data:`NAMES`, or ``shuffled_1``, ..."""
    return name in NAMES or bool(_SHUFFLED.match(name))


def reorder(
    consist: Sequence[Block], name: str, cars: Sequence[int] | None = None, seed: int = 0
) -> list[dict[str, Any]]:
    """The blocks of a resolved consist with its cars in another order.

    Parameters
    ----------
    consist : resolved blocks: mass and length of each are given
    name : the order; cars that are equal in it keep the order they had
    cars : first and last car (from 1) of those that are put in order; all of them by default
    seed : of the shuffled orders
    """
    single = [{**block, "count": 1} for block in consist for _ in range(int(block["count"]))]
    first, last = (1, len(single)) if cars is None else cars
    if last > len(single):
        raise ValueError(f"no car {last}: the train has {len(single)}")
    part = single[first - 1 : last]
    part = [part[i] for i in _order(part, name, seed)]
    return _blocks([*single[: first - 1], *part, *single[last:]])


def _order(part: Sequence[Block], name: str, seed: int) -> list[int]:
    n = len(part)
    shuffled = _SHUFFLED.match(name)
    if shuffled:
        sequence = np.random.SeedSequence(entropy=seed, spawn_key=(int(shuffled[1]),))
        return [int(i) for i in np.random.Generator(np.random.Philox(sequence)).permutation(n)]
    if name == "as_given":
        return list(range(n))
    if name == "reversed":
        return list(range(n))[::-1]
    key = "mass_kg" if ("light" in name or "heavy" in name) else "length_m"
    rising = sorted(range(n), key=lambda i: part[i][key])
    falling = sorted(range(n), key=lambda i: -part[i][key])
    if name.endswith("_first"):
        return rising if name.startswith(("light", "short")) else falling
    if name.endswith("_middle"):
        # the chosen ones last, then dealt out from the ends inwards
        outer = falling if name.startswith(("light", "short")) else rising
        return outer[0::2] + outer[1::2][::-1]
    # alternating: one from each end of the ranking in turn
    half = (n + 1) // 2
    low, high = rising[:half], rising[half:]
    return [(low if i % 2 == 0 else high)[i // 2] for i in range(n)]


def _blocks(cars: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Equal neighbours as one block."""
    blocks: list[dict[str, Any]] = []
    for car in cars:
        if blocks and {**blocks[-1], "count": 1} == car:
            blocks[-1]["count"] += 1
        else:
            blocks.append(dict(car))
    return blocks
