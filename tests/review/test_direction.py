"""The direction of travel, on every picture along the track at the scene."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from derail_ros.recording.recorded_run import RecordedRun
from derail_ros.review import comparison, drawing, figures, film
from derail_ros.review.replay_page import write
from derail_ros.review.scene import final_scene

TURNS = (0.0, 1.9, -2.6)
"""Angles by which the whole run is turned, rad."""


def turned(run: RecordedRun, angle: float) -> RecordedRun:
    """The same run on a track that leads elsewhere."""
    c, s = math.cos(angle), math.sin(angle)

    def turn(x: Any, y: Any) -> tuple[Any, Any]:
        return c * x - s * y, s * x + c * y

    pose = run.pose.copy()
    pose[..., 0], pose[..., 1] = turn(run.pose[..., 0], run.pose[..., 1])
    pose[..., 5] += angle
    line = run.line
    along = np.linspace(-1000.0, 1000.0, 201)
    breaks = line.breaks.copy()
    breaks[:, 1], breaks[:, 2] = turn(line.breaks[:, 1], line.breaks[:, 2])
    breaks[:, 3] += angle
    x, y = turn(along, np.zeros_like(along))
    flat = np.zeros_like(along)
    line = replace(line, s=along, x=x, y=y, heading=flat + angle, curvature=flat, breaks=breaks)
    return replace(run, pose=pose, line=line)


def arrows(figure: Any) -> list[tuple[float, float]]:
    """Directions of the arrows of a figure, on the page."""
    found = []
    for axes in figure.axes:
        for text in axes.texts:
            if getattr(text, "arrow_patch", None) is not None and text.get_text() == "":
                (x0, y0), (x1, y1) = axes.transData.transform([text.get_position(), text.xy])
                size = math.hypot(x1 - x0, y1 - y0)
                found.append(((x1 - x0) / size, (y1 - y0) / size))
    return found


@pytest.mark.parametrize("angle", TURNS)
def test_the_arrow_of_figures_and_films_lies_along_the_track(
    run: RecordedRun, angle: float
) -> None:
    way = pytest.approx((math.cos(angle), math.sin(angle)), abs=1e-6)
    there = turned(run, angle)
    assert final_scene(there).travel == way
    assert arrows(figures.final_scene(final_scene(there))) == [way]
    stage = film.Stage(there, 480)
    stage.picture(float(there.time[-1]))
    assert arrows(stage.figure) == [way]
    assert drawing.TRAVEL in [t.get_text() for t in stage.axes.texts]


def test_two_scenes_have_one_arrow_or_each_its_own(run: RecordedRun) -> None:
    assert arrows(comparison.scenes(run, run)) == [pytest.approx((1.0, 0.0))]
    other = turned(run, TURNS[1])
    found = arrows(comparison.scenes(run, other))
    assert found == [pytest.approx((math.cos(a), math.sin(a)), abs=1e-6) for a in (0.0, TURNS[1])]


def test_on_a_curve_it_is_the_track_at_the_derailed_cars(run: RecordedRun) -> None:
    """A track that turns by 90 degrees before the scene."""
    scene = final_scene(run)
    centre = scene.pose[scene.derailed, :2].mean(axis=0)
    track = np.array([centre + (0.0, -200.0), centre + (-200.0, 0.5), centre + (100.0, 0.5)])
    assert replace(scene, track=track).travel == pytest.approx((1.0, 0.0))
    track = np.array([centre + (-200.0, 0.0), centre + (0.5, -100.0), centre + (0.5, 100.0)])
    assert replace(scene, track=track).travel == pytest.approx((0.0, 1.0))


@pytest.mark.parametrize("angle", TURNS)
def test_the_arrow_of_the_replay_page(
    browser, run: RecordedRun, angle: float, tmp_path: Path
) -> None:
    path = write(turned(run, angle), tmp_path / "replay.html")
    browser.get(path.as_uri())
    way = browser.execute_script("return derailReplay.travel")
    assert way == pytest.approx([math.cos(angle), math.sin(angle)], abs=1e-3)
