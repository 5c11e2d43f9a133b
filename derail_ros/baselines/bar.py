r"""Quick estimates: a train as a uniform bar that slides from the rails onto the ground.

Three cases of E. E. Toma, *A Computer Model of a Derailment*, PhD thesis, Queen's University,
1998 ("the thesis"). A bar of length ``l = n l_car`` (m) runs at ``v0`` (m/s) along surface 1 (the
rails, friction ``mu1``) and over a point ``x = 0`` onto surface 2 (the ground, friction ``mu2``).
``x`` is the distance its front has gone beyond that point; the number of cars derailed is
``x_s / l_car`` at the place ``x_s`` where it stops, at most ``n``. The mass of the train cancels.

All functions take scalars or arrays that broadcast together and answer with arrays:

- ``speed`` : v0, m/s; ``cars`` : number of cars n; ``car_length`` : m
- ``mu1``, ``mu2`` : friction of the rails and of the ground
- ``ground_length`` : d, m; ``form`` : "published" or "corrected"

Published and corrected forms
-----------------------------
Case 2 loses the part of the bar further than ``d`` beyond the point. The thesis writes the
momentum of what is left as if the lost part carried none away: ``d(m v)/dt = -F`` with
``m = rho (l - x + d)`` and ``dm/dt = -rho v`` gives

    a = (v^2 - g (mu1 (l - x) + mu2 d)) / (l - x + d)              (published)

But the part is left behind at the train's own speed, so that it takes its momentum with it and
pushes nothing: the same without ``v^2`` (corrected). The published form accelerates the train
as soon as ``v^2 > g (mu1 (l - x) + mu2 d)``, and since the right side falls while ``v`` rises,
it never stops: above a limiting speed the whole train derails.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from derail_ros.vocabulary.params import GRAVITY

F64 = NDArray[np.float64]
Form = Literal["published", "corrected"]

FORMS: tuple[Form, ...] = ("published", "corrected")

CAR_LENGTH = 15.0
"""Length of a car in the published figures, m."""

GROUND_LENGTH = 45.0
"""Length ``d`` of the bar that still rubs on the ground: three cars, m."""

BRAKED_MU = 0.1
"""Effective friction of a fully braked train at rest in case 3."""

BRAKE_RISE = 10.0
"""Rise of the brake force in case 3, s."""

BRAKE_SIGNAL_SPEED = 290.0
"""Speed of the emergency signal along the train in case 3, m/s."""

BRAKE_CONSTANT_SPEED = 22.2
"""Speed above which the brake's friction does not change any more (80 km/h), m/s."""


@dataclass(frozen=True)
class Estimate:
    """Answer of a model with one coordinate, in the broadcast shape of the arguments."""

    distance: F64  # of the train's front beyond the point where it stops or has gone over whole, m
    cars_derailed: F64  # not rounded
    whole_train: NDArray[np.bool_]  # all of it went over before it could stop
    duration: F64  # until it stops or has gone over whole, s
    peak_speed: F64  # above v0 where a form gains energy, m/s


def brake_friction(speed: ArrayLike) -> F64:
    r"""Speed factor of a composition shoe, ``F(v) = mu(v) / mu(0)`` (thesis, brake law).

    ``mu(v) = 0.21 (v + 19.223) / (v + 9.388)``, v in m/s, constant above 22.2 m/s.
    """
    v = np.minimum(np.abs(np.asarray(speed, dtype=float)), BRAKE_CONSTANT_SPEED)
    return (v + 19.223) / (v + 9.388) * (9.388 / 19.223)


POSITIVE = ("cars", "car_length", "ground_length", "mass")
"""Arguments that must be above zero; the others may be zero."""


def arrays(**arguments: ArrayLike) -> list[F64]:
    """Checked arguments, broadcast to one shape, as copies."""
    for name, value in arguments.items():
        array = np.asarray(value, dtype=float)
        positive = name in POSITIVE
        bad = ~np.isfinite(array) | ((array <= 0.0) if positive else (array < 0.0))
        if np.any(bad):
            rule = "positive" if positive else "zero or positive"
            raise ValueError(f"{name}: must be {rule} and finite, got {array[bad].flat[0]:g}")
    return [np.array(a, dtype=float) for a in np.broadcast_arrays(*arguments.values())]


def check_brakes(rise_time: float, signal_speed: float) -> None:
    """Refuse times and speeds that no brake has."""
    if not np.isfinite(rise_time) or rise_time < 0.0:
        raise ValueError(f"rise_time: must be zero or positive and finite, got {rise_time:g}")
    if not signal_speed > 0.0:
        raise ValueError(f"signal_speed: must be positive, got {signal_speed:g}")


def slide_distance(speed: ArrayLike, length: ArrayLike, mu1: ArrayLike, mu2: ArrayLike) -> F64:
    r"""Stopping distance of case 1 while part of the bar is still on surface 1, m.

    From ``v0^2 = (g / l) (2 x l mu1 + x^2 (mu2 - mu1))``. Its roots are
    ``x = (-l mu1 +/- sqrt(l^2 mu1^2 + (mu2 - mu1) l v0^2 / g)) / (mu2 - mu1)``; the one that is
    reached first (the thesis: the minus sign when ``mu1 > mu2`` and the denominator is written
    ``mu1 - mu2``), and ``v0^2 / (2 mu g)`` for equal surfaces, are all of

        x = (v0^2 / g) / (mu1 + sqrt(mu1^2 + (mu2 - mu1) v0^2 / (g l)))

    ``inf`` where it does not stop (a bar too fast on a ground smoother than the rails).
    """
    v, length, mu1, mu2 = (np.asarray(a, dtype=float) for a in (speed, length, mu1, mu2))
    h = v * v / GRAVITY
    inside = mu1 * mu1 + (mu2 - mu1) * h / length
    with np.errstate(divide="ignore", invalid="ignore"):
        x = h / (mu1 + np.sqrt(np.maximum(inside, 0.0)))
    x = np.where(h == 0.0, 0.0, x)
    return np.where(inside < 0.0, np.inf, x)


def _slide_time(u0: F64, x: F64, length: F64, mu1: F64, mu2: F64) -> F64:
    r"""Time of case 1 from ``x = 0`` to ``x``, s.

    ``xdd = -g mu1 - k x`` with ``k = g (mu2 - mu1) / l`` is an oscillator (k > 0), a uniform
    deceleration (k = 0) or an unstable one (k < 0). ``t = int dx / v`` is taken by Gauss-Legendre
    quadrature in ``s``, ``x = x_e (1 - (1 - s)^2)``, which takes the square root out of v at a
    stop.
    """
    nodes, weights = np.polynomial.legendre.leggauss(40)
    s = 0.5 * (nodes + 1.0)
    shape = np.shape(u0)
    xs = np.reshape(x, (*shape, 1)) * (1.0 - (1.0 - s) ** 2)
    dx = np.reshape(x, (*shape, 1)) * 2.0 * (1.0 - s) * 0.5 * weights
    lengths, m1, m2 = (np.reshape(a, (*shape, 1)) for a in (length, mu1, mu2))
    u = np.reshape(u0, (*shape, 1)) - GRAVITY * (2.0 * xs * m1 + xs**2 * (m2 - m1) / lengths)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.sum(np.where(dx > 0.0, dx / np.sqrt(np.maximum(u, 0.0)), 0.0), axis=-1)
    return np.asarray(t)


def bar_case_1(
    speed: ArrayLike,
    cars: ArrayLike,
    *,
    mu1: ArrayLike = 0.05,
    mu2: ArrayLike = 0.5,
    car_length: ArrayLike = CAR_LENGTH,
) -> Estimate:
    r"""Case 1: the whole bar keeps sliding (published figure: mu2 = 0.5, 64 km/h).

    ``v0^2 = (g/l) (2 x l mu1 + x^2 (mu2 - mu1))``, see :func:`slide_distance`. The count is cut
    off at the length of the train, which the equation does not contain.
    """
    v, n, lc, m1, m2 = arrays(speed=speed, cars=cars, car_length=car_length, mu1=mu1, mu2=mu2)
    length = n * lc
    x = slide_distance(v, length, m1, m2)
    whole = x >= length
    x = np.minimum(x, length)
    return Estimate(x, x / lc, whole, _slide_time(v * v, x, length, m1, m2), v.copy())


def limiting_speed(
    cars: ArrayLike,
    *,
    mu1: ArrayLike = 0.05,
    mu2: ArrayLike = 1.0,
    car_length: ArrayLike = CAR_LENGTH,
    ground_length: ArrayLike = GROUND_LENGTH,
    form: Form = "published",
) -> F64:
    r"""Speed above which the whole train of case 2 derails, m/s.

    With ``s = l - x + d`` what is left of the bar, ``u = v^2`` and ``u_d`` at ``x = d``:

    - published: ``d(s^2 u)/ds = 2 g (mu1 s^2 + (mu2 - mu1) d s)``, so that the bar is still
      moving when its end comes over (s = d) if
      ``l^2 u_d > 2 g (mu1 (l^3 - d^3) / 3 + (mu2 - mu1) d (l^2 - d^2) / 2)``;
    - corrected: ``du/ds = 2 g (mu1 + (mu2 - mu1) d / s)``, so that it is if
      ``u_d > 2 g (mu1 (l - d) + (mu2 - mu1) d ln(l / d))``.

    The published one stays within ``g d (mu2 - mu1)`` of ``2 g mu1 l / 3`` however long the train;
    the corrected one grows with ``2 g mu1 l`` and the logarithm of the length.
    """
    n, lc, m1, m2, d = arrays(
        cars=cars, car_length=car_length, mu1=mu1, mu2=mu2, ground_length=ground_length
    )
    length = n * lc
    d = np.minimum(d, length)
    if _form(form) == "published":
        lost = (
            2.0
            / length**2
            * (m1 * (length**3 - d**3) / 3.0 + (m2 - m1) * d * (length**2 - d**2) / 2.0)
        )
    else:
        lost = 2.0 * (m1 * (length - d) + (m2 - m1) * d * np.log(length / d))
    first = 2.0 * d * m1 + d**2 * (m2 - m1) / length
    return np.sqrt(GRAVITY * (first + lost))


def _form(form: str) -> Form:
    if form not in FORMS:
        raise ValueError(f"form: must be one of {', '.join(FORMS)}, got {form!r}")
    return form  # type: ignore[return-value]


def bar_case_2(
    speed: ArrayLike,
    cars: ArrayLike,
    *,
    mu1: ArrayLike = 0.05,
    mu2: ArrayLike = 1.0,
    car_length: ArrayLike = CAR_LENGTH,
    ground_length: ArrayLike = GROUND_LENGTH,
    form: Form = "published",
) -> Estimate:
    r"""Case 2: what has gone further than ``d`` is lost (published figure: mu2 = 1, 64 km/h).

    As case 1 until ``x = d``, then ``a = ([v^2] - g (mu1 (l - x) + mu2 d)) / (l - x + d)``, the
    ``v^2`` in the published form only (see the head of this file).
    """
    return _integrate(speed, cars, mu1, mu2, car_length, ground_length, form)


def bar_case_3(
    speed: ArrayLike,
    cars: ArrayLike,
    *,
    mu2: ArrayLike = 1.0,
    mu1: ArrayLike = BRAKED_MU,
    car_length: ArrayLike = CAR_LENGTH,
    ground_length: ArrayLike = GROUND_LENGTH,
    rise_time: float = BRAKE_RISE,
    signal_speed: float = BRAKE_SIGNAL_SPEED,
    form: Form = "published",
) -> Estimate:
    r"""Case 3: case 2 with brakes, ``mu1(t, v) = K_t(t) mu1 F(v) / F(0)`` [R].

    ``F(v)/F(0)`` is :func:`brake_friction`; ``mu1`` (0.1) is the effective friction of the braked
    train at low speed. ``K_t`` rises linearly from 0 to 1 in ``rise_time`` (10 s) after the
    emergency signal, which leaves the front at t = 0 (the main model's brake law, delay 0), has
    reached the place in the train; for the bar it is the mean over the part on the rails,

        K_t = 1/(l - x) int_x^l min(1, max(0, (t - p/c)/t_r)) dp

    The thesis states for its form that at 105 km/h on mu2 = 1 trains of up to 100 cars derail
    whole and that fewer than 40 of 100 need mu2 > 2. With the signal's travel this comes out: up
    to 98 cars at 105 km/h (100 at 105.5 km/h), and 40 of 100 at mu2 = 2.06. With all brakes at
    once (``signal_speed=inf``) it does not (64 of 100; mu2 = 1.76), nor in the corrected form
    (38 of 100 at mu2 = 1). ``rise_time`` is t_r (s), ``signal_speed`` c (m/s; inf: all brakes at
    once), ``mu1`` the effective friction of the fully braked train at rest.
    """
    check_brakes(rise_time, signal_speed)
    brakes = (float(rise_time), float(signal_speed))
    return _integrate(speed, cars, mu1, mu2, car_length, ground_length, form, brakes=brakes)


def _ramp_integral(z: F64, rise: float) -> F64:
    """Integral of ``min(1, max(0, z / rise))`` from 0 to z, s."""
    z = np.maximum(z, 0.0)
    if rise == 0.0:
        return z
    return np.where(z < rise, z * z / (2.0 * rise), z - 0.5 * rise)


def applied_share(t: float, x: F64, length: F64, rise: float, signal: float) -> F64:
    """Share of the brake force applied, the mean over the part of the bar on the rails."""
    if np.isinf(signal):
        return np.full_like(x, min(t / rise, 1.0) if rise > 0.0 else 1.0)
    # Over a part shorter than a centimetre the mean is the value at the end.
    x = np.minimum(x, length - 0.01)
    gain = _ramp_integral(t - x / signal, rise) - _ramp_integral(t - length / signal, rise)
    return gain * signal / (length - x)


def slopes(
    acceleration: Callable[..., F64],
    t: float,
    h: float,
    x: F64,
    v: F64,
    i: NDArray[np.intp],
    least: float = -np.inf,
) -> tuple[F64, F64]:
    """Mean velocity and acceleration of a step of the classical Runge-Kutta method.

    ``acceleration(t, x, v, i)`` is that of the trains ``i``; its velocities are at least
    ``least``.
    """
    a1 = acceleration(t, x, v, i)
    v2 = np.maximum(v + 0.5 * h * a1, least)
    a2 = acceleration(t + 0.5 * h, x + 0.5 * h * v, v2, i)
    v3 = np.maximum(v + 0.5 * h * a2, least)
    a3 = acceleration(t + 0.5 * h, x + 0.5 * h * v2, v3, i)
    v4 = np.maximum(v + h * a3, least)
    a4 = acceleration(t + h, x + h * v3, v4, i)
    return (v + 2.0 * v2 + 2.0 * v3 + v4) / 6.0, (a1 + 2.0 * a2 + 2.0 * a3 + a4) / 6.0


def _integrate(
    speed: ArrayLike,
    cars: ArrayLike,
    mu1: ArrayLike,
    mu2: ArrayLike,
    car_length: ArrayLike,
    ground_length: ArrayLike,
    form: str,
    *,
    brakes: tuple[float, float] | None = None,
    step: float = 0.01,
    time_limit: float = 3600.0,
) -> Estimate:
    """Cases 2 and 3 in time: classical Runge-Kutta on all trains at once.

    The last step of each train is shortened to the moment when it stops or has gone over whole,
    found on the quadratic through the step's ends.
    """
    thrust = 1.0 if _form(form) == "published" else 0.0
    given = arrays(
        speed=speed, cars=cars, car_length=car_length, mu1=mu1, mu2=mu2,
        ground_length=ground_length,
    )  # fmt: skip
    shape = given[0].shape
    v, n, lc, m1, m2, ground = (a.ravel() for a in given)
    length = n * lc

    def acceleration(t: float, x: F64, v: F64, i: NDArray[np.intp]) -> F64:
        on_rails = np.maximum(length[i] - x, 0.0)
        k = m1[i]
        if brakes is not None:
            k = k * applied_share(t, x, length[i], *brakes) * brake_friction(v)
        lost = x > ground[i]
        on_ground = np.minimum(x, ground[i])
        friction = GRAVITY * (k * on_rails + m2[i] * on_ground)
        push = np.where(lost, thrust * v * v, 0.0)
        return (push - friction) / (on_rails + on_ground)

    x = np.zeros_like(v)
    peak = v.copy()
    duration = np.zeros_like(v)
    whole = np.zeros(v.shape, dtype=bool)
    live = np.flatnonzero(v > 0.0)
    t = 0.0
    while live.size and t < time_limit:
        i, h = live, step
        x0, v0 = x[i], v[i]
        speed_mean, mean = slopes(acceleration, t, h, x0, v0, i)
        x1, v1 = x0 + h * speed_mean, v0 + h * mean
        stops = v1 <= 0.0
        over = ~stops & (x1 >= length[i])
        with np.errstate(divide="ignore", invalid="ignore"):
            rest = np.where(stops, v0 / -mean, h)
            room = length[i] - x0
            root = np.sqrt(np.maximum(v0 * v0 + 2.0 * mean * room, 0.0))
            cross = np.where(over, 2.0 * room / (v0 + root), h)
        part = np.minimum(np.where(stops, rest, cross), h)
        x[i] = np.where(
            stops, np.minimum(x0 + 0.5 * v0 * rest, length[i]), np.where(over, length[i], x1)
        )
        v[i] = np.where(stops, 0.0, v1)
        peak[i] = np.maximum(peak[i], v1)
        duration[i] = t + part
        whole[i] = over
        live = i[~(stops | over)]
        t += h
    if live.size:
        raise ValueError(f"a train has not stopped after {time_limit:g} s; check the friction")
    return Estimate(*(a.reshape(shape) for a in (x, x / lc, whole, duration, peak)))
