"""Consist lists: what is read, what is assumed, and every mistake in one line."""

import json

import pytest

from derail_ros.cli import main
from derail_ros.scenario import ScenarioError, load_scenario, loads_scenario
from derail_ros.scenario.consist_list import find_type, read_consist_list
from derail_ros.scenario.rolling_stock import load_rolling_stock
from derail_ros.scenario.schema import CarType
from derail_ros.vocabulary.train import length_over_couplers, train_totals

LIST = """\
Pos,Car,AAR Code,Type,Length (ft),Tare (lb),Gross (short tons),L/E,Trucks,Commodity,Brakes
1,CN 5700,,SD70M-2,74.25,,197,,2,,
2,CN 1,C114,covered hopper,59' 0",62500,143,L,2,wheat,
3,TTGX 3,V,autorack,93.83,"114,000",,E,2,,cut out
4,GATX 4,T108,DOT-117J,59.7,94000,143,L,2,ethanol,
5,TTAX 5,Q,spine,270,141000,233,L,6,containers,
"""
TON = 907.18474
FT = 0.3048


def read(tmp_path, text, name="cars.csv"):
    (tmp_path / name).write_text(text)
    return read_consist_list(tmp_path / name)


def test_a_list_of_a_railway(tmp_path):
    found = read(tmp_path, LIST)
    scenario = found.to_scenario()
    cars = scenario.to_params().cars
    lengths = [length_over_couplers(car) / FT for car in cars]
    assert lengths[:4] == pytest.approx([74.25, 59, 93.83, 59.7])
    assert sum(lengths[4:]) == pytest.approx(270, rel=1e-4)
    masses = [car.mass / TON for car in cars]
    assert masses[:4] == pytest.approx([197, 143, 57, 143])
    # the spine car's own tare and its lading, 70.5 and 162.5 short tons
    assert sum(masses[4:]) == pytest.approx(233, rel=1e-3)
    assert [car.contents for car in cars[1:5]] == ["wheat", "", "ethanol", "containers"]
    assert cars[2].brakes[0].force == 0.0
    totals = scenario.totals
    assert (totals.cars, totals.locomotives, totals.loads, totals.empties) == (9, 1, 7, 1)
    assert totals.length == pytest.approx(sum(lengths) * FT)
    assert any("'DOT-117J' taken as tank_dot_117j" in text for text in found.assumed)
    # the broken rail is that under the first car behind the locomotives
    assert scenario.model.track.rail_breaks_under_cars == (2,)


def test_couplings_of_a_list_break(tmp_path):
    """A few derailed loads pull with more than a knuckle bears."""
    found = read(tmp_path, LIST)
    assert found.to_scenario().to_params().couplings.knuckle_strength == 2.89e6
    assert "knuckle_strength_N: 2.89e6  # assumed" in found.to_yaml()
    assert any(text.startswith("knuckles break at 2.89 MN") for text in found.assumed)


def test_units_of_other_railways(tmp_path):
    found = read(
        tmp_path, "type;longueur;length_m;gross_t;load;count\ntank car;;18,2;129,7;L;20\n"
    )
    (block,) = found.to_scenario()._resolved.blocks
    assert (block.count, block.mass) == (20, 129.7e3)
    assert found.to_scenario().totals.length == pytest.approx(20 * 18.2)
    assert "column 'longueur' is not used" in found.assumed


def test_positions_decide_the_order(tmp_path):
    head, *rows = LIST.splitlines()
    turned = read(tmp_path, "\n".join([head, *rows[::-1]]))
    assert turned.to_scenario().hash != ""
    assert turned.blocks == read(tmp_path, LIST, "other.csv").blocks


def test_the_list_travels_by_its_hash(tmp_path, capsys):
    (tmp_path / "cars.csv").write_text(LIST)
    made = tmp_path / "train.yaml"
    assert main(["consist", str(tmp_path / "cars.csv"), "-o", str(made), "--json"]) == 0
    told = capsys.readouterr()
    assert json.loads(told.out)["train"]["cars"] == 9
    assert "9 cars (1 locomotive, 7 loads, 1 empty)" in told.err
    scenario = load_scenario(made)
    assert scenario.files["cars.csv"] == LIST.encode()
    assert scenario.warnings == ()
    other = tmp_path / "elsewhere" / "fast.yaml"
    other.parent.mkdir()
    other.write_text("version: 1\ntitle: fast\nextends: train\ntrain: {speed_mph: 60}\n")
    fast = load_scenario(other, [tmp_path])
    assert (fast.files["cars.csv"], fast.warnings) == (LIST.encode(), ())
    (tmp_path / "cars.csv").write_text(LIST + "\n")
    assert "has changed since train was made from it" in load_scenario(made).warnings[0]
    assert load_scenario(made).hash == scenario.hash
    (tmp_path / "cars.csv").unlink()
    assert "not found" in load_scenario(made).warnings[0]
    assert main(["consist", str(tmp_path / "none.csv")]) == 2
    (tmp_path / "cars.csv").write_text(LIST)
    assert main(["consist", str(tmp_path / "cars.csv"), "-o", str(made)]) == 2
    assert "exists already" in capsys.readouterr().err


def test_a_list_in_place_of_a_scenario(tmp_path):
    (tmp_path / "cars.csv").write_text(LIST)
    with pytest.raises(ScenarioError, match="`derail consist .*cars.csv -o cars.yaml` makes one"):
        load_scenario(tmp_path / "cars.csv")
    (tmp_path / "cars.json").write_text("{}")
    with pytest.raises(ScenarioError, match=r"is no scenario: those are YAML files"):
        load_scenario(tmp_path / "cars.json")


# what of the list is replaced, by what, line, heading, part of the reason
MISTAKES = {
    "no unit": ("Length (ft)", "Length", 1, "Length", "names no unit"),
    "twice": ("Commodity", "Gross (kg)", 1, "Gross (kg)", "same as 'Gross (short tons)'"),
    "no number": ("59.7", "long", 5, "Length (ft)", "must be a number of ft, got 'long'"),
    "negative": ("59.7", "-4", 5, "Length (ft)", "must be a number of ft"),
    "unknown type": ("V,autorack,93.83", ",zeppelin,", 4, "Type", "unknown car type 'zeppelin'"),
    "unknown load": ("143,L,2,wheat", "143,X,2,wheat", 3, "L/E", "must be L or E"),
    "gross below tare": (
        "62500,143",
        "62500,14.3",
        3,
        "Gross (short tons)",
        "14.3 short tons is below the tare of 62500 lb",
    ),
    "a car missing": ("4,GATX", "5,GATX", 6, "Pos", "5 is on line 5 already"),
    "a gap": ("5,TTAX", "7,TTAX", 6, "Pos", "7 follows 4: a car is missing"),
    "no position": ("4,GATX", "x,GATX", 5, "Pos", "must be a whole number, got 'x'"),
    "shared trucks": ("2,ethanol", "3,ethanol", 5, "Trucks", "tank_dot_117j has 2"),
    "brakes": ("cut out", "weak", 4, "Brakes", "must be one of composition"),
    "too long": ("59.7", "900", 5, "Length (ft)", "900 ft: no car is that long"),
    "metres": ("59.7", "17.98", 5, "Length (ft)", "17.98 ft: no car is that short; is it in m?"),
    "position 0": ("1,CN 5700", "0,CN 5700", 2, "Pos", "is 0; positions count from 1"),
    "no columns": (LIST, "a,b\n1,2\n", 1, "", "no column gives the type or the length"),
    "empty": (LIST, "\n", None, "", "is empty"),
    "headings only": (LIST, LIST.splitlines()[0], None, "", "has headings and no cars"),
}


@pytest.mark.parametrize("old, new, line, heading, reason", MISTAKES.values(), ids=MISTAKES.keys())
def test_mistakes(tmp_path, old, new, line, heading, reason):
    with pytest.raises(ScenarioError) as caught:
        read(tmp_path, LIST.replace(old, new, 1)).to_scenario()
    error = caught.value
    assert (error.file, error.line, error.field) == ("cars.csv", line, heading)
    assert reason in error.reason and "\n" not in str(error)


HEADS = "Pos,Type,L/E,Gross (tons)\n"
WEIGHTS = {
    "pounds": ("Pos,Type,L/E,Gross (kg)\n1,DOT-117J,L,286000\n",
               "286000 kg: no car is that heavy; is it in lb?"),
    "below empty": (f"{HEADS}1,boxcar,L,12\n",
                    "12 tons loaded is not above the empty mass of boxcar_50ft_286k"),
    "negative": (f"{HEADS}1,boxcar,L,-20\n", "must be a number of tons, got '-20'"),
}  # fmt: skip


@pytest.mark.parametrize("text, reason", WEIGHTS.values(), ids=WEIGHTS.keys())
def test_weights_are_told_in_the_units_of_the_list(tmp_path, text, reason):
    with pytest.raises(ScenarioError) as caught:
        read(tmp_path, text)
    assert caught.value.field.startswith("Gross (") and caught.value.line == 2
    assert reason in caught.value.reason and "_tons" not in caught.value.reason


def test_the_more_specific_of_code_and_type_decides(tmp_path):
    text = (
        "AAR,Type,Length (ft)\nC112,covered hopper,42\nT104,DOT-111,60\nH350,hopper,53\n"
        "V942,covered hopper,59\n"
    )
    found = read(tmp_path, text)
    assert [block["car"] for block in found.blocks] == [
        "covered_hopper_small_286k", "tank_dot_111_30000_gal", "hopper_263k",
        "covered_hopper_286k",
    ]  # fmt: skip
    assert "column 'Length (ft)' taken as over couplers" in found.assumed


def test_types_by_code_and_name():
    stock = load_rolling_stock()

    def known(text):
        return (find_type(text, stock) or ("", 0))[0]

    assert known("H350") == "hopper_263k"
    assert known("C112") == "covered_hopper_small_286k"
    assert known("C114") == "covered_hopper_286k"
    assert known("T389") == "tank_dot_112j_33600_gal"
    assert known("117R") == "tank_dot_117r" and known("DOT117R100W") == "tank_dot_117r"
    assert known("box_car") == "box_car" and known("Box Car") == "boxcar_50ft_286k"
    assert known("X999") == known("zeppelin") == ""


CARS = """\
version: 1
title: cars
train:
  speed_kmh: 40
  consist:
    - {car: well_car_53ft_3_unit, count: 2, load: 0.5}
    - {car: box_car, count: 3, load: empty}
    - {car: box_car, mass_kg: 27e3}
    - {car: source_base_car}
track: {rail_breaks: [900]}
"""


def test_articulated_car():
    scenario = loads_scenario(CARS)
    cars = scenario.to_params().cars
    assert scenario.n_cars == len(cars) == 11
    assert scenario.car_types[:7] == ("well_car_53ft_3_unit",) * 6 + ("box_car",)
    assert sum(length_over_couplers(car) for car in cars[:3]) == pytest.approx(203 * FT, rel=1e-4)
    assert [car.front.name for car in cars[:4]] == ["E60", "ARTICULATED", "ARTICULATED", "E60"]
    assert [car.rear.name for car in cars[:3]] == ["ARTICULATED", "ARTICULATED", "E60"]
    # the two halves of a shared truck stand a wheelbase, 1.8 m, apart
    a, b = cars[0], cars[1]
    pitch = a.pivot_distance + a.rear.length + b.front.length + b.pivot_distance
    assert pitch - a.truck_distance - b.truck_distance == pytest.approx(1.8)
    again = loads_scenario(scenario.to_yaml())
    assert (again.hash, again.totals) == (scenario.hash, scenario.totals)
    with pytest.raises(ScenarioError, match="has platforms: give it by their types"):
        scenario.with_overrides({"train.consist.0.mass_kg": 1e5})


def test_totals_of_loads():
    scenario = loads_scenario(CARS)
    totals = scenario.totals
    assert (totals.cars, totals.loads, totals.empties) == (11, 6, 4)  # of one it is not known
    assert "1 with load not given" in totals.text
    virtual = scenario.with_overrides({"train.virtual_from": 5}).totals
    assert (virtual.cars, virtual.loads, virtual.empties) == (11, 6, 4)
    assert (virtual.length, virtual.mass) == pytest.approx((totals.length, totals.mass))
    assert totals == train_totals(scenario.to_params().cars)


def test_values_that_no_car_has():
    odd = {"train.consist.1.mass_kg": 120, "train.consist.2.length_over_couplers_m": 60}
    odd |= {"track.rail_breaks": [99999, -500]}
    told = " | ".join(loads_scenario(CARS).with_overrides(odd).warnings)
    assert "cars 7 to 9 (box car): 120 kg: no car is as light as that" in told
    assert "car 10 (box car): 60 m over couplers: no car is as long as that" in told
    assert "rail break at 99999 m: the train does not reach it" in told
    assert "rail break at -500 m: it lies behind the train" in told
    assert loads_scenario(CARS).warnings == ()


def test_the_library_is_plausible():
    """Each type alone makes a train without a warning; its curves fall with speed."""
    stock = load_rolling_stock()
    for name, kind in stock.cars.items():
        text = CARS.replace("well_car_53ft_3_unit, count: 2, load: 0.5", name)
        assert loads_scenario(text).warnings == (), name
        assert isinstance(kind, CarType)
        for curve in (kind.tractive_effort_kmh_kN, kind.dynamic_brake_kmh_kN):
            speeds, forces = [p[0] for p in curve], [p[1] for p in curve]
            assert speeds == sorted(set(speeds)), name
            top = forces.index(max(forces)) if forces else 0
            assert forces[top:] == sorted(forces[top:], reverse=True), name
