"""The planar multibody derailment engine: numpy arrays, numba kernels; no ROS, no files.

Heavy imports (numba) happen when a run is first built, not when the package is imported.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from derail_ros.engine.simulation import PlanarSimulation
    from derail_ros.engine.track import Track
    from derail_ros.engine.warming import warm_up

_LAZY = {"PlanarSimulation": "simulation", "Track": "track", "warm_up": "warming"}

__all__ = ["PlanarSimulation", "Track", "warm_up"]


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(importlib.import_module(f"derail_ros.engine.{_LAZY[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
