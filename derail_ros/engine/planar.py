"""The planar engine as ``derail_ros.models`` offers it."""

from __future__ import annotations

from typing import Any

from derail_ros.engine.jit import kernels_hash, source_hash
from derail_ros.engine.simulation import PlanarSimulation
from derail_ros.engine.warming import warm_up
from derail_ros.vocabulary.params import TrainParams


class PlanarEngine:
    """Toma's planar multibody model."""

    name = "planar"
    words = "E. E. Toma 1998, the main model"
    features = frozenset({"rail_breaks", "brakes", "collisions", "energy"})

    def build(self, params: TrainParams) -> PlanarSimulation:
        """A run at its start."""
        return PlanarSimulation(params)

    def load(self, data: bytes) -> PlanarSimulation:
        """A run from its bytes."""
        return PlanarSimulation.from_bytes(data)

    def warm_up(self, progress: Any = None) -> Any:
        """Compile the kernels."""
        return warm_up(progress)

    def source_hash(self) -> str:
        """Hash of the engine's sources."""
        return source_hash()

    def engine_hash(self) -> str:
        """Hash of the engine's sources, the compiler's versions and the processor."""
        return kernels_hash()


ENGINE = PlanarEngine()
