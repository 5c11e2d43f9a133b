"""What a run starts from and reports: samples that account for every acceleration, outcomes."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from derail_ros.engine import PlanarSimulation
from derail_ros.engine.arrays import make_work
from derail_ros.engine.blocks import prepare
from derail_ros.engine.dynamics import PLAIN, accelerations
from derail_ros.engine.methods import METHODS
from derail_ros.engine.solver import plain_masses
from derail_ros.vocabulary.events import EventKind
from derail_ros.vocabulary.params import BrakeTrigger, LateralForce, TrackParams, TrackSegment
from tests.engine.reference import Reference, corner_list, touching
from tests.engine.support import (
    COUPLERS,
    CURVE,
    make_car,
    make_train,
    mixed_cars,
    start,
    steps_of,
    with_integration,
)


def pile_up(method="rkf45", track=None, position=0.0, n=14):
    """A train that piles up."""
    params = make_train(
        n,
        speed=60.0 / 3.6,
        position=position,
        derailed=((1, "front"), (1, "rear")),
        breaks=(position,),
        lateral=(LateralForce(),),
        triggers=(BrakeTrigger(),),
        track=track,
    )
    return with_integration(params, method=method)


# Starts ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("position", [-10.0, 150.0, 400.0, 760.0, 1000.0, 1300.0])
def test_a_start_anywhere_meets_the_constraints(position):
    # tangent, spiral, curve, reversing spiral, curve, spiral
    params = make_train(mixed_cars(9), speed=17.0, position=position, track=CURVE)
    run = PlanarSimulation(params)
    s = run.sample()
    reference = Reference(params)
    assert np.abs(reference.phi(s.q)).max() < 1e-9
    assert np.abs(reference.rate(s.q, s.v)).max() < 1e-9
    # car 1 has the place and the speed that were asked for, the others follow at theirs
    at, offset = run.track.locate(*s.q[0, :2], position)
    assert at == pytest.approx(position, abs=1e-3)
    assert abs(offset) < 0.2
    assert np.hypot(*s.v[0, :2]) == pytest.approx(17.0, rel=1e-9)
    assert np.hypot(*s.v[:, :2].T) == pytest.approx(17.0, rel=2e-4)
    assert np.all(np.diff(s.truck_coordinate.ravel()) < 0.0)
    # and nothing is wound up: neighbours point nearly the same way
    assert np.abs(np.diff(s.q[:, 2])).max() < 0.1
    assert np.abs(s.q[:, 3:] - s.q[:, 2:3]).max() < 0.1


def test_a_start_on_the_straight():
    params = make_train(mixed_cars(6), speed=12.0, position=33.0)
    s = PlanarSimulation(params).sample()
    assert s.q[0, 0] == 33.0
    assert np.all(s.q[:, 1:] == 0.0)
    assert np.all(s.v[:, 0] == 12.0)
    assert np.all(s.v[:, 1:] == 0.0)
    for i in range(5):
        a, b = params.cars[i], params.cars[i + 1]
        between = a.pivot_distance + a.rear.length + b.front.length + b.pivot_distance
        assert s.q[i, 0] - s.q[i + 1, 0] == pytest.approx(between, rel=1e-12)


def test_a_start_on_a_full_circle_is_not_wound_up():
    # headings pass +-pi along the train
    circle = TrackParams((TrackSegment(2 * math.pi * 80.0, 1 / 80, 1 / 80),), start_heading=1.0)
    s = PlanarSimulation(make_train(24, position=460.0, track=circle, speed=5.0)).sample()
    assert np.ptp(s.q[:, 2]) > 4.5
    assert np.abs(np.diff(s.q[:, 2])).max() < 0.3
    assert np.abs(s.relative_angle).max() < 1e-9
    assert np.abs(s.q[:, 3:] - s.q[:, 2:3]).max() < 0.2


# Samples ---------------------------------------------------------------------------------------


def explained(params, s, heading):
    """Generalized forces (N, 5) put together from the fields of a sample."""
    n = len(params.cars)
    out = np.zeros((n, 5))
    axis = np.stack([np.cos(s.q[:, 2]), np.sin(s.q[:, 2])], axis=1)

    def push(i, arm, force, moment=True):
        out[i, :2] += force
        if moment:
            out[i, 2] += arm[0] * force[1] - arm[1] * force[0]

    for i, c in enumerate(params.cars):
        speed = np.hypot(*s.v[i, :2])
        push(i, (0.0, 0.0), -s.brake_force[i] * s.v[i, :2] / speed)
        out[i, 2] += s.ground_moment[i] + s.collision_moment[i]
        push(i, None, s.ground_body_force[i] + s.collision_force[i], moment=False)
        for k, r in enumerate((c.truck_distance, -c.truck_distance)):
            push(i, None, s.ground_truck_force[i, k], moment=False)
            normal = np.array([-math.sin(heading[i, k]), math.cos(heading[i, k])])
            push(i, r * axis[i], s.rail_force[i, k] * normal)
        # the initiating force acts at the front truck of car 1
        push(i, c.truck_distance * axis[i], s.external_force[i])
        for k, e in enumerate((c.front, c.rear)):
            out[i, 2] += e.striker_arm * s.striker_force[i, k]
            out[i, 3 + k] -= e.striker_arm * s.striker_force[i, k]
        if i < n - 1:
            f, d = s.coupler_force[i], params.cars[i + 1]
            push(i, -c.pivot_distance * axis[i], f)
            push(i + 1, d.pivot_distance * axis[i + 1], -f)
            for car, col, r, g in ((i, 4, -c.rear.length, f), (i + 1, 3, d.front.length, -f)):
                angle = s.q[car, col]
                out[car, col] += r * (math.cos(angle) * g[1] - math.sin(angle) * g[0])
            out[i, 4] += s.knuckle_moment[i]
            out[i + 1, 3] -= s.knuckle_moment[i]
    return out


@pytest.mark.parametrize("track", [None, CURVE], ids=["straight", "curved"])
def test_a_sample_accounts_for_every_acceleration(track):
    params = pile_up(track=track, position=0.0 if track is None else 250.0)
    run = PlanarSimulation(params)
    inertia = np.array(
        [[c.mass, c.mass, c.inertia, c.coupler_inertia, c.coupler_inertia] for c in params.cars]
    )
    seen = set()
    for t in np.arange(0.25, 9.0, 0.25):
        run.advance_to(t)
        for s in (run.sample(), run.sample(run.time)):
            heading = np.array(
                [[run.track.point(c)[2] for c in row] for row in s.truck_coordinate]
            )
            force = inertia * s.a
            got = explained(params, s, heading)
            scale = np.abs(force).max(axis=0) + 1e3
            assert np.abs((got - force) / scale).max() < 1e-8
            for name in (
                "brake_force", "ground_body_force", "ground_truck_force", "collision_force",
                "rail_force", "external_force", "knuckle_moment", "striker_force",
            ):  # fmt: skip
                if np.any(getattr(s, name) != 0.0):
                    seen.add(name)
    assert len(seen) == 8


def test_fields_of_a_sample():
    params = pile_up()
    run = PlanarSimulation(params)
    run.advance_to(6.0)
    for t in (run.time, 0.5 * (run.time + run.previous_time)):
        s = run.sample(t)
        assert s.time == t
        for i, c in enumerate(params.cars):
            for k, r in enumerate((c.truck_distance, -c.truck_distance)):
                x = s.q[i, 0] + r * math.cos(s.q[i, 2])
                # on the straight the track coordinate is X, on the rails or off
                assert s.truck_coordinate[i, k] == pytest.approx(x, abs=1e-9)
                if s.truck_on[i, k]:
                    assert np.all(s.ground_truck_force[i, k] == 0.0)
                else:
                    assert s.rail_force[i, k] == 0.0
        assert s.relative_angle == pytest.approx(s.q[:-1, 4] - s.q[1:, 3])
        assert np.all(s.coupler_gap < 1e-8)
        parted = s.coupled == 0
        assert parted.any()
        assert np.all(s.coupler_force[parted] == 0.0)
        assert np.all(s.knuckle_moment[parted] == 0.0)
        # the reports of corners belong to the forces on the cars
        touched = s.corner_force > 0.0
        assert np.array_equal(touched, s.corner_other > 0)
        assert np.array_equal(touched, np.isfinite(s.corner_gap))
        assert np.all((s.brake_force == 0.0) | s.truck_on.any(axis=1))
    e = s.energy
    given = e["initial"] + e["external"] + e["stabilization_net"]
    taken = ("brakes", "ground_trucks", "ground_body", "collisions", "striker_dampers")
    left = given - sum(
        e[k] for k in (*taken, "knuckles_released", "kinetic", "striker", "knuckle")
    )
    assert e["residual"] == pytest.approx(left)


def test_no_pair_is_missing_from_the_neighbour_list():
    # at states of a pile-up, all pairs looked at by the other geometry
    params = pile_up()
    run = PlanarSimulation(params)
    law = params.contact
    compared = pairs = 0
    for t in np.arange(2.0, 14.0, 0.25):
        run.advance_to(t)
        s = run.sample()
        if (s.corner_gap <= 0.0).any():
            continue  # penetration: other tests
        force = np.zeros((14, 2))
        corners = [corner_list(*s.q[i, :3], c.length, c.width) for i, c in enumerate(params.cars)]
        for i in range(14):
            for j in range(i + 1, 14):
                if np.hypot(*(s.q[i, :2] - s.q[j, :2])) > 14.1 + 2.6 + law.buffer:
                    continue
                for pa, pb, gap in touching(corners[i], corners[j], law.buffer):
                    normal = (pa - pb) / gap
                    u = [
                        s.v[k, :2]
                        + s.v[k, 2] * np.array([-(p - s.q[k, :2])[1], (p - s.q[k, :2])[0]])
                        for k, p in ((i, pa), (j, pb))
                    ]
                    v = (u[1] - u[0]) @ normal
                    f = law.force_max * 2.0 ** -((gap / law.half_distance) ** 2)
                    f *= max(0.0, law.c1 * v * abs(v) + law.c2 * v + law.c3)
                    force[i] += f * normal
                    force[j] -= f * normal
                    pairs += f > 1e3
        compared += 1
        size = np.abs(force).max() + 1.0
        assert s.collision_force == pytest.approx(force, abs=1e-8 * size)
    assert compared > 15
    assert pairs > 30


def test_corners_that_a_step_leaves_out_have_no_force():
    run = PlanarSimulation(pile_up("row"))
    model = run._model
    looked_at = of = 0
    for _ in steps_of(run, 14.0):
        state, pairs = run._state, int(run._state.cnt["pairs"][0])
        corners = run._work.corners[1 : 1 + int(run._work.active[0])]
        looked_at += sum(bin(bits).count("1") for bits in corners)
        of += 8 * pairs
        view = state._replace(
            pair=state.pair.copy(), cnt=state.cnt.copy(), truck_s=state.truck_s.copy()
        )
        work = make_work(run.n_cars, len(state.pairs), 0, False)
        plain_masses(model, work.wk)
        prepare(model, view, work, view.q, view.v)  # every corner of all pairs
        a = np.empty_like(view.a)
        assert accelerations(model, view, work, run.time, view.q, view.v, a, PLAIN)
        assert np.array_equal(a, state.a)
        assert np.array_equal(work.lam_c, state.coupler_force)
        assert np.array_equal(view.pair[:pairs], state.pair[:pairs])
    assert 1000 < looked_at < 0.5 * of


# Outcomes --------------------------------------------------------------------------------------


@pytest.mark.parametrize("track", [None, CURVE], ids=["straight", "curved"])
def test_the_outcome_of_a_run(track):
    params = pile_up(track=track, position=0.0 if track is None else 250.0)
    run = PlanarSimulation(params)
    peak = np.zeros(14)
    while not run.ended:
        run.advance_steps(1)
        peak = np.maximum(peak, run.sample().corner_force.max(axis=1))
    o, s = run.outcome(), run.sample()
    off = np.flatnonzero((s.truck_on == 0).any(axis=1)) + 1
    assert o.derailed_cars == tuple(off)
    assert o.cars_derailed == len(off)
    assert (o.final, o.void, o.status, o.time) == (True, False, "at rest", run.time)
    assert (o.steps, o.rejected_steps) == (run.step_count, run.statistics["rejected"])
    # a corner's force is one on both cars: each car's peak is that of its contacts
    contacts = run.collisions
    for i in range(14):
        mine = [c for c in contacts if i + 1 in (c.car_a, c.car_b)]
        top = max(mine, key=lambda c: c.peak_force, default=None)
        if top is None or top.peak_force < o.car_peak_force[i]:
            # below the 10 kN that make an event
            assert o.car_peak_force[i] < 10e3
            continue
        assert o.car_peak_force[i] == top.peak_force
        assert o.car_peak_time[i] == top.peak_time
        assert o.car_peak_other[i] == (top.car_b if top.car_a == i + 1 else top.car_a)
        assert peak[i] <= o.car_peak_force[i] * (1 + 1e-12)
    assert o.peak_force == max(c.peak_force for c in contacts)
    assert o.peak_resultant == max(c.peak_resultant for c in contacts)
    assert all(c.final for c in contacts)
    assert o.cars_above_5MN == tuple(np.flatnonzero(o.car_peak_force > 5e6) + 1)
    assert o.cars_above_10MN == tuple(np.flatnonzero(o.car_peak_force > 10e6) + 1)
    # the scene: the box along and across the track that holds all derailed cars
    places = []
    for i in off - 1:
        c = params.cars[i]
        for x, y in corner_list(*s.q[i, :3], c.length, c.width):
            places.append(run.track.locate(x, y, s.truck_coordinate[i, 0]))
    length, width = np.ptp(np.array(places), axis=0)
    assert o.scene_length == pytest.approx(length, rel=1e-9)
    assert o.scene_width == pytest.approx(width, rel=1e-9)
    assert o.scene_area == pytest.approx(length * width, rel=1e-9)
    assert np.array_equal(o.pose, s.pose)
    if len(off) < 14:
        behind = off[-1]
        assert o.rear_stop == s.truck_coordinate[behind, 0]
    assert np.array_equal(np.isnan(o.derail_time), ~np.isin(np.arange(1, 15), off))
    assert o.energy["initial"] == pytest.approx(0.5 * 14 * 68e3 * (60 / 3.6) ** 2, rel=1e-3)


@pytest.mark.parametrize("method", METHODS)
def test_peaks_are_those_within_steps(method):
    # steps are long against the rise of a contact: its peak lies between their ends
    run = PlanarSimulation(pile_up(method, n=40))
    peak, when = np.zeros(40), np.zeros(40)
    while not run.ended:
        run.advance_steps(1)
        if run.sample().corner_force.max() < 1e6:
            continue
        for share in np.linspace(0.1, 0.95, 7):
            s = run.sample(run.previous_time + share * run.step_size)
            now = s.corner_force.max(axis=1)
            when[now > peak] = s.time
            peak = np.maximum(peak, now)
    o = run.outcome()
    assert o.peak_force == pytest.approx(peak.max(), rel=0.01)
    assert o.peak_force_time == pytest.approx(when[peak.argmax()], abs=0.01)
    # a car's own corners; the corners of others may have struck it harder
    strong = peak > 2e6
    assert strong.sum() > 4
    assert np.all(o.car_peak_force[strong] > 0.98 * peak[strong])


def test_an_outcome_without_anything():
    o = PlanarSimulation(make_train(3)).outcome()
    assert (o.final, o.status, o.cars_derailed, o.peak_force) == (False, "running", 0, 0.0)
    assert o.peak_force_pair is None
    assert math.isnan(o.peak_force_time)
    assert math.isnan(o.duration)
    assert (o.scene_length, o.scene_width, o.scene_area) == (0.0, 0.0, 0.0)


def test_new_collisions_are_told_at_their_peak_and_at_their_end():
    run = PlanarSimulation(pile_up())
    told = {}
    while not run.ended:
        run.advance_to(run.time + 0.05)
        for c in run.new_collisions():
            told.setdefault(c.id, []).append(c)
    final = {c.id: c for c in run.collisions}
    assert set(told) == set(final)
    for k, rows in told.items():
        assert rows[-1] == final[k]
        assert rows[-1].final
        peaks = [c.peak_force for c in rows]
        assert peaks == sorted(peaks)
    assert run.new_collisions() == []


# Anything --------------------------------------------------------------------------------------

CAR = st.builds(
    lambda mass, length, front, rear, gap, index: make_car(
        index,
        mass=mass,
        inertia=mass * (length**2 / 12 + 0.6),
        length=length,
        pivot_distance=0.5 * length - gap,
        truck_distance=0.5 * length - 1.5,
        front=COUPLERS[front],
        rear=COUPLERS[rear],
    ),
    st.floats(20e3, 150e3),
    st.floats(9.0, 24.0),
    st.sampled_from(sorted(COUPLERS)),
    st.sampled_from(sorted(COUPLERS)),
    st.floats(0.0, 0.6),
    st.integers(0, 8),
)

TRAINS = st.builds(
    lambda cars, speed, at, force, derailed, method, curved: with_integration(
        make_train(
            cars,
            speed=speed,
            position=400.0 if curved else 0.0,
            derailed=tuple((1 + k % len(cars), end) for k, end in derailed),
            breaks=(400.0 + at if curved else at,),
            lateral=(LateralForce(force=force),),
            triggers=(BrakeTrigger(),),
            track=CURVE if curved else None,
        ),
        method=method,
        time_limit=5.0,
    ),
    st.lists(CAR, min_size=1, max_size=9),
    st.floats(0.0, 40.0),
    st.floats(-60.0, 20.0),
    st.floats(-300e3, 300e3),
    st.lists(st.tuples(st.integers(0, 8), st.sampled_from(["front", "rear"])), max_size=3),
    st.sampled_from(sorted(METHODS)),
    st.booleans(),
)


def check_any_run(params):
    """What holds for any run at all."""
    run = PlanarSimulation(params)
    heard = list(run.events)
    half = None
    while not run.ended:
        heard += run.advance_to(run.time + 1.3)
        if half is None:
            half = run.to_bytes()
    o = run.outcome()
    assert o.status in ("at rest", "time limit")
    assert repr(heard) == repr(run.events)
    times = [e.time for e in heard]
    assert times == sorted(times)
    assert heard[-1].kind == EventKind.RUN_ENDED
    s = run.sample()
    for name in ("q", "v", "a", "rail_force", "coupler_force"):
        assert np.isfinite(getattr(s, name)).all(), name
    assert np.isfinite(list(s.energy.values())).all()
    assert o.max_coupler_gap < 1e-8
    assert o.max_truck_offset < 1e-8
    assert o.energy_residual < 0.02 or o.energy["initial"] < 1e5
    for name in ("brakes", "ground_trucks", "ground_body", "striker_dampers",
                 "knuckles_released"):  # fmt: skip
        # up to what quadrature makes of nearly nothing
        assert o.energy[name] >= -100.0 - 1e-5 * o.energy["initial"], name
    # energy comes from nowhere but the push
    room = o.energy["initial"] + o.energy["external"] + o.energy["stabilization_net"]
    assert o.energy["kinetic"] <= room * 1.02 + 1e3
    again = PlanarSimulation.from_bytes(half)
    again.run()
    assert again.state_hash() == run.state_hash()
    return run


@settings(deadline=None, max_examples=30, derandomize=True)
@given(TRAINS)
def test_any_train(params):
    check_any_run(params)


@pytest.mark.slow
@settings(deadline=None, max_examples=600)
@given(TRAINS)
def test_many_trains(params):
    check_any_run(params)


def test_one_car_and_no_events():
    run = start(make_train(1, speed=3.0, triggers=(BrakeTrigger(mode="instant"),)))
    outcome = run.run()
    assert outcome.status == "at rest"
    assert outcome.cars_derailed == 0
    assert run.collisions == []


def test_an_outcome_is_shown_in_a_line():
    from derail_ros import simulate

    outcome = simulate("base_train", {"train.consist.0.count": 20})
    text = repr(outcome)
    assert "\n" not in text and len(text) < 160
    assert (
        f"{outcome.cars_derailed} cars derailed" in text
        and f"at rest after {outcome.duration:.1f} s" in text
    )
    assert "car {} into car {}".format(*outcome.peak_force_pair) in text
    assert str(outcome) == text


def test_an_application_from_both_ends_in_words():
    from derail_ros.engine.simulation import brake_words

    assert brake_words("conventional", "both_ends") == "conventional from both ends"
    assert brake_words("traction_limited", "rear") == "traction limited from the rear"


def test_applications_are_told_in_these_words():
    from derail_ros.engine import PlanarSimulation
    from derail_ros.scenario import load_scenario

    scenario = load_scenario("base_train").with_overrides({"brakes.signal_source": "both_ends"})
    run = PlanarSimulation(scenario.to_params())
    run.trigger_emergency_brake("conventional", "both_ends", 1, 0.0)
    run.advance_to(0.2)
    causes = [str(e.cause) for e in run.events if "from" in str(e.cause)]
    assert causes == ["conventional from both ends", "command: conventional from both ends"]
