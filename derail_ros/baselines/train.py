"""The train of the simple models: the cars that pass the point of derailment, and its brakes.

They all begin where the first car derails: cars ahead of it are not involved, the lumped cars of
a virtual body are taken apart again.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from derail_ros.vocabulary.params import GRAVITY, BrakeTrigger, Car, TrainParams

F64 = NDArray[np.float64]


class ModelError(ValueError):
    """A model cannot be run on a train; the message is the reason."""


@dataclass(frozen=True)
class Train:
    """The part of a train that runs over the point of derailment."""

    cars: tuple[Car, ...]  # from the first car to derail on; none stands for several
    first: int  # cars ahead of it
    speed: float  # m/s
    start: float  # track coordinate of the first car's mass centre, m
    point: float  # track coordinate of the point of derailment, m
    run_up: float  # from the first car's front truck to the point, m; 0 if derailed from the start
    derailed: int  # derailed from the start, counted from the first one without a gap

    @property
    def n(self) -> int:
        """Number of cars."""
        return len(self.cars)

    @property
    def numbers(self) -> tuple[int, ...]:
        """Car numbers within the whole train, car 1 leads."""
        return tuple(range(self.first + 1, self.first + 1 + self.n))

    def masses(self) -> F64:
        """(N,) kg."""
        return np.array([car.mass for car in self.cars])

    def reach(self) -> tuple[F64, F64]:
        """(N,) from each mass centre to the coupling's middle ahead and behind, m."""
        ahead = [car.pivot_distance + car.front.length for car in self.cars]
        behind = [car.pivot_distance + car.rear.length for car in self.cars]
        return np.array(ahead), np.array(behind)

    def mean_length(self) -> float:
        """Mean length of the bodies, m."""
        return float(np.mean([car.length for car in self.cars]))

    def mean_mass(self) -> float:
        """Mean mass of the cars, kg."""
        return float(np.mean(self.masses()))


def centres(cars: Sequence[Car]) -> F64:
    """(N,) arc length of each mass centre behind that of the first, couplers stretched, m."""
    reach = [
        a.pivot_distance + a.rear.length + b.front.length + b.pivot_distance
        for a, b in zip(cars[:-1], cars[1:], strict=True)
    ]
    return np.cumsum([0.0, *reach])


def take_apart(cars: Sequence[Car]) -> tuple[Car, ...]:
    """The cars with the last one, if it stands for several, replaced by as many equal ones."""
    last = cars[-1]
    k = last.represents
    if k == 1:
        return tuple(cars)
    units = last.brakes if len(last.brakes) == k else (None,) * k
    single = [
        replace(
            last,
            mass=last.mass / k,
            inertia=last.inertia / k,
            represents=1,
            brakes=last.brakes if unit is None else (unit,),
            name="one of the virtual cars",
        )
        for unit in units
    ]
    return (*cars[:-1], *single)


def is_straight(params: TrainParams) -> bool:
    """The track has no curve."""
    return all(s.curvature_start == s.curvature_end == 0.0 for s in params.track.segments)


def derailing_train(params: TrainParams) -> Train:
    """Find the first car to derail and the cars behind it.

    The first one of those derailed from the start, else the first car behind the rail break that
    is met soonest. Without a break the point of derailment lies under the front truck of the first
    derailed car.

    Raises
    ------
    ModelError
        Nothing derails.
    """
    start = params.initiation
    trucks = np.array([car.truck_distance for car in params.cars])
    fronts = start.position - centres(params.cars) + trucks
    derailed = sorted({number - 1 for number, _ in start.derailed_trucks})
    meets = []
    for place in params.track.rail_breaks:
        behind = np.flatnonzero(fronts <= place)
        if len(behind) and params.cars[behind[0]].represents == 1:
            meets.append((place - float(fronts[behind[0]]), int(behind[0]), place))
    if derailed:
        first = derailed[0]
        at = [place for _, car, place in meets if car >= first]
        behind_nose = [b for b in params.track.rail_breaks if b <= fronts[first]]
        point = max(behind_nose) if behind_nose else (at[0] if at else float(fronts[first]))
        run_up = 0.0
    elif meets:
        run_up, first, point = min(meets)
    else:
        raise ModelError(
            "nothing derails: no truck starts derailed and the train reaches no rail break"
        )
    cars = take_apart(params.cars[first:])
    count = 0
    while first + count in derailed:
        count += 1
    centre = float(fronts[first]) - params.cars[first].truck_distance
    return Train(cars, first, start.speed, centre, point, run_up, count)


@dataclass(frozen=True)
class Brakes:
    """Emergency brakes of the cars of a :class:`Train`: arrival times and forces."""

    force: F64  # (N,) full force at rest, shoe's and car's factors in it, N
    iron: NDArray[np.bool_]  # (N,) cast iron shoes
    traction: F64  # (N,) force of the traction limited mode, N
    conventional: F64  # (N,) arrival time, s; likewise the next three
    instant: F64
    traction_limited: F64
    instant_traction: F64
    rise_time: float  # s

    def at(self, t: float, v: float) -> F64:
        """(N,) forces at the time ``t`` (s) and the speed ``v`` (m/s), N."""

        def rise(arrival: F64) -> F64:
            if self.rise_time == 0.0:
                return (t > arrival).astype(float)
            return np.clip((t - arrival) / self.rise_time, 0.0, 1.0)

        from derail_ros.engine.laws.brake import cast_iron_factor, composition_factor

        cast, composition = cast_iron_factor(abs(v)), composition_factor(abs(v))
        shoe = np.maximum(rise(self.conventional), t >= self.instant)
        rail = np.maximum(rise(self.traction_limited), t >= self.instant_traction)
        return np.maximum(
            shoe * self.force * np.where(self.iron, cast, composition), rail * self.traction
        )


def brakes_of(params: TrainParams, train: Train) -> Brakes:
    """The brakes of a scenario on a train; the signal starts as the scenario says.

    Where an application only starts as a coupling parts, it is taken to start at the first car to
    derail at the moment when it does: these models part no coupling.
    """
    law = params.brakes
    cars = train.cars
    whole = centres(params.cars)
    place = whole[train.first] + centres(cars)
    triggers = law.triggers
    if not triggers and law.vent_on_parting:
        t = train.run_up / train.speed if train.speed > 0.0 else math.inf
        triggers = (BrakeTrigger(time=t, source="car", car=train.first + 1),)
    arrival = {
        mode: np.full(len(cars), math.inf)
        for mode in ("conventional", "instant", "traction_limited", "instant_traction_limited")
    }
    delay = np.array([min((u.delay for u in car.brakes), default=0.0) for car in cars])
    for trigger in triggers:
        places = []
        if trigger.source in ("front", "both_ends"):
            places.append(0.0)
        if trigger.source in ("rear", "both_ends"):
            places.append(float(place[-1]))
        if trigger.source == "car":
            places.append(float(whole[trigger.car - 1]))
        for origin in places:
            travel = np.abs(place - origin) / law.signal_speed
            if trigger.mode.startswith("instant"):
                travel = np.zeros(len(cars))
            times = trigger.time + trigger.delay + travel + delay
            arrival[trigger.mode] = np.minimum(arrival[trigger.mode], times)
    shoes = [[u for u in car.brakes if u.shoe != "none"] for car in cars]
    return Brakes(
        force=np.array([sum(law.force * u.scale for u in units) for units in shoes]),
        iron=np.array([any(u.shoe == "cast_iron" for u in units) for units in shoes]),
        traction=np.array(
            [sum(law.traction_coefficient * GRAVITY * u.weight for u in units) for units in shoes]
        ),
        conventional=arrival["conventional"],
        instant=arrival["instant"],
        traction_limited=arrival["traction_limited"],
        instant_traction=arrival["instant_traction_limited"],
        rise_time=law.rise_time,
    )
