"""What a prediction says of itself in words."""

from dataclasses import replace

import numpy as np

from derail_ros.predict.prediction import Prediction, differs, statistical_of, train_of
from derail_ros.predict.runs import OUTPUTS, Member
from derail_ros.scenario import load_scenario
from derail_ros.scenario.calibrated import load_calibrated
from derail_ros.vocabulary.params import GradeChange, TrackSegment

PARAMS = load_scenario("base_train").to_params()


def made_up(counts: list[float], few: list[int]) -> Prediction:
    constants = load_calibrated()
    outputs = np.full((len(counts), len(OUTPUTS)), np.nan)
    outputs[:, OUTPUTS.index("derailed")] = counts
    train = train_of(PARAMS)
    drawn = [Member(constants.draw(i, 0), k, i) for i, k in enumerate(few)]
    found = statistical_of(constants, "broken_rail", train)
    return Prediction(train, "broken_rail", "calibrated", drawn, outputs, found, 0.1)


def test_runs_without_a_pile_up_are_told_with_their_number_of_cars() -> None:
    (first, _) = made_up([20.0] * 8, [0, 0, 31, 0, 0, 3, 0, 0]).sentences()
    assert first.endswith(
        "In 25% of them no pile-up forms: the derailed cars are dragged along in line, "
        "17 on average and 31 at most, as in reports."
    )
    assert "no pile-up" not in made_up([20.0] * 4, [0] * 4).sentences()[0]


def test_why_runs_differ_from_the_statistical_models() -> None:
    usual = made_up([1.0], [0]).statistical
    mean = float(np.mean([p @ np.arange(1, len(p) + 1) for p in usual.values()]))
    assert differs(made_up([mean], [0]), PARAMS) == ""
    far = made_up([2.0 * mean], [0])
    track = replace(
        PARAMS.track, segments=(TrackSegment(900.0, 1 / 582.0, 1 / 582.0),),
        grades=(GradeChange(-np.inf, -0.008),),
    )  # fmt: skip
    brakes = replace(PARAMS.brakes, triggers=(), vent_on_parting=True)
    said = differs(far, replace(PARAMS, track=track, brakes=brakes))
    assert f"derail {2 * mean:.0f} cars on average, the statistical models {mean:.0f}" in said
    assert said.endswith(
        "This scenario also has a curve of 582 m radius, a grade of -0.8 % and brakes that begin "
        "only where a coupling parts."
    )
