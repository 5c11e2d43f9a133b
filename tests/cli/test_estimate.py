"""``derail estimate``."""

import pytest

from derail_ros.commands.estimate import parse_cars


def test_published_figures(derail):
    answer = derail("estimate", "bar-1", "--json")
    assert answer.json["speed_kmh"] == 64.0
    assert answer.json["mu2"] == 0.5
    assert answer.json["form"] is None
    assert [row["cars"] for row in answer.json["trains"]] == list(range(10, 101, 10))
    assert answer.json["trains"][0]["cars_derailed"] == pytest.approx(5.886, abs=1e-3)


def test_limiting_speed(derail):
    answer = derail("estimate", "bar-2", "--cars", 60, "--speed-kmh", 101, "--json")
    (row,) = answer.json["trains"]
    assert row["whole_train"]
    assert row["limiting_speed_kmh"] == pytest.approx(100.4, abs=0.05)
    corrected = derail(
        "estimate", "bar-2", "--cars", 60, "--speed-kmh", 101, "--form", "corrected", "--json"
    )
    assert not corrected.json["trains"][0]["whole_train"]


def test_case_3_parameters(derail):
    answer = derail("estimate", "bar-3", "--cars", "90,100", "--mu2", 2.1, "--json")
    assert answer.json["speed_kmh"] == 105.0
    assert answer.json["trains"][1]["cars_derailed"] < 40.0


def test_table(derail):
    out = derail("estimate", "bar-3").out
    assert "published form" in out
    assert "whole train" in out


@pytest.mark.parametrize(
    ("text", "cars"),
    [
        ("60", [60]),
        ("20, 40", [20, 40]),
        ("10:14", [10, 11, 12, 13, 14]),
        ("10:30:10,5", [10, 20, 30, 5]),
    ],
)
def test_numbers_of_cars(text, cars):
    assert parse_cars(text) == cars
