"""Cars that stand on second tracks: bodies behind the train's own in all tables of a run.

They have a centre line and a chain of couplings of their own and no brake pipe; contacts, ground,
hand brakes, resistance and what takes a truck off the rails are those of the train. Second tracks
are level and have no breaks.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator

import numpy as np

from derail_ros.engine.arrays import F64
from derail_ros.engine.negotiability import free_swing
from derail_ros.engine.track import Track
from derail_ros.vocabulary.errors import ParameterError
from derail_ros.vocabulary.params import StandingCut, TrackParams, TrainParams
from derail_ros.vocabulary.scene import Line, car_corners


def cuts(params: TrainParams) -> Iterator[tuple[StandingCut, int]]:
    """The cuts, each with the row of its first car."""
    first = params.n_train
    for cut in params.standing:
        yield cut, first
        first += cut.cars


def position_field(params: TrainParams, i: int) -> str:
    """The parameter that says where car ``i`` (from 0) stands."""
    for j, (cut, first) in enumerate(cuts(params)):
        if first <= i < first + cut.cars:
            return f"site.standing.{j}.position"
    return "initiation.position"


@functools.lru_cache(32)
def _line(line: TrackParams) -> Track:
    return Track(line)


def side_lines(params: TrainParams) -> list[Track]:
    """The second tracks."""
    return [_line(track.line) for track in params.tracks]


def car_lines(params: TrainParams, track: Line) -> list[Line]:
    """The track of each car; ``track`` is the main one."""
    lines: list[Line] = [track] * params.n_train
    side = side_lines(params)
    for cut in params.standing:
        lines += [side[cut.track]] * cut.cars
    return lines


def side_rows(params: TrainParams) -> list[tuple[int, int]]:
    """For each car the rows of its second track in ``Model.side``; (0, 0) of the train's own."""
    ends = np.cumsum([0, *(len(line.pieces) for line in side_lines(params))])
    rows = [(0, 0)] * params.n_train
    for cut in params.standing:
        rows += [(int(ends[cut.track]), int(ends[cut.track + 1]))] * cut.cars
    return rows


def side_swing(params: TrainParams) -> list[F64]:
    """``free_swing`` of each cut on its track."""
    found = []
    for cut, first in cuts(params):
        try:
            cars = params.cars[first : first + cut.cars]
            found.append(free_swing(cars, side_lines(params)[cut.track]))
        except ParameterError as error:
            reason = f"on this track, of the cut that begins with car {first + 1}: {error.reason}"
            raise ParameterError(f"site.tracks.{cut.track}", reason) from None
    return found


def check_standing(params: TrainParams) -> None:
    """Refuse second tracks and standing cars that no run can be built from."""
    for j, track in enumerate(params.tracks):
        line, at = track.line, f"site.tracks.{j}.line"
        if not line.segments:
            raise ParameterError(f"{at}.segments", "must not be empty")
        if line.rail_breaks or line.grades or line.curve_resistance:
            raise ParameterError(at, "a second track is level, whole and without resistance")
        for k, segment in enumerate(line.segments):
            bends = segment.curvature_start, segment.curvature_end
            if not (0.0 < segment.length <= 1e6 and all(-0.1 <= bend <= 0.1 for bend in bends)):
                raise ParameterError(f"{at}.segments.{k}", "has no length, or R below 10 m")
    for i, car in enumerate(params.cars if params.standing else ()):
        if car.represents != 1:
            raise ParameterError(f"cars.{i}.represents", "must be 1 where there are standing cars")
    for j, cut in enumerate(params.standing):
        if not 0 <= cut.track < len(params.tracks):
            raise ParameterError(f"site.standing.{j}.track", f"there is no track {cut.track}")
        if cut.cars < 1 or params.n_train < 1:
            raise ParameterError(f"site.standing.{j}.cars", f"must be at least 1, not {cut.cars}")


def refuse_touching(params: TrainParams, q: F64) -> None:
    """Refuse standing cars that overlap cars of another cut or of the train."""
    if not params.standing:
        return
    pose = q[:, :3]
    length, width = (np.array([getattr(c, k) for c in params.cars]) for k in ("length", "width"))
    corners = car_corners(pose, length, width)
    sizes = [params.n_train, *(cut.cars for cut in params.standing)]
    whose = np.repeat(np.arange(len(sizes)), sizes)
    for i in range(params.n_train, len(pose)):
        apart = np.hypot(*(pose[:, :2] - pose[i, :2]).T)
        near = (whose < whose[i]) & (apart < 0.5 * np.hypot(length + length[i], width + width[i]))
        for j in np.flatnonzero(near):
            if _overlap(corners[i], corners[j]):
                reason = f"car {i + 1} stands where car {j + 1} is"
                raise ParameterError(position_field(params, i), reason)


def _overlap(a: F64, b: F64) -> bool:
    """Two rectangles (4, 2) share a place: no edge of either parts them."""
    for shape in (a, b):
        for axis in (shape[0] - shape[1], shape[0] - shape[2]):
            p, r = a @ axis, b @ axis
            if p.max() < r.min() or r.max() < p.min():
                return False
    return True
