"""``derail scenarios`` and ``derail models``: what can be run by name."""

from __future__ import annotations

from collections.abc import Sequence

from derail_ros.commands import common
from derail_ros.commands.common import OK


def scenarios(as_json: bool) -> int:
    """List the scenarios."""
    from derail_ros.scenario import list_scenarios

    found = list_scenarios()
    if as_json:
        rows = [{"name": s.name, "title": s.title} for s in found]
        common.print_json("scenarios", {"scenarios": rows})
        return OK
    _print(("name", "title"), [(s.name, s.title) for s in found])
    return OK


def models(as_json: bool) -> int:
    """List the engines with their features, and the earlier models."""
    from derail_ros import models as engines
    from derail_ros.baselines.models import MODELS

    names = engines.names()
    rows = [
        {
            "name": name,
            "engine": name in names,
            "features": sorted(engines.engine(name).features) if name in names else [],
            "words": MODELS[name].words if name in MODELS else "",
        }
        for name in dict.fromkeys([*names, *MODELS])
    ]
    if as_json:
        common.print_json("models", {"models": rows})
        return OK
    told = [(r["name"], r["words"], ", ".join(r["features"])) for r in rows]
    _print(("name", "model", "features"), told)
    print("`derail simulate SCENARIO --model NAME` runs a model; only engines write recordings.")
    return OK


def _print(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    from rich.markup import escape
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for k, head in enumerate(heads):
        table.add_column(head, style=None if k else "bold", no_wrap=not k)
    for row in rows:
        table.add_row(*(escape(cell) for cell in row))
    common.out().print(table)
