"""The investigated trains in ``docs/accidents.md``: reported and computed side by side."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from derail_ros.commands import common
from derail_ros.commands.common import CommandFailure, counting_runs
from derail_ros.engine import PlanarSimulation
from derail_ros.engine.track import Track
from derail_ros.models import engine_hash
from derail_ros.studies.ensemble import member_factor, vary
from derail_ros.studies.tables import Table
from derail_ros.vocabulary.events import EventKind
from derail_ros.vocabulary.params import TrackParams, TrainParams
from derail_ros.vocabulary.words import force, number_list
from research.pages import Options, fill, with_places

REPORTED = {
    "dublin_2015": ("21: the 11th to the 31st car", "a broken joint"),
    "minot_2002": ("31, from the 4th car on", "a broken rail"),
    "nickel_lake_2013": ("40 in two groups, 12 and 28", "not read: two places"),
    "waterfall_2011": ("11 cars of several platforms", "a switch"),
    "avondale_2010": ("15", "not read: a curve, under power"),
    "dugald_2009": ("none", "parted by a pull at a weak sill"),
    "brighton_2009": ("6", "compression after an undesired emergency"),
    "macmillan_yard_2019": ("9, the 26th to the 34th car, to the inside", "pull in a curve"),
}
"""Scenario -> cars derailed, and why, as the summary of the investigation has them."""

COUNTS = ("train", "reported", "computed, mean and range", "in the first run", "groups")
WAYS = ("train", "reported why", "first truck off", "first coupling parted", "to the inside",
        "largest forces, first run")  # fmt: skip


@dataclass(frozen=True)
class Run:
    """What a run says of how its train derailed; cars are counted behind the locomotives ahead."""

    cars: tuple[int, ...]
    began: str
    parted: str
    inside: int
    forces: str


def write(options: Options) -> None:
    """Run the trains and write their rows into the page; rows of the same engine and runs stay."""
    names = options.names or tuple(REPORTED)
    if unknown := [name for name in names if name not in REPORTED]:
        raise CommandFailure(f"{', '.join(unknown)}: none of {', '.join(REPORTED)}")
    text = with_places(options.page, ["trains"])
    members = options.members or 10
    counts: list[tuple[str, ...]] = []
    ways: list[tuple[str, ...]] = []
    for name in names:
        params = common.load(name).to_params()
        with counting_runs(name) as progress:
            runs = []
            for member in range(members):
                runs.append(_run(params, member_factor(options.seed, member)))
                progress(member + 1, members)
        cars, why = REPORTED[name]
        counts.append((f"`{name}`", cars, *_counted(runs)))
        began, parted = (_each(getattr(run, key) for run in runs) for key in ("began", "parted"))
        side = f"{runs[0].inside} of {len(runs[0].cars)}" if params.track.segments else ""
        ways.append((f"`{name}`", why, began, parted, side, runs[0].forces))
    about = (
        f"<sub>`python -m research trains`: {members} runs each; the first is the scenario, the "
        "others have the speed and the push that starts or disturbs the motion changed by at most "
        f"4 %, seed {options.seed}. Cars are counted behind the leading locomotives, those within "
        "the train among them; a platform of an articulated car is a car. "
        f"Engine {engine_hash()[:16]}.</sub>"
    )
    kept = text if about in text else ""
    tables = []
    for heads, fresh in ((COUNTS, counts), (WAYS, ways)):
        rows = {row[0]: row for row in (*_rows(kept, len(heads)), *fresh)}
        told = [rows[f"`{name}`"] for name in REPORTED if f"`{name}`" in rows]
        tables.append(Table(heads, told, texts=len(heads)).markdown())
    options.write(fill(text, {"trains": "\n\n".join((about, *tables))}), {})


def _rows(text: str, columns: int) -> list[tuple[str, ...]]:
    """Rows of a page's tables with so many columns."""
    rows = (tuple(line.strip("| ").split(" | ")) for line in text.splitlines())
    return [row for row in rows if len(row) == columns]


def _run(params: TrainParams, factor: float) -> Run:
    """One run, with its speed and push times ``factor``."""
    ahead = next(i for i, car in enumerate(params.cars) if not car.locomotives)
    start = replace(params.initiation, speed=params.initiation.speed * factor)
    run = PlanarSimulation(vary(replace(params, initiation=start), factor))
    began = "none"
    while not run.ended and began == "none":
        run.advance_steps(1)
        for event in run.events:
            if event.kind == EventKind.TRUCK_DERAILED:
                began = event.cause
                if began == "lateral force":
                    began += f", {_pressed(run, event.cars[0])}"
                break
    outcome = run.run()
    cars = outcome.derailed_cars
    forces = (
        f"{which} {force(value)} behind car {coupling - ahead}"
        for which in ("draft", "buff")
        for value, coupling, _ in [outcome.largest(which)]
    )
    return Run(
        tuple(int(car) - ahead for car in cars),
        began,
        outcome.parted[0].cause if outcome.parted else "none",
        sum(_inside(run.track, params.track, *outcome.pose[car - 1, :2]) for car in cars),
        ", ".join(forces),
    )


def _pressed(run: PlanarSimulation, car: int) -> str:
    """Whether a car was pulled or pushed more: "in draft" or "in buff"."""
    axial = run.sample().axial_force[max(car - 2, 0) : car]
    return "in draft" if axial[np.argmax(np.abs(axial))] > 0.0 else "in buff"


def _inside(track: Track, params: TrackParams, x: float, y: float) -> bool:
    """A place lies more than a metre to the side to which the track turns in all."""
    bend = sum((p.curvature_start + p.curvature_end) * p.length for p in params.segments)
    return track.locate(x, y)[1] * math.copysign(1.0, bend) > 1.0


def _counted(runs: Sequence[Run]) -> tuple[str, str, str]:
    """Cars derailed: mean and range of the runs; which ones and how many groups in the first."""
    numbers = [len(run.cars) for run in runs]
    spread = f" ({min(numbers)} to {max(numbers)})" if min(numbers) < max(numbers) else ""
    groups = sum(b - a > 1 for a, b in pairwise(runs[0].cars)) + bool(runs[0].cars)
    return f"{sum(numbers) / len(runs):.1f}{spread}", number_list(runs[0].cars), str(groups)


def _each(words: Iterable[str]) -> str:
    """Each of the words with the number of runs that say it."""
    return ", ".join(f"{word} ({n})" for word, n in Counter(words).most_common())
