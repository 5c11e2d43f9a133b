"""Sites in three dimensions: slopes, zones, walls and standing cars against closed forms."""

import math
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from derail_ros.spatial import kernels
from derail_ros.spatial.simulation import FlatSimulation, SpatialSimulation
from derail_ros.vocabulary.events import EventKind
from derail_ros.vocabulary.params import (
    GRAVITY,
    GroundParams,
    IntegrationParams,
    SecondTrack,
    StandingCut,
    TrackParams,
    TrackSegment,
)
from derail_ros.vocabulary.shapes import BED_HEIGHT, RAIL_HEIGHT
from derail_ros.vocabulary.site import Area, FixedBody, GroundZone, SiteParams, Slope, zone_slope
from tests.spatial.test_physics import CAR, OFF, aside, train

FLAT = GroundParams(c_s=0.3, c_d=0.3, c_v=0.0)
SLICK = GroundParams(c_s=1e-6, c_d=1e-6, c_v=0.0)
NEVER = IntegrationParams(rest_hold=60.0)


def box(x0, x1, y0=-50.0, y1=50.0):
    return ((x0, y0), (x1, y0), (x1, y1), (x0, y1))


def zone(outline, mu=0.3, name="zone", **more):
    return GroundZone(name, outline, c_s=mu, c_d=mu, eps=0.01, c_v=0.0, **more)


def put(run, y=None, x=None, z=None, roll=0.0, speed=(0.0, 0.0, 0.0)):
    """Put car 1 somewhere else, moving as a whole; ``z`` of its centre of gravity, m."""
    at, rate = (int(run._space.body[0][key]) for key in ("qpos", "qvel"))
    for k, value in enumerate((x, y, z)):
        if value is not None:
            run._data.qpos[at + k] = value
    run._data.qpos[at + 3 : at + 7] = math.cos(0.5 * roll), math.sin(0.5 * roll), 0.0, 0.0
    run._data.qvel[rate : rate + 3] = speed
    mujoco.mj_step1(run._mj, run._data)
    run._evaluate()
    run._space.before[:] = run._space.velocity


def lengthways(run, speed, y=30.0, x=0.0):
    """Put car 1 on the level ground beside the track, moving along it."""
    aside(run, y)
    put(run, x=x, speed=(speed, 0.0, 0.0))


def energies(run):
    """What the ledger does not account for since the car was put there, but for a constant, J."""
    return run.outcome().energy["residual"]


def kinetic(run):
    return run.outcome().energy["kinetic"]


def test_a_car_slides_across_the_border_of_two_zones():
    # v^2 / 2 g = mu (way before the border) + soft (way behind it), once all of the car is across;
    # little friction, so that both trucks carry half of the weight
    mu, soft, at, v = 0.05, 0.15, 12.0, 8.5
    site = SiteParams(zones=(zone(box(at, 400.0), soft),))
    ground = replace(FLAT, c_s=mu, c_d=mu)
    run = SpatialSimulation(train(off=OFF, ground=ground, site=site, integration=NEVER))
    lengthways(run, v)
    left = energies(run)
    run.advance_to(14.0)
    beyond = (0.5 * v * v / GRAVITY - mu * at) / soft
    assert beyond > CAR.truck_distance + 1.4
    assert run.sample().pose[0, 0] == pytest.approx(at + beyond, rel=0.02)
    assert run.outcome().site.record()["zones"] == [{"name": "zone", "cars": [1]}]
    assert abs(energies(run) - left) < 0.02 * 0.5 * CAR.mass * v * v


def test_a_car_slides_up_a_slope():
    # v^2 / 2 g = (mu cos + sin) of the way along it, where all of the car is on it
    mu, rise, v = 0.1, 0.2, 14.0
    slope = zone(box(-200.0, 400.0, 20.0, 140.0), mu, rise=(0.0, rise))
    run = SpatialSimulation(train(off=OFF, ground=FLAT, site=SiteParams(zones=(slope,)),
                                  integration=NEVER))  # fmt: skip
    angle, height = math.atan(rise), run._space.body[0]["height"]
    # upright on the slope, its axis along the contour
    put(
        run, y=60.0 - height * math.sin(angle), roll=angle,
        z=kernels.ground_height(60.0)[0] + 40.0 * rise + height * math.cos(angle),
        speed=(0.0, v * math.cos(angle), v * math.sin(angle)),
    )  # fmt: skip
    first = run.sample().pose[0, :3]
    top = first
    while run.time < 6.0:
        run.advance_steps(5)
        now = run.sample().pose[0, :3]
        if now[1] < top[1]:
            break
        top = now
    way = float(np.hypot(*(top - first)[1:]))
    expected = 0.5 * v * v / (GRAVITY * (mu * math.cos(angle) + math.sin(angle)))
    assert way == pytest.approx(expected, rel=0.02)
    assert (top - first)[2] == pytest.approx((top - first)[1] * rise, abs=0.05)


def test_a_zone_is_level_with_the_ground_where_it_is_nearest_to_the_track():
    line = SpatialSimulation(train()).track
    berm = zone(box(-50.0, 50.0, 6.0, 16.0), rise=(0.0, 0.4))
    ditch = zone(box(-50.0, 50.0, 6.0, 16.0), rise=(0.0, -0.4))
    across = zone(box(-50.0, 50.0, -10.0, 20.0), rise=(0.0, 0.1))
    for part, at, height in (
        (berm, 6.0, 0.0), (berm, 16.0, 4.0), (ditch, 16.0, -4.0), (across, 0.0, 0.0),
        (across, -10.0, -1.0),
    ):  # fmt: skip
        slope = zone_slope(part, line, 0.5)
        assert part.rise[1] * at - slope.base == pytest.approx(height, abs=1e-9)
    assert zone_slope(berm, line, 0.5) == Slope(pytest.approx(2.4), pytest.approx(4.0), 1.0)
    run = SpatialSimulation(train(site=SiteParams(zones=(berm,))))
    level = [kernels.terrain(run._model, run._space, 0.0, y) for y in (3.0, 8.0, 15.0, 17.0)]
    assert level == pytest.approx([0.0, 0.8, 3.6, 0.0], abs=1e-9)


@pytest.mark.parametrize("speed", [4.0, 9.0])
def test_a_berm_pushes_and_stops(speed):
    # without friction the energy comes back; the top of the path is at v^2 / 2 g
    berm = zone(box(-300.0, 300.0, 40.0, 80.0), 1e-6, rise=(0.0, 0.3))
    run = SpatialSimulation(
        train(off=OFF, ground=SLICK, site=SiteParams(zones=(berm,)), integration=NEVER)
    )
    aside(run, 30.0, speed=speed)
    height, slowest = run.sample().pose[0, 2], math.inf
    before, left = kinetic(run), energies(run)
    highest = height
    while run.time < 25.0 and run.sample().pose[0, 1] > 29.0:
        run.advance_steps(20)
        highest = max(highest, run.sample().pose[0, 2])
        slowest = min(slowest, kinetic(run))
    assert slowest < 0.15 * before
    assert 0.6 < (highest - height) / (0.5 * speed * speed / GRAVITY) < 1.15
    assert abs(energies(run) - left) < 0.02 * before


def test_a_face_holds_what_runs_into_it():
    # behind the crest of a berm stands a face as high as the crest: nothing goes through it, and
    # nothing is thrown over it
    berm = zone(box(-300.0, 300.0, 40.0, 60.0), 0.3, rise=(0.0, 0.2))
    run = SpatialSimulation(
        train(off=OFF, ground=FLAT, site=SiteParams(zones=(berm,)), integration=NEVER)
    )
    aside(run, 72.0, speed=-14.0)
    before, left = kinetic(run), energies(run)
    run.advance_to(5.0)
    pose = run.sample().pose[0]
    assert 55.0 < pose[1] < 75.0 and pose[2] < 4.0
    assert abs(energies(run) - left) < 0.05 * before


def wall_run(speed, wall, kind=SpatialSimulation, y=30.0, x=28.0, ground=SLICK):
    """A car without friction that slides along x into a wall across its way at x = 40."""
    params = train(off=OFF, ground=ground, site=SiteParams(fixed=(wall,)), integration=NEVER)
    run = kind(params)
    lengthways(run, speed, y, x)
    return run


WALL = FixedBody("wall", ((40.0, -60.0), (40.0, 60.0)))


def test_a_rigid_wall_turns_the_momentum_back():
    run = wall_run(6.0, WALL)
    impulse, before = 0.0, run.sample().velocity[0, 0]
    for _ in range(1000):
        impulse += run._space.wall[0, 0] * run.step_size
        run._step()
    after = run.sample().velocity[0, 0]
    assert after < -0.5
    assert impulse == pytest.approx(CAR.mass * (after - before), rel=0.01)
    (struck,) = run.outcome().site.record()["fixed"]
    assert struck["struck_by"] == [1] and struck["force_N"] > 1e6
    (blow,) = run.collisions
    assert blow.object == "wall" and blow.x == pytest.approx(40.0, abs=0.5)
    assert blow.closing_speed == pytest.approx(6.0, rel=0.05) and 0.5 < blow.z < 4.0
    assert struck["energy_J"] == pytest.approx(0.5 * CAR.mass * (before**2 - after**2), rel=0.03)


def test_a_yielding_wall_takes_what_the_car_loses():
    wall = replace(WALL, force=0.4e6)
    run = wall_run(5.0, wall)
    before = kinetic(run)
    run.advance_to(4.0)
    outcome = run.outcome()
    (struck,) = outcome.site.record()["fixed"]
    assert struck["force_N"] == pytest.approx(0.4e6)
    lost = before - outcome.energy["kinetic"]
    assert lost > 0.9 * before
    assert outcome.energy["fixed_bodies"] == pytest.approx(lost, rel=0.03)
    assert struck["energy_J"] == pytest.approx(lost, rel=0.03)


def test_a_wall_gives_way_after_its_energy():
    wall = replace(WALL, force=0.4e6, energy=0.3e6)
    run = wall_run(6.0, wall)
    before = kinetic(run)
    run.advance_to(4.0)
    (struck,) = run.outcome().site.record()["fixed"]
    assert struck["given_way"] == 1
    assert before - kinetic(run) == pytest.approx(0.3e6, rel=0.05)
    assert run.sample().pose[0, 0] > 45.0


def test_a_low_wall_is_passed_over_and_a_high_one_not():
    # a car on the track bed, which a kerb that ends below the top of the bed does not stop
    ends = {}
    for name, height in (("kerb", BED_HEIGHT - 0.02), ("wall", 5.0)):
        body = replace(WALL, height=height)
        params = train(off=OFF, ground=SLICK, speed=8.0, site=SiteParams(fixed=(body,)),
                       integration=NEVER)  # fmt: skip
        start = replace(params.initiation, position=26.0)
        run = SpatialSimulation(replace(params, initiation=start))
        run.advance_to(3.0)
        ends[name] = run.sample().pose[0, 0]
    assert ends["kerb"] == pytest.approx(26.0 + 24.0, abs=0.2)
    assert ends["wall"] < 40.0 - 0.5 * CAR.length + 0.7


def test_a_car_held_low_is_tipped_by_a_low_wall():
    # slides sideways into a wall below its centre of gravity: it rolls over the wall
    low = FixedBody("low", ((-60.0, 40.0), (60.0, 40.0)), height=0.9)
    site = SiteParams(fixed=(low,))
    run = SpatialSimulation(train(off=OFF, ground=FLAT, site=site, integration=NEVER))
    aside(run, 33.0, speed=9.0)
    run.advance_to(2.5)
    fell = [e for e in run.events if e.kind == EventKind.CAR_ON_SIDE]
    assert len(fell) == 1 and fell[0].value < 0.0  # over the wall, to the left


def test_the_plane_of_the_flat_engine_meets_the_same_wall():
    tall = wall_run(6.0, WALL)
    tall.advance_to(2.0)
    params = train(off=OFF, ground=SLICK, speed=6.0, site=SiteParams(fixed=(WALL,)),
                   integration=NEVER)  # fmt: skip
    params = replace(params, initiation=replace(params.initiation, position=28.0))
    flat = FlatSimulation(params)
    flat.advance_to(2.0)
    force = tall.outcome().site.fixed[0].force
    assert flat.outcome().site.fixed[0].force == pytest.approx(force, rel=0.03)


SIDING = SecondTrack("siding", TrackParams(segments=(TrackSegment(600.0),), start_x=-300.0,
                                           start_coordinate=-300.0, start_y=4.5))  # fmt: skip


def with_siding(n=1, standing=2, **more):
    params = train(n, **more)
    return replace(
        params, cars=params.cars + (CAR,) * standing, tracks=(SIDING,),
        standing=(StandingCut(0, 20.0, standing),),
    )  # fmt: skip


def test_cars_that_nobody_touches_stand():
    params = with_siding(2, speed=10.0)
    run = SpatialSimulation(params)
    home = run.sample().pose[2:]
    run.advance_to(2.0)
    assert np.abs(run.sample().pose[2:] - home)[:, [0, 1, 5]].max() < 1e-6
    assert np.abs(run.sample().pose[2:, 2]).max() < 2e-3
    standing = run.outcome().standing
    assert (standing.cars, standing.struck, standing.moved, standing.derailed) == (2, (), (), ())
    assert run.sample().pose[0, 0] == pytest.approx(20.0, abs=0.1)


def test_a_standing_car_that_is_struck_counts_apart():
    params = with_siding(1, off=OFF, ground=FLAT)
    run = SpatialSimulation(params)
    # the train's car slides sideways into the first car on the siding
    aside(run, -4.0)
    put(run, x=20.0, speed=(0.0, 12.0, 0.0))
    run.advance_to(3.0)
    outcome = run.outcome()
    assert outcome.standing.struck == (2,) or outcome.standing.struck == (2, 3)
    assert 2 in outcome.standing.derailed
    assert outcome.derailed_cars == (1,)
    assert outcome.peak_force_pair == (1, 2)
    assert outcome.values["cars_on_side"] <= 1.0
    off = [e.cars for e in run.events if e.kind == EventKind.TRUCK_DERAILED and e.cars == (2,)]
    assert off
    again = SpatialSimulation.from_bytes(run.to_bytes())
    again.advance_to(3.4)
    run.advance_to(3.4)
    assert again.to_bytes() == run.to_bytes()


def test_the_siding_has_a_bed_of_its_own():
    # a car that lies across the siding's bed stands as high as on the main track's
    params = with_siding(1, 1, off=OFF, ground=GroundParams(c_s=2.0, c_d=2.0))
    run = SpatialSimulation(params)
    put(run, x=-60.0, y=4.5)
    run.advance_to(1.0)
    assert run.sample().pose[0, 2] == pytest.approx(-RAIL_HEIGHT, abs=0.05)


def test_areas_tell_who_came_and_who_stays():
    areas = (Area("road", ((20.0, -60.0), (20.0, 60.0)), closed=False),
             Area("yard", box(60.0, 90.0)))  # fmt: skip
    run = SpatialSimulation(train(off=OFF, ground=SLICK, site=SiteParams(areas=areas),
                                  integration=NEVER))  # fmt: skip
    lengthways(run, 20.0)
    run.advance_to(3.5)
    told = {row["name"]: row for row in run.outcome().site.record()["inside"]}
    assert told["road"] == {"name": "road", "cars_ever": [1], "cars_at_rest": []}
    assert told["yard"] == {"name": "yard", "cars_ever": [1], "cars_at_rest": [1]}


def test_a_run_with_a_site_is_repeated_to_the_bit():
    wall = FixedBody("wall", ((-20.0, 4.0), (60.0, 4.0)), force=0.5e6)
    site = SiteParams(zones=(zone(box(-20.0, 60.0, 5.0, 20.0), rise=(0.0, 0.3)),), fixed=(wall,))
    params = with_siding(3, 1, off=OFF, speed=12.0, breaks=(0.0,), site=site,
                         forces=train().initiation.lateral_forces)  # fmt: skip
    params = replace(params, standing=(StandingCut(0, 200.0, 1),))
    run = SpatialSimulation(params)
    run.advance_to(0.8)
    saved = run.to_bytes()
    run.advance_to(1.6)
    again = SpatialSimulation.from_bytes(saved)
    assert again.to_bytes() == saved
    again.advance_to(1.6)
    assert again.to_bytes() == run.to_bytes()


def test_a_car_that_leans_into_a_wall_gains_no_energy():
    # it rolls towards the wall as it strikes it: the edge that leads moves, not the middle
    wall = FixedBody("wall", ((-60.0, 40.0), (60.0, 40.0)))
    ground = GroundParams(c_s=0.45, c_d=0.45, c_v=0.0)
    run = SpatialSimulation(
        train(off=OFF, ground=ground, site=SiteParams(fixed=(wall,)), integration=NEVER)
    )
    aside(run, 34.0, speed=9.0)
    before, left = kinetic(run), energies(run)
    leans = []
    while run.time < 3.0:
        run.advance_steps(10)
        leans.append(run.sample().pose[0, 3])
    assert min(leans) < -0.05 and run.outcome().site.fixed[0].struck_by == (1,)
    outcome = run.outcome()
    taken = outcome.energy["fixed_bodies"]
    assert 0.1 * before < taken < before
    # the site's energy is summed from the law, as in the plane; a blow of 9 MN rises within a few
    # steps of 2 ms, in each of which the force is that of its beginning
    assert taken < outcome.site.fixed[0].energy < 1.15 * taken
    assert abs(energies(run) - left) < 0.02 * before
