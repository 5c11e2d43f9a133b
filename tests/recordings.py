"""Recordings of a small train as fixtures, for the tests of reading and of reviewing."""

from __future__ import annotations

from pathlib import Path

import pytest

from derail_ros.recording import record_run
from derail_ros.recording.reader import read_bag
from derail_ros.recording.recorded_run import RecordedRun
from tests.nodes.support import simulation, small


@pytest.fixture(scope="session")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of ten cars over a broken rail."""
    path = tmp_path_factory.mktemp("bags") / "small"
    record_run(simulation(), small(), path)
    return path


@pytest.fixture(scope="session")
def sqlite_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same in the other storage."""
    path = tmp_path_factory.mktemp("bags") / "small_sqlite"
    record_run(simulation(), small(), path, storage="sqlite3")
    return path


@pytest.fixture(scope="session")
def run(bag: Path) -> RecordedRun:
    """The recording as arrays."""
    return read_bag(bag)
