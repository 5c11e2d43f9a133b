"""Messages sent at the state rate: poses, state, couplings, energy.

Flat arrays only; an encoder is made once a run and serialises straight from the sample's arrays.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
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
from msg_adapters.definitions import fields_of, message_class, serialize

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


class TransformEncoder:
    """`/tf`: frames `car_1` ... at the mass centres, x along the car, in the inertial frame."""

    def __init__(self, n_cars: int, context: RunContext) -> None:
        self.context = context
        vector = message_class("geometry_msgs/msg/Vector3")
        quaternion = message_class("geometry_msgs/msg/Quaternion")
        transform = message_class("geometry_msgs/msg/Transform")
        stamped = message_class("geometry_msgs/msg/TransformStamped")
        marked = SentinelContext("", 0, context.frame_id)
        template = message_class("tf2_msgs/msg/TFMessage")(
            [
                stamped(
                    marked.header(0.0),
                    f"car_{i}",
                    transform(vector(SENTINEL, 0.0, 0.0), quaternion(0.0, 0.0, 0.0, 1.0)),
                )
                for i in range(1, n_cars + 1)
            ]
        )
        data = serialize(template)
        self._size = len(data)
        self._data = bytearray(data + bytes(-(len(data) - 4) % 8))
        self._doubles = np.frombuffer(self._data, "<f8", offset=4)
        self._words = np.frombuffer(self._data, "<u4", offset=4)
        self._places = np.flatnonzero(self._doubles == SENTINEL)
        self._seconds = np.flatnonzero(self._words == SENTINEL_SECONDS)

    def __call__(self, sample: Sample) -> bytes:
        """CDR bytes of ``tf2_msgs/TFMessage``."""
        seconds, rest = divmod(self.context.stamp(sample.time), NANOSECONDS)
        self._words[self._seconds], self._words[self._seconds + 1] = seconds, rest
        at, d = self._places, self._doubles
        d[at[:, None] + np.arange(3)] = sample.pose[:, 0:3]
        d[at[:, None] + np.arange(3, 7)] = quaternions(sample.pose)
        return bytes(self._data[: self._size])


class FlatEncoder:
    """Bytes of a message of numbers and arrays of which only the numbers are renewed.

    Texts and lengths of arrays are those of the message given.
    """

    def __init__(self, message: Any) -> None:
        data = serialize(message)
        # Doubles are aligned to 8 bytes after the encapsulation of 4, and so they are in memory.
        self._buffer = bytearray(bytes(PAD) + data)
        self._stamp = np.frombuffer(self._buffer, "<u4", 2, PAD + 4)
        self._views: dict[str, NDArray[Any]] = {}
        at = START
        for name, kind in fields_of(message.__msgtype__):
            if kind == "std_msgs/msg/Header":
                at = self._after_text(at + 8)
            elif kind == "string":
                at = self._after_text(at)
            else:
                count = 1
                if kind.endswith("[]"):
                    at += -at % 4
                    count = int.from_bytes(self._buffer[at : at + 4], "little")
                    at += 4
                dtype = np.dtype(kind.removesuffix("[]")).newbyteorder("<")
                if count:
                    at += -at % dtype.itemsize
                    self._views[name] = np.frombuffer(self._buffer, dtype, count, at)
                    at += count * dtype.itemsize
        if at != len(self._buffer):
            raise ValueError(f"{message.__msgtype__}: {len(self._buffer) - at} bytes left over")

    def _after_text(self, at: int) -> int:
        at += -at % 4
        return at + 4 + int.from_bytes(self._buffer[at : at + 4], "little")

    def __call__(self, stamp: int, fields: Mapping[str, Any]) -> bytes:
        """CDR bytes with another time (ns) and other numbers."""
        self._stamp[:] = divmod(stamp, NANOSECONDS)
        for name, view in self._views.items():
            view[...] = fields[name]
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
        q, v, a = s.q.T, s.v.T, s.a.T
        on = s.truck_on.T
        coordinate = s.truck_coordinate.T
        rail = s.rail_force.T
        ground = s.ground_truck_force.transpose(1, 2, 0)
        body = s.ground_body_force.T
        collision = s.collision_force.T
        external = s.external_force.T
        return {
            "step": s.step,
            "time": s.time,
            "x": q[0],
            "y": q[1],
            "yaw": q[2],
            "vx": v[0],
            "vy": v[1],
            "yaw_rate": v[2],
            "ax": a[0],
            "ay": a[1],
            "yaw_acceleration": a[2],
            "coupler_angle_front": q[3],
            "coupler_angle_rear": q[4],
            "coupler_rate_front": v[3],
            "coupler_rate_rear": v[4],
            "coupler_acceleration_front": a[3],
            "coupler_acceleration_rear": a[4],
            "truck_status_front": on[0],
            "truck_status_rear": on[1],
            "track_coordinate_front": coordinate[0],
            "track_coordinate_rear": coordinate[1],
            "rail_force_front": rail[0],
            "rail_force_rear": rail[1],
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
        striker = s.striker_force.T
        force = s.coupler_force.T
        return {
            "step": s.step,
            "time": s.time,
            "coupled": s.coupled,
            "relative_angle": s.relative_angle,
            "knuckle_moment": s.knuckle_moment,
            "constraint_force_x": force[0],
            "constraint_force_y": force[1],
            "gap_error": s.coupler_gap,
            "striker_force_front": striker[0],
            "striker_force_rear": striker[1],
        }

    def energy(self, s: Sample) -> Any:
        """``derail_msgs/EnergyLedger`` of a sample.

        The engine counts energy taken out of the cars; the message gives the work on them.
        """
        return self._message("derail_msgs/msg/EnergyLedger", self._energy(s))

    def _energy(self, s: Sample) -> dict[str, Any]:
        ledger = s.energy
        initial = ledger["initial"]
        return {
            "step": s.step,
            "time": s.time,
            "initial": initial,
            "kinetic": ledger["kinetic"],
            "striker_elastic": ledger["striker"],
            "knuckle_elastic": ledger["knuckle"],
            "work_brakes": -ledger["brakes"],
            "work_ground_trucks": -ledger["ground_trucks"],
            "work_ground_body": -ledger["ground_body"],
            "work_collisions": -ledger["collisions"],
            "work_striker_dampers": -ledger["striker_dampers"],
            "work_knuckles_released": -ledger["knuckles_released"],
            "work_external": ledger["external"],
            "stabilization_net": ledger["stabilization_net"],
            "stabilization_gross": ledger["stabilization_gross"],
            # Both sides of the two balances name the same leftover, with opposite signs.
            "residual": -ledger["residual"],
            "residual_relative": -ledger["residual"] / initial if initial > 0.0 else math.nan,
        }

    def _message(self, kind: str, fields: Mapping[str, Any]) -> Any:
        """The message with these fields, as a serialiser wants them."""
        types = dict(fields_of(kind))
        arrays = {
            name: np.ascontiguousarray(value, dtype=types[name].removesuffix("[]"))
            for name, value in fields.items()
            if types[name].endswith("[]")
        }
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
