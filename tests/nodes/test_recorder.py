"""The recorder node: whole recordings, nothing missed in silence."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest

pytest.importorskip("rclpy")
pytest.importorskip("derail_msgs")

from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.interfaces import QosDurability
from rosbags.rosbag2 import Reader

from derail_ros.nodes.recorder_node import chosen_topics
from derail_ros.recording import read_manifest
from derail_ros.recording.listener import Listener
from derail_ros.recording.storage import BagError, open_bag
from msg_adapters.common import TIME_ZERO
from msg_adapters.definitions import deserialize
from msg_adapters.topics import LIVE_TOPICS, ON_MAP, STATE_TOPICS, TOPICS
from tests.nodes.graph import DEEP, LIMIT_COMPILING, graph
from tests.nodes.support import SMALL

pytestmark = pytest.mark.ros


@pytest.fixture
def scenarios(tmp_path) -> Path:
    """A folder with a small scenario."""
    folder = tmp_path / "scenarios"
    folder.mkdir()
    (folder / "small.yaml").write_text(SMALL)
    return folder


def contents(bag: Path) -> dict[str, list[tuple[int, bytes]]]:
    found: dict[str, list[tuple[int, bytes]]] = {}
    with Reader(bag) as reader:
        for connection, stamp, data in reader.messages():
            found.setdefault(connection.topic, []).append((stamp, data))
    return found


def on_disk(bag: Path) -> set[str]:
    """Topics with messages in a recording that is still being written."""
    try:
        return {channel.name for channel, _, _ in open_bag(bag).messages()}
    except BagError:
        return set()


def test_what_it_hears_is_what_the_simulator_records(tmp_path, scenarios) -> None:
    """The same bytes at the same times on every topic, from the first message to the last."""
    with graph(tmp_path) as made:
        heard = made.start(
            "recorder", path=tmp_path / "heard", stop_when_final=True, topics="[all]"
        )
        simulator = made.simulator(
            ready=False,
            scenario="small",
            scenario_dirs=f"['{scenarios}']",
            speed_factor=20.0,
            await_listeners=1,
            auto_exit=True,
            record=tmp_path / "own",
            record_all=True,
            odometry="1-2",
            **DEEP,
        )
        assert simulator.wait() == 0, simulator.output
        assert heard.wait() == 0, heard.output
    assert "no message missed" in heard.output
    assert "Traceback" not in heard.output + simulator.output
    first, second = contents(tmp_path / "heard"), contents(tmp_path / "own")
    for topic in TOPICS.values():
        name = f"/{topic.name}"
        if topic.recorded and topic.name != "markers":
            heard_bytes, own_bytes = first.get(name, []), second.get(name, [])
            assert len(heard_bytes) == len(own_bytes), name
            for (at, a), (own_at, b) in zip(heard_bytes, own_bytes):
                assert at == own_at, name
                # On the wire a message is filled up to a multiple of four bytes.
                assert a[: len(b)] == b and len(a) - len(b) < 4, name
    for name in STATE_TOPICS:
        assert [stamp for stamp, _ in first[f"/{name}"]] == [
            TIME_ZERO + 20_000_000 * k for k in range(len(first[f"/{name}"]))
        ]
    # What is asked for besides: latched ones as they are, frames and joints of the same moments.
    for name in ("/robot_description", "/tf_static"):
        assert [a for _, a in first[name]] and len(first[name]) == len(second[name]) == 1
    for name in ("/tf", "/joint_states"):
        assert [at for at, _ in first[name]] == [at for at, _ in second[name]], name
        assert len(first[name]) == len(first["/train_state"])
    for name in ("/car_1/odometry", "/car_2/odometry"):
        own_stamps = [at for at, _ in second[name]]
        assert {at for at, _ in first[name]} <= set(own_stamps) and own_stamps[0] == TIME_ZERO
    # Diagnostics come once a second of wall time: not in every run as short as this.
    assert "/markers" in first
    last = first["/train_state"][-1][0]
    for name, messages in first.items():
        assert all(0 <= stamp <= last for stamp, _ in messages), name
    heard_run, own_run = read_manifest(tmp_path / "heard").run, read_manifest(tmp_path / "own").run
    assert heard_run.run_id == own_run.run_id
    assert heard_run.scenario == own_run.scenario
    assert heard_run.status == own_run.status == "at rest"
    assert heard_run.outcome["derailed_cars"] == own_run.outcome["derailed_cars"]

    # others read it with nothing but the file
    with (tmp_path / "heard" / "heard.mcap").open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        topics = {channel.topic for _, channel, _, _ in reader.iter_decoded_messages()}
    assert topics >= set(first)
    with Reader(tmp_path / "heard") as reader:
        qos = {c.topic: c.ext.offered_qos_profiles[0].durability for c in reader.connections}
        order = [c.topic for c in reader.connections]
    assert qos["/consist"] is QosDurability.TRANSIENT_LOCAL
    assert qos["/robot_description"] is qos["/tf_static"] is QosDurability.TRANSIENT_LOCAL
    assert qos["/train_state"] is qos["/tf"] is QosDurability.VOLATILE
    assert order.index("/outcome") < order.index("/car_poses")


def test_signals_close_recordings_whole_and_so_does_the_end_of_the_simulator(tmp_path) -> None:
    """Four recorders at one simulator, each ended in another way."""
    ways = {
        "interrupted": ("mcap", signal.SIGINT),
        "terminated": ("mcap", signal.SIGTERM),
        "sqlite3": ("sqlite3", signal.SIGTERM),
        "abandoned": ("mcap", None),
    }
    with graph(tmp_path) as made:
        recorders = {
            name: made.start(
                "recorder",
                "-r",
                f"__node:={name}",
                path=tmp_path / name,
                storage=storage,
                stop_when_final=number is None,
            )
            for name, (storage, number) in ways.items()
        }
        simulator = made.simulator(ready=False, scenario="base_train", await_listeners=4, **DEEP)
        made.listen("train_state")
        made.until(lambda: len(made.heard["train_state"]) > 30, "the run goes on", simulator)
        for name, (_, number) in ways.items():
            if number is not None:
                assert recorders[name].end(number) == 0, recorders[name].output
        assert simulator.end(signal.SIGTERM) == 0, simulator.output
        assert recorders["abandoned"].wait() == 0, recorders["abandoned"].output
    assert "the simulator is gone" in recorders["abandoned"].output
    assert read_manifest(tmp_path / "abandoned").run.status == "stopped"
    for name, recorder in recorders.items():
        assert "Traceback" not in recorder.output
        manifest = read_manifest(tmp_path / name)
        assert manifest.messages["/train_state"] >= 20, name
        found = contents(tmp_path / name)
        assert {topic: len(messages) for topic, messages in found.items()} == {
            topic: n for topic, n in manifest.messages.items() if n
        }, name
        assert manifest.settings["missed"]["/train_state"] == {
            "received": manifest.messages["/train_state"],
            "lost": 0,
            "gaps": 0,
        }, name


def test_who_comes_late_says_what_it_missed(tmp_path) -> None:
    with graph(tmp_path) as made:
        simulator = made.simulator(scenario="base_train", speed_factor=2.0, **DEEP)
        made.listen("train_state")
        made.until(lambda: len(made.heard["train_state"]) > 50, "the run goes on", simulator)
        recorder = made.start(
            "recorder", path=tmp_path / "bag", topics="[train_state, events, consist]"
        )
        made.until(
            lambda: {"train_state", "events", "consist"} <= on_disk(tmp_path / "bag"),
            "all topics are recorded",
            recorder,
        )
        assert recorder.end() == 0, recorder.output
    # What was sent before it came is no message that was lost on the way.
    said = re.search(
        r"/train_state: 0 messages missed by their sequence numbers, (\d+)", recorder.output
    )
    assert said and int(said[1]) >= 10, recorder.output
    found = contents(tmp_path / "bag")
    first = found["/train_state"][0][0]
    assert first > 0
    # events are kept for those who come late
    events = [deserialize(data, "derail_msgs/msg/TrainEvent") for _, data in found["/events"]]
    assert [e.sequence for e in events] == list(range(len(events)))


def test_a_place_that_is_taken_is_one_clear_line(tmp_path) -> None:
    with graph(tmp_path) as made:
        recorder = made.start("recorder", fresh=True, path=tmp_path)
        assert recorder.wait() == 1
        assert recorder.output.strip().splitlines()[-1].startswith("error: ")
        assert "exists already" in recorder.output and "Traceback" not in recorder.output
        other = made.start("recorder", path=tmp_path / "x", topics="[nothing]")
        assert other.wait() == 1 and "got 'nothing'" in other.output


def test_topics_by_their_names() -> None:
    assert {t.name for t in chosen_topics([])} == set(TOPICS) - {"/clock"}
    assert [t.name for t in chosen_topics(["/yard/energy", "clock"])] == ["energy", "/clock"]
    every = {t.name for t in chosen_topics(["all"])}
    assert every == (set(TOPICS) | set(LIVE_TOPICS)) - {"/clock", ON_MAP.name}
    few = chosen_topics(["/tf", "/yard/car_5/odometry", "robot_description"])
    assert [t.name for t in few] == ["/tf", "car_5/odometry", "robot_description"]
    for name in ("speed", "car_5/speed", "car_0/odometry", "geojson"):
        with pytest.raises(ValueError, match="topics must be among"):
            chosen_topics([name])


def test_the_demonstration_ends_by_itself(tmp_path) -> None:
    """`make run` with the shortest of the shipped runs: two nodes, recording, outcome, figures."""
    scenario = "mississauga_brake_instant_traction"
    command = [sys.executable, "-m", "derail_ros.demo", scenario]
    command += ["--speed-factor", "0", "--output", str(tmp_path / "out")]
    said, told = "", ""
    with subprocess.Popen(
        command, env=os.environ | {"PYTHONUNBUFFERED": "1"}, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            said += line
            if line.startswith("page: "):  # its stream ends with the demonstration
                with urllib.request.urlopen(line.split()[1] + "events", timeout=120) as stream:
                    told = stream.read().decode()
    assert process.returncode == 0, said
    assert "cars derailed" in said and "no message missed" in said
    kinds = re.findall(r"^event: (\w+)$", told, re.M)
    assert kinds[0] == "hello" and kinds[-1] == "closed"
    assert {"state", "break", "event", "end"} <= set(kinds), kinds
    assert "derails at the rail break" in told
    for name in ("final_scene.png", "peak_forces.png", "bag/bag.mcap", "bag/manifest.json"):
        assert (tmp_path / "out" / name).stat().st_size > 0


def test_the_demonstration_ends_at_a_signal(tmp_path) -> None:
    """With both its nodes, in the midst of the run."""
    command = [sys.executable, "-m", "derail_ros.demo", "mississauga"]
    command += ["--speed-factor", "1", "--output", str(tmp_path / "out")]
    with subprocess.Popen(
        command, env=os.environ | {"PYTHONUNBUFFERED": "1"}, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        page = next(line.split()[1] for line in process.stdout if line.startswith("page: "))
        with urllib.request.urlopen(page + "events", timeout=LIMIT_COMPILING) as stream:
            assert any(line.startswith(b"event: state") for line in stream)
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        assert len(children) == 2
        process.terminate()
        said = process.stdout.read()
    assert process.returncode == 130 and "interrupted" in said and "Traceback" not in said
    assert not any(Path(f"/proc/{child}").exists() for child in children)
    for node in ("simulator", "recorder"):
        assert "Traceback" not in (tmp_path / "out" / f"{node}.log").read_text()


# --- the listener itself, without a graph ----------------------------------------------------


def recorded_messages(tmp_path: Path) -> list[tuple[str, int, bytes]]:
    """Messages of a small run with two resets, as they would come over a graph."""
    from tests.nodes.bench import Simulator
    from tests.nodes.support import ready

    made = Simulator(speed_factor=0.0, publish_clock=False)
    made.core.load(ready(), {"start_paused": True})
    made.step(100)
    made.core.reset(0)
    made.step(100)
    made.core.reset(1)
    made.step(50)
    return [(name, data) for name, data in made.heard.raw if name in TOPICS]


def test_lost_messages_are_counted_both_ways(tmp_path) -> None:
    topics = {f"/{t.name.lstrip('/')}": t for t in chosen_topics([])}
    listener = Listener(tmp_path / "bag", "mcap", topics)
    numbers: dict[str, int] = {}
    for name, data in recorded_messages(tmp_path):
        full = f"/{name.lstrip('/')}"
        numbers[full] = numbers.get(full, 0) + 1
        if name == "train_state" and 10 <= numbers[full] < 13:
            continue
        info = {
            "publication_sequence_number": numbers[full],
            "publisher_gid": {"data": b"one"},
        }
        listener.take(full, data, info)
    listener.close()
    missed = read_manifest(tmp_path / "bag").settings["missed"]
    assert missed["/train_state"]["lost"] == 3 and missed["/train_state"]["gaps"] == 3
    assert missed["/energy"]["lost"] == missed["/energy"]["gaps"] == 0


def test_time_that_begins_anew_begins_a_new_file(tmp_path) -> None:
    topics = {f"/{t.name.lstrip('/')}": t for t in chosen_topics([])}
    listener = Listener(tmp_path / "bag", "mcap", topics)
    for name, data in recorded_messages(tmp_path):
        listener.take(f"/{name.lstrip('/')}", data, {})
    listener.close()
    assert [p.name for p in listener.closed] == ["bag", "bag_1"]
    first, second = read_manifest(tmp_path / "bag"), read_manifest(tmp_path / "bag_1")
    assert first.messages["/train_state"] == 202
    assert second.messages["/train_state"] == 51
    assert first.settings["missed"]["/train_state"]["gaps"] == 0
    for place in ("bag", "bag_1"):
        with Reader(tmp_path / place) as reader:
            stamps = [
                stamp
                for connection, stamp, _ in reader.messages()
                if connection.topic == "/train_state"
            ]
        assert stamps == [TIME_ZERO + 20_000_000 * k for k in range(len(stamps))]
    assert first.messages["/consist"] == 2 and second.messages["/consist"] == 1
    assert [run.status for run in first.runs] == ["stopped", "stopped"]
    events = [
        deserialize(d, TOPICS["events"].msgtype)
        for _, d in contents(tmp_path / "bag_1")["/events"]
    ]
    assert events[0].kind_name == "run_reset"
    assert [e.sequence for e in events] == list(range(len(events)))


def test_topics_in_any_order_go_into_the_right_file(tmp_path) -> None:
    """Topics have no order among each other: here each comes as a whole, the states last."""
    topics = {f"/{t.name.lstrip('/')}": t for t in chosen_topics([])}
    messages = recorded_messages(tmp_path)
    by_topic = sorted(messages, key=lambda m: (m[0] in STATE_TOPICS, m[0]))
    before = messages[: len(messages) // 2]
    after = [m for m in by_topic if m not in before]
    listener = Listener(tmp_path / "bag", "mcap", topics)
    for name, data in before + after:
        listener.take(f"/{name.lstrip('/')}", data, {})
    listener.close()
    first, second = read_manifest(tmp_path / "bag"), read_manifest(tmp_path / "bag_1")
    runs = [run.run_id for run in first.runs], [run.run_id for run in second.runs]
    assert len(runs[0]) == 2 and len(runs[1]) == 1
    for place, ids in zip(("bag", "bag_1"), runs):
        for name, found in contents(tmp_path / place).items():
            if name.lstrip("/") in TOPICS and TOPICS[name.lstrip("/")].msgtype.startswith(
                "derail"
            ):
                kind = TOPICS[name.lstrip("/")].msgtype
                assert {deserialize(d, kind).run_id for _, d in found} <= set(ids), name
