"""Executable of the node ``recorder``; its program is in ``recorder_node.py``."""

import sys

from derail_ros.nodes.process import run_node


def main(argv: list[str] | None = None) -> int:
    """Run the node until it is told to end; returns the exit code."""
    return run_node("recorder", argv)


if __name__ == "__main__":
    sys.exit(main())
