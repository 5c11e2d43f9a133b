"""The tables of the investigated trains."""

import pytest

from research import trains
from research.pages import Options

PAGE = "# Trains\n\n<!-- results: trains -->\n\n<!-- end of results -->\n"


@pytest.fixture
def page(tmp_path):
    path = tmp_path / "accidents.md"
    path.write_text(PAGE, encoding="utf-8")
    return path


def test_a_sill_that_gives_parts_the_train_and_derails_nothing(page):
    trains.write(Options(page=page, names=("dugald_2009",), members=2))
    counts, ways = (line for line in page.read_text().splitlines() if "`dugald_2009`" in line)
    assert counts.split(" | ")[1:] == ["none", "0.0", "none", "0 |"]
    assert "| none (2) | coupler body broke (2) |" in ways


def test_rows_of_other_trains_stay_and_keep_their_order(page, monkeypatch):
    found = trains.Run((26, 27, 30), "lateral force, in draft", "knuckle broke", 2, "draft 1.0 MN")
    monkeypatch.setattr(trains, "_run", lambda params, factor: found)
    for name in ("macmillan_yard_2019", "dublin_2015"):
        trains.write(Options(page=page, names=(name,), members=3))
    rows = [line for line in page.read_text().splitlines() if line.startswith("| `")]
    assert [row.split("`")[1] for row in rows] == ["dublin_2015", "macmillan_yard_2019"] * 2
    assert "| 3.0 | 26, 27, 30 | 2 |" in rows[1]
    assert "| lateral force, in draft (3) | knuckle broke (3) | 2 of 3 | draft 1.0 MN |" in rows[3]
    trains.write(Options(page=page, names=("dublin_2015",), members=2))  # other runs
    assert "macmillan" not in page.read_text()
