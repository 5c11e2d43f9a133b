"""``derail validate`` on a few members a case."""

import pytest


def test_bad_settings_are_refused_before_the_first_run(derail):
    answer = derail("validate", "--set", "contact.no_such=1")
    assert answer.code == 2
    assert "contact.no_such" in answer.err


@pytest.mark.slow
def test_validate(derail):
    answer = derail("validate", "-n", 3, "--json")
    assert answer.code == 0
    assert len(answer.json["cases"]) == 21
    assert len(answer.json["statements"]) == 21
    assert all(c["failed"] == 0 for c in answer.json["cases"])
    reached = {g["goal"]: g["value"] for g in answer.json["goals"]}
    assert reached["count_rms"] < 2.0


def test_unknown_numerics_are_refused_before_the_first_run(derail):
    answer = derail("validate", "--numerics", "exact")
    assert answer.code == 2
    assert "shipped or source" in answer.err


def test_figures(derail, tmp_path):
    assert derail("figures", "laws", "-o", tmp_path / "laws").code == 0
    assert (tmp_path / "laws" / "laws.png").stat().st_size > 50_000
    answer = derail("figures", "scene", "base_train", "--at", "1.5", "-o", tmp_path / "scene")
    assert answer.code == 0
    assert (tmp_path / "scene" / "scene_1.50s.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (("everything",), "must be one of laws, scene, variations, scenes, got 'everything'"),
        (("scene",), "--at"),
        (("scene", "--at", "-1"), "zero or more, got -1"),
        (("laws", "no_such"), "no_such"),
    ],
)
def test_figures_that_are_refused(derail, tmp_path, arguments, reason):
    answer = derail("figures", *arguments, "-o", tmp_path / "out")
    assert answer.code == 2
    assert reason in answer.err
    assert not (tmp_path / "out").exists()
