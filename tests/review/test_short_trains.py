"""Recordings of one and two cars: nothing in words or figures about what is not there."""

import re

import pytest

from derail_ros.recording import record_run
from derail_ros.recording.reader import read_bag
from derail_ros.review import figures, plots, summary
from derail_ros.review.scene import final_scene
from tests.nodes.support import simulation, small

SCENARIO = """
version: 1
constants: published
title: A short train over a broken rail
train:
  speed_kmh: 60
  consist:
    - {{car: tank_dot_111, count: {cars}}}
track:
  rail_breaks: [30]
"""


@pytest.fixture(scope="module", params=[1, 2])
def short(request, tmp_path_factory):
    """A run of a car or two, off the rails and struck by nothing."""
    text = SCENARIO.format(cars=request.param)
    path = tmp_path_factory.mktemp("bags") / "short"
    record_run(simulation(text), small(text), path)
    return read_bag(path)


def told(figure):
    """Every text of a figure."""
    found = [t.get_text() for t in figure.texts]
    for axes in figure.axes:
        found += [t.get_text() for t in axes.texts]
        legends = [axes.get_legend()] if axes.get_legend() else []
        found += [t.get_text() for legend in legends for t in legend.get_texts()]
    return found + [t.get_text() for legend in figure.legends for t in legend.get_texts()]


def test_the_summary_has_no_nonsense(short) -> None:
    text = summary.text(short).replace(str(short.path), "")  # in a folder of any name
    assert len(short.outcome.derailed_cars) == short.n
    assert not re.search(r"-0(\.0)?\b(?!\.)", text), "a zero with a sign"
    assert not re.search(r"\b0 J|nan", text)
    assert "strikers" not in text  # what it took would be written as 0 J
    assert ("runs through" in text) == (short.n > 1)
    assert "torn loose" not in text  # nothing parted


def test_the_scene_tells_of_couplings_where_there_are_some(short) -> None:
    figure = figures.final_scene(final_scene(short))
    assert ("coupled" in told(figure)) == (short.n > 1)
    assert "parted" not in told(figure)
    # The dimensions lie clear of the cars and of the couplers at their ends.
    main = figure.axes[0]
    scene = final_scene(short)
    renderer = figure.canvas.get_renderer()
    figure.draw_without_rendering()
    labels = [t for t in main.texts if re.fullmatch(r"[\d.]+ m", t.get_text())]
    assert len(labels) == 2
    boxes = [t.get_window_extent(renderer).transformed(main.transData.inverted()) for t in labels]
    above, beside = sorted(boxes, key=lambda box: -box.y0)
    assert above.y0 > scene.corners()[..., 1].max()
    assert beside.x0 > scene.faces()[..., 0].max()


def test_speeds_are_explained_by_what_is_drawn(short) -> None:
    figure = plots.speeds(short)
    texts = told(figure)
    assert not any("stayed on the rails" in t for t in texts)
    assert any("coloured by their number" in t for t in texts) == (short.n > 1)
    assert ("car 1" in texts) == (short.n == 1)
    if short.n == 1:
        assert len(figure.axes) == 1  # no bar of colours for one car
    else:
        ticks = [float(t) for t in figure.axes[1].get_yticks()]
        assert ticks == [1.0, 2.0]


def test_the_energy_has_no_parts_of_nothing(short) -> None:
    texts = told(plots.energy_over_time(short))
    assert any(t.startswith("brakes\n") for t in texts)
    assert not any("\n0 J" in t for t in texts)


def test_peak_forces_where_no_car_was_struck(short) -> None:
    texts = told(figures.peak_forces(short.outcome))
    assert "No car was struck." in texts
    assert not any(t.startswith(("Above each bar", "below 5 MN")) for t in texts)
