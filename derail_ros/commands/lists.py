"""``derail scenarios`` and ``derail models``: what can be run by name."""

from __future__ import annotations

from derail_ros.commands import common
from derail_ros.commands.common import OK
from derail_ros.commands.options import Json
from derail_ros.studies.tables import Table


def scenarios(as_json: Json = False) -> int:
    """List the scenarios."""
    from derail_ros.scenario import list_scenarios

    found = list_scenarios()
    if as_json:
        names = [{"name": s.name, "title": s.title} for s in found]
        common.print_json("scenarios", {"scenarios": names})
        return OK
    rows = [(s.name, s.title) for s in found]
    common.print_tables(Table(("name", "title"), rows, texts=2))
    return OK


def models(as_json: Json = False) -> int:
    """List the models: the engines, and the earlier models."""
    from derail_ros import models as engines
    from derail_ros.baselines.models import MODELS

    names = engines.names()
    rows = [
        {
            "name": name,
            "engine": name in names,
            "features": sorted(engines.engine(name).features) if name in names else [],
            "words": (MODELS[name] if name in MODELS else engines.engine(name)).words,
        }
        for name in dict.fromkeys([*names, *MODELS])
    ]
    if as_json:
        common.print_json("models", {"models": rows})
        return OK
    told = [(r["name"], r["words"], ", ".join(r["features"])) for r in rows]
    common.print_tables(Table(("name", "model", "features"), told, texts=3))
    print("`derail simulate SCENARIO --model NAME` runs a model; only engines write recordings.")
    return OK
