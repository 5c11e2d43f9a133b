"""``derail play``: the node ``player`` from the command line."""

from __future__ import annotations

import math
from typing import Annotated

import typer

from derail_ros.commands.common import FAILED, CommandFailure
from derail_ros.commands.options import Bag
from derail_ros.commands.review import bag_errors


def run(
    bag: Bag,
    rate: Annotated[float, typer.Option(help="Recorded time per wall time.")] = 1.0,
    start: Annotated[float, typer.Option(help="Begin this long after the beginning, s.")] = 0.0,
    loop: Annotated[bool, typer.Option("--loop", help="Start again at the end.")] = False,
    paused: Annotated[bool, typer.Option("--paused", help="Wait for the service resume.")] = False,
    clock: Annotated[bool, typer.Option(help="Publish /clock.")] = True,
) -> int:
    """Publish a recording on a ROS 2 graph, with the node player."""
    from derail_ros.recording.storage import open_bag

    if not math.isfinite(rate) or rate <= 0.0:
        raise CommandFailure(f"--rate: must be above zero, got {rate:g}")
    if not math.isfinite(start) or start < 0.0:
        raise CommandFailure(f"--start: must be zero or above, got {start:g}")
    with bag_errors():
        found = open_bag(bag)
    if not found.intact:
        raise CommandFailure(f"{bag}: is cut off; repair it with `derail repair {bag}`")
    try:
        import rclpy  # noqa: F401
    except ImportError:
        raise CommandFailure(
            "play needs ROS 2 (rclpy); without it, `derail review` makes a page that plays",
            FAILED,
        ) from None
    from derail_ros.nodes.player import main

    parameters = {
        "rate": rate,
        "start_offset": start,
        "loop": loop,
        "start_paused": paused,
        "publish_clock": clock,
    }
    arguments = ["--ros-args", "-p", f"path:='{str(found.path).replace(chr(39), chr(39) * 2)}'"]
    for name, value in parameters.items():
        text = str(value).lower() if isinstance(value, bool) else str(float(value))
        arguments += ["-p", f"{name}:={text}"]
    return main(arguments)
