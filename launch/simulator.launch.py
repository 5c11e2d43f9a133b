"""The simulator: `ros2 launch derail_ros simulator.launch.py scenario:=NAME speed_factor:=2.0`.

Every parameter of the node is an argument; one that is not given keeps its value in `params_file`.
"""

import difflib

import yaml
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, LogInfo, OpaqueFunction
from launch.substitutions import PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from derail_ros.nodes.parameters import SIMULATOR

PARAMETERS = {parameter.name: parameter for parameter in SIMULATOR}
OTHERS = {
    "namespace": "namespace of the node, its topics and services",
    "params_file": "file of parameters; without one config/simulator.yaml",
    "use_sim_time": "true: the node itself takes its time from /clock",
    "rviz": "true: RViz too, with config/derail_ros.rviz",
}
SHOWN = ("markers", "track_markers", "car_poses", "robot_description")
"""Topics of the configuration of RViz, which is written for a simulator without a namespace."""


def value(name: str, text: str):
    """The value of a parameter in the node's type from the text of an argument."""
    if isinstance(PARAMETERS[name].default, str):
        return "" if text in ('""', "''") else text
    read = yaml.safe_load(text)
    if isinstance(PARAMETERS[name].default, list) and not isinstance(read, list):
        read = text.split(":")
    return PARAMETERS[name].check(read)


def start(context):
    """Start the nodes with the arguments that are given."""
    given = {name: text for name, text in context.launch_configurations.items() if text != ""}
    known = [*PARAMETERS, *OTHERS]
    entities = []
    for name in sorted(set(given) - set(known)):
        # Arguments of a file that includes this one are here too: only what looks like a slip.
        if meant := difflib.get_close_matches(name, known, 1, 0.85):
            text = f"simulator.launch.py has no argument {name}; did you mean {meant[0]}?"
            entities.append(LogInfo(msg=text))
    share = FindPackageShare("derail_ros")
    file = given.get("params_file", PathJoinSubstitution([share, "config", "simulator.yaml"]))
    parameters = {name: value(name, given[name]) for name in PARAMETERS if name in given}
    # An empty list has no type: the node takes it for none.
    parameters = {name: v if v != [] else [""] for name, v in parameters.items()}
    parameters["use_sim_time"] = given.get("use_sim_time", "false").lower() == "true"
    namespace = given.get("namespace", "")
    entities.append(
        Node(
            package="derail_ros",
            executable="simulator",
            name="simulator",
            namespace=namespace,
            output="screen",
            parameters=[file, parameters],
        )
    )
    if given.get("rviz", "false").lower() == "true":
        entities.append(
            Node(
                package="rviz2",
                executable="rviz2",
                name="rviz2",
                namespace=namespace,
                remappings=[(f"/{topic}", topic) for topic in SHOWN],
                arguments=["-d", PathJoinSubstitution([share, "config", "derail_ros.rviz"])],
                parameters=[{"use_sim_time": True}],
            )
        )
    return entities


def generate_launch_description() -> LaunchDescription:
    """Declare the arguments, and start the nodes once they are known."""
    texts = {name: parameter.description for name, parameter in PARAMETERS.items()} | OTHERS
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value="", description=description)
                for name, description in texts.items()
            ),
            OpaqueFunction(function=start),
        ]
    )
