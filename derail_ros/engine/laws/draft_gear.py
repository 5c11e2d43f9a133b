"""Draft gear of a coupling: slack, preload, friction.

``x`` (m) is by how much the coupling is longer than in the middle of its slack, both gears
together; ``u = |x| - slack / 2`` the compression of the gears, in draft as in buff. Loading they
follow

    L(u) = F0 min(u / d, 1) + k u

and unloading ``r L(u)``. Between the two lines the force changes over the travel ``d``: with the
friction's share p, which grows by 2 for each d of travel and stays within -1 and 1,

    F = L(u) ((1 + r) / 2 + p (1 - r) / 2) + S max(u - travel, 0)

``S`` is the stiffness of the gone-solid gear and the underframes. Energy that comes back is that
under the unloading line. Sources: AAR M-901-G (70 to 80 mm of travel a gear at 2.2 MN, solid
beyond); loading 25.7 MN/m from a preload of 240 kN, unloading by about a fifth of it: published
code for one friction gear (a weak source); d and S are assumed.
"""

from __future__ import annotations

from derail_ros.engine.jit import jit


@jit
def friction_share(u: float, u0: float, p0: float, d: float) -> float:
    """Share p at the compression ``u`` (m), for a share ``p0`` at ``u0``; -1 where gears meet."""
    p = 2.0 * u / d - 1.0 if u0 <= 0.0 else p0 + 2.0 * (u - u0) / d
    return min(1.0, max(-1.0, p))


@jit
def loading(u: float, preload: float, k: float, d: float) -> float:
    """``L(u)``, N, for a compression ``u`` >= 0 (m)."""
    return preload * min(u / d, 1.0) + k * u


@jit
def loading_energy(u: float, preload: float, k: float, d: float) -> float:
    """Integral of ``L`` from 0 to ``u``, J."""
    w = min(u, d)
    return preload * (0.5 * w * w / d + (u - w)) + 0.5 * k * u * u
