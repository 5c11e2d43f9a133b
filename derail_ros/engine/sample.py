"""What a run reports at one moment, one entry a car (N cars)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]


@dataclass(frozen=True)
class Sample:
    """State and forces at ``time``, interpolated within the step that holds it.

    Coordinates of car i are ``(X, Y, theta, alpha, beta)``: mass centre (m), yaw, absolute angles
    of the front and rear coupler body (rad). Index 0 is car 1. Trucks: column 0 front, 1 rear.
    Corners: 0 front left, 1 front right, 2 rear left, 3 rear right.

    Attributes
    ----------
    time : s
    step : number of accepted steps
    q, v, a : (N, 5) coordinates, velocities, accelerations
    truck_on : (N, 2) 1 while the truck is on the rails
    coupled : (N-1,) 1 while the coupling behind car i holds
    truck_coordinate : (N, 2) track coordinate of each truck, m
    rail_force : (N, 2) lateral force of the rails on each truck (positive along the track's left
        normal), N; 0 when derailed
    brake_force : (N,) retarding force of the brakes, N, >= 0
    ground_truck_force : (N, 2, 2) ground force on [car, truck, x|y], N
    ground_body_force : (N, 2) ground force over the body, N
    ground_moment : (N,) moment of all ground forces about the mass centre, N m
    striker_force : (N, 2) striker force front, rear, N (positive for a positive displacement)
    coupler_angle : (N-1,) beta_i - alpha_{i+1}, rad
    knuckle_moment : (N-1,) moment on coupler beta_i, N m
    coupler_force : (N-1, 2) force of car i+1 on car i through the coupling (x, y), N
    coupler_gap : (N-1,) distance between the mated faces, m (0 up to the constraint error; once
        parted the distance they have moved apart is not an error and 0 is given)
    collision_force : (N, 2) sum of the collision forces on the car, N
    collision_moment : (N,) their moment about the mass centre, N m
    corner_force : (N, 4) largest-contact force at each corner, N (0 without contact)
    corner_gap, corner_closing_speed : (N, 4) gap (m) and closing speed (m/s) of that contact, nan
        without
    corner_other : (N, 4) car number on the other side of it, 0 without
    external_force : (N, 2) lateral initiating force, N
    energy : (K,) the ledger, in the order of ``derail_ros.engine.ENERGY_ENTRIES``, J
    """

    time: float
    step: int
    q: F64
    v: F64
    a: F64
    truck_on: U8
    coupled: U8
    truck_coordinate: F64
    rail_force: F64
    brake_force: F64
    ground_truck_force: F64
    ground_body_force: F64
    ground_moment: F64
    striker_force: F64
    coupler_angle: F64
    knuckle_moment: F64
    coupler_force: F64
    coupler_gap: F64
    collision_force: F64
    collision_moment: F64
    corner_force: F64
    corner_gap: F64
    corner_closing_speed: F64
    corner_other: NDArray[np.int64]
    external_force: F64
    energy: F64


@dataclass(frozen=True, repr=False)
class Outcome:
    """What came of a run. ``nan`` and ``None`` where a quantity does not exist.

    Attributes
    ----------
    final : the run has ended (all at rest, time limit or void)
    void : a virtual body reached a break: model more cars and run again
    status : "running", "at rest", "time limit", "void" or "failed"
    time : simulation time, s
    duration : time to rest, s; with the status "time limit" the time at which the run was cut off
    steps, rejected_steps : accepted and rejected steps
    derailed_cars : car numbers, from 1
    peak_force : largest force at a single corner, N
    peak_force_pair : (a, b): a struck b; None without a collision
    peak_force_time : s
    peak_resultant : largest resultant between a pair, N
    car_peak_force, car_peak_time : (N,) largest single-corner force on each car, N; time, s
    car_peak_other : (N,) car number of the opposing car, 0 without
    scene_length, scene_width, scene_area : box of all corners of the derailed cars along and
        across the track (arc length and offset), m, m, m^2 (0 without)
    max_coupler_gap, max_truck_offset : largest constraint errors over all accepted steps, m
    derail_time, derail_speed : (N,) first derailment of each car, s, m/s (nan without)
    final_pose : (N, 3) x, y, yaw
    cars_above_5MN, cars_above_10MN : car numbers by peak corner force
    rear_stop : track coordinate of the front truck of the first car still on the rails behind
        the derailed ones, m (nan without)
    energy_initial : kinetic energy at the start, J
    energy : ledger entry -> J now
    energy_residual : largest |imbalance| / initial energy over the run
    """

    final: bool
    void: bool
    status: str
    time: float
    duration: float
    steps: int
    rejected_steps: int
    derailed_cars: tuple[int, ...]
    peak_force: float
    peak_force_pair: tuple[int, int] | None
    peak_force_time: float
    peak_resultant: float
    car_peak_force: F64
    car_peak_time: F64
    car_peak_other: NDArray[np.int64]
    scene_length: float
    scene_width: float
    scene_area: float
    max_coupler_gap: float
    max_truck_offset: float
    derail_time: F64
    derail_speed: F64
    final_pose: F64
    cars_above_5MN: tuple[int, ...]
    cars_above_10MN: tuple[int, ...]
    rear_stop: float
    energy_initial: float
    energy: dict[str, float]
    energy_residual: float

    def __repr__(self) -> str:
        """The outcome in a line; a notebook shows this."""
        force = f"peak force {self.peak_force * 1e-6:.2f} MN"
        if self.peak_force_pair is not None:
            force += " (car {} into car {})".format(*self.peak_force_pair)
        at = self.time if math.isnan(self.duration) else self.duration
        return (
            f"<Outcome: {self.status} at {at:.2f} s, {self.cars_derailed} cars derailed, "
            f"{force}, scene {self.scene_length:.1f} m x {self.scene_width:.1f} m>"
        )

    @property
    def cars_derailed(self) -> int:
        """Number of derailed cars."""
        return len(self.derailed_cars)
