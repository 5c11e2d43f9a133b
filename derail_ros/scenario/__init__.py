"""Scenarios: versioned YAML in, engine parameters out, and the rolling stock library.

The names are imported when they are first used: the schema takes a tenth of a second to build,
which a command that only prints its help need not wait for.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from derail_ros.scenario.errors import ScenarioError as ScenarioError
    from derail_ros.scenario.json_format import json_schema as json_schema
    from derail_ros.scenario.rolling_stock import RollingStock as RollingStock
    from derail_ros.scenario.rolling_stock import load_rolling_stock as load_rolling_stock
    from derail_ros.scenario.scenario import Scenario as Scenario
    from derail_ros.scenario.scenario import ScenarioInfo as ScenarioInfo
    from derail_ros.scenario.scenario import list_scenarios as list_scenarios
    from derail_ros.scenario.scenario import load_scenario as load_scenario
    from derail_ros.scenario.scenario import load_scenario_by_name as load_scenario_by_name
    from derail_ros.scenario.scenario import loads_scenario as loads_scenario
    from derail_ros.scenario.scenario import parse_set as parse_set

_HOMES = {
    "ScenarioError": "errors",
    "RollingStock": "rolling_stock",
    "load_rolling_stock": "rolling_stock",
    "json_schema": "json_format",
    "Scenario": "scenario",
    "ScenarioInfo": "scenario",
    "list_scenarios": "scenario",
    "load_scenario": "scenario",
    "load_scenario_by_name": "scenario",
    "loads_scenario": "scenario",
    "parse_set": "scenario",
}
__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
