"""Whether a struck tank car releases: three rules from impact tests.

Each is a probability ``P = Phi(ln(x / x50) / s)`` whose median and spread are set by tests, not by
accident reports. The 5 and 95 % points of a single shell are

- force: 2.2 and 4.45 MN, at which tank cars of the 1970s ruptured in impact tests (thesis); x is
  the largest force at a corner of the car, whatever struck what.
- energy: 1.27 and 2.64 MJ. In the FRA's side impact tests with a rigid punch a DOT-105 was
  punctured by 1.27 MJ (punch of 152 mm), a DOT-111 by at most 2.64 MJ (305 mm). x is the work
  that a blow has taken from the two cars.
- approach: 4.34 and 6.26 m/s, the speeds of these two tests (9.7 and 14.0 mph, rams of 135 t). x
  is the speed along the normal when the contact began. Birk, Anderson and Coppens (1990) judged
  punctures by approach speed and angle. Their numbers are not to be had; these are the tests'.

Energy and approach count blows by another car's corner that comes across, at :data:`ACROSS` or
more between the long axes: a corner that slides along does not enter a shell. That angle is a
guess. A car with several blows holds if it holds each. A stronger tank: surrogates of the double
shell DOT-113 were not punctured by 4.0 and 4.5 MJ. So its median energy is ``4.5 / 2.64`` times
the single shell's, or more; forces (equal stiffness) and speeds go with the root of the energy.

A corner of a car is not a punch: how far off the rules are stands beside the release ratios of
reports in ``docs/prediction.md``.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from derail_ros.predict.runs import LEVELS, OUTPUTS
from derail_ros.vocabulary.words import finite

if TYPE_CHECKING:
    from derail_ros.vocabulary.events import Collision

F64 = NDArray[np.float64]

TESTS = {"force": (2.2e6, 4.45e6), "energy": (1.27e6, 2.64e6), "approach": (4.34, 6.26)}
"""Rule -> 5 and 95 % points of a single shell, N, J, m/s."""

STRENGTH = {"single_shell": 1.0, "double_shell": 4.5 / 2.64}
"""Kind of tank -> its median energy over that of a bare shell."""

ACROSS = math.radians(30.0)
"""Least angle between the long axes of two cars at a blow that may enter a shell."""


def probability(value: Any, kind: str = "single_shell", rule: str = "force") -> Any:
    """Probability that a tank car releases, by the ``value`` that a rule looks at (SI units)."""
    low, high = TESTS[rule]
    stronger = STRENGTH[kind] if rule == "energy" else math.sqrt(STRENGTH[kind])
    median = math.sqrt(low * high) * stronger
    spread = math.log(high / low) / (2.0 * 1.6449)
    return ndtr(np.log(np.maximum(value, 1e-9) / median) / spread)


def by_blows(collisions: Iterable[Collision], cars: int, kind: str, rule: str) -> F64:
    """Probability (cars,) of each car that it releases by the blows of a run: energy, approach."""
    holds = np.ones(cars)
    for c in collisions:
        struck = c.car_b if c.corner_car == c.car_a else c.car_a
        if c.angle < ACROSS or not 1 <= struck <= cars:
            continue
        value = c.energy_lost if rule == "energy" else c.closing_speed
        holds[struck - 1] *= 1.0 - probability(value, kind, rule)
    return 1.0 - holds


def expected(outputs: F64, kind: str = "single_shell", rule: str = "force") -> F64:
    """Expected number of cars that would release in each run if all were tank cars.

    By force from the cars counted between neighbouring ``LEVELS``: each with the probability at
    the geometric mean of the two.
    """
    if rule != "force":
        return outputs[:, OUTPUTS.index(f"{rule}_{kind}")]
    above = outputs[:, [OUTPUTS.index(f"above_{x / 1e6:g}MN") for x in LEVELS]]
    between = above - np.concatenate([above[:, 1:], np.zeros((len(above), 1))], axis=1)
    edges = np.array([*LEVELS, 2.0 * LEVELS[-1]])
    return between @ probability(np.sqrt(edges[:-1] * edges[1:]), kind)


def of_runs(outputs: F64, behind: int, hazardous: int = 0) -> dict[str, Any]:
    """Share of the derailed cars that would release, and cars if ``hazardous`` stand at random.

    By force, and in ``by_energy`` and ``by_approach`` by the other rules.
    """
    good = outputs[np.isfinite(outputs[:, 0])]
    found: dict[str, Any] = {"basis": "impact tests: largest force on a car"}

    def of(kind: str, rule: str) -> dict[str, Any]:
        cars = expected(good, kind, rule)
        one: dict[str, Any] = {
            "share_of_derailed": finite(cars.sum() / max(good[:, 0].sum(), 1.0), 4)
        }
        if hazardous:
            n = np.random.default_rng(0).binomial(hazardous, np.clip(cars / behind, 0.0, 1.0))
            one["cars"] = counts(n)
        return one

    for kind in STRENGTH:
        found[kind] = of(kind, "force")
        found[kind] |= {f"by_{rule}": of(kind, rule) for rule in ("energy", "approach")}
    return found


def counts(n: Any) -> dict[str, float | None]:
    """Mean and ends of the 50 and 90 % bands of counts."""
    levels = {"q05": 0.05, "q25": 0.25, "q50": 0.5, "q75": 0.75, "q95": 0.95}
    quantiles = {k: float(np.quantile(n, q, method="inverted_cdf")) for k, q in levels.items()}
    return {"mean": finite(float(np.mean(n)), 3), **quantiles}
