"""The simulator node on a real graph."""

from __future__ import annotations

import json
import math
import os
import signal
import statistics
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import pytest

pytest.importorskip("rclpy")
pytest.importorskip("derail_msgs")

from rcl_interfaces.srv import GetParameters
from rclpy.qos import QoSProfile, ReliabilityPolicy

from derail_ros.nodes import clock_guard
from derail_ros.nodes.outputs import RETIRE_WAIT
from derail_ros.nodes.parameters import SIMULATOR
from derail_ros.nodes.serving import SERVICE_DEPTH
from derail_ros.recording import read_manifest
from msg_adapters.common import TIME_ZERO, stamp_of
from msg_adapters.topics import STATE_TOPICS, TOPICS
from tests.nodes.bench import BAD
from tests.nodes.graph import PAUSED, PLAYING, QUITTING, SERVICES, STOPPED, Graph, Process, graph
from tests.nodes.support import ENDLESS, OFF_THE_TRACK, SIDING, SMALL

pytestmark = pytest.mark.ros

LATCHED = [t.name for t in TOPICS.values() if t.latched]
ALL = [name for name in TOPICS if name not in ("/clock", "/diagnostics")]


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    """A graph with one simulator for many tests; each loads what it needs."""
    with graph(tmp_path_factory.mktemp("simulator")) as made:
        made.process = made.simulator(scenario="", allow_quit=False)
        made.listen(*ALL, "/clock", "/diagnostics")
        yield made
        assert made.process.end() == 0, made.process.output
        assert "Traceback" not in made.process.output


@pytest.fixture
def fresh(served: Graph) -> Graph:
    """The same with nothing heard yet."""
    served.set_parameter("speed_factor", 1.0)
    for messages in served.heard.values():
        messages.clear()
    return served


def load(made: Graph, text: str = ENDLESS, paused: bool = False, **fields):
    answer = made.ask("load_consist", scenario_yaml=text, start_paused=paused, **fields)
    assert answer.success, answer.message
    made.until(
        lambda: any(m.run_id == answer.run_id for m in made.heard["consist"]),
        "the consist is heard",
    )
    return answer


def diagnosed(made: Graph, key: str) -> list[str]:
    """The values of a key in the diagnostics heard so far."""
    return [
        pair.value
        for message in made.heard["/diagnostics"]
        for pair in message.status[0].values
        if pair.key == key
    ]


def finals(made: Graph, run_id: str) -> list:
    return [m for m in made.of_run("outcome", run_id) if m.is_final]


def test_a_run_from_loading_to_its_end(fresh: Graph) -> None:
    fresh.set_parameter("speed_factor", 0.0)
    answer = load(fresh, SMALL)
    heard = fresh.heard
    fresh.until(lambda: finals(fresh, answer.run_id), "the final outcome")
    (outcome,) = finals(fresh, answer.run_id)
    assert outcome.status_name == "at rest" and len(outcome.derailed_cars) > 0
    fresh.reaches(answer.run_id, outcome.time)
    assert len(fresh.of_run("consist", answer.run_id)[0].mass) == 10
    events = fresh.of_run("events", answer.run_id)
    assert [e.sequence for e in events] == list(range(len(events)))
    assert events[0].kind_name == "run_loaded" and events[-1].kind_name == "run_ended"
    stamps = [stamp_of(e) for e in events]
    assert stamps == sorted(stamps)
    kinds = {e.kind_name for e in events}
    assert {"truck_derailed", "brake_signal_reached", "car_at_rest"} <= kinds
    assert any(c.final for c in fresh.of_run("collisions", answer.run_id))
    first, last = (stamp_of(m) for m in (events[0], outcome))

    def grid(topic: str) -> list[int]:
        return [s for s in map(stamp_of, heard[topic]) if first <= s <= last]

    for topic in STATE_TOPICS:
        fresh.until(lambda t=topic: last in grid(t), f"the last message of {topic}")
        stamps = grid(topic)
        assert stamps[0] == first and stamps == sorted(set(stamps))
        assert all(b - a == 20_000_000 for a, b in zip(stamps, stamps[1:])), topic
    fresh.until(lambda: heard["markers"], "markers")
    assert heard["markers"][0].markers
    answer = fresh.ask("get_events")
    assert answer.success and [e.text for e in answer.events] == [e.text for e in events]


def test_who_comes_late_gets_the_present_run_whole(fresh: Graph) -> None:
    """Train, track, outcome, and all events and contacts of this run, of no other."""
    fresh.set_parameter("speed_factor", 0.0)
    first = load(fresh, SMALL).run_id
    fresh.until(lambda: finals(fresh, first), "the first run ends")
    answer = fresh.ask("reset_simulation")
    fresh.ask("set_simulation_state", state=PLAYING)
    fresh.until(
        lambda: any(e.kind_name == "run_ended" for e in fresh.of_run("events", answer.run_id)),
        "the second run ends",
    )
    fresh.until(
        lambda: all(
            any(c.final and c.id == other.id for c in fresh.of_run("collisions", answer.run_id))
            for other in fresh.of_run("collisions", answer.run_id)
        ),
        "all contacts have ended",
    )
    events = fresh.of_run("events", answer.run_id)
    contacts = fresh.of_run("collisions", answer.run_id)
    # The first run's publishers live until all they sent has arrived, a second at most.
    fresh.until(
        lambda: all(fresh.node.count_publishers(n) == 1 for n in ("events", "collisions")),
        "the first run's publishers are gone",
    )
    with graph(fresh.folder, fresh.domain) as late:
        late.listen(*LATCHED)
        late.until(
            lambda: (
                len(late.heard["events"]) >= len(events)
                and len(late.heard["collisions"]) >= len(contacts)
                and all(late.heard[name] for name in LATCHED)
            ),
            "the late one has everything",
        )
    assert [e.text for e in late.heard["events"]] == [e.text for e in events]
    for name in ("consist", "track", "outcome", "events", "collisions"):
        assert {m.run_id for m in late.heard[name]} == {answer.run_id}, name
    assert late.heard["outcome"][-1].is_final
    assert late.heard["track_markers"][-1].markers[0].action == 3


def test_the_place_and_what_stands_there(fresh: Graph) -> None:
    fresh.set_parameter("speed_factor", 0.0)
    answer = load(fresh, SIDING)
    assert "4 cars" in answer.message
    fresh.until(lambda: finals(fresh, answer.run_id), "the final outcome")
    (outcome,) = finals(fresh, answer.run_id)
    assert set(outcome.derailed_cars) <= {1, 2, 3, 4}
    told = {m.key: list(m.values) for m in outcome.measures}
    assert told["train_cars"] == [4] and told["standing_cars"] == [3]
    assert set(told["standing_derailed"]) <= {5, 6, 7} and told["standing_struck"]
    states, consists = (
        fresh.until(lambda n=n: fresh.of_run(n, answer.run_id), f"{n} of the run")
        for n in ("train_state", "consist")
    )
    assert len(states[-1].x) == 7
    consist = consists[0]
    cut = {q.key: list(q.values) for q in consist.more}["standing_cut"]
    assert cut == [0, 0, 0, 0, 1, 1, 1]
    fresh.until(
        lambda: any(
            {"second_rails", "second_track_beds", "fixed"} <= {m.ns for m in each.markers}
            for each in fresh.heard["track_markers"]
        ),
        "the markers of the place",
    )
    names = {m.text for m in fresh.heard["track_markers"][-1].markers if m.ns == "site_labels"}
    assert names == {"wall", "siding"}


def test_each_mistake_gets_its_answer_and_the_run_goes_on(fresh: Graph) -> None:
    run = load(fresh).run_id
    for service, fields, reason in BAD:
        answer = fresh.ask(service, caller="tester", **fields)
        assert not answer.success, (service, fields)
        assert reason in answer.message, (service, fields, answer.message)

    def by_tester() -> list:
        # The entry of the load, which nobody has waited for, may still come.
        return [entry for entry in fresh.heard["command_log"] if entry.caller == "tester"]

    fresh.until(lambda: len(by_tester()) >= len(BAD), "all refusals are logged")
    logged = by_tester()
    assert [entry.command for entry in logged] == [service for service, _, _ in BAD]
    assert not any(entry.accepted for entry in logged)
    assert all(json.loads(entry.request_json) for entry in logged)
    fresh.goes_on(run)
    stamps = [stamp_of(m) for m in fresh.of_run("train_state", run)]
    assert all(b - a == 20_000_000 for a, b in zip(stamps, stamps[1:]))
    fresh.until(
        lambda: any(int(value) >= len(BAD) for value in diagnosed(fresh, "refused_commands")),
        "diagnostics count the refusals",
    )


def test_commands_act_and_are_logged(fresh: Graph) -> None:
    run = load(fresh).run_id
    fresh.goes_on(run)
    broken = fresh.ask("inject_rail_break", car=2, caller="me")
    assert broken.success and math.isfinite(broken.track_coordinate)
    braked = fresh.ask("trigger_emergency_brake", source=2, caller="me")
    assert braked.success and braked.step >= broken.step
    fresh.until(
        lambda: any(e.kind_name == "truck_derailed" for e in fresh.of_run("events", run)),
        "a truck derails at the break",
    )
    entries = {m.command: m for m in fresh.heard["command_log"] if m.accepted}
    entry = entries["inject_rail_break"]
    assert entry.step == broken.step and entry.applied_at == broken.applied_at
    event = next(e for e in fresh.of_run("events", run) if e.kind_name == "rail_break_set")
    assert event.track_coordinate == broken.track_coordinate
    fresh.until(
        lambda: any(
            list(m.rail_break_coordinate) == [broken.track_coordinate]
            for m in fresh.of_run("track", run)
        ),
        "the track with its break",
    )
    fresh.until(
        lambda: any(
            m.ns == "rail_breaks" for each in fresh.heard["track_markers"] for m in each.markers
        ),
        "the marker of the break",
    )


def test_pausing_stepping_and_stopping(fresh: Graph) -> None:
    run = load(fresh, paused=True).run_id
    assert not fresh.ask("step_simulation", ticks=0).success
    answer = fresh.ask("step_simulation", ticks=25)
    assert answer.success, answer.message
    assert (answer.applied_at.sec * 10**9 + answer.applied_at.nanosec) % 20_000_000 == 0
    fresh.reaches(run, 0.5)
    assert fresh.ask("set_simulation_state", state=PAUSED).message == "already paused"
    clocks = len(fresh.heard["/clock"])
    fresh.until(lambda: len(fresh.heard["/clock"]) > clocks + 20, "the clock goes on")
    assert fresh.of_run("train_state", run)[-1].time == pytest.approx(0.5)
    assert fresh.ask("set_simulation_state", state=PLAYING).state == PLAYING
    fresh.reaches(run, 1.0)
    answer = fresh.ask("set_simulation_state", state=STOPPED)
    assert answer.success and answer.state == STOPPED and answer.step == 0
    assert not fresh.ask("step_simulation", ticks=1).success


def test_requests_that_come_all_at_once_are_all_answered(fresh: Graph) -> None:
    load(fresh)
    kind = SERVICES["inject_rail_break"]
    # The client's own depth holds as many.
    client = fresh.node.create_client(
        kind, "/simulator/inject_rail_break", qos_profile=QoSProfile(depth=SERVICE_DEPTH)
    )
    fresh.until(client.service_is_ready, "the service is there")
    futures = [client.call_async(kind.Request(track_coordinate=math.nan)) for _ in range(80)]
    fresh.until(lambda: all(future.done() for future in futures), "all are answered")
    assert not any(future.result().success for future in futures)
    fresh.node.destroy_client(client)


def test_a_long_step_request_leaves_the_node_free(fresh: Graph) -> None:
    run = load(fresh, paused=True).run_id
    client = fresh.client("step_simulation")
    future = client.call_async(client.srv_type.Request(ticks=10**9))
    fresh.reaches(run, 2.0)
    assert fresh.ask("get_events").success and not future.done()
    assert fresh.ask("set_simulation_state", state=PLAYING).success
    fresh.until(future.done, "the overtaken request is answered")
    assert not future.result().success and "ticks done" in future.result().message


def test_time_rises_through_resets_or_begins_at_its_start(fresh: Graph) -> None:
    first = load(fresh)
    fresh.reaches(first.run_id, 0.5)
    second = fresh.ask("reset_simulation")
    assert second.success and second.run_id not in ("", first.run_id)
    fresh.until(lambda: fresh.of_run("train_state", second.run_id), "the second run is heard")
    stamps = [stamp_of(m) for m in fresh.heard["train_state"]]
    assert stamps == sorted(stamps)
    third = fresh.ask("reset_simulation", mode=1)
    assert third.success and (third.applied_at.sec, third.applied_at.nanosec) == (1, 0)
    fresh.until(lambda: fresh.of_run("train_state", third.run_id), "the third run is heard")
    assert TIME_ZERO <= stamp_of(fresh.of_run("train_state", third.run_id)[0]) < 2 * TIME_ZERO
    for run in (first, second, third):
        fresh.until(lambda r=run: fresh.of_run("consist", r.run_id), "its train is told")
        fresh.until(lambda r=run: fresh.of_run("track", r.run_id), "its track is told")
    for run in (first, second):
        fresh.until(lambda r=run: finals(fresh, r.run_id), "its last outcome is told")
        assert finals(fresh, run.run_id)[0].status_name == "stopped"


def held_up(fresh: Graph) -> tuple[Any, list[str], float]:
    """A listener that stood still during three resets: it, the runs, and how long it stood (s)."""
    runs = [load(fresh).run_id]
    ear = fresh.ear("consist", "track", "outcome", "events")
    fresh.until(lambda: ("outcome", runs[0]) in ear.heard(), "it hears the first run")
    begun = time.monotonic()
    ear.signal(signal.SIGSTOP)
    for _ in range(3):
        fresh.goes_on(runs[-1])
        runs.append(fresh.ask("reset_simulation").run_id)
    # Longer than a new run waits for its subscribers.
    fresh.goes_on(runs[-1], 1.5)
    ear.signal(signal.SIGCONT)
    return ear, runs, time.monotonic() - begun


def test_who_is_held_up_gets_the_end_of_each_run_and_the_beginning_of_the_next(
    fresh: Graph,
) -> None:
    """A process that stands still for longer than resets take: nothing latched is overwritten."""
    ear, runs, stood = held_up(fresh)
    while stood > RETIRE_WAIT - 2.0:  # on a busy machine; an ended run's publisher may be gone
        ear.end()
        ear, runs, stood = held_up(fresh)
    expected = {(topic, run) for run in runs for topic in ("consist", "track", "outcome")}
    expected |= {("final outcome", run) for run in runs[:-1]}
    expected |= {("run_ended", run) for run in runs[:-1]}
    fresh.until(lambda: expected <= ear.heard(), "all of it arrives")
    ear.end()


def test_parameters_change_or_say_why_not(fresh: Graph) -> None:
    run = load(fresh).run_id
    for name, value, reason in (
        ("speed_factor", -1.0, "speed_factor"),
        ("speed_factor", math.nan, "speed_factor"),
        ("speed_factor", "fast", "speed_factor"),
        ("state_rate", 0.0, "state_rate"),
        ("frame_id", "odom", "read"),
        ("record", "/tmp/x", "read"),
        ("scenario", "nowhere", "unknown scenario"),
        ("clock_rate", 1e6, "clock_rate"),
    ):
        result = fresh.set_parameter(name, value)
        assert not result.successful and reason in result.reason, (name, value, result.reason)
    assert fresh.get_parameter("speed_factor") == 1.0
    assert fresh.set_parameter("speed_factor", 4).successful  # a whole number will do
    fresh.goes_on(run)
    fresh.until(
        lambda: any(float(value) > 2.0 for value in diagnosed(fresh, "real_time_factor")),
        "the run goes faster",
    )
    assert fresh.set_parameter("scenario", "base_train").successful
    fresh.until(
        lambda: fresh.heard["consist"][-1].scenario_name == "base_train", "it loads the scenario"
    )
    told = fresh.set_parameter("scenario", "")
    assert not told.successful and "unload_world" in told.reason
    for parameter in SIMULATOR:
        told = fresh.describe_parameter(parameter.name)
        assert told.read_only == parameter.read_only and told.description


def test_simulation_time_for_itself_comes_and_goes(fresh: Graph) -> None:
    """The parameter of every node brings a subscription, and takes it away again."""
    run = load(fresh).run_id
    for value in (True, False, True, False):
        assert fresh.set_parameter("use_sim_time", value).successful
        fresh.goes_on(run)


def test_all_parameters_together_have_values(fresh: Graph) -> None:
    """One without would make `ros2 param dump` come out empty."""
    names = [parameter.name for parameter in SIMULATOR]
    request = GetParameters.Request(names=names)
    values = fresh._parameters(GetParameters, "get_parameters", request).values
    assert len(values) == len(names) and all(value.type for value in values)
    assert fresh.get_parameter("scenario_dirs") == [""]


def test_another_speed(fresh: Graph) -> None:
    answer = load(fresh, SMALL, paused=True, speed_kmh=36.0)
    assert fresh.of_run("consist", answer.run_id)[0].initial_speed == pytest.approx(10.0)


def test_a_failed_run_is_told_and_another_can_be_loaded(fresh: Graph) -> None:
    answer = load(fresh, OFF_THE_TRACK)
    fresh.until(
        lambda: any(e.kind_name == "run_failed" for e in fresh.of_run("events", answer.run_id)),
        "the failure is told",
    )
    fresh.until(
        lambda: any(d.status[0].level == b"\x02" for d in fresh.heard["/diagnostics"]),
        "diagnostics tell of an error",
    )
    refused = fresh.ask("set_simulation_state", state=PLAYING)
    assert not refused.success and "failed" in refused.message
    fresh.until(lambda: finals(fresh, answer.run_id), "the outcome is told")
    assert finals(fresh, answer.run_id)[0].status_name == "failed"
    saved = list(Path(fresh.folder).rglob(f"failed-{answer.run_id}.state"))
    assert len(saved) == 1
    again = load(fresh)
    fresh.until(lambda: fresh.of_run("train_state", again.run_id), "the next run goes on")


def test_a_request_takes_at_most_a_tenth_of_a_second_of_computing(fresh: Graph) -> None:
    """In the processor time of the node: wall time belongs to whatever else the machine does."""
    fresh.set_parameter("speed_factor", 0.0)
    fresh.ask("load_consist", scenario_name="mississauga", speed_kmh=90.0)
    used, took = [], []
    # A listener of its own: the other one is busy with what it has subscribed to.
    with graph(fresh.folder, fresh.domain) as asker:
        asker.client("get_events"), asker.client("inject_rail_break")
        for k in range(40):
            before, began = processor_time(fresh.process), time.perf_counter()
            if k % 2:
                asker.ask("get_events")
            else:
                assert not asker.ask("inject_rail_break", track_coordinate=math.nan).success
            took.append(time.perf_counter() - began)
            used.append(processor_time(fresh.process) - before)
        assert fresh.ask("set_simulation_state", state=STOPPED).success
    print(
        f"wall: median {statistics.median(took):.4f} s, worst {max(took):.4f} s; "
        f"processor: median {statistics.median(used):.4f} s, worst {max(used):.4f} s"
    )
    # While the client waits for a processor the node goes on: the worst belong to the machine.
    assert statistics.median(used[2:]) < 0.1


def processor_time(process: Process) -> float:
    """Processor time that all threads of a process have used, s."""
    tasks = Path(f"/proc/{process.process.pid}/task").iterdir()
    return sum(1e-9 * int((task / "schedstat").read_text().split()[0]) for task in tasks)


def test_only_one_of_two_simulators_publishes_the_clock(fresh: Graph) -> None:
    """The second refuses; where discovery was slow and both are young, either of them may."""
    second = fresh.start("simulator", "-r", "__node:=second", scenario="")
    refusal = (
        "another node publishes /clock: this one does not (parameter publish_clock). Each has "
    )
    refusal += "a time of its own, and nodes with use_sim_time follow that of the other one"
    fresh.until(
        lambda: refusal in second.output or refusal in fresh.process.output, "one refuses", second
    )
    ticking(fresh)
    assert second.end() == 0, second.output
    ticking(fresh)


def test_simulators_can_have_clocks_of_their_own(fresh: Graph) -> None:
    names = ("-r", "__node:=second", "-r", "/clock:=/second/clock")
    said = len(fresh.process.output)  # of tests before
    second = fresh.start("simulator", *names, scenario="")
    fresh.until(
        lambda: fresh.node.count_publishers("/second/clock") == 1, "it has its clock", second
    )
    ticking(fresh)
    assert second.end() == 0, second.output
    assert "clock: this one does not" not in second.output + fresh.process.output[said:]


def ticking(made: Graph) -> None:
    """Wait until one node publishes the clock, and see it go on."""
    made.until(lambda: made.node.count_publishers("/clock") == 1, "one publishes")
    clocks = len(made.heard["/clock"])
    made.until(lambda: len(made.heard["/clock"]) > clocks + 10, "the clock goes on")


@pytest.mark.parametrize(("mine", "other"), [(b"a", b"b"), (b"b", b"a")])
def test_a_young_clock_gives_way_to_an_old_one_whatever_its_identity(
    mine, other, monkeypatch
) -> None:
    """Discovery was slow, so that both publish; the old one will not give way."""
    now = [100.0]
    monkeypatch.setattr(clock_guard.time, "monotonic", lambda: now[0])
    node, opened, closed = MagicMock(), MagicMock(), MagicMock()
    node.get_name.return_value, node.get_namespace.return_value = "young", "/"
    node.get_publishers_info_by_topic.return_value = [
        SimpleNamespace(node_name=name, node_namespace="/", endpoint_gid=gid)
        for name, gid in (("young", mine), ("old", other))
    ]
    node.count_publishers.return_value = 0
    guard = clock_guard.ClockGuard(node, opened, closed, True)
    while now[0] < 101.0:
        now[0] += 0.11
        guard.look()
    assert guard.publishing
    node.count_publishers.return_value = 2
    end = now[0] + clock_guard.PATIENCE + 0.5
    while now[0] < end:
        now[0] += 0.11
        guard.look()
    assert not guard.publishing
    assert opened.call_count == closed.call_count == 1


# --- processes of their own ------------------------------------------------------------------


def test_quality_of_service_names_and_namespaces_can_be_changed(tmp_path) -> None:
    """Two simulators side by side, one of them remapped and with another QoS."""
    with graph(tmp_path) as made:
        made.simulator("-r", "__ns:=/north", ready=False, scenario="base_train")
        made.simulator(
            *("-r", "__ns:=/south", "-r", "train_state:=states", "-r", "__node:=engine"),
            *("-p", "qos_overrides./south/states.publisher.depth:=77"),
            *("-p", "qos_overrides./south/states.publisher.reliability:=best_effort"),
            ready=False,
            scenario="base_train",
            speed_factor=2.0,
        )
        made.listen("train_state", namespace="/north")
        made.until(lambda: made.heard["train_state"], "the northern one runs")
        find = lambda: made.node.get_publishers_info_by_topic("/south/states")  # noqa: E731
        # Discovery tells of a publisher before it knows its node.
        made.until(lambda: [i for i in find() if i.node_name == "engine"], "the southern one runs")
        (info,) = find()
        assert info.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
        assert info.node_name == "engine" and info.node_namespace == "/south"
        assert not made.node.get_publishers_info_by_topic("/south/train_state")
        answer = made.ask("reset_simulation", node="/south/engine")
        assert answer.success
        # Per-run publishers keep to it too, and the other one knows nothing of it.
        made.until(lambda: made.node.count_publishers("/south/outcome"), "the next run")
        run = made.heard["train_state"][-1].run_id
        made.until(lambda: made.heard["train_state"][-1].time > 1.0, "the northern one goes on")
        assert made.heard["train_state"][-1].run_id == run != answer.run_id
        for process in made.processes:
            assert process.end() == 0, process.output
            assert "Traceback" not in process.output


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_it_ends_cleanly_and_its_recording_is_whole(tmp_path, number) -> None:
    with graph(tmp_path) as made:
        process = made.simulator(
            *("-r", "__ns:=/yard"),
            fresh=True,
            ready=False,
            scenario="base_train",
            record=tmp_path / "bag",
        )
        made.listen("train_state", namespace="/yard")
        made.until(lambda: len(made.heard["train_state"]) > 20, "the run goes on", process)
        assert process.end(number) == 0, process.output
    assert "Traceback" not in process.output
    manifest = read_manifest(tmp_path / "bag")
    assert manifest.run.status == "stopped"
    assert manifest.messages["/yard/train_state"] > 20
    from rosbags.rosbag2 import Reader

    with Reader(tmp_path / "bag") as reader:
        counts = {c.topic: c.msgcount for c in reader.connections}
    assert counts == manifest.messages


def test_quitting_when_it_is_allowed(tmp_path) -> None:
    with graph(tmp_path) as made:
        process = made.simulator(fresh=True, scenario="", allow_quit=True)
        assert made.ask("set_simulation_state", state=QUITTING).success
        assert process.wait() == 0, process.output
        assert "Traceback" not in process.output


@pytest.mark.parametrize(
    ("parameters", "reason"),
    [
        ({"scenario": "nowhere"}, "unknown scenario"),
        ({"speed_factor": -2.0}, "speed_factor must be 0 to 1000"),
        ({"state_rate": "often"}, "state_rate must be of type double"),
        ({"record": "/proc/nowhere/bag"}, "nowhere"),
        ({"frame_id": "/map"}, "frame_id must be the name of a frame"),
        ({"imu": "all:roof"}, "imu: there is no place 'roof'"),
        ({"frame_id": "car_7"}, "frame_id must not be a frame of the train"),
        ({"model": "nope", "scenario": ""}, "model must be one of planar"),
    ],
)
def test_a_mistake_at_the_start_is_one_clear_line(tmp_path, parameters, reason) -> None:
    with graph(tmp_path) as made:
        process = made.start("simulator", fresh=True, **parameters)
        assert process.wait() == 1
        assert reason in process.output and "Traceback" not in process.output
        assert process.output.strip().splitlines()[-1].startswith("error: ")


def test_arguments_that_no_node_looks_at_are_refused(tmp_path) -> None:
    log = tmp_path / "recorder.log"
    process = Process("derail_ros.nodes.recorder", dict(os.environ), log, "mississauga")
    assert process.wait() == 1
    assert process.output.startswith("error: unknown argument mississauga; parameters are given")


def test_a_signal_in_the_compiler_waits_until_it_has_returned() -> None:
    """An exception in what LLVM calls back is printed and lost."""
    text = """
import os, signal, time
from derail_ros.nodes.process import Interrupted, Stop
scope = {"__name__": "llvmlite.binding.executionengine", "os": os, "signal": signal}
exec('''
def callback():
    try:
        os.kill(os.getpid(), signal.SIGINT)
        for _ in range(1000): pass
    except BaseException:
        print("lost")
''', scope)
def work():
    scope["callback"]()
    print("returned")
    time.sleep(100.0)
try:
    Stop().during(work)
except Interrupted:
    print("interrupted")
"""
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True)
    assert (done.stdout, done.stderr) == ("returned\ninterrupted\n", "")


def test_a_signal_where_no_exception_can_go_on_comes_again() -> None:
    """Python prints what is raised in the callback of a weak reference, and drops it."""
    text = """
import os, signal, time, weakref
from derail_ros.nodes.process import Interrupted, Stop
class Thing:
    pass
def callback(_):
    os.kill(os.getpid(), signal.SIGTERM)
    for _ in range(1000): pass
    print("not reached")
def work():
    thing = Thing()
    watch = weakref.ref(thing, callback)
    del thing
    print("goes on")
    time.sleep(100.0)
try:
    Stop().during(work)
except Interrupted:
    print("interrupted")
"""
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True)
    assert (done.stdout, done.stderr) == ("goes on\ninterrupted\n", "")


def test_help_needs_no_graph(tmp_path) -> None:
    for node in ("simulator", "recorder"):
        log = tmp_path / f"{node}.log"
        process = Process(f"derail_ros.nodes.{node}", dict(os.environ), log, "--help")
        assert process.wait() == 0 and "usage" in process.output
