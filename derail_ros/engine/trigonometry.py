"""Sines and cosines of all angles of a train at once.

Reduction by multiples of pi/2 in three parts (Cody and Waite) and the minimax polynomials of
fdlibm's kernels: below one unit in the last place for angles up to 1e5 rad. Written out and not
taken from the C library because it is faster inside a kernel, and because its bits are then the
same whatever library a machine has.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from derail_ros.engine import layout as L
from derail_ros.engine.jit import inner_jit, jit

F64 = NDArray[np.float64]

_TWO_OVER_PI = 2.0 / math.pi
# pi/2 in three parts of 33 bits and a rest (fdlibm's pio2_1, pio2_2, pio2_3)
_P1 = float.fromhex("0x1.921fb544p+0")
_P2 = float.fromhex("0x1.0b4611a6p-34")
_P3 = float.fromhex("0x1.3198a2e037073p-69")


@jit
def sincos(x: float) -> tuple[float, float]:
    """``(sin x, cos x)`` for |x| < 1e5 rad."""
    k = math.floor(x * _TWO_OVER_PI + 0.5)
    r = ((x - k * _P1) - k * _P2) - k * _P3
    z = r * r
    s = r + r * z * (
        -1.66666666666666324348e-01
        + z
        * (
            8.33333333332248946124e-03
            + z
            * (
                -1.98412698298579493134e-04
                + z
                * (
                    2.75573137070700676789e-06
                    + z * (-2.50507602534068634195e-08 + z * 1.58969099521155010221e-10)
                )
            )
        )
    )
    w = 0.5 * z
    c = 1.0 - w
    # the rounding of 1 - w is given back
    c += ((1.0 - c) - w) + z * z * (
        4.16666666666666019037e-02
        + z
        * (
            -1.38888888888741095749e-03
            + z
            * (
                2.48015872894767294178e-05
                + z
                * (
                    -2.75573143513906633035e-07
                    + z * (2.08757232129817482790e-09 + z * -1.13596475577881948265e-11)
                )
            )
        )
    )
    # quadrant, without a branch
    half = k - 2.0 * math.floor(0.5 * k)
    sign_s = 1.0 - 2.0 * (0.5 * (k - half) - 2.0 * math.floor(0.25 * (k - half)))
    sign_c = sign_s * (1.0 - 2.0 * half)
    return (
        sign_s * (s if half == 0.0 else c),
        (sign_s if half == 0.0 else sign_c) * (c if half == 0.0 else s),
    )


@inner_jit
def angles(q: F64, wk: F64) -> None:
    """Cosines and sines of yaw and coupler angles of every car into ``wk``."""
    for i in range(q.shape[0]):
        wk[i, L.W_ST], wk[i, L.W_CT] = sincos(q[i, 2])
        wk[i, L.W_SA], wk[i, L.W_CA] = sincos(q[i, 3])
        wk[i, L.W_SB], wk[i, L.W_CB] = sincos(q[i, 4])
