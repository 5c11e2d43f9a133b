"""``derail sensitivity``, ``spread`` and ``convergence``: real runs of the quickest kind."""

import pytest


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (("sensitivity", "--case", "no_such"), "base_48"),
        (("sensitivity", "--only", "no_such"), "k2"),
        (("spread", "no_such"), "no_such"),
        (("spread", "--set", "ground.no_such=1"), "ground.no_such"),
        (("spread", "--set", "initiation.lateral_force_N=0"), "lateral"),
        (("spread", "base_train", "base_train"), "twice"),
        (("convergence", "--rtol", "1e-3"), "two"),
        (("convergence", "--rtol", "1e-3", "--rtol", "-1"), "--rtol"),
        (("convergence", "-n", "2"), "3"),
    ],
)
def test_mistakes_are_one_line_before_the_first_run(derail, arguments, word):
    answer = derail(*arguments)
    assert answer.code == 2
    assert word in answer.err
    assert answer.err.count("\n") == 1
    assert answer.out == ""


def test_sensitivity(derail):
    quick = ("--case", "base_30", "--only", "rest_speed", "--only", "mirror")
    answer = derail("sensitivity", "-n", 2, *quick, "--json")
    assert answer.code == 0
    assert answer.json["failed"] == 0
    by_value = {e["value"]: e["overall"] for e in answer.json["effects"]}
    # a lower threshold is reached later, and nothing else changes
    assert by_value["0.05"]["duration_s"]["change"] > 0.0
    assert by_value["0.05"]["cars_derailed"]["change"] == 0.0
    assert abs(by_value["to the right"]["duration_s"]["change"]) < 0.1
    table = derail("sensitivity", "-n", 2, *quick)
    assert "at rest below (m/s)" in table.out


def test_spread(derail, small):
    answer = derail("spread", small, "-n", 4, "--json")
    assert answer.code == 0
    (spread,) = answer.json["spreads"]
    assert len(spread["measures"]["duration_s"]["values"]) == 4
    table = derail("spread", small, "-n", 4, "-j", 1)
    assert "cars derail" in table.out


def test_convergence(derail, small):
    tolerances = ("--rtol", "1e-3", "--rtol", "1e-5")
    answer = derail("convergence", small, "-n", 3, *tolerances, "--json")
    assert answer.code == 0
    (study,) = answer.json["studies"]
    assert [level["rtol"] for level in study["tolerances"]] == [1e-3, 1e-5]
    assert study["reference"]["method"] == "rkf45"
    assert study["tolerances"][0]["measures"]["cars_derailed"]["difference"] == 0.0
    table = derail("convergence", small, "-n", 3, *tolerances)
    assert "rkf45 1e-5" in table.out
