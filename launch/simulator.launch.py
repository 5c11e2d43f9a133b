"""The simulator: `ros2 launch derail_ros simulator.launch.py scenario:=NAME speed_factor:=2.0`."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

ARGUMENTS = {
    "scenario": ("mississauga", "name of the scenario"),
    "speed_factor": ("1.0", "simulation time per wall time; 0 is as fast as possible"),
    "record": ("", "folder of the lossless recording that the simulator writes; empty for none"),
    "await_listeners": ("0", "start when each state topic has this many subscribers"),
}
TYPES = {"scenario": str, "speed_factor": float, "record": str, "await_listeners": int}


def generate_launch_description() -> LaunchDescription:
    """Declare the arguments and start the node with config/simulator.yaml and them."""
    parameters = {
        name: ParameterValue(LaunchConfiguration(name), value_type=TYPES[name])
        for name in ARGUMENTS
    }
    file = PathJoinSubstitution([FindPackageShare("derail_ros"), "config", "simulator.yaml"])
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=description)
                for name, (default, description) in ARGUMENTS.items()
            ),
            Node(
                package="derail_ros",
                executable="simulator",
                name="simulator",
                output="screen",
                parameters=[file, parameters],
            ),
        ]
    )
