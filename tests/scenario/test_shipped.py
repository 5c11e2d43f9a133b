"""The shipped scenarios and rolling stock against the source's numbers."""

import csv
import dataclasses
from pathlib import Path

import pytest

from derail_ros.engine import build
from derail_ros.scenario import (
    list_scenarios,
    load_rolling_stock,
    load_scenario,
    load_scenario_by_name,
    loads_scenario,
)
from derail_ros.vocabulary.params import TrainParams
from derail_ros.vocabulary.train import length_over_couplers, train_totals

DATA = Path(__file__).parent / "data"
REPORTED = [
    "avondale_2010",
    "brighton_2009",
    "dublin_2015",
    "dugald_2009",
    "macmillan_yard_2019",
    "minot_2002",
    "nickel_lake_2013",
    "waterfall_2011",
]
NAMES = [
    *REPORTED,
    "base_train",
    "cars_on_a_siding",
    "curve_derailment",
    "mid_train_break",
    "mississauga",
    "mississauga_brake_instant",
    "mississauga_brake_instant_traction",
    "mississauga_brake_traction",
    "mississauga_published",
    "mississauga_published_brake_instant",
    "mississauga_published_brake_instant_traction",
    "mississauga_published_brake_traction",
    "mississauga_soft_ground",
    "mississauga_wall",
    "place_from_a_map",
    "yang_manos_base",
]


def table(name):
    with (DATA / name).open() as stream:
        return list(csv.DictReader(line for line in stream if not line.startswith("#")))


def test_list():
    listed = list_scenarios()
    assert [name for name, _ in listed] == sorted(NAMES)
    assert dict(listed)["base_train"] == "Base train, 60 identical cars at 60 km/h"


@pytest.mark.parametrize("name", NAMES)
def test_loads_converts_and_is_described(name):
    scenario = load_scenario_by_name(name)
    params = scenario.to_params()
    assert isinstance(params, TrainParams)
    assert scenario.name == name
    assert scenario.title and scenario.description and scenario.source
    assert scenario.n_cars == sum(car.represents for car in params.cars[: params.n_train])
    assert params.brakes.vent_on_parting == (
        not name.startswith(("mississauga", "base_train", "yang_manos"))
    )


@pytest.mark.parametrize("name", NAMES)
def test_engine_accepts(name):
    build.validate(load_scenario(name).to_params())


@pytest.mark.parametrize("name", NAMES)
def test_loading_reads_each_file_of_the_rolling_stock_once(name, monkeypatch):
    """Parsing these files takes most of the time of loading a scenario."""
    read = []
    cached = load_rolling_stock.__globals__
    known = cached["read_text"]
    monkeypatch.setitem(cached, "read_text", lambda path: read.append(path) or known(path))
    cached["_load"].cache_clear()
    for _ in range(2):
        load_scenario(name).to_params()
    assert read and len(read) == len(set(read))


@pytest.mark.parametrize("name", NAMES)
def test_yaml_round_trip(name):
    scenario = load_scenario(name)
    again = loads_scenario(scenario.to_yaml(), name)
    assert again.resolved() == scenario.resolved()
    assert again == scenario
    assert again.to_params() == scenario.to_params()
    assert again.to_yaml() == scenario.to_yaml()


def test_no_two_scenarios_are_the_same():
    assert len({load_scenario(name).hash for name in NAMES}) == len(NAMES)


# --- Mississauga ------------------------------------------------------------------------------


def test_mississauga_cars_are_those_of_the_source():
    rows = table("mississauga_consist.csv")
    cars = load_scenario("mississauga").to_params().cars
    assert len(cars) == 74
    for row, car in zip(rows[:24], cars):
        # the surviving copy's misprint for car 4 is corrected in the data
        assert (car.mass, car.inertia) == (float(row["mass_kg"]), float(row["inertia_kg_m2"]))
        assert car.length == float(row["length_m"])
        assert 2 * car.pivot_distance == float(row["coupler_pivots_m"])
        assert 2 * car.truck_distance == float(row["truck_centres_m"])
        assert (car.front.name, car.rear.name) == (row["coupler"], row["coupler"])
        if row["contents"] and "box car" not in row["contents"]:
            assert car.contents.split()[0] == row["contents"].split()[0]
    for car in cars[24:]:
        shape = dataclasses.replace(
            cars[23],
            mass=61_400.0,
            inertia=car.inertia,
            brakes=car.brakes,
            name=car.name,
            contents="",
        )
        assert car == shape
    # the solid cylinder reproduces the inertia of the 18.04 m cars
    assert cars[24].inertia == pytest.approx(cars[23].inertia * 61.4 / 120, rel=2e-3)


def test_mississauga_mass_and_length():
    rows = table("mississauga_consist.csv")
    cars = load_scenario("mississauga").to_params().cars
    assert sum(car.mass for car in cars) == pytest.approx(
        sum(float(row["mass_kg"]) for row in rows), rel=1e-12
    )
    assert sum(car.mass for car in cars[24:]) == pytest.approx(3_070_000, rel=1e-12)
    # the whole train: 106 cars and 3 locomotives, 2020 m
    length = cars[-1].brakes[0].distance - cars[0].brakes[0].distance
    assert 0.9 * 2020 / 109 < length / 73 < 1.1 * 2020 / 109


def test_mississauga_start():
    params = load_scenario("mississauga").to_params()
    start = params.initiation
    assert start.speed == pytest.approx(25.0)
    assert start.position == 0.0
    assert start.derailed_trucks == ((1, "front"), (1, "rear"))
    assert start.parted_couplings == ()
    (push,) = start.lateral_forces
    assert (push.force, push.car, push.place) == (50e3, 1, "front")
    assert (push.start, push.duration) == (0, 1)
    assert params.track.segments == ()
    assert params.track.rail_breaks == (0.0,)
    (trigger,) = params.brakes.triggers
    assert (trigger.time, trigger.source, trigger.mode, trigger.delay) == (
        0,
        "front",
        "conventional",
        0,
    )
    assert {car.width for car in params.cars} == {2.6}
    assert {car.coupler_inertia for car in params.cars} == {20e3}


def test_published_mississauga_has_a_virtual_body():
    cars = load_scenario("mississauga").to_params().cars
    published = load_scenario("mississauga_published").to_params().cars
    assert published[:24] == cars[:24]
    (body,) = published[24:]
    assert body.represents == 50
    assert body.mass == pytest.approx(3_070_000, rel=1e-12)
    assert body.front == cars[24].front
    assert body.brakes == tuple(car.brakes[0] for car in cars[24:])
    assert {unit.weight for unit in body.brakes} == {61_400.0}


@pytest.mark.parametrize("train", ["mississauga", "mississauga_published"])
@pytest.mark.parametrize("test", ["instant", "traction", "instant_traction"])
def test_brake_tests(train, test):
    base = load_scenario(train).to_params()
    params = load_scenario(f"{train}_brake_{test}").to_params()
    mode = {"traction": "traction_limited", "instant_traction": "instant_traction_limited"}
    (trigger,) = params.brakes.triggers
    assert trigger.mode == mode.get(test, test)
    assert params.brakes.traction_coefficient == 0.3
    late = "published" in train and test != "instant"
    assert trigger.delay == (3.5 if late else 0.0)
    assert dataclasses.replace(params, brakes=base.brakes) == base


def test_brake_distances_are_arc_lengths_between_centres():
    cars = load_scenario("mississauga").to_params().cars
    # car 1 to 2: half the pivot distance of each and two F79 couplers
    assert cars[1].brakes[0].distance == pytest.approx(13.26 / 2 + 2 * 1.092 + 13.3 / 2)
    # car 7 to 8: F79 against F73
    step = cars[7].brakes[0].distance - cars[6].brakes[0].distance
    assert step == pytest.approx(12.1 / 2 + 1.092 + 1.524 + 16.88 / 2)


# --- the others -------------------------------------------------------------------------------


def test_base_train():
    scenario = load_scenario("base_train")
    assert len(scenario.model.train.consist) == 1
    params = scenario.to_params()
    assert len(params.cars) == 60
    car = params.cars[0]
    assert (car.mass, car.length, car.front.name) == (68_000, 14.1, "F73")
    assert (2 * car.pivot_distance, 2 * car.truck_distance) == (13.3, 11.5)
    assert car.inertia == pytest.approx(1.165e6, rel=1e-3)
    other = load_scenario("mississauga").to_params()
    assert params.initiation == dataclasses.replace(
        other.initiation, speed=params.initiation.speed
    )
    assert params.initiation.speed == pytest.approx(60 / 3.6)
    assert dataclasses.replace(params, cars=other.cars, initiation=other.initiation) == other


def test_mid_train_break_lies_ahead_of_the_middle_car():
    params = load_scenario("mid_train_break").to_params()
    car = params.cars[23]
    truck = -car.brakes[0].distance + car.truck_distance
    assert params.track.rail_breaks == (pytest.approx(truck + 0.5),)
    assert params.initiation.derailed_trucks == ()
    assert params.brakes.triggers == ()


def test_curve_is_entered_through_a_spiral_of_400_m_radius():
    params = load_scenario("curve_derailment").to_params()
    kinds = [(s.curvature_start, s.curvature_end) for s in params.track.segments]
    assert kinds == [(0, 0), (0, 1 / 400), (1 / 400, 1 / 400), (1 / 400, 0), (0, 0)]


def test_coupler_types():
    stock = load_rolling_stock()
    rows = table("coupler_types.csv")
    assert sorted(stock.couplers) == sorted([row["type"] for row in rows] + ["ARTICULATED"])
    for row in rows:
        spec = stock.couplers[row["type"]]
        assert spec.head == row["type"][0]
        for key in (
            "pivot_to_face_m",
            "pivot_to_striker_m",
            "striker_opening_m",
            "k1_N_per_m",
            "k2_N_per_m",
        ):
            assert getattr(spec, key) == float(row[key])


def test_car_types():
    stock = load_rolling_stock()
    by_title = {car.title: car for car in stock.cars.values()}
    for row in table("car_types.csv"):
        car = by_title[row["type"]]
        assert car.empty_mass_kg == pytest.approx(
            1000 * float(row["light_weight_kN"]) / 9.81, abs=1
        )
        assert car.loaded_mass_kg == pytest.approx(
            1000 * float(row["gross_weight_kN"]) / 9.81, abs=1
        )
        assert car.length_m == float(row["length_m"])
        assert car.overall_width_m == float(row["width_m"])
        assert car.truck_centres_m == float(row["truck_centres_m"])
        assert car.width_m == 2.6
    for row in table("locomotives.csv"):
        car = by_title[f"{row['manufacturer']} {row['model']}"]
        assert (car.axles, car.power_kW) == (int(row["axles"]), float(row["power_kW"]))
        assert car.empty_mass_kg == float(row["min_mass_kg"])
        assert car.loaded_mass_kg == float(row["max_mass_kg"])


@pytest.mark.parametrize("kind", sorted(load_rolling_stock().cars))
def test_every_car_type_makes_a_train(kind):
    text = (
        "version: 1\ntitle: x\ntrain:\n  speed_kmh: 60\n"
        f"  consist: [{{car: {kind}, count: 3}}]\ntrack: {{rail_breaks: [30]}}\n"
    )
    cars = loads_scenario(text).to_params().cars
    stock = load_rolling_stock().cars[kind]
    assert len(cars) == 3 * max(1, len(stock.platforms))
    if stock.length_over_couplers_m is not None:
        assert length_over_couplers(cars[0]) == pytest.approx(stock.length_over_couplers_m)
    if stock.coupler_pivots_m is None and not kind.startswith("source_") and not stock.platforms:
        inset = 1.16 if stock.coupler in ("F73", "E69") else 0.34
        if stock.length_m is not None and stock.length_over_couplers_m is not None:
            inset = stock.length_m - 2 * cars[0].pivot_distance  # both are given
        assert 2 * cars[0].pivot_distance == pytest.approx(cars[0].length - inset)
    # far enough apart that the couplings carry the train and not the buffers
    places = [car.brakes[0].distance for car in cars]
    for ahead, car, a, b in zip(cars, cars[1:], places, places[1:]):
        assert b - a - 0.5 * (ahead.length + car.length) > 0.8


# cars, locomotives, loads, empties, feet and what they are of, tonnes: as the summaries have them
TRAINS = {
    "macmillan_yard_2019": (82, 34, 48, None, None),
    "nickel_lake_2013": (184, 184, 0, ("train", 11058), 24432),
    "brighton_2009": (137, 75, 62, ("cars", 8850), None),
    "dublin_2015": (76, 76, 0, None, None),
    "avondale_2010": (72, 62, 10, ("cars", 4300), 7760 * 0.90718474),
    "minot_2002": (112, 86, 26, None, 12015 * 0.90718474),
    "waterfall_2011": (150, 150, 0, ("cars", 10201), 9537),
}


@pytest.mark.parametrize("name", TRAINS)
def test_reported_trains_are_those_of_the_summaries(name):
    cars, loads, empties, length, mass = TRAINS[name]
    scenario = load_scenario(name)
    bodies = scenario.to_params().cars
    totals = scenario.totals
    without = train_totals(car for car in bodies if not car.locomotives)
    assert (without.cars, totals.loads, totals.empties) == (cars, loads, empties)
    if length is not None:
        found = totals.length if length[0] == "train" else without.length
        assert found / 0.3048 == pytest.approx(length[1], rel=0.006)
    if mass is not None:
        assert without.mass == pytest.approx(mass * 1e3, rel=0.005)
    assert scenario.warnings == ()
    assert "Assumed:" in scenario.source


def test_macmillan_yard_groups():
    bodies = load_scenario("macmillan_yard_2019").to_params().cars
    racks = train_totals(bodies[27:51])
    assert (racks.mass / 1e3, racks.length / 0.3048) == pytest.approx((1245, 2252), rel=1e-3)
    loaded = train_totals(car for car in bodies if car.loads)
    assert (loaded.mass / 1e3, loaded.length / 0.3048) == pytest.approx((3391, 2074), rel=1e-3)


def test_a_low_limit_in_three_dimensions_is_told():
    def told(**changed):
        scenario = load_scenario_by_name("minot_2002").with_overrides(changed)
        return [w for w in scenario.warnings if "derailment.lv_limit" in w]

    (warning,) = told(model="spatial")
    assert "compared at" in warning
    assert not told()
    assert not told(model="spatial", **{"derailment.lv_limit": 2.0})
