"""Markers for RViz, Foxglove and their like.

Three colours of the palette of Okabe and Ito, told apart with any colour vision, and the label of
each car says the same in words. Identities are stable: the car, its label and its force arrow have
the car's number as id in the namespaces ``cars``, ``labels`` and ``contact_forces``.

Serialising some hundred markers takes milliseconds, so the bytes of a message are kept and only
poses, colours, points and actions are renewed in place; the message is laid out anew only when a
label changes or a coupling parts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from derail_ros.vocabulary.params import TrainParams
from msg_adapters.car_frame import heights, places
from msg_adapters.common import (
    NANOSECONDS,
    SENTINEL,
    SENTINEL_SECONDS,
    RunContext,
    SentinelContext,
)
from msg_adapters.definitions import message_class, serialize, typestore

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from derail_ros.vocabulary.sample import Sample
    from derail_ros.vocabulary.site import Shape

ARROW, CUBE, LINE_STRIP, LINE_LIST, TEXT, TRIANGLE_LIST = 0, 1, 4, 5, 9, 11
ADD, DELETE, DELETE_ALL = 0, 2, 3

BLUE = (0.0, 0.447, 0.698)
GREEN = (0.0, 0.62, 0.451)
ORANGE = (0.902, 0.624, 0.0)
VERMILION = (0.835, 0.369, 0.0)
PURPLE = (0.8, 0.475, 0.655)
BLACK = (0.05, 0.05, 0.05)
WHITE = (1.0, 1.0, 1.0)
BALLAST = (0.55, 0.53, 0.5)
CONCRETE = (0.42, 0.38, 0.35)
SOIL = (0.48, 0.42, 0.25)

ON_RAILS, STANDING, DERAILED, STRUCK_HARD = BLUE, GREEN, ORANGE, VERMILION

HARD = 5.0e6
"""Force at a single corner known to rupture a tank car, N."""
CAR_HEIGHT, CAR_FLOOR = 3.2, 0.9
"""Drawn height of a car body and of its floor above the rails, m (the model is planar)."""
COUPLER_HEIGHT = 1.0
FORCE_SCALE = 1.0e-6
"""Length of a force arrow, m/N: a metre a meganewton."""
FORCE_SHOWN = 1.0e4
"""Smallest force that gets an arrow, N."""
FILLED = (1.0, 1.0, 1.0)
"""Scale of triangles."""
NAME_HEIGHT = 3.5
"""Least height of the names of what stands beside the track, m."""
GAUGE = 1.435
BED_WIDTH = 4.0

_ACTION = 0x7A5C3E11
"""Marks, in a new layout, the actions that are renewed."""


def _marker(
    context: RunContext,
    time: float,
    namespace: str,
    number: int,
    kind: int,
    color: tuple[float, float, float] = WHITE,
    *,
    action: int = ADD,
    position: Sequence[float] = (0.0, 0.0, 0.0),
    rotation: tuple[float, float] = (0.0, 1.0),
    scale: Sequence[float] = (0.0, 0.0, 0.0),
    points: Sequence[Sequence[float]] = (),
    text: str = "",
    alpha: float = 1.0,
) -> Any:
    """One ``visualization_msgs/Marker``."""
    point = message_class("geometry_msgs/msg/Point")
    vector = message_class("geometry_msgs/msg/Vector3")
    quaternion = message_class("geometry_msgs/msg/Quaternion")
    pose = message_class("geometry_msgs/msg/Pose")
    rgba = message_class("std_msgs/msg/ColorRGBA")
    duration = message_class("builtin_interfaces/msg/Duration")
    image = message_class("sensor_msgs/msg/CompressedImage")
    mesh = message_class("visualization_msgs/msg/MeshFile")
    head = context.header(time)
    return message_class("visualization_msgs/msg/Marker")(
        header=head,
        ns=namespace,
        id=number,
        type=kind,
        action=action,
        pose=pose(
            point(*(float(p) for p in position)),
            quaternion(0.0, 0.0, float(rotation[0]), float(rotation[1])),
        ),
        scale=vector(*(float(s) for s in scale)),
        color=rgba(*color, alpha),
        lifetime=duration(0, 0),
        frame_locked=False,
        points=[point(*(float(c) for c in p)) for p in points],
        colors=[],
        texture_resource="",
        texture=image(head, "", np.zeros(0, dtype=np.uint8)),
        uv_coordinates=[],
        text=text,
        mesh_resource="",
        mesh_file=mesh("", np.zeros(0, dtype=np.uint8)),
        mesh_use_embedded_materials=False,
    )


def _array(markers: list[Any]) -> bytes:
    return serialize(message_class("visualization_msgs/msg/MarkerArray")(markers))


def _from(places: Sequence[int], count: int) -> NDArray[np.int64]:
    """(M, count) indices: each place and those after it."""
    return np.asarray(places, dtype=np.int64)[:, None] + np.arange(count)


def clear(context: RunContext, time: float = 0.0) -> bytes:
    """A ``MarkerArray`` that clears everything shown before."""
    return _array([_marker(context, time, "", 0, CUBE, action=DELETE_ALL)])


@dataclass(frozen=True)
class _Piece:
    """The bytes of one marker and where in them its changing parts are."""

    data: bytes
    doubles: tuple[int, ...]
    seconds: tuple[int, ...]
    actions: tuple[int, ...]


def _piece(marker: Any, phase: int) -> _Piece:
    """Serialise a marker that begins ``phase`` bytes (0 or 4) after a multiple of eight."""
    store = typestore()
    definition = store.get_msgdef("visualization_msgs/msg/Marker")
    end = definition.getsize_cdr(phase, marker, store)
    data = bytearray(end + -end % 8)
    definition.serialize_cdr_le(memoryview(data), phase, marker, store)
    doubles, words = np.frombuffer(data, "<f8"), np.frombuffer(data, "<u4")

    def places(found: NDArray[np.bool_], size: int) -> tuple[int, ...]:
        return tuple((size * np.flatnonzero(found) - phase).tolist())

    return _Piece(
        bytes(data[phase:end]),
        places(doubles == SENTINEL, 8),
        places(words == SENTINEL_SECONDS, 4),
        places(words == _ACTION, 4),
    )


class MarkerEncoder:
    """``markers`` of a run: cars, labels, couplings and contact forces.

    ``pieces`` of an earlier run of the same train in the same frame are used again.
    """

    def __init__(
        self,
        params: TrainParams,
        context: RunContext,
        pieces: dict[tuple[Any, ...], _Piece] | None = None,
    ) -> None:
        cars = params.cars
        self.context = context
        self._n = len(cars)
        self._length = np.array([car.length for car in cars])
        self._width = np.array([car.width for car in cars])
        self._height = heights(cars)
        self._represents = [car.represents for car in cars]
        self._standing = np.array(params.cut_numbers) > 0
        self._pivot = np.array([car.pivot_distance for car in cars])
        self._layout: tuple[Any, ...] = ()
        self._labelled: tuple[bytes, tuple[str, ...]] = (b"", ())
        self._pieces: dict[tuple[Any, ...], _Piece] = {} if pieces is None else pieces
        self._data = bytearray()

    def _labels(self, derailed: NDArray[np.bool_], peak: NDArray[np.float64]) -> tuple[str, ...]:
        known = derailed.tobytes() + peak.tobytes()
        if known == self._labelled[0]:
            return self._labelled[1]
        labels = []
        for i in range(self._n):
            lines = [str(i + 1)]
            if self._represents[i] > 1:
                lines[0] += f" ({self._represents[i]} cars)"
            if self._standing[i]:
                lines[0] += " (not of the train)"
            if derailed[i]:
                lines.append("off")
            if peak[i] > HARD:
                lines.append(f"{peak[i] / 1e6:.0f} MN")
            labels.append("\n".join(lines))
        self._labelled = known, tuple(labels)
        return self._labelled[1]

    def _make(self, what: str, number: int, detail: Any) -> Any:
        """A marker with marks where its changing parts will be."""
        mark = (SENTINEL, 0.0, 0.0)
        context = SentinelContext("", 0, self.context.frame_id)
        if what == "clear":
            return _marker(context, 0.0, "", 0, CUBE, action=DELETE_ALL)
        if what == "cars":
            size = (self._length[number - 1], self._width[number - 1], CAR_HEIGHT)
            return _marker(context, 0.0, what, number, CUBE, position=mark, scale=size)
        if what == "labels":
            return _marker(
                context, 0.0, what, number, TEXT, position=mark, scale=(0.0, 0.0, 2.0), text=detail
            )
        if what == "contact_forces":
            return _marker(
                context,
                0.0,
                what,
                number,
                ARROW,
                PURPLE,
                action=_ACTION,
                scale=(0.35, 0.8, 0.8),
                points=(mark, mark),
            )
        return _marker(
            context,
            0.0,
            "couplers",
            0,
            LINE_LIST,
            BLACK,
            action=ADD if detail else DELETE,  # RViz complains of a list without points
            scale=(0.35, 0.0, 0.0),
            points=[mark] * (2 * detail),
        )

    def _lay_out(self, labels: tuple[str, ...], coupled: bytes, reset: bool) -> None:
        """Put the message together from pieces and note where its changing parts are."""
        numbers = range(1, self._n + 1)
        content: list[tuple[str, int, Any]] = [
            *([("clear", 0, None)] if reset else []),
            *(("cars", i, None) for i in numbers),
            *(("labels", i, text) for i, text in zip(numbers, labels)),
            *(("contact_forces", i, None) for i in numbers),
            ("couplers", 0, sum(coupled)),
        ]
        # Places count from the end of the encapsulation header, as alignment does.
        chunks = [len(content).to_bytes(4, "little")]
        at = 4
        doubles: dict[str, list[int]] = {}
        seconds: list[int] = []
        actions: list[int] = []
        for item in content:
            key = (*item, at % 8)
            piece = self._pieces.get(key)
            if piece is None:
                piece = self._pieces[key] = _piece(self._make(*item), at % 8)
            doubles.setdefault(item[0], []).extend((at + d) // 8 for d in piece.doubles)
            seconds.extend((at + w) // 4 for w in piece.seconds)
            actions.extend((at + w) // 4 for w in piece.actions)
            padding = -len(piece.data) % 4 if item is not content[-1] else 0
            chunks += [piece.data, bytes(padding)]
            at += len(piece.data) + padding
        data = bytearray(b"".join([b"\x00\x01\x00\x00", *chunks, bytes(-at % 8)]))
        self._data = data
        self._size = 4 + at
        self._doubles = np.frombuffer(data, "<f8", offset=4)
        self._singles = np.frombuffer(data, "<f4", offset=4)
        self._words = np.frombuffer(data, "<u4", offset=4)
        self._cars = _from(doubles["cars"], 7)
        self._text = _from(doubles["labels"], 3)
        self._arrows = _from(doubles["contact_forces"], 3).reshape(self._n, 2, 3)
        self._links = doubles["couplers"][0] if doubles["couplers"] else 0
        self._link_count = sum(coupled)
        self._seconds = np.array(seconds)
        self._actions = np.array(actions)
        # A marker's pose and scale are ten doubles; its colour follows as four floats.
        self._colors = _from([2 * (at + 10) for at in doubles["cars"]], 3)
        self._layout = (labels, coupled, reset)

    def __call__(self, sample: Sample, peak: NDArray[np.float64], *, reset: bool = False) -> bytes:
        """CDR bytes of ``visualization_msgs/MarkerArray``.

        ``peak`` is the largest force (N) at a single corner of each car so far; ``reset`` puts a
        DELETEALL in front.
        """
        derailed = (sample.truck_on == 0).any(axis=1)
        labels = self._labels(derailed, peak)
        coupled = sample.coupled.astype(np.uint8).tobytes()
        if self._layout != (labels, coupled, reset):
            self._lay_out(labels, coupled, reset)
        d, place = self._doubles, sample.pose[:, :3]
        box, label = np.empty((self._n, 7)), np.empty((self._n, 3))
        box[:, :3] = places(sample.pose, self._height, CAR_FLOOR + 0.5 * CAR_HEIGHT)
        box[:, 3:] = sample.quaternions
        label[:] = place + (0.0, 0.0, CAR_FLOOR + CAR_HEIGHT + 1.5)
        d[self._cars], d[self._text] = box, label
        kind = np.where(peak > HARD, 2, np.where(derailed, 1, np.where(self._standing, 3, 0)))
        colors = np.array([ON_RAILS, DERAILED, STRUCK_HARD, STANDING])
        self._singles[self._colors] = colors[kind]

        force = sample.collision_force
        shown = np.hypot(force[:, 0], force[:, 1]) > FORCE_SHOWN
        # The arrow ends at the car that feels the force.
        arrows = np.empty((self._n, 2, 3))
        arrows[:, 0, :2], arrows[:, 1, :2] = place[:, :2] - FORCE_SCALE * force, place[:, :2]
        arrows[:, :, 2] = place[:, 2:] + CAR_FLOOR + CAR_HEIGHT + 0.4
        d[self._arrows] = arrows
        words = self._words
        words[self._actions] = np.where(shown, ADD, DELETE)

        if self._link_count:
            points = self._coupler_points(sample)
            d[self._links : self._links + points.size] = points.ravel()

        stamp = divmod(self.context.stamp(sample.time), NANOSECONDS)
        words[self._seconds], words[self._seconds + 1] = stamp
        return bytes(memoryview(self._data)[: self._size])

    def _coupler_points(self, sample: Sample) -> NDArray[np.float64]:
        """(2 C, 3) pivots joined by the couplings that hold, m."""
        held, pose, height = np.flatnonzero(sample.coupled), sample.pose, self._height
        points = np.empty((len(held), 2, 3))
        for end, (cars, sign) in enumerate(((held, -1.0), (held + 1, 1.0))):
            points[:, end] = places(
                pose[cars], height[cars], COUPLER_HEIGHT, sign * self._pivot[cars]
            )
        return points.reshape(-1, 3)


def _ribbon(line: NDArray[np.float64], half: float, z: float) -> tuple[NDArray[np.float64], ...]:
    """Lines ``half`` to the left and to the right of one (K, 3: x, y, heading), at a height, m."""
    x, y, heading = line.T
    nx, ny = -np.sin(heading), np.cos(heading)
    left, right = (
        np.stack([x + d * nx, y + d * ny, np.full_like(x, z)], axis=1) for d in (half, -half)
    )
    return left, right


def _strip(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Triangles (6 (K - 1), 3) that fill what lies between two lines."""
    quads = np.stack([a[:-1], b[:-1], a[1:], a[1:], b[:-1], b[1:]], axis=1)
    return quads.reshape(-1, 3)


def _rails(
    context: RunContext, time: float, line: NDArray[np.float64], names: tuple[str, str], first: int
) -> list[Any]:
    """Bed and rails of a track (K, 3: x, y, heading), the latter numbered from ``first``."""
    bed = _strip(*_ribbon(line, 0.5 * BED_WIDTH, -0.2))
    parts: list[Any] = [(names[0], first // 2, TRIANGLE_LIST, BALLAST, FILLED, bed)]
    for k, rail in enumerate(_ribbon(line, 0.5 * GAUGE, 0.0)):
        parts.append((names[1], first + k, LINE_STRIP, BLACK, (0.15, 0.0, 0.0), rail))
    return [_marker(context, time, *part[:4], scale=part[4], points=part[5]) for part in parts]


def _site_markers(context: RunContext, time: float, shapes: Sequence[Shape]) -> list[Any]:
    """What stands beside the track, with its name: second tracks, walls, outlines of ground."""
    found = []
    for number, shape in enumerate(shapes):
        points = shape.points
        if shape.role == "track":
            tangent = np.gradient(points, axis=0)
            heading = np.arctan2(tangent[:, 1], tangent[:, 0])
            line = np.column_stack([points, heading])
            names = ("second_track_beds", "second_rails")
            found += _rails(context, time, line, names, 2 * number)
        else:
            ring = np.concatenate([points, points[:1]]) if shape.closed else points
            low, high = (
                np.column_stack([ring, np.full(len(ring), z)]) for z in (0.1, shape.height)
            )
            kind, size, color, drawn = LINE_STRIP, (0.3, 0.0, 0.0), GREEN, low
            if shape.role == "fixed":
                kind, size, color, drawn = TRIANGLE_LIST, FILLED, CONCRETE, _strip(low, high)
            elif shape.role == "zone":
                color = SOIL
            one = _marker(context, time, shape.role, number, kind, color, scale=size, points=drawn)
            found.append(one)
        x, y = points.mean(axis=0) if shape.closed else points[len(points) // 2]
        found.append(
            _marker(
                context,
                time,
                "site_labels",
                number,
                TEXT,
                position=(x, y, max(NAME_HEIGHT, shape.height + 1.0)),
                scale=(0.0, 0.0, 1.5),
                text=shape.name,
            )
        )
    return found


def track_markers(
    track: Any, context: RunContext, time: float = 0.0, site: Sequence[Shape] = ()
) -> bytes:
    """``track_markers``: bed, rails and breaks of a ``derail_msgs/Track`` message, and its site.

    The message clears what was shown before and holds everything, since only the last one is kept
    for late subscribers.
    """
    # Of a straight its two ends are enough.
    turns = np.abs(np.diff(track.heading)) > 1e-12
    kept = np.ones(len(track.s), dtype=bool)
    kept[1:-1] = turns[1:] | turns[:-1]
    line = np.column_stack([track.x, track.y, track.heading])[kept]
    markers = [
        _marker(context, time, "", 0, CUBE, action=DELETE_ALL),
        *_rails(context, time, line, ("track_bed", "rails"), 0),
        *_site_markers(context, time, site),
    ]
    angle = np.interp(track.rail_break_coordinate, track.s, track.heading)
    for number, (s, bx, by) in enumerate(
        zip(track.rail_break_coordinate, track.rail_break_x, track.rail_break_y)
    ):
        half = 0.5 * float(angle[number])
        markers.append(
            _marker(
                context,
                time,
                "rail_breaks",
                number,
                CUBE,
                VERMILION,
                position=(bx, by, 0.4),
                rotation=(np.sin(half), np.cos(half)),
                scale=(0.4, BED_WIDTH + 1.0, 0.8),
            )
        )
        markers.append(
            _marker(
                context,
                time,
                "rail_break_labels",
                number,
                TEXT,
                WHITE,
                # Beside the track: above it the label would lie on the car that stands there.
                position=(
                    bx + BED_WIDTH * np.sin(angle[number]),
                    by - BED_WIDTH * np.cos(angle[number]),
                    6.0,
                ),
                scale=(0.0, 0.0, 2.0),
                text=f"rail break {s:.1f} m",
            )
        )
    return _array(markers)
