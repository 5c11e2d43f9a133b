"""The set of constants of a scenario, and how the calibrated one fills open fields."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from derail_ros.scenario.calibrated import Draw, load_calibrated
from derail_ros.scenario.resolve import KMH, Resolved, placed_bodies, rail_breaks
from derail_ros.scenario.schema import ScenarioModel

FIELDS: dict[str, tuple[str, tuple[str, ...]]] = {
    "brake_delay": ("brakes", ("delay_s",)),
    "brake_force": ("brakes", ("force_scale", "force_N", "law")),
    "ground": ("ground", ("scale", "c_s", "c_d", "c_v_s_per_m")),
    "push": ("initiation", ("lateral_force_N", "lateral_force_start_s")),
    "contact": ("contact", ("force_max_N", "inside")),
}
"""What ensembles draw -> its section, and the fields any of which settles it."""


def left_open(model: ScenarioModel) -> tuple[str, ...]:
    """The :data:`FIELDS` that a scenario does not give."""
    names = []
    for name, (section, keys) in FIELDS.items():
        waits = model.initiation.await_command and name in ("brake_delay", "push")
        unbraked = name == "brake_delay" and model.brakes.signal_source == "none"
        given = getattr(model, section).model_fields_set.intersection(keys)
        if not (given or waits or unbraked):
            names.append(name)
    return tuple(names)


def reach(resolved: Resolved) -> float:
    """Time until the first truck is off, s: until it reaches a break, at the initial speed."""
    model = resolved.model
    if model.initiation.derailed_trucks or not model.train.speed_kmh:
        return 0.0
    trucks = [
        model.initiation.position_m - place + end * 0.5 * block.trucks
        for place, block in placed_bodies(resolved)
        for end in (1.0, -1.0)
    ]
    ways = [b - t for b in rail_breaks(resolved) for t in trucks if t <= b]
    return min(ways, default=0.0) / (model.train.speed_kmh * KMH)


def values_of(resolved: Resolved, names: tuple[str, ...], draw: Draw) -> dict[str, dict[str, Any]]:
    """Values of a draw for the fields of ``names``: section -> field -> value."""
    model = resolved.model
    speed = max(model.train.speed_kmh * KMH, 0.1)
    begin = reach(resolved)
    every: dict[str, dict[str, Any]] = {
        "brake_delay": {"delay_s": min(begin + draw.delay(speed), 1e4)},
        "brake_force": {"law": "braking_ratio", "force_scale": min(draw.brake_force, 10.0)},
        "ground": {"scale": draw.ground},
        "push": {
            "lateral_force_N": draw.push,
            "lateral_force_start_s": begin + draw.push_distance / speed,
        },
        "contact": {
            "force_max_N": draw.contact_force,
            "inside": "even" if draw.contact_even >= 0.5 else "held",
        },
    }
    found: dict[str, dict[str, Any]] = {}
    for name in names:
        found.setdefault(FIELDS[name][0], {}).update(every[name])
    return found


def filled(resolved: Resolved, names: tuple[str, ...], draw: Draw) -> Resolved:
    """The same scenario with a draw in the fields of ``names``."""
    model = resolved.model
    update = {
        section: getattr(model, section).model_copy(update=values)
        for section, values in values_of(resolved, names, draw).items()
    }
    return replace(resolved, model=model.model_copy(update=update))


def chosen(resolved: Resolved) -> Resolved:
    """A scenario with its set of constants decided, the middle of the calibrated one filled in."""
    model = resolved.model
    names = model.drawn or left_open(model)
    if model.constants == "published" or not names:
        return resolved
    if not model.drawn:  # otherwise the values stand in the text
        resolved = filled(resolved, names, load_calibrated().central)
    update = {"constants": "calibrated", "drawn": names}
    return replace(resolved, model=resolved.model.model_copy(update=update))
