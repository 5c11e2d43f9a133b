"""Moment between two mated coupler heads.

Source: thesis, coupler chapter (polynomials fitted to tests). With ``n`` the angle
``beta_i - alpha_{i+1}`` between the couplers,

    M(n) = -sign(n) (c0 + c1 |n| + c2 n^2)   |n| beyond the polynomial's root, else 0

acts on coupler ``beta_i`` and its opposite on ``alpha_{i+1}``. It depends on the angle only, so it
stores energy; what is stored when the coupling parts is lost. Starting at the root, so that the
moment is continuous, is reconstructed [R], and so is the whole E-F pair (mean of the two).
"""

from __future__ import annotations

import math

from derail_ros.engine.jit import jit

POLYNOMIALS = {
    "EE": (-203.08e3, 1061.7e3, -455.87e3),
    "FF": (-762.77e3, 3536.2e3, -2777.1e3),
    "EF": (
        0.5 * (-203.08e3 - 762.77e3),
        0.5 * (1061.7e3 + 3536.2e3),
        0.5 * (-455.87e3 - 2777.1e3),
    ),
}
"""Coefficients (N m, N m/rad, N m/rad^2) by the pair of heads."""


def pair_of_heads(first: str, second: str) -> str:
    """Key of a mated pair: "EE", "EF" or "FF", whatever the order."""
    return "".join(sorted((first, second)))


def polynomial_root(pair: str) -> float:
    """Smallest angle (rad) at which the moment of a pair of heads begins."""
    c0, c1, c2 = POLYNOMIALS[pair]
    return (-c1 + math.sqrt(c1 * c1 - 4.0 * c2 * c0)) / (2.0 * c2)


@jit
def knuckle_moment(n: float, c0: float, c1: float, c2: float, root: float) -> float:
    """Moment on coupler ``beta_i``, N m, for an angle ``n`` (rad)."""
    u = abs(n)
    if u <= root:
        return 0.0
    m = c0 + (c1 + c2 * u) * u
    return -m if n > 0.0 else m


@jit
def knuckle_energy(n: float, c0: float, c1: float, c2: float, root: float) -> float:
    """Energy stored at the angle ``n`` (rad), J: the integral of the moment from the root."""
    u = abs(n)
    if u <= root:
        return 0.0
    upper = (c0 + (0.5 * c1 + c2 / 3.0 * u) * u) * u
    lower = (c0 + (0.5 * c1 + c2 / 3.0 * root) * root) * root
    return upper - lower
