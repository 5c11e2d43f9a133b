"""The simulator without ROS: states, pacing, commands, recordings.

The node hands over requests and calls :meth:`SimulatorCore.work` in a loop; what comes out goes
through :class:`Output`. Wall time comes from a function, so tests can drive it.
"""

from __future__ import annotations

import dataclasses
import enum
import math
import os
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from derail_ros.recording.manifest import Manifest
from derail_ros.recording.recorder import RecordingError, RunRecorder, absolute, recorded_topics
from derail_ros.recording.session import Prepared, Rates, Session, prepare
from derail_ros.scenario import ScenarioError, load_scenario_by_name, loads_scenario
from derail_ros.vocabulary.errors import CommandError, DerailError, SimulationError
from derail_ros.vocabulary.events import EventKind
from derail_ros.vocabulary.status import BRAKE_MODES, BRAKE_SOURCES
from msg_adapters import reports
from msg_adapters.common import RunContext
from msg_adapters.definitions import serialize
from msg_adapters.topics import TRANSFORMS

EARLY = 0.002
"""What is due so soon goes out with what is due now: each time that the loop wakes up costs more
than a message does, s."""
SLICE = 0.008
"""Wall time of physics after which requests get their turn, s."""
SLACK = 0.010
"""Lateness that is made up for, s; what is beyond slows the run instead."""
MAX_CARS = 1000
MAX_YAML = 256 * 1024
MAX_COMMANDS = 10_000
"""Commands that a run takes: each is kept, for its repetition."""
MAX_BREAKS = 1000
"""Rail breaks of a run: each is looked at in every step, and told with each new one."""
SAME_PLACE = 1e-6
"""Two breaks that are nearer than this are at the same place, m."""
MAX_TEXT = 1000
"""Characters of a text of a request, a caller or a reason that are kept: a stranger chose them."""
MAX_REFUSED = 1000
"""Refused commands of a run that its manifest lists; the others are counted."""
IDLE = 0.1
"""Wall time after which the loop looks around even if nothing is due, s."""
IDLE_MARKERS = 1.0
"""Wall time between markers while nothing moves, s: for those who come late."""

CLEARS = 3
"""Marker messages of a new run that clear what was shown: of depth 1, one could be overwritten."""


class State(enum.IntEnum):
    """States of the simulation; the numbers of ``derail_msgs/SetSimulationState``."""

    STOPPED = 0
    PLAYING = 1
    PAUSED = 2
    QUITTING = 3


class Level(enum.IntEnum):
    """Levels of ``diagnostic_msgs/DiagnosticStatus``."""

    OK = 0
    WARN = 1
    ERROR = 2


@dataclass
class Settings:
    """What the node's parameters set; see ``derail_ros/nodes/parameters.py``."""

    scenario_dirs: tuple[str, ...] = ()
    speed_factor: float = 1.0
    state_rate: float = 50.0
    marker_rate: float = 15.0
    publish_clock: bool = True
    publish_tf: bool = False
    clock_rate: float = 100.0
    allow_quit: bool = False
    frame_id: str = "map"
    record: str = ""
    record_storage: str = "mcap"
    namespace: str = ""
    name: str = "simulator"
    state_dir: str = ""


class Output(Protocol):
    """Where live messages go."""

    def publish(self, topic: str, data: bytes) -> None:
        """Send a message."""

    def begin_run(self) -> None:
        """Forget the events and contacts kept for late subscribers."""

    def log(self, level: Level, text: str) -> None:
        """Tell the user."""


@dataclass(frozen=True)
class Answer:
    """Answer to a request.

    Attributes
    ----------
    success, message : as in every service
    stamp : simulation time of application, ns
    step : accepted integration steps at that moment
    run_id : of the run
    value : a number that the answer carries (the coordinate of a break)
    """

    success: bool
    message: str
    stamp: int
    step: int
    run_id: str = ""
    value: float = math.nan


@dataclass
class _Pace:
    """Counts for the diagnostics."""

    overruns: int = 0
    refused: int = 0
    since: float = 0.0
    simulated: float = 0.0
    asked: float = 0.0
    asked_since: float = 0.0
    factor: float = 0.0
    steps: int = 0
    step_size: float = math.nan


@dataclass
class _Stepping:
    """A request for ticks that is being carried out."""

    left: int
    asked: int
    caller: str
    done: Callable[[Answer], None]


@dataclass
class _Due:
    """Wall times at which something is due, s."""

    tick: float = 0.0
    clock: float = 0.0
    clock_shift: float = 0.0
    markers: float = 0.0
    idle_markers: float = 0.0
    diagnostics: float = 0.0
    pending: bool = field(default=False)


class SimulatorCore:
    """The simulator's behaviour.

    Parameters
    ----------
    settings
        May be changed between calls, except where the parameter table says read-only.
    output
        Takes live messages.
    wall
        Steady clock, s.

    Raises
    ------
    RecordingError
        If the recording asked for cannot be begun.
    """

    def __init__(
        self,
        settings: Settings,
        output: Output,
        wall: Callable[[], float] = time.monotonic,
    ) -> None:
        self.settings = settings
        self.output = output
        self.wall = wall
        self.state = State.STOPPED
        self.session: Session | None = None
        self.error = ""
        self.recorder: RunRecorder | None = None
        self.manifest = Manifest()
        self._recordings = 0
        self._base = 0
        self._sequence = 0
        self._pace = _Pace(since=wall(), asked=settings.speed_factor)
        self._due = _Due()
        self._stepping: _Stepping | None = None
        self._markers_reset = 0
        self._markers_fresh = False
        if settings.record:
            self._begin_recording()

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
    def run_id(self) -> str:
        """Identity of the run, "" without one."""
        return self.session.context.run_id if self.session else ""

    @property
    def context(self) -> RunContext:
        """What messages outside of a run carry."""
        if self.session:
            return self.session.context
        return RunContext("", self._base, self.settings.frame_id)

    @property
    def finished(self) -> bool:
        """Whether there is a run and it has ended."""
        return self.session is not None and self.session.finished

    # --- messages ----------------------------------------------------------------------------

    def _emit(self, topic: str, stamp: int, data: bytes) -> None:
        self.output.publish(topic, data)
        self._record(topic, stamp, data)

    def _publish_transforms(self, data: bytes) -> None:
        self.output.publish(TRANSFORMS.name, data)

    def _record(self, topic: str, stamp: int, data: bytes) -> None:
        if self.recorder is None:
            return
        try:
            self.recorder.write(absolute(topic, self.settings.namespace), stamp, data)
        except RecordingError as error:
            # The run is worth more than its recording: it goes on, loudly.
            self.recorder = None
            self.error = f"recording failed: {error}"
            self.output.log(Level.ERROR, self.error)

    def _begin_recording(self) -> None:
        path = Path(self.settings.record)
        if self._recordings:
            path = path.with_name(f"{path.name}_{self._recordings}")
        self.manifest = Manifest(
            settings={
                "state_rate": self.settings.state_rate,
                "marker_rate": self.settings.marker_rate,
                "frame_id": self.settings.frame_id,
                "storage": self.settings.record_storage,
            }
        )
        self.recorder = RunRecorder(
            path, self.settings.record_storage, recorded_topics(self.settings.namespace)
        )
        self._recordings += 1

    def _end_recording(self) -> None:
        """Close the recording whole."""
        if self.recorder is None:
            return
        self._enter_manifest()
        try:
            self.recorder.close(self.manifest)
            self.output.log(Level.OK, f"recording closed: {self.recorder.path}")
        except RecordingError as error:
            self.error = f"recording failed: {error}"
            self.output.log(Level.ERROR, self.error)
        self.recorder = None

    def _enter_manifest(self) -> None:
        """Bring the present run's entry of the manifest up to date."""
        if self.session is None:
            return
        entry = self.session.entry()
        if self.manifest.runs and self.manifest.runs[-1].run_id == entry.run_id:
            self.manifest.runs[-1] = entry
        else:
            self.manifest.runs.append(entry)

    # --- requests ----------------------------------------------------------------------------

    def _answer(
        self,
        command: str,
        request: Mapping[str, Any],
        caller: str,
        success: bool,
        message: str,
        *,
        time: float | None = None,
        value: float = math.nan,
        accepted: bool | None = None,
    ) -> Answer:
        """Log a command with its answer, and give the answer.

        ``accepted`` differs from ``success`` where a command was carried out in part.
        """
        accepted = success if accepted is None else accepted
        request = {name: shortened(value) for name, value in request.items()}
        caller, message = shortened(caller), shortened(message)
        context = self.context
        if time is None:
            time = self.session.time if self.session else 0.0
        data = serialize(
            reports.command_log(
                context=context,
                step=self.step,
                time=time,
                sequence=self._sequence,
                command=command,
                request=request,
                caller=caller,
                accepted=accepted,
                answer=message,
            )
        )
        self._sequence += 1
        self._emit("command_log", context.stamp(time), data)
        if not accepted:
            self._pace.refused += 1
            if self.session is not None:
                self.session.refuse(
                    {
                        "command": command,
                        "request": request,
                        "reason": message,
                        "step": self.step,
                        "time": time,
                    },
                    MAX_REFUSED,
                )
            self.output.log(Level.WARN, f"{command} refused: {message}")
        return Answer(success, message, context.stamp(time), self.step, self.run_id, value)

    def read(self, name: str, text: str) -> Any:
        """Read a scenario by its name or from its text.

        Raises
        ------
        ValueError
            With the reason why it is refused.
        """
        if bool(name) == bool(text):
            raise ValueError("give either scenario_name or scenario_yaml")
        if len(text.encode()) > MAX_YAML:
            raise ValueError("scenario_yaml: over 256 KB")
        dirs = self.settings.scenario_dirs
        try:
            scenario = (
                loads_scenario(text, dirs=dirs) if text else load_scenario_by_name(name, dirs)
            )
        except ScenarioError as error:
            raise ValueError(str(error)) from error
        if scenario.n_cars > MAX_CARS:
            raise ValueError(f"train: {scenario.n_cars} cars, at most {MAX_CARS} are allowed")
        return scenario

    def prepare(self, name: str, text: str, speed_kmh: float = math.nan) -> Prepared:
        """Read a scenario and make it ready; may be called from another thread.

        Raises
        ------
        ValueError
            With the reason why it is refused.
        """
        scenario = self.read(name, text)
        if math.isinf(speed_kmh) or speed_kmh < 0.0:
            raise ValueError("speed_kmh: must be a finite number above 0 (0 or NaN: as it is)")
        try:
            prepared = prepare(scenario, speed_kmh)
        except (ScenarioError, DerailError) as error:
            raise ValueError(str(error)) from error
        if text:
            # Nobody gave it a name; with a blank in it, it is no scenario's that has one.
            prepared = dataclasses.replace(prepared, name=f"{scenario.title} (inline)")
        prepared.warm(self.settings.frame_id)
        return prepared

    def load(
        self,
        prepared: Prepared | ValueError,
        request: Mapping[str, Any],
        *,
        start_paused: bool,
        caller: str = "",
    ) -> Answer:
        """Begin a run of a prepared scenario, or refuse with the error of its preparation."""
        name = "load_consist"
        if isinstance(prepared, ValueError):
            return self._answer(name, request, caller, False, str(prepared))
        self._begin(prepared, EventKind.RUN_LOADED)
        self._go(State.PAUSED if start_paused else State.PLAYING)
        cars = len(prepared.simulation.params.cars)
        return self._answer(
            name, request, caller, True, f"loaded {prepared.name}: {cars} cars, {self.run_id}"
        )

    def reset(self, mode: int, caller: str = "") -> Answer:
        """Begin the loaded scenario again, in the same state; mode 1 sets time to zero too."""
        name, request = "reset_simulation", {"mode": mode}
        if mode not in (0, 1):
            return self._answer(name, request, caller, False, f"mode: {mode} is none of 0, 1")
        if self.session is None:
            return self._answer(name, request, caller, False, "no run is loaded")
        was = self.state
        self._begin(self.session.prepared, EventKind.RUN_RESET, time_to_zero=mode == 1)
        self._go(was)
        return self._answer(name, request, caller, True, f"reset: run {self.run_id}")

    def _begin(self, prepared: Prepared, kind: EventKind, *, time_to_zero: bool = False) -> None:
        self._interrupt("a new run began")
        if self.session is not None:
            self.session.stop()
            self._enter_manifest()
            # Never the same stamp twice: the new run begins a tick after the old one.
            self._base = self.session.context.stamp(self.session.time + self.session.tick_length)
        if time_to_zero:
            self._base = 0
            if self.recorder is not None:
                self._end_recording()
                try:
                    self._begin_recording()
                except RecordingError as error:
                    self.error = str(error)
                    self.output.log(Level.ERROR, self.error)
        self.output.begin_run()
        settings = self.settings
        recording = self.recorder is not None
        self.session = Session(
            prepared,
            self._emit,
            base=self._base,
            frame_id=settings.frame_id,
            kind=kind,
            rates=Rates(settings.state_rate, settings.marker_rate if recording else 0.0),
            record_markers=self._record if recording else None,
            live_transforms=self._publish_transforms if settings.publish_tf else None,
        )
        if not self.error.startswith("recording"):
            self.error = ""
        self._enter_manifest()
        if self.recorder is not None:
            self.recorder.write_manifest(self.manifest, self._base)
        self._markers_reset, self._markers_fresh = CLEARS, True
        self._due.tick = self.wall() + self.session.tick_length / max(settings.speed_factor, 1e-9)
        self.session.begin()
        self.output.log(Level.OK, f"run {self.run_id} of {prepared.name} begins")

    def inject_rail_break(self, coordinate: float, car: int, caller: str = "") -> Answer:
        """Open a break at a track coordinate (m), or just ahead of a car if one is given."""
        request = {"track_coordinate": coordinate, "car": car}
        reason = ""
        if car and math.isfinite(coordinate) and coordinate != 0.0:
            reason = (
                f"track_coordinate: {coordinate:g} m and car {car} are two places: "
                "give one of them (with a car: 0 or NaN)"
            )
        elif not car and not math.isfinite(coordinate):
            reason = f"track_coordinate: {coordinate} is not a finite number"
        if reason:
            return self._answer("inject_rail_break", request, caller, False, reason)
        arguments = {"car": int(car)} if car else {"coordinate": float(coordinate)}
        return self._command("inject_rail_break", request, caller, arguments)

    def trigger_emergency_brake(
        self, mode: int, source: int, car: int, delay: float, caller: str = ""
    ) -> Answer:
        """Make an emergency application."""
        request = {"mode": mode, "source": source, "car": car, "delay_s": delay}
        reason = ""
        if not 0 <= mode < len(BRAKE_MODES):
            reason = f"mode: {mode} is none of 0 to {len(BRAKE_MODES) - 1}"
        elif not 0 <= source < len(BRAKE_SOURCES):
            reason = f"source: {source} is none of 0 to {len(BRAKE_SOURCES) - 1}"
        elif not math.isfinite(delay) or delay < 0.0:
            reason = f"delay_s: {delay} is not a finite number from 0 up"
        elif car and BRAKE_SOURCES[source] != "car":
            reason = f"car: {car} goes only with source {BRAKE_SOURCES.index('car')} (car)"
        if reason:
            return self._answer("trigger_emergency_brake", request, caller, False, reason)
        return self._command(
            "trigger_emergency_brake",
            request,
            caller,
            {
                "mode": BRAKE_MODES[mode],
                "source": BRAKE_SOURCES[source],
                "car": int(car),
                "delay": float(delay),
            },
        )

    def _command(
        self, name: str, request: Mapping[str, Any], caller: str, arguments: dict[str, Any]
    ) -> Answer:
        session = self.session
        if session is None:
            return self._answer(name, request, caller, False, "no run is loaded")
        # Requests are served between steps: this is the next step boundary.
        moment = float(session.simulation.time)
        reason = ""
        if len(session.simulation.commands) >= MAX_COMMANDS:
            reason = f"the run has had {MAX_COMMANDS} commands, the most it takes"
        elif name == "inject_rail_break" and len(session.simulation.rail_breaks) >= MAX_BREAKS:
            reason = f"the track has {MAX_BREAKS} breaks, the most a run takes"
        if reason:
            return self._answer(name, request, caller, False, reason, time=moment)
        broken = [float(place) for place in session.simulation.rail_breaks]
        try:
            result = session.command(name, **arguments)
        except CommandError as error:
            return self._answer(name, request, caller, False, str(error), time=moment)
        value = float(result) if isinstance(result, float) else math.nan
        done = f"rail break at {value:.3f} m" if math.isfinite(value) else "applied"
        if any(abs(value - place) < SAME_PLACE for place in broken):
            done += ", where the rail was broken already"
        return self._answer(name, request, caller, True, done, time=moment, value=value)

    def set_state(self, wanted: int, caller: str = "") -> Answer:
        """Go to a state; being there already is a success."""
        name, request = "set_simulation_state", {"state": wanted}
        try:
            state = State(wanted)
        except ValueError:
            reason = f"state: {wanted} is none of 0 to {len(State) - 1}"
            return self._answer(name, request, caller, False, reason)
        if state == self.state:
            return self._answer(name, request, caller, True, f"already {state.name.lower()}")
        reason = self._refusal(state)
        if reason:
            return self._answer(name, request, caller, False, reason)
        self._interrupt(f"the state became {state.name.lower()}")
        session = self.session
        if state == State.STOPPED and session is not None and session.begun:
            self._begin(session.prepared, EventKind.RUN_RESET)
        self._go(state)
        return self._answer(name, request, caller, True, f"now {state.name.lower()}")

    def _refusal(self, state: State) -> str:
        if state == State.QUITTING:
            return "" if self.settings.allow_quit else "the parameter allow_quit is false"
        if self.session is None:
            return "no run is loaded"
        if state == State.PLAYING and self.session.failure:
            return "the run has failed: reset it or load another"
        if state == State.PLAYING and self.session.finished:
            return "the run has ended: reset it or load another"
        return ""

    def step_simulation(
        self, ticks: int, done: Callable[[Answer], None], caller: str = ""
    ) -> None:
        """Advance a paused simulation; ``done`` gets the answer when the ticks are done."""
        name, request = "step_simulation", {"ticks": ticks}
        reason = ""
        if self.session is None:
            reason = "no run is loaded"
        elif self.state != State.PAUSED:
            reason = f"not paused but {self.state.name.lower()}"
        elif ticks < 1:
            reason = "ticks: must be at least 1"
        elif self._stepping is not None:
            reason = "another step_simulation is under way"
        elif self.session.finished:
            reason = "the run has ended: reset it or load another"
        if reason:
            done(self._answer(name, request, caller, False, reason))
            return
        self._stepping = _Stepping(ticks, ticks, caller, done)

    def _interrupt(self, why: str) -> None:
        """Answer a request for ticks that cannot be carried out to its end."""
        self._stepped(why)

    def _stepped(self, why: str = "") -> None:
        stepping, self._stepping = self._stepping, None
        if stepping is None:
            return
        made = stepping.asked - stepping.left
        message = f"{made} of {stepping.asked} ticks done"
        if why:
            message += f": {why}"
        request = {"ticks": stepping.asked}
        stepping.done(
            self._answer(
                "step_simulation",
                request,
                stepping.caller,
                stepping.left == 0,
                message,
                accepted=made > 0,
            )
        )

    def _go(self, state: State) -> None:
        self.state = state
        now = self.wall()
        self._pace.asked_since = now
        if state == State.PLAYING and self.session is not None:
            self._due.tick = now + self._tick_period(self.session)
            self._due.pending = False
            self._align_clock()

    def _tick_period(self, session: Session) -> float:
        """Wall time of a tick, s."""
        factor = self.settings.speed_factor
        return session.tick_length / factor if factor > 0.0 else 0.0

    def pace_changed(self) -> None:
        """Take up a new speed factor or rate.

        Nothing comes later for it: a client that changes parameters all the time, by a slider,
        would hold up the run.
        """
        now, due, settings = self.wall(), self._due, self.settings
        if settings.speed_factor != self._pace.asked:
            self._pace.asked, self._pace.asked_since = settings.speed_factor, now
        if self.session is not None:
            # After a time without a pace nothing is late.
            tick = due.tick if now - due.tick <= SLACK else now
            due.tick = min(tick, now + self._tick_period(self.session))
        due.clock = min(due.clock, now + 1.0 / settings.clock_rate)
        self._align_clock()
        if settings.marker_rate > 0.0:
            due.markers = min(due.markers, now + 1.0 / settings.marker_rate)

    # --- the loop ----------------------------------------------------------------------------

    def work(self) -> float:
        """Do what is due, for about a slice at most.

        Returns
        -------
        float
            Wall time (s) until which nothing is due; a time past means there is more to do.
        """
        now = self.wall()
        settings = self.settings
        active = self.state == State.PLAYING or self._stepping is not None
        if active:
            # Computed before anything is sent: what is due in this slice is then sent fresh.
            self._work_ticks(now)
            now = self.wall()
            active = self.state == State.PLAYING or self._stepping is not None
        next_time = now + IDLE
        if settings.publish_clock:
            next_time = min(next_time, self._work_clock(now))
        next_time = min(next_time, self._work_markers(now))
        if now >= self._due.diagnostics:
            self._due.diagnostics = now + 1.0
            self._diagnose(now)
        next_time = min(next_time, self._due.diagnostics)
        if active:
            free = self._stepping is not None or settings.speed_factor <= 0.0
            next_time = min(next_time, now if free else self._due.tick)
        return next_time

    def _work_ticks(self, now: float) -> None:
        """Advance the run by what is due within a slice."""
        session = self.session
        if session is None:
            return
        end = now + SLICE
        while True:
            factor = self.settings.speed_factor
            paced = self._stepping is None and factor > 0.0
            if paced and now < self._due.tick:
                break
            if paced and not self._due.pending and now - self._due.tick > SLACK:
                # Too slow, or busy elsewhere: the run falls behind and stays behind.
                self._due.tick = now
                self._align_clock()
                self._pace.overruns += 1
            before = session.time
            try:
                reached = session.advance(max(end - now, 0.0))
            except SimulationError as error:
                self._failed(session, error)
                return
            now = self.wall()
            self._due.pending = not reached
            if reached:
                self._markers_fresh = True
                self._pace.simulated += session.time - before
                if paced:
                    self._due.tick += self._tick_period(session)
                if self._stepping is not None:
                    self._stepping.left -= 1
                if session.finished:
                    self._ended(session)
                    return
                if self._stepping is not None and self._stepping.left == 0:
                    self._stepped()
                    return
            if now >= end:
                break

    def _ended(self, session: Session) -> None:
        self._go(State.PAUSED)
        if self._stepping is not None and self._stepping.left:
            self._stepped("the run has ended")
        self._stepped()
        self._enter_manifest()
        self.output.log(Level.OK, f"run {self.run_id} has ended: {session.status}")

    def _failed(self, session: Session, error: SimulationError) -> None:
        self._go(State.PAUSED)
        place = self._save_state(session)
        self.error = f"{session.failure} (state saved to {place})"
        self._stepped("the run failed")
        self._enter_manifest()
        self.output.log(Level.ERROR, f"run {self.run_id} failed: {self.error}")

    def _save_state(self, session: Session) -> str:
        """Save the state at the last accepted step, for whoever wants to know why it failed."""
        name = f"failed-{session.context.run_id}.state"
        last = ""
        for folder in (
            Path(self.settings.state_dir or state_folder()),
            Path(tempfile.gettempdir()),
        ):
            try:
                folder.mkdir(parents=True, exist_ok=True)
                (folder / name).write_bytes(session.simulation.to_bytes())
                return str(folder / name)
            except OSError as error:
                last = str(error)
        return f"nowhere: {last}"

    def _align_clock(self) -> None:
        """Put the clock in phase with the ticks, so that one waking up serves both.

        Each message is moved by half a period at most, and by as much as the others: the rate
        stays, however often the ticks fall behind.
        """
        period = 1.0 / self.settings.clock_rate
        off = self._due.tick - self._due.clock
        self._due.clock_shift = (off + 0.5 * period) % period - 0.5 * period

    def _work_clock(self, now: float) -> float:
        due = self._due
        if now >= due.clock + due.clock_shift - EARLY:
            self.output.publish("/clock", reports.clock(self.stamp))
            period = 1.0 / self.settings.clock_rate
            due.clock += period
            late = now - (due.clock + 0.5 * period)
            if late > 0.0:
                # What was missed is left out; the phase stays.
                due.clock += period * math.ceil(late / period)
        return due.clock + due.clock_shift

    def _work_markers(self, now: float) -> float:
        """Send markers when there are new ones, and now and then for those who come late."""
        rate = self.settings.marker_rate
        if rate <= 0.0 or self.session is None:
            return math.inf
        early, late = EARLY, 0.0
        if self.settings.publish_clock and self.settings.clock_rate >= rate:
            # With the nearest message of the clock: the loop does not wake up for them alone.
            early = late = 0.5 / self.settings.clock_rate
        if now >= self._due.markers - early and (
            self._markers_fresh or now >= self._due.idle_markers
        ):
            self.output.publish("markers", self.session.markers(reset=self._markers_reset > 0))
            self._markers_reset = max(0, self._markers_reset - 1)
            self._markers_fresh = False
            self._due.markers = max(self._due.markers + 1.0 / rate, now)
            self._due.idle_markers = now + IDLE_MARKERS
        due = self._due.markers if self._markers_fresh else self._due.idle_markers
        return due + late

    # --- diagnostics -------------------------------------------------------------------------

    def _diagnose(self, now: float) -> None:
        pace, settings, session = self._pace, self.settings, self.session
        elapsed = max(now - pace.since, 1e-9)
        pace.factor = pace.simulated / elapsed
        asked = settings.speed_factor
        steps = self.step - pace.steps
        if steps > 0 and pace.simulated > 0.0:
            pace.step_size = pace.simulated / steps
        level, message = Level.OK, self.state.name.lower()
        # Of a second in which the pace was not the same throughout nothing can be said.
        steady = self.state == State.PLAYING and pace.asked_since < pace.since
        if session is None:
            message = "no run is loaded"
        elif session.finished:
            message = f"run has ended: {session.status}"
        elif steady and pace.factor < 0.95 * asked:
            level = Level.WARN
            message = f"slower than asked: {pace.factor:.2f} instead of {asked:g}"
        if self.error:
            level, message = Level.ERROR, self.error
        values: dict[str, Any] = {
            "state": self.state.name.lower(),
            "real_time_factor_asked": asked,
            "real_time_factor": pace.factor,
            "overruns": pace.overruns,
            "refused_commands": pace.refused,
            "state_rate": settings.state_rate if session is None else session.rates.state,
            "simulation_time": self.stamp / 1e9,
            "recording": str(self.recorder.path) if self.recorder else "",
        }
        if session is not None:
            outcome = session.simulation.outcome()
            values |= {
                "run_id": self.run_id,
                "scenario": session.prepared.name,
                "run_time": session.time,
                "status": session.status,
                "cars": len(session.params.cars),
                "cars_derailed": len(outcome.derailed_cars),
                "steps": self.step,
                "rejected_steps": outcome.rejected_steps,
                "mean_step_size": pace.step_size,
                "max_coupler_gap": outcome.max_coupler_gap,
                "max_truck_offset": outcome.max_truck_offset,
                "energy_residual_relative": outcome.energy_residual,
            }
        pace.since, pace.simulated, pace.steps = now, 0.0, self.step
        self.output.publish(
            "/diagnostics",
            serialize(
                reports.diagnostics(
                    self.stamp,
                    f"{settings.name}: simulation",
                    level,
                    message,
                    values,
                    "derail_ros",
                )
            ),
        )

    # --- the end -----------------------------------------------------------------------------

    def close(self) -> None:
        """End the run and close the recording whole."""
        self._interrupt("the simulator ends")
        if self.session is not None:
            self.session.stop()
        self._end_recording()
        self.state = State.QUITTING


def shortened(value: Any) -> Any:
    """A value for logs and manifests: a long text without its end."""
    if isinstance(value, str) and len(value) > MAX_TEXT:
        return f"{value[:MAX_TEXT]}... ({len(value)} characters)"
    return value


def state_folder() -> str:
    """Folder for what is kept about a failure, unless another is given."""
    base = os.environ.get("XDG_STATE_HOME") or os.path.join(
        os.path.expanduser("~"), ".local", "state"
    )
    return os.path.join(base, "derail_ros")
