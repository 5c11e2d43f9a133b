"""The source's statements about its runs, and whether they hold for this model.

Each statement is judged by a tolerance that is written beside it. Statements on the validation
run are judged over its ensemble, a statement that holds in at least half of the runs is kept;
those on the base train are judged on its variations.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from derail_ros import models
from derail_ros.scenario import load_scenario
from derail_ros.studies.ensemble import Job, Stopped, ensemble_jobs
from derail_ros.studies.published import NOISE
from derail_ros.studies.records import Ensemble
from derail_ros.vocabulary.events import Collision
from derail_ros.vocabulary.outcome import Outcome
from derail_ros.vocabulary.words import count, number_list

F64 = NDArray[np.float64]

SAMPLE = 0.05
"""Time between two samples of a trace, s."""

WINDOW = 0.5
"""A collision is the published one within this time of it, s."""

STANDING = 0.5
"""A car stands below this speed, m/s."""

SPEED_TOLERANCE = 0.1
SEVEN, APART = 7.0, 0.1
"""The first seven seconds, s, are identical within this distance, m."""

LITTLE = 5e6
"""Cars struck by less are little damaged, N."""

LENGTHS = (30, 48, 72, 90)
SCALES = (0.5, 0.8, 1.2, 1.5)
"""Variations of the base train: number of cars; factors on brake force and on the ground."""


@dataclass(frozen=True)
class Statement:
    """A statement of the source."""

    name: str
    text: str  # what it says
    tolerance: str  # by which it is judged
    found: str
    kept: bool

    def as_dict(self) -> dict[str, Any]:
        """As plain data."""
        return {
            "statement": self.name,
            "text": self.text,
            "tolerance": self.tolerance,
            "found": self.found,
            "kept": self.kept,
        }


@dataclass(frozen=True)
class Trace:
    """A run with what an outcome does not hold, at T samples of N cars."""

    outcome: Outcome
    collisions: Sequence[Collision]
    time: F64  # (T,) s
    position: F64  # (T, N, 2) m
    speed: F64  # (T, N) m/s

    def speeds_at(self, t: float) -> F64:
        """(N,) speeds at a time, linear between the samples; the last ones after the end."""
        return np.array([np.interp(t, self.time, column) for column in self.speed.T])


@dataclass(frozen=True)
class TraceKey:
    """Key of a job that is traced, up to a time (s)."""

    name: str
    until: float = float("inf")


def trace(job: Job, stop: Callable[[], bool]) -> Trace:
    """Run a job whose key is a :class:`TraceKey` and sample it on its way."""
    run = models.build(job.params())
    times, places, speeds = [], [], []
    t = 0.0
    while t < job.key.until:
        run.advance_to(t)
        now = run.sample(min(t, run.time))
        times.append(now.time)
        places.append(now.pose[:, :2])
        speeds.append(np.hypot(*now.velocity[:, :2].T))
        if run.ended:
            break
        if stop():
            raise Stopped
        t += SAMPLE
    return Trace(
        run.outcome(), run.collisions, np.array(times), np.array(places), np.array(speeds)
    )


def traced_jobs(
    text: Mapping[str, Any], members: int, seed: int, settings: Mapping[str, Any]
) -> Iterator[Job]:
    """The traced runs that the statements need; none without a text."""
    if not text:
        return
    validation = load_scenario("mississauga_published").with_overrides(settings)
    yield from ensemble_jobs(validation, members, seed=seed, key=TraceKey("validation"))
    base = load_scenario("base_train").with_overrides(settings)
    yield Job(base, key=TraceKey("base", SEVEN))
    for path, values in (("train.consist.0.count", LENGTHS), ("brakes.force_scale", SCALES)):
        for value in values:
            yield Job(base, {path: value}, key=TraceKey(f"{path}={value}", SEVEN))


def ground_jobs(
    text: Mapping[str, Any], members: int, seed: int, settings: Mapping[str, Any]
) -> Iterator[Job]:
    """The base train with the ground reaction raised and lowered; key: the factor."""
    for scale in SCALES if text else ():
        changed = load_scenario("base_train").with_overrides({**settings, "ground.scale": scale})
        yield from ensemble_jobs(changed, members, seed=seed, key=("ground", scale))


def judge(
    text: Mapping[str, Any],
    traces: Mapping[TraceKey, Sequence[Trace]],
    cases: Mapping[str, Ensemble],
    ground: Mapping[float, Ensemble],
) -> list[Statement]:
    """All statements.

    Parameters
    ----------
    text : ``data/published.yaml``, its section text
    traces : of :func:`traced_jobs`
    cases : name of a published case -> its ensemble
    ground : factor on the ground reaction -> ensemble of the base train
    """
    runs = [t for t in traces[TraceKey("validation")] if not t.outcome.void]
    found: list[Statement] = []
    if runs:
        found += [_collision(runs, c) for c in text["collisions"]]
        found += [_speed(runs, c) for c in text["collisions"] if "speed_mps" in c]
        found += [_standing(runs, s) for s in text["standing"]]
        found += [
            _above(runs, text["cars_above_10MN"]),
            _worst(runs, text["worst_damaged"], text["cars_above_10MN"]),
            _front_three(runs),
        ]
    return [
        *found,
        _seven("lengths", "train.consist.0.count", LENGTHS, traces),
        _seven("brake forces", "brakes.force_scale", SCALES, traces),
        _quotient(cases),
        _area("mass", cases["base_60"], {n: cases[n] for n in ("base_34t", "base_102t")}),
        _area("ground", cases["base_60"], {f"x {k:g}": e for k, e in ground.items()}),
    ]


# The validation run --------------------------------------------------------------------------


def _found(run: Trace, published: Mapping[str, Any]) -> Collision | None:
    """The hardest collision of the pair, whichever struck, near its published time."""
    near = [
        c
        for c in run.collisions
        if {c.car_a, c.car_b} == set(published["pair"])
        and abs(c.peak_time - published["time_s"]) <= WINDOW
    ]
    return max(near, key=lambda c: c.peak_force, default=None)


def _collision(runs: Sequence[Trace], published: Mapping[str, Any]) -> Statement:
    a, b = published["pair"]
    noise = NOISE["peak_force_N"]
    seen = [c for run in runs if (c := _found(run, published)) is not None]
    found, kept = f"in {len(seen)} of {count(len(runs), 'run')}", False
    if seen:
        force = np.array([c.peak_force for c in seen])
        low, high = np.quantile(force, [0.05, 0.95]) * [1.0 - noise, 1.0 + noise]
        kept = 2 * len(seen) >= len(runs) and low <= published["force_N"] <= high
        when = np.mean([c.peak_time for c in seen])
        found += f"; mean {force.mean() / 1e6:.2f} MN at {when:.2f} s"
    return Statement(
        f"collision {a}-{b}",
        f"{a} into {b}: {published['force_N'] / 1e6:.2f} MN at {published['time_s']:.2f} s",
        f"the pair collides within {WINDOW:g} s of it in half of the runs, and the force lies in "
        f"the 90 % band widened by {100 * noise:g} %",
        found,
        bool(kept),
    )


def _speed(runs: Sequence[Trace], published: Mapping[str, Any]) -> Statement:
    a, b = published["pair"]
    said = published["speed_mps"]
    speeds = []
    for run in runs:
        collision = _found(run, published)
        if collision is not None:
            speeds.append(run.speeds_at(collision.start)[a - 1])
    near = [abs(v - said) <= SPEED_TOLERANCE * said for v in speeds]
    mean = f", mean {np.mean(speeds):.1f} m/s" if speeds else ""
    return Statement(
        f"speed {a}-{b}",
        f"car {a} has {said:g} m/s just before it strikes {b}",
        f"within {100 * SPEED_TOLERANCE:g} % as the contact begins, in half of the runs",
        f"in {sum(near)} of {count(len(runs), 'run')}{mean}",
        2 * sum(near) >= len(runs),
    )


def _standing(runs: Sequence[Trace], published: Mapping[str, Any]) -> Statement:
    cars, t = published["cars"], published["time_s"]
    limit = published.get("below_mps", STANDING)
    speeds = np.array([run.speeds_at(t)[np.array(cars) - 1].max() for run in runs])
    good = int((speeds < limit).sum())
    word = "stand" if limit == STANDING else "almost stand"
    subject, s = ("car", "s") if len(cars) == 1 else ("cars", "")
    return Statement(
        f"{word.replace(' ', '_')} {t:g}",
        f"at {t:.2f} s {subject} {number_list(cars)} {word}{s}",
        f"below {limit:g} m/s in half of the runs",
        f"in {good} of {count(len(runs), 'run')}; fastest {np.median(speeds):.1f} m/s (median)",
        2 * good >= len(runs),
    )


def _often_above(runs: Sequence[Trace]) -> NDArray[np.bool_]:
    """(N,) the car is struck above 10 MN in at least half of the runs."""
    return np.mean([run.outcome.car_peak_force > 10e6 for run in runs], axis=0) >= 0.5


def _above(runs: Sequence[Trace], published: Sequence[int]) -> Statement:
    above = _often_above(runs)[:24]
    said = np.isin(np.arange(1, 25), published)
    agree = int((above == said).sum())
    return Statement(
        "cars_above_10MN",
        f"cars {number_list(published)} are struck above 10 MN, the others of 24 are not",
        "18 of the 24 cars agree, judged by half of the runs",
        f"{agree} agree; above: {number_list(np.flatnonzero(above) + 1)}",
        agree >= 18,
    )


def _worst(runs: Sequence[Trace], worst: Sequence[int], published: Sequence[int]) -> Statement:
    above = set(np.flatnonzero(_often_above(runs)) + 1)
    own, theirs = len(above & set(worst)), len(set(published) & set(worst))
    return Statement(
        "worst_damaged",
        f"of the {len(worst)} cars worst damaged in the accident {theirs} are struck above 10 MN",
        "as many or more, judged by half of the runs",
        f"{own}",
        own >= theirs,
    )


def _front_three(runs: Sequence[Trace]) -> Statement:
    force = np.array([run.outcome.car_peak_force[:3].max() for run in runs])
    good = int((force < LITTLE).sum())
    return Statement(
        "front_three",
        "the front three cars are little damaged",
        f"below {LITTLE / 1e6:g} MN in half of the runs",
        f"in {good} of {count(len(runs), 'run')}; median {np.median(force) / 1e6:.1f} MN",
        2 * good >= len(runs),
    )


# The base train ------------------------------------------------------------------------------


def _seven(
    what: str, path: str, values: Sequence[float], traces: Mapping[TraceKey, Sequence[Trace]]
) -> Statement:
    apart = []
    for value in values:
        both = [*traces[TraceKey("base", SEVEN)], *traces[TraceKey(f"{path}={value}", SEVEN)]]
        if len(both) < 2:  # one failed
            apart.append(np.inf)
            continue
        base, other = both
        n = min(base.position.shape[1], other.position.shape[1])
        off = base.position[:, :n] - other.position[:, :n]
        apart.append(float(np.hypot(off[..., 0], off[..., 1]).max()))
    listed = ", ".join(f"{d:.2g} m at {v:g}" for d, v in zip(apart, values, strict=True))
    return Statement(
        f"seven_seconds {what}",
        f"the first seven seconds are identical for all {what}",
        f"positions of all cars within {APART:g} m",
        listed,
        max(apart) <= APART,
    )


def _quotient(cases: Mapping[str, Ensemble]) -> Statement:
    base = cases["base_60"].mean()
    others = [e.mean() for name, e in cases.items() if name.startswith("base_lv_")]
    cars = max(abs(e["cars_derailed"] - base["cars_derailed"]) for e in others)
    length = max(abs(e["scene_length_m"] / base["scene_length_m"] - 1.0) for e in others)
    return Statement(
        "quotient",
        "almost no change with the derailment quotient, from 1.0 to 3.0",
        "mean number of cars derailed within 1.0, mean length of the scene within 15 %",
        f"cars within {cars:.1f}, length within {100 * length:.0f} %",
        cars <= 1.0 and length <= 0.15,
    )


def _area(what: str, base: Ensemble, others: Mapping[str, Ensemble]) -> Statement:
    area = base.mean()["scene_area_m2"]
    found = {k: e.mean()["scene_area_m2"] for k, e in others.items()}
    listed = ", ".join(f"{k.removeprefix('base_')}: {v:.0f}" for k, v in found.items())
    return Statement(
        f"area {what}",
        f"the area of the scene grows when the {what} is raised or lowered",
        "the mean area is above the base train's in all variations",
        f"base {area:.0f} m2; {listed}",
        all(v > area for v in found.values()),
    )
