"""The models by name: each run on a scenario gives a record with the same keys, and a scene.

``planar`` is the main model. What a model does not compute is ``None`` in its record.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from derail_ros.baselines import bar
from derail_ros.baselines.blockage import blockage
from derail_ros.baselines.train import (
    ModelError,
    Train,
    brakes_of,
    derailing_train,
    is_straight,
)
from derail_ros.studies.ensemble import Job, Stopped, advance
from derail_ros.vocabulary.ledger import ENERGY_ENTRIES
from derail_ros.vocabulary.measures import Record, outcome_record
from derail_ros.vocabulary.outcome import Outcome
from derail_ros.vocabulary.params import PLANAR
from derail_ros.vocabulary.sample import planar
from derail_ros.vocabulary.scene import car_corners, scene_box
from derail_ros.vocabulary.status import AT_REST
from derail_ros.vocabulary.train import train_totals
from derail_ros.vocabulary.words import finite

if TYPE_CHECKING:
    from derail_ros.review.scene import Scene
    from derail_ros.vocabulary.params import TrainParams
    from derail_ros.vocabulary.simulation import Simulation

Watch = Callable[[float, int], None]
"""Called now and then with the time of a run (s) and the number of cars derailed so far."""

WHOLE_TRAIN = "whole train derailed"
"""Status of a run in which the model ran out of cars."""


@dataclass(frozen=True)
class ModelRun:
    """Result of a model for a train."""

    model: str
    record: Record  # keys as of ``outcome_record``
    scene: Scene | None = None  # at the end; None for models without a plane
    notes: dict[str, Any] = field(default_factory=dict)  # further results, by names with units


@dataclass(frozen=True)
class Request:
    """How a model is run."""

    roll: bool = False  # add the roll estimate to the notes (``planar``, ``anderson``)
    constants: Mapping[str, float] = field(default_factory=dict)  # of the model itself
    watch: Watch | None = None

    def go(self, simulation: Any) -> None:
        """Run a simulation to its end."""
        watch = self.watch
        if watch is None:
            advance(simulation)
        else:
            advance(
                simulation,
                progress=lambda s: watch(s.time, len(s.outcome().derailed_cars)),
                slice_s=0.5,
            )


@dataclass(frozen=True)
class Model:
    """A model."""

    words: str
    # gives record, scene and notes of a train
    run: Callable[[TrainParams, Request], tuple[Record, Scene | None, dict[str, Any]]]
    plane: bool = False  # it gives a final scene
    varied: bool = False  # depends on the lateral force that starts the motion: it has ensembles
    kernels: bool = False  # it is compiled at its first use
    rolls: bool = False  # it parts couplings, so that the roll of free cars can be estimated
    constants: tuple[str, ...] = ()  # of its own that a caller may choose


def record_of(outcome: Outcome, unknown: Iterable[str] = (), **known: Any) -> Record:
    """The record of a model's outcome; ``unknown`` is what it does not compute."""
    energy = {key: finite(outcome.energy.get(key)) for key in ENERGY_ENTRIES}
    record = outcome_record(outcome) | dict.fromkeys(unknown) | {"energy_J": energy}
    return record | {"at_rest": outcome.status in (AT_REST, WHOLE_TRAIN)} | known


def run_model(
    name: str,
    params: TrainParams,
    *,
    roll: bool = False,
    constants: Mapping[str, float] | None = None,
    progress: Watch | None = None,
) -> ModelRun:
    """Run a model on a train.

    Parameters
    ----------
    name : of :data:`MODELS`
    params : the engine's parameters of a scenario
    roll, constants, progress : see :class:`Request`; constants by the names of
        ``YangManosParams``, ``AndersonParams`` and the arguments of ``roorda_gracie``

    Raises
    ------
    ModelError
        The model cannot be run on this train.
    ParameterError, SimulationError
        As of the engine, for the models that use it.
    """
    name = FORMER.get(name, name)
    if name not in MODELS:
        raise ModelError(f"unknown model {name!r}; choose one of {', '.join(MODELS)}")
    own = dict(constants or {})
    if unknown := sorted(set(own) - set(MODELS[name].constants)):
        raise ModelError(f"{name} has no constant {unknown[0]!r}")
    if name != PLANAR:  # the others know no second tracks
        params = params.alone
    began = time.perf_counter()
    record, scene, notes = MODELS[name].run(params, Request(roll, own, progress))
    record["wall_s"] = finite(time.perf_counter() - began, 6)
    return ModelRun(name, record, scene, notes)


def run_job(
    name: str, job: Job, stop: Callable[[], bool], constants: Mapping[str, float] | None = None
) -> ModelRun:
    """Run a model on the train of a job; it is given up when ``stop()`` becomes true."""

    def watch(_t: float, _derailed: int) -> None:
        if stop():
            raise Stopped

    return run_model(name, job.params(), constants=constants, progress=watch)


# The main engine -----------------------------------------------------------------------------


def _planar(params: TrainParams, asked: Request) -> tuple[Record, Scene | None, dict[str, Any]]:
    from derail_ros import models
    from derail_ros.review.scene import scene_from_simulation

    simulation = models.build(params)
    notes: dict[str, Any] = {}
    if asked.roll:
        from derail_ros.baselines.anderson import roll_estimates

        free = free_speeds(simulation)
        notes["roll_deg"] = _degrees(roll_estimates(free))
        notes["free_speed_m_per_s"] = [finite(v, 3) for v in free]
    else:
        asked.go(simulation)
    return outcome_record(simulation.outcome()), scene_from_simulation(simulation), notes


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
            speed[new] = np.hypot(sample.velocity[new, 0], sample.velocity[new, 1])
        if simulation.ended:
            return speed
        simulation.advance_steps(1)


NO_FORCES = ("peak_force_N", "peak_force_pair", "peak_force_time_s", "peak_resultant_N",
             "severity", "cars_above_5MN", "cars_above_10MN")  # fmt: skip
"""What a model without forces between cars does not know."""
NO_COUPLINGS = (*NO_FORCES, "max_draft_N", "max_draft_coupling", "max_buff_N",
                "max_buff_coupling", "in_train", "parted")  # fmt: skip
"""What a model does not know that tells nothing of its couplings either."""


def _yang_manos(params: TrainParams, asked: Request) -> tuple[Record, Scene, dict[str, Any]]:
    from derail_ros import models
    from derail_ros.baselines.yang_manos import YangManosParams, configure, zigzag
    from derail_ros.review.scene import scene_from_simulation

    train = derailing_train(params)
    simulation = models.build(configure(params, YangManosParams(**asked.constants)))
    asked.go(simulation)
    outcome = simulation.outcome()
    rear = outcome.rear_part_first_car
    ahead = np.full(train.first, np.nan)  # couplings ahead of the first car are not looked at
    energy = {k: v for k, v in outcome.energy.items() if k not in ("collisions", "ground_body")}
    whole = dataclasses.replace(
        outcome,
        derailed_cars=tuple(c + train.first for c in outcome.derailed_cars),
        rear_part_first_car=rear + train.first if rear else 0,
        energy=energy,
        train=train_totals(params.cars),
        couplings={k: np.concatenate((ahead, v)) for k, v in outcome.couplings.items()},
        parted=tuple(
            dataclasses.replace(p, coupling=p.coupling + train.first) for p in outcome.parted
        ),
    )
    yaw = outcome.pose[: outcome.cars_derailed, 5]
    notes = {
        "zigzag": finite(zigzag(yaw), 3),
        "couplings_parted": int((simulation.sample().coupled == 0).sum()),
    }
    scene = dataclasses.replace(
        scene_from_simulation(simulation),
        numbers=train.numbers,
        peak_force=np.full(train.n, np.nan),
    )
    return record_of(whole, NO_FORCES), scene, notes


# A model of its own --------------------------------------------------------------------------


def _anderson(params: TrainParams, asked: Request) -> tuple[Record, Scene, dict[str, Any]]:
    from derail_ros.baselines.anderson import AndersonModel, AndersonParams

    model = AndersonModel(params, AndersonParams(**asked.constants))
    asked.go(model)
    o = model.outcome()
    speed, other = o.car_values["approach_speed_m_per_s"], o.car_values["approach_car"]
    notes: dict[str, Any] = {
        "couplings_parted": int((model.coupled == 0).sum()),
        "approach_speed_m_per_s": [finite(v, 3) for v in speed],
    }
    if speed.max(initial=0.0) > 0.0:
        worst = int(np.argmax(speed))
        notes["largest_approach_speed_m_per_s"] = finite(speed[worst], 3)
        notes["largest_approach_pair"] = sorted([worst + 1, int(other[worst])])
    if asked.roll:
        notes["roll_deg"] = _degrees(o.car_values["roll_rad"])
    track = None if is_straight(params) else model.track
    breaks = params.track.rail_breaks
    scene = _scene(params.cars, model.pose, model.truck_on, model.coupled, o,
                   track=track, breaks=breaks)  # fmt: skip
    return record_of(o, NO_COUPLINGS), scene, notes


def _scene(
    cars: Any,
    pose: Any,
    truck_on: Any,
    coupled: Any,
    outcome: Outcome,
    numbers: Any = None,
    **more: Any,
) -> Scene:
    from derail_ros.review.scene import make_scene

    scene = make_scene(cars, pose, truck_on, coupled, outcome=outcome, **more)
    unknown = np.full(len(cars), np.nan)
    return dataclasses.replace(scene, peak_force=unknown, numbers=numbers or scene.numbers)


# Without forces -------------------------------------------------------------------------------


def _first_cars(train: Train, count: float) -> tuple[int, ...]:
    """The first cars of the train, as many as a count that is not whole rounds to."""
    return train.numbers[: min(round(count), train.n)]


def _roorda_gracie(params: TrainParams, asked: Request) -> tuple[Record, Scene, dict[str, Any]]:
    from derail_ros.baselines.roorda_gracie import roorda_gracie
    from derail_ros.engine import Track

    if not is_straight(params):
        raise ModelError("the model of Roorda and Gracie needs straight track")
    train = derailing_train(params)
    run = roorda_gracie(train, brakes_of(params, train), **asked.constants)
    k = run.derailed
    length, width = np.array([(c.length, c.width) for c in train.cars]).T
    straight = Track(dataclasses.replace(params.track, segments=()))
    box = scene_box(straight, car_corners(run.pose, length, width)[:k], run.pose[:k, 0])
    status = WHOLE_TRAIN if run.whole_train else AT_REST
    outcome = dataclasses.replace(
        _nothing(params, planar(run.pose), status, run.duration, len(run.time) - 1),
        derailed_cars=_first_cars(train, k),
        scene_length=box[0],
        scene_width=box[1],
        scene_area=box[2],
        energy={
            "kinetic": float(run.energy[-1]),
            "initial": float(run.energy[0]),
            "brakes": run.brake_work,
            "ground_trucks": run.ground_work,
        },
    )
    if k < train.n:
        stop = run.pose[k, 0] + train.cars[k].truck_distance
        outcome = dataclasses.replace(
            outcome, rear_part_first_car=train.numbers[k], rear_part_coordinate=float(stop)
        )
    on = np.ones((train.n, 2), dtype=bool)
    on[:k] = False
    scene = _scene(train.cars, run.pose, on, np.ones(train.n - 1, dtype=bool), outcome,
                   train.numbers, breaks=(train.point,))  # fmt: skip
    return record_of(outcome, NO_COUPLINGS), scene, {"advance_m": finite(run.advance, 3)}


def _nothing(params: TrainParams, pose: Any, status: str, duration: float, steps: int) -> Outcome:
    """An outcome in which nothing is known but how long it took."""
    blank = Outcome.nothing(pose, status, duration, steps)
    return dataclasses.replace(blank, duration=duration, train=train_totals(params.cars))


NO_PLANE = (*NO_COUPLINGS, "scene_length_m", "scene_width_m", "scene_area_m2", "steps",
            "rejected_steps")  # fmt: skip
"""What a model with one coordinate does not know."""


def _one_dimensional(
    params: TrainParams, train: Train, answer: Any
) -> tuple[Record, None, dict[str, Any]]:
    """Record and notes of an estimate with one coordinate."""
    count = float(answer.cars_derailed)
    status = WHOLE_TRAIN if answer.whole_train else AT_REST
    outcome = dataclasses.replace(
        _nothing(params, np.zeros((train.n, 6)), status, float(answer.duration), 0),
        derailed_cars=_first_cars(train, count),
        energy={"initial": 0.5 * float(train.masses().sum()) * train.speed**2},
    )
    notes = {
        "distance_m": finite(answer.distance, 3),
        "peak_speed_m_per_s": finite(answer.peak_speed, 3),
    }
    return record_of(outcome, NO_PLANE, cars_derailed=finite(count, 3)), None, notes


def _blockage(params: TrainParams, _: Request) -> tuple[Record, None, dict[str, Any]]:
    train = derailing_train(params)
    length = train.mean_length()
    answer = blockage(
        train.speed, train.n, mass=train.mean_mass(), car_length=length, run_up=train.run_up
    )
    return _one_dimensional(params, train, answer)


def _bar(case: Callable[..., bar.Estimate], **form: Any) -> Callable[..., Any]:
    def run(params: TrainParams, _: Request) -> tuple[Record, None, dict[str, Any]]:
        train = derailing_train(params)
        length = train.mean_length()
        more = {"ground_length": 3.0 * length, **form} if form else {}
        answer = case(train.speed, train.n, car_length=length, **more)
        return _one_dimensional(params, train, answer)

    return run


_PLANE = {"plane": True, "varied": True, "kernels": True}

MODELS: dict[str, Model] = {
    PLANAR: Model("E. E. Toma 1998, the main model", _planar, rolls=True, **_PLANE),
    "yang-manos": Model("Yang and Manos 1972", _yang_manos, constants=("friction", "widening"),
                        **_PLANE),
    "anderson": Model(
        "Birk, Anderson and Coppens 1990", _anderson, rolls=True,
        constants=("stiffness", "damping", "force_limit", "friction", "restitution"), **_PLANE
    ),
    "roorda-gracie": Model("Roorda and Gracie 1992", _roorda_gracie, plane=True,
                           constants=("friction", "increment", "start_angle")),
    "blockage": Model("one-dimensional blockage model", _blockage),
    "bar-1": Model("a bar slides from the rails onto the ground", _bar(bar.bar_case_1)),
    "bar-2": Model("bar-1, what has gone too far is left behind (published form)",
                   _bar(bar.bar_case_2, form="published")),
    "bar-2-corrected": Model("bar-2 without the gain of energy",
                             _bar(bar.bar_case_2, form="corrected")),
    "bar-3": Model("bar-2 with brakes (published form)", _bar(bar.bar_case_3, form="published")),
    "bar-3-corrected": Model("bar-3 without the gain of energy",
                             _bar(bar.bar_case_3, form="corrected")),
}  # fmt: skip
"""The models by their names."""

FORMER = {"toma": PLANAR}
"""Names that models had before, which are still read."""
