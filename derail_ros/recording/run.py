"""Records a run from beginning to end, without ROS."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Any

from derail_ros.recording.manifest import Manifest
from derail_ros.recording.recorder import RunRecorder, absolute
from msg_adapters.common import TIME_ZERO

PROGRESS_EVERY = 0.1
"""Wall time between two calls of ``progress``, s."""


def record_run(
    simulation: Any,
    scenario: Any,
    path: str | os.PathLike[str],
    state_rate: float = 50.0,
    marker_rate: float = 15.0,
    progress: Callable[[Any], None] | None = None,
    storage: str = "mcap",
) -> Manifest:
    """Run a simulation to its end and record what the node would have published.

    Parameters
    ----------
    simulation : at its start (``derail_ros.engine.Simulation``); it is run, so that the caller can
        ask it for its outcome afterwards
    scenario : the scenario it was built from (``derail_ros.scenario.Scenario``)
    path : folder of the recording; it must not exist
    state_rate, marker_rate : messages per second of simulation time; 0 markers a second leaves
        them out
    progress : called about ten times a second with the simulation
    storage : ``"mcap"`` or ``"sqlite3"``

    Returns
    -------
    Manifest
        As it was written beside and into the recording.

    Raises
    ------
    ValueError
        If the simulation is not at its start.
    RecordingError
        If the recording cannot be written.
    SimulationError
        If the run failed; the recording is whole up to there and says so.
    """
    from derail_ros.recording.session import Prepared, Rates, Session

    if simulation.step_count:
        raise ValueError("the simulation must be at its start")
    settings = {"state_rate": state_rate, "marker_rate": marker_rate, "storage": storage}
    manifest = Manifest(settings=settings)
    with RunRecorder(path, storage) as recorder:

        def emit(topic: str, stamp: int, data: bytes) -> None:
            recorder.write(absolute(topic), stamp, data)

        session = Session(
            Prepared(scenario, simulation),
            emit,
            rates=Rates(state_rate, marker_rate),
            record_markers=emit,
            simulation=simulation,
        )
        manifest.runs.append(session.entry())
        recorder.write_manifest(manifest, TIME_ZERO)
        try:
            session.begin()
            told = time.monotonic()
            while not session.finished:
                session.advance()
                if progress is not None and time.monotonic() - told >= PROGRESS_EVERY:
                    told = time.monotonic()
                    progress(simulation)
            if progress is not None:
                progress(simulation)
        finally:
            # Also of a run that failed, and of one that was interrupted.
            session.stop()
            manifest.runs[-1] = session.entry()
            recorder.close(manifest)
    return manifest
