"""``python -m research``: names, mistakes, and pages written for real on few runs."""

import re

import pytest

from research.__main__ import PAGES, main
from research.pages import Options

PNG = b"\x89PNG"


def test_the_list_names_every_page(capsys):
    assert main(["--list"]) == 0
    assert capsys.readouterr().out.split() == list(PAGES)


@pytest.mark.parametrize("name", PAGES)
def test_every_page_has_a_writer(name):
    import importlib

    assert callable(importlib.import_module(f"research.{name}").write)


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (("validation", "--to", "/no/such/page.md"), "/no/such"),
        (("sensitivity", "--to", "/no/such/page.md"), "/no/such"),
        (("spread", "no_such", "--to", "{folder}/page.md"), "no_such"),
        (("baselines", "--to", "/no/such/page.md"), "/no/such"),
        (("baselines", "--to", "{other}"), "no place for the results base_train"),
        (("accidents",), "name the files"),
        (("accidents", "{other}", "--to", "/no/such/page.md"), "/no/such"),
        (("accidents", "{other}", "--to", "{other}"), "has no place for the results about"),
        (("studies", "placement", "--to", "{other}"), "has no place for the results placement"),
    ],
)
def test_mistakes_are_one_line_before_the_first_run(capsys, tmp_path, arguments, word):
    other = tmp_path / "other.md"
    other.write_text("# By hand\n", encoding="utf-8")
    places = {"{other}": str(other), "{folder}": str(tmp_path)}
    given = [re.sub(r"\{\w+\}", lambda m: places[m[0]], argument) for argument in arguments]
    assert main(given) == 2
    out, err = capsys.readouterr()
    assert word in err
    assert (err.count("\n"), out) == (1, "")
    assert other.read_text(encoding="utf-8") == "# By hand\n"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "arguments", "heading"),
    [
        ("validation", ("-n", "3"), "## Goals"),
        ("sensitivity", ("base_30", "-n", "2"), "## Controls"),
        ("spread", ("base_train", "-n", "4"), "## Base train"),
        ("convergence", ("base_train", "-n", "3"), "## Base train"),
    ],
)
def test_pages(tmp_path, name, arguments, heading):
    page = tmp_path / "page.md"
    assert main([name, *arguments, "--to", str(page)]) == 0
    text = page.read_text(encoding="utf-8")
    assert heading in text
    images = re.findall(r"\((images/\w+\.png)\)", text)
    assert images
    for image in images:
        assert (tmp_path / image).read_bytes().startswith(PNG)


def test_a_study_is_told_in_its_place(tmp_path, monkeypatch):
    from derail_ros.api import study
    from research import studies

    plan = {
        "title": "Two speeds",
        "scenario": "base_train",
        "overrides": {"train.consist.0.count": 6},
        "design": "cases",
        "ensemble": 2,
        "columns": {"speed": {}},
        "cases": [{"at": {"speed": v}, "set": {"train.speed_kmh": v}} for v in (20, 30)],
    }
    study(plan, tmp_path / "two", table="csv")
    monkeypatch.setattr(studies, "list_studies", lambda: [("study", "", "another size")])
    monkeypatch.setitem(studies.FIGURES, "two", ("settings",))
    page = tmp_path / "page.md"
    page.write_text("Before <!-- results: two -->OLD<!-- end of results --> after\n", "utf-8")
    studies.write(Options(page, names=("two",), results=tmp_path))
    text = page.read_text(encoding="utf-8")
    assert "OLD" not in text and text.startswith("Before ") and text.endswith(" after\n")
    assert "$ derail study study -n 2" in text
    assert (tmp_path / "images" / "study_two_settings.png").read_bytes().startswith(PNG)
