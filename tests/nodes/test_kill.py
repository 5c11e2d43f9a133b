"""SIGKILL of each part: the others go on, and what is left behind is made good."""

from __future__ import annotations

import fcntl
import json
import os
import re
import signal
from pathlib import Path

import pytest

pytest.importorskip("rclpy")
pytest.importorskip("derail_msgs")

from derail_ros.cli import main
from derail_ros.nodes.shared_memory import sweep
from derail_ros.recording import read_manifest
from derail_ros.recording.storage import open_bag
from msg_adapters.common import TIME_ZERO, stamp_of
from msg_adapters.topics import STATE_TOPICS
from tests.nodes.graph import DEEP, PAUSED, PLAYING, Graph, Process, graph

pytestmark = pytest.mark.ros


def killed(made: Graph, process: Process) -> None:
    """Kill a process, which the graph then no longer misses."""
    process.process.kill()
    process.process.wait()
    made.processes.remove(process)


def stamps(bag: Path, topic: str = "/train_state") -> list[int]:
    return sorted(stamp for _, stamp, _ in open_bag(bag).messages(lambda c: c.topic == topic))


def goes_on(made: Graph, seconds: float = 1.0) -> None:
    """Wait until the run has gone on for a while."""
    states = made.heard["train_state"]
    made.until(lambda: states, "a state")
    at = stamp_of(states[-1])
    made.until(lambda: stamp_of(states[-1]) > at + seconds * 1e9, "the run goes on")


def without_gaps(times: list[int]) -> bool:
    return all(b - a == 20_000_000 for a, b in zip(times, times[1:]))


def test_recorders_and_clients_that_are_killed(tmp_path, capsys) -> None:
    """Of two recorders one, a subscriber, and a client that waits for an answer."""
    with graph(tmp_path) as made:
        recorders = {
            name: made.start("recorder", "-r", f"__node:={name}", path=tmp_path / name)
            for name in ("first", "second")
        }
        simulator = made.simulator(scenario="base_train", await_listeners=2, **DEEP)
        states = made.listen("train_state")["train_state"]
        goes_on(made, 3.0)
        last = stamp_of(states[-1])
        killed(made, recorders["first"])
        ear = made.ear("train_state", "events")
        made.until(lambda: ear.heard(), "the ear hears")
        killed(made, ear)
        goes_on(made)

        made.ask("set_simulation_state", state=PAUSED)
        client = Process(
            "tests.nodes.waiter", made.env, tmp_path / "waiter.log", "step_simulation", "1000000"
        )
        made.processes.append(client)
        ticks = len(states)
        made.until(lambda: len(states) > ticks + 20, "the client's ticks are made")
        killed(made, client)
        # The state changes: the answer to the client that is gone goes nowhere, and does no harm.
        assert made.ask("set_simulation_state", state=PLAYING).success
        goes_on(made)
        assert made.ask("get_events").success
        assert recorders["second"].end() == 0, recorders["second"].output
        assert simulator.end() == 0, simulator.output
    assert "Traceback" not in simulator.output + recorders["second"].output
    missed = read_manifest(tmp_path / "second").settings["missed"]
    assert not [n for n, c in missed.items() if (c["lost"] or c["gaps"]) and n != "/markers"]
    whole = stamps(tmp_path / "second")
    assert whole[0] == TIME_ZERO and without_gaps(whole)

    assert main(["repair", str(tmp_path / "first")]) == 0, capsys.readouterr().err
    repaired = tmp_path / "first_repaired"
    assert open_bag(repaired).intact
    times = stamps(repaired)
    assert times[0] == TIME_ZERO and without_gaps(times)
    # The last second may be lost; what was on its way when the recorder was killed as well.
    assert times[-1] > last - 1_250_000_000
    for topic in STATE_TOPICS:
        assert abs(len(stamps(repaired, f"/{topic}")) - len(times)) <= 50
    assert {"/consist", "/track"} <= {c.topic for c in open_bag(repaired).channels}
    assert main(["review", str(repaired), "-o", str(tmp_path / "review"), "--no-figures"]) == 0
    # Train, command log and events are enough to compute it again, repaired or not.
    for place in ("first", "first_repaired", "first/first.mcap"):
        capsys.readouterr()
        assert main(["replay", str(tmp_path / place), "--json"]) == 0, capsys.readouterr()
        (run,) = json.loads(capsys.readouterr().out)["runs"]
        assert run["events"] > 0 and run["steps"] > 50 and run["differences"] == []


def segments(process: Process) -> list[Path]:
    """The segments of shared memory that a process has made: it holds their locks."""
    folder = Path(f"/proc/{process.process.pid}/fd")
    links = [os.readlink(link) for link in folder.iterdir() if link.is_symlink()]
    found = [re.fullmatch(r"(/dev/shm/fastdds_[0-9a-f]{16})_el", link) for link in links]
    return [Path(each[1]) for each in found if each]


@pytest.mark.slow
def test_a_simulator_that_is_killed(tmp_path, capsys) -> None:
    """Its recorder ends whole, its own recording is repaired, another takes over the clock."""
    with graph(tmp_path) as made:
        recorder = made.start("recorder", path=tmp_path / "heard", stop_when_final=True)
        simulator = made.simulator(
            scenario="base_train", await_listeners=1, record=tmp_path / "own", **DEEP
        )
        made.listen("train_state", "/clock")
        made.until(lambda: made.heard["/clock"], "the clock")
        second = made.start("simulator", "-r", "__ns:=/second", scenario="base_train")
        # Where discovery takes long both begin, and then one of them gives way.
        said = "another node publishes /clock"
        made.until(lambda: said in simulator.output + second.output, "one gives way")
        assert made.ask("trigger_emergency_brake", mode=1).success
        goes_on(made, 2.0)
        last = stamp_of(made.heard["train_state"][-1])
        # What is under way when its sender is killed may reach one listener and not the other.
        goes_on(made, 0.2)
        left = segments(simulator)
        killed(made, simulator)
        assert left and all(file.exists() for file in left)
        # The middleware takes 20 s to notice that a process is gone.
        if said in second.output:
            made.until(lambda: "the other node is gone" in second.output, "it takes over")
        made.heard["/clock"].clear()
        made.until(lambda: len(made.heard["/clock"]) > 20, "its clock")
        assert recorder.wait() == 0, recorder.output
        # Those who knew it sweep up, or else whatever node starts next.
        third = made.simulator(scenario="")
        assert not any(file.exists() for file in left)
        assert third.end(signal.SIGTERM) == 0, third.output
        assert second.end(signal.SIGTERM) == 0, second.output
    assert "the simulator is gone" in recorder.output
    heard = stamps(tmp_path / "heard")
    manifest = read_manifest(tmp_path / "heard")
    assert manifest.messages["/train_state"] == len(heard)
    assert without_gaps(heard) and heard[0] == TIME_ZERO and heard[-1] >= last
    assert main(["repair", str(tmp_path / "own")]) == 0, capsys.readouterr().err
    times = stamps(tmp_path / "own_repaired")
    assert without_gaps(times) and times[0] == TIME_ZERO and times[-1] > last - 1_250_000_000
    # What it has is the beginning of the run with its command.
    capsys.readouterr()
    assert main(["replay", str(tmp_path / "own_repaired")]) == 0, capsys.readouterr().out
    assert "1 command," in capsys.readouterr().out


def test_a_subscriber_that_stands_still_slows_nobody(tmp_path) -> None:
    with graph(tmp_path) as made:
        made.simulator(scenario="base_train", **DEEP)
        slow = made.ear(*STATE_TOPICS, "events", "markers")
        states = made.listen("train_state")["train_state"]
        goes_on(made, 0.1)
        made.until(lambda: ("train_state", states[-1].run_id) in slow.heard(), "it hears too")
        slow.signal(signal.SIGSTOP)
        first = len(states)
        goes_on(made, 6.0)
        times = [stamp_of(m) for m in states[first:]]
        assert without_gaps(times) and made.ask("get_events").success
        slow.signal(signal.SIGCONT)
        before = slow.output.count("train_state")
        made.until(lambda: slow.output.count("train_state") > before + 20, "it hears again")
        assert slow.end() == 0, slow.output


def test_only_segments_that_nobody_holds_are_swept_up(tmp_path) -> None:
    names = [f"fastdds_{k:016x}" for k in range(3)]
    for name in names:
        (tmp_path / name).write_bytes(b"segment")
        (tmp_path / f"{name}_el").touch()
        os.utime(tmp_path / f"{name}_el", (0, 0))
    os.utime(tmp_path / f"{names[1]}_el")
    for other in ("fastdds_port7400_el", "sem.fastdds_port7400_mutex", "somebody_el"):
        (tmp_path / other).touch()
        os.utime(tmp_path / other, (0, 0))
    with (tmp_path / f"{names[2]}_el").open() as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        assert sweep(tmp_path) == 1
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(
        [
            names[1],
            f"{names[1]}_el",
            names[2],
            f"{names[2]}_el",
            "fastdds_port7400_el",
            "sem.fastdds_port7400_mutex",
            "somebody_el",
        ]
    )
    assert sweep(tmp_path / "nowhere") == 0
