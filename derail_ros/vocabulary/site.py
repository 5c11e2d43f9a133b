"""The place of a run: ground zones, fixed bodies and areas, and the results for them.

Outlines are vertices (x, y) in the frame of the track, m, or with ``beside`` track coordinate and
offset to the left. A closed one is a polygon, the last vertex joined to the first; an open one is
a chain of segments.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from derail_ros.vocabulary import words

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from derail_ros.vocabulary.scene import Line

Outline = tuple[tuple[float, float], ...]

WALL_HEIGHT = 5.0
"""Of a fixed body over the ground, m, where a scenario names none [A]: more than a car is high, so
that cars do not pass over it. Read in three dimensions only."""
CHORD = 5.0
"""Beside curved track an edge is divided into chords of at most this along the track, m."""


@dataclass(frozen=True)
class GroundZone:
    """Ground of its own within a polygon; of overlapping zones the last one counts.

    Attributes
    ----------
    name : name in outputs
    outline : its polygon
    c_s, c_d, eps, c_v : constants of the ground reaction in it (``params.GroundParams``)
    rise : slope along x and y, rise per metre; it pushes what has left the rails downhill
    """

    name: str
    outline: Outline
    c_s: float
    c_d: float
    eps: float
    c_v: float
    rise: tuple[float, float] = (0.0, 0.0)
    beside: bool = False


@dataclass(frozen=True)
class FixedBody:
    """A fixed body beside the track: a wall (open), or a building or pier (closed).

    Attributes
    ----------
    name : name in outputs
    outline : its vertices
    closed : a polygon, or else a chain of segments
    force : with which one corner of a car pushes it in, N; infinite: rigid
    energy : after which it gives way for good, J: each segment of a chain, a polygon as a whole
    height : over the ground beside the track, m; in three dimensions
    """

    name: str
    outline: Outline
    closed: bool = False
    force: float = math.inf
    energy: float = math.inf
    beside: bool = False
    height: float = field(default=WALL_HEIGHT, metadata={"left_out_at_default": True})


@dataclass(frozen=True)
class Area:
    """A line or a polygon; the outcome says which cars enter it. It changes no motion."""

    name: str
    outline: Outline
    closed: bool = True
    beside: bool = False


def in_plane(part: GroundZone | FixedBody | Area, line: Line) -> NDArray[np.float64]:
    """Vertices (V, 2) of an outline as x, y, m; those of edges beside curved track among them."""
    import numpy as np

    if not part.beside:
        return np.array(part.outline, dtype=float)
    ends = np.array(part.outline, dtype=float)
    if isinstance(part, GroundZone) or part.closed:
        ends = np.concatenate([ends, ends[:1]])
    places = [ends[:1]]
    for a, b in zip(ends, ends[1:], strict=False):
        n = 1 if line.straight else max(1, math.ceil(abs(b[0] - a[0]) / CHORD))
        places.append(a + np.linspace(0.0, 1.0, n + 1)[1:, None] * (b - a))
    along = np.concatenate(places)
    if isinstance(part, GroundZone) or part.closed:
        along = along[:-1]
    told = []
    for s, d in along:
        x, y, heading, _ = line.point(float(s))
        told.append((x - d * math.sin(heading), y + d * math.cos(heading)))
    return np.array(told)


@dataclass(frozen=True)
class Slope:
    """The ground of a zone in three dimensions: ``r . p - base`` over the level ground, m.

    ``highest``: its highest place, m, at least 0; ``edge``: within how much it comes back to the
    ground around it, m.
    """

    base: float
    highest: float
    edge: float


def zone_slope(zone: GroundZone, line: Line, border: float) -> Slope:
    """The slope of a zone: level with the ground around it where it is nearest to the track.

    Of several such places the lowest. Where the track crosses the zone they lie on the track.
    """
    import numpy as np

    if not any(zone.rise):
        return Slope(0.0, 0.0, border)
    corners = in_plane(zone, line)
    ends = np.concatenate([corners, corners[:1]])
    steps = [max(2, math.ceil(math.dist(a, b)) + 1) for a, b in zip(ends, ends[1:], strict=False)]
    places = np.concatenate(
        [np.linspace(a, b, n) for a, b, n in zip(ends, ends[1:], steps, strict=False)]
    )
    offset = np.array([line.locate(float(x), float(y))[1] for x, y in places])
    cross = np.flatnonzero(offset[:-1] * offset[1:] < 0.0)
    if len(cross):
        share = offset[cross] / (offset[cross] - offset[cross + 1])
        on = places[cross] + share[:, None] * (places[cross + 1] - places[cross])
        places, offset = np.concatenate([places, on]), np.append(offset, np.zeros(len(on)))
    rise = np.array(zone.rise)
    base = float((places[np.abs(offset) <= np.abs(offset).min() + 0.01] @ rise).min())
    height = corners @ rise - base
    return Slope(
        base, max(0.0, float(height.max())), max(border, 0.25 * float(np.abs(height).max()))
    )


@dataclass(frozen=True)
class Shape:
    """A part of the place as pictures show it; ``role``: "zone", "fixed", "area" or "track"."""

    role: str
    name: str
    closed: bool
    points: NDArray[np.float64]  # (V, 2) x, y, m
    height: float = 0.0  # of a fixed body over the ground, m


@dataclass(frozen=True)
class SiteParams:
    """The surroundings of the track.

    Attributes
    ----------
    zones, fixed, areas : as above
    tracks : centre lines of second tracks, to be drawn
    border : width over which one zone's ground passes into the next, m
    """

    zones: tuple[GroundZone, ...] = ()
    fixed: tuple[FixedBody, ...] = ()
    areas: tuple[Area, ...] = ()
    border: float = 0.5
    tracks: tuple[Area, ...] = field(default=(), metadata={"left_out_at_default": True})

    def shapes(self, line: Line) -> tuple[Shape, ...]:
        """All parts as outlines in the plane."""
        named = (
            *(("zone", self.zones), ("fixed", self.fixed)),
            *(("area", self.areas), ("track", self.tracks)),
        )
        return tuple(
            Shape(
                role,
                part.name,
                bool(getattr(part, "closed", True)),
                in_plane(part, line),
                float(getattr(part, "height", 0.0)),
            )  # fmt: skip
            for role, parts in named
            for part in parts
        )


@dataclass(frozen=True)
class Struck:
    """The impacts on a fixed body.

    Attributes
    ----------
    name : of the body
    force : largest force of one corner, N
    energy : taken by it and by what struck it, there, J
    struck_by : car numbers, in the order of their first contact above ``begin_force``
    given_way : segments that gave way (1 for a polygon)
    """

    name: str
    force: float
    energy: float
    struck_by: tuple[int, ...]
    given_way: int = 0


@dataclass(frozen=True)
class Entered:
    """Cars with a part within an area: at any time so far, and now."""

    name: str
    ever: tuple[int, ...]
    now: tuple[int, ...]


@dataclass(frozen=True)
class SiteOutcome:
    """What came of a run at its place; ``zones`` : name -> cars with a part in it now."""

    fixed: tuple[Struck, ...] = ()
    zones: tuple[tuple[str, tuple[int, ...]], ...] = ()
    inside: tuple[Entered, ...] = ()

    def record(self) -> Mapping[str, Any]:
        """As it stands in JSON."""
        return {
            "fixed": [
                {
                    "name": s.name,
                    "force_N": s.force,
                    "energy_J": s.energy,
                    "struck_by": list(s.struck_by),
                    "given_way": s.given_way,
                }
                for s in self.fixed
            ],
            "zones": [{"name": name, "cars": list(cars)} for name, cars in self.zones],
            "inside": [
                {"name": e.name, "cars_ever": list(e.ever), "cars_at_rest": list(e.now)}
                for e in self.inside
            ],
        }


def site_rows(record: Mapping[str, Any]) -> list[tuple[str, str]]:
    """What came of each area and fixed body in words: name, text; of `SiteOutcome.record`."""
    rows = []
    for area in record["inside"]:
        ever, now = area["cars_ever"], area["cars_at_rest"]
        text = f"{words.cars(ever)} entered" if ever else "no car entered"
        if ever:
            text += f"; {words.cars(now)} in it at the end" if now else "; none in it at the end"
        rows.append((area["name"], text))
    for body in record["fixed"]:
        struck = body["struck_by"]
        text = "not struck"
        if struck:
            text = (
                f"struck by {words.cars(sorted(struck))}, {words.force(body['force_N'])} at most"
            )
            text += "; gave way" if body["given_way"] else ""
        rows.append((body["name"], text))
    return rows
