"""The place of a scenario: reads GeoJSON, checks outlines, and prepares them for the engine.

A GeoJSON file (RFC 7946) lies beside the scenario; its features become entries of ``site`` when
the scenario is read, so that a resolved scenario needs no file. Longitude and latitude go to the
frame of the track by ``site.datum``, coordinates of a projected system by pyproj and then the
datum. Mistakes name the feature and the vertex.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from derail_ros.scenario.errors import Refusal, ScenarioError
from derail_ros.scenario.messages import did_you_mean, shown, validated
from derail_ros.scenario.schema import (
    AreaSpec,
    FixedSpec,
    Ground,
    Outlined,
    ScenarioModel,
    Section,
    Site,
    TrackSection,
    ZoneSpec,
)
from derail_ros.scenario.schema import Datum as DatumSpec
from derail_ros.scenario.second_tracks import check_track, drawn_track
from derail_ros.scenario.strict_yaml import Path
from derail_ros.scenario.units import canonical, field_of
from derail_ros.vocabulary.place import Datum, datum_of
from derail_ros.vocabulary.site import Area, FixedBody, GroundZone, SiteParams

if TYPE_CHECKING:
    from derail_ros.scenario.alignment import Alignment

ROLES: dict[str, tuple[str, type[Section]]] = {
    "zone": ("zones", ZoneSpec),
    "fixed": ("fixed", FixedSpec),
    "area": ("areas", AreaSpec),
}
"""Property ``role`` of a feature -> list of ``site`` and what its entries are."""

SECOND_TRACK = "second_track"
"""Role of a feature that becomes a track of ``site.tracks``."""

TOLERANCE = TrackSection.model_fields["file_tolerance_m"].default
"""Standard deviation that is granted to the points of a file, m, unless it is given."""

FARTHEST = 20e3
"""Distance from the origin of the frame beyond which an outline cannot be meant, m."""

SOILS = {"soil_lowest": 1.0, "soil_highest": 3.5}
"""Presets of zones: ends of the range of resistance that the source cites for soils (rising with
speed; constant here). No other number has a source."""

Point = tuple[float, float]
ToFrame = Callable[[float, float], Point]


# Outlines ------------------------------------------------------------------------------------


def _crosses(a: Point, b: Point, c: Point, d: Point) -> bool:
    """The segments from a to b and from c to d share a place."""

    def side(p: Point, q: Point, r: Point) -> float:
        return (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0])

    def within(p: Point, q: Point, r: Point) -> bool:
        return all(min(p[k], q[k]) <= r[k] <= max(p[k], q[k]) for k in (0, 1))

    s = (side(a, b, c), side(a, b, d), side(c, d, a), side(c, d, b))
    if s[0] * s[1] < 0.0 and s[2] * s[3] < 0.0:
        return True
    ends = ((a, b, c), (a, b, d), (c, d, a), (c, d, b))
    return any(value == 0.0 and within(*end) for value, end in zip(s, ends, strict=True))


def check_outline(points: Sequence[Point], closed: bool) -> tuple[int, str] | None:
    """The first mistake of an outline: vertex, from 0, and reason; None if there is none."""
    n = len(points)
    least = 3 if closed else 2
    if n < least:
        kind = "polygon" if closed else "line"
        return max(n - 1, 0), f"a {kind} needs at least {least} vertices, this one has {n}"
    for k, (x, y) in enumerate(points):
        if max(abs(x), abs(y)) > FARTHEST:
            far = math.hypot(x, y) / 1000.0
            return k, (
                f"lies {far:,.0f} km from the origin: another reference system, or longitude and "
                "latitude exchanged?"
            )
        if k and math.dist(points[k - 1], (x, y)) < 1e-3:
            return k, "repeats the vertex before it"
    if closed and math.dist(points[0], points[-1]) < 1e-3:
        return n - 1, "is the first vertex again: a polygon closes by itself"
    edges = n if closed else n - 1
    for i in range(edges):
        a, b = points[i], points[(i + 1) % n]
        for j in range(i + 1, edges):
            c, d = points[j], points[(j + 1) % n]
            beside = j == i + 1 or (closed and i == 0 and j == n - 1)
            if not beside and _crosses(a, b, c, d):
                return j, f"the edge from here crosses the one from vertex {i + 1}"
            if beside:
                first, middle, last = (a, b, d) if j == i + 1 else (c, d, b)
                u = (first[0] - middle[0], first[1] - middle[1])
                v = (last[0] - middle[0], last[1] - middle[1])
                turn, along = u[0] * v[1] - u[1] * v[0], u[0] * v[0] + u[1] * v[1]
                if abs(turn) <= 1e-12 * abs(along) and along > 0.0:
                    return (i + 1 if j == i + 1 else 0), "the outline turns back on itself here"
    return None


def _vertices(part: Outlined, path: Path) -> tuple[Sequence[Point], bool]:
    """Vertices of an entry, and whether they are given beside the track."""
    if bool(part.outline_m) == bool(part.outline_along_m):
        raise Refusal(path, "must have exactly one of outline_m and outline_along_m")
    if part.outline_m:
        return part.outline_m, False
    return part.outline_along_m, True


def _closed(part: Outlined) -> bool:
    return bool(getattr(part, "closed", True))


def check_site(model: ScenarioModel) -> None:
    """Refuse a place that cannot be meant."""
    if model.site is None:
        return
    for key in ("zones", "fixed", "areas", "tracks"):
        names: set[str] = set()
        for i, part in enumerate(getattr(model.site, key)):
            path: Path = ("site", key, i)
            if part.name in names:
                raise Refusal((*path, "name"), f"there is a {part.name!r} already")
            names.add(part.name)
            if key == "tracks":
                check_track(part, path)
                continue
            points, beside = _vertices(part, path)
            mistake = check_outline(points, _closed(part))
            if mistake is not None:
                field = "outline_along_m" if beside else "outline_m"
                raise Refusal((*path, field, mistake[0]), mistake[1])
            if key == "zones":
                _check_zone(part, path)
    for key in ("zones", "fixed", "standing"):
        if model.model not in ("planar", "spatial") and getattr(model.site, key):
            raise Refusal(("site", key), f"the model {model.model} does not compute it")


def _check_zone(zone: ZoneSpec, path: Path) -> None:
    own = [k for k in ("c_s", "c_d", "eps_m_per_s", "c_v_s_per_m") if getattr(zone, k) is not None]
    ways = [*(["preset"] if zone.preset else []), *(["factor"] if zone.factor is not None else [])]
    ways += own[:1]
    if len(ways) > 1:
        raise Refusal((*path, ways[1]), f"cannot be given with {ways[0]}: give one of them")
    if (zone.rise_percent != 0.0) != (zone.uphill_deg is not None):
        missing = "uphill_deg" if zone.uphill_deg is None else "rise_percent"
        raise Refusal((*path, missing), "is required: a slope has a rise and a direction")


# For the engine ------------------------------------------------------------------------------


def site_params(model: ScenarioModel) -> SiteParams:
    """The place as the engine takes it, SI units."""
    return SiteParams() if model.site is None else site_of(model.site, model.ground)


def site_of(site: Site, ground: Ground) -> SiteParams:
    """The same of a section ``site`` and the ground around it."""
    return SiteParams(
        zones=tuple(_zone(zone, ground) for zone in site.zones),
        fixed=tuple(
            FixedBody(
                body.name,
                **_outline(body),
                force=math.inf if body.yields_at_N is None else body.yields_at_N,
                energy=math.inf if body.takes_J is None else body.takes_J,
                height=body.height_m,
            )
            for body in site.fixed
        ),
        areas=tuple(Area(area.name, **_outline(area)) for area in site.areas),
        tracks=tuple(drawn_track(track) for track in site.tracks),
        border=site.border_m,
    )


def _outline(part: Outlined) -> dict[str, Any]:
    points, beside = _vertices(part, ())
    told = {"outline": tuple((x, y) for x, y in points), "beside": beside}
    return told if isinstance(part, ZoneSpec) else {**told, "closed": _closed(part)}


def _zone(zone: ZoneSpec, ground: Ground) -> GroundZone:
    factor = 1.0 if zone.factor is None else zone.factor
    c_s, c_d, c_v = (factor * k for k in (ground.c_s, ground.c_d, ground.c_v_s_per_m))
    if zone.preset is not None:
        c_s, c_d, c_v = SOILS[zone.preset], SOILS[zone.preset], 0.0
    own = {"c_s": zone.c_s, "c_d": zone.c_d, "eps": zone.eps_m_per_s, "c_v": zone.c_v_s_per_m}
    law: dict[str, Any] = {"c_s": c_s, "c_d": c_d, "eps": ground.eps_m_per_s, "c_v": c_v}
    law |= {key: value for key, value in own.items() if value is not None}
    rise, up = 0.01 * zone.rise_percent, math.radians(zone.uphill_deg or 0.0)
    slope = (rise * math.cos(up), rise * math.sin(up)) if rise else (0.0, 0.0)
    return GroundZone(zone.name, **_outline(zone), **law, rise=slope)


# GeoJSON -------------------------------------------------------------------------------------


def add_alignment(data: dict[str, Any], file: str, content: bytes) -> list[str]:
    """Fit alignment and grades to a file and put them into the section ``track`` of ``data``.

    Returns a note with the residual.

    Raises
    ------
    ScenarioError
        With the vertex or the row, and the reason.
    """
    track = data["track"]
    tolerance = track.pop("file_tolerance_m", TOLERANCE)
    for key in ("alignment", "start_x_m", "start_y_m", "start_heading_rad"):
        if track.get(key):
            raise ScenarioError(
                file, None, f"track.{key}", "comes from the file too: give one of the two"
            )
    table = file.lower().endswith(".csv")
    points = _table(file, content) if table else _line(file, content, data.get("site") or {})
    fit, line, text = _fitted(file, "", points, tolerance)
    track |= line
    text += f", {fit.plan.largest:.3g} m at most"
    if fit.grades is not None:
        if track.get("grades"):
            reason = "come from the heights of the file too: give one of the two"
            raise ScenarioError(file, None, "track.grades", reason)
        begin = track.get("start_coordinate_m", 0.0)
        track["grades"] = list(_grades(fit.grades, begin))
        text += f"; heights {fit.grades.rms:.3g} m, {fit.grades.largest:.3g} m at most"
    _add_input(data, file, content)
    return [f"{file}: {text}"]


def _add_input(data: dict[str, Any], file: str, content: bytes) -> None:
    """Name a file among those that the scenario was made from."""
    entry = {"file": file, "sha256": hashlib.sha256(content).hexdigest()}
    data["inputs"] = [*(i for i in data.get("inputs") or [] if i != entry), entry]


def _piece(length: float, begin: float, end: float) -> dict[str, Any]:
    """A piece of the alignment by its length, m, and the curvature at its ends, 1/m."""
    if begin == end == 0.0:
        return {"tangent": {"length_m": length}}
    turn = "left" if begin + end > 0.0 else "right"
    if begin == end:
        return {"curve": {"length_m": length, "radius_m": abs(1.0 / begin), "turn": turn}}
    ends = {"radius_start_m": begin, "radius_end_m": end}
    radii = {key: abs(1.0 / value) for key, value in ends.items() if value}
    return {"spiral": {"length_m": length, "turn": turn, **radii}}


def _grades(fit: Any, begin: float) -> list[dict[str, Any]]:
    at, value = fit.stretches.knots()
    found = [{"from_m": None, "grade_percent": 100.0 * float(value[0])}]
    for j in range(1, len(at) - 1, 2):
        middle, length = 0.5 * (at[j] + at[j + 1]), at[j + 1] - at[j]
        grade = 100.0 * float(value[j + 1])
        found.append(
            {
                "from_m": begin + float(middle),
                "grade_percent": grade,
                "vertical_curve_m": float(length),
            }
        )
    return found


def _table(file: str, content: bytes) -> Any:
    """Points of a CSV table of chainage, curvature and height."""
    import csv
    import io

    import numpy as np

    from derail_ros.scenario.alignment import points_of_table

    rows = list(csv.DictReader(io.StringIO(content.decode("utf-8-sig"))))
    columns = set(rows[0]) if rows else set()
    if not {"chainage_m", "curvature_per_m"} <= columns:
        raise ScenarioError(file, 1, "", "needs the columns chainage_m and curvature_per_m")
    names = [n for n in ("chainage_m", "curvature_per_m", "height_m") if n in columns]
    values = np.zeros((len(rows), len(names)))
    for i, row in enumerate(rows):
        for j, name in enumerate(names):
            try:
                values[i, j] = float(row[name])
            except (TypeError, ValueError):
                raise ScenarioError(file, i + 2, name, "must be a number") from None
            if not math.isfinite(values[i, j]):
                raise ScenarioError(file, i + 2, name, "must be finite")
        if i and values[i, 0] <= values[i - 1, 0]:
            raise ScenarioError(file, i + 2, "chainage_m", "must rise from row to row")
        if abs(values[i, 1]) > 0.1:
            raise ScenarioError(file, i + 2, "curvature_per_m", "must lie within -0.1 and 0.1")
    if len(rows) < 2:
        raise ScenarioError(file, None, "", "needs at least two rows")
    return points_of_table(*values.T)


def _line(file: str, content: bytes, site: dict[str, Any]) -> Any:
    """Points of the one LineString of a GeoJSON file, with heights where all have one."""
    import numpy as np

    features = _features(file, content)
    lines = [
        (n, f)
        for n, f in enumerate(features, 1)
        if isinstance(f.get("geometry"), dict) and f["geometry"].get("type") == "LineString"
    ]
    named = [(n, f) for n, f in lines if (f.get("properties") or {}).get("role") == "track"]
    lines = named or lines
    if len(lines) != 1:
        reason = f"must have one LineString, or one with the role track, has {len(lines)}"
        raise ScenarioError(file, None, "", reason)
    number, feature = lines[0]
    place = f"feature {number}"
    to_frame = _to_frame(file, json.loads(content), site)
    points, _ = _geometry(file, place, feature["geometry"], to_frame)
    heights = [v[2] for v in feature["geometry"]["coordinates"] if len(v) > 2]
    if heights and len(heights) != len(points):
        raise ScenarioError(file, None, place, "some vertices have a height and others none")
    return np.column_stack([points, heights]) if heights else np.array(points)


def add_features(data: dict[str, Any], file: str, content: bytes) -> list[str]:
    """Put the features of a GeoJSON file before the entries of the section ``site`` in ``data``.

    Returns notes about what was ignored.

    Raises
    ------
    ScenarioError
        With the feature, the vertex and the reason.
    """
    site = data["site"]
    features = _features(file, content)
    to_frame = _to_frame(file, json.loads(content), site)
    found: dict[str, list[dict[str, Any]]] = {"zones": [], "fixed": [], "areas": [], "tracks": []}
    notes = []
    for number, feature in enumerate(features, 1):
        properties = feature.get("properties") or {}
        role = properties.get("role")
        name = properties.get("name")
        if role == "track":
            continue  # that is for track.file
        place = f"feature {number}" + (f" ({name})" if isinstance(name, str) else "")
        if role == SECOND_TRACK:
            line, note = _second_track(file, place, feature, to_frame)
            found["tracks"].append({"name": name or f"track {number}", **line})
            notes.append(note)
            continue
        if role not in ROLES:
            told = "has no role" if role is None else f"has the unknown role {shown(role)}"
            known = (*ROLES, SECOND_TRACK)
            reason = f"{told}: one of {', '.join(known)}{did_you_mean(str(role), known)}"
            raise ScenarioError(file, None, place, reason)
        key, kind = ROLES[role]
        points, closed = _geometry(file, place, feature.get("geometry"), to_frame)
        entry: dict[str, Any] = {"name": name or f"{role} {number}", "outline_m": points}
        if "closed" in kind.model_fields:
            entry["closed"] = closed
        elif not closed:
            raise ScenarioError(file, None, place, f"a {role} must be a Polygon")
        for prop, value in properties.items():
            if prop in entry:
                continue
            if prop in kind.model_fields or field_of(prop, kind) is not None:
                entry[prop] = value
            elif prop not in ("role", "name"):
                notes.append(f"{file}: {place}: property {prop!r} is not known and is ignored")
        try:
            entry = canonical(entry, kind, (), {})
            validated(kind, entry)
        except Refusal as mistake:
            what = ".".join(map(str, mistake.path))
            raise ScenarioError(file, None, place, f"{what}: {mistake.reason}") from None
        found[key].append(entry)
    for key, entries in found.items():
        if entries:
            site[key] = [*entries, *(site.get(key) or [])]
    _add_input(data, file, content)
    return notes


def _second_track(
    file: str, place: str, feature: dict[str, Any], to_frame: ToFrame
) -> tuple[dict[str, Any], str]:
    """The alignment fitted to a LineString, and a note with the residual."""
    points, closed = _geometry(file, place, feature.get("geometry"), to_frame)
    if closed:
        raise ScenarioError(file, None, place, f"a {SECOND_TRACK} must be a LineString")
    tolerance = feature["properties"].get("file_tolerance_m", TOLERANCE)
    _, line, text = _fitted(file, place, points, tolerance)
    return line, f"{file}: {place}: {text}"


def _fitted(
    file: str, place: str, points: Any, tolerance: Any
) -> tuple[Alignment, dict[str, Any], str]:
    """An alignment fitted to points, the fields of a track that say it, and the residual."""
    import numpy as np

    from derail_ros.scenario.alignment import FitError, fit_once

    if not isinstance(tolerance, (int, float)) or not 0.0 < tolerance <= 100.0:
        reason = f"file_tolerance_m: must be above 0 and at most 100, got {shown(tolerance)}"
        raise ScenarioError(file, None, place, reason)
    try:
        fit = fit_once(np.asarray(points), float(tolerance))
    except FitError as error:
        raise ScenarioError(file, None, place, str(error)) from None
    line = {"start_x_m": fit.x, "start_y_m": fit.y, "start_heading_rad": fit.heading}
    alignment = [_piece(*piece) for piece in fit.pieces()]
    text = f"{len(alignment)} pieces of track, residual {fit.plan.rms:.3g} m (root mean square)"
    return fit, {**line, "alignment": alignment}, text


def _features(file: str, content: bytes) -> list[dict[str, Any]]:
    try:
        data = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise ScenarioError(file, None, "", f"is no GeoJSON: {error}") from None
    features = data.get("features") if isinstance(data, dict) else None
    if not isinstance(features, list) or not all(isinstance(f, dict) for f in features):
        raise ScenarioError(file, None, "", "is no GeoJSON FeatureCollection")
    return features


def _to_frame(file: str, data: dict[str, Any], site: dict[str, Any]) -> ToFrame:
    """From the coordinates of the file to the frame of the track."""
    system = str(site.get("reference_system") or "").upper()
    named = ((data.get("crs") or {}).get("properties") or {}).get("name")
    if named:  # of GeoJSON before RFC 7946
        code = re.search(r"(\d+)$", str(named))
        own = f"EPSG:{code[1]}" if code and "CRS84" not in str(named) else "EPSG:4326"
        if system and system != own:
            reason = f"is in {own} by its crs, site.reference_system says {system}"
            raise ScenarioError(file, None, "crs", reason)
        system = own
    if system == "LOCAL":
        return lambda x, y: (x, y)
    given = site.get("datum")
    if not isinstance(given, dict):
        reason = "longitude and latitude need site.datum (or reference_system: local, in metres)"
        raise ScenarioError(file, None, "", reason)
    try:
        checked = validated(DatumSpec, canonical(given, DatumSpec, (), {}))
    except Refusal as mistake:
        raise Refusal(("site", "datum", *mistake.path), mistake.reason) from None
    datum = datum_of({"datum": checked.model_dump()})
    assert datum is not None
    if system in ("", "EPSG:4326"):
        return _by_degrees(datum)
    try:
        import pyproj
    except ImportError:
        reason = f"{system} needs pyproj: pip install derail_ros[site]"
        raise ScenarioError(file, None, "site.reference_system", reason) from None
    try:
        transformer = pyproj.Transformer.from_crs(system, "EPSG:4326", always_xy=True)
    except pyproj.exceptions.CRSError:
        reason = f"{system} is no reference system"
        raise ScenarioError(file, None, "site.reference_system", reason) from None

    def projected(x: float, y: float) -> Point:
        longitude, latitude = transformer.transform(x, y)
        return datum.local(latitude, longitude)

    return projected


def _by_degrees(datum: Datum) -> ToFrame:
    def to_frame(longitude: float, latitude: float) -> Point:
        if abs(latitude) > 90.0 or abs(longitude) > 180.0:
            raise ValueError(
                f"({longitude:g}, {latitude:g}) is no longitude and latitude: another reference "
                "system (site.reference_system), or exchanged?"
            )
        return datum.local(latitude, longitude)

    return to_frame


def _geometry(
    file: str, place: str, geometry: Any, to_frame: ToFrame
) -> tuple[list[list[float]], bool]:
    """Vertices in the frame, m, of a Polygon or LineString, and whether it is closed."""
    kind = geometry.get("type") if isinstance(geometry, dict) else None
    if kind not in ("Polygon", "LineString"):
        reason = f"must be a Polygon or a LineString, not {shown(kind)}"
        raise ScenarioError(file, None, place, reason)
    rings = geometry.get("coordinates")
    if kind == "Polygon" and isinstance(rings, list) and len(rings) > 1:
        raise ScenarioError(file, None, place, "has a hole: give a polygon without holes")
    ring = rings[0] if kind == "Polygon" and rings else rings
    points: list[list[float]] = []
    for k, vertex in enumerate(ring if isinstance(ring, list) else ()):
        numbers = isinstance(vertex, list) and len(vertex) >= 2
        if not numbers or not all(type(v) in (int, float) and math.isfinite(v) for v in vertex):
            raise ScenarioError(file, None, place, f"vertex {k + 1}: must be two numbers")
        try:
            x, y = to_frame(float(vertex[0]), float(vertex[1]))
        except ValueError as error:
            raise ScenarioError(file, None, place, f"vertex {k + 1}: {error}") from None
        points.append([round(x, 4), round(y, 4)])
    if kind == "Polygon":
        if len(points) < 2 or points[0] != points[-1]:
            raise ScenarioError(file, None, place, "the last vertex must be the first one again")
        points.pop()
    mistake = check_outline([(x, y) for x, y in points], kind == "Polygon")
    if mistake is not None:
        raise ScenarioError(file, None, place, f"vertex {mistake[0] + 1}: {mistake[1]}")
    return points, kind == "Polygon"
