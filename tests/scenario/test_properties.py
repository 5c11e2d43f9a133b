"""Whatever the text: a scenario or a ScenarioError, never anything else."""

import copy
import json
import pickle
import random

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from derail_ros.scenario import (
    Scenario,
    ScenarioError,
    list_scenarios,
    load_scenario,
    loads_scenario,
    parse_set,
)
from derail_ros.scenario.schema import ScenarioModel
from derail_ros.scenario.strict_yaml import dump

MISSISSAUGA = load_scenario("mississauga")
TEXTS = [load_scenario(name).to_yaml() for name, _ in list_scenarios()]
SMALL = """\
version: 1
title: x
train:
  speed_kmh: 60
  consist: [{car: box_car, count: 3}, {car: tank_lpg}]
track: {rail_breaks: [30]}
"""

# the same examples in each run, and no time limit for each on a busy machine
steady = settings(deadline=None, derandomize=True)


def load(text):
    try:
        scenario = loads_scenario(text)
    except ScenarioError as error:
        assert str(error).startswith("<inline>")
        assert "\n" not in str(error)
        str(error).encode()  # can be printed
        pickle.loads(pickle.dumps(error))
        return None
    assert isinstance(scenario, Scenario)
    assert len(scenario.to_params().cars) <= 1000
    return scenario


@steady
@given(st.text())
@example("\ud800")
@example("a: \x00")
@example('a: "\\ud800"')
@example("%YAML 9.9\n---\n")
@example("%TAG ! tag:x,2000:\n---\na: !b c\n")
@example("? ? ?")
@example("\ufeffversion: 1")
@example("version: 1\ntitle: '\\ud800'\n")
@example("---\n...\n---\n")
def test_any_text(text):
    load(text)


@steady
@given(st.text(alphabet="ab1:- ,[]{}&*!|>'\"%#?\n\t.~"))
def test_any_text_of_yaml_signs(text):
    load(text)


leaves = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.floats(),
    st.text(max_size=8),
    st.sampled_from(["F79", "box_car", "front", "left", "composition", 1, 2, 0.5, 60, 400]),
)
SECTIONS = [getattr(f.annotation, "model_fields", {}) for f in ScenarioModel.model_fields.values()]
keys = st.sampled_from(
    ["extends", "overrides", "car", "count", *ScenarioModel.model_fields]
    + [name for fields in SECTIONS for name in fields]
)
trees = st.recursive(
    leaves,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(keys, inner, max_size=4),
    max_leaves=20,
)


@steady
@given(st.dictionaries(keys, trees))
def test_any_tree(tree):
    load(dump(tree))


@steady
@given(st.data())
def test_any_change_to_a_shipped_scenario(data):
    lines = data.draw(st.sampled_from(TEXTS)).splitlines()
    for _ in range(data.draw(st.integers(1, 3))):
        i = data.draw(st.integers(0, len(lines) - 1))
        what = data.draw(st.sampled_from(["drop", "double", "value", "indent", "cut"]))
        line = lines[i]
        if what == "drop":
            del lines[i]
        elif what == "double":
            lines.insert(i, line)
        elif what == "value":
            value = data.draw(leaves)
            lines[i] = f"{line.partition(':')[0]}: {json.dumps(value)}"
        elif what == "indent":
            lines[i] = "  " + line
        else:
            lines[i] = line[: data.draw(st.integers(0, len(line)))]
        if not lines:
            break
    load("\n".join(lines))


def paths(data, prefix=""):
    items = data.items() if isinstance(data, dict) else enumerate(data)
    for key, value in items:
        yield f"{prefix}{key}"
        if isinstance(value, (dict, list)):
            yield from paths(value, f"{prefix}{key}.")


PATHS = list(paths(MISSISSAUGA.resolved()))


@steady
@given(st.dictionaries(st.sampled_from(PATHS) | st.text(max_size=20), trees, max_size=3))
def test_any_override(overrides):
    try:
        changed = MISSISSAUGA.with_overrides(overrides)
    except ScenarioError as error:
        assert "\n" not in str(error)
    else:
        changed.to_params()


@steady
@given(st.text(max_size=40))
def test_any_set(text):
    try:
        path, _ = parse_set(text)
    except ScenarioError:
        pass
    else:
        assert path


def shuffled(value, seed):
    """A copy with the keys of all mappings in another order."""
    order = random.Random(seed)
    if isinstance(value, dict):
        names = list(value)
        order.shuffle(names)
        return {name: shuffled(value[name], seed + 1) for name in names}
    if isinstance(value, list):
        return [shuffled(item, seed + 1) for item in value]
    return value


@steady
@given(st.integers(), st.sampled_from([name for name, _ in list_scenarios()]))
def test_hash_does_not_depend_on_the_order_of_keys(seed, name):
    scenario = load_scenario(name)
    other = loads_scenario(dump(shuffled(scenario.resolved(), seed)), name)
    assert other.hash == scenario.hash
    assert other == scenario


def test_hash_is_of_the_content():
    scenario = loads_scenario(SMALL)
    assert len(scenario.hash) == 64
    assert loads_scenario(SMALL.replace("60", "60.0"), "other").hash == scenario.hash
    assert loads_scenario(SMALL.replace("60", "61")).hash != scenario.hash
    zero = scenario.with_overrides({"initiation.position_m": 0.0})
    assert scenario.with_overrides({"initiation.position_m": -0.0}).hash == zero.hash


def test_resolved_is_json_and_a_fixed_point():
    for text in [*TEXTS, SMALL]:
        scenario = loads_scenario(text)
        data = scenario.resolved()
        assert json.loads(json.dumps(data)) == data
        again = loads_scenario(dump(data))
        assert again.resolved() == data
        assert again.to_params() == scenario.to_params()


def test_resolved_is_a_copy():
    data = MISSISSAUGA.resolved()
    before = copy.deepcopy(data)
    data["train"]["consist"].clear()
    data["ground"]["c_s"] = 5
    assert MISSISSAUGA.resolved() == before


def test_scenarios_can_be_sent_to_other_processes():
    again = pickle.loads(pickle.dumps(MISSISSAUGA))
    assert again == MISSISSAUGA
    assert hash(again) == hash(MISSISSAUGA)
    assert again.with_overrides({"train.speed_kmh": 80}).to_params()


def test_scenarios_do_not_change():
    with pytest.raises(Exception, match="frozen"):
        MISSISSAUGA.model.train.speed_kmh = 3
    with pytest.raises(AttributeError):
        MISSISSAUGA.name = "x"


def test_a_thousand_different_cars_fit():
    rng = random.Random(1)
    cars = [{"car": "tank_lpg", "load": rng.random(), "contents": "LPG"} for _ in range(1000)]
    scenario = loads_scenario(SMALL).with_overrides({"train.consist": cars})
    assert scenario.n_cars == 1000
    assert loads_scenario(scenario.to_yaml()).to_params() == scenario.to_params()
