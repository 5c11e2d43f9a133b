"""The page on the reconstructed constants and its figure."""

import itertools

import pytest

from derail_ros.studies.sensitivity import COMPARED, CONTROL
from research import sensitivity as t
from tests.studies.test_sensitivity import made_up_study


@pytest.fixture(scope="module")
def study():
    return made_up_study()


def test_page(study):
    page = t.page(study)
    assert "(images/sensitivity.png)" in page
    assert "| brake force F0 (kN) | 64 | 35 | **+1.00 ± 0.00** |" in page
    assert f"## {CONTROL}" in page
    assert "## Runs left out" in page
    assert "nan" not in page
    assert max(len(line) for line in page.splitlines() if not line.startswith("|")) < 110


def test_figure(study):
    figure = t.tornado(study)
    assert len(figure.axes) == len(COMPARED)
    texts = " ".join(x.get_text() for x in figure.texts)
    assert "20  35  50  [64]  70" in texts
    assert "[Gaussian]  sech² | quartic | Lorentzian" in texts
    assert "0  2  [3.5]  5  0, mu_t 0.16" in texts
    assert "linear up to the first number on either side of zero and logarithmic beyond" in texts


@pytest.mark.parametrize("linear", [1.0, 20.0])
@pytest.mark.parametrize("reach", [1.15, 3.5, 11.5, 40.0, 70.0, 250.0, 2500.0])
def test_numbers_on_the_axes_of_the_figure_do_not_run_into_each_other(linear, reach):
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    places = t.ticks(linear, reach)
    assert places[len(places) // 2] == 0.0 and linear in places and -linear in places
    figure = Figure(figsize=(t.PANEL / 0.8, 2.0))
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.1, 0.3, 0.8, 0.5))
    axes.set_xscale("symlog", linthresh=linear, linscale=t.LINSCALE)
    axes.set_xlim(-max(reach, linear), max(reach, linear))
    axes.set_xticks(places, [f"{p:+g}" if p else "0" for p in places], size=7.5)
    figure.canvas.draw()
    boxes = [label.get_window_extent() for label in axes.get_xticklabels()]
    for a, b in itertools.pairwise(boxes):
        assert b.x0 - a.x1 > 1.0
