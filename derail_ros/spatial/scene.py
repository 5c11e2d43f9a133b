"""The train as a MuJoCo model (MJCF): bodies, trucks, couplers, couplings.

A car is a free body at its centre of gravity with a box or a capsule for the body and a box for
each truck. A coupler is a light body on a yaw and a pitch hinge; two mated ones are joined at
their faces by a ``connect`` equality. Rails and ground are not in the model: the kernels push
(``derail_ros.spatial.kernels``).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from derail_ros.spatial import constants as c
from derail_ros.spatial.shapes import Body
from derail_ros.vocabulary.params import GRAVITY, Car, TrainParams
from derail_ros.vocabulary.shapes import (
    CAR_FRICTION,
    Part,
    contact_response,
    parts,
)


def _numbers(*values: float) -> str:
    return " ".join(repr(float(v)) for v in values)


TALL = 100.0
"""Of bodies that move in the plane only, m: more than two of them ever overlap."""


def _prism(body: Part) -> Part:
    """A body as a car that is kept in the plane has it.

    The normal of a contact is that of the least overlap. Of boxes and capsules it would turn
    upright where two bodies overlap by more than their height or their axes cross, and upright a
    locked car has no mass that could give way: such a contact once reached 879 MN.
    """
    return replace(body, capsule=False, size=(*body.size[:2], TALL))


def _geom(part: Part, number: int, mass: float) -> str:
    half = [0.5 * size for size in part.size]
    if part.capsule:
        turn = _numbers(0.0, 0.5 * math.pi, 0.0)
        shape = f'type="capsule" size="{_numbers(half[2], half[0] - half[2])}" euler="{turn}"'
    else:
        shape = f'type="box" size="{_numbers(*half)}"'
    soft = _numbers(*(-value for value in contact_response(mass)))
    at = _numbers(*part.at)
    return f'<geom name="{part.name} {number}" {shape} pos="{at}" solref="{soft}"/>'


SLIDE = '<joint type="slide" axis="-1 0 0"/>'
"""A rear coupler with draft gear slides in its car; positive: outwards."""
TIED = ' solref="0.004 1" solimp="0.9999 0.9999 0.001"'
"""Of couplings with draft gear: MuJoCo ties by the mass that is moved, here a coupler that slides,
and by default 400 kN would pull the two heads 38 mm apart."""


def _coupler(car: Car, body: Body, end: int, number: int, locked: bool, gear: bool) -> str:
    sign = 1.0 - 2.0 * end
    coupler = (car.front, car.rear)[end]
    name = f"{('front', 'rear')[end]} coupler {number}"
    limit = c.PITCH_LIMIT_F if body.shelf[end] else c.PITCH_LIMIT_E
    pitch = f'<joint axis="0 1 0" limited="true" range="{_numbers(-limit, limit)}"/>'
    at = _numbers(sign * car.pivot_distance, 0.0, c.COUPLER_HEIGHT - body.height)
    inertia = _numbers(c.COUPLER_ROLL, car.coupler_inertia, car.coupler_inertia)
    return (
        f'<body name="{name}" pos="{at}">'
        f'<inertial pos="0 0 0" mass="{c.COUPLER_MASS!r}" diaginertia="{inertia}"/>'
        f'<joint axis="0 0 1"/>{"" if locked else pitch}{SLIDE if gear and end else ""}'
        f'<site name="{name}" pos="{_numbers(sign * coupler.length, 0.0, 0.0)}"/></body>'
    )


def _car(car: Car, body: Body, number: int, locked: bool, gear: bool) -> str:
    joint = (
        '<joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/>'
        '<joint type="hinge" axis="0 0 1"/>'
        if locked
        else "<freejoint/>"
    )
    inertia = _numbers(body.roll_inertia, body.pitch_inertia, body.yaw_inertia)
    found = parts(body.kind, body.height, car.length, car.width, car.truck_distance)
    if locked:
        found = [_prism(found[0])]
    shapes = "".join(_geom(part, number, car.mass) for part in found)
    couplers = "".join(_coupler(car, body, end, number, locked, gear) for end in (0, 1))
    return (
        f'<body name="car {number}" pos="{_numbers(0.0, 0.0, body.height)}">{joint}'
        f'<inertial pos="0 0 0" mass="{body.mass!r}" diaginertia="{inertia}"/>'
        f"{shapes}{couplers}</body>"
    )


def mjcf(params: TrainParams, bodies: Sequence[Body], time_step: float, locked: bool) -> str:
    """The model. ``locked``: cars move in the plane only."""
    cars = "".join(
        _car(car, body, i, locked, params.couplings.gear.on)
        for i, (car, body) in enumerate(zip(params.cars, bodies, strict=True), 1)
    )
    tied = TIED if params.couplings.gear.on else ""
    joined = "".join(
        f'<connect site1="rear coupler {i}" site2="front coupler {i + 1}"{tied}/>'
        for i in range(1, len(params.cars))
    )
    collides = int(params.variant.collisions)
    return (
        f'<mujoco model="derailment"><compiler angle="radian" eulerseq="xyz"/>'
        f'<option timestep="{time_step!r}" gravity="0 0 {-GRAVITY!r}" integrator="Euler" '
        'cone="elliptic" jacobian="sparse" tolerance="1e-6">'
        '<flag eulerdamp="disable" autoreset="disable"/></option>'
        '<size memory="256M"/>'
        f'<default><geom friction="{CAR_FRICTION!r} 0.005 0.0001" contype="{collides}"/></default>'
        f"<worldbody>{cars}</worldbody><equality>{joined}</equality></mujoco>"
    )
