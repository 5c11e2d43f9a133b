"""Integration methods by name, and their tables.

A table of s stages is an array of 4 + 2 s rows and s + 1 columns: b (slopes that make the new
state), e (slopes that make the error; the last column is for the slope at the new state), c (times
of the stages), one row with the diagonal gamma (0: explicit), the exponent of the error in the
choice of the step, and how far the method is stable along the negative real axis; then s rows
alpha (slopes that make the stages) and s rows gamma (of implicit friction, without the diagonal).
"""

from __future__ import annotations

from collections.abc import Sequence

# Rows of a table before those of the stages, and the columns of the last of them.
WEIGHTS, ERRORS, TIMES, META = 0, 1, 2, 3
STAGES = 4
GAMMA, EXPONENT, BOUND = 0, 1, 2

Table = tuple[tuple[float, ...], ...]


def table(
    alpha: Sequence[Sequence[float]],
    b: Sequence[float],
    e: Sequence[float],
    order: int,
    gamma: float = 0.0,
    gammas: Sequence[Sequence[float]] = (),
) -> Table:
    """The table of a method whose error is of the order ``order``."""
    width = len(b) + 1

    def padded(row: Sequence[float]) -> tuple[float, ...]:
        return (*(float(x) for x in row), *(0.0,) * (width - len(row)))

    implicit = list(gammas) or [()] * len(b)
    times = [sum(row) for row in alpha]
    rows = (b, e, times, (gamma, 1.0 / order, stability_bound(alpha, b)), *alpha, *implicit)
    return tuple(padded(row) for row in rows)


def stability_bound(alpha: Sequence[Sequence[float]], b: Sequence[float]) -> float:
    """Largest x with ``|R(-z)| <= 1`` for 0 <= z <= x, to 1e-6: R is the stability function.

    A step of the explicit method multiplies a velocity that friction relaxes at the rate ``rate``
    by ``R(-h rate)``; R is a polynomial that begins below 1 and leaves [-1, 1] once.
    """

    def factor(z: float) -> float:
        slopes: list[float] = []
        for row in alpha:
            slopes.append(-z * (1.0 + sum(a * k for a, k in zip(row, slopes))))
        return 1.0 + sum(w * k for w, k in zip(b, slopes))

    low, high = 0.0, 0.01
    while abs(factor(high)) <= 1.0:
        low, high = high, high + 0.01
    while high - low > 1e-6:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if abs(factor(middle)) <= 1.0 else (low, middle)
    return low


# E. Fehlberg, NASA TR R-315 (1969): 4(5), the fifth-order solution is carried on.
RKF45 = table(
    alpha=(
        (),
        (1 / 4,),
        (3 / 32, 9 / 32),
        (1932 / 2197, -7200 / 2197, 7296 / 2197),
        (439 / 216, -8, 3680 / 513, -845 / 4104),
        (-8 / 27, 2, -3544 / 2565, 1859 / 4104, -11 / 40),
    ),
    b=(16 / 135, 0, 6656 / 12825, 28561 / 56430, -9 / 50, 2 / 55),
    e=(1 / 360, 0, -128 / 4275, -2197 / 75240, 1 / 50, 2 / 55),
    order=5,
)

# The classical method of order 4 (W. Kutta, 1901) as a W-method: with implicit friction it keeps
# order 3 for any damping and is L-stable along the negative axis. The error is a sixth of the
# change of the slope from the last stage to the new state, both at the end of the step (an
# embedded method of order 3 that costs nothing). With g_ij = gamma_ij + gamma delta_ij and
# beta = alpha + g the gammas solve
#     sum b_i g_ij = 0,    sum b_i alpha_ij g_jk = 0,    sum b_i g_ij alpha_jk = 0,
#     sum b_i g_ij g_jk = 0,    sum b_i (beta^-1)_ij = 1  (no memory of infinitely fast friction)
# for gamma = 2/5 and gamma_21 = -1/25. What a step leaves of a velocity then falls from 1 to -0.13
# the faster the friction is, and rises to 0.
ROW = table(
    alpha=((), (1 / 2,), (0, 1 / 2), (0, 0, 1)),
    gammas=((), (-1 / 25,), (-152 / 575, -103 / 115), (14 / 23, 131 / 805, -27 / 35)),
    b=(1 / 6, 1 / 3, 1 / 3, 1 / 6),
    e=(0, 0, 0, 1 / 6, -1 / 6),
    order=4,
    gamma=2 / 5,
)

METHODS = {"rkf45": RKF45, "row": ROW}
"""Name -> table: ``rkf45`` is the explicit reference, ``row`` takes friction implicitly."""
