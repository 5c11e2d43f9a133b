"""Another engine than the planar one in the node: nothing but its name is different."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rclpy")
pytest.importorskip("derail_msgs")

from derail_ros.recording import read_manifest
from derail_ros.recording.reader import read_bag
from derail_ros.vocabulary.measures import MEASURES
from derail_ros.vocabulary.params import GRAVITY
from msg_adapters.topics import STATE_TOPICS
from tests.nodes.graph import DEEP, graph
from tests.nodes.support import SMALL
from tests.second_engine import FRICTION, MEASURE

pytestmark = pytest.mark.ros

SPEED = 10.0
SCENARIO = f"""\
version: 1
title: A bar
model: bar
train: {{speed_kmh: {3.6 * SPEED}, consist: [{{car: box_car, count: 4}}]}}
initiation: {{await_command: true}}
"""
DECELERATION = FRICTION * GRAVITY
SLIDE = SPEED**2 / (2.0 * DECELERATION)


def place(time):
    """Where the train is at a time (s), seen from its start, m."""
    time = np.minimum(time, SPEED / DECELERATION)
    return SPEED * time - 0.5 * DECELERATION * time**2


def test_a_bar_slides_through_node_and_recorder(tmp_path, monkeypatch) -> None:
    (tmp_path / "scenarios").mkdir()
    (tmp_path / "scenarios" / "bar.yaml").write_text(SCENARIO)
    with graph(tmp_path) as made:
        recorder = made.start("recorder", path=tmp_path / "heard", stop_when_final=True)
        simulator = made.simulator(
            module="tests.nodes.bar_simulator",
            ready=False,
            scenario="bar",
            scenario_dirs=f"['{tmp_path / 'scenarios'}']",
            await_listeners=2,
            record=tmp_path / "own",
            **DEEP,
        )
        heard = made.listen(*STATE_TOPICS, "outcome")
        made.until(lambda: heard["train_state"], "the run goes on", simulator)
        refused = made.ask("inject_rail_break", track_coordinate=5.0)
        assert not refused.success and "bar has no rail breaks" in refused.message
        refused = made.ask("trigger_emergency_brake")
        assert not refused.success and "bar has no brakes" in refused.message
        made.until(lambda: any(m.is_final for m in heard["outcome"]), "the run ends", simulator)
        assert recorder.wait() == 0, recorder.output
        # The planar engine in the same node, one run after the other.
        answer = made.ask("load_consist", scenario_yaml=SMALL, start_paused=True)
        assert answer.success, answer.message
        assert made.ask("step_simulation", ticks=5).success
        assert simulator.end() == 0, simulator.output
    assert "Traceback" not in simulator.output + recorder.output
    assert "starting anyway" not in simulator.output
    assert "no message missed" in recorder.output

    outcome = next(m for m in heard["outcome"] if m.is_final)
    run = outcome.run_id
    states = [m for m in heard["train_state"] if m.run_id == run]
    times = np.array([m.time for m in states])
    assert np.allclose(np.diff(times), 0.02) and times[0] == 0.0
    x = np.array([m.x for m in states])
    assert np.allclose(x - x[0], place(times)[:, None])
    assert outcome.status_name == "at rest"
    assert {q.key: list(q.values) for q in outcome.measures}["slide_m"] == pytest.approx([SLIDE])
    ledger = [m for m in heard["energy"] if m.run_id == run][-1]
    entries = {q.key: q.values[0] for q in ledger.entries}
    assert entries["sliding"] == pytest.approx(entries["initial"])

    own, other = read_manifest(tmp_path / "own").runs, read_manifest(tmp_path / "heard").run
    assert [entry.model for entry in own] == ["bar", "planar"]
    assert own[0].run_id == other.run_id == run and own[0].status == other.status == "at rest"
    assert own[0].outcome["slide_m"] == pytest.approx(SLIDE)
    assert len(own[0].refused) == 2
    monkeypatch.setitem(MEASURES, MEASURE.key, MEASURE)
    for bag in ("own", "heard"):
        recorded = read_bag(tmp_path / bag, run=run)
        assert recorded.outcome.values["slide_m"] == pytest.approx(SLIDE)
