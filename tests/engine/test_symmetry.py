"""Runs that must agree up to the first contact: mirrored, shifted, with virtual cars, tighter."""

import math
from dataclasses import replace

import numpy as np
import pytest

from derail_ros.engine import PlanarSimulation
from derail_ros.engine.methods import METHODS
from derail_ros.vocabulary.params import (
    BrakeTrigger,
    BrakeUnit,
    LateralForce,
    TrackParams,
    TrackSegment,
)
from tests.engine.support import make_car, make_train, with_integration

SPEED = 60.0 / 3.6


def train(
    force=50e3, position=0.0, n=12, cars=None, track=None, breaks=(0.0,), method="rkf45", **extra
):
    """The base train, derailed at a break."""
    params = make_train(
        n if cars is None else cars,
        speed=SPEED,
        position=position,
        derailed=((1, "front"), (1, "rear")),
        breaks=breaks,
        lateral=(LateralForce(force=force),),
        triggers=(BrakeTrigger(),),
        track=track,
    )
    return with_integration(params, method=method, **extra)


def first_contact(params):
    """Time at which the first contact begins."""
    run = PlanarSimulation(params)
    while not run.collisions and not run.ended:
        run.advance_to(run.time + 0.1)
    return run.collisions[0].start


def compare(a, b, times, transform):
    """Largest difference of coordinates and velocities, those of ``b`` transformed."""
    worst = 0.0
    for t in times:
        a.advance_to(t)
        b.advance_to(t)
        x, y = a.sample(t), b.sample(t)
        q, v = transform(y.q, y.v)
        worst = max(worst, np.abs(x.q - q).max(), np.abs(x.v - v).max())
    return worst


MIRROR = np.array([1.0, -1.0, -1.0, -1.0, -1.0])


@pytest.mark.parametrize("method", METHODS)
def test_mirror_image(method):
    until = first_contact(train(method=method))
    assert until > 2.0
    left, right = (
        PlanarSimulation(train(method=method)),
        PlanarSimulation(train(-50e3, method=method)),
    )
    times = np.linspace(0.1, until, 12)
    assert compare(left, right, times, lambda q, v: (q * MIRROR, v * MIRROR)) < 1e-8
    assert np.abs(left.sample().q[0, 1:3]).max() > 0.5
    for a, b in zip(left.events, right.events):
        assert (a.kind, a.cars, a.end) == (b.kind, b.cars, b.end)
        assert a.time == pytest.approx(b.time, abs=1e-9)


@pytest.mark.parametrize("method", METHODS)
def test_mirror_image_on_a_curve(method):
    def curve(turn):
        segments = (
            TrackSegment(200.0),
            TrackSegment(60.0, 0.0, turn / 400),
            TrackSegment(300.0, turn / 400, turn / 400),
        )
        return TrackParams(segments=segments)

    left, right = (
        train(50e3 * turn, 240.0, 8, track=curve(turn), breaks=(240.0,), method=method)
        for turn in (1.0, -1.0)
    )
    until = min(first_contact(left), 3.0)
    times = np.linspace(0.1, until, 8)
    worst = compare(
        PlanarSimulation(left),
        PlanarSimulation(right),
        times,
        lambda q, v: (q * MIRROR, v * MIRROR),
    )
    assert worst < 1e-8


@pytest.mark.parametrize("shift", [1.0, -1234.5, 1e4])
def test_shift_along_the_track(shift):
    until = first_contact(train())
    moved = train(position=shift, breaks=(shift,))

    def back(q, v):
        q = q.copy()
        q[:, 0] -= shift
        return q, v

    times = np.linspace(0.1, until, 12)
    assert compare(PlanarSimulation(train()), PlanarSimulation(moved), times, back) < 1e-8


def test_a_straight_of_the_alignment_is_the_endless_straight():
    # turned, moved and starting elsewhere
    until = first_contact(train())
    psi = 2.3
    track = TrackParams((TrackSegment(900.0),), -450.0, 20.0, -7.0, psi)
    c, s = math.cos(psi), math.sin(psi)
    origin = np.array([20.0 + 450.0 * c, -7.0 + 450.0 * s])

    def back(q, v):
        q, v = q.copy(), v.copy()
        turn = np.array([[c, -s], [s, c]])
        q[:, :2] = (q[:, :2] - origin) @ turn
        v[:, :2] = v[:, :2] @ turn
        q[:, 2:] -= psi
        return q, v

    times = np.linspace(0.1, until, 12)
    turned = PlanarSimulation(train(track=track))
    assert compare(PlanarSimulation(train()), turned, times, back) < 1e-8


# Virtual cars ----------------------------------------------------------------------------------


def with_virtual_rear(n, kept):
    """The base train with all behind car ``kept`` in one virtual body."""
    cars = [make_car(i) for i in range(n)]
    units = tuple(unit for car in cars[kept:] for unit in car.brakes)
    rear = replace(
        cars[kept],
        mass=sum(c.mass for c in cars[kept:]),
        inertia=sum(c.inertia for c in cars[kept:]),
        represents=n - kept,
        brakes=units,
    )
    return (*cars[:kept], rear)


def test_virtual_cars_before_the_first_contact():
    # Cars on straight rails with straight couplers are one rigid bar, virtual or not: the same
    # mass, the same brake forces, each with its own arrival. What happens in front bends the
    # couplers between cars that stay on the rails by nothing, as a car on the rails passes no
    # moment on. So the two runs agree to rounding until a virtual body comes to the break or a
    # car in front of it is struck.
    n, kept = 20, 10
    until = first_contact(train(n=n))
    whole, lumped = (
        PlanarSimulation(train(n=n)),
        PlanarSimulation(train(cars=with_virtual_rear(n, kept))),
    )
    worst = 0.0
    for t in np.linspace(0.2, until, 10):
        whole.advance_to(t)
        lumped.advance_to(t)
        a, b = whole.sample(t), lumped.sample(t)
        worst = max(worst, np.abs(a.q[:kept] - b.q[:kept]).max())
        # the virtual body's place is that of the first car it stands for
        assert abs(a.q[kept, 0] - b.q[kept, 0]) < 1e-9
        assert b.brake_force[kept] == pytest.approx(a.brake_force[kept:].sum(), rel=1e-6)
    assert worst < 1e-9
    assert whole.sample().q[0, 1] > 0.5


def test_virtual_brakes_arrive_at_their_own_cars():
    rear = replace(
        make_car(1),
        mass=3 * 68e3,
        represents=3,
        brakes=tuple(BrakeUnit(distance=d, weight=68e3) for d in (290.0, 580.0, 870.0)),
    )
    params = make_train((make_car(0), rear), triggers=(BrakeTrigger(),))
    run = PlanarSimulation(with_integration(params, max_step=0.01))
    run.advance_to(2.5)
    s = run.sample(2.5)
    v = s.v[1, 0]
    mu = (v + 19.223) / (v + 9.388) * 9.388 / 19.223
    assert s.brake_force[1] == pytest.approx(64e3 * mu * (0.15 + 0.05), rel=1e-6)
    reached = [(e.cars, e.time) for e in run.events if e.kind.name == "BRAKE_SIGNAL_REACHED"]
    assert reached == [((1,), 0.0), ((2,), 1.0), ((3,), 2.0)]


# Tolerance and method --------------------------------------------------------------------------


@pytest.mark.parametrize("method", METHODS)
def test_tighter_tolerances_agree(method):
    until = first_contact(train())
    exact = PlanarSimulation(train(rtol=1e-11))
    exact.advance_to(until)
    want = exact.sample(until)
    errors = []
    # below 1e-9 or so what is left is where crossings are located, 1e-7 m
    for rtol in (1e-4, 1e-7, 1e-10):
        run = PlanarSimulation(train(rtol=rtol, method=method))
        run.advance_to(until)
        errors.append(np.abs(run.sample(until).q - want.q).max())
    # at the default the cap on a corner's way, not the tolerance, sets most of rkf45's steps
    assert errors[0] < {"rkf45": 1e-5, "row": 1e-3}[method]
    assert errors[2] < 1e-7
    assert errors[0] > errors[1] > errors[2]


def test_a_tight_pair_agrees_to_1e_8():
    until = first_contact(train())
    a, b = (PlanarSimulation(train(rtol=rtol)) for rtol in (1e-11, 1e-12))
    assert compare(a, b, [0.5 * until, until], lambda q, v: (q, v)) < 1e-8


def test_baumgarte_agrees_with_projection():
    until = first_contact(train())
    a = PlanarSimulation(train(rtol=1e-9))
    b = PlanarSimulation(train(rtol=1e-9, stabilization="baumgarte"))
    assert compare(a, b, [0.5 * until, until], lambda q, v: (q, v)) < 1e-5
