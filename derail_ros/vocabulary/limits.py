"""Sentences that say where an outcome is outside of what the model was compared with."""

from __future__ import annotations

import math

from derail_ros.vocabulary.outcome import Outcome
from derail_ros.vocabulary.scene import Line
from derail_ros.vocabulary.words import cars

IN_LINE = math.radians(5.0)
"""A derailed car whose heading differs by less from the track's was dragged in line, rad."""
BESIDE = 1.5
"""... and whose mass centre is this near to the centre line, m."""


def limits(outcome: Outcome, line: Line) -> list[str]:
    """Curves, cars dragged in line, and no collision: each a sentence, most outcomes have none."""
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
    return found
