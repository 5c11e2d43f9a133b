"""A run: parameters, state, history; stepping, commands, samples, saving."""

from __future__ import annotations

import hashlib
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from derail_ros.engine import arrays as A
from derail_ros.engine import layout as L
from derail_ros.engine import stepper
from derail_ros.engine.arrays import State, Work, make_work
from derail_ros.engine.build import (
    ARRIVALS,
    ENDS,
    build_model,
    check_trigger,
    initial_state,
    validate,
)
from derail_ros.engine.dynamics import (
    PLAIN,
    accelerations,
    project_positions,
    project_velocities,
)
from derail_ros.engine.forces import coupler_energy, kinetic_energy
from derail_ros.engine.interpolation import interpolate, interpolate_energy
from derail_ros.engine.neighbours import rebuild
from derail_ros.engine.outcome import make_outcome
from derail_ros.engine.sample import Outcome, Sample
from derail_ros.engine.serial import from_plain, pack, to_plain, unpack
from derail_ros.engine.solver import plain_masses
from derail_ros.engine.track import Track
from derail_ros.engine.warming import ensure_compiled
from derail_ros.vocabulary.errors import (
    CommandError,
    ConstraintError,
    DerailError,
    NonFiniteStateError,
    ParameterError,
    SimulationError,
    StateFormatError,
    StepSizeError,
    TrackEndError,
)
from derail_ros.vocabulary.events import Collision, Command, Event, EventKind
from derail_ros.vocabulary.params import TrainParams

ENERGY_ENTRIES = (
    "kinetic",
    "striker",
    "knuckle",
    "initial",
    "brakes",
    "ground_trucks",
    "ground_body",
    "collisions",
    "striker_dampers",
    "knuckles_released",
    "external",
    "stabilization_net",
    "stabilization_gross",
    "residual",
)
"""Entries of ``Sample.energy``, J: the first three are stored now; ``external`` and
``stabilization_net`` were put in, the others taken out since the start."""

STATUS = {
    L.RUNNING: "running",
    L.AT_REST: "at rest",
    L.TIME_LIMIT: "time limit",
    L.VOID: "void",
    L.FAILED: "failed",
}

CAUSES = {
    L.CAUSE_NONE: "",
    L.CAUSE_INITIAL: "initial",
    L.CAUSE_BREAK: "rail break",
    L.CAUSE_LATERAL: "lateral force",
    L.CAUSE_ANGLE: "angle",
    L.CAUSE_COMMAND: "command",
    L.CAUSE_VENT: "vented",
    L.CAUSE_SIGNAL: "brake signal",
}

ERRORS: dict[int, tuple[type[SimulationError], str]] = {
    stepper.NON_FINITE: (NonFiniteStateError, "the state is no longer finite"),
    stepper.STEP_FLOOR: (StepSizeError, "the step size fell below its floor"),
    stepper.SINGULAR: (ConstraintError, "the constraint equations cannot be solved"),
    stepper.TRACK_END: (TrackEndError, "a truck on the rails left the end of the alignment"),
}

# Arrays with spare rows, and the counter of those in use.
_ROWS = {"pairs": L.N_PAIRS, "mask": L.N_PAIRS, "pair": L.N_PAIRS, "contact": L.N_CONTACTS}
_EVENT_ROWS_PER_CAR = 16

_BEFORE_AFTER = {
    EventKind.TRUCK_DERAILED: ("on the rails", "derailed"),
    EventKind.COUPLER_PARTED: ("coupled", "parted"),
    EventKind.RAIL_BREAK_SET: ("rail whole", "rail broken"),
    EventKind.BRAKES_TRIGGERED: ("released", "emergency"),
    EventKind.BRAKE_SIGNAL_REACHED: ("released", "applying"),
    EventKind.CAR_AT_REST: ("moving", "at rest"),
}


def brake_words(mode: str, source: str) -> str:
    """An application in words: ``conventional from both ends``."""
    article = "" if source == "both_ends" else "the "
    return f"{mode} from {article}{source}".replace("_", " ")


def _all_active(state: State, work: Work) -> None:
    """Let the next evaluation look at every pair of the neighbour list."""
    count = int(state.cnt[L.N_PAIRS])
    work.active[0] = count
    work.active[1 : 1 + count] = np.arange(count)


class Simulation:
    """One derailment.

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
        self._work = make_work(n, len(self._state.pairs), event_rows, False)
        plain_masses(self._model, self._work.wk)
        self._report: A.Work | None = None

    def _start(self) -> None:
        s = self._state
        if not project_positions(self._model, s, self._work, s.truck_on, s.coupled, s.q):
            raise ParameterError("initiation", "the train does not fit the track here")
        project_velocities(self._model, self._work, s.truck_on, s.coupled, s.v)
        s.q0[:] = s.q
        s.v0[:] = s.v
        start = self.params.initiation
        for number, end in start.derailed_trucks:
            self._add_event(
                EventKind.TRUCK_DERAILED, (number,), end=end, cause="initial",
                truck=(number - 1, ENDS.index(end)),
            )  # fmt: skip
        for number in start.parted_couplings:
            self._add_event(EventKind.COUPLER_PARTED, (number, number + 1), cause="initial")
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
        self._grow_until(rebuild(self._model, s, self._work))
        if not self._evaluate():
            raise ParameterError("initiation", "the constraints of the train are not independent")
        s.a0[:] = s.a
        s.a1[:] = s.a
        s.power0[:] = s.power
        s.power1[:] = s.power
        s.clock[L.E_INITIAL] = kinetic_energy(self._model, s.v) + sum(
            coupler_energy(self._model, s.coupled, s.q)
        )
        self._drain()

    def _evaluate(self) -> bool:
        """Accelerations, multipliers and powers of the state as it stands, into the state."""
        s, work = self._state, self._work
        s.clock[L.T_ON] = s.clock[L.T]
        _all_active(s, work)
        ok = accelerations(
            self._model, s, work, self.time, s.truck_on, s.coupled, s.q, s.v, s.a, PLAIN
        )
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
    def n_cars(self) -> int:
        """Number of bodies."""
        return len(self.params.cars)

    @property
    def time(self) -> float:
        """End of the last accepted step, s."""
        return float(self._state.clock[L.T])

    @property
    def previous_time(self) -> float:
        """Beginning of the last accepted step, s."""
        return float(self._state.clock[L.T_PREV])

    @property
    def step_count(self) -> int:
        """Accepted steps so far."""
        return int(self._state.cnt[L.STEP])

    @property
    def status(self) -> str:
        """ "running", "at rest", "time limit", "void" or "failed"."""
        return STATUS[int(self._state.cnt[L.STATUS])]

    @property
    def ended(self) -> bool:
        """No further step will be taken."""
        return bool(self._state.cnt[L.STATUS] != L.RUNNING)

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
        c = self._state.cnt
        return {
            "steps": int(c[L.STEP]),
            "rejected": int(c[L.REJECTED]),
            "evaluations": int(c[L.EVALS]),
            "neighbour_lists": int(c[L.REBUILDS]),
            "limited_by_accuracy": int(c[L.LIMIT_ACCURACY]),
            "limited_by_cap": int(c[L.LIMIT_CAP]),
            "limited_by_stability": int(c[L.LIMIT_STABILITY]),
            "limited_by_largest": int(c[L.LIMIT_LARGEST]),
            "ended_at_a_moment": int(c[L.LIMIT_MOMENT]),
            "implicit": int(c[L.IMPLICIT_STEPS]),
        }

    @property
    def step_size(self) -> float:
        """Size of the last accepted step, s."""
        return self.time - self.previous_time

    @property
    def collisions(self) -> list[Collision]:
        """All contacts so far, in the order of their beginning."""
        return [self._collision(k) for k in range(int(self._state.cnt[L.N_CONTACTS]))]

    def new_collisions(self) -> list[Collision]:
        """Contacts whose peak has passed, or that have ended, since the last call."""
        out = []
        for k in range(int(self._state.cnt[L.N_CONTACTS])):
            version = int(self._state.contact[k, L.K_VERSION])
            if version != self._seen.get(k, 0):
                self._seen[k] = version
                out.append(self._collision(k))
        return out

    def _collision(self, k: int) -> Collision:
        r = self._state.contact[k].tolist()
        return Collision(
            id=k,
            final=r[L.K_STAGE] == 2.0,
            car_a=int(r[L.K_A]),
            car_b=int(r[L.K_B]),
            corner_car=int(r[L.K_CORNER_CAR]),
            corner=int(r[L.K_CORNER]),
            start=r[L.K_START],
            end=r[L.K_ENDT],
            peak_corner_force=r[L.K_PEAK],
            peak_time=r[L.K_PEAK_T],
            peak_resultant=r[L.K_RES],
            peak_resultant_time=r[L.K_RES_T],
            closing_speed=r[L.K_CLOSING],
            x=r[L.K_X],
            y=r[L.K_Y],
            normal_x=r[L.K_NX],
            normal_y=r[L.K_NY],
            angle=r[L.K_ANGLE],
            energy_lost=r[L.K_ENERGY],
        )

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

    def run(self) -> Outcome:
        """Go on to the end of the run."""
        self.advance_to(math.inf)
        return self.outcome()

    def _advance(self, t: float, max_steps: int) -> list[Event]:
        first = len(self._events)
        target_step = self.step_count + max_steps if max_steps < 2**62 else 2**62
        if self._state.cnt[L.STATUS] == L.FAILED:
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
                self._grow_contacts()
            elif code in ERRORS:
                kind, reason = ERRORS[code]
                text = f"{reason} at t = {self.time:.6f} s (step {self.step_count})"
                self._events.append(
                    Event(EventKind.RUN_FAILED, self.time, self.step_count, cause=reason)
                )
                raise kind(text, self)

    def _grow_pairs(self) -> None:
        grown: dict[str, NDArray[Any]] = {}
        for name in ("pairs", "mask", "pair"):
            old = getattr(self._state, name)
            new = np.zeros((2 * len(old), *old.shape[1:]), dtype=old.dtype)
            new[: len(old)] = old
            grown[name] = new
        self._state = self._state._replace(**grown)
        self._make_work()
        self._grow_contacts()

    def _grow_contacts(self) -> None:
        old = self._state.contact
        new = np.zeros((2 * len(old) + len(self._state.pairs), old.shape[1]))
        new[: len(old)] = old
        self._state = self._state._replace(contact=new)

    def _drain(self) -> None:
        """Turn the kernels' event rows into events, with the scheduled ones that are due."""
        count = int(self._state.cnt[L.N_EVENTS])
        rows = self._work.event[:count].tolist()
        self._state.cnt[L.N_EVENTS] = 0
        batch = [self._event(row) for row in rows]
        while self._scheduled and self._scheduled[0].time <= self.time:
            batch.append(self._scheduled.pop(0))
        batch.sort(key=lambda e: e.time)
        self._events += batch

    def _event(self, r: list[float]) -> Event:
        kind = EventKind(int(r[L.V_KIND]))
        cars = tuple(int(c) for c in (r[L.V_CAR], r[L.V_CAR2]) if c > 0)
        code = int(r[L.V_CAUSE])
        cause = STATUS[code] if kind == EventKind.RUN_ENDED else CAUSES[code]
        before, after = _BEFORE_AFTER.get(kind, ("", ""))
        x, y, s = r[L.V_X], r[L.V_Y], r[L.V_S]
        if math.isnan(s) and not math.isnan(x):
            s = self.track.locate(x, y)[0]
        elif math.isnan(x) and not math.isnan(s):
            x, y, _, _ = self.track.point(s)
        return Event(
            kind=kind,
            time=r[L.V_TIME],
            step=int(r[L.V_STEP]),
            cars=cars,
            end=("", *ENDS)[int(r[L.V_END])],
            cause=cause,
            x=x,
            y=y,
            track_coordinate=s,
            speed=r[L.V_SPEED],
            value=r[L.V_VALUE],
            before=before,
            after=after,
        )

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
        before, after = _BEFORE_AFTER.get(kind, ("", ""))
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
            grown = np.full(2 * len(s.breaks) + 2, math.inf)
            grown[: len(s.breaks)] = s.breaks
            s = self._state = s._replace(breaks=grown)
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
            check_trigger(mode, source, car, delay, self.n_cars, "")
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
        distance = self._model.car[:, L.DIST]
        units = self._model.unit[:, L.U_DIST]
        places = []
        if source in ("front", "both_ends"):
            places.append(float(distance[0]))
        if source in ("rear", "both_ends"):
            # the virtual body's last car is further back than its centre
            places.append(float(max(distance[-1], units.max(initial=0.0))))
        if source == "car":
            places.append(float(distance[car - 1]))
        for place in places:
            stepper.apply_brakes(self._model, self._state, place, True, True, kind, t)

    def apply(self, command: Command) -> None:
        """Apply a logged command again, at the step at which it was logged.

        Takes the steps up to there first.
        """
        if command.step < self.step_count:
            raise CommandError("step", f"step {command.step} has passed ({self.step_count})")
        self.advance_steps(command.step - self.step_count)
        arguments = dict(command.arguments)
        if command.name == "inject_rail_break":
            self._refuse_when_ended()
            self._break_rail(float(arguments["coordinate"]), int(arguments["car"]))  # type: ignore[arg-type, call-overload]
        elif command.name == "trigger_emergency_brake":
            self.trigger_emergency_brake(**arguments)  # type: ignore[arg-type]
        else:
            raise CommandError("name", f"there is no command {command.name!r}")

    def _log(self, name: str, arguments: dict[str, object]) -> None:
        self._commands.append(Command(name, arguments, self.step_count, self.time))

    def _refuse_when_ended(self) -> None:
        if self.ended:
            raise CommandError("run", f"the run has ended ({self.status})")

    def _car_index(self, number: int) -> int:
        if not isinstance(number, (int, np.integer)) or isinstance(number, bool):
            raise CommandError("car", f"must be a whole number, not {number!r}")
        if not 1 <= number <= self.n_cars:
            raise CommandError("car", f"there is no car {number} (1 to {self.n_cars})")
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
        s = self._state
        n = self.n_cars
        if self._report is None:
            self._report = make_work(n, len(s.pairs), 0, True)
            plain_masses(self._model, self._report.wk)
        work = self._report
        inside = t < self.time
        q, v, a = np.empty((n, 5)), np.empty((n, 5)), np.empty((n, 5))
        energy = s.energy.copy()
        if inside:
            interpolate(s, t, q, v, a)
            interpolate_energy(s, t, energy)
        else:
            q[:], v[:], a[:] = s.q, s.v, s.a
        clock = s.clock.copy()
        clock[L.T_ON] = s.clock[L.T_PREV] if inside else s.clock[L.T]
        view = s._replace(
            q=q,
            v=v,
            clock=clock,
            cnt=s.cnt.copy(),
            truck_s=s.truck_s.copy(),
            pair=s.pair.copy(),
            truck_on=(s.truck_on0 if inside else s.truck_on).copy(),
            coupled=(s.coupled0 if inside else s.coupled).copy(),
        )
        _all_active(s, work)
        if not accelerations(
            self._model,
            view,
            work,
            min(t, self.time),
            view.truck_on,
            view.coupled,
            q,
            v,
            work.dx,
            PLAIN,
        ):
            raise ConstraintError("the constraint equations cannot be solved", self)
        r = work.report
        c, sn = np.cos(q[:, 2]), np.sin(q[:, 2])
        arm = self._model.car[:, L.DT]
        coordinate = view.truck_s
        for k, sign in ((0, 1.0), (1, -1.0)):
            for i in np.flatnonzero(view.truck_on[:, k] == 0):
                coordinate[i, k] = self.track.locate(
                    float(q[i, 0] + sign * arm[i] * c[i]),
                    float(q[i, 1] + sign * arm[i] * sn[i]),
                    float(coordinate[i, k]),
                )[0]
        coupled = view.coupled.astype(bool)
        gap = np.zeros(max(n - 1, 0))
        if n > 1:
            car = self._model.car
            rear = q[:, :2] - np.stack(
                [
                    car[:, L.DP] * c + car[:, L.DCR] * np.cos(q[:, 4]),
                    car[:, L.DP] * sn + car[:, L.DCR] * np.sin(q[:, 4]),
                ],
                axis=1,
            )
            front = q[:, :2] + np.stack(
                [
                    car[:, L.DP] * c + car[:, L.DCF] * np.cos(q[:, 3]),
                    car[:, L.DP] * sn + car[:, L.DCF] * np.sin(q[:, 3]),
                ],
                axis=1,
            )
            gap = np.where(coupled, np.hypot(*(rear[:-1] - front[1:]).T), 0.0)
        striker, knuckle = coupler_energy(self._model, view.coupled, q)
        kinetic = kinetic_energy(self._model, v)
        ledger = np.array(
            [kinetic, striker, knuckle, s.clock[L.E_INITIAL], *energy, 0.0], dtype=np.float64
        )
        # The work entries are stored in another order than they are reported in.
        order = (L.E_BRAKE, L.E_GROUND_TRUCK, L.E_GROUND_BODY, L.E_COLLISION, L.E_DAMPER,
                 L.E_KNUCKLE, L.E_EXTERNAL, L.E_STAB_NET, L.E_STAB_GROSS)  # fmt: skip
        ledger[4:13] = energy[list(order)]
        ledger[13] = ledger[3] + ledger[10] + ledger[11] - ledger[:3].sum() - ledger[4:10].sum()
        corner = r[:, A.R_CORNER :].reshape(n, 4, 4)
        touched = corner[:, :, 0] > 0.0
        return Sample(
            time=t,
            step=self.step_count,
            q=q,
            v=v,
            a=a,
            truck_on=view.truck_on,
            coupled=view.coupled,
            truck_coordinate=coordinate,
            rail_force=work.lam_t.copy(),
            brake_force=r[:, A.R_BRAKE].copy(),
            ground_truck_force=r[:, A.R_TRUCK : A.R_TRUCK + 4].reshape(n, 2, 2).copy(),
            ground_body_force=r[:, A.R_BODY : A.R_BODY + 2].copy(),
            ground_moment=r[:, A.R_GROUND_MOMENT].copy(),
            striker_force=r[:, A.R_STRIKER : A.R_STRIKER + 2].copy(),
            coupler_angle=q[:-1, 4] - q[1:, 3],
            knuckle_moment=r[:-1, A.R_KNUCKLE].copy(),
            coupler_force=work.lam_c.copy(),
            coupler_gap=gap,
            collision_force=r[:, A.R_COLLISION : A.R_COLLISION + 2].copy(),
            collision_moment=r[:, A.R_COLLISION + 2].copy(),
            corner_force=corner[:, :, 0].copy(),
            corner_gap=np.where(touched, corner[:, :, 1], math.nan),
            corner_closing_speed=np.where(touched, corner[:, :, 2], math.nan),
            corner_other=corner[:, :, 3].astype(np.int64),
            external_force=r[:, A.R_EXTERNAL : A.R_EXTERNAL + 2].copy(),
            energy=ledger,
        )

    def outcome(self) -> Outcome:
        """What has come of the run so far."""
        return make_outcome(self)

    # --- copies ------------------------------------------------------------------------------

    def copy(self) -> Simulation:
        """An independent run at the same state."""
        other = object.__new__(Simulation)
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

    def _arrays(self) -> dict[str, NDArray[Any]]:
        """The state's arrays without their spare rows."""
        cnt = self._state.cnt
        return {
            name: array[: int(cnt[_ROWS[name]])] if name in _ROWS else array
            for name, array in self._state._asdict().items()
        }

    def to_bytes(self) -> bytes:
        """The whole run: parameters, state, events and commands."""
        header = {
            "params": to_plain(self.params),
            "events": to_plain(self._events),
            "commands": to_plain(self._commands),
            "scheduled": to_plain(self._scheduled),
        }
        return pack(header, self._arrays())

    @classmethod
    def from_bytes(cls, data: bytes) -> Simulation:
        """A run from `to_bytes`; it goes on to the bit as the saved one would have.

        Raises
        ------
        StateFormatError
            The bytes are something else, damaged, or of another version.
        """
        header, arrays = unpack(data)
        try:
            params = from_plain(TrainParams, header["params"])
            run = cls(params)
            fields = run._state._asdict()
            if set(fields) != set(arrays):
                raise StateFormatError("the arrays of the saved state do not match this version")
            for name, saved in arrays.items():
                own = fields[name]
                if saved.dtype != own.dtype or saved.shape[1:] != own.shape[1:]:
                    raise StateFormatError(f"array {name} does not match this version")
                if name in _ROWS:
                    counter = {"contact": L.N_CONTACTS}.get(name, L.N_PAIRS)
                    rows = max(len(own), 2 * int(arrays["cnt"][counter]) + 64)
                    if name != "contact":
                        rows = max(len(run._state.pairs), 2 * int(arrays["cnt"][L.N_PAIRS]) + 64)
                    grown = np.zeros((rows, *own.shape[1:]), dtype=own.dtype)
                    grown[: len(saved)] = saved
                    fields[name] = grown
                elif name != "breaks" and saved.shape != own.shape:
                    raise StateFormatError(f"array {name} does not fit this train or this version")
                else:
                    fields[name] = saved
            run._state = State(**fields)
            run._events = [from_plain(Event, e) for e in header["events"]]
            run._commands = [from_plain(Command, c) for c in header["commands"]]
            run._scheduled = [from_plain(Event, e) for e in header["scheduled"]]
        except StateFormatError:
            raise
        except (KeyError, TypeError, ValueError, DerailError) as error:
            raise StateFormatError(f"the saved state is damaged ({error})") from error
        run._make_work()
        return run

    def state_hash(self) -> str:
        """SHA-256 (hex) of all that decides the future of the run."""
        digest = hashlib.sha256()
        arrays = self._arrays()
        # Evaluations count work done, not where the run is.
        for name, array in arrays.items():
            data = array.copy() if name == "cnt" else array
            if name == "cnt":
                data[L.EVALS] = 0
            if name == "breaks":
                data = data[np.isfinite(data)]
            digest.update(name.encode())
            digest.update(np.ascontiguousarray(data).tobytes())
        return digest.hexdigest()
