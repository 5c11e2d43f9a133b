"""``derail validate`` on two members a case."""

import pytest


def test_bad_settings_are_refused_before_the_first_run(derail):
    answer = derail("validate", "--set", "contact.no_such=1")
    assert answer.code == 2
    assert "contact.no_such" in answer.err


def test_page_and_settings_do_not_go_together(derail):
    answer = derail("validate", "--write", "--set", "ground.scale=1.1")
    assert answer.code == 2
    assert "--write" in answer.err


def test_page_needs_its_folder(derail, tmp_path):
    answer = derail("validate", "--write", "--to", tmp_path / "none" / "page.md")
    assert answer.code == 2


@pytest.mark.slow
def test_validate(derail, tmp_path):
    page = tmp_path / "validation.md"
    answer = derail("validate", "-n", 3, "--json", "--write", "--to", page)
    assert answer.code == 0
    assert len(answer.json["cases"]) == 9
    assert all(c["failed"] == 0 for c in answer.json["cases"])
    reached = {g["goal"]: g["value"] for g in answer.json["goals"]}
    assert reached["count_rms"] < 2.0
    assert "## Goals" in page.read_text(encoding="utf-8")
