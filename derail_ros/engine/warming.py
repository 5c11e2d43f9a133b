"""Compile all kernels, or load them from the cache, before they are needed."""

from __future__ import annotations

from derail_ros.engine.params import (
    BrakeUnit,
    Car,
    CouplerType,
    InitiationParams,
    TrainParams,
)


def warm_up() -> None:
    """Run a train of three cars for a moment, through every kernel a run uses."""
    from derail_ros.engine.simulation import Simulation

    coupler = CouplerType("F79", "F", 1.092, 0.788, 0.170, 3.15e6)
    cars = tuple(
        Car(
            mass=80e3,
            inertia=1e6,
            length=12.0,
            width=2.6,
            pivot_distance=5.9,
            truck_distance=4.8,
            front=coupler,
            rear=coupler,
            brakes=(BrakeUnit(distance=14.0 * i, weight=80e3),),
        )
        for i in range(3)
    )
    run = Simulation(TrainParams(cars=cars, initiation=InitiationParams(speed=10.0)))
    run.advance_to(0.01)
    run.sample()
    run.sample(0.5 * (run.previous_time + run.time))
    run.outcome()
