"""The findings of a study in sentences, and what it cannot tell."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from derail_ros.studies import statistics
from derail_ros.studies.design import LatinHypercube, OneAtATime, Sobol
from derail_ros.studies.results import StudyResults
from derail_ros.studies.study_measures import measure_of
from derail_ros.vocabulary.words import capital, count, joined

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
            found.append((capital(measure_of(measure).words), lines))
    return found


def statements(results: StudyResults) -> list[str]:
    """The findings, each a sentence that names its measure."""
    return [
        f"{heading}: {line}" if heading else line
        for heading, lines in findings(results)
        for line in lines
    ]


def _state(results: StudyResults) -> list[str]:
    found = []
    manifest, table = results.manifest, results.table

    def are(n: int) -> str:
        return "is" if n == 1 else "are"

    if not results.complete:
        found.append(
            f"The study is not finished: {len(table)} of {manifest['runs']} runs "
            f"{are(len(table))} here."
        )
    failed, void = (int((table["status"] == status).sum()) for status in ("failed", "void"))
    if failed:
        found.append(f"{count(failed, 'run')} failed and {are(failed)} left out.")
    if void:
        found.append(
            f"{count(void, 'run')} {are(void)} void (the body that stands for the cars behind "
            "reached a break) and left out."
        )
    if manifest["ensemble"] > 1:
        params = results.study.scenario.to_params()
        if not params.initiation.lateral_forces:
            found.append(
                "The scenario has no lateral force to vary: all runs of a point are the same, and "
                "their intervals mean nothing."
            )
    return found


def shown(measure: str, value: float, more: int = 0) -> str:
    """A value of a measure; a count has a digit after the point."""
    m = measure_of(measure)
    if m.whole and not more and value == int(value):
        return f"{value:.1f}"
    return m.shown(value, more)


def with_unit(measure: str, text: str) -> str:
    """A number with the unit of a measure."""
    m = measure_of(measure)
    return f"{text} {m.shown_unit or m.unit}".rstrip()


def _rows(results: StudyResults, measure: str) -> list[dict[str, Any]]:
    """The effects on a measure."""
    effects = statistics.effects(results)
    return effects[effects["measure"] == measure].to_dict("records") if len(effects) else []


# --- effects ----------------------------------------------------------------------------------


def _ranking(results: StudyResults, measure: str) -> list[str]:
    rows = _rows(results, measure)
    if not rows:
        return []
    if isinstance(results.design, OneAtATime):
        return _changes(results, measure, rows)
    if results.study.model.design == "cases":
        return _extremes(results, measure)
    shares = {r["parameter"]: 100.0 * r["share"] for r in rows}
    named = sorted((n for n in shares if n[0] != "("), key=lambda n: -shares[n])
    parts = [f"{results.study.words(n)} {shares[n]:.0f} %" for n in named]
    if "(interplay)" in shares:
        parts.append(f"their interaction {shares['(interplay)']:.0f} %")
    parts.append(f"chaos (between the runs of one point) {shares['(chaos)']:.0f} %")
    return [f"Shares of the variance of all runs: {joined(parts)}."]


def _changes(results: StudyResults, measure: str, rows: list[dict[str, Any]]) -> list[str]:
    """One at a time: from one end of each parameter to the other, the largest change first."""
    study = results.study
    parts = []
    for row in sorted(rows, key=lambda r: -r["swing"]):
        name = row["parameter"]
        ends = " to ".join(study.value(name, row[key]) for key in ("from", "to"))
        first, last = (shown(measure, row[f"mean_{key}"]) for key in ("from", "to"))
        text = shown(measure, row["change"])
        change = text if text.startswith("-") else f"+{text}"
        half = 0.5 * (row["change_high"] - row["change_low"])
        if math.isfinite(half):
            change += f" \N{PLUS-MINUS SIGN} {shown(measure, half, 1)}"
        last = with_unit(measure, last)
        parts.append(f"{study.words(name)} {ends}: {first} to {last} ({change})")
    return ["By parameter, the largest effect first: " + "; ".join(parts) + "."]


def _extremes(results: StudyResults, measure: str) -> list[str]:
    means = {p: float(v.mean()) for p, v in results.values(measure).items()}
    if len(means) < 2:
        return []

    def at(point: int) -> str:
        return with_unit(measure, shown(measure, means[point]))

    low, high = min(means, key=means.__getitem__), max(means, key=means.__getitem__)
    labels, base = results.labels, results.base
    text = f"Least with {labels[low]} ({at(low)}), most with {labels[high]} ({at(high)})"
    if base is not None and base in means:
        text += f"; {labels[base]}, the base: {at(base)}"
    return [text + "."]


# --- what cannot be told ----------------------------------------------------------------------


def _not_told(results: StudyResults, measure: str) -> list[str]:
    values = results.values(measure)
    if results.manifest["ensemble"] < 2:
        return ["With one run per point, settings cannot be distinguished; set an ensemble."]
    found = []
    for line in statistics.lines(results):
        known = [(v, p) for v, p in zip(line.values, line.points, strict=True) if p in values]
        if not line.numeric:
            known.sort(key=lambda pair: float(values[pair[1]].mean()))
        groups = [values[p] for _, p in known]
        for i, j in statistics.alike(statistics.told_apart(groups)):
            words = [
                v if line.column is None else results.study.value(line.column, v)
                for v, _ in known[i : j + 1]
            ]
            found.append(_cannot(results, measure, line, words, groups[i : j + 1]))
    return found


MOST_NEEDED = 10_000
"""Largest number of runs a point that a sentence names."""


def _cannot(
    results: StudyResults,
    measure: str,
    line: statistics.Line,
    words: list[str],
    groups: list[Any],
) -> str:
    """The sentence about neighbours that cannot be distinguished."""
    study, n = results.study, results.manifest["ensemble"]
    subject = "" if line.column is None else f"{study.words(line.column)} "
    if line.fixed:
        fixed = [f"{study.words(c)} {study.value(c, v)}" for c, v in line.fixed.items()]
        subject = f"at {joined(fixed)}, {subject}"
    listed = joined(words)
    if any("," in w for w in words):
        listed = "; ".join(words[:-1]) + "; and " + words[-1]
    text = capital(f"{subject}{listed} cannot be distinguished with {count(n, 'run')} per point")
    everything = np.concatenate(groups)
    if np.ptp(everything) == 0.0:
        m = measure_of(measure)
        value = f"{everything[0]:.0f}" if m.whole else m.shown(everything[0])
        return f"{text}: every run gives {with_unit(measure, value)}."
    if all(np.array_equal(groups[0], g) for g in groups[1:]):
        return f"{text}: all runs give the same."
    means = [float(g.mean()) for g in groups]
    least, most = int(np.argmin(means)), int(np.argmax(means))
    ends = " to ".join(shown(measure, means[i], 1) for i in (least, most))
    text += f" (means {with_unit(measure, ends)}"
    needed = statistics.runs_needed(groups[least], groups[most])
    if needed is not None and needed > MOST_NEEDED:
        text += f"; more than {MOST_NEEDED} runs per point would be needed"
    elif needed is not None and needed > n:
        # two digits are all that such an estimate has
        rounded = int(round(needed, -max(0, len(str(needed)) - 2)))
        text += f"; about {rounded} runs per point would be needed"
    return text + ")."


# --- designs that draw their points -----------------------------------------------------------


def _latin(results: StudyResults, measure: str) -> list[str]:
    words = results.study.words
    rows = [r for r in _rows(results, measure) if math.isfinite(r["rank_correlation"])]
    rows.sort(key=lambda r: -abs(r["rank_correlation"]))
    sure = [r for r in rows if r["low"] > 0.0 or r["high"] < 0.0]
    found = []
    if sure:
        parts = [
            f"{words(r['parameter'])} {r['rank_correlation']:+.2f} "
            f"({r['low']:+.2f} to {r['high']:+.2f})"
            for r in sure
        ]
        found.append(f"Rank correlations: {joined(parts)}.")
    unsure = [words(r["parameter"]) for r in rows if r not in sure]
    if unsure:
        found.append(
            f"No significant effect of {joined(unsure)} at {results.manifest['points']} points."
        )
    return found


def _sobol(results: StudyResults, measure: str) -> list[str]:
    rows = _rows(results, measure)
    if not rows:
        return ["No Sobol indices: too few runs, or all give the same."]
    words = results.study.words
    found = []
    if left := int(rows[0]["left_out"]):
        found.append(f"{left} base points with failed or void runs are left out.")
    single = [r for r in rows if math.isfinite(r["S1"])]
    single.sort(key=lambda r: -r["ST"])

    def half(row: dict[str, Any], key: str) -> str:
        width = 0.5 * (row[f"{key}_high"] - row[f"{key}_low"])
        return f"{row[key]:.2f} \N{PLUS-MINUS SIGN} {width:.2f}"

    parts = [
        f"{words(r['parameter'])} in all {half(r, 'ST')}, alone {half(r, 'S1')}" for r in single
    ]
    found.append(f"Sobol indices: {'; '.join(parts)}.")
    for a, b in zip(single, single[1:], strict=False):
        if b["ST_high"] >= a["ST_low"]:
            found.append(
                f"{capital(words(a['parameter']))} and {words(b['parameter'])} cannot be ranked "
                f"with {a['base_points']} base points: the intervals of their total indices "
                "overlap."
            )
    chaos = _of(rows, "(chaos)")
    if chaos is not None:
        found.append(
            f"Chaos (between the runs of one point) makes about {100.0 * chaos['ST']:.0f} % "
            "of the variance between points, and is part of every total index."
        )
    return found


def _of(rows: Iterable[dict[str, Any]], parameter: str) -> dict[str, Any] | None:
    return next((r for r in rows if r["parameter"] == parameter), None)
