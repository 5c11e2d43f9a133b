"""The state between the ends of a step.

Coordinates by quintic Hermite interpolation on (q, v, a) at both ends: sixth order in the step,
with velocity and acceleration its derivatives. Work entries of the ledger by cubic Hermite
interpolation on their powers. Forces are evaluated at the interpolated state with the constraints
of that step.
"""

from __future__ import annotations

from derail_ros.engine import layout
from derail_ros.engine.arrays import F64, State
from derail_ros.engine.jit import inner_jit, jit


@jit
def hermite(
    x: float, h: float, q0: float, v0: float, a0: float, q1: float, v1: float, a1: float
) -> tuple[float, float, float]:
    """Quintic with the given values, slopes and curvatures at both ends of a step ``h``.

    ``x`` in [0, 1]. Returns value, first and second derivative.
    """
    # q0 + h v0 x + h^2 a0 x^2 / 2 + c3 x^3 + c4 x^4 + c5 x^5
    d = q1 - q0 - h * v0 - 0.5 * h * h * a0
    e = h * (v1 - v0) - h * h * a0
    f = h * h * (a1 - a0)
    c3 = 10.0 * d - 4.0 * e + 0.5 * f
    c4 = -15.0 * d + 7.0 * e - f
    c5 = 6.0 * d - 3.0 * e + 0.5 * f
    q = q0 + x * (h * v0 + x * (0.5 * h * h * a0 + x * (c3 + x * (c4 + x * c5))))
    v = v0 + x * (h * a0 + x * (3.0 * c3 + x * (4.0 * c4 + x * 5.0 * c5)) / h)
    a = a0 + x * (6.0 * c3 + x * (12.0 * c4 + x * 20.0 * c5)) / (h * h)
    return q, v, a


@jit
def interpolate(state: State, t: float, q: F64, v: F64, a: F64) -> None:
    """Coordinates, velocities and accelerations at ``t`` within the last step."""
    t0 = state.clock[0].t_prev
    h = state.clock[0].t - t0
    x = (t - t0) / h
    for i in range(q.shape[0]):
        for k in range(5):
            q[i, k], v[i, k], a[i, k] = hermite(
                x, h, state.q0[i, k], state.v0[i, k], state.a0[i, k], state.q[i, k],
                state.v[i, k], state.a1[i, k],
            )  # fmt: skip


@jit
def interpolate_energy(state: State, t: float, out: F64) -> None:
    """Work entries of the ledger at ``t`` within the last step, J."""
    t0 = state.clock[0].t_prev
    h = state.clock[0].t - t0
    x = (t - t0) / h
    y = 1.0 - x
    for k in range(layout.N_ENERGY):
        if k < layout.N_POWER:
            out[k] = (
                state.energy0[k] * (1.0 + 2.0 * x) * y * y
                + h * state.power0[k] * x * y * y
                + state.energy[k] * x * x * (3.0 - 2.0 * x)
                - h * state.power1[k] * x * x * y
            )
        else:
            out[k] = state.energy0[k]


LOCATED = 1e-7
"""A crossing is located to this, m (rail breaks) or rad (couplings)."""


@inner_jit
def cubic_root(g0: float, d0: float, g1: float, d1: float) -> float:
    """Where in (0, 1] the cubic with values g0 <= 0 < g1 and slopes d0, d1 crosses zero."""
    lo = 0.0
    hi = 1.0
    for _ in range(60):
        x = 0.5 * (lo + hi)
        y = 1.0 - x
        g = (
            g0 * (1.0 + 2.0 * x) * y * y
            + d0 * x * y * y
            + g1 * x * x * (3.0 - 2.0 * x)
            - d1 * x * x * y
        )
        if g > 0.0:
            hi = x
        else:
            lo = x
    return hi
