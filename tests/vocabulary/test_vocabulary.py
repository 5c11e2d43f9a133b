"""Numbers in words, the ledger's balance and shares, measures and events."""

import math
from dataclasses import fields, replace

import numpy as np
import pytest

from derail_ros.vocabulary.events import Event, EventKind
from derail_ros.vocabulary.ledger import (
    ENERGY_ENTRIES,
    INITIAL,
    PUT,
    STORED,
    TAKEN,
    percentages,
    residual,
    stopped_by,
)
from derail_ros.vocabulary.measures import MEASURES, measure, outcome_record
from derail_ros.vocabulary.outcome import Outcome
from derail_ros.vocabulary.sample import Sample, planar
from derail_ros.vocabulary.scene import car_corners
from derail_ros.vocabulary.status import STATUSES
from derail_ros.vocabulary.words import finite, number_list


def outcome(**changes):
    return replace(Outcome.nothing(np.zeros((4, 6)), "at rest", 12.0, 7), **changes)


def test_the_residual_is_what_the_roles_leave():
    signs = {STORED: -1.0, TAKEN: -1.0, INITIAL: 1.0, PUT: 1.0}
    ledger = {key: 2.0**k for k, key in enumerate(ENERGY_ENTRIES)}
    expected = sum(signs.get(ENERGY_ENTRIES[k].role, 0.0) * v for k, v in ledger.items())
    assert residual(ledger) == expected
    assert residual({"initial": 5.0, "kinetic": 3.0}) == 2.0


@pytest.mark.parametrize("values", [[0.555, 0.445], [1 / 3] * 3, [0.005, 0.005, 0.99], [0.2]])
def test_percentages_add_up(values):
    assert sum(percentages(values)) == round(100 * sum(values))
    assert all(abs(n - 100 * v) < 1.0 for n, v in zip(percentages(values), values))


def test_what_stopped_the_train():
    ledger = {"initial": 2e8, "brakes": 1.12e8, "ground_trucks": 0.88e8, "collisions": 1e5}
    assert stopped_by(ledger) == (
        "Of the 200 MJ at the start, these took: the brakes 56 % and the ground under derailed "
        "trucks 44 %. Less than half a percent each: collisions between cars."
    )
    assert "40 % is still motion" in stopped_by({"initial": 1e6, "kinetic": 4e5, "brakes": 6e5})
    assert "nothing has been taken out" in stopped_by({"initial": 1e6, "brakes": 0.0})
    assert stopped_by({}) == "The energy ledger is not known."


def test_the_duration_is_the_time_to_rest_and_nothing_else():
    rest = outcome_record(outcome())
    assert (rest["duration_s"], rest["end_time_s"], rest["at_rest"]) == (12.0, 12.0, True)
    for status in set(STATUSES) - {"at rest"}:
        o = Outcome.nothing(np.zeros((4, 6)), status, 30.0)
        assert outcome_record(o)["duration_s"] is None
        assert "at rest after" not in o.text and "30.0 s" in o.text


def test_the_rear_part_stopped_only_if_the_train_did():
    behind = {"rear_part_first_car": 3, "rear_part_coordinate": -4.0}
    assert outcome_record(outcome(**behind))["rear_stop_m"] == -4.0
    moving = outcome_record(outcome(**behind, status="time limit"))
    assert moving["rear_stop_m"] is None and moving["rear_part_coordinate_m"] == -4.0


def test_measures_have_units_in_their_names_and_are_plain_data():
    record = outcome_record(outcome(peak_force=2.5e6, peak_force_pair=(np.int64(2), np.int64(1))))
    for key, m in MEASURES.items():
        assert m.key == key and (not m.unit or key.endswith(f"_{m.unit}"))
        assert type(record[key]) in (int, float, str, bool, list, type(None)), key
    assert measure("peak_force_MN") is MEASURES["peak_force_N"]
    assert MEASURES["peak_force_N"].shown(2.5e6) == "2.50"
    assert MEASURES["peak_force_pair"].shown([2, 1]) == "car 2 into car 1"
    assert MEASURES["cars_above_5MN"].shown([1, 2, 3, 7]) == "4  (1 to 3, 7)"
    assert MEASURES["cars_above_5MN"].number([1, 2]) == 2.0
    assert MEASURES["duration_s"].shown(None) == "-"
    with pytest.raises(KeyError):
        measure("no_such")


def test_a_sample_that_is_not_whole_is_filled():
    s = Sample.make(1.0, 2, planar(np.array([[1.0, 2.0, 0.3], [0.0, 0.0, 0.1]])))
    assert s.q.tolist() == [[1.0, 2.0, 0.3, 0.3, 0.3], [0.0, 0.0, 0.1, 0.1, 0.1]]
    assert s.truck_on.all() and s.coupled.tolist() == [1]
    whole = {f.name for f in fields(Sample)} - {"time", "step", "energy", "cars", "couplings"}
    assert all(len(getattr(s, name)) in (1, 2) for name in whole)
    with pytest.raises(TypeError, match="no_such"):
        Sample.make(1.0, 2, np.zeros((2, 6)), no_such=1)


def test_corners_of_a_turned_car():
    pose = planar(np.array([[10.0, 5.0, math.pi / 2]]))
    corners = car_corners(pose, np.array([20.0]), np.array([3.0]))[0]
    assert corners == pytest.approx(np.array([[8.5, 15], [11.5, 15], [8.5, -5], [11.5, -5]]))


def test_every_kind_of_event_has_words():
    for kind in EventKind:
        assert Event(kind, 1.0, 1, cars=(3, 4)).text
    hair = Event(EventKind.TRUCK_DERAILED, 1.0, 3, cars=(2,), track_coordinate=-1e-9)
    assert " at 0.0 m" in hair.text


def test_numbers_and_lists_in_words():
    assert number_list([1, 2, 3, 5, 7, 8]) == "1 to 3, 5, 7, 8"
    assert number_list([]) == "none"
    assert finite(math.inf) is None and finite(1.23456, 2) == 1.23
