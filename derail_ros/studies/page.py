"""The page of a study: figures, findings and tables in one self-contained HTML file.

No scripts, no requests: the content security policy allows inline pictures and the one style
sheet, by its hash. Whatever comes from a study's file is escaped. Every figure has a text for a
reader who cannot see it, and its numbers stand in tables.
"""

from __future__ import annotations

import base64
import hashlib
import io
import math
from collections.abc import Mapping, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from derail_ros.review.drawing import save
from derail_ros.studies import plots, statistics
from derail_ros.studies.plan import shown_value
from derail_ros.studies.results import StudyResults
from derail_ros.studies.sentences import findings, shown
from derail_ros.studies.study_measures import measure_of
from derail_ros.studies.tables import Table

if TYPE_CHECKING:
    import pandas

    from derail_ros.studies.plots import Drawn

DPI = 110

MOST_ROWS = 400
"""Longest table on the page; the CSV files are whole."""


def write_report(results: StudyResults, folder: Path) -> Path:
    """Write ``report.html``, the figures and the tables as CSV into a folder; the page's path."""
    folder.mkdir(parents=True, exist_ok=True)
    drawn = plots.draw(results)
    for d in drawn:
        save(d.figure, folder / f"{d.name}.png", dpi=DPI)
    tables = {
        "runs.csv": results.table,
        "summary.csv": statistics.summary(results),
        "counts.csv": statistics.counts(results),
        "effects.csv": statistics.effects(results),
    }
    for name, table in tables.items():
        table.to_csv(folder / name, index=False, lineterminator="\n")
    page = folder / "report.html"
    page.write_text(html(results, drawn), encoding="utf-8")
    return page


# --- tables -----------------------------------------------------------------------------------


def records(table: pandas.DataFrame) -> list[dict[str, Any]]:
    """A table as plain data; what is not a finite number is None."""
    return [{k: _plain(v) for k, v in row.items()} for row in table.to_dict("records")]


def _plain(value: Any) -> Any:
    value = value.item() if hasattr(value, "item") else value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if isinstance(value, (bool, int, str)) else None


def mean_table(results: StudyResults, measure: str, most: int) -> Table:
    """The means of a measure with their uncertainty, of so many points at most."""
    study = results.study
    summary = statistics.summary(results)
    relative = "relative" in summary
    one = study.model.design == "one_at_a_time"
    names = [] if one else list(results.design.columns)
    rows = []
    for row in summary[summary["measure"] == measure].to_dict("records")[:most]:
        point = [results.labels[row["point"]]] if one else [shown_value(row[n]) for n in names]
        rows.append([*point, *_mean_cells(measure, row, relative)])
    heads = ["point"] if one else [study.label(n) for n in names]
    more = ["runs", "mean (95 % interval)", "sd", "5 to 95 % of runs"]
    if relative:
        more.append("relative to the base")
    title = results.manifest["measures"][measure]
    return Table([*heads, *more], rows, title, texts=len(heads))


def _mean_cells(measure: str, row: Mapping[str, Any], relative: bool) -> list[str]:
    """Number of runs, mean with its interval, spread, quantiles, relative."""

    def text(name: str, more: int = 0) -> str:
        value = _plain(row[name])
        return "-" if value is None else shown(measure, float(value), more)

    def between(low: str, high: str) -> str:
        return "-" if "-" in (low, high) else f"{low} to {high}"

    n = str(row["n"]) if row["n"] == row["runs"] else f"{row['n']} of {row['runs']}"
    mean, interval = text("mean", 1), between(text("mean_low", 1), text("mean_high", 1))
    if interval != "-":
        mean += f" ({interval})"
    cells = [n, mean, text("sd", 1), between(text("q05"), text("q95"))]
    if relative:
        values = [_plain(row[f"relative{end}"]) for end in ("", "_low", "_high")]
        known = ["-" if v is None else f"{v:.2f}" for v in values]
        own = values[1] is None or values[1] == values[0]  # the base itself
        cells.append(known[0] if own else f"{known[0]} ({known[1]} to {known[2]})")
    return cells


EFFECTS = {
    "sobol": "Sobol indices",
    "latin_hypercube": "Rank correlations",
    "one_at_a_time": "Effects",
}
"""What effects are called, by design; shares of the variance in the others."""

HEADS = {
    "mean_from": "mean there",
    "mean_base": "mean at the base",
    "mean_to": "mean there",
    "change_low": "change, low",
    "change_high": "change, high",
    "relative_swing": "largest less least, of the base",
    "swing": "largest less least",
    "share": "share of the variance",
    "at_least": "at",
    "at_largest": "at",
}
"""Headings of columns of effects that are not their names."""


SCALED = ("mean", "change", "swing", "least_mean", "largest_mean")
"""Columns of effects in the unit of their measure."""


def effect_table(results: StudyResults) -> Table:
    """The effects by measure and parameter."""
    table = statistics.effects(results)
    names = ["measure", "parameter", *(c for c in table if c not in ("measure", "parameter"))]
    rows = []
    for row in records(table)[:MOST_ROWS]:
        cells = [measure_of(row["measure"]).title, row["parameter"].replace("_", " ")]
        scale = measure_of(row["measure"]).scale
        for name in names[2:]:
            value = row[name]
            if isinstance(value, float):
                value *= scale if name.startswith(SCALED) else 1.0
                value = f"{value:.3g}" if abs(value) < 1e4 else f"{value:.0f}"
            cells.append("-" if value is None else str(value))
        rows.append(cells)
    heads = [HEADS.get(name, name.replace("_", " ")) for name in names]
    return Table(heads, rows, "By measure and parameter", texts=2)


# --- the page ---------------------------------------------------------------------------------


def html(results: StudyResults, drawn: Sequence[Drawn]) -> str:
    """The page."""
    manifest = results.manifest
    style = (files("derail_ros.studies") / "data" / "report.css").read_text("utf-8").strip()
    digest = base64.b64encode(hashlib.sha256(style.encode()).digest()).decode()
    policy = (
        f"default-src 'none'; img-src data:; style-src 'sha256-{digest}'; "
        "base-uri 'none'; form-action 'none'"
    )
    description = results.study.model.description
    effects = EFFECTS.get(results.study.model.design, "Shares of the variance")
    sections = [
        ("findings", "What it says", _findings(results)),
        *((f"figure-{d.name}", d.title, _picture(d)) for d in drawn),
        ("means", "Means with their uncertainty", _means(results)),
        ("effects", effects, _effects(results)),
        ("about", "How it was made", _about(results)),
    ]
    links = "".join(f'<li><a href="#{i}">{escape(t)}</a></li>' for i, t, _ in sections)
    body = "".join(
        f'<section aria-labelledby="{i}"><h2 id="{i}">{escape(t)}</h2>{text}</section>\n'
        for i, t, text in sections
    )
    title = escape(manifest["title"])
    return (
        "<!DOCTYPE html>\n"
        '<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="referrer" content="no-referrer">\n'
        f"<title>{title}</title>\n<style>{style}</style>\n</head>\n<body>\n"
        '<a class="skip" href="#main">To the findings</a>\n'
        f'<header><h1>{title}</h1><p class="size">{escape(manifest["size"])}'
        f"{'' if results.complete else ', unfinished'}</p>"
        f"{f'<p>{escape(description)}</p>' if description else ''}"
        f'<nav aria-label="Contents"><ul>{links}</ul></nav></header>\n'
        f'<main id="main" tabindex="-1">\n{body}</main>\n'
        f"<footer>derail_ros {escape(manifest['software']['derail_ros'])}. Results are for "
        "research and teaching, not for operational or regulatory decisions.</footer>\n"
        "</body>\n</html>\n"
    )


def _findings(results: StudyResults) -> str:
    parts = []
    for heading, lines in findings(results):
        items = "".join(f"<li>{escape(line)}</li>" for line in lines)
        parts.append(f"{f'<h3>{escape(heading)}</h3>' if heading else ''}<ul>{items}</ul>")
    return "".join(parts)


def _picture(drawn: Drawn) -> str:
    buffer = io.BytesIO()
    drawn.figure.savefig(buffer, format="png", dpi=DPI, metadata={"Software": "derail_ros"})
    data = base64.b64encode(buffer.getvalue()).decode()
    width, height = (round(v * DPI) for v in drawn.figure.get_size_inches())
    return (
        f'<figure><img src="data:image/png;base64,{data}" width="{width}" height="{height}" '
        f'alt="{escape(drawn.alt)}"><figcaption>{escape(drawn.caption)}</figcaption></figure>'
    )


def _means(results: StudyResults) -> str:
    parts = [
        "<p>Intervals of means are 95 % intervals (Student's t); beside them the standard "
        "deviation of single runs and the quantiles 5 and 95 %. Runs that failed or are void are "
        "left out.</p>"
    ]
    n = len(results.first)
    for k, measure in enumerate(results.measures):
        table = mean_table(results, measure, MOST_ROWS)
        more = f"<p>The first {MOST_ROWS} of {n} points; all are in summary.csv.</p>"
        state = " open" if k == 0 and n <= 40 else ""
        parts.append(
            f"<details{state}><summary>{escape(table.title)}</summary>{table.html()}"
            f"{more if n > MOST_ROWS else ''}</details>"
        )
    return "".join(parts)


def _effects(results: StudyResults) -> str:
    if not len(statistics.effects(results)):
        return "<p>None: nothing varies.</p>"
    return effect_table(results).html()


def _about(results: StudyResults) -> str:
    manifest = results.manifest
    software = manifest["software"]
    entries = {
        "study": manifest["name"],
        "base scenario": f"{manifest['scenario_name']} (SHA-256 {manifest['scenario_hash'][:16]})",
        "runs": manifest["size"],
        "variation of the lateral force": f"+/- {100 * manifest['variation']:g} %, seed "
        f"{manifest['seed']}; member 0 is the point itself",
        "computed": f"{manifest['started']} to {manifest.get('finished', 'now')}, "
        f"{manifest['wall_s']:.0f} s",
        "software": f"derail_ros {software['derail_ros']}, engine "
        f"{software['engine_hash'][:16]}, Python {software['python']}",
        "files": "runs.csv (a row for each run), summary.csv, counts.csv, effects.csv",
    }
    items = "".join(f"<dt>{escape(k)}</dt><dd>{escape(v)}</dd>" for k, v in entries.items())
    return f"<dl>{items}</dl>"
