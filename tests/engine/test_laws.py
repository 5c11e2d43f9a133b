"""Each force law alone: hand-worked numbers, published constants, corners, energies."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.optimize import brentq

from derail_ros.engine.laws.brake import (
    cast_iron_factor,
    composition_factor,
    rise,
    smooth_direction,
)
from derail_ros.engine.laws.contact import GAP_LAWS, gap_force, speed_factor
from derail_ros.engine.laws.ground import BODY_POINTS, drag, resistance
from derail_ros.engine.laws.knuckle import (
    POLYNOMIALS,
    knuckle_energy,
    knuckle_moment,
    pair_of_heads,
    polynomial_root,
)
from derail_ros.engine.laws.striker import spring_energy, spring_force
from derail_ros.vocabulary.params import ContactParams, DerailmentParams, GroundParams

settings.register_profile("laws", deadline=None, max_examples=200, derandomize=True)
COUNTED = settings.get_profile("laws")

# Striker ---------------------------------------------------------------------------------------

F73 = (0.0, 0.300, 4.88e6, 50e6)  # opening, k1, k2
F70 = (0.0, 0.080, 1.75e6, 50e6)


@pytest.mark.parametrize(
    ("law", "x", "force"),
    [
        (F73, 0.0, 0.0),
        (F73, 0.1, 0.488e6),
        (F73, 0.3, 1.464e6),  # at the opening, from below
        (F73, 0.3 + 1e-12, 1.464e6),  # and from above
        (F73, 0.4, 1.464e6 + 5.0e6),
        (F73, -0.4, -6.464e6),
        (F70, 0.08, 0.14e6),
        (F70, 0.10, 0.14e6 + 1.0e6),
        (F70, -0.05, -87.5e3),
        ((0.02, *F70[1:]), -0.02, 0.0),  # free swing
        ((0.02, *F70[1:]), -0.05, -52.5e3),
        ((0.02, *F70[1:]), 0.10, 105e3 + 1.0e6),
    ],
)
def test_striker_force_by_hand(law, x, force):
    assert spring_force(x, *law) == pytest.approx(force, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize(
    ("law", "x", "energy"),
    [
        (F73, 0.3, 0.5 * 4.88e6 * 0.09),  # 219.6 kJ
        (F73, 0.4, 219.6e3 + 146.4e3 + 250e3),  # triangle, rectangle, triangle
        (F73, -0.4, 616.0e3),
        (F70, 0.1, 5.6e3 + 2.8e3 + 10e3),
        ((0.02, *F70[1:]), 0.1, 3.15e3 + 2.1e3 + 10e3),
    ],
)
def test_striker_energy_by_hand(law, x, energy):
    assert spring_energy(x, *law) == pytest.approx(energy, rel=1e-12)


@COUNTED
@given(
    st.floats(-0.8, 0.8), st.floats(0.0, 1.0), st.floats(0.0, 0.4), st.floats(1e5, 1e7),
    st.floats(1e5, 1e8),
)  # fmt: skip
def test_striker_energy_is_the_integral_of_its_force(x, share, opening, k1, k2):
    law = (share * opening, opening, k1, k2)
    kinks = [s * k for s in (-1, 1) for k in law[:2] if min(0.0, x) < s * k < max(0.0, x)]
    work, error = quad(spring_force, 0.0, x, args=law, points=sorted(set(kinks)) or None)
    assert spring_energy(x, *law) == pytest.approx(work, rel=1e-9, abs=1e-6 + error)
    assert spring_force(-x, *law) == -spring_force(x, *law)


# Knuckle ---------------------------------------------------------------------------------------

ROOTS = {"EE": 0.210, "FF": 0.275}
PUBLISHED_RANGE = {"EE": (0.22, 0.90), "FF": (0.28, 0.71)}


@pytest.mark.parametrize("pair", ["EE", "FF"])
def test_knuckle_root(pair):
    root = polynomial_root(pair)
    assert root == pytest.approx(ROOTS[pair], abs=6e-4)
    # the moment starts there continuously, below the published range
    assert knuckle_moment(root, *POLYNOMIALS[pair], root) == 0.0
    assert abs(knuckle_moment(root + 1e-9, *POLYNOMIALS[pair], root)) < 1e-2
    assert root < PUBLISHED_RANGE[pair][0]
    assert knuckle_moment(0.999 * root, *POLYNOMIALS[pair], root) == 0.0


@pytest.mark.parametrize(
    ("pair", "n", "moment"),
    [
        # by hand from the published polynomials, kN m
        ("EE", 0.22, -203.08 + 1061.7 * 0.22 - 455.87 * 0.0484),  # 8.43
        ("EE", 0.90, -203.08 + 955.53 - 369.2547),  # 383.20 at the limit
        ("FF", 0.28, -762.77 + 990.136 - 217.72464),  # 9.64
        ("FF", 0.71, -762.77 + 2510.702 - 1399.93611),  # 348.00 at the limit
        ("EF", 0.50, -482.925 + 0.5 * 2298.95 - 0.25 * 1616.485),  # 262.43
    ],
)
def test_knuckle_moment_by_hand(pair, n, moment):
    law = (*POLYNOMIALS[pair], polynomial_root(pair))
    # against the angle, on the coupler of the car in front
    assert knuckle_moment(n, *law) == pytest.approx(-1e3 * moment, rel=1e-12)
    assert knuckle_moment(-n, *law) == pytest.approx(1e3 * moment, rel=1e-12)


def test_knuckle_mean_of_both_pairs():
    for a, b, c in zip(POLYNOMIALS["EE"], POLYNOMIALS["FF"], POLYNOMIALS["EF"]):
        assert c == pytest.approx(0.5 * (a + b), rel=1e-15)
    assert pair_of_heads("F", "E") == pair_of_heads("E", "F") == "EF"


def test_knuckle_limits_are_the_published_ones():
    limits = DerailmentParams()
    assert limits.knuckle_limit_ee == 0.90
    assert limits.knuckle_limit_ff == 0.71
    assert limits.knuckle_limit_ef == 0.80


@COUNTED
@given(st.sampled_from(["EE", "FF", "EF"]), st.floats(-1.0, 1.0))
def test_knuckle_energy_is_the_integral_of_its_moment(pair, n):
    law = (*POLYNOMIALS[pair], polynomial_root(pair))
    sign = math.copysign(1.0, n)
    start = sign * min(law[3], abs(n))
    work, error = quad(lambda x: -knuckle_moment(x, *law), start, n)
    assert knuckle_energy(n, *law) == pytest.approx(work, rel=1e-9, abs=1e-6 + error)


# Ground ----------------------------------------------------------------------------------------

GROUND = (0.8, 0.7, 0.01, 0.03)


def test_ground_defaults():
    g = GroundParams()
    assert (g.c_s, g.c_d, g.eps, g.c_v, g.scale) == (*GROUND, 1.0)
    assert BODY_POINTS == 10


@pytest.mark.parametrize(
    ("v", "k"),
    [
        (0.0, 0.8),
        (0.01, 0.7 + 0.1 * math.exp(-1.0) + 0.0003),
        (1.0, 0.73),
        (60.0 / 3.6, 1.2),
        (90.0 / 3.6, 1.45),
    ],
)
def test_ground_resistance_by_hand(v, k):
    assert resistance(v, *GROUND) == pytest.approx(k, rel=1e-14)


def test_ground_drag_at_rest_and_moving():
    # times the velocity: nothing at rest, K at speed, K / sqrt(2) at v = eps
    assert drag(0.0, *GROUND) * 0.0 == 0.0
    assert drag(0.0, *GROUND) == pytest.approx(0.8 / 0.01)
    assert 20.0 * drag(20.0, *GROUND) == pytest.approx(0.7 + 0.6, rel=1e-6)
    expected = resistance(0.01, *GROUND) / math.sqrt(2.0)
    assert 0.01 * drag(0.01, *GROUND) == pytest.approx(expected, rel=1e-14)


def test_ground_resistance_has_no_jump_where_the_exponential_is_dropped():
    v = 40.0 * 0.01
    below, above = resistance(np.nextafter(v, 0.0), *GROUND), resistance(v, *GROUND)
    assert below == pytest.approx(above, rel=3e-16)


@COUNTED
@given(st.floats(0.0, 60.0))
def test_ground_resistance_form(v):
    c_s, c_d, eps, c_v = GROUND
    expected = c_d + (c_s - c_d) * math.exp(-v / eps) + c_v * v
    assert resistance(v, *GROUND) == pytest.approx(expected, rel=1e-15)


# Contact ---------------------------------------------------------------------------------------

GAP = (3.0e6, 0.08, 0.8)
FACTOR = (0.025, 0.1, 1.0)


def test_contact_defaults():
    c = ContactParams()
    assert (c.force_max, c.half_distance, c.buffer) == GAP
    assert (c.c1, c.c2, c.c3) == FACTOR
    assert (c.begin_force, c.end_force, c.end_hold) == (10e3, 5e3, 0.020)


@pytest.mark.parametrize(
    ("x", "force"),
    [
        (0.0, 3.0e6),
        (0.04, 3.0e6 * 2.0**-0.25),
        (0.08, 1.5e6),
        (0.16, 3.0e6 / 16.0),
        (0.8 - 1e-12, 3.0e6 * 2.0**-100),
        (0.8, 0.0),
        (5.0, 0.0),
        (-1e-9, 3.0e6),
        (-1.3, 3.0e6),
    ],
)
def test_gap_force_by_hand(x, force):
    # the last bits of 2^-100 are those of the gap
    assert gap_force(x, *GAP, 0, 0) == pytest.approx(force, rel=1e-9, abs=0.0)


SHAPES = {
    "gaussian": lambda r: 2.0 ** -(r * r),
    "lorentzian": lambda r: 1.0 / (1.0 + r * r),
    "sech2": lambda r: 1.0 - math.tanh(math.acosh(math.sqrt(2.0)) * r) ** 2,
    "quartic": lambda r: 1.0 / (1.0 + r**4),
}


@pytest.mark.parametrize("shape", SHAPES)
def test_shapes_of_the_gap_law(shape):
    law = GAP_LAWS[shape]
    for even in (0, 1):
        assert gap_force(0.0, *GAP, law, even) == 3.0e6
        assert gap_force(0.08, *GAP, law, even) == pytest.approx(1.5e6, rel=1e-12)
        assert gap_force(0.8, *GAP, law, even) == 0.0
        for x in (0.02, 0.12, 0.24):
            expected = 3.0e6 * SHAPES[shape](x / 0.08)
            assert gap_force(x, *GAP, law, even) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("shape", SHAPES)
def test_inside_a_body_the_bell_is_even_or_held(shape):
    law = GAP_LAWS[shape]
    for x in (1e-9, 0.05, 0.3, 0.8, 1.3):
        assert gap_force(-x, *GAP, law, 1) == gap_force(x, *GAP, law, 1)
        assert gap_force(-x, *GAP, law, 0) == 3.0e6


@pytest.mark.parametrize(
    ("v", "factor"),
    [
        (0.0, 1.0),
        (10.0, 2.5 + 1.0 + 1.0),
        (-2.0, -0.1 - 0.2 + 1.0),
        (5.0, 0.625 + 0.5 + 1.0),
        (-4.7, 0.0),
        (-30.0, 0.0),
    ],
)
def test_speed_factor_by_hand(v, factor):
    assert speed_factor(v, *FACTOR) == pytest.approx(factor, rel=1e-14)


def test_speed_factor_clamps_at_the_published_separation():
    zero = brentq(lambda v: 1.0 + 0.1 * v + 0.025 * v * abs(v), -6.0, -3.0)
    assert zero == pytest.approx(-4.63, abs=0.01)
    assert speed_factor(zero + 1e-9, *FACTOR) > 0.0
    assert speed_factor(zero - 1e-9, *FACTOR) == 0.0


@COUNTED
@given(st.floats(0.0, 20.0))
def test_contact_takes_energy_out_at_every_speed(v):
    # pushing in at v and back out at v
    assert speed_factor(v, *FACTOR) >= speed_factor(-v, *FACTOR) >= 0.0


# Brakes ----------------------------------------------------------------------------------------

V80 = 80.0 / 3.6


@pytest.mark.parametrize(
    ("kmh", "mu"),
    [
        (0.0, 0.21 * 19.223 / 9.388),  # 0.430
        (30.0, 0.21 * (30 / 3.6 + 19.223) / (30 / 3.6 + 9.388)),
        (80.0, 0.21 * (V80 + 19.223) / (V80 + 9.388)),
        (120.0, 0.21 * (V80 + 19.223) / (V80 + 9.388)),  # constant above 80 km/h
    ],
)
def test_composition_shoe_by_hand(kmh, mu):
    mu0 = 0.21 * 19.223 / 9.388
    assert composition_factor(kmh / 3.6) == pytest.approx(mu / mu0, rel=1e-14)


def test_cast_iron_form():
    for v in (0.0, 5.0, 15.0, 40.0):
        kmh = 3.6 * v
        form = (kmh + 100.0) / (kmh + 20.0)
        expected = cast_iron_factor(0.0) / 5.0 * form
        assert cast_iron_factor(v) == pytest.approx(expected, rel=1e-14)


def test_cast_iron_stops_from_80_kmh_like_composition():
    stop = SimpleNamespace()
    for name, law in (("iron", cast_iron_factor), ("composition", composition_factor)):
        distance, _ = quad(lambda v, law=law: v / law(v), 0.0, V80, epsabs=0, epsrel=1e-12)
        setattr(stop, name, distance)
    assert stop.iron == pytest.approx(stop.composition, rel=1e-10)
    # and it is not the same law: weaker fast, stronger slow
    assert cast_iron_factor(V80) < composition_factor(V80)
    assert cast_iron_factor(0.0) > composition_factor(0.0)


@pytest.mark.parametrize(
    ("t", "share"),
    [(0.0, 0.0), (3.0, 0.0), (3.0 + 1e-9, 1e-10), (5.5, 0.25), (13.0, 1.0), (99.0, 1.0)],
)
def test_rise(t, share):
    assert rise(t, 3.0, 10.0) == pytest.approx(share, rel=1e-6)


def test_rise_of_a_signal_that_never_comes():
    assert rise(1e9, math.inf, 10.0) == 0.0


def test_smooth_direction():
    assert 3.0 * smooth_direction(3.0, 0.01) == pytest.approx(1.0, rel=1e-5)
    assert 0.01 * smooth_direction(0.01, 0.01) == pytest.approx(1.0 / math.sqrt(2.0))
    assert 0.0 * smooth_direction(0.0, 0.01) == 0.0
