"""What sensors of cars would measure: the standard messages of ROS, from samples of a run.

Ground truth with white noise of a given standard deviation, which the covariances tell. Where
there is no noise they are zero, which sensor_msgs defines as unknown. Frames are
those of ``frames``; x is along the car, y to its left, z up. Each sensor measures at the origin of
the frame that its messages name.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from derail_ros.vocabulary.params import GRAVITY, TrainParams
from derail_ros.vocabulary.place import Datum
from msg_adapters.car_frame import Motion, heights, motion
from msg_adapters.common import SENTINEL, RunContext
from msg_adapters.definitions import message_class
from msg_adapters.templates import Template, marked_header, quaternion, vector
from msg_adapters.topics import SENSOR_TOPICS, Topic, topic_named

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from derail_ros.vocabulary.sample import Sample

RUNNING_PRESSURE = 620_500.0
"""Pressure above the atmosphere in a charged brake pipe, Pa: 90 psi, usual in North America."""
VENTING_TIME = 0.5
"""Time in which an emergency application takes the pipe's pressure at a car to 1/e of it, s. A
guess: valves vent the pipe beside them within a second or two."""
PLACES = ("body", "front_truck", "rear_truck")
"""Places of an inertial measurement unit: the car, or the axle boxes of a truck."""


@dataclass(frozen=True)
class Mount:
    """What every sensor is made with.

    Attributes
    ----------
    car : index of the car, from 0
    params : the train
    context : stamps and the frame of the run
    prefix : before the names of the train's frames
    noise : standard deviation in the unit of what is measured
    rng : where noise comes from; not used without noise
    """

    car: int
    params: TrainParams
    context: RunContext
    prefix: str = ""
    noise: float = 0.0
    rng: Any = None


class Sensor(ABC):
    """A sensor at a car: ``sensor(sample)`` gives the bytes of its message.

    ``name`` ends its topic, ``place`` is where it sits. ``topic`` is where its messages are sent,
    ``frame`` what they are measured in.
    """

    msgtype: str

    def __init__(self, mount: Mount, name: str, place: str = "body") -> None:
        topic = topic_named(f"car_{mount.car + 1}/{name}")
        assert topic is not None
        self.topic: Topic = topic
        self.context, self.car, self.noise = mount.context, mount.car, mount.noise
        self.frame = f"{mount.prefix}car_{mount.car + 1}" + (place != "body") * f"/{place}"
        distance = mount.params.cars[mount.car].truck_distance
        self._along = {"body": 0.0, "front_truck": distance, "rear_truck": -distance}[place]
        self._height = heights(mount.params.cars[mount.car : mount.car + 1])
        self._rng = mount.rng
        self._template: Template | None = None

    def _noisy(self, values: Any, noise: float | None = None) -> NDArray[np.float64]:
        values, noise = np.atleast_1d(values).astype(float), self.noise if noise is None else noise
        return values + noise * self._rng.standard_normal(values.shape) if noise else values

    def _bytes(self, sample: Sample, values: Any) -> bytes:
        if self._template is None:
            self._template = Template(self._message())
        return self._template(self.context.stamp(sample.time), np.asarray(values, dtype=float))

    def _motion(self, sample: Sample) -> Motion:
        return motion(sample, self._height, slice(self.car, self.car + 1))

    def _in_car(self, sample: Sample) -> tuple[NDArray, NDArray, NDArray]:
        """Velocity, acceleration less that of free fall, and rates, in the car's axes.

        Of the point at ``along`` m on the x axis of the car's frame: with v, a, w of its origin,
        ``v + w x r`` and ``a + dw/dt x r + w x (w x r)``.
        """
        m, x = self._motion(sample), self._along
        turn = m.axes[0].T
        spin, growth = turn @ m.spin[0], turn @ m.spin_growth[0]
        p, q, r = spin
        velocity = turn @ m.velocity[0] + [0.0, r * x, -q * x]
        acceleration = turn @ m.acceleration[0] + [
            -(q**2 + r**2) * x, growth[2] * x + p * q * x, p * r * x - growth[1] * x
        ]  # fmt: skip
        return velocity, acceleration + GRAVITY * turn[:, 2], spin

    @abstractmethod
    def _message(self) -> Any:
        """A message with marks in the place of what changes."""

    @abstractmethod
    def __call__(self, sample: Sample) -> bytes:
        """CDR bytes of the message."""


class Odometry(Sensor):
    """``nav_msgs/Odometry``: pose of the car's frame in the inertial one, velocity in its own.

    ``noise`` is that of the position, m each way, ``speed_noise`` that of the velocity, m/s each
    way. Orientation and rates have none.
    """

    msgtype = SENSOR_TOPICS["odometry"].msgtype

    def __init__(self, mount: Mount, speed_noise: float = 0.0) -> None:
        super().__init__(mount, "odometry")
        self._speed_noise = speed_noise

    def _message(self) -> Any:
        pose = message_class("geometry_msgs/msg/Pose")
        point = message_class("geometry_msgs/msg/Point")(*(SENTINEL,) * 3)
        twist = message_class("geometry_msgs/msg/Twist")(vector(), vector())

        def covariance(noise: float) -> NDArray[np.float64]:
            return np.diag([noise**2] * 3 + [0.0] * 3).reshape(-1)

        placed, moving = covariance(self.noise), covariance(self._speed_noise)
        return message_class(self.msgtype)(
            marked_header(self.context.frame_id),
            self.frame,
            message_class("geometry_msgs/msg/PoseWithCovariance")(
                pose(point, quaternion()), placed
            ),
            message_class("geometry_msgs/msg/TwistWithCovariance")(twist, moving),
        )

    def __call__(self, sample: Sample) -> bytes:
        velocity, _, rates = self._in_car(sample)
        place, turn = self._noisy(self._motion(sample).place[0]), sample.quaternions[self.car]
        velocity = self._noisy(velocity, self._speed_noise)
        return self._bytes(sample, [*place, *turn, *velocity, *rates])


class Imu(Sensor):
    """``sensor_msgs/Imu``: orientation, rates of turn, and acceleration, which gravity is part of.

    ``noise`` is that of the acceleration, m/s^2, ``turn_noise`` that of the rates, rad/s.
    """

    msgtype = SENSOR_TOPICS["imu_body"].msgtype

    def __init__(self, mount: Mount, place: str = "body", turn_noise: float = 0.0) -> None:
        super().__init__(mount, f"imu_{place}", place)
        self._turn_noise = turn_noise

    def _message(self) -> Any:
        def covariance(noise: float) -> NDArray[np.float64]:
            return noise**2 * np.eye(3).reshape(-1)

        return message_class(self.msgtype)(
            marked_header(self.frame),
            quaternion(),
            covariance(0.0),
            vector(),
            covariance(self._turn_noise),
            vector(),
            covariance(self.noise),
        )

    def __call__(self, sample: Sample) -> bytes:
        _, felt, rates = self._in_car(sample)
        felt, turn = self._noisy(felt), sample.quaternions[self.car]
        return self._bytes(sample, [*turn, *self._noisy(rates, self._turn_noise), *felt])


class NavSat(Sensor):
    """``sensor_msgs/NavSatFix`` of the car's frame; ``noise`` is in metres each way."""

    msgtype = SENSOR_TOPICS["fix"].msgtype

    def __init__(self, mount: Mount, datum: Datum) -> None:
        super().__init__(mount, "fix")
        self._datum = datum

    def _message(self) -> Any:
        kind = message_class(self.msgtype)
        status = message_class("sensor_msgs/msg/NavSatStatus")
        covariance = self.noise**2 * np.eye(3).reshape(-1)
        return kind(
            marked_header(self.frame),
            status(status=status.STATUS_FIX, service=status.SERVICE_GPS),
            *(SENTINEL,) * 3,
            covariance,
            # Zeros are no covariance of a fix: exact ones have none.
            kind.COVARIANCE_TYPE_KNOWN if self.noise else kind.COVARIANCE_TYPE_UNKNOWN,
        )

    def __call__(self, sample: Sample) -> bytes:
        place = self._noisy(self._motion(sample).place[0])
        return self._bytes(sample, self._datum.fix(*place.tolist()))


class WheelSpeed(Sensor):
    """``geometry_msgs/TwistStamped``: speed of the front truck along the car, as its wheels turn.

    The model has no slip. A derailed truck has no wheel that rolls: NaN.
    """

    msgtype = SENSOR_TOPICS["wheel_speed"].msgtype

    def __init__(self, mount: Mount) -> None:
        super().__init__(mount, "wheel_speed", "front_truck")

    def _message(self) -> Any:
        twist = message_class("geometry_msgs/msg/Twist")
        zero = vector(0.0, 0.0, 0.0)
        return message_class(self.msgtype)(
            marked_header(self.frame), twist(vector(SENTINEL, 0.0, 0.0), zero)
        )

    def __call__(self, sample: Sample) -> bytes:
        velocity, _, _ = self._in_car(sample)
        rolls = bool(sample.truck_on[self.car, 0])
        return self._bytes(sample, self._noisy(velocity[0] if rolls else math.nan))


class PipePressure(Sensor):
    """``sensor_msgs/FluidPressure`` of the brake pipe at a car, Pa above the atmosphere.

    The model has the signal of an emergency application and no pressure: from the running
    pressure it falls as an exponential from the moment the signal reaches the car.
    ``reached`` is the car's number -> that run time (s); who has the events fills it in.
    """

    msgtype = SENSOR_TOPICS["brake_pipe_pressure"].msgtype

    def __init__(self, mount: Mount, reached: Mapping[int, float]) -> None:
        super().__init__(mount, "brake_pipe_pressure")
        self._reached = reached

    def _message(self) -> Any:
        header = marked_header(self.frame)
        return message_class(self.msgtype)(header, SENTINEL, float(self.noise**2))

    def __call__(self, sample: Sample) -> bytes:
        since = max(0.0, sample.time - self._reached.get(self.car + 1, math.inf))
        return self._bytes(sample, self._noisy(RUNNING_PRESSURE * math.exp(-since / VENTING_TIME)))
