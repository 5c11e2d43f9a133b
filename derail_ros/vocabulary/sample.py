"""State of a run at one moment, one entry a car (N cars)."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]


@dataclass(frozen=True)
class Sample:
    """State and forces at ``time``. Index 0 is car 1, which leads; coupling 0 joins cars 1 and 2.

    Frame: x forward along the straight track, y left, z up; angles counter-clockwise, in the order
    roll, pitch, yaw (rotate about z by yaw, then about the new y by pitch, then about the new x by
    roll). A planar engine leaves z, roll and pitch at zero. Trucks: column 0 front, 1 rear.
    Corners: 0 front left, 1 front right, 2 rear left, 3 rear right. Forces are those on the car.
    In couplings draft (tension) is positive, buff (compression) negative.

    Attributes
    ----------
    time : run time, s
    step : number of accepted steps
    pose, velocity, acceleration : (N, 6) of the mass centre: x, y, z (m), roll, pitch, yaw (rad)
        and their rates
    coupler_yaw, coupler_rate, coupler_acceleration : (N, 2) absolute yaw angles of the front and
        rear coupler bodies (rad) and their rates
    truck_on : (N, 2) 1 while the truck is on the rails
    coupled : (N-1,) 1 while the coupling behind car i holds
    truck_coordinate : (N, 2) track coordinate of each truck, m
    rail_force : (N, 2) lateral force of the rails on each truck (positive along the track's left
        normal), N; 0 when derailed
    brake_force : (N,) retarding force of the brakes, N, >= 0
    ground_truck_force : (N, 2, 2) ground force on [car, truck, x|y], N
    ground_body_force : (N, 2) ground force over the body, N
    ground_moment : (N,) moment of all ground forces about the mass centre, N m
    striker_force : (N, 2) striker force front, rear, N (positive for a positive displacement)
    relative_angle : (N-1,) rear coupler's yaw of the car ahead less front coupler's of the car
        behind, rad
    knuckle_moment : (N-1,) moment on the rear coupler of the car ahead, N m
    coupler_force : (N-1, 2) force of car i+1 on car i through the coupling (x, y), N
    coupler_gap : (N-1,) distance between the mated faces, m: the constraint error; 0 once parted
    collision_force : (N, 2) sum of the collision forces on the car, N
    collision_moment : (N,) their moment about the mass centre, N m
    corner_force : (N, 4) largest-contact force at each corner, N (0 without contact)
    corner_gap, corner_closing_speed : (N, 4) gap (m) and closing speed (m/s) of that contact, nan
        without
    corner_other : (N, 4) car number on the other side of it, 0 without
    external_force : (N, 2) force that starts the motion, N
    external_moment : (N,) its moment about the mass centre, N m
    energy : ledger entry (``ledger.ENERGY_ENTRIES``) -> J
    cars, couplings : further quantities by name, unit in the name: (N,) and (N-1,)
    """

    time: float
    step: int
    pose: F64
    velocity: F64
    acceleration: F64
    coupler_yaw: F64
    coupler_rate: F64
    coupler_acceleration: F64
    truck_on: U8
    coupled: U8
    truck_coordinate: F64
    rail_force: F64
    brake_force: F64
    ground_truck_force: F64
    ground_body_force: F64
    ground_moment: F64
    striker_force: F64
    relative_angle: F64
    knuckle_moment: F64
    coupler_force: F64
    coupler_gap: F64
    collision_force: F64
    collision_moment: F64
    corner_force: F64
    corner_gap: F64
    corner_closing_speed: F64
    corner_other: NDArray[np.int64]
    external_force: F64
    external_moment: F64
    energy: Mapping[str, float]
    cars: Mapping[str, F64] = field(default_factory=dict)
    couplings: Mapping[str, F64] = field(default_factory=dict)

    @classmethod
    def make(cls, time: float, step: int, pose: F64, **given: Any) -> Sample:
        """A sample of an engine that does not compute everything.

        Parameters
        ----------
        time, step, pose : as above
        given : any other attributes; those left out are zero (trucks on the rails, couplings
            whole, couplers along their cars, no contact)
        """
        n = len(pose)
        fields: dict[str, Any] = {
            name: np.zeros([n - 1 if k == "N-1" else n if k == "N" else k for k in shape])
            for name, shape in _SHAPES.items()
        }
        fields["coupler_yaw"] = np.repeat(np.asarray(pose)[:, 5:6], 2, axis=1)
        fields["truck_on"] = np.ones((n, 2), dtype=np.uint8)
        fields["coupled"] = np.ones(n - 1, dtype=np.uint8)
        fields["corner_other"] = np.zeros((n, 4), dtype=np.int64)
        for name in ("corner_gap", "corner_closing_speed"):
            fields[name][:] = np.nan
        unknown = set(given) - set(cls.__dataclass_fields__)
        if unknown:
            raise TypeError(f"a sample has no {', '.join(sorted(unknown))}")
        fields["energy"] = {}
        return cls(time=time, step=step, pose=np.asarray(pose, dtype=float), **(fields | given))

    @property
    def n_cars(self) -> int:
        """Number of bodies N."""
        return len(self.pose)

    @functools.cached_property
    def quaternions(self) -> F64:
        """(N, 4) orientation of the cars: x, y, z, w."""
        return quaternions(self.pose)

    @property
    def axial_force(self) -> F64:
        """(N-1,) coupling force along the train, N: draft positive, buff negative; 0 once parted.

        The force of the car behind on the car ahead, along the line from it to the car behind.
        """
        line = self.pose[1:, :2] - self.pose[:-1, :2]
        size = np.hypot(line[:, 0], line[:, 1])
        along = self.coupler_force[:, 0] * line[:, 0] + self.coupler_force[:, 1] * line[:, 1]
        return np.divide(along, size, out=np.zeros_like(along), where=size > 0.0)

    @property
    def plane(self) -> F64:
        """(N, 3) x, y, yaw: the pose seen from above."""
        return self.pose[:, [0, 1, 5]]

    @property
    def q(self) -> F64:
        """(N, 5) coordinates of the planar model: x, y, yaw, front and rear coupler's yaw."""
        return np.column_stack([self.plane, self.coupler_yaw])

    @property
    def v(self) -> F64:
        """(N, 5) rates of :attr:`q`."""
        return np.column_stack([self.velocity[:, [0, 1, 5]], self.coupler_rate])

    @property
    def a(self) -> F64:
        """(N, 5) accelerations of :attr:`q`."""
        return np.column_stack([self.acceleration[:, [0, 1, 5]], self.coupler_acceleration])


_SHAPES: dict[str, tuple[Any, ...]] = {
    "velocity": ("N", 6),
    "acceleration": ("N", 6),
    "coupler_rate": ("N", 2),
    "coupler_acceleration": ("N", 2),
    "truck_coordinate": ("N", 2),
    "rail_force": ("N", 2),
    "brake_force": ("N",),
    "ground_truck_force": ("N", 2, 2),
    "ground_body_force": ("N", 2),
    "ground_moment": ("N",),
    "striker_force": ("N", 2),
    "relative_angle": ("N-1",),
    "knuckle_moment": ("N-1",),
    "coupler_force": ("N-1", 2),
    "coupler_gap": ("N-1",),
    "collision_force": ("N", 2),
    "collision_moment": ("N",),
    "corner_force": ("N", 4),
    "corner_gap": ("N", 4),
    "corner_closing_speed": ("N", 4),
    "external_force": ("N", 2),
    "external_moment": ("N",),
}
"""Shapes of what :meth:`Sample.make` fills with zeros."""


def planar(values: F64) -> F64:
    """(N, 6) x, y, z, roll, pitch, yaw from (N, 3+) x, y, yaw: the rest is zero."""
    full = np.zeros((len(values), 6))
    full[:, [0, 1, 5]] = values[:, :3]
    return full


def quaternions(pose: F64) -> F64:
    """(N, 4) quaternions x, y, z, w of poses (N, 6) that end with roll, pitch, yaw (rad)."""
    half = 0.5 * pose[:, 3:6]
    sine, cosine = np.sin(half), np.cos(half)
    if not half[:, :2].any():
        flat = np.zeros((len(pose), 4))
        flat[:, 2], flat[:, 3] = sine[:, 2], cosine[:, 2]
        return flat
    (sr, sp, sy), (cr, cp, cy) = sine.T, cosine.T
    return np.stack(
        [
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
            cr * cp * cy + sr * sp * sy,
        ],
        axis=-1,
    )
