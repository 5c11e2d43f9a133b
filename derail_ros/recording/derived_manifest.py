"""The manifest of a recording that has none, derived from its messages.

The message of the train holds the scenario with all defaults and the versions, the command log
the commands, and the outcome how far the run went. A listener uses the same messages.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import yaml

from derail_ros.recording.channels import Message
from derail_ros.recording.decoding import decode
from derail_ros.recording.manifest import Manifest, RunEntry
from derail_ros.scenario import ScenarioError, loads_scenario
from derail_ros.vocabulary.measures import outcome_record
from msg_adapters.common import stamp_of
from msg_adapters.reports import outcome_from_message

CONSIST = "derail_msgs/msg/Consist"
COMMAND_LOG = "derail_msgs/msg/CommandLog"
OUTCOME = "derail_msgs/msg/Outcome"
SOURCES = (CONSIST, COMMAND_LOG, OUTCOME)
"""Types of the messages that a manifest is derived from."""


def add_message(manifest: Manifest, message: Any) -> None:
    """Add to a manifest what a message of :data:`SOURCES` says about a run."""
    kind = message.__msgtype__
    run = next((r for r in manifest.runs if r.run_id == message.run_id), None)
    if kind == CONSIST and run is None:
        manifest.software |= {
            "derail_ros": message.software_version,
            "engine_hash": message.engine_hash,
        }
        manifest.runs.append(
            RunEntry(
                run_id=message.run_id,
                scenario_name=message.scenario_name,
                scenario_hash=message.scenario_hash,
                scenario=_resolved(message.scenario_yaml),
                model=message.model,
                engine_hash=message.engine_hash,
                files={f.name: f.sha256 for f in message.files},
                start_time=stamp_of(message),
            )
        )
    elif run is not None and kind == COMMAND_LOG:
        command = logged_command(message)
        if message.accepted:
            run.commands.append(command)
        else:
            run.refused.append(command | {"reason": message.message})
    elif run is not None and kind == OUTCOME:
        run.status = message.status_name
        run.time, run.steps = float(message.time), int(message.step)
        run.outcome = outcome_record(outcome_from_message(message))


def logged_command(message: Any) -> dict[str, Any]:
    """A command as a client requested it, from ``derail_msgs/CommandLog``."""
    return {
        "command": message.command,
        "request": message.request_json,
        "step": int(message.step),
        "time": float(message.time),
    }


def derive_manifest(messages: Iterable[Message]) -> Manifest:
    """The manifest of the runs in a recording.

    The message of the train is latched and may come after the first command or outcome of its
    run. Messages that cannot be read are left out.
    """
    manifest = Manifest(software={}, created="", settings={"gathered": True})
    sources = [(c, data) for c, _, data in messages if c.msgtype in SOURCES]
    for channel, data in sorted(sources, key=lambda item: item[0].msgtype != CONSIST):
        try:
            add_message(manifest, decode(channel, data))
        except Exception:  # bytes that are no message make rosbags raise anything
            continue
    return manifest


def _resolved(text: str) -> dict[str, Any]:
    """A scenario with all defaults, as plain data, from the YAML of a consist."""
    try:
        return loads_scenario(text).resolved()
    except ScenarioError:  # of another version: what it says is still worth keeping
        data = yaml.safe_load(text)
        return data if isinstance(data, dict) else {}
