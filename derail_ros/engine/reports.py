"""Rows that kernels write, as events and collisions."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from derail_ros.engine import layout
from derail_ros.vocabulary import status as names
from derail_ros.vocabulary.events import Collision, Event, EventKind
from derail_ros.vocabulary.scene import Line
from derail_ros.vocabulary.site import FixedBody

STATUS = {
    layout.RUNNING: names.RUNNING,
    layout.AT_REST: names.AT_REST,
    layout.TIME_LIMIT: names.TIME_LIMIT,
    layout.VOID: names.VOID,
    layout.FAILED: names.FAILED,
}

CAUSES = {
    layout.CAUSE_NONE: "",
    layout.CAUSE_INITIAL: "initial",
    layout.CAUSE_BREAK: "rail break",
    layout.CAUSE_LATERAL: "lateral force",
    layout.CAUSE_ANGLE: "angle",
    layout.CAUSE_COMMAND: "command",
    layout.CAUSE_VENT: "vented",
    layout.CAUSE_SIGNAL: "brake signal",
    layout.CAUSE_KNUCKLE: "knuckle broke",
    layout.CAUSE_BODY: "coupler body broke",
}

BEFORE_AFTER = {
    EventKind.TRUCK_DERAILED: ("on the rails", "derailed"),
    EventKind.COUPLER_PARTED: ("coupled", "parted"),
    EventKind.RAIL_BREAK_SET: ("rail whole", "rail broken"),
    EventKind.BRAKES_TRIGGERED: ("released", "emergency"),
    EventKind.BRAKE_SIGNAL_REACHED: ("released", "applying"),
    EventKind.CAR_AT_REST: ("moving", "at rest"),
}


def event_of(r: Mapping[str, float], track: Line) -> Event:
    """The event of a row; place and track coordinate fill each other in."""
    kind = EventKind(int(r["kind"]))
    code = int(r["cause"])
    before, after = BEFORE_AFTER.get(kind, ("", ""))
    x, y, s = r["x"], r["y"], r["s"]
    if math.isnan(s) and not math.isnan(x):
        s = track.locate(x, y)[0]
    elif math.isnan(x) and not math.isnan(s):
        x, y, _, _ = track.point(s)
    return Event(
        kind=kind,
        time=r["time"],
        step=int(r["step"]),
        cars=tuple(int(c) for c in (r["car"], r["car2"]) if c > 0),
        end=("", *names.ENDS)[int(r["end"])],
        cause=STATUS[code] if kind == EventKind.RUN_ENDED else CAUSES[code],
        x=x,
        y=y,
        track_coordinate=s,
        speed=r["speed"],
        value=r["value"],
        before=before,
        after=after,
    )


def collision_of(
    number: int, r: Mapping[str, float], fixed: Sequence[FixedBody] = ()
) -> Collision:
    """The collision of a row; the struck ``b`` -1 is the first of the fixed bodies."""
    b = int(r["b"])
    return Collision(
        id=number,
        final=r["stage"] == 2.0,
        car_a=int(r["a"]),
        car_b=max(b, 0),
        corner_car=int(r["corner_car"]),
        corner=int(r["corner"]),
        start=r["start"],
        end=r["end"],
        peak_force=r["peak"],
        peak_time=r["peak_time"],
        peak_resultant=r["resultant"],
        peak_resultant_time=r["resultant_time"],
        closing_speed=r["closing"],
        x=r["x"],
        y=r["y"],
        normal_x=r["nx"],
        normal_y=r["ny"],
        angle=r["angle"],
        energy_lost=r["energy"],
        object="" if b >= 0 else fixed[-b - 1].name,
    )


def brake_words(mode: str, source: str) -> str:
    """An application in words: ``conventional from both ends``."""
    article = "" if source == "both_ends" else "the "
    return f"{mode} from {article}{source}".replace("_", " ")
