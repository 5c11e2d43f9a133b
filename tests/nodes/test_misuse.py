"""Strangers at the services of a running simulator: it neither falls nor swells nor forgets."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

pytest.importorskip("rclpy")
pytest.importorskip("derail_msgs")

from derail_ros.cli import main
from derail_ros.recording import read_manifest
from tests.nodes.graph import DEEP, Graph, Process, graph
from tests.nodes.support import ENDLESS

pytestmark = pytest.mark.ros

MEGABYTE = 1024 * 1024


def held(pid: int) -> dict[str, int]:
    """What a process holds: memory (bytes), open files, threads, files in shared memory."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    maps = Path(f"/proc/{pid}/maps").read_text()
    return {
        "memory": pages * os.sysconf("SC_PAGE_SIZE"),
        "files": len(os.listdir(f"/proc/{pid}/fd")),
        "threads": len(os.listdir(f"/proc/{pid}/task")),
        "shared": len({line.split()[-1] for line in maps.splitlines() if "/dev/shm/" in line}),
    }


def storm(made: Graph, simulator: Process, calls: int, seeds: range) -> list[dict]:
    """Let strangers call; what each reports."""
    strangers = []
    for seed in seeds:
        log = made.folder / f"stranger-{seed}.log"
        env = made.env | {"ROS_PYTHON_CHECK_FIELDS": "0"}
        strangers.append(
            Process("tests.nodes.stranger", env, log, str(seed), str(calls // len(seeds)))
        )
    made.processes += strangers
    made.until(
        lambda: all(s.process.poll() is not None for s in strangers),
        "the strangers are done",
        limit=1500.0,
    )
    assert simulator.process.poll() is None, simulator.output
    for stranger in strangers:
        assert stranger.wait() == 0, stranger.output
    return [json.loads(s.output.strip().splitlines()[-1]) for s in strangers]


@pytest.mark.parametrize(
    "calls",
    [300, pytest.param(10_000, marks=[pytest.mark.slow, pytest.mark.timeout(1800)])],
)
def test_mixed_calls_from_four_clients(tmp_path, capsys, calls) -> None:
    scenarios = tmp_path / "scenarios"
    scenarios.mkdir()
    (scenarios / "endless.yaml").write_text(ENDLESS)
    with graph(tmp_path) as made:
        simulator = made.simulator(
            scenario="endless", scenario_dirs=f"['{scenarios}']", record=tmp_path / "bag", **DEEP
        )
        made.listen("events", "train_state")
        pid = simulator.process.pid
        # What is made once, on first use, is no leak: nor are the pools of as many calls.
        reports = storm(made, simulator, calls, range(4))
        before = held(pid)
        reports += storm(made, simulator, calls, range(4, 8))
        after = held(pid)
        assert made.ask("set_simulation_state", state=2).success
        told = made.ask("get_events").events
        made.until(lambda: len(made.heard["events"]) >= len(told), "all events are heard")
        heard = [event.text for event in made.heard["events"]]
        states = made.heard["train_state"]
        assert simulator.end() == 0, simulator.output
    assert "Traceback" not in simulator.output
    said = "".join(p.output for p in made.processes if p is not simulator)
    assert sum(r["answered"] for r in reports) == 2 * (calls // 4) * 4, said
    assert [r["wrong"] for r in reports] == [[]] * 8

    # Events are those of the accepted commands, in order, and nothing else.
    accepted = [entry for r in reports for entry in r["accepted"]]
    breaks = [e for e in told if e.kind_name == "rail_break_set"]
    # A request that was sent again may have been carried out before.
    resent = sum(r["resent"] for r in reports)
    asked = sum(service == "inject_rail_break" for service, _ in accepted)
    assert asked <= len(breaks) <= asked + resent, said
    assert {e.kind_name for e in told} == {"run_loaded", "rail_break_set"}
    assert heard == [event.text for event in told]
    assert {m.run_id for m in states} == {told[0].run_id}
    assert [b.time - a.time for a, b in zip(states, states[1:])] == pytest.approx(
        [0.02] * (len(states) - 1), abs=1e-9
    )
    run = read_manifest(tmp_path / "bag").run
    assert len(accepted) <= len(run.commands) <= len(accepted) + resent
    refused = sum(r["refused"] for r in reports)
    assert min(refused, 1000) <= len(run.refused) <= min(refused + resent, 1001)
    # The run without the refused calls is the same, to the bit.
    assert main(["replay", str(tmp_path / "bag")]) == 0, capsys.readouterr().out

    grown = (after["memory"] - before["memory"]) / MEGABYTE
    print(f"{calls} calls: {grown:.1f} MB more, {before} before, {after} after")
    # The manifest's list of commands is kept; a leaked request (2 MB) or event list is more.
    assert grown < 10.0 + calls * 0.001
    for what in ("files", "threads", "shared"):
        assert after[what] <= before[what] + 4, (what, before, after)
