"""The player node: rosbag2's services, latched topics after a seek, one clock, clean ends."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from derail_ros.nodes.playback import Playback
from derail_ros.recording import record_run
from derail_ros.recording.files import add_topic, bag_writer
from derail_ros.recording.listener import Listener
from derail_ros.recording.storage import BagError, open_bag
from msg_adapters.common import stamp_of_bytes
from msg_adapters.definitions import serialize
from msg_adapters.reports import clock as clock_message
from msg_adapters.reports import string
from msg_adapters.topics import TOPICS, rclpy_class
from tests.nodes.support import simulation, small

SECOND = 1_000_000_000


@pytest.fixture(scope="module")
def bag(tmp_path_factory) -> Path:
    """A recording of a small train."""
    path = tmp_path_factory.mktemp("player") / "small"
    record_run(simulation(), small(), path, state_rate=20.0, marker_rate=0.0)
    return path


# --- the playback itself, with a wall clock that the test moves ------------------------------


class Wall:
    def __init__(self) -> None:
        self.time = 100.0

    def __call__(self) -> float:
        return self.time


class Sink:
    def __init__(self) -> None:
        self.sent: list[tuple[str, bytes]] = []
        self.renewed = 0

    def publish(self, topic: str, data: bytes) -> None:
        self.sent.append((topic, data))

    def renew(self) -> None:
        self.renewed += 1
        self.sent.clear()

    def topics(self) -> list[str]:
        return [topic for topic, _ in self.sent]


@pytest.fixture
def playback(bag):
    wall, sink = Wall(), Sink()
    made = Playback(bag, sink, wall)
    yield made, wall, sink
    made.close()


def go(made: Playback, wall: Wall, seconds: float, step: float = 0.02) -> None:
    for _ in range(round(seconds / step)):
        made.work()
        wall.time += step
    made.work()


def states(sink: Sink) -> list[bytes]:
    return [data for topic, data in sink.sent if topic == "/train_state"]


def test_messages_come_at_their_times(playback) -> None:
    made, wall, sink = playback
    assert made.paused
    go(made, wall, 1.0)
    assert not sink.sent, "it waits until it is resumed"
    made.resume()
    go(made, wall, 1.0)
    assert len(states(sink)) == pytest.approx(21, abs=1)
    assert made.now == pytest.approx(made.start + SECOND, abs=1e6)


def test_another_rate_plays_faster_from_there_on(playback) -> None:
    made, wall, sink = playback
    made.resume()
    go(made, wall, 1.0)
    assert made.set_rate(4.0)
    assert made.rate == 4.0
    before = made.now
    go(made, wall, 0.5)
    assert made.now - before == pytest.approx(2.0 * SECOND, abs=1e6)


@pytest.mark.parametrize("rate", [0.0, -1.0, float("nan"), float("inf"), 1e308, 1e-300])
def test_rates_that_cannot_be_are_refused(playback, rate) -> None:
    made, _, _ = playback
    assert not made.set_rate(rate)
    assert made.rate == 1.0


def test_pause_holds_time(playback) -> None:
    made, wall, _ = playback
    made.resume()
    go(made, wall, 0.5)
    made.pause()
    before = made.now
    go(made, wall, 2.0)
    assert made.now == before
    made.resume()
    go(made, wall, 0.5)
    assert made.now - before == pytest.approx(0.5 * SECOND, abs=1e6)


def test_step_by_message_only_while_paused(playback) -> None:
    made, wall, sink = playback
    assert made.play_next()
    assert len(sink.sent) == 1
    assert made.burst(5) == 5
    assert len(sink.sent) == 6
    made.resume()
    assert not made.play_next()
    assert made.burst(3) == 0


def test_a_burst_of_all_that_are_left(playback) -> None:
    made, _, sink = playback
    count = made.burst(0)
    assert count == len(sink.sent) == len(list(made.bag.messages()))
    assert made.finished
    assert made.burst(0) == 0
    assert not made.play_next()


def test_after_a_seek_latched_topics_and_the_last_state_come_again(playback) -> None:
    made, wall, sink = playback
    middle = (made.start + made.end) // 2
    assert made.seek(middle)
    topics = set(sink.topics())
    assert {"/consist", "/track", "/events", "/outcome", "/manifest"} <= topics
    assert {"/train_state", "/coupler_states", "/energy"} <= topics, "what a display needs"
    events = sink.topics().count("/events")
    assert made.seek(made.end)
    assert sink.topics().count("/events") > events, "all events up to there"
    assert made.seek(made.start)
    assert not sink.sent
    assert made.paused


def test_after_a_seek_the_clock_goes_out_first(playback) -> None:
    made, _, sink = playback
    order: list[object] = []
    made.moved = lambda: order.append(made.clock)
    sink.publish = lambda topic, data: order.append(topic)
    for stamp in ((made.start + made.end) // 2, made.end):
        order.clear()
        made.seek(stamp)
        assert order[0] == made.base.time(stamp) and "/train_state" in order


def test_a_seek_plays_what_comes_after_it_and_nothing_twice(playback, bag) -> None:
    made, _, sink = playback
    middle = made.start + (made.end - made.start) // 2
    made.seek(middle)
    shown = sink.topics().count("/events")
    made.burst(0)
    whole = Playback(bag, Sink(), Wall())
    whole.burst(0)
    assert sink.topics().count("/events") == whole.output.topics().count("/events")
    assert shown > 0
    whole.close()


def test_a_seek_outside_is_refused(playback) -> None:
    made, _, _ = playback
    before = made.now
    assert not made.seek(made.start - 1)
    assert not made.seek(made.end + SECOND)
    assert made.now == before


def test_at_the_end_it_stands_and_resume_begins_again(playback) -> None:
    made, wall, _ = playback
    made.set_rate(100.0)
    made.resume()
    go(made, wall, 2.0)
    assert made.finished
    assert made.paused
    made.resume()
    assert not made.finished
    assert made.now == made.start


def test_the_present_moment_is_sent_before_it_goes_on(playback) -> None:
    made, wall, sink = playback
    wall.time += 5.0
    made.send_present()
    assert len(states(sink)) == 1 and made.now == made.start
    made.resume()
    go(made, wall, 1.0)
    assert len(states(sink)) == pytest.approx(21, abs=1)


def test_topics_are_shown_again_to_who_comes_while_it_is_paused(playback) -> None:
    made, wall, sink = playback
    made.resume()
    go(made, wall, 1.0)
    made.pause()
    last = states(sink)[-1]
    sink.sent.clear()
    made.show_again({"/train_state", "/consist"})
    assert sink.sent == [("/train_state", last)], "what is latched need not be sent again"


def test_a_loop_begins_again(playback) -> None:
    made, wall, sink = playback
    made.loop = True
    made.set_rate(100.0)
    made.resume()
    go(made, wall, 1.0)
    assert made.laps >= 1
    assert not made.finished
    assert sink.renewed >= 1


def test_a_stall_is_not_followed_by_a_burst(playback) -> None:
    made, wall, sink = playback
    made.resume()
    go(made, wall, 0.2)
    before = len(states(sink))
    wall.time += 5.0
    made.work()
    assert len(states(sink)) - before <= 2


WALL = 1_764_500_000 * SECOND
"""A time of the log as ``ros2 bag record`` writes it: wall time."""


@pytest.fixture(params=["clock", "headers"])
def logged_by_wall_time(request, tmp_path, bag) -> Path:
    """The recording as ``ros2 bag record -a`` has it, at twice real time and with a pause."""
    whole = open_bag(bag)
    path = tmp_path / "wall"
    writer = bag_writer(path, "mcap")
    writer.open()
    clock = add_topic(writer, "/clock", "rosgraph_msgs/msg/Clock", [])
    rosout = add_topic(writer, "/rosout", "std_msgs/msg/String", [])
    known = [c for c in whole.channels if c.msgtype != "std_msgs/msg/String"]
    topics = {c.topic: add_topic(writer, c.topic, c.msgtype, c.qos) for c in known}
    start = whole.span()[0]
    for channel, stamp, data in whole.messages(lambda c: c.topic in topics):
        log = WALL + (stamp - start) // 2 + (3 * SECOND if stamp > start + SECOND else 0)
        if channel.topic == "/train_state":
            if request.param == "clock":
                writer.write(clock, log, bytes(clock_message(stamp)))
            writer.write(rosout, log, serialize(string("a line")))
        writer.write(topics[channel.topic], log, data)
    writer.close()
    return path


def test_a_log_of_wall_time_is_played_in_the_time_of_its_messages(
    logged_by_wall_time, bag
) -> None:
    """One time base: /clock is where the stamps are, and a seek is in that time too."""
    wall, sink = Wall(), Sink()
    made = Playback(logged_by_wall_time, sink, wall)
    own = Playback(bag)
    first, last = own.start, own.end
    assert made.start >= WALL and made.clock == pytest.approx(first, abs=SECOND // 20)
    made.resume()
    # Half a second of the log is a second of the run; then it stood still for three.
    for seconds, reached in ((0.5, SECOND), (2.9, SECOND), (0.35, 1.5 * SECOND)):
        go(made, wall, seconds, 0.01)
        assert made.clock - first == pytest.approx(reached, abs=0.06 * SECOND)
        assert abs(stamp_of_bytes(states(sink)[-1]) - made.clock) <= SECOND // 20
    assert made.seek_time(first + 2 * SECOND)
    assert made.clock == pytest.approx(first + 2 * SECOND, abs=SECOND // 100)
    assert abs(stamp_of_bytes(states(sink)[-1]) - made.clock) <= SECOND // 20
    assert not made.seek_time(last + 10 * SECOND) and not made.seek_time(0)


def test_a_log_of_simulation_time_stays_as_it_is(bag) -> None:
    made = Playback(bag)
    assert made.clock == made.start and made.base.time(made.end) == made.end


def test_topics_are_chosen_and_left_out(bag) -> None:
    names = {c.topic for c in Playback(bag).channels}
    only = Playback(bag, topics=["train_state", "/ev*"])
    assert {c.topic for c in only.channels} == {"/train_state", "/events"}
    less = Playback(bag, exclude=["*markers", "/train_state"])
    assert {c.topic for c in less.channels} == {
        n for n in names if not n.endswith("markers") and n != "/train_state"
    }
    more = Playback(bag, exclude=["/tf*", "/train_state"])
    assert {c.topic for c in more.channels} == names - {"/train_state"}
    assert more.unmatched == ["/tf*"], "what is not there need not be left out"
    for given in ({"topics": ["states"]}, {"exclude": ["*"]}):
        with pytest.raises(BagError, match=next(iter(given))):
            Playback(bag, **given)


def test_a_recording_that_was_cut_off_is_refused(tmp_path, bag) -> None:
    data = next(bag.glob("*.mcap")).read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) // 2])
    with pytest.raises(BagError, match="derail repair"):
        Playback(tmp_path / "cut.mcap")


# --- on a graph ------------------------------------------------------------------------------


DEEP = {"qos_overrides./train_state.publisher.depth": 1000}
"""A depth at which nothing is overwritten before it has arrived, however busy the machine is."""


def on_graph(tmp_path):
    pytest.importorskip("rclpy")
    pytest.importorskip("derail_msgs")
    from derail_msgs import srv
    from tests.nodes import graph as module

    for name, kind in (
        ("pause", srv.Pause),
        ("resume", srv.Resume),
        ("toggle_paused", srv.TogglePaused),
        ("is_paused", srv.IsPaused),
        ("get_rate", srv.GetRate),
        ("set_rate", srv.SetRate),
        ("play_next", srv.PlayNext),
        ("burst", srv.Burst),
        ("seek", srv.Seek),
        ("stop", srv.Stop),
    ):
        module.SERVICES[name] = kind
    return module.graph(tmp_path)


@pytest.mark.ros
def test_services_and_topics_on_a_graph(tmp_path, bag) -> None:
    with on_graph(tmp_path) as made:
        player = made.start("player", path=bag, start_paused=True, auto_exit=False)

        def ask(service, **fields):
            return made.ask(service, "/player", **fields)

        heard = made.listen("train_state", "events", "consist", "/clock")
        made.until(lambda: heard["/clock"], "the clock runs while paused", player)
        made.until(lambda: heard["train_state"], "the state, though it is paused", player)
        made.until(lambda: ask("play_next").success, "it plays a message", player)
        assert ask("is_paused").paused
        assert ask("get_rate").rate == 1.0
        assert not ask("set_rate", rate=-1.0).success
        assert ask("burst", num_messages=10).actually_burst == 10
        # It must not be at its end when it is told to pause, or it would begin again afterwards.
        assert ask("set_rate", rate=0.01).success
        ask("resume")
        assert not ask("is_paused").paused
        ask("pause")
        assert ask("is_paused").paused
        assert ask("set_rate", rate=20.0).success
        ask("toggle_paused")
        made.until(lambda: heard["consist"], "the consist", player)
        made.until(lambda: len(heard["train_state"]) > 50, "states", player)
        made.until(
            lambda: heard["events"] and heard["events"][-1].kind_name == "run_ended",
            "the end of the run",
            player,
        )
        consists = len(heard["consist"])
        heard["events"].clear()
        from builtin_interfaces.msg import Time

        made.until(lambda: ask("is_paused").paused, "it stands at the end", player)
        assert ask("seek", time=Time(sec=2)).success
        made.until(lambda: len(heard["consist"]) > consists, "latched topics again", player)
        made.until(lambda: heard["events"], "events up to there", player)
        assert max(e.time for e in heard["events"]) <= 2.0 + 1e-6
        assert not ask("seek", time=Time(sec=100_000)).success
        assert ask("stop").return_code == 0
        assert player.wait() == 0


@pytest.mark.ros
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_it_cleanly(tmp_path, bag, number) -> None:
    with on_graph(tmp_path) as made:
        player = made.start("player", fresh=True, path=bag, loop=True)
        heard = made.listen("train_state")
        made.until(lambda: heard["train_state"], "it plays", player)
        assert player.end(number) == 0
        assert "Traceback" not in player.output


@pytest.mark.ros
def test_it_is_never_the_second_publisher_of_the_clock(tmp_path, bag) -> None:
    with on_graph(tmp_path) as made:
        first = made.start("player", path=bag, loop=True)
        made.listen("/clock")
        made.until(lambda: made.heard["/clock"], "the first one's clock", first)
        second = made.start("player", "-r", "__ns:=/second", path=bag, loop=True)
        # Where discovery takes long both begin, and then one of them gives way.
        both = (first, second)
        made.until(lambda: any("publishes /clock" in p.output for p in both), "one gives way")
        made.until(lambda: made.node.count_publishers("/clock") == 1, "one is left")
        made.until(lambda: any("subscribers get both" in p.output for p in both), "it warns")


@pytest.mark.ros
def test_topics_come_under_other_names_and_rosout_is_no_rival(tmp_path, bag) -> None:
    with on_graph(tmp_path) as made:
        player = made.start("player", "-r", "/train_state:=/states", path=bag, loop=True)
        heard: list = []
        topic = TOPICS["train_state"]
        made.node.create_subscription(rclpy_class(topic.msgtype), "/states", heard.append, 10)
        made.until(lambda: len(heard) > 20, "states under another name", player)
        assert not made.node.count_publishers("/train_state")
        assert "subscribers get both" not in player.output


@pytest.mark.ros
def test_it_ends_when_everything_has_been_played(tmp_path, bag) -> None:
    with on_graph(tmp_path) as made:
        player = made.start("player", path=bag, rate=20.0, await_listeners=1, **DEEP)
        heard = made.listen("train_state", "outcome")
        assert made.until(lambda: player.process.poll() is not None, "it ends", player)
        assert player.wait() == 0
        made.until(lambda: heard["outcome"] and heard["outcome"][-1].is_final, "the outcome")
        playback = Playback(bag)
        total = sum(1 for _ in playback.bag.messages(lambda c: c.topic == "/train_state"))
        playback.close()
        assert len(heard["train_state"]) == total, "nothing is lost"


def test_a_recording_of_nothing_is_refused(tmp_path) -> None:
    Listener(tmp_path / "none", "mcap", {"/train_state": TOPICS["train_state"]}).close()
    with pytest.raises(BagError, match="no message in it"):
        Playback(tmp_path / "none")


def test_mistakes_are_told_in_a_line(tmp_path) -> None:
    pytest.importorskip("rclpy")
    pytest.importorskip("derail_msgs")
    for arguments, text in (
        ([], "path must name a recording"),
        (["-p", f"path:={tmp_path / 'nothing'}"], "no such file"),
    ):
        done = subprocess.run(
            [sys.executable, "-m", "derail_ros.nodes.player", "--ros-args", *arguments],
            capture_output=True,
            text=True,
            timeout=250,
        )
        assert done.returncode == 1
        assert text in done.stderr
        assert "Traceback" not in done.stderr
