"""Files of recordings: field by field as rosbag2's sources read them, and sound as MCAP."""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml
from mcap.reader import make_reader
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import get_types_from_msg

from derail_ros.recording import record_run
from derail_ros.recording.files import full_text
from derail_ros.recording.recorder import recorded_topics
from derail_ros.recording.repair import repair
from derail_ros.recording.storage import open_bag
from msg_adapters.definitions import read_copy, typestore
from msg_adapters.topics import TOPICS, Topic
from tests.nodes.support import simulation, small
from tests.recording.doctor import faults


@pytest.fixture(scope="module", params=["mcap", "sqlite3"])
def bag(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small recording in each storage."""
    path = tmp_path_factory.mktemp(request.param) / "bag"
    record_run(simulation(), small(), path, storage=request.param)
    return path


def file_of(bag: Path) -> Path:
    return next(f for f in bag.iterdir() if f.suffix in (".mcap", ".db3"))


# --- metadata.yaml -----------------------------------------------------------------------------


def typed(node: dict[str, Any], **kinds: type) -> None:
    """Hold fields against the types that rosbag2 asks its parser for."""
    for name, kind in kinds.items():
        assert type(node[name]) is kind, f"{name}: {node[name]!r}"


def check_profile(text: str, topic: Topic) -> None:
    """A topic's profiles as rosbag2 before Jazzy reads them: a text with numbers in it."""
    (profile,) = yaml.safe_load(text)
    typed(profile, history=int, depth=int, reliability=int, durability=int, liveliness=int)
    typed(profile, avoid_ros_namespace_conventions=bool)
    # rmw_qos_*_policy_t: keep last, reliable, transient local or volatile, automatic.
    assert (profile["history"], profile["reliability"], profile["liveliness"]) == (1, 1, 1)
    assert profile["durability"] == (1 if topic.latched else 2)
    assert profile["depth"] == topic.depth
    for name in ("deadline", "lifespan", "liveliness_lease_duration"):
        # RMW_DURATION_INFINITE.
        assert profile[name] == {"sec": 9223372036, "nsec": 854775807}


def test_metadata_are_as_rosbag2_decodes_them(bag: Path) -> None:
    """Field by field by ``rosbag2_storage/yaml.hpp``, Humble's (version 5) and the present one."""
    info = yaml.safe_load((bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    typed(info, version=int, storage_identifier=str, message_count=int, ros_distro=str)
    typed(info, compression_format=str, compression_mode=str, custom_data=dict)
    # Version 9 writes the profiles as a list, at which Humble and Iron stop.
    assert info["version"] == 8
    assert info["storage_identifier"] == ("mcap" if file_of(bag).suffix == ".mcap" else "sqlite3")
    # Chunks are compressed inside MCAP; these two are of rosbag2's own compression.
    assert info["compression_format"] == info["compression_mode"] == ""
    assert all(type(v) is str for v in info["custom_data"].values())
    with Reader(bag) as reader:
        stamps = [(c.topic, stamp) for c, stamp, _ in reader.messages()]
    first, last = min(s for _, s in stamps), max(s for _, s in stamps)
    (file,) = info["files"]
    assert info["relative_file_paths"] == [file["path"]] == [file_of(bag).name]
    for node in (info, file):
        assert node["starting_time"] == {"nanoseconds_since_epoch": first}
        assert node["duration"] == {"nanoseconds": last - first}
        assert node["message_count"] == len(stamps)
    topics = recorded_topics()
    listed = info["topics_with_message_count"]
    assert [t["topic_metadata"]["name"] for t in listed] == [
        name for name, _ in sorted(topics.items(), key=lambda item: not item[1].latched)
    ]
    for entry in listed:
        about = entry["topic_metadata"]
        typed(about, name=str, type=str, offered_qos_profiles=str, type_description_hash=str)
        assert about["serialization_format"] == "cdr"
        assert about["type"] == topics[about["name"]].msgtype
        assert about["type_description_hash"] == typestore().hash_rihs01(about["type"])
        assert entry["message_count"] == sum(name == about["name"] for name, _ in stamps)
        check_profile(about["offered_qos_profiles"], topics[about["name"]])


@pytest.mark.ros
def test_hashes_of_types_are_those_of_the_built_messages() -> None:
    # A distribution's prefixes, or that of the wheels.
    prefixes = [*filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(":")), sys.prefix]
    for msgtype in {t.msgtype for t in TOPICS.values()}:
        package, _, name = msgtype.split("/")
        places = [Path(p) / "share" / package / "msg" / f"{name}.json" for p in prefixes]
        about = json.loads(next(p for p in places if p.exists()).read_text(encoding="utf-8"))
        hashes = {h["type_name"]: h["hash_string"] for h in about["type_hashes"]}
        assert typestore().hash_rihs01(msgtype) == hashes[msgtype]


# --- definitions -------------------------------------------------------------------------------


@pytest.mark.parametrize("msgtype", sorted({t.msgtype for t in TOPICS.values()}))
def test_definitions_are_whole_and_say_what_fields_mean(msgtype: str) -> None:
    text = full_text(msgtype)
    own, *others = text.split("=" * 80 + "\nMSG: ")
    if msgtype in read_copy():
        assert own.rstrip() == read_copy()[msgtype].rstrip(), "ours with their comments"
    parsed = get_types_from_msg(own, msgtype)
    for part in others:
        name, _, body = part.partition("\n")
        package, _, message = name.rpartition("/")
        parsed |= get_types_from_msg(body, f"{package}/msg/{message}")
    store = typestore()
    for name, (constants, fields) in parsed.items():
        known_constants, known_fields = store.fielddefs[name]
        assert [c[:2] for c in constants] == [c[:2] for c in known_constants]
        assert [f[0] for f in fields] == [f[0] for f in known_fields]


def test_the_file_alone_says_all_of_it(bag: Path, tmp_path: Path) -> None:
    """Profiles, hashes and definitions are in the file too, for who has nothing but it."""
    file = tmp_path / file_of(bag).name
    file.write_bytes(file_of(bag).read_bytes())
    topics = recorded_topics()
    if file.suffix == ".mcap":
        with file.open("rb") as stream:
            summary = make_reader(stream, validate_crcs=True).get_summary()
        assert summary is not None
        rows = [
            (c.topic, s.name, c.metadata["offered_qos_profiles"], c.metadata["topic_type_hash"])
            for c in summary.channels.values()
            for s in [summary.schemas[c.schema_id]]
        ]
        texts = {s.name: (s.encoding, s.data.decode()) for s in summary.schemas.values()}
        assert {c.message_encoding for c in summary.channels.values()} == {"cdr"}
    else:
        database = sqlite3.connect(file)
        rows = database.execute(
            "SELECT name, type, offered_qos_profiles, type_description_hash FROM topics"
        ).fetchall()
        found = database.execute(
            "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        )
        texts = {kind: (encoding, text) for kind, encoding, text in found}
        ((schema,),) = database.execute("SELECT schema_version FROM schema")
        ((version, inner),) = database.execute("SELECT metadata_version, metadata FROM metadata")
        assert (schema, version) == (4, 8)
        beside = yaml.safe_load((bag / "metadata.yaml").read_text())
        assert yaml.safe_load(inner) == beside["rosbag2_bagfile_information"]
        database.close()
    assert {row[0] for row in rows} == set(topics)
    for name, kind, profiles, digest in rows:
        assert kind == topics[name].msgtype and digest == typestore().hash_rihs01(kind)
        check_profile(profiles, topics[name])
        assert texts[kind] == ("ros2msg", full_text(kind))


# --- MCAP --------------------------------------------------------------------------------------


def test_the_file_is_sound(bag: Path, tmp_path: Path) -> None:
    if file_of(bag).suffix == ".db3":
        database = sqlite3.connect(file_of(bag))
        assert database.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
        database.close()
        return
    assert faults(file_of(bag)) == []
    shutil.copytree(bag, tmp_path / "cut")
    (tmp_path / "cut" / "metadata.yaml").unlink()
    repaired = repair(tmp_path / "cut", tmp_path / "again").path
    assert faults(file_of(repaired)) == []


def test_what_the_check_of_soundness_finds(tmp_path: Path) -> None:
    with Writer(tmp_path / "bag", version=8, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/a", "std_msgs/msg/String", typestore=typestore())
        writer.write(connection, 2, b"\0\1\0\0\1\0\0\0\0")
        writer.write(connection, 1, b"\0\1\0\0\1\0\0\0\0")
    found = faults(file_of(tmp_path / "bag"))
    assert any("no checksum" in text for text in found)
    assert any("order" in text for text in found)
    assert any("summary" in text for text in found)


def test_damage_in_a_chunk_is_noticed(tmp_path: Path) -> None:
    """Without compression every byte still unpacks: only the checksum tells."""
    path = tmp_path / "bag"
    record_run(simulation(), small(), path)
    file = file_of(path)
    with file.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    index = summary.chunk_indexes[len(summary.chunk_indexes) // 2]
    raw = bytearray(file.read_bytes())
    # The checksum itself, so that what is compressed still unpacks.
    raw[index.chunk_start_offset + 9 + 24] ^= 0xFF
    file.write_bytes(raw)
    whole = open_bag(path)
    list(whole.messages())
    assert any("crc" in text for text in whole.warnings)
    # Gone through from its beginning, only that part is left out.
    part = open_bag(path)
    part.intact = False
    stamps = [stamp for _, stamp, _ in part.messages()]
    assert any("crc" in text for text in part.warnings)
    assert stamps and max(stamps) == summary.statistics.message_end_time
    assert not any(index.message_start_time < s < index.message_end_time for s in stamps)
