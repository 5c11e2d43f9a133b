"""The simulator without a graph: pacing, states, commands, runs, recordings."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from derail_ros.engine import PlanarSimulation
from derail_ros.nodes import commands, loop
from derail_ros.nodes.commands import Answer
from derail_ros.nodes.core import State
from derail_ros.recording import RecordingError, read_manifest
from derail_ros.recording.run import record_run
from derail_ros.vocabulary.status import BRAKE_MODES, BRAKE_SOURCES
from msg_adapters.common import TIME_ZERO, stamp_of
from msg_adapters.topics import STATE_TOPICS
from tests.nodes.bench import BAD, Simulator, Wall
from tests.nodes.support import ENDLESS, OFF_THE_TRACK, SMALL, ready, small


class Bench(Simulator):
    """A simulator with a clock that moves when it is told to."""

    def __init__(self, **settings) -> None:
        self.wall = Wall()
        super().__init__(self.wall, **settings)

    def load(self, text: str = SMALL, paused: bool = False) -> Answer:
        request = {"scenario_yaml": text, "start_paused": paused}
        return self.core.load(ready(text), request)

    def go(self, seconds: float, step: float = 0.001) -> None:
        """Let wall time pass."""
        for _ in range(round(seconds / step)):
            self.wall.now += step
            self.loop.work()

    def run(self, seconds: float, each: float = math.inf, do: Callable[[], Any] = int) -> int:
        """Work whenever there is work, and do something now and then; gives how often."""
        end, woken = self.wall.now + seconds, 0
        again = self.wall.now + each
        while self.wall.now < end:
            due = self.loop.work()
            self.wall.now = min(max(due, self.wall.now + 1e-4), again)
            woken += 1
            if self.wall.now >= again:
                do()
                again += each
        return woken

    def ticks(self) -> int:
        return len(self.heard.of("train_state"))


@pytest.fixture
def bench() -> Bench:
    return Bench()


# --- pacing ----------------------------------------------------------------------------------


@pytest.mark.parametrize("factor", [0.5, 1.0, 4.0])
def test_simulation_time_follows_wall_time(factor) -> None:
    bench = Bench(speed_factor=factor)
    bench.load(ENDLESS)
    bench.go(2.0)
    assert bench.core.session.time == pytest.approx(2.0 * factor, abs=0.021)


def test_a_stall_slows_the_run_and_is_never_made_up_for() -> None:
    bench = Bench(speed_factor=1.0)
    bench.load(ENDLESS)
    bench.go(1.0)
    before = bench.ticks()
    bench.wall.now += 3.0  # the machine was busy elsewhere
    bench.loop.work()
    assert bench.ticks() == before + 1
    bench.go(1.0)
    assert bench.ticks() - before == pytest.approx(51, abs=2)
    assert bench.core.pace.overruns == 1


def test_small_delays_are_made_up_for() -> None:
    bench = Bench(speed_factor=1.0)
    bench.load(ENDLESS)
    for k in range(400):
        bench.wall.now += 0.004 if k % 2 else 0.006
        bench.loop.work()
    assert bench.core.session.time == pytest.approx(2.0, abs=0.03)
    assert bench.core.pace.overruns == 0


def test_a_change_of_speed_begins_at_once() -> None:
    bench = Bench(speed_factor=1.0)
    bench.load(ENDLESS)
    bench.go(1.0)
    bench.core.settings.speed_factor = 5.0
    bench.core.pace.change()
    bench.go(1.0)
    assert bench.core.session.time == pytest.approx(6.0, abs=0.1)


def test_speed_zero_runs_to_the_end_without_waiting() -> None:
    bench = Bench(speed_factor=0.0)
    bench.load()
    for _ in range(5000):
        bench.loop.work()
        if bench.core.finished:
            break
    assert bench.core.finished and bench.core.state == State.PAUSED
    assert bench.heard.last("outcome").is_final


def test_at_full_load_the_loop_works_for_a_slice_at_a_time() -> None:
    """A request waits for one slice at most, so that services answer soon."""
    bench = Bench(speed_factor=0.0)
    bench.load(ENDLESS)
    session = bench.core.session
    advance, budgets = session.advance, []

    def costly(budget: float) -> bool:
        budgets.append(budget)
        bench.wall.now += 0.3 * loop.SLICE
        return advance()

    session.advance = costly
    for _ in range(20):
        before = bench.wall.now
        assert bench.loop.work() <= bench.wall.now
        assert bench.wall.now - before == pytest.approx(1.2 * loop.SLICE)
    assert max(budgets) <= loop.SLICE


def test_work_says_when_it_is_needed_again() -> None:
    bench = Bench(speed_factor=1.0, publish_clock=False, marker_rate=0.0)
    assert bench.loop.work() > bench.wall.now
    bench.load(ENDLESS)
    bench.loop.work()
    assert bench.loop.work() == pytest.approx(bench.wall.now + 0.02)
    bench.core.settings.speed_factor = 0.0
    assert bench.core.session is not None


@pytest.mark.parametrize("rates", [(50.0, 1.0), (10.0, 0.0), (333.0, 7.0)])
def test_neither_rate_nor_speed_changes_what_is_computed(rates) -> None:
    bare = PlanarSimulation(small().to_params())
    bare.run()
    bench = Bench(state_rate=rates[0], speed_factor=rates[1])
    bench.load()
    while not bench.core.finished:
        bench.wall.now += 0.01
        bench.loop.work()
    assert bench.core.session.simulation.state_hash() == bare.state_hash()


# --- messages --------------------------------------------------------------------------------


def test_the_clock_goes_on_while_paused(bench: Bench) -> None:
    bench.load(ENDLESS)
    bench.go(1.0)
    bench.core.set_state(State.PAUSED)
    bench.heard.raw.clear()
    bench.go(1.0)
    clocks = bench.heard.of("/clock")
    assert len(clocks) == pytest.approx(100, abs=3)
    assert {(c.clock.sec, c.clock.nanosec) for c in clocks} == {divmod(bench.core.stamp, 10**9)}
    assert bench.ticks() == 0


@pytest.mark.parametrize(
    ("clock", "markers"), [(100.0, 15.0), (37.0, 11.0), (60.0, 40.0), (5.0, 20.0)]
)
def test_clock_and_markers_keep_their_rates_whatever_they_are(clock, markers) -> None:
    """Woken up when it wants to be: what goes out together is not sent more often, nor less."""
    bench = Bench(clock_rate=clock, marker_rate=markers)
    bench.load(ENDLESS)
    woken = bench.run(10.0)
    # A clock goes out before each state, too: with the next one due if that is near.
    least = max(clock, 50.0)
    most = clock if clock % 50.0 == 0.0 else clock + 50.0
    assert 10.0 * least - 3 <= len(bench.heard.of("/clock")) <= 10.0 * most + 3
    assert len(bench.heard.of("markers")) == pytest.approx(10.0 * markers, abs=3)
    assert bench.ticks() == pytest.approx(500, abs=2)
    if (clock, markers) == (100.0, 15.0):
        assert woken < 1050, "one waking up serves the clock, the ticks and the markers"


def test_the_clock_keeps_its_rate_when_the_ticks_fall_behind_all_the_time() -> None:
    bench = Bench(speed_factor=1000.0)
    bench.load(ENDLESS)
    session = bench.core.session
    advance = session.advance

    def costly(budget: float) -> bool:
        bench.wall.now += 1e-3
        return advance()

    session.advance = costly
    bench.run(3.0)
    assert bench.core.pace.overruns > 200
    # Each tick has a clock before it; there are far more ticks than the 300 clocks of 3 s.
    assert len(bench.heard.of("/clock")) == pytest.approx(bench.ticks(), abs=5)
    assert bench.ticks() > 1000


def test_a_client_that_changes_parameters_all_the_time_holds_up_nothing(bench: Bench) -> None:
    """A slider: a change comes more often than a tick."""
    bench.load(ENDLESS)

    bench.run(3.0, each=0.015, do=bench.core.pace.change)
    assert bench.ticks() == pytest.approx(150, abs=2)
    assert len(bench.heard.of("/clock")) == pytest.approx(300, abs=3)
    assert len(bench.heard.of("markers")) == pytest.approx(45, abs=3)
    assert bench.core.pace.overruns == 0


@pytest.mark.parametrize("state", [State.PLAYING, State.PAUSED])
def test_a_rate_that_is_raised_is_taken_up_at_once(state) -> None:
    bench = Bench(speed_factor=0.01, clock_rate=1.0, marker_rate=0.01)
    bench.load(ENDLESS)
    bench.core.set_state(state)
    bench.run(1.5)
    bench.heard.raw.clear()
    settings = bench.core.settings
    settings.speed_factor, settings.clock_rate, settings.marker_rate = 1.0, 100.0, 15.0
    bench.core.pace.change()
    bench.run(1.0)
    assert len(bench.heard.of("/clock")) == pytest.approx(100, abs=2)
    playing = state == State.PLAYING
    assert bench.ticks() == pytest.approx(50 if playing else 0, abs=2)
    assert len(bench.heard.of("markers")) == pytest.approx(15 if playing else 1, abs=2)


def test_after_a_time_without_a_pace_nothing_is_late(bench: Bench, monkeypatch) -> None:
    monkeypatch.setattr(loop, "SLICE", 0.0)  # the clock stands still while a slice is computed
    bench.load(ENDLESS)
    settings = bench.core.settings
    settings.speed_factor = 0.0
    bench.core.pace.change()
    bench.go(1.0, step=0.1)
    settings.speed_factor = 1.0
    bench.core.pace.change()
    before = bench.ticks()
    bench.run(1.0)
    assert bench.ticks() - before == pytest.approx(50, abs=2)
    assert bench.core.pace.overruns == 0


def test_a_run_that_begins_in_the_middle_of_a_tick_leaves_the_loop_at_rest(monkeypatch) -> None:
    """What was left of the tick is forgotten with its run."""
    monkeypatch.setattr(loop, "SLICE", 0.0)  # one step of the engine at a time
    bench = Bench(state_rate=1.0)
    bench.load(ENDLESS)
    bench.wall.now += 1.0
    assert bench.loop.work() <= bench.wall.now
    session = bench.core.session
    assert session.tick == 0 and session.step == 1
    bench.core.reset(0)
    assert bench.run(0.9) < 200


def test_markers_come_at_their_rate_and_seldom_while_nothing_moves(bench: Bench) -> None:
    bench.load(ENDLESS)
    bench.go(2.0)
    assert len(bench.heard.of("markers")) == pytest.approx(30, abs=2)
    assert bench.heard.of("markers")[0].markers[0].action == 3
    bench.core.set_state(State.PAUSED)
    bench.go(0.1)
    bench.heard.raw.clear()
    bench.go(5.0)
    assert len(bench.heard.of("markers")) == pytest.approx(5, abs=1)


def test_frames_that_nobody_listens_to_are_not_made(bench: Bench) -> None:
    bench.heard.unheard.add("/tf")
    bench.load(ENDLESS)
    bench.go(0.2)
    names = [name for name, _ in bench.heard.raw]
    assert "/tf" not in names and names.count("joint_states") == bench.ticks() > 5
    bench.heard.unheard.clear()
    bench.go(0.2)
    assert "/tf" in [name for name, _ in bench.heard.raw[len(names) :]]


def test_frames_come_unless_they_are_not_wanted(bench: Bench) -> None:
    bench.load(ENDLESS)
    bench.go(0.2)
    assert len([name for name, _ in bench.heard.raw if name == "/tf"]) == bench.ticks() > 5
    other = Bench(publish_tf=False)
    other.load(ENDLESS)
    other.go(0.2)
    assert not [name for name, _ in other.heard.raw if name.startswith("/tf")]


def test_states_are_on_a_grid_of_whole_ticks(bench: Bench) -> None:
    bench.load(ENDLESS)
    bench.go(1.0)
    stamps = [stamp_of(m) for m in bench.heard.of("car_poses")]
    assert stamps == [TIME_ZERO + 20_000_000 * k for k in range(len(stamps))]
    for topic in STATE_TOPICS:
        assert [stamp_of(m) for m in bench.heard.of(topic)] == stamps


def test_diagnostics_tell_the_factor_asked_and_got() -> None:
    bench = Bench(speed_factor=2.0)
    bench.load(ENDLESS)
    bench.go(3.5)
    (status,) = bench.heard.last("/diagnostics").status
    values = {pair.key: pair.value for pair in status.values}
    assert status.level == 0
    assert float(values["real_time_factor_asked"]) == 2.0
    assert float(values["real_time_factor"]) == pytest.approx(2.0, rel=0.05)
    assert float(values["max_coupler_gap"]) < 1e-3
    assert abs(float(values["energy_residual_relative"])) < 1e-3
    assert {"mean_step_size", "overruns", "refused_commands", "run_id"} <= set(values)


def test_diagnostics_warn_when_the_run_is_slower_than_asked() -> None:
    bench = Bench(speed_factor=1.0)
    bench.load(ENDLESS)
    bench.go(1.1)
    bench.go(3.0, step=0.06)  # one look each 60 ms: a tick each, not three
    (status,) = bench.heard.last("/diagnostics").status
    assert status.level == 1 and "slower than asked" in status.message


def test_diagnostics_do_not_warn_of_a_pace_that_has_just_changed(bench: Bench) -> None:
    bench.load(ENDLESS)
    bench.run(1.5)
    bench.core.settings.speed_factor = 5.0
    bench.core.pace.change()
    bench.run(1.9)
    bench.core.set_state(State.PAUSED)
    bench.run(0.3)
    bench.core.set_state(State.PLAYING)
    bench.run(1.9)
    told = [message.status[0] for message in bench.heard.of("/diagnostics")]
    assert len(told) >= 5 and {status.level for status in told} == {0}
    assert told[-1].message == "playing"


# --- states ----------------------------------------------------------------------------------


def test_without_a_run_nothing_but_loading_is_possible(bench: Bench) -> None:
    core = bench.core
    assert core.state == State.STOPPED
    assert core.set_state(State.STOPPED).success
    for answer in (
        core.set_state(State.PLAYING),
        core.set_state(State.PAUSED),
        core.reset(0),
        core.inject_rail_break(1.0, 0),
        core.trigger_emergency_brake(0, 0, 0, 0.0),
        *bench.step(1),
    ):
        assert not answer.success and answer.message == "no run is loaded"
    assert len(bench.heard.of("command_log")) == 7


def test_requesting_the_current_state_succeeds(bench: Bench) -> None:
    bench.load(ENDLESS)
    answer = bench.core.set_state(State.PLAYING)
    assert answer.success and answer.message == "already playing"


def test_steps_only_while_paused(bench: Bench) -> None:
    bench.load(ENDLESS)
    (refused,) = bench.step(3)
    assert not refused.success and refused.message == "the state must be paused, it is playing"
    bench.core.set_state(State.PAUSED)
    before = bench.core.session.tick
    (answer,) = bench.step(7)
    assert answer.success and answer.message == "7 of 7 ticks done"
    assert bench.core.session.tick == before + 7
    assert answer.stamp == bench.core.stamp == TIME_ZERO + 20_000_000 * (before + 7)
    bench.go(1.0)
    assert bench.core.session.tick == before + 7
    (none,) = bench.step(0)
    assert not none.success


def test_a_step_request_that_is_overtaken_is_answered(bench: Bench) -> None:
    bench.load(ENDLESS, paused=True)
    answers: list[Answer] = []
    bench.core.step_simulation(10**9, answers.append)
    again: list[Answer] = []
    bench.core.step_simulation(1, again.append)
    assert again[0].message == "another step_simulation is being carried out"
    bench.core.set_state(State.PLAYING)
    assert len(answers) == 1 and not answers[0].success
    assert "the state became playing" in answers[0].message


def test_steps_end_with_the_run(bench: Bench) -> None:
    bench.load(paused=True)
    (answer,) = bench.step(10**6)
    assert not answer.success and "the run has ended" in answer.message
    (answer,) = bench.step(1)
    assert not answer.success
    assert not bench.core.set_state(State.PLAYING).success
    assert not bench.core.inject_rail_break(1.0, 0).success


def test_stopping_goes_back_to_the_start(bench: Bench) -> None:
    bench.load(ENDLESS)
    bench.go(1.0)
    run = bench.core.run_id
    assert bench.core.set_state(State.STOPPED).success
    assert bench.core.run_id != run and bench.core.session.tick == 0
    bench.go(1.0)
    assert bench.core.session.tick == 0
    assert not bench.step(1)[0].success
    assert bench.core.set_state(State.PLAYING).success
    bench.go(0.5)
    assert bench.core.session.tick > 10


def test_quitting_needs_permission(bench: Bench) -> None:
    answer = bench.core.set_state(State.QUITTING)
    assert not answer.success and "allow_quit" in answer.message
    bench.core.settings.allow_quit = True
    assert bench.core.set_state(State.QUITTING).success
    assert bench.core.state == State.QUITTING
    assert not bench.core.set_state(17).success


# --- runs ------------------------------------------------------------------------------------


def test_a_new_run_has_a_new_identity_and_later_stamps(bench: Bench) -> None:
    bench.load(ENDLESS)
    bench.go(1.0)
    first, stamp = bench.core.run_id, bench.core.stamp
    answer = bench.core.reset(0)
    assert answer.success and answer.run_id == bench.core.run_id != first
    assert bench.core.stamp == answer.stamp == stamp + 20_000_000
    assert bench.heard.runs == 2
    events = bench.heard.of("events")
    ends = [e for e in events if e.run_id == first]
    assert ends[-1].kind_name == "run_ended" and ends[-1].cause == "command"
    begins = [e for e in events if e.run_id != first]
    assert begins[0].kind_name == "run_reset" and begins[0].sequence == 0
    assert stamp_of(begins[0]) == bench.core.stamp and begins[0].time == 0.0
    outcomes = [o for o in bench.heard.of("outcome") if o.run_id == first]
    assert outcomes[-1].status_name == "stopped" and outcomes[-1].is_final
    for topic in ("consist", "track", "track_markers"):
        assert len(bench.heard.of(topic)) == 2
    bench.go(0.5)
    clears = [m.markers[0].action == 3 for m in bench.heard.of("markers")]
    assert clears[:4] == [True, True, True, False] and not clears[-1]
    assert sum(clears) == 6


def test_a_run_that_never_left_its_start_ends_too(bench: Bench) -> None:
    bench.load(ENDLESS, paused=True)
    first = bench.core.run_id
    bench.core.reset(0)
    mine = [e.kind_name for e in bench.heard.of("events") if e.run_id == first]
    assert mine == ["run_loaded", "run_ended"]
    outcomes = [o for o in bench.heard.of("outcome") if o.run_id == first]
    assert [o.is_final for o in outcomes] == [False, True]
    assert outcomes[-1].status_name == "stopped"


def test_reset_to_zero_sets_time_to_zero(bench: Bench) -> None:
    bench.load(ENDLESS)
    bench.go(1.0)
    answer = bench.core.reset(1)
    assert answer.success and answer.stamp == TIME_ZERO == bench.core.stamp


def test_reset_keeps_playing_and_stays_paused(bench: Bench) -> None:
    bench.load(ENDLESS)
    bench.go(0.5)
    bench.core.reset(0)
    assert bench.core.state == State.PLAYING
    bench.core.set_state(State.PAUSED)
    bench.core.reset(0)
    assert bench.core.state == State.PAUSED


def test_a_run_that_has_ended_begins_again_when_reset(bench: Bench) -> None:
    bench.load(paused=True)
    bench.step(10**6)
    bench.core.reset(0)
    assert not bench.core.finished
    assert bench.step(1)[0].success


@pytest.mark.parametrize(("service", "fields", "reason"), BAD)
def test_a_refused_request_leaves_the_run_alone(bench: Bench, service, fields, reason) -> None:
    bench.load(ENDLESS)
    bench.go(0.2)
    run = bench.core.run_id
    answer = bench.ask(service, **fields)
    assert not answer.success and reason in answer.message
    bench.go(0.2)
    assert bench.core.run_id == run and bench.core.session.time == pytest.approx(0.4, abs=0.03)
    assert bench.core.session.simulation.rail_breaks == []
    entry = bench.heard.last("command_log")
    assert (entry.accepted, entry.message) == (False, answer.message)


def test_another_speed_is_part_of_the_scenario(bench: Bench) -> None:
    prepared = bench.core.prepare("", SMALL, 36.0)
    bench.core.load(prepared, {"start_paused": True})
    assert bench.heard.last("consist").initial_speed == pytest.approx(10.0)
    assert "speed_kmh: 36" in bench.heard.last("consist").scenario_yaml


# --- commands --------------------------------------------------------------------------------


def test_a_break_opens_at_once_and_the_track_tells(bench: Bench) -> None:
    bench.load(ENDLESS, paused=True)
    bench.step(5)
    bench.heard.raw.clear()
    answer = bench.core.inject_rail_break(55.5, 0, "me")
    assert answer.success and answer.value == 55.5
    event = bench.heard.last("events")
    assert event.kind_name == "rail_break_set" and event.cause == "command"
    assert bench.heard.last("track").rail_break_coordinate.tolist() == [55.5]
    assert bench.heard.last("track").rail_break_time[0] == event.time
    assert any(m.ns == "rail_breaks" for m in bench.heard.last("track_markers").markers)
    entry = bench.heard.last("command_log")
    assert entry.accepted and entry.caller == "me" and entry.step == answer.step
    assert json.loads(entry.request_json) == {"track_coordinate": 55.5, "car": 0}
    assert stamp_of(entry) == answer.stamp == bench.core.session.context.stamp(entry.time)


def test_a_second_break_at_a_place_is_told(bench: Bench) -> None:
    bench.load(ENDLESS, paused=True)
    before = len(bench.core.session.simulation.rail_breaks)
    assert bench.core.inject_rail_break(0.0, 2).success, "0 is a field left out"
    first = bench.core.inject_rail_break(55.5, 0)
    assert first.success and first.message == "rail break at 55.500 m"
    again = bench.core.inject_rail_break(55.5, 0)
    assert again.success and "already broken" in again.message
    assert "already" not in bench.core.inject_rail_break(55.6, 0).message
    assert len(bench.core.session.simulation.rail_breaks) == before + 4


def test_a_run_from_a_text_is_called_by_its_title(bench: Bench) -> None:
    prepared = bench.core.prepare("", SMALL)
    answer = bench.core.load(prepared, {"start_paused": True})
    title = yaml.safe_load(SMALL)["title"]
    assert bench.heard.last("consist").scenario_name == f"{title} (inline)"
    assert f"loaded {title} (inline)" in answer.message and "<inline>" not in answer.message


def test_a_break_under_a_car_opens_ahead_of_its_front_truck(bench: Bench) -> None:
    bench.load(ENDLESS, paused=True)
    bench.step(5)
    session = bench.core.session
    front = float(session.simulation.sample().truck_coordinate[1, 0])
    answer = bench.core.inject_rail_break(0.0, 2)
    assert answer.value == pytest.approx(front + 0.5)
    bench.core.set_state(State.PLAYING)
    bench.go(1.0)
    kinds = [e.kind_name for e in bench.heard.of("events")]
    assert "truck_derailed" in kinds


def test_what_a_stranger_sends_is_kept_short(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(commands, "MAX_REFUSED", 3)
    bench = Bench(record=str(tmp_path / "bag"))
    bench.load(ENDLESS, paused=True)
    request = {"scenario_yaml": "y" * 5_000_000, "start_paused": True}
    for _ in range(5):
        refusal = ValueError("no: " + "z" * 10_000)
        bench.core.load(refusal, request, "c" * 10_000)
    entry = bench.heard.last("command_log")
    for text in (json.loads(entry.request_json)["scenario_yaml"], entry.caller, entry.message):
        assert 1000 < len(text) < 1100 and text.endswith(" characters)")
    bench.core.close()
    refused = read_manifest(tmp_path / "bag").run.refused
    assert len(refused) == 4 and refused[-1]["reason"] == "2 more, not listed"
    assert len(refused[0]["request"]["scenario_yaml"]) < 1100


def test_commands_have_an_end(bench: Bench, monkeypatch) -> None:
    monkeypatch.setattr(commands, "MAX_BREAKS", 2)
    monkeypatch.setattr(commands, "MAX_COMMANDS", 4)
    bench.load(ENDLESS, paused=True)
    answers = [bench.core.inject_rail_break(500.0 + k, 0) for k in range(3)]
    assert [a.success for a in answers] == [True, True, False]
    assert "2 breaks" in answers[2].message
    answers = [bench.core.trigger_emergency_brake(0, 0, 0, 9.0) for _ in range(3)]
    assert [a.success for a in answers] == [True, True, False]
    assert "4 commands" in answers[2].message


def test_a_brake_that_was_made_before_says_that_it_changes_nothing(bench: Bench) -> None:
    bench.load(ENDLESS, paused=True)
    brake = bench.core.trigger_emergency_brake
    assert brake(0, 3, 2, 1.0).message == "applied"
    bench.step(5)
    again = "applied; it changes nothing, the same was commanded before"
    assert brake(0, 3, 2, 1.0).message == again
    for other in ((0, 3, 2, 0.0), (1, 3, 2, 1.0), (0, 3, 1, 1.0), (0, 0, 0, 1.0)):
        assert brake(*other).message == "applied", other
    bench.step(100)
    texts = [e.text for e in bench.heard.of("events") if e.kind_name == "brakes_triggered"]
    assert "emergency brakes: command: conventional from car 2" in texts
    assert not any("the car" in text for text in texts)


def test_what_was_commanded_is_logged_and_what_was_refused_by_its_service(bench: Bench) -> None:
    bench.load(ENDLESS, paused=True)
    bench.core.inject_rail_break(500.0, 0)
    bench.core.trigger_emergency_brake(0, 0, 0, 0.0)
    told = [text for level, text in bench.heard.logs if level == "info"]
    assert "inject_rail_break at 0.000 s: rail break at 500.000 m" in told
    assert "trigger_emergency_brake at 0.000 s: applied" in told
    answers: list[Answer] = []
    bench.core.step_simulation(0, answers.append, service="simulate_steps", field="steps")
    request = {"scenario_name": "x", "start_paused": True}
    bench.core.load(ValueError("no"), request, service="load_world")
    warned = [text for level, text in bench.heard.logs if level == "warning"]
    assert warned[-2:] == [
        "simulate_steps refused: steps must be at least 1, got 0", "load_world refused: no"
    ]  # fmt: skip


def test_a_run_that_is_over_says_so_in_one_sentence(bench: Bench) -> None:
    bench.load(paused=True)
    bench.step(10**6)
    core = bench.core
    answers = [
        core.inject_rail_break(500.0, 0), core.trigger_emergency_brake(0, 0, 0, 0.0),
        core.set_state(State.PLAYING), *bench.step(1),
    ]  # fmt: skip
    assert {(a.success, a.message) for a in answers} == {
        (False, "the run has ended; reset it or load another")
    }


def test_brakes_stop_the_train(bench: Bench) -> None:
    bench.load(ENDLESS, paused=True)
    assert bench.core.trigger_emergency_brake(1, 2, 0, 0.5).success
    bench.step(10**6)
    assert bench.heard.last("outcome").status_name == "at rest"
    kinds = [e.kind_name for e in bench.heard.of("events")]
    assert kinds.count("brakes_triggered") == 1
    assert kinds.count("brake_signal_reached") == 3


def test_the_numbers_of_the_services_mean_what_their_files_say() -> None:
    folder = Path(__file__).resolve().parents[2] / "derail_msgs" / "srv"

    def numbers(service: str, prefix: str) -> list[str]:
        text = (folder / f"{service}.srv").read_text(encoding="utf-8")
        found = re.findall(rf"^uint8 {prefix}_(\w+)=(\d+)", text, re.MULTILINE)
        assert [int(number) for _, number in found] == list(range(len(found)))
        return [name.lower() for name, _ in found]

    assert numbers("TriggerEmergencyBrake", "MODE") == list(BRAKE_MODES)
    assert numbers("TriggerEmergencyBrake", "SOURCE") == list(BRAKE_SOURCES)
    assert numbers("SetSimulationState", "STATE") == [state.name.lower() for state in State]


@pytest.mark.parametrize(("source", "first"), [(0, [1]), (1, [3]), (2, [1, 3]), (3, [2])])
@pytest.mark.parametrize("mode", range(4))
def test_brakes_of_each_kind_from_each_place(bench: Bench, mode, source, first) -> None:
    bench.load(ENDLESS, paused=True)
    assert bench.core.trigger_emergency_brake(mode, source, 2 if source == 3 else 0, 0.1).success
    bench.step(150)
    reached = {
        car: e.time
        for e in bench.heard.of("events")
        if e.kind_name == "brake_signal_reached"
        for car in e.cars.tolist()
    }
    assert sorted(reached) == [1, 2, 3]
    instant = BRAKE_MODES[mode].startswith("instant")
    begin = min(reached.values())
    assert [c for c in sorted(reached) if reached[c] == begin] == ([1, 2, 3] if instant else first)
    assert begin >= 0.1
    # Adhesion lets more through than the brake gear gives.
    share = bench.heard.last("train_state").brake_force / bench.heard.last("consist").mass / 9.81
    assert (share > 0.07).tolist() == [BRAKE_MODES[mode].endswith("traction_limited")] * 3


def test_sequences_have_no_gaps(bench: Bench) -> None:
    bench.load(ENDLESS)
    for k in range(5):
        bench.core.inject_rail_break(math.nan if k % 2 else 1e5 + k, 0)
        bench.go(0.05)
    bench.core.reset(0)
    assert [c.sequence for c in bench.heard.of("command_log")] == list(range(7))
    for run in {e.run_id for e in bench.heard.of("events")}:
        numbers = [e.sequence for e in bench.heard.of("events") if e.run_id == run]
        assert numbers == list(range(len(numbers)))


def test_scenario_and_command_log_repeat_the_run_to_the_bit(tmp_path) -> None:
    """What the node published is enough to compute the same run again."""
    from derail_ros.scenario import loads_scenario
    from derail_ros.vocabulary.events import Command

    bench = Bench(speed_factor=0.0, record=str(tmp_path / "bag"))
    bench.load(ENDLESS, paused=True)
    bench.step(13)
    bench.core.trigger_emergency_brake(0, 3, 2, 0.25)
    bench.step(31)
    bench.core.inject_rail_break(math.nan, 0)
    bench.core.inject_rail_break(0.0, 1)
    bench.step(10**6)
    assert bench.core.finished
    state = bench.core.session.simulation.state_hash()
    events = [e for e in bench.heard.of("events") if e.kind_name != "run_loaded"]
    bench.core.close()

    again = PlanarSimulation(
        loads_scenario(bench.heard.of("consist")[0].scenario_yaml).to_params()
    )
    for entry in bench.heard.of("command_log"):
        request = json.loads(entry.request_json)
        if not entry.accepted or entry.command not in (
            "inject_rail_break",
            "trigger_emergency_brake",
        ):
            continue
        again.advance_steps(entry.step - again.step_count)
        if entry.command == "inject_rail_break":
            again.inject_rail_break(car=request["car"])
        else:
            again.trigger_emergency_brake(
                BRAKE_MODES[request["mode"]],
                BRAKE_SOURCES[request["source"]],
                request["car"],
                request["delay_s"],
            )
    again.run()
    assert again.state_hash() == state
    assert [(e.kind.name.lower(), e.time, e.cars) for e in again.events] == [
        (e.kind_name, e.time, tuple(e.cars.tolist())) for e in events
    ]

    run = read_manifest(tmp_path / "bag").run
    third = PlanarSimulation(small(ENDLESS).to_params())
    for command in run.commands:
        third.apply(Command(**command))
    third.run()
    assert third.state_hash() == state == run.final_state_hash
    assert len(run.refused) == 1


# --- failure ---------------------------------------------------------------------------------


def test_a_failure_pauses_tells_and_keeps_the_state(tmp_path) -> None:
    bench = Bench(speed_factor=0.0, state_dir=str(tmp_path / "state"))
    bench.load(OFF_THE_TRACK)
    for _ in range(1000):
        bench.loop.work()
    core = bench.core
    assert core.state == State.PAUSED and core.finished
    assert bench.heard.last("events").kind_name == "run_failed"
    assert [e.kind_name for e in bench.heard.of("events")].count("run_failed") == 1
    assert bench.heard.last("outcome").status_name == "failed"
    bench.wall.now += 2.0
    bench.loop.work()
    (status,) = bench.heard.last("/diagnostics").status
    assert status.level == 2 and "TrackEndError" in status.message
    (file,) = (tmp_path / "state").iterdir()
    saved = PlanarSimulation.from_bytes(file.read_bytes())
    assert saved.time == core.session.simulation.time
    answer = core.set_state(State.PLAYING)
    assert not answer.success and "failed" in answer.message
    bench.load(ENDLESS)
    bench.core.settings.speed_factor = 1.0
    bench.core.pace.change()
    bench.go(2.5)
    (status,) = bench.heard.last("/diagnostics").status
    assert status.level == 0 and core.session.time > 1.0


def test_a_state_that_cannot_be_saved_is_no_second_failure(tmp_path, monkeypatch) -> None:
    blocker = tmp_path / "file"
    blocker.write_text("")
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(blocker))
    bench = Bench(speed_factor=0.0, state_dir=str(blocker / "state"))
    bench.load(OFF_THE_TRACK)
    for _ in range(1000):
        bench.loop.work()
    assert "nowhere" in bench.core.failure


# --- recordings ------------------------------------------------------------------------------


def test_the_node_records_what_a_run_without_it_records(tmp_path) -> None:
    """Same scenario, one recording by the core, one by record_run: the same messages."""
    from rosbags.rosbag2 import Reader

    bench = Bench(speed_factor=0.0, record=str(tmp_path / "core"))
    bench.load()
    while not bench.core.finished:
        bench.loop.work()
    bench.core.close()
    record_run(PlanarSimulation(small().to_params()), small(), tmp_path / "run")

    def content(path: Path) -> list[tuple[str, int, bytes]]:
        (run,) = read_manifest(path).runs
        with Reader(path) as reader:
            return sorted(
                (connection.topic, stamp, data.replace(run.run_id.encode(), b"*" * 32))
                for connection, stamp, data in reader.messages()
                if connection.topic not in ("/command_log", "/manifest")
            )

    first, second = content(tmp_path / "core"), content(tmp_path / "run")
    assert len(first) == len(second) > 1000
    assert first == second


def test_time_to_zero_begins_a_new_file_and_keeping_time_does_not(tmp_path) -> None:
    bench = Bench(speed_factor=0.0, record=str(tmp_path / "bag"))
    bench.load(ENDLESS, paused=True)
    bench.step(10)
    bench.core.reset(0)
    bench.step(10)
    bench.core.reset(1)
    bench.step(10)
    bench.core.close()
    assert len(read_manifest(tmp_path / "bag").runs) == 2
    assert len(read_manifest(tmp_path / "bag_1").runs) == 1
    assert read_manifest(tmp_path / "bag").messages["/train_state"] == 22
    assert {"bag", "bag_1"} == {p.name for p in tmp_path.iterdir()}


def test_a_place_that_is_taken_is_refused_at_the_start(tmp_path) -> None:
    with pytest.raises(RecordingError, match="exists already"):
        Bench(record=str(tmp_path))


def test_a_run_outlives_its_recording(tmp_path) -> None:
    bench = Bench(speed_factor=1.0, record=str(tmp_path / "bag"))
    bench.load(ENDLESS)
    bench.core.recording._recorder._failure = OSError(28, "No space left on device")
    bench.go(2.5)
    assert bench.core.session.time == pytest.approx(2.5, abs=0.05)
    (status,) = bench.heard.last("/diagnostics").status
    assert status.level == 2 and "No space left" in status.message
    assert any(level == "error" for level, _ in bench.heard.logs)
    bench.core.close()
