"""The studies in ``docs/site.md``: walls and soft ground, placement, speed and energy limits."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from derail_ros.commands.common import CommandFailure, counting_runs
from derail_ros.models import engine_hash
from derail_ros.scenario import Scenario, load_scenario
from derail_ros.studies.ensemble import ensemble_jobs, gather
from derail_ros.studies.tables import Table
from derail_ros.vocabulary.outcome import Outcome
from derail_ros.vocabulary.severity import severity
from derail_ros.vocabulary.status import CERTAIN_RUPTURE_FORCE, RUPTURE_FORCE
from research.pages import Options, fill, with_places

MEMBERS = 20
OFFSETS = (4.0, 6.0, 8.0, 10.0)
"""Distances of the wall from the centre line, m."""
CHLORINE = 7
"""The car of Mississauga whose rupture the placement question is about."""
SPEEDS = (30.0, 45.0, 60.0, 75.0, 90.0)
MASSES = {"empty, 34 t": 34e3, "half loaded, 68 t": 68e3, "loaded, 120 t": 120e3}
"""Cars of the base train, kg each."""
RISKS = (0.05, 0.5)
"""Accepted probabilities that a car is struck above ``RUPTURE_FORCE``."""

Settings = Mapping[str, Scenario]
Outcomes = Mapping[str, Sequence[Outcome]]


def walls() -> Settings:
    """Mississauga as it was, with a wall on the left, and with soft ground on the right."""
    wall = load_scenario("mississauga_wall")
    settings = {"as it was": wall.with_overrides({"site.fixed": []})}
    for offset in OFFSETS:
        outline = [[-40.0, offset], [160.0, offset]]
        name = f"wall {offset:g} m to the left"
        settings[name] = wall.with_overrides({"site.fixed.0.outline_along_m": outline})
    settings["soft ground to the right"] = load_scenario("mississauga_soft_ground")
    return settings


def placement() -> Settings:
    """Mississauga with its car 8, a long propane car behind the chlorine car, elsewhere."""
    base = load_scenario("mississauga")
    consist = base.resolved()["train"]["consist"]
    cars = [{**block, "count": 1} for block in consist for _ in range(block["count"])]
    rest = cars[:7] + cars[8:]
    orders = {
        "as it was": cars,
        "car 8 moved behind car 24": rest[:23] + [cars[7]] + rest[23:],
        "car 8 exchanged with car 6": [*cars[:5], cars[7], cars[6], cars[5], *cars[8:]],
        "car 8 as short as car 6": [*cars[:7], {**cars[5], "contents": "propane"}, *cars[8:]],
    }
    return {name: base.with_overrides({"train.consist": order}) for name, order in orders.items()}


def speeds() -> Settings:
    """The base train at several speeds, of empty, half loaded and loaded cars."""
    base = load_scenario("base_train")
    return {
        f"{name} at {speed:g}": base.with_overrides(
            {"train.speed_kmh": speed, "train.consist.0.mass_kg": mass}
        )
        for name, mass in MASSES.items()
        for speed in SPEEDS
    }


PARTS: dict[str, Callable[[], Settings]] = {
    "walls": walls,
    "placement": placement,
    "speeds": speeds,
}


def write(options: Options) -> None:
    """Run the studies and write their tables into the page."""
    names = options.names or tuple(PARTS)
    if unknown := [name for name in names if name not in PARTS]:
        raise CommandFailure(f"{', '.join(unknown)}: none of {', '.join(PARTS)}")
    text = with_places(options.page, names)
    members = options.members or MEMBERS
    tables = {"walls": wall_table, "placement": placement_table, "speeds": speed_tables}
    found = {}
    for name in names:
        outcomes = _run(name, PARTS[name](), members, options)
        about = (
            f"<sub>`python -m research site {name}`: {members} runs each with the force that "
            f"starts the motion changed by at most 4 %, seed {options.seed}. Engine "
            f"{engine_hash()[:16]}.</sub>"
        )
        told = [table.markdown() for table in tables[name](outcomes)]
        found[name] = "\n\n".join([about, *told])
    options.write(fill(text, found), {})


def _run(what: str, settings: Settings, members: int, options: Options) -> Outcomes:
    """The outcomes of all runs of each setting."""

    def jobs() -> Iterable[Any]:
        for name, scenario in settings.items():
            yield from ensemble_jobs(scenario, members, seed=options.seed, key=name)

    with counting_runs(what) as progress:
        found = gather(jobs(), jobs=options.jobs, progress=progress)
    return {name: [result.outcome for result in found[name]] for name in settings}


def _mean(outcomes: Sequence[Outcome], value: Callable[[Outcome], float], digits: int = 1) -> str:
    values = np.array([value(o) for o in outcomes], dtype=float)
    return f"{values.mean():.{digits}f} ± {values.std(ddof=1):.{digits}f}"


def _share(outcomes: Sequence[Outcome], holds: Callable[[Outcome], bool]) -> str:
    return f"{100.0 * np.mean([holds(o) for o in outcomes]):.0f} %"


def _wall(outcome: Outcome, what: str) -> float:
    fixed = outcome.site.fixed if outcome.site else ()
    if not fixed:
        return np.nan
    return {"force": fixed[0].force * 1e-6, "cars": float(len(fixed[0].struck_by)),
            "energy": fixed[0].energy / outcome.energy["initial"] * 100.0}[what]  # fmt: skip


def _far(index: int) -> Callable[[Outcome], bool]:
    return lambda o: bool(o.site and o.site.inside[index].ever)


def wall_table(found: Outcomes) -> list[Table]:
    """What walls and soft ground do to the scene, and what the wall bears."""
    scene = [
        (
            name,
            _mean(o, lambda x: x.cars_derailed),
            _mean(o, lambda x: x.scene_length),
            _mean(o, lambda x: x.scene_width),
            _share(o, _far(0)),
            _share(o, _far(1)),
            _mean(o, lambda x: x.peak_force * 1e-6),
            _mean(o, lambda x: len(x.cars_above_5MN)),
        )
        for name, o in found.items()
    ]
    heads = ("", "cars derailed", "scene length, m", "width, m", "beyond 10 m left", "and right",
             "largest force between cars, MN", "cars struck above 5 MN")  # fmt: skip
    borne = [
        (name, _mean(o, partial(_wall, what="cars")), _mean(o, partial(_wall, what="force")),
         _mean(o, partial(_wall, what="energy")))
        for name, o in found.items() if name.startswith("wall")
    ]  # fmt: skip
    of_wall = ("", "cars that strike it", "largest force of a corner, MN", "its energy, %")
    return [Table(heads, scene), Table(of_wall, borne)]


def placement_table(found: Outcomes) -> list[Table]:
    """What the chlorine car meets."""
    i = CHLORINE - 1

    def above(level: float) -> Callable[[Outcome], bool]:
        return lambda o: bool(o.car_peak_force[i] > level)

    rows = [
        (
            name,
            _mean(o, lambda x: x.car_peak_force[i] * 1e-6),
            _share(o, above(RUPTURE_FORCE)),
            _share(o, above(CERTAIN_RUPTURE_FORCE)),
            _mean(o, lambda x: x.peak_force * 1e-6),
            _mean(o, lambda x: len(x.cars_above_10MN)),
        )
        for name, o in found.items()
    ]
    heads = ("", "largest force on car 7, MN", "above 5 MN", "above 10 MN",
             "largest force of all, MN", "cars struck above 10 MN")  # fmt: skip
    return [Table(heads, rows)]


def speed_tables(found: Outcomes) -> list[Table]:
    """Outcomes over speed, and the speeds and energies that keep a risk."""
    rows, limits = [], []
    for cars in MASSES:
        risks, energies = [], []
        for speed in SPEEDS:
            o = found[f"{cars} at {speed:g}"]
            energies.append(o[0].energy["initial"] * 1e-6)
            risks.append(float(np.mean([len(x.cars_above_5MN) > 0 for x in o])))
            rows.append(
                (f"{cars}", f"{speed:g}", f"{energies[-1]:.0f}",
                 _mean(o, lambda x: x.cars_derailed), f"{100.0 * risks[-1]:.0f} %",
                 _mean(o, lambda x: len(x.cars_above_5MN)), _mean(o, severity, 2))
            )  # fmt: skip
        limits.append((cars, *(_limit(risks, energies, risk) for risk in RISKS)))
    heads = ("cars", "km/h", "energy, MJ", "cars derailed", "some car struck above 5 MN",
             "cars struck above 5 MN", "severity")  # fmt: skip
    of_limit = ("cars", *(f"risk of {100.0 * r:g} % at most" for r in RISKS))
    return [Table(heads, rows), Table(of_limit, limits)]


def _limit(risks: Sequence[float], energies: Sequence[float], accepted: float) -> str:
    """The highest speed, and its energy, of those run up to which the risk is accepted."""
    kept = 0
    while kept < len(risks) and risks[kept] <= accepted:
        kept += 1
    if kept == 0:
        return f"below {SPEEDS[0]:g} km/h"
    return f"{SPEEDS[kept - 1]:g} km/h, {energies[kept - 1]:.0f} MJ"
