"""Collisions: hand-worked geometry, an independent geometry, and what must hold for any pair."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from derail_ros.vocabulary.params import ContactParams
from tests.engine.reference import corner_list, touching
from tests.engine.support import (
    free_train,
    make_car,
    make_train,
    place,
    start,
    steps_of,
    with_integration,
)

COUNTED = settings(deadline=None, max_examples=150, derandomize=True)

# Base cars: 14.1 m x 2.6 m
A, B = 7.05, 1.3
F_MAX, D_C, D_B = ContactParams().force_max, 0.08, 0.8


def bell(gap):
    """Force of the gap law at no speed."""
    return F_MAX * 2.0 ** (-((max(gap, 0.0) / D_C) ** 2))


def factor(closing):
    """Speed factor."""
    return max(0.0, 1.0 + 0.1 * closing + 0.025 * closing * abs(closing))


PAIR = free_train(
    (make_car(0), make_car(1, length=11.0, width=3.1, truck_distance=4.5)),
    parted=(1,),
    speed=0.0,
)
TWINS = free_train(2, parted=(1,), speed=0.0)
TRIO = free_train(3, parted=(1, 2), speed=0.0)
PAIR_RUN, TWINS_RUN, TRIO_RUN = (start(p) for p in (PAIR, TWINS, TRIO))
SWAPPED_RUN = start(replace(PAIR, cars=PAIR.cars[::-1]))


def coordinates(poses):
    """(N, 5) coordinates with straight couplers from (x, y, yaw) of each car."""
    p = np.array(poses, dtype=float)
    return np.column_stack([p, p[:, 2], p[:, 2]])


def pair(pose, velocity=(0.0, 0.0, 0.0), run=TWINS_RUN, other=(0.0, 0.0, 0.0)):
    """Sample of two cars: car 1 at ``pose`` and ``velocity``, car 2 at ``other`` at rest."""
    q = coordinates([pose, other])
    v = coordinates([velocity, (0.0, 0.0, 0.0)])
    return place(run, q, v).sample()


def passing(poses):
    """Sample of two cars, car 1 taken from pose to pose, none too far from the last."""
    run = start(with_integration(TWINS, max_step=1e-5), coordinates([poses[0], (0.0,) * 3]))
    for pose in poses:
        # a step at rest, in which the memory of the corners is brought up to date
        run.advance_steps(1)
        place(run, coordinates([pose, (0.0, 0.0, 0.0)]), np.zeros((2, 5)), remember=True)
    return run.sample()


# By hand ---------------------------------------------------------------------------------------


def test_corner_to_wall():
    # car 1 stands across, yawed a quarter turn and 0.5 rad; its rear left corner is 0.1 m above
    # the left wall of car 2, 3 m ahead of the centre
    yaw = 0.5 * math.pi + 0.5
    c, s = math.cos(yaw), math.sin(yaw)
    lever = np.array([-A * c - B * s, -A * s + B * c])
    centre = np.array([3.0, B + 0.1]) - lever
    sample = pair((*centre, yaw), (0.0, -2.0, 0.0))
    f = bell(0.1) * factor(2.0)
    assert sample.collision_force == pytest.approx(np.array([[0.0, f], [0.0, -f]]), abs=1e-6)
    assert sample.corner_force[0] == pytest.approx([0.0, 0.0, f, 0.0])
    assert sample.corner_force[1] == pytest.approx([0.0, 0.0, 0.0, 0.0])
    assert sample.corner_gap[0, 2] == pytest.approx(0.1)
    assert sample.corner_closing_speed[0, 2] == pytest.approx(2.0)
    assert sample.corner_other[0].tolist() == [0, 0, 2, 0]
    assert sample.collision_moment == pytest.approx([lever[0] * f, -3.0 * f])


def test_corner_to_corner_along_the_line_of_corners():
    # front left corner of car 2 and rear right corner of car 1, 0.06 and 0.08 m apart
    sample = pair((2 * A + 0.06, 2 * B + 0.08, 0.0), (-3.0, -4.0, 0.0))
    f = bell(0.1) * factor(0.6 * 3.0 + 0.8 * 4.0)
    assert sample.collision_force[0] == pytest.approx([0.6 * f, 0.8 * f])
    assert sample.collision_force[1] == pytest.approx([-0.6 * f, -0.8 * f])
    # once per pair, and reported at both corners
    assert sample.corner_force[0] == pytest.approx([0.0, 0.0, 0.0, f])
    assert sample.corner_force[1] == pytest.approx([f, 0.0, 0.0, 0.0])
    assert sample.corner_other[0, 3] == 2
    assert sample.corner_other[1, 0] == 1
    assert sample.collision_moment == pytest.approx([(-A * 0.8 + B * 0.6) * f] * 2)


@pytest.mark.parametrize("offset", [0.4, -1.1, 2.5])
def test_wall_to_wall_is_one_corner_of_each(offset):
    sample = pair((2 * A + 0.05, offset, 0.0), (-1.0, 0.0, 0.0))
    f = bell(0.05) * factor(1.0)
    assert sample.collision_force[0] == pytest.approx([2 * f, 0.0], abs=1e-3)
    assert sorted(sample.corner_force[0]) == pytest.approx([0.0, 0.0, 0.0, f])
    assert sorted(sample.corner_force[1]) == pytest.approx([0.0, 0.0, 0.0, f])


@pytest.mark.parametrize("offset", [0.0, 1e-16, 1e-15, -1e-12, 3e-9])
def test_aligned_cars_meet_like_nearly_aligned_ones(offset):
    sample = pair((2 * A + 0.05, offset, 0.0))
    assert sample.collision_force[0] == pytest.approx([2 * bell(0.05), 0.0], rel=1e-6, abs=1.0)
    assert sample.collision_moment == pytest.approx([0.0, 0.0], abs=4 * B * bell(0.05))


def test_a_wide_wall_meets_both_corners_of_a_narrow_one():
    # car 2 of this pair is 3.1 m wide
    sample = pair((7.05 + 5.5 + 0.05, 0.0, 0.0), run=PAIR_RUN)
    f = bell(0.05)
    assert sample.collision_force[0] == pytest.approx([2 * f, 0.0], abs=1e-6)
    assert sample.corner_force[0] == pytest.approx([0.0, 0.0, f, f])
    assert sample.collision_moment == pytest.approx([0.0, 0.0], abs=1e-3)


def test_side_by_side():
    sample = pair((1.0, 2 * B + 0.12, 0.0))
    f = bell(0.12)
    assert sample.collision_force[0] == pytest.approx([0.0, 2 * f], abs=1e-6)
    # the two feet are as far ahead of one as behind the other
    assert sample.collision_moment == pytest.approx([-f, -f], rel=1e-9)


@pytest.mark.parametrize("speed", [4.5, 4.64, 20.0])
def test_separating_bodies_are_never_pulled(speed):
    sample = pair((2 * A + 0.05, 0.3, 0.0), (speed, 0.0, 0.0))
    f = 2 * bell(0.05) * factor(-speed)
    assert sample.collision_force[0] == pytest.approx([f, 0.0], abs=1e-3)
    assert (f == 0.0) == (speed > 4.6332)


def test_the_speed_is_that_of_the_points_in_contact():
    # car 1 turns about its centre: its rear corners move sideways past the wall, not onto it
    sample = pair((2 * A + 0.05, 0.3, 0.0), (0.0, 0.0, 0.8))
    gap, f = 0.05, bell(0.05)
    # the rear corners of car 1 lie 1.3 m to either side: +-1.04 m/s along the normal
    own = [k for k in range(4) if sample.corner_force[0, k] > 0.0]
    assert own == [3]
    # left and right of the centre the rear wall comes and goes with -w omega
    assert sample.corner_closing_speed[0, 3] == pytest.approx(-0.8 * B)
    assert sample.corner_force[0, 3] == pytest.approx(f * factor(-0.8 * B))
    # the front left corner of car 2 meets it 1.0 m to the left of its centre
    assert sample.corner_closing_speed[1, 0] == pytest.approx(0.8 * (B - 0.3))
    assert sample.corner_force[1, 0] == pytest.approx(f * factor(0.8 * (B - 0.3)))
    assert sample.corner_gap[1, 0] == pytest.approx(gap)


def test_bodies_that_cross_like_a_plus_have_no_corner_in_reach():
    # stuck through each other, no corner near a wall: the model has no force for that
    sample = pair((0.5, -0.2, 0.5 * math.pi))
    assert np.all(sample.collision_force == 0.0)
    assert np.all(sample.corner_other == 0)


def test_three_bodies_at_once():
    poses = [(2 * A + 0.05, 0.4, 0.1), (0.0, 0.0, 0.0), (2.0, 2 * B + 0.1, 0.0)]
    far = 200.0
    run = TRIO_RUN

    def force(moved):
        q = coordinates([(p[0] + moved.get(i, 0.0), *p[1:]) for i, p in enumerate(poses)])
        return place(run, q, np.zeros((3, 5))).sample().collision_force

    together = force({})
    # each pair alone: the third car taken far away
    apart = force({0: far}) + force({1: far}) + force({2: -far})
    assert np.abs(together[1]).max() > 1e6
    assert together == pytest.approx(apart, rel=1e-12, abs=1e-6)


def test_coupled_neighbours_collide_too():
    # short couplers: bodies 0.4 m apart already on straight track
    cars = tuple(make_car(i, coupler="F70", pivot_distance=6.507) for i in range(2))
    run = start(free_train(cars, speed=0.0))
    gap = 2 * (6.507 + 0.743) - 14.1
    assert 0.0 < gap < D_B
    assert run.sample().collision_force[0, 0] == pytest.approx(2 * bell(gap), rel=1e-6)


def test_a_virtual_body_never_collides():
    cars = (make_car(0), make_car(1, represents=20))
    params = make_train(cars, derailed=((1, "front"), (1, "rear")), parted=(1,), speed=0.0)
    q = coordinates([(14.15, 0.3, 0.0), (0.0, 0.0, 0.0)])
    run = start(params, q, np.zeros((2, 5)))
    assert np.all(run.sample().collision_force == 0.0)
    real = replace(params, cars=(make_car(0), make_car(1)))
    assert start(real, q, np.zeros((2, 5))).sample().collision_force[0, 0] > 1e6


@pytest.mark.parametrize("swapped", [False, True])
@pytest.mark.parametrize("dy", [-1e-6, -1e-9, -5e-10, 0.0, 5e-10, 1e-9, 1e-6])
def test_the_force_is_continuous_at_the_end_of_a_wall(dy, swapped):
    # a corner of the turned car opposite the end of the other's front wall
    yaw = 0.25 * math.pi
    c = s = math.sqrt(0.5)
    tip = min((c * u - s * w, s * u + c * w) for u in (A, -A) for w in (B, -B))
    poses = [(A + 0.05 - tip[0], B + dy - tip[1], yaw), (0.0, 0.0, 0.0)]
    q = coordinates(poses[::-1] if swapped else poses)
    sample = place(TWINS_RUN, q, np.zeros((2, 5))).sample()
    force = sample.collision_force[1 if swapped else 0]
    assert force == pytest.approx([bell(0.05), 0.0], abs=1e-3 * bell(0.05))


# At the edge of the buffer ---------------------------------------------------------------------

# half of F_max at the edge, so that a touch cannot be overlooked
SHARP = ContactParams(half_distance=0.8)


@pytest.mark.parametrize(
    ("pose", "corner"),
    [
        ((2 * A + D_B, 0.7, 0.0), "wall"),
        ((0.3, 2 * B + D_B, 0.0), "wall"),
        ((2 * A + 0.6 * D_B, 2 * B + 0.8 * D_B, 0.0), "corner"),
    ],
)
def test_just_hit_and_just_missed(pose, corner):
    run = start(replace(TWINS, contact=SHARP))
    direction = np.array([0.6, 0.8, 0.0] if corner == "corner" else [1.0, 1.0, 0.0])
    hit = pair(np.array(pose) - 1e-9 * direction, run=run)
    missed = pair(np.array(pose) + 1e-9 * direction, run=run)
    contacts = 1 if corner == "corner" else 2
    resultant = np.hypot(*hit.collision_force[0])
    assert resultant == pytest.approx(contacts * 0.5 * F_MAX, rel=1e-6)
    assert np.all(missed.collision_force == 0.0)


# the gap at which two corners at no closing speed give the 10 kN that make an event
EVENT_GAP = D_C * math.sqrt(math.log2(2 * F_MAX / 10e3))


@pytest.mark.parametrize(("gap", "count"), [(EVENT_GAP - 1e-5, 1), (EVENT_GAP + 1e-5, 0)])
def test_a_passing_pair_just_hit_and_just_missed(gap, count):
    # so heavy that the contact does not move them
    cars = tuple(make_car(i, mass=1e12) for i in range(2))
    params = free_train(cars, parted=(1,), speed=0.0)
    q = coordinates([(20.0, 2 * B + gap, 0.0), (0.0, 0.0, 0.0)])
    run = start(params, q, coordinates([(-10.0, 0.0, 0.0), (0.0, 0.0, 0.0)]))
    run.advance_to(4.5)
    assert run.sample().q[0, 0] < -20.0
    assert len(run.collisions) == count
    for c in run.collisions:
        assert (c.car_a, c.car_b) in ((1, 2), (2, 1))
        assert c.peak_resultant == pytest.approx(10e3, rel=1e-2)
        # alongside for 28.2 m of travel; force above 5 kN from the corners a little longer
        assert c.end - c.start == pytest.approx(28.2 / 10.0, abs=0.06)
        assert c.final


# Penetration -----------------------------------------------------------------------------------


@pytest.mark.parametrize("depth", [0.1, 1.0, 1.29, 1.31, 2.0, 2.59])
def test_a_corner_inside_keeps_the_wall_it_came_through(depth):
    # car 1 stands across and its rear comes down through the left wall of car 2
    across = 0.5 * math.pi
    path = np.append(np.arange(0.3, -depth, -0.1), -depth)
    sample = passing([(1.0, B + A + y, across) for y in path])
    force = sample.collision_force[0]
    assert force[1] == pytest.approx(2 * F_MAX, rel=1e-9)
    assert sample.corner_gap[0, 2:] == pytest.approx([-depth, -depth])
    # looked at afresh, the nearest wall is the other one past the middle
    fresh = pair((1.0, B + A - depth, across))
    assert np.sign(fresh.collision_force[0, 1]) == (1.0 if depth < B else -1.0)


def test_a_corner_forgets_its_wall_once_it_is_out():
    across = 0.5 * math.pi
    through = [(1.0, B + A + y, across) for y in np.arange(0.3, -2 * B - 0.15, -0.1)]
    # out on the far side: pushed away from there
    assert passing(through).collision_force[0, 1] < 0.0
    back = [(1.0, B + A + y, across) for y in np.arange(-2 * B - 0.1, -B + 0.5, 0.1)]
    # and back in through the far wall, which it now keeps past the middle
    sample = passing(through + back)
    assert sample.corner_gap[0, 2] < -B
    assert sample.collision_force[0, 1] == pytest.approx(-2 * F_MAX)


def test_a_corner_that_enters_at_a_corner_takes_the_wall_it_is_least_behind():
    # from the corner region of car 2's front left, diagonally in
    steps = np.arange(0.5, -0.36, -0.05)
    sample = passing([(A + A + 0.3 * k, B + B + k, 0.0) for k in steps])
    # 0.35 m behind the left wall, 0.105 m behind the front one
    assert sample.collision_force[0] == pytest.approx([2 * F_MAX, 0.0], abs=1e-3)


def test_deep_penetration_in_motion():
    # a buffer too weak to stop anything: the car passes through, pushed back all the way
    weak = ContactParams(force_max=1.0e3, c1=0.0, c2=0.0)
    params = replace(TWINS, contact=weak)
    q = coordinates([(1.0, B + A + 2.0, 0.5 * math.pi), (0.0, 0.0, 0.0)])
    run = start(params, q, coordinates([(0.0, -12.0, 0.0), (0.0, 0.0, 0.0)]))
    seen = 0
    for _ in steps_of(run, 0.5):
        s = run.sample()
        rear = s.q[0, 1] - A - s.q[1, 1]
        if -B + 1e-6 < rear < B - 1e-6:
            seen += 1
            assert s.collision_force[0, 1] == pytest.approx(2.0e3, rel=1e-3)
    assert seen > 10
    assert rear < -B


def test_through_the_even_wall_costs_the_area_of_the_bell():
    # without speed dependence two corners take 2 F_max d_c sqrt(pi / ln 2) on their way in
    even = ContactParams(inside="even", c1=0.0, c2=0.0)
    q = coordinates([(1.0, B + A + 0.9, 0.5 * math.pi), (0.0, 0.0, 0.0)])
    run = start(replace(TWINS, contact=even), q, coordinates([(0.0, -12.0, 0.0), (0.0,) * 3]))
    for _ in steps_of(run, 0.5):
        s = run.sample()
        if s.q[0, 1] - A - s.q[1, 1] < B - 0.85:
            break
    work = 2.0 * F_MAX * D_C * math.sqrt(math.pi / math.log(2.0))
    assert run.outcome().energy["collisions"] == pytest.approx(work, rel=2e-3)
    assert s.corner_gap[0, 2] < -0.5 or np.isnan(s.corner_gap[0, 2])


# Any pair --------------------------------------------------------------------------------------

POSES = st.tuples(st.floats(-14.5, 14.5), st.floats(-9.5, 9.5), st.floats(-3.2, 3.2))
OTHERS = st.tuples(st.floats(-50.0, 50.0), st.floats(-20.0, 20.0), st.floats(-3.2, 3.2))
RATES = st.tuples(st.floats(-15.0, 15.0), st.floats(-15.0, 15.0), st.floats(-1.0, 1.0))


def any_pair(relative_pose, other, rates, run=PAIR_RUN):
    """Two cars placed in the plane, the first given in the frame of the second."""
    c, s = math.cos(other[2]), math.sin(other[2])
    x, y, yaw = relative_pose
    pose = (other[0] + c * x - s * y, other[1] + s * x + c * y, other[2] + yaw)
    q, v = coordinates([pose, other]), coordinates(rates)
    return q, v, place(run, q, v).sample()


@COUNTED
@given(POSES, OTHERS, st.tuples(RATES, RATES))
def test_action_equals_reaction_without_net_torque(pose, other, rates):
    q, _, sample = any_pair(pose, other, rates)
    f, m = sample.collision_force, sample.collision_moment
    size = sample.corner_force.max()
    assume(size > 0.0)
    assert np.abs(f.sum(axis=0)).max() <= 1e-14 * size
    about_origin = m + q[:, 0] * f[:, 1] - q[:, 1] * f[:, 0]
    assert abs(about_origin.sum()) <= 1e-13 * size * (1.0 + np.abs(q[:, :2]).max())


@COUNTED
@given(POSES, OTHERS, st.tuples(RATES, RATES))
def test_the_same_in_any_frame(pose, other, rates):
    # turned and moved together, forces turn with the bodies
    turn = other[2]
    c, s = math.cos(turn), math.sin(turn)
    turned = [(c * a - s * b, s * a + c * b, w) for a, b, w in rates]
    _, _, home = any_pair(pose, (0.0, 0.0, 0.0), rates)
    _, _, away = any_pair(pose, other, turned)
    f = home.collision_force @ np.array([[c, s], [-s, c]])
    size = home.corner_force.max()
    # not where a corner has a choice of walls, which rounding decides
    _, _, beside = any_pair(np.array(pose) + 1e-9, (0.0, 0.0, 0.0), rates)
    moved = np.abs(beside.collision_force - home.collision_force).max()
    assume(size > 1.0 and moved < 1e-4 * size)
    assert away.collision_force == pytest.approx(f, abs=1e-9 * size)
    assert away.collision_moment == pytest.approx(home.collision_moment, abs=1e-8 * size)


@COUNTED
@given(POSES, OTHERS, st.tuples(RATES, RATES))
def test_the_same_when_the_bodies_swap_places(pose, other, rates):
    q, v, sample = any_pair(pose, other, rates)
    swapped = place(SWAPPED_RUN, q[::-1], v[::-1]).sample()
    size = sample.corner_force.max()
    assume(size > 0.0)
    force, moment = swapped.collision_force[::-1], swapped.collision_moment[::-1]
    assert force == pytest.approx(sample.collision_force, abs=1e-11 * size)
    assert moment == pytest.approx(sample.collision_moment, abs=1e-10 * size)
    assert swapped.corner_other[::-1].astype(bool).tolist() == (
        sample.corner_other.astype(bool).tolist()
    )


@COUNTED
@given(POSES, OTHERS, st.tuples(RATES, RATES))
def test_against_vertices_and_edges_in_the_plane(pose, other, rates):
    q, v, sample = any_pair(pose, other, rates)
    cars = PAIR.cars
    corners = [corner_list(*q[i, :3], c.length, c.width) for i, c in enumerate(cars)]
    try:
        contacts = touching(*corners, D_B)
    except AssertionError:
        assume(False)  # one inside the other: tested above
    force, moment = np.zeros((2, 2)), np.zeros(2)
    for pa, pb, gap in contacts:
        assume(gap > 1e-6)
        normal = (pa - pb) / gap
        speeds = [
            v[i, :2] + v[i, 2] * np.array([-(p - q[i, :2])[1], (p - q[i, :2])[0]])
            for i, p in enumerate((pa, pb))
        ]
        f = bell(gap) * factor((speeds[1] - speeds[0]) @ normal) * normal
        for i, (p, g) in enumerate(((pa, f), (pb, -f))):
            force[i] += g
            arm = p - q[i, :2]
            moment[i] += arm[0] * g[1] - arm[1] * g[0]
    size = sample.corner_force.max()
    assert bool(contacts) == (size > 0.0) or size < 1e-12
    assert sample.collision_force == pytest.approx(force, abs=1e-9 * size + 1e-15)
    assert sample.collision_moment == pytest.approx(moment, abs=1e-8 * size + 1e-14)


# Events ----------------------------------------------------------------------------------------


def test_a_collision_as_an_event():
    # car 2 runs into car 1, which stands
    q = coordinates([(0.0, 0.2, 0.0), (-18.0, 0.0, 0.0)])
    params = replace(TWINS, integration=replace(TWINS.integration, max_step=1e-3, rtol=1e-8))
    run = start(params, q, coordinates([(0.0, 0.0, 0.0), (6.0, 0.0, 0.0)]))
    rows = []
    for _ in steps_of(run, 2.0):
        s = run.sample()
        rows.append(
            (s.time, np.hypot(*s.collision_force[0]), s.corner_force.max(), s.corner_gap[0, 3])
        )
    t, resultant, corner, _ = np.array(rows).T
    (c,) = run.collisions
    assert (c.car_a, c.car_b, c.final) == (2, 1, True)
    # begins at 10 kN, ends when it has been below 5 kN for 20 ms
    above = np.flatnonzero(resultant >= 10e3)
    assert c.start == t[above[0]]
    below = np.flatnonzero((resultant < 5e3) & (t > c.peak_time))[0]
    assert c.end == t[below]
    # the peak lies between two steps
    assert corner.max() <= c.peak_force < 1.001 * corner.max()
    assert c.peak_time == pytest.approx(t[corner.argmax()], abs=1e-3)
    assert resultant.max() <= c.peak_resultant < 1.001 * resultant.max()
    assert c.closing_speed == pytest.approx(6.0, abs=0.02)
    assert c.angle == pytest.approx(0.0, abs=0.1)
    # the force on the striking car points back
    assert (c.normal_x, c.normal_y) == pytest.approx((-1.0, 0.0), abs=0.05)
    outcome = run.outcome()
    assert outcome.peak_force == c.peak_force
    assert outcome.peak_force_pair == (2, 1)
    assert outcome.car_peak_other.tolist() == [2, 1]
    # what the contact took out is what the bodies lost
    lost = 0.5 * 68e3 * 36.0 - outcome.energy["kinetic"] - outcome.energy["striker"]
    lost -= outcome.energy["striker_dampers"]
    assert c.energy_lost == pytest.approx(lost, rel=1e-3)
    assert c.energy_lost > 0.0


def test_a_gap_in_the_force_shorter_than_the_hold_does_not_end_a_contact():
    # the same impact with a hold longer than the whole contact
    q = coordinates([(0.0, 0.2, 0.0), (-18.0, 0.0, 0.0)])
    v = coordinates([(0.0, 0.0, 0.0), (6.0, 0.0, 0.0)])
    open_ended = replace(TWINS, contact=ContactParams(end_hold=100.0))
    run = start(open_ended, q, v)
    run.advance_to(2.0)
    (c,) = run.collisions
    assert not c.final
    assert math.isnan(c.end)
    assert run.sample().collision_force[0, 0] == 0.0
