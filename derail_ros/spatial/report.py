"""Samples and outcomes of runs in three dimensions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from derail_ros.engine import layout
from derail_ros.engine.arrays import F64, State, Work
from derail_ros.spatial import constants as c
from derail_ros.spatial.kernels import Space
from derail_ros.spatial.shapes import Body
from derail_ros.vocabulary.outcome import Outcome
from derail_ros.vocabulary.sample import Sample


def make_sample(
    run: Any,
    s: State,
    work: Work,
    space: Space,
    t: float,
    last: tuple[F64, F64, F64] | None,
    energy: dict[str, float],
) -> Sample:
    """The state at ``t``, between that at the beginning of the step, ``last``, and its end."""
    pose, velocity, q, v, a = (x.copy() for x in (space.pose, space.rates, s.q, s.v, s.a))
    acceleration = run.growth
    on, coupled = s.truck_on.copy(), s.coupled.copy()
    if last is not None:
        share = (t - run.previous_time) / (run.time - run.previous_time)
        mixed = (
            (pose, last[0]), (velocity, last[1]), (acceleration, last[2]),
            (q, s.q0), (v, s.v0), (a, s.a0),
        )  # fmt: skip
        for now, before in mixed:
            now[:] = before + share * (now - before)
        on, coupled = s.truck_on0.copy(), s.coupled0.copy()
    acceleration[:, [0, 1, 5]] = a[:, :3]
    pose[:, 2] -= space.body["height"]
    r = work.report
    ground = space.wrench[0] + space.wrench[1]
    truck = np.zeros((len(pose), 2, 2))
    for i, (front, rear) in enumerate(on):
        off = 2 - int(front) - int(rear)
        if off:
            truck[i, on[i] == 0] = space.wrench[0, i, :2] / off
    travel = np.where(coupled.astype(bool), s.coupling["travel"], 0.0)
    return Sample.make(
        t,
        run.step_count,
        pose,
        velocity=velocity,
        acceleration=acceleration,
        coupler_yaw=q[:, 3:5],
        coupler_rate=v[:, 3:5],
        coupler_acceleration=a[:, 3:5],
        truck_on=on,
        coupled=coupled,
        truck_coordinate=s.truck_s.copy(),
        rail_force=s.rail_force.copy(),
        brake_force=r[:, layout.R_BRAKE].copy(),
        ground_truck_force=truck,
        ground_body_force=ground[:, :2] - truck.sum(axis=1),
        ground_moment=ground[:, 5],
        striker_force=r[:, layout.R_STRIKER : layout.R_STRIKER + 2].copy(),
        relative_angle=q[:-1, 4] - q[1:, 3],
        knuckle_moment=r[:-1, layout.R_KNUCKLE].copy(),
        coupler_force=s.coupler_force.copy(),
        collision_force=space.wrench[2, :, :2] + (space.wall[:, :2] if len(space.wall) else 0.0),
        collision_moment=space.wrench[2, :, 5] + (space.wall[:, 5] if len(space.wall) else 0.0),
        external_force=r[:, layout.R_EXTERNAL : layout.R_EXTERNAL + 2].copy(),
        external_moment=r[:, layout.R_EXTERNAL + 2].copy(),
        energy=energy,
        cars={
            "load_on_rails_N": space.wheel.sum(axis=(1, 2)),
            "load_on_ground_N": space.load.sum(axis=1),
        },
        couplings={
            "coupler_vertical_force_N": space.coupler_lift.copy(),
            **({"draft_gear_travel_m": travel} if run.params.couplings.gear.on else {}),
        },
    )


def tilt(pose: F64) -> F64:
    """Angle of each car from upright, rad: (N,)."""
    return np.arccos(np.clip(np.cos(pose[:, 3]) * np.cos(pose[:, 4]), -1.0, 1.0))


def highest(space: Space, half_length: F64) -> F64:
    """Height of the highest point of each car over the rail, m: (N,)."""
    body = space.body
    m = space.xmat[body["body"].astype(int)]
    up = np.where(m[:, 8] >= 0.0, body["top"] - body["height"], body["height"] - body["bottom"])
    reach = np.abs(m[:, 6]) * half_length + np.abs(m[:, 7]) * 0.5 * body["width"]
    return np.asarray(space.pose[:, 2] + reach + np.abs(m[:, 8]) * up)


def make_outcome(
    run: Any, plane: Outcome, space: Space, bodies: Sequence[Body], energy: dict[str, float]
) -> Outcome:
    """The outcome of the plane view, with the third dimension."""
    derailed = np.zeros(run.n_cars, dtype=bool)
    derailed[[i - 1 for i in plane.derailed_cars]] = True
    pose = space.pose.copy()
    pose[:, 2] += plane.pose[:, 2] - space.body["height"]
    lean = tilt(pose)
    opened = np.array([body.kind.open for body in bodies])
    loaded = np.array([bool(car.loads) or not car.empties for car in run.params.cars])
    top = highest(space, np.array([0.5 * car.length for car in run.params.cars]))
    scale = max(abs(energy["initial"]), 1.0)
    return replace(
        plane,
        pose=pose,
        energy=energy,
        energy_residual=abs(energy["residual"]) / scale,
        max_coupler_gap=math.nan,
        max_truck_offset=math.nan,
        values={
            "cars_on_side": float(((lean > c.ON_SIDE) & derailed).sum()),
            "pile_height_m": float(top[derailed].max()) if derailed.any() else 0.0,
            "cars_spilled": float(((lean > c.SPILLS) & derailed & opened & loaded).sum()),
            "real_time_factor": run.real_time_factor,
            "largest_roll_rad": float(np.abs(pose[: run.params.n_train, 3]).max()),
        },
        car_values={"roll_rad": pose[:, 3].copy(), "tilt_rad": lean, "top_m": top},
    )
