"""A second engine, as small as one can be: the train as a bar that slides to rest.

Its state is a number of steps; place and speed follow in closed form.
"""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np

from derail_ros.vocabulary.events import Event, EventKind
from derail_ros.vocabulary.ledger import TAKEN, EnergyEntry
from derail_ros.vocabulary.measures import Measure
from derail_ros.vocabulary.outcome import Outcome
from derail_ros.vocabulary.params import GRAVITY, TrainParams
from derail_ros.vocabulary.plain import from_plain, to_plain
from derail_ros.vocabulary.sample import Sample, planar
from derail_ros.vocabulary.simulation import Simulation

FRICTION = 0.25
STEP = 0.05
MEASURE = Measure("slide_m", "sliding distance", lambda o: o.values.get("slide_m"), unit="m")
ENTRY = EnergyEntry("sliding", TAKEN, "sliding")


class Straight:
    """The endless straight along +X."""

    start, end, straight = -math.inf, math.inf, True

    def point(self, s):
        return s, 0.0, 0.0, 0.0

    def locate(self, x, y, hint=None):
        return x, y


class BarSimulation(Simulation):
    """The train slides with the deceleration ``FRICTION * GRAVITY``."""

    track = Straight()

    def __init__(self, params: TrainParams, steps: int = 0) -> None:
        self.params, self._steps = params, steps
        self._stop = params.initiation.speed / (FRICTION * GRAVITY)
        lengths = [car.length for car in params.cars]
        self._places = params.initiation.position - np.cumsum(lengths) + lengths[0]
        self._mass = sum(car.mass for car in params.cars)

    step_count = property(lambda self: self._steps)
    time = property(lambda self: self._steps * STEP)
    previous_time = property(lambda self: max(self._steps - 1, 0) * STEP)
    status = property(lambda self: "at rest" if self.time >= self._stop else "running")

    @property
    def events(self):
        if not self.ended:
            return []
        return [Event(EventKind.RUN_ENDED, self.time, self._steps, cause="at rest")]

    def advance_steps(self, n):
        before = len(self.events)
        self._steps += min(n, max(math.ceil(self._stop / STEP) - self._steps, 0))
        return self.events[before:]

    def advance_to(self, t):
        return self.advance_steps(2**62 if math.isinf(t) else math.ceil((t - self.time) / STEP))

    def _slide(self, t):
        t = min(t, self._stop)
        return (self.params.initiation.speed - 0.5 * FRICTION * GRAVITY * t) * t

    def sample(self, t=None):
        t = self.time if t is None else t
        x = self._places + self._slide(t)
        rest = np.zeros_like(x)
        speed = max(self.params.initiation.speed - FRICTION * GRAVITY * t, 0.0)
        return Sample.make(
            t,
            self._steps,
            planar(np.stack([x, rest, rest], axis=-1)),
            velocity=planar(np.stack([rest + speed, rest, rest], axis=-1)),
            truck_coordinate=np.stack([x, x], axis=-1),
            energy=self._energy(t),
            cars={"slide_m": rest + self._slide(t)},
        )

    def _energy(self, t):
        initial = 0.5 * self._mass * self.params.initiation.speed**2
        lost = FRICTION * self._mass * GRAVITY * self._slide(t)
        return {"kinetic": initial - lost, "initial": initial, "sliding": lost, "residual": 0.0}

    def outcome(self):
        outcome = Outcome.nothing(self.sample().pose, self.status, self.time, self._steps)
        values = {"slide_m": self._slide(self.time)}
        return replace(outcome, energy=self._energy(self.time), values=values)

    def to_bytes(self):
        return json.dumps([to_plain(self.params), self._steps]).encode()

    @classmethod
    def from_bytes(cls, data):
        params, steps = json.loads(data)
        return cls(from_plain(TrainParams, params), steps)


class BarEngine:
    """As ``derail_ros.models`` offers it."""

    name = "bar"
    words = "a bar"
    features = frozenset({"energy"})
    build = staticmethod(BarSimulation)
    load = staticmethod(BarSimulation.from_bytes)

    def warm_up(self, progress=None):
        return None

    def source_hash(self):
        return "bar"

    engine_hash = source_hash
