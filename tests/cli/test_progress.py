"""Progress where there is no terminal."""

import re

import pytest

from derail_ros.commands import common


@pytest.fixture
def plain(monkeypatch):
    """A display without a terminal, and a clock that is set by hand."""
    clock = [100.0]
    monkeypatch.setattr(common.time, "monotonic", lambda: clock[0])
    with common.progress(*common.counting_columns()) as bars:
        yield bars, clock


def test_what_is_quick_says_nothing(plain, capsys):
    bars, clock = plain
    task = bars.add_task("runs", total=5)
    for _ in range(5):
        clock[0] += 0.9 * common.PLAIN_S / 5
        bars.update(task, advance=1)
    assert capsys.readouterr() == ("", "")


def test_what_takes_long_says_a_line_now_and_then(plain, capsys):
    bars, clock = plain
    task = bars.add_task("runs", total=50)
    for _ in range(50):
        clock[0] += 1.0
        bars.update(task, advance=1)
    out, err = capsys.readouterr()
    assert out == ""
    left = [f"derail: runs: {n} of 50, about {50 - n} s left" for n in (10, 20, 30, 40)]
    assert err.splitlines() == [*left, "derail: runs: 50 of 50"]


def test_a_state_in_words(plain, capsys):
    bars, clock = plain
    task = bars.add_task("train, anderson", total=None, state="")
    clock[0] += 11.0
    bars.update(task, state="3.5 s, 4 cars derailed")
    assert capsys.readouterr().err == "derail: train, anderson: 3.5 s, 4 cars derailed\n"


@pytest.mark.parametrize("model", ["planar", "anderson", "yang-manos"])
def test_every_model_that_takes_time_tells_how_far_it_is(derail, small, monkeypatch, model):
    monkeypatch.setattr(common, "PLAIN_S", 0.0)
    answer = derail("simulate", small, "--model", model, "--json")
    assert answer.code == 0
    lines = answer.err.splitlines()
    assert len(lines) > 3 and all(re.search(r"\d cars? derailed$", x) for x in lines[:3]), lines


def test_a_comparison_tells_which_model_it_is_at(derail, small, monkeypatch):
    monkeypatch.setattr(common, "PLAIN_S", 0.0)
    answer = derail("compare-models", small, "--model", "planar", "--model", "blockage")
    assert answer.code == 0
    lines = [re.sub(", about [0-9]+ (s|min) left$", "", x) for x in answer.err.splitlines()]
    assert lines[:2] == [
        "derail: small, planar: 0 of 2",
        "derail: small, blockage: 1 of 2",
    ]
