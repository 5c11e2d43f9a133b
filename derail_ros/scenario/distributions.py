"""Distributions of a value: their mistakes, and the value below which a share of them lies."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from derail_ros.scenario.schema import Distribution, Uncertain
from derail_ros.scenario.strict_yaml import Path


def shapes(distribution: Distribution) -> list[str]:
    """Names of the shapes that are given."""
    fields = type(distribution).model_fields
    return [k for k in fields if k != "relative" and getattr(distribution, k) is not None]


def mistake(distribution: Distribution) -> tuple[Path, str] | None:
    """Place within it and reason, if it is no distribution."""
    names = [k for k in type(distribution).model_fields if k != "relative"]
    given = shapes(distribution)
    if len(given) != 1:
        return (), f"must be one of {', '.join(names[:-1])} and {names[-1]}"
    (name,) = given
    shape: Any = getattr(distribution, name)
    if name == "values":
        return None
    low, high = shape if name == "uniform" else (shape.low, shape.high)
    if low is not None and high is not None and not low < high:
        return (name,), f"must rise, got {low:g} to {high:g}"
    if name == "triangular" and not low <= shape.mode <= high:
        return (name, "mode"), f"must lie between {low:g} and {high:g}"
    if name == "lognormal" and high is not None and high <= 0:
        return (name, "high"), "must be above 0"
    return None


def quantile_of(distribution: Distribution) -> Callable[[float], Any]:
    """The inverse of a distribution function; of a list, which entry."""
    from scipy.stats import triang, truncnorm

    if isinstance(distribution, Uncertain) and distribution.values is not None:
        values = distribution.values
        return lambda u: values[min(int(u * len(values)), len(values) - 1)]
    if isinstance(distribution, Uncertain) and distribution.uniform is not None:
        first, last = distribution.uniform
        return lambda u: first + (last - first) * u
    if (t := distribution.triangular) is not None:
        law = triang((t.mode - t.low) / (t.high - t.low), t.low, t.high - t.low)
        return lambda u: float(law.ppf(u))

    def standard(low: float, high: float) -> Callable[[float], float]:
        law = truncnorm(low, high)
        # the ends of an open distribution lie at infinity
        return lambda u: float(law.ppf(min(max(u, 1e-12), 1.0 - 1e-12)))

    if (n := distribution.normal) is not None:
        mean, sd = n.mean, n.sd
        ends = [end if value is None else (value - mean) / sd
                for value, end in ((n.low, -math.inf), (n.high, math.inf))]  # fmt: skip
        z = standard(*ends)
        return lambda u: mean + sd * z(u)
    ln = distribution.lognormal
    assert ln is not None
    median, sigma = ln.median, ln.sigma

    def score(value: float | None, end: float) -> float:
        if value is None:
            return end
        return math.log(value / median) / sigma if value > 0.0 else -math.inf

    z = standard(score(ln.low, -math.inf), score(ln.high, math.inf))
    return lambda u: median * math.exp(sigma * z(u))
