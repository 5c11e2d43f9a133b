"""Checks whether messages are plausible.

Damage, or another program, can leave a message that decodes. A message with numbers that no train
has, or with lists of different lengths, is left out like one that cannot be decoded.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from derail_ros.vocabulary.status import STATUSES
from msg_adapters.definitions import fields_of

F64 = NDArray[np.float64]

LARGEST = 1.0e12
"""No quantity of a train is larger than this, SI units."""

MAY_BE_NAN = {
    "Collision": ("end",),
    "CouplerStates": ("axial_force",),
    "TrainEvent": ("x", "y", "track_coordinate", "speed", "value"),
    "TrainState": ("corner_gap", "corner_closing_speed"),
}
"""Fields of ``derail_msgs/msg/<kind>`` in which NaN says that there is none."""
POSITIVE = {"Consist": ("mass", "length", "width", "represents_cars")}
LEDGERS = ("entries", "energy")
"""Lists of quantities in which every number is finite, as is all that a train is told by."""
GROUPS = ("corner_", "coupling_", "rail_break_", "striker_")
"""Lists of a message have one length, and those whose names begin like this one of their own."""
FINITE = (
    "peak_force_N",
    "peak_resultant_N",
    "scene_length_m",
    "scene_width_m",
    "scene_area_m2",
    "car_peak_force_N",
    "car_peak_other",
    "x_m",
    "y_m",
)
"""Quantities that every outcome has."""
FREE = {"TrainEvent": ("cars",), "Consist": ("files",), "Outcome": ("derailed_cars",)}
"""Lists of any length."""


@dataclass
class _Fields:
    """Fields of a kind of message: numbers and quantities, finite or perhaps NaN, and lists."""

    finite: list[str] = field(default_factory=list)
    or_nan: list[str] = field(default_factory=list)
    finite_quantities: list[str] = field(default_factory=list)
    quantities: list[str] = field(default_factory=list)
    lists: list[tuple[str, str]] = field(default_factory=list)  # with the group of one length


@functools.cache
def _sorted_fields(kind: str, msgtype: str) -> _Fields:
    found = _Fields()
    for name, of in fields_of(msgtype):
        if of.startswith("float64"):
            (found.or_nan if name in MAY_BE_NAN.get(kind, ()) else found.finite).append(name)
        if of == "derail_msgs/msg/Quantity[]":
            known = name in LEDGERS or kind == "Consist"
            (found.finite_quantities if known else found.quantities).append(name)
        elif of.endswith("[]") and name not in FREE.get(kind, ()):
            group = next((g for g in GROUPS if name.startswith(g)), "")
            found.lists.append((name, group))
    return found


def is_plausible(kind: str, message: Any) -> bool:
    """Whether a message (``derail_msgs/msg/<kind>``) can be that of a train."""
    fields = _sorted_fields(kind, message.__msgtype__)
    lengths: dict[str, int] = {}
    for name, group in fields.lists:
        size = len(getattr(message, name))
        if lengths.setdefault(group, size) != size:
            return False
    # A comparison with NaN is false.
    for values in _joined(message, fields.finite, fields.finite_quantities):
        if not (np.abs(values) <= LARGEST).all():
            return False
    for values in _joined(message, fields.or_nan, fields.quantities):
        if (np.abs(values) > LARGEST).any():
            return False
    if any(not (getattr(message, name) > 0).all() for name in POSITIVE.get(kind, ())):
        return False
    if kind in ("TrainState", "Consist"):
        return lengths[""] > 0
    if kind == "Track":
        return len(message.s) != 1 and bool((np.diff(message.s) > 0.0).all())
    return kind != "Outcome" or _is_outcome(message)


def _is_outcome(message: Any) -> bool:
    told = {q.key: np.asarray(q.values) for q in (*message.measures, *message.cars)}
    if not all(len(told.get(key, ())) and np.isfinite(told[key]).all() for key in FINITE):
        return False
    known = {key for key, values in told.items() if np.isfinite(values).any()}
    timed = not len(told.get("peak_force_pair", ())) or "peak_force_time_s" in known
    one_length = len({len(q.values) for q in message.cars}) == 1
    return message.status_name in STATUSES and one_length and timed


def _joined(message: Any, numbers: list[str], quantities: list[str]) -> list[F64]:
    """All numbers of these fields in one array; none without any."""
    values = [np.atleast_1d(getattr(message, name)) for name in numbers]
    values += [np.asarray(q.values) for name in quantities for q in getattr(message, name)]
    return [np.concatenate(values)] if values else []
