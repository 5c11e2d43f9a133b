"""Moment between adjacent cars that is held beyond its largest value.

Source: Yang and Manos, 1972, as E. E. Toma's thesis (1998) describes it: a reaction moment
polynomial in the angle between adjacent cars, with a dead band wider than that of the thesis, is
the only restraint on rotation, and no coupling parts. The coefficients are not given there:
reconstructed [R] from the polynomials of the thesis, moved outwards by a widening ``w``. A
coupling that never parts needs a moment at every angle; the polynomial falls beyond its largest
value, which is held from there on [R]:

    M(n) = -sign(n) (c0 + c1 u + c2 u^2),   u = min(|n| - w, u_top),   u_top = -c1 / (2 c2)

for ``u`` beyond the polynomial's root, else 0. The moment depends on the angle only: it stores
energy and takes none out.
"""

from __future__ import annotations

from derail_ros.engine.jit import jit


def top_angle(c1: float, c2: float) -> float:
    """Angle of the polynomial's largest value, rad."""
    return -0.5 * c1 / c2


@jit
def joint_moment(
    n: float, c0: float, c1: float, c2: float, root: float, widening: float, top: float
) -> float:
    """Moment on coupler ``beta_i``, N m, for an angle ``n`` (rad) between the two."""
    u = abs(n) - widening
    if u <= root:
        return 0.0
    u = min(u, top)
    m = c0 + (c1 + c2 * u) * u
    return -m if n > 0.0 else m


@jit
def joint_energy(
    n: float, c0: float, c1: float, c2: float, root: float, widening: float, top: float
) -> float:
    """Energy stored at the angle ``n`` (rad), J: the integral of the moment from the root."""
    u = abs(n) - widening
    if u <= root:
        return 0.0
    w = min(u, top)
    upper = (c0 + (0.5 * c1 + c2 / 3.0 * w) * w) * w
    lower = (c0 + (0.5 * c1 + c2 / 3.0 * root) * root) * root
    held = (c0 + (c1 + c2 * w) * w) * (u - w)
    return upper - lower + held
