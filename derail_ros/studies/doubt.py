"""Ensembles in which the lost constants vary too.

An ensemble varies the force that starts the motion. What the surviving copy of the source lost is
the same in all its runs. Where the largest force occurs early, all runs have the same one, and
the band is narrower than what is not known about the model. Each member of a *doubtful* ensemble
has constants and forms of its own, drawn independently and uniformly from the ranges below: what
the source leaves open. What it prints is not drawn. The same draws are used for every case.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from derail_ros.scenario.resolve import cylinder_inertia
from derail_ros.studies.ensemble import Job, ScenarioLike
from derail_ros.vocabulary.params import TrainParams

INERTIA = "inertia of cylinders"
"""Not a path: a factor on the inertia of the cars that have that of a cylinder."""

DELAY = "brakes.delay_s"
"""Drawn only where the brakes are limited by traction."""


@dataclass(frozen=True)
class Doubt:
    """A constant or a form in doubt."""

    label: str  # with the unit of the range
    path: str  # dotted, or INERTIA
    low: float = 0.0
    high: float = 0.0
    scale: float = 1.0  # the path's unit in the label's
    why: str = ""  # where the range comes from
    logarithmic: bool = False  # uniform in its logarithm
    forms: tuple[str, ...] = ()  # what is chosen from, in place of a range

    def at(self, u: float) -> Any:
        """The value (unit of the path) below which a share ``u`` of the probability lies."""
        if self.forms:
            return self.forms[int(u * len(self.forms))]
        if self.logarithmic:
            return self.scale * self.low * (self.high / self.low) ** u
        return self.scale * (self.low + (self.high - self.low) * u)

    @property
    def words(self) -> str:
        """The range, or the forms."""
        return ", ".join(self.forms) if self.forms else f"{self.low:g} to {self.high:g}"


DOUBTS: tuple[Doubt, ...] = (
    Doubt("shape of the gap law", "contact.gap_law", forms=("gaussian", "sech2", "quartic"),
          why="its form is lost; these fit the words of the source"),
    Doubt("gap law inside a body", "contact.inside", forms=("even", "held"),
          why="the source does not say"),
    Doubt("striker stiffness k2 (MN/m)", "couplers.k2_N_per_m", 30.0, 170.0, 1e6,
          "the printed exponent is unclear; Mississauga's collisions appear only there",
          logarithmic=True),
    Doubt("ground, growth with speed c_v (s/m)", "ground.c_v_s_per_m", 0.015, 0.045, 1.0,
          "the printed 3.0 cannot have its printed unit"),
    Doubt("brake force F0 (kN)", "brakes.force_N", 45.0, 75.0, 1e3,
          "the source's tables ask for 45 to 65 and more, its prose for less"),
    Doubt("start of the brakes with traction (s)", DELAY, 2.0, 5.0, 1.0,
          "the text says no delay, the tables ask for some 3 s"),
    Doubt("yaw inertia of the base train's cars, relative", INERTIA, 0.9, 1.1, 1.0,
          "not printed"),
)  # fmt: skip
"""All that is drawn."""


def draw(seed: int, member: int, doubts: Sequence[Doubt] = DOUBTS) -> Mapping[str, Any]:
    """Path -> value of a member: from a stream of its own, keyed on ``(seed, member)``."""
    sequence = np.random.SeedSequence(entropy=seed, spawn_key=(member, 1))
    shares = np.random.Generator(np.random.Philox(sequence)).uniform(size=len(doubts))
    return {d.path: d.at(float(u)) for d, u in zip(doubts, shares, strict=True)}


def with_draw(scenario: ScenarioLike, drawn: Mapping[str, Any]) -> TrainParams:
    """The engine's parameters of a scenario with what was drawn."""
    values = dict(drawn)
    factor = values.pop(INERTIA)
    triggers = scenario.to_params().brakes.triggers
    if not any("traction_limited" in trigger.mode for trigger in triggers):
        del values[DELAY]
    params = scenario.with_overrides(values).to_params()
    cars = tuple(
        replace(car, inertia=factor * car.inertia)
        if car.inertia == cylinder_inertia(car.mass, car.length)
        else car
        for car in params.cars
    )
    return replace(params, cars=cars)


def doubtful_jobs(
    scenario: ScenarioLike, members: int, *, seed: int = 0, key: Any = None
) -> Iterator[Job]:
    """The members of a doubtful ensemble: lateral forces as in ``ensemble_jobs``."""
    for member in range(members):
        params = with_draw(scenario, draw(seed, member))
        yield Job(params, member=member, seed=seed, key=key)
