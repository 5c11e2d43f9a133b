"""The bar estimates: closed solutions, an independent integration, the published statements."""

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

from derail_ros.baselines.bar import (
    GRAVITY,
    bar_case_1,
    bar_case_2,
    bar_case_3,
    brake_friction,
    limiting_speed,
    slide_distance,
)

V64 = 64.0 / 3.6
V105 = 105.0 / 3.6


# Case 1 ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("mu1", "mu2"), [(0.05, 0.5), (0.3, 0.3), (0.5, 0.4)])
def test_case_1_solves_its_energy_equation(mu1, mu2):
    length = 600.0
    x = float(slide_distance(V64, length, mu1, mu2))
    energy = GRAVITY / length * (2.0 * x * length * mu1 + x**2 * (mu2 - mu1))
    assert energy == pytest.approx(V64**2, rel=1e-12)


def test_case_1_equal_surfaces():
    assert float(slide_distance(V64, 600.0, 0.3, 0.3)) == pytest.approx(V64**2 / (0.6 * GRAVITY))


def test_case_1_takes_the_first_root_when_the_rails_are_rougher():
    length, mu1, mu2 = 100.0, 0.5, 0.4
    minus = length * mu1 - np.sqrt(length**2 * mu1**2 - (mu1 - mu2) * length * V64**2 / GRAVITY)
    assert float(slide_distance(V64, length, mu1, mu2)) == pytest.approx(minus / (mu1 - mu2))


def test_case_1_hand_worked():
    # 10 cars of 15 m at 64 km/h: h = v0^2/g = 32.217 m,
    # x = h / (0.05 + sqrt(0.0025 + 0.45 * 32.217 / 150)) = 88.29 m
    answer = bar_case_1(V64, 10)
    assert float(answer.distance) == pytest.approx(88.294, abs=0.002)
    assert float(answer.cars_derailed) == pytest.approx(5.8863, abs=0.0005)
    assert not answer.whole_train


def test_case_1_duration_is_that_of_the_oscillator():
    # xdd = -g mu1 - k x, k = g (mu2 - mu1) / l, from x = 0 at v0 until v = 0
    length, mu1, mu2 = 150.0, 0.05, 0.5
    omega = np.sqrt(GRAVITY * (mu2 - mu1) / length)
    x_rest = GRAVITY * mu1 / omega**2
    expected = np.arctan2(V64, x_rest * omega) / omega
    assert float(bar_case_1(V64, 10).duration) == pytest.approx(expected, rel=1e-6)


def test_case_1_short_fast_train_goes_over_whole():
    answer = bar_case_1(V105, [1, 2, 50])
    assert answer.whole_train.tolist() == [True, True, False]
    assert answer.cars_derailed[0] == 1.0
    assert answer.cars_derailed[1] == 2.0


def test_case_1_grows_more_and_more_slowly_with_the_train():
    count = bar_case_1(V64, np.arange(10, 101, 10)).cars_derailed
    first = np.diff(count)
    assert (first > 0).all()
    assert (np.diff(first) < 0).all()


# Case 2 ------------------------------------------------------------------------------------


def independent_case_2(v0, n, mu1, mu2, published, d=45.0, lc=15.0):
    length = n * lc

    def rhs(_, y):
        x, v = y
        s = max(length - x, 0.0) + min(x, d)
        push = v * v if (published and x > d) else 0.0
        return [v, (push - GRAVITY * (mu1 * max(length - x, 0.0) + mu2 * min(x, d))) / s]

    def stop(_, y):
        return y[1]

    def over(_, y):
        return y[0] - length

    stop.terminal = over.terminal = True
    sol = solve_ivp(rhs, (0, 500), [0.0, v0], events=(stop, over), rtol=1e-9, max_step=0.05)
    return sol.y[0, -1] / lc, sol.t[-1]


@pytest.mark.parametrize("form", ["published", "corrected"])
@pytest.mark.parametrize(("speed", "cars"), [(64, 10), (64, 60), (88, 100), (104, 60), (30, 2)])
def test_case_2_against_an_independent_integration(form, speed, cars):
    answer = bar_case_2(speed / 3.6, cars, form=form)
    count, time = independent_case_2(speed / 3.6, cars, 0.05, 1.0, form == "published")
    assert float(answer.cars_derailed) == pytest.approx(count, abs=5e-3)
    assert float(answer.duration) == pytest.approx(time, abs=0.02)


@pytest.mark.parametrize("form", ["published", "corrected"])
@pytest.mark.parametrize("cars", [10, 40, 100])
def test_above_a_limiting_speed_the_whole_train_derails(form, cars):
    limit = float(limiting_speed(cars, form=form))
    assert bool(bar_case_2(1.002 * limit, cars, form=form).whole_train)
    assert not bool(bar_case_2(0.998 * limit, cars, form=form).whole_train)


def test_the_limit_is_an_artefact_of_the_thrust():
    """Published: 88 to 112 km/h for 10 to 100 cars; without the thrust it is twice that."""
    cars = np.array([10, 100])
    published = limiting_speed(cars, form="published") * 3.6
    corrected = limiting_speed(cars, form="corrected") * 3.6
    np.testing.assert_allclose(published, [88.1, 111.9], atol=0.1)
    np.testing.assert_allclose(corrected, [128.9, 239.5], atol=0.1)


def test_the_published_form_gains_speed_and_the_corrected_never():
    v = 1.3 * float(limiting_speed(60))
    assert float(bar_case_2(v, 60, form="published").peak_speed) > v
    assert float(bar_case_2(v, 60, form="corrected").peak_speed) == v


def test_case_2_is_case_1_while_nothing_is_lost():
    slow = 20.0 / 3.6
    for form in ("published", "corrected"):
        two = bar_case_2(slow, [3, 40], mu2=0.5, form=form)
        one = bar_case_1(slow, [3, 40], mu2=0.5)
        np.testing.assert_allclose(two.distance, one.distance, rtol=1e-5)
        np.testing.assert_allclose(two.duration, one.duration, atol=0.01)


# Case 3 ------------------------------------------------------------------------------------


def test_brake_friction():
    assert float(brake_friction(0.0)) == pytest.approx(1.0)
    assert float(brake_friction(22.2)) == pytest.approx((41.423 / 31.588) * (9.388 / 19.223))
    assert float(brake_friction(40.0)) == float(brake_friction(22.2))


def test_published_statement_105_kmh_whole_trains():
    """At 105 km/h and mu2 = 1 trains of up to 100 cars derail whole.

    The [R] constants put the very last one at 105.5 km/h.
    """
    assert bar_case_3(V105, [10, 30, 50, 70, 90, 98]).whole_train.all()
    assert bool(bar_case_3(105.5 / 3.6, 100).whole_train)


def test_published_statement_fewer_than_40_of_100_need_mu2_above_2():
    count = bar_case_3(V105, 100, mu2=[1.5, 2.0, 2.1, 3.0]).cars_derailed
    assert count[1] > 40.0 > count[2]
    assert (np.diff(count) < 0).all()


def test_statements_of_case_3_need_the_signal_to_travel():
    together = bar_case_3(V105, 100, signal_speed=np.inf)
    assert not bool(together.whole_train)
    assert float(bar_case_3(V105, 100, mu2=2.0, signal_speed=np.inf).cars_derailed) < 40.0


def test_statements_of_case_3_belong_to_the_published_form():
    assert float(bar_case_3(V105, 100, form="corrected").cars_derailed) < 40.0


def test_case_3_brake_share_is_the_mean_over_the_train():
    from derail_ros.baselines.bar import applied_share

    t, x, length = 8.0, 200.0, 1500.0
    mean = quad(
        lambda p: min(max((t - p / 290.0) / 10.0, 0.0), 1.0), x, length, points=[580.0, 1200.0]
    )[0] / (length - x)
    value = applied_share(t, np.array([x]), np.array([length]), 10.0, 290.0)
    assert float(value[0]) == pytest.approx(mean, rel=1e-6)


def test_full_brakes_at_once_on_rails_only():
    # The bar never reaches the ground's d: mu2 = 0 leaves only the braked part, case 2 without
    # ground; compare energy: braked at constant 0.1 F(v).
    answer = bar_case_3(10.0, 100, mu2=0.0, rise_time=0.0, signal_speed=np.inf, form="corrected")
    sol = solve_ivp(
        lambda _, y: [
            y[1],
            -GRAVITY
            * 0.1
            * float(brake_friction(y[1]))
            * (1500 - y[0])
            / (1500 - y[0] + min(y[0], 45.0)),
        ],
        (0, 60),
        [0.0, 10.0],
        events=_stops,
        rtol=1e-9,
        max_step=0.05,
    )
    assert float(answer.distance) == pytest.approx(sol.y[0, -1], rel=1e-4)


def _stops(_, y):
    return y[1]


_stops.terminal = True


# All ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("case", [bar_case_1, bar_case_2, bar_case_3])
def test_counts_grow_with_speed_and_shapes_broadcast(case):
    speed = np.array([[20.0], [40.0], [60.0]]) / 3.6
    answer = case(speed, np.array([20, 50]))
    assert answer.cars_derailed.shape == (3, 2)
    assert (np.diff(answer.cars_derailed, axis=0) > 0).all()


@pytest.mark.parametrize("case", [bar_case_1, bar_case_2, bar_case_3])
def test_standing_train_derails_nothing(case):
    answer = case(0.0, 10)
    assert float(answer.cars_derailed) == 0.0
    assert float(answer.duration) == 0.0


@pytest.mark.parametrize("case", [bar_case_1, bar_case_2, bar_case_3])
@pytest.mark.parametrize(
    ("arguments", "field"),
    [
        ({"speed": -1.0, "cars": 10}, "speed"),
        ({"speed": float("nan"), "cars": 10}, "speed"),
        ({"speed": 10.0, "cars": 0}, "cars"),
        ({"speed": 10.0, "cars": 10, "mu2": -0.1}, "mu2"),
    ],
)
def test_bad_arguments_are_named(case, arguments, field):
    with pytest.raises(ValueError, match=f"^{field}: "):
        case(**arguments)


def test_unknown_form_is_refused():
    with pytest.raises(ValueError, match="form"):
        bar_case_2(10.0, 10, form="right")
