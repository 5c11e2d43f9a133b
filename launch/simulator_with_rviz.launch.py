"""The simulator and RViz; takes the arguments of simulator.launch.py."""

from launch import LaunchDescription
from launch.actions import IncludeLaunchDescription
from launch.substitutions import PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    """Start the simulator, and RViz with config/derail_ros.rviz (fixed frame map)."""
    share = FindPackageShare("derail_ros")
    return LaunchDescription(
        [
            IncludeLaunchDescription(
                PathJoinSubstitution([share, "launch", "simulator.launch.py"]),
                launch_arguments={"rviz": "true"}.items(),
            ),
        ]
    )
