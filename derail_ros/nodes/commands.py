"""Requests of clients: their limits, their answers, their log."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from derail_ros.recording.session import Session
from derail_ros.vocabulary.errors import CommandError
from derail_ros.vocabulary.events import Command
from derail_ros.vocabulary.simulation import COMMANDS
from derail_ros.vocabulary.status import BRAKE_MODES, BRAKE_SOURCES
from msg_adapters import reports
from msg_adapters.common import RunContext
from msg_adapters.definitions import serialize

MAX_COMMANDS = 10_000
"""Commands that a run accepts: each is kept, so that the run can be repeated."""
MAX_BREAKS = 1000
"""Rail breaks of a run: each is checked in every step and sent with each new one."""
SAME_PLACE = 1e-6
"""Breaks closer than this are at the same place, m."""
MAX_REFUSED = 1000
"""Refused commands of a run that its manifest lists; the others are counted."""
MAX_TEXT = 1000
"""Characters of a text from a client that are kept."""


class Refusal(ValueError):
    """A request is refused; the text is the reason."""


@dataclass(frozen=True)
class Request:
    """A request of a client: command, fields, name of the caller."""

    command: str
    fields: Mapping[str, Any]
    caller: str = ""
    service: str = ""  # that was called, if it has another name than the command


@dataclass(frozen=True)
class Answer:
    """Answer to a request: applied at simulation time ``stamp`` (ns), after ``step`` steps.

    ``value`` is a number that belongs to the answer: the coordinate of a break (m).
    """

    success: bool
    message: str
    stamp: int
    step: int
    run_id: str = ""
    value: float = math.nan


# --- requests --------------------------------------------------------------------------------


def one_of(name: str, value: int, number: int) -> None:
    """Refuse a number that is not one of 0 to ``number`` - 1."""
    if not 0 <= value < number:
        raise Refusal(f"{name} must be 0 to {number - 1}, got {value}")


def rail_break(coordinate: float, car: int) -> dict[str, Any]:
    """Arguments of ``Simulation.inject_rail_break``, or a refusal of two places and of none.

    With a car, a coordinate of 0 (a field that was left out) is no place.
    """
    if not math.isfinite(coordinate):
        raise Refusal(f"track_coordinate must be a finite number, got {coordinate}")
    if not car:
        return {"coordinate": float(coordinate)}
    if coordinate != 0.0:
        raise Refusal(
            f"track_coordinate {coordinate:g} m and car {car} are two places; give one of them"
        )
    return {"car": int(car)}


def emergency_brake(mode: int, source: int, car: int, delay: float) -> dict[str, Any]:
    """Arguments of ``Simulation.trigger_emergency_brake``, or a refusal."""
    one_of("mode", mode, len(BRAKE_MODES))
    one_of("source", source, len(BRAKE_SOURCES))
    if not math.isfinite(delay) or delay < 0.0:
        raise Refusal(f"delay_s must be a finite number from 0 up, got {delay}")
    by_car = BRAKE_SOURCES.index("car")
    if car and source != by_car:
        raise Refusal(f"car {car} is allowed only with source {by_car} (car)")
    if not car and source == by_car:
        raise Refusal(f"source {by_car} (car) needs the field car, a number from 1 up")
    return {
        "mode": BRAKE_MODES[mode],
        "source": BRAKE_SOURCES[source],
        "car": int(car),
        "delay": float(delay),
    }


def apply(session: Session, name: str, arguments: Mapping[str, Any]) -> tuple[str, float]:
    """Apply a command at the present step boundary; returns message and value of the answer.

    Raises
    ------
    Refusal, CommandError
        If the run does not accept it.
    """
    simulation, last = session.simulation, session.params.n_train
    if session.finished or simulation.ended:
        raise Refusal(over(session))
    if int(arguments.get("car", 0)) > last:
        raise Refusal(f"car must be 1 to {last}, the cars of the train, got {arguments['car']}")
    if len(simulation.commands) >= MAX_COMMANDS:
        raise Refusal(f"the run has had {MAX_COMMANDS} commands, the most it accepts")
    broken = list(simulation.rail_breaks)
    if name == "inject_rail_break" and len(broken) >= MAX_BREAKS:
        raise Refusal(f"the track has {MAX_BREAKS} breaks, the most it can have")
    repeated = any(_repeats(arguments, simulation.time, former) for former in simulation.commands)
    try:
        place = session.command(name, **arguments)
    except CommandError as error:
        # The engine's name of the field is not that of the service.
        where = {"coordinate": "track_coordinate: "}.get(error.field, "")
        raise Refusal(f"{where}{error.reason}" if where else str(error)) from None
    if name != "inject_rail_break":
        changes = "; it changes nothing, the same was commanded before" if repeated else ""
        return f"applied{changes}", math.nan
    message = f"rail break at {place + 0.0:.3f} m"  # without the sign of zero
    if any(abs(place - other) < SAME_PLACE for other in broken):
        message += "; the rail was already broken there"
    return message, float(place)


def over(session: Session) -> str:
    """Why nothing more can be done with a run that is over."""
    how = "failed" if session.failure else "ended"
    return f"the run has {how}; reset it or load another"


def _repeats(arguments: Mapping[str, Any], now: float, former: Command) -> bool:
    """Whether a brake is one that was commanded before and is made no earlier than that."""
    if former.name != "trigger_emergency_brake" or "mode" not in arguments:
        return False
    same = all(former.arguments[key] == arguments[key] for key in ("mode", "source", "car"))
    return same and former.time + float(str(former.arguments["delay"])) <= now + arguments["delay"]


# --- the log ---------------------------------------------------------------------------------


def shortened(value: Any) -> Any:
    """A value for logs and manifests: the end of a long text is left out."""
    if isinstance(value, str) and len(value) > MAX_TEXT:
        return f"{value[:MAX_TEXT]}... ({len(value)} characters)"
    return value


class CommandLog:
    """Answers requests, and logs them: as messages, in the manifest, refusals to the user too."""

    def __init__(self, emit: Callable[[str, int, bytes], None], log: Any) -> None:
        self.refused = 0
        self._emit = emit
        self._log = log
        self._sequence = 0

    def answer(
        self,
        session: Session | None,
        context: RunContext,
        request: Request,
        success: bool,
        message: str,
        *,
        value: float = math.nan,
        accepted: bool | None = None,
    ) -> Answer:
        """Log a request and answer it; ``accepted`` differs from ``success`` if part was done."""
        accepted = success if accepted is None else accepted
        command, message = request.command, shortened(message)
        fields = {name: shortened(value) for name, value in request.fields.items()}
        time, step = 0.0, 0
        if session is not None:
            # Commands act at the end of the last step, everything else at a tick.
            time = session.simulation.time if command in COMMANDS else session.time
            step = session.step
        entry = reports.command_log(
            context=context,
            step=step,
            time=time,
            sequence=self._sequence,
            command=command,
            request=fields,
            caller=shortened(request.caller),
            accepted=accepted,
            answer=message,
        )
        self._sequence += 1
        stamp = context.stamp(time)
        self._emit("command_log", stamp, serialize(entry))
        if accepted and command in COMMANDS:
            self._log.info(f"{command} at {time:.3f} s: {message}")
        if not accepted:
            self.refused += 1
            self._log.warning(f"{request.service or command} refused: {message}")
            if session is not None:
                refused = {"command": command, "request": fields, "reason": message}
                session.refuse(refused | {"step": step, "time": time}, MAX_REFUSED)
        return Answer(success, message, stamp, step, context.run_id, value)
