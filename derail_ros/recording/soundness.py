"""Which messages can be believed.

What damage or another program has left in a message may still decode. A message whose numbers
are none, or whose lists do not match, is left out like one that cannot be read.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

LARGEST = 1.0e12
"""No quantity of a train that is shown is larger than this, in SI units."""


ENERGY_ENTRIES = (
    "initial",
    "kinetic",
    "striker_elastic",
    "knuckle_elastic",
    "work_brakes",
    "work_ground_trucks",
    "work_ground_body",
    "work_collisions",
    "work_striker_dampers",
    "work_knuckles_released",
    "work_external",
    "stabilization_net",
    "stabilization_gross",
    "residual",
)
"""Entries of the energy ledger in its message, J."""


@dataclass(frozen=True)
class _Rule:
    """What must hold of the fields that are used of a message.

    Attributes
    ----------
    numbers : finite, and no larger than anything real
    or_none : the same, or NaN: "there is none"
    positive : finite and above zero
    alike : lists with as many entries each
    """

    numbers: tuple[str, ...] = ()
    or_none: tuple[str, ...] = ()
    positive: tuple[str, ...] = ()
    alike: tuple[tuple[str, ...], ...] = ()


RULES = {
    "TrainState": _Rule(
        numbers=(
            "time",
            "x",
            "y",
            "yaw",
            "vx",
            "vy",
            "yaw_rate",
            "coupler_angle_front",
            "coupler_angle_rear",
            "brake_force",
            "largest_corner_force",
        ),
        alike=(
            (
                "x",
                "y",
                "yaw",
                "vx",
                "vy",
                "yaw_rate",
                "coupler_angle_front",
                "coupler_angle_rear",
                "truck_status_front",
                "truck_status_rear",
                "brake_force",
                "largest_corner_force",
            ),
        ),
    ),
    "CouplerStates": _Rule(numbers=("time",)),
    "EnergyLedger": _Rule(numbers=("time", *ENERGY_ENTRIES)),
    "TrainEvent": _Rule(
        numbers=("time",), or_none=("x", "y", "track_coordinate", "speed", "value")
    ),
    "Collision": _Rule(
        numbers=(
            "start_time",
            "peak_corner_force",
            "peak_corner_force_time",
            "peak_resultant_force",
            "peak_resultant_force_time",
            "closing_speed",
            "x",
            "y",
            "normal_x",
            "normal_y",
            "angle",
            "energy_taken_out",
        ),
        or_none=("end_time",),
    ),
    "Outcome": _Rule(
        numbers=(
            "time",
            "duration",
            "peak_corner_force",
            "peak_resultant_force",
            "car_peak_force",
            "scene_length",
            "scene_width",
            "scene_area",
            "max_coupler_gap",
            "max_truck_offset",
        ),
        or_none=(
            "derailment_time",
            "derailment_speed",
            "peak_corner_force_time",
            "car_peak_time",
            "rear_part_track_coordinate",
            "energy_residual_relative",
            "severity",
        ),
        alike=(
            (
                "car_peak_force",
                "car_peak_other_car",
                "car_peak_time",
                "derailment_time",
                "derailment_speed",
            ),
        ),
    ),
    "Consist": _Rule(
        numbers=(
            "initial_speed",
            "truck_distance",
            "pivot_distance",
            "coupler_length_front",
            "coupler_length_rear",
        ),
        positive=("mass", "length", "width", "represents_cars"),
        alike=(
            (
                "mass",
                "length",
                "width",
                "pivot_distance",
                "truck_distance",
                "coupler_length_front",
                "coupler_length_rear",
                "represents_cars",
                "car_name",
                "car_type",
                "contents",
                "coupler_type_front",
                "coupler_type_rear",
            ),
        ),
    ),
    "Track": _Rule(
        numbers=(
            "s",
            "x",
            "y",
            "heading",
            "curvature",
            "rail_break_coordinate",
            "rail_break_x",
            "rail_break_y",
            "rail_break_time",
        ),
        alike=(
            ("s", "x", "y", "heading", "curvature"),
            ("rail_break_coordinate", "rail_break_x", "rail_break_y", "rail_break_time"),
        ),
    ),
}


def believable(kind: str, message: Any) -> bool:
    """Whether the numbers of a message (``derail_msgs/msg/<kind>``) can be those of a train."""
    rule = RULES.get(kind)
    if rule is None:
        return True
    if any(len({len(getattr(message, f)) for f in fields}) > 1 for fields in rule.alike):
        return False
    numbers = _together(message, rule.numbers)
    # A comparison with NaN is false.
    if not bool((np.abs(numbers) <= LARGEST).all()):
        return False
    some = _together(message, rule.or_none)
    if not bool((np.isnan(some) | (np.abs(some) <= LARGEST)).all()):
        return False
    above = _together(message, rule.positive)
    if not bool(((above > 0.0) & (above <= LARGEST)).all()):
        return False
    if kind == "Outcome" and message.peak_car_a and np.isnan(message.peak_corner_force_time):
        return False
    if kind == "Track":
        return len(message.s) != 1 and bool((np.diff(message.s) > 0.0).all())
    return kind not in ("TrainState", "Consist") or len(getattr(message, rule.alike[0][0])) > 0


def _together(message: Any, fields: tuple[str, ...]) -> np.ndarray[Any, np.dtype[np.float64]]:
    if not fields:
        return np.zeros(0)
    return np.concatenate(
        [np.atleast_1d(np.asarray(getattr(message, f), dtype=np.float64)) for f in fields]
    )
