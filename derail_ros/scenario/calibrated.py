"""Uncertain constants of a run as draws from their distribution: the set ``calibrated``.

The set ``published`` is the thesis': one value each. What those values do not settle differs from
accident to accident (where the grade was, how good the brakes were, how far the train ran on
before they took hold). A :class:`Draw` holds one value of each. The distribution is learned from
accident reports (``research.calibration``); ``constants`` puts draws into scenarios.
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from derail_ros.config_path import config_path


@dataclass(frozen=True)
class Draw:
    """Values of the uncertain constants of one run.

    Attributes
    ----------
    brake_distance : how far the train runs on, after its first car is off, before its brake pipe
        is open, m: at the speed of the beginning, the time ``brake_distance / v``
    brake_time : added to that, s
    brake_force : factor on the brake of every car
    ground : factor on the ground reaction
    push : force that starts the motion, N
    push_distance : how far cars run on in line before it, m
    contact_force : largest force of the collision law, N
    contact_even : the collision law inside a body: even (1) or held (0)
    grade : rise per metre, uphill positive
    length : factor on the length of cars, where that is not known
    """

    brake_distance: float = 0.0
    brake_time: float = 0.0
    brake_force: float = 1.0
    ground: float = 1.0
    push: float = 50e3
    push_distance: float = 0.0
    contact_force: float = 3.0e6
    contact_even: float = 0.0
    grade: float = 0.0
    length: float = 1.0

    def delay(self, speed: float) -> float:
        """Brake delay after the first car is off, s, at a speed in m/s."""
        return self.brake_time + self.brake_distance / max(speed, 0.1)


# The shipped set ---------------------------------------------------------------------------


FILE = ("constants", "calibrated.json")
"""Of the set, below ``config/``: written by ``python -m research calibration``."""

NAMES = tuple(f.name for f in fields(Draw))


@dataclass(frozen=True)
class Few:
    """How often only a few cars derail, and how many: of a group of causes.

    ``odds`` : ln odds at 12 m/s with 80 cars behind, their slopes over ln speed and ln behind
    ``mean`` : of the cars above 1; ``dispersion`` : of their negative binomial distribution
    """

    odds: tuple[float, float, float]
    mean: float
    dispersion: float

    def share(self, speed: float, behind: int) -> float:
        """Probability that it is few, at a speed in m/s."""
        a, b, c = self.odds
        x = a + b * math.log(max(speed, 0.1) / 12.0) + c * math.log(max(behind, 1) / 80.0)
        return 1.0 / (1.0 + math.exp(-x))


@dataclass(frozen=True)
class Calibrated:
    """The shipped set: draws from the posterior, and their origin.

    Attributes
    ----------
    draws : values of :class:`Draw` in the order of :data:`NAMES`
    few : group of causes -> how often few cars derail
    statistical : group of causes -> kind -> coefficients of the models refitted beside it
    emulator : of ``predict.emulator``
    provenance : command, number of runs and reports, years, engine's hash, hashes checked since
    """

    draws: tuple[tuple[float, ...], ...]
    few: Mapping[str, Few]
    statistical: Mapping[str, Mapping[str, Any]]
    emulator: Mapping[str, Any]
    provenance: Mapping[str, Any]

    def draw(self, member: int, seed: int = 0) -> Draw:
        """Draw of a member: all of them in an order of the seed, then again."""
        import numpy as np

        turn, at = divmod(member, len(self.draws))
        order = np.random.default_rng([seed, turn]).permutation(len(self.draws))
        return self._at(order[at])

    @functools.cached_property
    def central(self) -> Draw:
        """The draw nearest to the middle of all, used for a single run."""
        columns = [sorted(c) for c in zip(*self.draws)]
        middle = [c[len(c) // 2] for c in columns]
        size = [max(c[len(c) * 3 // 4] - c[len(c) // 4], 1e-9) for c in columns]

        def far(draw: tuple[float, ...]) -> float:
            return sum(((x - m) / s) ** 2 for x, m, s in zip(draw, middle, size))

        return self._at(min(range(len(self.draws)), key=lambda i: far(self.draws[i])))

    def _at(self, i: int) -> Draw:
        return Draw(**dict(zip(NAMES, self.draws[i], strict=True)))

    def warning(self, engine: str) -> str:
        """A warning if the engine is not the one that learned the set."""
        known = {self.provenance["engine"], *self.provenance.get("checked", ())}
        if engine in known:
            return ""
        return (
            f"the calibrated constants were learned with engine "
            f"{self.provenance['engine'][:16]}, this is {engine[:16]}: check them with "
            "`python -m research calibration --check`"
        )


@functools.cache
def load_calibrated() -> Calibrated:
    """The shipped set."""
    data = json.loads(config_path(*FILE).read_text(encoding="utf-8"))
    if tuple(data["names"]) != NAMES:
        raise ValueError(f"{config_path(*FILE)}: holds {data['names']}, not {list(NAMES)}")
    few = {
        group: Few(tuple(f["odds"]), f["mean"], f["dispersion"])
        for group, f in data["few"].items()
    }
    return Calibrated(
        tuple(map(tuple, data["draws"])),
        few,
        data["statistical"],
        data["emulator"],
        data["provenance"],
    )
