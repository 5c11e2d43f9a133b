r"""Statistics of a study: means with their uncertainty, spread, effects, Sobol indices.

Runs of an ensemble are taken as independent draws: outcomes are chaotic, so that a push that
differs by a percent gives a draw of its own.

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
from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from derail_ros.studies.design import LatinHypercube, OneAtATime, Sobol

if TYPE_CHECKING:
    import pandas

    from derail_ros.studies.results import StudyResults

LEVEL = 0.95
"""Level of the intervals."""

QUANTILES = {"q05": 0.05, "q25": 0.25, "median": 0.5, "q75": 0.75, "q95": 0.95}


def t_quantile(degrees: NDArray | float, level: float = LEVEL) -> Any:
    """Two-sided quantile of Student's t."""
    from scipy.special import stdtrit

    return stdtrit(degrees, 0.5 * (1.0 + level))


@lru_cache(maxsize=1000)
def _t_of(degrees: int) -> float:
    return float(t_quantile(degrees))


def summary(results: StudyResults) -> pandas.DataFrame:
    """A row for each point and measure, in this order."""
    import pandas as pd

    runs = results.runs
    columns = results.design.columns
    first = results.table.drop_duplicates("point").set_index("point")
    grouped = runs.groupby("point", sort=True)
    total = results.table.groupby("point").size()
    status = results.table.groupby("point")["status"]
    frames = []
    for measure in results.measures:
        values = grouped[measure].apply(lambda v: v.to_numpy(dtype=float, na_value=np.nan))
        rows = {p: describe(values[p] if p in values.index else []) for p in first.index}
        frame = pd.DataFrame.from_dict(rows, orient="index")
        frame.insert(0, "measure", measure)
        frame.insert(0, "point", frame.index)
        frame["void"] = status.apply(lambda s: int((s == "void").sum()))
        frame["failed"] = status.apply(lambda s: int((s == "failed").sum()))
        frame["runs"] = total
        for name in reversed([*(["varied"] if "varied" in first else []), *columns]):
            frame.insert(1, name, first[name])
        frames.append(frame)
    table = pd.concat(frames, ignore_index=True)
    order = {m: i for i, m in enumerate(results.measures)}
    table["_"] = table["measure"].map(order)
    table = table.sort_values(["point", "_"], kind="stable").drop(columns="_")
    if results.base is not None:
        table = _relative(table, results.base)
    return table.reset_index(drop=True)


def describe(values: Iterable[float]) -> dict[str, float]:
    """Mean, its interval, spread and quantiles of some runs; nan where there are too few."""
    x = np.asarray(list(values), dtype=float)
    x = x[np.isfinite(x)]
    n = len(x)
    out: dict[str, float] = {"n": n, "mean": float(x.mean()) if n else math.nan}
    sd = float(x.std(ddof=1)) if n > 1 else math.nan
    half = _t_of(n - 1) * sd / math.sqrt(n) if n > 1 else math.nan
    out |= {"mean_low": out["mean"] - half, "mean_high": out["mean"] + half, "sd": sd}
    quantiles = np.quantile(x, list(QUANTILES.values())) if n else [math.nan] * len(QUANTILES)
    out |= {name: float(q) for name, q in zip(QUANTILES, quantiles, strict=True)}
    out |= {"least": float(x.min()) if n else math.nan, "most": float(x.max()) if n else math.nan}
    return out


def _relative(table: pandas.DataFrame, base: int) -> pandas.DataFrame:
    """Add the means relative to those of the base point."""
    reference = table[table["point"] == base].set_index("measure")
    m0 = table["measure"].map(reference["mean"])
    e0 = table["measure"].map(reference["sd"]) / np.sqrt(table["measure"].map(reference["n"]))
    error = table["sd"] / np.sqrt(table["n"])
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = (table["mean"] / m0).where(m0 > 0.0)
        sd = np.sqrt(error**2 + (ratio * e0) ** 2) / m0
    # for the base itself numerator and denominator are the same draw
    sd = sd.where(table["point"] != base, 0.0)
    half = t_quantile(np.maximum(table["n"].to_numpy() - 1, 1)) * sd
    return table.assign(relative=ratio, relative_low=ratio - half, relative_high=ratio + half)


def counts(results: StudyResults) -> pandas.DataFrame:
    """Number of runs of each point with each number of cars derailed, and their share."""
    runs = results.runs
    grouped = runs.groupby(["point", "cars_derailed"]).size().rename("runs").reset_index()
    grouped["share"] = grouped["runs"] / grouped.groupby("point")["runs"].transform("sum")
    first = results.table.drop_duplicates("point").set_index("point")
    for name in reversed(results.design.columns):
        grouped.insert(1, name, grouped["point"].map(first[name]))
    return grouped


# --- telling settings apart -------------------------------------------------------------------


def welch(a: NDArray, b: NDArray) -> tuple[float, float, float]:
    """Difference of the means ``b - a``, half its 95 % interval, and the p-value of no difference.

    With less than two runs in either nothing can be said: nan, nan.
    """
    from scipy.special import stdtr

    difference = float(b.mean() - a.mean()) if len(a) and len(b) else math.nan
    if len(a) < 2 or len(b) < 2:
        return difference, math.nan, math.nan
    va, vb = a.var(ddof=1) / len(a), b.var(ddof=1) / len(b)
    variance = float(va + vb)
    if variance == 0.0:
        return difference, 0.0, 1.0 if difference == 0.0 else 0.0
    degrees = variance**2 / (va**2 / (len(a) - 1) + vb**2 / (len(b) - 1))
    error = math.sqrt(variance)
    p = 2.0 * float(stdtr(degrees, -abs(difference) / error))
    return difference, float(t_quantile(degrees)) * error, p


def runs_needed(a: NDArray, b: NDArray, power: float = 0.8) -> int | None:
    """Runs in each of two settings that would tell a difference as large as the one seen."""
    from scipy.special import ndtri

    difference = abs(float(b.mean() - a.mean()))
    variance = 0.5 * float(a.var(ddof=1) + b.var(ddof=1))
    if difference == 0.0 or variance == 0.0:
        return None
    z = float(ndtri(0.5 * (1.0 + LEVEL)) + ndtri(power))
    return math.ceil(2.0 * variance * (z / difference) ** 2) + 1


def told_apart(groups: Sequence[NDArray]) -> NDArray[np.bool_]:
    """Which pairs of settings can be told apart, as a symmetric matrix."""
    k = len(groups)
    pairs = [(i, j) for i in range(k) for j in range(i + 1, k)]
    p = np.array([welch(groups[i], groups[j])[2] for i, j in pairs])
    apart = np.zeros((k, k), dtype=bool)
    order = np.argsort(np.where(np.isnan(p), 1.0, p), kind="stable")
    for rank, which in enumerate(order):
        if not p[which] <= (1.0 - LEVEL) / (len(pairs) - rank):
            break  # Holm: what is not told ends the list
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


def effects(results: StudyResults) -> pandas.DataFrame:
    """Effects of the parameters; Sobol indices for that design."""
    import pandas as pd

    design = results.design
    if isinstance(design, Sobol):
        return sobol(results)
    if isinstance(design, OneAtATime):
        rows = _one_at_a_time(results)
    elif isinstance(design, LatinHypercube):
        rows = _rank_correlations(results)
    else:
        rows = _shares_of_variance(results)
    return pd.DataFrame(rows)


def point_values(results: StudyResults, measure: str) -> dict[int, NDArray]:
    """The runs of each point in a measure."""
    runs = results.runs[["point", measure]].dropna()
    values = runs[measure].to_numpy(dtype=float)
    points = runs["point"].to_numpy()
    cuts = np.flatnonzero(np.diff(points)) + 1
    return {
        int(p[0]): v
        for p, v in zip(np.split(points, cuts), np.split(values, cuts), strict=True)
        if len(p)
    }


def _one_at_a_time(results: StudyResults) -> list[dict[str, Any]]:
    """Per parameter: means at its ends and at the base, and the change between the ends."""
    design = results.design
    rows = []
    for measure in results.measures:
        values = point_values(results, measure)
        base = values.get(0, np.array([]))
        for line in lines(results):
            name = line.column
            known = [(v, p) for v, p in zip(line.values, line.points, strict=True) if p in values]
            if len(known) < 2:
                continue
            (low, first), (high, last) = known[0], known[-1]
            change, half, p = welch(values[first], values[last])
            means = {v: float(values[q].mean()) for v, q in known}
            m0 = float(base.mean()) if len(base) else math.nan
            rows.append(
                {
                    "measure": measure,
                    "parameter": name,
                    "from": low,
                    "to": high,
                    "mean_from": means[low],
                    "mean_base": m0,
                    "mean_to": means[high],
                    "change": change,
                    "change_low": change - half,
                    "change_high": change + half,
                    "p": p,
                    "swing": max(means.values()) - min(means.values()),
                    "relative_swing": (max(means.values()) - min(means.values())) / m0
                    if m0 > 0.0
                    else math.nan,
                }
            )
    assert design is not None
    return rows


def _shares_of_variance(results: StudyResults) -> list[dict[str, Any]]:
    """Grid and cases: shares of the variance of all runs: columns, their interplay, chaos."""
    rows = []
    for measure in results.measures:
        runs = results.runs.dropna(subset=[measure])
        x = runs[measure].to_numpy(dtype=float)
        total = float(x.var()) if len(x) else 0.0
        if total == 0.0:
            continue
        within = runs.groupby("point")[measure].transform("mean").to_numpy(dtype=float)
        chaos = float(((x - within) ** 2).mean())
        explained = 0.0
        for name in results.design.columns:
            means = runs.groupby(name)[measure].transform("mean").to_numpy(dtype=float)
            share = float(((means - x.mean()) ** 2).mean()) / total
            levels = runs.groupby(name)[measure].mean().astype(float)
            explained += share
            rows.append(
                {
                    "measure": measure,
                    "parameter": name,
                    "share": share,
                    "least_mean": float(levels.min()),
                    "at_least": levels.idxmin(),
                    "largest_mean": float(levels.max()),
                    "at_largest": levels.idxmax(),
                }
            )
        if results.study.model.design == "grid" and len(results.design.columns) > 1:
            rest = max(0.0, 1.0 - chaos / total - explained)
            rows.append({"measure": measure, "parameter": "(interplay)", "share": rest})
        rows.append({"measure": measure, "parameter": "(chaos)", "share": chaos / total})
    return rows


def _rank_correlations(results: StudyResults) -> list[dict[str, Any]]:
    """Latin hypercube: rank correlation of each parameter with the points' means."""
    rows = []
    for measure in results.measures:
        means = results.runs.groupby("point")[measure].mean().astype(float).dropna()
        first = results.table.drop_duplicates("point").set_index("point").loc[means.index]
        for axis in results.design.axes:
            if not axis.numeric:
                continue
            r, low, high = spearman(first[axis.name].to_numpy(dtype=float), means.to_numpy())
            rows.append(
                {
                    "measure": measure,
                    "parameter": axis.name,
                    "rank_correlation": r,
                    "low": low,
                    "high": high,
                    "points": len(means),
                }
            )
    return rows


def spearman(x: NDArray, y: NDArray) -> tuple[float, float, float]:
    """Spearman's rank correlation with its 95 % interval."""
    from scipy.special import ndtri
    from scipy.stats import rankdata

    n = len(x)
    if n < 4 or np.ptp(x) == 0.0 or np.ptp(y) == 0.0:
        return math.nan, math.nan, math.nan
    r = float(np.corrcoef(rankdata(x), rankdata(y))[0, 1])
    z = math.atanh(min(max(r, -0.999999), 0.999999))
    half = float(ndtri(0.5 * (1.0 + LEVEL))) * math.sqrt((1.0 + 0.5 * r * r) / (n - 3))
    return r, math.tanh(z - half), math.tanh(z + half)


def sobol(results: StudyResults) -> pandas.DataFrame:
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
    rows: list[dict[str, Any]] = []
    for measure in results.measures:
        means = np.full(len(design), np.nan)
        found = results.runs.groupby("point")[measure].mean().astype(float)
        means[found.index.to_numpy()] = found.to_numpy()
        blocks = means.reshape(-1, 2 * d + 2)
        whole = np.isfinite(blocks).all(axis=1)
        y = blocks[whole].ravel()
        if whole.sum() < 4 or np.ptp(y) == 0.0:
            continue
        with np.errstate(divide="ignore", invalid="ignore"):
            s = analyze.analyze(problem, y, calc_second_order=True, conf_level=LEVEL, seed=1)
        common = {
            "measure": measure,
            "base_points": int(whole.sum()),
            "left_out": int((~whole).sum()),
        }
        for i, name in enumerate(names):
            rows.append(
                {
                    **common,
                    "parameter": name,
                    "S1": float(s["S1"][i]),
                    "S1_low": float(s["S1"][i] - s["S1_conf"][i]),
                    "S1_high": float(s["S1"][i] + s["S1_conf"][i]),
                    "ST": float(s["ST"][i]),
                    "ST_low": float(s["ST"][i] - s["ST_conf"][i]),
                    "ST_high": float(s["ST"][i] + s["ST_conf"][i]),
                }
            )
        for i in range(d):
            for j in range(i + 1, d):
                rows.append(
                    {
                        **common,
                        "parameter": f"{names[i]} x {names[j]}",
                        "S2": float(s["S2"][i, j]),
                        "S2_low": float(s["S2"][i, j] - s["S2_conf"][i, j]),
                        "S2_high": float(s["S2"][i, j] + s["S2_conf"][i, j]),
                    }
                )
        variance = results.runs.groupby("point")[measure].var().astype(float)
        if len(variance.dropna()):
            n = results.manifest["ensemble"]
            chaos = float(variance.mean()) / n / float(y.var())
            rows.append({**common, "parameter": "(chaos)", "ST": chaos})
    return pd.DataFrame(rows)


# --- lines ------------------------------------------------------------------------------------


class Line:
    """Points that differ in one column only, in its order.

    Attributes
    ----------
    column : what differs; None for a list of cases
    fixed : the values of the others
    values, points : its values and their points
    """

    def __init__(
        self,
        column: str | None,
        fixed: dict[str, Any],
        values: Sequence[Any],
        points: Sequence[int],
    ) -> None:
        self.column = column
        self.fixed = fixed
        self.values = list(values)
        self.points = [int(p) for p in points]


def _sorted(values: Sequence[Any], points: Sequence[int]) -> tuple[list[Any], list[int]]:
    pairs = list(zip(values, points, strict=True))
    if all(isinstance(v, (int, float, np.number)) and not isinstance(v, bool) for v in values):
        pairs.sort(key=lambda pair: pair[0])
    return [v for v, _ in pairs], [int(p) for _, p in pairs]


def lines(results: StudyResults) -> list[Line]:
    """The lines of a design with levels; none for those that draw their points."""
    design = results.design
    columns = list(design.columns)
    first = results.table.drop_duplicates("point")
    found: list[Line] = []
    if isinstance(design, OneAtATime):
        for axis in design.axes:
            chosen = first[(first["varied"] == axis.name) | (first["point"] == 0)]
            values, points = _sorted(list(chosen[axis.name]), list(chosen["point"]))
            found.append(Line(axis.name, {}, values, points))
    elif results.study.model.design == "grid":
        for name in columns:
            others = [c for c in columns if c != name]
            groups = first.groupby(others, sort=False) if others else [((), first)]
            for key, group in groups:
                if len(group) < 2:
                    continue
                fixed = dict(zip(others, key, strict=True)) if others else {}
                values, points = _sorted(list(group[name]), list(group["point"]))
                found.append(Line(name, fixed, values, points))
    elif results.study.model.design == "cases":
        points = [int(p) for p in first["point"]]
        found.append(Line(None, {}, [results.labels[p] for p in points], points))
    return found
