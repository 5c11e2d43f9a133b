"""Recordings: whole, latched topics first, readable by others, and never in silence incomplete."""

from __future__ import annotations

import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import yaml
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from mcap_ros2.decoder import DecoderFactory
from rosbags.interfaces import QosDurability
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from derail_ros.engine import PlanarSimulation
from derail_ros.recording import (
    Manifest,
    RecordingError,
    RunRecorder,
    read_manifest,
    record_run,
)
from derail_ros.recording.manifest import CUSTOM_DATA
from derail_ros.recording.recorder import absolute, recorded_topics
from derail_ros.scenario import loads_scenario
from derail_ros.vocabulary.errors import SimulationError
from msg_adapters import reports
from msg_adapters.common import TIME_ZERO, stamp_of
from msg_adapters.definitions import deserialize, serialize
from msg_adapters.topics import STATE_TOPICS, TOPICS
from tests.nodes.support import OFF_THE_TRACK, small


def read(bag: Path) -> dict[str, list[tuple[int, object]]]:
    """All messages of a recording, decoded, by topic."""
    found: dict[str, list[tuple[int, object]]] = {}
    with Reader(bag) as reader:
        for connection in reader.connections:
            found.setdefault(connection.topic, [])
        for connection, stamp, data in reader.messages():
            found[connection.topic].append((stamp, deserialize(data, connection.msgtype)))
    return found


@pytest.fixture(scope="module", params=["mcap", "sqlite3"])
def recorded(request, tmp_path_factory) -> tuple[Path, Manifest, PlanarSimulation]:
    """A small run recorded from beginning to end."""
    scenario = small()
    simulation = PlanarSimulation(scenario.to_params())
    path = tmp_path_factory.mktemp(request.param) / "bag"
    calls: list[float] = []
    manifest = record_run(
        simulation,
        scenario,
        path,
        storage=request.param,
        progress=lambda sim: calls.append(sim.time),
    )
    assert calls[-1] == simulation.time
    return path, manifest, simulation


def test_every_topic_is_there_without_gaps(recorded) -> None:
    path, manifest, simulation = recorded
    found = read(path)
    assert set(found) == set(recorded_topics())
    ticks = len(found["/train_state"])
    for name in STATE_TOPICS:
        stamps = [stamp for stamp, _ in found["/" + name]]
        assert stamps == [TIME_ZERO + 20_000_000 * k for k in range(ticks)]
        assert all(stamp == stamp_of(message) for stamp, message in found["/" + name])
    assert 0.0 <= 0.02 * (ticks - 1) - simulation.time < 0.02
    assert len(found["/markers"]) == pytest.approx(15 * simulation.time, abs=2)
    assert len(found["/outcome"]) == int(simulation.time) + 2
    assert {name: len(messages) for name, messages in found.items()} == manifest.messages


def test_times_are_those_of_the_headers(recorded) -> None:
    """Also of a contact's peak, which is known only when it has passed."""
    path, _, _ = recorded
    found = read(path)
    assert any(not message.final for _, message in found["/collisions"])
    for name, topic in TOPICS.items():
        if topic.recorded and topic.msgtype.startswith("derail_msgs/"):
            for stamp, message in found[f"/{name}"]:
                assert stamp == stamp_of(message), name


def test_events_and_contacts_are_those_of_the_engine(recorded) -> None:
    path, _, simulation = recorded
    found = read(path)
    events = [reports.event_from_message(m) for _, m in found["/events"]]
    assert events[0].kind.name == "RUN_LOADED"
    assert repr(events[1:]) == repr(simulation.events)
    assert [m.sequence for _, m in found["/events"]] == list(range(len(events)))
    final = {m.id: m for _, m in found["/collisions"] if m.final}
    assert [reports.collision_from_message(final[c.id]) for c in simulation.collisions] == list(
        simulation.collisions
    )
    assert found["/outcome"][-1][1].is_final


def test_messages_are_in_the_order_of_their_times(recorded) -> None:
    path = recorded[0]
    with Reader(path) as reader:
        stamps = [stamp for _, stamp, _ in reader.messages()]
    assert stamps == sorted(stamps)


def test_latched_topics_come_first_and_a_player_knows_them(recorded) -> None:
    path = recorded[0]
    topics = recorded_topics()
    with Reader(path) as reader:
        order = [c.topic for c in reader.connections]
        latched = [topics[name].latched for name in order]
        assert latched == sorted(latched, reverse=True)
        for connection in reader.connections:
            (qos,) = connection.ext.offered_qos_profiles
            expected = topics[connection.topic].latched
            assert (qos.durability is QosDurability.TRANSIENT_LOCAL) == expected
            assert qos.depth == topics[connection.topic].depth
        first = [c.topic for c, _, _ in reader.messages()][:4]
    assert set(first) == {"/manifest", "/consist", "/track", "/track_markers"}


def test_the_manifest_is_beside_and_inside(recorded) -> None:
    path, manifest, simulation = recorded
    beside = read_manifest(path)
    assert beside.to_json() == manifest.to_json()
    inside = read(path)["/manifest"][-1][1].data
    assert Manifest.from_json(inside).to_json() == manifest.to_json()
    metadata = yaml.safe_load((path / "metadata.yaml").read_text())
    custom = metadata["rosbag2_bagfile_information"]["custom_data"][CUSTOM_DATA]
    assert Manifest.from_json(custom).to_json() == manifest.to_json()
    run = beside.run
    assert run.final_state_hash == simulation.state_hash()
    assert run.status == "at rest" and run.scenario_hash.startswith("sha256:")
    assert run.outcome["derailed_cars"] == list(simulation.outcome().derailed_cars)
    assert {"derail_ros", "engine_hash", "python", "numpy", "numba", "llvmlite"} <= set(
        beside.software
    )


def test_the_manifest_repeats_the_run_to_the_bit(recorded) -> None:
    path, manifest, _ = recorded
    again = PlanarSimulation(loads_scenario(yaml.safe_dump(manifest.run.scenario)).to_params())
    again.run()
    assert again.state_hash() == manifest.run.final_state_hash
    text = read(path)["/consist"][0][1].scenario_yaml
    again = PlanarSimulation(loads_scenario(text).to_params())
    again.run()
    assert again.state_hash() == manifest.run.final_state_hash


def strangers_mcap(file: Path) -> Iterator[tuple[str, Any]]:
    """Topics and messages by mcap and mcap-ros2-support."""
    with file.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages():
            yield channel.topic, message


def strangers_sqlite(file: Path) -> Iterator[tuple[str, Any]]:
    """Topics and messages by sqlite3, with the definitions that are in the file."""
    types = get_typestore(Stores.EMPTY)
    with closing(sqlite3.connect(file)) as database:
        definitions = "SELECT topic_type, encoded_message_definition FROM message_definitions"
        for msgtype, text in database.execute(definitions):
            own, *others = text.split("=" * 80 + "\nMSG: ")
            types.register(
                {
                    name: fields
                    for part in [f"{msgtype.replace('/msg/', '/')}\n{own}", *others]
                    for head, _, body in [part.partition("\n")]
                    for name, fields in get_types_from_msg(
                        body, head.replace("/", "/msg/")
                    ).items()
                }
            )
        messages = (
            "SELECT name, type, data FROM messages JOIN topics ON topic_id = topics.id "
            "ORDER BY timestamp"
        )
        for topic, msgtype, data in database.execute(messages):
            yield topic, types.deserialize_cdr(data, msgtype)


def test_others_read_it_with_nothing_but_the_file(recorded) -> None:
    """MCAP by the libraries of its makers, SQLite by its own and by the definitions in it."""
    (file,) = (f for f in recorded[0].iterdir() if f.suffix in (".mcap", ".db3"))
    counts: dict[str, int] = {}
    for topic, message in (strangers_mcap if file.suffix == ".mcap" else strangers_sqlite)(file):
        counts[topic] = counts.get(topic, 0) + 1
        if topic == "/train_state":
            assert len(message.x) == 10 and len(message.corner_gap) == 40
    expected = {name: n for name, n in recorded[1].messages.items() if n}
    assert counts == expected


def test_what_is_computed_does_not_depend_on_the_recording(tmp_path) -> None:
    scenario = small()
    hashes = set()
    for k, (state_rate, marker_rate) in enumerate([(50.0, 15.0), (7.0, 0.0), (400.0, 60.0)]):
        simulation = PlanarSimulation(scenario.to_params())
        manifest = record_run(
            simulation, scenario, tmp_path / str(k), state_rate=state_rate, marker_rate=marker_rate
        )
        hashes.add(manifest.run.final_state_hash)
        assert (manifest.messages["/markers"] == 0) == (marker_rate == 0.0)
    bare = PlanarSimulation(scenario.to_params())
    bare.run()
    assert hashes == {bare.state_hash()}


def test_commands_are_in_the_manifest_and_repeat_the_run(tmp_path) -> None:
    from derail_ros.vocabulary.events import Command

    scenario = small()
    simulation = PlanarSimulation(scenario.to_params())
    simulation.trigger_emergency_brake(mode="instant")
    simulation.inject_rail_break(car=9)
    manifest = record_run(simulation, scenario, tmp_path / "bag")
    again = PlanarSimulation(scenario.to_params())
    for command in manifest.run.commands:
        again.apply(Command(**command))
    again.run()
    assert again.state_hash() == manifest.run.final_state_hash
    assert len(manifest.run.commands) == 2


def test_a_run_that_has_begun_already_is_refused(tmp_path) -> None:
    scenario = small()
    simulation = PlanarSimulation(scenario.to_params())
    simulation.advance_to(1.0)
    with pytest.raises(ValueError, match="at its start"):
        record_run(simulation, scenario, tmp_path / "bag")
    assert not (tmp_path / "bag").exists()


def test_a_failed_run_leaves_a_whole_recording(tmp_path) -> None:
    scenario = small(OFF_THE_TRACK)
    with pytest.raises(SimulationError):
        record_run(PlanarSimulation(scenario.to_params()), scenario, tmp_path / "bag")
    found = read(tmp_path / "bag")
    assert found["/events"][-1][1].kind_name == "run_failed"
    assert found["/outcome"][-1][1].status_name == "failed"
    assert read_manifest(tmp_path / "bag").run.status == "failed"


def test_an_interrupted_run_leaves_a_whole_recording(tmp_path) -> None:
    scenario = small()
    simulation = PlanarSimulation(scenario.to_params())

    def interrupt(sim: PlanarSimulation) -> None:
        raise KeyboardInterrupt

    original = PlanarSimulation.advance_to
    slow = lambda self, t: (time.sleep(0.02), original(self, t))[1]  # noqa: E731
    simulation.advance_to = slow.__get__(simulation)
    with pytest.raises(KeyboardInterrupt):
        record_run(simulation, scenario, tmp_path / "bag", progress=interrupt)
    assert read_manifest(tmp_path / "bag").run.status == "stopped"
    assert read(tmp_path / "bag")["/outcome"][-1][1].status_name == "stopped"


# --- the writer itself -----------------------------------------------------------------------

CLOCK = serialize(reports.string("x"))


def test_a_recording_is_never_overwritten(tmp_path) -> None:
    RunRecorder(tmp_path / "bag").close()
    with pytest.raises(RecordingError, match="exists already"):
        RunRecorder(tmp_path / "bag")


def test_an_unknown_storage_is_refused(tmp_path) -> None:
    with pytest.raises(RecordingError, match="storage must be one of mcap, sqlite3"):
        RunRecorder(tmp_path / "bag", "hdf5")


def test_a_place_that_cannot_be_written_is_told(tmp_path) -> None:
    blocker = tmp_path / "file"
    blocker.write_text("")
    with pytest.raises(RecordingError):
        RunRecorder(blocker / "bag")


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_an_error_while_writing_is_told_and_not_swallowed(tmp_path, storage) -> None:
    recorder = RunRecorder(tmp_path / "bag", storage)

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    recorder._writer.write = full
    recorder.write("/manifest", 0, CLOCK)
    with pytest.raises(RecordingError, match="No space left"):
        for k in range(1000):
            recorder.write("/manifest", k, CLOCK)
            time.sleep(0.005)
    with pytest.raises(RecordingError):
        recorder.close()


def test_nothing_is_lost_when_the_writer_is_slow(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("derail_ros.recording.recorder.QUEUE_SIZE", 10)
    recorder = RunRecorder(tmp_path / "bag")
    original = recorder._writer.write
    recorder._writer.write = lambda *a: (time.sleep(0.001), original(*a))
    for k in range(200):
        recorder.write("/manifest", k, CLOCK)
    recorder.close()
    assert len(read(tmp_path / "bag")["/manifest"]) == 200


def test_an_empty_recording_opens(tmp_path) -> None:
    RunRecorder(tmp_path / "bag").close()
    assert not any(read(tmp_path / "bag").values())


def test_names_in_a_namespace() -> None:
    assert absolute("train_state") == "/train_state"
    assert absolute("train_state", "/a/b") == "/a/b/train_state"
    assert absolute("/clock", "/a") == "/clock"
    assert "/a/manifest" in recorded_topics("/a")


KILLED = """
import sys, time
from derail_ros.recording import RunRecorder
from msg_adapters import reports
from msg_adapters.definitions import serialize
data = serialize(reports.string("x"))
recorder = RunRecorder(sys.argv[1], sys.argv[2])
for k in range(100):
    recorder.write("/manifest", k, data)
print("written", flush=True)
time.sleep(60)
"""


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_what_a_killed_writer_had_for_a_second_is_there(tmp_path, storage) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", KILLED, str(tmp_path / "bag"), storage], stdout=subprocess.PIPE
    )
    assert process.stdout is not None
    assert process.stdout.readline() == b"written\n"
    file = tmp_path / "bag" / ("bag.mcap" if storage == "mcap" else "bag.db3")
    # The promise is a second; a busy machine takes longer. The writer itself does nothing more.
    while _messages(file, storage) < 100 and process.poll() is None:
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    assert _messages(file, storage) == 100


def _messages(file: Path, storage: str) -> int:
    """Messages that a scan finds in a file that was never closed."""
    if storage == "sqlite3":
        connection = sqlite3.connect(f"file:{file}?mode=ro", uri=True)
        try:
            return int(connection.execute("SELECT COUNT(*) FROM messages").fetchone()[0])
        except sqlite3.OperationalError:
            return 0
        finally:
            connection.close()
    count = 0
    with file.open("rb") as stream:
        try:
            for record in StreamReader(stream).records:
                count += type(record).__name__ == "Message"
        except Exception:  # the end of an unfinished file, whatever it looks like
            pass
    return count
