"""The place of a run as tables: zones, fixed bodies and areas; and what came of a run there."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from derail_ros.engine import layout
from derail_ros.engine.arrays import Model, Rows
from derail_ros.engine.outlines import meets, outline_rows
from derail_ros.vocabulary.errors import ParameterError
from derail_ros.vocabulary.scene import Line
from derail_ros.vocabulary.site import Entered, SiteOutcome, SiteParams, Struck, in_plane

if TYPE_CHECKING:
    from derail_ros.engine.simulation import PlanarSimulation

FARTHEST = 1e6
"""Bound on the coordinates of outlines, m."""


def _number(value: Any, field: str, low: float, high: float = math.inf) -> None:
    if not (isinstance(value, (int, float)) and low <= value <= high):  # nan is refused too
        span = f"at least {low:g}" if math.isinf(high) else f"within {low:g} and {high:g}"
        raise ParameterError(field, f"must be {span}, not {value!r}")


def check_site(site: SiteParams) -> None:
    """Refuse a place that no run can be built from, naming the field and the reason."""
    _number(site.border, "site.border", 1e-3, 100.0)
    for kind in ("zones", "fixed", "areas"):
        names = set()
        for j, part in enumerate(getattr(site, kind)):
            at = f"site.{kind}.{j}"
            if part.name in names:
                raise ParameterError(f"{at}.name", f"there is a {part.name!r} already")
            names.add(part.name)
            least = 3 if kind == "zones" or part.closed else 2
            if len(part.outline) < least:
                raise ParameterError(f"{at}.outline", f"needs at least {least} vertices")
            for k, vertex in enumerate(part.outline):
                for value in vertex:
                    _number(value, f"{at}.outline.{k}", -FARTHEST, FARTHEST)
                if k and math.dist(vertex, part.outline[k - 1]) < 1e-6:
                    raise ParameterError(f"{at}.outline.{k}", "is the vertex before it")
    for j, zone in enumerate(site.zones):
        for name in ("c_s", "c_d", "c_v"):
            _number(getattr(zone, name), f"site.zones.{j}.{name}", 0.0, 1e3)
        _number(zone.eps, f"site.zones.{j}.eps", 1e-6, 10.0)
        for value in zone.rise:
            _number(value, f"site.zones.{j}.rise", -10.0, 10.0)
    for j, body in enumerate(site.fixed):
        for name in ("force", "energy"):
            value = getattr(body, name)
            if not value > 0.0:
                raise ParameterError(f"site.fixed.{j}.{name}", f"must be above 0, not {value!r}")


def site_tables(site: SiteParams, track: Line) -> dict[str, Rows]:
    """The tables ``outline``, ``zone``, ``fixed`` and ``area`` of a model; fixed bodies first."""
    outlines = [np.zeros(0, layout.OUTLINE)]
    tables: dict[str, list[tuple[float, ...]]] = {"fixed": [], "zone": [], "area": []}
    group = first = 0
    every: dict[str, tuple[Any, ...]] = {
        "fixed": site.fixed,
        "zone": site.zones,
        "area": site.areas,
    }
    for name, parts in every.items():
        for part in parts:
            closed = name == "zone" or part.closed
            rows = outline_rows(in_plane(part, track), closed, group)
            outlines.append(rows)
            x, y = rows["x"], rows["y"]
            box = (x.min(), x.max(), y.min(), y.max())
            more: tuple[float, ...] = ()
            if name == "fixed":
                group = int(rows["group"].max()) + 1
                more = (part.force,)
            elif name == "zone":
                more = (part.c_s, part.c_d, part.eps, part.c_v, *part.rise)
            tables[name].append((first, first + len(rows), closed, *box, *more))
            first += len(rows)
    kinds = {"fixed": layout.FIXED, "zone": layout.ZONE, "area": layout.AREA}
    told: dict[str, Rows] = {n: np.array(rows, kinds[n]) for n, rows in tables.items()}
    return {"outline": np.concatenate(outlines), **told}


def site_state(site: SiteParams, model: Model, n: int) -> dict[str, Any]:
    """The arrays of a state with ``n`` cars that belong to the place."""
    bodies, last = len(model.fixed), model.fixed["last"]
    vertices = int(last[-1]) if bodies else 0
    groups = model.outline["group"][:vertices]
    group = np.zeros(int(groups.max(initial=-1)) + 1, layout.GROUP)
    for row, body in zip(model.fixed, site.fixed, strict=True):
        own = groups[int(row["first"]) : int(row["last"])].astype(int)
        group["limit"][own] = body.energy
    struck = np.zeros(n * bodies, layout.PAIR)
    struck["contact"] = struck["below"] = -1.0
    return {
        "struck": struck,
        "hold": np.zeros((n, 4 * bodies + vertices), dtype=np.int64),
        "dent": np.zeros((n, 4 * bodies + vertices)),
        "group": group,
        "inside": np.zeros((n, len(site.areas)), dtype=np.uint8),
    }


def cars_in(model: Model, table: Rows, row: int, q: Any) -> tuple[int, ...]:
    """Numbers of the cars at ``q`` with a part in what ``row`` of ``table`` outlines."""
    car = model.car
    return tuple(
        i + 1
        for i in range(len(q))
        if not car[i]["virtual"]
        and meets(
            model.outline, table, row, q[i, 0], q[i, 1], math.cos(q[i, 2]), math.sin(q[i, 2]),
            car[i]["half_l"], car[i]["half_w"],
        )
    )  # fmt: skip


def refuse_overlap(site: SiteParams, model: Model, q: Any) -> None:
    """Refuse a train that stands on a fixed body."""
    for b, body in enumerate(site.fixed):
        cars = cars_in(model, model.fixed, b, q)
        if cars:
            reason = f"{body.name} stands where car {cars[0]} is at the start"
            raise ParameterError(f"site.fixed.{b}", reason)


def site_outcome(run: PlanarSimulation) -> SiteOutcome | None:
    """What came of a run at its place; None where it has none."""
    site, model, state = run.params.site, run._model, run._state
    if not (site.zones or site.fixed or site.areas):
        return None
    train = state.q[: run.params.n_train]
    contacts = state.contact[: int(state.cnt["contacts"][0])]
    struck = []
    for b, body in enumerate(site.fixed):
        own = contacts[contacts["b"] == -1.0 - b]
        rows = model.outline[int(model.fixed[b]["first"]) : int(model.fixed[b]["last"])]
        groups = state.group[np.unique(rows["group"]).astype(int)]
        by = tuple(dict.fromkeys(int(car) for car in own["a"]))
        force = float(own["peak"].max(initial=0.0))
        gone = int(groups["gone"].sum())
        struck.append(Struck(body.name, force, float(groups["energy"].sum()), by, gone))
    zones = tuple(
        (zone.name, cars_in(model, model.zone, z, train)) for z, zone in enumerate(site.zones)
    )
    inside = tuple(
        Entered(
            area.name,
            tuple(int(i) + 1 for i in np.flatnonzero(state.inside[: len(train), a])),
            cars_in(model, model.area, a, train),
        )
        for a, area in enumerate(site.areas)
    )
    return SiteOutcome(tuple(struck), zones, inside)
