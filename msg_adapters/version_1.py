"""Messages of version 1, as recordings made before version 2 hold them, turned into today's."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from derail_ros.vocabulary.events import EventKind
from derail_ros.vocabulary.ledger import ENERGY_ENTRIES
from derail_ros.vocabulary.outcome import Outcome
from derail_ros.vocabulary.params import PLANAR
from derail_ros.vocabulary.sample import planar
from derail_ros.vocabulary.status import AT_REST
from msg_adapters.definitions import fields_of, message_class

LEDGER = {
    "kinetic": ("kinetic", 1.0),
    "striker": ("striker_elastic", 1.0),
    "knuckle": ("knuckle_elastic", 1.0),
    "initial": ("initial", 1.0),
    "brakes": ("work_brakes", -1.0),
    "ground_trucks": ("work_ground_trucks", -1.0),
    "ground_body": ("work_ground_body", -1.0),
    "collisions": ("work_collisions", -1.0),
    "striker_dampers": ("work_striker_dampers", -1.0),
    "knuckles_released": ("work_knuckles_released", -1.0),
    "external": ("work_external", 1.0),
    "stabilization_net": ("stabilization_net", 1.0),
    "stabilization_gross": ("stabilization_gross", 1.0),
    "residual": ("residual", -1.0),
}
"""Entry of the ledger -> field of version 1 and its sign: there, work on the cars was counted."""

WALLS = {0: "front end", 1: "left side", 2: "rear end", 3: "right side", 4: "corner"}
ENDS = ("", "front", "rear")


def upgraded(message: Any) -> Any:
    """A message of version 1 (``derail_msgs``) as one of version 2."""
    name = message.__msgtype__.rpartition("/")[2]
    return _UPGRADES[name](message)


def _like(m: Any, **changes: Any) -> Any:
    """The message of today with the fields that both have, and those given."""
    fields = dict(fields_of(m.__msgtype__))
    same = {name: getattr(m, name) for name in fields if hasattr(m, name) and name not in changes}
    return message_class(m.__msgtype__)(**same, **changes)


def _collision(m: Any) -> Any:
    return _like(
        m,
        final=m.is_final,
        object="",
        wall=WALLS.get(int(m.struck_wall), ""),
        start=m.start_time,
        end=m.end_time,
        peak_force=m.peak_corner_force,
        peak_time=m.peak_corner_force_time,
        peak_resultant=m.peak_resultant_force,
        peak_resultant_time=m.peak_resultant_force_time,
        z=0.0,
        normal_z=0.0,
        energy_lost=m.energy_taken_out,
    )


def _consist(m: Any) -> Any:
    return _like(m, model=PLANAR, files=[], more=[])


def _coupler_states(m: Any) -> Any:
    return _like(m, axial_force=np.full(len(m.coupled), math.nan), more=[])


def _energy(m: Any) -> Any:
    from msg_adapters.reports import ledger

    entries = {key: sign * getattr(m, name) for key, (name, sign) in LEDGER.items()}
    roles = [ENERGY_ENTRIES[key].role for key in LEDGER]
    return _like(m, entries=ledger(entries), roles=roles)


def _event(m: Any) -> Any:
    kind = str(m.kind_name)
    known = kind.upper() in EventKind.__members__
    return _like(
        m,
        kind=int(EventKind[kind.upper()]) if known else 255,
        end=ENDS[m.end] if m.end < len(ENDS) else "",
        cause="initial" if m.cause == "scenario" else m.cause,
        z=0.0,
        object="",
        more=[],
    )


def _track(m: Any) -> Any:
    return _like(m, z=np.zeros(len(m.s)), grade=np.zeros(len(m.s)), more=[])


def _state(m: Any) -> Any:
    flat = ("z", "roll", "pitch", "vz", "roll_rate", "pitch_rate", "az", "roll_acceleration",
            "pitch_acceleration")  # fmt: skip
    return _like(m, more=[], **{name: np.zeros(len(m.x)) for name in flat})


def _outcome(m: Any) -> Any:
    from msg_adapters.reports import outcome_fields

    pair = (int(m.peak_car_a), int(m.peak_car_b))
    outcome = Outcome(
        status=str(m.status_name),
        time=float(m.time),
        duration=float(m.duration) if m.status_name == AT_REST else math.nan,
        steps=int(m.step),
        rejected_steps=int(m.rejected_steps),
        derailed_cars=tuple(int(c) for c in m.derailed_cars),
        peak_force=float(m.peak_corner_force),
        peak_force_pair=pair if pair[0] else None,
        peak_force_time=float(m.peak_corner_force_time),
        peak_resultant=float(m.peak_resultant_force),
        car_peak_force=np.array(m.car_peak_force),
        car_peak_time=np.array(m.car_peak_time),
        car_peak_other=np.array(m.car_peak_other_car, dtype=np.int64),
        scene_length=float(m.scene_length),
        scene_width=float(m.scene_width),
        scene_area=float(m.scene_area),
        max_coupler_gap=float(m.max_coupler_gap),
        max_truck_offset=float(m.max_truck_offset),
        derail_time=np.array(m.derailment_time),
        derail_speed=np.array(m.derailment_speed),
        pose=planar(np.stack([m.x, m.y, m.yaw], axis=-1)),
        rear_part_first_car=int(m.rear_part_first_car),
        rear_part_coordinate=float(m.rear_part_track_coordinate),
        energy={"initial": float(m.energy_initial)},
        energy_residual=float(m.energy_residual_relative),
    )
    return _like(m, **outcome_fields(outcome))


_UPGRADES: dict[str, Callable[[Any], Any]] = {
    "Collision": _collision,
    "CommandLog": _like,
    "Consist": _consist,
    "CouplerStates": _coupler_states,
    "EnergyLedger": _energy,
    "Outcome": _outcome,
    "Track": _track,
    "TrainEvent": _event,
    "TrainState": _state,
}
