"""``derail look``: the live run, its server, and its page in a real browser."""

from __future__ import annotations

import http.client
import json
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from derail_ros import models
from derail_ros.look.board import Board, Refused
from derail_ros.look.live import LiveRun, Wish
from derail_ros.look.server import Server, serving
from derail_ros.vocabulary.events import Event, EventKind
from tests.review.conftest import browser  # noqa: F401

LIMIT = 120.0
CURVE = "curve_derailment"


def until(done: Callable[[], Any], what: str) -> Any:
    """Wait for a condition; its value."""
    end = time.monotonic() + LIMIT
    while time.monotonic() < end:
        if found := done():
            return found
        time.sleep(0.05)
    raise AssertionError(f"never came: {what}")


@contextmanager
def live(wish: Wish, rate: float = 8.0) -> Iterator[tuple[LiveRun, Server]]:
    """A run that goes on in a thread, and its server."""
    models.engine().warm_up()  # as the command does before its run begins
    run = LiveRun(wish, rate)
    thread = threading.Thread(target=run.go_on)
    with serving(run.board, port=0) as server:
        thread.start()
        try:
            yield run, server
        finally:
            run.close()
            thread.join(LIMIT)


def ask(server: Server, method: str, path: str, body: Any = None, **headers: str) -> Any:
    """Status, headers and text of an answer."""
    port = server.server_address[1]
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=LIMIT)
    text = None if body is None else json.dumps(body)
    sent = {"Content-Type": "application/json"} if body is not None else {}
    connection.request(
        method, path, text, sent | {k.replace("_", "-"): v for k, v in headers.items()}
    )
    answer = connection.getresponse()
    try:
        return answer.status, answer.headers, answer.read().decode()
    finally:
        connection.close()


# --- the board -----------------------------------------------------------------------------------


def test_a_slow_reader_misses_states_and_never_events() -> None:
    board = Board(lambda name, arguments: "", ())
    slow = board.reader()
    assert slow.next(0.0) == []
    board.begin("t", "s", *_train(), np.zeros(2))
    for k in range(5):
        pose = np.full((2, 6), float(k))
        board.state(k, pose, pose, pose[:, :2], np.ones((2, 2)), np.ones(1))
        board.event(Event(EventKind.CAR_AT_REST, k, k, (1,)))
    told = slow.next(0.0)
    assert [kind for kind, _ in told] == ["hello", "state", *["event"] * 5]
    assert told[1][1]["x"] == [4.0, 4.0]
    assert [what["time"] for kind, what in told if kind == "event"] == [0, 1, 2, 3, 4]
    assert slow.next(0.0) == []
    board.begin("t", "s", *_train(), np.zeros(2))
    assert [kind for kind, _ in slow.next(0.0)] == ["hello"], "of the new run nothing old"
    board.close()
    assert slow.next(0.0) is None


def _train() -> Any:
    from derail_ros.recording.recorded_run import Cars, SampledLine
    from derail_ros.vocabulary.train import TrainTotals

    one = np.ones(2)
    cars = Cars(
        ("a", "b"), ("", ""), ("", ""), one, one, one, one, one, np.ones((2, 2)),
        (("E", "E"), ("E", "E")), np.ones(1), np.ones(2, dtype=np.int64),
        TrainTotals(2), np.zeros(2, dtype=np.int64), np.ones(2),
    )  # fmt: skip
    return cars, SampledLine()


# --- the run and its commands --------------------------------------------------------------------


def test_commands_of_a_run() -> None:
    with live(Wish(CURVE, (), whole=True)) as (run, server):

        def command(name: str, **more: Any) -> tuple[int, dict[str, str]]:
            status, _, text = ask(server, "POST", "/command", {"command": name, **more})
            return status, json.loads(text)

        assert command("pause") == (200, {"said": "Paused."})
        stood = run.simulation.time
        assert run.simulation.rail_breaks == [], "whole until it is broken"
        # A place beside the curve: the break is at its foot on the centre line.
        x, y, heading, _ = run.simulation.track.point(180.0)
        left = (x - 1.5 * np.sin(heading), y + 1.5 * np.cos(heading))
        status, told = command("break", x=left[0], y=left[1])
        assert (status, told["said"]) == (200, "The rail is broken at 180.0 m.")
        assert run.simulation.rail_breaks == pytest.approx([180.0], abs=1e-6)
        assert command("brake")[0] == 200
        assert [c.name for c in run.simulation.commands] == [
            "inject_rail_break",
            "trigger_emergency_brake",
        ]
        for name, more, reason in (
            ("break", {"car": 999}, "car"),
            ("break", {"x": "here", "y": 0.0}, "x must be a number"),
            ("rate", {"value": 1e9}, "value must be 0.1 to 10"),
            ("restart", {"speed_kmh": -5.0}, "speed_kmh must be 1 to 400, got -5"),
            ("restart", {"scenario": "/etc/passwd"}, "there is no scenario"),
            ("stop", {}, "command must be one of"),
        ):
            status, told = command(name, **more)
            assert status == 409 and reason in told["error"], (name, told)
        assert run.simulation.time == stood, "refusals change nothing"
        assert command("brake", force=1)[0] == 400
        assert command("restart", speed_kmh=100.0, whole=False)[0] == 200
        assert run.simulation.params.initiation.speed == pytest.approx(100.0 / 3.6)
        assert run.simulation.rail_breaks == [210.0], "as the scenario has it"
        # On straight track nothing would derail without a command: that is no mistake here.
        assert command("restart", scenario="mid_train_break")[0] == 200
        assert run.simulation.rail_breaks == []
        until(lambda: run.simulation.time > 1.0, "the run goes on by itself")


def test_only_its_own_page_may_send_commands() -> None:
    sent = []

    def act(name: str, arguments: dict[str, Any]) -> str:
        sent.append((name, arguments))
        raise Refused("not now")

    with serving(Board(act, ("brake",)), port=0) as server:
        port = server.server_address[1]
        own, brake = f"http://127.0.0.1:{port}", {"command": "brake"}
        status, headers, text = ask(server, "GET", "/")
        assert status == 200 and "Content-Security-Policy" in text
        assert headers["X-Frame-Options"] == "DENY"
        assert ask(server, "GET", "/etc/passwd")[0] == 404
        assert ask(server, "GET", "/", Host="elsewhere.example")[0] == 403, "a rebound name"
        assert ask(server, "POST", "/command", brake, Origin="http://evil.example")[0] == 403
        assert ask(server, "POST", "/command", brake, Content_Type="text/plain")[0] == 400
        assert ask(server, "POST", "/command", {"command": "x" * 20_000})[0] == 400
        assert not sent
        assert ask(server, "POST", "/command", brake, Origin=own)[0] == 409
        assert sent == [("brake", {})]
    with serving(Board(act, ()), "0.0.0.0", 0) as server:
        assert not server.local
        assert server.addresses[0].startswith("http://127.0.0.1:")


def test_the_command_serves_and_ends() -> None:
    program = "import sys; from derail_ros.cli import main; sys.exit(main(sys.argv[1:]))"
    arguments = ["look", "--no-browser", "--port", "0"]
    with subprocess.Popen(
        [sys.executable, "-c", program, *arguments], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        said = process.stdout.readline()
        address = said.split()[1]
        assert address.startswith("http://127.0.0.1:"), said
        connection = http.client.HTTPConnection(address.split("/")[2], timeout=LIMIT)
        connection.request("GET", "/events")
        assert connection.getresponse().readline() == b"event: hello\n"
        process.send_signal(signal.SIGINT)
        assert process.wait(LIMIT) == 0
        connection.close()


# --- the page ------------------------------------------------------------------------------------


def test_the_page_in_a_browser(browser: Any) -> None:  # noqa: F811
    from selenium.webdriver import ActionChains
    from selenium.webdriver.support.ui import Select

    with live(Wish(CURVE, (), whole=True)) as (run, server):
        browser.get(server.addresses[0])

        def js(what: str) -> Any:
            return browser.execute_script(f"return window.derailLook.{what}")

        until(lambda: js("time") > 1.0, "states")
        assert js("cars") == 40 and js("breaks") == 0
        browser.find_element("id", "break").click()
        until(lambda: js("breaks") == 1, "the break on the page")
        until(lambda: js("derailed") > 2, "cars off the rails")
        browser.find_element("id", "brake").click()
        until(lambda: js("ended"), "the end of the run")
        assert js("derailed") == run.simulation.outcome().cars_derailed
        shown = browser.find_element("id", "outcome").text
        assert shown.startswith(f"{js('derailed')} cars derailed, at rest after"), shown
        assert not browser.find_element("id", "break").is_enabled()
        # The slider and a new start; a place on the track is tapped.
        browser.execute_script(
            "const s = document.getElementById('speed'); s.value = 120;"
            "s.dispatchEvent(new Event('input'))"
        )
        assert browser.find_element("id", "speed-shown").text == "120 km/h (75 mph)"
        browser.find_element("id", "restart").click()
        until(lambda: js("run") == 2 and js("time") > 0.2, "a new run")
        assert run.simulation.params.initiation.speed == pytest.approx(120.0 / 3.6)
        assert browser.find_element("id", "break").is_enabled()
        browser.find_element("id", "pause").click()
        until(lambda: browser.find_element("id", "pause").text == "Go on", "paused")

        def still() -> Any:
            before = js("pose(1)")
            time.sleep(0.3)
            return before if before == js("pose(1)") else None

        track = run.simulation.track
        head, _ = track.locate(*until(still, "the page has caught up"))
        x, y, _, _ = track.point(head + 12.0)
        scene = browser.find_element("id", "scene")
        size = scene.rect["width"], scene.rect["height"]

        def in_view() -> bool:
            return all(20.0 < at < most - 20.0 for at, most in zip(js(f"screen({x}, {y})"), size))

        # The view has glided there, and then stands still.
        until(in_view, "the place in view")
        Select(browser.find_element("id", "view")).select_by_value("free")
        assert in_view()
        across, down = js(f"screen({x}, {y})")
        browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", scene)
        click = ActionChains(browser)
        click.move_to_element_with_offset(scene, across - size[0] / 2, down - size[1] / 2)
        click.click().perform()
        assert browser.find_element("id", "break").text == "Break the rail here"
        browser.find_element("id", "break").click()
        (place,) = until(lambda: run.simulation.rail_breaks, "a break where it was tapped")
        assert place == pytest.approx(head + 12.0, abs=1.5)
        assert [e for e in browser.get_log("browser") if e["level"] == "SEVERE"] == []


def test_the_page_on_a_phone(browser: Any) -> None:  # noqa: F811
    size = {"width": 360, "height": 740, "deviceScaleFactor": 2, "mobile": True}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    try:
        with live(Wish(CURVE, (), whole=True), rate=1.0) as (_, server):
            browser.get(server.addresses[0])
            until(lambda: browser.execute_script("return window.derailLook.time > 0"), "states")
            root = "return document.documentElement."
            assert browser.execute_script(root + "scrollWidth") <= 360
            # Scene and buttons are on the first screen, and large enough for a finger.
            for name in ("scene", "break", "brake"):
                box = browser.find_element("id", name).rect
                assert box["y"] + box["height"] <= 740 and box["height"] >= 44, (name, box)
    finally:
        browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
