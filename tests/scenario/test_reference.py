"""The page, the JSON schema and the engine's parameters keep step with the models."""

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import jsonschema
import pytest

from derail_ros.scenario import json_schema, list_scenarios, load_scenario, loads_scenario
from derail_ros.scenario.schema import ScenarioModel, Section
from derail_ros.scenario.strict_yaml import parse
from derail_ros.scenario.units import unit_of
from derail_ros.vocabulary import params as engine
from research import scenarios
from research.pages import fill

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "scenarios.md"


def models(model=ScenarioModel):
    yield model
    for info in model.model_fields.values():
        for part in (info.annotation, *getattr(info.annotation, "__args__", ())):
            if isinstance(part, type) and issubclass(part, Section):
                yield from models(part)


def test_page_is_in_step():
    text = PAGE.read_text(encoding="utf-8")
    tables = {name: make() for name, make in scenarios.TABLES.items()}
    assert fill(text, tables) == text, "run: python -m research scenarios"


def test_examples_of_the_page_load():
    blocks = PAGE.read_text(encoding="utf-8").split("```yaml\n")[1:]
    texts = [block.partition("```")[0] for block in blocks]
    whole = "version: 1\ntitle: x\ntrain:\n  speed_kmh: 60\n  consist: [{car: box_car}]\n"
    assert len(texts) == 7
    for text in texts:
        if "version" not in text:
            section = text.partition(":")[0]
            text = "version: 1\ntitle: x\n" + text
            if section != "train":
                text += whole[whole.index("train:") :]
            if section != "track":
                text += "track: {rail_breaks: [30]}\n"
        assert loads_scenario(text).to_params()


def test_message_of_the_page():
    text = "version: 1\ntitle: x\ntrain:\n  consist: [{car: box_car}]\n  speed: 60\n"
    with pytest.raises(ValueError) as caught:
        loads_scenario(text, "my_train.yaml")
    assert str(caught.value) in PAGE.read_text(encoding="utf-8")


def test_every_field_is_described():
    for model in models():
        assert model.__doc__
        for name, info in model.model_fields.items():
            assert info.description, f"{model.__name__}.{name}"


def test_units_are_in_the_names():
    keys = {
        "speed_kmh": "km/h", "slack_m": "m", "inertia_kg_m2": "kg m2", "force_N": "N", "share": "",
        "k1_N_per_m": "N/m", "damping_N_s_per_m": "N s/m", "baumgarte_position_per_s2": "1/s2",
        "grade_percent": "%", "tractive_effort_kmh_kN": "km/h, kN", "c1_s2_per_m2": "s2/m2",
    }  # fmt: skip
    assert {key: unit_of(key) for key in keys} == keys
    # these two end like units and are none, or have one that their key does not name
    others = {
        name: info.json_schema_extra["unit"]
        for model in models()
        for name, info in model.model_fields.items()
        if "unit" in info.json_schema_extra
    }
    assert others == {"c_s": "", "rail_breaks": "m"}


def test_every_parameter_of_the_engine_can_be_set():
    reached = {
        info.json_schema_extra["engine"]
        for model in models()
        for info in model.model_fields.values()
        if "engine" in info.json_schema_extra
    }
    # these have no single field: they are made of several, or counted
    made = {
        "TrackParams": {"segments", "rail_breaks", "grades"},
        "TractionParams": {"notches"},
        "DraftGearParams": {"on", "start"},
        "InitiationParams": {"speed", "derailed_trucks", "parted_couplings", "lateral_forces"},
        "BrakeParams": {"triggers", "remote"},
        "BrakeTrigger": {"car", "mode"},
        "GroundParams": set(),
        "ContactParams": set(),
        "DerailmentParams": set(),
        "IntegrationParams": set(),
        "LateralForce": set(),
    }
    for owner, others in made.items():
        names = {f.name for f in dataclasses.fields(getattr(engine, owner))}
        assert {f"{owner}.{name}" for name in names - others} == {
            name for name in reached if name.startswith(f"{owner}.")
        }


def test_defaults_are_those_of_the_engine():
    text = "version: 1\nconstants: published\ntitle: x\n"
    text += "train: {speed_kmh: 60, consist: [{car: box_car}]}\n"
    params = loads_scenario(text + "initiation: {await_command: true}\n").to_params()
    default = engine.TrainParams(
        params.cars, engine.InitiationParams(params.initiation.speed, derailed_trucks=())
    )
    assert params == default
    coupler = params.cars[0].front
    assert coupler == engine.CouplerType(
        coupler.name,
        coupler.head,
        coupler.length,
        coupler.striker_arm,
        coupler.striker_opening,
        coupler.k1,
    )
    unit = params.cars[0].brakes[0]
    assert unit == engine.BrakeUnit(0.0, weight=params.cars[0].mass)


def test_json_schema():
    schema = json_schema()
    assert json.loads(json.dumps(schema)) == schema
    assert schema["$schema"].endswith("2020-12/schema")
    assert schema["additionalProperties"] is False
    assert set(schema["properties"]) == {*ScenarioModel.model_fields, "extends", "overrides"}


def test_json_schema_accepts_the_shipped_files_and_refuses_mistakes():
    validator = jsonschema.Draft202012Validator(json_schema())
    for path in sorted((ROOT / "config" / "scenarios").glob("*.yaml")):
        data = parse(path.read_text(), path.name).data
        validator.validate(data)
        with pytest.raises(jsonschema.ValidationError):
            validator.validate({**data, "trains": 1})
    for name, _ in list_scenarios():
        validator.validate(load_scenario(name).resolved())
    with pytest.raises(jsonschema.ValidationError):
        validator.validate({"version": 1, "title": "x", "train": {}})


def test_names_are_imported_when_they_are_used():
    code = (
        "import sys, derail_ros.scenario as s; assert 'pydantic' not in sys.modules;"
        "from derail_ros.scenario import ScenarioError; assert 'pydantic' not in sys.modules;"
        "s.load_scenario('mississauga').to_params(); assert 'numba' not in sys.modules;"
        "assert not {'rclpy', 'numpy'} & set(sys.modules);"
        "assert 'load_scenario' in dir(s)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)


def test_unknown_name_of_the_package():
    import derail_ros.scenario as package

    with pytest.raises(AttributeError):
        package.nothing  # noqa: B018
    for name in package.__all__:
        assert getattr(package, name)
