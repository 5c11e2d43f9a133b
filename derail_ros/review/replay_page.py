"""The replay page: a run as one HTML file that needs no network.

The page is put together from ``replay_page.html``, ``.css``, ``scene.js`` and ``replay_page.js``
(:mod:`derail_ros.review.web`).
"""

from __future__ import annotations

import base64
import html
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from derail_ros.review import drawing, summary, web
from derail_ros.review.plots import energy_parts, some
from derail_ros.review.scene import final_scene
from derail_ros.vocabulary.events import EventKind
from derail_ros.vocabulary.ledger import ENERGY_ENTRIES
from derail_ros.vocabulary.words import capital

if TYPE_CHECKING:
    from derail_ros.recording.recorded_run import RecordedRun

STATES = 2500
"""No more states than this are put into the page; of longer runs every second, third ..."""
ENERGY_ROWS = 300

# Name, size of a step in the page's numbers, order of the differences that are stored.
RESOLUTION = {
    "time": (1e-6, 2),
    "x": (1e-3, 2),
    "y": (1e-3, 2),
    "yaw": (1e-4, 2),
    "alpha": (1e-3, 2),
    "beta": (1e-3, 2),
    "speed": (1e-2, 1),
    "force": (1e3, 1),
}

ENERGY_PARTS = {
    "kinetic": "motion",
    "brakes": "brakes",
    "ground_trucks": "ground, trucks",
    "ground_body": "ground, bodies",
    "collisions": "collisions",
    "": "draft gear and couplers",
}
"""Part of the energy (:func:`plots.energy_parts`) -> its name on the page."""


def page(run: RecordedRun, facts: dict[str, Any] | None = None) -> str:
    """The replay page of a run as HTML."""
    outcome, stopped = summary.headline(run)
    facts = summary.findings(run) if facts is None else facts
    template, style, script = (
        web.text("derail_ros.review", f"replay_page.{kind}") for kind in ("html", "css", "js")
    )
    return web.assemble(
        template,
        style,
        web.scene_script(script),
        TITLE=html.escape(run.title),
        OUTCOME=html.escape(outcome),
        STOPPED=html.escape(stopped),
        SOURCE=html.escape(_source(run)),
        WARNINGS=_warnings(run),
        DATA=web.script_json(data(run, facts)),
    )


def write(run: RecordedRun, path: Path, facts: dict[str, Any] | None = None) -> Path:
    """Write the replay page of a run."""
    path.write_text(page(run, facts), encoding="utf-8")
    return path


def _source(run: RecordedRun) -> str:
    states = f"{len(run.time)} states from {run.time[0]:.2f} s to {run.time[-1]:.2f} s"
    return (
        f"Recording {run.path.name}, run {run.run_id}; scenario {run.name} {run.scenario_hash};"
        f" {states}; computed by derail_ros {run.software}."
    )


def _warnings(run: RecordedRun) -> str:
    notes = [html.escape(w) for w in run.warnings]
    if run.outcome.void:
        notes.insert(0, summary.NOT_VALID)
    if not notes:
        return ""
    items = "".join(f"<li>{note}</li>" for note in notes)
    return f'<div class="warning" role="note"><ul>{items}</ul></div>'


# --- numbers ---------------------------------------------------------------------------------


def pack(name: str, values: NDArray[Any]) -> tuple[dict[str, Any], bytes]:
    """Whole multiples of a step, as differences, byte plane by byte plane: it compresses well."""
    step, order = RESOLUTION[name]
    table = np.atleast_2d(np.asarray(values, dtype=float))
    if np.ndim(values) == 1:
        table = table.T
    table = np.nan_to_num(table, nan=0.0, posinf=0.0, neginf=0.0)
    whole = np.round(table / step).astype(np.int64)
    for _ in range(order):
        whole = np.diff(whole, axis=0, prepend=np.zeros((1, whole.shape[1]), dtype=np.int64))
    reach = int(np.abs(whole).max(initial=0)) + 1
    width = next(w for w in (1, 2, 3, 4, 5, 6) if reach < 1 << (8 * w - 1))
    planes = whole.astype("<i8").reshape(-1).view(np.uint8).reshape(-1, 8)[:, :width]
    head = {
        "name": name,
        "rows": whole.shape[0],
        "columns": whole.shape[1],
        "bytes": width,
        "scale": step,
        "order": order,
    }
    return head, np.ascontiguousarray(planes.T).tobytes()


def data(run: RecordedRun, facts: dict[str, Any]) -> dict[str, Any]:
    """All that the page shows, as plain data."""
    keep = some(len(run.time), STATES)
    columns = {
        "time": run.time[keep],
        "x": run.pose[keep, :, 0],
        "y": run.pose[keep, :, 1],
        "yaw": run.pose[keep, :, 5],
        "alpha": run.coupler_yaw[keep, :, 0],
        "beta": run.coupler_yaw[keep, :, 1],
        "speed": run.speed[keep],
        "force": run.corner_force[keep],
    }
    packed = [pack(name, values) for name, values in columns.items()]
    blob = zlib.compress(b"".join(raw for _, raw in packed), 9)
    return {
        "parts": [head for head, _ in packed],
        "blob": base64.b64encode(blob).decode("ascii"),
        "cars": web.car_data(run.cars),
        "track": _track(run),
        "site": list(drawing.stage(final_scene(run))),
        "place": web.place_data(run.site.shapes(run.line)),
        "off": _off(run),
        "parted": _parted(run),
        "contacts": [web.contact_data(c) for c in run.collisions],
        "timeline": [
            {
                "time": round(e["time_s"], 6),
                "kind": e["kind"],
                "cars": e["cars"],
                "text": capital(e["text"]),
            }
            for e in facts["timeline"]
        ],
        "carEvents": _car_events(run),
        "energy": _energy(run),
    }


def _track(run: RecordedRun) -> dict[str, Any]:
    low, high = run.pose[..., 0].min(), run.pose[..., 0].max()
    return web.track_data(run.line, float(low) - 300.0, float(high) + 400.0)


def _off(run: RecordedRun) -> list[list[float | None]]:
    """Time at which each truck left the rails: that of the event, or of the first state."""
    times: list[list[float | None]] = [[None, None] for _ in range(run.n)]
    for e in run.events:
        if e.kind == EventKind.TRUCK_DERAILED and e.cars and e.cars[0] <= run.n and e.end:
            pair = times[e.cars[0] - 1]
            k = 0 if e.end == "front" else 1
            if pair[k] is None:
                pair[k] = round(e.time, 6)
    for i, k in zip(*np.nonzero(~run.truck_on[-1])):
        if times[i][k] is None:
            first = int(np.flatnonzero(~run.truck_on[:, i, k])[0])
            times[i][k] = float(run.time[first])
    return times


def _parted(run: RecordedRun) -> list[float | None]:
    """Time at which each coupling parted."""
    times: list[float | None] = [None] * max(run.n - 1, 0)
    for e in run.events:
        if e.kind == EventKind.COUPLER_PARTED and e.cars and min(e.cars) < run.n:
            times[min(e.cars) - 1] = round(e.time, 6)
    for i in np.flatnonzero(~run.coupled[-1]):
        if times[i] is None:
            times[i] = float(run.time[np.flatnonzero(~run.coupled[:, i])[0]])
    return times


def _car_events(run: RecordedRun) -> list[list[dict[str, Any]]]:
    """What happened to each car, in order."""
    rows: list[list[dict[str, Any]]] = [[] for _ in range(run.n)]

    def add(car: int, time: float, kind: str, text: str) -> None:
        if 1 <= car <= run.n:
            rows[car - 1].append({"time": round(time, 6), "kind": kind, "text": capital(text)})

    for e in run.events:
        for car in e.cars[:2]:
            add(car, e.time, e.kind.word, e.text)
    for c in run.collisions:
        for car in (c.car_a, c.car_b):
            add(car, c.peak_time, "collision", c.text)
    for row in rows:
        row.sort(key=lambda r: r["time"])
    return rows


def _energy(run: RecordedRun) -> dict[str, Any] | None:
    if not run.energy or float(run.energy["initial"][0]) <= 0.0:
        return None
    keep = some(len(run.energy_time), ENERGY_ROWS)
    ledger = {name: values[keep] for name, values in run.energy.items()}
    parts = energy_parts(ledger, [key for key in ENERGY_PARTS if key in ENERGY_ENTRIES][1:])
    return {
        "initial": float(ledger["initial"][0]),
        "time": run.energy_time[keep].round(4).tolist(),
        "parts": [
            {"label": ENERGY_PARTS[key], "values": np.round(values).tolist()}
            for key, values in parts
        ],
    }
