"""Second tracks and the cars that stand on them, from the fields of ``site``.

A track at an offset d from the main one has its centre of curvature in common with it: beside the
curvature k it has ``k / (1 - k d)`` and its length is that of the main one times ``1 - k d``. This
is exact on tangents and circular curves; beside a spiral it is taken in pieces of ``PIECE``.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING

from derail_ros.scenario.errors import Refusal
from derail_ros.scenario.messages import did_you_mean, shown
from derail_ros.scenario.schema import Piece, SecondTrackSpec, Site
from derail_ros.scenario.strict_yaml import Path
from derail_ros.vocabulary.params import Car, SecondTrack, StandingCut, TrackParams, TrackSegment
from derail_ros.vocabulary.site import Area

if TYPE_CHECKING:  # numpy is slow to load, and most scenarios have no second tracks
    import numpy as np
    from numpy.typing import NDArray

    F64 = NDArray[np.float64]

PIECE = 5.0
"""Longest piece of a second track beside a spiral, m."""


def segments(alignment: Iterable[Piece]) -> Iterator[TrackSegment]:
    """The pieces of an alignment as the engine takes them."""
    for piece in alignment:
        if piece.tangent:
            yield TrackSegment(piece.tangent.length_m)
        elif piece.curve:
            kappa = _curvature(piece.curve.radius_m, piece.curve.turn)
            yield TrackSegment(piece.curve.length_m, kappa, kappa)
        elif piece.spiral:
            spiral = piece.spiral
            yield TrackSegment(
                spiral.length_m,
                _curvature(spiral.radius_start_m, spiral.turn),
                _curvature(spiral.radius_end_m, spiral.turn),
            )


def _curvature(radius: float | None, turn: str) -> float:
    """Curvature, 1/m, positive to the left."""
    if radius is None:
        return 0.0
    return 1.0 / radius if turn == "left" else -1.0 / radius


def check_pieces(alignment: Iterable[Piece], path: Path) -> None:
    """Refuse pieces of an alignment that are not exactly one of the three kinds."""
    for i, piece in enumerate(alignment):
        given = [key for key in type(piece).model_fields if getattr(piece, key) is not None]
        if len(given) != 1:
            reason = "must be exactly one of tangent, spiral and curve"
            raise Refusal((*path, i), f"{reason}, has {' and '.join(given) or 'none'}")
        spiral = piece.spiral
        if spiral and spiral.radius_start_m is None and spiral.radius_end_m is None:
            reason = "is required, or radius_start_m: a spiral leads from or to a curve"
            raise Refusal((*path, i, "spiral", "radius_end_m"), reason)


def check_track(track: SecondTrackSpec, path: Path) -> None:
    """Refuse a second track whose fields do not go together."""
    if (track.offset_m is None) == (not track.alignment):
        raise Refusal(path, "must have exactly one of offset_m and alignment")
    check_pieces(track.alignment, (*path, "alignment"))
    if track.offset_m is None:
        return
    for key in ("from_m", "to_m"):
        if getattr(track, key) is None:
            raise Refusal((*path, key), "is required with offset_m")
    if not track.from_m < track.to_m:  # type: ignore[operator]
        reason = f"must be above from_m, {shown(track.from_m)}, got {shown(track.to_m)}"
        raise Refusal((*path, "to_m"), reason)


def _own_line(track: SecondTrackSpec) -> TrackParams:
    return TrackParams(
        segments=tuple(segments(track.alignment)),
        start_coordinate=track.start_coordinate_m,
        start_x=track.start_x_m,
        start_y=track.start_y_m,
        start_heading=track.start_heading_rad,
    )


def drawn_track(track: SecondTrackSpec) -> Area:
    """The centre line of a second track, to be drawn."""
    if track.offset_m is not None:
        ends = tuple((float(s), track.offset_m) for s in (track.from_m, track.to_m))  # type: ignore[arg-type]
        return Area(track.name, ends, closed=False, beside=True)
    places, _ = along(_own_line(track), PIECE)
    return Area(track.name, tuple((x, y) for x, y, _ in places.tolist()), closed=False)


def along(line: TrackParams, step: float) -> tuple[F64, F64]:
    """Places (K, 3) x, y (m), heading (rad) of a line at most every ``step`` m; coordinates (K,).

    By Gauss' rule of order 16: exact to rounding at steps of some metres.
    """
    import numpy as np

    nodes, weights = np.polynomial.legendre.leggauss(8)
    x, y, psi, s = line.start_x, line.start_y, line.start_heading, line.start_coordinate
    rows = [(x, y, psi, s)]
    for segment in line.segments:
        n = max(1, math.ceil(segment.length / step))
        size = segment.length / n
        slope = (segment.curvature_end - segment.curvature_start) / segment.length
        for k in range(n):
            kappa = segment.curvature_start + slope * size * k
            u = 0.5 * size * (nodes + 1.0)
            heading = psi + (kappa + 0.5 * slope * u) * u
            x += 0.5 * size * float(weights @ np.cos(heading))
            y += 0.5 * size * float(weights @ np.sin(heading))
            psi += (kappa + 0.5 * slope * size) * size
            s += size
            rows.append((x, y, psi, s))
    table = np.array(rows)
    return table[:, :3], table[:, 3]


def second_track(track: SecondTrackSpec, main: TrackParams, path: Path) -> SecondTrack:
    """A second track as the engine takes it.

    Raises
    ------
    Refusal
        It begins or ends beyond the main track, or has no curvature beside it.
    """
    import numpy as np

    if track.offset_m is None:
        return SecondTrack(track.name, _own_line(track))
    d, begin, end = track.offset_m, float(track.from_m), float(track.to_m)  # type: ignore[arg-type]
    if not main.segments:
        line = TrackParams((TrackSegment(end - begin),), begin, start_x=begin, start_y=d)
        return SecondTrack(track.name, line)
    s = main.start_coordinate
    last = s + sum(segment.length for segment in main.segments)
    for key, at in (("from_m", begin), ("to_m", end)):
        if not s <= at <= last:
            reason = f"{shown(at)} m lies beyond the alignment ({shown(s)} to {shown(last)} m)"
            raise Refusal((*path, key), reason)
    ahead, found = [], []
    for segment in main.segments:
        slope = (segment.curvature_end - segment.curvature_start) / segment.length

        def piece(a: float, b: float, s: float = s, slope: float = slope) -> TrackSegment:
            bend = segment.curvature_start  # noqa: B023
            return TrackSegment(b - a, bend + slope * (a - s), bend + slope * (b - s))

        low, high = max(s, begin), min(s + segment.length, end)
        if s < begin:
            ahead.append(piece(s, min(s + segment.length, begin)))
        if low < high:
            n = max(1, math.ceil((high - low) / PIECE)) if slope else 1
            cuts = np.linspace(low, high, n + 1)
            found += [piece(float(a), float(b)) for a, b in zip(cuts, cuts[1:], strict=False)]
        s += segment.length
    tight = [max(p.curvature_start * d, p.curvature_end * d) for p in found]
    if max(tight) > 0.9:
        raise Refusal((*path, "offset_m"), f"{shown(d)} m is about the radius of the main track")
    start = along(TrackParams(**{**vars(main), "segments": tuple(ahead)}), PIECE)[0][-1]
    x, y, psi = (float(value) for value in start)
    line = TrackParams(
        segments=tuple(_beside(p, d) for p in found),
        start_coordinate=begin,
        start_x=x - d * math.sin(psi),
        start_y=y + d * math.cos(psi),
        start_heading=psi,
    )
    return SecondTrack(track.name, line)


def _beside(piece: TrackSegment, d: float) -> TrackSegment:
    a, b = piece.curvature_start, piece.curvature_end
    length = piece.length * (1.0 - 0.5 * (a + b) * d)
    return TrackSegment(length, a / (1.0 - a * d), b / (1.0 - b * d))


def standing_cuts(
    site: Site, cars: Sequence[Sequence[Car]], main: TrackParams, widest: float
) -> tuple[tuple[SecondTrack, ...], tuple[StandingCut, ...]]:
    """Second tracks and cuts as the engine takes them; ``cars`` are those of each cut.

    Raises
    ------
    Refusal
        No such track; beyond its ends; nearer to the main track than cars of the width ``widest``
        (m) need.
    """
    import numpy as np

    from derail_ros.vocabulary.scene import car_corners

    names = [track.name for track in site.tracks]
    tracks = tuple(
        second_track(track, main, ("site", "tracks", i)) for i, track in enumerate(site.tracks)
    )
    cuts = []
    for j, (spec, own) in enumerate(zip(site.standing, cars, strict=True)):
        path: Path = ("site", "standing", j)
        if spec.track not in names:
            reason = f"there is no second track {spec.track!r}{did_you_mean(spec.track, names)}"
            raise Refusal((*path, "track"), reason)
        row = names.index(spec.track)
        line = tracks[row].line
        pose = _stand(line, own, spec.position_m, path)
        corners = car_corners(pose, *np.array([(c.length, c.width) for c in own]).T)
        room = _distance(main, corners, pose)
        if room.min() < 0.5 * widest:
            reason = (
                f"car {int(room.argmin()) + 1} of the cut stands {shown(round(room.min(), 2))} m "
                f"from the centre line of the main track, whose cars need {shown(0.5 * widest)} m"
            )
            raise Refusal((*path, "position_m"), reason)
        cuts.append(StandingCut(row, spec.position_m, len(own)))
    return tracks, tuple(cuts)


def _stand(line: TrackParams, cars: Sequence[Car], position: float, path: Path) -> F64:
    """About where the cars of a cut stand: (K, 3) x, y (m), yaw (rad)."""
    import numpy as np

    places, s = along(line, 1.0)
    ends, at = [], position
    for i, car in enumerate(cars):
        if i:
            ahead = cars[i - 1]
            at -= ahead.pivot_distance + ahead.rear.length + car.front.length + car.pivot_distance
        ends.append((at + car.truck_distance, at - car.truck_distance))
    if not s[0] <= ends[-1][1] <= ends[0][0] <= s[-1]:
        reason = f"its cars stand beyond the track ({shown(s[0])} to {shown(round(s[-1], 3))} m)"
        raise Refusal((*path, "position_m"), reason)
    told = np.array(ends)
    x, y = (np.interp(told, s, places[:, k]) for k in (0, 1))
    yaw = np.arctan2(y[:, 0] - y[:, 1], x[:, 0] - x[:, 1])
    return np.stack([x.mean(axis=1), y.mean(axis=1), yaw], axis=1)


def _distance(main: TrackParams, corners: F64, pose: F64) -> F64:
    """How near the sides of cars come to the centre line of the main track: (K,) m."""
    import numpy as np

    if main.segments:
        line = along(main, 1.0)[0][:, :2]
    else:
        span = np.arange(pose[:, 0].min() - 50.0, pose[:, 0].max() + 50.0)
        line = np.stack([span, np.zeros(len(span))], axis=1)
    found = []
    for rectangle, (x, y, yaw) in zip(corners, pose, strict=True):
        c, s = math.cos(yaw), math.sin(yaw)
        half = np.abs((rectangle - (x, y)) @ np.array([[c, -s], [s, c]]))[0]
        apart = np.abs((line - (x, y)) @ np.array([[c, -s], [s, c]])) - half
        found.append(float(np.hypot(*np.maximum(apart, 0.0).T).min()))
    return np.array(found)
