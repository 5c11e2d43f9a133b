"""``python -m research NAME``: write a page of the documentation and its figures anew."""

from __future__ import annotations

import argparse
import importlib
import sys
from pathlib import Path

from derail_ros.commands.common import CommandFailure
from derail_ros.scenario import ScenarioError
from research.pages import DOCS, Options

PAGES = {
    "validation": "comparison with the published runs",
    "sensitivity": "what the reconstructed constants do",
    "spread": "distributions of outcomes; NAMES: other scenarios",
    "convergence": "ensembles at several tolerances",
    "spatial": "the engine in three dimensions; NAMES: only these cases",
    "baselines": "the earlier models beside this one",
    "accidents": "reported accidents; NAMES: files of accident reports (CSV, FRA form 54)",
    "bank": "no page: runs for calibration; NAMES: files of accident reports; --results",
    "calibration": "calibrated constants and scores; NAMES: files of accident reports; --results",
    "engine_scores": "scores by runs of the engine; NAMES: files of accident reports; --results",
    "trains": "the investigated trains that ship, in docs/accidents.md; NAMES: only these",
    "studies": "the studies that ship; NAMES: only these",
    "site": "walls, soft ground, placement and limits; NAMES: only these",
    "scenarios": "fields, units, shipped scenarios and rolling stock of the scenario format",
    "parameters": "parameters and topics of the nodes; config/simulator.yaml too",
    "screenshots": "pictures of a final scene and of the replay page",
}
"""Name of a page, which is also the name of its module -> what it shows."""


OF_REPORTS = ("accidents", "bank", "calibration", "engine_scores")
"""What reads files of accident reports."""

PARTS = {"trains": "accidents", "calibration": "prediction", "engine_scores": "prediction"}
"""Part of a page -> that page."""


def parser() -> argparse.ArgumentParser:
    """The options."""
    listed = "\n".join(f"  {name:13} {words}" for name, words in PAGES.items())
    parser = argparse.ArgumentParser(
        "python -m research",
        description=f"Write a page of the documentation and its figures anew.\n\n{listed}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("page", nargs="?", choices=[*PAGES, "all"], metavar="PAGE")
    parser.add_argument("names", nargs="*", help="see above")
    parser.add_argument("--list", action="store_true", help="print the names of the pages")
    parser.add_argument("-n", "--ensemble", type=int, help="runs each")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-j", "--jobs", type=int, help="runs at a time; one per core by default")
    parser.add_argument("--to", type=Path, help="the page; docs/PAGE.md by default")
    parser.add_argument("--results", type=Path, help="studies: results that are there: DIR/NAME")
    parser.add_argument(
        "--check", action="store_true", help="calibration: compare this engine with the bank's"
    )
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Write pages; the exit code."""
    given = parser().parse_args(arguments)
    if given.list or given.page is None:
        print("\n".join(PAGES))
        return 0
    names = PAGES if given.page == "all" else [given.page]
    for name in names:
        if given.page == "all" and name in OF_REPORTS and not given.names:
            print(f"{name}: left out, no files of accident reports are named", file=sys.stderr)
            continue
        extra = given.names if given.page != "all" or name in OF_REPORTS else []
        options = Options(
            page=given.to or DOCS / f"{PARTS.get(name, name)}.md",
            names=tuple(extra),
            members=given.ensemble,
            seed=given.seed,
            jobs=given.jobs,
            results=given.results,
            check=given.check,
        )
        try:
            importlib.import_module(f"research.{name}").write(options)
        except (CommandFailure, ScenarioError) as error:
            print(f"research {name}: {error}", file=sys.stderr)
            return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
