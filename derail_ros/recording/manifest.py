"""The origin of a recording: enough to repeat its runs to the bit.

A manifest lies beside the recording (``manifest.json`` in the bag's folder), in its metadata
(custom data ``derail_ros_manifest``) and in it, as the last message of the latched topic
``manifest``.
"""

from __future__ import annotations

import dataclasses
import datetime
import importlib.metadata
import json
import os
import platform
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import derail_ros
from derail_ros.vocabulary.params import PLANAR
from derail_ros.vocabulary.status import RUNNING
from msg_adapters.reports import jsonable

FORMAT = "derail_ros/manifest"
VERSION = 2
"""Version 1 had no model and no files, and keys of an outcome without units; it is still read."""
FILE_NAME = "manifest.json"
CUSTOM_DATA = "derail_ros_manifest"

PACKAGES = ("numpy", "numba", "llvmlite", "pydantic", "PyYAML", "rosbags", "mcap", "ros-rclpy")


def software_versions(*more: str) -> dict[str, str]:
    """Versions of everything that a result may depend on; of ``more`` packages too."""
    from derail_ros.models import engine_hash

    versions = {
        "derail_ros": derail_ros.__version__,
        "engine_hash": engine_hash(),
        "python": sys.version.split()[0],
        "platform": platform.platform(),
        "machine": platform.machine(),
    }
    for package in (*PACKAGES, *more):
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    if distribution := os.environ.get("ROS_DISTRO"):
        versions["ros_distro"] = distribution
    return versions


@dataclass
class RunEntry:
    """One run of a recording."""

    run_id: str
    scenario_name: str
    scenario_hash: str
    scenario: dict[str, Any]  # with all defaults filled in, as plain data
    model: str = PLANAR
    engine_hash: str = ""  # "": that of ``Manifest.software``
    # SHA-256 by name; the content is in the train's message
    files: dict[str, str] = field(default_factory=dict)
    seed: int | None = None  # of what is drawn at random; the model draws nothing
    start_time: int = 0  # simulation time, ns
    # applied ones: name, arguments, step, time
    commands: list[dict[str, Any]] = field(default_factory=list)
    # refused ones: command, request, reason, step, time
    refused: list[dict[str, Any]] = field(default_factory=list)
    status: str = RUNNING  # how it ended, or "running"
    time: float = 0.0  # run time at its end, s
    steps: int = 0  # accepted ones
    final_state_hash: str = ""  # of the engine's state at its end
    outcome: dict[str, Any] = field(default_factory=dict)  # ``vocabulary.measures.outcome_record``


@dataclass
class Manifest:
    """Where a recording comes from."""

    # in order; the outcome of interest is usually that of the last one
    runs: list[RunEntry] = field(default_factory=list)
    software: dict[str, str] = field(default_factory=software_versions)
    # wall time at which it was begun, ISO 8601
    created: str = field(
        default_factory=lambda: datetime.datetime.now(datetime.timezone.utc).isoformat()
    )
    # state_rate (Hz), marker_rate (Hz) and so on
    settings: dict[str, Any] = field(default_factory=dict)
    # by topic, known once the recording is closed
    messages: dict[str, int] = field(default_factory=dict)
    format: str = FORMAT
    version: int = VERSION

    @property
    def run(self) -> RunEntry:
        """The last run."""
        return self.runs[-1]

    def to_json(self) -> str:
        """The manifest as JSON; non-finite numbers are the texts ``nan``, ``inf``, ``-inf``."""
        return json.dumps(jsonable(dataclasses.asdict(self)), indent=1, allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> Manifest:
        """A manifest from its JSON.

        Raises
        ------
        ValueError
            If it is something else, or of another version.
        """
        try:
            data = json.loads(text)
        except ValueError:
            raise ValueError("not JSON") from None
        form = data.get("format") if isinstance(data, dict) else None
        if form != FORMAT:
            raise ValueError(f"its format must be {FORMAT!r}, got {form!r}")
        if data.get("version") not in (1, VERSION):
            raise ValueError(f"its version must be 1 or {VERSION}, got {data.get('version')!r}")
        data["runs"] = [RunEntry(**run) for run in data["runs"]]
        return cls(**data)


def read_manifest(path: str | os.PathLike[str]) -> Manifest:
    """The manifest beside a recording: ``path`` is the bag's folder or the file itself."""
    place = Path(path)
    if place.is_dir():
        place = place / FILE_NAME
    return Manifest.from_json(place.read_text(encoding="utf-8"))
