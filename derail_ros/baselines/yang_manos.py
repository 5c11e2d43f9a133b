r"""Yang and Manos 1972: couplings that never part, no collisions, constant friction.

A configuration of the main engine, with its solver, integrator and ledger. As the source describes
the model: the first car derails and cars ahead of it are not involved; the cars on the rails are
one lumped mass that brakes; a car derails when its front truck reaches the derailment point;
couplings never part; a moment polynomial in the angle between adjacent cars, with a wider dead
band, is the only restraint on rotation (``engine.laws.joint``); Coulomb friction of 1.0 to 2.0
times the normal force at the truck places; no collisions; straight track. Base case: 61 cars of
72.6 t at 65 km/h, friction 1.0.

How the laws are put to the engine:

- The lumped mass needs nothing: couplings that never part, on straight track, make the cars on
  the rails move as one. A virtual body is taken apart, so that its cars may derail too.
- Adjacent cars share one pin in the middle of the coupling: coupler bodies are held straight by a
  stiff spring, and the moment between the heads is the moment between the cars. The spring keeps
  the lateral constraints of pin and trucks independent.
- Coulomb friction is the engine's ground law with ``c_s = c_d = mu`` and ``c_v = 0``.

Interpretation [R]: the widening of the dead band, the moment held beyond its largest value, the
stiffness of the pins, and the brakes, which are the scenario's.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from derail_ros.baselines.train import ModelError, derailing_train, is_straight
from derail_ros.vocabulary.params import (
    BrakeTrigger,
    CouplerType,
    DerailmentParams,
    GroundParams,
    TrainParams,
    VariantParams,
)

FRICTION = 1.0
"""Coulomb friction at the trucks (source: 1.0 to 2.0)."""

WIDENING = 0.2
"""The dead band is wider than the thesis' by this much, rad [R]."""

PIN_STIFFNESS = 1.0e8
"""Spring that holds a coupler straight, N m/rad [R]."""

PIN_DAMPING = 2.0e5
"""Damper beside it, N m s/rad [R]."""

NEVER = 1.0e9
"""A limit that is never reached (rad; derailment quotient)."""


@dataclass(frozen=True)
class YangManosParams:
    """Constants of the model."""

    friction: float = FRICTION  # mu at the trucks of derailed cars
    widening: float = WIDENING  # of the dead band, rad


def _straight(coupler: CouplerType) -> CouplerType:
    return replace(
        coupler,
        striker_arm=1.0,
        striker_opening=NEVER,
        k1=PIN_STIFFNESS,
        k2=PIN_STIFFNESS,
        damping=PIN_DAMPING,
    )


def configure(params: TrainParams, own: YangManosParams | None = None) -> TrainParams:
    """The engine's parameters of a train under this model, from the first car to derail on.

    Raises
    ------
    ModelError
        The track is curved, or nothing derails.
    """
    own = YangManosParams() if own is None else own
    if not is_straight(params):
        raise ModelError("the model of Yang and Manos needs straight track")
    train = derailing_train(params)
    start = params.initiation
    cars = tuple(
        replace(car, front=_straight(car.front), rear=_straight(car.rear)) for car in train.cars
    )
    brakes = params.brakes
    moved = []
    for trigger in brakes.triggers:
        if trigger.source == "car":
            trigger = replace(trigger, car=max(trigger.car - train.first, 1))
        moved.append(trigger)
    if not moved and brakes.vent_on_parting:
        # no coupling parts: the pipe is taken to open where the train derails, when it does
        time = train.run_up / train.speed if train.speed > 0.0 else 0.0
        moved = [BrakeTrigger(time=time, source="front")]
    forces = tuple(
        replace(f, car=f.car - train.first) for f in start.lateral_forces if f.car > train.first
    )
    derailed = ((1, "front"), (1, "rear")) if train.derailed else ()
    for number in range(2, train.derailed + 1):
        derailed += ((number, "front"), (number, "rear"))
    return replace(
        params,
        cars=cars,
        initiation=replace(
            start,
            position=train.start,
            derailed_trucks=derailed,
            parted_couplings=(),
            lateral_forces=forces,
        ),
        track=replace(params.track, segments=(), start_coordinate=0.0, rail_breaks=(train.point,)),
        brakes=replace(brakes, triggers=tuple(moved), vent_on_parting=False),
        ground=replace(
            GroundParams(), c_s=own.friction, c_d=own.friction, c_v=0.0, eps=params.ground.eps
        ),
        derailment=DerailmentParams(
            lv_limit=NEVER,
            knuckle_limit_ee=NEVER,
            knuckle_limit_ff=NEVER,
            knuckle_limit_ef=NEVER,
        ),
        variant=VariantParams(
            held_moment=True,
            moment_widening=own.widening,
            whole_car=True,
            collisions=False,
        ),
    )


def zigzag(yaw: NDArray[np.float64]) -> float:
    """Share of neighbouring cars whose yaws (rad) have opposite signs: 1 for a zig-zag."""
    yaw = np.asarray(yaw, dtype=float)
    if len(yaw) < 2:
        return 0.0
    return float(np.mean(yaw[:-1] * yaw[1:] < 0.0))
