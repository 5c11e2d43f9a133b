"""The page of a study: self-contained, no scripts, escaped, with words for every picture."""

import base64
import hashlib
import re
import shutil
import subprocess
from html.parser import HTMLParser

import pandas as pd
import pytest

from derail_ros.api import StudyAnswers as StudyResults
from derail_ros.studies.runner import run_study
from tests.conftest import UNCHECKED

EVIL = "<script>alert('&\"x')</script>"
HEAD = f"version: 1\ntitle: {EVIL}\ndescription: 'a <b>bold</b> & claim'\nscenario: small\n"

STUDIES = {
    "one_at_a_time": HEAD
    + """\
design: one_at_a_time
ensemble: 3
parameters:
  speed: {path: train.speed_kmh, unit: "<i>km/h", percent: [-20, 20]}
  ground: {path: ground.scale, values: [0.8, 1.2]}
  brakes: {settings: {"<normal>": {}, "instant": {brakes.instant: true}}}
measures: [cars_derailed, peak_force_MN, relative_severity]
""",
    "grid": HEAD
    + """\
design: grid
ensemble: 3
parameters:
  speed: {path: train.speed_kmh, values: [10, 12, 14]}
  brakes: {settings: {"<normal>": {}, "instant": {brakes.instant: true}}}
""",
    "cases": HEAD
    + """\
design: cases
ensemble: 3
columns: {kind: {label: "<kind>"}, size: {}}
cases:
  - {at: {kind: "<a>", size: 1}}
  - {at: {kind: "<b>", size: 2}, set: {ground.scale: 2}}
base: {size: 1}
figures: [{x: size, y: duration_s}]
""",
    "latin_hypercube": HEAD
    + """\
design: latin_hypercube
points: 40
ensemble: 2
parameters:
  speed: {path: train.speed_kmh, range: [10, 20]}
  kind: {settings: {"<a>": {}, "b": {ground.scale: 2}}}
""",
    "sobol": HEAD
    + """\
design: sobol
points: 8
ensemble: 2
parameters:
  speed: {path: train.speed_kmh, range: [10, 20]}
  ground: {path: ground.scale, range: [0.5, 1.5]}
measures: [cars_derailed, duration_s, scene_area_m2]
""",
}


class Page(HTMLParser):
    def __init__(self, text):
        super().__init__()
        self.tags, self.ids, self.stack, self.texts = [], [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        attributes = dict(attributes)
        self.tags.append((tag, attributes))
        self.ids += [attributes["id"]] if "id" in attributes else []
        if tag not in ("meta", "img", "br"):
            self.stack.append(tag)

    def handle_endtag(self, tag):
        assert self.stack.pop() == tag

    def handle_data(self, data):
        self.texts.append(data)

    def of(self, tag):
        return [attributes for t, attributes in self.tags if t == tag]


@pytest.fixture(params=sorted(STUDIES))
def report(request, load, folder, invented):
    def some(point, member):
        if (point, member) == (1, 1):
            raise ValueError(EVIL)
        return {
            "cars_derailed": 2 + (point + member) % 3,
            "duration_s": 5.0 + 0.3 * point + 0.1 * member,
            "peak_force_N": 1e6 + 2e5 * ((point * 7 + member) % 5),
            "scene_area_m2": 100.0 + point,
        }

    place = run_study(load(STUDIES[request.param]), folder / "out", run=invented(some))
    path = StudyResults(place).report(folder / "page")
    return request.param, path, path.read_text(encoding="utf-8")


def test_the_page(report):
    design, path, text = report
    page = Page(text)
    assert page.stack == []
    # nothing runs, nothing is fetched
    assert not page.of("script") and not page.of("link") and not page.of("iframe")
    assert "javascript:" not in text and "http://" not in text and "https://" not in text
    assert not any(k.startswith("on") or k == "style" for _, a in page.tags for k in a)
    (policy,) = [a["content"] for a in page.of("meta") if "http-equiv" in a]
    assert policy.startswith("default-src 'none'; img-src data:; style-src 'sha256-")
    style = re.search(r"<style>(.*?)</style>", text, re.DOTALL)[1]
    digest = base64.b64encode(hashlib.sha256(style.encode()).digest()).decode()
    assert f"'sha256-{digest}'" in policy
    # what came from the study is text
    assert EVIL in "".join(page.texts)
    assert not page.of("b") and not page.of("i") and not page.of("normal")
    # for who cannot see it
    assert page.of("html")[0]["lang"] == "en"
    assert len(page.of("h1")) == 1
    assert len(page.of("img")) >= 2
    for image in page.of("img"):
        assert len(image["alt"]) > 30
        assert image["src"].startswith("data:image/png;base64,")
    assert all(a.get("scope") in ("col", "row") for a in page.of("th"))
    assert len(page.of("caption")) == len(page.of("table"))
    assert len(set(page.ids)) == len(page.ids)
    assert {a["href"][1:] for a in page.of("a")} <= set(page.ids)
    words = "".join(page.texts)
    assert "1 run failed and is left out." in words
    assert {
        "sobol": "Sobol indices",
        "latin_hypercube": "Rank correlations",
        "one_at_a_time": "By parameter",
        "grid": "Shares of the variance",
        "cases": "Least with",
    }[design] in words
    # beside it
    folder = path.parent
    assert len(list(folder.glob("*.png"))) == len(page.of("img"))
    assert len(pd.read_csv(folder / "runs.csv")) == len(StudyResults(folder.parent / "out").table)
    for name in ("summary.csv", "counts.csv", "effects.csv"):
        assert (folder / name).stat().st_size > 50


@pytest.mark.slow
def test_a_browser_shows_it_without_complaint(report):
    browser = shutil.which("chromium") or shutil.which("chromium-browser")
    if browser is None:
        pytest.skip(f"{UNCHECKED}the page of a study in a browser: no Chromium")
    path = report[1]
    answer = subprocess.run(
        [
            browser,
            *("--headless=new", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr"),
            *("--window-size=1000,3000", f"--screenshot={path.parent / 'shot.png'}"),
            path.as_uri(),
        ],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert (path.parent / "shot.png").stat().st_size > 20_000
    assert "CONSOLE" not in answer.stderr


def test_settings_side_by_side_have_a_title_and_begin_at_zero(load, folder, invented):
    from derail_ros.studies import plots

    def some(point, member):
        return {"cars_derailed": 12 + point, "duration_s": 20.0 + 0.1 * member}

    text = STUDIES["cases"].replace(EVIL, "Costs $5 or $6").split("figures:")[0]
    place = run_study(load(text), folder / "out", run=invented(some))
    (drawn,) = [d for d in plots.draw(StudyResults(place)) if d.name == "settings"]
    (legend,) = drawn.figure.legends
    assert legend.get_title().get_text() == r"Costs \$5 or \$6"
    drawn.figure.canvas.draw()
    for axes in drawn.figure.axes:
        assert axes.get_xlim()[0] <= 0.0
        # where all runs agree they stand out above and below the mean's diamond
        dots = [line for line in axes.lines if line.get_marker() == "." and len(line.get_ydata())]
        for line in dots:
            y = line.get_ydata()
            assert max(abs(y - round(y.mean()))) > 0.25


@pytest.mark.parametrize(
    ("measure", "said"),
    [("relative_severity", "mean relative severity"), ("peak_force_N", "mean largest force")],
)
def test_a_ranking_says_once_what_it_is_relative_to(load, folder, invented, measure, said):
    from derail_ros.studies import plots

    def some(point, member):
        value = 2.0 + point + 0.1 * member
        return {"cars_derailed": 2 + point, "peak_force_N": value, "scene_area_m2": value}

    head, _, _ = STUDIES["one_at_a_time"].partition("measures:")
    study = load(f"{head}measures: [{measure}]\n")
    results = StudyResults(run_study(study, folder / "out", run=invented(some)))
    (drawn,) = [d for d in plots.draw(results) if d.name == "ranking"]
    (axes,) = drawn.figure.axes
    assert axes.get_xlabel() == f"{said}, base = 1"
    assert f"largest {said} over each" in drawn.caption
    assert f"{said}, base = 1: " in drawn.alt
