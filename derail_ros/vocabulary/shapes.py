"""Shapes and surfaces of cars in three dimensions, by their type and load.

Scenarios name a car's type and mass; heights here are typical of each kind [A], where no source is
named. Lengths in m, heights over the top of the rail with the car at rest.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from derail_ros.vocabulary.params import Car

RAIL_HEIGHT = 0.18
"""The ground lies so far below the rail, m: a rail of 132 to 136 lb/yd is 181 to 186 mm high."""
HALF_GAUGE = 0.755
"""From the middle of the track to the middle of a rail head, m: 1.435 m of gauge and a head."""
LIGHT_WEIGHT = 28.5e3
"""Of a car without its load, kg, for its centre of gravity: a manifest car (ALTRIOS)."""
LIGHT_HEIGHT = 1.14
"""Centre of gravity of an empty car, m: about 45 in."""
GREATEST_HEIGHT = 2.49
"""Of the centre of gravity of a car and its load, m: 98 in, AAR loading rules."""
WIDER = 0.4
"""Bodies are wider than in the planar model, whose buffer holds part of the width, m."""
TRUCK = (2.7, 1.64, 0.95)
"""Length, width and height of a truck, m: 1.78 m of axle base, a wheel of 0.91 m. Width over the
outer faces of the wheels, on which a derailed car stands and over which it tips: 53 3/32 in.
between the wheels and two rims of 5 23/32 in. (AAR)."""

BED_HALF_WIDTH = 1.60
"""Of the track bed, m: half a tie of 8 ft 6 in. and a shoulder of 12 in., as is usual on main
lines of North America."""
BED_HEIGHT = 0.483
"""Of the bed over the ground beside it, m: a tie of 7 in. on 12 in. of ballast (usual); ditches
and embankments, which most lines have besides, are left out."""
BED_SLOPE = 0.5
"""Of its sides: 2 to 1 (usual)."""

CAR_FRICTION = 0.3
"""Of car on car: steel on steel, dry."""
CAR_STIFFNESS, CAR_DAMPING = 4.74e6, 0.19
"""Of car on car, N/m, and share of critical damping: set by the source's impact tests of tank
cars (docs/spatial.md)."""
GROUND_STIFFNESS, GROUND_DAMPING = 625.0, 50.0
"""The same of the ground, critically damped: a weight sinks by 16 mm [A]."""


@dataclass(frozen=True)
class Kind:
    """A kind of body: its underside, its top, the middle of its load; a tank; open above."""

    bottom: float
    top: float
    load: float
    tank: bool = False
    open: bool = False


BOX = Kind(1.0, 4.4, 2.3)
LOCOMOTIVE = Kind(1.0, 4.7, 1.7)
KINDS = {
    "tank": Kind(1.0, 4.0, 2.5, tank=True),
    "autorack": Kind(1.0, 5.8, 2.9),
    "covered hopper": Kind(0.9, 4.6, 2.4),
    "hopper": Kind(0.9, 4.0, 2.2, open=True),
    "gondola": Kind(0.9, 3.4, 2.0, open=True),
    "spine": Kind(0.7, 3.6, 2.2),
    "well": Kind(0.4, 4.6, 2.2),
    "flat": Kind(0.9, 1.3, 2.1),
    "locomotive": LOCOMOTIVE,
}
"""Kinds by a word of the car's name; BOX for all others."""


def kind_of(name: str, locomotive: bool = False) -> Kind:
    """The kind of a car, by its name."""
    if locomotive:
        return LOCOMOTIVE
    words = name.lower().replace("_", " ")
    return next((kind for word, kind in KINDS.items() if word in words), BOX)


def gravity_height(kind: Kind, mass: float) -> float:
    """Height of the centre of gravity of a car of that mass (kg), m.

    ``h = (m_l LIGHT_HEIGHT + (m - m_l) h_load) / m`` with the light weight m_l, at most
    GREATEST_HEIGHT.
    """
    if kind is LOCOMOTIVE:
        return kind.load
    light = min(LIGHT_WEIGHT, mass)
    height = (light * LIGHT_HEIGHT + (mass - light) * kind.load) / mass
    return min(height, GREATEST_HEIGHT)


def height_of(car: Car) -> float:
    """Height of the centre of gravity of a car over the rail at rest, m."""
    kind = kind_of(car.name, bool(car.locomotives) and car.represents == 1)
    return gravity_height(kind, car.mass / car.represents)


def box_of(car: Car) -> tuple[float, float]:
    """Width and top of the box, from the rails up, that holds a car's shapes, m.

    It is as long as the car.
    """
    kind = kind_of(car.name, bool(car.locomotives) and car.represents == 1)
    found = parts(kind, height_of(car), car.length, car.width, car.truck_distance)
    return max(part.size[1] for part in found), kind.top


def contact_response(mass: float) -> tuple[float, float]:
    """Stiffness (1/s^2) and damping (1/s) over the mass moved of contacts of a car of ``mass`` kg.

    Two equal cars move half of it, so ``2 CAR_STIFFNESS / m``; of two, MuJoCo takes the stiffer.
    """
    stiffness = 2.0 * CAR_STIFFNESS / mass
    return stiffness, 2.0 * CAR_DAMPING * math.sqrt(stiffness)


@dataclass(frozen=True)
class Part:
    """A box, or a capsule along the car, in the car's frame at its centre of gravity, m.

    ``size``: length, width, height over all.
    """

    name: str
    capsule: bool
    size: tuple[float, float, float]
    at: tuple[float, float, float]


def parts(kind: Kind, height: float, length: float, width: float, truck: float) -> list[Part]:
    """Body, front and rear truck of a car whose centre of gravity lies at ``height``.

    ``width`` is that of the planar model; ``truck`` the distance from the centre to a truck.
    """
    tall = kind.top - kind.bottom
    capsule = kind.tank and length > tall
    size = (length, tall if capsule else width + WIDER, tall)
    found = [Part("body", capsule, size, (0.0, 0.0, 0.5 * (kind.bottom + kind.top) - height))]
    for name, sign in (("front truck", 1.0), ("rear truck", -1.0)):
        found.append(Part(name, False, TRUCK, (sign * truck, 0.0, 0.5 * TRUCK[2] - height)))
    return found
