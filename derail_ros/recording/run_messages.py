"""The messages of a recording, sorted by run and kept as objects of the vocabulary.

A :class:`Collector` takes messages from a recording (reader, repair, recomputation) or from a
graph (listener). What it has taken gives a manifest too, for recordings that have none.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import yaml

from derail_ros.recording.channels import Channel
from derail_ros.recording.decoding import decode
from derail_ros.recording.manifest import Manifest, RunEntry
from derail_ros.recording.plausibility import is_plausible
from derail_ros.recording.recorded_run import SampledLine
from derail_ros.scenario import ScenarioError, loads_scenario
from derail_ros.vocabulary.events import Collision, Event
from derail_ros.vocabulary.measures import outcome_record
from derail_ros.vocabulary.outcome import Outcome
from msg_adapters.common import stamp_of
from msg_adapters.reports import (
    collision_from_message,
    event_from_message,
    ledger_from_message,
    outcome_from_message,
)

BUDGET = 120_000_000
"""Memory for the states of a run; of longer ones every second, fourth ... state is kept, bytes."""
POSE = ("x", "y", "z", "roll", "pitch", "yaw")
VELOCITY = ("vx", "vy", "vz", "roll_rate", "pitch_rate", "yaw_rate")


class Series:
    """Rows of a state topic; beyond a budget of memory every second one is dropped."""

    def __init__(self) -> None:
        self.rows: list[tuple[Any, ...]] = []
        self.every = 1
        self.count = 0
        self.last: tuple[Any, ...] | None = None
        self.limit = 0

    def add(self, row: tuple[Any, ...]) -> bool:
        """Add a row; false if it is of another number of cars than the first one."""
        if self.rows and np.shape(row[1]) != np.shape(self.rows[0][1]):
            return False
        if not self.limit:
            size = sum(a.nbytes if isinstance(a, np.ndarray) else 8 for a in row) + 1200
            self.limit = max(200, BUDGET // size)
        if self.count % self.every == 0:
            self.rows.append(row)
            if len(self.rows) > self.limit:
                del self.rows[1::2]
                self.every *= 2
        self.last = row
        self.count += 1
        return True

    def columns(self) -> list[Any]:
        """Columns in order of the first one, each time once."""
        rows = self.rows
        if self.last is not None and rows[-1] is not self.last:
            rows = [*rows, self.last]
        times = np.array([row[0] for row in rows])
        _, order = np.unique(times[::-1], return_index=True)  # of equal times the later one
        rows = [rows[len(rows) - 1 - k] for k in order]
        return [np.array(column) for column in zip(*rows)]


@dataclass
class RunMessages:
    """The messages of one run."""

    consist: Any = None  # ``derail_msgs/Consist``
    line: SampledLine | None = None  # the track
    outcome: Outcome | None = None  # the last one, or the final one
    # by their numbers in the run, as are collisions and commands
    events: dict[int, Event] = field(default_factory=dict)
    collisions: dict[int, Collision] = field(default_factory=dict)
    commands: dict[int, dict[str, Any]] = field(default_factory=dict)
    steps: int = 0  # largest number in any message
    # time, pose, velocity, coupler angles, trucks, brakes, corner force, stamp (ns)
    states: Series = field(default_factory=Series)
    couplings: Series = field(default_factory=Series)  # time, which hold
    energy: Series = field(default_factory=Series)  # time, values, entries

    def take(self, kind: str, m: Any) -> bool:
        """Keep a message; false if it does not fit the others.

        Raises
        ------
        KeyError, ValueError, IndexError
            If it says what is not known here.
        """
        self.steps = max(self.steps, int(getattr(m, "step", 0)))
        return TAKE[kind](self, m) is not False

    def _state(self, m: Any) -> bool:
        trucks = np.stack([m.truck_status_front, m.truck_status_rear], axis=-1)
        return self.states.add(
            (
                float(m.time),
                np.stack([getattr(m, k) for k in POSE], axis=-1),
                np.stack([getattr(m, k) for k in VELOCITY], axis=-1),
                np.stack([m.coupler_angle_front, m.coupler_angle_rear], axis=-1),
                trucks == m.TRUCK_ON_RAILS,
                m.brake_force.astype(np.float32),
                m.largest_corner_force.astype(np.float32),
                stamp_of(m),
            )
        )

    def _couplers(self, m: Any) -> bool:
        return self.couplings.add((float(m.time), m.coupled == m.COUPLED))

    def _ledger(self, m: Any) -> bool:
        ledger = ledger_from_message(m.entries)
        return self.energy.add((float(m.time), np.array(list(ledger.values())), tuple(ledger)))

    def _event(self, m: Any) -> None:
        self.events[int(m.sequence)] = event_from_message(m)

    def _collision(self, m: Any) -> None:
        old = self.collisions.get(int(m.id))
        if old is None or not old.final:
            self.collisions[int(m.id)] = collision_from_message(m)

    def _outcome(self, m: Any) -> None:
        if self.outcome is None or not self.outcome.final or m.is_final:
            self.outcome = outcome_from_message(m)

    def _command(self, m: Any) -> None:
        self.commands[int(m.sequence)] = {
            "command": m.command,
            "request": m.request_json,
            "caller": m.caller,
            "accepted": bool(m.accepted),
            "message": m.message,
            "time": float(m.time),
            "step": int(m.step),
        }

    def _consist(self, m: Any) -> None:
        self.consist = m

    def _track(self, m: Any) -> None:
        self.line = SampledLine.of_message(m)

    def entry(self, run_id: str) -> RunEntry:
        """The run's entry in a manifest; it has a consist."""
        m = self.consist
        entry = RunEntry(
            run_id=run_id,
            scenario_name=m.scenario_name,
            scenario_hash=m.scenario_hash,
            scenario=_resolved(m.scenario_yaml),
            model=m.model,
            engine_hash=m.engine_hash,
            files={f.name: f.sha256 for f in m.files},
            start_time=stamp_of(m),
        )
        for number in sorted(self.commands):
            command = self.commands[number]
            logged = {key: command[key] for key in ("command", "request", "step", "time")}
            if command["accepted"]:
                entry.commands.append(logged)
            else:
                entry.refused.append(logged | {"reason": command["message"]})
        if (outcome := self.outcome) is not None:
            entry.status, entry.time, entry.steps = outcome.status, outcome.time, outcome.steps
            entry.outcome = outcome_record(outcome)
        return entry


TAKE: dict[str, Callable[[RunMessages, Any], bool | None]] = {
    "Consist": RunMessages._consist,
    "Track": RunMessages._track,
    "TrainEvent": RunMessages._event,
    "Collision": RunMessages._collision,
    "Outcome": RunMessages._outcome,
    "CommandLog": RunMessages._command,
    "TrainState": RunMessages._state,
    "CouplerStates": RunMessages._couplers,
    "EnergyLedger": RunMessages._ledger,
}
"""Type of ``derail_msgs`` -> what keeps its messages."""
STATES = ("TrainState", "CouplerStates", "EnergyLedger")
REPORTS = tuple(kind for kind in TAKE if kind not in STATES)
"""Types that are rare: a first pass over a recording reads them."""


class Collector:
    """Takes messages and sorts them by run.

    Attributes
    ----------
    runs : by their identities, in the order of their first messages
    manifest_text : the last manifest, as JSON; "" without
    broken, implausible : number of messages that cannot be read, or that cannot be true
    """

    def __init__(self) -> None:
        self.runs: dict[str, RunMessages] = {}
        self.manifest_text = ""
        self.broken = 0
        self.implausible = 0

    def take(self, channel: Channel, data: bytes, only: str | None = None) -> None:
        """Take a message of a type in :data:`TAKE`, or a manifest; ``only`` of this run."""
        try:
            message = decode(channel, data)
        except Exception:  # bytes that are no message make rosbags raise anything
            self.broken += 1
            return
        if channel.is_manifest:
            self.manifest_text = str(message.data)
        elif only is None or message.run_id == only:
            self._keep(channel.kind, message)

    def _keep(self, kind: str, message: Any) -> None:
        if not is_plausible(kind, message):
            self.implausible += 1
            return
        run = self.runs.setdefault(str(message.run_id), RunMessages())
        try:
            self.implausible += not run.take(kind, message)
        except (KeyError, ValueError, IndexError):
            self.broken += 1

    def manifest(self) -> Manifest:
        """The manifest that was taken; without one, that of the runs with a consist."""
        try:
            return Manifest.from_json(self.manifest_text)
        except (ValueError, TypeError, KeyError):  # none, damaged, or of another version
            return self.derived_manifest()

    def derived_manifest(self) -> Manifest:
        """The manifest of the runs with a consist."""
        known = {key: run for key, run in self.runs.items() if run.consist is not None}
        software: dict[str, str] = {}
        for run in known.values():
            software |= {
                "derail_ros": run.consist.software_version,
                "engine_hash": run.consist.engine_hash,
            }
        entries = [run.entry(key) for key, run in known.items()]
        return Manifest(entries, software, created="", settings={"gathered": True})


def _resolved(text: str) -> dict[str, Any]:
    """A scenario with all defaults, as plain data, from the YAML of a consist."""
    try:
        return loads_scenario(text).resolved()
    except ScenarioError:  # of another version: what it says is still worth keeping
        data = yaml.safe_load(text)
        return data if isinstance(data, dict) else {}
