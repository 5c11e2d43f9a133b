"""Alignments fitted to points: exact, noisy within their stated errors; tables, grades."""

import json
import sys

import numpy as np
import pytest

from derail_ros.scenario import ScenarioError, load_scenario
from derail_ros.scenario.alignment import (
    FitError,
    Stretches,
    fit_alignment,
    fit_grades,
    line_points,
)

LINE = Stretches(
    np.array([0.0, 1 / 400, -1 / 300, 0.0]), np.array([300.0, 500.0, 300.0]),
    np.array([80.0, 120.0, 200.0]),
)  # fmt: skip
"""Tangent, spiral, left-hand curve, reversing spiral, right-hand curve, spiral, tangent."""
BEND = Stretches(np.array([0.0, 1 / 500, 0.0]), np.array([250.0, 400.0]), np.array([90.0, 60.0]))
GRADES = Stretches(
    np.array([0.0, 0.012, -0.006]), np.array([300.0, 400.0]), np.array([60.0, 90.0])
)


def points(line, length, step, heading=0.3):
    s = np.arange(0.0, length + 0.5 * step, step)
    z = line_points(line, heading, s)
    return np.stack([z.real - 150.0, z.imag + 40.0], axis=1)


DENSE = points(BEND, 1200.0, 10.0)


def test_points_of_a_line_by_closed_form():
    circle = Stretches(np.array([1 / 200]), np.zeros(0), np.zeros(0))
    s = np.array([0.0, 100.0, 731.0])
    expected = 200.0 * (np.exp(1j * s / 200.0) - 1.0) / 1j
    assert line_points(circle, 0.0, s) == pytest.approx(expected, abs=1e-9)


def test_an_alignment_is_fitted_back_from_sampled_points():
    given = points(LINE, 1900.0, 10.0)
    found = fit_alignment(given, 0.01)
    assert len(list(found.pieces())) == 8  # the reversing spiral is two
    fit = found.plan.stretches
    assert fit.level == pytest.approx(LINE.level, rel=0.005, abs=1e-7)
    assert fit.length == pytest.approx(LINE.length, abs=0.05)
    assert fit.ramp == pytest.approx(LINE.ramp, abs=0.05)
    assert found.plan.largest < 0.01
    # between the points too
    dense = points(LINE, 1900.0, 1.0)
    on = line_points(fit, found.heading, np.arange(0.0, 1900.5, 1.0))
    there = np.stack([on.real + found.x, on.imag + found.y], axis=1)
    assert np.hypot(*(there - dense).T).max() < 0.01


def test_from_points_with_a_metre_of_noise_within_the_stated_confidence():
    exact = points(BEND, 1200.0, 10.0)
    inside = []
    for seed in range(3):
        noise = np.random.default_rng(seed).normal(0.0, 1.0, exact.shape)
        plan = fit_alignment(exact + noise, 1.0).plan
        assert len(plan.stretches.level) == 3
        assert plan.stretches.level[1] == pytest.approx(1 / 500, rel=0.05)
        for part in ("level", "length", "ramp"):
            off = np.abs(getattr(plan.stretches, part) - getattr(BEND, part))
            error = getattr(plan.error, part)
            inside += list(off[error > 0.0] / error[error > 0.0])
    # one level, two lengths, two ramps a fit; of normal errors 95 % lie within 1.96
    assert len(inside) == 15
    assert np.mean(np.array(inside) < 1.96) >= 0.8
    assert np.median(inside) > 0.1


def test_grades_from_heights_exact_and_noisy():
    s = np.arange(0.0, 1400.0, 10.0)
    height = 80.0 + GRADES.integral(s)
    exact = fit_grades(s, height, 0.01)
    assert exact.stretches.level == pytest.approx(GRADES.level, abs=1e-6)
    assert exact.stretches.ramp == pytest.approx(GRADES.ramp, abs=0.05)
    noisy = fit_grades(s, height + np.random.default_rng(3).normal(0.0, 0.5, len(s)), 0.5)
    off = np.abs(noisy.stretches.level - GRADES.level)
    assert (off < 3.0 * np.maximum(noisy.error.level, 1e-4)).all()


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        (points(BEND, 50.0, 10.0), "needs at least 8 points"),
        (
            points(BEND, 1200.0, 10.0)[[*range(30), 29, *range(30, 120)]],
            "vertex 31: repeats the vertex",
        ),
        (
            points(BEND, 1200.0, 10.0)[[*range(30), 40, *range(31, 120)]],
            "vertex 31: the line turns",
        ),
    ],
)
def test_bad_lines_are_refused_by_vertex(given, reason):
    with pytest.raises(FitError, match=reason):
        fit_alignment(given, 0.01)


def test_what_does_not_fit_is_refused():
    given = DENSE.copy()
    given[::2] += (0.0, 0.5)  # a zigzag
    with pytest.raises(FitError, match="curves: a larger tolerance is needed"):
        fit_alignment(given, 0.02)


SCENARIO = """\
version: 1
title: a line from the map
train: {speed_kmh: 40, consist: [{car: box_car, count: 3}]}
initiation: {position_m: 200}
track: {rail_breaks: [400], file: %s}
site: {reference_system: local}
"""


def scenario(tmp_path, name, content):
    (tmp_path / name).write_text(content)
    (tmp_path / "there.yaml").write_text(SCENARIO % name)
    return load_scenario(tmp_path / "there.yaml")


def test_a_scenario_takes_its_track_from_a_line_or_a_table(tmp_path):
    xy = points(BEND, 1200.0, 10.0)
    s = np.arange(0.0, 1200.5, 10.0)
    height = GRADES.integral(s)
    coordinates = np.column_stack([xy, height]).tolist()
    geometry = {"type": "LineString", "coordinates": coordinates}
    feature = {"type": "Feature", "properties": {}, "geometry": geometry}
    data = {"type": "FeatureCollection", "features": [feature]}
    rows = [f"{a},{np.interp(a, *BEND.knots())},{b}" for a, b in zip(s, height, strict=True)]
    table = "\n".join(["chainage_m,curvature_per_m,height_m", *rows])
    for name, content in (("line.geojson", json.dumps(data)), ("line.csv", table)):
        loaded = scenario(tmp_path, name, content)
        kinds = [next(iter(p)) for p in loaded.resolved()["track"]["alignment"]]
        assert kinds == ["tangent", "spiral", "curve", "spiral", "tangent"]
        curve = loaded.resolved()["track"]["alignment"][2]["curve"]
        assert curve["radius_m"] == pytest.approx(500.0, rel=0.005)
        assert curve["length_m"] == pytest.approx(400.0, abs=0.5)
        grades = loaded.to_params().track.grades
        assert [g.grade for g in grades] == pytest.approx([0.0, 0.012, -0.006], abs=1e-4)
        assert loaded.files[name] == content.encode()
        assert any("residual" in note for note in loaded.warnings)


def test_grades_of_the_scenario_go_with_a_line_without_heights(tmp_path, monkeypatch):
    """And with one that has heights they are refused."""
    text = SCENARIO.replace("file: %s", "file: %s, grades: [{grade_percent: -0.8}]")
    monkeypatch.setattr(sys.modules[__name__], "SCENARIO", text)
    rows = "".join(f"{s},0\n" for s in range(0, 1201, 100))
    loaded = scenario(tmp_path, "line.csv", f"chainage_m,curvature_per_m\n{rows}")
    assert [g.grade for g in loaded.to_params().track.grades] == pytest.approx([-0.008])
    rows = "".join(f"{s},0,5\n" for s in range(0, 1201, 100))
    with pytest.raises(ScenarioError, match="track.grades: come from the heights of the file too"):
        scenario(tmp_path, "line.csv", f"chainage_m,curvature_per_m,height_m\n{rows}")


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("chainage_m,height_m\n0,1\n", "line.csv:1: needs the columns"),
        (
            "chainage_m,curvature_per_m\n0,0\n5,x\n",
            "line.csv:3: curvature_per_m: must be a number",
        ),
        ("chainage_m,curvature_per_m\n9,0\n5,0\n", "line.csv:3: chainage_m: must rise"),
        ("chainage_m,curvature_per_m\n0,0\n5,2\n", "line.csv:3: curvature_per_m: must lie"),
    ],
)
def test_bad_tables_are_refused_by_row(tmp_path, content, reason):
    with pytest.raises(ScenarioError) as error:
        scenario(tmp_path, "line.csv", content)
    assert reason in str(error.value)
