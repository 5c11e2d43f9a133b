"""Sentences that say where an outcome is outside of what the model was compared with."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from derail_ros.vocabulary.events import Event, EventKind
from derail_ros.vocabulary.outcome import Outcome
from derail_ros.vocabulary.scene import Line
from derail_ros.vocabulary.words import cars, count, force

IN_LINE = math.radians(5.0)
"""A derailed car whose heading differs by less from the track's was dragged in line, rad."""
BESIDE = 1.5
"""... and whose mass centre is this near to the centre line, m."""

KNUCKLE = 2.89e6
"""Tension that a knuckle has to bear in the static test of AAR M-211, N."""
SILL = 4.45e6
"""Compression that a car body has to bear in the static test of AAR M-1001, 1 000 000 lbf, N."""

LATE = 10.0
"""Brakes that begin later than this after the first derailment are told of, s; a choice."""


def late_brakes(events: Iterable[Event]) -> list[str]:
    """A sentence where the brakes waited long for a coupling to part, mostly none."""
    derailed = math.nan
    for event in events:
        if event.kind == EventKind.TRUCK_DERAILED and math.isnan(derailed):
            derailed = event.time
        elif event.kind == EventKind.BRAKES_TRIGGERED:
            if event.cause == "vented" and event.time > derailed + LATE:
                return [
                    f"the emergency brakes began {event.time - derailed:.1f} s after the first "
                    "derailment: no coupling parted before, and nothing else made an emergency "
                    "(brakes.signal_source, brakes.triggers)"
                ]
            return []
    return []


def train_force_limits(
    draft: Sequence[float], buff: Sequence[float], breaks: bool = False
) -> list[str]:
    """In-train forces that couplings or cars would not bear, a sentence for draft and for buff.

    Parameters
    ----------
    draft, buff : largest force of each run, N; nan where it is not known
    breaks : couplings break in tension in these runs
    """
    found = []
    if not breaks:
        bearer = "at which knuckles break (AAR M-211)"
        why = "couplings do not break in tension here; set couplers.knuckle_strength_N"
        found += _above("draft", draft, KNUCKLE, bearer, why)
    bearer = "for which car bodies are tested (AAR M-1001)"
    return found + _above("buff", buff, SILL, bearer, "nothing yields in this model")


def _above(which: str, forces: Sequence[float], level: float, bearer: str, why: str) -> list[str]:
    above = [f for f in forces if f > level]
    if not above:
        return []
    told = f"above the {level * 1e-6:.2f} MN {bearer}: {why}"
    if len(forces) == 1:
        return [f"the largest {which} force is {force(above[0])}, {told}"]
    most = f"{force(max(above))} at most"
    runs = f"in {len(above)} of {count(len(forces), 'run')} ({most})"
    return [f"the largest {which} force is, {runs}, {told}"]


def limits(outcome: Outcome, line: Line) -> list[str]:
    """Curves, cars dragged in line, places in three dimensions: a sentence each, mostly none."""
    found = []
    radius = math.inf
    dragged: list[int] = []
    for car in outcome.derailed_cars:
        x, y, yaw = outcome.pose[car - 1, [0, 1, 5]]
        place, offset = line.locate(float(x), float(y))
        _, _, heading, curvature = line.point(place)
        radius = min(radius, 1.0 / abs(curvature) if curvature else math.inf)
        if abs(math.remainder(yaw - heading, 2.0 * math.pi)) < IN_LINE and abs(offset) < BESIDE:
            dragged.append(car)
    if math.isfinite(radius):
        found.append(
            f"the derailed cars lie in a curve of {radius:.0f} m radius: none of the published "
            "runs that the model was compared with is on a curve"
        )
    if dragged:
        one = len(dragged) == 1
        found.append(
            f"{cars(dragged)} {'is' if one else 'are'} off the rails but in line with the track; "
            f"{'it counts' if one else 'they count'} as derailed, and {'adds' if one else 'add'} "
            "to the scene's length"
        )
    site = outcome.site
    if math.isfinite(outcome.values.get("pile_height_m", math.nan)) and (
        outcome.standing.cars or (site is not None and (site.fixed or site.zones))
    ):
        found.append(
            "walls, ground zones and standing cars in three dimensions were compared with closed "
            "forms of single cars, and with no accident"
        )
    return found
