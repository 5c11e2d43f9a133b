"""Dotted paths: what --set and studies vary, and what variants of files give."""

import numpy as np
import pytest

from derail_ros.scenario import (
    ScenarioError,
    list_scenarios,
    load_scenario,
    load_scenario_by_name,
    loads_scenario,
)

BASE = load_scenario("base_train")

# path, value, where it lands in the engine's parameters, value there
PATHS = [
    ("train.speed_kmh", 72, "initiation.speed", 20.0),
    ("train.consist.0.mass_kg", 34e3, "cars.59.mass", 34e3),
    ("train.consist.0.mass_kg", 34e3, "cars.59.brakes.0.weight", 34e3),
    ("train.consist.0.width_m", 3.0, "cars.0.width", 3.0),
    ("train.consist.0.front_coupler", "F79", "cars.3.front.name", "F79"),
    ("train.consist.0.coupler_inertia_kg_m2", 2e3, "cars.0.coupler_inertia", 2e3),
    ("train.consist.0.brake.shoe", "cast_iron", "cars.9.brakes.0.shoe", "cast_iron"),
    ("train.consist.0.brake.scale", 0.5, "cars.9.brakes.0.scale", 0.5),
    ("train.consist.0.brake.delay_s", 2, "cars.9.brakes.0.delay", 2.0),
    ("train.virtual_from", 31, "cars.30.represents", 30),
    ("couplers.k2_N_per_m", 50e9, "cars.0.front.k2", 50e9),
    ("couplers.damping_N_s_per_m", 0, "cars.0.rear.damping", 0.0),
    ("couplers.inertia_kg_m2", 2e3, "cars.0.coupler_inertia", 2e3),
    ("couplers.types.F73.k1_N_per_m", 1e6, "cars.0.front.k1", 1e6),
    ("track.rail_breaks", [5, 2.5], "track.rail_breaks", (2.5, 5.0)),
    ("track.rail_breaks.0", 5, "track.rail_breaks", (5.0,)),
    ("initiation.position_m", -10, "initiation.position", -10.0),
    ("initiation.lateral_force_N", -40e3, "initiation.lateral_forces.0.force", -40e3),
    ("initiation.lateral_force_N", 0, "initiation.lateral_forces", ()),
    ("initiation.lateral_force_car", 7, "initiation.lateral_forces.0.car", 7),
    ("initiation.lateral_force_place", "centre", "initiation.lateral_forces.0.place", "centre"),
    ("initiation.lateral_force_start_s", 1, "initiation.lateral_forces.0.start", 1.0),
    ("initiation.lateral_force_duration_s", 2, "initiation.lateral_forces.0.duration", 2.0),
    ("initiation.lateral_forces", [{"force_N": 9}], "initiation.lateral_forces.1.force", 9.0),
    ("initiation.derailed_trucks", [], "initiation.derailed_trucks", ()),
    ("initiation.derailed_trucks.0.truck", "rear", "initiation.derailed_trucks", ((1, "rear"),)),
    ("initiation.parted_couplings", [3, 1, 3], "initiation.parted_couplings", (1, 3)),
    ("brakes.force_N", 50e3, "brakes.force", 50e3),
    ("brakes.force_scale", 0.8, "cars.59.brakes.0.scale", 0.8),
    ("brakes.rise_time_s", 5, "brakes.rise_time", 5.0),
    ("brakes.signal_speed_m_per_s", 250, "brakes.signal_speed", 250.0),
    ("brakes.delay_s", 3, "brakes.triggers.0.delay", 3.0),
    ("brakes.instant", True, "brakes.triggers.0.mode", "instant"),
    ("brakes.traction_limited", True, "brakes.triggers.0.mode", "traction_limited"),
    ("brakes.traction_coefficient", 0.15, "brakes.traction_coefficient", 0.15),
    ("brakes.vent_on_parting", True, "brakes.vent_on_parting", True),
    ("brakes.signal_source", "rear", "brakes.triggers.0.source", "rear"),
    ("brakes.signal_source", "both_ends", "brakes.triggers.0.source", "both_ends"),
    ("brakes.signal_source", "none", "brakes.triggers", ()),
    ("brakes.triggers", [{"time_s": 4, "instant": True}], "brakes.triggers.1.mode", "instant"),
    ("ground.scale", 1.5, "ground.scale", 1.5),
    ("ground.c_s", 1, "ground.c_s", 1.0),
    ("ground.c_v_s_per_m", 0.04, "ground.c_v", 0.04),
    ("contact.force_max_N", 2e6, "contact.force_max", 2e6),
    ("contact.gap_law", "sech2", "contact.gap_law", "sech2"),
    ("contact.inside", "held", "contact.inside", "held"),
    ("derailment.lv_limit", 1.0, "derailment.lv_limit", 1.0),
    ("derailment.break_follows_lateral", True, "derailment.break_follows_lateral", True),
    ("derailment.knuckle_limit_ff_rad", 0.6, "derailment.knuckle_limit_ff", 0.6),
    ("integration.rtol", 1e-8, "integration.rtol", 1e-8),
    ("integration.locate_crossings", False, "integration.locate_crossings", False),
    ("integration.time_limit_s", 5, "integration.time_limit", 5.0),
]


def look_up(params, path):
    for step in path.split("."):
        params = params[int(step)] if step.isdigit() else getattr(params, step)
    return params


@pytest.mark.parametrize(("path", "value", "place", "expected"), PATHS)
def test_path(path, value, place, expected):
    changed = BASE.with_overrides({path: value})
    found = look_up(changed.to_params(), place)
    assert found == (pytest.approx(expected) if type(expected) is float else expected)
    assert changed.hash != BASE.hash
    # the resolved scenario has the same paths
    flat = loads_scenario(BASE.to_yaml(), BASE.name)
    assert flat.with_overrides({path: value}).to_params() == changed.to_params()


def test_count():
    params = BASE.with_overrides({"train.consist.0.count": 5}).to_params()
    assert len(params.cars) == 5


def test_alignment():
    pieces = [
        {"tangent": {"length_m": 1500}},
        {"spiral": {"length_m": 50, "radius_end_m": 300, "turn": "right"}},
        {"curve": {"length_m": 200, "radius_m": 300, "turn": "right"}},
    ]
    params = BASE.with_overrides(
        {"track.alignment": pieces, "track.start_coordinate_m": -1400}
    ).to_params()
    assert [s.length for s in params.track.segments] == [1500, 50, 200]
    assert params.track.segments[1].curvature_end == -1 / 300
    assert params.track.start_coordinate == -1400


def test_signal_from_a_car():
    params = BASE.with_overrides(
        {"brakes.signal_source": "car", "brakes.signal_car": 30, "brakes.instant": True,
         "brakes.traction_limited": True}
    ).to_params()  # fmt: skip
    (trigger,) = params.brakes.triggers
    assert (trigger.source, trigger.car) == ("car", 30)
    assert trigger.mode == "instant_traction_limited"


def test_several_at_once_and_one_after_the_other_agree():
    both = BASE.with_overrides({"train.speed_kmh": 72, "ground.scale": 1.2})
    one = BASE.with_overrides({"ground.scale": 1.2}).with_overrides({"train.speed_kmh": 72})
    assert both == one
    assert both.with_overrides({}) == both


def test_back_to_the_default():
    assert BASE.with_overrides({"ground.scale": 1.2}).with_overrides({"ground.scale": 1}) == BASE
    assert BASE.with_overrides({"train.virtual_from": None}) == BASE


@pytest.mark.parametrize("value", [np.float64(72), np.int64(72), np.float32(72), np.array(72.0)])
def test_numpy_numbers(value):
    changed = BASE.with_overrides({"train.speed_kmh": value})
    assert changed == BASE.with_overrides({"train.speed_kmh": 72})


def test_numpy_list():
    changed = BASE.with_overrides({"track.rail_breaks": np.array([1.0, 2.0])})
    assert changed.to_params().track.rail_breaks == (1.0, 2.0)


# --- mass and inertia -------------------------------------------------------------------------

INLINE = """\
version: 1
title: x
train:
  speed_kmh: 60
  consist:
    - mass_kg: 80e3
      inertia_kg_m2: 1.2e6
      length_m: 12.44
      coupler_pivots_m: 12.1
      truck_centres_m: 9.86
      coupler: F79
    - {car: source_tank_12m44}
    - {car: tank_dot_111, load: empty}
    - {car: tank_dot_111, load: empty, inertia_kg_m2: 0.5e6}
track: {rail_breaks: [30]}
"""


@pytest.mark.parametrize("block", [0, 1, 2, 3])
@pytest.mark.parametrize("mass", [40e3, 100e3])
def test_mass_scales_inertia(block, mass):
    scenario = loads_scenario(INLINE)
    before = scenario.to_params().cars[block]
    after = scenario.with_overrides({f"train.consist.{block}.mass_kg": mass}).to_params()
    assert after.cars[block].mass == mass
    assert after.cars[block].inertia == pytest.approx(before.inertia * mass / before.mass)
    others = [i for i in range(4) if i != block]
    for i in others:
        assert after.cars[i].inertia == scenario.to_params().cars[i].inertia


def test_mass_and_inertia_together_are_taken_as_given():
    changed = loads_scenario(INLINE).with_overrides(
        {"train.consist.0.mass_kg": 40e3, "train.consist.0.inertia_kg_m2": 1e6}
    )
    car = changed.to_params().cars[0]
    assert (car.mass, car.inertia) == (40e3, 1e6)


def test_mass_there_and_back():
    scenario = loads_scenario(INLINE)
    path = "train.consist.0.mass_kg"
    again = scenario.with_overrides({path: 40e3}).with_overrides({path: 80e3})
    assert again.to_params().cars[0].inertia == pytest.approx(1.2e6)


def test_load_scales_a_given_inertia_and_replaces_a_given_mass():
    scenario = loads_scenario(INLINE)
    loaded = scenario.with_overrides({"train.consist.3.load": "loaded"}).to_params().cars[3]
    empty = scenario.to_params().cars[3]
    assert loaded.mass == pytest.approx(1170e3 / 9.81, abs=1)
    assert loaded.inertia == pytest.approx(0.5e6 * loaded.mass / empty.mass)
    heavy = scenario.with_overrides({"train.consist.3.mass_kg": 50e3})
    assert (
        heavy.with_overrides({"train.consist.3.load": 1}).to_params().cars[3].mass == loaded.mass
    )


def test_half_load_is_half_way():
    halfway = loads_scenario(INLINE).with_overrides({"train.consist.2.load": 0.5})
    assert halfway.to_params().cars[2].mass == pytest.approx((39144 + 119266) / 2)


# --- mistakes ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("path", "value", "field", "reason"),
    [
        ("train.speed_kph", 3, "train.speed_kph", "did you mean 'speed_kmh'"),
        ("train.speed_kmh", "fast", "train.speed_kmh", "must be a number"),
        ("train.speed_kmh", float("nan"), "train.speed_kmh", "finite"),
        ("train.speed_kmh", -1, "train.speed_kmh", "above 0"),
        ("train.speed_kmh.x", 1, "train.speed_kmh.x", "has no field 'x'"),
        ("train.consist.1.mass_kg", 1, "train.consist.1.mass_kg", "no entry 1: it has 1 entry"),
        ("train.consist.x", 1, "train.consist.x", "no entry 'x'"),
        ("train.consist.00", 1, "train.consist.00", "no entry '00'"),
        ("train.0", 1, "train.0", "has no field 0"),
        ("track.alignment.0.curve", 1, "track.alignment.0.curve", "the list is empty"),
        ("nothing", 1, "nothing", "unknown key"),
        ("", 1, "", "is not a dotted path"),
        ("a..b", 1, "a.''.b", "is not a dotted path"),
        (".".join("a" * 99), 1, None, "is not a dotted path"),
        ("version", 1, "version", "cannot be overridden"),
        ("extends", "x", "extends", "cannot be overridden"),
        ("train.speed_kmh", object(), "train.speed_kmh", "a object cannot stand"),
        ("train.consist", [], "train.consist", "at least one"),
        ("train.consist.0", 5, "train.consist.0", "mapping"),
        ("train.consist.0.car", "none", "train.consist.0.car", "unknown car type"),
        ("train.consist.0.load", 0.5, "train.consist.0.load", "no empty and loaded mass"),
    ],
)
def test_mistake(path, value, field, reason):
    with pytest.raises(ScenarioError) as caught:
        BASE.with_overrides({path: value})
    error = caught.value
    assert (error.file, error.line) == ("base_train", None)
    if field:
        assert error.field == field
    assert reason in error.reason


def test_an_override_may_break_something_in_the_file():
    with pytest.raises(ScenarioError) as caught:
        BASE.with_overrides({"train.consist": [{"car": "box_car", "widht_m": 1}]})
    assert caught.value.field == "train.consist.0.widht_m"
    assert caught.value.line is None
    with pytest.raises(ScenarioError) as caught:
        load_scenario("mid_train_break").with_overrides({"train.consist": [{"car": "box_car"}]})
    assert caught.value.field == "initiation.lateral_force_car"
    assert caught.value.file.endswith("mid_train_break.yaml")
    assert caught.value.line


def test_overlapping_overrides_are_refused():
    with pytest.raises(ScenarioError, match="overlaps"):
        BASE.with_overrides(
            {"train.consist.0.mass_kg": 1e4, "train.consist.0": {"car": "box_car"}}
        )


# --- variants ---------------------------------------------------------------------------------


def write(folder, name, text):
    (folder / f"{name}.yaml").write_text("version: 1\n" + text)


def test_variant_of_a_variant(tmp_path):
    write(tmp_path, "a", "extends: base_train\ntitle: a\noverrides: {train.speed_kmh: 40}\n")
    write(
        tmp_path,
        "b",
        "extends: a\ntitle: b\ntrain: {virtual_from: 31}\nground: {scale: 2}\n"
        "overrides:\n  train.consist.0.mass_kg: 50e3\n",
    )
    write(tmp_path, "c", "extends: b\ntitle: c\ntrain: {speed_kmh: 50, virtual_from: null}\n")
    a, b, c = (load_scenario(name, [tmp_path]) for name in "abc")
    assert a.with_overrides({"title": "base"}).to_params() == (
        BASE.with_overrides({"train.speed_kmh": 40}).to_params()
    )
    assert b.model.train.speed_kmh == 40  # what a overrode
    assert c.model.train.speed_kmh == 50  # is laid over in c
    assert c.to_params().ground.scale == 2
    assert len(c.to_params().cars) == 60
    assert c.to_params().cars[0].mass == 50e3
    assert (c.title, c.description, c.source) == ("c", "", BASE.source)
    assert "extends" not in c.resolved()
    assert loads_scenario(c.to_yaml()).to_params() == c.to_params()
    path = load_scenario(tmp_path / "c.yaml")  # finds b and a beside it
    assert path.to_params() == c.to_params()
    text = loads_scenario("version: 1\nextends: c\ntitle: d\n", dirs=[tmp_path])
    assert text.to_params() == c.to_params()


def test_lists_are_replaced(tmp_path):
    write(tmp_path, "a", "extends: mississauga\ntitle: a\ntrain: {consist: [{car: box_car}]}\n")
    assert load_scenario("a", [tmp_path]).n_cars == 1


def test_extra_folders_come_first(tmp_path):
    write(tmp_path, "zz", "extends: base_train\ntitle: mine\n")
    other = tmp_path / "other"
    other.mkdir()
    write(other, "base_train", "extends: mississauga\ntitle: another base\n")
    assert load_scenario("base_train", [other]).title == "another base"
    assert load_scenario("zz", [tmp_path, other]).n_cars == 74
    assert load_scenario("zz", [tmp_path]).n_cars == 60
    listed = dict(list_scenarios([tmp_path, other]))
    assert listed["base_train"] == "another base"
    assert listed["zz"] == "mine"
    assert len(listed) == len(list_scenarios()) + 1


def test_list_tells_of_files_that_cannot_be_read(tmp_path):
    (tmp_path / "bad.yaml").write_text("a: [")
    (tmp_path / "untitled.yaml").write_text("version: 1")
    (tmp_path / "not a name.yaml").write_text("version: 1")
    (tmp_path / "notes.txt").write_text("x")
    listed = dict(list_scenarios([tmp_path, tmp_path / "missing"]))
    assert listed["bad"].startswith("(cannot be read: ")
    assert listed["untitled"] == "(no title)"
    assert len(listed) == len(list_scenarios()) + 2


@pytest.mark.parametrize(
    ("text", "line", "field", "reason"),
    [
        ("extends: bose_train\ntitle: x\n", 2, "extends", "did you mean 'base_train'"),
        ("extends: ../base_train\ntitle: x\n", 2, "extends", "must be the name of a scenario"),
        ("extends: /etc/passwd\ntitle: x\n", 2, "extends", "must be the name of a scenario"),
        ("extends: [a]\ntitle: x\n", 2, "extends", "got a list"),
        ("extends: null\ntitle: x\n", 2, "extends", "got null"),
        ("extends: loop\ntitle: x\n", None, "extends", "round in a circle"),
        ("extends: base_train\n", 1, "title", "is required"),
        ("extends: base_train\ntitle: x\ntrain: 3\n", 4, "train", "mapping"),
        ("extends: base_train\ntitle: x\ntrain:\n  speed: 3\n", 5, "train.speed", "'speed_kmh'"),
        ("extends: base_train\ntitle: x\noverrides: 3\n", 4, "overrides", "must be a mapping"),
        (
            "extends: base_train\ntitle: x\noverrides:\n  train.speed: 3\n",
            5,
            "train.speed",
            "'speed_kmh'",
        ),
        (
            "extends: base_train\ntitle: x\noverrides:\n  train.consist.7.count: 3\n",
            5,
            "train.consist.7.count",
            "no entry 7",
        ),
    ],
)
def test_variant_mistakes(tmp_path, text, line, field, reason):
    write(tmp_path, "loop", "extends: loop2\ntitle: x\n")
    write(tmp_path, "loop2", "extends: loop\ntitle: x\n")
    write(tmp_path, "bad", text)
    with pytest.raises(ScenarioError) as caught:
        load_scenario_by_name("bad", [tmp_path])
    error = caught.value
    assert error.field == field
    assert reason in error.reason
    if line is not None:
        assert (error.file, error.line) == (str(tmp_path / "bad.yaml"), line)


def test_scenario_that_extends_itself(tmp_path):
    write(tmp_path, "me", "extends: me\ntitle: x\n")
    for name in ("me", tmp_path / "me.yaml"):
        with pytest.raises(ScenarioError, match="circle"):
            load_scenario(name, [tmp_path])


def test_long_chain(tmp_path):
    write(tmp_path, "s0", "extends: base_train\ntitle: x\n")
    for i in range(1, 12):
        write(tmp_path, f"s{i}", f"extends: s{i - 1}\ntitle: x\n")
    assert load_scenario("s5", [tmp_path]).n_cars == 60
    with pytest.raises(ScenarioError, match="chain"):
        load_scenario("s11", [tmp_path])


def test_mistake_in_the_base_points_to_the_base(tmp_path):
    write(tmp_path, "low", "title: x\ntrain:\n  speed_kmh: -3\n  consist: [{car: box_car}]\n")
    write(tmp_path, "high", "extends: low\ntitle: x\n")
    with pytest.raises(ScenarioError) as caught:
        load_scenario("high", [tmp_path])
    assert (caught.value.file, caught.value.line) == (str(tmp_path / "low.yaml"), 4)


def test_conflict_between_base_and_variant_points_to_the_line_it_came_from(tmp_path):
    write(tmp_path, "high", "extends: mid_train_break\ntitle: x\ntrain:\n  virtual_from: 5\n")
    with pytest.raises(ScenarioError) as caught:
        load_scenario("high", [tmp_path])
    error = caught.value
    assert error.field == "initiation.lateral_force_car"
    assert error.file.endswith("mid_train_break.yaml")
    assert "there is no modelled car 24, the last one is 4" in error.reason


@pytest.mark.parametrize(("overrides", "kind"), [([1], "list"), ("train.speed_kmh=1", "str")])
def test_overrides_that_are_no_mapping(overrides, kind):
    with pytest.raises(ScenarioError) as info:
        load_scenario("base_train").with_overrides(overrides)
    assert f"overrides: must be a mapping of dotted paths to values, got {kind}" in str(info.value)


def test_a_list_of_one_has_one_entry():
    with pytest.raises(ScenarioError, match="it has 1 entry, numbered from 0"):
        load_scenario("base_train").with_overrides({"train.consist.3.mass_kg": 1e4})


def test_the_title_names_the_changed_settings():
    slow = BASE.with_overrides({"train.speed_kmh": 30})
    assert slow.title == f"{BASE.title} (train.speed_kmh = 30)"
    assert slow.resolved()["title"] == slow.title
    both = slow.with_overrides({"ground.scale": 1.5, "contact.gap_law": "lorentzian"})
    assert both.title == (
        f"{BASE.title} (contact.gap_law = lorentzian, ground.scale = 1.5, train.speed_kmh = 30)"
    )
    assert slow.with_overrides({"train.speed_kmh": 40}).title.endswith(" (train.speed_kmh = 40)")
    assert slow.with_overrides({"title": "Mine"}).title == "Mine"
    listed = BASE.with_overrides({"track.rail_breaks": [5]})
    assert listed.title == f"{BASE.title} (track.rail_breaks changed)"
    assert BASE.with_overrides({}).title == BASE.title


def test_a_title_with_many_changed_settings_keeps_within_its_length():
    paths = [path for path, value, *_ in PATHS if isinstance(value, (int, float))]
    many = {path: value for path, value, *_ in PATHS if path in paths[20:32]}
    title = BASE.with_overrides(many).title
    assert len(title) <= 120
    assert title.startswith(f"{BASE.title} (") and title.endswith(" more)")
    long = BASE.with_overrides({"title": "x" * 119}).with_overrides({"train.speed_kmh": 30})
    assert long.title == "x" * 108 + " (1 changed)"
