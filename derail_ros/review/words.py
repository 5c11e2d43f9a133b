"""A recorded run in words."""

from __future__ import annotations

from derail_ros.recording.recorded_run import RecordedRun
from derail_ros.vocabulary import ledger
from derail_ros.vocabulary.ledger import NO_ENERGY
from derail_ros.vocabulary.outcome import derailed
from derail_ros.vocabulary.words import (
    cars,
    coordinate,
    energy,
    force,
    number_list,
    place,
    speed,
)

__all__ = [
    "NO_ENERGY",
    "cars",
    "coordinate",
    "derailed",
    "energy",
    "force",
    "number_list",
    "place",
    "sentence",
    "shares",
    "speed",
    "stopped_by",
]


def sentence(run: RecordedRun) -> str:
    """The outcome in a line."""
    return run.outcome.text


def shares(run: RecordedRun) -> list[tuple[str, str, float, float]]:
    """What took the energy: entry, words, J, share of the initial energy; the largest first."""
    return [(e.key, e.words, taken, share) for e, taken, share in ledger.shares(run.ledger())]


def stopped_by(run: RecordedRun) -> str:
    """What stopped the train, in a sentence or two."""
    return ledger.stopped_by(run.ledger())
