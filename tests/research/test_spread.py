"""The page on the spread of outcomes and its histograms."""

from derail_ros.studies.spread import KEYS, spread
from research.spread import histograms, page
from tests.studies.made_up import runner
from tests.studies.test_spread import MISSISSAUGA, made_up_spread


def test_page():
    text = page([made_up_spread()])
    assert "(images/spread_mississauga.png)" in text
    assert "24 (at 8" in text
    assert "nan" not in text
    assert max(len(line) for line in text.splitlines() if not line.startswith("|")) < 110


def test_figure():
    figure = histograms(made_up_spread())
    assert len(figure.axes) == len(KEYS)
    bars = [sum(p.get_height() for p in axes.patches) for axes in figure.axes]
    assert bars == [18] * len(KEYS)
    notes = [t.get_text() for axes in figure.axes for t in axes.texts]
    assert {"published 24", "accident 24", "accident 132", "published 23.09"} <= set(notes)


def test_runs_that_all_failed_have_words_and_a_figure():
    s = spread(MISSISSAUGA, 3, run=runner(lambda run: RuntimeError("x")))
    assert "nan" not in page([s])
    histograms(s)
