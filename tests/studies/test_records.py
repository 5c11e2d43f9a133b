"""Records of outcomes and their moments."""

import json
import math

import numpy as np
import pytest

from derail_ros.studies.records import Ensemble
from derail_ros.vocabulary.measures import counted, failed_record, outcome_record, record_numbers
from derail_ros.vocabulary.words import finite
from tests.studies.made_up import outcome as made_up


def outcome(**changes):
    values = {
        "derailed_cars": (1, 2, 3),
        "duration": 12.5,
        "peak_force_pair": (np.int64(2), np.int64(1)),
        "peak_force_time": 3.25,
        "energy": {"initial": 1e8, "brakes": 4e7, "residual": float("nan")},
        "derail_time": np.array([math.nan, 1.25, 0.5]),
    }
    return made_up(**(values | changes))


def test_record_is_json_without_nan():
    record = outcome_record(
        outcome(peak_force_pair=None, peak_force_time=math.nan, duration=math.inf), 0.25
    )
    text = json.dumps(record, allow_nan=False)
    back = json.loads(text)
    assert back["peak_force_pair"] is None
    assert back["peak_force_time_s"] is None
    assert back["duration_s"] is None
    assert back["energy_J"] == {"initial": 1e8, "brakes": 4e7, "residual": None}
    assert back["wall_s"] == 0.25


def test_record_holds_plain_types():
    record = outcome_record(outcome())
    assert record["peak_force_pair"] == [2, 1]
    assert all(type(c) is int for c in record["peak_force_pair"])
    assert record["wall_s"] is None


def test_number():
    assert finite(np.float64(2.0)) == 2.0
    assert finite(None) is None
    assert finite(math.nan) is None


def test_flatten_counts_lists_and_leaves_out_what_has_no_mean():
    flat = record_numbers(outcome_record(outcome(car_peak_force=np.array([6e6, 1e6, 7e6]))))
    assert flat["cars_above_5MN"] == 2.0
    assert flat["energy_J.brakes"] == 4e7
    assert not {"derailed_cars", "peak_force_pair", "void", "status"} & flat.keys()


def ensemble(*records):
    return Ensemble(tuple(records))


def test_means_and_deviations_are_numpys():
    durations = np.random.default_rng(1).normal(25.0, 1.0, 50)
    found = ensemble(*(outcome_record(outcome(duration=d)) for d in durations))
    assert len(found.good) == 50
    assert found.mean()["duration_s"] == pytest.approx(durations.mean(), rel=1e-12)
    assert found.sd()["duration_s"] == pytest.approx(durations.std(ddof=1), rel=1e-9)
    assert found.mean()["energy_J"]["brakes"] == pytest.approx(4e7)


def test_void_and_failed_are_counted_but_left_out():
    found = ensemble(
        outcome_record(outcome()),
        outcome_record(outcome(status="void", derailed_cars=tuple(range(1, 100)))),
        failed_record("StepSizeError: step below its floor", 0.1),
    )
    assert (len(found.good), found.void, found.failed) == (1, 1, 1)
    assert found.mean()["cars_derailed"] == 3.0
    assert found.sd()["cars_derailed"] is None
    assert not counted(failed_record("x"))


def test_a_measure_that_some_runs_lack_is_the_mean_of_the_others():
    found = ensemble(outcome_record(outcome()), outcome_record(outcome(peak_force_time=math.nan)))
    assert found.mean()["peak_force_time_s"] == 3.25
    assert found.sd()["peak_force_time_s"] is None


def test_no_runs_at_all():
    found = ensemble(failed_record("x"))
    assert found.mean() == {}
    assert found.sd() == {}


def test_the_first_derailment_and_rest():
    record = outcome_record(outcome())
    assert record["first_derailment_s"] == 0.5 and record["at_rest"] is True
    nothing = outcome_record(outcome(derail_time=np.full(3, math.nan), status="time limit"))
    assert nothing["first_derailment_s"] is None and nothing["at_rest"] is False
