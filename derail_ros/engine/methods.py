"""Integration methods by name."""

from __future__ import annotations

METHODS = {"rkf45": 0}
"""Name -> code of each integrator; ``rkf45`` is the reference."""
