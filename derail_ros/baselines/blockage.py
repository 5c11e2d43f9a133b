r"""The one-dimensional blockage model: cars on the rails brake, the pile pushes back.

The simplest of the published models of a train has one coordinate, the distance ``x`` (m)
that the train has run on since its first car derailed. The cars still on the rails are one mass;
they brake, and the pile pushes back with a blockage force that grows with speed. One car is lost
to the pile every ``l`` metres, and the count starts at 1:

    n = 1 + x / l
    (N - n) m dv/dt = -[(N - n) K_t F_b + (b_0 + b_1 v) m g]

with N the cars of the train, m the mass of a car (kg), ``F_b`` the full brake force of a car
(35 kN), ``K_t`` its mean share applied over the cars on the rails (signal of 290 m/s from the
front, then a linear rise in 10 s) and the blockage ``(1.32 + 0.109 v) m g``, v in m/s. What is
lost is left behind at the train's own speed: no ``v^2`` (see ``bar``).

The constants are a fit to the published speed series of the two-dimensional model (60 cars of
68 t and 14.1 m at 30, 48, 60, 72 and 90 km/h: 5, 10, 14, 18 and 24 cars); they are not measured,
and outside of that series they extrapolate. The model has no single cars, no geometry and no
collisions.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from derail_ros.baselines.bar import (
    BRAKE_RISE,
    BRAKE_SIGNAL_SPEED,
    Estimate,
    applied_share,
    arrays,
    check_brakes,
    slopes,
)
from derail_ros.vocabulary.params import GRAVITY

F64 = NDArray[np.float64]

CAR_LENGTH = 14.1
"""Travel of the train for each car lost, m: the body length of the fitted train."""

CAR_MASS = 68e3
"""Mass of a car of the fitted train, kg."""

BRAKE_FORCE = 35e3
"""Full brake force of a car, N."""

BLOCKAGE_REST = 1.32
"""Blockage force at rest as a multiple of a car's weight, ``b_0``."""

BLOCKAGE_SLOPE = 0.109
"""Its growth with speed, ``b_1``, s/m."""


def blockage(
    speed: ArrayLike,
    cars: ArrayLike,
    *,
    mass: ArrayLike = CAR_MASS,
    car_length: ArrayLike = CAR_LENGTH,
    brake_force: ArrayLike = BRAKE_FORCE,
    rest: ArrayLike = BLOCKAGE_REST,
    slope: ArrayLike = BLOCKAGE_SLOPE,
    run_up: ArrayLike = 0.0,
    rise_time: float = BRAKE_RISE,
    signal_speed: float = BRAKE_SIGNAL_SPEED,
    step: float = 0.02,
    time_limit: float = 3600.0,
) -> Estimate:
    """Cars derailed, all trains at once; arguments are scalars or arrays that broadcast.

    The count is 0 if the train stops short of the point; the braking before it counts in the
    duration.

    Parameters
    ----------
    speed : v0, m/s
    cars : N
    mass : m of a car, kg
    car_length : l, m
    brake_force : F_b of a car, N
    rest, slope : b_0 and b_1 (s/m) of the blockage
    run_up : way of the first car on the rails before it derails, braked but not blocked, m
    rise_time, signal_speed : of the brakes, s, m/s
    step : of the classical Runge-Kutta method, s

    Raises
    ------
    ValueError
        An argument is out of its range, or a train has not stopped after ``time_limit``.
    """
    check_brakes(rise_time, signal_speed)
    given = arrays(
        speed=speed, cars=cars, mass=mass, car_length=car_length, brake_force=brake_force,
        rest=rest, slope=slope, run_up=run_up,
    )  # fmt: skip
    shape, start = given[0].shape, given[0].ravel()
    v, n, m, lc, f_b, b0, b1, ahead = (a.flatten() for a in given)
    length = n * lc
    x = -ahead  # of the first car beyond the point
    duration = np.zeros_like(v)
    whole = np.zeros(v.shape, dtype=bool)
    peak = v.copy()

    def acceleration(t: float, x: F64, v: F64, i: NDArray[np.intp]) -> F64:
        # what has gone over; the first car goes at once
        gone = np.where(x >= 0.0, np.minimum(lc[i] + x, length[i]), 0.0)
        share = applied_share(t, gone, length[i], rise_time, signal_speed)
        brakes = share * f_b[i] / m[i]
        on_rails = np.maximum(n[i] - gone / lc[i], 1e-9)
        push = np.where(gone > 0.0, (b0[i] + b1[i] * v) * GRAVITY / on_rails, 0.0)
        return -(brakes + push)

    live = np.flatnonzero(v > 0.0)
    t = 0.0
    while live.size and t < time_limit:
        i, h = live, step
        x0, v0 = x[i], v[i]
        speed_mean, mean = slopes(acceleration, t, h, x0, v0, i, least=0.0)
        x1, v1 = x0 + h * speed_mean, v0 + h * mean
        stops = v1 <= 0.0
        with np.errstate(divide="ignore", invalid="ignore"):
            part = np.where(stops, np.minimum(v0 / -mean, h), h)
        x1 = np.where(stops, x0 + 0.5 * v0 * part, x1)
        over = x1 >= length[i] - lc[i]
        x[i] = np.minimum(x1, length[i] - lc[i])
        v[i] = np.where(stops | over, 0.0, v1)
        peak[i] = np.maximum(peak[i], v1)
        duration[i] = t + part
        whole[i] = over
        live = i[~(stops | over)]
        t += h
    if live.size:
        raise ValueError(f"a train has not stopped after {time_limit:g} s; check the friction")
    started = (x >= 0.0) & (start > 0.0)
    count = np.where(started, np.minimum(1.0 + x / lc, n), 0.0)
    found = (np.maximum(x, 0.0), count, whole, duration, peak)
    return Estimate(*(a.reshape(shape) for a in found))
