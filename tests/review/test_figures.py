"""Figures: what is on them, that they can be read, that pyplot is left alone."""

import math
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.patches import Patch

from derail_ros.review import drawing, figures
from derail_ros.review.scene import Scene, make_scene
from derail_ros.vocabulary.outcome import Outcome
from derail_ros.vocabulary.params import Car, CouplerType

F79 = CouplerType("F79", "F", 1.092, 0.788, 0.170, 3.15e6)


def cars(n, represents=1):
    made = [
        Car(
            mass=120e3,
            inertia=2e6,
            length=13.58,
            width=2.6,
            pivot_distance=6.63,
            truck_distance=5.75,
            front=F79,
            rear=F79,
        )
        for _ in range(n)
    ]
    if represents > 1:
        made[-1] = Car(**(made[-1].__dict__ | {"represents": represents}))
    return made


def pile_up(n=30, derailed=8, represents=1, **kwargs):
    rng = np.random.default_rng(0)
    pose = np.zeros((n, 3))
    pose[:derailed, 0] = 40.0 - 4.0 * np.arange(derailed)
    pose[:derailed, 1] = rng.normal(0.0, 4.0, derailed)
    pose[:derailed, 2] = np.where(np.arange(derailed) % 2, 1.2, -1.2)
    pose[derailed:, 0] = 4.0 - 15.4 * np.arange(n - derailed)
    trucks = np.ones((n, 2), dtype=np.uint8)
    trucks[:derailed] = 0
    coupled = np.ones(n - 1, dtype=np.uint8)
    coupled[: derailed - 2] = 0
    force = np.zeros(n)
    force[:derailed] = np.linspace(2e6, 14e6, derailed)
    outcome = SimpleNamespace(
        car_peak_force=force, scene_length=61.0, scene_width=24.5, scene_area=1494.5
    )
    return make_scene(
        cars(n, represents), pose, trucks, coupled, outcome=outcome, breaks=[0.0],
        title="A pile-up", subtitle="8 cars derailed", **kwargs,
    )  # fmt: skip


def texts(figure):
    found = [t.get_text() for t in figure.texts]
    for axes in figure.axes:
        found += [t.get_text() for t in axes.texts]
    for legend in figure.legends:
        found += [t.get_text() for t in legend.get_texts()]
    return found


# The scene ---------------------------------------------------------------------------------


def test_states_of_cars():
    scene = pile_up()
    assert scene.derailed.sum() == 8
    assert scene.free.tolist() == [True] * 6 + [False] * 24


def test_a_missing_neighbour_counts_as_parted():
    scene = make_scene(
        cars(2), np.zeros((2, 3)), np.array([[0, 1], [1, 1]]), np.array([0]), outcome=None
    )
    assert scene.free.tolist() == [True, False]


def test_geometry_of_a_car():
    pose = np.array([[10.0, 5.0, math.pi / 2.0]])
    scene = make_scene(cars(1), pose, np.ones((1, 2)), np.zeros(0), coupler=np.array([[0.0, 0.0]]))
    np.testing.assert_allclose(
        scene.corners()[0],
        [[8.7, 11.79], [11.3, 11.79], [8.7, -1.79], [11.3, -1.79]],
        atol=1e-12,
    )
    np.testing.assert_allclose(
        scene.outlines()[0],
        [[8.7, 11.79], [11.3, 11.79], [11.3, -1.79], [8.7, -1.79]],
        atol=1e-12,
    )
    np.testing.assert_allclose(scene.pivots()[0], [[10.0, 11.63], [10.0, -1.63]], atol=1e-12)
    # face = pivot + d_C (cos alpha, sin alpha) in front, - d_C (cos beta, sin beta) behind
    np.testing.assert_allclose(scene.faces()[0], [[11.092, 11.63], [8.908, -1.63]], atol=1e-12)


def test_mated_faces_of_a_straight_train_meet():
    n = 5
    pose = np.zeros((n, 3))
    pose[:, 0] = -np.arange(n) * 2.0 * (6.63 + 1.092)
    scene = make_scene(cars(n), pose, np.ones((n, 2)), np.ones(n - 1))
    np.testing.assert_allclose(scene.faces()[:-1, 1], scene.faces()[1:, 0], atol=1e-12)


def test_wrong_shapes_are_named():
    with pytest.raises(ValueError, match="coupled"):
        make_scene(cars(3), np.zeros((3, 3)), np.ones((3, 2)), np.ones(3))


def test_scene_from_a_curved_track():
    class Circle:
        start, end, straight = -1000.0, 1000.0, False

        def point(self, s):
            return (
                400.0 * math.sin(s / 400.0),
                400.0 * (1 - math.cos(s / 400.0)),
                s / 400.0,
                1 / 400,
            )

        def locate(self, x, y):
            return 400.0 * math.atan2(x, 400.0 - y), 0.0

    pose = np.array([[*Circle().point(s)[:2], s / 400.0] for s in (0.0, -15.0, -30.0)])
    scene = make_scene(
        cars(3), pose, np.ones((3, 2)), np.ones(2), track=Circle(), breaks=[10.0], title="curve"
    )
    assert not scene.straight
    assert len(scene.track) > 20
    np.testing.assert_allclose(scene.breaks[0], Circle().point(10.0)[:3])
    figures.final_scene(scene)


# final_scene -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def figure():
    return figures.final_scene(pile_up())


def test_a_body_for_many_cars_is_explained_where_it_can_be_seen():
    for n, here in ((12, False), (9, True), (40, True)):
        # Of 9 it is the car behind the break, of 40 it is in the strip below.
        drawn = figures.final_scene(pile_up(n=n, represents=50))
        strip = len(drawn.axes) == 3
        assert ("one body for 50 cars" in texts(drawn)) == here, n
        assert strip == (n == 40)


def test_derailed_cars_are_numbered_and_drawn_to_scale(figure):
    main = figure.axes[0]
    shown = [t.get_text() for t in main.texts]
    assert {str(i) for i in range(1, 9)} <= set(shown)
    assert main.get_aspect() == 1.0
    x0, x1 = main.get_xlim()
    y0, y1 = main.get_ylim()
    box = main.get_position()
    width, height = figure.get_size_inches()
    per_metre = (box.width * width / (x1 - x0), box.height * height / (y1 - y0))
    assert per_metre[0] == pytest.approx(per_metre[1], rel=1e-6)


def test_all_derailed_cars_are_within_the_picture(figure):
    scene = pile_up()
    corners = scene.corners()[:8].reshape(-1, 2)
    (x0, x1), (y0, y1) = figure.axes[0].get_xlim(), figure.axes[0].get_ylim()
    assert (corners[:, 0] > x0).all()
    assert (corners[:, 0] < x1).all()
    assert (corners[:, 1] > y0).all()
    assert (corners[:, 1] < y1).all()


def test_dimensions_break_scale_and_key(figure):
    found = texts(figure)
    for text in ("61.0 m", "24.5 m", "rail break", "direction of travel", "coupled", "parted"):
        assert text in found
    assert "derailed, uncoupled (6)" in found
    assert "derailed, coupled (2)" in found
    assert "on the rails (22)" in found
    assert any(t.endswith("m shown; the frame is the picture above") for t in found)


def test_dimensions_lie_clear_of_cars_and_couplers_that_stick_out():
    """Of a car across the track in the middle, its front coupler towards the label."""
    scene = pile_up()
    low, high = np.ptp(scene.corners()[:8, :, 0]), scene.corners()[:8, :, 1].max()
    middle = scene.corners()[:8, :, 0].min() + 0.5 * low
    scene.pose[3] = (middle, high - 5.0, math.pi / 2)
    coupler = scene.faces()[3, 0]
    assert coupler[1] > scene.corners()[:8, :, 1].max() + 0.5
    figure = figures.final_scene(scene)
    figure.draw_without_rendering()
    axes = figure.axes[0]
    (label,) = (t for t in axes.texts if t.get_text() == "61.0 m")
    box = label.get_window_extent(figure.canvas.get_renderer())
    box = box.transformed(axes.transData.inverted())
    assert box.y0 > coupler[1]


def test_states_differ_by_more_than_colour(figure):
    (legend,) = figure.legends
    hatches = [h.get_hatch() for h in legend.legend_handles if isinstance(h, Patch)]
    assert len(set(hatches)) == len(hatches) == 3


def test_marks_of_forces():
    found = texts(figures.final_scene(pile_up()))
    diamond = "\N{BLACK DIAMOND}"
    force = pile_up().peak_force
    assert found.count(diamond) == int(((force >= 5e6) & (force < 10e6)).sum())
    assert found.count(2 * diamond) == int((force >= 10e6).sum())


def test_a_train_on_the_rails_can_be_drawn():
    n = 74
    pose = np.zeros((n, 3))
    pose[:, 0] = -15.4 * np.arange(n)
    scene = make_scene(cars(n), pose, np.ones((n, 2)), np.ones(n - 1))
    assert "on the rails (74)" in texts(figures.final_scene(scene))


def test_the_body_that_stands_for_cars_is_named():
    found = texts(figures.final_scene(pile_up(n=10, represents=50)))
    assert "one body for 50 cars" in found
    assert "on the rails (1)" in found


@pytest.mark.parametrize("title", ["Short", "A title of a hundred letters and more " * 3])
def test_nothing_runs_off_the_page(title):
    scene = pile_up()
    scene = Scene(**(scene.__dict__ | {"title": title}))
    drawn = figures.final_scene(scene)
    drawn.canvas.draw()
    renderer = drawn.canvas.get_renderer()
    width, height = (s * drawn.dpi for s in drawn.get_size_inches())
    boxes = [t.get_window_extent(renderer) for t in drawn.texts]
    boxes += [legend.get_window_extent(renderer) for legend in drawn.legends]
    for box in boxes:
        assert box.x0 >= 0.0
        assert box.x1 <= width
        assert box.y0 >= 0.0
        assert box.y1 <= height


def test_numbers_of_cars_that_lie_on_each_other_do_not():
    pose = np.zeros((3, 3))
    pose[:, 0] = [0.0, 0.5, 60.0]
    scene = make_scene(cars(3), pose, np.zeros((3, 2)), np.zeros(2))
    places = drawing.number_places(scene, 2.0)
    assert np.linalg.norm(places[1] - places[0]) >= 2.0
    np.testing.assert_allclose(places[[0, 2]], pose[[0, 2], :2])


# peak_forces -------------------------------------------------------------------------------


def peaks(force, other, time=None, derailed=()):
    """An outcome with these peak forces."""
    n = len(force)
    outcome = Outcome.nothing(np.zeros((n, 6)), "at rest", 20.0)
    return replace(
        outcome,
        car_peak_force=np.asarray(force, dtype=float),
        car_peak_other=np.asarray(other),
        car_peak_time=np.full(n, math.nan) if time is None else np.asarray(time),
        derailed_cars=tuple(derailed),
    )


def test_peak_forces_shows_bars_lines_and_opponents():
    drawn = figures.peak_forces(
        peaks([2e6, 7e6, 12e6, 0.0], [2, 1, 2, 0], [1.0, 2.0, 3.0, math.nan], (1, 2, 3))
    )
    (axes,) = drawn.axes
    heights = sorted(p.get_height() for p in axes.patches)
    assert heights == pytest.approx([2.0, 7.0, 12.0])
    assert [line.get_ydata()[0] for line in axes.lines[:2]] == [5.0, 10.0]
    found = [t.get_text() for t in axes.texts]
    assert "2\n1.0 s" in found
    assert "1\n2.0 s" in found
    labels = [t.get_text() for t in axes.get_legend().get_texts()]
    assert labels == ["below 5 MN (1)", "5 to 10 MN (1)", "above 10 MN (1)", "derailed"]


def test_peak_forces_leaves_out_cars_far_from_the_trouble_and_says_so():
    force = np.zeros(74)
    force[30:40] = 3e6
    drawn = figures.peak_forces(
        peaks(force, np.ones(74, dtype=int), np.zeros(74), derailed=range(31, 41))
    )
    assert drawn.axes[0].get_xlim() == pytest.approx((28.3, 42.7))
    assert any("cars 1 to 28 and 43 to 74" in t for t in texts(drawn))


def test_peak_forces_without_collisions():
    drawn = figures.peak_forces(peaks(np.full(5, np.nan), np.zeros(5, dtype=int)))
    assert "no collisions" in texts(drawn)


# Files -------------------------------------------------------------------------------------


def test_save_writes_a_png_and_leaves_pyplot_alone(tmp_path, figure):
    before = "matplotlib.pyplot" in sys.modules
    path = drawing.save(figure, tmp_path / "scene.png", dpi=60)
    assert path.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert ("matplotlib.pyplot" in sys.modules) == before


def test_settings_of_others_are_left_alone():
    import matplotlib

    before = dict(matplotlib.rcParams)
    figures.final_scene(pile_up())
    figures.peak_forces(peaks([1e6], [1], [0.0]))
    assert dict(matplotlib.rcParams) == before


def test_the_same_scene_gives_the_same_picture(tmp_path):
    a = drawing.save(figures.final_scene(pile_up()), tmp_path / "a.png", dpi=50)
    b = drawing.save(figures.final_scene(pile_up()), tmp_path / "b.png", dpi=50)
    assert a.read_bytes() == b.read_bytes()
