"""The page on convergence and its figure."""

from research.convergence import convergence_figure, page
from tests.studies.test_convergence import made_up_study


def test_words_and_figure():
    study = made_up_study()
    text = page([study], 12, 0)
    assert "| rkf45 1e-5 | 100 |" in text
    assert "| 1e-2 | **+5.00 ± " in text
    assert "nan" not in text
    assert len(convergence_figure([study], 12).axes) == 6
