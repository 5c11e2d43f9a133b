"""The scene of a recorded run at a moment."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from derail_ros.recording.recorded_run import RecordedRun, SampledLine
from derail_ros.review.scene import Scene
from derail_ros.vocabulary.scene import car_corners, scene_box

F64 = NDArray[np.float64]

MARGIN = 60.0
"""How much of the track is shown around the cars, m."""


def scene_at(run: RecordedRun, time: float, title: str = "", subtitle: str = "") -> Scene:
    """The scene of a run at a time (s)."""
    i = run.at(time)
    pose = run.pose_at(time)
    off = run.derailed[i] & run.cars.real
    corners = car_corners(pose, run.cars.length, run.cars.width)[off]
    length, width, area = scene_box(run.line, corners, pose[off, 0])
    outcome = run.outcome
    last = i == len(run.time) - 1 and outcome.final
    if last and math.isfinite(outcome.scene_length):
        length, width, area = outcome.scene_length, outcome.scene_width, outcome.scene_area
    line, breaks = _track(run.line, pose, time)
    return Scene(
        pose=pose[:, [0, 1, 5]],
        length=run.cars.length,
        width=run.cars.width,
        pivot=run.cars.pivot,
        truck_on=run.truck_on[i],
        coupled=run.coupled[i],
        represents=run.cars.represents,
        coupler=run.coupler_yaw[i],
        coupler_length=run.cars.coupler,
        peak_force=run.peaks_until(time),
        track=line,
        breaks=breaks,
        scene_length=length,
        scene_width=width,
        scene_area=area,
        straight=run.line.straight,
        title=title,
        subtitle=subtitle,
    )


def _track(line: SampledLine, pose: F64, time: float) -> tuple[F64, F64]:
    """The part of the centre line around the cars, and the breaks there are."""
    breaks = line.breaks[line.breaks[:, 4] <= time + 1e-9][:, 1:4]
    low, high = pose[:, :2].min(axis=0) - MARGIN, pose[:, :2].max(axis=0) + MARGIN
    if line.straight or len(line.s) < 3:
        return np.array([[low[0], 0.0], [high[0], 0.0]]), breaks
    s = np.arange(line.start, line.end, 2.0)
    points = np.stack([np.interp(s, line.s, line.x), np.interp(s, line.s, line.y)], axis=-1)
    inside = ((points > low) & (points < high)).all(axis=1)
    if inside.sum() < 2:
        return points, breaks
    first, last = np.flatnonzero(inside)[[0, -1]]
    return points[first : last + 1], breaks
