"""A field in another unit: converted by definition, told by the key that was written."""

import math

import jsonschema
import pytest

from derail_ros.scenario import ScenarioError, json_schema, loads_scenario
from derail_ros.scenario.strict_yaml import parse

TEXT = """\
version: 1
title: test train
train:
  speed_mph: 40
  consist:
    - {car: box_car, count: 2, length_over_couplers_ft: 58, mass_short_tons: 100}
    - {mass_lb: 200000, length_in: 600, truck_centres_ft: 38, coupler: F79, width_ft: 8.5}
track:
  start_heading_deg: 90
  alignment:
    - tangent: {length_mi: 1}
    - curve: {length_ft: 1000, degree_of_curve: 4, turn: left}
  rail_breaks: [900]
initiation: {position_m: 800, lateral_force_kN: 60}
"""


def test_each_quantity():
    scenario = loads_scenario(TEXT)
    car = scenario.model.train.consist[0]
    other = scenario.model.train.consist[1]
    assert scenario.model.train.speed_kmh == 64.37376
    assert car.length_over_couplers_m == pytest.approx(17.6784, rel=1e-15)
    assert car.mass_kg == pytest.approx(90718.474, rel=1e-15)
    assert (other.mass_kg, other.length_m) == pytest.approx((90718.474, 15.24), rel=1e-15)
    track = scenario.model.track
    assert track.start_heading_rad == pytest.approx(math.pi / 2)
    assert track.alignment[0].tangent.length_m == 1609.344
    # 100 feet of arc turn by the degree of the curve
    assert track.alignment[1].curve.radius_m * math.radians(4) == pytest.approx(30.48)
    assert scenario.to_params().initiation.lateral_forces[0].force == 60e3


def test_the_same_train_whatever_the_unit():
    si = TEXT.replace("speed_mph: 40", "speed_kmh: 64.37376")
    assert loads_scenario(si).hash == loads_scenario(TEXT).hash


def test_overrides_replace_the_field():
    base = loads_scenario(TEXT)
    for changes in ({"train.speed_mph": 30}, {"train.speed_kmh": 48.28032}):
        changed = base.with_overrides(changes)
        assert changed.model.train.speed_kmh == 48.28032
        assert changed.title == "test train (train.speed_kmh = 48.28032)"
    cars = [{"car": "box_car", "length_over_couplers_ft": 60}]
    changed = base.with_overrides({"train.consist": cars})
    assert changed.totals.length == pytest.approx(18.288)


MISTAKES = {
    "two units": ("speed_mph: 40", "speed_mph: 40\n  speed_kmh: 60", "speed_mph: gives the same"),
    "two units of a length": ("count: 2", "length_over_couplers_m: 17", "give one of the two"),
    "too fast": (
        "speed_mph: 40",
        "speed_mph: 400",
        "speed_mph: must be at most 500, got 643.7376",
    ),
    "text": ("speed_mph: 40", "speed_mph: fast", "speed_mph: must be a number, got 'fast'"),
    "no such unit": ("speed_mph", "speed_knots", "unknown key; did you mean 'speed_kmh'"),
    "another quantity": ("mass_lb: 2", "mass_ft: 2", "unknown key; did you mean 'mass_kg'"),
    "infinite": ("speed_mph: 40", "speed_mph: 1e308", "speed_mph: must be at most 500"),
    "no curve": ("degree_of_curve: 4", "degree_of_curve: 0", "must not be 0"),
    "sharp curve": ("degree_of_curve: 4", "degree_of_curve: 400", "must be at least 10"),
}


@pytest.mark.parametrize("old, new, reason", MISTAKES.values(), ids=MISTAKES.keys())
def test_mistakes(old, new, reason):
    text = TEXT.replace(old, new, 1)
    with pytest.raises(ScenarioError) as caught:
        loads_scenario(text, "x.yaml")
    assert reason in str(caught.value)
    assert "\n" not in str(caught.value) and caught.value.line is not None


def test_mistakes_of_overrides():
    base = loads_scenario(TEXT)
    with pytest.raises(
        ScenarioError, match=r"train\.speed_mph: must be at most 500, got 804\.672"
    ):
        base.with_overrides({"train.speed_mph": 500})
    with pytest.raises(ScenarioError, match="given twice, in two units"):
        base.with_overrides({"train.speed_mph": 50, "train.speed_kmh": 50})


def test_json_schema_knows_the_units():
    schema = json_schema()
    jsonschema.validate(parse(TEXT, "x").data, schema)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(parse(TEXT.replace("  speed_mph: 40\n", ""), "x").data, schema)
