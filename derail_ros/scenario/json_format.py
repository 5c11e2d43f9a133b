"""The JSON schema of the format."""

from __future__ import annotations

from typing import Any

from derail_ros.scenario.schema import ScenarioModel
from derail_ros.scenario.units import unit_of, variants


def json_schema() -> dict[str, Any]:
    """JSON schema (draft 2020-12) of a scenario file, for editors and other programs."""
    schema = ScenarioModel.model_json_schema()
    schema["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    schema["title"] = "derail_ros scenario, version 1"
    # not fields of a scenario but instructions to the loader, which leaves none of them behind
    schema["properties"]["extends"] = {
        "type": "string",
        "description": "name of the scenario of which only the differences are given here",
    }
    schema["properties"]["overrides"] = {
        "type": "object",
        "description": "dotted path -> value, carried out last; only with extends",
    }
    # what a scenario extends may give everything but the title
    train = schema["$defs"]["Train"].pop("required")
    schema["required"] = ["version", "title"]
    schema["if"] = {"not": {"required": ["extends"]}}
    schema["then"] = {"required": ["train"], "properties": {"train": {"allOf": _needs(train)}}}
    for part in (schema, *schema["$defs"].values()):
        if "required" in part and part is not schema:
            part["allOf"] = _needs(part.pop("required"))
        names = part.get("properties", {})
        for name, field in names.items():
            if unit := unit_of(name):
                field.setdefault("unit", unit)
        others = {
            other: {"type": "number", "description": f"instead of {name}, in its own unit"}
            for name in list(names)
            for other in variants(name)
            if other not in names
        }
        names.update(others)
    return schema


def _needs(required: list[str]) -> list[dict[str, Any]]:
    """What requires each field, in whatever unit."""
    return [{"anyOf": [{"required": [n]} for n in (name, *variants(name))]} for name in required]
