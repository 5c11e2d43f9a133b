"""A derailment detector on board: brakes when its car shakes and nobody brakes yet.

    ros2 run derail_ros simulator --ros-args -p imu:=5:front_truck -p pipe_pressure:=5
    python examples/derailment_detector.py --ros-args -p car:=5

It hears what a detector at a car would measure: the acceleration along the car at an axle box
and the pressure of the brake pipe. A derailed truck drags on ballast and ties and holds the whole
train back: in a train of 40 cars one truck does so by 0.17 m/s^2. If the acceleration, averaged
over ``hold``, is stronger than ``threshold`` while the pipe is charged, so that nobody brakes,
the detector vents the pipe at its car. A threshold is a choice: a real train also slows on a
grade, by its rolling resistance and by the dynamic brake of its locomotives.
"""

import math
import signal
import threading

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import FluidPressure, Imu

from derail_msgs.srv import TriggerEmergencyBrake

CHARGED = 500_000.0
"""Pressure of a pipe in which nobody has braked yet, Pa above the atmosphere."""
SOURCE_CAR = TriggerEmergencyBrake.Request.SOURCE_CAR


class DerailmentDetector(Node):
    """Watches one car."""

    def __init__(self) -> None:
        super().__init__("derailment_detector")
        self.car = self.declare_parameter("car", 1).value
        self.threshold = self.declare_parameter("threshold", 0.12).value  # m/s^2
        self.hold = self.declare_parameter("hold", 0.5).value  # s
        simulator = self.declare_parameter("simulator", "simulator").value
        self.pressure = 0.0
        self.mean, self.last = 0.0, math.nan
        self.braked = False
        self.brake = self.create_client(
            TriggerEmergencyBrake, f"{simulator}/trigger_emergency_brake"
        )
        self.create_subscription(Imu, f"car_{self.car}/imu_front_truck", self.on_imu, 100)
        self.create_subscription(
            FluidPressure, f"car_{self.car}/brake_pipe_pressure", self.on_pressure, 100
        )

    def on_pressure(self, message: FluidPressure) -> None:
        self.pressure = message.fluid_pressure

    def on_imu(self, message: Imu) -> None:
        now = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        passed, self.last = now - self.last, now
        if not 0.0 <= passed < self.hold:  # the first one, or time has begun anew
            self.mean = 0.0
            return
        self.mean += (message.linear_acceleration.x - self.mean) * passed / self.hold
        if not self.braked and abs(self.mean) > self.threshold and self.pressure > CHARGED:
            self.braked = True
            request = TriggerEmergencyBrake.Request(source=SOURCE_CAR, car=self.car)
            request.caller = self.get_name()
            self.brake.call_async(request)
            self.get_logger().warning(
                f"car {self.car}: {self.mean:.2f} m/s^2 and nobody brakes: braking at {now:.2f} s"
            )


def main() -> None:
    # Not rclpy's own handlers and rclpy.spin: these wake the executor before they shut the context
    # down. If the executor looks in between, it waits again, for ever.
    asked = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: asked.set())
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = DerailmentDetector()
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while not asked.is_set():
        executor.spin_once(timeout_sec=0.1)
    executor.shutdown()
    node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main()
