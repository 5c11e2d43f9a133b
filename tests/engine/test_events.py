"""Events: where and when they happen, what they say, and what they do to the run."""

import math
from dataclasses import replace

import numpy as np
import pytest

from derail_ros.engine import PlanarSimulation
from derail_ros.engine.methods import METHODS
from derail_ros.vocabulary.events import EventKind
from derail_ros.vocabulary.params import (
    BrakeParams,
    BrakeTrigger,
    BrakeUnit,
    DerailmentParams,
    GroundParams,
    LateralForce,
    TrackParams,
    TrackSegment,
)
from tests.engine.support import (
    COUPLERS,
    CURVE,
    NO_CONTACT,
    all_trucks,
    free_train,
    make_car,
    make_train,
    project,
    start,
    steps_of,
    tight,
    with_integration,
)

SPACING = 16.348  # of the base cars' centres


def of_kind(run, kind):
    """Events of one kind."""
    return [e for e in run.events if e.kind == kind]


def derailments(run):
    """Trucks that derailed during the run."""
    return [e for e in of_kind(run, EventKind.TRUCK_DERAILED) if e.cause != "initial"]


# Rail breaks -----------------------------------------------------------------------------------


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("track", [None, CURVE], ids=["straight", "curved"])
def test_breaks_are_located(method, track):
    here = 0.0 if track is None else 250.0
    params = make_train(5, speed=22.0, position=here, breaks=(here + 11.0,), track=track)
    run = PlanarSimulation(with_integration(params, method=method))
    while len(derailments(run)) < 5:
        run.advance_steps(1)
        for e in derailments(run):
            if e.step != run.step_count:
                continue
            # the truck stands at the break, and the run has stopped a step there
            i, k = e.cars[0] - 1, ("front", "rear").index(e.end)
            car = params.cars[i]
            r = car.truck_distance * (1 - 2 * k)
            q = run.sample().q[i]
            x, y = q[0] + r * math.cos(q[2]), q[1] + r * math.sin(q[2])
            s, d = run.track.locate(x, y, here + 11.0)
            assert s == pytest.approx(here + 11.0, abs=1e-6)
            assert abs(d) < 1e-9
            assert (e.x, e.y) == pytest.approx((x, y), abs=1e-12)
            assert e.track_coordinate == pytest.approx(s, abs=1e-9)
            assert e.time == run.time
            assert e.cause == "rail break"
            assert e.value == here + 11.0
            assert (e.before, e.after) == ("on the rails", "derailed")
            assert e.speed == pytest.approx(np.hypot(*run.sample().v[i, :2]))
            assert run.sample().truck_on[i, k] == 0
    places = [(e.cars, e.end) for e in derailments(run)]
    assert places[:4] == [((1,), "front"), ((1,), "rear"), ((2,), "front"), ((2,), "rear")]


def test_a_break_under_a_moving_train_waits_for_the_next_truck():
    run = PlanarSimulation(make_train(4, speed=20.0))
    run.advance_to(1.0)
    at = float(run.sample().q[1, 0])  # under the middle of car 2
    run.inject_rail_break(at)
    (event,) = of_kind(run, EventKind.RAIL_BREAK_SET)
    assert (event.track_coordinate, event.x, event.y) == (at, at, 0.0)
    assert event.time == run.time
    run.advance_to(2.2)
    first = derailments(run)[0]
    assert (first.cars, first.end) == ((2,), "rear")
    assert run.sample().truck_on[0].tolist() == [1, 1]
    assert run.sample().truck_on[1].tolist() == [1, 0]


def test_a_break_behind_a_train_derails_nothing():
    run = PlanarSimulation(make_train(3, speed=20.0, position=0.0))
    run.inject_rail_break(-3 * SPACING)
    run.advance_to(3.0)
    assert derailments(run) == []


def test_a_break_ahead_of_a_train():
    run = PlanarSimulation(make_train(3, speed=20.0))
    run.inject_rail_break(45.75)
    run.advance_to(2.1)
    e = derailments(run)[0]
    assert (e.cars, e.end) == ((1,), "front")
    # 40 m ahead of its front truck, nothing brakes: two seconds
    assert e.time == pytest.approx(2.0, abs=1e-7)


def test_a_break_under_a_car_opens_ahead_of_its_front_truck():
    run = PlanarSimulation(make_train(3, speed=20.0))
    run.advance_to(0.5)
    truck = run.sample().truck_coordinate[1, 0]
    at = run.inject_rail_break(car=2)
    assert at == pytest.approx(truck + 0.5, abs=1e-9)
    assert run.rail_breaks == [at]
    run.advance_to(1.0)
    e = derailments(run)[0]
    assert (e.cars, e.end) == ((2,), "front")
    # 0.5 m at 20 m/s
    assert e.time == pytest.approx(of_kind(run, EventKind.RAIL_BREAK_SET)[0].time + 0.025)


def test_a_break_exactly_under_a_truck_takes_it():
    run = PlanarSimulation(make_train(2, speed=20.0))
    run.advance_to(0.4)
    truck = float(run.sample().truck_coordinate[0, 1])
    run.inject_rail_break(truck)
    run.advance_steps(2)
    e = derailments(run)[0]
    assert (e.cars, e.end) == ((1,), "rear")
    assert e.track_coordinate == pytest.approx(truck, abs=1e-6)


def test_a_truck_that_moves_backwards_onto_a_break():
    params = make_train(2, speed=0.0, breaks=(-30.0,))
    v = np.zeros((2, 5))
    v[:, 0] = -9.0
    run = start(params, v=v)
    run.advance_to(1.0)
    e = derailments(run)[0]
    # rear truck of car 2, at -16.348 - 5.75
    assert (e.cars, e.end) == ((2,), "rear")
    assert e.track_coordinate == pytest.approx(-30.0, abs=1e-6)
    assert e.time == pytest.approx((30.0 - SPACING - 5.75) / 9.0, abs=1e-6)


def test_the_source_form_tests_only_at_the_ends_of_steps():
    params = make_train(3, speed=22.0, breaks=(8.0,))
    late = PlanarSimulation(with_integration(params, locate_crossings=False, max_step=0.005))
    late.advance_to(2.0)
    exact = PlanarSimulation(with_integration(params, max_step=0.005))
    exact.advance_to(2.0)
    over = [e.track_coordinate - 8.0 for e in derailments(late)]
    assert all(0.0 <= d <= 0.11 + 1e-9 for d in over)
    assert max(over) > 1e-3
    assert max(abs(e.track_coordinate - 8.0) for e in derailments(exact)) < 1e-6


# Derailment quotient ---------------------------------------------------------------------------


@pytest.mark.parametrize("limit", [2.0, 0.7])
def test_lateral_derailment(limit):
    # a side force at a truck: lambda = -F there, nothing else on straight track
    weight = 0.5 * 68e3 * 9.81

    def pushed(force):
        push = LateralForce(force=force, car=2, place="front", duration=0.5)
        params = make_train(3, lateral=(push,))
        law = DerailmentParams(lv_limit=limit)
        run = PlanarSimulation(replace(params, derailment=law))
        run.advance_to(0.1)
        return run

    held = pushed(0.999 * limit * weight)
    assert derailments(held) == []
    assert held.sample().rail_force[1, 0] == pytest.approx(-0.999 * limit * weight, rel=1e-3)
    let_go = pushed(1.001 * limit * weight)
    e = derailments(let_go)[0]
    assert (e.cars, e.end, e.cause) == ((2,), "front", "lateral force")
    assert e.value == pytest.approx(1.001 * limit, rel=1e-3)
    assert let_go.sample().truck_on[1, 0] == 0
    assert let_go.rail_breaks == []


@pytest.mark.parametrize("method", METHODS)
def test_lateral_derailments_are_located(method):
    # a pile-up pushes trucks off; the quotient is then the limit, unless a constraint that went
    # just before has thrown its load on the truck at once
    params = make_train(
        14,
        speed=20.0,
        derailed=((1, "front"), (1, "rear")),
        breaks=(0.0,),
        lateral=(LateralForce(),),
    )
    params = replace(
        with_integration(params, method=method), derailment=DerailmentParams(lv_limit=0.6)
    )
    run = PlanarSimulation(params)
    run.run()
    removals = [
        e for e in run.events if e.kind in (EventKind.TRUCK_DERAILED, EventKind.COUPLER_PARTED)
    ]
    alone = 0
    for before, e in zip(removals, removals[1:]):
        if e.cause == "lateral force":
            assert e.value > 0.6
            if e.step > before.step + 1:
                alone += 1
                assert e.value == pytest.approx(0.6, rel=2e-3)
    assert alone > 3
    late = PlanarSimulation(with_integration(params, locate_crossings=False))
    late.run()
    values = [e.value for e in late.events if e.cause == "lateral force"]
    assert max(values) > 0.61


def test_a_lateral_derailment_may_roll_the_rail_over():
    push = LateralForce(force=800e3, car=2, place="front", duration=0.2)
    params = replace(
        make_train(4, lateral=(push,)), derailment=DerailmentParams(break_follows_lateral=True)
    )
    run = PlanarSimulation(params)
    run.advance_to(0.01)
    e = derailments(run)[0]
    assert e.cause == "lateral force"
    assert run.rail_breaks == [e.track_coordinate]
    set_event = [e for e in run.events if e.kind == EventKind.RAIL_BREAK_SET]
    assert [b.cause for b in set_event] == ["lateral force"]
    run.advance_to(1.5)
    # what follows derails there
    following = [f for f in derailments(run) if f.cause == "rail break"]
    assert (following[0].cars, following[0].end) == ((2,), "rear")
    assert following[0].track_coordinate == pytest.approx(run.rail_breaks[0], abs=1e-6)


# Couplings -------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("heads", "limit"), [(("F73", "F79"), 0.71), (("E69", "E60"), 0.90), (("F73", "E69"), 0.80)]
)
def test_a_coupling_parts_at_its_limit(heads, limit, method):
    # soft strikers: two cars fold up
    rear, front = (replace(COUPLERS[h], k1=1e3, k2=1e3, damping=0.0) for h in heads)
    cars = (make_car(0, rear=rear), make_car(1, front=front))
    params = free_train(cars, speed=0.0, contact=NO_CONTACT)
    v = np.zeros((2, 5))
    v[0, 4], v[1, 3] = 3.0, -3.0
    run = project(start(with_integration(params, method=method), v=v))
    while not of_kind(run, EventKind.COUPLER_PARTED):
        last = abs(run.sample().relative_angle[0])
        assert last < limit
        run.advance_steps(1)
        assert run.time < 5.0
    (e,) = of_kind(run, EventKind.COUPLER_PARTED)
    s = run.sample()
    assert abs(s.relative_angle[0]) == pytest.approx(limit, abs=1e-6)
    assert e.value == pytest.approx(limit, abs=1e-6)
    assert (e.cars, e.cause, e.time) == ((1, 2), "angle", run.time)
    assert (e.before, e.after) == ("coupled", "parted")
    assert s.coupled[0] == 0
    assert s.coupler_force[0].tolist() == [0.0, 0.0]
    assert s.knuckle_moment[0] == 0.0
    # what the knuckle had stored is released
    assert run.outcome().energy["knuckles_released"] > 1e3
    # the event's place is the rear face of car 1
    c = params.cars[0]
    x = s.q[0, 0] - c.pivot_distance * math.cos(s.q[0, 2]) - c.rear.length * math.cos(s.q[0, 4])
    assert e.x == pytest.approx(x)


def test_a_coupling_parted_from_the_start():
    params = make_train(3, parted=(1,), triggers=(BrakeTrigger(source="car", car=3),))
    run = PlanarSimulation(params)
    (e,) = of_kind(run, EventKind.COUPLER_PARTED)
    assert (e.cars, e.cause, e.time) == ((1, 2), "initial", 0.0)
    run.advance_to(3.0)
    s = run.sample()
    # the rear part brakes harder at first, so it falls back without a force between them
    assert s.coupled.tolist() == [0, 1]
    assert np.all(s.coupler_force[0] == 0.0)
    assert s.coupler_gap[0] == 0.0


# Brakes ----------------------------------------------------------------------------------------


def arrivals(run):
    """Car number -> time at which its brake was reached."""
    reached = of_kind(run, EventKind.BRAKE_SIGNAL_REACHED)
    assert len({e.cars for e in reached}) == len(reached)
    return {e.cars[0]: e.time for e in reached}


@pytest.mark.parametrize(
    ("source", "car", "way"),
    [
        ("front", 0, [0, 1, 2, 3, 4, 5]),
        ("rear", 0, [5, 4, 3, 2, 1, 0]),
        ("both_ends", 0, [0, 1, 2, 2, 1, 0]),
        ("car", 3, [2, 1, 0, 1, 2, 3]),
    ],
)
def test_the_signal_arrives_after_its_way_at_290_m_per_s(source, car, way):
    trigger = BrakeTrigger(time=0.3, delay=0.2, source=source, car=car)
    run = PlanarSimulation(make_train(6, triggers=(trigger,)))
    run.advance_to(1.5)
    expected = 0.5 + np.array(way) * SPACING / 290.0
    got = arrivals(run)
    assert [got[i + 1] for i in range(6)] == pytest.approx(expected, abs=1e-12)
    (e,) = of_kind(run, EventKind.BRAKES_TRIGGERED)
    assert e.time == 0.5
    assert source.replace("_", " ") in e.cause
    # linear rise over 10 s from there
    s = run.sample(run.time)
    u = s.v[:, 0]
    full = 64e3 * (u + 19.223) / (u + 9.388) * 9.388 / 19.223
    assert s.brake_force / full == pytest.approx((run.time - expected) / 10.0, rel=1e-5)


def test_a_cars_own_delay():
    late = make_car(1, brakes=(BrakeUnit(distance=SPACING, weight=68e3, delay=0.4),))
    run = PlanarSimulation(make_train((make_car(0), late), triggers=(BrakeTrigger(),)))
    run.advance_to(1.0)
    assert arrivals(run) == {1: 0.0, 2: pytest.approx(0.4 + SPACING / 290.0)}


def test_instant_brakes():
    params = make_train(4, triggers=(BrakeTrigger(time=0.25, mode="instant"),))
    run = PlanarSimulation(params)
    before = np.nextafter(0.25, 0.0)
    run.advance_to(0.25)
    assert run.time == 0.25
    assert np.all(run.sample(before).brake_force == 0.0)
    assert run.sample().brake_force.min() > 20e3
    assert set(arrivals(run).values()) == {0.25}


def test_a_second_trigger_only_raises():
    def brake(*triggers):
        run = PlanarSimulation(make_train(5, triggers=triggers))
        run.advance_to(4.0)
        return run.sample(run.time), run

    first = BrakeTrigger(time=0.5, source="front")
    for second in (
        BrakeTrigger(time=1.5, source="rear"),
        BrakeTrigger(time=2.0, mode="instant", source="car", car=4),
        BrakeTrigger(time=1.0, mode="traction_limited"),
        BrakeTrigger(time=3.0, source="front"),
    ):
        one, run_one = brake(first)
        two, run_two = brake(first, second)
        # same speeds, as far as the brakes have been the same; compare the forces per speed
        both = PlanarSimulation(make_train(5, triggers=(second,)))
        both.advance_to(4.0)
        only = both.sample(both.time)

        def share(s):
            u = s.v[:, 0]
            return s.brake_force / (64e3 * (u + 19.223) / (u + 9.388) * 9.388 / 19.223)

        if second.mode == "conventional":
            expected = np.maximum(share(one), share(only))
            assert share(two) == pytest.approx(expected, abs=2e-3)
        assert np.all(share(two) >= share(one) - 1e-3)
        early = arrivals(run_one)
        for number, t in arrivals(run_two).items():
            assert t <= early[number]
    # by command, too
    run = PlanarSimulation(make_train(5, triggers=(first,)))
    run.advance_to(2.0)
    before = run.sample().brake_force
    run.trigger_emergency_brake(source="rear")
    assert run.sample().brake_force == pytest.approx(before, rel=1e-12)
    run.trigger_emergency_brake(mode="instant")
    assert np.all(run.sample().brake_force > 4 * before)


def test_a_parted_coupling_vents_the_pipe_both_ways():
    # couplings so weak that the first bend parts one
    push = LateralForce(force=500e3, car=3, place="rear")
    params = make_train(
        6,
        derailed=((3, "front"), (3, "rear")),
        lateral=(push,),
        brakes=BrakeParams(vent_on_parting=True, triggers=()),
    )
    run = PlanarSimulation(replace(params, derailment=DerailmentParams(knuckle_limit_ff=0.01)))
    run.advance_to(1.0)
    parted = of_kind(run, EventKind.COUPLER_PARTED)
    vented = of_kind(run, EventKind.BRAKES_TRIGGERED)
    assert parted
    assert [e.cars for e in parted] == [e.cars for e in vented]
    assert [e.time for e in parted] == [e.time for e in vented]
    assert {e.cause for e in vented} == {"vented"}
    # from the middle of the coupling, both ways; the earliest signal counts
    got = arrivals(run)
    for i in range(6):
        signals = [e.time + abs(i + 0.5 - e.cars[0]) * SPACING / 290.0 for e in parted]
        assert got[i + 1] == pytest.approx(min(signals), abs=1e-12)


def test_cars_without_brakes():
    bare = tuple(make_car(i, brakes=()) for i in range(3))
    brakes = BrakeParams(vent_on_parting=True, triggers=(BrakeTrigger(source="both_ends"),))
    run = PlanarSimulation(make_train(bare, brakes=brakes))
    run.trigger_emergency_brake(source="car", car=3)
    run.advance_to(1.0)
    assert np.all(run.sample().brake_force == 0.0)
    # a signal that starts at a car without brakes still starts there
    mixed = (*bare[:2], make_car(2))
    run = PlanarSimulation(make_train(mixed, triggers=(BrakeTrigger(source="front"),)))
    run.advance_to(1.0)
    assert arrivals(run) == {3: pytest.approx(2 * SPACING / 290.0)}


# Ends of a run ---------------------------------------------------------------------------------


def test_a_virtual_body_at_a_break_makes_the_run_void():
    rear = replace(make_car(2), mass=20 * 68e3, represents=20)
    params = make_train(
        (make_car(0), make_car(1), rear),
        speed=20.0,
        breaks=(-5.0,),
        contact=NO_CONTACT,
        ground=GroundParams(scale=0.0),
    )
    run = PlanarSimulation(params)
    outcome = run.run()
    assert (outcome.status, outcome.void, outcome.final) == ("void", True, True)
    (e,) = of_kind(run, EventKind.RUN_VOID)
    assert e.cars == (3,)
    # front truck of the virtual body: -2 * 16.348 + 5.75
    assert e.time == pytest.approx((-5.0 + 2 * SPACING - 5.75) / 20.0, abs=1e-6)
    assert run.events[-1].kind == EventKind.RUN_ENDED
    assert run.events[-1].cause == "void"
    assert [e.cars for e in derailments(run)] == [(1,), (2,), (2,)]
    at = run.state_hash()
    assert run.advance_to(100.0) == []
    assert run.state_hash() == at


def test_a_virtual_body_does_not_derail_sideways():
    rear = replace(make_car(1), represents=5)
    push = LateralForce(force=5e6, car=2, place="rear", duration=0.1)
    run = PlanarSimulation(make_train((make_car(0), rear), lateral=(push,)))
    run.advance_to(0.05)
    s = run.sample()
    assert abs(s.rail_force[1, 1]) > 2.0 * 0.5 * 68e3 * 9.81
    assert s.truck_on.all()


def test_the_time_limit():
    run = PlanarSimulation(with_integration(make_train(2, speed=20.0), time_limit=1.25))
    outcome = run.run()
    assert (outcome.status, outcome.final, outcome.void) == ("time limit", True, False)
    assert 1.25 <= outcome.time < 1.25 + 0.051
    assert math.isnan(outcome.duration)
    assert run.events[-1].kind == EventKind.RUN_ENDED
    assert run.events[-1].cause == "time limit"
    # any later time gives the final state
    assert np.array_equal(run.sample(99.0).q, run.sample().q)


@pytest.mark.parametrize("method", METHODS)
def test_coming_to_rest(method):
    params = make_train(3, speed=6.0, derailed=all_trucks(3))
    run = PlanarSimulation(with_integration(params, method=method))
    limits = run.params.integration
    fast = []
    for _ in steps_of(run, 60.0):
        s = run.sample()
        moving = (
            np.hypot(*s.v[:, :2].T).max() >= limits.rest_speed
            or np.abs(s.v[:, 2]).max() >= limits.rest_yaw_rate
        )
        fast.append((run.time, moving))
    outcome = run.outcome()
    assert outcome.status == "at rest"
    # the run ends half a second after it was last faster than the limits
    last = max(t for t, moving in fast if moving)
    first = min(t for t, _ in fast if t > last)
    assert outcome.duration == first
    assert 0.5 <= run.time - first < 0.5 + 0.051
    resting = of_kind(run, EventKind.CAR_AT_REST)
    assert sorted(e.cars[0] for e in resting) == [1, 2, 3]
    assert max(e.time for e in resting) == pytest.approx(outcome.duration)
    assert run.events[-1].value == outcome.duration


def test_events_come_in_the_order_of_their_time():
    params = make_train(
        10,
        speed=18.0,
        derailed=((1, "front"), (1, "rear")),
        breaks=(0.0,),
        lateral=(LateralForce(),),
        triggers=(BrakeTrigger(time=1.0, source="both_ends"),),
    )
    run = PlanarSimulation(params)
    heard = list(run.events)
    while not run.ended:
        heard += run.advance_to(run.time + 0.33)
    times = [e.time for e in run.events]
    assert times == sorted(times)
    assert heard == run.events or repr(heard) == repr(run.events)
    assert [e.kind for e in run.events[:3]] == [
        EventKind.TRUCK_DERAILED,
        EventKind.TRUCK_DERAILED,
        EventKind.RAIL_BREAK_SET,
    ]
    # each truck, coupling and brake at most once
    for kind in (EventKind.TRUCK_DERAILED, EventKind.COUPLER_PARTED):
        keys = [(e.cars, e.end) for e in of_kind(run, kind)]
        assert len(keys) == len(set(keys))
    outcome = run.outcome()
    off = {e.cars[0] for e in of_kind(run, EventKind.TRUCK_DERAILED)}
    assert set(outcome.derailed_cars) == off
    for i, t in enumerate(outcome.derail_time):
        first = [e.time for e in of_kind(run, EventKind.TRUCK_DERAILED) if e.cars == (i + 1,)]
        assert (math.isnan(t) and not first) or t == min(first)


def test_the_lateral_force_is_on_for_its_time():
    push = LateralForce(force=40e3, start=0.3, duration=0.45, car=2, place="rear")
    run = PlanarSimulation(
        tight(free_train(2, lateral=(push,), ground=GroundParams(scale=0.0)), 1e-6)
    )
    seen = []
    for _ in steps_of(run, 1.2):
        seen.append((run.previous_time, run.time))
        middle = 0.5 * (run.previous_time + run.time)
        on = 0.3 < middle < 0.75
        force = run.sample(middle).external_force
        assert force == pytest.approx(np.array([[0.0, 0.0], [0.0, 40e3 * on]]))
    # no step straddles a switch
    ends = [b for _, b in seen]
    assert 0.3 in ends
    assert 0.75 in ends


def test_the_lateral_force_acts_across_the_track():
    heading = 0.8
    track = TrackParams((TrackSegment(400.0),), start_heading=heading)
    push = LateralForce(force=40e3)
    run = PlanarSimulation(make_train(1, derailed=all_trucks(1), lateral=(push,), position=200.0,
                                track=track))  # fmt: skip
    force = run.sample().external_force[0]
    assert force == pytest.approx(40e3 * np.array([-math.sin(heading), math.cos(heading)]))
