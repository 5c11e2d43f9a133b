"""Brakes in scenarios: what may be said, and what is refused."""

import pytest

from derail_ros.cli import main
from derail_ros.scenario import ScenarioError, load_scenario, loads_scenario

TEXT = """\
version: 1
title: brakes
train:
  speed_kmh: 60
  consist:
    - {car: locomotive_sd70ace, count: 2}
    - {car: hopper_286k, count: 10}
    - {car: locomotive_es44ac}
    - {car: hopper_286k, count: 10, load: empty}
initiation: {await_command: true}
brakes:
  law: braking_ratio
  system: distributed_power
"""
G = 9.81
FRICTION = 0.21 * 19.223 / 9.388


def test_the_places_of_distributed_power():
    params = loads_scenario(TEXT).to_params()
    assert params.brakes.remote == (params.cars[12].brakes[0].distance,)
    given = loads_scenario(TEXT + "  remote_locomotives: [20, 13]\n").to_params()
    assert given.brakes.remote == tuple(params.cars[i].brakes[0].distance for i in (12, 19))
    eot = loads_scenario(TEXT.replace("distributed_power", "two_way_eot")).to_params()
    assert eot.brakes.remote == (params.cars[-1].brakes[0].distance,)


def test_forces_of_the_facts():
    """A loaded car of 130 t: about 50 kN in emergency at a friction of 0.3; empty 25 kN."""
    cars = "[{mass_kg: 130e3, length_m: 15, truck_centres_m: 11, coupler: F79}, "
    cars += "{empty_mass_kg: 28.5e3, loaded_mass_kg: 130e3, load: 0, length_m: 15, "
    cars += "truck_centres_m: 11, coupler: F79}]"
    scenario = loads_scenario(TEXT.replace("distributed_power", "ecp"))
    conventional = loads_scenario(TEXT.replace("distributed_power", "conventional"))
    loaded, empty = (
        car.brakes[0].force * 0.3 / FRICTION
        for car in conventional.with_overrides({"train.consist": _parse(cars)}).to_params().cars
    )
    assert (loaded, empty) == pytest.approx((50e3, 25e3), rel=0.02)
    ahead = scenario.to_params().cars[2].brakes[0].force
    assert ahead == pytest.approx(1.22 * conventional.to_params().cars[2].brakes[0].force)
    assert scenario.to_params().brakes.rise_time == 12.0


def _parse(text):
    from derail_ros.scenario import parse_set

    return parse_set(f"x={text}")[1]


def test_round_trip():
    text = TEXT.replace("load: empty", "load: empty, brake: {cut_out: true, hand_brake: true}")
    scenario = loads_scenario(text)
    again = loads_scenario(scenario.to_yaml())
    assert (again.hash, again.to_params()) == (scenario.hash, scenario.to_params())


@pytest.mark.parametrize("name", ["base_train", "mississauga_published"])
def test_published_scenarios_say_nothing_new(name):
    """What came later is left out, so that hash and parameters stay what they were."""
    scenario = load_scenario(name)
    assert {"law", "system", "ecp_rise_time_s"}.isdisjoint(scenario.resolved()["brakes"])
    units = [unit for car in scenario.to_params().cars for unit in car.brakes]
    assert {(unit.force, unit.hand) for unit in units} == {(None, 0.0)}


MISTAKES = {
    "no locomotive": (
        "- {car: locomotive_es44ac}",
        "- {car: hopper_286k}",
        "brakes.remote_locomotives: is required: no locomotive stands behind the head",
    ),
    "places of another system": (
        "system: distributed_power",
        "system: ecp\n  remote_locomotives: [13]",
        "brakes.remote_locomotives: only goes with system distributed_power, got ecp",
    ),
    "no such car": (
        "distributed_power",
        "distributed_power\n  remote_locomotives: [40]",
        "brakes.remote_locomotives.0: there is no car 40, the last one is 23",
    ),
    "no such system": ("distributed_power", "dp", "brakes.system: must be 'conventional'"),
    "no such law": (
        "braking_ratio",
        "ratio",
        "brakes.law: must be 'published' or",
    ),
    "ratio in percent": (
        "distributed_power",
        "distributed_power\n  net_braking_ratio_loaded: 11",
        "brakes.net_braking_ratio_loaded: must be at most 1, got 11",
    ),
    "negative delay": (
        "distributed_power",
        "distributed_power\n  radio_delay_s: -1",
        "brakes.radio_delay_s: must be at least 0, got -1",
    ),
    "a word for a switch": (
        "load: empty",
        "brake: {cut_out: 1}",
        "train.consist.3.brake.cut_out: must be true or false, got 1",
    ),
    "empty above loaded": (
        "load: empty",
        "empty_mass_lb: 300000",
        "train.consist.3.empty_mass_lb: must not be above loaded_mass_kg",
    ),
}


@pytest.mark.parametrize("old, new, reason", MISTAKES.values(), ids=MISTAKES.keys())
def test_mistakes(old, new, reason):
    with pytest.raises(ScenarioError) as caught:
        loads_scenario(TEXT.replace(old, new, 1), "x.yaml")
    assert reason in str(caught.value)
    assert "\n" not in str(caught.value) and caught.value.line is not None


ROLLING = """\
version: 1
title: rolls
train: {speed_kmh: 30, consist: [{car: box_car, count: 4}]}
track: {rail_breaks: [12]}
brakes: {signal_source: none}
integration: {time_limit_s: 8}
"""


def test_a_train_that_nothing_braked_is_told(tmp_path, capsys):
    path = tmp_path / "rolls.yaml"
    path.write_text(ROLLING)
    assert main(["simulate", str(path)]) == 0
    told = capsys.readouterr()
    assert "never applied" in told.out
    assert "the train was never braked: no emergency was made" in told.err
    assert "4 cars (4 loads), 67.3 m over couplers, 384 t" in told.out
    path.write_text(ROLLING.replace("signal_source: none", "delay_s: 0"))
    assert main(["simulate", str(path)]) == 0
    told = capsys.readouterr()
    assert "never" not in told.out + told.err
