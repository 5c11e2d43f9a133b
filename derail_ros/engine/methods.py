"""Integration methods by name."""

from __future__ import annotations

RKF45 = 0
ROW = 1

METHODS = {"rkf45": RKF45, "row": ROW}
"""Name -> code: ``rkf45`` is the explicit reference, ``row`` the linearly implicit method."""
