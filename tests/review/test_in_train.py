"""The figure of the forces in the train."""

import numpy as np
import pytest

from derail_ros.review.figures import in_train_forces
from derail_ros.vocabulary.ledger import available, residual, shares, stopped_by
from derail_ros.vocabulary.outcome import Outcome, Parted


def outcome(**fields):
    from dataclasses import replace

    return replace(Outcome.nothing(np.zeros((5, 6)), "at rest", 9.0), **fields)


COUPLINGS = {
    "max_draft_N": np.array([1e5, 4e5, 0.0, 2e5]),
    "max_draft_time_s": np.array([1.0, 2.5, np.nan, 3.0]),
    "max_buff_N": np.array([0.0, 1e5, 1.5e6, 2e5]),
    "max_buff_time_s": np.array([np.nan, 2.0, 4.5, 1.0]),
}


def test_bars_are_the_largest_forces_and_crosses_the_parted_couplings():
    found = outcome(couplings=COUPLINGS, parted=(Parted(3, 5.0, "angle"),))
    figure = in_train_forces(found, "A train")
    (axes,) = figure.axes
    heights = [bar.get_height() for bar in axes.patches]
    assert heights == pytest.approx([0.1, 0.4, 0.0, 0.2, 0.0, -0.1, -1.5, -0.2])
    crosses = [line for line in axes.lines if line.get_marker() == "x"]
    assert [list(line.get_xdata()) for line in crosses] == [[3]]
    texts = " ".join(text.get_text() for text in figure.texts)
    assert "buff 1.50 MN in coupling 3 at 4.5 s" in texts
    assert "draft 0.40 MN in coupling 2 at 2.5 s" in texts


def test_forces_beyond_what_couplers_bear_are_marked():
    def marks(factor):
        told = {k: v * factor if k.endswith("_N") else v for k, v in COUPLINGS.items()}
        (axes,) = in_train_forces(outcome(couplings=told), "A train").figure.axes
        return [text.get_text().split("\n")[0] for text in axes.texts]

    assert marks(1.0) == []
    assert marks(4.0) == ["4.45 MN"]
    assert marks(10.0) == ["2.89 MN", "4.45 MN"]


def test_what_was_gained_on_the_way_counts_as_energy_to_lose():
    ledger = {"initial": 1e6, "kinetic": 0.0, "potential": -5e5, "traction": 5e5, "brakes": 1.5e6,
              "resistance": 5e5}  # fmt: skip
    assert residual(ledger) == 0.0
    assert available(ledger) == 2e6
    assert [(e.key, share) for e, _, share in shares(ledger)][:2] == [
        ("brakes", 0.75),
        ("resistance", 0.25),
    ]
    assert stopped_by(ledger).startswith(
        "Of the 2.00 MJ at the start, from locomotives and from the grade, these took: the brakes"
    )


def test_shares_of_a_record_are_those_of_the_text():
    from derail_ros.vocabulary.measures import MEASURES

    ledger = {"initial": 1e6, "potential": -1e6, "brakes": 1.5e6, "collisions": 5e5}
    found = outcome(energy=ledger)
    assert MEASURES["share_brakes"].value(found) == 0.75
    assert {e.key: s for e, _, s in shares(ledger)}["brakes"] == 0.75
