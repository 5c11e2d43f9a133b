"""The planar multibody derailment engine: numpy arrays, numba kernels; no ROS, no files.

Heavy imports (numba) happen when a run is first built, not when the package is imported.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from derail_ros.engine.methods import METHODS
from derail_ros.vocabulary.errors import (
    CommandError,
    ConstraintError,
    DerailError,
    NonFiniteStateError,
    ParameterError,
    SimulationError,
    StateFormatError,
    StepSizeError,
    TrackEndError,
)
from derail_ros.vocabulary.events import Collision, Command, Event, EventKind
from derail_ros.vocabulary.params import (
    BrakeParams,
    BrakeTrigger,
    BrakeUnit,
    Car,
    ContactParams,
    CouplerType,
    DerailmentParams,
    GroundParams,
    InitiationParams,
    IntegrationParams,
    LateralForce,
    TrackParams,
    TrackSegment,
    TrainParams,
    VariantParams,
)

if TYPE_CHECKING:
    from derail_ros.engine.sample import Outcome, Sample
    from derail_ros.engine.simulation import ENERGY_ENTRIES, Simulation
    from derail_ros.engine.track import Track
    from derail_ros.engine.warming import warm_up

_LAZY = {
    "ENERGY_ENTRIES": "simulation",
    "Outcome": "sample",
    "Sample": "sample",
    "Simulation": "simulation",
    "Track": "track",
    "warm_up": "warming",
}

__all__ = [
    "ENERGY_ENTRIES",
    "METHODS",
    "BrakeParams",
    "BrakeTrigger",
    "BrakeUnit",
    "Car",
    "Collision",
    "Command",
    "CommandError",
    "ConstraintError",
    "ContactParams",
    "CouplerType",
    "DerailError",
    "DerailmentParams",
    "Event",
    "EventKind",
    "GroundParams",
    "InitiationParams",
    "IntegrationParams",
    "LateralForce",
    "NonFiniteStateError",
    "Outcome",
    "ParameterError",
    "Sample",
    "Simulation",
    "SimulationError",
    "StateFormatError",
    "StepSizeError",
    "Track",
    "TrackEndError",
    "TrackParams",
    "TrackSegment",
    "TrainParams",
    "VariantParams",
    "warm_up",
]


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        module = importlib.import_module(f"derail_ros.engine.{_LAZY[name]}")
        return getattr(module, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
