r"""Roorda and Gracie 1992: the train advances by increments, without inertia.

Gracie's first form (1991) kept inertia as pseudo-static forces and differentiated positions twice,
which is unstable. The second one dropped it: the train advances by increments, the derailed cars
move as their links demand, friction at the trucks takes kinetic energy out until none is left,
and the time is estimated afterwards. No coupling parts.

The derailed cars are a chain of k rigid links, pinned in the middle of the couplings and free at
the front; its last pin is pushed along the track by ``ds`` (m) an increment. Among the motions
that the links allow the chain takes the one with the least frictional work,

    min over dtheta  sum_j mu (m_j g / 2) (|dr_j,front| + |dr_j,rear|)
    dr_j = ds e + sum_{i behind j} L_i n_i dtheta_i + (b_j +/- d_T) n_j dtheta_j

with ``theta_i`` the angle of link i (rad), ``n_i`` its normal, ``L_i`` its length, ``b_j`` from
its rear pin to the mass centre and ``d_T`` from there to a truck (m). A convex problem: solved by
reweighted least squares, started from the last increment's motion. A car joins the chain when its
front truck reaches the point of derailment. The energy ``E = 1/2 M v0^2`` loses the frictional
work and the brakes' work ``sum F_b ds`` each increment; the run ends when it is spent, and speed
and time follow from ``E = 1/2 M' v^2`` with ``M' = M_rails + sum m_j (|dr_j| / ds)^2``.

What is interpretation [R]: the source tells that the derailed part moves with the geometry of the
last two increments; that it does so with the least frictional work is this project's reading of
it, as are pins in the middle of the couplings, no limit to the angle between cars (they may lie
one upon the other), no moment in the couplings, the kink of the first car that stands for what
starts the motion, and the speed that belongs to an energy. The friction was tuned by the authors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from derail_ros.baselines.train import Brakes, ModelError, Train
from derail_ros.vocabulary.params import GRAVITY

F64 = NDArray[np.float64]

FRICTION = 1.0
"""Coulomb friction at the trucks of derailed cars; tuned in the source [R]."""

INCREMENT = 0.25
"""Advance of the train an increment, m [R]."""

START_ANGLE = 0.1
"""Angle of the first car as it derails, rad [R]; the outcome hardly depends on it."""


@dataclass(frozen=True)
class IncrementalRun:
    """What came of a run; K cars derailed, S increments."""

    derailed: int  # K
    whole_train: bool  # all cars derailed before the energy was spent
    duration: float  # estimated time to rest, s
    advance: float  # of the cars on the rails from the first derailment on, m
    time: F64  # (S+1,) estimated, after each increment, s
    energy: F64  # (S+1,) left after each increment, J
    ground_work: float  # taken out by friction, J
    brake_work: float  # J
    pose: F64  # (N, 3) x, y (m), yaw (rad) of all cars at the end, along a straight track


def least_work(jacobian: F64, push: F64, load: F64, guess: F64) -> F64:
    """The motion with the least frictional work, by reweighted least squares.

    Minimizes ``sum_p load_p |jacobian_p x + push_p|``, smoothed below 2 % of the push.

    Parameters
    ----------
    jacobian : (P, 2, K) displacements of the points for unit changes of the angles, m
    push : (P, 2) their displacements without any, m
    load : (P,) friction force at each, N
    guess : (K,) where to start, rad

    Returns
    -------
    (K,) changes of the angles, rad
    """
    k = jacobian.shape[2]
    flat = jacobian.reshape(-1, k)
    size = float(np.max(np.abs(push)))
    arm = float(np.max(np.abs(flat)))
    x = guess
    for _ in range(30):
        r = jacobian @ x + push
        weight = np.repeat(load / np.sqrt((r * r).sum(axis=1) + (0.02 * size) ** 2), 2)
        normal = flat.T @ (flat * weight[:, None])
        normal[np.diag_indices(k)] += 1e-9 * np.trace(normal)
        new = np.linalg.solve(normal, -flat.T @ (weight * push.ravel()))
        moved = float(np.max(np.abs(new - x))) * arm
        x = new
        if moved < 0.02 * size:
            break
    return x


def roorda_gracie(
    train: Train,
    brakes: Brakes,
    *,
    friction: float = FRICTION,
    increment: float = INCREMENT,
    start_angle: float = START_ANGLE,
    time_limit: float = 600.0,
) -> IncrementalRun:
    """Advance a train over the point of derailment until its energy is spent.

    Parameters
    ----------
    train, brakes : what runs, and what brakes it
    friction : mu at the trucks of derailed cars
    increment : ds, m
    start_angle : angle of the first car as it derails, rad
    time_limit : s of estimated time

    Raises
    ------
    ModelError
        A parameter is out of its range.
    """
    for name, value in (("friction", friction), ("increment", increment)):
        if not (np.isfinite(value) and value > 0.0):
            raise ModelError(f"{name}: must be positive, got {value:g}")
    n = train.n
    mass = train.masses()
    ahead, behind = train.reach()
    link = ahead + behind
    truck = np.array([car.truck_distance for car in train.cars])
    place = np.concatenate([[0.0], -np.cumsum(behind[:-1] + ahead[1:])])
    front = train.start + place + truck
    total = float(mass.sum())
    energy = 0.5 * total * train.speed**2
    t = s = 0.0
    ground = braked = 0.0
    times, energies = [0.0], [energy]
    k = 0
    theta = np.zeros(0)
    motion = np.zeros(0)
    moving = total
    joins = np.maximum(train.point - front, 0.0)
    joins[: train.derailed] = 0.0

    while True:
        while k < n and s >= joins[k] - 1e-9:
            theta = np.append(theta, start_angle if k == 0 else 0.0)
            motion = np.append(motion, 0.0)
            k += 1
        if k == n or energy <= 0.0 or t >= time_limit:
            break
        step = min(increment, joins[k] - s)
        v = np.sqrt(2.0 * energy / max(moving, 1e-3 * total))
        # The bound keeps the time finite where the last of the energy is spent.
        dt = step / max(v, 0.05)
        resist = float(brakes.at(t + 0.5 * dt, v)[k:].sum())
        work = 0.0
        if k:
            jacobian, push = _chain(theta, link[:k], behind[:k], truck[:k], step)
            load = np.repeat(friction * GRAVITY * 0.5 * mass[:k], 2)
            motion = least_work(jacobian, push, load, motion)
            moved = np.sqrt(((jacobian @ motion + push) ** 2).sum(axis=1))
            work = float(load @ moved)
            centre = 0.5 * (jacobian[0::2] + jacobian[1::2]) @ motion + push[0::2]
            share = (centre**2).sum(axis=1) / step**2
            moving = float(mass[k:].sum() + mass[:k] @ share)
        loss = work + resist * step
        part = min(1.0, energy / loss) if loss > 0.0 else 1.0
        theta = theta + part * motion
        s += part * step
        t += part * dt
        energy = max(energy - part * loss, 0.0)
        ground += part * work
        braked += part * resist * step
        times.append(t)
        energies.append(energy)
        motion = motion * (increment / step)

    pose = np.zeros((n, 3))
    pose[:, 0] = train.start + place + s
    if k:
        u = np.stack([np.cos(theta), np.sin(theta)], axis=-1)
        last = k - 1
        pin = np.array([train.start + place[last] - behind[last] + s, 0.0])
        for i in range(last, -1, -1):
            pose[i, :2] = pin + behind[i] * u[i]
            pose[i, 2] = theta[i]
            pin = pin + link[i] * u[i]
    return IncrementalRun(
        derailed=k,
        whole_train=k == n,
        duration=t,
        advance=s - float(joins[0]),
        time=np.array(times),
        energy=np.array(energies),
        ground_work=ground,
        brake_work=braked,
        pose=pose,
    )


def _chain(theta: F64, link: F64, behind: F64, truck: F64, step: float) -> tuple[F64, F64]:
    """Jacobian (2K, 2, K) and push (2K, 2) of the trucks of the chain, front and rear in turn."""
    k = len(theta)
    normal = np.stack([-np.sin(theta), np.cos(theta)], axis=-1)
    # [car j, link i]: all links behind a car carry it along
    carried = np.triu(np.ones((k, k)), 1)[:, :, None] * (link[:, None] * normal)[None]
    jacobian = np.repeat(np.moveaxis(carried, 2, 1), 2, axis=0)
    cars = np.arange(k)
    for end, sign in ((0, 1.0), (1, -1.0)):
        jacobian[2 * cars + end, :, cars] += (behind + sign * truck)[:, None] * normal
    push = np.zeros((2 * k, 2))
    push[:, 0] = step
    return jacobian, push
