"""The models by name: each put to work on scenarios gives a record with the same keys and a scene.

``toma`` is the main model. What a model does not know is ``None`` in its record.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from derail_ros.baselines.train import (
    ModelError,
    Train,
    brakes_of,
    derailing_train,
    is_straight,
)
from derail_ros.vocabulary.measures import MEASURES, Record, outcome_record
from derail_ros.vocabulary.status import AT_REST
from derail_ros.vocabulary.words import finite

if TYPE_CHECKING:
    from derail_ros.review.scene import Scene
    from derail_ros.vocabulary.params import TrainParams
    from derail_ros.vocabulary.simulation import Simulation

MODELS: dict[str, str] = {
    "toma": "E. E. Toma 1998, the main model",
    "yang-manos": "Yang and Manos 1972",
    "anderson": "Birk, Anderson and Coppens 1990",
    "roorda-gracie": "Roorda and Gracie 1992",
    "blockage": "one-dimensional blockage model",
    "bar-1": "a bar slides from the rails onto the ground",
    "bar-2": "bar-1, what has gone too far is left behind (published form)",
    "bar-2-corrected": "bar-2 without the gain of energy",
    "bar-3": "bar-2 with brakes (published form)",
    "bar-3-corrected": "bar-3 without the gain of energy",
}
"""Name -> what it is."""

VARIED = ("toma", "yang-manos", "anderson")
"""Models whose outcome knows the initiating lateral force: those that have ensembles."""

CONSTANTS: dict[str, tuple[str, ...]] = {
    "yang-manos": ("friction", "widening"),
    "anderson": ("stiffness", "damping", "force_limit", "friction", "restitution"),
    "roorda-gracie": ("friction", "increment", "start_angle"),
}
"""Models with constants of their own that a caller may choose."""


@dataclass(frozen=True)
class ModelRun:
    """What a model made of a train.

    Attributes
    ----------
    model : its name
    record : the outcome, keys as of ``outcome_record``
    scene : the final scene; None for models without a plane
    notes : what it tells beyond the keys of the record
    """

    model: str
    record: Record
    scene: Scene | None = None
    notes: dict[str, Any] = field(default_factory=dict)


def blank_record() -> Record:
    """A record in which nothing is known."""
    known = {"status": AT_REST, "at_rest": True, "void": False}
    return dict.fromkeys(MEASURES) | known | {"energy_J": {}, "wall_s": None}


def run_model(
    name: str,
    params: TrainParams,
    *,
    roll: bool = False,
    constants: Mapping[str, float] | None = None,
    progress: Callable[[float, int], None] | None = None,
) -> ModelRun:
    """Put a model to work on a train.

    Parameters
    ----------
    name : of :data:`MODELS`
    params : the engine's parameters of a scenario
    roll : add the roll estimate to the notes (``toma``, ``anderson``)
    constants : of the model itself, by the names of ``YangManosParams``, ``AndersonParams`` and
        the arguments of ``roorda_gracie``; the others have none
    progress : called now and then with the time of the run (s) and the cars derailed so far

    Raises
    ------
    ModelError
        The model cannot be put to work on this train.
    ParameterError, SimulationError
        As of the engine, for the models that use it.
    """
    if name not in MODELS:
        raise ModelError(f"unknown model {name!r}; there are {', '.join(MODELS)}")
    own = dict(constants or {})
    if unknown := sorted(set(own) - set(CONSTANTS.get(name, ()))):
        raise ModelError(f"{name} has no constant {unknown[0]!r}")
    began = time.perf_counter()
    if name == "toma":
        run = _toma(params, roll, progress)
    elif name == "yang-manos":
        run = _yang_manos(params, own, progress)
    elif name == "anderson":
        run = _anderson(params, roll, own, progress)
    elif name == "roorda-gracie":
        run = _roorda_gracie(params, own)
    elif name == "blockage":
        run = _blockage(params)
    else:
        run = _bar(name, params)
    run.record["wall_s"] = finite(time.perf_counter() - began, 6)
    return run


# The main engine -----------------------------------------------------------------------------


def _go(simulation: Simulation, progress: Callable[[float, int], None] | None) -> None:
    while not simulation.ended:
        simulation.advance_to(simulation.time + 0.5)
        if progress is not None:
            progress(simulation.time, len(simulation.outcome().derailed_cars))


def _toma(
    params: TrainParams, roll: bool, progress: Callable[[float, int], None] | None
) -> ModelRun:
    from derail_ros import models
    from derail_ros.review.scene import scene_from_simulation

    simulation = models.build(params)
    notes: dict[str, Any] = {}
    if roll:
        from derail_ros.baselines.anderson import roll_estimates

        free = free_speeds(simulation)
        notes["roll_deg"] = _degrees(roll_estimates(free))
        notes["free_speed_m_per_s"] = [finite(v, 3) for v in free]
    else:
        _go(simulation, progress)
    return ModelRun(
        "toma", outcome_record(simulation.outcome()), scene_from_simulation(simulation), notes
    )


def _degrees(angles: NDArray[np.float64]) -> list[float | None]:
    return [finite(math.degrees(a), 1) for a in angles]


def free_speeds(simulation: Simulation) -> NDArray[np.float64]:
    """Run a simulation to its end; the speed at which each car came free of both neighbours.

    A car is free when it is derailed and neither of its couplings holds (a missing neighbour
    counts as parted); nan for cars that never are, m/s.
    """
    speed = np.full(simulation.n_cars, math.nan)
    seen = -1
    while True:
        changes = len(simulation.events)
        if changes != seen:
            seen = changes
            sample = simulation.sample()
            held = np.zeros(simulation.n_cars, dtype=bool)
            held[:-1] |= sample.coupled.astype(bool)
            held[1:] |= sample.coupled.astype(bool)
            off = ~sample.truck_on.astype(bool).all(axis=1)
            new = off & ~held & np.isnan(speed)
            speed[new] = np.hypot(sample.v[new, 0], sample.v[new, 1])
        if simulation.ended:
            return speed
        simulation.advance_steps(1)


def _yang_manos(
    params: TrainParams,
    own: dict[str, float],
    progress: Callable[[float, int], None] | None,
) -> ModelRun:
    from derail_ros import models
    from derail_ros.baselines.yang_manos import YangManosParams, configure, zigzag
    from derail_ros.review.scene import scene_from_simulation

    train = derailing_train(params)
    simulation = models.build(configure(params, YangManosParams(**own)))
    _go(simulation, progress)
    outcome = simulation.outcome()
    record = outcome_record(outcome)
    record["derailed_cars"] = [c + train.first for c in record["derailed_cars"]]
    for key in (
        "peak_force_N",
        "peak_force_pair",
        "peak_force_time_s",
        "peak_resultant_N",
        "severity",
        "cars_above_5MN",
        "cars_above_10MN",
    ):
        record[key] = None
    record["energy_J"]["collisions"] = None
    record["energy_J"]["ground_body"] = None
    scene = scene_from_simulation(simulation)
    yaw = outcome.pose[: outcome.cars_derailed, 5]
    notes = {
        "zigzag": finite(zigzag(yaw), 3),
        "couplings_parted": int((~simulation.sample().coupled.astype(bool)).sum()),
    }
    numbers = tuple(train.first + 1 + i for i in range(train.n))
    unknown = np.full(train.n, np.nan)
    return ModelRun(
        "yang-manos",
        record,
        dataclasses.replace(scene, numbers=numbers, peak_force=unknown),
        notes,
    )


# A model of its own --------------------------------------------------------------------------


def _anderson(
    params: TrainParams,
    roll: bool,
    own: dict[str, float],
    progress: Callable[[float, int], None] | None,
) -> ModelRun:
    from derail_ros.baselines.anderson import AndersonModel, AndersonParams
    from derail_ros.review.scene import make_scene

    model = AndersonModel(params, AndersonParams(**own))
    while not model.ended:
        model.advance_to(model.time + 0.5)
        if progress is not None:
            progress(model.time, int((model.truck_on == 0).any(axis=1).sum()))
    o = model.outcome()
    record = blank_record()
    record |= {
        "cars_derailed": len(o.derailed_cars),
        "derailed_cars": list(o.derailed_cars),
        "duration_s": finite(o.duration),
        "scene_length_m": finite(o.scene[0]),
        "scene_width_m": finite(o.scene[1]),
        "scene_area_m2": finite(o.scene[2]),
        "rear_stop_m": finite(o.rear_stop),
        "energy_initial_J": finite(o.energy["initial"]),
        "energy_J": {k: finite(v) for k, v in o.energy.items()},
        "energy_residual": finite(o.residual),
        "void": o.status == "void",
        "status": o.status,
        "at_rest": o.status == "at rest",
        "end_time_s": finite(o.time),
        "steps": o.steps,
        "rejected_steps": o.rejected_steps,
    }
    record["energy_J"]["ground_body"] = record["energy_J"]["knuckle"] = None
    notes: dict[str, Any] = {
        "couplings_parted": len(o.parted),
        "approach_speed_m_per_s": [finite(v, 3) for v in o.approach_speed],
    }
    if o.approach_speed.max(initial=0.0) > 0.0:
        worst = int(np.argmax(o.approach_speed))
        notes["largest_approach_speed_m_per_s"] = finite(o.approach_speed[worst], 3)
        notes["largest_approach_pair"] = sorted([worst + 1, int(o.approach_other[worst])])
    if roll:
        notes["roll_deg"] = _degrees(o.roll)
    straight = None if is_straight(params) else model.track
    scene = make_scene(
        params.cars,
        model.pose,
        model.truck_on,
        model.coupled,
        track=straight,
        breaks=params.track.rail_breaks,
    )
    return ModelRun("anderson", record, _boxed(scene, o.scene), notes)


def _boxed(scene: Scene, box: tuple[float, float, float]) -> Scene:
    return dataclasses.replace(scene, scene_length=box[0], scene_width=box[1], scene_area=box[2])


# Without forces -------------------------------------------------------------------------------


def _numbers(train: Train, count: float) -> list[int]:
    """The first cars of the train, as many as a count that is not whole rounds to."""
    return [train.first + 1 + i for i in range(min(round(count), train.n))]


def _roorda_gracie(params: TrainParams, own: dict[str, float]) -> ModelRun:
    from derail_ros.baselines.roorda_gracie import roorda_gracie
    from derail_ros.engine import Track
    from derail_ros.review.scene import make_scene
    from derail_ros.vocabulary.scene import car_corners, scene_box

    if not is_straight(params):
        raise ModelError("the model of Roorda and Gracie is put to work on straight track only")
    train = derailing_train(params)
    run = roorda_gracie(train, brakes_of(params, train), **own)
    k = run.derailed
    size = [np.array([getattr(c, key) for c in train.cars]) for key in ("length", "width")]
    straight = Track(dataclasses.replace(params.track, segments=()))
    corners = car_corners(run.pose, *size)
    box = scene_box(straight, corners[:k], run.pose[:k, 0])
    record = blank_record()
    record |= {
        "cars_derailed": k,
        "derailed_cars": _numbers(train, k),
        "duration_s": finite(run.duration),
        "scene_length_m": finite(box[0]),
        "scene_width_m": finite(box[1]),
        "scene_area_m2": finite(box[2]),
        "energy_initial_J": finite(run.energy[0]),
        "status": "whole train derailed" if run.whole_train else "at rest",
        "end_time_s": finite(run.duration),
        "steps": len(run.time) - 1,
        "rejected_steps": 0,
    }
    if k < train.n:
        record["rear_stop_m"] = finite(run.pose[k, 0] + train.cars[k].truck_distance)
    record["energy_J"] |= {
        "kinetic": finite(run.energy[-1]),
        "initial": finite(run.energy[0]),
        "brakes": finite(run.brake_work),
        "ground_trucks": finite(run.ground_work),
    }
    on = np.ones((train.n, 2), dtype=bool)
    on[:k] = False
    scene = make_scene(
        train.cars,
        run.pose,
        on,
        np.ones(train.n - 1, dtype=bool),
        breaks=(train.point,),
    )
    numbers = tuple(train.first + 1 + i for i in range(train.n))
    scene = dataclasses.replace(_boxed(scene, box), numbers=numbers)
    return ModelRun("roorda-gracie", record, scene, {"advance_m": finite(run.advance, 3)})


def _one_dimensional(
    train: Train, count: float, duration: float, whole: bool, masses: float
) -> Record:
    record = blank_record()
    record |= {
        "cars_derailed": finite(count, 3),
        "derailed_cars": _numbers(train, count),
        "duration_s": finite(duration),
        "energy_initial_J": finite(0.5 * masses * train.speed**2),
        "status": "whole train derailed" if whole else "at rest",
        "end_time_s": finite(duration),
    }
    record["energy_J"]["initial"] = record["energy_initial_J"]
    return record


def _blockage(params: TrainParams) -> ModelRun:
    from derail_ros.baselines.blockage import blockage

    train = derailing_train(params)
    answer = blockage(
        train.speed,
        train.n,
        mass=train.mean_mass(),
        car_length=train.mean_length(),
        run_up=train.run_up,
    )
    record = _one_dimensional(
        train,
        float(answer.cars_derailed),
        float(answer.duration),
        bool(answer.whole_train),
        float(train.masses().sum()),
    )
    notes = {
        "distance_m": finite(answer.distance, 3),
        "peak_speed_m_per_s": finite(answer.peak_speed, 3),
    }
    return ModelRun("blockage", record, None, notes)


def _bar(name: str, params: TrainParams) -> ModelRun:
    from derail_ros.baselines import bar

    train = derailing_train(params)
    length = train.mean_length()
    arguments: dict[str, Any] = {"car_length": length}
    kind = name.removesuffix("-corrected")
    if kind != "bar-1":
        arguments["form"] = "published" if kind == name else "corrected"
        arguments["ground_length"] = 3.0 * length
    function = {"bar-1": bar.bar_case_1, "bar-2": bar.bar_case_2, "bar-3": bar.bar_case_3}[kind]
    answer = function(train.speed, train.n, **arguments)
    record = _one_dimensional(
        train,
        float(answer.cars_derailed),
        float(answer.duration),
        bool(answer.whole_train),
        float(train.masses().sum()),
    )
    notes = {
        "distance_m": finite(answer.distance, 3),
        "peak_speed_m_per_s": finite(answer.peak_speed, 3),
    }
    return ModelRun(name, record, None, notes)
