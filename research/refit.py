"""Fits the reconstructed constants to all published runs: ``python -m research.refit``.

Fitted are the brake force F0, the speed below which a car stands, and the two readings of the
brake tests that are limited by traction. Everything else is printed in the source, or is left as
it was chosen. For each value the ensembles of all published runs are computed, and

    count    sqrt(mean((mean - published)^2)), cars derailed
    duration the same, s
    length, width   sqrt(mean((mean / published - 1)^2))

One run gives the duration for every threshold of rest: it ends at the lowest, and its speeds are
sampled every 0.05 s.

``--search`` tries in the same way what may explain the differences that are left, and prints what
each trial does to them.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from derail_ros import models
from derail_ros.scenario import load_scenario
from derail_ros.studies.ensemble import Job, ensemble_jobs, gather
from derail_ros.studies.published import PublishedCase, load_published
from derail_ros.studies.records import ensembles
from derail_ros.studies.tables import Table
from derail_ros.studies.validation import NUMERICS, CaseResult, goals
from derail_ros.vocabulary.outcome import Outcome

F0_KN = (50, 56, 60, 62, 64, 66, 70)
REST = ((0.05, 0.01), (0.1, 0.02), (0.2, 0.035), (0.3, 0.05), (0.5, 0.1))
"""Thresholds: speed, m/s, and yaw rate, rad/s."""

HOLD = 0.5
SAMPLE = 0.05
TRACTION = [
    *((mu, 0.0) for mu in (0.15, 0.16, 0.3)),
    *((mu, delay) for mu in (0.25, 0.3) for delay in (2.5, 3.0, 3.5)),
]
"""Readings of the brake tests: coefficient, delay of the brakes in s."""


@dataclass
class Rests:
    """Samples of a run: largest speed and yaw rate of its cars."""

    time: list[float] = field(default_factory=list)
    speed: list[float] = field(default_factory=list)
    rate: list[float] = field(default_factory=list)

    def duration(self, speed: float, rate: float) -> float:
        """Start of the first half second in which all cars stand, s."""
        moving = (np.array(self.speed) >= speed) | (np.array(self.rate) >= rate)
        time = np.array(self.time)
        ends = [*time[moving], np.inf]
        begin = 0.0
        for end in ends:
            if end - begin >= HOLD:
                return begin
            begin = end + SAMPLE
        raise AssertionError


def task(job: Job, _stop: Callable[[], bool]) -> tuple[Outcome, Rests]:
    """A run to rest, its speeds sampled."""
    run = models.build(job.params())
    rests = Rests()
    t = 0.0
    while not run.ended:
        t += SAMPLE
        run.advance_to(t)
        if t > run.time:
            break
        now = run.sample(t)
        rests.time.append(t)
        rests.speed.append(float(np.hypot(*now.velocity[:, :2].T).max()))
        rests.rate.append(float(np.abs(now.velocity[:, 5]).max()))
    return run.outcome(), rests


def compute(
    cases: Sequence[tuple[str, PublishedCase, Mapping[str, Any]]], members: int
) -> dict[str, list[tuple[Outcome, Rests]]]:
    """Name -> the runs that count of each ``(name, case, settings)``."""

    def jobs() -> Iterator[Job]:
        for name, case, settings in cases:
            low = {"integration.rest_speed_m_per_s": REST[0][0],
                   "integration.rest_yaw_rate_rad_per_s": REST[0][1]}  # fmt: skip
            scenario = load_scenario(case.scenario)
            scenario = scenario.with_overrides({**case.overrides, **settings, **low})
            yield from ensemble_jobs(scenario, members, key=name)

    found = gather(jobs(), jobs=1, task=task)
    return {k: [r.value for r in rs if not r.value[0].void] for k, rs in found.items()}


def _rms(values: Sequence[float]) -> str:
    return f"{np.sqrt(np.mean(np.square(values))):.3f}"


def rows_of(
    cases: Sequence[PublishedCase], runs: Mapping[str, Sequence[tuple[Outcome, Rests]]]
) -> list[list[str]]:
    """For each threshold of rest: rms of count, duration, length, width over the cases."""

    def off(key: str, value: Callable[[Any], float], relative: bool = False) -> list[float]:
        known = [(c.published[key], runs[c.name]) for c in cases if key in c.published]
        means = [(p, float(np.mean([value(r) for r in of]))) for p, of in known]
        return [m / p - 1.0 if relative else m - p for p, m in means]

    count = _rms(off("cars_derailed", lambda r: r[0].cars_derailed))
    size = [
        _rms(off(f"scene_{what}_m", lambda r, w=what: getattr(r[0], f"scene_{w}"), True))
        for what in ("length", "width")
    ]
    rows = []
    for speed, rate in REST:
        late = off("duration_s", lambda r, s=speed, w=rate: r[1].duration(s, w))
        rows.append([f"{speed:g}, {rate:g}", count, _rms(late), f"{np.mean(late):+.2f}", *size])
    return rows


TYPES = {"F79": 0.788, "F73": 1.22}
"""Coupler types of the published runs and their striker arms, m."""


def _k1(of: Callable[[float], float]) -> dict[str, Any]:
    return {f"couplers.types.{name}": {"k1_N_per_m": of(arm)} for name, arm in TYPES.items()}


SEARCH: dict[str, dict[str, Any]] = {
    "as it is": {},
    "gap law sech2": {"contact.gap_law": "sech2"},
    "gap law quartic": {"contact.gap_law": "quartic"},
    "gap law lorentzian": {"contact.gap_law": "lorentzian"},
    "held inside": {"contact.inside": "held"},
    "k1 in N/rad (4.0 MN/m for all types)": _k1(lambda arm: 4.0e6),
    "k1 in N m/rad": _k1(lambda arm: 4.0e6 / arm),
    "k2 30 MN/m": {"couplers.k2_N_per_m": 30e6},
    "k2 100 MN/m": {"couplers.k2_N_per_m": 100e6},
    "k2 170 MN/m": {"couplers.k2_N_per_m": 170e6},
    "striker damper 0": {"couplers.damping_N_s_per_m": 0.0},
    "striker damper 40 kN s/m": {"couplers.damping_N_s_per_m": 40e3},
    "couplers of 2 t m2": {"couplers.inertia_kg_m2": 2000.0},
    "F-F heads part at 0.60 rad": {"derailment.knuckle_limit_ff_rad": 0.60},
    "F-F heads part at 0.80 rad": {"derailment.knuckle_limit_ff_rad": 0.80},
    "c_v 0.02 s/m": {"ground.c_v_s_per_m": 0.02},
    "c_v 0.04 s/m": {"ground.c_v_s_per_m": 0.04},
    "brakes 3 s late, F0 80 kN": {"brakes.delay_s": 3.0, "brakes.force_N": 80e3},
    "lateral derailment breaks the rail": {"derailment.break_follows_lateral": True},
    "push of 25 kN": {"initiation.lateral_force_N": 25e3},
    "push of 100 kN": {"initiation.lateral_force_N": 100e3},
}
"""What may explain the differences that are left."""


def search(members: int) -> Table:
    """What each trial does: goals over all cases, and the differences that are open."""
    published = load_published()
    cases = {c.name: c for c in published.cases}
    rows = []
    for words, settings in SEARCH.items():

        def jobs(settings: Mapping[str, Any] = settings) -> Iterator[Job]:
            for name, case in cases.items():
                scenario = load_scenario(case.scenario)
                scenario = scenario.with_overrides({**case.overrides, **settings})
                yield from ensemble_jobs(scenario, members, key=name)

        found = ensembles(jobs(), jobs=1)
        results = [CaseResult(c, found[name]) for name, c in cases.items()]
        reached = {g.name: g.value for g in goals(results, published.goals)}
        chosen = ("count_rms", "duration_rms_s", "length_rms", "width_rms", "pair_share")
        light, slow = found["base_34t"].mean(), found["base_30"].mean()
        strikes = found["mississauga"].pairs
        rows.append([
            words, *(f"{reached[name]:.2f}" for name in chosen), f"{reached['pair_cases']:.0f}",
            f"{light['scene_width_m']:.1f}", f"{slow['cars_derailed']:.1f}",
            f"{slow['peak_force_N'] / 1e6:.1f}", next(iter(strikes), "-"),
        ])  # fmt: skip
        print(rows[-1], file=sys.stderr, flush=True)
    heads = ["trial", "count", "duration", "length", "width", "pair", "cases with it",
             "width at 34 t (33.8)", "cars at 30 km/h (5)", "MN (0.78)",
             "hardest at Mississauga (11-9)"]  # fmt: skip
    return Table(heads, rows)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser("python -m research.refit", description=__doc__)
    parser.add_argument("-n", "--ensemble", type=int, default=10, help="runs each")
    parser.add_argument("--numerics", choices=tuple(NUMERICS), default="shipped")
    parser.add_argument("--force", type=float, nargs="*", default=F0_KN, help="F0, kN")
    parser.add_argument("--search", action="store_true", help="what may explain the rest")
    given = parser.parse_args()
    if given.search:
        print(search(given.ensemble).markdown())
        return
    numerics = NUMERICS[given.numerics]
    cases = load_published().cases
    braked = [c for c in cases if "traction" not in c.name]
    limited = [c for c in cases if "traction" in c.name]
    heads = ["F0 (kN)", "rest (m/s, rad/s)", "count", "duration", "mean", "length", "width"]
    rows: list[list[str]] = []
    for force in given.force:
        settings = {**numerics, "brakes.force_N": 1e3 * force}
        runs = compute([(c.name, c, settings) for c in braked], given.ensemble)
        rows += [[f"{force:g}", *row] for row in rows_of(braked, runs)]
        print(Table(heads, rows[-len(REST) :]).markdown(), flush=True)
    rows = []
    for mu, delay in TRACTION:
        settings = {**numerics, "brakes.traction_coefficient": mu, "brakes.delay_s": delay}
        runs = compute([(c.name, c, settings) for c in limited], given.ensemble)
        cells = [f"{mu:g}", f"{delay:g}"]
        for case in limited:
            of = runs[case.name]
            pair = case.published["peak_force_pair"]
            hit = np.mean([set(o.peak_force_pair or ()) == set(pair) for o, _ in of])
            cells += [f"{np.mean([o.cars_derailed for o, _ in of]):.1f}"]
            cells += [f"{np.mean([r.duration(*REST[3]) for _, r in of]):.2f}"]
            cells += [f"{np.mean([o.peak_force for o, _ in of]) / 1e6:.1f}", f"{hit:.1f}"]
        rows.append(cells)
    heads = ["mu", "delay (s)"]
    for case in limited:
        heads += [f"{case.name}: cars", "s", "MN", "pair"]
    print(Table(heads, rows).markdown())


if __name__ == "__main__":
    main()
