"""What a study says in plain sentences, first of all where it cannot tell."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from derail_ros.studies import statistics
from derail_ros.studies.design import LatinHypercube, OneAtATime, Sobol
from derail_ros.studies.measures import MEASURES, shown
from derail_ros.studies.plan import shown_value
from derail_ros.vocabulary.words import count

if TYPE_CHECKING:
    from derail_ros.studies.results import StudyResults


Findings = list[tuple[str, list[str]]]


def findings(results: StudyResults) -> Findings:
    """The findings of a study: first what is amiss, then sentences for each of its measures."""
    design = results.design
    found: Findings = []
    if state := _state(results):
        found.append(("", state))
    for measure in results.measures:
        if isinstance(design, Sobol):
            lines = _sobol(results, measure)
        elif isinstance(design, LatinHypercube):
            lines = _latin(results, measure)
        else:
            lines = _ranking(results, measure) + _not_told(results, measure)
        if lines:
            found.append((_title(measure), lines))
    return found


def _state(results: StudyResults) -> list[str]:
    found = []
    manifest = results.manifest
    if not results.complete:
        found.append(
            f"The study is not finished: {len(results.table)} of {manifest['runs']} runs "
            f"{_are(len(results.table))} here."
        )
    failed = int((results.table["status"] == "failed").sum())
    void = int((results.table["status"] == "void").sum())
    if failed:
        found.append(f"{count(failed, 'run')} failed and {_are(failed)} left out.")
    if void:
        found.append(
            f"{count(void, 'run')} {_are(void)} void (the body that stands for the cars behind "
            "reached a break) and left out."
        )
    if manifest["ensemble"] > 1 and not _varies(results):
        found.append(
            "The scenario has no lateral force to vary: the runs of a point are all the same, "
            "and their intervals say nothing."
        )
    return found


def _are(n: int) -> str:
    return "is" if n == 1 else "are"


def _varies(results: StudyResults) -> bool:
    return bool(results.study.scenario.to_params().initiation.lateral_forces)


def _and(words: Sequence[str]) -> str:
    words = list(words)
    return words[0] if len(words) == 1 else ", ".join(words[:-1]) + " and " + words[-1]


def _title(measure: str) -> str:
    label = MEASURES[measure].label
    return label[0].upper() + label[1:]


def _number(measure: str, value: float) -> str:
    unit = MEASURES[measure].unit
    return shown(measure, value) + (f" {unit}" if unit else "")


def _at(results: StudyResults, column: str, value: Any) -> str:
    owner = results.study.model.parameters.get(column) or results.study.model.columns.get(column)
    unit = f" {owner.unit}" if owner is not None and owner.unit else ""
    return f"{shown_value(_plain(value))}{unit}"


def _plain(value: Any) -> Any:
    return value.item() if hasattr(value, "item") else value


def _name(results: StudyResults, column: str) -> str:
    owner = results.study.model.parameters.get(column) or results.study.model.columns.get(column)
    return (owner.label if owner is not None else None) or column.replace("_", " ")


# --- what matters -----------------------------------------------------------------------------


def _ranking(results: StudyResults, measure: str) -> list[str]:
    effects = results.effects()
    if not len(effects):
        return []
    rows = effects[effects["measure"] == measure].to_dict("records")
    if not rows:
        return []
    if isinstance(results.design, OneAtATime):
        return _changes(results, measure, rows)
    if results.study.model.design == "cases":
        return _extremes(results, measure)
    shares = {r["parameter"]: 100.0 * r["share"] for r in rows}
    named = sorted((n for n in shares if n[0] != "("), key=lambda n: -shares[n])
    parts = [f"{_name(results, n)} {shares[n]:.0f} %" for n in named]
    if "(interplay)" in shares:
        parts.append(f"their interplay {shares['(interplay)']:.0f} %")
    parts.append(f"chaos (runs of one point among themselves) {shares['(chaos)']:.0f} %")
    return [f"Shares of the variance of all runs: {_and(parts)}."]


def _changes(results: StudyResults, measure: str, rows: list[dict[str, Any]]) -> list[str]:
    """One at a time: from one end of each parameter to the other, the largest change first."""
    rows = sorted(rows, key=lambda r: -r["swing"])
    parts = []
    for row in rows:
        name = row["parameter"]
        ends = f"{_at(results, name, row['from'])} to {_at(results, name, row['to'])}"
        means = f"{shown(measure, row['mean_from'])} to {_number(measure, row['mean_to'])}"
        change = _signed(measure, row["change"])
        half = 0.5 * (row["change_high"] - row["change_low"])
        if math.isfinite(half):
            change += f" \N{PLUS-MINUS SIGN} {shown(measure, half, 1)}"
        parts.append(f"{_name(results, name)} {ends}: {means} ({change})")
    return ["By parameter, the largest effect first: " + "; ".join(parts) + "."]


def _extremes(results: StudyResults, measure: str) -> list[str]:
    values = statistics.point_values(results, measure)
    means = {p: float(v.mean()) for p, v in values.items()}
    if len(means) < 2:
        return []
    low, high = min(means, key=means.__getitem__), max(means, key=means.__getitem__)
    text = (
        f"Least with {results.labels[low]} ({_number(measure, means[low])}), most with "
        f"{results.labels[high]} ({_number(measure, means[high])})"
    )
    base = results.base
    if base is not None and base in means:
        text += f"; {results.labels[base]}, the base: {_number(measure, means[base])}"
    return [text + "."]


def _signed(measure: str, value: float) -> str:
    text = shown(measure, value)
    return text if text.startswith("-") else f"+{text}"


# --- what cannot be told ----------------------------------------------------------------------


def _not_told(results: StudyResults, measure: str) -> list[str]:
    values = statistics.point_values(results, measure)
    if results.manifest["ensemble"] < 2:
        return ["With one run a point no two settings can be told apart; give an ensemble."]
    found = []
    for line in statistics.lines(results):
        known = [(v, p) for v, p in zip(line.values, line.points, strict=True) if p in values]
        numeric = all(isinstance(v, (int, float, np.number)) for v, _ in known)
        if not numeric:
            known.sort(key=lambda pair: float(values[pair[1]].mean()))
        groups = [values[p] for _, p in known]
        for i, j in statistics.alike(statistics.told_apart(groups)):
            words = [
                v if line.column is None else _at(results, line.column, v)
                for v, _ in known[i : j + 1]
            ]
            found.append(_cannot(results, measure, line, words, groups[i : j + 1]))
    return found


MOST_NEEDED = 10_000


def _round(n: int) -> int:
    """Two digits are all that such an estimate has."""
    digits = max(0, len(str(n)) - 2)
    return int(round(n, -digits))


def _cannot(
    results: StudyResults,
    measure: str,
    line: statistics.Line,
    words: list[str],
    groups: list[Any],
) -> str:
    """The sentence about neighbours of which no two can be told apart."""
    n = results.manifest["ensemble"]
    subject = "" if line.column is None else f"{_name(results, line.column)} "
    if line.fixed:
        fixed = [f"{_name(results, c)} {_at(results, c, v)}" for c, v in line.fixed.items()]
        subject = f"at {_and(fixed)}, {subject}"
    between = "; " if any("," in w for w in words) else ", "
    listed = between.join(words[:-1]) + (between + "and " if between == "; " else " and ")
    text = f"{subject}{listed}{words[-1]} cannot be told apart at {count(n, 'run')} a point"
    text = text[0].upper() + text[1:]
    everything = np.concatenate(groups)
    if np.ptp(everything) == 0.0:
        value = _number(measure, everything[0])
        if MEASURES[measure].whole:
            value = f"{everything[0]:.0f}"
        return f"{text}: every run gives {value}."
    if all(np.array_equal(groups[0], g) for g in groups[1:]):
        return f"{text}: run by run they give the same."
    means = [float(g.mean()) for g in groups]
    least, most = int(np.argmin(means)), int(np.argmax(means))
    unit = MEASURES[measure].unit
    text += f" (means {shown(measure, means[least], 1)} to {shown(measure, means[most], 1)}"
    text += f" {unit}" if unit else ""
    needed = statistics.runs_needed(groups[least], groups[most])
    if needed is not None and needed > MOST_NEEDED:
        text += "; no ensemble that one would compute tells a difference so small"
    elif needed is not None and needed > n:
        text += f"; a difference as large as that would take about {_round(needed)} runs a point"
    return text + ")."


# --- designs that draw their points -----------------------------------------------------------


def _latin(results: StudyResults, measure: str) -> list[str]:
    effects = results.effects()
    rows = effects[effects["measure"] == measure].to_dict("records") if len(effects) else []
    rows = [r for r in rows if math.isfinite(r["rank_correlation"])]
    rows.sort(key=lambda r: -abs(r["rank_correlation"]))
    sure = [r for r in rows if r["low"] > 0.0 or r["high"] < 0.0]
    found = []
    if sure:
        parts = [
            f"{_name(results, r['parameter'])} {r['rank_correlation']:+.2f} "
            f"({r['low']:+.2f} to {r['high']:+.2f})"
            for r in sure
        ]
        found.append(f"Rank correlations: {_and(parts)}.")
    unsure = [_name(results, r["parameter"]) for r in rows if r not in sure]
    if unsure:
        found.append(
            f"No effect of {_and(unsure)} can be told from none at "
            f"{results.manifest['points']} points."
        )
    return found


def _sobol(results: StudyResults, measure: str) -> list[str]:
    table = results.sobol()
    rows = table[table["measure"] == measure] if len(table) else table
    if not len(rows):
        return ["No Sobol indices: too few runs, or all of them give the same."]
    found = []
    if left := int(rows["left_out"].iloc[0]):
        found.append(f"{left} base points with failed or void runs are left out.")
    single = rows[rows["S1"].notna()].sort_values("ST", ascending=False, kind="stable")
    records = single.to_dict("records")

    def half(row: dict[str, Any], key: str) -> str:
        width = 0.5 * (row[f"{key}_high"] - row[f"{key}_low"])
        return f"{row[key]:.2f} \N{PLUS-MINUS SIGN} {width:.2f}"

    parts = [
        f"{_name(results, r['parameter'])} in all {half(r, 'ST')}, alone {half(r, 'S1')}"
        for r in records
    ]
    found.append(f"Sobol indices: {'; '.join(parts)}.")
    for a, b in zip(records, records[1:], strict=False):
        if b["ST_high"] >= a["ST_low"]:
            found.append(
                f"{_name(results, a['parameter'])} and {_name(results, b['parameter'])} cannot be "
                f"ranked with {a['base_points']} base points: the intervals of their total "
                "indices overlap."
            )
    chaos = rows[rows["parameter"] == "(chaos)"]
    if len(chaos):
        share = 100.0 * float(chaos["ST"].iloc[0])
        found.append(
            f"Chaos (runs of one point among themselves) makes about {share:.0f} % of the "
            "variance between points, and is part of every total index."
        )
    return [line[0].upper() + line[1:] for line in found]
