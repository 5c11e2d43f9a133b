"""`derail replay`: a live run with a client's commands is computed again to the bit."""

from __future__ import annotations

import json
import shutil
import time
from pathlib import Path

import pytest

from derail_ros.cli import main
from derail_ros.engine import PlanarSimulation
from derail_ros.recording import read_manifest, record_run
from derail_ros.recording.recomputation import collect
from derail_ros.recording.repair import repair
from derail_ros.recording.storage import BagError, open_bag
from tests.nodes.bench import Simulator
from tests.nodes.support import ENDLESS, OFF_THE_TRACK, SMALL, ready, small

LIVE = SMALL.replace("count: 10", "count: 24")
"""Piles up, and has cars on the rails for a client to stop and to derail."""


def replay(place: Path, capsys: pytest.CaptureFixture[str]) -> tuple[int, dict]:
    """Exit code and JSON of the command."""
    capsys.readouterr()
    code = main(["replay", str(place), "--json"])
    out = capsys.readouterr().out
    return code, json.loads(out) if out else {}


@pytest.mark.ros
def test_a_live_run_with_a_clients_breaks_and_brakes(tmp_path, capsys) -> None:
    """Other rates, a speed factor that changes meanwhile, and two recordings of it."""
    pytest.importorskip("rclpy")
    pytest.importorskip("derail_msgs")
    from tests.nodes.graph import graph

    scenarios = tmp_path / "scenarios"
    scenarios.mkdir()
    (scenarios / "live.yaml").write_text(LIVE)
    with graph(tmp_path) as made:
        recorder = made.start("recorder", path=tmp_path / "heard", stop_when_final=True)
        simulator = made.simulator(
            ready=False,
            scenario="live",
            scenario_dirs=f"['{scenarios}']",
            speed_factor=3.0,
            state_rate=23.0,
            marker_rate=7.0,
            await_listeners=1,
            auto_exit=True,
            record=tmp_path / "own",
        )
        states = made.listen("train_state")["train_state"]
        made.until(lambda: states and states[-1].time > 0.5, "the run goes on", simulator)
        assert made.ask("inject_rail_break", car=20).success
        made.until(lambda: states[-1].time > 1.0, "the run goes on", simulator)
        assert made.ask("trigger_emergency_brake", source=3, car=14, delay_s=0.25).success
        assert not made.ask("trigger_emergency_brake", mode=77).success
        made.until(lambda: states[-1].time > 1.5, "the run goes on", simulator)
        assert made.set_parameter("speed_factor", 8.0).successful
        ahead = made.ask("inject_rail_break", car=24)
        assert ahead.success
        assert made.ask("inject_rail_break", track_coordinate=ahead.track_coordinate + 9).success
        assert made.ask("trigger_emergency_brake", mode=3, source=1).success
        assert made.set_parameter("speed_factor", 0.0).successful
        assert simulator.wait() == 0, simulator.output
        assert recorder.wait() == 0, recorder.output
    own = read_manifest(tmp_path / "own").run
    assert own.status == "at rest" and own.outcome["derailed_cars"]
    assert len(own.commands) == 5 and len(own.refused) == 1

    code, answer = replay(tmp_path / "own" / "manifest.json", capsys)
    assert code == 0, answer
    (run,) = answer["runs"]
    assert answer["same"] and run["same_state"] is True
    assert run["commands"] == 5 and run["steps"] == own.steps and run["status"] == "at rest"
    assert run["events"] > 20 and run["contacts"] > 0

    # What a recorder heard is enough too: no state in there, but all events and contacts.
    code, answer = replay(tmp_path / "heard", capsys)
    assert code == 0, answer
    assert answer["runs"][0]["same_state"] is None
    for what in ("commands", "events", "contacts", "steps"):
        assert answer["runs"][0][what] == run[what], what

    # A command left out, or a step later: it is seen.
    manifest = json.loads((tmp_path / "own" / "manifest.json").read_text())
    commands = manifest["runs"][0]["commands"]
    for change in ("left out", "later"):
        manifest["runs"][0]["commands"] = commands[1:]
        if change == "later":
            later = commands[0] | {"step": commands[0]["step"] + 1}
            manifest["runs"][0]["commands"] = [later, *commands[1:]]
        (tmp_path / "own" / "changed.json").write_text(json.dumps(manifest))
        code, answer = replay(tmp_path / "own" / "changed.json", capsys)
        assert code == 3 and not answer["same"], change
        assert answer["runs"][0]["differences"], change


def test_stopped_reset_and_failed_runs(tmp_path, capsys) -> None:
    """Each run of a recording, however it ended."""
    made = Simulator(speed_factor=0.0, record=str(tmp_path / "bag"))
    core, step = made.core, made.step

    core.load(ready(ENDLESS), {"start_paused": True})
    step(20)
    core.inject_rail_break(0.0, 2)
    step(30)
    core.reset(0)
    core.trigger_emergency_brake(1, 2, 0, 0.1)
    step(9)
    core.load(ready(OFF_THE_TRACK), {"start_paused": True})
    core.inject_rail_break(float("nan"), 0)
    step(10**6)
    core.load(ready(SMALL), {"start_paused": True})
    step(10**6)
    core.close()
    code, answer = replay(tmp_path / "bag", capsys)
    assert code == 0, answer
    assert [run["status"] for run in answer["runs"]] == ["stopped", "stopped", "failed", "at rest"]
    assert [run["commands"] for run in answer["runs"]] == [1, 1, 0, 0]
    assert all(run["same_state"] for run in answer["runs"])
    assert main(["replay", str(tmp_path / "bag")]) == 0
    assert capsys.readouterr().out.count("the same to the bit") == 4


def _commands_on_disk(bag: Path) -> int:
    """Commands in a recording that is still being written."""
    try:
        runs = collect(open_bag(bag)).runs
    except BagError:
        return 0
    return sum(len(run.commands) for run in runs.values())


def test_a_recording_that_was_cut_off(tmp_path, capsys) -> None:
    """Its manifest was written at the beginning; the command log in it knows the rest."""
    made = Simulator(speed_factor=0.0, record=str(tmp_path / "bag"))
    core, step = made.core, made.step
    core.load(ready(ENDLESS), {"start_paused": True})

    step(20)
    core.inject_rail_break(0.0, 2)
    step(50)
    end = time.monotonic() + 60.0
    while _commands_on_disk(tmp_path / "bag") < 1:
        assert time.monotonic() < end, "nothing reaches the disk"
        time.sleep(0.05)
    shutil.copytree(tmp_path / "bag", tmp_path / "cut")
    core.close()
    repair(tmp_path / "cut", tmp_path / "whole")
    code, answer = replay(tmp_path / "whole", capsys)
    assert code == 0, answer
    (run,) = answer["runs"]
    assert run["status"] == "running" and run["commands"] == 1 and run["same_state"] is None


def test_a_recording_without_a_manifest(tmp_path, capsys) -> None:
    """As `ros2 bag record` or a killed recorder leaves it: its messages say scenario and commands.

    A command that is not in its log is missed.
    """
    from derail_ros.recording.files import add_topic, bag_writer

    made = Simulator(speed_factor=0.0, record=str(tmp_path / "own"))
    core, step = made.core, made.step
    core.load(ready(LIVE), {"start_paused": True})
    step(40)
    core.trigger_emergency_brake(1, 2, 0, 0.1)
    step(10**6)
    core.close()
    for name, left_out in (("heard", "manifest"), ("silent", "command_log"), ("no", "consist")):
        with bag_writer(tmp_path / name, "mcap") as writer:
            raw = open_bag(tmp_path / "own")
            channels = {
                c.topic: add_topic(writer, c.topic, c.msgtype, c.qos)
                for c in raw.channels
                if c.name not in (left_out, "manifest")
            }
            for channel, stamp, data in raw.messages():
                if channel.topic in channels:
                    writer.write(channels[channel.topic], stamp, data)
    code, answer = replay(tmp_path / "heard", capsys)
    assert code == 0, answer
    (run,) = answer["runs"]
    assert run["status"] == "at rest" and run["commands"] == 1 and run["contacts"] > 0
    assert run["same_state"] is None
    code, answer = replay(tmp_path / "silent", capsys)
    assert code == 3
    assert "1 command known from events only" in answer["runs"][0]["differences"][-1]
    assert main(["replay", str(tmp_path / "no")]) == 2
    assert "no train (topic consist)" in capsys.readouterr().err


def test_a_recording_is_taken_as_by_all_commands(tmp_path, capsys) -> None:
    """Its folder, a file of it, a folder with one in it; or its manifest."""
    record_run(PlanarSimulation(small().to_params()), small(), tmp_path / "out" / "recording")
    (tmp_path / "out" / "manifest.json").write_text('{"format": "derail_ros/results"}')
    bag = tmp_path / "out" / "recording"
    for place in (bag, bag.parent, next(bag.glob("*.mcap")), bag / "manifest.json"):
        code, answer = replay(place, capsys)
        assert code == 0 and answer["runs"][0]["events"] > 0, place
        assert answer["runs"][0]["same_state"] is True, place
    (tmp_path / "alone").mkdir()
    shutil.copy(bag / "manifest.json", tmp_path / "alone")
    code, answer = replay(tmp_path / "alone", capsys)
    assert code == 0 and answer["runs"][0]["events"] is None
    assert main(["replay", str(bag.parent / "manifest.json")]) == 2
    assert "got 'derail_ros/results'" in capsys.readouterr().err
    (tmp_path / "scenario.yaml").write_text("format: 1")
    (tmp_path / "picture.png").write_bytes(b"\x89PNG")
    for name in ("scenario.yaml", "picture.png"):
        assert main(["replay", str(tmp_path / name)]) == 2
        assert "neither an MCAP nor an SQLite recording" in capsys.readouterr().err


def test_what_is_no_manifest_is_one_line(tmp_path, capsys) -> None:
    (tmp_path / "other.json").write_text('{"format": "something"}')
    (tmp_path / "list.json").write_text("[]")
    (tmp_path / "broken.json").write_text("{")
    for name in ("other.json", "list.json", "broken.json", "nowhere.json", ""):
        assert main(["replay", str(tmp_path / name)]) == 2
        said = capsys.readouterr()
        assert said.out == "" and len(said.err.strip().splitlines()) == 1, name
        assert "repair" not in said.err and "line 1 column" not in said.err, name


def test_a_run_without_ros(tmp_path, capsys) -> None:
    simulation = PlanarSimulation(small().to_params())
    simulation.trigger_emergency_brake(mode="instant")
    record_run(simulation, small(), tmp_path / "bag")
    assert replay(tmp_path / "bag", capsys)[1]["same"]
