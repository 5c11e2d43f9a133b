"""A very stiff spring in place of a coupling, removed at a limiting force.

Source: Birk, Anderson and Coppens, 1990 (the Anderson model), as E. E. Toma's thesis (1998)
describes it; stiffness, damper and limit are not given there: reconstructed [R].

    F = k g + c gdot,    removed when |F| exceeds F_max

with ``g`` the vector (m) from the rear face of the car ahead to the front face of the car behind,
k in N/m, c in N s/m; F acts on the car ahead, its opposite on the car behind. The energy
``k g^2 / 2`` that the spring holds when it is removed is lost.
"""

from __future__ import annotations

from derail_ros.engine.jit import jit


@jit
def coupling_force(
    gap_x: float, gap_y: float, rate_x: float, rate_y: float, k: float, c: float
) -> tuple[float, float]:
    """Force on the car ahead, N, for a gap (m) that grows at a rate (m/s)."""
    return k * gap_x + c * rate_x, k * gap_y + c * rate_y


@jit
def coupling_energy(gap_x: float, gap_y: float, k: float) -> float:
    """Energy in the spring, J."""
    return 0.5 * k * (gap_x * gap_x + gap_y * gap_y)
