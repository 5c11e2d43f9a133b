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
from msg_adapters.common import (
    NANOSECONDS,
    SENTINEL,
    SENTINEL_SECONDS,
    RunContext,
    SentinelContext,
)
from msg_adapters.definitions import message_class, serialize, typestore
from msg_adapters.state import quaternions

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from derail_ros.vocabulary.sample import Sample

ARROW, CUBE, LINE_STRIP, LINE_LIST, TEXT, TRIANGLE_LIST = 0, 1, 4, 5, 9, 11
ADD, DELETE, DELETE_ALL = 0, 2, 3

BLUE = (0.0, 0.447, 0.698)
ORANGE = (0.902, 0.624, 0.0)
VERMILION = (0.835, 0.369, 0.0)
PURPLE = (0.8, 0.475, 0.655)
BLACK = (0.05, 0.05, 0.05)
WHITE = (1.0, 1.0, 1.0)
BALLAST = (0.55, 0.53, 0.5)

ON_RAILS, DERAILED, STRUCK_HARD = BLUE, ORANGE, VERMILION

HARD = 5.0e6
"""Force at a single corner known to rupture a tank car, N."""
CAR_HEIGHT, CAR_FLOOR = 3.2, 0.9
"""Drawn height of a car body and of its floor above the rails, m (the model is planar)."""
COUPLER_HEIGHT = 1.0
FORCE_SCALE = 1.0e-6
"""Length of a force arrow, m/N: a metre a meganewton."""
FORCE_SHOWN = 1.0e4
"""Smallest force that gets an arrow, N."""
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
        self._represents = [car.represents for car in cars]
        self._pivot = np.array([car.pivot_distance for car in cars])
        self._layout: tuple[Any, ...] = ()
        self._pieces: dict[tuple[Any, ...], _Piece] = {} if pieces is None else pieces
        self._data = bytearray()

    def _labels(self, derailed: NDArray[np.bool_], peak: NDArray[np.float64]) -> tuple[str, ...]:
        labels = []
        for i in range(self._n):
            lines = [str(i + 1)]
            if self._represents[i] > 1:
                lines[0] += f" ({self._represents[i]} cars)"
            if derailed[i]:
                lines.append("off")
            if peak[i] > HARD:
                lines.append(f"{peak[i] / 1e6:.0f} MN")
            labels.append("\n".join(lines))
        return tuple(labels)

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
        self._cars = np.array(doubles["cars"])
        self._text = np.array(doubles["labels"])
        self._arrows = np.array(doubles["contact_forces"]).reshape(self._n, 2)
        self._links = doubles["couplers"][0] if doubles["couplers"] else 0
        self._link_count = sum(coupled)
        self._seconds = np.array(seconds)
        self._actions = np.array(actions)
        # A marker's pose and scale are ten doubles; its colour follows as four floats.
        self._colors = 2 * (self._cars + 10)
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
        d = self._doubles
        x, y, z = sample.pose[:, :3].T
        at = self._cars
        d[at], d[at + 1] = x, y
        d[at + 2] = z + CAR_FLOOR + 0.5 * CAR_HEIGHT
        d[at[:, None] + np.arange(3, 7)] = quaternions(sample.pose)
        colors = np.where(
            (peak > HARD)[:, None],
            np.array(STRUCK_HARD),
            np.where(derailed[:, None], np.array(DERAILED), np.array(ON_RAILS)),
        )
        for channel in range(3):
            self._singles[self._colors + channel] = colors[:, channel]

        at = self._text
        d[at], d[at + 1], d[at + 2] = x, y, CAR_FLOOR + CAR_HEIGHT + 1.5

        force = sample.collision_force
        shown = np.hypot(force[:, 0], force[:, 1]) > FORCE_SHOWN
        top = CAR_FLOOR + CAR_HEIGHT + 0.4
        # The arrow ends at the car that feels the force.
        for column, share in ((0, -FORCE_SCALE), (1, 0.0)):
            at = self._arrows[:, column]
            d[at], d[at + 1], d[at + 2] = x + share * force[:, 0], y + share * force[:, 1], top
        words = self._words
        words[self._actions] = np.where(shown, ADD, DELETE)

        if self._link_count:
            points = self._coupler_points(sample)
            d[self._links : self._links + points.size] = points.ravel()

        stamp = divmod(self.context.stamp(sample.time), NANOSECONDS)
        words[self._seconds], words[self._seconds + 1] = stamp
        return bytes(self._data[: self._size])

    def _coupler_points(self, sample: Sample) -> NDArray[np.float64]:
        """(2 C, 3) pivots joined by the couplings that hold, m."""
        q = sample.q
        held = np.flatnonzero(sample.coupled)
        cos, sin = np.cos(q[:, 2]), np.sin(q[:, 2])
        points = np.empty((len(held), 2, 3))
        points[:, 0, 0] = q[held, 0] - self._pivot[held] * cos[held]
        points[:, 0, 1] = q[held, 1] - self._pivot[held] * sin[held]
        behind = held + 1
        points[:, 1, 0] = q[behind, 0] + self._pivot[behind] * cos[behind]
        points[:, 1, 1] = q[behind, 1] + self._pivot[behind] * sin[behind]
        points[:, :, 2] = COUPLER_HEIGHT
        return points.reshape(-1, 3)


def track_markers(track: Any, context: RunContext, time: float = 0.0) -> bytes:
    """``track_markers``: bed, rails and breaks of a ``derail_msgs/Track`` message.

    The message clears what was shown before and holds everything, since only the last one is kept
    for late subscribers.
    """
    # Of a straight its two ends are enough.
    turns = np.abs(np.diff(track.heading)) > 1e-12
    kept = np.ones(len(track.s), dtype=bool)
    kept[1:-1] = turns[1:] | turns[:-1]
    x, y, heading = track.x[kept], track.y[kept], track.heading[kept]
    nx, ny = -np.sin(heading), np.cos(heading)

    def offset(side: float, z: float) -> NDArray[np.float64]:
        return np.stack([x + side * nx, y + side * ny, np.full_like(x, z)], axis=1)

    left, right = offset(0.5 * BED_WIDTH, -0.2), offset(-0.5 * BED_WIDTH, -0.2)
    bed = np.stack([left[:-1], right[:-1], left[1:], left[1:], right[:-1], right[1:]], axis=1)
    markers = [
        _marker(context, time, "", 0, CUBE, action=DELETE_ALL),
        _marker(
            context,
            time,
            "track_bed",
            0,
            TRIANGLE_LIST,
            BALLAST,
            scale=(1.0, 1.0, 1.0),
            points=bed.reshape(-1, 3),
        ),
    ]
    for number, side in enumerate((0.5 * GAUGE, -0.5 * GAUGE)):
        markers.append(
            _marker(
                context,
                time,
                "rails",
                number,
                LINE_STRIP,
                BLACK,
                scale=(0.15, 0.0, 0.0),
                points=offset(side, 0.0),
            )
        )
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
