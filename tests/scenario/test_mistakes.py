"""Every mistake is refused with its file, line, field and reason."""

import pytest

from derail_ros.scenario import (
    Scenario,
    ScenarioError,
    load_scenario,
    load_scenario_by_name,
    loads_scenario,
)

# line numbers in the cases count from here
TEXT = """\
version: 1
title: test train
train:
  speed_kmh: 60
  consist:
    - {car: tank_dot_111, count: 2}
    - mass_kg: 90e3
      length_m: 16.0
      coupler_pivots_m: 15.6
      truck_centres_m: 12.5
      coupler: F79
track:
  rail_breaks: [30]
"""
END = TEXT.count("\n") + 1

# (replaced text, its replacement or what is appended, line, field, part of the reason)
CASES = {
    "unknown key": ("speed_kmh", "speed_kph", 4, "train.speed_kph", "did you mean 'speed_kmh'"),
    "unit left out": ("speed_kmh", "speed", 4, "train.speed", "did you mean 'speed_kmh'"),
    "unknown section": ("track:", "tracks:", 12, "tracks", "did you mean 'track'"),
    "unknown key in a list": ("count: 2", "counts: 2", 6, "train.consist.0.counts", "'count'"),
    "unknown key, nothing near": ("count: 2", "xyz: 2", 6, "train.consist.0.xyz", "unknown key"),
    "key missing": ("  speed_kmh: 60\n", "", 3, "train.speed_kmh", "is required"),
    "section missing": (TEXT[TEXT.index("train:") :], "", 1, "train", "is required"),
    "text for a number": ("60", "fast", 4, "train.speed_kmh", "must be a number, got 'fast'"),
    "quoted number": ("60", "'60'", 4, "train.speed_kmh", "must be a number, got '60'"),
    "bool for a number": ("60", "true", 4, "train.speed_kmh", "must be a number, got true"),
    "null for a number": ("60", "", 4, "train.speed_kmh", "must be a number, got null"),
    "list for a number": ("60", "[60]", 4, "train.speed_kmh", "must be a number, got a list"),
    "mapping for a number": ("60", "{a: 1}", 4, "train.speed_kmh", "got a mapping"),
    "yes for a switch": ("", "brakes: {instant: yes}", END, "brakes.instant", "true or false"),
    "number for a switch": ("", "brakes: {instant: 1}", END, "brakes.instant", "true or false"),
    "fraction for a count": ("count: 2", "count: 2.5", 6, "train.consist.0.count", "whole number"),
    "number for text": ("test train", "12", 2, "title", "must be text, got 12"),
    "empty title": ("test train", "''", 2, "title", "must not be empty"),
    "long title": ("test train", "x" * 200, 2, "title", "longer than 120 characters"),
    "number for a list": ("[30]", "30", 13, "track.rail_breaks", "must be a list, got 30"),
    "number for a section": ("", "ground: 3", END, "ground", "mapping of keys to values, got 3"),
    "number for a mapping": ("", "couplers: {types: 3}", END, "couplers.types", "mapping"),
    "infinite": ("60", ".inf", 4, "train.speed_kmh", "must be a finite number, got inf"),
    "infinite by size": ("60", "1e999", 4, "train.speed_kmh", "finite"),
    "infinite by length": ("60", "9" * 5000, 4, "train.speed_kmh", "finite"),
    "not a number": ("60", ".nan", 4, "train.speed_kmh", "must be a finite number, got nan"),
    "too small": ("60", "0", 4, "train.speed_kmh", "must be above 0, got 0"),
    "too large": ("60", "501", 4, "train.speed_kmh", "must be at most 500, got 501"),
    "negative": ("", "ground: {c_s: -1}", END, "ground.c_s", "must be at least 0, got -1"),
    "bad word": (
        "",
        "brakes: {signal_source: fron}",
        END,
        "brakes.signal_source",
        "did you mean 'front'",
    ),
    "bad load": ("count: 2", "load: full", 6, "train.consist.0.load", "must be a number"),
    "bad load fraction": ("count: 2", "load: 1.5", 6, "train.consist.0.load", "at most 1"),
    "load of a car without": (
        "car: tank_dot_111",
        "car: source_base_car, load: empty",
        6,
        "train.consist.0.load",
        "no empty and loaded mass",
    ),
    "load and mass": (
        "count: 2",
        "load: empty, mass_kg: 3e4",
        6,
        "train.consist.0.load",
        "mass_kg is given too",
    ),
    "no consist": (TEXT[TEXT.index("    - {car") : TEXT.index("track:")], "    []\n", 5,
                   "train.consist", "at least one entry"),
    "unknown car type": (
        "tank_dot_111",
        "tank_dott_111",
        6,
        "train.consist.0.car",
        "unknown car type 'tank_dott_111'; did you mean 'tank_dot_111'",
    ),
    "odd car type": ("tank_dot_111", "../x", 6, "train.consist.0.car", "must be a name"),
    "unknown coupler type": (
        "coupler: F79",
        "coupler: F78",
        11,
        "train.consist.1.coupler",
        "unknown coupler type 'F78'; did you mean 'F7",
    ),
    "unknown front coupler": (
        "coupler: F79",
        "coupler: F79\n      front_coupler: X1",
        12,
        "train.consist.1.front_coupler",
        "unknown coupler type 'X1'",
    ),
    "no mass": ("mass_kg: 90e3", "count: 1", 7, "train.consist.1.mass_kg", "is required"),
    "no length": ("      length_m: 16.0\n", "", 7, "train.consist.1.length_m", "is required"),
    "no coupler": ("      coupler: F79\n", "", 7, "train.consist.1.coupler", "is required"),
    "trucks beyond the body": (
        "truck_centres_m: 12.5",
        "truck_centres_m: 16.5",
        10,
        "train.consist.1.truck_centres_m",
        "trucks beyond the body: 16.5 m on a length of 16 m",
    ),
    "pivots beyond the body": (
        "coupler_pivots_m: 15.6",
        "coupler_pivots_m: 17",
        9,
        "train.consist.1.coupler_pivots_m",
        "beyond the body",
    ),
    "coupler shorter than the overhang": (
        "coupler_pivots_m: 15.6",
        "coupler_pivots_m: 13",
        7,
        "train.consist.1.front_coupler",
        "coupler 'F79' of 1.092 m is shorter than the overhang of 1.5 m",
    ),
    "body too short": (
        "length_m: 16.0\n      coupler_pivots_m: 15.6",
        "length_m: 0.3",
        8,
        "train.consist.1.length_m",
        "too short",
    ),
    "impossible inertia": (
        "mass_kg: 90e3",
        "mass_kg: 90e3\n      inertia_kg_m2: 1e8",
        8,
        "train.consist.1.inertia_kg_m2",
        "is more than 90000 kg within 16 m can have",
    ),
    "too many cars": (
        "count: 2}",
        "count: 1000}",
        7,
        "train.consist.1.count",
        "the train has 1001 cars, the limit is 1000",
    ),
    "too many cars in a block": ("count: 2", "count: 1001", 6, "train.consist.0.count", "1000"),
    "nothing to derail": ("[30]", "[]", 1, "initiation", "nothing to derail"),
    "no locomotive": ("", "traction: {notch: 3}", END, "traction.notch", "no car of the train"),
    "notch": ("", "traction: {notch: 9}", END, "traction.notch", "must be at most 8, got 9"),
    "a car that does not pull": (
        "", "traction:\n  schedule: [{time_s: 1, notch: 0, cars: [2]}]", END + 1,
        "traction.schedule.0.cars.0", "car 2 is no locomotive of the train"),
    "later before earlier": (
        "", "traction:\n  schedule: [{time_s: 2, notch: 0}, {time_s: 1, notch: 0}]", END + 1,
        "traction.schedule.1.time_s", "must not be before the last, 2 s"),
    "second grade without a place": (
        "[30]", "[30]\n  grades: [{grade_percent: 1}, {grade_percent: 2}]", 14,
        "track.grades.1.from_m", "is required for all but the first"),
    "vertical curves on each other": (
        "[30]", "[30]\n  grades: [{from_m: 0, grade_percent: 1}, {from_m: 10, grade_percent: 2}]",
        14, "track.grades.1.from_m", "must be 30 m or more"),
    "steep": ("[30]", "[30]\n  grades: [{grade_percent: 40}]", 14,
              "track.grades.0.grade_percent", "at most 15"),
    "law of resistance": (
        "", "resistance: {law: davis}", END, "resistance.law", "must be 'none' or 'fcalc'"),
    "weak coupling that is not there": (
        "", "couplers: {weak: [{coupling: 3, strength_N: 1e6}]}", END,
        "couplers.weak.0.coupling", "there is no coupling 3, the last one is 2"),
    "unloading above loading": (
        "", "couplers: {draft_gear: {unloading: 1.5}}", END, "couplers.draft_gear.unloading",
        "at most 1"),
    "break behind the train": ("[30]", "[-100]", 1, "initiation", "nothing to derail"),
    "virtual body from the first car": (
        "60",
        "60\n  virtual_from: 1",
        5,
        "train.virtual_from",
        "at least 2",
    ),
    "virtual body of one car": (
        "60",
        "60\n  virtual_from: 3",
        5,
        "train.virtual_from",
        "must be below the number of cars, 3",
    ),
    "derailed car that is not there": (
        "",
        "initiation:\n  derailed_trucks:\n  - {car: 1, truck: both}\n  - {car: 4, truck: rear}",
        END + 3,
        "initiation.derailed_trucks.1.car",
        "there is no car 4, the last one is 3",
    ),
    "parted coupling that is not there": (
        "",
        "initiation: {parted_couplings: [3]}",
        END,
        "initiation.parted_couplings.0",
        "there is no coupling 3",
    ),
    "push on a car that is not there": (
        "",
        "initiation: {lateral_force_car: 9}",
        END,
        "initiation.lateral_force_car",
        "there is no car 9",
    ),
    "break under a car that is not there": (
        "[30]",
        "[30]\n  rail_breaks_under_cars: [9]",
        14,
        "track.rail_breaks_under_cars.0",
        "there is no car 9",
    ),
    "signal from a car that is not there": (
        "",
        "brakes: {signal_source: car, signal_car: 9}",
        END,
        "brakes.signal_car",
        "there is no car 9",
    ),
    "signal from no car": (
        "",
        "brakes: {signal_source: car}",
        END,
        "brakes.signal_car",
        "is required with signal_source car",
    ),
    "signal car without use": (
        "",
        "brakes: {signal_car: 2}",
        END,
        "brakes.signal_car",
        "only goes with signal_source car",
    ),
    "trigger from no car": (
        "",
        "brakes: {triggers: [{source: car}]}",
        END,
        "brakes.triggers.0.car",
        "is required",
    ),
    "trigger car without use": (
        "",
        "brakes: {triggers: [{car: 2}]}",
        END,
        "brakes.triggers.0.car",
        "only goes with",
    ),
    "piece with two shapes": (
        "[30]",
        "[30]\n  alignment:\n    - {tangent: {length_m: 9}, "
        "curve: {length_m: 9, radius_m: 400, turn: left}}",
        15,
        "track.alignment.0",
        "exactly one of tangent, spiral and curve, has tangent and curve",
    ),
    "piece without shape": (
        "[30]",
        "[30]\n  alignment: [{}]",
        14,
        "track.alignment.0",
        "has none",
    ),
    "spiral without radius": (
        "[30]",
        "[30]\n  alignment: [{spiral: {length_m: 60, turn: left}}]",
        14,
        "track.alignment.0.spiral.radius_end_m",
        "is required",
    ),
    "curve too tight": (
        "[30]",
        "[30]\n  alignment: [{curve: {length_m: 60, radius_m: 5, turn: left}}]",
        14,
        "track.alignment.0.curve.radius_m",
        "at least 10",
    ),
    "train beyond the track": (
        "[30]",
        "[30]\n  alignment: [{tangent: {length_m: 600}}]",
        1,
        "initiation.position_m",
        "the rear truck of the train would stand at",
    ),
    "break beyond the track": (
        "[30]",
        "[30, 800]\n  start_coordinate_m: -100\n  alignment: [{tangent: {length_m: 600}}]",
        13,
        "track.rail_breaks.1",
        "lies outside the track, which runs from -100.0 to 500.0 m",
    ),
    "start of no alignment": (
        "[30]",
        "[30]\n  start_x_m: 5",
        14,
        "track.start_x_m",
        "has no effect without track.alignment",
    ),
    "unknown method": ("", "integration: {method: euler}", END, "integration.method", "rkf45"),
    "steps crossed": (
        "",
        "integration: {min_step_s: 0.01, max_step_s: 0.001}",
        END,
        "integration.min_step_s",
        "must be below max_step_s",
    ),
    "collision levels crossed": (
        "",
        "contact: {end_force_N: 20e3}",
        END,
        "contact.end_force_N",
        "must not be above begin_force_N",
    ),
    "gap law wider than its buffer": (
        "",
        "contact: {half_distance_m: 1}",
        END,
        "contact.half_distance_m",
        "must not be above buffer_m",
    ),
    "new coupler incomplete": (
        "",
        "couplers: {types: {F80: {head: F}}}",
        END,
        "couplers.types.F80.pivot_to_face_m",
        "is required for a new coupler type",
    ),
    "striker beyond the coupler": (
        "",
        "couplers:\n  types:\n    F79:\n      pivot_to_striker_m: 1.2",
        END + 3,
        "couplers.types.F79.pivot_to_striker_m",
        "must be below the coupler length, 1.092 m, got 1.2 m",
    ),
    "car type without mass": (
        "60\n",
        "60\n  car_types:\n    x: {length_m: 15, truck_centres_m: 12, coupler: F79}\n",
        6,
        "train.car_types.x.mass_kg",
        "is required, or both",
    ),
    "car type with too many masses": (
        "60\n",
        "60\n  car_types:\n    x: {mass_kg: 1, empty_mass_kg: 1, length_m: 15, "
        "truck_centres_m: 12, coupler: F79}\n",
        6,
        "train.car_types.x.mass_kg",
        "goes without",
    ),
    "car type emptied by loading": (
        "60\n",
        "60\n  car_types:\n    x: {empty_mass_kg: 2, loaded_mass_kg: 1, length_m: 15, "
        "truck_centres_m: 12, coupler: F79}\n",
        6,
        "train.car_types.x.empty_mass_kg",
        "must not be above",
    ),
    "no version": ("version: 1\n", "", 1, "version", "is required"),
    "next version": ("version: 1", "version: 2", 1, "version", "must be 1, "),
    "version as text": ("version: 1", "version: '1'", 1, "version", "got '1'"),
    "version as a float": ("version: 1", "version: 1.0", 1, "version", "got 1.0"),
    "version true": ("version: 1", "version: true", 1, "version", "got true"),
    "duplicate key": (
        "60",
        "60\n  speed_kmh: 70",
        5,
        "train.speed_kmh",
        "duplicate key, first given on line 4",
    ),
    "anchor": ("[30]", "&a [30]", 13, "track.rail_breaks", "anchors and aliases"),
    "anchor on a key": ("track:", "&a track:", 12, "", "anchors and aliases"),
    "alias": ("[30]", "*a", 13, "track.rail_breaks", "anchors and aliases"),
    "merge key": ("60", "60\n  <<: {virtual_from: 2}", 5, "train.'<<'", "unknown key"),
    "tag": ("60", "!!float 60", 4, "train.speed_kmh", "tags are not allowed"),
    "python tag": ("60", "!!python/name:os.system", 4, "train.speed_kmh", "tags"),
    "key that is a list": ("track:", "[a]: 1\ntrack:", 12, "", "keys must be plain text"),
    "two documents": ("track:", "---\ntrack:", 12, "", "more than one YAML document"),
    "open bracket": ("[30]", "[30", END, "", "not valid YAML"),
    "tab": ("  speed", "\tspeed", 4, "", "not valid YAML"),
    "control character": ("test train", "a\x07b", 2, "", "U+0007 is not allowed"),
    "deep nesting": ("[30]", "[" * 40 + "]" * 40, 13, "track.rail_breaks.0.0", "deeper than"),
    "overrides without extends": ("", "overrides: {}", END, "overrides", "only goes with extends"),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_mistake(case):
    old, new, line, field, reason = CASES[case]
    if old:
        assert old in TEXT
        text = TEXT.replace(old, new, 1)
    else:
        text = TEXT + new + "\n"
    with pytest.raises(ScenarioError) as caught:
        loads_scenario(text, "train.yaml")
    error = caught.value
    assert (error.file, error.line, error.field) == ("train.yaml", line, field), str(error)
    assert reason in error.reason
    assert "\n" not in str(error)
    assert str(error).startswith(f"train.yaml:{line}: {field}")


def test_text_is_valid_without_mistake():
    assert isinstance(loads_scenario(TEXT), Scenario)


@pytest.mark.parametrize("text", ["", "# nothing\n", "- 1\n", "just text", "null"])
def test_top_level_must_be_a_mapping(text):
    with pytest.raises(ScenarioError) as caught:
        loads_scenario(text)
    assert caught.value.file == "<inline>"


def test_too_long_a_text():
    with pytest.raises(ScenarioError, match="limit is 512 KB"):
        loads_scenario(TEXT + "# " + "x" * 512 * 1024)


def test_only_the_first_mistake_is_told_and_a_misspelt_key_before_a_missing_one():
    with pytest.raises(ScenarioError) as caught:
        loads_scenario("version: 1\ntitle: x\ntrain:\n  speed_km: 3\n")
    assert caught.value.field == "train.speed_km"


def test_file_with_mistake(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(TEXT.replace("60", "-60"))
    with pytest.raises(ScenarioError) as caught:
        load_scenario(path)
    assert str(caught.value) == f"{path}:4: train.speed_kmh: must be above 0, got -60"


def test_files_that_cannot_be_read(tmp_path):
    def reason(path):
        with pytest.raises(ScenarioError) as caught:
            load_scenario(path)
        assert caught.value.file == str(path)
        return caught.value.reason

    assert reason(tmp_path / "none.yaml") == "no such file"
    (tmp_path / "folder.yaml").mkdir()
    assert reason(tmp_path / "folder.yaml") == "is not a file"
    (tmp_path / "latin.yaml").write_bytes(b"version: 1\ntitle: \xe9\n")
    assert reason(tmp_path / "latin.yaml") == "is not UTF-8 text"
    (tmp_path / "long.yaml").write_bytes(b"#" * (512 * 1024 + 1))
    assert reason(tmp_path / "long.yaml") == "is over the limit of 512 KB"
    assert reason("x\0.yaml")


def test_unknown_name():
    with pytest.raises(ScenarioError) as caught:
        load_scenario("missisauga")
    assert str(caught.value) == "missisauga: unknown scenario; did you mean 'mississauga'?"


@pytest.mark.parametrize(
    "name",
    ["../mississauga", "/etc/passwd", "a/b", "..", ".", "", "a\0b", "x\n", "mississauga.yaml"],
)
def test_a_name_is_never_a_path(name, tmp_path, monkeypatch):
    (tmp_path / "scenarios").mkdir()
    (tmp_path / "mississauga.yaml").write_text(TEXT)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ScenarioError):
        load_scenario_by_name(name, [tmp_path / "scenarios"])
