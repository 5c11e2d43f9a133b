"""The Mississauga run car by car: forces and places beside what is published of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from derail_ros.studies.ensemble import Result, ScenarioLike, ensemble_runs, run_many

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
class PublishedRun:
    """What is published of the run beside its outcome.

    Attributes
    ----------
    peaks : the largest forces, the largest first
    above : cars struck above 10 MN
    scenes : time (s) -> what the source says of it
    """

    peaks: tuple[Peak, ...]
    above: tuple[int, ...]
    scenes: Mapping[float, str]

    @property
    def by_car(self) -> dict[int, float]:
        """Published peak force on a car, N, where it is known: that of its first pair."""
        known: dict[int, float] = {}
        for peak in self.peaks:
            for car in peak.pair:
                known.setdefault(car, peak.force)
        return known


def load_published_run() -> PublishedRun:
    """Read what is published."""
    import yaml

    text = (files("derail_ros.studies") / "data" / "published.yaml").read_text(encoding="utf-8")
    data = yaml.safe_load(text)["mississauga"]
    return PublishedRun(
        peaks=tuple(
            Peak((p["pair"][0], p["pair"][1]), 1e6 * p["force_MN"], p["time_s"])
            for p in data["peaks"]
        ),
        above=tuple(data["cars_above_10MN"]),
        scenes={s["time_s"]: s["text"] for s in data["scenes"]},
    )


@dataclass(frozen=True)
class Details:
    """An ensemble of the run, car by car, and the scenes of its first member.

    Attributes
    ----------
    force : (members, cars) peak force on each car, N; runs that count
    scenes : time (s) -> scene and speeds (cars,) (m/s) and velocities (cars, 2)
    final : the scene at the end
    summary : the first member's outcome in a line
    """

    force: NDArray[np.float64]
    scenes: Mapping[float, tuple[Scene, NDArray[np.float64]]]
    final: Scene
    summary: str

    def share_above(self, force: float = 10e6) -> NDArray[np.float64]:
        """(cars,) share of runs in which a car was struck above ``force``."""
        return (self.force > force).mean(axis=0)


def details(
    members: int,
    seed: int = 0,
    *,
    jobs: int | None = None,
    load: Callable[[str], ScenarioLike] | None = None,
    run: Callable[..., Iterator[Result]] = run_many,
    published: PublishedRun | None = None,
) -> Details:
    """Run the ensemble again, the same members as in the comparison, and the first in detail."""
    if load is None:
        from derail_ros.scenario import load_scenario as load
    if published is None:
        published = load_published_run()
    scenario: Any = load(SCENARIO)
    outcomes: list[Any] = [None] * members
    with closing(run(ensemble_runs(scenario, members, seed=seed), jobs=jobs)) as results:
        for result in results:
            if result.error is None and not result.outcome.void:
                outcomes[result.run.member] = result.outcome
    force = np.array([o.car_peak_force for o in outcomes if o is not None])
    scenes, final, summary = _scenes(scenario, sorted(published.scenes))
    return Details(force, scenes, final, summary)


def _scenes(scenario: Any, times: list[float]) -> tuple[dict[float, Any], Scene, str]:
    from derail_ros import models
    from derail_ros.review.scene import make_scene, scene_from_simulation

    simulation = models.build(scenario.to_params())
    scenes = {}
    for t in times:
        simulation.advance_to(t)
        now = simulation.sample(min(t, simulation.time))
        scene = make_scene(
            simulation.params.cars,
            now.q[:, :3],
            now.truck_on,
            now.coupled,
            coupler=now.q[:, 3:5],
            track=simulation.track,
            breaks=simulation.rail_breaks,
        )
        scenes[t] = (scene, now.v[:, :2].copy())
    outcome = simulation.run()
    pair = outcome.peak_force_pair
    struck = "" if pair is None else f" (car {pair[0]} struck {pair[1]})"
    summary = (
        f"{outcome.cars_derailed} cars derailed, at rest after {outcome.duration:.1f} s, largest "
        f"force {outcome.peak_force * 1e-6:.1f} MN{struck}"
    )
    final = scene_from_simulation(simulation, scenario.title, summary)
    return scenes, final, summary
