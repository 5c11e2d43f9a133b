"""What goes wrong where nodes are not alone, start badly or end badly; on real graphs."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("rclpy")
pytest.importorskip("derail_msgs")

from rosbags.rosbag2 import Reader

from derail_ros.recording import read_manifest
from derail_ros.recording.listener import message_run, message_stamp
from msg_adapters.topics import TOPICS
from tests.nodes.graph import LIMIT_COMPILING, PAUSED, Graph, graph
from tests.nodes.support import ENDLESS, SMALL

pytestmark = pytest.mark.ros


def two_scenarios(parent: Path) -> Path:
    """A new folder with two scenarios."""
    folder = parent / "scenarios"
    folder.mkdir()
    (folder / "small.yaml").write_text(SMALL)
    (folder / "endless.yaml").write_text(ENDLESS)
    return folder


@pytest.fixture
def scenarios(tmp_path) -> Path:
    """A folder with two scenarios."""
    return two_scenarios(tmp_path)


def test_two_trains_in_two_namespaces_share_no_frame(tmp_path, scenarios) -> None:
    pytest.importorskip("tf2_msgs")
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from std_msgs.msg import String
    from tf2_msgs.msg import TFMessage

    with graph(tmp_path) as made:
        parents: dict[str, set[tuple[str, str]]] = {}
        texts: dict[str, list] = {"north": [], "south": []}

        def take(message: TFMessage) -> None:
            for one in message.transforms:
                parents.setdefault(one.child_frame_id, set()).add(one.header.frame_id)

        latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        made.node.create_subscription(TFMessage, "/tf", take, 100)
        made.node.create_subscription(TFMessage, "/tf_static", take, latched)
        for name, heard in texts.items():
            made.node.create_subscription(
                String, f"/{name}/robot_description", heard.append, latched
            )
            made.simulator(
                "-r", f"__ns:=/{name}", ready=False, scenario="endless",
                scenario_dirs=f"[{scenarios}]",
            )  # fmt: skip
        cars = {f"{name}/car_{i}" for name in texts for i in (1, 2, 3)}
        frames = cars | {f"{car}/front_truck" for car in cars} | {
            f"{car}/rear_coupler/head" for car in cars
        }  # fmt: skip
        made.until(lambda: frames <= set(parents), "all frames", limit=LIMIT_COMPILING)
        made.until(lambda: all(texts.values()), "both descriptions")
        assert all(len(of) == 1 for of in parents.values()), "each frame has one parent"
        assert {child for child, of in parents.items() if of == {"map"}} == cars
        for name, heard in texts.items():
            assert f'link name="{name}/car_3/rear_coupler"' in heard[0].data
        assert not any("subscribers get both" in p.output for p in made.processes)


OWN_TIMES = ("train_state", "coupler_states", "energy")
"""Topics of regular times whose messages name their run."""


def times_of(bag: Path) -> dict[str, dict[str, set[int]]]:
    """Times of the messages of each run in a recording, ns: topic -> run -> times."""
    found: dict[str, dict[str, set[int]]] = {}
    with Reader(bag) as reader:
        for connection, _, data in reader.messages():
            name = connection.topic.removeprefix("/")
            if name in OWN_TIMES:
                runs = found.setdefault(connection.topic, {})
                runs.setdefault(message_run(TOPICS[name], bytes(data)), set()).add(
                    message_stamp(TOPICS[name], bytes(data), -1)
                )
    return found


def test_two_simulators_of_one_name_are_noticed_by_all(tmp_path, scenarios) -> None:
    """Both simulators, the recorder; and its recording is one, in which nothing is missed."""
    bag = tmp_path / "bag"
    with graph(tmp_path) as made:
        recorder = made.start("recorder", path=bag)
        endless = {"scenario": "endless", "scenario_dirs": f"[{scenarios}]"}
        first = made.simulator(**endless, record=tmp_path / "first")
        heard = made.listen("train_state")["train_state"]
        made.until(lambda: len(heard) > 100, "the first one runs for a while")
        second = made.start("simulator", **endless, record=tmp_path / "second")
        made.until(
            lambda: all("subscribers get both" in p.output for p in made.processes),
            "all three say so",
            limit=LIMIT_COMPILING,
        )
        runs = {m.run_id for m in heard}
        made.until(lambda: len({m.run_id for m in heard}) > 1, "the second one runs")
        before = len(heard)
        made.until(lambda: len(heard) > before + 100, "both run")
        assert second.end() == 0 and first.end() == 0 and recorder.end() == 0
        assert len(runs | {m.run_id for m in heard}) == 2
    assert not [path for path in tmp_path.iterdir() if path.name.startswith("bag_")]
    missed = read_manifest(bag).settings["missed"]
    assert missed["/train_state"]["received"] > 200
    # How much a recorder misses depends on the machine; what it says is the truth on any.
    sent = [times_of(tmp_path / name) for name in ("first", "second")]
    heard_of = times_of(bag)
    for topic, counts in missed.items():
        if topic.removeprefix("/") not in OWN_TIMES:
            continue
        gone = 0
        for own in sent:
            ((run, published),) = own[topic].items()
            last = max(heard_of[topic][run])
            gone += len({t for t in published if t <= last} - heard_of[topic][run])
        assert counts["gaps"] == gone, (topic, missed)
        # numbers begin with the first message that came; who is late gets states again
        assert counts["lost"] <= gone + 20, (topic, missed)


def test_a_recorder_follows_what_is_offered_and_names_what_never_came(tmp_path, scenarios) -> None:
    with graph(tmp_path) as made:
        recorder = made.start("recorder", path=tmp_path / "bag")
        simulator = made.simulator(
            "-r", "train_state:=states",
            "-p", "qos_overrides./energy.publisher.reliability:=best_effort",
            "-p", "qos_overrides./outcome.publisher.durability:=volatile",
            scenario="endless", scenario_dirs=f"[{scenarios}]",
        )  # fmt: skip
        made.listen("coupler_states")
        made.until(lambda: len(made.heard["coupler_states"]) > 150, "it runs for three seconds")
        assert simulator.end() == 0 and recorder.end() == 0
    assert "nothing came on" in recorder.output
    assert "/train_state (no node publishes it)" in recorder.output
    assert "no message missed" not in recorder.output
    missed = read_manifest(tmp_path / "bag").settings["missed"]
    for topic in ("/energy", "/outcome"):
        assert topic not in recorder.output.partition("nothing came on")[2]
        assert missed[topic]["received"] > 0


def test_a_recorder_without_a_simulator_says_so(tmp_path) -> None:
    with graph(tmp_path) as made:
        recorder = made.start("recorder", path=tmp_path / "bag")
        made.until(lambda: "recording" in recorder.output, "it listens")
        recorder.end()
        assert "nothing came on any topic" in recorder.output
        assert "no message missed" not in recorder.output


@pytest.mark.parametrize("node", ["simulator", "recorder"])
def test_a_recording_that_is_not_whole_reaches_the_exit_code(tmp_path, scenarios, node) -> None:
    """In one line; the run itself goes on to its end."""
    with graph(tmp_path) as made:
        path = "record" if node == "simulator" else "path"
        given = ["--ros-args", "-p", f"{path}:={tmp_path / 'bag'}"]
        if node == "simulator":
            given += ["-p", "scenario:=small", "-p", f"scenario_dirs:=[{scenarios}]"]
            given += ["-p", "speed_factor:=0.0", "-p", "auto_exit:=true"]
        done = subprocess.Popen(
            [sys.executable, "-m", "tests.nodes.small_disk", node, "20000", *given],
            stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=made.env,
        )  # fmt: skip
        if node == "recorder":
            made.simulator(scenario="endless", scenario_dirs=f"[{scenarios}]", speed_factor=2.0)
        _, errors = done.communicate(timeout=LIMIT_COMPILING)
    assert done.returncode == 1
    assert "Traceback" not in errors
    last = errors.strip().splitlines()[-1]
    assert last.startswith("error: recording failed:") and "File too large" in last


@pytest.mark.parametrize("node", ["simulator", "recorder", "player"])
@pytest.mark.parametrize("after", [0.0, 0.2, 0.7, 1.5])
def test_a_signal_during_the_start_ends_it_quietly(tmp_path, node, after) -> None:
    with graph(tmp_path) as made:
        # Python then tells what it imports, so that its own start can be waited for.
        made.env["PYTHONPROFILEIMPORTTIME"] = "1"
        process = made.start(node, fresh=True, path=tmp_path / "bag")
        made.until(lambda: "| derail_ros" in process.output, "Python has started", process)
        end = time.monotonic() + after
        while time.monotonic() < end and process.process.poll() is None:
            made.spin()
        process.end()
        told = [line for line in process.output.splitlines() if "import time:" not in line]
        assert not [line for line in told if "Traceback" in line or "Interrupt" in line], told


def test_an_empty_list_in_a_parameter_file_is_none(tmp_path) -> None:
    file = tmp_path / "parameters.yaml"
    file.write_text(
        "/**:\n  ros__parameters:\n    scenario_dirs: []\n    scenario: ''\n"
        "    topics: []\n    exclude: []\n"
    )
    with graph(tmp_path) as made:
        simulator = made.simulator("--params-file", str(file))
        assert made.get_parameter("scenario") == ""
        assert simulator.end() == 0
        recorder = made.start("recorder", "--params-file", str(file), path=tmp_path / "bag")
        made.until(lambda: "recording" in recorder.output, "it listens", recorder)


@pytest.fixture(scope="module")
def paused(tmp_path_factory) -> Iterator[Graph]:
    """A simulator that was told to start paused."""
    folder = two_scenarios(tmp_path_factory.mktemp("paused"))
    with graph(folder.parent) as made:
        made.simulator(scenario="small", scenario_dirs=f"[{folder}]", start_paused=True)
        yield made


def test_who_comes_while_it_is_paused_gets_the_state(paused) -> None:
    for topic in ("car_poses", "train_state", "coupler_states", "energy"):
        heard = paused.listen(topic)[topic]
        paused.until(lambda heard=heard: heard, f"{topic} though it is paused")
        assert heard[0].header.stamp.sec >= 1


def test_the_parameter_names_the_scenario_that_is_loaded(paused) -> None:
    heard = paused.listen("consist")["consist"]
    answer = paused.ask("load_consist", scenario_name="endless", start_paused=True)
    assert answer.success and paused.get_parameter("scenario") == "endless"
    assert not paused.ask("load_consist", scenario_name="nowhere").success
    assert paused.get_parameter("scenario") == "endless"
    assert paused.ask("load_consist", scenario_yaml=SMALL, start_paused=True).success
    assert paused.get_parameter("scenario") == "", "what came as text has no name"
    assert paused.set_parameter("scenario", "endless").successful
    paused.until(lambda: heard and heard[-1].scenario_name == "endless", "it is loaded")
    assert paused.get_parameter("scenario") == "endless"
    runs = {m.run_id for m in heard}
    assert paused.ask("set_simulation_state", state=PAUSED).success
    assert {m.run_id for m in heard} == runs, "naming it loads nothing"
