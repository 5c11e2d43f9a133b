"""Times of messages as the recorder node takes them, from their bytes."""

from __future__ import annotations

import pytest
from rosbags.rosbag2 import Reader

from derail_ros.recording import listener as listener_module
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


def heard(listener: Listener, rows: list, who: int, number: int) -> None:
    """One message of the process ``who``, as the middleware brings it."""
    name, data = rows[number]
    identity = bytes([who] * 12) + bytes([list(TOPICS).index(name), 0, 0, 3])
    sent = sum(row[0] == name for row in rows[: number + 1])
    info = {"publisher_gid": {"data": identity}, "publication_sequence_number": sent}
    listener.take(f"/{name}", data, info)


def test_two_simulators_at_once_are_one_recording_and_no_loss(messages, tmp_path) -> None:
    """Their times run beside each other: neither makes the other's begin anew."""
    topics = {f"/{name}": topic for name, topic in TOPICS.items() if not name.startswith("/")}
    listener = Listener(tmp_path / "bag", "mcap", topics)
    late = len(messages) // 2
    for number in range(late, len(messages)):
        heard(listener, messages, 1, number)
        heard(listener, messages, 2, number - late)
    for number in range(late, len(messages)):
        heard(listener, messages, 2, number)
    listener.close()
    assert len(listener.closed) == 1
    report = listener.reports[0]
    assert all(counts["gaps"] == counts["lost"] == 0 for counts in report.values()), report


def test_a_simulator_that_takes_the_place_of_one_that_is_gone_begins_anew(
    messages, tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr(listener_module, "SILENCE", 0.0)
    topics = {f"/{name}": topic for name, topic in TOPICS.items() if not name.startswith("/")}
    listener = Listener(tmp_path / "bag", "mcap", topics)
    for number in range(len(messages)):
        heard(listener, messages, 1, number)
    other = [(name, data) for name, data in messages if name == "car_poses"]
    for number in range(len(other)):
        heard(listener, other, 2, number)
    listener.close()
    assert len(listener.closed) == 2


def test_topics_that_come_seconds_apart_are_of_one_recording(messages, tmp_path) -> None:
    """As they do at high speed factors: all poses, then all markers, then what has a run."""
    topics = {f"/{name}": topic for name, topic in TOPICS.items() if not name.startswith("/")}
    listener = Listener(tmp_path / "bag", "mcap", topics)
    order = {"car_poses": 0, "markers": 1}
    rows = sorted(messages, key=lambda row: order.get(row[0], 2))
    for number in range(len(rows)):
        heard(listener, rows, 1, number)
    listener.close()
    assert len(listener.closed) == 1
