"""What goes wrong where nodes are not alone, start badly or end badly; on real graphs."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import pytest

pytest.importorskip("rclpy")
pytest.importorskip("derail_msgs")

from derail_ros.recording import read_manifest
from tests.nodes.graph import LIMIT_COMPILING, PAUSED, graph
from tests.nodes.support import ENDLESS, SMALL

pytestmark = pytest.mark.ros


@pytest.fixture
def scenarios(tmp_path) -> Path:
    """A folder with two scenarios."""
    folder = tmp_path / "scenarios"
    folder.mkdir()
    (folder / "small.yaml").write_text(SMALL)
    (folder / "endless.yaml").write_text(ENDLESS)
    return folder


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


def test_two_simulators_of_one_name_are_noticed_by_all(tmp_path, scenarios) -> None:
    """Both simulators, the recorder; and its recording is one, in which nothing is missed."""
    bag = tmp_path / "bag"
    with graph(tmp_path) as made:
        recorder = made.start("recorder", path=bag)
        first = made.simulator(scenario="endless", scenario_dirs=f"[{scenarios}]")
        heard = made.listen("train_state")["train_state"]
        made.until(lambda: len(heard) > 100, "the first one runs for a while")
        second = made.start("simulator", scenario="endless", scenario_dirs=f"[{scenarios}]")
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
    # A busy machine may lose a few; each other's messages are no losses.
    assert all(counts["lost"] + counts["gaps"] < 50 for counts in missed.values()), missed


def test_topics_that_never_came_are_named(tmp_path, scenarios) -> None:
    with graph(tmp_path) as made:
        recorder = made.start("recorder", path=tmp_path / "bag")
        simulator = made.simulator(
            "-r", "train_state:=states", scenario="endless", scenario_dirs=f"[{scenarios}]"
        )
        made.listen("energy")
        made.until(lambda: len(made.heard["energy"]) > 20, "it runs")
        assert simulator.end() == 0 and recorder.end() == 0
        assert "nothing came on" in recorder.output
        assert "/train_state (no node publishes it)" in recorder.output
        assert "/energy" not in recorder.output.partition("nothing came on")[2]
        assert "no message missed" not in recorder.output


def test_a_recorder_without_a_simulator_says_so(tmp_path) -> None:
    with graph(tmp_path) as made:
        recorder = made.start("recorder", path=tmp_path / "bag")
        made.until(lambda: "recording" in recorder.output, "it listens")
        recorder.end()
        assert "nothing came on any topic" in recorder.output
        assert "no message missed" not in recorder.output


@pytest.mark.parametrize("policy", ["reliability:=best_effort", "durability:=volatile"])
def test_a_recorder_follows_what_is_offered(tmp_path, scenarios, policy) -> None:
    topic = "outcome" if "volatile" in policy else "train_state"
    with graph(tmp_path) as made:
        recorder = made.start("recorder", path=tmp_path / "bag")
        simulator = made.simulator(
            "-p", f"qos_overrides./{topic}.publisher.{policy}",
            scenario="endless", scenario_dirs=f"[{scenarios}]",
        )  # fmt: skip
        made.listen("energy")
        made.until(lambda: len(made.heard["energy"]) > 150, "it runs for three seconds")
        assert simulator.end() == 0 and recorder.end() == 0
    assert read_manifest(tmp_path / "bag").settings["missed"][f"/{topic}"]["received"] > 0


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
        process = made.start(node, path=tmp_path / "bag")
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


def test_the_parameter_names_the_scenario_that_is_loaded(tmp_path, scenarios) -> None:
    with graph(tmp_path) as made:
        made.simulator(scenario="small", scenario_dirs=f"[{scenarios}]")
        heard = made.listen("consist")["consist"]
        answer = made.ask("load_consist", scenario_name="endless", start_paused=True)
        assert answer.success and made.get_parameter("scenario") == "endless"
        assert not made.ask("load_consist", scenario_name="nowhere").success
        assert made.get_parameter("scenario") == "endless"
        assert made.ask("load_consist", scenario_yaml=SMALL, start_paused=True).success
        assert made.get_parameter("scenario") == "", "what came as text has no name"
        assert made.set_parameter("scenario", "endless").successful
        made.until(lambda: heard and heard[-1].scenario_name == "endless", "it is loaded")
        assert made.get_parameter("scenario") == "endless"
        runs = {m.run_id for m in heard}
        assert made.ask("set_simulation_state", state=PAUSED).success
        assert {m.run_id for m in heard} == runs, "naming it loads nothing"


def test_who_comes_while_it_is_paused_gets_the_state(tmp_path, scenarios) -> None:
    with graph(tmp_path) as made:
        made.simulator(scenario="endless", scenario_dirs=f"[{scenarios}]", start_paused=True)
        for topic in ("car_poses", "train_state", "coupler_states", "energy"):
            heard = made.listen(topic)[topic]
            made.until(lambda heard=heard: heard, f"{topic} though it is paused")
            assert heard[0].header.stamp.sec >= 1
