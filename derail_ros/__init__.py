"""derail_ros: a simulator of train derailments, in Python and in ROS 2."""

import os
import signal
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from derail_ros.api import simulate as simulate
    from derail_ros.api import study as study
    from derail_ros.nodes.client import SimulatorClient as SimulatorClient

if os.path.basename(sys.argv[0]) == "derail":
    # The command is being imported; ``cli.main`` says "interrupted" once it runs.
    signal.signal(signal.SIGINT, lambda *_: os._exit(130))

__version__ = "0.2.0"
__all__ = ["SimulatorClient", "__version__", "simulate", "study"]


def __getattr__(name: str) -> Any:
    # imported when it is first used: the command line's help waits for neither numpy nor numba
    if name in ("simulate", "study"):
        from derail_ros import api

        return getattr(api, name)
    if name == "SimulatorClient":
        from derail_ros.nodes.client import SimulatorClient

        return SimulatorClient
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
