"""A run on the map: GeoJSON and KML of footprints, paths, the place, and covered ground.

Coordinates are longitude and latitude by ``site.datum``, or without one x and y of the frame of
the track in metres, which the member ``reference_system`` then says.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from derail_ros.recording.recorded_run import Cars, RecordedRun, SampledLine
from derail_ros.vocabulary.events import Collision
from derail_ros.vocabulary.outcome import Outcome
from derail_ros.vocabulary.place import Datum, datum_of
from derail_ros.vocabulary.scene import car_corners
from derail_ros.vocabulary.site import SiteParams
from derail_ros.vocabulary.status import CORNERS
from derail_ros.vocabulary.words import finite

F64 = NDArray[np.float64]
Feature = dict[str, Any]

ANY = 0.0
"""Stands for a place that is covered in any of the runs."""
SHARES = (ANY, 0.05, 0.5, 0.95)
"""Shares of the runs in which places are covered that are drawn."""
CELL = 0.5
"""Side of the cells in which it is counted, m."""
ROUND = [CORNERS.index(c) for c in ("front left", "front right", "rear right", "rear left")]
"""Corners of a car in their order around it."""
PATH_STEP = 0.5
"""Distance between places on a path, m."""


class Map:
    """Features of one file, in longitude and latitude if there is a datum."""

    def __init__(self, datum: Datum | None) -> None:
        self.datum = datum

    def coordinates(self, points: F64) -> list[list[float]]:
        """Places (K, 2) as GeoJSON has them."""
        if self.datum is None:
            return [[round(float(x), 3), round(float(y), 3)] for x, y in points]
        fixes = (self.datum.fix(float(x), float(y)) for x, y in points)
        return [[round(longitude, 8), round(latitude, 8)] for latitude, longitude, _ in fixes]

    def feature(self, points: F64, closed: bool, **properties: Any) -> Feature:
        """A Polygon or LineString."""
        places = self.coordinates(points)
        if closed:
            x, y = points.T
            if (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() < 0.0:
                places.reverse()  # RFC 7946: counter-clockwise
            geometry: Feature = {"type": "Polygon", "coordinates": [[*places, places[0]]]}
        else:
            geometry = {"type": "LineString", "coordinates": places}
        return {"type": "Feature", "geometry": geometry, "properties": properties}

    def collection(self, features: Iterable[Feature]) -> dict[str, Any]:
        """A FeatureCollection."""
        data: dict[str, Any] = {"type": "FeatureCollection", "features": list(features)}
        if self.datum is None:
            data["reference_system"] = "x and y of the frame of the track, m"
        return data


def outlines(cars: Any, pose: F64) -> F64:
    """Corners (N, 4, 2) of the bodies of cars in their order around them, m."""
    return car_corners(pose, cars.length, cars.width)[:, ROUND]


def footprints(
    cars: Cars,
    line: SampledLine,
    pose: F64,
    outcome: Outcome,
    collisions: Iterable[Collision],
    on: Map,
) -> list[Feature]:
    """The cars in a pose (N, 6): what they are, and what happened to them.

    ``name`` is the reporting mark of a car of a consist list. Cars on the rails have no side and
    no offset.
    """
    corners = outlines(cars, pose)
    _, offset = line.locate_all(*pose[:, :2].T)
    struck: dict[int, tuple[float, str]] = {}
    for c in collisions:
        for car, by in ((c.car_a, c.object or f"car {c.car_b}"), (c.car_b, f"car {c.car_a}")):
            if car and c.peak_force > struck.get(car, (0.0, ""))[0]:
                struck[car] = (c.peak_force, by)
    found = []
    for i in np.flatnonzero(cars.real):
        force, by = struck.get(int(i) + 1, (0.0, ""))
        off = int(i) + 1 in (*outcome.derailed_cars, *outcome.standing.derailed)
        found.append(
            on.feature(
                corners[i],
                True,
                car=int(i) + 1,
                name=cars.name[i],
                type=cars.kind[i] or cars.name[i],
                contents=cars.contents[i],
                standing=bool(cars.cut[i]),
                derailed=off,
                side=("left" if offset[i] > 0.0 else "right") if off else None,
                offset_m=round(float(offset[i]), 2) if off else None,
                largest_force_N=finite(force, 4),
                struck_by=by,
            )
        )
    return found


def paths(run: RecordedRun, on: Map) -> list[Feature]:
    """Where the mass centres of the derailed cars went, from their derailment on.

    And of the standing cars that moved, from the beginning.
    """
    found = []
    for car in (*run.outcome.derailed_cars, *run.outcome.standing.moved):
        begin = 0 if run.cars.cut[car - 1] else int(np.argmax(run.derailed[:, car - 1]))
        track = run.pose[begin:, car - 1, :2]
        way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(track, axis=0).T))])
        if way[-1] < PATH_STEP:
            continue
        kept = np.unique(np.floor(way / PATH_STEP), return_index=True)[1]
        kept = np.union1d(kept, [len(track) - 1])
        found.append(
            on.feature(
                track[kept],
                False,
                car=car,
                standing=bool(run.cars.cut[car - 1]),
                from_s=round(float(run.time[begin]), 3),
                length_m=round(float(way[-1]), 2),
            )
        )
    return found


def place(line: SampledLine, site: SiteParams, pose: F64, on: Map) -> list[Feature]:
    """The track, and what stands beside it; a straight reaches 50 m beyond poses (..., 6)."""
    if len(line.x):
        points = np.stack([line.x, line.y], axis=1)
    else:
        x = pose[..., 0]
        points = np.array([[x.min() - 50.0, 0.0], [x.max() + 50.0, 0.0]])
    found = [on.feature(points, False, role="track", name="track")]
    for shape in site.shapes(line):
        found.append(on.feature(shape.points, shape.closed, role=shape.role, name=shape.name))
    return found


def raster(footprints: Sequence[F64], cell: float = CELL) -> tuple[F64, F64]:
    """Lower left corner (2,) of square cells, and the share (I, J) of runs that cover each.

    Parameters
    ----------
    footprints : for each run the outlines (K, 4, 2) of its cars, m
    cell : side of the cells; one counts as covered where its middle is, m
    """
    every = np.concatenate([f.reshape(-1, 2) for f in footprints])
    if not len(every):
        return np.zeros(2), np.zeros((0, 0))
    low = np.floor(every.min(axis=0) / cell) * cell
    size = np.ceil((every.max(axis=0) - low) / cell).astype(int) + 1
    x = low[0] + cell * (np.arange(size[0]) + 0.5)
    y = low[1] + cell * (np.arange(size[1]) + 0.5)
    counts = np.zeros(size)
    for cars in footprints:
        hit = np.zeros(size, dtype=bool)
        for car in cars:
            box = (np.stack([car.min(axis=0), car.max(axis=0)]) - low) / cell
            (i0, j0), (i1, j1) = np.floor(box[0]).astype(int), np.ceil(box[1]).astype(int)
            px, py = np.meshgrid(x[i0:i1], y[j0:j1], indexing="ij")
            edges = np.roll(car, -1, axis=0) - car
            turn = edges[0, 0] * edges[1, 1] - edges[0, 1] * edges[1, 0]
            within = np.ones(px.shape, dtype=bool)
            for corner, edge in zip(car, edges, strict=True):
                side = edge[0] * (py - corner[1]) - edge[1] * (px - corner[0])
                within &= side * np.sign(turn) >= 0.0
            hit[i0:i1, j0:j1] |= within
        counts += hit
    return low, counts / len(footprints)


def covered(footprints: Sequence[F64], cell: float = CELL) -> dict[float, Any]:
    """Where footprints lie in a share of the runs of an ensemble or more: share -> shapely shape.

    Parameters as of :func:`raster`.
    """
    import shapely

    low, probability = raster(footprints, cell)
    shapes = {}
    for share in SHARES:
        strips = []
        for i, column in enumerate(probability > max(share - 1e-12, 0.0)):
            ends = np.flatnonzero(np.diff(np.concatenate([[0], column.astype(int), [0]])))
            for j, k in zip(ends[::2], ends[1::2], strict=True):
                x0, y0 = low + cell * np.array([i, j])
                strips.append(shapely.box(x0, y0, x0 + cell, low[1] + cell * k))
        if strips:
            shapes[share] = shapely.unary_union(strips)
    return shapes


def cover_features(shapes: Mapping[float, Any], members: int, on: Map) -> list[Feature]:
    """One MultiPolygon for each share of :func:`covered`."""
    from shapely.geometry.polygon import orient

    def ring(of: Any) -> list[list[float]]:
        places = on.coordinates(np.array(of.coords)[:-1])
        return [*places, places[0]]

    def polygon(part: Any) -> list[list[list[float]]]:
        part = orient(part)  # RFC 7946: counter-clockwise, holes clockwise
        return [ring(part.exterior), *map(ring, part.interiors)]

    found = []
    for share, shape in shapes.items():
        parts = [polygon(part) for part in getattr(shape, "geoms", [shape])]
        told = {
            "covered": "in any run"
            if share == ANY
            else f"in {100 * share:g} % of the runs or more",
            "probability": round(1.0 / members, 4) if share == ANY else share,
            "members": members,
            "area_m2": round(shape.area, 2),
        }
        geometry = {"type": "MultiPolygon", "coordinates": parts}
        found.append({"type": "Feature", "geometry": geometry, "properties": told})
    return found


def kml(title: str, layers: Mapping[str, Sequence[Feature]]) -> bytes:
    """Layers of features in longitude and latitude as KML 2.2."""
    root = ElementTree.Element("kml", xmlns="http://www.opengis.net/kml/2.2")
    document = ElementTree.SubElement(root, "Document")
    ElementTree.SubElement(document, "name").text = title
    for name, features in layers.items():
        folder = ElementTree.SubElement(document, "Folder")
        ElementTree.SubElement(folder, "name").text = name
        for feature in features:
            told = feature["properties"]
            mark = ElementTree.SubElement(folder, "Placemark")
            words = told.get("name") or ""
            if "car" in told:
                words = f"car {told['car']}" + (f", {words}" if words else "")
            if "covered" in told:
                words = f"covered {told['covered']}"
            ElementTree.SubElement(mark, "name").text = words
            text = "\n".join(f"{key}: {value}" for key, value in told.items())
            ElementTree.SubElement(mark, "description").text = text
            _kml_geometry(mark, feature["geometry"])
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)


def _kml_geometry(mark: ElementTree.Element, geometry: Feature) -> None:
    def coordinates(parent: ElementTree.Element, places: list[list[float]]) -> None:
        text = " ".join(f"{x},{y}" for x, y in places)
        ElementTree.SubElement(parent, "coordinates").text = text

    if geometry["type"] == "LineString":
        coordinates(ElementTree.SubElement(mark, "LineString"), geometry["coordinates"])
        return
    parts = [geometry["coordinates"]]
    if geometry["type"] == "MultiPolygon":
        parts, mark = geometry["coordinates"], ElementTree.SubElement(mark, "MultiGeometry")
    for part in parts:
        polygon = ElementTree.SubElement(mark, "Polygon")
        for k, ring in enumerate(part):
            bound = ElementTree.SubElement(polygon, "innerBoundaryIs" if k else "outerBoundaryIs")
            coordinates(ElementTree.SubElement(bound, "LinearRing"), ring)


def export(run: RecordedRun, output: Path, members: Sequence[F64] = ()) -> dict[str, int]:
    """Write the files of a run; returns their names and numbers of features.

    Parameters
    ----------
    run : the run
    output : an existing folder
    members : for each run of an ensemble the outlines (K, 4, 2) of its derailed cars, m
    """
    on = Map(datum_of(run.scenario.get("site")))
    layers = {
        "footprints": footprints(
            run.cars, run.line, run.pose[-1], run.outcome, run.collisions, on
        ),
        "paths": paths(run, on),
        "place": place(run.line, run.site, run.pose, on),
    }
    if members:
        layers["covered"] = cover_features(covered(members), len(members), on)
    counts = {}
    for name, features in layers.items():
        path = output / f"{name}.geojson"
        path.write_text(json.dumps(on.collection(features)), encoding="utf-8")
        counts[path.name] = len(features)
    if on.datum is not None:
        (output / "run.kml").write_bytes(kml(run.title, layers))
        counts["run.kml"] = sum(map(len, layers.values()))
    return counts
