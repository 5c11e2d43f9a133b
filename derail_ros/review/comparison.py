"""Two recordings side by side: measures, events, collisions, scenes."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from derail_ros.review import drawing
from derail_ros.review.drawing import WIDTH, styled
from derail_ros.review.scene import final_scene
from derail_ros.vocabulary import words
from derail_ros.vocabulary.events import EventKind
from derail_ros.vocabulary.measures import HEADLINE, MEASURES
from derail_ros.vocabulary.words import finite

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from derail_ros.recording.recorded_run import RecordedRun
    from derail_ros.vocabulary.events import Event

SCHEMA = "derail_ros/comparison"
SCHEMA_VERSION = 2
"""Version of :func:`compare`; 1 had measures with keys of its own."""
HAPPENED = (EventKind.TRUCK_DERAILED, EventKind.COUPLER_PARTED, EventKind.RAIL_BREAK_SET)
"""Kinds of events that are compared one by one."""
SAME = 1e-9
"""Times closer than this are the same, s."""
HARD = 1.0e6
"""Collisions from here on are compared, N."""

OF_RECORDINGS: dict[str, tuple[str, Callable[[RecordedRun], float]]] = {
    "collisions": ("collisions", lambda run: len(run.collisions)),
    "couplings_parted": ("couplings parted", lambda run: int((~run.own_coupled[-1]).sum())),
    "initial_speed_m_s": ("speed at the start (m/s)", lambda run: run.initial_speed),
}
"""What is compared beside the measures of the outcome: key -> words, value."""


def measures(run: RecordedRun) -> dict[str, float | None]:
    """Measures of a run as numbers, None where one does not exist."""
    found = {
        key: m.number(m.value(run.outcome))
        for key, m in MEASURES.items()
        if m.numeric and key != "derailed_cars"  # they are told one by one
    }
    return found | {key: finite(of(run)) for key, (_, of) in OF_RECORDINGS.items()}


def _key(e: Event) -> tuple[Any, ...]:
    return e.kind, tuple(sorted(e.cars)), e.end, round(e.track_coordinate, 3) if not e.cars else 0


def _happened(run: RecordedRun) -> dict[tuple[Any, ...], Event]:
    found: dict[tuple[Any, ...], Event] = {}
    for e in run.events:
        if e.kind in HAPPENED:
            found.setdefault(_key(e), e)
    return found


def _pairs(run: RecordedRun) -> dict[tuple[int, int], float]:
    """Largest force between each pair of cars, N."""
    found: dict[tuple[int, int], float] = {}
    for c in run.collisions:
        pair = (min(c.car_a, c.car_b), max(c.car_a, c.car_b))
        found[pair] = max(found.get(pair, 0.0), c.peak_force)
    return found


def compare(a: RecordedRun, b: RecordedRun) -> dict[str, Any]:
    """Differences between two runs, as plain data."""
    ma, mb = measures(a), measures(b)
    ea, eb = _happened(a), _happened(b)
    shared = [(ea[k], eb[k]) for k in ea if k in eb]
    shifted = [(x, y) for x, y in shared if abs(x.time - y.time) > SAME]
    only_a = sorted((e for k, e in ea.items() if k not in eb), key=lambda e: e.time)
    only_b = sorted((e for k, e in eb.items() if k not in ea), key=lambda e: e.time)
    moments = [e.time for e in only_a + only_b] + [min(x.time, y.time) for x, y in shifted]
    pa, pb = _pairs(a), _pairs(b)
    pairs = sorted(
        (p for p in pa.keys() | pb.keys() if max(pa.get(p, 0.0), pb.get(p, 0.0)) >= HARD),
        key=lambda p: -max(pa.get(p, 0.0), pb.get(p, 0.0)),
    )
    derailed_a, derailed_b = set(a.outcome.derailed_cars), set(b.outcome.derailed_cars)
    return {
        "schema": SCHEMA,
        "schema_version": SCHEMA_VERSION,
        "first": _about(a),
        "second": _about(b),
        "same_scenario": a.scenario_hash == b.scenario_hash,
        "same_events": _sequence(a) == _sequence(b),
        "settings": settings(a.scenario, b.scenario),
        "measures": {
            key: {
                "first": ma[key],
                "second": mb[key],
                "difference": None if None in (ma[key], mb[key]) else mb[key] - ma[key],
            }
            for key in ma
        },
        "derailed_only_in_first": sorted(derailed_a - derailed_b),
        "derailed_only_in_second": sorted(derailed_b - derailed_a),
        "events_shared": len(shared),
        "events_only_in_first": [_event(e) for e in only_a],
        "events_only_in_second": [_event(e) for e in only_b],
        "events_at_other_times": [
            {
                "text": x.text,
                "first_s": x.time,
                "second_s": y.time,
                "difference_s": y.time - x.time,
            }
            for x, y in sorted(shifted, key=lambda p: p[0].time)
        ],
        "first_difference_s": min(moments, default=None),
        "collisions": [
            {"cars": list(p), "first_N": pa.get(p, 0.0), "second_N": pb.get(p, 0.0)} for p in pairs
        ],
    }


def _sequence(run: RecordedRun) -> list[tuple[Any, ...]]:
    """All events to the bit."""
    return [
        (e.time, e.kind, e.cars, e.end, e.cause, repr(e.value))
        for e in run.events
        if not e.kind.name.startswith("RUN_")
    ]


def _about(run: RecordedRun) -> dict[str, Any]:
    return {
        "path": str(run.path),
        "run_id": run.run_id,
        "scenario": run.name,
        "title": run.title,
        "hash": run.scenario_hash,
        "status": run.outcome.status,
        "bodies": run.n,
        "outcome": run.outcome.text,
        "warnings": list(run.warnings),
    }


def _event(e: Event) -> dict[str, Any]:
    kind = e.kind.word
    return {"time_s": e.time, "kind": kind, "cars": list(e.cars), "text": e.text}


def settings(a: Any, b: Any, path: str = "") -> list[dict[str, Any]]:
    """Values of two scenarios that are different, by their path."""
    if isinstance(a, dict) and isinstance(b, dict):
        found: list[dict[str, Any]] = []
        for key in dict.fromkeys([*a, *b]):
            found += settings(a.get(key), b.get(key), f"{path}.{key}" if path else str(key))
        return found
    if isinstance(a, list) and isinstance(b, list) and len(a) == len(b):
        return [
            row for i, (x, y) in enumerate(zip(a, b)) for row in settings(x, y, f"{path}[{i}]")
        ]
    return [] if a == b else [{"path": path, "first": a, "second": b}]


# --- text ------------------------------------------------------------------------------------


def text(facts: dict[str, Any], most: int = 12) -> str:
    """Differences as text."""
    first, second = facts["first"], facts["second"]
    lines = [f"A  {first['title']}: {first['outcome']}", f"   {first['path']}"]
    lines += [f"B  {second['title']}: {second['outcome']}", f"   {second['path']}", ""]
    if facts["same_events"]:
        lines += ["The events of both are the same to the bit.", ""]
    elif facts["first_difference_s"] is not None:
        lines += [f"The events differ from {facts['first_difference_s']:.3f} s on.", ""]
    lines += _table(facts["measures"])
    for which, name in (("first", "A"), ("second", "B")):
        cars = facts[f"derailed_only_in_{which}"]
        if cars:
            lines.append(f"  derailed only in {name}: {words.cars(cars)}")

    def section(title: str, rows: list[str], head: str = "") -> None:
        if rows:
            lines.extend(["", title, *filter(None, [head]), *rows[:most]])
            if len(rows) > most:
                lines.append(f"  and {len(rows) - most} more")

    rows = facts["settings"]
    section(
        f"Settings that differ: {len(rows)}",
        [f"  {r['path']}: {_short(r['first'])} | {_short(r['second'])}" for r in rows],
    )
    for which, name in (("first", "A"), ("second", "B")):
        rows = facts[f"events_only_in_{which}"]
        section(
            f"Only in {name}: {len(rows)}", [f"  {r['time_s']:8.2f} s  {r['text']}" for r in rows]
        )
    rows = facts["events_at_other_times"]
    section(
        f"In both, at other times: {len(rows)} of {facts['events_shared']}",
        [f"  {r['first_s']:8.2f} s  {r['difference_s']:+8.3f} s  {r['text']}" for r in rows],
    )
    rows = [] if facts["same_events"] else facts["collisions"]
    pairs = []
    for r in rows:
        cells = [words.force(r[k]) if r[k] else "-" for k in ("first_N", "second_N")]
        pair = "{} and {}".format(*r["cars"])
        pairs.append(f"  {pair:<12}{cells[0]:>10}{cells[1]:>10}")
    section("Largest force between two cars", pairs, f"  {'cars':<12}{'A':>10}{'B':>10}")
    return "\n".join(lines) + "\n"


def _table(rows: dict[str, dict[str, float | None]]) -> list[str]:
    """The measures that one of the two has, side by side."""
    lines = [f"  {'':<34}{'A':>12}{'B':>12}{'B - A':>12}"]
    for key, row in rows.items():
        a, b, change = row["first"], row["second"], row["difference"]
        if a is b is None or (key in MEASURES and MEASURES[key].group != HEADLINE):
            continue
        if key in MEASURES:
            m = MEASURES[key]
            title, cells = m.title, [m.shown(v) for v in (a, b, change)]
        else:
            title, cells = OF_RECORDINGS[key][0], [f"{v:g}" for v in (a, b, change)]
        sign = "+" if change is not None and change > 0.0 else ""
        lines.append(f"  {title:<34}{cells[0]:>12}{cells[1]:>12}{sign + cells[2]:>12}")
    return lines


def _short(value: Any) -> str:
    line = str(value)
    return line if len(line) <= 40 else line[:37] + "..."


# --- scenes ----------------------------------------------------------------------------------


@styled
def scenes(a: RecordedRun, b: RecordedRun) -> Figure:
    """Draw both scenes at the end, one above the other, to the same scale and place."""
    drawn = [final_scene(run) for run in (a, b)]
    windows = np.array([drawing.site(scene) for scene in drawn])
    low, high = windows.min(axis=0), windows.max(axis=0)
    window = (float(low[0]), float(high[1]), float(low[2]), float(high[3]))
    inner = WIDTH - 1.0
    aspect = (window[3] - window[2]) / (window[1] - window[0])
    tall = float(np.clip(inner * aspect, 2.6, 5.6))
    window = drawing.fit(window, tall / inner)
    top, head, key = 0.55, 0.62, 0.5
    height = top + 2.0 * (tall + head) + key
    figure = drawing.sheet(WIDTH, height)
    drawing.heading(figure, "Two runs, to the same scale")
    points = inner * 72.0 / (window[1] - window[0])
    for k, (name, run, scene) in enumerate(zip("AB", (a, b), drawn)):
        upper = top + head + k * (tall + head)
        axes = drawing.place(figure, 0.5, upper, inner, tall)
        drawing.show(axes, window)
        drawing.draw_track(axes, scene, window, points)
        drawing.draw_cars(axes, scene, window, points)
        drawing.draw_box(axes, scene)
        look = {"size": 11, "weight": "bold", "color": drawing.INK}
        drawing.put(figure, 0.5, upper - 0.3, f"{name}   {run.title}", **look)
        drawing.put(figure, 0.5, upper - 0.11, scene.subtitle, size=9)
    ways = [scene.travel for scene in drawn]
    same = math.isclose(math.dist(*ways), 0.0, abs_tol=0.1)
    drawing.draw_scale(figure, window, ways[0] if same else None)
    if not same:  # each its own, over the picture and clear of the cars
        page = drawing.inches(figure)
        for k, way in enumerate(ways):
            level = height - top - k * (tall + head) - 0.5 * head
            drawing.draw_travel(page, (WIDTH - 0.85, level), way)
    drawing.draw_key(figure, drawn, 0.5, height - key + 0.1, window)
    return figure
