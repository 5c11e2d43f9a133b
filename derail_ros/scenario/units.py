"""Units: a field may be given in another unit of its quantity, named by the end of its key.

``speed_kmh`` may be written ``speed_mph``, ``length_m`` ``length_ft``: one table serves all
fields. A value is converted once, before anything else looks at it, to the unit of its field.
"""

from __future__ import annotations

import functools
import itertools
import math
import operator
from collections.abc import Callable
from typing import Any

from pydantic import BaseModel

from derail_ros.scenario.errors import Refusal
from derail_ros.scenario.messages import model_at, shown
from derail_ros.scenario.strict_yaml import Path

FOOT = 0.3048
POUND = 0.45359237
MILE = 1609.344

UNITS: dict[str, dict[str, float]] = {
    "length": {"m": 1.0, "ft": FOOT, "in": FOOT / 12.0, "km": 1000.0, "mi": MILE},
    "mass": {
        "kg": 1.0,
        "t": 1000.0,
        "tonnes": 1000.0,
        "lb": POUND,
        "short_tons": 2000.0 * POUND,
        "long_tons": 2240.0 * POUND,
    },
    "speed": {"m_per_s": 1.0, "kmh": 1.0 / 3.6, "mph": MILE / 3600.0, "ft_per_s": FOOT},
    "force": {"N": 1.0, "kN": 1000.0, "MN": 1e6, "lbf": POUND * 9.80665},
    "power": {"kW": 1000.0, "W": 1.0, "hp": 550.0 * FOOT * POUND * 9.80665},
    "angle": {"rad": 1.0, "deg": math.pi / 180.0},
}
"""Units by quantity: end of a key -> its size in SI. Exact by definition of the units."""

CURVES = {
    "degree_of_curve": "radius_m",
    "degree_of_curve_start": "radius_start_m",
    "degree_of_curve_end": "radius_end_m",
}
"""Keys that give a radius as railways in America do: degrees of arc per 100 feet."""


def radius_of(degree: float) -> float:
    """Radius (m) of a curve of ``D`` degrees, by 100 feet of arc: ``1746.4 / D``."""
    return 100.0 * FOOT * 180.0 / (math.pi * degree)


WORDS = {"m", "s", "N", "kg", "m2", "s2", "rad", "deg", "kmh", "kN", "J", "kW", "percent", "per"}
"""What the ends of the fields' keys are made of."""


def unit_of(key: str) -> str:
    """The unit that the end of a field's key names, as it is printed; "" if it names none."""
    words = list(itertools.takewhile(WORDS.__contains__, reversed(key.split("_")[1:])))[::-1]
    above, per, below = " ".join(words).partition("per ")
    unit = f"{above.strip() or 1}/{below}" if per else above
    return {"kmh": "km/h", "kmh kN": "km/h, kN", "percent": "%"}.get(unit, unit)


def split(key: str) -> tuple[str, str, str] | None:
    """Stem, quantity and unit of a key; None if it ends in no unit."""
    found = [
        (len(unit), key[: -len(unit) - 1], quantity, unit)
        for quantity, units in UNITS.items()
        for unit in units
        if key.endswith(f"_{unit}") and not key.endswith(f"_per_{unit}")
    ]
    return max(found)[1:] if found else None


def field_of(key: str, model: type[BaseModel]) -> tuple[str, Callable[[float], float]] | None:
    """The field that a key in another unit stands for, and the conversion to the field's unit."""
    if CURVES.get(key) in model.model_fields:
        return CURVES[key], radius_of
    given = split(key)
    if given is None:
        return None
    stem, quantity, unit = given
    for other, size in UNITS[quantity].items():
        if f"{stem}_{other}" in model.model_fields:
            factor = UNITS[quantity][unit] / size
            return f"{stem}_{other}", functools.partial(operator.mul, factor)
    return None


def variants(key: str) -> list[str]:
    """Other keys in which a field may be given."""
    found = [curve for curve, radius in CURVES.items() if radius == key]
    given = split(key)
    if given is not None:
        stem, quantity, unit = given
        found += [f"{stem}_{other}" for other in UNITS[quantity] if other != unit]
    return found


def canonical(
    data: Any, model: type[BaseModel] | None, path: Path, written: dict[Path, str]
) -> Any:
    """Plain data with each quantity in the unit of its field; notes in ``written`` what changed.

    Raises
    ------
    Refusal
        If one quantity is given in two units, or a number of degrees has no radius.
    """
    if model is None:
        return data
    if isinstance(data, list):
        return [canonical(item, model, (*path, i), written) for i, item in enumerate(data)]
    if not isinstance(data, dict):
        return data
    result: dict[str, Any] = {}
    for key, value in data.items():
        name = key
        if key not in model.model_fields:
            found = field_of(str(key), model)
            if found is not None:
                name, convert = found
                if isinstance(value, (int, float)) and not isinstance(value, bool):
                    value = _converted(value, convert, (*path, key))
                written[(*path, name)] = key
        if name in result or (name != key and name in data):
            first = written.get((*path, name), name)
            other = name if first == key else first
            reason = f"gives the same quantity as {other}: give one of the two"
            raise Refusal((*path, key), reason)
        inner = model_at(model, (name,)) if name in model.model_fields else None
        free = inner is not None and "dict[" in str(model.model_fields[name].annotation)
        if free and isinstance(value, dict):
            value = {k: canonical(v, inner, (*path, name, k), written) for k, v in value.items()}
        else:
            value = canonical(value, inner, (*path, name), written)
        result[name] = value
    return result


def _converted(value: float, convert: Callable[[float], float], path: Path) -> float:
    try:
        return float(f"{convert(float(value)):.15g}")  # 40 mph: 64.37376, not ...375999999999
    except ZeroDivisionError:
        raise Refusal(path, f"must not be {shown(value)}: a straight piece is a tangent") from None
    except OverflowError:
        return math.inf
