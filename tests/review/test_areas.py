"""Does anything reach the school? Areas and walls in tables, summaries, files and pictures."""

import csv
from dataclasses import replace

import numpy as np
import pytest

from derail_ros import models
from derail_ros.cli import main
from derail_ros.recording import record_run
from derail_ros.recording.reader import read_bag
from derail_ros.review import drawing
from derail_ros.review.scene import scene_from_simulation
from derail_ros.review.summary import text as summary
from derail_ros.scenario import loads_scenario
from derail_ros.studies.ensemble import advance
from derail_ros.studies.records import interval
from derail_ros.vocabulary.site import Shape, site_rows

TEXT = """\
version: 1
title: beside a school
train: {speed_kmh: 30, consist: [{car: box_car, count: 3}]}
track: {rail_breaks: [12]}
initiation: {lateral_force_car: 1}
integration: {time_limit_s: 2}
site:
  fixed: [{name: wall, outline_along_m: [[-10, -60], [60, -60]]}]
  areas:
    - {name: line, outline_m: [[10, -5], [10, 5]], closed: false}
    - {name: school, outline_m: [[0, 60], [30, 60], [30, 80], [0, 80]]}
"""


def test_the_interval_of_a_share():
    """Clopper and Pearson: (k + 1)-th of n by the binomial distribution, 5 % at each end."""
    from scipy.stats import binom

    assert interval(0, 28) == (0.0, pytest.approx(1.0 - 0.05 ** (1.0 / 28.0)))
    assert interval(28, 28) == (pytest.approx(0.05 ** (1.0 / 28.0)), 1.0)
    low, high = interval(5, 28)
    assert binom.sf(4, 28, low) == pytest.approx(0.05)
    assert binom.cdf(5, 28, high) == pytest.approx(0.05)


def test_an_ensemble_says_how_often_cars_reach_a_place(tmp_path, capsys):
    (tmp_path / "there.yaml").write_text(TEXT, encoding="utf-8")
    out = tmp_path / "out"
    assert main(["simulate", str(tmp_path / "there.yaml"), "-n", "3", "-o", str(out)]) == 0
    lines = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    assert "line: a car enters 3 of 3 100 % above 37 %" in lines
    assert "school: a car enters 0 of 3 0 % below 63 %" in lines
    assert "wall: a car strikes it 0 of 3 0 % below 63 %" in lines
    with (out / "outcomes.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["entered.school"] for row in rows] == ["0"] * 3
    assert [row["struck.wall"] for row in rows] == ["0"] * 3
    assert all(int(row["entered.line"]) > 0 for row in rows)


def test_a_run_and_its_summary_say_which_cars_entered(tmp_path, capsys):
    (tmp_path / "there.yaml").write_text(TEXT, encoding="utf-8")
    assert main(["simulate", str(tmp_path / "there.yaml")]) == 0
    shown = capsys.readouterr().out
    assert "school" in shown and "no car entered" in shown
    simulation = models.build(loads_scenario(TEXT, "there").to_params())
    record_run(simulation, loads_scenario(TEXT, "there"), tmp_path / "bag")
    text = summary(read_bag(tmp_path / "bag"))
    rows = dict(site_rows(simulation.outcome().site.record()))
    assert rows["school"] == "no car entered" and rows["wall"] == "not struck"
    assert rows["line"].startswith("car")
    for name, words in rows.items():
        assert any(line.split() == [name, *words.split()] for line in text.splitlines())


def test_areas_are_in_the_frame_of_a_picture():
    """One nearby is shown whole, one too far away not, and a long line by its near edge."""
    simulation = models.build(loads_scenario(TEXT, "there").to_params())
    advance(simulation)
    scene = scene_from_simulation(simulation)
    window = drawing.site(scene)
    assert window[3] < 60.0
    grown = drawing.with_areas(window, scene)
    assert grown[3] >= 80.0 and grown[2] > -20.0
    far = Shape("area", "far", True, np.array([[0.0, 5e3], [9.0, 5e3], [9.0, 5.1e3]]))
    assert drawing.with_areas(window, replace(scene, site=(far,))) == pytest.approx(window)
    road = Shape("area", "road", False, np.array([[-5e3, 60.0], [5e3, 60.0]]))
    grown = drawing.with_areas(window, replace(scene, site=(road,)))
    assert 60.0 < grown[3] < 80.0 and grown[1] - grown[0] < 300.0


def test_the_scale_and_the_break_label_keep_clear_of_cars():
    """A car in the lower right corner: the scale goes to the lower left, the label to the top."""
    from matplotlib.text import Annotation

    simulation = models.build(loads_scenario(TEXT, "there").to_params())
    scene = scene_from_simulation(simulation)
    window = (0.0, 100.0, 0.0, 60.0)
    pose = np.array([[90.0, 4.0, 0.0], [75.0, 4.0, 0.0], [-90.0, 4.0, 0.0]])
    breaks = np.array([[80.0, 30.0, 0.0]])
    scene = replace(scene, pose=pose, breaks=breaks, site=(), track=np.array([[0, 30], [100, 30]]))
    page = drawing.sheet(6.0, 4.0)
    axes = drawing.place(page, 0.0, 0.0, 6.0, 3.6)
    drawing.show(axes, window)
    drawing.draw_track(axes, scene, window, 4.3)
    drawing.scale_inside(axes, window, 0.2, scene=scene)
    at = {t.get_text(): t.xy for t in axes.get_children() if isinstance(t, Annotation)}
    assert at["20 m"][0] < 30.0 and at["20 m"][1] < 10.0
    assert at["rail break"] == pytest.approx((80.0, 57.9))
    free = replace(scene, pose=pose - [0.0, 90.0, 0.0], breaks=np.zeros((0, 3)))
    axes = drawing.place(page, 0.0, 0.0, 6.0, 3.6)
    drawing.scale_inside(axes, window, 0.2, scene=free)
    assert axes.texts[0].xy[0] > 70.0


def test_the_name_of_a_wall_keeps_clear_of_cars():
    """A car stands in the middle of a wall: the name goes beside it."""
    from matplotlib.text import Annotation

    simulation = models.build(loads_scenario(TEXT, "there").to_params())
    wall = Shape("fixed", "wall", False, np.array([[0.0, 20.0], [50.0, 20.0], [100.0, 20.0]]))
    pose = np.array([[50.0, 20.0, 0.0], [40.0, -40.0, 0.0], [50.0, -40.0, 0.0]])
    scene = replace(scene_from_simulation(simulation), pose=pose, site=(wall,))
    page = drawing.sheet(6.0, 4.0)
    axes = drawing.place(page, 0.0, 0.0, 6.0, 3.6)
    window = (-10.0, 110.0, -12.0, 60.0)
    drawing.show(axes, window)
    drawing.draw_site(axes, scene, window)
    at = next(t.xy for t in axes.get_children() if isinstance(t, Annotation))
    assert abs(at[0] - 50.0) > 10.0 and at[1] == 20.0
