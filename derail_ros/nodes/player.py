"""Executable of the node ``player``; its program is in ``player_node.py``."""

import sys

from derail_ros.nodes.process import run_node


def main(argv: list[str] | None = None) -> int:
    """Run the node until it is told to end; returns the exit code."""
    return run_node("player", argv)


if __name__ == "__main__":
    sys.exit(main())
