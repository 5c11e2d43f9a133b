"""The interface of a run, which every engine implements.

Sessions, recordings, nodes, reviews and studies speak to :class:`Simulation` and :class:`Engine`
and to nothing behind them. ``derail_ros.models`` finds an engine by its name.
"""

from __future__ import annotations

import hashlib
import math
from abc import ABC, abstractmethod
from typing import Any, ClassVar, Protocol

from derail_ros.vocabulary.errors import CommandError
from derail_ros.vocabulary.events import Collision, Command, Event
from derail_ros.vocabulary.outcome import Outcome
from derail_ros.vocabulary.params import TrainParams
from derail_ros.vocabulary.sample import Sample
from derail_ros.vocabulary.scene import Line
from derail_ros.vocabulary.status import RUNNING, STATUSES


class Simulation(ABC):
    """One run.

    The run takes its own steps, whatever output is asked for: ``advance_to(t)`` returns with
    ``time >= t`` and ``sample(t)`` interpolates. Commands apply at the end of the last step. The
    same parameters and commands at the same steps give the same run to the bit on one machine and
    set of versions.

    Attributes
    ----------
    params : parameters of the run
    track : the centre line
    """

    params: TrainParams
    track: Line

    # --- what every engine gives --------------------------------------------------------------

    @property
    @abstractmethod
    def time(self) -> float:
        """End of the last accepted step, s."""

    @property
    @abstractmethod
    def previous_time(self) -> float:
        """Beginning of the last accepted step, s."""

    @property
    @abstractmethod
    def step_count(self) -> int:
        """Accepted steps so far."""

    @property
    @abstractmethod
    def status(self) -> str:
        """A key of ``status.STATUSES``."""

    @abstractmethod
    def advance_to(self, t: float) -> list[Event]:
        """Take steps until ``time >= t`` or the run ends; returns the new events.

        Raises
        ------
        SimulationError
            The run cannot go on; it keeps its last accepted state.
        """

    @abstractmethod
    def advance_steps(self, n: int) -> list[Event]:
        """Take ``n`` steps (fewer when the run ends); returns the new events."""

    @abstractmethod
    def sample(self, t: float | None = None) -> Sample:
        """State and forces at ``t`` within the last step (default: its end).

        After the end of the run any later ``t`` gives the final state.
        """

    @abstractmethod
    def outcome(self) -> Outcome:
        """Result of the run so far."""

    @abstractmethod
    def to_bytes(self) -> bytes:
        """The whole run: parameters, state, events and commands."""

    @classmethod
    @abstractmethod
    def from_bytes(cls, data: bytes) -> Simulation:
        """Restore a run from `to_bytes`; it continues as the saved one would have, to the bit.

        Raises
        ------
        StateFormatError
            The bytes are something else, damaged, or of another version.
        """

    # --- what an engine may leave as it is ----------------------------------------------------

    @property
    def n_cars(self) -> int:
        """Number of bodies."""
        return len(self.params.cars)

    @property
    def step_size(self) -> float:
        """Size of the last accepted step, s."""
        return self.time - self.previous_time

    @property
    def ended(self) -> bool:
        """Whether the run has ended."""
        return STATUSES[self.status].ended

    @property
    def events(self) -> list[Event]:
        """All events so far, in the order of their time."""
        return []

    @property
    def commands(self) -> list[Command]:
        """Commands applied so far."""
        return []

    @property
    def collisions(self) -> list[Collision]:
        """All contacts so far, in the order of their beginning."""
        return []

    def new_collisions(self) -> list[Collision]:
        """Contacts whose peak has passed, or that have ended, since the last call."""
        return []

    @property
    def rail_breaks(self) -> list[float]:
        """Track coordinates of all breaks so far, m."""
        return []

    @property
    def statistics(self) -> dict[str, int]:
        """Counters of the computation."""
        return {"steps": self.step_count}

    def run(self) -> Outcome:
        """Run to the end."""
        self.advance_to(math.inf)
        return self.outcome()

    def inject_rail_break(self, coordinate: float | None = None, car: int | None = None) -> float:
        """Break the rail at a track coordinate (m), or just ahead of a car's front truck.

        Returns the track coordinate. Trucks derail as they pass it, either way.

        Raises
        ------
        CommandError
            No such place or car, the run has ended, or this engine has no rail breaks.
        """
        raise CommandError("model", f"{self.params.model} has no rail breaks")

    def trigger_emergency_brake(
        self,
        mode: str = "conventional",
        source: str = "front",
        car: int = 0,
        delay: float = 0.0,
    ) -> None:
        """Start an emergency application; a second one can only raise each car's brake.

        Parameters
        ----------
        mode : one of ``status.BRAKE_MODES``
        source : one of ``status.BRAKE_SOURCES``
        car : the car, for that source
        delay : s until it is made

        Raises
        ------
        CommandError
            Bad mode, source, car or delay, the run has ended, or this engine has no brakes.
        """
        raise CommandError("model", f"{self.params.model} has no brakes")

    def apply(self, command: Command) -> None:
        """Apply a logged command again, at the step at which it was logged.

        Takes the steps up to there first.
        """
        if command.name not in COMMANDS:
            raise CommandError("name", f"there is no command {command.name!r}")
        self._go_to(command.step)
        getattr(self, command.name)(**command.arguments)

    def _go_to(self, step: int) -> None:
        """Take the steps up to a step."""
        if step < self.step_count:
            raise CommandError("step", f"step {step} has passed ({self.step_count})")
        self.advance_steps(step - self.step_count)

    def copy(self) -> Simulation:
        """An independent run at the same state."""
        return type(self).from_bytes(self.to_bytes())

    def state_hash(self) -> str:
        """SHA-256 (hex) of everything that affects the rest of the run."""
        return hashlib.sha256(self.to_bytes()).hexdigest()

    def _refuse_when_ended(self) -> None:
        if self.status != RUNNING:
            raise CommandError("run", f"the run has ended ({self.status})")


COMMANDS = ("inject_rail_break", "trigger_emergency_brake")
"""Commands that change a run: methods of :class:`Simulation`."""


class Engine(Protocol):
    """An engine: it computes runs.

    Attributes
    ----------
    name : of the model, as in ``model:`` of a scenario
    words : short description
    features : its abilities, from :data:`FEATURES`
    """

    name: ClassVar[str]
    words: ClassVar[str]
    features: ClassVar[frozenset[str]]

    def build(self, params: TrainParams) -> Simulation:
        """A run at its start.

        Raises
        ------
        ParameterError
            A parameter is out of its range or does not fit the others.
        """

    def load(self, data: bytes) -> Simulation:
        """A run from the bytes of ``Simulation.to_bytes``."""

    def warm_up(self, progress: Any = None) -> Any:
        """Do the slow work that is needed once on a machine (compile kernels)."""

    def source_hash(self) -> str:
        """Hash of this engine's sources, equal on all machines."""

    def engine_hash(self) -> str:
        """Hash of everything that affects the results: equal hashes compute equal bits."""


FEATURES = {
    "rail_breaks": "breaks the rail during a run",
    "brakes": "applies the brakes during a run",
    "collisions": "computes collisions between cars",
    "energy": "keeps an energy ledger",
    "height": "moves cars vertically, with roll and pitch",
}
"""Abilities of engines, in words."""
