"""The run of ``derail look``: in this process, in step with the clock."""

from __future__ import annotations

import contextlib
import math
import queue
import time
from concurrent.futures import Future
from concurrent.futures import TimeoutError as NotYet
from dataclasses import dataclass
from typing import Any

import numpy as np

from derail_ros import models
from derail_ros.look.board import Board, Refused
from derail_ros.recording.recorded_run import Cars, SampledLine
from derail_ros.review import web
from derail_ros.scenario import Scenario, ScenarioError, list_scenarios, load_scenario
from derail_ros.vocabulary.errors import CommandError, ParameterError, SimulationError
from derail_ros.vocabulary.events import EventKind
from derail_ros.vocabulary.ledger import stopped_by
from derail_ros.vocabulary.words import capital, coordinate
from msg_adapters import reports
from msg_adapters.common import RunContext

CAN = ("break", "brake", "pause", "resume", "rate", "restart")
EVERY = 0.05
"""Wall time between two states, s."""
ANSWER = 120.0
"""A command that is not carried out within this is given up, s."""
BEHIND = 0.25
"""A run that has fallen behind the clock by more than this does not catch up, s."""
RATES = (0.1, 10.0)
SPEEDS = (1.0, 400.0)
"""Speed of a train that may be asked for, km/h."""
WHOLE_RAIL = {
    "track.rail_breaks": [],
    "track.rail_breaks_under_cars": [],
    "initiation.await_command": True,
}


@dataclass(frozen=True)
class Wish:
    """The requested run: a scenario's name or file, and its changes.

    ``whole`` leaves out the rail breaks of the scenario; ``speed_kmh`` is nan for its own speed.
    """

    scenario: str
    settings: tuple[tuple[str, Any], ...] = ()
    whole: bool = False
    speed_kmh: float = math.nan

    def load(self) -> Scenario:
        """The scenario as it is to run.

        Raises
        ------
        ScenarioError
            Naming file, line and field.
        """
        changed = dict(self.settings)
        if math.isfinite(self.speed_kmh):
            changed["train.speed_kmh"] = self.speed_kmh
        scenario = load_scenario(self.scenario)
        return scenario.with_overrides(changed | (WHOLE_RAIL if self.whole else {}))


class LiveRun:
    """A run that goes on by itself and takes commands from other threads.

    Parameters
    ----------
    wish : what runs first
    rate : run time per wall time

    Raises
    ------
    ScenarioError, ParameterError
        It cannot be run.
    """

    def __init__(self, wish: Wish, rate: float = 1.0) -> None:
        self._queue: queue.Queue[tuple[str, dict[str, Any], Future[str]]] = queue.Queue()
        self._first = wish.scenario
        names = tuple(s.name for s in list_scenarios())
        choices = names if wish.scenario in names else (wish.scenario, *names)
        self.board = Board(self.ask, CAN, choices)
        self._rate, self._paused, self._closed = rate, False, False
        self._start(wish)

    def ask(self, name: str, arguments: dict[str, Any]) -> str:
        """Have a command carried out by the thread of :meth:`go_on`; what it says.

        Raises
        ------
        Refused
            With the reason.
        """
        answer: Future[str] = Future()
        self._queue.put((name, arguments, answer))
        try:
            return answer.result(timeout=ANSWER)
        except NotYet:
            raise Refused(f"the run did not answer within {ANSWER:g} s") from None

    # --- the run ------------------------------------------------------------------------------

    def _start(self, wish: Wish) -> None:
        scenario = wish.load()
        simulation = models.build(scenario.to_params())
        self._wish, self.simulation = wish, simulation
        self._ended = False
        context = RunContext("", 0, "map")
        params, sample = simulation.params, simulation.sample()
        places = reports.track_coordinates(simulation.track, sample.truck_coordinate)
        consist = reports.consist(
            params, context, car_types=scenario.car_types[: len(params.cars)]
        )
        features = models.engine(params.model).features
        self.board.begin(
            load_scenario(wish.scenario).title,
            wish.scenario,
            Cars.of_message(consist),
            SampledLine.of_message(reports.track(simulation.track, places, [], context)),
            sample.pose[:, 0],
            place=web.place_data(params.site.shapes(simulation.track)),
            speed=round(3.6 * params.initiation.speed, 1),
            whole=wish.whole,
            rate=self._rate,
            paused=self._paused,
            breaks="rail_breaks" in features,
            brakes="brakes" in features,
        )
        for event in simulation.events:
            self._happened(event)
        if not any(e.kind == EventKind.RAIL_BREAK_SET for e in simulation.events):
            for place in simulation.rail_breaks:
                self._broken(place, 0.0)
        self._show(simulation.time)
        self._anchor()

    def _anchor(self) -> None:
        """From here on the clock counts."""
        self._wall, self._from = time.monotonic(), self.simulation.time

    def _happened(self, event: Any) -> None:
        self.board.event(event)
        if event.kind == EventKind.RAIL_BREAK_SET:
            self._broken(event.track_coordinate, event.time)

    def _broken(self, place: float, when: float) -> None:
        x, y, heading, _ = self.simulation.track.point(place)
        self.board.rail_break(float(x), float(y), float(heading), when)

    def _show(self, t: float) -> None:
        s = self.simulation.sample(t)
        self.board.state(
            s.time, s.pose, s.velocity, s.coupler_yaw, s.truck_on, s.coupled,
            derailed=self.simulation.outcome().cars_derailed, paused=self._paused, rate=self._rate,
        )  # fmt: skip

    def _advance(self) -> None:
        """Go on to what the clock says, or to the end."""
        simulation, now = self.simulation, time.monotonic()
        goal = self._from + self._rate * (now - self._wall)
        try:
            events = simulation.advance_to(goal)
        except SimulationError as error:
            self._ended = True
            self.board.end(f"The computation failed: {error}")
            return
        for event in events:
            self._happened(event)
        for contact in simulation.new_collisions():
            self.board.contact(contact)
        self._show(min(goal, simulation.time))
        if time.monotonic() - now > BEHIND:
            self._anchor()
        if simulation.ended:
            self._ended = True
            outcome = simulation.outcome()
            self.board.end(f"{capital(outcome.text)}.", stopped_by(outcome.energy))

    @property
    def _moves(self) -> bool:
        return not (self._paused or self._ended)

    def go_on(self) -> None:
        """Advance the run and carry out commands until :meth:`close`."""
        due = time.monotonic()
        while not self._closed:
            wait = max(0.001, due - time.monotonic()) if self._moves else 0.5
            with contextlib.suppress(queue.Empty):
                self._carry_out(*self._queue.get(timeout=wait))
            if self._moves and time.monotonic() >= due:
                self._advance()
                due = max(due + EVERY, time.monotonic())

    def close(self) -> None:
        """End :meth:`go_on`, from any thread."""
        self._closed = True

    # --- commands -----------------------------------------------------------------------------

    def _carry_out(self, name: str, arguments: dict[str, Any], answer: Future[str]) -> None:
        try:
            said = getattr(self, f"_do_{name}")(**arguments)
        except CommandError as error:
            answer.set_exception(Refused(str(error)))
        except (ScenarioError, ParameterError) as error:
            answer.set_exception(Refused(f"not started: {error}"))
        except Exception as error:  # a command's mistake must not end the run
            answer.set_exception(error)
        else:
            answer.set_result(said)

    def _do_break(
        self, car: int | None = None, x: float | None = None, y: float | None = None
    ) -> str:
        place = None
        if x is not None and y is not None:
            place, _ = self.simulation.track.locate(_number("x", x), _number("y", y))
        known = set(map(id, self.simulation.events))
        place = self.simulation.inject_rail_break(coordinate=place, car=car)
        self._tell_new(known)
        return f"The rail is broken at {coordinate(place)} m."

    def _do_brake(self) -> str:
        known = set(map(id, self.simulation.events))
        self.simulation.trigger_emergency_brake()
        self._tell_new(known)
        return "Emergency brakes, from the front of the train."

    def _tell_new(self, known: set[int]) -> None:
        """Events of a command come at once, not with the next step."""
        for event in self.simulation.events:
            if id(event) not in known:
                self._happened(event)

    def _do_pause(self) -> str:
        self._paused = True
        self._show(self.simulation.time)
        return "Paused."

    def _do_resume(self) -> str:
        self._paused = False
        self._anchor()
        return "Running."

    def _do_rate(self, value: float) -> str:
        self._rate = _number("value", value, *RATES)
        self._anchor()
        return f"{self._rate:g} times real time."

    def _do_restart(
        self, scenario: str | None = None, speed_kmh: float | None = None, whole: bool = True
    ) -> str:
        name = self._wish.scenario if scenario is None else scenario
        if name not in self.board.choices:
            raise Refused(f"there is no scenario {name}")
        fast = math.nan if speed_kmh is None else _number("speed_kmh", speed_kmh, *SPEEDS)
        # What was set on the command line is meant for the scenario named there.
        settings = self._wish.settings if name == self._first else ()
        self._paused = False
        self._start(Wish(name, settings, bool(whole), fast))
        return f"{name} from its start."


def _number(name: str, value: Any, least: float = -math.inf, most: float = math.inf) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not np.isfinite(value):
        raise Refused(f"{name} must be a number, got {value!r}")
    if not least <= value <= most:
        raise Refused(f"{name} must be {least:g} to {most:g}, got {value:g}")
    return float(value)
