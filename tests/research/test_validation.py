"""The page on the validation, its figures, and the Mississauga run car by car."""

import dataclasses

import numpy as np
import pytest

from derail_ros.review.scene import make_scene
from derail_ros.scenario import load_scenario
from derail_ros.studies.published import PublishedCase, load_published
from derail_ros.studies.records import Ensemble
from derail_ros.studies.statements import Statement
from derail_ros.studies.validation import KEYS, CaseResult, validate
from derail_ros.vocabulary.measures import outcome_record
from research import mississauga
from research.mississauga import Details, details, load_published_run
from research.pages import DOCS
from research.validation import ARGUED, FIGURES, page, pairs_words
from research.validation_figures import peaks_by_car, published_against_computed, scene_series
from tests.studies.made_up import outcome, runner
from tests.studies.test_validation import made_up_comparison


@pytest.fixture
def comparison():
    return made_up_comparison()


def test_page(comparison):
    text = page(comparison)
    assert "| A train | 10 | 10.5 | 0.6 | 10 to 11 | in the band |" in text
    assert "| Another | 30.00 | 21.50 |" in text
    assert "| A train | 4.50 | 4.15 to 6.85 | 4.15 to 6.85 |" in text
    assert "| cars derailed | 1 of 1 | 1 of 1 |" in text
    assert "**missed**" in text
    assert "nan" not in text
    for file, _, _ in FIGURES:
        assert f"(images/{file})" in text
    lines = [line for line in text.splitlines() if not line.startswith("|")]
    assert max(map(len, lines)) < 100


def test_the_page_compares_the_numerics(comparison):
    text = page(comparison, dataclasses.replace(comparison, numerics="source"))
    assert "--numerics source" in text
    assert "| measure | goal | as shipped | as the source |" in text
    assert "as the source" not in page(comparison)


def test_the_page_says_which_statements_are_kept(comparison):
    said = (
        Statement("a", "one thing", "within 1 m", "0.5 m", True),
        Statement("b", "another thing", "in half of the runs", "in 2 of 10 runs", False),
    )
    text = page(dataclasses.replace(comparison, statements=said))
    assert "1 of 2 statements hold" in " ".join(text.split())
    assert "| another thing | in half of the runs | in 2 of 10 runs | **not kept** |" in text
    assert "in words" not in page(comparison)


def test_a_page_without_doubtful_ensembles(comparison):
    assert "in doubt" not in page(dataclasses.replace(comparison, doubtful=()))


def test_the_page_says_in_how_many_cases_the_published_pair_occurs():
    def result(name, pair, *pairs):
        published = {} if pair is None else {"peak_force_pair": pair}
        records = [outcome_record(outcome(peak_force_pair=p)) for p in pairs]
        case = PublishedCase(name, name.upper(), "s", published)
        return CaseResult(case, Ensemble(tuple(records)))

    none = [
        result("a", [11, 9], (8, 6), (15, 14)),
        result("b", [7, 6], (10, 11)),
        result("c", None),
    ]
    words = pairs_words(none)
    assert "in 0 of 2 cases" in words
    assert "0 % of the runs" in words
    # whichever of the two struck
    two = [*none, result("d", [3, 2], (5, 4), (3, 2)), result("e", [2, 3], (3, 2))]
    assert "in 2 of 4 cases" in pairs_words(two)
    assert "38 % of the runs" in pairs_words(two)
    assert "No pair" in pairs_words([result("c", None)])


def test_the_page_says_which_goals_are_missed_and_where_that_is_argued(comparison):
    met = [dataclasses.replace(g, value=next(iter(g.limits.values()))) for g in comparison.goals]
    missed = [*met[:2], dataclasses.replace(met[2], value=99.0), *met[3:]]
    text = " ".join(page(dataclasses.replace(comparison, goals=tuple(missed))).split())
    assert f"Missed: {met[2].text}. {ARGUED}" in text
    text = page(dataclasses.replace(comparison, goals=tuple(met)))
    assert "Missed" not in text and "decisions.md" not in text
    assert " ".join(pairs_words(comparison.cases).split()) in " ".join(text.split())


def test_the_paragraph_that_argues_is_there():
    title = ARGUED.split('"')[1]
    assert f"**{title}.**" in (DOCS / "decisions.md").read_text(encoding="utf-8")


def test_the_evidence_says_what_the_validation_page_says():
    text = (DOCS / "validation.md").read_text(encoding="utf-8")
    evidence = " ".join((DOCS / "evidence.md").read_text(encoding="utf-8").split())
    table = text.split("## Goals")[1].split("![")[0]
    rows = [line.split("|")[1:-1] for line in table.splitlines() if line.startswith("|")]
    reached = {row[0].strip(): [cell.strip() for cell in row[1:]] for row in rows if len(row) == 6}

    def of(words):
        (found,) = (cells for name, cells in reached.items() if name.startswith(words))
        return found

    cases, _, band, *_ = of("peak force, share")
    pairs, _, found, *_ = of("cases whose")
    share = of("published pair, mean share")[2]
    for said in (
        f"cars derailed to {of('cars derailed')[2]} cars (rms)",
        f"durations to {of('duration')[2]} s",
        f"scene lengths to {of('scene length')[2]} and widths to {of('scene width')[2]}",
        f"in {found.split('.')[0]} of {pairs} ensembles",
        f"in {100 * float(share):.0f} % of all their runs",
        f"of {round(float(band) * int(cases))} of {cases} ensembles",
    ):
        assert said in evidence


# Figures, and the run car by car -----------------------------------------------------------


def test_published_run():
    run = load_published_run()
    assert run.peaks[0].pair == (11, 9)
    assert run.by_car == {
        11: 23.09e6, 9: 23.09e6, 8: 16.11e6, 6: 16.11e6, 7: 15.70e6, 10: 15.36e6, 12: 13.77e6,
    }  # fmt: skip
    assert set(run.by_car) <= set(run.above)
    assert len(run.above) == 11
    assert list(run.scenes) == [5.7, 5.9, 8.0, 8.6]


@pytest.fixture(scope="module")
def made_up():
    """Details of a train of 24 cars and what is behind them."""
    cars = load_scenario(mississauga.SCENARIO).to_params().cars
    pose = np.zeros((len(cars), 3))
    pose[:, 0] = -15.0 * np.arange(len(cars))
    velocity = np.zeros((len(cars), 2))
    velocity[7:, 0] = 20.0
    on = np.ones((len(cars), 2), dtype=bool)
    on[:9] = False
    scene = make_scene(cars, pose, on, np.ones(len(cars) - 1, dtype=bool), breaks=[0.0])
    force = np.random.default_rng(0).uniform(0.0, 25e6, (6, len(cars)))
    force[:, 24:] = 0.0
    scenes = dict.fromkeys(load_published_run().scenes, (scene, velocity))
    return Details(force, scenes, scene, "summary")


def test_shares(made_up):
    assert made_up.share_above_10MN()[3] == np.mean(made_up.force[:, 3] > 10e6)


def test_peaks_by_car(made_up):
    figure = peaks_by_car(made_up, load_published_run(), "Mississauga")
    (axes,) = figure.axes
    assert axes.get_xlim()[1] > 24
    assert "11 into 9 23.09" in " ".join(t.get_text() for t in figure.texts)


def test_scenes(made_up):
    figure = scene_series(made_up, load_published_run(), "Mississauga")
    assert len(figure.axes) == 4
    texts = [t.get_text() for t in figure.texts]
    assert "standing here: 1 to 7" in texts
    assert any("11 into 9" in text for text in texts)


def test_published_against_computed():
    published = dataclasses.replace(load_published(), text={})
    made = runner(lambda run: outcome(duration=20.0 + run.member))
    comparison = validate(3, published=published, run=made)
    assert len(published_against_computed(comparison).axes) == len(KEYS)


@pytest.mark.slow
def test_details_for_real():
    found = details(3)
    assert found.force.shape == (3, 25)
    assert list(found.scenes) == [5.7, 5.9, 8.0, 8.6]
    scene, velocity = found.scenes[5.7]
    assert np.hypot(*velocity[0]) < np.hypot(*velocity[10])
    assert scene.derailed[0]
    assert found.final.derailed.sum() >= 18
    assert "cars derailed" in found.summary
