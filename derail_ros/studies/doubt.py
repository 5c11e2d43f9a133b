"""Ensembles in which the reconstructed constants vary too.

An ensemble varies the force that starts the motion. The constants that the surviving copy of the
source lost are the same in all its runs. Where the largest force occurs early, all runs have the
same one, and the band is narrower than what is not known about the model. Each member of a
*doubtful* ensemble has constants of its own, drawn independently and uniformly from the ranges
below: what the source leaves open. The same draws are used for every case.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from derail_ros.studies.ensemble import Job, ScenarioLike


@dataclass(frozen=True)
class Doubt:
    """A constant in doubt."""

    label: str  # with the unit of the range
    path: str  # dotted
    low: float
    high: float
    scale: float  # the path's unit in the label's
    why: str  # where the range comes from
    logarithmic: bool = False  # uniform in its logarithm

    def at(self, u: float) -> float:
        """The value (unit of the path) below which a share ``u`` of the probability lies."""
        if self.logarithmic:
            return self.scale * self.low * (self.high / self.low) ** u
        return self.scale * (self.low + (self.high - self.low) * u)


DOUBTS: tuple[Doubt, ...] = (
    Doubt("brake force F0 (kN)", "brakes.force_N", 45.0, 75.0, 1e3,
          "the source's tables ask for 45 to 65 and more, its prose for less"),
    Doubt("traction coefficient of the brake tests", "brakes.traction_coefficient", 0.13, 0.2,
          1.0, "the text's 0.3 cannot give the tables"),
    Doubt("ground, growth with speed c_v (s/m)", "ground.c_v_s_per_m", 0.015, 0.045, 1.0,
          "the printed 3.0 cannot have its printed unit"),
    Doubt("ground, dynamic coefficient c_d", "ground.c_d", 0.6, 0.8, 1.0,
          "the equation is lost"),
    Doubt("force at contact F_max (MN)", "contact.force_max_N", 1.5, 3.3, 1e6,
          "set by impact tests, then stiffened by a factor that is lost"),
    Doubt("gap of half the force d_c (m)", "contact.half_distance_m", 0.04, 0.16, 1.0,
          "likewise", logarithmic=True),
    Doubt("striker stiffness k2 (MN/m)", "couplers.k2_N_per_m", 10.0, 500.0, 1e6,
          "the printed exponent is unclear", logarithmic=True),
)  # fmt: skip
"""All that is drawn."""


def draw(seed: int, member: int, doubts: Sequence[Doubt] = DOUBTS) -> Mapping[str, float]:
    """Dotted path -> value of a member: from a stream of its own, keyed on ``(seed, member)``."""
    sequence = np.random.SeedSequence(entropy=seed, spawn_key=(member, 1))
    shares = np.random.Generator(np.random.Philox(sequence)).uniform(size=len(doubts))
    return {d.path: d.at(float(u)) for d, u in zip(doubts, shares, strict=True)}


def doubtful_jobs(
    scenario: ScenarioLike, members: int, *, seed: int = 0, key: Any = None
) -> Iterator[Job]:
    """The members of a doubtful ensemble: lateral forces as in ``ensemble_jobs``.

    The traction coefficient matters only in runs whose brakes are limited by traction.
    """
    for member in range(members):
        yield Job(scenario, overrides=draw(seed, member), member=member, seed=seed, key=key)
