"""Values that are possible but unlikely: a warning each, none is refused."""

from __future__ import annotations

from collections.abc import Iterator

from derail_ros.scenario.messages import shown
from derail_ros.scenario.resolve import KMH, Block, Resolved, placed_bodies, rail_breaks
from derail_ros.vocabulary.params import DerailmentParams
from derail_ros.vocabulary.words import cars

LIGHTEST, HEAVIEST = 9e3, 250e3
"""Bounds on the mass of a car, kg: a platform of a spine car empty, and the heaviest six-axle
locomotives and loaded eight-axle cars, with a margin."""
SHORTEST, LONGEST = 6.0, 31.0
"""Bounds on its length over couplers, m: short hoppers are 7.3 m long, autoracks 28.9 m."""
NARROWEST, WIDEST = 1.5, 4.0
"""Bounds on the width of its body, m."""
FASTEST = 200.0
"""Bound on the speed of a freight train, km/h."""


def doubts(resolved: Resolved) -> tuple[str, ...]:
    """The unlikely values of a scenario, a sentence each."""
    return (*_cars(resolved), *_run(resolved), *_in_space(resolved))


def _cars(resolved: Resolved) -> Iterator[str]:
    number = 1
    for block in resolved.blocks:
        name = f" ({block.name})" if block.name else ""
        for what in _odd(block, block.coupled_length(resolved.couplers)):
            yield f"{cars(range(number, number + block.count))}{name}: {what}"
        number += block.count


def _odd(block: Block, length: float) -> Iterator[str]:
    for value, least, most, unit, low, high in (
        (block.mass, LIGHTEST, HEAVIEST, "kg", "light", "heavy"),
        (length, SHORTEST, LONGEST, "m over couplers", "short", "long"),
        (block.width, NARROWEST, WIDEST, "m of width", "narrow", "wide"),
    ):
        if value < least:
            yield f"{shown(value)} {unit}: no car is as {low} as that"
        elif value > most:
            yield f"{shown(value)} {unit}: no car is as {high} as that"


def _in_space(resolved: Resolved) -> Iterator[str]:
    """What is assumed or was not compared in three dimensions."""
    model = resolved.model
    if model.model != "spatial":
        return
    limit, compared = model.derailment.lv_limit, DerailmentParams().lv_limit
    if limit < compared:
        yield (
            f"derailment.lv_limit: {shown(limit)}: in three dimensions the load on the wheels is "
            f"that of the moment; results were compared at {shown(compared)} only"
        )
    if model.site is not None:
        for body in model.site.fixed:
            if "height_m" not in body.model_fields_set:
                assumed = f"{shown(body.height_m)} m over the ground are assumed"
                yield f"site.fixed: {body.name}: no height_m is given; {assumed}"


def _run(resolved: Resolved) -> Iterator[str]:
    model = resolved.model
    speed = model.train.speed_kmh
    if speed > FASTEST:
        yield f"train.speed_kmh: {shown(speed)} km/h: no freight train is as fast as that"
    bodies = placed_bodies(resolved)
    front = model.initiation.position_m + 0.5 * bodies[0][1].trucks
    rear = model.initiation.position_m - bodies[-1][0] - 0.5 * bodies[-1][1].trucks
    way = speed * KMH * model.integration.time_limit_s
    for place in rail_breaks(resolved):
        if place - front > way:
            yield (
                f"rail break at {shown(place)} m: the train does not reach it; at "
                f"{shown(speed)} km/h it runs {way:.0f} m at most within the time limit"
            )
        elif place < rear:
            yield f"rail break at {shown(place)} m: it lies behind the train"
