"""The centre line: tangents, spirals (clothoids) and circular curves.

Every piece has a curvature that changes linearly with arc length,
``kappa(u) = kappa0 + kappa' u``, so its heading is ``psi0 + kappa0 u + kappa' u^2 / 2`` and its
place the integral of (cos, sin) of the heading. An empty alignment is an endless straight along +X
whose track coordinate is X.

A truck on the rails is a point whose signed distance d from the line (positive to the left) is
zero. With n the unit normal at the foot point, t the tangent, and ``c = kappa / (1 - kappa d)``,

    grad d = n,    d'' = n . A - c (t . V)^2

so a row of the constraint Jacobian is n and its multiplier is the lateral force in newtons.
"""

from __future__ import annotations

import math

import numpy as np

from derail_ros.engine import layout
from derail_ros.engine.arrays import F64, Rows
from derail_ros.engine.jit import inner_jit, jit
from derail_ros.engine.laws.profile import height
from derail_ros.engine.trigonometry import sincos
from derail_ros.vocabulary.params import GradeChange, TrackParams

_GAUSS_X, _GAUSS_W = np.polynomial.legendre.leggauss(8)
GX = tuple(0.5 * (x + 1.0) for x in _GAUSS_X.tolist())
GW = tuple(0.5 * w for w in _GAUSS_W.tolist())

MAX_PIECE_TURN = 0.2
"""Clothoids are cut into pieces that turn less than this (rad): 8 Gauss points are then exact to
rounding."""


@jit
def heading_at(track: Rows, k: int, u: float) -> float:
    """Heading (rad) at the distance ``u`` (m) along piece ``k``."""
    return track[k].psi + (track[k].kappa + 0.5 * track[k].dkappa * u) * u


@jit
def point_at(track: Rows, k: int, u: float) -> tuple[float, float]:
    """Place (m) at the distance ``u`` (m) along piece ``k``."""
    x0 = track[k].x
    y0 = track[k].y
    psi = track[k].psi
    kappa = track[k].kappa
    if track[k].dkappa == 0.0:
        if kappa == 0.0:
            return x0 + u * math.cos(psi), y0 + u * math.sin(psi)
        # chord of the arc, free of cancellation at small angles
        half = 0.5 * kappa * u
        chord = 2.0 * math.sin(half) / kappa
        return x0 + chord * math.cos(psi + half), y0 + chord * math.sin(psi + half)
    sx = 0.0
    sy = 0.0
    for g in range(8):
        h = heading_at(track, k, GX[g] * u)
        sx += GW[g] * math.cos(h)
        sy += GW[g] * math.sin(h)
    return x0 + u * sx, y0 + u * sy


@jit
def piece_of(track: Rows, s: float, hint: int) -> int:
    """Index of the piece that holds the track coordinate ``s``, searched from ``hint``."""
    k = min(max(hint, 0), track.shape[0] - 1)
    while k > 0 and s < track[k].s:
        k -= 1
    while k < track.shape[0] - 1 and s >= track[k + 1].s:
        k += 1
    return k


@inner_jit
def _foot_on_arc(track: Rows, k: int, x: float, y: float, s: float) -> tuple[float, float]:
    """Foot point of (x, y) on piece ``k`` of constant curvature: track coordinate and offset, m.

    Of the turns of a circle the one nearest to ``s`` counts.
    """
    n, c = sincos(track[k].psi)
    dx = x - track[k].x
    dy = y - track[k].y
    a = c * dx + n * dy
    b = -n * dx + c * dy
    kappa = track[k].kappa
    if kappa == 0.0:
        return track[k].s + a, b
    phi = math.atan2(kappa * a, 1.0 - kappa * b)
    turns = (kappa * (s - track[k].s) - phi) / (2.0 * math.pi)
    phi += 2.0 * math.pi * math.floor(turns + 0.5)
    # the distance to the centre, in radii, is sqrt(1 + kappa w): free of cancellation
    w = kappa * (a * a + b * b) - 2.0 * b
    return track[k].s + phi / kappa, -w / (1.0 + math.sqrt(max(1.0 + kappa * w, 0.0)))


@jit
def locate(track: Rows, x: float, y: float, s: float) -> tuple[float, float, float, float, float]:
    """Foot point of (x, y) on the line; on spirals by Newton's method from ``s`` (m).

    Returns ``(s, d, heading, kappa, residual)``: track coordinate, signed offset to the left (m),
    heading and curvature at the foot point, and what is left of the foot-point equation (m). The
    end pieces are continued beyond the ends.
    """
    if track.shape[0] == 0:
        return x, y, 0.0, 0.0, 0.0
    k = piece_of(track, s, 0)
    e = 0.0
    d = 0.0
    h = 0.0
    kappa = 0.0
    for _ in range(30):
        if track[k].dkappa == 0.0:
            e = 0.0
            s, d = _foot_on_arc(track, k, x, y, s)
            h = heading_at(track, k, s - track[k].s)
            kappa = track[k].kappa
            other = piece_of(track, s, k)
            if other == k:
                break
            k = other
            continue
        u = s - track[k].s
        px, py = point_at(track, k, u)
        h = heading_at(track, k, u)
        kappa = track[k].kappa + track[k].dkappa * u
        c = math.cos(h)
        n = math.sin(h)
        e = (x - px) * c + (y - py) * n
        d = -(x - px) * n + (y - py) * c
        if abs(e) < 1e-11:
            break
        s += e / max(1.0 - kappa * d, 0.1)
        k = piece_of(track, s, k)
    return s, d, h, kappa, e


def grade_pieces(changes: tuple[GradeChange, ...]) -> Rows:
    """Pieces of the profile (``laws.profile``), with height 0 at the track coordinate 0."""
    rows: list[tuple[float, float, float, float]] = []
    grade = 0.0
    for change in changes:
        if math.isinf(change.at):
            grade = change.grade
            continue
        begin, end = change.at - 0.5 * change.length, change.at + 0.5 * change.length
        if not rows:
            rows.append((begin, 0.0, grade, 0.0))
        s, z, g, c = rows[-1]
        z += (g + 0.5 * c * (begin - s)) * (begin - s)
        if change.length > 0.0:
            rows.append((begin, z, grade, (change.grade - grade) / change.length))
            z += 0.5 * (grade + change.grade) * change.length
        rows.append((end, z, change.grade, 0.0))
        grade = change.grade
    if changes and not rows:
        rows.append((0.0, 0.0, grade, 0.0))
    pieces = np.array(rows, layout.GRADE)
    if rows:
        pieces["z"] -= height(pieces, 0.0)[0]
    return pieces


class Track:
    """The alignment of a run, for queries from outside the kernels.

    Attributes
    ----------
    pieces : (P,) TRACK, as the kernels take them
    start, end : track coordinates of its ends, m (infinite for the endless straight)
    grades : (G,) GRADE; none: level
    """

    def __init__(self, params: TrackParams) -> None:
        rows: list[tuple[float, ...]] = []
        s, x, y, psi = (
            params.start_coordinate,
            params.start_x,
            params.start_y,
            params.start_heading,
        )
        for seg in params.segments:
            slope = (seg.curvature_end - seg.curvature_start) / seg.length
            turn = max(abs(seg.curvature_start), abs(seg.curvature_end)) * seg.length
            parts = 1 if slope == 0.0 else max(1, math.ceil(turn / MAX_PIECE_TURN))
            for j in range(parts):
                length = seg.length / parts
                kappa = seg.curvature_start + slope * length * j
                row = (s, length, x, y, psi, kappa, slope)
                one = np.array([row], layout.TRACK)
                x, y = point_at(one, 0, length)
                psi = heading_at(one, 0, length)
                s += length
                rows.append(row)
        self.pieces: Rows = np.array(rows, layout.TRACK)
        self.start = params.start_coordinate if rows else -math.inf
        self.end = s if rows else math.inf
        self.grades = grade_pieces(params.grades)

    @property
    def straight(self) -> bool:
        """The endless straight along +X, with track coordinate X."""
        return len(self.pieces) == 0

    def point(self, s: float) -> tuple[float, float, float, float]:
        """Place, heading and curvature at the track coordinate ``s``: (x, y, heading, kappa)."""
        if len(self.pieces) == 0:
            return s, 0.0, 0.0, 0.0
        k = piece_of(self.pieces, s, 0)
        u = s - self.pieces[k]["s"]
        x, y = point_at(self.pieces, k, u)
        kappa = self.pieces[k]["kappa"] + self.pieces[k]["dkappa"] * u
        return float(x), float(y), float(heading_at(self.pieces, k, u)), float(kappa)

    def points(self, s: F64) -> F64:
        """Places (m, (..., 2)) at track coordinates ``s`` (m), also beyond the ends."""
        if len(self.pieces) == 0:
            return np.stack([s, np.zeros_like(s)], axis=-1)
        last = len(self.pieces) - 1
        p = self.pieces[np.clip(np.searchsorted(self.pieces["s"], s, "right") - 1, 0, last)]
        u = s - p["s"]
        half = 0.5 * p["kappa"] * u
        chord = u * np.sinc(half / np.pi)
        arc = chord * np.exp(1j * (p["psi"] + half))
        heading = sum(
            w * np.exp(1j * (p["psi"] + (p["kappa"] + 0.5 * p["dkappa"] * g * u) * g * u))
            for g, w in zip(GX, GW, strict=True)
        )
        z = p["x"] + 1j * p["y"] + np.where(p["dkappa"] == 0.0, arc, u * heading)
        return np.stack([z.real, z.imag], axis=-1)

    def height(self, s: float) -> tuple[float, float]:
        """Height over the track at coordinate 0 (m) and grade (rise per metre) at ``s``."""
        if len(self.grades) == 0:
            return 0.0, 0.0
        z, grade = height(self.grades, s)
        return float(z), float(grade)

    def locate(self, x: float, y: float, hint: float | None = None) -> tuple[float, float]:
        """Track coordinate and offset to the left of a point (m).

        Without a ``hint`` the nearest of a sampling of the line starts the search.
        """
        if len(self.pieces) == 0:
            return x, y
        if hint is None:
            grid = np.linspace(self.start, self.end, max(2, int((self.end - self.start) / 5.0)))
            points = np.array([self.point(float(s))[:2] for s in grid])
            hint = float(grid[np.argmin(np.hypot(points[:, 0] - x, points[:, 1] - y))])
        s, d, _, _, _ = locate(self.pieces, x, y, hint)
        return float(s), float(d)
