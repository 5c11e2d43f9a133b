"""The collision law beside the tank car impact tests."""

import math

import pytest

from derail_ros.engine.laws.contact import GAP_LAWS
from derail_ros.vocabulary.params import ContactParams
from research.impact import impact, impacts, words


@pytest.mark.parametrize("law", GAP_LAWS)
def test_an_impact_without_speed_dependence_gives_its_energy_back(law):
    contact = ContactParams(c1=0.0, c2=0.0, half_distance=0.3, gap_law=law)
    found = impact(5.0, contact=contact)
    # the force begins at d_b with a jump, so a step's part of it is lost or won
    assert found.parting_speed_mps == pytest.approx(5.0 / 3.6, rel=1e-3)


def test_an_impact_that_the_force_never_stops_within_the_gap():
    # by energy: 2 F_max times the depth beyond contact takes what the gap has left
    contact = ContactParams(c1=0.0, c2=0.0)
    found = impact(25.0, contact=contact)
    assert found.peak_force_N == 2.0 * contact.force_max


def test_an_even_wall_lets_the_hardest_blow_through():
    # 2.57 MJ against 2 F_max d_c sqrt(pi / ln 2) of the whole bell, times a factor below 2.9
    soft, hard = (impact(v, contact=ContactParams(inside="even")) for v in (10.0, 25.0))
    assert math.isnan(hard.parting_speed_mps) and hard.depth_m >= 0.8
    assert soft == impact(10.0)
    assert 0.0 < impact(25.0).depth_m < 0.2


def test_slow_impacts_are_soft_and_no_speed_is_refused():
    assert impact(2.0).peak_force_N < impact(15.0).peak_force_N
    with pytest.raises(ValueError, match="speed_kmh"):
        impact(0.0)


def test_the_sentence_on_the_impacts_has_their_numbers():
    found = impacts()
    text = words(found)
    smallest, largest = found[0], found[-1]
    assert f"{smallest.peak_force_N / 1e6:.1f} to {largest.peak_force_N / 1e6:.1f} MN" in text
    assert f"{largest.peak_force_N / 4.5e6:.1f} times the largest" in text
