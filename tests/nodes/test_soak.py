"""Many loads, breaks, brakes and resets: nothing grows, and the last run is like the first."""

from __future__ import annotations

import itertools
import math
from typing import Any

import pytest

pytest.importorskip("rclpy")
pytest.importorskip("derail_msgs")

from msg_adapters.common import stamp_of
from tests.nodes.graph import PAUSED, PLAYING, Graph, graph
from tests.nodes.support import ENDLESS, OFF_THE_TRACK, SMALL
from tests.nodes.test_misuse import MEGABYTE, held

pytestmark = pytest.mark.ros

KEPT = 50
"""Messages of a topic that the test itself remembers."""


def ended(made: Graph, run_id: str) -> Any:
    """Wait for the final outcome of a run."""

    def final() -> Any:
        for messages in made.heard.values():
            del messages[:-KEPT]
        mine = [m for m in made.heard["outcome"] if m.run_id == run_id and m.is_final]
        return mine[0] if mine else None

    return made.until(final, "the run ends")


def told(outcome: Any) -> tuple[Any, ...]:
    """What must be the same each time, to the bit."""
    return (
        outcome.status_name,
        outcome.time,
        outcome.step,
        tuple(outcome.derailed_cars),
        # As text: what does not exist is NaN, which equals nothing.
        [(q.key, repr(list(q.values))) for q in (*outcome.measures, *outcome.cars)],
        [(q.key, repr(list(q.values))) for q in outcome.energy],
    )


def one_round(made: Graph, number: int) -> dict[str, tuple[Any, ...]]:
    """Load, play, reset, break, brake, fail, load again; what came of each run."""
    found = {}
    answer = made.ask("load_consist", scenario_name="base_train")
    assert answer.success, answer.message
    found["base train"] = told(ended(made, answer.run_id))
    answer = made.ask("reset_simulation", mode=number % 2)
    assert answer.success and made.ask("set_simulation_state", state=PLAYING).success
    found["again"] = told(ended(made, answer.run_id))
    assert found["again"] == found["base train"]

    # Commands while paused act at a step that is always the same one.
    answer = made.ask("load_consist", scenario_yaml=ENDLESS, start_paused=True)
    assert made.ask("step_simulation", ticks=40).success
    assert made.ask("inject_rail_break", car=2).success
    assert not made.ask("inject_rail_break", track_coordinate=math.nan).success
    assert made.ask("trigger_emergency_brake", source=2, delay_s=0.5).success
    assert made.ask("set_simulation_state", state=PLAYING).success
    found["braked"] = told(ended(made, answer.run_id))

    assert not made.ask("load_consist", scenario_yaml=SMALL.replace("80", ".nan")).success
    answer = made.ask("load_consist", scenario_yaml=OFF_THE_TRACK)
    found["failed"] = told(ended(made, answer.run_id))
    assert found["failed"][0] == "failed"
    answer = made.ask("load_consist", scenario_yaml=SMALL)
    found["small"] = told(ended(made, answer.run_id))
    events = made.ask("get_events").events
    assert events[0].kind_name == "run_loaded" and events[-1].kind_name == "run_ended"
    return found


@pytest.mark.parametrize(
    "seconds",
    [80.0, pytest.param(3600.0, marks=[pytest.mark.slow, pytest.mark.timeout(3000)])],
)
def test_nothing_grows_and_the_state_stays_right(tmp_path, seconds) -> None:
    """So many seconds of simulated time, an hour in the slow one."""
    with graph(tmp_path) as made:
        simulator = made.simulator(scenario="", speed_factor=0.0)
        made.listen("outcome", "consist", "events")
        pid = simulator.process.pid
        first = one_round(made, 0)
        before, simulated = {}, 0.0
        for number in itertools.count(1):
            assert one_round(made, number) == first
            simulated += sum(run[1] for run in first.values())
            if not before and simulated >= 0.2 * seconds:
                before = held(pid)  # what is made once has been made
            if simulated >= seconds:
                break
        after = held(pid)
        assert made.ask("set_simulation_state", state=PAUSED).success
        times = [stamp_of(m) for m in made.heard["outcome"]]
        assert simulator.end() == 0, simulator.output
    assert times and "Traceback" not in simulator.output
    grown = (after["memory"] - before["memory"]) / MEGABYTE
    print(f"{simulated:.0f} s simulated: {grown:.1f} MB more, {before} before, {after} after")
    assert grown < 12.0
    for what in ("files", "threads", "shared"):
        assert after[what] <= before[what] + 4, (what, before, after)
