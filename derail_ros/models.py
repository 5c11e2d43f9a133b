"""Engines by the name of their model (``model:`` in a scenario, ``--model`` on a command line)."""

from __future__ import annotations

import functools
import importlib
from importlib.metadata import EntryPoint, entry_points
from typing import TYPE_CHECKING, Any

from derail_ros.vocabulary.errors import ParameterError
from derail_ros.vocabulary.params import PLANAR, TrainParams

if TYPE_CHECKING:
    from derail_ros.vocabulary.simulation import Engine, Simulation

GROUP = "derail_ros.engines"
"""Entry points of this group (name = module:object) are engines of other packages."""

_ENGINES: dict[str, Any] = {
    PLANAR: "derail_ros.engine.planar:ENGINE",
    "spatial": "derail_ros.spatial.engine:ENGINE",
}


@functools.cache  # reading what is installed takes longer than reading a scenario
def _installed() -> dict[str, EntryPoint]:
    return {e.name: e for e in entry_points(group=GROUP)}


def names() -> list[str]:
    """Names of the models, the default one first."""
    return [*_ENGINES, *sorted(_installed().keys() - _ENGINES.keys())]


def register(engine: Engine) -> None:
    """Register an engine in this process."""
    _ENGINES[engine.name] = engine


def engine(name: str = PLANAR) -> Engine:
    """The engine of a model.

    Raises
    ------
    ParameterError
        There is no such model.
    """
    found = _ENGINES.get(name)
    if found is None and name in _installed():
        found = _installed()[name].load()
    if found is None:
        raise ParameterError("model", f"must be one of {', '.join(names())}, got {name}")
    if isinstance(found, str):  # imported at first use: kernels take a second to load
        module, _, attribute = found.partition(":")
        found = getattr(importlib.import_module(module), attribute)
    _ENGINES[name] = found
    return found


def rises(name: str) -> bool:
    """Whether a model computes heights of the cars."""
    return "height" in engine(name).features


def build(params: TrainParams) -> Simulation:
    """Build a run at its start, with the engine that the parameters name.

    Raises
    ------
    ParameterError
        A parameter is out of its range, does not fit the others, or there is no such model.
    """
    return engine(params.model).build(params)


def source_hash(name: str = PLANAR) -> str:
    """Hash of the sources of a model's engine, equal on all machines."""
    return engine(name).source_hash()


def engine_hash(name: str = PLANAR) -> str:
    """Hash of everything that affects a model's results, the processor included."""
    return engine(name).engine_hash()
