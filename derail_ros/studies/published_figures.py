"""The source's parameter studies and final scenes, drawn from this model's runs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.ticker import MaxNLocator

from derail_ros import models
from derail_ros.review import drawing
from derail_ros.review.drawing import (
    BLUE,
    INK,
    VERMILION,
    dress,
    grid_of,
    heading,
    mark,
    place,
    put,
    sheet,
    styled,
)
from derail_ros.review.scene import Scene, scene_from_simulation
from derail_ros.scenario import load_scenario
from derail_ros.studies.ensemble import Job, advance, ensemble_jobs, gather
from derail_ros.studies.published import PublishedCase, load_published
from derail_ros.studies.records import Ensemble, ensembles
from derail_ros.vocabulary.measures import MEASURES

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PALE = "#cfe3f1"

MEASURES_SHOWN = ("cars_derailed", "duration_s", "peak_force_N", "scene_area_m2")

VARIATIONS: tuple[tuple[str, str, float, tuple[float, ...]], ...] = (
    ("speed (km/h)", "train.speed_kmh", 1.0, (30, 48, 60, 72, 90)),
    ("mass of a car (t)", "train.consist.0.mass_kg", 1e3, (34, 54.4, 68, 81.6, 102)),
    ("number of cars", "train.consist.0.count", 1, (30, 48, 60, 72, 90)),
    ("brake force, factor", "brakes.force_scale", 1.0, (0.5, 0.8, 1.0, 1.2, 1.5)),
    ("derailment quotient", "derailment.lv_limit", 1.0, (1.0, 1.6, 2.0, 2.4, 3.0)),
    ("ground reaction, factor", "ground.scale", 1.0, (0.5, 0.8, 1.0, 1.2, 1.5)),
)
"""Words, dotted path, the path's unit in that of the words, and values: the third is the base
train's. As in ``config/studies/six_variations.yaml``."""


def variation_ensembles(members: int, seed: int = 0, **how: Any) -> Mapping[Any, Ensemble]:
    """``(path, value)`` -> ensemble of the base train with that value."""
    base = load_scenario("base_train")

    def jobs() -> Iterator[Job]:
        for _, path, scale, values in VARIATIONS:
            for value in values:
                changed = base.with_overrides({path: scale * value})
                yield from ensemble_jobs(changed, members, seed=seed, key=(path, value))

    return ensembles(jobs(), **how)


def published_points(path: str, scale: float) -> Iterator[tuple[float, Mapping[str, Any]]]:
    """Value and published measures of the variations of the base train along a path."""
    base = next(values[2] for _, p, _, values in VARIATIONS if p == path)
    for case in load_published().cases:
        if case.name == "base_60":
            yield base, case.published
        elif case.scenario == "base_train" and list(case.overrides) == [path]:
            yield case.overrides[path] / scale, case.published


@styled
def variations(found: Mapping[Any, Ensemble]) -> Figure:
    """Draw the six variations: mean and range of the runs, the published values beside them."""
    figure = sheet(15.2, 10.4)
    rows, columns = len(MEASURES_SHOWN), len(VARIATIONS)
    panels = grid_of(figure, rows * columns, columns, (0.75, 0.2, 1.15, 0.55, 0.5, 0.25))
    tops = {}
    for k, axes in enumerate(panels):
        row, column = divmod(k, columns)
        words, path, scale, values = VARIATIONS[column]
        measure = MEASURES[MEASURES_SHOWN[row]]
        of = [found[path, value].distribution(measure.key) for value in values]
        mean = np.array([d.mean for d in of]) * measure.scale
        low, high = np.array([[d.quantile(q) for d in of] for q in (0.0, 1.0)]) * measure.scale
        axes.fill_between(values, low, high, color=PALE, lw=0, zorder=2)
        axes.plot(values, mean, "-o", color=BLUE, ms=4, lw=1.5, zorder=3)
        points = [
            (value, published[measure.key] * measure.scale)
            for value, published in published_points(path, scale)
            if measure.key in published
        ]
        if points:
            look = {"ls": "", "marker": "D", "mfc": VERMILION, "mec": "white", "ms": 6.5}
            axes.plot(*zip(*points, strict=True), zorder=5, **look)
        tops.setdefault(row, []).append(max([*high, *(y for _, y in points)]))
        dress(axes)
        axes.xaxis.set_major_locator(MaxNLocator(5))
        if column == 0:
            axes.set_ylabel(measure.title)
        else:
            axes.set_yticklabels([])
        if row == rows - 1:
            axes.set_xlabel(words)
        else:
            axes.set_xticklabels([])
    for k, axes in enumerate(panels):
        axes.set_ylim(0.0, 1.08 * max(tops[k // columns]))
    runs = max(len(e) for e in found.values())
    heading(figure, "Six variations of the base train", f"{runs} runs a point.", left=0.75)
    handles = [
        mark("mean of the runs", marker="o", color=BLUE, ls="-"),
        drawing.hatched("from the least to the largest", PALE, ec="none"),
        mark("published", **drawing.DIAMOND),
    ]
    drawing.legend(figure, 0.75, 0.78, handles)
    return figure


# Scenes ------------------------------------------------------------------------------------


def scenes_at(scenario: Any, times: Sequence[float]) -> Iterator[tuple[float, Scene]]:
    """Times (s; the end of the run for later ones) and scenes of a run."""
    run = models.build(scenario.to_params())
    for time in sorted(times):
        run.advance_to(time)
        now = min(time, run.time)
        text = f"{now:.2f} s after the start; {run.outcome().text}"
        yield now, scene_from_simulation(run, scenario.title, text, now)


def final_scenes(cases: Sequence[PublishedCase], **how: Any) -> list[Scene]:
    """The final scene of each case as it is, without variation of the lateral force."""

    def task(job: Job, _stop: Any) -> Scene:
        run = models.build(job.params())
        return scene_from_simulation(run, job.key, advance(run).text)

    jobs = [Job(load_scenario(c.scenario).with_overrides(c.overrides), key=c.title) for c in cases]
    found = gather(jobs, task=task, **how)
    return [results[0].value for results in found.values() if results[0].error is None]


@styled
def scene_sheet(scenes: Sequence[Scene], columns: int = 3) -> Figure:
    """Draw final scenes on one sheet, all to the same scale."""
    windows = [drawing.site(scene, margin=3.0, reach=0.0) for scene in scenes]
    wide = max(w[1] - w[0] for w in windows)
    inner = (15.0 - 0.6 - (columns - 1) * 0.25) / columns
    per_metre = inner / wide
    rows = [range(k, min(k + columns, len(scenes))) for k in range(0, len(scenes), columns)]
    talls = [max((windows[i][3] - windows[i][2]) * per_metre for i in row) for row in rows]
    figure = sheet(15.0, 1.0 + sum(talls) + 0.5 * len(rows) + 0.1)
    top = 1.0
    for row, tall in zip(rows, talls, strict=True):
        for column, i in enumerate(row):
            scene, window = scenes[i], windows[i]
            middle = 0.5 * (window[2] + window[3])
            half = 0.5 * tall / per_metre
            window = (window[1] - wide, window[1], middle - half, middle + half)
            left = 0.3 + column * (inner + 0.25)
            put(figure, left, top + 0.12, scene.title, weight="bold", size=9, color=INK)
            size = f"{scene.scene_length:.1f} m x {scene.scene_width:.1f} m"
            put(figure, left, top + 0.29, f"{int(scene.derailed.sum())} cars, {size}", size=8)
            axes = place(figure, left, top + 0.38, inner, tall)
            drawing.show(axes, window)
            axes.plot(scene.track[:, 0], scene.track[:, 1], color=drawing.RAIL, lw=0.8, zorder=1)
            drawing.draw_bodies(axes, scene, 0.5)
            drawing.draw_fronts(axes, scene)
            drawing.draw_stand_ins(axes, scene, 0.5, 3)
            for j in np.flatnonzero(scene.real & scene.derailed):
                x, y = scene.pose[j, :2]
                look = {"ha": "center", "va": "center_baseline", "size": 6, "zorder": 10}
                pad = {"boxstyle": "round,pad=0.08", "fc": "white", "ec": "none", "alpha": 0.8}
                axes.text(x, y, str(scene.numbers[j]), bbox=pad, clip_on=True, **look)
            if column == 0 and row is rows[0]:
                drawing.scale_inside(axes, window, 0.2)
        top += tall + 0.5
    heading(figure, "Final scenes", "All to one scale; the train runs to the right.", left=0.3)
    drawing.legend(figure, 0.3, 0.76, drawing.state_handles())
    return figure
