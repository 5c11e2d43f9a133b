"""A planar run: parameters, state, history; stepping and commands.

Its parts have files of their own: samples (``sampling``), outcome (``outcome``), rows of events
and collisions (``reports``), growth of arrays and saving (``saving``).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from derail_ros.engine import layout, saving, stepper
from derail_ros.engine.arrays import State, make_work
from derail_ros.engine.blocks import prepare
from derail_ros.engine.build import ARRIVALS, build_model, check_trigger, initial_state, validate
from derail_ros.engine.dynamics import PLAIN, accelerations, project_positions, project_velocities
from derail_ros.engine.energy import stored_energy
from derail_ros.engine.forces.along import potential_energy
from derail_ros.engine.forces.brakes import apply_brakes
from derail_ros.engine.neighbours import rebuild
from derail_ros.engine.outcome import make_outcome
from derail_ros.engine.reports import (
    BEFORE_AFTER,
    CAUSES,
    STATUS,
    brake_words,
    collision_of,
    event_of,
)
from derail_ros.engine.sampling import Sampler
from derail_ros.engine.solver import plain_masses
from derail_ros.engine.track import Track
from derail_ros.engine.warming import ensure_compiled
from derail_ros.vocabulary.errors import (
    CommandError,
    ConstraintError,
    NonFiniteStateError,
    ParameterError,
    SimulationError,
    StepSizeError,
    TrackEndError,
)
from derail_ros.vocabulary.events import Collision, Command, Event, EventKind
from derail_ros.vocabulary.outcome import Outcome
from derail_ros.vocabulary.params import TrainParams
from derail_ros.vocabulary.sample import Sample
from derail_ros.vocabulary.simulation import Simulation
from derail_ros.vocabulary.status import ENDS

ERRORS: dict[int, tuple[type[SimulationError], str]] = {
    stepper.NON_FINITE: (NonFiniteStateError, "the state is no longer finite"),
    stepper.STEP_FLOOR: (StepSizeError, "the step size fell below its floor"),
    stepper.SINGULAR: (ConstraintError, "the constraint equations cannot be solved"),
    stepper.TRACK_END: (TrackEndError, "a truck on the rails left the end of the alignment"),
}

_EVENT_ROWS_PER_CAR = 16


class PlanarSimulation(Simulation):
    """One derailment of the planar model.

    The run takes its own steps, whatever output is asked for: ``advance_to(t)`` returns with
    ``time >= t`` and ``sample(t)`` interpolates. Commands apply at the end of the last step. The
    same parameters and commands at the same steps give the same run to the bit on one machine and
    set of versions.

    Parameters
    ----------
    params : everything the run is built from

    Raises
    ------
    ParameterError
        A parameter is out of its range or does not fit the others.
    """

    def __init__(self, params: TrainParams) -> None:
        validate(params)
        ensure_compiled()
        self.params = params
        self.track = Track(params.track)
        self._model = build_model(params, self.track)
        self._state = initial_state(params, self._model, self.track)
        self._events: list[Event] = []
        self._commands: list[Command] = []
        self._scheduled: list[Event] = []
        self._seen: dict[int, int] = {}
        self._make_work()
        self._start()

    def _make_work(self) -> None:
        n = len(self.params.cars)
        event_rows = _EVENT_ROWS_PER_CAR * n + 2 * len(self._model.unit) + 64
        fixed = len(self._model.fixed)
        self._work = make_work(n, len(self._state.pairs), event_rows, False, fixed)
        plain_masses(self._model, self._work.wk)
        self._sampler = Sampler(self)

    def _start(self) -> None:
        s = self._state
        if not project_positions(self._model, s, self._work, s.q):
            raise ParameterError("initiation", "the train does not fit the track here")
        project_velocities(self._model, s, self._work, s.v)
        s.q0[:] = s.q
        s.v0[:] = s.v
        self._announce()
        self._grow_until(rebuild(self._model, s, self._work))
        if not self._evaluate():
            raise ParameterError("initiation", "the constraints of the train are not independent")
        s.a0[:] = s.a
        s.a1[:] = s.a
        s.power0[:] = s.power
        s.power1[:] = s.power
        self._model.par["datum"] = potential_energy(self._model, s, s.q)
        s.clock["initial_energy"][0] = stored_energy(self._model, s, s.q, s.v)
        self._drain()

    def _announce(self) -> None:
        """Events of the start; applications of the brakes that are given from there."""
        s = self._state
        start = self.params.initiation
        for number, end in start.derailed_trucks:
            self._add_event(
                EventKind.TRUCK_DERAILED, (number,), end=end, cause="initial",
                truck=(number - 1, ENDS.index(end)),
            )  # fmt: skip
        for number in start.parted_couplings:
            self._add_event(EventKind.COUPLER_PARTED, (number, number + 1), cause="initial")
            if self.params.brakes.vent_on_parting:
                at = float(self._model.car["distance"][number - 1 : number + 1].mean())
                apply_brakes(self._model, s, at, layout.ARR_CONV, 0.0)
                self._add_event(
                    EventKind.BRAKES_TRIGGERED, (number, number + 1),
                    cause=CAUSES[layout.CAUSE_VENT],
                )  # fmt: skip
        for coordinate in self.params.track.rail_breaks:
            x, y, _, _ = self.track.point(coordinate)
            self._add_event(
                EventKind.RAIL_BREAK_SET, cause="initial", x=x, y=y, track_coordinate=coordinate
            )
        for trigger in self.params.brakes.triggers:
            self._start_brakes(
                trigger.mode, trigger.source, trigger.car, trigger.time + trigger.delay
            )
            event = Event(
                kind=EventKind.BRAKES_TRIGGERED,
                time=trigger.time + trigger.delay,
                step=0,
                cars=(trigger.car,) if trigger.source == "car" else (),
                cause=brake_words(trigger.mode, trigger.source),
                before="released",
                after="emergency",
            )
            self._scheduled.append(event)
        self._scheduled.sort(key=lambda e: e.time)

    def _evaluate(self) -> bool:
        """Accelerations, multipliers and powers of the state as it stands, into the state."""
        s, work = self._state, self._work
        s.clock["t_on"][0] = s.clock["t"][0]
        prepare(self._model, s, work, s.q, s.v)
        ok = accelerations(self._model, s, work, self.time, s.q, s.v, s.a, PLAIN)
        s.power[:] = work.power
        s.rail_force[:] = work.lam_t
        s.coupler_force[:] = work.lam_c
        return bool(ok)

    def _grow_until(self, fits: bool) -> None:
        while not fits:
            self._grow_pairs()
            fits = rebuild(self._model, self._state, self._work)

    # --- what it is at -----------------------------------------------------------------------

    @property
    def time(self) -> float:
        """End of the last accepted step, s."""
        return float(self._state.clock["t"][0])

    @property
    def previous_time(self) -> float:
        """Beginning of the last accepted step, s."""
        return float(self._state.clock["t_prev"][0])

    @property
    def step_count(self) -> int:
        """Accepted steps so far."""
        return int(self._state.cnt["steps"][0])

    @property
    def status(self) -> str:
        """ "running", "at rest", "time limit", "void" or "failed"."""
        return STATUS[int(self._state.cnt["status"][0])]

    @property
    def events(self) -> list[Event]:
        """All events so far, in the order of their time."""
        return list(self._events)

    @property
    def commands(self) -> list[Command]:
        """Commands applied so far."""
        return list(self._commands)

    @property
    def rail_breaks(self) -> list[float]:
        """Track coordinates of all breaks so far, m."""
        return [float(s) for s in self._state.breaks if math.isfinite(s)]

    @property
    def statistics(self) -> dict[str, int]:
        """Counters of the integration: steps, rejected steps, evaluations, what set the step."""
        c = self._state.cnt[0]
        return {
            "steps": int(c["steps"]),
            "rejected": int(c["rejected"]),
            "evaluations": int(c["evaluations"]),
            "neighbour_lists": int(c["rebuilds"]),
            "limited_by_accuracy": int(c["by_accuracy"]),
            "limited_by_cap": int(c["by_cap"]),
            "limited_by_stability": int(c["by_stability"]),
            "limited_by_largest": int(c["by_largest"]),
            "ended_at_a_moment": int(c["by_moment"]),
            "implicit": int(c["implicit"]),
        }

    @property
    def collisions(self) -> list[Collision]:
        """All contacts so far, in the order of their beginning."""
        return [self._collision(k) for k in range(int(self._state.cnt["contacts"][0]))]

    def new_collisions(self) -> list[Collision]:
        """Contacts whose peak has passed, or that have ended, since the last call."""
        out = []
        for k in range(int(self._state.cnt["contacts"][0])):
            version = int(self._state.contact[k]["version"])
            if version != self._seen.get(k, 0):
                self._seen[k] = version
                out.append(self._collision(k))
        return out

    def _collision(self, k: int) -> Collision:
        fixed = self.params.site.fixed
        return collision_of(k, layout.named(self._state.contact[k : k + 1])[0], fixed)

    # --- going on ----------------------------------------------------------------------------

    def advance_to(self, t: float) -> list[Event]:
        """Take steps until ``time >= t`` or the run ends; returns the new events.

        Raises
        ------
        SimulationError
            The run cannot go on; it keeps its last accepted state.
        """
        if math.isnan(t):
            raise CommandError("t", "must be a number")
        return self._advance(t, np.iinfo(np.int64).max)

    def advance_steps(self, n: int) -> list[Event]:
        """Take ``n`` steps (fewer when the run ends); returns the new events."""
        return self._advance(math.inf, n)

    def _advance(self, t: float, max_steps: int) -> list[Event]:
        first = len(self._events)
        target_step = self.step_count + max_steps if max_steps < 2**62 else 2**62
        if self._state.cnt["status"][0] == layout.FAILED:
            raise SimulationError("the run has failed before and cannot go on", self)
        while True:
            left = target_step - self.step_count
            code = stepper.advance(self._model, self._state, self._work, t, left)
            self._drain()
            if code == stepper.DONE:
                return self._events[first:]
            if code == stepper.GROW_PAIRS:
                self._grow_pairs()
            elif code == stepper.GROW_CONTACTS:
                self._state = saving.grown_contacts(self._state)
            elif code in ERRORS:
                kind, reason = ERRORS[code]
                text = f"{reason} at t = {self.time:.6f} s (step {self.step_count})"
                self._events.append(
                    Event(EventKind.RUN_FAILED, self.time, self.step_count, cause=reason)
                )
                raise kind(text, self)

    def _grow_pairs(self) -> None:
        self._state = saving.grown_pairs(self._state)
        self._make_work()

    def _drain(self) -> None:
        """Turn the kernels' event rows into events, with the scheduled ones that are due."""
        count = int(self._state.cnt["events"][0])
        self._state.cnt["events"][0] = 0
        batch = [event_of(row, self.track) for row in layout.named(self._work.event[:count])]
        while self._scheduled and self._scheduled[0].time <= self.time:
            batch.append(self._scheduled.pop(0))
        batch.sort(key=lambda e: e.time)
        self._events += batch

    def _add_event(
        self,
        kind: EventKind,
        cars: tuple[int, ...] = (),
        truck: tuple[int, int] | None = None,
        **fields: Any,
    ) -> None:
        s = self._state
        if truck is not None:
            i, k = truck
            r = self.params.cars[i].truck_distance * (1 if k == 0 else -1)
            fields["x"] = float(s.q[i, 0] + r * math.cos(s.q[i, 2]))
            fields["y"] = float(s.q[i, 1] + r * math.sin(s.q[i, 2]))
            fields["track_coordinate"] = float(s.truck_s[i, k])
        if cars:
            fields["speed"] = float(math.hypot(*s.v[cars[0] - 1, :2]))
        before, after = BEFORE_AFTER.get(kind, ("", ""))
        self._events.append(
            Event(kind, self.time, self.step_count, cars, before=before, after=after, **fields)
        )

    # --- commands ----------------------------------------------------------------------------

    def inject_rail_break(self, coordinate: float | None = None, car: int | None = None) -> float:
        """Break the rail at a track coordinate (m), or just ahead of a car's front truck.

        Returns the track coordinate. Trucks derail as they pass it, either way.

        Raises
        ------
        CommandError
            No such place or car, or the run has ended.
        """
        self._refuse_when_ended()
        if (coordinate is None) == (car is None):
            raise CommandError("coordinate", "give either a track coordinate or a car")
        if car is not None:
            i = self._car_index(car)
            if not self._state.truck_on[i, 0]:
                raise CommandError("car", f"the front truck of car {car} is off the rails")
            ahead = self.params.derailment.break_ahead_of_truck
            coordinate = float(self._state.truck_s[i, 0]) + ahead
        try:
            place = float(coordinate)  # type: ignore[arg-type]
        except (TypeError, ValueError):
            raise CommandError("coordinate", f"must be a number, not {coordinate!r}") from None
        self._break_rail(place, 0 if car is None else int(car))
        return place

    def _break_rail(self, place: float, car: int) -> None:
        """Break the rail at ``place``; ``car`` is the one it was asked under, or 0."""
        if not math.isfinite(place):
            raise CommandError("coordinate", f"must be finite, not {place}")
        low, high = max(self.track.start, -1e6), min(self.track.end, 1e6)
        if not low <= place <= high:
            raise CommandError(
                "coordinate", f"{place:g} m lies outside the track ({low:g} to {high:g} m)"
            )
        s = self._state
        free = np.flatnonzero(np.isinf(s.breaks))
        if len(free) <= 2 * self.n_cars:
            # rows in reserve for the breaks that lateral derailments may leave
            s = self._state = saving.grown_breaks(s)
            free = np.flatnonzero(np.isinf(s.breaks))
        s.breaks[free[0]] = place
        self._log("inject_rail_break", {"coordinate": place, "car": car})
        x, y, _, _ = self.track.point(place)
        self._add_event(
            EventKind.RAIL_BREAK_SET, cause="command", x=x, y=y, track_coordinate=place,
            value=float(car),
        )  # fmt: skip

    def trigger_emergency_brake(
        self,
        mode: str = "conventional",
        source: str = "front",
        car: int = 0,
        delay: float = 0.0,
    ) -> None:
        """Start an emergency application; a second one can only raise each car's brake.

        Parameters
        ----------
        mode : "conventional", "instant", "traction_limited" or "instant_traction_limited"
        source : "front", "rear", "both_ends" or "car"
        car : the car, for that source
        delay : s until it is made

        Raises
        ------
        CommandError
            Bad mode, source, car or delay, or the run has ended.
        """
        self._refuse_when_ended()
        try:
            check_trigger(mode, source, car, delay, self.params.n_train, "")
        except ParameterError as error:
            raise CommandError(error.field.lstrip("."), error.reason) from None
        delay = float(delay)
        self._start_brakes(mode, source, car, self.time + delay)
        self._log(
            "trigger_emergency_brake",
            {"mode": mode, "source": source, "car": int(car), "delay": delay},
        )
        self._scheduled.append(
            Event(
                kind=EventKind.BRAKES_TRIGGERED,
                time=self.time + delay,
                step=self.step_count,
                cars=(int(car),) if source == "car" else (),
                cause=f"command: {brake_words(mode, source)}",
                before="released",
                after="emergency",
            )
        )
        self._scheduled.sort(key=lambda e: e.time)
        self._drain()
        self._evaluate()

    def _start_brakes(self, mode: str, source: str, car: int, t: float) -> None:
        kind = ARRIVALS[mode]
        distance = self._model.car["distance"]
        units = self._model.unit["distance"]
        own = self._model.unit["body"] < self.params.n_train
        places = []
        if source in ("front", "both_ends"):
            places.append(float(distance[0]))
        if source in ("rear", "both_ends"):
            # the virtual body's last car is further back than its centre
            last = float(distance[self.params.n_train - 1])
            places.append(float(max(last, units[own].max(initial=0.0))))
        if source == "car":
            places.append(float(distance[car - 1]))
        for place in places:
            apply_brakes(self._model, self._state, place, kind, t)

    def apply(self, command: Command) -> None:
        """Apply a logged command again, at the step at which it was logged."""
        arguments = dict(command.arguments)
        if command.name == "inject_rail_break" and set(arguments) == {"coordinate", "car"}:
            # as logged: the place is known, and the car it was asked under goes with it
            self._go_to(command.step)
            self._refuse_when_ended()
            self._break_rail(float(arguments["coordinate"]), int(arguments["car"]))  # type: ignore[arg-type, call-overload]
        else:
            super().apply(command)

    def _log(self, name: str, arguments: dict[str, object]) -> None:
        self._commands.append(Command(name, arguments, self.step_count, self.time))

    def _car_index(self, number: int) -> int:
        if not isinstance(number, (int, np.integer)) or isinstance(number, bool):
            raise CommandError("car", f"must be a whole number, not {number!r}")
        last = self.params.n_train
        if not 1 <= number <= last:
            raise CommandError("car", f"there is no car {number} of the train (1 to {last})")
        return int(number) - 1

    # --- reports -----------------------------------------------------------------------------

    def sample(self, t: float | None = None) -> Sample:
        """State and forces at ``t`` within the last step (default: its end).

        After the end of the run any later ``t`` gives the final state.
        """
        t = self.time if t is None else float(t)
        if not self.previous_time <= t <= self.time and not (self.ended and t > self.time):
            raise ValueError(
                f"t = {t} s is outside the last step ({self.previous_time} to {self.time} s)"
            )
        return self._sampler(t)

    def outcome(self) -> Outcome:
        """What has come of the run so far."""
        return make_outcome(self)

    # --- copies ------------------------------------------------------------------------------

    def copy(self) -> PlanarSimulation:
        """An independent run at the same state."""
        other = object.__new__(type(self))
        other.params = self.params
        other.track = self.track
        other._model = self._model
        arrays: Any = (array.copy() for array in self._state)
        other._state = State(*arrays)
        other._events = list(self._events)
        other._commands = list(self._commands)
        other._scheduled = list(self._scheduled)
        other._seen = dict(self._seen)
        other._make_work()
        return other

    def to_bytes(self) -> bytes:
        """The whole run: parameters, state, events and commands."""
        return saving.to_bytes(self)

    @classmethod
    def from_bytes(cls, data: bytes) -> PlanarSimulation:
        """A run from `to_bytes`; it goes on to the bit as the saved one would have."""
        return saving.from_bytes(cls, data)

    def state_hash(self) -> str:
        """SHA-256 (hex) of all that decides the future of the run."""
        return saving.state_hash(self._state)
