"""The Mississauga run car by car: forces and places beside what is published of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from derail_ros import models
from derail_ros.review.scene import make_scene, scene_from_simulation
from derail_ros.scenario import load_scenario
from derail_ros.studies.ensemble import ensemble_jobs, gather
from derail_ros.studies.published import load_published
from derail_ros.vocabulary.status import CERTAIN_RUPTURE_FORCE

if TYPE_CHECKING:
    from derail_ros.review.scene import Scene

SCENARIO = "mississauga_published"


@dataclass(frozen=True)
class Peak:
    """A published peak force: ``pair`` (a, b), a struck b; N; s."""

    pair: tuple[int, int]
    force: float
    time: float


@dataclass(frozen=True)
class PublishedDetails:
    """What is published of the run beside its outcome."""

    peaks: tuple[Peak, ...]  # the largest first
    above: tuple[int, ...]  # cars struck above 10 MN
    scenes: Mapping[float, str]  # time (s) -> what the source says of it

    @property
    def by_car(self) -> dict[int, float]:
        """Published peak force on a car, N, where it is known: that of its first pair."""
        known: dict[int, float] = {}
        for peak in self.peaks:
            for car in peak.pair:
                known.setdefault(car, peak.force)
        return known


def load_published_run() -> PublishedDetails:
    """What is published."""
    data = load_published().text
    return PublishedDetails(
        peaks=tuple(
            Peak((p["pair"][0], p["pair"][1]), p["force_N"], p["time_s"])
            for p in data["collisions"]
        ),
        above=tuple(data["cars_above_10MN"]),
        scenes={s["time_s"]: s["text"] for s in data["scenes"]},
    )


@dataclass(frozen=True)
class Details:
    """An ensemble of the run, car by car, and the scenes of its first member."""

    force: NDArray[np.float64]  # (members, cars) peak force on each car, N; runs that count
    # time (s) -> scene and velocities (cars, 2), m/s
    scenes: Mapping[float, tuple[Scene, NDArray[np.float64]]]
    final: Scene
    summary: str  # the first member's outcome in a line

    def share_above_10MN(self) -> NDArray[np.float64]:
        """(cars,) share of runs in which a car was struck above 10 MN."""
        return (self.force > CERTAIN_RUPTURE_FORCE).mean(axis=0)


def details(
    members: int,
    seed: int = 0,
    *,
    jobs: int | None = None,
    published: PublishedDetails | None = None,
) -> Details:
    """Run the ensemble again, the same members as in the comparison, and the first in detail."""
    scenario = load_scenario(SCENARIO)
    runs = ensemble_jobs(scenario, members, seed=seed)
    (results,) = gather(runs, jobs=jobs).values()
    outcomes = [r.outcome for r in results if r.error is None]
    force = np.array([o.car_peak_force for o in outcomes if not o.void])

    simulation = models.build(scenario.to_params())
    scenes = {}
    for t in sorted((published or load_published_run()).scenes):
        simulation.advance_to(t)
        now = simulation.sample(min(t, simulation.time))
        scene = make_scene(
            simulation.params.cars,
            now.plane,
            now.truck_on,
            now.coupled,
            coupler=now.coupler_yaw,
            track=simulation.track,
            breaks=simulation.rail_breaks,
        )
        scenes[t] = (scene, now.velocity[:, :2].copy())
    outcome = simulation.run()
    final = scene_from_simulation(simulation, scenario.title, outcome.text)
    return Details(force, scenes, final, outcome.text)
