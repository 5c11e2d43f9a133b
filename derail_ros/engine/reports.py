"""Rows that kernels write, as events and collisions."""

from __future__ import annotations

import math

from derail_ros.engine import layout as L
from derail_ros.vocabulary import status as names
from derail_ros.vocabulary.events import Collision, Event, EventKind
from derail_ros.vocabulary.scene import Line

STATUS = {
    L.RUNNING: names.RUNNING,
    L.AT_REST: names.AT_REST,
    L.TIME_LIMIT: names.TIME_LIMIT,
    L.VOID: names.VOID,
    L.FAILED: names.FAILED,
}

CAUSES = {
    L.CAUSE_NONE: "",
    L.CAUSE_INITIAL: "initial",
    L.CAUSE_BREAK: "rail break",
    L.CAUSE_LATERAL: "lateral force",
    L.CAUSE_ANGLE: "angle",
    L.CAUSE_COMMAND: "command",
    L.CAUSE_VENT: "vented",
    L.CAUSE_SIGNAL: "brake signal",
}

BEFORE_AFTER = {
    EventKind.TRUCK_DERAILED: ("on the rails", "derailed"),
    EventKind.COUPLER_PARTED: ("coupled", "parted"),
    EventKind.RAIL_BREAK_SET: ("rail whole", "rail broken"),
    EventKind.BRAKES_TRIGGERED: ("released", "emergency"),
    EventKind.BRAKE_SIGNAL_REACHED: ("released", "applying"),
    EventKind.CAR_AT_REST: ("moving", "at rest"),
}


def event_of(r: list[float], track: Line) -> Event:
    """The event of a row; place and track coordinate fill each other in."""
    kind = EventKind(int(r[L.V_KIND]))
    code = int(r[L.V_CAUSE])
    before, after = BEFORE_AFTER.get(kind, ("", ""))
    x, y, s = r[L.V_X], r[L.V_Y], r[L.V_S]
    if math.isnan(s) and not math.isnan(x):
        s = track.locate(x, y)[0]
    elif math.isnan(x) and not math.isnan(s):
        x, y, _, _ = track.point(s)
    return Event(
        kind=kind,
        time=r[L.V_TIME],
        step=int(r[L.V_STEP]),
        cars=tuple(int(c) for c in (r[L.V_CAR], r[L.V_CAR2]) if c > 0),
        end=("", *names.ENDS)[int(r[L.V_END])],
        cause=STATUS[code] if kind == EventKind.RUN_ENDED else CAUSES[code],
        x=x,
        y=y,
        track_coordinate=s,
        speed=r[L.V_SPEED],
        value=r[L.V_VALUE],
        before=before,
        after=after,
    )


def collision_of(number: int, r: list[float]) -> Collision:
    """The collision of a row."""
    return Collision(
        id=number,
        final=r[L.K_STAGE] == 2.0,
        car_a=int(r[L.K_A]),
        car_b=int(r[L.K_B]),
        corner_car=int(r[L.K_CORNER_CAR]),
        corner=int(r[L.K_CORNER]),
        start=r[L.K_START],
        end=r[L.K_ENDT],
        peak_force=r[L.K_PEAK],
        peak_time=r[L.K_PEAK_T],
        peak_resultant=r[L.K_RES],
        peak_resultant_time=r[L.K_RES_T],
        closing_speed=r[L.K_CLOSING],
        x=r[L.K_X],
        y=r[L.K_Y],
        normal_x=r[L.K_NX],
        normal_y=r[L.K_NY],
        angle=r[L.K_ANGLE],
        energy_lost=r[L.K_ENERGY],
    )


def brake_words(mode: str, source: str) -> str:
    """An application in words: ``conventional from both ends``."""
    article = "" if source == "both_ends" else "the "
    return f"{mode} from {article}{source}".replace("_", " ")
