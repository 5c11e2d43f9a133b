"""Counts in words."""

from __future__ import annotations


def count(n: int, noun: str) -> str:
    """``0 runs``, ``1 run``, ``12 runs``."""
    return f"{n} {noun}{'' if n == 1 else 's'}"
