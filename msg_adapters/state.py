"""Messages sent at the state rate: poses, state, couplings, energy.

Flat arrays only; an encoder is made once a run and serialises straight from the sample's arrays.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from derail_ros.vocabulary.ledger import ENERGY_ENTRIES
from derail_ros.vocabulary.params import TrainParams
from msg_adapters.car_frame import heights, places
from msg_adapters.common import NANOSECONDS, RunContext
from msg_adapters.definitions import fields_of, message_class, serialize
from msg_adapters.reports import quantity

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from derail_ros.vocabulary.sample import Sample

PAD = 4
START = PAD + 4
"""Where a message begins in the buffer of an encoder, after its encapsulation."""
POSE_DOUBLES = 7
"""x, y, z and the quaternion x, y, z, w."""


class PoseEncoder:
    """``car_poses``: the bytes of one message, of which only time and poses are renewed."""

    def __init__(self, params: TrainParams, context: RunContext) -> None:
        self.context = context
        self._height, n_cars = heights(params.cars), len(params.cars)
        point = message_class("geometry_msgs/msg/Point")
        quaternion = message_class("geometry_msgs/msg/Quaternion")
        pose = message_class("geometry_msgs/msg/Pose")
        template = message_class("geometry_msgs/msg/PoseArray")(
            context.header(0.0),
            [pose(point(0.0, 0.0, 0.0), quaternion(0.0, 0.0, 0.0, 1.0)) for _ in range(n_cars)],
        )
        self._data = bytearray(serialize(template))
        # The poses end the message and hold nothing but doubles.
        start = len(self._data) - 8 * POSE_DOUBLES * n_cars
        self._poses = np.frombuffer(self._data, "<f8", POSE_DOUBLES * n_cars, start).reshape(
            n_cars, POSE_DOUBLES
        )
        self._stamp = np.frombuffer(self._data, "<u4", 2, 4)

    def __call__(self, sample: Sample) -> bytes:
        """CDR bytes of ``geometry_msgs/PoseArray``: the frames of the cars, in their order."""
        self._stamp[:] = divmod(self.context.stamp(sample.time), NANOSECONDS)
        self._poses[:, 0:3] = places(sample.pose, self._height)
        self._poses[:, 3:7] = sample.quaternions
        return bytes(self._data)


class FlatEncoder:
    """Bytes of a message of numbers and arrays of which only the numbers are renewed.

    Texts and lengths of arrays are those of the message given, and so are the numbers that it is
    not called with. Arrays of ``Quantity`` are mappings from their keys. Arrays that follow each
    other in the message may be given as rows of one: ``("x", "y"): (2, N)``.
    """

    def __init__(self, message: Any) -> None:
        data = serialize(message)
        # Doubles are aligned to 8 bytes after the encapsulation of 4, and so they are in memory.
        self._buffer = bytearray(bytes(PAD) + data)
        self._stamp = np.frombuffer(self._buffer, "<u4", 2, PAD + 4)
        self._views: dict[Any, NDArray[Any]] = {}
        self._places: dict[Any, int] = {}
        self._doubles = np.frombuffer(self._buffer, "<f8", (len(self._buffer) - START) // 8, START)
        self._plan: list[tuple[Any, Any, NDArray[Any]]] = []
        self._singles: list[tuple[str, list[str], NDArray[np.int64]]] = []
        self._at = START
        for name, kind in fields_of(message.__msgtype__):
            if kind == "std_msgs/msg/Header":
                self._at += 8
                self._text()
            elif kind == "string":
                self._text()
            elif kind == "string[]":
                for _ in range(self._count()):
                    self._text()
            elif kind == "derail_msgs/msg/Quantity[]":
                for _ in range(self._count()):
                    key = self._text()
                    self._text()
                    self._numbers((name, key), "float64", self._count())
            else:
                dtype = kind.removesuffix("[]")
                self._numbers(name, dtype, self._count() if kind.endswith("[]") else 1)
        if self._at != len(self._buffer):
            left = len(self._buffer) - self._at
            raise ValueError(f"{message.__msgtype__}: {left} bytes left over")

    def _count(self) -> int:
        self._at += -self._at % 4
        self._at += 4
        return int.from_bytes(self._buffer[self._at - 4 : self._at], "little")

    def _text(self) -> str:
        length = self._count()
        self._at += length
        return bytes(self._buffer[self._at - length : self._at - 1]).decode()

    def _numbers(self, name: Any, kind: str, count: int) -> None:
        dtype = np.dtype(kind).newbyteorder("<")
        if count:
            self._at += -self._at % dtype.itemsize
            self._views[name] = np.frombuffer(self._buffer, dtype, count, self._at)
            self._places[name] = self._at
            self._at += count * dtype.itemsize

    def _rows(self, names: tuple[str, ...]) -> NDArray[Any]:
        """Arrays of the message as rows of one: there is as much between each and the next."""
        first, places = self._views[names[0]], [self._places[name] for name in names]
        gap = places[1] - places[0]
        same = all(self._views[name].dtype == first.dtype for name in names)
        if not same or places != [places[0] + k * gap for k in range(len(names))]:
            raise ValueError(f"{', '.join(names)} are not rows of one array")
        shape, strides = (len(names), len(first)), (gap, first.itemsize)
        return np.ndarray(shape, first.dtype, self._buffer, places[0], strides)

    def _lay_out(self, fields: Mapping[Any, Any]) -> None:
        """Find the places of fields: name, key of a mapping, view."""
        for name, value in fields.items():
            if isinstance(value, Mapping):
                keys = [key for key in value if (name, key) in self._views]
                if keys and all(np.ndim(value[key]) == 0 for key in keys):
                    places = [(self._places[name, key] - START) // 8 for key in keys]
                    self._singles.append((name, keys, np.array(places)))
                else:
                    self._plan += [(name, key, self._views[name, key]) for key in keys]
            elif isinstance(name, tuple) and name[0] in self._views:
                self._plan.append((name, None, self._rows(name)))
            elif name in self._views:
                self._plan.append((name, None, self._views[name]))

    def __call__(self, stamp: int, fields: Mapping[Any, Any]) -> bytes:
        """CDR bytes with another time (ns) and other numbers, of the same fields in each call."""
        if not self._plan:
            self._lay_out(fields)
        self._stamp[:] = divmod(stamp, NANOSECONDS)
        for name, key, view in self._plan:
            view[...] = fields[name] if key is None else fields[name][key]
        for name, keys, at in self._singles:
            values = fields[name]
            self._doubles[at] = [values[key] for key in keys]
        return bytes(memoryview(self._buffer)[PAD:])


class StateEncoder:
    """The messages of one sample."""

    def __init__(self, params: TrainParams, context: RunContext) -> None:
        self.context = context
        self.poses = PoseEncoder(params, context)
        self._encoders: dict[str, FlatEncoder] = {}
        self._makers = {
            "train_state": (self.train_state, self._train_state),
            "coupler_states": (self.coupler_states, self._couplers),
            "energy": (self.energy, self._energy),
        }

    def train_state(self, s: Sample) -> Any:
        """``derail_msgs/TrainState`` of a sample."""
        return self._message("derail_msgs/msg/TrainState", self._train_state(s))

    def _train_state(self, s: Sample) -> dict[Any, Any]:
        return {
            "step": s.step,
            "time": s.time,
            _POSE: s.pose.T,
            _VELOCITY: s.velocity.T,
            _ACCELERATION: s.acceleration.T,
            _ends("coupler_angle"): s.coupler_yaw.T,
            _ends("coupler_rate"): s.coupler_rate.T,
            _ends("coupler_acceleration"): s.coupler_acceleration.T,
            _ends("truck_status"): s.truck_on.T,
            _ends("track_coordinate"): s.truck_coordinate.T,
            _ends("rail_force"): s.rail_force.T,
            "brake_force": s.brake_force,
            _GROUND: s.ground_truck_force.reshape(-1, 4).T,
            _plane("ground_force_body"): s.ground_body_force.T,
            "ground_moment": s.ground_moment,
            _plane("collision_force"): s.collision_force.T,
            "collision_moment": s.collision_moment,
            "largest_corner_force": self._largest(s),
            "corner_force": s.corner_force.reshape(-1),
            "corner_gap": s.corner_gap.reshape(-1),
            "corner_closing_speed": s.corner_closing_speed.reshape(-1),
            "corner_other_car": s.corner_other.reshape(-1),
            _plane("external_force"): s.external_force.T,
            "external_moment": s.external_moment,
            "more": s.cars,
        }

    @staticmethod
    def _largest(s: Sample) -> NDArray[np.float64]:
        """Largest force at a single corner of any contact of each car, as striker or struck, N."""
        largest: NDArray[np.float64] = s.corner_force.max(axis=1, initial=0.0)
        car, corner = np.nonzero(s.corner_force > 0.0)
        other = np.asarray(s.corner_other)[car, corner] - 1
        known = other >= 0
        np.maximum.at(largest, other[known], s.corner_force[car, corner][known])
        return largest

    def coupler_states(self, s: Sample) -> Any:
        """``derail_msgs/CouplerStates`` of a sample."""
        return self._message("derail_msgs/msg/CouplerStates", self._couplers(s))

    def _couplers(self, s: Sample) -> dict[Any, Any]:
        return {
            "step": s.step,
            "time": s.time,
            "coupled": s.coupled,
            "relative_angle": s.relative_angle,
            "knuckle_moment": s.knuckle_moment,
            _plane("constraint_force"): s.coupler_force.T,
            "axial_force": s.axial_force,
            "gap_error": s.coupler_gap,
            _ends("striker_force"): s.striker_force.T,
            "more": s.couplings,
        }

    def energy(self, s: Sample) -> Any:
        """``derail_msgs/EnergyLedger`` of a sample."""
        known = [e for e in ENERGY_ENTRIES.values() if e.key in s.energy]
        entries = {e.key: [s.energy[e.key]] for e in known}
        roles = [e.role for e in known]
        fields = self._energy(s) | {"entries": entries, "roles": roles}
        return self._message("derail_msgs/msg/EnergyLedger", fields)

    def _energy(self, s: Sample) -> dict[Any, Any]:
        return {"step": s.step, "time": s.time, "entries": s.energy}

    def _message(self, kind: str, rows: Mapping[Any, Any]) -> Any:
        """The message with these fields, as a serialiser wants them."""
        types = dict(fields_of(kind))
        fields: dict[str, Any] = {}
        for name, value in rows.items():
            if isinstance(name, tuple):
                fields.update(zip(name, value))
            else:
                fields[name] = value
        arrays: dict[str, Any] = {}
        for name, value in fields.items():
            of = types[name].removesuffix("[]")
            if isinstance(value, Mapping):
                unit = "J" if name == "entries" else ""
                arrays[name] = [quantity(key, values, unit) for key, values in value.items()]
            elif types[name].endswith("[]") and of != "string":
                arrays[name] = np.ascontiguousarray(value, dtype=of)
        header = self.context.header(float(fields["time"]))
        return message_class(kind)(
            header=header, run_id=self.context.run_id, **{**fields, **arrays}
        )

    def _bytes(self, topic: str, sample: Sample) -> bytes:
        message, fields_of_sample = self._makers[topic]
        encoder = self._encoders.get(topic)
        if encoder is None:
            encoder = self._encoders[topic] = FlatEncoder(message(sample))
        return encoder(self.context.stamp(sample.time), fields_of_sample(sample))

    def encode(self, sample: Sample) -> list[tuple[str, bytes]]:
        """Topic name and CDR bytes of each state message of a sample."""
        return [
            ("car_poses", self.poses(sample)),
            *((topic, self._bytes(topic, sample)) for topic in self._makers),
        ]


_POSE = ("x", "y", "z", "roll", "pitch", "yaw")
_VELOCITY = ("vx", "vy", "vz", "roll_rate", "pitch_rate", "yaw_rate")
_ACCELERATION = (
    "ax", "ay", "az", "roll_acceleration", "pitch_acceleration", "yaw_acceleration"
)  # fmt: skip


@functools.cache
def _ends(name: str) -> tuple[str, str]:
    """Names of two fields: front and rear."""
    return f"{name}_front", f"{name}_rear"


@functools.cache
def _plane(name: str) -> tuple[str, str]:
    """Names of two fields: x and y."""
    return f"{name}_x", f"{name}_y"


_GROUND = _plane("ground_force_front") + _plane("ground_force_rear")
