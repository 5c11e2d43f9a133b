"""Couplers on curves: the smallest radius of a pair, and trains that stay on tight curves."""

import math
from dataclasses import replace
from itertools import combinations_with_replacement, pairwise

import numpy as np
import pytest

from derail_ros.engine import PlanarSimulation
from derail_ros.engine.negotiability import free_swing, opening, smallest_radius, swing
from derail_ros.engine.track import Track
from derail_ros.scenario import loads_scenario
from derail_ros.scenario.rolling_stock import load_rolling_stock
from derail_ros.vocabulary.errors import ParameterError
from derail_ros.vocabulary.params import GRAVITY, TrackParams, TrackSegment

from .support import COUPLERS, make_car

AUTORACK = (
    "{name: autorack, count: 5, length_m: 27.5, truck_centres_m: 20.1, coupler: E69, "
    "mass_kg: 47000}"
)
EMPTY_BOX_CAR = "{car: box_car, count: 5, load: empty}"
EMPTY_TANK_CAR = "{car: tank_dot_105, count: 5, load: empty}"


def car(pivot, truck, coupler):
    return make_car(
        pivot_distance=pivot, truck_distance=truck, length=2.0 * pivot,
        front=COUPLERS[coupler], rear=COUPLERS[coupler],
    )  # fmt: skip


@pytest.mark.parametrize(
    ("first", "second", "radius"),
    [
        # (l + d_P - d_T) (d_P + d_T + l) / (2 l) over d_so / d_st, the larger of the two cars
        (("E69", 13.17, 10.05), ("E69", 13.17, 10.05), 26.578 / (0.390 / 1.220)),
        (("F79", 7.32, 6.205), ("F79", 7.32, 6.205), 11.866 / (0.170 / 0.788)),
        (("F79", 7.32, 6.205), ("E69", 13.17, 10.05), 28.326 / (0.390 / 1.220)),
    ],
)
def test_smallest_radius_by_hand(first, second, radius):
    pair = [car(d_p, d_t, coupler) for coupler, d_p, d_t in (first, second)]
    assert smallest_radius(*pair) == pytest.approx(radius, rel=0.01)
    assert smallest_radius(*pair[::-1]) == pytest.approx(smallest_radius(*pair), rel=1e-4)


def test_swing_on_a_circle():
    """Equal cars: the bar makes the same angle with both, half of that between the cars."""
    one = car(7.32, 6.205, "F79")
    r = math.sqrt(100.0**2 - 6.205**2)
    pivots = math.hypot(r, 7.32)
    half = math.atan(7.32 / r) + math.asin(1.092 / pivots)
    track = Track(TrackParams((TrackSegment(300.0, 0.01, 0.01),)))
    assert swing(track, one, one, np.array([150.0])) == pytest.approx(half, abs=2e-4)


def test_straight_track_leaves_the_strikers_as_they_are():
    cars = tuple(make_car(i) for i in range(3))
    assert not free_swing(cars, Track(TrackParams())).any()
    assert not free_swing(cars, Track(TrackParams((TrackSegment(900.0),)))).any()


def test_free_swing_lies_within_the_opening():
    cars = (car(7.32, 6.205, "F79"), car(13.17, 10.05, "E69"), car(13.17, 10.05, "E69"))
    segments = TrackSegment(99.0), TrackSegment(99.0, 0.011, 0.011)
    free = free_swing(cars, Track(TrackParams(segments)))
    assert free[0, 0] == free[2, 1] == 0.0
    assert 0.0 < free[0, 1] < opening(COUPLERS["F79"])
    assert np.all((free[1:, 0] > 0.0) & (free[1:, 0] <= opening(COUPLERS["E69"])))


def test_a_curve_that_is_too_tight_is_refused():
    cars = tuple(replace(car(7.32, 6.205, "F79"), name=name) for name in "abc")
    track = TrackParams((TrackSegment(99.0), TrackSegment(99.0, 0.02, 0.02)))
    with pytest.raises(ParameterError, match=r"1 \(a\) and 2 \(b\) .* curve of 50 m .* is 55 m"):
        free_swing(cars, Track(track))
    reverse = TrackParams((TrackSegment(99.0, 0.017, 0.017), TrackSegment(99.0, -0.017, -0.017)))
    with pytest.raises(ParameterError, match="is 55 m and the curve reverses here"):
        free_swing(cars, Track(reverse))


def scenario(consist, radius, position=300.0, speed=10.0, brakes="signal_source: none"):
    return f"""
version: 1
title: a train on a curve
train: {{speed_kmh: {speed}, consist: [{consist}]}}
track:
  start_coordinate_m: -600
  alignment:
    - tangent: {{length_m: 600}}
    - curve: {{length_m: {min(500.0, 4.0 * radius)}, radius_m: {radius}, turn: left}}
initiation: {{await_command: true, lateral_force_N: 0, position_m: {position}}}
brakes: {{{brakes}}}
integration: {{time_limit_s: 120}}
"""


def largest_lateral(text, until=20.0, brake=False):
    """Largest lateral force of a truck over its load, and cars derailed."""
    params = loads_scenario(text).to_params()
    run = PlanarSimulation(params)
    load = np.array([0.5 * GRAVITY * c.mass for c in params.cars])
    if brake:
        run.trigger_emergency_brake("conventional", "front")
    largest = 0.0
    while not run.ended and run.time < until:
        run.advance_to(run.time + 0.25)
        largest = max(largest, float(np.max(np.abs(run.sample().rail_force).T / load)))
    return largest, run.outcome().cars_derailed


@pytest.mark.parametrize("speed", [0.01, 10.0])
@pytest.mark.parametrize(
    ("consist", "radius"),
    [
        (AUTORACK, 150.0),
        (f"{EMPTY_BOX_CAR}, {AUTORACK}", 300.0),
        (f"{EMPTY_BOX_CAR}, {EMPTY_TANK_CAR}", 150.0),
    ],
)
def test_a_train_stays_on_a_tight_curve(consist, radius, speed):
    largest, derailed = largest_lateral(scenario(consist, radius, speed=speed))
    assert largest < 0.05
    assert derailed == 0


def test_autoracks_enter_a_yard_track():
    assert largest_lateral(scenario(AUTORACK, 116.0, position=-20.0), 60.0)[0] < 0.05


def test_gentle_brakes_on_a_tight_curve():
    text = scenario(f"{EMPTY_BOX_CAR}, {AUTORACK}", 150.0, brakes="force_scale: 0.2")
    largest, derailed = largest_lateral(text, 60.0, brake=True)
    assert largest < 0.5
    assert derailed == 0


_radii = {}


def smallest(pair):
    key = tuple((c.pivot_distance, c.truck_distance, c.front, c.rear) for c in pair)
    if key not in _radii:
        _radii[key] = smallest_radius(*pair)
    return _radii[key]


def library():
    """Cars of the library by their shape: entry of a consist, longest first."""
    entries = {}
    for name, kind in sorted(load_rolling_stock().cars.items()):
        entry = f"{{car: {name}" + (", load: empty}" if kind.empty_mass_kg else "}")
        cars = loads_scenario(scenario(entry, 2000.0)).to_params().cars
        shape = tuple((c.pivot_distance, c.truck_distance, c.front, c.rear) for c in cars)
        entries.setdefault(shape, (max(c.length for c in cars), entry))
    return [entry for _, entry in sorted(entries.values(), reverse=True)]


def check_pair(a, b):
    """At 1.1 times the smallest radius, standing and entering: a quarter of the limit at most."""
    wide = loads_scenario(scenario(f"{a}, {b}", 2000.0)).to_params()
    radius = 1.1 * max(smallest(pair) for pair in pairwise(wide.cars))
    for position, speed in ((80.0, 0.01), (-5.0, 10.0)):
        text = scenario(f"{a}, {b}", radius, position=position, speed=speed)
        largest, derailed = largest_lateral(text, 2.0 if speed < 1.0 else 30.0)
        assert largest < 0.5, (a, b, radius, position)
        assert derailed == 0


def test_every_car_of_the_library_behind_the_longest():
    cars = library()
    for car_ in cars:
        check_pair(cars[0], car_)


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_every_car_of_the_library_beside_every_other():
    for a, b in combinations_with_replacement(library(), 2):
        check_pair(a, b)
