"""The centre line against Fresnel functions and its own definition."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from derail_ros.engine import Track
from derail_ros.vocabulary.params import TrackParams, TrackSegment
from tests.engine.reference import Line
from tests.engine.support import CURVE

COUNTED = settings(deadline=None, max_examples=200, derandomize=True)
LENGTH = sum(segment.length for segment in CURVE.segments)


def test_points_match_the_closed_form():
    track, line = Track(CURVE), Line(CURVE)
    for s in np.linspace(CURVE.start_coordinate, CURVE.start_coordinate + LENGTH, 401):
        assert track.point(float(s)) == pytest.approx(line.at(float(s)), rel=1e-12, abs=1e-10)


@pytest.mark.parametrize("turn", [0.5, 2.0, 6.0])
def test_long_spirals_stay_exact(turn):
    params = TrackParams(segments=(TrackSegment(400.0, 0.0, 2.0 * turn / 400.0),))
    track, line = Track(params), Line(params)
    for s in (130.0, 399.0, 400.0):
        assert track.point(s) == pytest.approx(line.at(s), rel=1e-11, abs=1e-9)


def test_a_full_circle_closes():
    radius = 250.0
    length = 2.0 * math.pi * radius
    track = Track(
        TrackParams(segments=(TrackSegment(length, 1 / radius, 1 / radius),), start_heading=0.7)
    )
    assert track.point(length)[:2] == pytest.approx((0.0, 0.0), abs=1e-9)
    # the centre lies a radius to the left
    x, y, _, kappa = track.point(length / 2.0)
    assert (x, y) == pytest.approx((-2 * radius * math.sin(0.7), 2 * radius * math.cos(0.7)))
    assert kappa == 1.0 / radius


@COUNTED
@given(st.floats(CURVE.start_coordinate + 1.0, CURVE.start_coordinate + LENGTH - 1.0),
       st.floats(-30.0, 30.0))  # fmt: skip
def test_locate_inverts_the_line(s, offset):
    track = Track(CURVE)
    x, y, heading, _ = track.point(s)
    x -= offset * math.sin(heading)
    y += offset * math.cos(heading)
    for hint in (None, s + 3.0, s - 3.0):
        found, d = track.locate(x, y, hint)
        assert found == pytest.approx(s, abs=1e-8)
        assert d == pytest.approx(offset, abs=1e-9)


def test_heading_and_curvature_have_no_jumps():
    track = Track(CURVE)
    s = CURVE.start_coordinate
    for segment in CURVE.segments[:-1]:
        s += segment.length
        before, after = track.point(s - 1e-9), track.point(s + 1e-9)
        assert before == pytest.approx(after, abs=1e-8)


def test_the_endless_straight():
    track = Track(TrackParams())
    assert track.point(-123.4) == (-123.4, 0.0, 0.0, 0.0)
    assert track.locate(7.0, -2.0) == (7.0, -2.0)
    assert track.end == math.inf
