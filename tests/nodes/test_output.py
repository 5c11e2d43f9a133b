"""Publishers that begin anew with each run, without a graph."""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace

import pytest

from derail_ros.nodes import outputs
from derail_ros.nodes.outputs import RETIRED_MOST, Outputs
from msg_adapters.topics import TOPICS, Topic


class Publisher:
    """A publisher whose subscribers match and acknowledge when they are told to."""

    def __init__(self, topic: str) -> None:
        self.topic = topic
        self.matched = 0
        self.acknowledged = False
        self.destroyed = False
        self.sent: list[bytes] = []

    def publish(self, data: bytes) -> None:
        assert not self.destroyed
        self.sent.append(data)

    def get_subscription_count(self) -> int:
        return self.matched


class Bench:
    """An output on publishers like that, and a clock."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 100.0
        self.made: dict[str, list[Publisher]] = {}
        monkeypatch.setattr(outputs, "time", SimpleNamespace(monotonic=lambda: self.now))
        monkeypatch.setattr(outputs, "acknowledged", lambda p, _: p.acknowledged)
        self.output = Outputs(SimpleNamespace(destroy_publisher=self._destroy))
        for topic in TOPICS.values():
            self.output.open(topic.name, partial(self._make, topic.name), topic.latched)

    def _make(self, name: str) -> Publisher:
        publisher = Publisher(name)
        self.made.setdefault(name, []).append(publisher)
        return publisher

    @staticmethod
    def _destroy(publisher: Publisher) -> None:
        publisher.destroyed = True

    def outcomes(self) -> list[Publisher]:
        return self.made["outcome"]


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Bench:
    return Bench(monkeypatch)


def test_a_type_that_is_not_installed_is_told_once() -> None:
    said: list[str] = []
    node = SimpleNamespace(get_logger=lambda: SimpleNamespace(warning=said.append))
    output = Outputs(node)
    absent = Topic("map", "nobodys_msgs/msg/Map", 1, True, "")
    for _ in range(3):
        assert not output.offer(absent)
    output.publish("map", b"")
    output.renew()
    assert said == ["no map: No module named 'nobodys_msgs'"]


def test_each_latched_topic_begins_anew_with_a_run(bench: Bench) -> None:
    bench.output.renew()
    for name, publishers in bench.made.items():
        assert len(publishers) == (2 if TOPICS[name].latched else 1), name


def test_a_new_run_waits_for_those_who_heard_the_last_one(bench: Bench) -> None:
    first = bench.outcomes()[0]
    first.matched = 2
    bench.output.renew()
    bench.output.publish("outcome", b"new")
    second = bench.outcomes()[1]
    second.matched = 1
    bench.output.pump()
    assert second.sent == []
    second.matched = 2
    bench.output.pump()
    assert second.sent == [b"new"]


def test_an_old_publisher_stays_until_everything_has_arrived(bench: Bench) -> None:
    first = bench.outcomes()[0]
    first.matched = 1
    bench.output.publish("outcome", b"final")
    bench.output.renew()
    bench.now += 5.0
    bench.output.pump()
    assert not first.destroyed
    first.acknowledged = True
    bench.output.pump()
    assert first.destroyed


def test_a_run_that_is_replaced_at_once_still_tells_its_end(bench: Bench) -> None:
    """Nobody has matched its publisher yet: that nothing waits for an answer proves nothing."""
    bench.outcomes()[0].matched = 1
    bench.output.renew()
    bench.output.publish("outcome", b"first of the second run")
    bench.output.publish("outcome", b"final of the second run")
    bench.output.renew()
    second = bench.outcomes()[1]
    second.acknowledged = True
    bench.output.pump()
    assert second.sent[-1] == b"final of the second run" and not second.destroyed
    second.matched = 1
    bench.output.pump()
    assert second.destroyed


def test_subscribers_that_never_answer_keep_no_publisher_for_ever(bench: Bench) -> None:
    bench.outcomes()[0].matched = 1
    for _ in range(3 * RETIRED_MOST):
        bench.output.renew()
    alive = [p for p in bench.outcomes() if not p.destroyed]
    assert len(alive) == RETIRED_MOST + 1
    bench.now += 60.0
    bench.output.pump()
    assert [p for p in bench.outcomes() if not p.destroyed] == [bench.outcomes()[-1]]
