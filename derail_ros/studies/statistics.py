r"""Statistics of a study: means with their uncertainty, spread, effects, Sobol indices.

Runs of an ensemble are taken as independent draws: outcomes are chaotic, so a push that differs
by a percent gives another draw.

- interval of a mean: Student's t, ``m +/- t s / sqrt(n)``, 95 %;
- interval of a ratio of means ``m / m0``: first order,
  ``sd^2 = (s^2 / n + (m / m0)^2 s0^2 / n0) / m0^2``;
- two settings are told apart when Welch's test of their means says so at 5 %, corrected after
  Holm for the number of comparisons made side by side; equal draws are never told apart, unequal
  constants always;
- main effects on a grid: the variance of a level's means over all combinations of the others, as
  a share of the variance of all runs; chaos: the variance within the points;
- in a Latin hypercube: Spearman's rank correlation of the points' means, its interval after
  Fisher with Bonett and Wright's standard error;
- Sobol indices: Saltelli's and Jansen's estimators (SALib), intervals by resampling.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import wraps
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from derail_ros.studies.design import LatinHypercube, OneAtATime, Sobol
from derail_ros.studies.results import StudyResults

if TYPE_CHECKING:
    import pandas as pd

LEVEL = 0.95
"""Level of the intervals."""

QUANTILES = {"q05": 0.05, "q25": 0.25, "median": 0.5, "q75": 0.75, "q95": 0.95}

Rows = list[dict[str, Any]]


def _once(compute: Callable[[StudyResults], pd.DataFrame]) -> Callable[..., pd.DataFrame]:
    """Compute a table once for the same results; give it as a copy."""

    @wraps(compute)
    def inner(results: StudyResults) -> pd.DataFrame:
        name = compute.__name__
        if name not in results.tables:
            results.tables[name] = compute(results)
        return results.tables[name].copy()

    return inner


# --- means ------------------------------------------------------------------------------------


def describe(values: Iterable[float]) -> dict[str, float]:
    """Mean, its interval, spread and quantiles of some runs; nan where there are too few."""
    x = np.asarray(list(values), dtype=float)
    x = x[np.isfinite(x)]
    n = len(x)
    mean = float(x.mean()) if n else math.nan
    sd = float(x.std(ddof=1)) if n > 1 else math.nan
    half = float(stats.t.ppf(0.5 + 0.5 * LEVEL, n - 1)) * sd / math.sqrt(n) if n > 1 else math.nan
    shares = [*QUANTILES.values(), 0.0, 1.0]
    quantiles = np.quantile(x, shares) if n else [math.nan] * len(shares)
    found = dict(zip((*QUANTILES, "least", "most"), map(float, quantiles), strict=True))
    return {"n": n, "mean": mean, "mean_low": mean - half, "mean_high": mean + half,
            "sd": sd, **found}  # fmt: skip


@_once
def summary(results: StudyResults) -> pd.DataFrame:
    """A row for each point and measure, in this order."""
    import pandas as pd

    first = results.first
    names = [*(["varied"] if "varied" in first else []), *results.design.columns]
    status = results.table.groupby("point")["status"]
    numbers = pd.DataFrame(
        {
            "void": status.apply(lambda s: int((s == "void").sum())),
            "failed": status.apply(lambda s: int((s == "failed").sum())),
            "runs": status.size(),
        }
    )
    values = {measure: results.values(measure) for measure in results.measures}
    rows = [
        {"point": point, **first.loc[point, names].to_dict(), "measure": measure,
         **describe(values[measure].get(point, ())), **numbers.loc[point].to_dict()}
        for point in first.index
        for measure in results.measures
    ]  # fmt: skip
    table = pd.DataFrame(rows)
    return table if results.base is None else _relative(table, results.base)


def _relative(table: pd.DataFrame, base: int) -> pd.DataFrame:
    """Add the means relative to those of the base point."""
    reference = table[table["point"] == base].set_index("measure")
    m0, s0, n0 = (table["measure"].map(reference[name]) for name in ("mean", "sd", "n"))
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = (table["mean"] / m0).where(m0 > 0.0)
        sd = np.sqrt(table["sd"] ** 2 / table["n"] + ratio**2 * s0**2 / n0) / m0
    # for the base itself numerator and denominator are the same draw
    sd = sd.where(table["point"] != base, 0.0)
    half = stats.t.ppf(0.5 + 0.5 * LEVEL, np.maximum(table["n"] - 1, 1)) * sd
    return table.assign(relative=ratio, relative_low=ratio - half, relative_high=ratio + half)


@_once
def counts(results: StudyResults) -> pd.DataFrame:
    """Number of runs of each point with each number of cars derailed, and their share."""
    grouped = results.runs.groupby(["point", "cars_derailed"]).size().rename("runs").reset_index()
    grouped["share"] = grouped["runs"] / grouped.groupby("point")["runs"].transform("sum")
    for name in reversed(results.design.columns):
        grouped.insert(1, name, grouped["point"].map(results.first[name]))
    return grouped


# --- telling settings apart -------------------------------------------------------------------


def welch(a: NDArray, b: NDArray) -> tuple[float, float, float]:
    """Difference of the means ``b - a``, half its 95 % interval, and the p-value of no difference.

    With less than two runs in either nothing can be said: nan, nan.
    """
    difference = float(b.mean() - a.mean()) if len(a) and len(b) else math.nan
    if len(a) < 2 or len(b) < 2:
        return difference, math.nan, math.nan
    if np.ptp(a) == np.ptp(b) == 0.0:
        return difference, 0.0, 1.0 if difference == 0.0 else 0.0
    with warnings.catch_warnings():  # SciPy's, of runs that are nearly the same
        warnings.simplefilter("ignore", RuntimeWarning)
        test = stats.ttest_ind(b, a, equal_var=False)
    low, high = test.confidence_interval(LEVEL)
    return difference, float(0.5 * (high - low)), float(test.pvalue)


def runs_needed(a: NDArray, b: NDArray, power: float = 0.8) -> int | None:
    """Runs in each of two settings that would tell a difference as large as the one seen."""
    difference = abs(float(b.mean() - a.mean()))
    variance = 0.5 * float(a.var(ddof=1) + b.var(ddof=1))
    if difference == 0.0 or variance == 0.0:
        return None
    z = float(stats.norm.ppf(0.5 + 0.5 * LEVEL) + stats.norm.ppf(power))
    return math.ceil(2.0 * variance * (z / difference) ** 2) + 1


def told_apart(groups: Sequence[NDArray]) -> NDArray[np.bool_]:
    """Which pairs of settings can be told apart, as a symmetric matrix."""
    k = len(groups)
    pairs = list(combinations(range(k), 2))
    p = np.array([welch(groups[i], groups[j])[2] for i, j in pairs])
    apart = np.zeros((k, k), dtype=bool)
    order = np.argsort(np.where(np.isnan(p), 1.0, p), kind="stable")
    for rank, which in enumerate(order):
        if not p[which] <= (1.0 - LEVEL) / (len(pairs) - rank):
            break  # Holm: the first that is not told apart ends the list
        i, j = pairs[which]
        apart[i, j] = apart[j, i] = True
    return apart


def alike(apart: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and last of each longest stretch of neighbours of which no two are told apart."""
    k = len(apart)
    found: list[tuple[int, int]] = []
    for i in range(k):
        j = i
        while j + 1 < k and not apart[i : j + 2, i : j + 2].any():
            j += 1
        if j > i and (not found or j > found[-1][1]):
            found.append((i, j))
    return found


# --- effects ----------------------------------------------------------------------------------


@_once
def effects(results: StudyResults) -> pd.DataFrame:
    """The effect of each parameter on each measure; the columns depend on the design."""
    import pandas as pd

    design = results.design
    if isinstance(design, Sobol):
        return sobol(results)
    if isinstance(design, OneAtATime):
        of = _one_at_a_time
    elif isinstance(design, LatinHypercube):
        of = _rank_correlations
    else:
        of = _shares_of_variance
    return pd.DataFrame(
        [{"measure": m, **row} for m in results.measures for row in of(results, m)]
    )


def _one_at_a_time(results: StudyResults, measure: str) -> Rows:
    """Per parameter: means at its ends and at the base, and the change between the ends."""
    values = results.values(measure)
    base = float(values[0].mean()) if 0 in values else math.nan
    rows = []
    for line in lines(results):
        known = [(v, p) for v, p in zip(line.values, line.points, strict=True) if p in values]
        if len(known) < 2:
            continue
        (low, first), (high, last) = known[0], known[-1]
        change, half, p = welch(values[first], values[last])
        means = [float(values[point].mean()) for _, point in known]
        swing = max(means) - min(means)
        rows.append(
            {
                "parameter": line.column,
                "from": low,
                "to": high,
                "mean_from": means[0],
                "mean_base": base,
                "mean_to": means[-1],
                "change": change,
                "change_low": change - half,
                "change_high": change + half,
                "p": p,
                "swing": swing,
                "relative_swing": swing / base if base > 0.0 else math.nan,
            }
        )
    return rows


def _shares_of_variance(results: StudyResults, measure: str) -> Rows:
    """Grid and cases: shares of the variance of all runs: columns, their interplay, chaos."""
    runs = results.runs.dropna(subset=[measure])
    x = runs[measure].astype(float)
    total = float(x.var(ddof=0)) if len(x) else 0.0
    if total == 0.0:
        return []
    chaos = float((x - x.groupby(runs["point"]).transform("mean")).pow(2).mean()) / total
    rows: Rows = []
    for name in results.design.columns:
        levels = x.groupby(runs[name]).mean()
        share = float((runs[name].map(levels) - x.mean()).pow(2).mean()) / total
        rows.append(
            {
                "parameter": name,
                "share": share,
                "least_mean": float(levels.min()),
                "at_least": levels.idxmin(),
                "largest_mean": float(levels.max()),
                "at_largest": levels.idxmax(),
            }
        )
    if results.study.model.design == "grid" and len(rows) > 1:
        rest = max(0.0, 1.0 - chaos - sum(row["share"] for row in rows))
        rows.append({"parameter": "(interplay)", "share": rest})
    return [*rows, {"parameter": "(chaos)", "share": chaos}]


def _rank_correlations(results: StudyResults, measure: str) -> Rows:
    """Latin hypercube: rank correlation of each parameter with the points' means."""
    means = {point: v.mean() for point, v in results.values(measure).items()}
    first = results.first.loc[list(means)]
    rows = []
    for axis in results.design.axes:
        if axis.numeric:
            x = first[axis.name].to_numpy(dtype=float)
            r, low, high = spearman(x, np.array(list(means.values())))
            rows.append(
                {"parameter": axis.name, "rank_correlation": r, "low": low, "high": high,
                 "points": len(means)}
            )  # fmt: skip
    return rows


def spearman(x: NDArray, y: NDArray) -> tuple[float, float, float]:
    """Spearman's rank correlation with its 95 % interval."""
    n = len(x)
    if n < 4 or np.ptp(x) == 0.0 or np.ptp(y) == 0.0:
        return math.nan, math.nan, math.nan
    r = float(stats.spearmanr(x, y).statistic)
    z = math.atanh(min(max(r, -0.999999), 0.999999))
    half = float(stats.norm.ppf(0.5 + 0.5 * LEVEL)) * math.sqrt((1.0 + 0.5 * r * r) / (n - 3))
    return r, math.tanh(z - half), math.tanh(z + half)


@_once
def sobol(results: StudyResults) -> pd.DataFrame:
    """First order, total and second order Sobol indices with their intervals.

    Rows with one parameter have S1 and ST, rows with two (``a x b``) S2. A base point of which any
    of the 2 D + 2 points has no run that counts is left out. With two or more runs a point the
    share of the variance that is chaos (the runs of a point among themselves) is a row too.
    """
    import pandas as pd
    from SALib.analyze import sobol as analyze

    design = results.design
    if not isinstance(design, Sobol):
        raise ValueError("Sobol indices need the design sobol")
    names = [axis.name for axis in design.axes]
    d = len(names)
    problem = {"num_vars": d, "names": names, "bounds": [[0.0, 1.0]] * d}
    rows: Rows = []

    def index(kind: str, at: Any) -> dict[str, float]:
        value, half = float(s[kind][at]), float(s[f"{kind}_conf"][at])
        return {kind: value, f"{kind}_low": value - half, f"{kind}_high": value + half}

    for measure in results.measures:
        values = results.values(measure)
        means = np.array(
            [values[p].mean() if p in values else math.nan for p in range(len(design))]
        )
        blocks = means.reshape(-1, 2 * d + 2)
        whole = np.isfinite(blocks).all(axis=1)
        y = blocks[whole].ravel()
        if whole.sum() < 4 or np.ptp(y) == 0.0:
            continue
        with np.errstate(divide="ignore", invalid="ignore"):
            s = analyze.analyze(problem, y, calc_second_order=True, conf_level=LEVEL, seed=1)
        common = {"measure": measure, "base_points": int(whole.sum()),
                  "left_out": int((~whole).sum())}  # fmt: skip
        rows += [{**common, "parameter": n, **index("S1", i), **index("ST", i)}
                 for i, n in enumerate(names)]  # fmt: skip
        rows += [{**common, "parameter": f"{names[i]} x {names[j]}", **index("S2", (i, j))}
                 for i, j in combinations(range(d), 2)]  # fmt: skip
        variances = [v.var(ddof=1) for v in values.values() if len(v) > 1]
        if variances:
            chaos = float(np.mean(variances)) / results.manifest["ensemble"] / float(y.var())
            rows.append({**common, "parameter": "(chaos)", "ST": chaos})
    return pd.DataFrame(rows)


# --- lines ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Line:
    """Points that differ in one column only, in its order."""

    column: str | None  # what differs; None for a list of cases
    values: list[Any]
    points: list[int]
    fixed: dict[str, Any] = field(default_factory=dict)  # the values of the others

    @property
    def numeric(self) -> bool:
        """The values are numbers."""
        return is_numeric(self.values)


def is_numeric(values: Iterable[Any]) -> bool:
    """All values are numbers, none is true or false."""
    return all(isinstance(v, (int, float, np.number)) and type(v) is not bool for v in values)


def _line(column: str, part: pd.DataFrame, fixed: dict[str, Any] | None = None) -> Line:
    """The points of a part of the first rows, in the order of the column where it is numeric."""
    pairs = list(zip(part[column], (int(p) for p in part.index), strict=True))
    if is_numeric(v for v, _ in pairs):
        pairs.sort(key=lambda pair: pair[0])
    return Line(column, [v for v, _ in pairs], [p for _, p in pairs], fixed or {})


def lines(results: StudyResults) -> list[Line]:
    """The lines of a design with levels; none for those that draw their points."""
    first, design = results.first, results.study.model.design
    columns = list(results.design.columns)
    if design == "one_at_a_time":
        return [_line(c, first[(first["varied"] == c) | (first.index == 0)]) for c in columns]
    if design == "cases":
        points = [int(p) for p in first.index]
        return [Line(None, [results.labels[p] for p in points], points)]
    found: list[Line] = []
    if design == "grid":
        for name in columns:
            others = [c for c in columns if c != name]
            groups = first.groupby(others, sort=False) if others else [((), first)]
            for key, part in groups:
                if len(part) > 1:
                    found.append(_line(name, part, dict(zip(others, key, strict=True))))
    return found
