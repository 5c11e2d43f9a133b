r"""Johnson 1991 and Guran 1992: joint velocities after a blow across the head of a train.

A straight train of N rigid bars, pinned to each other without friction, lies at rest on a
frictionless plane; a transverse impulse P (N s) hits the head of the first bar. The joint
velocities just after it, relative to that of the head, measure how readily the train jack-knifes.
Johnson's bars are equal (a train of 450 t), Guran's are not: heavy cars near the blow make it
milder.

On a straight chain the transverse motion does not depend on the longitudinal one. With ``u_j``
(m/s) the transverse velocity of joint j (0 the head, N the tail), bar i between joints i and i + 1
moves with ``(u_i + u_i+1) / 2`` and turns with ``(u_i - u_i+1) / l_i``, so that the kinetic
energy gives

    T u = P e_0,
    T_ii += m_i / 4 + I_i / l_i^2 (both ends),    T_i,i+1 = m_i / 4 - I_i / l_i^2

a symmetric positive definite tridiagonal matrix, solved by elimination from the tail at O(N).
For uniform bars ``I = m l^2 / 12`` the entries are m/3 and m/6, and in a long train of equal bars
each joint has ``-(2 - sqrt(3)) = -0.268`` times the velocity of the one before, whatever their
length.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from derail_ros.baselines.train import take_apart
from derail_ros.vocabulary.params import TrainParams

F64 = NDArray[np.float64]


@dataclass(frozen=True)
class JointVelocities:
    """State just after the impulse."""

    joint: F64  # (N+1,) transverse velocities of the joints, head first, m/s
    relative: F64  # (N+1,) the same over the head's
    centre: F64  # (N,) transverse velocities of the mass centres, m/s
    yaw_rate: F64  # (N,) rad/s, positive when the head end moves in the blow's direction
    bend: F64  # (N-1,) yaw_rate[i] - yaw_rate[i+1] at the inner joints, rad/s
    impulse: F64  # (N-1,) transverse impulse from the bar ahead to the bar behind, N s
    energy: float  # kinetic, J: half of the impulse times the head's velocity


def joint_velocities(
    mass: ArrayLike,
    length: ArrayLike,
    *,
    inertia: ArrayLike | None = None,
    impulse: float = 1000.0,
) -> JointVelocities:
    """Velocities just after a transverse impulse on the head of a chain of bars, at O(N).

    Parameters
    ----------
    mass : (N,) of the bars, head first, kg
    length : (N,) or scalar, between the joints, m
    inertia : (N,) or scalar about the mass centres, which lie in the middle, kg m^2; of uniform
        bars without
    impulse : P, N s

    Raises
    ------
    ValueError
        A mass, length or inertia is not positive, or there is no bar.
    """
    m = np.atleast_1d(np.asarray(mass, dtype=float))
    length = np.broadcast_to(np.asarray(length, dtype=float), m.shape)
    moment = m * length**2 / 12.0 if inertia is None else np.asarray(inertia, dtype=float)
    moment = np.broadcast_to(moment, m.shape)
    if m.ndim != 1 or m.size == 0:
        raise ValueError("mass: must be a list of at least one bar")
    for name, values in (("mass", m), ("length", length), ("inertia", moment)):
        if not (np.isfinite(values).all() and (values > 0.0).all()):
            raise ValueError(f"{name}: must be positive and finite")
    if not np.isfinite(impulse):
        raise ValueError("impulse: must be finite")
    own = 0.25 * m + moment / length**2
    cross = 0.25 * m - moment / length**2
    n = m.size
    # From the tail: u[j+1] = ratio[j] u[j].
    ratio = np.empty(n)
    diagonal = own[n - 1]
    for j in range(n - 1, -1, -1):
        ratio[j] = -cross[j] / diagonal
        diagonal = own[j] + cross[j] * ratio[j] + (own[j - 1] if j > 0 else 0.0)
    relative = np.concatenate([[1.0], np.cumprod(ratio)])
    joint = impulse / diagonal * relative
    centre = 0.5 * (joint[:-1] + joint[1:])
    yaw = (joint[:-1] - joint[1:]) / length
    # What is left of the impulse behind each bar.
    passed = impulse - np.cumsum(m * centre)
    return JointVelocities(
        joint=joint,
        relative=relative,
        centre=centre,
        yaw_rate=yaw,
        bend=yaw[:-1] - yaw[1:],
        impulse=passed[:-1],
        energy=float(0.5 * impulse * joint[0]),
    )


def train_bars(params: TrainParams) -> tuple[F64, F64, F64]:
    """A train as bars: masses (N,), kg, lengths, m, and inertias, kg m^2."""
    cars = take_apart(params.cars)
    length = [2.0 * c.pivot_distance + c.front.length + c.rear.length for c in cars]
    mass, inertia = [c.mass for c in cars], [c.inertia for c in cars]
    return np.array(mass), np.array(length), np.array(inertia)
