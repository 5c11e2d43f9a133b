"""The page of a study: figures, findings and tables in one HTML file that needs nothing else.

No scripts, no requests: the content security policy allows inline pictures and the one style
sheet, by its hash. Whatever comes from a study's file is escaped. Every figure has a text for who
cannot see it, and its numbers stand in tables.
"""

from __future__ import annotations

import base64
import hashlib
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from derail_ros.studies.measures import MEASURES, shown
from derail_ros.studies.plan import shown_value

if TYPE_CHECKING:
    import pandas

    from derail_ros.studies.plots import Drawn
    from derail_ros.studies.results import StudyResults

DPI = 110

STYLE = """
:root { color-scheme: light; --ink: #222; --soft: #555; --line: #d5d9de; --link: #00538a; }
* { box-sizing: border-box; }
body { margin: 0; color: var(--ink); background: #fff; line-height: 1.5;
  font-family: system-ui, "Segoe UI", "DejaVu Sans", sans-serif; }
header, main, footer { max-width: 64rem; margin: 0 auto; padding: 0 1.25rem; }
header { padding-top: 2rem; }
h1 { font-size: 1.7rem; line-height: 1.25; margin: 0 0 .5rem; }
h3 { font-size: 1rem; margin: 1.2rem 0 .2rem; }
h2 { font-size: 1.25rem; margin: 2.5rem 0 .75rem; padding-top: .75rem;
  border-top: 1px solid var(--line); }
p, li { max-width: 48rem; }
li { margin: .3rem 0; overflow-wrap: anywhere; }
a { color: var(--link); }
a:focus-visible, summary:focus-visible, .scroll:focus-visible {
  outline: 3px solid #d55e00; outline-offset: 2px; }
.skip { position: absolute; left: -100rem; }
.skip:focus { left: 1rem; top: .5rem; background: #fff; padding: .4rem .8rem; }
.size { color: var(--soft); margin: 0; }
nav ul { padding: 0; list-style: none; display: flex; flex-wrap: wrap; gap: .25rem 1.25rem; }
figure { margin: 1rem 0; }
figure img { max-width: 100%; height: auto; display: block; }
figcaption { color: var(--soft); font-size: .92rem; max-width: 48rem; margin-top: .4rem; }
.scroll { overflow-x: auto; margin: .75rem 0; }
table { border-collapse: collapse; font-size: .88rem; font-variant-numeric: tabular-nums; }
caption { text-align: left; font-weight: 600; padding: .4rem 0; white-space: nowrap; }
th, td { padding: .22rem .7rem .22rem 0; text-align: right; white-space: nowrap;
  border-bottom: 1px solid #eceff2; }
th.text, td.text { text-align: left; }
thead th { border-bottom: 2px solid var(--line); vertical-align: bottom; }
tbody th { font-weight: 400; }
details { margin: .6rem 0; }
summary { cursor: pointer; font-weight: 600; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .2rem 1.25rem;
  font-size: .92rem; }
dt { color: var(--soft); }
dd { margin: 0; overflow-wrap: anywhere; }
footer { color: var(--soft); font-size: .88rem; padding: 1.5rem 1.25rem 2.5rem; }
@media print { details { display: block; } .skip, nav { display: none; } }
""".strip()

MOST_ROWS = 400
"""Longest table on the page; the CSV files are whole."""


def write_report(results: StudyResults, folder: Path) -> Path:
    """Write ``report.html``, the figures and the tables as CSV into a folder; the page's path."""
    from derail_ros.review.drawing import save
    from derail_ros.studies import plots

    folder.mkdir(parents=True, exist_ok=True)
    drawn = plots.draw(results)
    for d in drawn:
        save(d.figure, folder / f"{d.name}.png", dpi=DPI)
    tables = {
        "runs.csv": results.table,
        "summary.csv": results.summary(),
        "counts.csv": results.counts(),
        "effects.csv": results.effects(),
    }
    for name, table in tables.items():
        table.to_csv(folder / name, index=False, lineterminator="\n")
    page = folder / "report.html"
    page.write_text(html(results, drawn), encoding="utf-8")
    return page


def records(table: pandas.DataFrame) -> list[dict[str, Any]]:
    """A table as plain data; what is not a finite number is None."""
    return [{k: _plain(v) for k, v in row.items()} for row in table.to_dict("records")]


def _plain(value: Any) -> Any:
    value = value.item() if hasattr(value, "item") else value
    if isinstance(value, (bool, int, str)):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return None


def point_cells(results: StudyResults, row: Mapping[str, Any]) -> list[str]:
    """What a point is: its label one at a time, else its values in the parameters."""
    if results.study.model.design == "one_at_a_time":
        return [results.labels[int(row["point"])]]
    return [shown_value(_plain(row[name])) for name in results.design.columns]


def point_heads(results: StudyResults) -> list[str]:
    """Headings of :func:`point_cells`."""
    if results.study.model.design == "one_at_a_time":
        return ["point"]
    return [results.study.label(name) for name in results.design.columns]


def interval(measure: str, row: Mapping[str, Any]) -> list[str]:
    """Number of runs, mean with its interval, spread, quantiles, relative: a row of a table."""

    def known(name: str) -> float | None:
        value = _plain(row.get(name))
        return None if value is None else float(value)

    n = str(row["n"])
    if row["n"] < row["runs"]:
        n = f"{row['n']} of {row['runs']}"
    mean = shown(measure, known("mean"), 1)
    if known("mean_low") is not None:
        low, high = (shown(measure, known(k), 1) for k in ("mean_low", "mean_high"))
        mean += f" ({low} to {high})"
    cells = [n, mean, shown(measure, known("sd"), 1)]
    low, high = shown(measure, known("q05")), shown(measure, known("q95"))
    cells.append("-" if low == "-" else f"{low} to {high}")
    if "relative" in row:
        relative = known("relative")
        text = "-" if relative is None else f"{relative:.2f}"
        if known("relative_low") is not None and known("relative_low") != relative:
            text += f" ({known('relative_low'):.2f} to {known('relative_high'):.2f})"
        cells.append(text)
    return cells


# --- the page ---------------------------------------------------------------------------------


def html(results: StudyResults, drawn: Sequence[Drawn]) -> str:
    """The page."""
    manifest = results.manifest
    digest = base64.b64encode(hashlib.sha256(STYLE.encode()).digest()).decode()
    policy = (
        f"default-src 'none'; img-src data:; style-src 'sha256-{digest}'; "
        "base-uri 'none'; form-action 'none'"
    )
    description = results.study.model.description
    sections = [
        ("findings", "What it says", _findings(results)),
        *((f"figure-{d.name}", d.title, _picture(d)) for d in drawn),
        ("means", "Means with their uncertainty", _means(results)),
        ("effects", _effects_title(results), _effects(results)),
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
        f"<title>{title}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n"
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
    for heading, lines in results.findings():
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


def _table(
    caption: str, heads: Sequence[str], rows: Iterable[Sequence[str]], texts: int = 1
) -> str:
    """A table; the first ``texts`` columns are headings of their rows."""

    def kind(i: int) -> str:
        return ' class="text"' if i < texts else ""

    top = "".join(f'<th scope="col"{kind(i)}>{escape(h)}</th>' for i, h in enumerate(heads))
    lines = []
    for row in rows:
        cells = [
            f'<th scope="row" class="text">{escape(c)}</th>'
            if i < texts
            else f"<td>{escape(c)}</td>"
            for i, c in enumerate(row)
        ]
        lines.append(f"<tr>{''.join(cells)}</tr>")
    return (
        f'<div class="scroll" role="region" tabindex="0" aria-label="{escape(caption)}">'
        f"<table><caption>{escape(caption)}</caption><thead><tr>{top}</tr></thead>"
        f"<tbody>{''.join(lines)}</tbody></table></div>"
    )


def _means(results: StudyResults) -> str:
    summary = results.summary()
    names = point_heads(results)
    parts = [
        "<p>Intervals of means are 95 % intervals (Student's t); beside them the standard "
        "deviation of single runs and the quantiles 5 and 95 %. Runs that failed or are void are "
        "left out.</p>"
    ]
    for k, measure in enumerate(results.measures):
        rows = summary[summary["measure"] == measure].to_dict("records")
        heads = [*names, "runs", "mean (95 % interval)", "sd", "5 to 95 % of runs"]
        if "relative" in summary:
            heads.append("relative to the base")
        title = results.manifest["measures"][measure]
        cells = [[*point_cells(results, row), *interval(measure, row)] for row in rows[:MOST_ROWS]]
        table = _table(title, heads, cells, len(names))
        if len(rows) > MOST_ROWS:
            table += f"<p>The first {MOST_ROWS} of {len(rows)} points; all are in summary.csv.</p>"
        state = " open" if k == 0 and len(rows) <= 40 else ""
        parts.append(f"<details{state}><summary>{escape(title)}</summary>{table}</details>")
    return "".join(parts)


def _effects_title(results: StudyResults) -> str:
    return {
        "sobol": "Sobol indices",
        "latin_hypercube": "Rank correlations",
        "one_at_a_time": "Effects",
    }.get(results.study.model.design, "Shares of the variance")


EFFECT_HEADS = {
    "measure": "measure",
    "parameter": "parameter",
    "mean_from": "mean there",
    "mean_base": "mean at the base",
    "mean_to": "mean there",
    "change_low": "change, low",
    "change_high": "change, high",
    "relative_swing": "largest less least, of the base",
    "swing": "largest less least",
    "share": "share of the variance",
    "least_mean": "least mean",
    "at_least": "at",
    "largest_mean": "largest mean",
    "at_largest": "at",
    "rank_correlation": "rank correlation",
    "base_points": "base points",
    "left_out": "left out",
}


def _effects(results: StudyResults) -> str:
    table = results.effects()
    if not len(table):
        return "<p>None: nothing varies.</p>"
    heads = [EFFECT_HEADS.get(c, c.replace("_", " ")) for c in table.columns]
    texts = [c for c in table.columns if c in ("measure", "parameter")]
    ordered = texts + [c for c in table.columns if c not in texts]
    heads = [EFFECT_HEADS.get(c, c.replace("_", " ")) for c in ordered]
    rows = []
    for row in records(table)[:MOST_ROWS]:
        cells = []
        for name in ordered:
            value = row[name]
            if name == "measure":
                cells.append(MEASURES[value].title)
            elif name == "parameter":
                cells.append(value.replace("_", " "))
            elif value is None:
                cells.append("-")
            elif isinstance(value, float):
                cells.append(f"{value:.3g}" if abs(value) < 1e4 else f"{value:.0f}")
            else:
                cells.append(str(value))
        rows.append(cells)
    return _table("By measure and parameter", heads, rows, 2)


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
