"""Statuses of a run, force levels and names, each in one table."""

from __future__ import annotations

from dataclasses import dataclass

RUNNING = "running"
AT_REST = "at rest"
TIME_LIMIT = "time limit"
VOID = "void"
FAILED = "failed"
STOPPED = "stopped"
CUT_OFF = "cut off"


@dataclass(frozen=True)
class Status:
    """A status of a run.

    Attributes
    ----------
    word : its name, in JSON, messages and tables
    number : its number in messages
    ended : the run takes no further step
    by_itself : the computation ended, nobody ended it
    words : how the run ended, before the time; for a run with a time to rest before the duration
    """

    word: str
    number: int
    ended: bool
    by_itself: bool
    words: str


STATUSES: dict[str, Status] = {
    s.word: s
    for s in (
        Status(RUNNING, 0, False, False, "still running at"),
        Status(AT_REST, 1, True, True, "at rest after"),
        Status(TIME_LIMIT, 2, True, True, "ended by its time limit, not at rest, at"),
        Status(VOID, 3, True, True, "void (a virtual body reached a break) at"),
        Status(FAILED, 4, True, True, "failed at"),
        Status(STOPPED, 5, True, False, "stopped by a command at"),
        # Of a recording that ends before its run does.
        Status(CUT_OFF, 6, False, False, "recorded up to"),
    )
}
"""All statuses by their names."""

STATUS_OF_NUMBER = {s.number: s.word for s in STATUSES.values()}

RUPTURE_FORCE = 5.0e6
"""A tank car struck this hard is known to rupture (source), N."""
CERTAIN_RUPTURE_FORCE = 10.0e6
"""The source's own conservative level, N."""

ENDS = ("front", "rear")
"""Trucks of a car, in the order of all arrays that have one entry a truck."""
CORNERS = ("front left", "front right", "rear left", "rear right")
"""Corners of a car, in the order of all arrays that have one entry a corner."""

BRAKE_MODES = ("conventional", "instant", "traction_limited", "instant_traction_limited")
"""Modes of an emergency application, by their numbers in ``TriggerEmergencyBrake``."""
BRAKE_SOURCES = ("front", "rear", "both_ends", "car")
"""Where an emergency application starts, by the numbers in ``TriggerEmergencyBrake``."""
