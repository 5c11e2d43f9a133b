"""What happened in a run, as plain data and as text."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

import derail_ros
from derail_ros.recording.recorded_run import RecordedRun
from derail_ros.review import words
from derail_ros.review.run_scene import scene_at
from derail_ros.review.scene import Scene
from derail_ros.vocabulary.events import Collision, Event, EventKind
from derail_ros.vocabulary.severity import severity

FORMAT = "derail_ros/review"
VERSION = 1
NOTABLE = 1.0e6
"""Collisions from here on are part of the timeline, N."""


def number(value: float) -> float | None:
    """A number as JSON knows it: None where there is none."""
    return float(value) if math.isfinite(value) else None


# --- cars ------------------------------------------------------------------------------------


def car_findings(run: RecordedRun) -> list[dict[str, Any]]:
    """What came of each car: where and when it derailed, parted, was struck, came to rest."""
    rows: list[dict[str, Any]] = []
    for i in range(run.n):
        rows.append(
            {
                "car": i + 1,
                "name": run.cars.name[i],
                "type": run.cars.kind[i],
                "contents": run.cars.contents[i],
                "represents": int(run.cars.represents[i]),
                "derailed": None,
                "trucks": [],
                "parted_front": None,
                "parted_rear": None,
                "struck": [],
                "peak_force_N": float(run.outcome.car_peak_force[i]),
                "peak_force_from": int(run.outcome.car_peak_other[i]) or None,
                "peak_force_time_s": number(run.outcome.car_peak_time[i]),
                "at_rest": None,
                "pushed_on_until_s": None,
                "end": {
                    "x_m": float(run.pose[-1, i, 0]),
                    "y_m": float(run.pose[-1, i, 1]),
                    "yaw_rad": float(run.pose[-1, i, 5]),
                },
            }
        )
    for e in run.events:
        if not e.cars or e.cars[0] > run.n:
            continue
        row = rows[e.cars[0] - 1]
        if e.kind == EventKind.TRUCK_DERAILED:
            found = _moment(e) | {"truck": e.end, "cause": e.cause}
            row["trucks"].append(found)
            row["derailed"] = row["derailed"] or found
        elif e.kind == EventKind.COUPLER_PARTED and len(e.cars) > 1:
            found = _moment(e) | {"cause": e.cause, "angle_rad": number(e.value)}
            row["parted_rear"] = found | {"from": e.cars[1]}
            if e.cars[1] <= run.n:
                rows[e.cars[1] - 1]["parted_front"] = found | {"from": e.cars[0]}
        elif e.kind == EventKind.CAR_AT_REST:
            row["at_rest"] = _moment(e)  # the last time counts: a car may be pushed on
            row["pushed_on_until_s"] = _pushed_on(run, e.cars[0] - 1, e.time)
    for c in run.collisions:
        for car, other in ((c.car_a, c.car_b), (c.car_b, c.car_a)):
            if car <= run.n:
                rows[car - 1]["struck"].append(
                    {
                        "collision": c.id,
                        "other_car": other,
                        "struck_by_it": car == c.car_b,
                        "time_s": c.peak_time,
                        "force_N": c.peak_force,
                    }
                )
    return rows


PUSHED = 0.25
"""A car at rest that moves further than this again was pushed on, m."""


def _pushed_on(run: RecordedRun, i: int, rest: float) -> float | None:
    """Until when a car that had come to rest was still being pushed, None if it was not."""
    gap = np.hypot(*(run.pose[:, i, :2] - run.pose[-1, i, :2]).T)
    away = np.flatnonzero((gap > PUSHED) & (run.time > rest + 0.1))
    return float(run.time[away[-1]]) if len(away) else None


def _moment(e: Event) -> dict[str, Any]:
    return {
        "time_s": e.time,
        "x_m": number(e.x),
        "y_m": number(e.y),
        "track_m": number(e.track_coordinate),
        "speed_m_s": number(e.speed),
    }


# --- collisions and timeline -----------------------------------------------------------------


def by_severity(run: RecordedRun) -> list[Collision]:
    """The collisions, the hardest first."""
    return sorted(run.collisions, key=lambda c: (-c.peak_force, c.id))


def collision_finding(c: Collision) -> dict[str, Any]:
    """A collision as plain data."""
    return {
        "id": c.id,
        "final": c.final,
        "striking_car": c.car_a,
        "struck_car": c.car_b,
        "text": c.text,
        "start_s": c.start,
        "end_s": number(c.end),
        "peak_force_N": c.peak_force,
        "peak_time_s": c.peak_time,
        "peak_resultant_N": c.peak_resultant,
        "closing_speed_m_s": number(c.closing_speed),
        "angle_deg": number(math.degrees(c.angle)),
        "x_m": c.x,
        "y_m": c.y,
        "corner": c.touch,
        "energy_taken_J": number(c.energy_lost),
    }


def timeline(run: RecordedRun) -> list[dict[str, Any]]:
    """Events and notable collisions in order of time, what is alike in one entry."""
    entries: list[dict[str, Any]] = []
    signals: list[Event] = []
    rests: dict[int, Event] = {}
    for e in run.events:
        if e.kind == EventKind.BRAKE_SIGNAL_REACHED:
            signals.append(e)
        elif e.kind == EventKind.CAR_AT_REST and e.cars:
            rests[e.cars[0]] = e
        else:
            entries.append(
                _moment(e)
                | {"kind": e.kind.word, "cars": list(e.cars), "cause": e.cause, "text": e.text}
            )
    if signals:
        cars = sorted(e.cars[0] for e in signals if e.cars)
        first, last = signals[0].time, signals[-1].time
        entries.append(
            {
                "time_s": first,
                "kind": "brake_signal_reached",
                "cars": cars,
                "cause": signals[0].cause,
                "text": f"the brake signal reaches {words.cars(cars)}"
                if len(cars) == 1
                else f"the brake signal runs through {words.cars(cars)}, the last at {last:.2f} s",
                "until_s": last,
            }
        )
    entries += _rests(rests)
    for c in run.collisions:
        if c.peak_force >= NOTABLE:
            entries.append(
                {
                    "time_s": c.peak_time,
                    "kind": "collision",
                    "cars": [c.car_a, c.car_b],
                    "cause": "",
                    "text": c.text,
                    "x_m": c.x,
                    "y_m": c.y,
                    "force_N": c.peak_force,
                    "collision": c.id,
                }
            )
    # What ends a run comes after all that happened at that moment.
    return sorted(entries, key=lambda e: (e["time_s"], e["kind"].startswith("run_ended")))


def _rests(rests: dict[int, Event]) -> list[dict[str, Any]]:
    """Cars that came to rest for good, those of one moment in one entry."""
    entries: list[dict[str, Any]] = []
    group: list[Event] = []

    def close() -> None:
        if group:
            cars = sorted(e.cars[0] for e in group)
            entries.append(
                _moment(group[0])
                | {
                    "kind": "car_at_rest",
                    "cars": cars,
                    "cause": "",
                    "text": f"{words.cars(cars)} come{'s' if len(cars) == 1 else ''} to rest",
                }
            )
        group.clear()

    for e in sorted(rests.values(), key=lambda e: e.time):
        if group and e.time > group[0].time + 0.1:
            close()
        group.append(e)
    close()
    return entries


# --- all of it -------------------------------------------------------------------------------


def findings(run: RecordedRun) -> dict[str, Any]:
    """What happened in a run, as data for JSON."""
    r = run.outcome
    return {
        "format": FORMAT,
        "version": VERSION,
        "derail_ros": derail_ros.__version__,
        "recording": {
            "path": str(run.path),
            "storage": run.storage,
            "run_id": run.run_id,
            "runs": list(run.run_ids),
            "states": len(run.time),
            "first_s": float(run.time[0]),
            "last_s": float(run.time[-1]),
            "software": run.software,
            "warnings": list(run.warnings),
        },
        "scenario": {
            "name": run.name,
            "title": run.title,
            "hash": run.scenario_hash,
            "cars": int(run.cars.represents.sum()),
            "bodies": run.n,
            "initial_speed_m_s": run.initial_speed,
        },
        "outcome": {
            "text": words.sentence(run),
            "status": r.status,
            "final": r.final,
            "void": r.void,
            "time_s": number(r.time),
            "duration_s": number(r.duration),
            "cars_derailed": len(r.derailed_cars),
            "derailed_cars": list(r.derailed_cars),
            "peak_force_N": r.peak_force,
            "peak_force_pair": list(r.peak_force_pair) if r.peak_force_pair else None,
            "peak_force_time_s": number(r.peak_force_time),
            "peak_resultant_N": r.peak_resultant,
            "scene_length_m": number(r.scene_length),
            "scene_width_m": number(r.scene_width),
            "scene_area_m2": number(r.scene_area),
            "cars_above_5MN": list(r.cars_above_5MN),
            "cars_above_10MN": list(r.cars_above_10MN),
            "rear_part_first_car": r.rear_part_first_car or None,
            "rear_part_stopped_at_m": number(r.rear_stop),
            "max_coupler_gap_m": number(r.max_coupler_gap),
            "energy_residual": number(r.energy_residual),
            "severity": number(severity(r)),
        },
        "stopped_by": {
            "text": words.stopped_by(run),
            "shares": [
                {"entry": entry, "words": text, "energy_J": taken, "share": number(share)}
                for entry, text, taken, share in words.shares(run)
            ],
        },
        "timeline": timeline(run),
        "collisions": [collision_finding(c) for c in by_severity(run)],
        "cars": car_findings(run),
        "commands": list(run.commands),
    }


# --- text ------------------------------------------------------------------------------------


def text(run: RecordedRun, facts: dict[str, Any] | None = None) -> str:
    """What happened in a run, for people: about a page for each part."""
    facts = findings(run) if facts is None else facts
    r = run.outcome
    lines: list[str] = [run.title, "=" * len(run.title), ""]
    lines += _wrap(_capital(words.sentence(run)) + ".", 96)
    lines += _wrap(words.stopped_by(run), 96)
    if r.void:
        lines.append("NOT A VALID RUN: a body that stands for many cars reached the break.")
    lines += ["", *_outcome(run)]
    if run.warnings:
        lines += ["", "Warnings", "--------", *(f"  {w}" for w in run.warnings)]
    lines += ["", "What happened", "-------------"]
    for entry in facts["timeline"]:
        wrapped = _wrap(_capital(entry["text"]), 84)
        lines.append(f"{entry['time_s']:8.2f} s  {wrapped[0]}")
        lines += [" " * 12 + rest for rest in wrapped[1:]]
    lines += ["", "Collisions, the hardest first", "-----------------------------"]
    lines += _collisions(run)
    lines += ["", "Cars", "----", *_cars(run, facts["cars"])]
    if run.commands:
        lines += ["", "Commands", "--------"]
        for c in run.commands:
            answer = "" if c["accepted"] else f"  REFUSED: {c['message']}"
            lines.append(f"{c['time']:8.2f} s  {c['command']} {c['request']}{answer}")
    lines += ["", "Recording", "---------", f"  {run.path}"]
    lines.append(
        f"  run {run.run_id}, {len(run.time)} states, {run.time[0]:.2f} s to {run.time[-1]:.2f} s"
    )
    lines.append(f"  scenario {run.name} {run.scenario_hash}")
    lines.append(f"  computed by derail_ros {run.software}")
    return "\n".join(lines) + "\n"


def _capital(line: str) -> str:
    return line[:1].upper() + line[1:]


def _wrap(line: str, width: int) -> list[str]:
    import re
    import textwrap

    # A number stays with its unit.
    tied = re.sub(r"(?<=\d) (?=(?:m|m/s|km/h|s|MN|kN|%|[GMk]?J)\b|%)", "\0", line)
    return [part.replace("\0", " ") for part in textwrap.wrap(tied, width)] or [""]


def _listed(numbers: Sequence[int]) -> str:
    return f"{len(numbers)}: {words.number_list(numbers)}"


def _outcome(run: RecordedRun) -> list[str]:
    r = run.outcome
    rows: list[tuple[str, str]] = [("cars derailed", f"{len(r.derailed_cars)}")]
    if r.derailed_cars:
        rows[0] = (
            "cars derailed",
            f"{len(r.derailed_cars)}: {words.number_list(r.derailed_cars)}",
        )
    rows.append(("speed at the start", words.speed(run.initial_speed)))
    status = r.status if r.final else f"{r.status} (the end is not recorded)"
    if math.isfinite(r.duration):
        rows.append((status, f"after {r.duration:.2f} s"))
    else:
        rows.append((status, f"at {r.time:.2f} s, not at rest"))
    if r.peak_force_pair:
        a, b = r.peak_force_pair
        rows.append(
            (
                "largest force",
                f"{words.force(r.peak_force)}, car {a} into car {b} at {r.peak_force_time:.2f} s",
            )
        )
        rows.append(
            ("above 5 MN", f"{len(r.cars_above_5MN)}: {words.number_list(r.cars_above_5MN)}")
        )
        rows.append(
            ("above 10 MN", f"{len(r.cars_above_10MN)}: {words.number_list(r.cars_above_10MN)}")
        )
    if r.derailed_cars:
        rows.append(
            ("scene", f"{r.scene_length:.1f} m × {r.scene_width:.1f} m, {r.scene_area:.0f} m²")
        )
        if math.isfinite(severity(r)):
            rows.append(("severity", f"{severity(r):.2f} (the source's base train: 1)"))
    if r.rear_part_first_car:
        stop = f" at {r.rear_stop:.1f} m" if math.isfinite(r.rear_stop) else ""
        # Without a parted coupling ahead of it there is no part that stands by itself.
        parted = not run.coupled[-1][: r.rear_part_first_car - 1].all()
        stands = "rear part stands" if math.isfinite(r.duration) else "rear part"
        label = stands if parted else "still on the rails"
        rows.append((label, f"from car {r.rear_part_first_car} on, its front truck{stop}"))
    return [f"  {label:<20}{value}" for label, value in rows]


SHOWN = 40


def _collisions(run: RecordedRun) -> list[str]:
    ranked = by_severity(run)
    if not ranked:
        return ["  none"]
    lines = [
        "  striking  struck   force   time     closing  angle   energy    where touched",
    ]
    for c in ranked[:SHOWN]:
        lines.append(
            f"  {c.car_a:>8}  {c.car_b:>6}  {c.peak_force * 1e-6:5.2f} MN"
            f" {c.peak_time:6.2f} s  {c.closing_speed:4.1f} m/s  {math.degrees(c.angle):4.0f}°"
            f"  {words.energy(c.energy_lost):>8}   {c.touch}"
        )
    rest = ranked[SHOWN:]
    if rest:
        lines.append(f"  and {len(rest)} more, none above {words.force(rest[0].peak_force)}")
    return lines


def _cars(run: RecordedRun, rows: list[dict[str, Any]]) -> list[str]:
    lines: list[str] = []
    quiet: list[int] = []
    for row in rows:
        if not (row["derailed"] or row["struck"] or row["parted_front"] or row["parted_rear"]):
            quiet.append(row["car"])
            continue
        about = ", ".join(filter(None, [row["name"], _cargo(row)]))
        lines.append(f"  Car {row['car']}{': ' + about if about else ''}")
        d = row["derailed"]
        if d:
            track = "" if d["track_m"] is None else f" at {words.coordinate(d['track_m'])} m"
            fast = "" if d["speed_m_s"] is None else f", {d['speed_m_s']:.1f} m/s"
            cause = {"initial": "from the start", "rail break": "broken rail"}.get(
                d["cause"], d["cause"]
            )
            trucks = " and ".join(dict.fromkeys(t["truck"] for t in row["trucks"] if t["truck"]))
            which = f" ({trucks} truck{'s' if ' and ' in trucks else ''})" if trucks else ""
            lines.append(f"    derailed  {d['time_s']:7.2f} s{track}{fast}: {cause}{which}")
        for key, end in (("parted_front", "front"), ("parted_rear", "rear")):
            p = row[key]
            if p:
                lines.append(f"    parted    {p['time_s']:7.2f} s {end}, from car {p['from']}")
        struck = sorted(row["struck"], key=lambda s: -s["force_N"])
        for s in struck[:4]:
            verb = "struck by" if s["struck_by_it"] else "struck"
            lines.append(
                f"    {verb:<9} {s['time_s']:7.2f} s car {s['other_car']},"
                f" {words.force(s['force_N'])}"
            )
        if len(struck) > 4:
            more = len(struck) - 4
            lines.append(f"              and {more} lighter one{'s' if more > 1 else ''}")
        rest = row["at_rest"]
        end = row["end"]
        where = words.place(end["x_m"], end["y_m"])
        turned = math.degrees(math.remainder(end["yaw_rad"], 2 * math.pi))
        heading = f"{words.coordinate(turned, 0)}°"
        if rest:
            lines.append(f"    at rest   {rest['time_s']:7.2f} s at {where}, heading {heading}")
            if row["pushed_on_until_s"] is not None:
                lines.append(f"              pushed on until {row['pushed_on_until_s']:.2f} s")
        else:
            lines.append(f"    last seen           at {where}, heading {heading}")
    if quiet:
        lines.append(f"  {_capital(words.cars(quiet))}: on the rails, coupled and not struck")
    return lines


def _cargo(row: dict[str, Any]) -> str:
    contents = row["contents"]
    return "" if not contents or contents in row["name"] else contents


def final_scene(run: RecordedRun) -> Scene:
    """The scene at the end of the recording, with its title."""
    return scene_at(run, float(run.time[-1]), run.title, words.sentence(run))
