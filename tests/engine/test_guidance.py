"""Rails that guide derailed trucks, and limits that must be exceeded for a while."""

import math
from dataclasses import replace

import numpy as np
import pytest

from derail_ros.engine import PlanarSimulation
from derail_ros.vocabulary.params import BrakeParams, DerailmentParams, LateralForce
from tests.engine.support import all_trucks, make_train, start, tight

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
