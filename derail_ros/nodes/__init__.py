"""ROS 2 nodes: thin layers over modules without ROS and without physics."""

import os
import signal
import sys


def _end_quietly(*_: object) -> None:
    os._exit(0)


if sys.orig_argv[1:2] == ["-m"] and sys.orig_argv[2].startswith(f"{__name__}."):
    # A node is the program, and until it has begun (``process.Stop``) a signal must not surface
    # as a traceback of whatever is imported just then; nothing is open yet.
    signal.signal(signal.SIGINT, _end_quietly)
    signal.signal(signal.SIGTERM, _end_quietly)
