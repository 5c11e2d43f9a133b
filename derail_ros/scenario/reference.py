"""The JSON schema of the format, and the tables of ``docs/scenarios.md``.

``python -m derail_ros.scenario.reference docs/scenarios.md`` brings the page up to date.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import annotated_types
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from derail_ros.scenario.messages import model_at
from derail_ros.scenario.rolling_stock import load_rolling_stock
from derail_ros.scenario.scenario import list_scenarios, loads_scenario
from derail_ros.scenario.schema import ScenarioModel, Section
from derail_ros.scenario.units import UNITS, unit_of, variants

BEGIN = "<!-- {}: generated, see derail_ros/scenario/reference.py -->"
END = "<!-- end of {} -->"


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


def field_tables() -> str:
    """All fields with unit, default, range and meaning, as Markdown tables."""
    parts: list[str] = []
    todo: list[tuple[str, type[Section]]] = [("", ScenarioModel)]
    told: dict[type[Section], str] = {}
    while todo:
        prefix, model = todo.pop(0)
        if told.setdefault(model, prefix) != prefix:
            parts.append(f"### `{prefix}`\n\nAs `{told[model]}`.")
            continue
        title = f"`{prefix}`" if prefix else "Top level"
        rows = [f"### {title}", "", _summary(model), ""]
        rows += ["| field | unit | default | range | meaning |", "| --- | --- | --- | --- | --- |"]
        inner: list[tuple[str, type[Section]]] = []
        for name, info in model.model_fields.items():
            rows.append(_row(name, info))
            child = model_at(model, (name,))
            if child is not None and issubclass(child, Section):
                inner.append((_place(prefix, name, info), child))
        parts.append("\n".join(rows))
        todo = [*inner, *todo]
    return "\n\n".join(parts)


def stock_tables() -> str:
    """The rolling stock library as Markdown tables."""
    stock = load_rolling_stock()
    rows = [
        "| car type | what it is | mass (t) | over couplers (m) | truck centres (m) | coupler |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for name, car in stock.cars.items():
        scenario = loads_scenario(ONE_CAR.format(name), name)
        light = scenario.totals.mass / 1000
        if car.mass_kg is None:
            light = scenario.with_overrides({"train.consist.0.load": 0}).totals.mass / 1000
        heavy = scenario.totals.mass / 1000
        trucks = f"{car.truck_centres_m:.4g}" if car.truck_centres_m else "shared"
        cells = (
            f"`{name}`",
            car.title,
            f"{light:.1f}" if light == heavy else f"{light:.1f} to {heavy:.1f}",
            f"{scenario.totals.length:.2f}",
            trucks,
            car.coupler or "",
        )
        rows.append(f"| {' | '.join(cells)} |")
    rows += [
        "",
        "| coupler type | head | pivot to face (m) | pivot to striker (m) | opening (m) "
        "| k1 (MN/m) | k2 (MN/m) |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for name, kind in stock.couplers.items():
        numbers = (kind.pivot_to_face_m, kind.pivot_to_striker_m, kind.striker_opening_m)
        stiffness = ((kind.k1_N_per_m or 0.0) / 1e6, (kind.k2_N_per_m or 0.0) / 1e6)
        columns = [f"`{name}`", str(kind.head), *(f"{x:g}" for x in (*numbers, *stiffness))]
        rows.append(f"| {' | '.join(columns)} |")
    return "\n".join(rows)


def unit_table() -> str:
    """The units in which a field may be given, as a Markdown table."""
    rows = ["| quantity | ends of a key |", "| --- | --- |"]
    for quantity, units in UNITS.items():
        rows.append(f"| {quantity} | {', '.join(f'`_{unit}`' for unit in units)} |")
    return "\n".join(rows)


def scenario_table() -> str:
    """The shipped scenarios as a Markdown table."""
    rows = ["| name | what it is |", "| --- | --- |"]
    rows += [f"| `{name}` | {title} |" for name, title in list_scenarios()]
    return "\n".join(rows)


ONE_CAR = """
version: 1
title: one car
train: {{speed_kmh: 1, consist: [{{car: {}}}]}}
initiation: {{await_command: true}}
"""

GENERATED = {
    "units": unit_table,
    "scenarios": scenario_table,
    "fields": field_tables,
    "rolling stock": stock_tables,
}


def fill(page: str) -> str:
    """The page with the content between its markers renewed."""
    for name, make in GENERATED.items():
        begin, end = BEGIN.format(name), END.format(name)
        before, found, rest = page.partition(begin)
        _, closed, after = rest.partition(end)
        if not found or not closed:
            raise ValueError(f"the page has no markers for {name!r}")
        page = f"{before}{begin}\n\n{make()}\n\n{end}{after}"
    return page


def _summary(model: type[BaseModel]) -> str:
    return (model.__doc__ or "").strip().split("\n\n")[0].replace("``", "`")


def _place(prefix: str, name: str, info: FieldInfo) -> str:
    """Dotted path of what stands within a field: ``N`` is an index, ``NAME`` a free key."""
    origin = str(info.annotation)
    index = ".N" if origin.startswith("tuple") else ".NAME" if origin.startswith("dict") else ""
    return f"{prefix}.{name}{index}".lstrip(".")


def _row(name: str, info: FieldInfo) -> str:
    extra = info.json_schema_extra
    unit = extra.get("unit", unit_of(name)) if isinstance(extra, dict) else ""
    cells = (f"`{name}`", str(unit), _default(info), _range(info), info.description or "")
    return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"


def _default(info: FieldInfo) -> str:
    default = info.default
    if default is PydanticUndefined:
        return "required"
    if default is None or isinstance(default, BaseModel):
        return ""
    if isinstance(default, bool):
        return str(default).lower()
    if isinstance(default, float):
        return f"{default:,.10g}".replace(",", " ")
    if default in ((), {}):
        return "none"
    return str(default)


def _range(info: FieldInfo) -> str:
    words = []
    for limit in _limits(info):
        if isinstance(limit, annotated_types.Gt):
            words.append(f"above {limit.gt:g}")
        elif isinstance(limit, annotated_types.Ge):
            words.append(f"from {limit.ge:g}")
        elif isinstance(limit, annotated_types.Le):
            words.append(f"to {limit.le:g}")
    return " ".join(words)


def _limits(info: FieldInfo) -> list[Any]:
    """Limits of a field, whether stated on the field or on its annotated type."""
    found = list(info.metadata)
    for part in getattr(info.annotation, "__args__", ()):
        for entry in getattr(part, "__metadata__", ()):
            found += entry.metadata if isinstance(entry, FieldInfo) else [entry]
    return found


if __name__ == "__main__":
    target = Path(sys.argv[1])
    target.write_text(fill(target.read_text(encoding="utf-8")), encoding="utf-8")
