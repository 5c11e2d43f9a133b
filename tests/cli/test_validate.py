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
    assert len(answer.json["cases"]) == 9
    assert all(c["failed"] == 0 for c in answer.json["cases"])
    reached = {g["goal"]: g["value"] for g in answer.json["goals"]}
    assert reached["count_rms"] < 2.0
