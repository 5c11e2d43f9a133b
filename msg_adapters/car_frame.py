"""The frame ``car_N``: place and motion of a car as ROS describes them.

The vocabulary gives the mass centre of a car, with ``z`` over its height at rest. The frame's
origin lies in the middle of the car at the height of the rail on which it stood, and turns with
the car. `/tf`, poses, odometry, sensors and entities are all of this frame, and all take it from
here. In the plane the two have the same numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from derail_ros.vocabulary.shapes import height_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from derail_ros.vocabulary.params import Car
    from derail_ros.vocabulary.sample import Sample

    F64 = NDArray[np.float64]


def heights(cars: Sequence[Car]) -> F64:
    """(N,) heights of the mass centres over the origins of the frames, m."""
    return np.array([height_of(car) for car in cars])


def axes(pose: F64) -> F64:
    """(N, 3, 3) axes x, y, z of the cars in space, as columns, of poses (N, 6)."""
    (sr, sp, sy), (cr, cp, cy) = np.sin(pose[:, 3:6]).T, np.cos(pose[:, 3:6]).T
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def places(pose: F64, height: F64, level: float = 0.0, along: F64 | None = None) -> F64:
    """(N, 3) places of the point (``along``, 0, ``level``) of each frame in space, m.

    With a_x and a_z the axes x and z of the car and e_z that of space, the point is at
    ``(x, y, z + level) + along a_x + (level - height) (a_z - e_z)``.
    """
    place = pose[:, :3] + np.array([0.0, 0.0, level])
    if not pose[:, 3:5].any():
        if along is not None:
            place[:, 0] += along * np.cos(pose[:, 5])
            place[:, 1] += along * np.sin(pose[:, 5])
        return np.asarray(place)
    turn = axes(pose)
    if along is not None:
        place += along[:, None] * turn[:, :, 0]
    return np.asarray(place + (level - height)[:, None] * (turn[:, :, 2] - [0.0, 0.0, 1.0]))


@dataclass(frozen=True)
class Motion:
    """Motion of the origins of the frames of N cars, in space.

    Attributes
    ----------
    place, velocity, acceleration : (N, 3) m, m/s, m/s^2
    spin, spin_growth : (N, 3) angular velocity, rad/s, and its rate, rad/s^2
    axes : (N, 3, 3) axes of the cars, as columns
    """

    place: F64
    velocity: F64
    acceleration: F64
    spin: F64
    spin_growth: F64
    axes: F64


def motion(sample: Sample, height: F64, cars: slice = slice(None)) -> Motion:
    """Motion of the frames of some cars; ``height``: theirs.

    With r from the mass centre to the origin and w the angular velocity: ``v = v_m + w x r``,
    ``a = a_m + dw/dt x r + w x (w x r)``. Roll, pitch and yaw turn about the car's x, about the
    level axis across it, and about z; the rate of w has the rates of these axes too.
    """
    pose, velocity, acceleration = (
        values[cars] for values in (sample.pose, sample.velocity, sample.acceleration)
    )
    turn = axes(pose)
    yaw = pose[:, 5]
    across = np.stack([-np.sin(yaw), np.cos(yaw), np.zeros_like(yaw)], axis=-1)
    about = np.stack([turn[:, :, 0], across, np.broadcast_to([0.0, 0.0, 1.0], across.shape)])
    parts = velocity[:, 3:].T[:, :, None] * about
    spin = parts.sum(axis=0)
    growth = (acceleration[:, 3:].T[:, :, None] * about).sum(axis=0)
    growth += np.cross(parts[2], parts[0] + parts[1]) + np.cross(parts[1], parts[0])
    arm = -height[:, None] * turn[:, :, 2]
    moved = np.cross(spin, arm)
    return Motion(
        place=places(pose, height),
        velocity=velocity[:, :3] + moved,
        acceleration=acceleration[:, :3] + np.cross(growth, arm) + np.cross(spin, moved),
        spin=spin,
        spin_growth=growth,
        axes=turn,
    )
