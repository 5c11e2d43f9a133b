"""Recordings of message version 1 stay readable: their numbers are those read when they were made.

``data/version_1/<name>.json`` is the summary that the version of that time wrote. Its keys stay;
the tables below say where each value is found today.
"""

from __future__ import annotations

import json
import math
import tarfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from derail_ros.recording.reader import read_bag
from derail_ros.recording.recomputation import collect, recompute
from derail_ros.recording.recorded_run import RecordedRun
from derail_ros.recording.repair import repair
from derail_ros.recording.storage import open_bag
from derail_ros.vocabulary.events import Collision, Event, EventKind
from derail_ros.vocabulary.measures import outcome_record
from derail_ros.vocabulary.outcome import Outcome
from derail_ros.vocabulary.severity import severity

DATA = Path(__file__).parent / "data" / "version_1"
NAMES = ("simulated_curve", "node_curve_commands", "pile_sqlite")

OUTCOME: dict[str, Callable[[Outcome], Any]] = {
    "status": lambda o: o.status,
    "final": lambda o: o.final,
    "void": lambda o: o.void,
    "time_s": lambda o: o.time,
    "duration_s": lambda o: o.duration,
    "cars_derailed": lambda o: o.cars_derailed,
    "derailed_cars": lambda o: o.derailed_cars,
    "peak_force_N": lambda o: o.peak_force,
    "peak_force_pair": lambda o: o.peak_force_pair,
    "peak_force_time_s": lambda o: o.peak_force_time,
    "peak_resultant_N": lambda o: o.peak_resultant,
    "scene_length_m": lambda o: o.scene_length,
    "scene_width_m": lambda o: o.scene_width,
    "scene_area_m2": lambda o: o.scene_area,
    "cars_above_5MN": lambda o: o.cars_above_5MN,
    "cars_above_10MN": lambda o: o.cars_above_10MN,
    "rear_part_first_car": lambda o: o.rear_part_first_car or None,
    "rear_part_stopped_at_m": lambda o: o.rear_stop,
    "max_coupler_gap_m": lambda o: o.max_coupler_gap,
    "energy_residual": lambda o: o.energy_residual,
    "severity": severity,
}
COLLISION: dict[str, Callable[[Collision], Any]] = {
    "id": lambda c: c.id,
    "final": lambda c: c.final,
    "striking_car": lambda c: c.car_a,
    "struck_car": lambda c: c.car_b,
    "corner": lambda c: c.touch,
    "start_s": lambda c: c.start,
    "end_s": lambda c: c.end,
    "peak_force_N": lambda c: c.peak_force,
    "peak_time_s": lambda c: c.peak_time,
    "peak_resultant_N": lambda c: c.peak_resultant,
    "closing_speed_m_s": lambda c: c.closing_speed,
    "angle_deg": lambda c: math.degrees(c.angle),
    "x_m": lambda c: c.x,
    "y_m": lambda c: c.y,
    "energy_taken_J": lambda c: c.energy_lost,
}
CAUSES = {"scenario": "initial"}
"""Causes that are named otherwise today."""
EVENT: dict[str, Callable[[Event], Any]] = {
    "kind": lambda e: e.kind.word,
    "cars": lambda e: list(e.cars),
    "cause": lambda e: e.cause,
    "time_s": lambda e: e.time,
    "x_m": lambda e: e.x,
    "y_m": lambda e: e.y,
    "track_m": lambda e: e.track_coordinate,
    "speed_m_s": lambda e: e.speed,
}
ENERGY = {
    "work_brakes": "brakes",
    "work_ground_trucks": "ground_trucks",
    "work_ground_body": "ground_body",
    "work_collisions": "collisions",
    "work_striker_dampers": "striker_dampers",
    "work_knuckles_released": "knuckles_released",
}
MERGED = ("collision", "brake_signal_reached", "car_at_rest")
"""Entries of the summary's timeline that are not one event each."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recordings, unpacked."""
    place = tmp_path_factory.mktemp("version_1")
    with tarfile.open(DATA / "recordings.tar.xz") as archive:
        archive.extractall(place)
    return place


@pytest.fixture(scope="module", params=NAMES)
def name(request: pytest.FixtureRequest) -> str:
    """Name of a recording."""
    return str(request.param)


@pytest.fixture(scope="module")
def run(folder: Path, name: str) -> RecordedRun:
    """A recording as arrays."""
    return read_bag(folder / name)


@pytest.fixture(scope="module")
def expected(name: str) -> dict[str, Any]:
    """The summary written when it was made."""
    value: dict[str, Any] = json.loads((DATA / f"{name}.json").read_text(encoding="utf-8"))
    return value


def check(found: Any, row: dict[str, Any], table: dict[str, Callable[[Any], Any]]) -> None:
    """Compare the values of an object with those of a row of the summary."""
    for key, read in table.items():
        value, old = read(found), row[key]
        if old is None:
            assert value is None or math.isnan(value), key
        elif isinstance(old, list):
            assert list(value) == old, key
        elif isinstance(old, float):
            assert value == pytest.approx(old, rel=1e-12, abs=1e-12), key
        else:
            assert value == old, key


def test_outcome(run: RecordedRun, expected: dict[str, Any]) -> None:
    assert run.warnings == ()
    check(run.outcome, expected["outcome"], OUTCOME)


def test_where_the_run_comes_from(run: RecordedRun, expected: dict[str, Any]) -> None:
    recording, scenario = expected["recording"], expected["scenario"]
    assert (run.storage, run.run_id) == (recording["storage"], recording["run_id"])
    assert list(run.run_ids) == recording["runs"] and run.software == recording["software"]
    assert len(run.time) == recording["states"]
    assert (run.time[0], run.time[-1]) == (recording["first_s"], recording["last_s"])
    assert (run.name, run.title, run.scenario_hash) == (
        scenario["name"],
        scenario["title"],
        scenario["hash"],
    )
    assert (run.n, run.initial_speed) == (scenario["bodies"], scenario["initial_speed_m_s"])


def test_collisions(run: RecordedRun, expected: dict[str, Any]) -> None:
    rows = {row["id"]: row for row in expected["collisions"]}
    assert len(run.collisions) == len(rows)
    for collision in run.collisions:
        check(collision, rows[collision.id], COLLISION)


def test_events(run: RecordedRun, expected: dict[str, Any]) -> None:
    events = [e for e in run.events if e.kind.word not in MERGED]
    rows = [row for row in expected["timeline"] if row["kind"] not in MERGED]
    order = [(row["time_s"], row["kind"], row["cars"]) for row in rows]
    assert len(events) == len(rows)
    for event in events:
        row = rows[order.index((event.time, event.kind.word, list(event.cars)))]
        check(event, row | {"cause": CAUSES.get(row["cause"], row["cause"])}, EVENT)
    signals = [e for e in run.events if e.kind == EventKind.BRAKE_SIGNAL_REACHED]
    (merged,) = [r for r in expected["timeline"] if r["kind"] == "brake_signal_reached"] or [None]
    if merged is not None:
        assert sorted(e.cars[0] for e in signals) == merged["cars"]
        assert (signals[0].time, signals[-1].time) == (merged["time_s"], merged["until_s"])


def test_cars(run: RecordedRun, expected: dict[str, Any]) -> None:
    for i, row in enumerate(expected["cars"]):
        assert (run.cars.name[i], run.cars.kind[i]) == (row["name"], row["type"])
        assert run.plane[-1, i].tolist() == [row["end"][k] for k in ("x_m", "y_m", "yaw_rad")]
        assert run.outcome.car_peak_force[i] == row["peak_force_N"]
        assert (int(run.outcome.car_peak_other[i]) or None) == row["peak_force_from"]
        derailed = row["derailed"]
        if derailed is not None:
            assert run.outcome.derail_time[i] == derailed["time_s"]
            assert run.outcome.derail_speed[i] == derailed["speed_m_s"]
        rest = [
            e.time for e in run.events if e.kind == EventKind.CAR_AT_REST and e.cars == (i + 1,)
        ]
        assert rest[-1:] == ([] if row["at_rest"] is None else [row["at_rest"]["time_s"]])


def test_energy_and_commands(run: RecordedRun, expected: dict[str, Any]) -> None:
    for row in expected["stopped_by"]["shares"]:
        assert run.energy[ENERGY[row["entry"]]][-1] == row["energy_J"]
    taken = {ENERGY[row["entry"]]: row["energy_J"] for row in expected["stopped_by"]["shares"]}
    measures = outcome_record(run.outcome)
    for measure, entries in (
        ("share_brakes", ("brakes",)),
        ("share_ground", ("ground_trucks", "ground_body")),
        ("share_collisions", ("collisions",)),
    ):
        share = sum(taken[e] for e in entries) / measures["energy_initial_J"]
        assert measures[measure] == pytest.approx(share, rel=1e-12), measure
    assert list(run.commands) == expected["commands"]


def test_it_is_computed_again(folder: Path, name: str) -> None:
    """With its commands, to the same end; the bits are those of the machine that recorded it."""
    collector = collect(open_bag(folder / name))
    (found,) = recompute(collector.manifest(), collector.runs)
    assert found.status == ("time limit" if name == "simulated_curve" else "at rest")
    assert found.commands == (2 if name == "node_curve_commands" else 0)
    assert found.events and found.contacts is not None
    assert not [d for d in found.differences if d.startswith(("fails", "refuses", "ends '"))]


def test_it_is_repaired(folder: Path, name: str, run: RecordedRun, tmp_path: Path) -> None:
    """Without its metadata it is written anew, and reads as before."""
    broken = tmp_path / name
    broken.mkdir()
    for file in (folder / name).glob(f"*.{'db3' if name == 'pile_sqlite' else 'mcap'}"):
        (broken / file.name).write_bytes(file.read_bytes())
    whole = read_bag(repair(broken).path)
    assert (whole.pose == run.pose).all()
    assert [e.text for e in whole.events] == [e.text for e in run.events]
    assert whole.outcome.peak_force == run.outcome.peak_force
