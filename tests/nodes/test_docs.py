"""The client of docs/ros2.md does what the page says, and its tables name what there is."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from derail_ros.nodes.parameters import SIMULATOR
from msg_adapters.topics import TOPICS

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "ros2.md").read_text(encoding="utf-8")


@pytest.mark.ros
def test_the_client_of_the_page(tmp_path) -> None:
    pytest.importorskip("rclpy")
    pytest.importorskip("derail_msgs")
    from tests.nodes.graph import LIMIT, graph

    program, other = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    with graph(tmp_path) as made:
        # Of a run before the client's own it hears events too.
        made.simulator(scenario="curve_derailment", speed_factor=0.0)
        made.listen("outcome")
        made.until(lambda: any(m.is_final for m in made.heard["outcome"]), "a run before")

        def run(text: str) -> subprocess.CompletedProcess[str]:
            command = [sys.executable, "-c", text]
            return subprocess.run(
                command, env=made.env, capture_output=True, text=True, timeout=LIMIT
            )

        answer = run(program)
        own = len(made.ask("get_events").events)
        loaded = run(other)
    assert loaded.returncode == 0 and loaded.stdout == "1 base_train\n", loaded
    assert answer.returncode == 0, answer.stderr
    said = r"broken at -?[\d.]+ m: \d+ cars derailed\nat rest after [\d.]+ s, (\d+) events heard"
    found = re.search(said, answer.stdout)
    assert found and 0 < int(found[1]) <= own, (answer.stdout, own)


@pytest.mark.ros
def test_the_client_of_the_tutorial(tmp_path) -> None:
    pytest.importorskip("rclpy")
    pytest.importorskip("derail_msgs")
    from tests.nodes.graph import LIMIT, graph

    page = (ROOT / "docs" / "tutorials" / "ros2.md").read_text(encoding="utf-8")
    (program,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    with graph(tmp_path) as made:
        made.simulator(scenario="curve_derailment", start_paused=True, speed_factor=0.0)

        def run(text: str) -> subprocess.CompletedProcess[str]:
            command = [sys.executable, "-c", text]
            return subprocess.run(
                command, env=made.env, capture_output=True, text=True, timeout=LIMIT
            )

        answer = run(program)
    assert (answer.returncode, answer.stdout) == (0, "at rest\n"), answer.stderr


def test_the_page_names_every_topic_and_service() -> None:
    services = [path.stem for path in (ROOT / "derail_msgs" / "srv").glob("*.srv")]
    names = {re.sub(r"(?<!^)([A-Z])", r"_\1", name).lower() for name in services}
    player = {"pause", "resume", "toggle_paused", "is_paused", "set_rate", "get_rate", "seek"}
    player |= {"play_next", "burst", "stop"}
    for name in names - player:
        assert f"`~/{name}`" in PAGE or f"`~/derail/{name}`" in PAGE, name
    for name in TOPICS:
        assert f"`{name}`" in PAGE, name
    for name in re.findall(r"parameter `(\w+)`", PAGE):
        assert name in {p.name for p in SIMULATOR}, name
