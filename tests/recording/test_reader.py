"""Recordings as arrays: they are what the engine computed; bad ones are told in a line."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import fields
from pathlib import Path
from typing import Any

import mcap.reader
import mcap.writer
import numpy as np
import pytest
import yaml
import zstandard
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer

from derail_ros.recording import run_messages as module
from derail_ros.recording.derived_outcome import derive_outcome
from derail_ros.recording.reader import read_bag
from derail_ros.recording.repair import repair
from derail_ros.recording.storage import (
    BagError,
    BagVersionError,
    NotABagError,
    OtherTopicsError,
    open_bag,
)
from msg_adapters.definitions import deserialize, read_copy, typestore
from tests.nodes.support import simulation

FINAL = (
    "pose",
    "velocity",
    "coupler_yaw",
    "truck_on",
    "coupled",
    "brake_force",
    "corner_force",
    "time",
)


@pytest.fixture(scope="module")
def engine():
    """The same run without a recording, at its end."""
    made = simulation()
    made.run()
    return made


def test_the_outcome_is_the_engines(run, engine) -> None:
    outcome = engine.outcome()
    assert run.outcome.final and run.outcome.status == "at rest"
    for field in fields(outcome):
        if field.name not in ("values", "car_values"):
            ours, theirs = getattr(run.outcome, field.name), getattr(outcome, field.name)
            np.testing.assert_equal(ours, theirs, err_msg=field.name)


def test_the_last_state_is_the_engines(run, engine) -> None:
    np.testing.assert_allclose(run.plane[-1], engine.sample().plane, atol=1e-6)
    assert run.n == 10
    assert np.array_equal(run.plane, run.pose[..., [0, 1, 5]])
    assert run.pose.shape == (len(run.time), 10, 6)
    assert run.coupled.shape == (len(run.time), 9)
    assert np.all(np.diff(run.time) > 0.0)
    assert not run.warnings


def test_every_message_is_there(run, bag) -> None:
    counts: dict[str, int] = {}
    last: dict[str, object] = {}
    with Reader(bag) as reader:
        for connection, _, data in reader.messages():
            counts[connection.topic] = counts.get(connection.topic, 0) + 1
            last[connection.topic] = deserialize(data, connection.msgtype)
    assert len(run.time) == counts["/train_state"]
    assert len(run.events) == counts["/events"]
    assert run.collisions and len(run.collisions) >= last["/collisions"].id + 1
    assert [e.time for e in run.events] == sorted(e.time for e in run.events)
    assert np.array_equal(run.pose[-1, :, 0], last["/train_state"].x)
    ledger = last["/energy"]
    assert run.ledger() == {q.key: q.values[0] for q in ledger.entries}


def test_both_storages_read_the_same(run, sqlite_bag) -> None:
    other = read_bag(sqlite_bag)
    assert other.storage == "sqlite3"
    for name in FINAL:
        assert np.array_equal(getattr(run, name), getattr(other, name)), name
    assert repr(run.events) == repr(other.events)
    assert run.collisions == other.collisions


def test_an_outcome_that_is_missing_is_worked_out(run) -> None:
    derived, told = derive_outcome(run), run.outcome
    assert derived.derailed_cars == told.derailed_cars
    assert derived.duration == told.duration
    assert derived.status == "at rest"
    assert derived.scene_length == pytest.approx(told.scene_length, abs=1e-6)
    assert derived.scene_width == pytest.approx(told.scene_width, abs=1e-6)
    np.testing.assert_allclose(derived.derail_time, told.derail_time, equal_nan=True)
    hit = told.car_peak_force >= 1e4
    np.testing.assert_allclose(derived.car_peak_force[hit], told.car_peak_force[hit])
    assert derived.peak_force_pair == told.peak_force_pair


def test_places_between_states_are_interpolated(run) -> None:
    k = len(run.time) // 3
    middle = run.pose_at(0.5 * (run.time[k] + run.time[k + 1]))
    np.testing.assert_allclose(middle, 0.5 * (run.pose[k] + run.pose[k + 1]))
    assert np.array_equal(run.pose_at(-5.0), run.pose[0])
    assert np.array_equal(run.pose_at(1e9), run.pose[-1])


def test_a_file_a_folder_and_a_folder_around_it_are_found(run, bag, tmp_path) -> None:
    file = next(bag.glob("*.mcap"))
    for place in (bag, file, bag / "metadata.yaml"):
        assert len(read_bag(place).time) == len(run.time)
    shutil.copyfile(file, tmp_path / "alone.mcap")
    alone = read_bag(tmp_path / "alone.mcap")
    assert np.array_equal(alone.pose, run.pose)
    assert not alone.warnings
    shutil.copytree(bag, tmp_path / "results" / "recording")
    assert len(read_bag(tmp_path / "results").time) == len(run.time)


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize("place", ["file", "folder"])
def test_compressed_as_a_file(run, bag, sqlite_bag, tmp_path, storage, place) -> None:
    """As rosbag2 writes it with ``--compression-mode file --compression-format zstd``."""
    source = bag if storage == "mcap" else sqlite_bag
    (file,) = [f for f in source.iterdir() if f.suffix in (".mcap", ".db3")]
    packed = tmp_path / f"{file.name}.zstd"
    packed.write_bytes(zstandard.compress(file.read_bytes()))
    if place == "folder":
        info = yaml.safe_load((source / "metadata.yaml").read_text())
        inner = info["rosbag2_bagfile_information"]
        inner |= {"compression_mode": "FILE", "compression_format": "zstd"}
        inner["relative_file_paths"] = [packed.name]
        (tmp_path / "metadata.yaml").write_text(yaml.safe_dump(info))
    found = read_bag(packed if place == "file" else tmp_path)
    assert found.storage == storage and found.size == packed.stat().st_size
    assert np.array_equal(found.pose, run.pose)
    assert found.path == (packed if place == "file" else tmp_path)
    assert not found.warnings


def test_a_compressed_file_that_is_cut_off(run, bag, tmp_path) -> None:
    data = zstandard.compress(next(bag.glob("*.mcap")).read_bytes())
    (tmp_path / "cut.mcap.zstd").write_bytes(data[: len(data) // 2])
    found = read_bag(tmp_path / "cut.mcap.zstd")
    assert 0 < len(found.time) < len(run.time)
    assert np.array_equal(found.pose, run.pose[: len(found.time)])
    whole = repair(tmp_path / "cut.mcap.zstd")
    assert whole.path == tmp_path / "cut_repaired"
    assert np.array_equal(read_bag(whole.path).pose, found.pose)


def test_each_message_compressed(run, bag, tmp_path) -> None:
    path = tmp_path / "messages"
    writer = Writer(path, version=8, storage_plugin=StoragePlugin.SQLITE3)
    writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    topics: dict[str, Any] = {}
    with writer:
        for topic, msgtype, stamp, data in rows_of(bag):
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, msgtype, typestore=typestore())
            writer.write(topics[topic], stamp, data)
    assert np.array_equal(read_bag(path).pose, run.pose)


@pytest.mark.parametrize("compression", list(mcap.writer.CompressionType))
@pytest.mark.parametrize("kind", ["indexed", "without index", "without chunks", "cut off"])
def test_mcap_as_others_write_it(run, bag, tmp_path, compression, kind) -> None:
    file = tmp_path / "other.mcap"
    writer = mcap.writer.Writer(
        str(file),
        compression=compression,
        use_chunking=kind != "without chunks",
        use_summary_offsets=kind == "indexed",
        use_statistics=kind == "indexed",
        repeat_channels=kind == "indexed",
        repeat_schemas=kind == "indexed",
        index_types=mcap.writer.IndexType.ALL if kind == "indexed" else mcap.writer.IndexType.NONE,
    )
    writer.start("ros2", "another recorder")
    topics = {}
    for topic, msgtype, stamp, data in rows_of(bag):
        if topic not in topics:
            schema = writer.register_schema(
                msgtype, "ros2msg", read_copy().get(msgtype, "").encode()
            )
            topics[topic] = writer.register_channel(topic, "cdr", schema)
        writer.add_message(topics[topic], stamp, data, stamp)
    writer.finish()
    if kind == "cut off":
        data = file.read_bytes()
        file.write_bytes(data[: 2 * len(data) // 3])
    found = read_bag(file)
    assert np.array_equal(found.pose, run.pose[: len(found.time)])
    if kind == "cut off":
        assert any("derail repair" in w for w in found.warnings)
        assert len(found.time) > 0.5 * len(run.time)
    else:
        assert len(found.time) == len(run.time) and not found.warnings


# --- bad ones --------------------------------------------------------------------------------


def test_what_is_not_a_recording_is_told(tmp_path) -> None:
    text = tmp_path / "text.mcap"
    text.write_text("not a recording")
    empty = tmp_path / "empty.mcap"
    empty.touch()
    magic = tmp_path / "magic.mcap"
    magic.write_bytes(b"\x89MCAP0\r\n")
    folder = tmp_path / "folder"
    folder.mkdir()
    (tmp_path / "sqlite.db3").write_bytes(b"SQLite format 3\0" + bytes(100))
    broken = tmp_path / "broken"
    broken.mkdir()
    (broken / "metadata.yaml").write_text("rosbag2_bagfile_information: [1, 2")
    for place in (text, empty, magic, folder, tmp_path / "no", tmp_path / "sqlite.db3", broken):
        with pytest.raises(NotABagError) as caught:
            read_bag(place)
        assert str(place.name) in str(caught.value)
        assert "\n" not in str(caught.value)


def write_bag(path: Path, rows, storage=StoragePlugin.MCAP) -> Path:
    store = typestore()
    with Writer(path, version=9, storage_plugin=storage) as writer:
        connections = {}
        for topic, msgtype, stamp, data in rows:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, msgtype, typestore=store)
            writer.write(connections[topic], stamp, data)
    return path


def rows_of(bag: Path):
    with Reader(bag) as reader:
        return [(c.topic, c.msgtype, t, bytes(d)) for c, t, d in reader.messages()]


def chunks_of(file: Path) -> list[Any]:
    """What the index of an MCAP file says of its chunks."""
    with file.open("rb") as stream:
        summary = mcap.reader.make_reader(stream).get_summary()
    assert summary is not None
    return sorted(summary.chunk_indexes, key=lambda c: c.chunk_start_offset)


def test_a_stray_file_beside_a_recording_is_told(run, bag, tmp_path) -> None:
    folder = tmp_path / "mixed"
    folder.mkdir()
    shutil.copyfile(next(bag.glob("*.mcap")), folder / "a.mcap")
    (folder / "b.mcap").write_text("something else")
    found = read_bag(folder)
    assert found.run_id == run.run_id
    assert any("b.mcap is not a recording" in w for w in found.warnings)


def test_other_topics_are_told(tmp_path) -> None:
    text = typestore().types["std_msgs/msg/String"]("hello")
    data = bytes(typestore().serialize_cdr(text, "std_msgs/msg/String"))
    path = write_bag(tmp_path / "other", [("/chatter", "std_msgs/msg/String", 1, data)])
    with pytest.raises(OtherTopicsError, match="/chatter"):
        read_bag(path)


def test_another_version_is_told(bag, tmp_path, monkeypatch) -> None:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    name = "derail_msgs/msg/TrainState"
    text = read_copy()[name].replace("INTERFACE_VERSION=2", "INTERFACE_VERSION=3")
    text += "float64[] something_new\n"
    store = get_typestore(Stores.ROS2_KILTED)
    quantity = "derail_msgs/msg/Quantity"
    store.register(get_types_from_msg(read_copy()[quantity], quantity))
    store.register(get_types_from_msg(text, name))
    path = tmp_path / "new"
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/train_state", name, typestore=store)
        writer.write(connection, 1, b"\0\1\0\0" + bytes(64))
    with pytest.raises(BagVersionError, match="version 3"):
        read_bag(path)


def test_a_recording_without_a_consist_or_states_is_told(bag, tmp_path) -> None:
    rows = rows_of(bag)
    without = [r for r in rows if r[0] != "/consist"]
    with pytest.raises(OtherTopicsError, match="consist"):
        read_bag(write_bag(tmp_path / "a", without))
    without = [r for r in rows if r[0] != "/train_state"]
    with pytest.raises(OtherTopicsError, match="states"):
        read_bag(write_bag(tmp_path / "b", without))


def test_what_can_be_done_without_is_a_warning(run, bag, tmp_path) -> None:
    optional = ("/track", "/energy", "/coupler_states", "/outcome", "/manifest", "/markers")
    rows = [r for r in rows_of(bag) if r[0] not in optional]
    dropped = [k for k, r in enumerate(rows) if r[0] == "/events"][3:5]
    rows = [r for k, r in enumerate(rows) if k not in dropped]
    found = read_bag(write_bag(tmp_path / "poor", rows))
    said = "; ".join(found.warnings)
    for words in ("no track", "no energy ledger", "no coupler states", "2 events are missing"):
        assert words in said
    assert np.array_equal(found.coupled[-1], run.coupled[-1])
    assert found.outcome.derailed_cars == run.outcome.derailed_cars
    assert not found.energy


@pytest.mark.parametrize(
    ("n", "said"), [(1, "1 state is missing ("), (5, "5 states are missing (")]
)
def test_states_that_are_missing_are_counted(bag, tmp_path, n, said) -> None:
    rows = rows_of(bag)
    which = [k for k, r in enumerate(rows) if r[0] == "/train_state"][100 : 100 + n]
    found = read_bag(
        write_bag(tmp_path / "gaps", [r for k, r in enumerate(rows) if k not in which])
    )
    assert any(said in w for w in found.warnings)


def test_messages_that_are_rubbish_are_left_out(run, bag, tmp_path) -> None:
    rows = [
        (t, m, s, d[:40] if t == "/energy" and k % 7 == 0 else d)
        for k, (t, m, s, d) in enumerate(rows_of(bag))
    ]
    found = read_bag(write_bag(tmp_path / "rubbish", rows))
    assert any("cannot be read" in w for w in found.warnings)
    assert len(found.time) == len(run.time)


@pytest.mark.parametrize("share", [0.3, 0.6, 0.95])
def test_a_file_that_is_cut_off_gives_what_is_left(run, bag, tmp_path, share) -> None:
    data = next(bag.glob("*.mcap")).read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: int(share * len(data))])
    found = read_bag(tmp_path / "cut.mcap")
    assert 0 < len(found.time) <= len(run.time)
    assert np.array_equal(found.pose, run.pose[: len(found.time)])
    said = "; ".join(found.warnings)
    assert "derail repair" in said
    assert "cut off" in said


@pytest.mark.parametrize("filling", [0x00, 0xFF])
def test_a_damaged_middle_ends_in_arrays_or_a_line(run, bag, tmp_path, filling) -> None:
    copy = tmp_path / "damaged"
    shutil.copytree(bag, copy)
    file = next(copy.glob("*.mcap"))
    data = bytearray(file.read_bytes())
    for k in range(1, 8):  # what is compressed has no checksum: not every damage can be seen
        middle = k * len(data) // 8
        data[middle : middle + 3000] = bytes([filling]) * 3000
    file.write_bytes(data)
    try:
        found = read_bag(copy)
    except BagError as error:
        assert "\n" not in str(error)
    else:
        assert found.warnings
        assert len(found.time) < len(run.time)


def test_behind_a_broken_record_the_index_leads_on(run, bag, tmp_path) -> None:
    shutil.copytree(bag, tmp_path / "damaged")
    (file,) = (tmp_path / "damaged").glob("*.mcap")
    chunks = chunks_of(file)
    data = bytearray(file.read_bytes())
    start = chunks[0].chunk_start_offset
    data[start + 1 : start + 9] = b"\xff" * 8  # the length of the first chunk
    file.write_bytes(data)
    whole = repair(tmp_path / "damaged")
    assert any("damaged at byte" in w for w in whole.warnings)
    kept = open_bag(whole.path).span()
    assert kept is not None and kept[1] == chunks[-1].message_end_time


def test_any_cut_ends_in_arrays_or_a_line(bag, tmp_path) -> None:
    data = next(bag.glob("*.mcap")).read_bytes()
    place = tmp_path / "cut.mcap"
    random = np.random.default_rng(5)
    for length in [0, 1, 8, 9, 20, 60, 300, *random.integers(300, len(data), 12)]:
        place.write_bytes(data[: int(length)])
        try:
            assert len(read_bag(place).time)
        except BagError as error:
            assert str(error)


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_killed_writer_leaves_what_can_be_read_and_made_whole(run, tmp_path, storage) -> None:
    script = f"""
import os, sys, time
from derail_ros.recording.recorder import RunRecorder
from rosbags.rosbag2 import Reader
recorder = RunRecorder({str(tmp_path / "killed")!r}, {storage!r})
with Reader({str(run.path)!r}) as reader:
    rows = [(c.topic, t, bytes(d)) for c, t, d in reader.messages()]
for topic, stamp, data in rows[: len(rows) // 2]:
    recorder.write(topic, stamp, data)
sizes = [0]
while sizes[-1] < 50_000 or sizes[-1] != sizes[-2]:  # all of it has reached the disk
    time.sleep(1.0)
    sizes.append(sum(f.stat().st_size for f in recorder.path.iterdir()))
for topic, stamp, data in rows[len(rows) // 2 : -100]:
    recorder.write(topic, stamp, data)
print("written", flush=True)
time.sleep(60)
"""
    process = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stdout.readline().strip() == b"written"
    time.sleep(0.1)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    before = {f.name: f.read_bytes() for f in (tmp_path / "killed").iterdir()}
    found = read_bag(tmp_path / "killed")
    assert len(found.time) >= 0.4 * len(run.time)
    assert np.array_equal(found.pose, run.pose[: len(found.time)])
    assert not found.outcome.final
    assert found.outcome.status == "cut off"
    done = repair(tmp_path / "killed")
    assert open_bag(done.path).intact
    whole = read_bag(done.path)
    assert np.array_equal(whole.pose, found.pose)
    assert repr(whole.events) == repr(found.events)
    with Reader(done.path) as reader:
        qos = {c.topic: c.ext.offered_qos_profiles[0].durability.name for c in reader.connections}
    assert qos["/consist"] == "TRANSIENT_LOCAL"
    assert qos["/train_state"] == "VOLATILE"
    after = {f.name: f.read_bytes() for f in (tmp_path / "killed").iterdir()}
    assert before == after, "the old one stays as it is"
    with pytest.raises(BagError, match="exists already"):
        repair(tmp_path / "killed")


def test_nothing_to_repair_and_nothing_written(bag, tmp_path, capsys) -> None:
    from derail_ros.cli import main

    shutil.copytree(bag, tmp_path / "out" / "recording")
    for more in ([], ["-o", str(tmp_path / "new")]):
        assert main(["repair", str(tmp_path / "out"), *more]) == 0
        assert "nothing to repair" in capsys.readouterr().out
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["recording"]
    assert not (tmp_path / "new").exists()
    # Index and metadata are there, but a part of it is damaged: the rest is worth having.
    (file,) = (tmp_path / "out" / "recording").glob("*.mcap")
    chunk = chunks_of(file)[0]
    data = bytearray(file.read_bytes())
    middle = chunk.chunk_start_offset + chunk.chunk_length // 2
    data[middle : middle + 64] = bytes(64)
    file.write_bytes(data)
    assert main(["repair", str(tmp_path / "out")]) == 0
    said = capsys.readouterr()
    assert ": nothing to repair" not in said.out and "damaged" in said.err
    whole = repair(tmp_path / "out" / "recording_repaired")
    assert whole.was_whole and 0 < sum(whole.counts.values()) < sum(repair(bag).counts.values())


# --- several runs, several trains, long ones -------------------------------------------------


def two_runs(bag: Path, path: Path) -> Path:
    """The same run twice, the second one later and under another identity."""
    store = typestore()
    rows = rows_of(bag)
    end = rows[-1][2] + 1_000_000_000
    second = []
    for topic, msgtype, stamp, data in rows:
        if msgtype.startswith("derail_msgs"):
            message = store.deserialize_cdr(data, msgtype)
            message.run_id = "second" + message.run_id
            data = bytes(store.serialize_cdr(message, msgtype))
            second.append((topic, msgtype, stamp + end, data))
    return write_bag(path, rows + second)


def test_of_several_runs_the_last_is_read_or_the_one_named(run, bag, tmp_path) -> None:
    path = two_runs(bag, tmp_path / "two")
    found = read_bag(path)
    assert found.run_id.startswith("second")
    assert any("2 runs" in w for w in found.warnings)
    assert read_bag(path, 1).run_id == run.run_id
    assert read_bag(path, "-2").run_id == run.run_id
    assert read_bag(path, "secon").run_id == found.run_id
    assert np.array_equal(read_bag(path, 1).pose, run.pose)
    for wrong in (3, 0, "nothing"):
        with pytest.raises(OtherTopicsError):
            read_bag(path, wrong)


def test_trains_in_namespaces(run, bag, tmp_path) -> None:
    rows = rows_of(bag)
    rows = [(f"/{n}{t}", m, s, d) for n in ("one", "two") for t, m, s, d in rows]
    path = write_bag(tmp_path / "both", sorted(rows, key=lambda r: r[2]))
    found = read_bag(path)
    assert any("several trains" in w for w in found.warnings)
    assert len(read_bag(path, namespace="two").time) == len(run.time) == len(found.time)
    with pytest.raises(OtherTopicsError, match="/one"):
        read_bag(path, namespace="three")


def test_of_long_runs_some_states_are_kept_and_all_events(run, bag, monkeypatch) -> None:
    monkeypatch.setattr(module, "BUDGET", 1)
    found = read_bag(bag)
    assert found.thinned > 1
    assert 100 <= len(found.time) <= 202
    assert found.time[-1] == run.time[-1]
    assert repr(found.events) == repr(run.events)
    assert any("long" in w for w in found.warnings)
