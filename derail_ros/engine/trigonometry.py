"""Sines and cosines of all angles of a train at once.

Reduction by multiples of pi/2 in three parts (Cody and Waite) and the minimax polynomials of
fdlibm's kernels: below one unit in the last place for angles up to 1e5 rad. Written out and not
taken from the C library because it is faster inside a kernel, and because its bits are then the
same whatever library a machine has.
"""

from __future__ import annotations

import math

from derail_ros.engine.arrays import F64, I64, Rows
from derail_ros.engine.jit import inner_jit, jit, keep_separate

_TWO_OVER_PI = 2.0 / math.pi
# pi/2 in three parts of 33 bits and a rest (fdlibm's pio2_1, pio2_2, pio2_3)
_P1 = float.fromhex("0x1.921fb544p+0")
_P2 = float.fromhex("0x1.0b4611a6p-34")
_P3 = float.fromhex("0x1.3198a2e037073p-69")
_ROUND = 6755399441055744.0  # 1.5 * 2^52: adding and taking it away rounds to a whole number


@jit
def sincos(x: float) -> tuple[float, float]:
    """``(sin x, cos x)`` for |x| < 1e5 rad; no branches, so that loops of it become vectors."""
    k = (x * _TWO_OVER_PI + _ROUND) - _ROUND
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
    # k = 2 t + odd: for odd = +-1 rounding to even leaves t even, for odd = 0 its parity counts
    t = (0.5 * k + _ROUND) - _ROUND
    odd = k - 2.0 * t
    sign = 1.0 - 2.0 * abs(t - 2.0 * ((0.5 * t + _ROUND) - _ROUND))
    even = odd == 0.0
    return (
        (sign if even else odd) * (s if even else c),
        (sign if even else -odd) * (c if even else s),
    )


@inner_jit
def angles(q: F64, wk: Rows, ang: F64, live: I64) -> None:
    """Cosines and sines of yaw and coupler angles of the cars in the list ``live`` into ``wk``.

    ``ang``: (3, 3 N) scratch: angles, sines, cosines.
    """
    keep_separate()
    n = live[0]
    for a in range(n):
        i = live[1 + a]
        ang[0, 3 * a] = q[i, 2]
        ang[0, 3 * a + 1] = q[i, 3]
        ang[0, 3 * a + 2] = q[i, 4]
    for m in range(3 * n):
        s, c = sincos(ang[0, m])
        ang[1, m] = s
        ang[2, m] = c
    for a in range(n):
        i = live[1 + a]
        wk[i].ct = ang[2, 3 * a]
        wk[i].st = ang[1, 3 * a]
        wk[i].ca = ang[2, 3 * a + 1]
        wk[i].sa = ang[1, 3 * a + 1]
        wk[i].cb = ang[2, 3 * a + 2]
        wk[i].sb = ang[1, 3 * a + 2]
