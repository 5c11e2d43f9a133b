"""The tables of ``docs/scenarios.md``: units, shipped scenarios, fields, rolling stock."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import annotated_types
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from derail_ros.scenario import list_scenarios, load_rolling_stock, loads_scenario
from derail_ros.scenario.messages import model_at
from derail_ros.scenario.schema import ScenarioModel, Section
from derail_ros.scenario.units import UNITS, unit_of
from derail_ros.studies.tables import Table
from research.pages import Options, fill, with_places


def write(options: Options) -> None:
    """Write the tables of the page anew."""
    text = with_places(options.page, list(TABLES))
    options.write(fill(text, {name: make() for name, make in TABLES.items()}), {})


FIELD_HEADS = ("field", "unit", "default", "range", "meaning")


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
        rows = []
        inner: list[tuple[str, type[Section]]] = []
        for name, info in model.model_fields.items():
            rows.append(_row(name, info))
            child = model_at(model, (name,))
            if child is not None and issubclass(child, Section):
                inner.append((_place(prefix, name, info), child))
        parts += [f"### {title}", _summary(model), Table(FIELD_HEADS, rows, texts=5).markdown()]
        todo = [*inner, *todo]
    return "\n\n".join(parts)


def stock_tables() -> str:
    """The rolling stock library as Markdown tables."""
    stock = load_rolling_stock()
    rows = []
    for name, car in stock.cars.items():
        scenario = loads_scenario(ONE_CAR.format(name), name)
        light = heavy = scenario.totals.mass / 1000
        if car.mass_kg is None:
            light = scenario.with_overrides({"train.consist.0.load": 0}).totals.mass / 1000
        rows.append(
            [
                f"`{name}`",
                car.title,
                f"{light:.1f}" if light == heavy else f"{light:.1f} to {heavy:.1f}",
                f"{scenario.totals.length:.2f}",
                f"{car.truck_centres_m:.4g}" if car.truck_centres_m else "shared",
                car.coupler or "",
            ]
        )
    heads = ["car type", "what it is", "mass (t)", "over couplers (m)", "truck centres (m)",
             "coupler"]  # fmt: skip
    cars = Table(heads, rows, texts=6)
    rows = []
    for name, kind in stock.couplers.items():
        numbers = (kind.pivot_to_face_m, kind.pivot_to_striker_m, kind.striker_opening_m)
        stiffness = ((kind.k1_N_per_m or 0.0) / 1e6, (kind.k2_N_per_m or 0.0) / 1e6)
        rows.append([f"`{name}`", str(kind.head), *(f"{x:g}" for x in (*numbers, *stiffness))])
    heads = ["coupler type", "head", "pivot to face (m)", "pivot to striker (m)", "opening (m)",
             "k1 (MN/m)", "k2 (MN/m)"]  # fmt: skip
    return f"{cars.markdown()}\n\n{Table(heads, rows, texts=7).markdown()}"


def unit_table() -> str:
    """The units in which a field may be given, as a Markdown table."""
    rows = [[q, ", ".join(f"`_{unit}`" for unit in units)] for q, units in UNITS.items()]
    return Table(["quantity", "ends of a key"], rows, texts=2).markdown()


def scenario_table() -> str:
    """The shipped scenarios as a Markdown table."""
    rows = [[f"`{name}`", title] for name, title in list_scenarios()]
    return Table(["name", "what it is"], rows, texts=2).markdown()


ONE_CAR = """
version: 1
title: one car
train: {{speed_kmh: 1, consist: [{{car: {}}}]}}
initiation: {{await_command: true}}
"""

TABLES: dict[str, Callable[[], str]] = {
    "units": unit_table,
    "scenarios": scenario_table,
    "fields": field_tables,
    "rolling stock": stock_tables,
}
"""Result between marks of the page -> what makes it."""


def _summary(model: type[BaseModel]) -> str:
    return (model.__doc__ or "").strip().split("\n\n")[0].replace("``", "`")


def _place(prefix: str, name: str, info: FieldInfo) -> str:
    """Dotted path of what stands within a field: ``N`` is an index, ``NAME`` a free key."""
    origin = str(info.annotation)
    index = ".N" if origin.startswith("tuple") else ".NAME" if origin.startswith("dict") else ""
    return f"{prefix}.{name}{index}".lstrip(".")


def _row(name: str, info: FieldInfo) -> list[str]:
    extra = info.json_schema_extra
    unit = extra.get("unit", unit_of(name)) if isinstance(extra, dict) else ""
    cells = (f"`{name}`", str(unit), _default(info), _range(info), info.description or "")
    return [cell.replace("|", "\\|") for cell in cells]


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
