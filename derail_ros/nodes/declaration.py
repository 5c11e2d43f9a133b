"""Declares the parameters of a node to ``rclpy`` and checks their values."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import derail_ros
from derail_ros.nodes.parameters import NODES, Parameter, Value
from derail_ros.scenario.messages import did_you_mean


def usage(node: str) -> str:
    """Help text of a node's command line."""
    lines = [
        f"{node} of derail_ros {derail_ros.__version__}: a ROS 2 node",
        "",
        f"usage: {node} [--ros-args -p NAME:=VALUE ... --params-file FILE]",
        "",
    ]
    for p in NODES[node]:
        lines.append(f"  {p.name} ({p.type_name}, default {p.default!r}): {p.description}")
    return "\n".join(lines)


def descriptor(parameter: Parameter) -> Any:
    """``rcl_interfaces/ParameterDescriptor`` of a parameter."""
    from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor

    unit = f" [{parameter.unit}]" if parameter.unit else ""
    result = ParameterDescriptor(
        name=parameter.name,
        description=parameter.description.replace("`", "") + unit,
        additional_constraints=", ".join(parameter.choices),
        read_only=parameter.read_only,
        # rclpy would refuse an integer for a double; check() decides.
        dynamic_typing=parameter.type_name == "double" or parameter.numeric,
    )
    if parameter.limits is not None:
        low, high = parameter.limits
        if parameter.type_name == "double":
            result.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
        else:
            whole = IntegerRange(from_value=int(low), to_value=int(high), step=1)
            result.integer_range = [whole]
    return result


def declare(node: Any, name: str) -> dict[str, Value]:
    """Declare the parameters of a node and return their values.

    Raises
    ------
    ValueError
        With the name of the parameter and the reason.
    """
    from rclpy.exceptions import ParameterException

    values: dict[str, Value] = {}
    for parameter in NODES[name]:
        # An empty list has no type in ROS, and one parameter without a value makes
        # `ros2 param dump` come out empty.
        default = parameter.default if parameter.default != [] else [""]
        given = _overrides(node).get(parameter.name)
        # An empty list in a file comes as a parameter without a type.
        none = given is not None and given.value is None and parameter.default == []
        if given is not None and not none:
            parameter.check(_plain(given.value))
        try:
            declared = node.declare_parameter(
                parameter.name, default, descriptor(parameter), ignore_override=none
            )
        except ParameterException as error:
            raise ValueError(f"{parameter.name}: {error}") from error
        value = _plain(declared.value)
        values[parameter.name] = parameter.default if value is None else parameter.check(value)
    for warning in without_effect(node, values):
        node.get_logger().warning(warning)
    return values


def without_effect(node: Any, values: Mapping[str, Value]) -> Iterator[str]:
    """A warning for each given parameter that has no effect.

    A file for all nodes (``/**``) gives each node the parameters of the others too; these are
    not reported.
    """
    known = {parameter.name for table in NODES.values() for parameter in table}
    for name in _overrides(node):
        # Publishers and subscriptions declare their QoS overrides when they are made.
        if not (name in known or node.has_parameter(name) or name.startswith("qos_overrides.")):
            yield f"there is no parameter {name}; ignored{did_you_mean(name, values)}"
    for folder in values.get("scenario_dirs", []):  # type: ignore[union-attr]
        if not Path(folder).is_dir():
            yield f"scenario_dirs: there is no folder {folder}"


def check_change(parameters: Iterable[Any], name: str) -> dict[str, Value]:
    """Checked values of a change that a client asks for.

    Raises
    ------
    ValueError
        With the name of the parameter and the reason; nothing has been changed.
    """
    known = {parameter.name: parameter for parameter in NODES[name]}
    return {p.name: known[p.name].check(_plain(p.value)) for p in parameters if p.name in known}


def _overrides(node: Any) -> Mapping[str, Any]:
    """Parameters from the command line and from files; ``rclpy`` has no public name for them."""
    return getattr(node, "_parameter_overrides", {})


def _plain(value: Any) -> Any:
    """A value without the array types of ``rclpy``; a list without empty texts."""
    if hasattr(value, "__iter__") and not isinstance(value, str):
        return [entry for entry in value if entry != ""]
    return value
