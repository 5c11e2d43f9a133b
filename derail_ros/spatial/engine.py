"""The engine in three dimensions as ``derail_ros.models`` offers it."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

from derail_ros.vocabulary.errors import ParameterError
from derail_ros.vocabulary.params import TrainParams

if TYPE_CHECKING:
    from derail_ros.spatial.simulation import SpatialSimulation

INSTALL = "needs MuJoCo: pip install 'derail_ros[spatial]'"
"""How to have it."""


def _simulation() -> type[SpatialSimulation]:
    try:
        from derail_ros.spatial.simulation import SpatialSimulation
    except ModuleNotFoundError as error:
        if error.name != "mujoco":
            raise
        raise ParameterError("model", f"spatial {INSTALL}") from None
    return SpatialSimulation


class SpatialEngine:
    """Cars as free bodies, moved by MuJoCo."""

    name = "spatial"
    words = "three dimensions, moved by MuJoCo"
    features = frozenset({"rail_breaks", "brakes", "collisions", "energy", "height"})

    def build(self, params: TrainParams) -> SpatialSimulation:
        """A run at its start."""
        return _simulation()(params)

    def load(self, data: bytes) -> SpatialSimulation:
        """A run from its bytes."""
        return _simulation().from_bytes(data)

    def warm_up(self, progress: Any = None) -> None:
        """Compile the kernels."""
        from derail_ros.engine.warming import small_train

        try:
            simulation = _simulation()
        except ParameterError:  # `build` tells
            return
        simulation(small_train()).advance_steps(1)

    def source_hash(self) -> str:
        """Hash of this engine's sources and the planar engine's, whose tables it uses."""
        from derail_ros.engine.jit import source_hash

        return _digest(source_hash())

    def engine_hash(self) -> str:
        """The same with MuJoCo's version, the compiler's and the processor."""
        import mujoco

        from derail_ros.engine.jit import kernels_hash

        return _digest(f"{kernels_hash()} {mujoco.__version__}")


def _digest(text: str) -> str:
    digest = hashlib.sha256(text.encode())
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


ENGINE = SpatialEngine()
