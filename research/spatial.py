"""``docs/spatial.md``: the engine in three dimensions beside published runs and the planar one.

``python -m research spatial [CASE ...]`` computes the named cases (all without names) and keeps
what came of each run in ``docs/spatial.json``; the page is written from that file, and from
nothing else for the name ``kept``.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from derail_ros import models
from derail_ros.commands.common import counting_runs, load
from derail_ros.spatial import constants as c
from derail_ros.spatial.simulation import FlatSimulation
from derail_ros.studies.ensemble import Job, advance, ensemble_jobs, gather
from derail_ros.studies.tables import Table
from derail_ros.vocabulary import shapes
from derail_ros.vocabulary.measures import outcome_record
from research.pages import DOCS, Options, fill, with_places

KEPT = DOCS / "spatial.json"
SPEEDS = {30: (5, 0.78e6), 48: (10, None), 60: (14, 9.47e6), 72: (18, None), 90: (24, None)}
"""Speed of the base train, km/h -> published count and largest force, N."""
CASES = {f"base_{kmh}": ("base_train", {"train.speed_kmh": kmh}) for kmh in SPEEDS} | {
    "mississauga": ("mississauga", {})
}
MODELS = ("spatial", "flat", "planar")
"""The engine, the same with cars kept in the plane, and the planar engine."""
KEYS = (
    "cars_derailed", "cars_on_side", "pile_height_m", "duration_s", "scene_length_m",
    "scene_width_m", "peak_force_N", "energy_residual", "status",
)  # fmt: skip


def _compute(job: Job, stop: Any = None) -> dict[str, Any]:
    params = job.params()
    build = FlatSimulation if job.key[1] == "flat" else models.build
    record = outcome_record(advance(build(params), stop))
    return {key: record[key] for key in KEYS}


def compute(name: str, members: int, seed: int, jobs: int | None) -> dict[str, Any]:
    """Results of a case, ``case`` or ``case:model``, by model: a list of records each."""
    found: dict[str, Any] = {}
    case, _, model = name.partition(":")
    scenario, overrides = CASES[case]
    for which in [model] if model else MODELS:
        engine = "planar" if which == "planar" else "spatial"
        params = load(scenario).with_overrides({**overrides, "model": engine}).to_params()
        listed = ensemble_jobs(params, members, seed=seed, key=(case, which))
        with counting_runs(f"{case}, {which}") as progress:
            (results,) = gather(listed, jobs=jobs, task=_compute, progress=progress).values()
        failed = [result.error for result in results if result.error]
        if failed:
            raise RuntimeError(f"{name}: {failed[0]}")
        found[which] = [result.value for result in results]
    return found


def write(options: Options) -> None:
    """Compute the cases that are named, keep them, write the page."""
    kept = json.loads(KEPT.read_text()) if KEPT.is_file() else {}
    for name in options.names or tuple(CASES):
        if name == "kept":
            continue
        found = compute(name, options.members or 3, options.seed, options.jobs)
        kept.setdefault(name.partition(":")[0], {}).update(found)
        KEPT.write_text(json.dumps(kept, indent=1) + "\n")
    text = fill(with_places(options.page, ["speeds", "planes", "constants"]), {
        "speeds": _speeds(kept), "planes": _planes(kept), "constants": _constants(),
    })  # fmt: skip
    options.write(text, {})


def _mean(rows: Sequence[Mapping[str, Any]], key: str) -> float:
    values = [row[key] for row in rows if row[key] is not None]
    return float(np.mean(values)) if values else math.nan


def _spread(
    rows: Sequence[Mapping[str, Any]], key: str, digits: int = 1, scale: float = 1.0
) -> str:
    values = [scale * row[key] for row in rows if row[key] is not None]
    if not values:
        return "-"
    return f"{np.mean(values):.{digits}f} ({min(values):.{digits}f} to {max(values):.{digits}f})"


def _cases(kept: Mapping[str, Any]) -> Iterator[tuple[str, Any, str]]:
    for case in CASES:
        if case in kept:
            kmh = case.removeprefix("base_")
            published = SPEEDS[int(kmh)][0] if kmh.isdigit() else 24
            label = f"base train, {kmh} km/h" if kmh.isdigit() else "Mississauga"
            yield label, kept[case], str(published)


def _speeds(kept: Mapping[str, Any]) -> Table:
    heads = (
        "case", "runs", "published count", "derailed", "on their side", "share", "height (m)",
        "to rest (s)", "scene (m)", "largest force (MN)",
    )  # fmt: skip
    rows = []
    for label, found, published in _cases(kept):
        runs = found.get("spatial", [])
        if not runs:
            continue
        share = _mean(runs, "cars_on_side") / max(_mean(runs, "cars_derailed"), 1e-9)
        rows.append((
            label, str(len(runs)), published, _spread(runs, "cars_derailed"),
            _spread(runs, "cars_on_side"), f"{share:.2f}", _spread(runs, "pile_height_m"),
            _spread(runs, "duration_s"),
            f"{_mean(runs, 'scene_length_m'):.0f} x {_mean(runs, 'scene_width_m'):.0f}",
            _spread(runs, "peak_force_N", 1, 1e-6),
        ))  # fmt: skip
    return Table(heads, rows, texts=1)


def _planes(kept: Mapping[str, Any]) -> Table:
    heads = ("case", "model", "derailed", "to rest (s)", "scene (m)", "largest force (MN)")
    rows = []
    for label, found, _ in _cases(kept):
        for which in MODELS:
            runs = found.get(which, [])
            if runs:
                rows.append((
                    label, which, _spread(runs, "cars_derailed"), _spread(runs, "duration_s"),
                    f"{_mean(runs, 'scene_length_m'):.0f} x {_mean(runs, 'scene_width_m'):.0f}",
                    _spread(runs, "peak_force_N", 1, 1e-6),
                ))  # fmt: skip
    return Table(heads, rows, texts=2)


def _constants() -> Table:
    rows = []
    for module in (c, shapes):
        for name, value in vars(module).items():
            if name.isupper() and isinstance(value, float):
                rows.append((f"`{name}`", f"{value:g}"))
    return Table(("constant", "value (SI)"), rows, texts=1)
