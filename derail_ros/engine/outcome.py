"""What came of a planar run, in numbers."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from derail_ros.engine import layout as L
from derail_ros.engine.sampling import ledger
from derail_ros.vocabulary.outcome import Outcome
from derail_ros.vocabulary.sample import planar
from derail_ros.vocabulary.scene import car_corners, scene_box
from derail_ros.vocabulary.status import AT_REST

if TYPE_CHECKING:
    from derail_ros.engine.simulation import PlanarSimulation


def make_outcome(run: PlanarSimulation) -> Outcome:
    """The outcome of a run as it stands."""
    state, model = run._state, run._model
    clock, cnt, peak = state.clock, state.cnt, state.peak
    off = (state.truck_on == 0).any(axis=1)
    derailed = tuple(int(i) + 1 for i in np.flatnonzero(off))
    pose = planar(state.q)
    corners = car_corners(pose, 2.0 * model.car[:, L.HALF_L], 2.0 * model.car[:, L.HALF_W])
    length, width, area = scene_box(run.track, corners[off], state.truck_s[off, 0])

    contacts = state.contact[: int(cnt[L.N_CONTACTS])]
    pair = None
    force, when, resultant = 0.0, math.nan, 0.0
    if len(contacts):
        top = contacts[int(np.argmax(contacts[:, L.K_PEAK]))]
        force, when = float(top[L.K_PEAK]), float(top[L.K_PEAK_T])
        pair = (int(top[L.K_A]), int(top[L.K_B]))
        resultant = float(contacts[:, L.K_RES].max())

    behind = range(derailed[-1], run.n_cars) if derailed else range(0)
    rear = next((i for i in behind if state.truck_on[i, 0]), None)
    initial = float(clock[L.E_INITIAL])
    return Outcome(
        status=run.status,
        time=run.time,
        duration=float(clock[L.DURATION]) if run.status == AT_REST else math.nan,
        steps=int(cnt[L.STEP]),
        rejected_steps=int(cnt[L.REJECTED]),
        derailed_cars=derailed,
        peak_force=force,
        peak_force_pair=pair,
        peak_force_time=when,
        peak_resultant=resultant,
        car_peak_force=peak[:, L.PK_F].copy(),
        car_peak_time=peak[:, L.PK_T].copy(),
        car_peak_other=peak[:, L.PK_OTHER].astype(np.int64),
        scene_length=length,
        scene_width=width,
        scene_area=area,
        max_coupler_gap=float(clock[L.MAX_GAP]),
        max_truck_offset=float(clock[L.MAX_OFFSET]),
        derail_time=peak[:, L.PK_DERAIL_T].copy(),
        derail_speed=peak[:, L.PK_DERAIL_V].copy(),
        pose=pose,
        rear_part_first_car=0 if rear is None else rear + 1,
        rear_part_coordinate=math.nan if rear is None else float(state.truck_s[rear, 0]),
        energy=ledger(model, initial, state.energy, state.coupled, state.q, state.v),
        energy_residual=float(clock[L.MAX_RESIDUAL]),
        train_cars=sum(car.represents for car in run.params.cars),
    )
