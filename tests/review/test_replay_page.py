"""The replay page in a real browser: it loads, plays, scrubs, and its numbers are the bag's."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import time
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from derail_ros.recording.recorded_run import RecordedRun
from derail_ros.review import replay_page as replay
from derail_ros.review import summary, web
from derail_ros.vocabulary.events import EventKind
from tests.review.conftest import find_browser, start_browser


@pytest.mark.slow
def test_there_is_a_browser() -> None:
    """`make verify` fails where the page cannot be checked."""
    found = find_browser()
    assert not isinstance(found, str), f"the replay page cannot be checked: {found}"


# --- the file ----------------------------------------------------------------------------------


class Elements(HTMLParser):
    """All start tags with their attributes, and the text of scripts and styles."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.raw: dict[str, list[str]] = {"script": [], "style": []}
        self._open = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        self._open = tag

    def handle_endtag(self, tag: str) -> None:
        self._open = ""

    def handle_data(self, data: str) -> None:
        if self._open in self.raw:
            self.raw[self._open].append(data)


@pytest.fixture(scope="module")
def page(run: RecordedRun, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of the small recording."""
    return replay.write(run, tmp_path_factory.mktemp("page") / "replay.html")


def test_the_page_needs_nothing_from_anywhere(page: Path) -> None:
    elements = Elements(page.read_text(encoding="utf-8"))
    for tag, attributes in elements.tags:
        for name, value in attributes.items():
            assert not name.startswith("on"), f"{tag} has a handler: {name}"
            assert name != "style", f"{tag} has a style of its own"
            if name in ("src", "href", "action", "data", "poster"):
                assert (value or "").startswith(("#", "data:,")), f"{tag} {name}={value}"
        assert tag not in ("iframe", "object", "embed", "base", "form")


def test_the_policy_allows_this_script_and_this_style_only(page: Path) -> None:
    elements = Elements(page.read_text(encoding="utf-8"))
    policy = next(
        a["content"]
        for t, a in elements.tags
        if t == "meta" and a.get("http-equiv") == "Content-Security-Policy"
    )
    rules = dict(rule.strip().split(" ", 1) for rule in str(policy).split(";"))
    assert rules["default-src"] == "'none'"
    for kind, text in (
        ("script-src", elements.raw["script"][-1]),
        ("style-src", elements.raw["style"][0]),
    ):
        digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        assert rules[kind] == f"'sha256-{digest}'"
    assert "unsafe" not in str(policy)
    assert set(rules) == {
        "default-src",
        "script-src",
        "style-src",
        "img-src",
        "base-uri",
        "form-action",
    }


def luminance(colour: str) -> float:
    """Relative luminance of #rrggbb, as WCAG has it."""
    parts = [int(colour[k : k + 2], 16) / 255.0 for k in (1, 3, 5)]
    linear = [p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts]
    return float(np.dot(linear, [0.2126, 0.7152, 0.0722]))


def test_texts_stand_out_from_what_they_are_on(page: Path) -> None:
    """A contrast of 4.5 (WCAG AA), light and dark; a chosen row lies on --now."""
    style = Elements(page.read_text(encoding="utf-8")).raw["style"][0]
    schemes = re.findall(r":root[^{]*\{([^}]*)\}", style)
    assert len(schemes) == 2
    for scheme in schemes:
        colour = dict(re.findall(r"--([\w-]+): (#\w{6})", scheme))
        pairs = [(text, on) for text in ("ink", "subtle") for on in ("bg", "panel", "now", "warn")]
        for text, on in [*pairs, ("accent-ink", "accent")]:
            light, dark = sorted((luminance(colour[c]) for c in (text, on)), reverse=True)
            assert (light + 0.05) / (dark + 0.05) >= 4.5, f"--{text} on --{on}"


def test_names_of_controls_and_identities(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    elements = Elements(text)
    names = [str(a["id"]) for _, a in elements.tags if "id" in a]
    assert len(names) == len(set(names))
    for tag, a in elements.tags:
        for reference in ("aria-controls", "aria-labelledby", "aria-describedby", "for"):
            if reference in a:
                assert a[reference] in names, f"{tag} {reference}={a[reference]}"
    script = "".join(elements.raw["script"])
    used = set(re.findall(r'\$\("([a-z-]+)"\)', script))
    assert used <= set(names)


def test_what_is_packed_comes_back(run: RecordedRun) -> None:
    """The decoder of the page, in Python."""
    import zlib

    data = replay.data(run, summary.findings(run))
    raw = zlib.decompress(base64.b64decode(data["blob"]))
    at = 0
    for part in data["parts"]:
        count, width = part["rows"] * part["columns"], part["bytes"]
        planes = np.frombuffer(raw[at : at + count * width], np.uint8).reshape(width, count)
        at += count * width
        whole = sum(planes[b].astype(np.int64) << (8 * b) for b in range(width))
        whole = np.where(whole >= 1 << (8 * width - 1), whole - (1 << (8 * width)), whole)
        table = whole.reshape(part["rows"], part["columns"])
        for _ in range(part["order"]):
            table = np.cumsum(table, axis=0)
        values = table * part["scale"]
        if part["name"] == "x":
            np.testing.assert_allclose(values, run.pose[..., 0], atol=0.51e-3)
        if part["name"] == "time":
            np.testing.assert_allclose(values[:, 0], run.time, atol=0.51e-6)
    assert at == len(raw)


# --- in the browser ----------------------------------------------------------------------------


def load(driver: Any, page: Path) -> Any:
    driver.get(page.resolve().as_uri())
    wait(driver, "return document.documentElement.dataset.ready === 'true'")
    return driver


def wait(driver: Any, script: str, seconds: float = 20.0) -> Any:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        value = driver.execute_script(script)
        if value:
            return value
        time.sleep(0.05)
    raise AssertionError(f"waited in vain: {script}")


def js(driver: Any, script: str, *values: Any) -> Any:
    return driver.execute_script(script, *values)


def keys(driver: Any, *which: str) -> None:
    from selenium.webdriver.common.action_chains import ActionChains

    ActionChains(driver).send_keys(*which).perform()


@pytest.fixture
def shown(browser: Any, page: Path) -> Any:
    """The page, freshly loaded; the console must stay empty."""
    browser.get_log("browser")
    load(browser, page)
    yield browser
    assert browser.get_log("browser") == []


def test_it_loads_without_errors_and_without_the_network(shown, run: RecordedRun) -> None:
    assert js(shown, "return performance.getEntriesByType('resource').length") == 0
    assert js(shown, "return derailReplay.time") == pytest.approx(run.time[0])
    assert js(shown, "return derailReplay.last") == pytest.approx(run.time[-1], abs=1e-6)
    assert js(shown, "return document.getElementById('failure').hidden")
    assert not js(shown, "return derailReplay.playing"), "it does not play of itself"


def test_the_numbers_are_the_recordings(shown, run: RecordedRun) -> None:
    facts = summary.findings(run)
    for k in np.linspace(0, len(run.time) - 1, 25).astype(int):
        time_now = float(run.time[k])
        js(shown, "derailReplay.seek(arguments[0] + 2e-6)", time_now)
        for car in (1, run.n // 2, run.n):
            pose = js(shown, "return derailReplay.pose(arguments[0])", car)
            np.testing.assert_allclose(pose[:2], run.pose[k, car - 1, :2], atol=2e-3)
            assert pose[2] == pytest.approx(run.pose[k, car - 1, 5], abs=2e-4)
            speed = js(shown, "return derailReplay.speed(arguments[0])", car)
            assert speed == pytest.approx(run.speed[k, car - 1], abs=0.02)
            peak = js(shown, "return derailReplay.peak(arguments[0])", car)
            assert peak == pytest.approx(run.peaks_until(time_now + 2e-6)[car - 1], rel=1e-6)
        assert js(shown, "return derailReplay.derailed()") == int(run.derailed[k].sum())
    rows = js(shown, "return [...document.querySelectorAll('#events li')].map(e => e.textContent)")
    assert len(rows) == len(facts["timeline"])
    for row, entry in zip(rows, facts["timeline"]):
        assert f"{entry['time_s']:.2f} s" in row
        assert entry["text"][1:] in row
    rows = js(shown, "return document.querySelectorAll('#collisions li').length")
    assert rows == len(run.collisions)


def test_it_plays_pauses_and_changes_its_speed(shown) -> None:
    play = shown.find_element("id", "play")
    play.click()
    assert js(shown, "return derailReplay.playing")
    assert play.text == "Pause"
    wait(shown, "return derailReplay.time > 0.5")
    play.click()
    assert not js(shown, "return derailReplay.playing")
    stood = js(shown, "return derailReplay.time")
    time.sleep(0.2)
    assert js(shown, "return derailReplay.time") == stood
    assert "cars derailed" in js(shown, "return document.getElementById('live').textContent")
    began = js(
        shown,
        "document.getElementById('rate').value = '8'; derailReplay.seek(0); derailReplay.play();"
        "return performance.now()",
    )
    wait(shown, "return derailReplay.time > 4 || !derailReplay.playing")
    # Both clocks in one script: on a slow machine the page plays on between two.
    reached, now = js(shown, "return [derailReplay.time, performance.now()]")
    assert reached <= 8.0 * (now - began) / 1000.0 + 1.0
    # On a slow machine it may have come to the end by now.
    js(shown, "derailReplay.seek(derailReplay.last - 0.1);"
              "if (!derailReplay.playing) derailReplay.play();")  # fmt: skip
    wait(shown, "return !derailReplay.playing")
    assert js(shown, "return derailReplay.time") == js(shown, "return derailReplay.last")


def test_it_is_scrubbed_and_stepped(shown, run: RecordedRun) -> None:
    js(
        shown,
        "const s = document.getElementById('scrub'); s.value = '3'; "
        "s.dispatchEvent(new Event('input'))",
    )
    assert js(shown, "return derailReplay.time") == pytest.approx(3.0, abs=2e-3)
    shown.find_element("id", "home").click()
    assert js(shown, "return derailReplay.time") == pytest.approx(run.time[0])
    for k in (1, 2, 3):
        shown.find_element("id", "step").click()
        assert js(shown, "return derailReplay.time") == pytest.approx(run.time[k], abs=1e-5)
    shown.find_element("id", "back").click()
    assert js(shown, "return derailReplay.time") == pytest.approx(run.time[2], abs=1e-5)
    label = js(shown, "return document.getElementById('scrub').getAttribute('aria-valuetext')")
    wait(shown, "return document.getElementById('readout').textContent.startsWith('0.04')")
    assert "seconds" in label


def test_the_keyboard_does_it_all(shown, run: RecordedRun) -> None:
    from selenium.webdriver.common.keys import Keys

    js(shown, "document.getElementById('scene').focus()")
    keys(shown, Keys.ARROW_RIGHT)
    assert js(shown, "return derailReplay.time") == pytest.approx(run.time[1], abs=1e-5)
    keys(shown, Keys.END)
    assert js(shown, "return derailReplay.time") == js(shown, "return derailReplay.last")
    keys(shown, Keys.HOME, " ")
    assert js(shown, "return derailReplay.playing")
    keys(shown, "k")
    assert not js(shown, "return derailReplay.playing")
    keys(shown, Keys.HOME, "n")
    first = min(e["time_s"] for e in summary.timeline(run) if e["time_s"] > 1e-3)
    assert js(shown, "return derailReplay.time") == pytest.approx(first, abs=1e-5)
    before = js(shown, "return derailReplay.camera")
    keys(shown, "+", "w", "d")
    after = js(shown, "return derailReplay.camera")
    assert after["zoom"] > before["zoom"]
    assert (after["x"], after["y"]) != (before["x"], before["y"])
    keys(shown, "0")
    assert js(shown, "return derailReplay.view") == "site"
    keys(shown, "]", "]", "f")
    assert js(shown, "return derailReplay.view") == "car3"
    keys(shown, "t")
    theme = js(shown, "return document.documentElement.dataset.theme")
    keys(shown, "t")
    assert js(shown, "return document.documentElement.dataset.theme") != theme
    keys(shown, "c", "?")
    assert js(shown, "return document.getElementById('colour').value") == "force"
    assert js(shown, "return !document.getElementById('help').hidden")


def test_letters_need_not_be_keys(shown) -> None:
    """Who dictates or types elsewhere can turn them off; the other keys stay."""
    from selenium.webdriver.common.keys import Keys

    shown.find_element("id", "help-button").click()
    shown.find_element("id", "letters").click()
    js(shown, "document.getElementById('scene').focus()")
    keys(shown, "k", "c", "t", "n", "+", "?")
    assert not js(shown, "return derailReplay.playing")
    assert js(shown, "return derailReplay.time") == 0.0
    assert js(shown, "return document.getElementById('colour').value") == "state"
    assert js(shown, "return derailReplay.view") == "site"
    assert not js(shown, "return document.getElementById('help').hidden")
    keys(shown, Keys.ARROW_RIGHT, " ")
    assert js(shown, "return derailReplay.playing && derailReplay.time > 0")


def test_a_space_on_a_button_presses_that_button_only(shown) -> None:
    from selenium.webdriver.common.keys import Keys

    js(shown, "document.getElementById('step').focus()")
    keys(shown, Keys.SPACE)
    assert not js(shown, "return derailReplay.playing")
    assert js(shown, "return derailReplay.time") > 0.0


def test_every_control_can_be_reached_and_has_a_name(shown) -> None:
    from selenium.webdriver.common.keys import Keys

    js(shown, "document.activeElement.blur(); window.scrollTo(0, 0)")
    reached: list[str] = []
    for _ in range(80):
        keys(shown, Keys.TAB)
        name = js(shown, "return document.activeElement.id || document.activeElement.tagName")
        if name == "BODY":
            break
        reached.append(name)
    wanted = ["theme", "help-button", "view", "colour", "marks", "zoom-out", "zoom-in", "fit"]
    wanted += ["scene", "scrub", "home", "previous", "back", "play", "step", "next", "rate"]
    wanted += ["loop", "tab-events", "filter"]
    assert [r for r in reached if r in wanted] == wanted, "in the order in which they are seen"
    nameless = js(
        shown,
        """return [...document.querySelectorAll('button, select, input, canvas[role], summary')]
        .filter(e => !(e.getAttribute('aria-label') || e.textContent.trim() || e.labels?.length))
        .map(e => e.outerHTML)""",
    )
    assert nameless == []


def test_events_and_collisions_jump_to_their_moment(shown, run: RecordedRun) -> None:
    js(shown, "document.getElementById('filter').value = 'coupler_parted';"
              "document.getElementById('filter').dispatchEvent(new Event('change'))")  # fmt: skip
    parted = [e for e in run.events if e.kind == EventKind.COUPLER_PARTED]
    buttons = shown.find_elements("css selector", "#events button")
    assert len(buttons) == len(parted)
    js(shown, "arguments[0].click()", buttons[1])
    assert js(shown, "return derailReplay.time") == pytest.approx(parted[1].time, abs=1e-5)
    assert buttons[1].get_attribute("aria-current") == "true"
    shown.find_element("id", "tab-collisions").click()
    hardest = summary.by_severity(run)[0]
    js(shown, "document.querySelector('#collisions button').click()")
    assert js(shown, "return derailReplay.time") == pytest.approx(hardest.start - 0.25, abs=1e-4)


def test_a_click_on_a_car_shows_it(shown, run: RecordedRun) -> None:
    from selenium.webdriver.common.action_chains import ActionChains

    js(shown, "derailReplay.seek(derailReplay.last)")
    car = run.outcome.derailed_cars[0]
    x, y = js(shown, "return derailReplay.screen(arguments[0])", car)
    scene = shown.find_element("id", "scene")
    size = scene.size
    ActionChains(shown).move_to_element_with_offset(
        scene, round(x - size["width"] / 2), round(y - size["height"] / 2)
    ).click().perform()
    chosen = js(shown, "return derailReplay.selected")
    assert chosen == car
    text = shown.find_element("id", "details").text
    assert f"Car {car}" in text
    assert "derailed" in text
    peak = run.outcome.car_peak_force[car - 1]
    assert f"{peak * 1e-6:.1f} MN" in text or f"{peak * 1e-3:.0f} kN" in text


def test_each_chart_is_a_table_too(shown, run: RecordedRun) -> None:
    js(shown, "document.querySelectorAll('#charts details').forEach(d => { d.open = true; })")
    wait(shown, "return document.querySelectorAll('#charts table').length === 4")
    heads = (
        "return [...document.querySelectorAll('#table-speed th')].map(h => h.textContent.trim())"
    )
    assert js(shown, heads) == ["time, s", "car 1, m/s", f"car {run.n}, m/s"]
    js(shown, "derailReplay.select(3)")
    assert js(shown, heads) == ["time, s", "car 3, m/s", "car 1, m/s", f"car {run.n}, m/s"]
    rows = js(
        shown,
        "return [...document.querySelectorAll('#table-speed tbody tr')]"
        ".map(r => [...r.children].map(c => Number(c.textContent)))",
    )
    for row in rows:
        k = int(np.abs(run.time - row[0]).argmin())
        np.testing.assert_allclose(row[1:], run.speed[k, [2, 0, run.n - 1]], atol=0.011)
    rows = js(
        shown,
        "return [...document.querySelectorAll('#table-force tbody tr')]"
        ".map(r => [...r.children].map(c => Number(c.textContent)))",
    )
    expected = sorted(run.collisions, key=lambda c: c.peak_time)
    assert len(rows) == len(expected)
    for row, c in zip(rows, expected):
        assert row[0] == pytest.approx(c.peak_time, abs=6e-4)
        assert row[1:3] == [c.car_a, c.car_b]
        assert row[3] == pytest.approx(c.peak_force * 1e-6, abs=6e-4)
    derailed = js(
        shown,
        "return [...document.querySelectorAll('#table-derailed tbody tr')]"
        ".map(r => Number(r.children[1].textContent))",
    )
    assert sorted(derailed) == sorted(run.outcome.derailed_cars)
    last = js(
        shown,
        "return [...document.querySelector('#table-energy tbody tr:last-child').children]"
        ".map(c => Number(c.textContent))",
    )
    scale = 1e-9 if run.energy["initial"][0] >= 1e9 else 1e-6
    assert last[2] == pytest.approx(run.energy["brakes"][-1] * scale, abs=2e-3)


def test_numbers_of_cars_far_off_are_whole_and_apart(
    browser, run: RecordedRun, tmp_path: Path
) -> None:
    """Of a whole train: no number cut by the edge, none on another."""
    page = replay.write(long_train(run), tmp_path / "long.html")
    browser.get_log("browser")
    load(browser, page)
    js(
        browser,
        """
        window.texts = [];
        const fill = CanvasRenderingContext2D.prototype.fillText;
        CanvasRenderingContext2D.prototype.fillText = function (text, x, y) {
          if (this.canvas.id === "scene" && /^[0-9]+$/.test(text)) {
            window.texts.push([text, x, y, this.measureText(text).width / 2]);
          }
          fill.call(this, text, x, y);
        };
        const view = document.getElementById("view");
        view.value = "train"; view.dispatchEvent(new Event("change"));
    """,
    )
    for t in np.linspace(0.0, run.time[-1], 12):
        texts, width = js(
            browser,
            "window.texts = []; derailReplay.seek(arguments[0]);"
            "return [window.texts, document.getElementById('scene').clientWidth]",
            float(t),
        )
        assert len(texts) > 5
        for _, x, _, half in texts:
            assert half <= x <= width - half
        for k, (_, x, y, half) in enumerate(texts):
            for _, other_x, other_y, other_half in texts[:k]:
                assert abs(x - other_x) >= half + other_half or abs(y - other_y) >= 8.0
    assert browser.get_log("browser") == []


LUMINANCE = """
const c = document.getElementById('scene'), small = document.createElement('canvas');
small.width = 40; small.height = 30;
const p = small.getContext('2d', {willReadFrequently: true});
p.drawImage(c, 0, 0, 40, 30);
const d = p.getImageData(0, 0, 40, 30).data, out = [];
for (let i = 0; i < d.length; i += 4) out.push(0.2126 * d[i] + 0.7152 * d[i+1] + 0.0722 * d[i+2]);
return out;
"""


def test_nothing_flashes(shown, run: RecordedRun) -> None:
    """Of the scene no quarter changes its brightness to and fro as WCAG's flashes do."""
    hardest = summary.by_severity(run)[0]
    rows = []
    for t in np.arange(hardest.peak_time - 1.0, hardest.peak_time + 1.0, 0.05):
        js(shown, "derailReplay.seek(arguments[0])", float(t))
        rows.append(js(shown, LUMINANCE))
    change = np.abs(np.diff(np.array(rows), axis=0)) > 25.5
    assert change.mean(axis=1).max() < 0.25


@pytest.mark.parametrize(
    ("arguments", "size"),
    [
        (("--blink-settings=preferredColorScheme=0",), (1300, 900)),
        (("--force-prefers-reduced-motion",), (1300, 900)),
        ((), (500, 800)),
    ],
    ids=["dark", "reduced motion", "narrow"],
)
def test_other_screens(page: Path, arguments, size) -> None:
    driver = start_browser(*arguments, size=size)
    try:
        load(driver, page)
        js(driver, "derailReplay.seek(3); document.getElementById('marks').value = 'all'")
        wide = js(driver, "return [document.documentElement.scrollWidth, innerWidth]")
        assert wide[0] <= wide[1], "nothing must be scrolled sideways"
        if "reduced" in str(arguments):
            assert js(driver, "return matchMedia('(prefers-reduced-motion: reduce)').matches")
        if "Color" in str(arguments):
            assert js(driver, "return document.documentElement.dataset.theme") == "dark"
        assert driver.get_log("browser") == []
    finally:
        driver.quit()


EVIL = "</script><img src=x onerror=hacked()><script>hacked()</script>@DATA@ & \"'\u2028 <b>bold"


def test_strings_of_a_recording_are_only_text(browser, run: RecordedRun, tmp_path: Path) -> None:
    cars = replace(
        run.cars,
        name=(EVIL,) * run.n,
        kind=(EVIL,) * run.n,
        contents=(EVIL,) * run.n,
        coupler_kind=((EVIL, EVIL),) * run.n,
    )
    events = tuple(replace(e, cause=EVIL) for e in run.events)
    evil = replace(
        run,
        title=EVIL,
        name=EVIL,
        run_id=EVIL,
        software=EVIL,
        scenario_hash=EVIL,
        warnings=(EVIL,),
        cars=cars,
        events=(*events, *run.events),
        path=Path("x" + EVIL.replace("/", "")),
    )
    page = replay.write(evil, tmp_path / "evil.html")
    browser.get_log("browser")
    load(browser, page)
    browser.find_element("id", "tab-car").click()
    js(browser, "derailReplay.select(2)")
    assert js(browser, "return document.querySelectorAll('img, b').length") == 0
    assert js(browser, "return document.querySelectorAll('script').length") == 2
    shown = js(browser, "return document.querySelector('h1').textContent")
    assert shown == EVIL
    assert "onerror" in js(browser, "return document.getElementById('details').textContent")
    assert browser.get_log("browser") == []


def long_train(run: RecordedRun, cars: int = 110, states: int = 1500) -> RecordedRun:
    """A run of many cars, made of what the small one has."""
    which = np.arange(cars) % run.n
    rows = np.linspace(0, len(run.time) - 1, states).astype(int)
    shift = -20.0 * (np.arange(cars) // run.n)

    def grow(values: Any) -> Any:
        return values[rows][:, which]

    pose = grow(run.pose).copy()
    pose[:, :, 0] += 10.0 * shift
    c = run.cars
    many = replace(
        c,
        name=tuple(c.name[i] for i in which),
        kind=tuple(c.kind[i] for i in which),
        contents=tuple(c.contents[i] for i in which),
        mass=c.mass[which],
        length=c.length[which],
        width=c.width[which],
        pivot=c.pivot[which],
        truck=c.truck[which],
        coupler=c.coupler[which],
        coupler_kind=tuple(c.coupler_kind[i] for i in which),
        angle_limit=np.resize(c.angle_limit, cars - 1),
        represents=c.represents[which],
        cut=c.cut[which],
    )
    coupled = run.coupled[rows][:, np.minimum(which[:-1], run.n - 2)]
    outcome = replace(
        run.outcome,
        car_peak_force=run.outcome.car_peak_force[which],
        car_peak_other=run.outcome.car_peak_other[which],
        car_peak_time=run.outcome.car_peak_time[which],
        derail_time=run.outcome.derail_time[which],
        derail_speed=run.outcome.derail_speed[which],
    )
    return replace(
        run,
        cars=many,
        time=np.linspace(0.0, 30.0, states),
        pose=pose,
        velocity=grow(run.velocity),
        coupler_yaw=grow(run.coupler_yaw),
        truck_on=grow(run.truck_on),
        coupled=coupled,
        brake_force=grow(run.brake_force),
        corner_force=grow(run.corner_force),
        outcome=outcome,
    )


def test_it_is_smooth_and_small_for_110_cars(browser, run: RecordedRun, tmp_path: Path) -> None:
    page = replay.write(long_train(run), tmp_path / "long.html")
    assert page.stat().st_size < 4e6
    browser.get_log("browser")
    load(browser, page)
    js(browser, "document.getElementById('view').value = 'train';"
                "document.getElementById('view').dispatchEvent(new Event('change'))")  # fmt: skip
    times = js(
        browser,
        "const out = []; for (let k = 0; k < 40; k++) { const t = performance.now();"
        "derailReplay.seek(k * 0.5); out.push(performance.now() - t); } return out",
    )
    assert np.median(times) < 33.0, "a picture in a thirtieth of a second, without a graphics card"
    # While it plays the pictures come as fast as they are drawn, the usual one in 50 ms at most
    # on a machine that is busy with other tests.
    browser.set_script_timeout(30)
    pictures = browser.execute_async_script(
        "const done = arguments[0], out = []; let last = performance.now();"
        "derailReplay.seek(5); derailReplay.play();"
        "const tick = (t) => { out.push(t - last); last = t;"
        "if (out.length < 60) requestAnimationFrame(tick);"
        "else { derailReplay.pause(); done([out, derailReplay.frames]); } };"
        "requestAnimationFrame(tick);"
    )
    assert np.median(pictures[0]) < 50.0
    assert pictures[1] >= 50, "the time moves in each of them"
    assert browser.get_log("browser") == []


def test_the_data_cannot_end_their_element() -> None:
    text = web.script_json({"a": EVIL})
    assert "<" not in text
    assert "\u2028" not in text
    assert json.loads(text) == {"a": EVIL}
