"""The train of an accident report as a run of the engine."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from derail_ros.scenario.calibrated import Draw
from derail_ros.scenario.resolve import SHOE_FRICTION, cylinder_inertia
from derail_ros.vocabulary.params import GRAVITY, BrakeUnit, Car, GradeChange, TrainParams
from derail_ros.vocabulary.train import length_over_couplers

if TYPE_CHECKING:
    from derail_ros.scenario import Scenario

EMPTY_KG = 28.5e3
LOADED_KG = 129.7e3
"""Mass of an empty and of the heaviest loaded car (286 000 lb), kg."""

BRAKING_RATIO_LOADED, BRAKING_RATIO_EMPTY, EMERGENCY = 0.11, 0.25, 1.2
"""Net braking ratios and the factor of an emergency: defaults of ``brakes`` in scenarios."""

SPARE = 10
"""Cars modelled beyond those that can reach the break."""


@dataclass(frozen=True)
class Train:
    """A train as a report describes it, from the first car involved on.

    Attributes
    ----------
    speed : m/s
    behind : cars
    mass : mean gross mass of a car, kg
    loaded : share of loaded cars
    """

    speed: float
    behind: int
    mass: float
    loaded: float = 1.0


TEMPLATE = """\
version: 1
title: Train of a report
constants: published
train:
  speed_kmh: 60
  consist:
    - {car: source_base_car}
track: {rail_breaks: [0]}
initiation:
  derailed_trucks: [{car: 1, truck: both}]
"""


@functools.lru_cache(maxsize=16)
def _template(speed: float) -> Scenario:
    """One car of the base train that has just derailed at a broken rail, at a speed in m/s."""
    from derail_ros.scenario import loads_scenario

    return loads_scenario(TEMPLATE, "report").with_overrides({"train.speed_kmh": 3.6 * speed})


def masses(train: Train, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Mass of each car (kg) and whether it is loaded, in random order.

    Their mean mass is the train's; an empty car weighs 28.5 t if that leaves the loaded ones at
    most 129.7 t.
    """
    n = train.behind
    share = min(max(train.loaded, 0.0), 1.0)
    k = round(share * n)
    loaded = np.zeros(n, dtype=bool)
    loaded[rng.permutation(n)[:k]] = True
    if k in (0, n):
        return np.full(n, train.mass), loaded
    f = k / n
    light = min(EMPTY_KG, 0.8 * train.mass)
    heavy = (train.mass - (1.0 - f) * light) / f
    if heavy > LOADED_KG > train.mass:
        heavy = LOADED_KG
        light = (train.mass - f * heavy) / (1.0 - f)
    return np.where(loaded, heavy, light), loaded


def train_params(train: Train, draw: Draw, order: int = 0) -> TrainParams:
    """Parameters of a run in which a rail breaks under the first car, every car modelled.

    Parameters
    ----------
    train : the train
    draw : the uncertain constants
    order : seed of the order of loaded and empty cars
    """
    base = on_grade(_template(train.speed).drawn_params(draw), draw)
    one = base.cars[0]
    longer = (draw.length - 1.0) * length_over_couplers(one)
    length = one.length + longer
    kg, loaded = masses(train, np.random.default_rng(order))
    cars = [
        replace(
            one,
            mass=float(m),
            inertia=cylinder_inertia(float(m), length),
            length=length,
            pivot_distance=one.pivot_distance + 0.5 * longer,
            truck_distance=one.truck_distance + 0.5 * longer,
            loads=int(full),
            empties=int(not full),
        )
        for m, full in zip(kg, loaded, strict=True)
    ]
    return replace(base, cars=_braked(cars, draw))


def consist_params(cars: Sequence[Car], speed: float, draw: Draw) -> TrainParams:
    """Parameters of a run in which a rail breaks under the first of these cars, at ``speed``."""
    base = on_grade(_template(speed).drawn_params(draw), draw)
    return replace(base, cars=_braked(cars, draw))


def _braked(cars: Sequence[Car], draw: Draw) -> tuple[Car, ...]:
    """Cars with a brake each, by the net braking ratio of loaded and of empty ones."""
    found = []
    place = 0.0
    for car in cars:
        ratio = BRAKING_RATIO_EMPTY if car.empties else BRAKING_RATIO_LOADED
        force = ratio * car.mass * GRAVITY * EMERGENCY * SHOE_FRICTION * draw.brake_force
        unit = BrakeUnit(place, scale=draw.brake_force, weight=car.mass, force=force)
        found.append(replace(car, brakes=(unit,)))
        place += length_over_couplers(car)
    return tuple(found)


def on_grade(params: TrainParams, draw: Draw) -> TrainParams:
    """The same run on a draw's grade, if it has no grade of its own."""
    if params.track.grades or not draw.grade:
        return params
    grade = GradeChange(-math.inf, draw.grade)
    return replace(params, track=replace(params.track, grades=(grade,)))


# Which car is the first ------------------------------------------------------------------------


def first_car(params: TrainParams) -> int:
    """Number of the first car involved, from 1: off at the start, or the next to reach a break."""
    numbers = [car for car, _ in params.initiation.derailed_trucks]
    place = params.initiation.position
    for i, car in enumerate(params.cars[: params.n_train], 1):
        if i > 1:
            place -= 0.5 * (length_over_couplers(params.cars[i - 2]) + length_over_couplers(car))
        truck = place + car.truck_distance
        if any(b >= truck for b in params.track.rail_breaks) and car.represents == 1:
            numbers.append(i)
            break
    return min(numbers, default=1)


def start_few(params: TrainParams, few: int) -> TrainParams:
    """The same train with a few cars off, from the first one on: no break, and no push."""
    first = first_car(params)
    last = min(first + few, params.n_train + 1)
    off = tuple((i, end) for i in range(first, last) for end in ("front", "rear"))
    start = replace(params.initiation, derailed_trucks=off, lateral_forces=())
    return replace(params, initiation=start, track=replace(params.track, rail_breaks=()))


def limited(params: TrainParams, draw: Draw, few: int = 0) -> TrainParams:
    """The same run with those cars as one body that cannot derail.

    Cars that brakes alone, without a pile, let reach the break can derail, and :data:`SPARE` more.
    Half of the build-up of 10 s counts as no braking, and 0.3 of the force as lost to speed.
    """
    cars = params.cars
    if len(cars) < SPARE + 2 or cars[-1].represents > 1 or params.track.segments:
        return params
    if params.standing:
        return params
    first = first_car(params)
    if few:
        keep = first + few + SPARE
    else:
        mass = math.fsum(c.mass for c in cars)
        full = params.brakes.force
        force = math.fsum(
            (full * u.scale if u.force is None else u.force) for c in cars for u in c.brakes
        )
        v = params.initiation.speed
        delay = max((t.delay + t.time for t in params.brakes.triggers), default=math.inf)
        slowing = max(0.7 * force / mass + GRAVITY * draw.grade, 0.08)
        way = v * (delay + 5.0) + v * v / (2.0 * slowing)
        pitch = math.fsum(map(length_over_couplers, cars)) / len(cars)
        keep = len(cars) if math.isinf(way) else first + math.ceil(way / pitch) + SPARE
    if keep >= len(cars) - 1:
        return params
    return replace(params, cars=(*cars[:keep], virtual(cars[keep:])))


def virtual(cars: tuple[Car, ...]) -> Car:
    """One body in the place of the first of these cars, with the mass and brakes of all."""
    return replace(
        cars[0],
        mass=math.fsum(c.mass for c in cars),
        inertia=math.fsum(c.inertia for c in cars),
        brakes=tuple(u for c in cars for u in c.brakes),
        represents=len(cars),
        loads=sum(c.loads for c in cars),
        empties=sum(c.empties for c in cars),
        coupled_length=math.fsum(length_over_couplers(c) for c in cars),
        name=f"{len(cars)} virtual cars",
    )
