"""Two recordings side by side: measures, events, collisions, scenes."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np

from derail_ros.review import figures, words
from derail_ros.review.figures import STYLE, WIDTH
from derail_ros.review.summary import final_scene, number
from derail_ros.vocabulary.events import Event, EventKind

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from derail_ros.recording.recorded_run import RecordedRun

FORMAT = "derail_ros/comparison"
VERSION = 1
HAPPENED = (EventKind.TRUCK_DERAILED, EventKind.COUPLER_PARTED, EventKind.RAIL_BREAK_SET)
"""Kinds of events that are compared one by one."""
SAME = 1e-9
"""Times closer than this are the same, s."""
HARD = 1.0e6
"""Collisions from here on are compared, N."""

MEASURES: tuple[tuple[str, str, str, float], ...] = (
    ("cars_derailed", "cars derailed", "", 1.0),
    ("duration_s", "duration", "s", 1.0),
    ("peak_force_N", "largest force", "MN", 1e-6),
    ("peak_time_s", "  at", "s", 1.0),
    ("cars_above_5MN", "cars struck above 5 MN", "", 1.0),
    ("cars_above_10MN", "cars struck above 10 MN", "", 1.0),
    ("collisions", "collisions", "", 1.0),
    ("length_m", "scene length", "m", 1.0),
    ("width_m", "scene width", "m", 1.0),
    ("area_m2", "scene area", "m²", 1.0),
    ("rear_stop_m", "first car on the rails behind at", "m", 1.0),
    ("couplings_parted", "couplings parted", "", 1.0),
    ("initial_speed_m_s", "speed at the start", "m/s", 1.0),
)


def measures(run: RecordedRun) -> dict[str, float]:
    """Measures of a run."""
    r = run.outcome
    return {
        "cars_derailed": float(len(r.derailed_cars)),
        "duration_s": r.duration,
        "peak_force_N": r.peak_force,
        "peak_time_s": r.peak_force_time,
        "cars_above_5MN": float(len(r.cars_above_5MN)),
        "cars_above_10MN": float(len(r.cars_above_10MN)),
        "collisions": float(len(run.collisions)),
        "length_m": r.scene_length,
        "width_m": r.scene_width,
        "area_m2": r.scene_area,
        "rear_stop_m": r.rear_part_coordinate,
        "couplings_parted": float((~run.coupled[-1]).sum()),
        "initial_speed_m_s": run.initial_speed,
    }


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
    """What is different between two runs, as plain data."""
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
        "format": FORMAT,
        "version": VERSION,
        "first": _about(a),
        "second": _about(b),
        "same_scenario": a.scenario_hash == b.scenario_hash,
        "same_events": _sequence(a) == _sequence(b),
        "settings": settings(a.scenario, b.scenario),
        "measures": {
            key: {
                "first": number(ma[key]),
                "second": number(mb[key]),
                "difference": number(mb[key] - ma[key]),
            }
            for key, *_ in MEASURES
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
        if not e.kind.word.startswith("run_")
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
        "outcome": words.sentence(run),
        "warnings": list(run.warnings),
    }


def _event(e: Event) -> dict[str, Any]:
    return {"time_s": e.time, "kind": e.kind.word, "cars": list(e.cars), "text": e.text}


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
    """What is different, for people."""
    first, second = facts["first"], facts["second"]
    lines = [f"A  {first['title']}: {first['outcome']}", f"   {first['path']}"]
    lines += [f"B  {second['title']}: {second['outcome']}", f"   {second['path']}", ""]
    if facts["same_events"]:
        lines += ["The events of both are the same to the bit.", ""]
    elif facts["first_difference_s"] is not None:
        lines += [f"The events differ from {facts['first_difference_s']:.3f} s on.", ""]
    lines.append(f"  {'':<26}{'A':>12}{'B':>12}{'B - A':>12}")
    for key, label, unit, factor in MEASURES:
        row = facts["measures"][key]
        cells = [_number(row[k], factor) for k in ("first", "second")]
        change = _number(row["difference"], factor, sign=True)
        name = f"{label}{', ' + unit if unit else ''}"
        lines.append(f"  {name:<26}{cells[0]:>12}{cells[1]:>12}{change:>12}")
    for which, name in (("first", "A"), ("second", "B")):
        cars = facts[f"derailed_only_in_{which}"]
        if cars:
            lines.append(f"  derailed only in {name}: {words.cars(cars)}")
    rows = facts["settings"]
    if rows:
        lines += ["", f"Settings that differ: {len(rows)}"]
        lines += [
            f"  {r['path']}: {_short(r['first'])} | {_short(r['second'])}" for r in rows[:most]
        ]
        lines += _more(len(rows), most)
    for which, name in (("first", "A"), ("second", "B")):
        rows = facts[f"events_only_in_{which}"]
        if rows:
            lines += ["", f"Only in {name}: {len(rows)}"]
            lines += [f"  {r['time_s']:8.2f} s  {r['text']}" for r in rows[:most]]
            lines += _more(len(rows), most)
    rows = facts["events_at_other_times"]
    if rows:
        lines += ["", f"In both, at other times: {len(rows)} of {facts['events_shared']}"]
        lines += [
            f"  {r['first_s']:8.2f} s  {r['difference_s']:+8.3f} s  {r['text']}"
            for r in rows[:most]
        ]
        lines += _more(len(rows), most)
    rows = facts["collisions"]
    if rows and not facts["same_events"]:
        lines += ["", "Largest force between two cars", f"  {'cars':<12}{'A':>10}{'B':>10}"]
        for r in rows[:most]:
            pair = f"{r['cars'][0]} and {r['cars'][1]}"
            cells = [words.force(r[k]) if r[k] else "-" for k in ("first_N", "second_N")]
            lines.append(f"  {pair:<12}{cells[0]:>10}{cells[1]:>10}")
        lines += _more(len(rows), most)
    return "\n".join(lines) + "\n"


def _more(count: int, most: int) -> list[str]:
    return [f"  and {count - most} more"] if count > most else []


def _short(value: Any) -> str:
    line = str(value)
    return line if len(line) <= 40 else line[:37] + "..."


def _number(value: float | None, factor: float, sign: bool = False) -> str:
    if value is None:
        return "-"
    scaled = value * factor
    if scaled == round(scaled) and abs(scaled) < 1e6:
        return f"{scaled:+.0f}" if sign else f"{scaled:.0f}"
    return f"{scaled:+.2f}" if sign else f"{scaled:.2f}"


# --- scenes ----------------------------------------------------------------------------------


def scenes(a: RecordedRun, b: RecordedRun) -> Figure:
    """Draw both scenes at the end, one above the other, to the same scale and place."""
    with matplotlib.rc_context(STYLE):
        return _scenes(a, b)


def _scenes(a: RecordedRun, b: RecordedRun) -> Figure:
    drawn = [final_scene(run) for run in (a, b)]
    windows = np.array([figures._pile_up(scene) for scene in drawn])
    window = (
        float(windows[:, 0].min()),
        float(windows[:, 1].max()),
        float(windows[:, 2].min()),
        float(windows[:, 3].max()),
    )
    inner = WIDTH - 1.0
    aspect = (window[3] - window[2]) / (window[1] - window[0])
    tall = float(np.clip(inner * aspect, 2.6, 5.6))
    window = figures._fit(window, tall / inner)
    top, head, legend = 0.55, 0.62, 0.5
    height = top + 2.0 * (tall + head) + legend
    figure = figures._figure(height)
    left = 0.5 / WIDTH
    figures._headline(figure, left, 1.0 - 0.3 / height, "Two runs, to the same scale", 80)
    points = inner * 72.0 / (window[1] - window[0])
    for k, (name, run, scene) in enumerate(zip("AB", (a, b), drawn)):
        bottom = height - top - (k + 1) * (tall + head)
        axes = figure.add_axes((left, bottom / height, inner / WIDTH, tall / height))
        figures._prepare(axes, window)
        figures._draw_track(axes, scene, window, points)
        figures._draw_cars(axes, scene, window, points)
        figures._draw_box(axes, scene)
        over = (bottom + tall) / height
        title = f"{name}   {run.title}"
        figure.text(left, over + 0.3 / height, title, size=11, weight="bold", va="center")
        figure.text(
            left, over + 0.11 / height, scene.subtitle, size=9, color="#555555", va="center"
        )
    ways = [scene.travel for scene in drawn]
    same = math.isclose(math.dist(*ways), 0.0, abs_tol=0.1)
    figures._draw_scale(figure, height, window, ways[0] if same else None)
    if not same:  # each its own, over the picture and clear of the cars
        page = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        page.set_axis_off()
        page.set_xlim(0.0, WIDTH)
        page.set_ylim(0.0, height)
        for k, way in enumerate(ways):
            level = height - top - k * (tall + head) - 0.5 * head
            figures._draw_travel(page, (WIDTH - 0.85, level), way)
    figures._draw_key(figure, drawn, left, (legend - 0.1) / height, window)
    return figure
