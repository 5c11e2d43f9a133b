"""Times of messages as the recorder node takes them, from their bytes."""

from __future__ import annotations

import pytest
from rosbags.rosbag2 import Reader

from derail_ros.recording import record_run, recorder
from derail_ros.recording.listener import Listener, message_stamp
from msg_adapters.common import stamp_of, time_message
from msg_adapters.definitions import deserialize, message_class, serialize, typestore
from msg_adapters.topics import TOPICS
from tests.nodes.support import simulation, small
from tests.recording.doctor import faults


@pytest.fixture(scope="module")
def messages(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[str, bytes]]:
    """Names of topics and messages of a run."""
    path = tmp_path_factory.mktemp("listener") / "bag"
    record_run(simulation(), small(), path)
    with Reader(path) as reader:
        rows = [(c.topic.lstrip("/"), bytes(data)) for c, _, data in reader.messages()]
    return [row for row in rows if row[0] in TOPICS]


def test_the_time_of_a_message_is_that_of_its_header(messages) -> None:
    for name, data in messages:
        message = deserialize(data, TOPICS[name].msgtype)
        first = message.markers[0] if name.endswith("markers") else message
        assert message_stamp(TOPICS[name], data, -1) == stamp_of(first), name
    assert {name for name, _ in messages} >= {"markers", "train_state", "collisions", "outcome"}


@pytest.mark.parametrize("count", [1, 127, 224, 256, 331, 700])
@pytest.mark.parametrize("little", [True, False])
def test_markers_of_any_number(messages, count, little) -> None:
    """The bytes of the count are not those that tell the byte order."""
    kind = TOPICS["markers"].msgtype
    message = deserialize(next(d for name, d in messages if name == "markers"), kind)
    marker = message.markers[-1]
    marker.header.stamp = time_message(27_123_456_789)
    message.markers = [marker] * count
    data = bytes(typestore().serialize_cdr(message, kind, little_endian=little))
    assert message_stamp(TOPICS["markers"], data, -1) == 27_123_456_789


def test_an_array_without_markers_has_the_time_before_it() -> None:
    empty = message_class("visualization_msgs/msg/MarkerArray")(markers=[])
    assert message_stamp(TOPICS["markers"], serialize(empty), 5) == 5


def test_what_comes_in_disorder_is_written_by_time(messages, tmp_path, monkeypatch) -> None:
    """Topics come in no order among each other; of each topic they do."""
    monkeypatch.setattr(recorder, "LATE_WALL", 600.0)  # however busy the machine is
    topics = {f"/{name}": topic for name, topic in TOPICS.items() if not name.startswith("/")}
    listener = Listener(tmp_path / "bag", "mcap", topics)
    by_topic = sorted(messages, key=lambda row: TOPICS[row[0]].latched)
    for name, data in by_topic:
        listener.take(f"/{name}", data, {})
    listener.close()
    assert faults(tmp_path / "bag" / "bag.mcap") == []
    with Reader(tmp_path / "bag") as reader:
        first = [c.topic for c, _, _ in reader.messages()][:2]
        count = sum(c.msgcount for c in reader.connections if c.topic != "/manifest")
    assert set(first) == {"/consist", "/track"}
    assert count == len(messages)
