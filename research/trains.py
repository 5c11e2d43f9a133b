"""The investigated trains in ``docs/accidents.md``: reported and computed side by side."""

from __future__ import annotations

from derail_ros.commands import common
from derail_ros.commands.common import CommandFailure, counting_runs
from derail_ros.models import engine_hash
from derail_ros.studies.ensemble import ensemble_jobs
from derail_ros.studies.records import Ensemble, ensembles
from derail_ros.studies.tables import Table
from derail_ros.vocabulary.words import number_list
from research.pages import Options, fill, with_places

REPORTED = {
    "dublin_2015": "21: the 11th to the 31st car",
    "minot_2002": "31, from the 4th car on",
    "nickel_lake_2013": "40 in two groups, 12 and 28",
    "waterfall_2011": "11 cars of several platforms",
    "avondale_2010": "15",
    "dugald_2009": "none",
    "brighton_2009": "6, by compression",
    "macmillan_yard_2019": "9, the 26th to the 34th car, to the inside",
}
"""Scenario -> cars derailed, as the summary of the investigation has them."""


def write(options: Options) -> None:
    """Run the trains and write their table into the page."""
    names = options.names or tuple(REPORTED)
    if unknown := [name for name in names if name not in REPORTED]:
        raise CommandFailure(f"{', '.join(unknown)}: none of {', '.join(REPORTED)}")
    text = with_places(options.page, ["trains"])
    members = options.members or 10
    rows = []
    for name in names:
        scenario = common.load(name)
        params = scenario.to_params()
        # without a force to vary all runs are the same
        n = members if params.initiation.lateral_forces else 1
        with counting_runs(name) as progress:
            jobs = ensemble_jobs(params, n, seed=options.seed)
            (found,) = ensembles(jobs, jobs=options.jobs, progress=progress).values()
        ahead = next(i for i, car in enumerate(params.cars) if not car.locomotives)
        rows.append((f"`{name}`", REPORTED[name], *_computed(found, ahead), str(n)))
    about = (
        "<sub>`python -m research trains`: runs with the force that starts the motion changed by "
        f"at most 4 %, seed {options.seed}. Cars are counted behind the leading locomotives, "
        "those within the train among them; a platform of an articulated car is a car. "
        f"Engine {engine_hash()[:16]}.</sub>"
    )
    heads = ("train", "reported", "computed, mean and range", "in the first run", "runs")
    table = Table(heads, rows, texts=4)
    options.write(fill(text, {"trains": f"{about}\n\n{table.markdown()}"}), {})


def _computed(found: Ensemble, ahead: int) -> tuple[str, str]:
    """Cars derailed: mean and range of the runs, and which in the first one."""
    counts = [len(r["derailed_cars"]) for r in found.records if "error" not in r]
    if not counts:
        return "failed", ""
    mean = sum(counts) / len(counts)
    spread = f" ({min(counts)} to {max(counts)})" if min(counts) < max(counts) else ""
    cars = [car - ahead for car in found.records[0]["derailed_cars"]]
    return f"{mean:.1f}{spread}" if spread else f"{counts[0]}", number_list(cars)
