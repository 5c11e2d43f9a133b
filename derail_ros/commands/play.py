"""``derail play``: the node ``player`` from the command line."""

from __future__ import annotations

import math

from derail_ros.commands.common import FAILED, CommandFailure
from derail_ros.commands.review import bag_errors


def run(bag: str, rate: float, start: float, loop: bool, paused: bool, clock: bool) -> int:
    """Play a recording; the exit code."""
    from derail_ros.recording.storage import open_bag

    if not math.isfinite(rate) or rate <= 0.0:
        raise CommandFailure(f"--rate: must be above zero, not {rate:g}")
    if not math.isfinite(start) or start < 0.0:
        raise CommandFailure(f"--start: must not be negative, not {start:g}")
    with bag_errors():
        found = open_bag(bag)
    if not found.intact:
        raise CommandFailure(f"{bag}: cut off; `derail repair {bag}` makes it whole")
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
