"""What happened in a run, as plain data and as text."""

from __future__ import annotations

import dataclasses
import math
import re
import textwrap
from collections.abc import Mapping
from hashlib import sha256
from typing import TYPE_CHECKING, Any

import numpy as np

import derail_ros
from derail_ros.vocabulary import words
from derail_ros.vocabulary.events import Event, EventKind
from derail_ros.vocabulary.ledger import shares, stopped_by
from derail_ros.vocabulary.limits import late_brakes, limits, train_force_limits
from derail_ros.vocabulary.measures import NUMERICS, outcome_record, shown_rows
from derail_ros.vocabulary.site import site_rows
from derail_ros.vocabulary.status import AT_REST
from derail_ros.vocabulary.words import capital, finite

if TYPE_CHECKING:
    from derail_ros.recording.recorded_run import RecordedRun
    from derail_ros.vocabulary.events import Collision

SCHEMA = "derail_ros/review"
SCHEMA_VERSION = 2
"""Version of :func:`findings`; 1 had an outcome with keys of its own."""
NOTABLE = 1.0e6
"""Collisions from here on are part of the timeline, N."""


def headline(run: RecordedRun) -> list[str]:
    """Outcome and what stopped the train, in a sentence each."""
    return [f"{capital(run.outcome.text)}.", stopped_by(_ledger(run))]


def _ledger(run: RecordedRun) -> Mapping[str, float]:
    """The energy ledger at the end, J."""
    return run.ledger() or run.outcome.energy


# --- cars ------------------------------------------------------------------------------------


def _resting(run: RecordedRun, x: float, y: float, yaw: float) -> dict[str, float]:
    """Pose at the end, and where that is along the track and to its left."""
    track, left = run.line.locate(x, y)
    return {"x_m": x, "y_m": y, "yaw_rad": yaw, "track_m": track, "left_m": left}


def car_findings(run: RecordedRun) -> list[dict[str, Any]]:
    """Findings for each car: where and when it derailed, parted, was struck, came to rest."""
    cars, outcome, end = run.cars, run.outcome, run.plane[-1]
    rows: list[dict[str, Any]] = [
        {
            "car": i + 1,
            "name": cars.name[i],
            "type": cars.kind[i],
            "contents": cars.contents[i],
            "represents": int(cars.represents[i]),
            "derailed": None,
            "trucks": [],
            "parted_front": None,
            "parted_rear": None,
            "struck": [],
            "peak_force_N": float(outcome.car_peak_force[i]),
            "peak_force_from": int(outcome.car_peak_other[i]) or None,
            "peak_force_time_s": finite(outcome.car_peak_time[i]),
            "at_rest": None,
            "pushed_on_until_s": None,
            "end": _resting(run, *map(float, end[i, :3])),
        }
        for i in range(run.n)
    ]
    for e in run.events:
        if not e.cars or e.cars[0] > run.n:
            continue
        row = rows[e.cars[0] - 1]
        if e.kind == EventKind.TRUCK_DERAILED:
            found = _moment(e) | {"truck": e.end, "cause": e.cause}
            row["trucks"].append(found)
            row["derailed"] = row["derailed"] or found
        elif e.kind == EventKind.COUPLER_PARTED and len(e.cars) > 1:
            found = _moment(e) | {"cause": e.cause, "angle_rad": finite(e.value)}
            row["parted_rear"] = found | {"from": e.cars[1]}
            if e.cars[1] <= run.n:
                rows[e.cars[1] - 1]["parted_front"] = found | {"from": e.cars[0]}
        elif e.kind == EventKind.CAR_AT_REST:
            row["at_rest"] = _moment(e)  # the last time counts: a car may be pushed on
            row["pushed_on_until_s"] = _pushed_on(run, e.cars[0] - 1, e.time)
    for c in run.collisions:
        for car, other in ((c.car_a, c.car_b), (c.car_b, c.car_a)):
            if 1 <= car <= run.n:
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
        "x_m": finite(e.x),
        "y_m": finite(e.y),
        "track_m": finite(e.track_coordinate),
        "speed_m_s": finite(e.speed),
    }


# --- collisions and timeline -----------------------------------------------------------------


def by_severity(run: RecordedRun) -> list[Collision]:
    """The collisions, the hardest first."""
    return sorted(run.collisions, key=lambda c: (-c.peak_force, c.id))


UNITS = {
    "time": "_s", "start": "_s", "end": "_s", "peak_time": "_s", "peak_resultant_time": "_s",
    "x": "_m", "y": "_m", "z": "_m", "track_coordinate": "_m", "speed": "_m_s",
    "closing_speed": "_m_s", "peak_force": "_N", "peak_resultant": "_N", "angle": "_rad",
    "energy_lost": "_J",
}  # fmt: skip
"""Unit of a number of an event or a collision, as its name in files ends with."""


def fields_of(item: Event | Collision) -> dict[str, Any]:
    """The fields of an event or a collision by their names with the unit."""
    found = {f.name: getattr(item, f.name) for f in dataclasses.fields(item)}
    return {k + UNITS.get(k, "") if isinstance(v, float) else k: v for k, v in found.items()}


def collision_finding(c: Collision) -> dict[str, Any]:
    """A collision as plain data."""
    found = {k: finite(v) if isinstance(v, float) else v for k, v in fields_of(c).items()}
    return found | {"touch": c.touch, "text": c.text}


def _entry(kind: EventKind, cars: list[int], text: str, **more: Any) -> dict[str, Any]:
    return {"kind": kind.word, "cars": cars, "cause": "", "text": text} | more


def timeline(run: RecordedRun) -> list[dict[str, Any]]:
    """Events and notable collisions in order of time; similar ones share an entry."""
    entries: list[dict[str, Any]] = []
    signals: list[Event] = []
    rests: dict[int, Event] = {}  # of each car the last one
    for e in run.events:
        if e.kind == EventKind.BRAKE_SIGNAL_REACHED and e.cars:
            signals.append(e)
        elif e.kind == EventKind.CAR_AT_REST and e.cars:
            rests[e.cars[0]] = e
        else:
            entries.append(_entry(e.kind, list(e.cars), e.text, **_moment(e), cause=e.cause))
    if signals:
        cars = sorted(e.cars[0] for e in signals)
        first, last = signals[0].time, signals[-1].time
        text = f"the brake signal runs through {words.cars(cars)}, the last at {last:.2f} s"
        if len(cars) == 1:
            text = signals[0].text
        more = {"time_s": first, "until_s": last, "cause": signals[0].cause}
        entries.append(_entry(EventKind.BRAKE_SIGNAL_REACHED, cars, text, **more))
    for group in _together(sorted(rests.values(), key=lambda e: e.time)):
        cars = sorted(e.cars[0] for e in group)
        text = f"{words.cars(cars)} come{'s' if len(cars) == 1 else ''} to rest"
        entries.append(_entry(EventKind.CAR_AT_REST, cars, text, **_moment(group[0])))
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
    return sorted(entries, key=lambda e: (e["time_s"], e["kind"] == "run_ended"))


def _together(events: list[Event], within: float = 0.1) -> list[list[Event]]:
    """Events in order of time in groups, each no longer than ``within`` s."""
    groups: list[list[Event]] = []
    for e in events:
        if groups and e.time <= groups[-1][0].time + within:
            groups[-1].append(e)
        else:
            groups.append([e])
    return groups


# --- all of it -------------------------------------------------------------------------------


def findings(run: RecordedRun) -> dict[str, Any]:
    """What happened in a run, as data for JSON; ``outcome`` as in ``derail simulate --json``."""
    text, stopped = headline(run)
    return {
        "schema": SCHEMA,
        "schema_version": SCHEMA_VERSION,
        "derail_ros": derail_ros.__version__,
        "text": text,
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
            "constants": run.scenario.get("constants") or "published",
            "model": run.model,
            "cars": run.cars.totals.cars,
            "bodies": run.n,
            "initial_speed_m_s": run.initial_speed,
            "files": {name: sha256(data).hexdigest() for name, data in run.files.items()},
        },
        "outcome": outcome_record(run.outcome),
        "limits": _limits(run),
        "stopped_by": {
            "text": stopped,
            "shares": [
                {"entry": e.key, "words": e.words, "energy_J": taken, "share": finite(share)}
                for e, taken, share in shares(_ledger(run))
            ],
        },
        "timeline": timeline(run),
        "collisions": [collision_finding(c) for c in by_severity(run)],
        "cars": car_findings(run),
        "commands": list(run.commands),
    }


def _limits(run: RecordedRun) -> list[str]:
    draft, buff = ([run.outcome.largest(which)[0]] for which in ("draft", "buff"))
    couplers = run.scenario.get("couplers") or {}
    breaks = any(couplers.get(f"{part}_strength_N") for part in ("knuckle", "body"))
    found = limits(run.outcome, run.line) + late_brakes(run.events)
    return found + train_force_limits(draft, buff, breaks)


# --- text ------------------------------------------------------------------------------------


def text(run: RecordedRun, facts: dict[str, Any] | None = None) -> str:
    """What happened in a run, as text."""
    facts = findings(run) if facts is None else facts
    lines: list[str] = [run.title, "=" * len(run.title), ""]
    for sentence in headline(run):
        lines += _wrap(sentence, 96)
    constants = facts["scenario"]["constants"]
    lines += _wrap(f"This is one possible run, with {constants} constants; another draw or push "
                   "gives another outcome (derail simulate --ensemble).", 96)  # fmt: skip
    if run.outcome.void:
        lines.append(NOT_VALID)
    lines += ["", *_outcome(run, facts["outcome"])]
    for sentence in facts["limits"]:
        lines += _wrap(f"{capital(sentence)}.", 96)

    def section(title: str, rows: list[str]) -> None:
        lines.extend(["", title, "-" * len(title), *rows])

    if run.warnings:
        section("Warnings", [f"  {w}" for w in run.warnings])
    happened = []
    for entry in facts["timeline"]:
        first, *rest = _wrap(capital(entry["text"]), 84)
        happened.append(f"{entry['time_s']:8.2f} s  {first}")
        happened += [" " * 12 + more for more in rest]
    section("What happened", happened)
    section("Collisions, the hardest first", _collisions(run))
    section("Cars", _cars(facts["cars"]))
    if run.commands:
        answers = ("" if c["accepted"] else f"  refused: {c['message']}" for c in run.commands)
        section(
            "Commands",
            [
                f"{c['time']:8.2f} s  {c['command']} {c['request']}{answer}"
                for c, answer in zip(run.commands, answers)
            ],
        )
    span = f"{run.time[0]:.2f} s to {run.time[-1]:.2f} s"
    numerics = shown_rows(facts["outcome"], (NUMERICS,))
    section(
        "Recording",
        [
            f"  {run.path}",
            f"  run {run.run_id}, {len(run.time)} states, {span}",
            f"  scenario {run.name} {run.scenario_hash}",
            f"  constants {facts['scenario']['constants']}",
            *(
                f"  made from {name} sha256:{digest}"
                for name, digest in facts["scenario"]["files"].items()
            ),
            f"  computed by derail_ros {run.software}",
            *(f"  {title}: {value}" for title, value in numerics),
        ],
    )
    return "\n".join(lines) + "\n"


NOT_VALID = "Not a valid run: a body that stands for many cars reached the break."


def _wrap(line: str, width: int) -> list[str]:
    # A number stays with its unit.
    tied = re.sub(r"(?<=\d) (?=(?:m|m/s|km/h|s|MN|kN|%|[GMk]?J)\b|%)", "\0", line)
    return [part.replace("\0", " ") for part in textwrap.wrap(tied, width)] or [""]


def _outcome(run: RecordedRun, record: dict[str, Any]) -> list[str]:
    o = run.outcome
    status = o.status if o.final else f"{o.status} (the end is not recorded)"
    rows = [("status", status), ("train", record["train"]["text"])]
    rows.append(("speed at the start", words.speed(run.initial_speed)))
    if record["braked"] is False:
        rows.append(("brakes", "never applied"))
    rows += shown_rows(record, without=("rear_stop_m",))
    if o.rear_part_first_car:
        # Only a parted coupling ahead makes it a part of its own.
        parted = not run.coupled[-1][: o.rear_part_first_car - 1].all()
        rest = " stands" if o.status == AT_REST else ""
        label = f"rear part{rest}" if parted else "still on the rails"
        at = o.rear_part_coordinate
        stop = f" at {words.coordinate(at)} m" if math.isfinite(at) else ""
        rows.append((label, f"from car {o.rear_part_first_car} on, its front truck{stop}"))
    rows += site_rows(record["site"])
    width = 2 + max(len(label) for label, _ in rows)
    return [f"  {label:<{width}}{value}" for label, value in rows]


SHOWN = 40
"""Collisions in the table."""
STRUCK = 4
"""Collisions of one car."""


def _collisions(run: RecordedRun) -> list[str]:
    ranked = by_severity(run)
    if not ranked:
        return ["  none"]
    lines = ["  striking  struck   force   time     closing  angle   energy    where touched"]
    lines += [
        f"  {c.car_a:>8}  {c.car_b or c.object:>6}  {c.peak_force * 1e-6:5.2f} MN"
        f" {c.peak_time:6.2f} s  {c.closing_speed:4.1f} m/s  {math.degrees(c.angle):4.0f}°"
        f"  {words.energy(c.energy_lost):>8}   {c.touch}"
        for c in ranked[:SHOWN]
    ]
    rest = ranked[SHOWN:]
    if rest:
        lines.append(f"  and {len(rest)} more, none above {words.force(rest[0].peak_force)}")
    return lines


CAUSES = {"initial": "from the start", "rail break": "broken rail"}


def _cars(rows: list[dict[str, Any]]) -> list[str]:
    lines: list[str] = []
    quiet: list[int] = []

    def tell(verb: str, time: float | None, rest: str) -> None:
        when = "" if time is None else f"{time:.2f} s"
        lines.append(f"    {verb:<9} {when:>9} {rest}")

    for row in rows:
        if not (row["derailed"] or row["struck"] or row["parted_front"] or row["parted_rear"]):
            quiet.append(row["car"])
            continue
        contents = row["contents"] if row["contents"] not in row["name"] else ""
        about = ", ".join(filter(None, [row["name"], contents]))
        lines.append(f"  Car {row['car']}{': ' + about if about else ''}")
        if d := row["derailed"]:
            track = "" if d["track_m"] is None else f"at {words.coordinate(d['track_m'])} m"
            fast = "" if d["speed_m_s"] is None else f"{d['speed_m_s']:.1f} m/s"
            cause = CAUSES.get(d["cause"], d["cause"])
            trucks = list(dict.fromkeys(t["truck"] for t in row["trucks"] if t["truck"]))
            which = f" ({words.joined(trucks)} truck{'s' * (len(trucks) > 1)})" if trucks else ""
            where = ", ".join(filter(None, [track, fast]))
            tell("derailed", d["time_s"], f"{where}: {cause}{which}")
        for end in ("front", "rear"):
            if p := row[f"parted_{end}"]:
                tell("parted", p["time_s"], f"{end}, from car {p['from']}")
        struck = sorted(row["struck"], key=lambda s: -s["force_N"])
        for s in struck[:STRUCK]:
            verb = "struck by" if s["struck_by_it"] else "struck"
            tell(verb, s["time_s"], f"car {s['other_car']}, {words.force(s['force_N'])}")
        if len(struck) > STRUCK:
            lines.append(f"{'':14}and {words.count(len(struck) - STRUCK, 'lighter one')}")
        end = row["end"]
        turned = math.degrees(math.remainder(end["yaw_rad"], 2 * math.pi))
        heading = f"heading {words.coordinate(turned, 0)}°"
        side = "left" if end["left_m"] > 0.0 else "right"
        off = f"{abs(end['left_m']):.1f} m {side} of the track"
        where = f"at {words.coordinate(end['track_m'])} m, {off}, {heading}"
        if rest := row["at_rest"]:
            tell("at rest", rest["time_s"], where)
            if row["pushed_on_until_s"] is not None:
                lines.append(f"{'':14}pushed on until {row['pushed_on_until_s']:.2f} s")
        else:
            tell("last seen", None, where)
    if quiet:
        lines.append(f"  {capital(words.cars(quiet))}: on the rails, coupled and not struck")
    return lines
