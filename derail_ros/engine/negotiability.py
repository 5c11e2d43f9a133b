"""Curve negotiability: how far couplers must swing on a curve, and the smallest radius they pass.

Two coupled cars stand with their trucks on the line. Their mated couplers form a straight bar
between the two coupler pivots, as in the curve calculations of AAR M-1001. The swing of a coupler
is the angle between the bar and its car. It must not pass the angle at which the coupler meets
its striker, ``d_so / d_st``. The largest swing comes at the beginning of a curve without a spiral,
where the car ahead is on the curve and its end overhangs the tangent on the outside. With l the
length of the bar and small angles it is

    (l + d_P - d_T) (d_P + d_T + l) / (2 l R)
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from typing import NoReturn

import numpy as np

from derail_ros.engine.arrays import F64
from derail_ros.engine.track import Track
from derail_ros.vocabulary.errors import ParameterError
from derail_ros.vocabulary.params import Car, CouplerType, TrackParams, TrackSegment

STEP = 0.5
"""Distance of the places at which a pair of cars is looked at, m."""

RESERVE = 1.05
"""Free swing over that of a straight bar: the couplers of a moving train are not in line."""


def swing(track: Track, ahead: Car, behind: Car, s: F64) -> F64:
    """Angles (rad, (M, 2)) of the bar to the car ahead and to the car behind.

    ``s`` (M,): track coordinates of the centre of the car ahead, m.
    """

    def pose(car: Car, at: F64) -> tuple[F64, F64]:
        reach = np.full_like(at, car.truck_distance)
        for _ in range(2):
            front, rear = track.points(at + reach), track.points(at - reach)
            reach = reach * 2.0 * car.truck_distance / np.hypot(*(front - rear).T)
        along = (front - rear) / (2.0 * car.truck_distance)
        return 0.5 * (front + rear), along

    bar = ahead.rear.length + behind.front.length
    centre, along = pose(ahead, s)
    pivot = centre - ahead.pivot_distance * along
    at = s - (ahead.pivot_distance + bar + behind.pivot_distance)
    for _ in range(6):
        centre, direction = pose(behind, at)
        link = pivot - (centre + behind.pivot_distance * direction)
        at = at + np.hypot(*link.T) - bar
    angles = [_angle(axis, link) for axis in (along, direction)]
    return np.stack(angles, axis=-1)


def _angle(a: F64, b: F64) -> F64:
    """Angle (rad) between vectors (M, 2), without a sign."""
    return np.arctan2(np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a * b, axis=1))


def opening(coupler: CouplerType) -> float:
    """Angle (rad) at which the coupler meets its striker; above 0, so that shares are finite."""
    return max(coupler.striker_opening / coupler.striker_arm, 1e-6)


def _shares(track: Track, ahead: Car, behind: Car, s: F64) -> F64:
    """Largest swing of each of the two couplers over its opening, at the places ``s``."""
    with np.errstate(invalid="ignore"):
        shares = swing(track, ahead, behind, s) / (opening(ahead.rear), opening(behind.front))
    return np.nan_to_num(shares, nan=math.inf)


def smallest_radius(ahead: Car, behind: Car) -> float:
    """Smallest radius (m) that two coupled cars pass, on the curve and as they enter it.

    The cars enter from a tangent, without a spiral, either of them first.
    """
    from scipy.optimize import root_scalar  # slow to load, and needed for a refusal only

    reach = 2.0 * (ahead.length + behind.length)
    first, second = (replace(car, front=car.rear, rear=car.front) for car in (behind, ahead))
    s = np.arange(-reach, 0.5 * reach, STEP)

    def excess(bend: float) -> float:
        segments = TrackSegment(reach), TrackSegment(reach, bend, bend)
        track = Track(TrackParams(segments, start_coordinate=-reach))
        pairs = ((ahead, behind), (first, second))
        return min(max(float(np.max(_shares(track, *pair, s))) for pair in pairs), 3.0) - 1.0

    bar = ahead.rear.length + behind.front.length
    start = max(
        (bar + c.pivot_distance - c.truck_distance) * (c.pivot_distance + c.truck_distance + bar)
        / (2.0 * bar * opening(coupler))
        for c, coupler in ((ahead, ahead.rear), (behind, behind.front))
    )  # fmt: skip
    found = root_scalar(excess, x0=1.0 / start, x1=1.01 / start, rtol=1e-6)
    return 1.0 / float(found.root)


def free_swing(cars: tuple[Car, ...], track: Track) -> F64:
    """Free swing (rad, (N, 2): front, rear) that the alignment asks of each coupler.

    Zero on straight track.

    Raises
    ------
    ParameterError : two coupled cars do not pass a curve; names the cars and the radius
    """
    free = np.zeros((len(cars), 2))
    pieces = track.pieces
    start = pieces["kappa"]
    bend = np.maximum(np.abs(start), np.abs(start + pieces["dkappa"] * pieces["length"]))
    if len(cars) < 2 or not np.any(bend):
        return free
    reach = 2.0 * max(car.length for car in cars)
    # a reversal of half the largest curvature asks for no more than the largest one
    tight = pieces[bend >= 0.5 * np.max(bend)]
    ends = np.unique(np.concatenate([tight["s"], tight["s"] + tight["length"]]))
    s = np.unique((ends[:, None] + np.arange(-reach, reach, STEP)).round(1))
    known: dict[tuple[object, ...], F64] = {}
    for i, (ahead, behind) in enumerate(pairwise(cars)):
        key = tuple(
            (c.pivot_distance, c.truck_distance, e.length, opening(e))
            for c, e in ((ahead, ahead.rear), (behind, behind.front))
        )
        if key not in known:
            shares = _shares(track, ahead, behind, s)
            worst = int(np.argmax(np.max(shares, axis=1)))
            if np.max(shares) > 1.0:
                _refuse(track, i, ahead, behind, float(s[worst]))
            known[key] = np.max(shares, axis=0)
        share = np.minimum(RESERVE * known[key], 1.0)
        free[i, 1] = share[0] * opening(ahead.rear)
        free[i + 1, 0] = share[1] * opening(behind.front)
    return free


def _refuse(track: Track, i: int, ahead: Car, behind: Car, s: float) -> NoReturn:
    reach = ahead.length + behind.length
    bend = max(abs(track.point(float(u))[3]) for u in np.arange(s - reach, s + reach, STEP))
    names = [f"{n} ({c.name})" if c.name else f"{n}" for n, c in ((i + 1, ahead), (i + 2, behind))]
    smallest = smallest_radius(ahead, behind)
    why = f"the smallest radius that they pass is {smallest:.0f} m"
    if bend * smallest <= 1.0:
        why += " and the curve reverses here"
    raise ParameterError(
        "track.alignment",
        f"cars {names[0]} and {names[1]} do not pass the curve of {1.0 / bend:.0f} m "
        f"at {s:.0f} m: {why}",
    )
