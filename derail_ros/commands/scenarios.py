"""``derail scenarios``: what can be simulated by name."""

from __future__ import annotations

from derail_ros.commands.common import OK, out, print_json


def run(as_json: bool) -> int:
    """List the scenarios."""
    from derail_ros.scenario import list_scenarios

    scenarios = list_scenarios()
    if as_json:
        print_json({"scenarios": [{"name": s.name, "title": s.title} for s in scenarios]})
        return OK
    from rich.markup import escape
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    table.add_column("name", style="bold", no_wrap=True)
    table.add_column("title")
    for scenario in scenarios:
        table.add_row(escape(scenario.name), escape(scenario.title))
    out().print(table)
    return OK
