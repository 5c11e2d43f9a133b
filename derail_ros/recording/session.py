"""One run and the messages about it: no ROS graph, no wall clock, no physics.

A session advances a simulation tick by tick (1 tick = 1/state_rate of simulation time), in slices
of wall time, and publishes the messages of each tick in the order of their stamps. A node and
a recording get the same bytes.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
import time
import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

import derail_ros
from derail_ros import models
from derail_ros.recording.manifest import RunEntry
from derail_ros.scenario import Scenario
from derail_ros.vocabulary.errors import CommandError, SimulationError
from derail_ros.vocabulary.events import Event, EventKind
from derail_ros.vocabulary.measures import outcome_record
from derail_ros.vocabulary.sample import Sample
from derail_ros.vocabulary.simulation import Simulation
from msg_adapters import reports
from msg_adapters.common import NANOSECONDS, TIME_ZERO, RunContext
from msg_adapters.definitions import serialize
from msg_adapters.markers import MarkerEncoder, track_markers
from msg_adapters.state import StateEncoder
from msg_adapters.topics import STATE_TOPICS

Emit = Callable[[str, int, bytes], None]
"""Takes a topic's name, the moment in simulation time (ns) and the message's bytes."""

OUTCOME_EVERY = 1.0
"""Simulation time between two outcomes, s."""
GRAIN = 1e-9
"""Times closer than this are the same, s."""
EASY = 0.25
"""A tick that takes less than this share of the time there is goes in one call of the engine."""


class Prepared:
    """A scenario with a run at its start. Building it takes long, starting a run does not.

    Attributes
    ----------
    name, hash : of the scenario
    yaml, resolved : the scenario with all defaults filled in, as text and as plain data
    files : what the scenario was read from: name -> content
    simulation : at its start, never advanced: runs are copies of it
    warnings : values of it that are possible but unlikely
    car_types : type of rolling stock of each car, "" where it was given by its numbers
    marker_pieces : serialised markers, kept from run to run
    kept : what else takes long and is the same in each run
    """

    def __init__(self, scenario: Scenario, simulation: Simulation) -> None:
        self.name = scenario.name
        self.hash = f"sha256:{scenario.hash}"
        self.yaml = scenario.to_yaml()
        self.resolved = scenario.resolved()
        self.files = scenario.files
        self.simulation = simulation
        self.warnings = scenario.warnings
        self.car_types = scenario.car_types[: simulation.n_cars]
        self.marker_pieces: dict[Any, Any] = {}
        self.kept: dict[str, Any] = {}

    def warm(self, frame_id: str) -> None:
        """Lay out the markers, which takes a while for a long train."""
        context = RunContext("", 0, frame_id)
        encoder = MarkerEncoder(self.simulation.params, context, self.marker_pieces)
        encoder(self.simulation.sample(), np.zeros(self.simulation.n_cars), reset=True)


def prepare(scenario: Scenario, speed_kmh: float = math.nan) -> Prepared:
    """Make a scenario ready to run, at another speed if one is given.

    Raises
    ------
    ScenarioError, ParameterError
        If it cannot be run.
    """
    if math.isfinite(speed_kmh) and speed_kmh != 0.0:
        scenario = scenario.with_overrides({"train.speed_kmh": float(speed_kmh)})
    return Prepared(scenario, models.build(scenario.to_params()))


@dataclass
class Rates:
    """Rates of a run in simulation time, Hz. Rate 0: no such messages."""

    state: float = 50.0
    recorded_markers: float = 0.0


class Live(Protocol):
    """Messages that are sent and not recorded, for they follow from the recorded ones.

    Attributes
    ----------
    topics : topics of the messages of each tick
    measured : topic -> last message of a sensor
    due : run time of the next measurement of the sensors, s; infinite without sensors
    """

    topics: Sequence[str]
    measured: dict[str, bytes]
    due: float

    def begin(self) -> list[tuple[str, bytes]]:
        """Topic name and CDR bytes of the latched messages at the start of the run."""

    def tick(self, sample: Sample) -> list[tuple[str, bytes]]:
        """Topic name and CDR bytes of the messages of a tick."""

    def end(self) -> list[tuple[str, bytes]]:
        """The same for the end of the run."""

    def measure(self, sample: Sample) -> list[tuple[str, bytes]]:
        """The same of the sensors that measure at ``due``, which moves on."""


class Session:
    """One run.

    Parameters
    ----------
    prepared : the scenario
    emit : takes the messages
    base : simulation time at which the run begins, ns
    kind : ``RUN_LOADED`` or ``RUN_RESET``: the first event of the run
    rates : ticks a second and markers a second
    record_markers : takes the markers at ``rates.recorded_markers`` of simulation time
    live : makes the messages that are not recorded, from scenario, simulation and context
    emit_live : takes them
    simulation : what to run instead of a copy of ``prepared.simulation``
    """

    def __init__(
        self,
        prepared: Prepared,
        emit: Emit,
        *,
        base: int = TIME_ZERO,
        frame_id: str = "map",
        kind: EventKind = EventKind.RUN_LOADED,
        rates: Rates | None = None,
        record_markers: Emit | None = None,
        live: Callable[[Prepared, Simulation, RunContext], Live] | None = None,
        emit_live: Emit | None = None,
        simulation: Simulation | None = None,
    ) -> None:
        self.prepared = prepared
        self.simulation = prepared.simulation.copy() if simulation is None else simulation
        self.params = self.simulation.params
        self.context = RunContext(uuid.uuid4().hex, base, frame_id)
        self.rates = rates or Rates()
        self.tick = 0
        self.finished = False
        self.failure = ""
        self.stopped = False
        self.announced = False
        self.sample: Sample = self.simulation.sample()
        self.car_peak: NDArray[np.float64] = np.zeros(len(self.params.cars))
        self.refused: list[dict[str, Any]] = []
        self.refused_unlisted = 0
        # Computing time of the last tick, and of the present one so far, s.
        self._last_took, self._took = math.inf, 0.0
        self._kind = kind
        self._emit = emit
        self._record_markers = record_markers
        self._markers_recorded = 0
        self._encoder = StateEncoder(self.params, self.context)
        self._markers = MarkerEncoder(self.params, self.context, prepared.marker_pieces)
        self._live = None if live is None else live(prepared, self.simulation, self.context)
        self._emit_live = emit_live
        self.event_messages: list[bytes] = []
        self._events_published = 0
        self._next_outcome = 0.0
        self._breaks: list[tuple[float, float]] = []
        self._collisions: list[Any] = []

    # --- time --------------------------------------------------------------------------------

    @property
    def tick_length(self) -> float:
        """Simulation time of a tick, s."""
        return 1.0 / self.rates.state

    @property
    def time(self) -> float:
        """Run time of the last tick published, s."""
        return self.tick / self.rates.state

    @property
    def stamp(self) -> int:
        """Simulation time of the last tick published, ns."""
        return self.context.stamp(self.time)

    @property
    def begun(self) -> bool:
        """Whether the run has left its start."""
        return self.tick > 0 or self.simulation.step_count > 0 or bool(self.simulation.commands)

    @property
    def step(self) -> int:
        """Accepted integration steps."""
        return int(self.simulation.step_count)

    # --- messages ----------------------------------------------------------------------------

    def _publish(self, topic: str, message: Any, stamp: int) -> None:
        data = message if isinstance(message, bytes) else serialize(message)
        self._emit(topic, stamp, data)

    def begin(self) -> None:
        """Publish the messages of the start: train, track, first events and state."""
        params, context, prepared = self.params, self.context, self.prepared
        self._publish(
            "consist",
            reports.consist(
                params,
                context,
                name=prepared.name,
                scenario_hash=prepared.hash,
                scenario_yaml=prepared.yaml,
                software_version=derail_ros.__version__,
                engine_hash=models.engine_hash(params.model),
                car_types=prepared.car_types,
                files=prepared.files,
                rises=models.rises(params.model),
            ),
            context.base,
        )
        coordinates = reports.track_coordinates(
            self.simulation.track, self.sample.truck_coordinate
        )
        self._line = coordinates
        self._breaks = [(float(s), 0.0) for s in self.simulation.rail_breaks]
        self._publish_track(0.0)
        self._publish_event(
            Event(self._kind, 0.0, 0, cause=prepared.name, after=f"{params.n_train} cars")
        )
        if self._live is not None:
            self._send_live(self.context.base, self._live.begin())
        self._publish_tick(self.sample, reset=True)
        self._measure(0.0)
        self.announced = True

    def _publish_track(self, time: float) -> None:
        stamp = self.context.stamp(time)
        message = reports.track(
            self.simulation.track, self._line, self._breaks, self.context, time
        )
        self._publish("track", message, stamp)
        site = self.params.site.shapes(self.simulation.track)
        markers = track_markers(message, self.context, time, site)
        self._publish("track_markers", markers, stamp)

    def _publish_event(self, event: Event) -> None:
        message = reports.train_event(event, len(self.event_messages), self.context)
        data = serialize(message)
        self.event_messages.append(data)
        self._publish("events", data, self.context.stamp(event.time))
        if event.kind == EventKind.RAIL_BREAK_SET:
            place = float(event.track_coordinate)
            if place not in [s for s, _ in self._breaks]:
                self._breaks.append((place, float(event.time)))
                self._publish_track(event.time)

    def _publish_until(self, until: float) -> None:
        """Publish the events and contacts up to a moment, in the order of their times."""
        self._collisions += self.simulation.new_collisions()
        for contact in self._collisions:
            for car in filter(None, (contact.car_a, contact.car_b)):
                self.car_peak[car - 1] = max(self.car_peak[car - 1], contact.peak_force)
        due: list[tuple[float, int, Any]] = []
        events = self.simulation.events
        while self._events_published < len(events):
            event = events[self._events_published]
            if event.time > until + GRAIN:
                break
            self._events_published += 1
            if event.kind not in (EventKind.RUN_LOADED, EventKind.RUN_RESET):
                due.append((event.time, 0, event))
        later = []
        for contact in self._collisions:
            moment = contact.end if contact.final else contact.peak_time
            if moment > until + GRAIN:
                later.append(contact)
            else:
                due.append((moment, 1, contact))
        self._collisions = later
        for moment, what, item in sorted(due, key=lambda entry: entry[:2]):
            if what == 0:
                self._publish_event(item)
            else:
                message = reports.collision(item, self.step, self.context)
                self._publish("collisions", message, self.context.stamp(moment))

    def _publish_tick(self, sample: Sample, *, reset: bool = False) -> None:
        """Publish everything that belongs to a tick."""
        self.sample = sample
        self._publish_until(sample.time)
        stamp = self.context.stamp(sample.time)
        for topic, data in self._encoder.encode(sample):
            self._publish(topic, data, stamp)
        if self._live is not None:
            self._send_live(stamp, self._live.tick(sample))
        if self._record_markers is not None and self.rates.recorded_markers > 0.0:
            due = self._markers_recorded / self.rates.recorded_markers
            if sample.time + GRAIN >= due:
                self._record_markers("markers", stamp, self.markers(reset=reset))
                self._markers_recorded = (
                    math.floor((sample.time + GRAIN) * self.rates.recorded_markers) + 1
                )
        if sample.time + GRAIN >= self._next_outcome:
            self._next_outcome = math.floor(sample.time + GRAIN) + OUTCOME_EVERY
            self._publish_outcome(sample.time)

    def _send_live(self, stamp: int, messages: list[tuple[str, bytes]]) -> None:
        if self._emit_live is not None:
            for topic, data in messages:
                self._emit_live(topic, stamp, data)

    def _measure(self, until: float) -> None:
        """Have the sensors measure what was due in the last step, up to a run time (s)."""
        simulation, live = self.simulation, self._live
        while live is not None and live.due <= min(until, simulation.time):
            when = live.due
            messages = live.measure(simulation.sample(when))
            self._send_live(self.context.stamp(when), messages)

    def _publish_outcome(self, time: float, status: str = "") -> None:
        message = self.outcome_message(time, status)
        self._publish("outcome", message, self.context.stamp(time))

    def outcome_message(self, time: float, status: str = "") -> Any:
        """``derail_msgs/Outcome`` at a run time (s)."""
        return reports.outcome(
            self.simulation.outcome(),
            self.context,
            time=time,
            step=self.step,
            status=status,
        )

    def present(self, later: int = 0) -> list[tuple[str, bytes]]:
        """Topic name and CDR bytes of the state messages of the last tick, for late subscribers.

        Frames and the like bear a time that is ``later`` (ns) than the tick's.
        """
        messages = self._encoder.encode(self.sample)
        if self._live is not None:
            moment = self.sample.time + later / NANOSECONDS
            messages += self._live.tick(dataclasses.replace(self.sample, time=moment))
            messages += self._live.measured.items()
        return messages

    @property
    def state_topics(self) -> tuple[str, ...]:
        """Topics of :meth:`present`."""
        return (*STATE_TOPICS, *(() if self._live is None else self._live.topics))

    @property
    def sensor_topics(self) -> tuple[str, ...]:
        """Topics of the sensors, whose last messages :meth:`present` has too."""
        return () if self._live is None else tuple(self._live.measured)

    def markers(self, *, reset: bool = False) -> bytes:
        """``MarkerArray`` of the last tick; ``reset`` clears what was shown before."""
        return self._markers(self.sample, self.car_peak, reset=reset)

    # --- advancing ---------------------------------------------------------------------------

    def advance(self, budget: float = math.inf) -> bool:
        """Compute towards the next tick for at most about ``budget`` seconds of wall time.

        Publishes the tick when it is reached. The engine takes its own steps: neither ticks nor
        slices change what it computes.

        Returns
        -------
        bool
            Whether the tick was reached.

        Raises
        ------
        SimulationError
            If the computation failed; the run has been ended as failed.
        """
        simulation = self.simulation
        target = (self.tick + 1) / self.rates.state
        try:
            began = time.perf_counter()
            unseen = self._live is None or self._live.due > target
            if math.isinf(budget) or (unseen and self._last_took + self._took < EASY * budget):
                simulation.advance_to(target)
            else:
                self._measure(target)  # what was due in the last step, after the last tick
                while simulation.time < target and not simulation.ended:
                    simulation.advance_steps(1)
                    self._measure(target)
                    if time.perf_counter() >= began + budget:
                        break
            self._took += time.perf_counter() - began
            if simulation.time < target and not simulation.ended:
                return False
            sample = simulation.sample(target)
        except SimulationError as error:
            self.fail(error)
            raise
        self._last_took, self._took = self._took, 0.0
        self.tick += 1
        if sample.time != target:
            # The state after the end is that at the end.
            sample = dataclasses.replace(sample, time=target)
        self._publish_tick(sample)
        if simulation.ended and self.time + GRAIN >= simulation.time:
            self._finish()
        return True

    def _finish(self) -> None:
        """Publish the end of the run."""
        simulation = self.simulation
        self._publish_until(math.inf)
        if not any(e.kind in (EventKind.RUN_ENDED, EventKind.RUN_VOID) for e in simulation.events):
            kind = EventKind.RUN_VOID if simulation.outcome().void else EventKind.RUN_ENDED
            self._publish_event(Event(kind, simulation.time, self.step, cause=simulation.status))
        self._publish_outcome(self.time)
        if self._live is not None:
            self._send_live(self.stamp, self._live.end())
        self.finished = True

    def fail(self, error: Exception) -> None:
        """End the run as failed, with all that happened up to the last accepted step."""
        self.failure = f"{type(error).__name__}: {error}"
        self._publish_until(math.inf)
        moment = float(self.simulation.time)
        if not any(event.kind == EventKind.RUN_FAILED for event in self.simulation.events):
            self._publish_event(Event(EventKind.RUN_FAILED, moment, self.step, cause=str(error)))
        self._publish_outcome(moment, "failed")
        self.finished = True

    def stop(self) -> None:
        """End a run that is replaced, even if it never left its start."""
        if self.finished or not self.announced:
            return
        self._publish_until(self.time)
        self._publish_event(Event(EventKind.RUN_ENDED, self.time, self.step, cause="command"))
        self._publish_outcome(self.time, "stopped")
        self.finished = self.stopped = True

    # --- commands ----------------------------------------------------------------------------

    def command(self, name: str, **arguments: Any) -> Any:
        """Apply a command at the present step boundary.

        Raises
        ------
        CommandError
            If it was refused; the run goes on as if it had not been given.
        """
        if self.finished or self.simulation.ended:
            raise CommandError("run", "it has ended")
        result = getattr(self.simulation, name)(**arguments)
        # Its events are published at once, also while paused.
        self._publish_until(self.simulation.time)
        return result

    def refuse(self, command: dict[str, Any], most: int) -> None:
        """Keep a refused command for the manifest; beyond ``most`` they are only counted."""
        if len(self.refused) < most:
            self.refused.append(command)
        else:
            self.refused_unlisted += 1

    # --- manifest ----------------------------------------------------------------------------

    @property
    def status(self) -> str:
        """How the run stands, in words."""
        if self.failure:
            return "failed"
        return "stopped" if self.stopped else str(self.simulation.status)

    def entry(self) -> RunEntry:
        """The entry of this run in a manifest."""
        simulation = self.simulation
        outcome = dataclasses.replace(simulation.outcome(), status=self.status)
        return RunEntry(
            run_id=self.context.run_id,
            scenario_name=self.prepared.name,
            scenario_hash=self.prepared.hash,
            scenario=self.prepared.resolved,
            model=self.params.model,
            engine_hash=models.engine_hash(self.params.model),
            files={n: hashlib.sha256(f).hexdigest() for n, f in self.prepared.files.items()},
            start_time=self.context.base,
            commands=[dataclasses.asdict(command) for command in simulation.commands],
            refused=self._refused(),
            status=self.status,
            time=float(simulation.time),
            steps=self.step,
            final_state_hash=simulation.state_hash(),
            outcome=outcome_record(outcome),
        )

    def _refused(self) -> list[dict[str, Any]]:
        more = self.refused_unlisted
        last = {"command": "", "request": {}, "reason": f"{more} more, not listed"}
        return [*self.refused, last | {"step": self.step, "time": self.time}][
            : len(self.refused) + (more > 0)
        ]
