"""The content of ``/diagnostics`` for a simulator."""

from __future__ import annotations

import enum
import math
from typing import Any

from derail_ros.nodes.core import NO_RUN, SimulatorCore, State
from derail_ros.recording.session import Session
from msg_adapters import reports
from msg_adapters.definitions import serialize

EVERY = 1.0
"""Wall time between two messages, s."""
TOO_SLOW = 0.95
"""A run slower than this share of its speed factor is warned of."""


class Level(enum.IntEnum):
    """Levels of ``diagnostic_msgs/DiagnosticStatus``."""

    OK = 0
    WARN = 1
    ERROR = 2


class Diagnostics:
    """Looks at a simulator once a second.

    Attributes
    ----------
    due : wall time of the next message, s
    simulated : simulation time since the last message, s; the loop adds to it
    """

    def __init__(self, core: SimulatorCore, now: float) -> None:
        self.due = 0.0
        self.simulated = 0.0
        self._core = core
        self._since = now
        self._steps = 0
        self._step_size = math.nan

    def message(self, now: float) -> bytes:
        """CDR bytes of ``diagnostic_msgs/DiagnosticArray`` at a wall time (s)."""
        core, settings, session = self._core, self._core.settings, self._core.session
        factor = self.simulated / max(now - self._since, 1e-9)
        # Nothing can be said of a second during which the pace changed.
        steady = core.state == State.PLAYING and core.pace.changed < self._since
        level, message = Level.OK, core.state.name.lower()
        if session is None:
            message = NO_RUN
        elif session.finished:
            message = f"the run has ended: {session.status}"
        elif steady and factor < TOO_SLOW * settings.speed_factor:
            level = Level.WARN
            message = f"slower than asked: {factor:.2f} instead of {settings.speed_factor:g}"
        if core.twins:
            level = max(level, Level.WARN)
            message += f"; another node publishes {', '.join(core.twins)} as well"
        if error := core.failure or core.recording.error:
            level, message = Level.ERROR, error
        values: dict[str, Any] = {
            "state": core.state.name.lower(),
            "real_time_factor_asked": settings.speed_factor,
            "real_time_factor": factor,
            "overruns": core.pace.overruns,
            "refused_commands": core.log.refused,
            "state_rate": settings.state_rate if session is None else session.rates.state,
            "simulation_time": core.stamp / 1e9,
            "recording": core.recording.path,
        }
        if session is not None:
            values |= self._of_run(session)
        self._since, self.simulated, self.due = now, 0.0, now + EVERY
        name = settings.full_name
        return serialize(
            reports.diagnostics(
                core.stamp, f"{name}: simulation", level, message, values, f"derail_ros {name}"
            )
        )

    def _of_run(self, session: Session) -> dict[str, Any]:
        outcome = session.simulation.outcome()
        steps = session.step - self._steps
        if steps > 0 and self.simulated > 0.0:
            self._step_size = self.simulated / steps
        self._steps = session.step
        return {
            "run_id": session.context.run_id,
            "scenario": session.prepared.name,
            "run_time": session.time,
            "status": session.status,
            "cars": session.simulation.n_cars,
            "cars_derailed": outcome.cars_derailed,
            "steps": session.step,
            "rejected_steps": outcome.rejected_steps,
            "mean_step_size": self._step_size,
            "max_coupler_gap": outcome.max_coupler_gap,
            "max_truck_offset": outcome.max_truck_offset,
            "energy_residual_relative": outcome.energy_residual,
        }
