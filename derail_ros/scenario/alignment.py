"""An alignment fitted to points: tangents, spirals and circular curves; grades to heights.

The curvature over the arc length is taken as level stretches (tangents, circular curves) with
ramps (spirals) between them. Least squares of the points' distances from the line give lengths and
curvatures; from many short stretches, those are taken out one after the other that the points do
not ask for: while the sum of squares over the variance of a point grows by less than
``PRICE ln(n)`` for each number less (the criterion of G. Schwarz, Ann. Statist. 6 (1978), is 1).
The same goes for the grade over the heights, with vertical curves (parabolas) as ramps. Standard
errors are those of least squares.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_smoothing_spline
from scipy.optimize import least_squares

F64 = NDArray[np.float64]

PRICE = 2.0
"""What a number must be worth; twice Schwarz's, for the points of surveys hang together."""
SHORTEST = 1.0
"""Shortest ramp, m."""
SAMPLES = 300
"""Places at which the first guess looks at the curvature."""
MOST = 40
"""Most level stretches of a first guess."""
FINENESS = (0.1, 0.05, 0.02)
"""Changes of the curvature that first guesses see, as shares of all of it; until one fits."""
ACCEPTED = 1.5
"""Largest residual, root mean square over the tolerance."""
CELL = 5.0
"""Largest cell of the integration along a line, m: four Gauss points are exact to rounding."""
_X, _W = np.polynomial.legendre.leggauss(4)
NODES, WEIGHTS = 0.5 * (_X + 1.0), 0.5 * _W


class FitError(ValueError):
    """Points that no line goes through within the tolerance."""


@dataclass(frozen=True)
class Stretches:
    """Level stretches of a value over arc length, with linear ramps between them.

    Attributes
    ----------
    level : (K,) values of the stretches
    length : (K-1,) lengths of all stretches but the last, m; it has no end
    ramp : (K-1,) lengths of the ramps behind them, m
    """

    level: F64
    length: F64
    ramp: F64

    def knots(self) -> tuple[F64, F64]:
        """Where stretches and ramps begin, from 0, and the values there."""
        steps = np.stack([self.length, self.ramp], axis=1).ravel()
        return np.concatenate([[0.0], np.cumsum(steps)]), np.repeat(self.level, 2)[:-1]

    def without(self, j: int) -> Stretches:
        """Without the stretch ``j``: it and its ramps become one ramp, or its neighbour's part."""
        level = np.delete(self.level, j)
        last = len(self.level) - 1
        if j == last:
            return Stretches(level, self.length[:-1], self.ramp[:-1])
        if j == 0:
            length = self.length[1:].copy()
            if len(length):
                length[0] += self.length[0] + self.ramp[0]
            return Stretches(level, length, self.ramp[1:])
        ramp = np.delete(self.ramp, j)
        ramp[j - 1] += self.length[j] + self.ramp[j]
        return Stretches(level, np.delete(self.length, j), ramp)

    @cached_property
    def _pieces(self) -> tuple[F64, F64, F64, F64]:
        """Where each piece begins, and there the value, half its slope, and its integral."""
        at, value = self.knots()
        long = np.diff(at)
        slope = np.append(np.diff(value) / np.maximum(long, 1e-12), 0.0)
        sums = np.concatenate([[0.0], np.cumsum(0.5 * (value[:-1] + value[1:]) * long)])
        return at, value, 0.5 * slope, sums

    def integral(self, s: F64) -> F64:
        """Integral of the value from 0 to ``s``."""
        at, value, half_slope, sums = self._pieces
        k = np.clip(np.searchsorted(at, s, "right") - 1, 0, len(at) - 1)
        u = s - at[k]
        return sums[k] + (value[k] + half_slope[k] * u) * u


@dataclass(frozen=True)
class Fit:
    """A fit of stretches.

    Attributes
    ----------
    stretches : the fit
    start : first numbers of it: offset (m) and heading (rad), or height (m)
    rms, largest : residual of the points, m
    error : standard errors of the levels (K,), of lengths (K-1,) and of ramps (K-1,)
    length : from the first point to the last one along the line, m
    """

    stretches: Stretches
    start: F64
    rms: float
    largest: float
    error: Stretches
    length: float


@dataclass(frozen=True)
class Alignment:
    """A line through points.

    Attributes
    ----------
    x, y, heading : of its beginning, m, rad
    plan : fit of the curvature, 1/m
    grades : fit of the grade; None without heights
    """

    x: float
    y: float
    heading: float
    plan: Fit
    grades: Fit | None = None

    def pieces(self) -> Iterator[tuple[float, float, float]]:
        """Length (m) and curvature at both ends (1/m) of each piece, in the order of travel."""
        at, value = self.plan.stretches.knots()
        ends = np.append(at[1:], max(self.plan.length, at[-1] + SHORTEST))
        nexts = np.append(value[1:], value[-1])
        for begin, end, a, b in zip(at, ends, value, nexts, strict=True):
            if end - begin < 1e-6:
                continue
            if a * b < 0.0:  # through zero: a spiral each way
                middle = (end - begin) * a / (a - b)
                yield middle, a, 0.0
                yield end - begin - middle, 0.0, b
            else:
                yield end - begin, a, b


def _cells(length: float) -> F64:
    return np.linspace(0.0, length, max(2, math.ceil(length / CELL) + 1))


def line_points(stretches: Stretches, heading: float, s: F64) -> NDArray[np.complex128]:
    """Places x + i y at the arc lengths ``s`` of a line from the origin with this curvature."""
    cells = np.union1d(_cells(max(float(s.max()), CELL)), np.minimum(stretches.knots()[0], 1e7))

    def way(begin: F64, end: F64) -> NDArray[np.complex128]:
        u = begin[:, None] + (end - begin)[:, None] * NODES
        turned = np.exp(1j * (heading + stretches.integral(u)))
        return (end - begin) * (turned @ WEIGHTS)

    starts = np.concatenate([[0.0j], np.cumsum(way(cells[:-1], cells[1:]))])
    k = np.clip(np.searchsorted(cells, s, "right") - 1, 0, len(cells) - 1)
    return starts[k] + way(cells[k], s)


def _pack(start: F64, fit: Stretches, free: NDArray[np.bool_]) -> F64:
    return np.concatenate([start, fit.length, fit.ramp, fit.level[free]])


def _unpack(p: F64, m: int, k: int, free: NDArray[np.bool_]) -> tuple[F64, Stretches]:
    level = np.zeros(k)
    level[free] = p[m + 2 * (k - 1) :]
    return p[:m], Stretches(level, p[m : m + k - 1], p[m + k - 1 : m + 2 * (k - 1)])


Residual = Callable[[F64, Stretches], F64]
Slopes = Callable[[F64, Stretches, list[Stretches]], F64]
"""Residuals of the points, and their derivatives by the starting numbers and by each change."""

SMALL = 1e-6
"""Change of a number for a derivative: of its size, and of a length in m."""


def _solve(
    problem: tuple[Residual, Slopes],
    start: F64,
    guess: Stretches,
    free: NDArray[np.bool_],
    far: float,
    tries: int = 200,
) -> tuple[float, F64, Stretches, Any]:
    """Least squares from a guess: sum of squares, start, stretches, what the solver says."""
    residual, slopes = problem
    m, k = len(start), len(guess.level)
    low = np.full(m + 2 * (k - 1) + int(free.sum()), -np.inf)
    high = np.full(len(low), np.inf)
    low[m : m + k - 1], high[m : m + 2 * (k - 1)] = 0.0, far
    low[m + k - 1 : m + 2 * (k - 1)] = SHORTEST
    p = np.clip(_pack(start, guess, free), low + 1e-6, high - 1e-6)
    steps = np.full(len(p), SMALL)
    steps[m + 2 * (k - 1) :] *= max(float(np.abs(guess.level).max()), 1e-9)

    def f(p: F64) -> F64:
        return residual(*_unpack(p, m, k, free))

    def jacobian(p: F64) -> F64:
        changed = []
        for j in range(m, len(p)):
            moved = p.copy()
            moved[j] += steps[j]
            changed.append(_unpack(moved, m, k, free)[1])
        told = slopes(*_unpack(p, m, k, free), changed)
        told[:, m:] /= steps[m:]
        return told

    told = least_squares(f, p, jac=jacobian, bounds=(low, high), x_scale="jac", xtol=1e-13,
                         ftol=1e-13, gtol=1e-15, max_nfev=tries)  # fmt: skip
    return 2.0 * float(told.cost), *_unpack(told.x, m, k, free), told


def _search(
    problem: tuple[Residual, Slopes], start: F64, guess: Stretches, sigma: float, n: int,
    far: float,
) -> Fit:  # fmt: skip
    """The fewest stretches that the points ask for."""
    price = PRICE * math.log(n) * sigma * sigma
    free = np.ones(len(guess.level), dtype=bool)
    best = _solve(problem, start, guess, free, far, 30)
    while len(best[2].level) > 1:
        tries = []
        for j in range(len(best[2].level)):
            left = np.delete(free, j)
            tried = _solve(problem, best[1], best[2].without(j), left, far, 12)
            tries.append((tried[0] - (2 + int(free[j])) * price, j, tried))
        _, j, tried = min(tries, key=lambda t: t[:2])
        left = np.delete(free, j)
        tried = _solve(problem, tried[1], tried[2], left, far, 60)
        if tried[0] - (2 + int(free[j])) * price > best[0]:
            break
        best, free = tried, left
    for j in np.argsort(np.abs(best[2].level)):
        fixed = free.copy()
        fixed[j] = False
        level = np.where(fixed, best[2].level, 0.0)
        flat = Stretches(level, best[2].length, best[2].ramp)
        tried = _solve(problem, best[1], flat, fixed, far)
        if tried[0] - price > best[0]:
            break
        best, free = tried, fixed
    best = _solve(problem, best[1], best[2], free, far)
    while (same := np.flatnonzero(~free[1:] & ~free[:-1])).size:
        free = np.delete(free, same[0])
        best = _solve(problem, best[1], best[2].without(int(same[0])), free, far)
    _, begin, fit, told = best
    rest = problem[0](begin, fit)
    # a ramp of no length changes nothing to first order: errors as at two spacings of the points
    seen = Stretches(fit.level, fit.length, np.maximum(fit.ramp, 2.0 * far / n))
    told = _solve(problem, begin, seen, free, far, 1)[3]
    spare = max(n - len(told.x), 1)
    scatter = float(rest @ rest) / spare
    size = np.maximum(np.sqrt((told.jac**2).sum(axis=0)), 1e-300)  # numbers differ in scale
    _, singular, turn = np.linalg.svd(told.jac / size, full_matrices=False)
    spread = turn.T / np.maximum(singular, 1e-9 * singular[0])
    p = np.sqrt((spread**2).sum(axis=1) * scatter) / size
    _, error = _unpack(p, len(begin), len(fit.level), free)
    return Fit(fit, begin, math.sqrt(float(np.mean(rest**2))), float(np.abs(rest).max()), error, 0)


def _guess(s: F64, value: F64, fine: float) -> Stretches:
    """Level stretches by dynamic programming: least squares and a price for each."""
    n = len(s)
    ones, sums, squares = (np.concatenate([[0.0], np.cumsum(value**k)]) for k in (0, 1, 2))

    def spread(i: Any, j: int) -> Any:
        count = ones[j] - ones[i]
        return squares[j] - squares[i] - (sums[j] - sums[i]) ** 2 / count

    total = float(np.ptp(value))
    price = max(n / 15.0 * (fine * total) ** 2, 1e-30)
    cost, back = np.zeros(n + 1), np.zeros(n + 1, dtype=int)
    for j in range(1, n + 1):
        i = np.arange(j)
        tried = cost[:j] + spread(i, j) + price
        back[j] = int(np.argmin(tried))
        cost[j] = tried[back[j]]
    cuts = [n]
    while cuts[-1] > 0:
        cuts.append(int(back[cuts[-1]]))
    cuts = cuts[::-1]
    level = np.array([value[a:b].mean() for a, b in zip(cuts, cuts[1:], strict=False)])
    borders = np.array([0.5 * (s[c - 1] + s[c]) for c in cuts[1:-1]]) - s[0]
    if len(level) > MOST:
        raise FitError(f"the points show {len(level)} curves: a larger tolerance is needed")
    # a third of each stretch beside a border becomes its ramp
    ends = np.concatenate([[0.0], borders, [s[-1] - s[0]]])
    third = np.diff(ends) / 3.0
    ramp = third[:-1] + third[1:]
    length = np.diff(ends)[:-1] - third[:-1] - np.concatenate([[0.0], third[1:-1]])
    return Stretches(level, np.maximum(length, 0.0), np.maximum(ramp, SHORTEST))


def _smooth(t: F64, value: F64, tolerance: float) -> Any:
    """The smoothest spline whose residual is within the tolerance, root mean square."""
    low, high = -8.0, 14.0  # of the power of ten of the penalty
    for _ in range(18):
        middle = 0.5 * (low + high)
        spline = make_smoothing_spline(t, value, lam=10.0**middle)
        if float(np.mean((spline(t) - value) ** 2)) <= tolerance * tolerance:
            low = middle
        else:
            high = middle
    return make_smoothing_spline(t, value, lam=10.0**low)


def fit_alignment(points: F64, tolerance: float = 0.01) -> Alignment:
    """Fit an alignment to points.

    Parameters
    ----------
    points : (n, 2) x and y, m, or (n, 3) with heights, in the direction of travel
    tolerance : standard deviation that is granted to a point, m

    Raises
    ------
    FitError
        Too few points, points out of order, or no fit within 1.5 times the tolerance.
    """
    points = np.asarray(points, dtype=float)
    if len(points) < 8:
        raise FitError(f"needs at least 8 points, not {len(points)}")
    steps = np.diff(points[:, :2], axis=0)
    chord = np.hypot(*steps.T)
    if not chord.min() > 1e-3:
        raise FitError(f"vertex {int(np.argmin(chord)) + 2}: repeats the vertex before it")
    ahead = (steps[:-1] * steps[1:]).sum(axis=1)
    if (ahead < 0.0).any() and chord.min() > 4.0 * tolerance:
        raise FitError(f"vertex {int(np.argmin(ahead)) + 2}: the line turns back on itself")
    t = np.concatenate([[0.0], np.cumsum(chord)])
    z = points[:, 0] + 1j * points[:, 1]
    splines = [_smooth(t, part, tolerance) for part in (z.real, z.imag)]
    grid = np.linspace(0.0, t[-1], min(SAMPLES, 4 * len(t)))
    speed = sum(d(grid) * 1j**k for k, d in enumerate(f.derivative() for f in splines))
    bend = sum(d(grid) * 1j**k for k, d in enumerate(f.derivative(2) for f in splines))
    kappa = (np.conj(speed) * bend).imag / np.abs(speed) ** 3
    s = np.concatenate([[0.0], np.cumsum(0.5 * np.diff(grid) * np.abs(speed[1:] + speed[:-1]))])
    first = np.interp(t, grid, s)
    foot = first.copy()

    def seen(start: F64, fit: Stretches) -> tuple[F64, F64]:
        origin = z[0] + 1j * np.exp(1j * start[1]) * start[0]
        away = z - origin - line_points(fit, start[1], foot)
        away *= np.exp(-1j * (start[1] + fit.integral(foot)))
        return away.real, away.imag

    def residual(start: F64, fit: Stretches) -> F64:
        foot[:] = first  # whatever an earlier trial left
        for _ in range(3):
            ahead, aside = seen(start, fit)
            if np.abs(ahead).max() < 1e-9:
                return aside
            foot[:] = foot + ahead
        return seen(start, fit)[1]

    def slopes(start: F64, fit: Stretches, changed: list[Stretches]) -> F64:
        nodes = _cells(max(float(foot.max()), CELL))
        turned = np.exp(1j * (start[1] + fit.integral(nodes)))
        now = fit.integral(nodes)
        turns = np.array(
            [np.ones(len(nodes)), *(other.integral(nodes) - now for other in changed)]
        )
        sway = 1j * turned * turns
        moved = np.zeros(sway.shape, dtype=complex)
        moved[:, 1:] = np.cumsum(0.5 * (sway[:, 1:] + sway[:, :-1]) * np.diff(nodes), axis=1)
        k = np.clip(np.searchsorted(nodes, foot, "right") - 1, 0, len(nodes) - 2)
        part = (foot - nodes[k]) / (nodes[k + 1] - nodes[k])
        at = moved[:, k] * (1.0 - part) + moved[:, k + 1] * part
        at[0] -= np.exp(1j * start[1]) * start[0]
        at = np.concatenate([np.full((1, len(foot)), 1j * np.exp(1j * start[1])), at])
        return -(at * np.exp(-1j * (start[1] + fit.integral(foot)))).imag.T

    begin = np.array([0.0, float(np.angle(speed[0]))])
    for fine in FINENESS:
        guess = _guess(s, kappa, fine)
        plan = _search((residual, slopes), begin, guess, tolerance, len(z), float(t[-1]))
        if plan.rms <= ACCEPTED * tolerance:
            break
    _accept(residual(plan.start, plan.stretches), tolerance, "the line")
    plan = replace(plan, length=float(foot.max()))
    origin = z[0] + 1j * np.exp(1j * plan.start[1]) * plan.start[0]
    grades = fit_grades(foot, points[:, 2], tolerance) if points.shape[1] > 2 else None
    return Alignment(origin.real, origin.imag, float(plan.start[1]), plan, grades)


@lru_cache(maxsize=8)
def _fit_again(shape: tuple[int, ...], points: bytes, tolerance: float) -> Alignment:
    return fit_alignment(np.frombuffer(points).reshape(shape), tolerance)


def fit_once(points: F64, tolerance: float) -> Alignment:
    """``fit_alignment``, which a process does once for the same points: it takes seconds."""
    points = np.ascontiguousarray(points, dtype=float)
    return _fit_again(points.shape, points.tobytes(), tolerance)


def fit_grades(s: F64, height: F64, tolerance: float) -> Fit:
    """Fit grades and vertical curves to heights (m) at arc lengths ``s`` (m, rising)."""
    spline = _smooth(s, height, tolerance)
    grid = np.linspace(s[0], s[-1], min(SAMPLES, 4 * len(s)))
    grade = spline.derivative()(grid)

    def residual(start: F64, fit: Stretches) -> F64:
        return start[0] + fit.integral(s) - height

    def slopes(start: F64, fit: Stretches, changed: list[Stretches]) -> F64:
        now = fit.integral(s)
        return np.stack([np.ones(len(s)), *(other.integral(s) - now for other in changed)], axis=1)

    for fine in FINENESS:
        guess = _guess(grid, grade, fine)
        far = float(s[-1])
        found = _search((residual, slopes), height[:1].copy(), guess, tolerance, len(s), far)
        if found.rms <= ACCEPTED * tolerance:
            break
    _accept(residual(found.start, found.stretches), tolerance, "the heights")
    return found


def _accept(residual: F64, tolerance: float, what: str) -> None:
    worst = int(np.argmax(np.abs(residual)))
    rms = math.sqrt(float(np.mean(residual**2)))
    if rms > ACCEPTED * tolerance:
        raise FitError(
            f"vertex {worst + 1}: lies {abs(residual[worst]):.3g} m off {what} that fits best "
            f"(rms {rms:.3g} m, tolerance {tolerance:g} m)"
        )


def points_of_table(chainage: F64, curvature: F64, height: F64 | None = None) -> F64:
    """Points of a line whose curvature (1/m) is linear between the rows of a table, m."""
    n = max(len(chainage), math.ceil((chainage[-1] - chainage[0]) / 5.0)) + 1
    s = np.unique(np.concatenate([chainage, np.linspace(chainage[0], chainage[-1], n)]))
    places = [0.0j]
    turned = np.concatenate([[0.0], np.cumsum(
        0.5 * (curvature[1:] + curvature[:-1]) * np.diff(chainage))])  # fmt: skip

    def heading(u: F64) -> F64:
        k = np.clip(np.searchsorted(chainage, u, "right") - 1, 0, len(chainage) - 2)
        d = u - chainage[k]
        slope = (curvature[k + 1] - curvature[k]) / (chainage[k + 1] - chainage[k])
        return turned[k] + (curvature[k] + 0.5 * slope * d) * d

    for a, b in zip(s, s[1:], strict=False):
        places.append(places[-1] + (b - a) * (np.exp(1j * heading(a + (b - a) * NODES)) @ WEIGHTS))
    z = np.array(places)
    columns = [z.real, z.imag]
    if height is not None:
        columns.append(np.interp(s, chainage, height))
    return np.stack(columns, axis=1)
