"""Add a saved state to ``tests/data``, or renew all of them; see README.md there.

python -m tests.data.add FILE.state NAME "why"
python -m tests.data.add --renew
"""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import Any

from derail_ros.engine import PlanarSimulation
from derail_ros.engine.serial import unpack
from derail_ros.vocabulary.errors import SimulationError
from derail_ros.vocabulary.events import Command, Event
from derail_ros.vocabulary.params import TrainParams
from derail_ros.vocabulary.plain import from_plain

FOLDER = Path(__file__).parent

HORIZON = 10.0
"""How long a next event is waited for, s of simulation."""


def saved_states() -> list[Path]:
    """All saved states."""
    return sorted(FOLDER.glob("*.state"))


def expectation(path: Path) -> dict[str, Any]:
    """What belongs to a saved state."""
    return json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))


def next_event(run: PlanarSimulation) -> tuple[Event | None, str]:
    """Go on to the next event; with the name of the error if that is a failure."""
    until = run.time + HORIZON
    before = len(run.events)
    try:
        while not run.ended and run.time < until and len(run.events) == before:
            run.advance_steps(1)
    except SimulationError as error:
        return run.events[-1], type(error).__name__
    new = run.events[before:]
    return (new[0] if new else None), ""


def describe(event: Event | None, error: str) -> dict[str, Any]:
    """An event as it is written down."""
    if event is None:
        return {"kind": "none"}
    said: dict[str, Any] = {
        "kind": event.kind.name,
        "time_s": event.time,
        "cars": list(event.cars),
        "end": event.end,
        "cause": event.cause,
    }
    if error:
        said["error"] = error
    if math.isfinite(event.track_coordinate):
        said["track_coordinate_m"] = event.track_coordinate
    return said


def write(name: str, state: bytes, why: str) -> dict[str, Any]:
    """Write a state and what comes next."""
    run = PlanarSimulation.from_bytes(state)
    told: dict[str, Any] = {
        "why": why,
        "saved_at_s": run.time,
        "saved_at_step": run.step_count,
        "next": describe(*next_event(run)),
    }
    (FOLDER / f"{name}.state").write_bytes(state)
    text = json.dumps(told, indent=2, allow_nan=False)
    (FOLDER / f"{name}.json").write_text(text + "\n", encoding="utf-8")
    return told


def renew(path: Path) -> dict[str, Any]:
    """Make a state again from the parameters and commands it holds."""
    header, _ = unpack(path.read_bytes())
    run = PlanarSimulation(from_plain(TrainParams, header["params"]))
    told = expectation(path)
    for command in (from_plain(Command, c) for c in header["commands"]):
        run.advance_to(min(command.time, told["saved_at_s"]))
        if command.name == "inject_rail_break":
            run.inject_rail_break(coordinate=command.arguments["coordinate"])
        else:
            run.trigger_emergency_brake(**command.arguments)
    run.advance_to(told["saved_at_s"])
    return write(path.stem, run.to_bytes(), told["why"])


def main() -> None:
    """Do what the command line says."""
    if sys.argv[1:] == ["--renew"]:
        for path in saved_states():
            print(f"{path.stem}: next {renew(path)['next']}")
        return
    if len(sys.argv) != 4:
        sys.exit(__doc__)
    source, name, why = sys.argv[1:]
    print(f"{name}: next {write(name, Path(source).read_bytes(), why)['next']}")


if __name__ == "__main__":
    main()
