"""What came of a run, in numbers."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from derail_ros.engine import layout as L
from derail_ros.engine.forces import coupler_energy, kinetic_energy
from derail_ros.engine.sample import Outcome
from derail_ros.engine.track import Track

if TYPE_CHECKING:
    from derail_ros.engine.simulation import Simulation

F64 = NDArray[np.float64]


def car_corners(pose: F64, half_length: F64, half_width: F64) -> F64:
    """Corners (N, 4, 2) of cars with poses (N, 3) x, y, yaw, m.

    Order: front left, front right, rear left, rear right.
    """
    c, s = np.cos(pose[:, 2])[:, None], np.sin(pose[:, 2])[:, None]
    u = np.array([1.0, 1.0, -1.0, -1.0]) * half_length[:, None]
    w = np.array([1.0, -1.0, 1.0, -1.0]) * half_width[:, None]
    return np.stack([pose[:, :1] + c * u - s * w, pose[:, 1:2] + s * u + c * w], axis=2)


def scene_box(track: Track, corners: F64, hints: F64) -> tuple[float, float, float]:
    """Length along and width across the track (m) and area (m^2) that hold all corners.

    Coordinates are those of the track (arc length of the foot point, offset): X and Y on the
    straight. ``hints`` (one a car) are track coordinates near the cars.
    """
    if len(corners) == 0:
        return 0.0, 0.0, 0.0
    if len(track.pieces) == 0:
        along, across = corners[:, :, 0].ravel(), corners[:, :, 1].ravel()
    else:
        places = [
            track.locate(float(x), float(y), float(hint))
            for car, hint in zip(corners, hints, strict=True)
            for x, y in car
        ]
        along, across = np.array(places).T
    length = float(along.max() - along.min())
    width = float(across.max() - across.min())
    return length, width, length * width


def make_outcome(run: Simulation) -> Outcome:
    """The outcome of a run as it stands."""
    state, model = run._state, run._model
    clock, cnt, peak = state.clock, state.cnt, state.peak
    off = (state.truck_on == 0).any(axis=1)
    derailed = tuple(int(i) + 1 for i in np.flatnonzero(off))
    pose = state.q[:, :3].copy()
    corners = car_corners(pose, model.car[:, L.HALF_L], model.car[:, L.HALF_W])
    length, width, area = scene_box(run.track, corners[off], state.truck_s[off, 0])

    contacts = state.contact[: int(cnt[L.N_CONTACTS])]
    pair = None
    force, when, resultant = 0.0, math.nan, 0.0
    if len(contacts):
        top = contacts[int(np.argmax(contacts[:, L.K_PEAK]))]
        force, when = float(top[L.K_PEAK]), float(top[L.K_PEAK_T])
        pair = (int(top[L.K_A]), int(top[L.K_B]))
        resultant = float(contacts[:, L.K_RES].max())
    car_peak = peak[:, L.PK_F].copy()

    rear_stop = math.nan
    if derailed:
        behind = [i for i in range(derailed[-1], run.n_cars) if state.truck_on[i, 0]]
        if behind:
            rear_stop = float(state.truck_s[behind[0], 0])

    striker, knuckle = coupler_energy(model, state.coupled, state.q)
    e = state.energy
    now = {
        "kinetic": kinetic_energy(model, state.v),
        "striker": striker,
        "knuckle": knuckle,
        "initial": float(clock[L.E_INITIAL]),
        "brakes": float(e[L.E_BRAKE]),
        "ground_trucks": float(e[L.E_GROUND_TRUCK]),
        "ground_body": float(e[L.E_GROUND_BODY]),
        "collisions": float(e[L.E_COLLISION]),
        "striker_dampers": float(e[L.E_DAMPER]),
        "knuckles_released": float(e[L.E_KNUCKLE]),
        "external": float(e[L.E_EXTERNAL]),
        "stabilization_net": float(e[L.E_STAB_NET]),
        "stabilization_gross": float(e[L.E_STAB_GROSS]),
    }
    return Outcome(
        final=run.ended,
        void=bool(cnt[L.STATUS] == L.VOID),
        status=run.status,
        time=run.time,
        duration=float(clock[L.DURATION]),
        steps=int(cnt[L.STEP]),
        rejected_steps=int(cnt[L.REJECTED]),
        derailed_cars=derailed,
        peak_force=force,
        peak_force_pair=pair,
        peak_force_time=when,
        peak_resultant=resultant,
        car_peak_force=car_peak,
        car_peak_time=peak[:, L.PK_T].copy(),
        car_peak_other=peak[:, L.PK_OTHER].astype(np.int64),
        scene_length=length,
        scene_width=width,
        scene_area=area,
        max_coupler_gap=float(clock[L.MAX_GAP]),
        max_truck_offset=float(clock[L.MAX_OFFSET]),
        derail_time=peak[:, L.PK_DERAIL_T].copy(),
        derail_speed=peak[:, L.PK_DERAIL_V].copy(),
        final_pose=pose,
        cars_above_5MN=tuple(int(i) + 1 for i in np.flatnonzero(car_peak > 5e6)),
        cars_above_10MN=tuple(int(i) + 1 for i in np.flatnonzero(car_peak > 10e6)),
        rear_stop=rear_stop,
        energy_initial=float(clock[L.E_INITIAL]),
        energy=now,
        energy_residual=float(clock[L.MAX_RESIDUAL]),
    )
