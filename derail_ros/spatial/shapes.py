"""Centre of gravity and inertia of a car, from its type and its load.

Roll inertia: a uniform box, ``m (w^2 + height^2) / 12``, or a cylinder, ``m r^2 / 2``; no measured
ones of freight cars were found. Pitch inertia: the yaw inertia.
"""

from __future__ import annotations

from dataclasses import dataclass

from derail_ros.spatial import constants as c
from derail_ros.vocabulary.params import Car
from derail_ros.vocabulary.shapes import WIDER, Kind, height_of, kind_of, parts


@dataclass(frozen=True)
class Body:
    """A car as a body.

    Attributes
    ----------
    kind : its kind
    height : of the centre of gravity over the rail, m
    width : m
    roll_inertia, pitch_inertia, yaw_inertia : of car without couplers, kg m^2
    mass : the same, kg
    shelf : its couplers do not slip vertically: type F, or the shelves that tank cars must have
        (49 CFR 179.14)
    """

    kind: Kind
    height: float
    width: float
    mass: float
    roll_inertia: float
    pitch_inertia: float
    yaw_inertia: float
    shelf: tuple[bool, bool]


def body_of(car: Car) -> Body:
    """A car as a body. A virtual one has the mass of all its cars."""
    kind = kind_of(car.name, bool(car.locomotives) and car.represents == 1)
    width = car.width + WIDER
    tall = kind.top - kind.bottom
    arm = tall * tall / 8.0 if kind.tank else (width * width + tall * tall) / 12.0
    mass = car.mass - 2.0 * c.COUPLER_MASS
    yaw = max(car.inertia - 2.0 * c.COUPLER_MASS * car.pivot_distance**2, 0.5 * car.inertia)
    return Body(
        kind=kind,
        height=height_of(car),
        width=width,
        mass=mass,
        roll_inertia=mass * arm,
        pitch_inertia=yaw,
        yaw_inertia=yaw,
        shelf=(car.front.head == "F" or kind.tank, car.rear.head == "F" or kind.tank),
    )


STATIONS = (-0.5, -0.25, 0.0, 0.25, 0.5)
"""Where along a body the ground is felt, in its lengths."""


def ground_points(body: Body, car: Car) -> list[tuple[float, ...]]:
    """Where a car feels the ground, in its frame: x, y, z, radius, 0 for a truck or 1 for a body.

    The lower corners of trucks, the edges of a box at five stations, five spheres in a tank.
    """
    found = []
    for part in parts(body.kind, body.height, car.length, car.width, car.truck_distance):
        half = [0.5 * size for size in part.size]
        x, y, z = part.at
        if part.name != "body":
            found += [
                (x + a * half[0], b * half[1], z - half[2], 0.0, 0.0)
                for a in (-1, 1) for b in (-1, 1)
            ]  # fmt: skip
        elif part.capsule:
            straight = 2.0 * (half[0] - half[2])
            found += [(a * straight, 0.0, z, half[2], 1.0) for a in STATIONS]
        else:
            found += [
                (a * part.size[0], b * half[1], z + d * half[2], 0.0, 1.0)
                for a in STATIONS for b in (-1, 1) for d in (-1, 1)
            ]  # fmt: skip
    return found
