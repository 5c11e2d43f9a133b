"""Frames of a train and its description for viewers: `/tf`, `/tf_static`, joints, URDF.

Frames, each name after a prefix: ``car_1`` in the middle of car 1 at the height of the rail on
which it stood, turned with it, x along it; in it the trucks ``car_1/front_truck``,
``car_1/rear_truck``, fixed, for no model turns them; the couplers ``car_1/front_coupler``,
``car_1/rear_coupler`` at their pivots, turned; and in these, at their mated faces, ``.../head``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np

from derail_ros.vocabulary.params import Car, TrainParams
from msg_adapters.car_frame import heights, places
from msg_adapters.common import SENTINEL, RunContext
from msg_adapters.definitions import message_class, serialize
from msg_adapters.markers import BLUE, CAR_FLOOR, CAR_HEIGHT, COUPLER_HEIGHT, GAUGE
from msg_adapters.state import FlatEncoder
from msg_adapters.templates import Template, marked_header, quaternion, vector

if TYPE_CHECKING:
    from derail_ros.vocabulary.sample import Sample

ENDS = ("front", "rear")
WHEEL_RADIUS, WHEEL_WIDTH, WHEEL_BASE = 0.42, 0.13, 1.78
"""Wheels of 33 inches and the axle distance of 5 ft 10 in of the usual three-piece truck, m. The
model needs neither; they are drawn only."""
COUPLER_RADIUS = 0.12
"""Drawn radius of a coupler, m."""


def _transform(head: Any, child: str, place: Any, turn: Any) -> Any:
    pose = message_class("geometry_msgs/msg/Transform")(place, turn)
    return message_class("geometry_msgs/msg/TransformStamped")(head, child, pose)


def _places(car: Car) -> list[tuple[str, str, float]]:
    """Frames of a car that are fixed in another: end of that one's name, own name, x (m)."""
    trucks = [(f"{end}_truck", sign * car.truck_distance) for end, sign in zip(ENDS, (1, -1))]
    couplers = ((f"{ENDS[0]}_coupler", car.front.length), (f"{ENDS[1]}_coupler", -car.rear.length))
    return [
        *(("", name, x) for name, x in trucks),
        *((name, f"{name}/head", x) for name, x in couplers),
    ]


def static_transforms(params: TrainParams, context: RunContext, prefix: str = "") -> bytes:
    """CDR bytes of the ``tf2_msgs/TFMessage`` of `/tf_static`: trucks, and heads of couplers."""
    stamp = context.header(0.0).stamp
    header = message_class("std_msgs/msg/Header")
    found = []
    for number, car in enumerate(params.cars, 1):
        base = f"{prefix}car_{number}"
        for parent, name, x in _places(car):
            head = header(stamp, f"{base}/{parent}" if parent else base)
            place, turn = vector(float(x), 0.0, 0.0), quaternion(0.0, 0.0, 0.0, 1.0)
            found.append(_transform(head, f"{base}/{name}", place, turn))
    return serialize(message_class("tf2_msgs/msg/TFMessage")(found))


class TransformEncoder:
    """`/tf`: the cars in the inertial frame, and their couplers in them."""

    def __init__(self, params: TrainParams, context: RunContext, prefix: str = "") -> None:
        self.context = context
        self._height = heights(params.cars)
        found = []
        for number, car in enumerate(params.cars, 1):
            name = f"{prefix}car_{number}"
            head = marked_header(context.frame_id)
            found.append(_transform(head, name, vector(), quaternion()))
            for end, sign in zip(ENDS, (1, -1)):
                place = vector(sign * car.pivot_distance, 0.0, COUPLER_HEIGHT)
                turn = quaternion(0.0, 0.0, SENTINEL, SENTINEL)
                found.append(_transform(marked_header(name), f"{name}/{end}_coupler", place, turn))
        self._encode = Template(message_class("tf2_msgs/msg/TFMessage")(found))
        self._values = np.empty((len(params.cars), 11))

    def __call__(self, sample: Sample) -> bytes:
        """CDR bytes of ``tf2_msgs/TFMessage``."""
        half = 0.5 * (sample.coupler_yaw - sample.pose[:, 5:6])
        values = self._values
        values[:, 0:3] = places(sample.pose, self._height)
        values[:, 3:7] = sample.quaternions
        values[:, 7::2], values[:, 8::2] = np.sin(half), np.cos(half)
        return self._encode(self.context.stamp(sample.time), values.reshape(-1))


def joint_names(n_cars: int, prefix: str = "") -> list[str]:
    """Names of the joints of the couplers, car by car, front before rear."""
    return [f"{prefix}car_{i}/{end}_coupler" for i in range(1, n_cars + 1) for end in ENDS]


class JointEncoder:
    """``joint_states``: angles of the couplers against their cars (rad) and their rates."""

    def __init__(self, n_cars: int, context: RunContext, prefix: str = "") -> None:
        self.context = context
        zero = np.zeros(2 * n_cars)
        self._encode = FlatEncoder(
            message_class("sensor_msgs/msg/JointState")(
                context.header(0.0), joint_names(n_cars, prefix), zero, zero, np.zeros(0)
            )
        )

    def __call__(self, sample: Sample) -> bytes:
        """CDR bytes of ``sensor_msgs/JointState``."""
        angle = sample.coupler_yaw - sample.pose[:, 5:6]
        rate = sample.coupler_rate - sample.velocity[:, 5:6]
        fields = {"position": angle.reshape(-1), "velocity": rate.reshape(-1)}
        return self._encode(self.context.stamp(sample.time), fields)


# --- URDF ------------------------------------------------------------------------------------


def _shape(
    link: Any, what: str, sizes: dict[str, Any], place: str, turn: str, color: str, solid: bool
) -> None:
    """Add a shape that is seen and, if ``solid``, collides."""
    for role in ("visual", "collision") if solid else ("visual",):
        element = ElementTree.SubElement(link, role)
        ElementTree.SubElement(element, "origin", xyz=place, rpy=turn)
        ElementTree.SubElement(ElementTree.SubElement(element, "geometry"), what, sizes)
        if role == "visual":
            ElementTree.SubElement(element, "material", name=color)


def _inertial(link: Any, mass: float, inertia: tuple[float, float, float], height: float) -> None:
    inertial = ElementTree.SubElement(link, "inertial")
    ElementTree.SubElement(inertial, "origin", xyz=f"0 0 {height:g}")
    ElementTree.SubElement(inertial, "mass", value=f"{mass:g}")
    values = dict(zip(("ixx", "iyy", "izz"), (f"{i:g}" for i in inertia)))
    ElementTree.SubElement(inertial, "inertia", values | dict.fromkeys(("ixy", "ixz", "iyz"), "0"))


def robot_description(params: TrainParams, frame_id: str = "map", prefix: str = "") -> str:
    """URDF of the whole train in metres and kilograms: boxes, wheels, couplers in their sizes.

    Boxes and wheels collide, couplers do not.

    The root is the inertial frame; the joints of the cars are floating, those of the couplers are
    continuous about z. Mass and yaw inertia are the model's; roll and pitch inertia are those of a
    homogeneous box, since the planar model has none.
    """
    root = ElementTree.Element("robot", name="train")
    for color, rgb in (("body", BLUE), ("steel", (0.2, 0.2, 0.2))):
        material = ElementTree.SubElement(root, "material", name=color)
        ElementTree.SubElement(material, "color", rgba=" ".join(f"{c:g}" for c in (*rgb, 1.0)))

    def link(name: str) -> Any:
        return ElementTree.SubElement(root, "link", name=name)

    def joint(name: str, kind: str, parent: str, x: float = 0.0, z: float = 0.0) -> Any:
        made = ElementTree.SubElement(root, "joint", name=name, type=kind)
        ElementTree.SubElement(made, "parent", link=parent)
        ElementTree.SubElement(made, "child", link=name)
        ElementTree.SubElement(made, "origin", xyz=f"{x:g} 0 {z:g}", rpy="0 0 0")
        return made

    link(frame_id)
    quarter = f"{np.pi / 2:.6f}"
    for number, car in enumerate(params.cars, 1):
        name = f"{prefix}car_{number}"
        body = link(name)
        middle = CAR_FLOOR + 0.5 * CAR_HEIGHT
        size = f"{car.length:g} {car.width:g} {CAR_HEIGHT:g}"
        _shape(body, "box", {"size": size}, f"0 0 {middle:g}", "0 0 0", "body", True)
        lying = car.mass / 12 * (car.width**2 + CAR_HEIGHT**2)
        pitching = car.mass / 12 * (car.length**2 + CAR_HEIGHT**2)
        _inertial(body, car.mass, (lying, pitching, car.inertia), middle)
        joint(name, "floating", frame_id)
        for end, sign, coupler in zip(ENDS, (1, -1), (car.front, car.rear)):
            truck = link(f"{name}/{end}_truck")
            for x in (0.5 * WHEEL_BASE, -0.5 * WHEEL_BASE):
                for y in (0.5 * GAUGE, -0.5 * GAUGE):
                    place = f"{x:g} {y:g} {WHEEL_RADIUS:g}"
                    sizes = {"radius": f"{WHEEL_RADIUS:g}", "length": f"{WHEEL_WIDTH:g}"}
                    _shape(truck, "cylinder", sizes, place, f"{quarter} 0 0", "steel", True)
            joint(f"{name}/{end}_truck", "fixed", name, sign * car.truck_distance)
            arm = link(f"{name}/{end}_coupler")
            sizes = {"radius": f"{COUPLER_RADIUS:g}", "length": f"{coupler.length:g}"}
            place = f"{sign * 0.5 * coupler.length:g} 0 0"
            _shape(arm, "cylinder", sizes, place, f"0 {quarter} 0", "steel", False)
            at = sign * car.pivot_distance
            turning = joint(f"{name}/{end}_coupler", "continuous", name, at, COUPLER_HEIGHT)
            ElementTree.SubElement(turning, "axis", xyz="0 0 1")
            link(f"{name}/{end}_coupler/head")
            joint(f"{name}/{end}_coupler/head", "fixed", arm.get("name"), sign * coupler.length)
    return ElementTree.tostring(root, encoding="unicode")
