"""Errors of engines: all that an engine raises on purpose derives from :class:`DerailError`."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from derail_ros.vocabulary.simulation import Simulation


class DerailError(Exception):
    """Base of all errors raised on purpose by the engine."""


class ParameterError(DerailError, ValueError):
    """A parameter is out of its range; ``field`` names it.

    Parameters
    ----------
    field
        Dotted name of the parameter, for example ``"cars.3.mass"``.
    reason
        What is wrong with it, as a sentence fragment.
    """

    def __init__(self, field: str, reason: str) -> None:
        super().__init__(f"{field}: {reason}")
        self.field = field
        self.reason = reason


class CommandError(DerailError, ValueError):
    """A command was refused; the run continues unchanged."""

    def __init__(self, field: str, reason: str) -> None:
        super().__init__(f"{field}: {reason}")
        self.field = field
        self.reason = reason


class StateFormatError(DerailError, ValueError):
    """Bytes given to ``Simulation.from_bytes`` are not a state that this version reads."""


class SimulationError(DerailError, RuntimeError):
    """The run stopped because it cannot go on.

    The simulation keeps its last accepted state, which can be saved with
    ``simulation.to_bytes()`` and inspected.

    Attributes
    ----------
    simulation : the stopped run, at its last accepted step
    time : simulation time of that step, s
    step : number of accepted steps
    """

    def __init__(self, message: str, simulation: Simulation | None = None) -> None:
        super().__init__(message)
        self.simulation = simulation
        self.time = float("nan") if simulation is None else simulation.time
        self.step = -1 if simulation is None else simulation.step_count


class NonFiniteStateError(SimulationError):
    """A coordinate, velocity or acceleration is not a finite number."""


class StepSizeError(SimulationError):
    """The integrator asked for a step below its floor."""


class ConstraintError(SimulationError):
    """The constraint equations are singular or their projection did not converge."""


class TrackEndError(SimulationError):
    """A truck on the rails left the end of the alignment."""
