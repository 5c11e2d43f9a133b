"""The manifest of a recording that has none, derived from its messages.

The message of the train holds the scenario with all defaults and the versions, the command log
the commands, and the outcome how far the run went. A listener uses the same messages.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import yaml

from derail_ros.recording.channels import Message
from derail_ros.recording.manifest import Manifest, RunEntry
from derail_ros.scenario import ScenarioError, loads_scenario
from msg_adapters.common import stamp_of
from msg_adapters.definitions import deserialize

CONSIST = "derail_msgs/msg/Consist"
COMMAND_LOG = "derail_msgs/msg/CommandLog"
OUTCOME = "derail_msgs/msg/Outcome"
SOURCES = (CONSIST, COMMAND_LOG, OUTCOME)
"""Types of the messages that a manifest is derived from."""


def add_message(manifest: Manifest, msgtype: str, data: bytes) -> None:
    """Add to a manifest what a message (CDR bytes) says about a run."""
    if msgtype not in SOURCES:
        return
    message = deserialize(data, msgtype)
    run = next((r for r in manifest.runs if r.run_id == message.run_id), None)
    if msgtype == CONSIST and run is None:
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
                start_time=stamp_of(message),
            )
        )
    elif run is not None and msgtype == COMMAND_LOG:
        command = logged_command(message)
        if message.accepted:
            run.commands.append(command)
        else:
            run.refused.append(command | {"reason": message.message})
    elif run is not None and msgtype == OUTCOME:
        run.status = message.status_name
        run.time, run.steps = float(message.time), int(message.step)
        run.outcome = {
            "cars_derailed": int(message.cars_derailed),
            "derailed_cars": message.derailed_cars.tolist(),
            "duration": float(message.duration),
            "peak_force": float(message.peak_corner_force),
            "peak_force_pair": [int(message.peak_car_a), int(message.peak_car_b)],
            "scene_length": float(message.scene_length),
            "scene_width": float(message.scene_width),
        }


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
    sources = [(c.msgtype, data) for c, _, data in messages if c.msgtype in SOURCES]
    for msgtype, data in sorted(sources, key=lambda item: item[0] != CONSIST):
        try:
            add_message(manifest, msgtype, data)
        except Exception:  # whatever bytes that are no message make rosbags raise
            continue
    return manifest


def _resolved(text: str) -> dict[str, Any]:
    """A scenario with all defaults, as plain data, from the YAML of a consist."""
    try:
        return loads_scenario(text).resolved()
    except ScenarioError:  # of another version: what it says is still worth keeping
        data = yaml.safe_load(text)
        return data if isinstance(data, dict) else {}
