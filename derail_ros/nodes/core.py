"""A simulator without ROS: its states and its runs.

The node passes requests on to :class:`SimulatorCore`, and ``loop.Loop`` advances it. Wall time
comes from a function, so that tests can drive it.
"""

from __future__ import annotations

import enum
import math
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from derail_ros.nodes import commands, loading
from derail_ros.nodes.commands import Answer, CommandLog, Refusal, Request
from derail_ros.nodes.live import NOTHING_ON_MAP, describe, live
from derail_ros.nodes.outputs import Output
from derail_ros.nodes.own_recording import OwnRecording
from derail_ros.nodes.pace import Pace
from derail_ros.nodes.parameters import Settings
from derail_ros.recording.session import Prepared, Rates, Session
from derail_ros.vocabulary.errors import CommandError
from derail_ros.vocabulary.events import EventKind
from msg_adapters import reports
from msg_adapters.common import NANOSECONDS, TIME_ZERO, RunContext
from msg_adapters.markers import clear
from msg_adapters.topics import ON_MAP

NO_RUN = "no run is loaded"


class State(enum.IntEnum):
    """States of the simulation; the numbers are those of ``derail_msgs/SetSimulationState``."""

    STOPPED = 0
    PLAYING = 1
    PAUSED = 2
    QUITTING = 3


@dataclass
class _Stepping:
    """A request for ticks that is being carried out."""

    request: Request
    left: int
    done: Callable[[Answer], None]
    progress: Callable[[int, int], bool] | None = None


class SimulatorCore:
    """States and runs of a simulator.

    ``output`` takes live messages, ``logger`` log lines, ``wall`` is the steady clock (s).

    Raises
    ------
    RecordingError
        If the recording that was asked for cannot be begun.
    """

    def __init__(
        self, settings: Settings, output: Output, logger: Any, wall: Callable[[], float]
    ) -> None:
        self.settings = settings
        self.state = State.STOPPED
        self.session: Session | None = None
        self.failure = ""
        self.twins: list[str] = []
        self.listened: dict[str, int] = {}
        self.pace = Pace(settings, wall)
        self.recording = OwnRecording(settings, logger)
        self.log = CommandLog(self._emit, logger)
        self._output = output
        self._logger = logger
        self._base = TIME_ZERO
        self._told = 0
        self._stepping: _Stepping | None = None

    # --- where things stand ------------------------------------------------------------------

    @property
    def stamp(self) -> int:
        """Simulation time, ns."""
        return self.session.stamp if self.session else self._base

    @property
    def step(self) -> int:
        """Accepted integration steps of the run."""
        return self.session.step if self.session else 0

    @property
    def context(self) -> RunContext:
        """What every message carries, with or without a run."""
        if self.session:
            return self.session.context
        return RunContext("", self._base, self.settings.frame_id)

    @property
    def run_id(self) -> str:
        """Identity of the run, "" without one."""
        return self.context.run_id

    @property
    def finished(self) -> bool:
        """Whether there is a run and it has ended."""
        return self.session is not None and self.session.finished

    @property
    def stepping(self) -> bool:
        """Whether a request for ticks is being carried out."""
        return self._stepping is not None

    @property
    def active(self) -> bool:
        """Whether the run goes on: it plays, or a request for ticks is being carried out."""
        return self.state == State.PLAYING or self.stepping

    def listening(self) -> dict[str, int]:
        """Subscribers of each topic of the state; of sensors too while nothing moves."""
        topics: tuple[str, ...] = ()
        if self.session is not None:
            still = () if self.active else self.session.sensor_topics
            topics = (*self.session.state_topics, *still)
        return {topic: self._output.subscribers(topic) for topic in topics}

    @property
    def paced(self) -> bool:
        """Whether ticks wait for the wall clock."""
        return not self.stepping and self.settings.speed_factor > 0.0

    @property
    def now(self) -> int:
        """Simulation time of the clock, ns: between two ticks it goes on with the wall clock, or
        with the computation, but not beyond the tick to come; it never goes back in a run."""
        session = self.session
        if session is None or not self.active:
            return max(self._told, self.stamp)
        if self.paced:
            share = self.pace.share
        else:
            share = (session.simulation.time - session.time) / session.tick_length
        ahead = min(max(share, 0.0), 1.0) * session.tick_length
        # What has the stamp of the tick to come is not there yet.
        return max(self._told, self.stamp, self.stamp + int(ahead * NANOSECONDS) - 1)

    def tell_time(self, stamp: int) -> None:
        """Send `/clock` if it is not as far as a stamp."""
        if stamp > self._told:
            self._told = stamp
            self.send_clock(stamp)

    def send_clock(self, stamp: int) -> None:
        """Send `/clock`."""
        self._told = stamp
        if self.settings.publish_clock:
            self.pace.clock_sent()
            self._output.publish("/clock", reports.clock(stamp))

    def _emit_live(self, topic: str, stamp: int, data: bytes) -> None:
        """Publish a message; it is recorded only if all are."""
        self.tell_time(stamp)
        self._output.publish(topic, data)
        if self.settings.records_all:
            self.recording.write(topic, stamp, data)

    def _emit(self, topic: str, stamp: int, data: bytes) -> None:
        """Publish and record a message; the clock is as far as its stamp before it goes out."""
        self.tell_time(stamp)
        self._output.publish(topic, data)
        self.recording.write(topic, stamp, data)

    # --- requests ----------------------------------------------------------------------------

    def _serve(self, request: Request, act: Callable[[], str | tuple[str, float]]) -> Answer:
        """Carry out a request, log it, and answer it.

        ``act`` returns the message of the answer, or message and value, or raises the reason for
        a refusal.
        """
        try:
            done = act()
        except (Refusal, CommandError) as error:
            return self._answer(request, False, str(error))
        message, value = (done, math.nan) if isinstance(done, str) else done
        return self._answer(request, True, message, value=value)

    def _answer(self, request: Request, success: bool, message: str, **more: Any) -> Answer:
        return self.log.answer(self.session, self.context, request, success, message, **more)

    @property
    def _session(self) -> Session:
        """The run that a request needs."""
        if self.session is None:
            raise Refusal(NO_RUN)
        return self.session

    def prepare(self, name: str, text: str, speed_kmh: float = 0.0) -> Prepared:
        """Make a scenario ready, from any thread; see :func:`loading.prepare`."""
        settings = self.settings
        prepared = loading.prepare(
            name, text, speed_kmh, dirs=settings.scenario_dirs, frame_id=settings.frame_id,
            model=settings.model,
        )  # fmt: skip
        describe(prepared, settings)
        return prepared

    def load(
        self,
        prepared: Prepared | ValueError,
        request: Mapping[str, Any],
        caller: str = "",
        state: State | None = None,
        service: str = "",
    ) -> Answer:
        """Begin a run of a prepared scenario, or refuse with the error of its preparation.

        It plays or is paused as the request wants, or is in the state given.
        """

        def act() -> str:
            if isinstance(prepared, ValueError):
                raise Refusal(str(prepared))
            self._begin(prepared, EventKind.RUN_LOADED)
            wanted = State.PAUSED if request["start_paused"] else State.PLAYING
            self._go(wanted if state is None else state)
            params = prepared.simulation.params
            told = f"loaded {prepared.name}: {params.n_train} cars, run {self.run_id}"
            began = params.initiation
            pushed = any(push.force for push in began.lateral_forces)
            if params.track.rail_breaks or began.derailed_trucks or pushed:
                return told
            return f"{told}; no rail is broken and nothing pushes it: see ~/inject_rail_break"

        return self._serve(Request("load_consist", request, caller, service), act)

    def unload(self, caller: str = "") -> Answer:
        """End the run and have none."""

        def act() -> str:
            ended = self._session
            self._end("the run is unloaded")
            self._output.publish("markers", clear(ended.context, ended.time))
            self._output.publish(ON_MAP.name, NOTHING_ON_MAP)
            self._output.renew()
            self.session, self.failure = None, ""
            self._go(State.STOPPED)
            return f"unloaded {ended.prepared.name}"

        return self._serve(Request("unload_world", {}, caller), act)

    def _end(self, why: str) -> None:
        """End the present run, if there is one."""
        self._interrupt(why)
        self.state = State.PAUSED  # what was left of a tick goes with its run
        if self.session is not None:
            self.session.stop()
            self.recording.enter(self.session)
            # No stamp twice: what comes begins a tick after it.
            end = self.session.time + self.session.tick_length
            self._base = self.session.context.stamp(end)

    def reset(self, mode: int, caller: str = "") -> Answer:
        """Begin the loaded scenario again, in the same state; mode 1 also sets time to zero."""

        def act() -> str:
            commands.one_of("mode", mode, 2)
            state = self.state
            self._begin(self._session.prepared, EventKind.RUN_RESET, time_to_zero=mode == 1)
            self._go(state)
            return f"reset: run {self.run_id}"

        return self._serve(Request("reset_simulation", {"mode": mode}, caller), act)

    def inject_rail_break(self, coordinate: float, car: int, caller: str = "") -> Answer:
        """Open a break at a track coordinate (m), or just ahead of a car if one is given."""
        fields = {"track_coordinate": coordinate, "car": car}
        return self._command(
            Request("inject_rail_break", fields, caller),
            lambda: commands.rail_break(coordinate, car),
        )

    def trigger_emergency_brake(
        self, mode: int, source: int, car: int, delay: float, caller: str = ""
    ) -> Answer:
        """Make an emergency application."""
        fields = {"mode": mode, "source": source, "car": car, "delay_s": delay}
        return self._command(
            Request("trigger_emergency_brake", fields, caller),
            lambda: commands.emergency_brake(mode, source, car, delay),
        )

    def _command(self, request: Request, arguments: Callable[[], dict[str, Any]]) -> Answer:
        # Requests are served between steps: this is the next step boundary.
        return self._serve(
            request, lambda: commands.apply(self._session, request.command, arguments())
        )

    def set_state(self, wanted: int, caller: str = "") -> Answer:
        """Go to a state. Requesting the current state succeeds and changes nothing."""

        def act() -> str:
            commands.one_of("state", wanted, len(State))
            state = State(wanted)
            if state == self.state and not self.stepping:
                return f"already {state.name.lower()}"
            self._check_transition(state)
            self._interrupt(f"the state became {state.name.lower()}")
            if state == State.STOPPED and self._session.begun:
                self._begin(self._session.prepared, EventKind.RUN_RESET)
            self._go(state)
            return f"now {state.name.lower()}"

        return self._serve(Request("set_simulation_state", {"state": wanted}, caller), act)

    def _check_transition(self, state: State) -> None:
        if state == State.QUITTING:
            if not self.settings.allow_quit:
                raise Refusal("the parameter allow_quit is false")
            return
        session = self._session
        if state == State.PLAYING and session.finished:
            raise Refusal(commands.over(session))

    def step_simulation(
        self,
        ticks: int,
        done: Callable[[Answer], None],
        caller: str = "",
        progress: Callable[[int, int], bool] | None = None,
        service: str = "",
        field: str = "ticks",
    ) -> None:
        """Advance a paused simulation; ``done`` gets the answer when the ticks are done.

        ``progress`` gets, after each tick, how many are done and how many are left, and says
        whether to go on. ``service`` and ``field`` are the names by which it was asked.
        """
        reason = ""
        if self.session is None:
            reason = NO_RUN
        elif self.state != State.PAUSED:
            reason = f"the state must be paused, it is {self.state.name.lower()}"
        elif ticks < 1:
            reason = f"{field} must be at least 1, got {ticks}"
        elif self._stepping is not None:
            reason = "another step_simulation is being carried out"
        elif self.session.finished:
            reason = commands.over(self.session)
        request = Request("step_simulation", {"ticks": ticks}, caller, service)
        if reason:
            done(self._answer(request, False, reason))
        else:
            self._stepping = _Stepping(request, ticks, done, progress)

    def _interrupt(self, why: str = "") -> None:
        """Answer a request for ticks, which is done or which something has put an end to."""
        stepping, self._stepping = self._stepping, None
        if stepping is None:
            return
        asked = stepping.request.fields["ticks"]
        made = asked - stepping.left
        message = f"{made} of {asked} ticks done"
        if stepping.left:
            message += f": {why}"
        whole = stepping.left == 0
        stepping.done(self._answer(stepping.request, whole, message, accepted=made > 0))

    # --- runs --------------------------------------------------------------------------------

    def _begin(self, prepared: Prepared, kind: EventKind, *, time_to_zero: bool = False) -> None:
        """Begin a run, and end the present one."""
        self._end("a new run has begun")
        if self.session is not None and time_to_zero:
            self._base, self._told = TIME_ZERO, 0
            self.recording.restart(self.session)
        self._output.renew()
        settings, recorded = self.settings, bool(self.recording.path)
        self.session = session = Session(
            prepared,
            self._emit,
            base=self._base,
            frame_id=settings.frame_id,
            kind=kind,
            rates=Rates(settings.state_rate, settings.marker_rate if recorded else 0.0),
            record_markers=self.recording.write if recorded else None,
            live=live(settings, self._output, self._logger),
            emit_live=self._emit_live,
        )
        self.failure = ""
        self.listened = self.listening()
        self.recording.begin_run(session)
        self.pace.begin(session.tick_length)
        session.begin()
        self._logger.info(f"run {self.run_id} of {prepared.name} begins")
        for warning in prepared.warnings:
            named = warning.startswith(prepared.name)  # it begins with a file of the scenario
            self._logger.warning(warning if named else f"{prepared.name}: {warning}")

    def _go(self, state: State) -> None:
        if self.state == State.PLAYING != state:
            self.pace.pause()
        self.state = state
        if state == State.PLAYING:
            self.pace.play()

    # --- called by the loop ------------------------------------------------------------------

    def tick_done(self, session: Session) -> bool:
        """Count a tick; whether it was the last one of the run or of a request for ticks."""
        if self._stepping is not None:
            self._stepping.left -= 1
        if session.finished:
            self._go(State.PAUSED)
            self._interrupt("the run has ended")
            self.recording.enter(session)
            self._logger.info(f"run {self.run_id} has ended: {session.status}")
            return True
        stepping = self._stepping
        if stepping is None:
            return False
        made = int(stepping.request.fields["ticks"]) - stepping.left
        goes_on = stepping.progress is None or stepping.progress(made, stepping.left)
        if stepping.left and goes_on:
            return False
        self._interrupt("the request was cancelled")
        return True

    def fail(self, session: Session) -> None:
        """The run cannot go on: pause, and keep its state."""
        self._go(State.PAUSED)
        place = self._save_state(session)
        self.failure = f"{session.failure} (state saved to {place})"
        self._interrupt("the run has failed")
        self.recording.enter(session)
        self._logger.error(f"run {self.run_id} has failed: {self.failure}")

    def _save_state(self, session: Session) -> str:
        """Save the last accepted state; returns the file, or why there is none."""
        reason = ""
        for folder in filter(None, (self.settings.state_dir, tempfile.gettempdir())):
            file = Path(folder) / f"failed-{self.run_id}.state"
            try:
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_bytes(session.simulation.to_bytes())
                return str(file)
            except OSError as error:
                reason = str(error)
        return f"nowhere: {reason}"

    def close(self) -> None:
        """End the run and close the recording whole."""
        self._interrupt("the simulator ends")
        if self.session is not None:
            self.session.stop()
        self.recording.close(self.session)
        self.state = State.QUITTING
