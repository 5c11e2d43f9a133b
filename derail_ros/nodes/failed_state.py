"""Keeps the state of a run that has failed, for whoever looks for the cause."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from derail_ros.vocabulary.simulation import Simulation


def save_state(simulation: Simulation, run_id: str, folder: str = "") -> str:
    """Save the last accepted state of a failed run; returns the file, or why there is none."""
    reason = ""
    for place in (Path(folder or state_folder()), Path(tempfile.gettempdir())):
        file = place / f"failed-{run_id}.state"
        try:
            place.mkdir(parents=True, exist_ok=True)
            file.write_bytes(simulation.to_bytes())
            return str(file)
        except OSError as error:
            reason = str(error)
    return f"nowhere: {reason}"


def state_folder() -> str:
    """Default folder for the states of failed runs."""
    base = os.environ.get("XDG_STATE_HOME") or os.path.join(
        os.path.expanduser("~"), ".local", "state"
    )
    return os.path.join(base, "derail_ros")
