"""The page on reported accidents, its figures and the averages that come with the package."""

import math
import re

import numpy as np
import pytest

from derail_ros.baselines import reenact
from derail_ros.studies import accidents as a
from research import accidents as page
from research.__main__ import PARTS
from research.pages import BEGIN, DOCS, END, Options, fill
from tests.studies.test_accidents import many_reports

SCOPE = page.Scope(
    most=2, every=2, group=a.Group(a.BROKEN_RAIL, behind=30),
    ways=(page.WAYS[0], page.WAYS[1], page.WAYS[-1]), matched=page.WAYS[1].label,
)  # fmt: skip


@pytest.fixture
def many(tmp_path):
    return many_reports(tmp_path / "many.txt")


def test_statistics_go_through_their_file(many, tmp_path, monkeypatch):
    statistics = page.statistics_of(a.read_reports([many]))
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / a.SHIPPED).write_text(page.statistics_yaml(statistics), encoding="utf-8")
    monkeypatch.setattr(a, "files", lambda _package: tmp_path)
    again = a.load_statistics()
    assert again.years == (2010, 2010)
    for name, classes in statistics.groups.items():
        for one, other in zip(classes, again.groups[name], strict=True):
            assert vars(other) == pytest.approx(vars(one), abs=5e-4)


def test_failed_runs_are_left_out_and_said(many):
    reports = reenact.sample(a.read_reports([many]), 100)
    counts = {"x": [2.0, None, 4.0, 6.0, None, None]}
    slow, fast = reenact.averages(reports, counts)
    assert (slow[3]["x"].mean, slow[3]["x"].failed) == (4.0, 1)
    assert math.isnan(fast[3]["x"].mean)
    assert fast[3]["x"].failed == 2
    assert "x: 3 runs failed." in page.reenacted(reports, counts)


def cells(text, block, row):
    """A row of a table of a block."""
    part = text.split(BEGIN.format(block))[1].split(END)[0]
    line = next(x for x in part.splitlines() if x.startswith(f"| {row} |"))
    return [c.strip() for c in line.strip("|").split("|")][1:]


def test_the_page(many, tmp_path, monkeypatch):
    path = tmp_path / "page.md"
    text = (DOCS / "accidents.md").read_text(encoding="utf-8")
    # nothing of what stands there is kept
    path.write_text(fill(text, dict.fromkeys(page.NAMES, "OLD")), encoding="utf-8")
    monkeypatch.setattr(a, "__file__", str(tmp_path / "accidents.py"))
    (tmp_path / "data").mkdir()
    page.write(Options(path, names=(str(many),), jobs=2), SCOPE)
    text = path.read_text(encoding="utf-8")
    assert "OLD" not in text
    found = page.compute(a.read_reports([many]), SCOPE)
    assert cells(text, "broken_rail", "trains") == ["2", "1"]
    own = [np.mean([r.derailed for r in found.reports if (r.speed_kmh > 30) == fast])
           for fast in (False, True)]  # fmt: skip
    assert [float(c.split(" ")[0]) for c in cells(text, "broken_rail", "*reported*")] == own
    label = SCOPE.ways[1].label
    expected = np.mean(found.counts[label][:2])
    assert cells(text, "broken_rail", label)[0].startswith(f"{expected:.1f}")
    assert cells(text, "all_causes", "trains") == ["2", "2"]
    ratio = sum(found.counts[label]) / sum(r.derailed for r in found.reports)
    assert cells(text, "agreement", label)[0] == f"{ratio:.2f}"
    assert cells(text, "agreement", "reported, mean of the class")[0] == "1.00"
    assert cells(text, "statistics", "all causes: cars behind, t a car") == ["48, 86", "61, 104"]
    assert "7 freight trains derailed on main track, 0 of them at speeds outside 8 to" in text
    images = {p.name for p in (tmp_path / "images").iterdir()}
    assert images == set(page.figures(found))
    assert (tmp_path / "data" / a.SHIPPED).is_file()


def test_the_page_has_a_place_for_every_result():
    text = (DOCS / "accidents.md").read_text(encoding="utf-8")
    others = [name for name, whole in PARTS.items() if whole == "accidents"]
    assert others == ["trains"]
    assert set(re.findall(r"<!-- results: (\w+) -->", text)) == {*page.NAMES, *others}
    images = re.findall(r"\((images/[a-z0-9_]+\.png)\)", text)
    assert len(images) == 2
    for image in images:
        assert (DOCS / image).stat().st_size > 5000
