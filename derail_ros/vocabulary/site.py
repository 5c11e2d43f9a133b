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

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from derail_ros.vocabulary.scene import Line

Outline = tuple[tuple[float, float], ...]

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
    """

    name: str
    outline: Outline
    closed: bool = False
    force: float = math.inf
    energy: float = math.inf
    beside: bool = False


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
class Shape:
    """A part of the place as pictures show it; ``role``: "zone", "fixed", "area" or "track"."""

    role: str
    name: str
    closed: bool
    points: NDArray[np.float64]  # (V, 2) x, y, m


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
            Shape(role, part.name, bool(getattr(part, "closed", True)), in_plane(part, line))
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
