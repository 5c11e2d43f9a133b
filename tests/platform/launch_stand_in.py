"""A stand-in for launch and launch_ros, which are not on PyPI: what a launch file asks of them.

Signatures are those of launch 3 and launch_ros 0.28 for what our files use: a name or an argument
that is not there fails here as it does there. Nothing is started.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any


@dataclass
class LaunchDescription:
    """``launch.LaunchDescription``."""

    entities: Iterable[Any] = ()


@dataclass
class DeclareLaunchArgument:
    """``launch.actions.DeclareLaunchArgument``."""

    name: str
    default_value: Any = field(default=None, kw_only=True)
    description: str | None = field(default=None, kw_only=True)
    choices: Iterable[str] | None = field(default=None, kw_only=True)


@dataclass
class LogInfo:
    """``launch.actions.LogInfo``."""

    msg: Any = field(kw_only=True)


@dataclass
class OpaqueFunction:
    """``launch.actions.OpaqueFunction``."""

    function: Any = field(kw_only=True)


@dataclass
class LaunchContext:
    """``launch.LaunchContext``, as far as an opaque function asks it."""

    launch_configurations: dict[str, str]


@dataclass
class IncludeLaunchDescription:
    """``launch.actions.IncludeLaunchDescription``."""

    launch_description_source: Any
    launch_arguments: Iterable[tuple[str, Any]] | None = field(default=None, kw_only=True)


@dataclass
class LaunchConfiguration:
    """``launch.substitutions.LaunchConfiguration``."""

    variable_name: str
    default: Any = field(default=None, kw_only=True)


@dataclass
class PathJoinSubstitution:
    """``launch.substitutions.PathJoinSubstitution``."""

    substitutions: Iterable[Any]


@dataclass
class FindPackageShare:
    """``launch_ros.substitutions.FindPackageShare``."""

    package: str


@dataclass
class ParameterValue:
    """``launch_ros.parameter_descriptions.ParameterValue``."""

    value: Any
    value_type: type | None = field(default=None, kw_only=True)


@dataclass(kw_only=True)
class Node:
    """``launch_ros.actions.Node``."""

    executable: Any
    package: Any = None
    name: Any = None
    namespace: Any = None
    exec_name: Any = None
    parameters: Iterable[Any] | None = None
    remappings: Iterable[tuple[Any, Any]] | None = None
    ros_arguments: Iterable[Any] | None = None
    arguments: Iterable[Any] | None = None
    output: str = "log"


MODULES: dict[str, tuple[type, ...]] = {
    "launch": (LaunchDescription, LaunchContext),
    "launch.actions": (DeclareLaunchArgument, IncludeLaunchDescription, LogInfo, OpaqueFunction),
    "launch.substitutions": (LaunchConfiguration, PathJoinSubstitution),
    "launch_ros": (),
    "launch_ros.actions": (Node,),
    "launch_ros.parameter_descriptions": (ParameterValue,),
    "launch_ros.substitutions": (FindPackageShare,),
}


@contextlib.contextmanager
def imported() -> Iterator[None]:
    """``import launch`` means the stand-in, also where the real one is installed."""
    hidden = {name: sys.modules.pop(name) for name in [*sys.modules] if is_launch(name)}
    for name, contents in MODULES.items():
        module = ModuleType(name)
        module.__path__ = []  # a package, without anything on disk
        for kind in contents:
            setattr(module, kind.__name__, kind)
        sys.modules[name] = module
    try:
        yield
    finally:
        for name in MODULES:
            del sys.modules[name]
        sys.modules.update(hidden)


def is_launch(name: str) -> bool:
    """Whether a module belongs to launch or launch_ros."""
    return name.partition(".")[0] in ("launch", "launch_ros")


def resolved(path: Any, share: Path) -> Path:
    """The file that a substitution names; only our own package has a known place."""
    assert isinstance(path, PathJoinSubstitution), path
    found = Path()
    for part in path.substitutions:
        if isinstance(part, FindPackageShare):
            assert part.package == "derail_ros"
            part = share
        found /= part
    return found
