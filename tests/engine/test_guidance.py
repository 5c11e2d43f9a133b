"""Rails that guide derailed trucks, limits that must be exceeded for a while, cars in buff."""

import math
from dataclasses import replace

import numpy as np
import pytest

from derail_ros.engine import PlanarSimulation
from derail_ros.vocabulary.events import EventKind
from derail_ros.vocabulary.params import (
    BrakeParams,
    BrakeTrigger,
    DerailmentParams,
    LateralForce,
)
from tests.engine.support import all_trucks, make_car, make_train, start, tight

NONE = BrakeParams(triggers=())
GUIDE = DerailmentParams(guide_strength=150e3, guide_stiffness=3e6, guide_play=0.6)


def sliding(guide, sideways, max_step=2e-3):
    """A car off the rails on ground without friction that moves aside."""
    params = make_train(1, speed=10.0, derailed=all_trucks(1), brakes=NONE)
    params = replace(params, ground=replace(params.ground, scale=0.0), derailment=guide)
    v = np.zeros((1, 5))
    v[0, :2] = 10.0, sideways
    return start(tight(params, 1e-8, max_step=max_step), v=v)


def test_a_rail_turns_a_slow_truck_back():
    # two springs of 3 MN/m: half a period of sqrt(2 k / m) beyond the play
    run = sliding(GUIDE, 0.3)
    m = run.params.cars[0].mass
    omega = math.sqrt(2.0 * GUIDE.guide_stiffness / m)
    run.advance_to(GUIDE.guide_play / 0.3 + 0.5 * math.pi / omega)
    s = run.sample()
    assert s.q[0, 1] - GUIDE.guide_play == pytest.approx(0.3 / omega, rel=1e-3)
    run.advance_to(run.time + 0.5 * math.pi / omega + 0.1)
    s = run.sample()
    assert s.v[0, 1] == pytest.approx(-0.3, rel=1e-3)
    assert s.energy["guidance"] == pytest.approx(0.0, abs=1.0)
    assert run.outcome().energy_residual < 1e-6


def test_a_fast_one_breaks_out_and_is_free_for_good():
    run = sliding(GUIDE, 1.5, max_step=5e-4)
    run.advance_to(2.0)
    m = run.params.cars[0].mass
    reach = GUIDE.guide_strength / GUIDE.guide_stiffness
    taken = GUIDE.guide_strength * reach  # two trucks, half of force times way each
    s = run.sample()
    assert s.v[0, 1] == pytest.approx(math.sqrt(1.5**2 - 2.0 * taken / m), rel=5e-3)
    assert s.energy["guidance"] == pytest.approx(taken, rel=0.02)
    assert s.v[0, 0] == pytest.approx(10.0, rel=1e-9)
    assert run._state.loose.all()


@pytest.mark.parametrize(("hold", "off"), [(0.0, 1), (0.04, 1), (0.06, 0)])
def test_a_truck_leaves_the_rails_when_its_limit_is_exceeded_long_enough(hold, off):
    push = LateralForce(force=400e3, car=1, place="front", start=0.5, duration=0.05)
    params = make_train(1, speed=10.0, lateral=(push,), brakes=NONE)
    params = replace(params, derailment=DerailmentParams(lv_limit=1.0, lv_hold=hold))
    run = PlanarSimulation(tight(params, 1e-6, max_step=2e-3))
    run.advance_to(1.0)
    assert (run.sample().truck_on[0] == 0).sum() == off  # the rear truck stays on
    if off:
        (event,) = [e for e in run.events if e.cause == "lateral force"]
        assert event.time == pytest.approx(0.5 + hold, abs=5e-3)


# In buff -----------------------------------------------------------------------------------------

PLAY = 0.03


def pushed(masses, braked, **derailment):
    """Cars on the straight of which one brakes, with half its weight and at once."""
    cars = []
    for i, mass in enumerate(masses):
        car = make_car(i, mass=mass, coupler="E60")
        weight = mass if i + 1 == braked else 0.0
        cars.append(replace(car, brakes=(replace(car.brakes[0], force=0.0, weight=weight),)))
    brakes = BrakeParams(
        traction_coefficient=0.5, triggers=(BrakeTrigger(mode="instant_traction_limited"),)
    )
    return replace(
        make_train(cars, brakes=brakes, speed=15.0), derailment=DerailmentParams(**derailment)
    )


def askew_quotients(masses):
    """Lateral over vertical force of the front truck of each car but the first, by hand.

    The first car brakes. The coupling in front of a car has the buff that slows the car and all
    behind it; the bars lean by the play, and a car bears their pushes on its trucks as a beam.
    """
    car = make_car(coupler="E60")
    slowing = 0.5 * 9.81 * masses[0] / sum(masses)
    buff = [slowing * sum(masses[i:]) for i in range(1, len(masses))] + [0.0]
    overhang = car.pivot_distance / car.truck_distance
    lean = 2.0 * PLAY * overhang / (2.0 * car.front.length)
    return [
        lean * (0.5 * (overhang + 1.0) * ahead + 0.5 * (overhang - 1.0) * behind)
        / (0.5 * mass * 9.81)
        for mass, ahead, behind in zip(masses[1:], buff, buff[1:])
    ]  # fmt: skip


EMPTIES = (1e6, 25e3, 22e3, 20e3, 24e3, 2e6)


def test_an_empty_car_is_pressed_off_the_rails_in_buff():
    quotients = askew_quotients(EMPTIES)
    worst = max(range(len(quotients)), key=quotients.__getitem__)
    assert worst == 2  # the lightest one, car 4
    for factor, off in ((1.005, False), (0.995, True)):
        limit = factor * quotients[worst]
        run = PlanarSimulation(pushed(EMPTIES, 1, lv_limit=limit, truck_play=PLAY))
        run.advance_to(0.5)
        events = [e for e in run.events if e.kind == EventKind.TRUCK_DERAILED]
        assert bool(events) is off
        if off:
            assert (events[0].cars, events[0].end, events[0].cause) == (
                (4,),
                "front",
                "lateral force",
            )
            assert events[0].value == pytest.approx(quotients[worst], rel=1e-2)


def test_draft_straightens_the_cars():
    """The same brake at the rear, where the couplings pull: nothing leaves the rails."""
    params = pushed(EMPTIES[::-1], len(EMPTIES), lv_limit=0.2, truck_play=PLAY)
    assert PlanarSimulation(params).run().cars_derailed == 0


def test_cars_fold_in_buff():
    """Off the rails, empties under compression jackknife, to either side as they are pushed."""
    params = pushed(EMPTIES, 1, lv_limit=0.8, truck_play=PLAY)
    found = []
    for side in (1.0, -1.0):
        push = LateralForce(force=side * 2e3, car=4, place="centre", duration=5.0)
        start = replace(params.initiation, lateral_forces=(push,))
        run = PlanarSimulation(replace(params, initiation=start))
        found.append(run.run())
    left, right = found
    assert set(left.derailed_cars) >= {3, 4, 5} and left.parted[0].cause == "angle"
    assert np.abs(left.pose[1:5, 5]).max() > 0.5
    assert left.pose[:, 1] == pytest.approx(-right.pose[:, 1], abs=1e-6)
    assert left.energy_residual < 1e-3
