"""The simulator and the recorder; takes the arguments of simulator.launch.py, and `bag`.

The recorder listens like any other node and can lose messages at high speed factors; the
simulator's own `record` cannot.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    """Start the recorder, and the simulator with it."""
    share = FindPackageShare("derail_ros")
    bag = ParameterValue(LaunchConfiguration("bag"), value_type=str)
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "bag", default_value="derail_bag", description="folder to write"
            ),
            DeclareLaunchArgument(
                "namespace", default_value="", description="namespace of both nodes"
            ),
            Node(
                package="derail_ros",
                executable="recorder",
                name="recorder",
                namespace=LaunchConfiguration("namespace"),
                output="screen",
                parameters=[{"path": bag}],
            ),
            IncludeLaunchDescription(
                PathJoinSubstitution([share, "launch", "simulator.launch.py"]),
                launch_arguments={"await_listeners": "1"}.items(),
            ),
        ]
    )
