"""Messages sent at the state rate: poses, state, couplings, energy.

Flat arrays only; an encoder is made once a run and serialises straight from the sample's arrays.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from derail_ros.vocabulary.ledger import ENERGY_ENTRIES
from derail_ros.vocabulary.params import TrainParams
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


def quaternions(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 4) quaternions x, y, z, w of poses (N, 6) that end with roll, pitch, yaw (rad)."""
    half = 0.5 * pose[:, 3:6]
    (sr, sp, sy), (cr, cp, cy) = np.sin(half).T, np.cos(half).T
    return np.stack(
        [
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
            cr * cp * cy + sr * sp * sy,
        ],
        axis=-1,
    )


class PoseEncoder:
    """``car_poses``: the bytes of one message, of which only time and poses are renewed."""

    def __init__(self, n_cars: int, context: RunContext) -> None:
        self.context = context
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
        """CDR bytes of ``geometry_msgs/PoseArray``: the mass centres, in order of the cars."""
        self._stamp[:] = divmod(self.context.stamp(sample.time), NANOSECONDS)
        self._poses[:, 0:3] = sample.pose[:, 0:3]
        self._poses[:, 3:7] = quaternions(sample.pose)
        return bytes(self._data)


class FlatEncoder:
    """Bytes of a message of numbers and arrays of which only the numbers are renewed.

    Texts and lengths of arrays are those of the message given. Arrays of ``Quantity`` are renewed
    by the name of their field and their key: ``("more", "height_m")``.
    """

    def __init__(self, message: Any) -> None:
        data = serialize(message)
        # Doubles are aligned to 8 bytes after the encapsulation of 4, and so they are in memory.
        self._buffer = bytearray(bytes(PAD) + data)
        self._stamp = np.frombuffer(self._buffer, "<u4", 2, PAD + 4)
        self._views: dict[Any, NDArray[Any]] = {}
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
            self._at += count * dtype.itemsize

    def __call__(self, stamp: int, fields: Mapping[Any, Any]) -> bytes:
        """CDR bytes with another time (ns) and other numbers."""
        self._stamp[:] = divmod(stamp, NANOSECONDS)
        for name, view in self._views.items():
            view[...] = fields[name[0]][name[1]] if isinstance(name, tuple) else fields[name]
        return bytes(memoryview(self._buffer)[PAD:])


class StateEncoder:
    """The messages of one sample."""

    def __init__(self, params: TrainParams, context: RunContext) -> None:
        self.context = context
        self.poses = PoseEncoder(len(params.cars), context)
        self._encoders: dict[str, FlatEncoder] = {}

    def train_state(self, s: Sample) -> Any:
        """``derail_msgs/TrainState`` of a sample."""
        return self._message("derail_msgs/msg/TrainState", self._train_state(s))

    def _train_state(self, s: Sample) -> dict[str, Any]:
        pose, velocity, acceleration = s.pose.T, s.velocity.T, s.acceleration.T
        ground = s.ground_truck_force.transpose(1, 2, 0)
        body = s.ground_body_force.T
        collision = s.collision_force.T
        external = s.external_force.T
        return {
            "step": s.step,
            "time": s.time,
            **dict(zip(("x", "y", "z", "roll", "pitch", "yaw"), pose)),
            **dict(zip(("vx", "vy", "vz", "roll_rate", "pitch_rate", "yaw_rate"), velocity)),
            **dict(zip(_ACCELERATIONS, acceleration)),
            **_ends("coupler_angle", s.coupler_yaw),
            **_ends("coupler_rate", s.coupler_rate),
            **_ends("coupler_acceleration", s.coupler_acceleration),
            **_ends("truck_status", s.truck_on),
            **_ends("track_coordinate", s.truck_coordinate),
            **_ends("rail_force", s.rail_force),
            "brake_force": s.brake_force,
            "ground_force_front_x": ground[0, 0],
            "ground_force_front_y": ground[0, 1],
            "ground_force_rear_x": ground[1, 0],
            "ground_force_rear_y": ground[1, 1],
            "ground_force_body_x": body[0],
            "ground_force_body_y": body[1],
            "ground_moment": s.ground_moment,
            "collision_force_x": collision[0],
            "collision_force_y": collision[1],
            "collision_moment": s.collision_moment,
            "largest_corner_force": self._largest(s),
            "corner_force": s.corner_force.reshape(-1),
            "corner_gap": s.corner_gap.reshape(-1),
            "corner_closing_speed": s.corner_closing_speed.reshape(-1),
            "corner_other_car": s.corner_other.reshape(-1),
            "external_force_x": external[0],
            "external_force_y": external[1],
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

    def _couplers(self, s: Sample) -> dict[str, Any]:
        force = s.coupler_force.T
        return {
            "step": s.step,
            "time": s.time,
            "coupled": s.coupled,
            "relative_angle": s.relative_angle,
            "knuckle_moment": s.knuckle_moment,
            "constraint_force_x": force[0],
            "constraint_force_y": force[1],
            "axial_force": s.axial_force,
            "gap_error": s.coupler_gap,
            **_ends("striker_force", s.striker_force),
            "more": s.couplings,
        }

    def energy(self, s: Sample) -> Any:
        """``derail_msgs/EnergyLedger`` of a sample."""
        return self._message("derail_msgs/msg/EnergyLedger", self._energy(s))

    def _energy(self, s: Sample) -> dict[str, Any]:
        known = [e for e in ENERGY_ENTRIES.values() if e.key in s.energy]
        return {
            "step": s.step,
            "time": s.time,
            "entries": {e.key: [s.energy[e.key]] for e in known},
            "roles": [e.role for e in known],
        }

    def _message(self, kind: str, fields: Mapping[str, Any]) -> Any:
        """The message with these fields, as a serialiser wants them."""
        types = dict(fields_of(kind))
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

    def _bytes(self, kind: str, fields: Mapping[str, Any]) -> bytes:
        encoder = self._encoders.get(kind)
        if encoder is None:
            encoder = self._encoders[kind] = FlatEncoder(self._message(kind, fields))
        return encoder(self.context.stamp(fields["time"]), fields)

    def encode(self, sample: Sample) -> list[tuple[str, bytes]]:
        """Topic name and CDR bytes of each state message of a sample."""
        return [
            ("car_poses", self.poses(sample)),
            ("train_state", self._bytes("derail_msgs/msg/TrainState", self._train_state(sample))),
            (
                "coupler_states",
                self._bytes("derail_msgs/msg/CouplerStates", self._couplers(sample)),
            ),
            ("energy", self._bytes("derail_msgs/msg/EnergyLedger", self._energy(sample))),
        ]


_ACCELERATIONS = ("ax", "ay", "az", "roll_acceleration", "pitch_acceleration", "yaw_acceleration")


def _ends(name: str, values: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """Two fields of a message from the two columns of an array: front and rear."""
    return {f"{name}_front": values[:, 0], f"{name}_rear": values[:, 1]}
