"""What came of a planar run, in numbers."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from derail_ros.engine.build import initial_positions
from derail_ros.engine.sampling import ledger, raised
from derail_ros.engine.site import site_outcome
from derail_ros.vocabulary.outcome import MOVED, Outcome, StandingOutcome, parted_couplings
from derail_ros.vocabulary.sample import planar
from derail_ros.vocabulary.scene import car_corners, scene_box
from derail_ros.vocabulary.status import AT_REST
from derail_ros.vocabulary.train import train_totals

if TYPE_CHECKING:
    from derail_ros.engine.simulation import PlanarSimulation


def make_outcome(run: PlanarSimulation) -> Outcome:
    """The outcome of a run as it stands."""
    state, model = run._state, run._model
    clock, cnt, peak = state.clock[0], state.cnt[0], state.peak
    own = run.params.n_train
    astray = (state.truck_on == 0).any(axis=1)
    off = astray & (np.arange(len(astray)) < own)
    derailed = tuple(int(i) + 1 for i in np.flatnonzero(off))
    pose = raised(run.track, planar(state.q), state.truck_s, own)
    corners = car_corners(pose, 2.0 * model.car["half_l"], 2.0 * model.car["half_w"])
    length, width, area = scene_box(run.track, corners[off], state.truck_s[off, 0])

    contacts = state.contact[: int(cnt["contacts"])]
    # fixed bodies are told apart, and standing cars that strike each other
    contacts = contacts[(contacts["b"] > 0.0) & (np.minimum(contacts["a"], contacts["b"]) <= own)]
    pair = None
    force, when, resultant = 0.0, math.nan, 0.0
    if len(contacts):
        top = contacts[int(np.argmax(contacts["peak"]))]
        force, when = float(top["peak"]), float(top["peak_time"])
        pair = (int(top["a"]), int(top["b"]))
        resultant = float(contacts["resultant"].max())

    behind = range(derailed[-1], own) if derailed else range(0)
    rear = next((i for i in behind if state.truck_on[i, 0]), None)
    return Outcome(
        status=run.status,
        time=run.time,
        duration=float(clock["duration"]) if run.status == AT_REST else math.nan,
        steps=int(cnt["steps"]),
        rejected_steps=int(cnt["rejected"]),
        derailed_cars=derailed,
        peak_force=force,
        peak_force_pair=pair,
        peak_force_time=when,
        peak_resultant=resultant,
        car_peak_force=peak["force"].copy(),
        car_peak_time=peak["time"].copy(),
        car_peak_other=peak["other"].astype(np.int64),
        scene_length=length,
        scene_width=width,
        scene_area=area,
        max_coupler_gap=float(clock["max_gap"]),
        max_truck_offset=float(clock["max_offset"]),
        derail_time=peak["derail_time"].copy(),
        derail_speed=peak["derail_speed"].copy(),
        pose=pose,
        rear_part_first_car=0 if rear is None else rear + 1,
        rear_part_coordinate=math.nan if rear is None else float(state.truck_s[rear, 0]),
        energy=ledger(model, state, state.energy, state.coupled, state.q, state.v),
        energy_residual=float(clock["max_residual"]),
        couplings={
            f"max_{which}_{unit}": state.coupling[column].copy()
            for which in ("draft", "buff")
            for unit, column in (("N", which), ("time_s", f"{which}_time"))
        },
        parted=parted_couplings(run.events, own),
        train=train_totals(run.params.cars[:own]),
        site=site_outcome(run),
        standing=_standing(run, astray),
    )


def _standing(run: PlanarSimulation, astray: NDArray[np.bool_]) -> StandingOutcome:
    """What came of the cars on second tracks."""
    state, own = run._state, run.params.n_train
    if own == run.n_cars:
        return StandingOutcome()
    contacts = state.contact[: int(state.cnt["contacts"][0])]
    return StandingOutcome.of(
        own,
        struck=np.isin(np.arange(1, run.n_cars + 1), [contacts["a"], contacts["b"]]),
        moved=np.hypot(*(state.q - initial_positions(run.params))[:, :2].T) > MOVED,
        derailed=astray,
    )
