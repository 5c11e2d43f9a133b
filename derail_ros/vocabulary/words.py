"""Formats numbers and lists as text: forces, speeds, lists of cars."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence


def count(n: int, noun: str) -> str:
    """``0 runs``, ``1 run``, ``12 runs``."""
    return f"{n} {noun}{'' if n == 1 else 's'}"


def capital(text: str) -> str:
    """A text that begins with a capital letter."""
    return text[:1].upper() + text[1:]


def finite(value: float | None, digits: int | None = None) -> float | None:
    """A number as JSON knows it: ``None`` for one that does not exist or is not finite."""
    if value is None:
        return None
    value = float(value)
    if not math.isfinite(value):
        return None
    return value if digits is None else round(value, digits)


def speed(value: float) -> str:
    """A speed (m/s): ``24.9 m/s (90 km/h)``."""
    return f"{value:.1f} m/s ({value * 3.6:.0f} km/h)" if math.isfinite(value) else ""


def force(value: float) -> str:
    """A force (N): ``27.5 MN``, ``340 kN``."""
    return f"{value * 1e-6:.1f} MN" if value >= 0.95e6 else f"{value * 1e-3:.0f} kN"


def energy(value: float) -> str:
    """An energy (J): ``1.79 GJ``, ``9.5 MJ``, ``12 kJ``."""
    for unit, size in (("GJ", 1e9), ("MJ", 1e6), ("kJ", 1e3)):
        if abs(value) >= size:
            digits = 2 if abs(value) < 10 * size else 1 if abs(value) < 100 * size else 0
            return f"{value / size:.{digits}f} {unit}"
    return f"{value:.0f} J"


def coordinate(value: float, digits: int = 1) -> str:
    """A coordinate or an angle; a zero has no sign."""
    return f"{round(value, digits) + 0.0:.{digits}f}"


def place(x: float, y: float) -> str:
    """A place in the plane (m): ``x = 42.1 m, y = -4.2 m``."""
    return f"x = {coordinate(x)} m, y = {coordinate(y)} m" if math.isfinite(x) else ""


def _ranges(numbers: Iterable[int]) -> list[str]:
    groups: list[list[int]] = []
    for number in numbers:
        if groups and number == groups[-1][1] + 1:
            groups[-1][1] = number
        else:
            groups.append([number, number])
    return [
        part
        for a, b in groups
        for part in ([f"{a} to {b}"] if b > a + 1 else map(str, range(a, b + 1)))
    ]


def number_list(numbers: Iterable[int]) -> str:
    """``1 to 5, 8`` for 1, 2, 3, 4, 5, 8; ``none`` for an empty list."""
    return ", ".join(_ranges(numbers)) or "none"


def cars(numbers: Sequence[int]) -> str:
    """``car 3``, ``cars 1 to 5 and 8``, for a sentence."""
    return f"car{'' if len(numbers) == 1 else 's'} {joined(_ranges(numbers)) or 'none'}"


def joined(parts: Sequence[str]) -> str:
    """``a``, ``a and b``, ``a, b and c``."""
    if len(parts) < 2:
        return "".join(parts)
    return ", ".join(parts[:-1]) + " and " + parts[-1]
