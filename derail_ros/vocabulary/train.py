"""Totals of a train, as an accident report gives them."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from derail_ros.vocabulary.params import Car
from derail_ros.vocabulary.words import count, finite

TRAIN_COUNTS = ("locomotives", "loads", "empties")
"""What a body counts as, by the names of :class:`TrainTotals` and of ``params.Car``."""


@dataclass(frozen=True)
class TrainTotals:
    """A train in numbers. A body that stands for several cars counts as those.

    Attributes
    ----------
    cars : numbered vehicles, locomotives and each platform of an articulated car among them
    locomotives : of them
    loads, empties : loaded and empty cars; the load of the others was not given
    length : over couplers, from pulling face to pulling face, couplings straight, m; nan: unknown
    mass : kg; nan: unknown
    """

    cars: int = 0
    locomotives: int = 0
    loads: int = 0
    empties: int = 0
    length: float = math.nan
    mass: float = math.nan

    @property
    def text(self) -> str:
        """The totals in a line: ``62 cars (2 locomotives, 60 loads), 1012.4 m, 8140 t``."""
        rest = self.cars - self.locomotives - self.loads - self.empties
        parts = [
            count(self.locomotives, "locomotive") if self.locomotives else "",
            count(self.loads, "load") if self.loads else "",
            ("1 empty" if self.empties == 1 else f"{self.empties} empties")
            if self.empties
            else "",
            f"{rest} with load not given" if rest and rest < self.cars else "",
        ]
        inside = ", ".join(filter(None, parts))
        text = count(self.cars, "car") + (f" ({inside})" if inside else "")
        if math.isfinite(self.length):
            text += f", {self.length:.1f} m over couplers"
        return text + (f", {self.mass * 1e-3:.0f} t" if math.isfinite(self.mass) else "")

    @property
    def record(self) -> dict[str, Any]:
        """The totals as plain data; None for unknown values."""
        counts = {key: getattr(self, key) for key in ("cars", *TRAIN_COUNTS)}
        sizes = {"length_m": finite(self.length), "mass_kg": finite(self.mass)}
        return {**counts, **sizes, "text": self.text}


def length_over_couplers(car: Car) -> float:
    """Length of a body, or of the cars it stands for, from pulling face to pulling face, m."""
    return car.coupled_length or car.front.length + 2.0 * car.pivot_distance + car.rear.length


def train_totals(cars: Iterable[Car]) -> TrainTotals:
    """Totals of these bodies."""
    cars = tuple(cars)
    return TrainTotals(
        cars=sum(car.represents for car in cars),
        **{key: sum(getattr(car, key) for car in cars) for key in TRAIN_COUNTS},
        length=math.fsum(map(length_over_couplers, cars)),
        mass=math.fsum(car.mass for car in cars),
    )
