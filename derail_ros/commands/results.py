"""The report of ``derail simulate`` for any model: JSON, tables, files."""

from __future__ import annotations

import csv
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from derail_ros.commands import common
from derail_ros.commands.common import FAILED, OK, note
from derail_ros.studies.ensemble import JobResult, Task, ensemble_jobs, run_many
from derail_ros.studies.records import Ensemble, record_of
from derail_ros.studies.tables import Table
from derail_ros.vocabulary.ledger import SMALL_SHARE, percentages, shares
from derail_ros.vocabulary.measures import (
    HEADLINE,
    MEASURES,
    NUMERICS,
    SCHEMA,
    SCHEMA_VERSION,
    Measure,
    Record,
    record_numbers,
    shown_of,
)
from derail_ros.vocabulary.params import PLANAR
from derail_ros.vocabulary.site import site_rows
from derail_ros.vocabulary.status import TIME_LIMIT, VOID
from derail_ros.vocabulary.words import capital, count, force

if TYPE_CHECKING:
    from derail_ros.scenario import Scenario
    from derail_ros.vocabulary.params import TrainParams

REMARKS = {
    VOID: ": the body that stands for the cars behind reached a break; model more cars",
    TIME_LIMIT: ": the run ended at its time limit, not at rest (integration.time_limit_s)",
}
"""Status of a run -> what to know of it."""


def members(
    scenario: Scenario | TrainParams,
    done: int,
    total: int,
    seed: int,
    jobs: int | None,
    task: Task,
    tell: Callable[[JobResult], object],
) -> list[Record]:
    """Records of the members of an ensemble from number ``done`` on; ``tell`` gets each result."""
    runs = islice(ensemble_jobs(scenario, total, seed=seed), done, None)
    found = {}  # records and not outcomes: there may be thousands
    with closing(run_many(runs, jobs=jobs, task=task)) as results:
        for result in results:
            found[result.job.member] = record_of(result, whole=True)
            tell(result)
    return [found[member] for member in sorted(found)]


def report_of(
    scenario: Scenario,
    model: str,
    seed: int | None,
    records: Sequence[Record],
    notes: Mapping[str, Any],
    warnings: Sequence[str] = (),
    limits: Sequence[str] = (),
    inputs: Sequence[Mapping[str, Any]] = (),
) -> Record:
    """The runs of a scenario as plain data; ``seed`` is None for a single run.

    ``limits`` are those of the first run (``vocabulary.limits``), ``inputs`` what each drew.
    """
    found = Ensemble(tuple(records))
    return {
        "schema": SCHEMA,
        "schema_version": SCHEMA_VERSION,
        "scenario": scenario.name,
        "title": scenario.title,
        "hash": scenario.hash,
        "constants": scenario.constants,
        "one_draw": one_draw(scenario),
        "seed": seed,
        "members": len(found),
        "void": found.void,
        "failed": found.failed,
        "outcomes": list(records),
        "mean": found.mean(),
        "sd": found.sd(),
        "site": found.site(),
        "model": model,
        "notes": dict(notes),
        "warnings": [*scenario.warnings, *warnings],
        "limits": list(limits),
        "inputs": list(map(dict, inputs)),
    }


def one_draw(scenario: Scenario) -> str:
    """That a run is one draw, and the band of such accidents; without a run, of the planar model.

    "" where there is nothing to say: a train without a break or a derailed truck.
    """
    from derail_ros.predict.prediction import quick_band

    if scenario.model.model != PLANAR:
        return ""
    return quick_band(scenario.to_params())


def finish(
    report: Record, output: Path | None, as_json: bool, verbose: bool, about: Sequence[str] = ()
) -> int:
    """Print a report and return the exit code. ``about`` are lines for people."""
    if as_json:
        common.print_json("outcome", report)
    else:
        _print(report, output, verbose, about)
    for warning in report["warnings"]:
        note(f"derail: warning: {warning}")
    errors = ((i, r["error"]) for i, r in enumerate(report["outcomes"]) if "error" in r)
    for i, error in errors:
        more = "; make the alignment longer ahead" if error.startswith("TrackEndError") else ""
        note(f"derail: member {i} failed: {error}{more}")
        break
    return FAILED if report["failed"] == report["members"] else OK


# Files -------------------------------------------------------------------------------------


def write(
    output: Path, scenario: Scenario, settings: Sequence[str], report: Record, **more: Any
) -> None:
    """Write outcomes and manifest; ``more`` are entries of the manifest."""
    from derail_ros.recording.manifest import software_versions

    common.write_json(output / "outcomes.json", report)
    if report["members"] > 1:
        write_csv(output / "outcomes.csv", report["outcomes"], report["inputs"])
    common.write_json(
        output / "manifest.json",
        {
            "schema": "derail_ros/results",
            "schema_version": 2,
            "command": "simulate",
            "model": report["model"],
            "scenario": scenario.resolved(),
            "scenario_name": scenario.name,
            "scenario_hash": scenario.hash,
            "settings": list(settings),
            "ensemble": report["members"],
            "seed": report["seed"],
            **more,
            "software": software_versions(),
            "files": sorted(p.name for p in output.iterdir()) + ["manifest.json"],
        },
    )


def write_csv(path: Path, records: Sequence[Record], inputs: Sequence[Record] = ()) -> None:
    """One row per member: what it drew, its measures, lists of cars as their number."""
    rows = []
    drawn = list(dict.fromkeys(name for one in inputs for name in one))
    for i, record in enumerate(records):
        pair = record.get("peak_force_pair")
        rows.append(
            {
                "member": i,
                "status": record.get("status", ""),
                "void": int(bool(record.get("void", False))),
                "error": record.get("error", ""),
                "peak_force_pair": "" if pair is None else f"{pair[0]}-{pair[1]}",
                **({name: inputs[i].get(name, "") for name in drawn}),
                **record_numbers(record),
                **_cars_at(record),
            }
        )
    names = list(dict.fromkeys(name for row in rows for name in row))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, names, restval="")
        writer.writeheader()
        writer.writerows(rows)


def _cars_at(record: Record) -> dict[str, int]:
    """Numbers of cars that entered each area and that struck each fixed body."""
    site = record.get("site") or {"inside": [], "fixed": []}
    return {
        **{f"entered.{e['name']}": len(e["cars_ever"]) for e in site["inside"]},
        **{f"struck.{e['name']}": len(e["struck_by"]) for e in site["fixed"]},
    }


# Tables ------------------------------------------------------------------------------------


def _print(report: Record, output: Path | None, verbose: bool, about: Sequence[str]) -> None:
    from rich.markup import escape

    console = common.out()
    console.print(f"[bold]{escape(report['scenario'])}[/bold]  {escape(report['title'])}")
    groups = (HEADLINE, NUMERICS) if verbose else (HEADLINE,)
    if report["members"] == 1:
        common.print_tables(_one_run(report["outcomes"][0], groups, report["constants"]))
    else:
        common.print_tables(_many_runs(report, groups))
        if any(report["site"].values()):
            common.print_tables(_reached(report["site"]))
        console.print(_counts(report))
    for line in (*(f"{capital(said)}." for said in report["limits"]), *about):
        console.print(escape(line), soft_wrap=True)
    if output is not None:
        which = ""
        if report["members"] > 1:
            which = (
                f": outcomes, final poses and pictures of all {report['members']} runs; "
                "recording, scene and forces of member 0"
            )
        console.print(f"results in {escape(str(output))}{which}", soft_wrap=True)


LEAD = ("cars_derailed", "derailed_cars", "scene_length_m", "scene_width_m", "duration_s")
"""Measures that lead a table of outcomes: they hold best (docs/validation.md)."""


def _ordered(groups: Sequence[str]) -> list[Measure]:
    """The measures of a table, in its order."""
    lead = [MEASURES[key] for key in LEAD]
    return lead + [m for m in MEASURES.values() if m.group in groups and m.key not in LEAD]


def _one_run(record: Record, groups: Sequence[str], constants: str) -> Table:
    if "error" in record:
        return Table(("outcome", ""), [("failed", record["error"])], texts=2)
    rows = [("status", record["status"] + REMARKS.get(record["status"], ""))]
    rows.append(("constants", constants))
    rows.append(("train", record["train"]["text"]))
    if record.get("braked") is False:
        rows.append(("brakes", "never applied"))
    measures = [
        (m.title, shown_of(record, m))
        for m in _ordered(groups)
        if m.everywhere or record.get(m.key) is not None
    ]
    # One row for how many and which.
    rows += [("cars derailed", measures[1][1]), *measures[2 : len(LEAD)]]
    ranked = [(e.words, share) for e, _, share in shares(record.get("energy_J") or {})]
    large = [(words, share) for words, share in ranked if share >= SMALL_SHARE]
    numbers = percentages([share for _, share in large])
    if large:
        parts = (f"{words} {n} %" for (words, _), n in zip(large, numbers))
        rows.append(("stopped by (share of energy)", ",\n".join(parts)))
    if record.get("peak_force_pair"):
        a, b = record["peak_force_pair"]
        hard = f"struck hardest, {force(record['peak_force_N'])} by car {a}"
        rows.append(("car to look at", f"{b}: {hard} at {record['peak_force_time_s']:.2f} s"))
    elif record.get("derailed_cars"):
        rows.append(("car to look at", f"{record['first_derailed']}: the first off the rails"))
    rows += measures[len(LEAD) :]
    if record.get("site"):
        rows += site_rows(record["site"])
    return Table(("outcome", ""), rows, texts=2)


def _many_runs(report: Record, groups: Sequence[str]) -> Table:
    found = Ensemble(tuple(report["outcomes"]))
    first = record_numbers(report["outcomes"][0])
    rows = []
    for m in _ordered(groups):
        if len(found.numbers.get(m.key, ())):
            values = found.distribution(m.key)
            spread = [m.shown_mean(report[k].get(m.key)) for k in ("mean", "sd")]
            ends = [m.shown(_whole(m, values.quantile(q))) for q in (0.0, 0.05, 0.95, 1.0)]
            rows.append((m.title, *spread, *ends, m.shown(first.get(m.key))))
    heads = ("ensemble", "mean", "sd", "least", "5 %", "95 %", "most", "member 0")
    return Table(heads, rows)


def _whole(m: Measure, value: float) -> float:
    """A quantile; of a count a whole number."""
    return round(value) if m.whole and math.isfinite(value) else value


def _reached(site: Record) -> Table:
    """How often cars enter each area and strike each fixed body."""
    rows = []
    for part, key, words in (("inside", "cars_ever", "a car enters"),
                             ("fixed", "struck_by", "a car strikes it")):  # fmt: skip
        for one in site[part]:
            k, n = one[f"runs_{key}"], one["runs"]
            low, high = (100.0 * limit for limit in one[f"interval_{key}"])
            between = f"{low:.0f} to {high:.0f} %"
            if k == 0:
                between = f"below {high:.0f} %"
            elif k == n:
                between = f"above {low:.0f} %"
            rows.append(
                (f"{one['name']}: {words}", f"{k} of {n}", f"{100 * k / n:.0f} %", between)
            )
    return Table(("place", "runs", "share", "90 % interval"), rows)


def _counts(report: Record) -> str:
    """How many runs there were, and which of them did not count."""
    text = f"{count(report['members'], 'run')}, constants {report['constants']}"
    if report["void"]:
        text += f", {report['void']} void and not counted"
    if report["failed"]:
        errors = Counter(
            r["error"].split(" at t = ")[0] for r in report["outcomes"] if "error" in r
        )
        which = "; ".join(f"{n} {error}" for error, n in errors.most_common())
        text += f", {report['failed']} failed and not in the table ({which})"
    beyond = [
        r["beyond_track_m"] for r in report["outcomes"] if r.get("beyond_track_m") is not None
    ]
    if beyond:
        text += (
            f", {len(beyond)} rolled beyond the end of the alignment, by {max(beyond):.0f} m at "
            "most: the track goes on straight there"
        )
    cut_off = sum(r["status"] == TIME_LIMIT for r in report["outcomes"])
    if cut_off:
        text += f", {cut_off} ended at the time limit, not at rest"
    return text
