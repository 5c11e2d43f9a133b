"""A moment of a recorded run as bodies in space, and as a world for other simulators.

A world holds each car as its shapes with mass and friction, the ground with the beds of the
tracks, fixed bodies as upright slabs along their edges, zones that rise over the ground as wedges
(but not in SDF, which has no shape for them), and the rails to look at.
Cars on the rails are fixed; derailed ones are free. Couplings are left out.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from derail_ros.review.scene import scene_at
from derail_ros.vocabulary import shapes
from derail_ros.vocabulary.params import GRAVITY, PLANAR, GroundParams
from derail_ros.vocabulary.sample import quaternions
from derail_ros.vocabulary.scene import car_corners
from derail_ros.vocabulary.shapes import Part, gravity_height, kind_of, parts
from derail_ros.vocabulary.site import in_plane, zone_slope

if TYPE_CHECKING:
    from derail_ros.recording.recorded_run import RecordedRun

F64 = NDArray[np.float64]

COLOURS = ((0.42, 0.47, 0.53), (0.90, 0.62, 0.0), (0.84, 0.37, 0.0))
"""Of cars on the rails, derailed and coupled, derailed and uncoupled."""
RAIL_COLOUR = (0.35, 0.33, 0.32)
GROUND_COLOUR = (0.72, 0.70, 0.64)
BED_COLOUR = (0.60, 0.58, 0.55)
WALL_COLOUR = (0.55, 0.52, 0.50)
SLOPE_COLOUR = (0.60, 0.62, 0.50)
WALL_THICK = 0.3
"""Of fixed bodies as they are drawn, m."""


@dataclass(frozen=True)
class Body:
    """A car: number, mass (kg), inertia (kg m^2, about its axes) and shapes in its frame."""

    number: int
    name: str
    mass: float
    inertia: tuple[float, float, float]
    parts: list[Part]
    height: float  # of its centre over the rail at rest, m


def bodies(run: RecordedRun) -> list[Body]:
    """The cars of a run; a stand-in for many is shown as one."""
    cars = run.cars
    found = []
    for i, name in enumerate(cars.name):
        kind = kind_of(f"{name} {cars.kind[i]}")
        mass = float(cars.mass[i] / cars.represents[i])
        told = float(cars.gravity_height[i])
        height = gravity_height(kind, mass) if np.isnan(told) else told
        shape = parts(kind, height, float(cars.length[i]), float(cars.width[i]),
                      float(cars.truck[i]))  # fmt: skip
        x, y, z = (size * size for size in shape[0].size)
        inertia = (mass * (y + z) / 12.0, mass * (x + z) / 12.0, mass * (x + y) / 12.0)
        found.append(Body(i + 1, name, mass, inertia, shape, height))
    return found


def places(run: RecordedRun, found: list[Body], time: float) -> tuple[F64, F64]:
    """Places (N, 3) of the centres of gravity, m, and turns (N, 4) w, x, y, z at a time (s)."""
    pose = run.pose_at(time)
    place = pose[:, :3] + np.outer([body.height for body in found], [0.0, 0.0, 1.0])
    return place, quaternions(pose)[:, [3, 0, 1, 2]]


def rails(run: RecordedRun, left: float, right: float) -> F64:
    """Pieces of the rails of all tracks, the main one between two coordinates: (pieces, 2, 3)."""
    s = np.arange(left, right + 5.0, 5.0)
    points = np.array([run.line.point(float(at)) for at in s])
    return np.concatenate(
        [_rails(points[:, :2], points[:, 2])]
        + [_rails(line, _headings(line)) for line in second_tracks(run)]
    )


def second_tracks(run: RecordedRun) -> list[F64]:
    """Centre lines (K, 2) of the second tracks, m."""
    return [shape.points for shape in run.site.shapes(run.line) if shape.role == "track"]


def _headings(line: F64) -> F64:
    return np.asarray(np.arctan2(*np.gradient(line, axis=0).T[::-1]))


def _rails(points: F64, heading: F64) -> F64:
    """Pieces of the two rails beside a line of places (K, 2) and headings (rad)."""
    normal = np.stack([-np.sin(heading), np.cos(heading)], axis=-1)
    found = []
    for side in (shapes.HALF_GAUGE, -shapes.HALF_GAUGE):
        xy = points + side * normal
        line = np.column_stack([xy, np.full(len(xy), -0.5 * shapes.RAIL_HEIGHT)])
        found.append(np.stack([line[:-1], line[1:]], axis=1))
    return np.concatenate(found)


@dataclass(frozen=True)
class Slab:
    """A box of the track bed: length, width, height; its middle (m); roll and yaw (rad)."""

    size: tuple[float, float, float]
    at: tuple[float, float, float]
    roll: float
    yaw: float

    @property
    def turn(self) -> F64:
        """As a quaternion w, x, y, z."""
        cr, sr = np.cos(0.5 * self.roll), np.sin(0.5 * self.roll)
        cy, sy = np.cos(0.5 * self.yaw), np.sin(0.5 * self.yaw)
        return np.array([cy * cr, cy * sr, sy * sr, sy * cr])


def bed(run: RecordedRun, left: float, right: float) -> list[Slab]:
    """The bed of the main track between two coordinates (m), and of the others: tops and sides.

    Only where the model has one: cars of the planar model lie at the height of the rails.
    """
    if run.model == PLANAR:
        return []
    tall, slope = shapes.BED_HEIGHT, shapes.BED_SLOPE
    lean, thick, wide = np.arctan(slope), 0.4, tall * np.hypot(1.0, 1.0 / slope)
    # a side's upper face joins the edges of the top and of the ground
    off = shapes.BED_HALF_WIDTH + 0.5 * (tall / slope - thick * np.sin(lean))
    middle = -shapes.RAIL_HEIGHT - 0.5 * tall
    parts = [(2.0 * shapes.BED_HALF_WIDTH, tall, 0.0, middle, 0.0)]
    parts += [
        (wide, thick, side * off, middle - 0.5 * thick * np.cos(lean), -side * lean)
        for side in (1.0, -1.0)
    ]
    pieces = 1 if run.line.straight else max(1, round((right - left) / 10.0))
    ends = [run.line.point(float(s))[:2] for s in np.linspace(left, right, pieces + 1)]
    found = []
    chords = list(zip(ends, ends[1:], strict=False))
    for line in second_tracks(run):
        chords += zip(line.tolist(), line.tolist()[1:], strict=False)
    for (ax, ay), (bx, by) in chords:
        yaw, length = np.arctan2(by - ay, bx - ax), np.hypot(bx - ax, by - ay)
        for width, height, aside, z, roll in parts:
            x = 0.5 * (ax + bx) - aside * np.sin(yaw)
            y = 0.5 * (ay + by) + aside * np.cos(yaw)
            size = (float(length), float(width), float(height))
            found.append(Slab(size, (float(x), float(y), float(z)), float(roll), float(yaw)))
    return found


def ground_level(run: RecordedRun) -> float:
    """Height of the ground beside the track over the rail, m."""
    return -shapes.RAIL_HEIGHT - (0.0 if run.model == PLANAR else shapes.BED_HEIGHT)


def walls(run: RecordedRun) -> list[Slab]:
    """Fixed bodies: an upright slab along each edge."""
    found = []
    for shape in run.site.shapes(run.line):
        if shape.role != "fixed":
            continue
        ends = shape.points.tolist()
        if shape.closed:
            ends.append(ends[0])
        z = ground_level(run) + 0.5 * shape.height
        for (ax, ay), (bx, by) in zip(ends, ends[1:], strict=False):
            yaw, length = np.arctan2(by - ay, bx - ax), np.hypot(bx - ax, by - ay)
            size = (float(length), WALL_THICK, shape.height)
            found.append(Slab(size, (0.5 * (ax + bx), 0.5 * (ay + by), z), 0.0, float(yaw)))
    return found


def entered(slab: Slab, cars: F64) -> bool:
    """One of the outlines (N, 4, 2) of cars and the slab's share a place."""
    size = np.array([slab.size[:2]])
    own = car_corners(np.array([[*slab.at[:2], slab.yaw]]), size[:, 0], size[:, 1])[0]
    for corners in cars:
        apart = False
        for shape in (own, corners):
            for axis in (shape[0] - shape[1], shape[0] - shape[2]):
                p, q = own @ axis, corners @ axis
                apart = apart or p.max() < q.min() or q.max() < p.min()
        if not apart:
            return True
    return False


def slopes(run: RecordedRun) -> list[F64]:
    """Zones that rise over the ground, as wedges (6, 3): a triangle on the ground, one above it.

    Only where the model follows heights. What lies below the ground is left out.
    """
    found: list[F64] = []
    if run.model == PLANAR:
        return found
    ground = ground_level(run)
    for zone in run.site.zones:
        slope = zone_slope(zone, run.line, run.site.border)
        if slope.highest <= 0.0:
            continue
        for corners in _triangles(in_plane(zone, run.line)):
            rise = np.maximum(corners @ np.array(zone.rise) - slope.base, 0.0)
            if rise.max() > 0.05:
                low = np.column_stack([corners, np.full(3, ground - 0.1)])
                found.append(
                    np.concatenate([low, low + [0.0, 0.0, 0.1] + np.outer(rise, [0, 0, 1])])
                )
    return found


WEDGE = np.array([
    (0, 2, 1), (3, 4, 5), (0, 1, 4), (0, 4, 3), (1, 2, 5), (1, 5, 4), (2, 0, 3), (2, 3, 5)
])  # fmt: skip
"""Triangles of a wedge, seen from outside, by its corners."""


def _triangles(outline: F64) -> list[F64]:
    """A polygon cut into triangles (3, 2), ear by ear, each counter-clockwise."""
    x, y = outline.T
    if (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() < 0.0:
        outline = outline[::-1]
    left = outline.tolist()
    found = []

    def turn(a: Any, b: Any, c: Any) -> float:
        return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))

    while len(left) > 3:
        for k in range(len(left)):
            a, b, c = left[k - 1], left[k], left[(k + 1) % len(left)]
            inside = any(
                min(turn(a, b, p), turn(b, c, p), turn(c, a, p)) >= 0.0
                for p in left
                if p not in (a, b, c)
            )
            if turn(a, b, c) > 0.0 and not inside:
                found.append(np.array([a, b, c]))
                del left[k]
                break
        else:
            break  # only slivers are left
    return [*found, np.array(left[:3])]


def _text(*values: float) -> str:
    return " ".join(f"{float(v):.9g}" for v in values)


@dataclass(frozen=True)
class World:
    """A moment of a run in space."""

    title: str
    time: float
    bodies: list[Body]
    place: F64
    turn: F64
    free: NDArray[np.bool_]
    state: NDArray[np.int64]
    rails: F64
    bed: list[Slab]
    ground: float  # height over the rail, m
    friction: float
    walls: list[Slab]
    slopes: list[F64]

    @classmethod
    def of(cls, run: RecordedRun, time: float) -> World:
        """The world at a time (s)."""
        scene = scene_at(run, time)
        found = bodies(run)
        place, turn = places(run, found, time)
        ground = run.scenario.get("ground", {})
        default = GroundParams()
        friction = ground.get("c_d", default.c_d) * ground.get("scale", default.scale)
        along = [run.line.locate(float(x), float(y))[0] for x, y in place[:, :2]]
        first, last = min(along) - 20.0, max(along) + 40.0
        outlines = car_corners(scene.pose, scene.length, scene.width + shapes.WIDER)
        return cls(
            title=run.title, time=time, bodies=found, place=place, turn=turn,
            free=scene.derailed & (run.cars.represents == 1), state=scene.state,
            rails=rails(run, first, last), bed=bed(run, first, last), ground=ground_level(run),
            friction=float(friction), slopes=slopes(run),
            # an edge into which a car has gone would throw it out
            walls=[slab for slab in walls(run) if not entered(slab, outlines)],
        )  # fmt: skip

    # --- formats -----------------------------------------------------------------------------

    def mjcf(self, moved: bool = False) -> str:
        """As a MuJoCo model; ``moved``: cars are placed from outside (to draw them)."""
        root = ET.Element("mujoco", model="wreck")
        ET.SubElement(root, "compiler", angle="radian", eulerseq="xyz")
        ET.SubElement(root, "option", timestep="0.002", gravity=_text(0, 0, -GRAVITY),
                      cone="elliptic", integrator="implicitfast")  # fmt: skip
        ET.SubElement(root, "statistic", extent="60", center=_text(*self.place.mean(axis=0)))
        visual = ET.SubElement(root, "visual")
        ET.SubElement(visual, "global", offwidth="3840", offheight="2160")
        ET.SubElement(visual, "quality", shadowsize="8192", offsamples="4")
        ET.SubElement(visual, "map", znear="0.02", zfar="10", shadowclip="1.5")
        ET.SubElement(visual, "headlight", ambient="0.45 0.45 0.45", diffuse="0.25 0.25 0.25",
                      specular="0 0 0")  # fmt: skip
        ET.SubElement(visual, "rgba", haze="0.93 0.95 0.97 1")
        assets = ET.SubElement(root, "asset")
        ET.SubElement(assets, "texture", type="skybox", builtin="gradient", width="256",
                      height="256", rgb1="0.93 0.95 0.97", rgb2="0.55 0.68 0.82")  # fmt: skip
        default = ET.SubElement(root, "default")
        ET.SubElement(default, "geom", friction=_text(shapes.CAR_FRICTION, 0.005, 0.0001))
        world = ET.SubElement(root, "worldbody")
        off = self.place[self.free] if self.free.any() else self.place
        x, y = off[:, :2].mean(axis=0)
        ET.SubElement(world, "light", directional="true", pos=_text(x + 32.0, y - 40.0, 80.0),
                      dir="-0.4 0.5 -1", diffuse="0.6 0.6 0.6", specular="0 0 0")  # fmt: skip
        earth = {
            "priority": "1", "friction": _text(self.friction, 0.005, 0.0001),
            "solref": _text(-shapes.GROUND_STIFFNESS, -shapes.GROUND_DAMPING),
        }  # fmt: skip
        ET.SubElement(
            world, "geom", name="ground", type="plane", size="0 0 1",
            pos=_text(x, y, self.ground), rgba=_text(*GROUND_COLOUR, 1), **earth,
        )  # fmt: skip
        slabs = [(f"bed {k}", slab, BED_COLOUR) for k, slab in enumerate(self.bed)]
        slabs += [(f"wall {k}", slab, WALL_COLOUR) for k, slab in enumerate(self.walls)]
        for name, slab, colour in slabs:
            ET.SubElement(
                world, "geom", name=name, type="box", pos=_text(*slab.at),
                quat=_text(*slab.turn), size=_text(*(0.5 * v for v in slab.size)),
                rgba=_text(*colour, 1), **earth,
            )  # fmt: skip
        for k, wedge in enumerate(self.slopes):
            middle = wedge.mean(axis=0)
            ET.SubElement(
                assets, "mesh", name=f"slope {k}", vertex=_text(*(wedge - middle).ravel())
            )
            ET.SubElement(
                world, "geom", name=f"slope {k}", type="mesh", mesh=f"slope {k}",
                pos=_text(*middle), rgba=_text(*SLOPE_COLOUR, 1), **earth,
            )  # fmt: skip
        for k, (start, end) in enumerate(self.rails):
            ET.SubElement(
                world, "geom", name=f"rail {k}", type="capsule", fromto=_text(*start, *end),
                size=_text(0.5 * shapes.RAIL_HEIGHT), contype="0", conaffinity="0",
                rgba=_text(*RAIL_COLOUR, 1),
            )  # fmt: skip
        for body, place, turn, free, state in self._rows():
            element = ET.SubElement(world, "body", name=f"car {body.number}", pos=_text(*place),
                                    quat=_text(*turn))  # fmt: skip
            if moved:
                element.set("mocap", "true")
            elif free:
                ET.SubElement(element, "freejoint")
            ET.SubElement(element, "inertial", pos="0 0 0", mass=_text(body.mass),
                          diaginertia=_text(*body.inertia))  # fmt: skip
            soft = _text(*(-value for value in shapes.contact_response(body.mass)))
            for part in body.parts:
                half = [0.5 * size for size in part.size]
                geom = ET.SubElement(
                    element, "geom", name=f"{part.name} {body.number}", pos=_text(*part.at),
                    solref=soft, rgba=_text(*COLOURS[state], 1),
                )  # fmt: skip
                geom.set("type", "capsule" if part.capsule else "box")
                geom.set("size", _text(half[2], half[0] - half[2]) if part.capsule
                         else _text(*half))  # fmt: skip
                if part.capsule:
                    geom.set("euler", _text(0.0, 0.5 * np.pi, 0.0))
                if part.name != "body":
                    geom.set("rgba", "0.16 0.16 0.17 1")
        ET.indent(root)
        return ET.tostring(root, encoding="unicode") + "\n"

    def _rows(self) -> Any:
        return zip(self.bodies, self.place, self.turn, self.free, self.state, strict=True)

    def sdf(self) -> str:
        """As an SDFormat 1.9 world."""
        root = ET.Element("sdf", version="1.9")
        world = ET.SubElement(root, "world", name="wreck")
        physics = ET.SubElement(world, "physics", name="steps", type="ode")
        rates = {"max_step_size": 0.002, "real_time_factor": 1, "real_time_update_rate": 500}
        for key, rate in rates.items():
            ET.SubElement(physics, key).text = _text(rate)
        ET.SubElement(world, "gravity").text = _text(0, 0, -GRAVITY)
        ET.SubElement(world, "magnetic_field").text = "0 0 0"
        ET.SubElement(world, "atmosphere", type="adiabatic")
        scene = ET.SubElement(world, "scene")
        for key, value in (("ambient", "0.4 0.4 0.4 1"), ("background", "0.7 0.8 0.9 1")):
            ET.SubElement(scene, key).text = value
        ET.SubElement(scene, "shadows").text = "true"
        light = ET.SubElement(world, "light", name="sun", type="directional")
        ET.SubElement(light, "pose").text = "0 0 80 0 0 0"
        ET.SubElement(light, "direction").text = "-0.4 0.5 -1"
        ground = self._model(world, "ground", (0, 0, self.ground), (1, 0, 0, 0), True)
        geometry = ET.Element("geometry")
        plane = ET.SubElement(geometry, "plane")
        ET.SubElement(plane, "normal").text = "0 0 1"
        ET.SubElement(plane, "size").text = "2000 2000"
        self._shape(ground, "ground", geometry, None, self.friction, GROUND_COLOUR)
        slabs = [(f"bed_{k}", slab, BED_COLOUR) for k, slab in enumerate(self.bed)]
        slabs += [(f"wall_{k}", slab, WALL_COLOUR) for k, slab in enumerate(self.walls)]
        for name, slab, colour in slabs:
            box = ET.Element("geometry")
            ET.SubElement(ET.SubElement(box, "box"), "size").text = _text(*slab.size)
            at = np.subtract(slab.at, (0.0, 0.0, self.ground))
            pose = _text(*at, slab.roll, 0.0, slab.yaw)
            self._shape(ground, name, box, pose, self.friction, colour)
        for body, place, turn, free, state in self._rows():
            link = self._model(world, f"car_{body.number}", place, turn, not free)
            inertial = ET.SubElement(link, "inertial")
            ET.SubElement(inertial, "mass").text = _text(body.mass)
            inertia = ET.SubElement(inertial, "inertia")
            values = (*body.inertia, 0.0, 0.0, 0.0)
            for name, value in zip(("ixx", "iyy", "izz", "ixy", "ixz", "iyz"), values):
                ET.SubElement(inertia, name).text = _text(value)
            for part in body.parts:
                geometry = ET.Element("geometry")
                turned = 0.0
                if part.capsule:
                    turned = 0.5 * np.pi
                    shape = ET.SubElement(geometry, "capsule")
                    ET.SubElement(shape, "radius").text = _text(0.5 * part.size[2])
                    ET.SubElement(shape, "length").text = _text(part.size[0] - part.size[2])
                else:
                    shape = ET.SubElement(geometry, "box")
                    ET.SubElement(shape, "size").text = _text(*part.size)
                at = _text(*part.at, 0.0, turned, 0.0)
                colour = COLOURS[state] if part.name == "body" else (0.16, 0.16, 0.17)
                name = part.name.replace(" ", "_")
                self._shape(link, name, geometry, at, shapes.CAR_FRICTION, colour)
        ET.indent(root)
        return '<?xml version="1.0"?>\n' + ET.tostring(root, encoding="unicode") + "\n"

    def _model(
        self, world: ET.Element, name: str, place: Any, turn: Any, fixed: bool
    ) -> ET.Element:
        """Add a model of one link, and return the link."""
        w, x, y, z = turn
        roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
        yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        model = ET.SubElement(world, "model", name=name)
        ET.SubElement(model, "static").text = str(bool(fixed)).lower()
        ET.SubElement(model, "pose").text = _text(*place, roll, pitch, yaw)
        return ET.SubElement(model, "link", name="link")

    def _shape(
        self, link: ET.Element, name: str, geometry: ET.Element, at: str | None, friction: float,
        colour: Any,
    ) -> None:  # fmt: skip
        """Add a shape that collides and is seen."""
        collision = ET.SubElement(link, "collision", name=f"{name}_collision")
        visual = ET.SubElement(link, "visual", name=f"{name}_visual")
        for element in (collision, visual):
            if at is not None:
                ET.SubElement(element, "pose").text = at
            element.append(geometry)
        ode = ET.SubElement(ET.SubElement(ET.SubElement(collision, "surface"), "friction"), "ode")
        for key in ("mu", "mu2"):
            ET.SubElement(ode, key).text = _text(friction)
        material = ET.SubElement(visual, "material")
        for key in ("ambient", "diffuse"):
            ET.SubElement(material, key).text = _text(*colour, 1)

    def gltf(self) -> bytes:
        """As binary glTF (needs trimesh, which comes with viser); y is up, as glTF has it."""
        import trimesh

        scene = trimesh.Scene()
        up = trimesh.transformations.rotation_matrix(-0.5 * np.pi, [1, 0, 0])
        for body, place, turn, _, state in self._rows():
            matrix = trimesh.transformations.quaternion_matrix(turn)
            matrix[:3, 3] = place
            for part in body.parts:
                mesh = part_mesh(part)
                colour = COLOURS[state] if part.name == "body" else (0.16, 0.16, 0.17)
                mesh.visual.face_colors = [*(255.0 * np.array(colour)), 255]
                name = f"car {body.number} {part.name}"
                scene.add_geometry(mesh, node_name=name, geom_name=name, transform=up @ matrix)
        low, high = self.place[:, :2].min(axis=0) - 60.0, self.place[:, :2].max(axis=0) + 60.0
        ground = trimesh.creation.box(extents=[*(high - low), 0.1])
        ground.visual.face_colors = [*(255.0 * np.array(GROUND_COLOUR)), 255]
        at = trimesh.transformations.translation_matrix(
            [*(0.5 * (low + high)), self.ground - 0.05]
        )
        scene.add_geometry(ground, node_name="ground", geom_name="ground", transform=up @ at)
        slabs = [(f"bed {k}", slab, BED_COLOUR) for k, slab in enumerate(self.bed)]
        slabs += [(f"wall {k}", slab, WALL_COLOUR) for k, slab in enumerate(self.walls)]
        for name, slab, colour in slabs:
            mesh = trimesh.creation.box(extents=slab.size)
            mesh.visual.face_colors = [*(255.0 * np.array(colour)), 255]
            at = trimesh.transformations.quaternion_matrix(slab.turn)
            at[:3, 3] = slab.at
            scene.add_geometry(mesh, node_name=name, geom_name=name, transform=up @ at)
        for k, wedge in enumerate(self.slopes):
            mesh = trimesh.Trimesh(wedge, WEDGE)
            mesh.visual.face_colors = [*(255.0 * np.array(SLOPE_COLOUR)), 255]
            name = f"slope {k}"
            scene.add_geometry(mesh, node_name=name, geom_name=name, transform=up)
        return bytes(scene.export(file_type="glb"))


def part_mesh(part: Part) -> Any:
    """A shape as triangles (trimesh), in the car's frame."""
    import trimesh

    if part.capsule:
        radius = 0.5 * part.size[2]
        mesh = trimesh.creation.capsule(height=part.size[0] - part.size[2], radius=radius,
                                        count=[24, 24])  # fmt: skip
        # trimesh's capsule stands on the z axis; centred here
        mesh.apply_translation(-mesh.bounds.mean(axis=0))
        mesh.apply_transform(trimesh.transformations.rotation_matrix(0.5 * np.pi, [0, 1, 0]))
    else:
        mesh = trimesh.creation.box(extents=part.size)
    mesh.apply_translation(part.at)
    return mesh


FORMATS = {"mjcf": ".xml", "sdf": ".sdf", "gltf": ".glb"}
"""Formats of a world and the ends of their files' names."""


def write(world: World, form: str, path: Path) -> None:
    """Write a world in a format of :data:`FORMATS`."""
    content = {"mjcf": world.mjcf, "sdf": world.sdf, "gltf": world.gltf}[form]()
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        path.write_text(content, encoding="utf-8")
