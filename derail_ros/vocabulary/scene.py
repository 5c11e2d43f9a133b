"""Geometry of the scene: corners of cars, and the box that holds the derailed ones."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]


class Line(Protocol):
    """The centre line of a track."""

    @property
    def start(self) -> float:
        """Track coordinate at which it begins, m; -inf for an endless straight."""

    @property
    def end(self) -> float:
        """Track coordinate at which it ends, m."""

    @property
    def straight(self) -> bool:
        """It is the straight along +X with the track coordinate X."""

    def point(self, s: float) -> tuple[float, float, float, float]:
        """Place x, y (m), heading (rad) and curvature (1/m) at a track coordinate (m)."""

    def locate(self, x: float, y: float, hint: float | None = None) -> tuple[float, float]:
        """Track coordinate of the foot point and offset to the left (m) of a place."""


def car_corners(pose: F64, length: F64, width: F64) -> F64:
    """Corners (N, 4, 2) of cars with poses (N, 3+) x, y, ..., yaw last, m.

    Order: front left, front right, rear left, rear right (``status.CORNERS``).
    """
    c, s = np.cos(pose[:, -1])[:, None], np.sin(pose[:, -1])[:, None]
    u = np.array([1.0, 1.0, -1.0, -1.0]) * 0.5 * np.asarray(length)[:, None]
    w = np.array([1.0, -1.0, 1.0, -1.0]) * 0.5 * np.asarray(width)[:, None]
    return np.stack([pose[:, :1] + c * u - s * w, pose[:, 1:2] + s * u + c * w], axis=2)


def scene_box(line: Line, corners: F64, hints: F64) -> tuple[float, float, float]:
    """Length along and width across the track (m) and area (m^2) that hold all corners (K, 4, 2).

    Coordinates are those of the track (arc length of the foot point, offset): X and Y on the
    straight. ``hints`` (one a car) are track coordinates near the cars.
    """
    if len(corners) == 0:
        return 0.0, 0.0, 0.0
    if line.straight:
        along, across = corners[:, :, 0].ravel(), corners[:, :, 1].ravel()
    else:
        places = [
            line.locate(float(x), float(y), float(hint))
            for car, hint in zip(corners, hints, strict=True)
            for x, y in car
        ]
        along, across = np.array(places).T
    length = float(along.max() - along.min())
    width = float(across.max() - across.min())
    return length, width, length * width
