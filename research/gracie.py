r"""Gracie 1991: inertia as pseudo-static forces, and why this is unstable.

Each increment of time the cars take the positions at which static forces balance, with inertia
among them as a force. Its accelerations are differences of the positions that are known:

    K x_{i+1} = F - M (x_i - 2 x_{i-1} + x_{i-2}) / dt^2

The source says that this is unstable, and no more. Here it is applied to the least that shows it:
a row of cars in one dimension, joined by springs k (N/m), the last one to a train that stands [R].
In a mode of the row with the frequency ``omega`` (rad/s) an error grows each increment by the
largest root of

    z^3 + s (z - 1)^2 = 0,    s = 1 / (omega dt)^2

which is above 1 for ``omega dt < 2``: the row is stable only for increments longer than twice the
inverse of its lowest frequency, in which nothing of the motion is left, and the shorter the
increments, the faster the growth (by ``s`` an increment).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from derail_ros.baselines.train import ModelError

F64 = NDArray[np.float64]


def row_stiffness(cars: int, stiffness: float) -> F64:
    """(N, N) stiffness of a row of cars, N/m: free in front, held behind."""
    matrix = 2.0 * np.eye(cars) - np.eye(cars, k=1) - np.eye(cars, k=-1)
    matrix[0, 0] = 1.0
    return stiffness * matrix


def advance(mass: F64, stiffness: float, force: F64, increment: float, increments: int) -> F64:
    """Positions of a row of cars that stands and is then pulled.

    Parameters
    ----------
    mass, force : (N,) of the cars, front car first, kg, N
    stiffness : of each coupling, N/m
    increment : of time, s
    increments : their number

    Returns
    -------
    (increments + 1, N) positions from those at rest, m

    Raises
    ------
    ModelError
        A parameter is out of its range.
    """
    for name, value in (
        ("mass", np.min(mass)),
        ("stiffness", stiffness),
        ("increment", increment),
    ):
        if not (np.isfinite(value) and value > 0.0):
            raise ModelError(f"{name}: must be positive, got {value:g}")
    inverse = np.linalg.inv(row_stiffness(len(mass), stiffness))
    x = np.zeros((increments + 3, len(mass)))
    for i in range(3, len(x)):
        acceleration = (x[i - 1] - 2.0 * x[i - 2] + x[i - 3]) / increment**2
        x[i] = inverse @ (force - mass * acceleration)
    return x[2:]


def frequencies(mass: F64, stiffness: float) -> F64:
    """(N,) frequencies of the row, rad/s, the lowest first."""
    root = 1.0 / np.sqrt(mass)
    scaled = root[:, None] * row_stiffness(len(mass), stiffness) * root
    return np.sqrt(np.linalg.eigvalsh(scaled))


def growth(mass: F64, stiffness: float, increment: float) -> float:
    """Largest factor by which an error grows each increment."""
    s = 1.0 / (frequencies(mass, stiffness) * increment) ** 2
    return float(max(np.abs(np.roots([1.0, a, -2.0 * a, a])).max() for a in s))


def least_increment(mass: F64, stiffness: float) -> float:
    """Increment from which on the row is stable, s."""
    return 2.0 / float(frequencies(mass, stiffness)[0])
