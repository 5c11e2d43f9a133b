"""Runs of a recording computed again, to the bit: the scenario and the commands are enough.

What is computed does not depend on the rates, the speed factor or who listened, so a run of a
node is repeated without one: from the scenario of its manifest, with each command at the step at
which it was applied.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import yaml

from derail_ros import models
from derail_ros.recording.gathered import CONSIST, gathered
from derail_ros.recording.manifest import Manifest, RunEntry
from derail_ros.scenario import loads_scenario
from derail_ros.vocabulary.errors import CommandError, SimulationError
from derail_ros.vocabulary.events import Command, EventKind
from derail_ros.vocabulary.simulation import Simulation
from derail_ros.vocabulary.status import BRAKE_MODES, BRAKE_SOURCES
from derail_ros.vocabulary.words import count
from msg_adapters.definitions import deserialize
from msg_adapters.reports import collision_from_message, event_from_message
from msg_adapters.topics import MANIFEST

PHYSICAL = ("inject_rail_break", "trigger_emergency_brake")
"""Commands that change a run; the others begin, pace or end it."""
ENDS = ("at rest", "time limit", "void", "failed")
"""Ways in which a run ends by itself."""
NOT_COMPUTED = (
    EventKind.RUN_LOADED,
    EventKind.RUN_RESET,
    EventKind.RUN_ENDED,
    EventKind.RUN_VOID,
    EventKind.RUN_FAILED,
)
"""Events of the node about a run."""


@dataclass
class Told:
    """What a recording says of a run.

    Attributes
    ----------
    events, contacts : those of the engine, in order; contacts that have ended
    commands : accepted commands that change a run, as they were requested
    steps : the largest number of steps that any message names
    """

    events: list[Any] = field(default_factory=list)
    contacts: list[Any] = field(default_factory=list)
    commands: list[dict[str, Any]] = field(default_factory=list)
    steps: int = 0


@dataclass(frozen=True)
class Replayed:
    """A run that was computed again, beside what was recorded of it.

    Attributes
    ----------
    run_id, scenario, status : of the run
    commands, steps, time : how many commands; accepted steps and run time (s) at its end
    same_state : whether the final states are the same to the bit, ``None`` if none was recorded
    events, contacts : how many were compared, ``None`` without a recording
    differences : in words, empty if everything is the same
    """

    run_id: str
    scenario: str
    status: str
    commands: int
    steps: int
    time: float
    same_state: bool | None
    events: int | None
    contacts: int | None
    differences: tuple[str, ...]


def told_by(messages: Iterable[tuple[Any, int, bytes]]) -> dict[str, Told]:
    """What a recording says of its runs, by their identities.

    Takes channel (``derail_ros.recording.storage.Channel``), time and bytes of each message.
    """
    runs: dict[str, Told] = {}
    for channel, _, data in messages:
        if channel.msgtype not in TELLING:
            continue
        try:
            message = deserialize(data, channel.msgtype)
        except Exception:  # whatever bytes that are no message make rosbags raise
            continue
        told = runs.setdefault(message.run_id, Told())
        told.steps = max(told.steps, int(message.step))
        kind = channel.msgtype.rpartition("/")[2]
        if kind == "TrainEvent":
            event = event_from_message(message)
            if event.kind not in NOT_COMPUTED:
                told.events.append(event)
        elif kind == "Collision" and message.is_final:
            told.contacts.append(collision_from_message(message))
        elif kind == "CommandLog" and message.accepted and message.command in PHYSICAL:
            told.commands.append(
                {
                    "command": message.command,
                    "request": message.request_json,
                    "step": int(message.step),
                    "time": float(message.time),
                }
            )
    return runs


TELLING = (
    "derail_msgs/msg/TrainEvent",
    "derail_msgs/msg/Collision",
    "derail_msgs/msg/CommandLog",
    "derail_msgs/msg/Outcome",
)


def needed(channel: Any) -> bool:
    """Whether :func:`told_by` or :func:`manifest_of` wants the messages of a channel."""
    return channel.msgtype in (*TELLING, CONSIST) or _is_manifest(channel)


def _is_manifest(channel: Any) -> bool:
    return bool(channel.name == MANIFEST.name and channel.msgtype == MANIFEST.msgtype)


def manifest_of(messages: Iterable[tuple[Any, int, bytes]]) -> Manifest:
    """The manifest that a recording holds, or else what its messages say instead of one.

    The node ``recorder`` writes its manifest last, and ``ros2 bag record`` none.
    """
    kept = list(messages)
    for channel, _, data in reversed(kept):
        if _is_manifest(channel):
            try:
                return Manifest.from_json(deserialize(data, channel.msgtype).data)
            except Exception:  # damaged, or of another version: the messages tell as well
                continue
    return gathered(kept)


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


def _give(simulation: Simulation, command: Command) -> None:
    """Give a command at its step."""
    if command.name == "inject_rail_break" and set(command.arguments) != {"coordinate", "car"}:
        # As a client asked for it: the engine finds the place.
        simulation.advance_steps(command.step - simulation.step_count)
        simulation.inject_rail_break(**command.arguments)  # type: ignore[arg-type]
    else:
        simulation.apply(command)


def replay_run(entry: RunEntry, told: Told | None = None) -> Replayed:
    """Compute a run again and compare.

    Raises
    ------
    ScenarioError, ParameterError
        If its scenario cannot be run by this version.
    """
    scenario = loads_scenario(yaml.safe_dump(entry.scenario), entry.scenario_name)
    simulation = models.build(scenario.to_params())
    cut_off = entry.status == "running"
    listed: Sequence[Mapping[str, Any]] = entry.commands
    if told is not None and (cut_off or not entry.final_state_hash):
        # The writer was killed, or only listened: the messages know more than the manifest.
        listed = told.commands
    commands = [engine_command(c) for c in listed if c.get("command", PHYSICAL[0]) in PHYSICAL]
    steps = max(entry.steps, told.steps if told is not None else 0) if cut_off else entry.steps
    differences: list[str] = []
    try:
        for command in commands:
            _give(simulation, command)
        if entry.status in ENDS:
            simulation.run()
        else:
            simulation.advance_steps(steps - simulation.step_count)
    except SimulationError as error:
        if entry.status != "failed":
            differences.append(f"fails at {simulation.time:.3f} s: {error}")
    except CommandError as error:
        differences.append(f"refuses a command at step {simulation.step_count}: {error}")
    if simulation.step_count != steps:
        differences.append(f"ends after {count(simulation.step_count, 'step')}, not {steps}")
    if entry.status in ENDS and simulation.status != entry.status:
        differences.append(f"ends {simulation.status!r}, not {entry.status!r}")
    same_state = None
    if entry.final_state_hash and not cut_off:
        same_state = simulation.state_hash() == entry.final_state_hash
        if not same_state:
            differences.append("the final state is another one")
    if told is not None:
        differences += _compare(simulation, told)
        if differences and (unknown := _asked(told) - len(commands)) > 0:
            differences.append(
                f"{count(unknown, 'command')} known from events only, not in the log"
            )
    return Replayed(
        run_id=entry.run_id,
        scenario=entry.scenario_name,
        status=entry.status,
        commands=len(commands),
        steps=simulation.step_count,
        time=float(simulation.time),
        same_state=same_state,
        events=None if told is None else len(told.events),
        contacts=None if told is None else len(told.contacts),
        differences=tuple(differences),
    )


def _asked(told: Told) -> int:
    """Number of a client's commands that the events tell of."""
    kinds = (EventKind.RAIL_BREAK_SET, EventKind.BRAKES_TRIGGERED)
    return sum(e.kind in kinds and e.cause.startswith("command") for e in told.events)


def _compare(simulation: Simulation, told: Told) -> list[str]:
    """Differences between what was computed and what was recorded, to the last bit.

    A run can be stopped between two ticks, before its last steps were told: what was recorded is
    the beginning of what was computed.
    """
    found = []
    events = [e for e in simulation.events if e.kind not in NOT_COMPUTED]
    for n, (mine, recorded) in enumerate(zip(events, told.events)):
        if repr(mine) != repr(recorded):
            found.append(f"event {n + 1} of {len(told.events)} is another one: {mine.kind.name}")
            break
    if len(events) < len(told.events):
        found.append(f"{count(len(events), 'event')} instead of {len(told.events)}")
    contacts = {c.id: repr(c) for c in simulation.collisions}
    # A contact that the end of a recorded run has closed may go on here.
    others = [c for c in told.contacts if contacts.get(c.id) != repr(c)]
    if others:
        found.append(f"{len(others)} of {len(told.contacts)} contacts are others")
    return found


def replay(manifest: Manifest, told: Mapping[str, Told] | None = None) -> list[Replayed]:
    """Compute all runs of a manifest again and compare."""
    return [
        replay_run(entry, None if told is None else told.get(entry.run_id, Told()))
        for entry in manifest.runs
    ]


def engine_differs(manifest: Manifest) -> bool:
    """Whether another version of the engine computed the runs."""
    return manifest.software.get("engine_hash", "") not in ("", models.engine_hash())


def as_plain(result: Replayed) -> dict[str, Any]:
    """A result for JSON."""
    plain = {name: getattr(result, name) for name in result.__dataclass_fields__}
    plain["time"] = result.time if math.isfinite(result.time) else None
    plain["differences"] = list(result.differences)
    return plain
