"""Runs of a recording computed again and compared to the bit.

The scenario and the commands determine a run: the rates, the speed factor and the subscribers
have no influence. A run of a node is computed again without a node: from the scenario of its
manifest, with each command at the step at which it was applied.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import yaml

from derail_ros import models
from derail_ros.recording.channels import Channel
from derail_ros.recording.decoding import is_known
from derail_ros.recording.manifest import Manifest, RunEntry
from derail_ros.recording.run_messages import REPORTS, Collector, RunMessages
from derail_ros.recording.storage import RawBag
from derail_ros.scenario import loads_scenario
from derail_ros.vocabulary.errors import CommandError, SimulationError
from derail_ros.vocabulary.events import Collision, Command, Event, EventKind
from derail_ros.vocabulary.simulation import COMMANDS, Simulation
from derail_ros.vocabulary.status import BRAKE_MODES, BRAKE_SOURCES, RUNNING, STATUSES
from derail_ros.vocabulary.words import count

NOT_COMPUTED = (
    EventKind.RUN_LOADED,
    EventKind.RUN_RESET,
    EventKind.RUN_ENDED,
    EventKind.RUN_VOID,
    EventKind.RUN_FAILED,
)
"""Events that the session adds to those of the engine."""


@dataclass(frozen=True)
class Recomputed:
    """A run that was computed again, compared with its recording."""

    run_id: str
    scenario: str
    status: str
    commands: int  # number of them
    steps: int  # accepted ones
    time: float  # run time at its end, s
    same_state: bool | None  # final states are equal to the bit; None if none was recorded
    events: int | None  # how many were compared, None without a recording; likewise contacts
    contacts: int | None
    differences: tuple[str, ...]  # in words, empty if everything is equal

    def plain(self) -> dict[str, Any]:
        """The fields for JSON."""
        time = self.time if math.isfinite(self.time) else None
        return asdict(self) | {"time": time, "differences": list(self.differences)}


def is_needed(channel: Channel) -> bool:
    """Whether the messages of a channel are read here."""
    return channel.is_manifest or (is_known(channel) and channel.kind in REPORTS)


def collect(bag: RawBag) -> Collector:
    """The runs of a recording, without their states."""
    collector = Collector()
    for channel, _, data in bag.messages(is_needed):
        collector.take(channel, data)
    return collector


# --- computing ---------------------------------------------------------------------------------


def engine_command(entry: Mapping[str, Any]) -> Command:
    """A command from a manifest: as the engine logged it, or as a client requested it."""
    if "arguments" in entry:
        return Command(**entry)
    request = entry["request"]
    request = json.loads(request) if isinstance(request, str) else request
    arguments: dict[str, Any]
    if entry["command"] == "inject_rail_break":
        car = int(request["car"])
        arguments = {"car": car} if car else {"coordinate": float(request["track_coordinate"])}
    else:
        arguments = {
            "mode": BRAKE_MODES[request["mode"]],
            "source": BRAKE_SOURCES[request["source"]],
            "car": int(request["car"]),
            "delay": float(request["delay_s"]),
        }
    return Command(entry["command"], arguments, int(entry["step"]), float(entry["time"]))


def _apply(simulation: Simulation, command: Command, by_time: bool) -> None:
    """Apply a command at its step, or at its time."""
    if by_time:
        simulation.advance_to(command.time)
        command = replace(command, step=simulation.step_count)
    if command.name == "inject_rail_break" and set(command.arguments) != {"coordinate", "car"}:
        # As a client requested it: the engine finds the place.
        simulation.advance_steps(command.step - simulation.step_count)
        simulation.inject_rail_break(**command.arguments)  # type: ignore[arg-type]
    else:
        simulation.apply(command)


def recompute_run(
    entry: RunEntry, recorded: RunMessages | None = None, by_time: bool = False
) -> Recomputed:
    """Compute a run again and compare it with its recording.

    With ``by_time`` commands are given at their times, for another engine takes other steps.

    Raises
    ------
    ScenarioError, ParameterError
        If its scenario cannot be run by this version.
    """
    scenario = loads_scenario(yaml.safe_dump(entry.scenario), entry.scenario_name)
    simulation = models.build(scenario.to_params())
    cut_off = entry.status == RUNNING
    by_itself = STATUSES[entry.status].by_itself
    listed: Sequence[Mapping[str, Any]] = entry.commands
    if recorded is not None and (cut_off or not entry.final_state_hash):
        # The writer was killed, or only listened: the messages know more than the manifest.
        listed = [c for _, c in sorted(recorded.commands.items()) if c["accepted"]]
    commands = [engine_command(c) for c in listed if c.get("command", COMMANDS[0]) in COMMANDS]
    steps = entry.steps
    if cut_off and recorded is not None:
        steps = max(steps, recorded.steps)
    differences: list[str] = []
    try:
        for command in commands:
            _apply(simulation, command, by_time)
        if by_itself:
            simulation.run()
        elif by_time and entry.time:
            simulation.advance_to(entry.time)
        else:
            simulation.advance_steps(steps - simulation.step_count)
    except SimulationError as error:
        if entry.status != "failed":
            differences.append(f"fails at {simulation.time:.3f} s: {error}")
    except CommandError as error:
        differences.append(f"refuses a command at step {simulation.step_count}: {error}")
    if simulation.step_count != steps:
        differences.append(f"ends after {count(simulation.step_count, 'step')}, not {steps}")
    if by_itself and simulation.status != entry.status:
        differences.append(f"ends {simulation.status!r}, not {entry.status!r}")
    same_state = None
    if entry.final_state_hash and not cut_off:
        same_state = simulation.state_hash() == entry.final_state_hash
        if not same_state:
            differences.append("the final state differs")
    events = [] if recorded is None else _engine_events(recorded)
    ended = [] if recorded is None else [c for c in recorded.collisions.values() if c.final]
    if recorded is not None:
        differences += _compare(simulation, events, ended)
        if differences and (unknown := _commands_in(events) - len(commands)) > 0:
            differences.append(
                f"{count(unknown, 'command')} known from events only, not in the log"
            )
    return Recomputed(
        run_id=entry.run_id,
        scenario=entry.scenario_name,
        status=entry.status,
        commands=len(commands),
        steps=simulation.step_count,
        time=float(simulation.time),
        same_state=same_state,
        events=None if recorded is None else len(events),
        contacts=None if recorded is None else len(ended),
        differences=tuple(differences),
    )


def _engine_events(recorded: RunMessages) -> list[Event]:
    """The recorded events that the engine computes, in order."""
    events = (recorded.events[k] for k in sorted(recorded.events))
    return [e for e in events if e.kind not in NOT_COMPUTED]


def _commands_in(events: Iterable[Event]) -> int:
    """Number of a client's commands that left an event."""
    kinds = (EventKind.RAIL_BREAK_SET, EventKind.BRAKES_TRIGGERED)
    return sum(e.kind in kinds and e.cause.startswith("command") for e in events)


def _numbers(event: Event) -> str:
    """All of an event but the words of its state, which may change."""
    return repr(replace(event, before="", after=""))


def _compare(
    simulation: Simulation, events: Sequence[Event], collisions: Sequence[Collision]
) -> list[str]:
    """Differences between the computed and the recorded run, to the last bit.

    A run can be stopped between two ticks, before its last steps were published: the recorded
    run is the beginning of the computed one.
    """
    found = []
    computed = [e for e in simulation.events if e.kind not in NOT_COMPUTED]
    for n, (mine, other) in enumerate(zip(computed, events), 1):
        if _numbers(mine) != _numbers(other):
            found.append(f"event {n} of {len(events)} differs: {mine.kind.name}")
            break
    if len(computed) < len(events):
        found.append(f"{count(len(computed), 'event')} instead of {len(events)}")
    contacts = {c.id: repr(c) for c in simulation.collisions}
    # A contact that the end of a recorded run has closed may go on here.
    others = [c for c in collisions if contacts.get(c.id) != repr(c)]
    if others:
        found.append(f"{len(others)} of {len(collisions)} contacts differ")
    return found


def recompute(
    manifest: Manifest, recorded: Mapping[str, RunMessages] | None = None
) -> list[Recomputed]:
    """Compute all runs of a manifest again and compare them with their recordings."""
    return [
        recompute_run(
            entry,
            None if recorded is None else recorded.get(entry.run_id, RunMessages()),
            _of_another_engine(entry, manifest),
        )
        for entry in manifest.runs
    ]


def _of_another_engine(run: RunEntry, manifest: Manifest) -> bool:
    software = manifest.software.get("engine_hash", "")
    return (run.engine_hash or software) not in ("", models.engine_hash(run.model))


def engine_differs(manifest: Manifest) -> bool:
    """Whether another version of the engine computed the runs."""
    return any(_of_another_engine(run, manifest) for run in manifest.runs)
