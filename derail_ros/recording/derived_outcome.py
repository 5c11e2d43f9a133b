"""Derives missing parts of a recording from the rest of it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from derail_ros.recording.recorded_run import RecordedRun
from derail_ros.vocabulary.events import Event, EventKind
from derail_ros.vocabulary.outcome import MOVED, Outcome, StandingOutcome
from derail_ros.vocabulary.scene import car_corners, scene_box
from derail_ros.vocabulary.status import AT_REST, CUT_OFF, FAILED, STATUSES, STOPPED, VOID

F64 = NDArray[np.float64]


def derive_couplings(
    events: Sequence[Event], time: F64, cut: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """(T, N-1) couplings that hold at each time (s), from the events and ``Cars.cut`` alone."""
    n = len(cut)
    held = np.ones((len(time), n - 1), dtype=bool) & (cut[1:] == cut[:-1])
    for event in events:
        if event.kind == EventKind.COUPLER_PARTED and event.cars and min(event.cars) < n:
            held[time >= event.time - 1e-9, min(event.cars) - 1] = False
    return held


def derive_outcome(run: RecordedRun, told: Outcome | None = None) -> Outcome:
    """The outcome at the last state, from states, events and collisions.

    Parameters
    ----------
    run : all but its outcome
    told : an earlier outcome of the run, for what only the engine knows
    """
    n = run.n
    blank = Outcome.nothing(run.pose[-1], "", float(run.time[-1]))
    status, duration = _ending(run.events)
    derail_time, derail_speed = blank.derail_time, blank.derail_speed
    for event in run.events:
        if event.kind == EventKind.TRUCK_DERAILED and event.cars and event.cars[0] <= n:
            i = event.cars[0] - 1
            if math.isnan(derail_time[i]):
                derail_time[i], derail_speed[i] = event.time, event.speed
    peak, other, when = blank.car_peak_force, blank.car_peak_other, blank.car_peak_time
    own = run.cars.own
    between = [c for c in run.collisions if not c.object]  # fixed things are told apart
    for c in between:
        for car, opposite in ((c.car_a, c.car_b), (c.car_b, c.car_a)):
            if car and c.peak_force > peak[car - 1]:
                peak[car - 1], other[car - 1], when[car - 1] = c.peak_force, opposite, c.peak_time
    between = [c for c in between if min(c.car_a, c.car_b) <= own]  # and standing cars
    hardest = max(between, key=lambda c: c.peak_force, default=None)
    astray = run.derailed[-1] & run.cars.real
    off = astray & (run.cars.cut == 0)
    corners = car_corners(run.pose[-1], run.cars.length, run.cars.width)[off]
    length, width, area = scene_box(run.line, corners, run.pose[-1][off, 0])
    energy = run.ledger()
    residual = math.nan
    if "residual" in run.energy and energy.get("initial", 0.0) > 0.0:
        residual = float(np.abs(run.energy["residual"]).max()) / energy["initial"]
    return dataclasses.replace(
        blank,
        status=status,
        duration=duration,
        steps=0 if told is None else told.steps,
        rejected_steps=0 if told is None else told.rejected_steps,
        derailed_cars=tuple(int(i) + 1 for i in np.flatnonzero(off)),
        peak_force=0.0 if hardest is None else hardest.peak_force,
        peak_force_pair=None if hardest is None else (hardest.car_a, hardest.car_b),
        peak_force_time=math.nan if hardest is None else hardest.peak_time,
        peak_resultant=max((c.peak_resultant for c in between), default=0.0),
        scene_length=length,
        scene_width=width,
        scene_area=area,
        max_coupler_gap=math.nan if told is None else told.max_coupler_gap,
        max_truck_offset=math.nan if told is None else told.max_truck_offset,
        energy=energy,
        energy_residual=residual,
        train=run.cars.totals,
        standing=StandingOutcome.of(
            own,
            struck=peak > 0.0,
            moved=np.hypot(*(run.pose[-1] - run.pose[0])[:, :2].T) > MOVED,
            derailed=astray,
        ),
    )


def _ending(events: Sequence[Event]) -> tuple[str, float]:
    """Status of a run and time to rest (s, nan without), by the event of its end."""
    for event in reversed(events):
        if event.kind == EventKind.RUN_VOID:
            return VOID, math.nan
        if event.kind == EventKind.RUN_FAILED:
            return FAILED, math.nan
        if event.kind == EventKind.RUN_ENDED:
            status = STOPPED if event.cause == "command" else event.cause
            if status in STATUSES:
                return status, event.value if status == AT_REST else math.nan
    return CUT_OFF, math.nan
