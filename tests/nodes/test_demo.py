"""What the demonstration shows at its end."""

from __future__ import annotations

import re

import pytest
from rich.console import Console

from derail_ros import demo
from derail_ros.recording import record_run
from derail_ros.recording.reader import read_bag
from derail_ros.vocabulary.measures import MEASURES
from tests.nodes.support import SMALL, simulation, small


@pytest.fixture(scope="module")
def last(tmp_path_factory):
    """Outcomes of a run that came to rest, and of one that its time limit ended."""
    folder = tmp_path_factory.mktemp("demo")
    found = {}
    for name, more in (("at rest", ""), ("time limit", "integration: {time_limit_s: 2.0}\n")):
        bag = folder / name.replace(" ", "_")
        record_run(simulation(SMALL + more), small(SMALL + more), bag)
        found[name] = read_bag(bag).outcome
        assert found[name].status == name
    return found


def shown(outcome, scenario: str, width: int) -> list[str]:
    """The table's lines on a terminal of that width."""
    console = Console(width=width)
    with console.capture() as capture:
        console.print(demo.comparison(outcome, scenario))
    return capture.get().splitlines()


@pytest.mark.parametrize("width", [80, 120])
def test_the_table_has_a_line_a_row(last, width) -> None:
    outcome = last["at rest"]
    lines = shown(outcome, demo.SCENARIO, width)
    rows = {line.split("│")[1].strip(): line for line in lines if "│" in line}
    assert list(rows) == [MEASURES[key].title for key in demo.KEYS]
    for key, size, others in (
        ("scene_length_m", outcome.scene_length, r"132\.0 +│ 109\.0"),
        ("scene_width_m", outcome.scene_width, r"39\.0 +│ 41\.7"),
    ):
        assert re.search(rf"│ {size:.1f} +│ {others}", rows[MEASURES[key].title])
    assert f"at rest after {outcome.duration:.1f} s" in lines[0]


def test_a_run_that_its_time_limit_ends_is_not_said_to_rest(last) -> None:
    outcome = last["time limit"]
    lines = shown(outcome, "small", 80)
    said = f"ended by its time limit, not at rest, at {outcome.time:.1f} s"
    assert said in " ".join(" ".join(lines[:2]).split())
    (row,) = (line for line in lines if "time to rest (s)" in line)
    assert row.split("│")[2].strip() == "-"
