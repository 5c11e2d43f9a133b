"""Zones, slopes, fixed bodies and areas: against closed forms and independent integration."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

from derail_ros.engine import PlanarSimulation
from derail_ros.vocabulary.errors import ParameterError
from derail_ros.vocabulary.params import GRAVITY, ContactParams, GroundParams, LateralForce
from derail_ros.vocabulary.site import Area, FixedBody, GroundZone, SiteParams
from tests.engine.support import (
    all_trucks,
    free_train,
    make_car,
    make_train,
    same_run,
    start,
    tight,
    with_integration,
)

MASS = 68e3
FLAT = GroundParams(c_s=0.6, c_d=0.6, c_v=0.0)
LAW = ContactParams()
HALF = 0.5 * 14.1


def box(x0, x1, y0=-50.0, y1=50.0):
    return ((x0, y0), (x1, y0), (x1, y1), (x0, y1))


def zone(outline, mu=0.6, name="zone", **more):
    return GroundZone(name, outline, c_s=mu, c_d=mu, eps=0.01, c_v=0.0, **more)


def sliding(site, speed=12.0, ground=FLAT, **options):
    """One car off the rails that slides along x from the origin."""
    params = make_train(1, speed=speed, derailed=all_trucks(1), ground=ground, **options)
    return PlanarSimulation(tight(replace(params, site=site), 1e-8))


def free(site, speed=6.0, time_limit=4.0):
    """One car on ground without friction."""
    params = with_integration(free_train(1, speed=speed), time_limit=time_limit)
    return PlanarSimulation(tight(replace(params, site=site), 1e-8))


def head_on(v0, top, most=math.inf):
    """Rebound speed, deepest place and largest force of a car that two corners stop, in 1D.

    ``top`` is that of the bell; above ``most`` the place that is reached stays behind.
    """
    deepest = [LAW.buffer]

    def force(gap, v):
        dent = max(0.0, -min(deepest)) if math.isfinite(most) else 0.0
        x = gap + dent
        bell = 0.0 if x >= LAW.buffer else top * 0.5 ** ((max(x, 0.0) / LAW.half_distance) ** 2)
        factor = max(0.0, LAW.c1 * v * abs(v) + LAW.c2 * v + LAW.c3)
        return 2.0 * min(most, bell * factor)

    def ode(_, y):
        return [-y[1], -force(*y) / MASS]

    def stops(_, y):
        return y[1]

    stops.terminal = True
    options = {"rtol": 1e-10, "atol": 1e-10, "max_step": 1e-3}
    into = solve_ivp(ode, (0.0, 3.0), [LAW.buffer, v0], events=stops, **options)
    deepest.append(into.y[0, -1])
    peak = max(force(g, v) for g, v in into.y.T) / 2.0
    out = solve_ivp(ode, (0.0, 3.0), [into.y[0, -1], -1e-12], **options)
    return -out.y[1, -1], into.y[0, -1], peak


def test_a_car_slides_across_the_border_of_two_zones():
    mu, soft, at, v = 0.6, 1.4, 8.0, 18.0
    run = sliding(SiteParams(zones=(zone(box(at, 200.0), soft),)), speed=v)
    outcome = run.run()
    beyond = (0.5 * v * v / GRAVITY - mu * at) / soft
    assert beyond > HALF  # all of the car is across
    assert run.sample().q[0, 0] == pytest.approx(at + beyond, abs=0.01)
    assert outcome.energy["ground_body"] == pytest.approx(0.5 * MASS * v * v, rel=1e-4)
    assert outcome.energy_residual < 1e-6
    assert outcome.site.record()["zones"] == [{"name": "zone", "cars": [1]}]


@pytest.mark.parametrize("border", [0.5, 4.0])
def test_a_border_costs_no_energy_whatever_its_width(border):
    site = SiteParams(zones=(zone(box(8.0, 200.0), 1.4),), border=border)
    params = make_train(1, speed=18.0, derailed=all_trucks(1), ground=FLAT)
    runs = [PlanarSimulation(p) for p in (replace(params, site=site), params)]
    outcomes = [run.run() for run in runs]
    assert outcomes[0].energy_residual < 1e-4
    # at the tolerance of every day, and few more steps than without a border
    assert outcomes[0].steps < 2.0 * outcomes[1].steps
    assert runs[0].sample().q[0, 0] == pytest.approx(8.0 + (162.0 / GRAVITY - 4.8) / 1.4, abs=0.02)


def test_the_last_of_overlapping_zones_counts():
    ice = zone(box(-100.0, 300.0), 0.1, "ice")
    sand = zone(box(8.0, 300.0), 0.9, "sand")
    run = sliding(SiteParams(zones=(ice, sand)), speed=14.0)
    run.run()
    assert run.sample().q[0, 0] == pytest.approx(8.0 + (98.0 / GRAVITY - 0.8) / 0.9, abs=0.02)


def test_a_car_slides_up_a_slope():
    mu, rise, at, v = 0.6, 0.4, 8.0, 16.0
    up = zone(box(at, 200.0), mu, rise=(rise, 0.0))
    run = sliding(SiteParams(zones=(up,)), speed=v)
    outcome = run.run()
    beyond = (0.5 * v * v / GRAVITY - mu * at) / (mu + rise)
    assert run.sample().q[0, 0] == pytest.approx(at + beyond, abs=0.01)
    assert outcome.energy["slopes"] == pytest.approx(MASS * GRAVITY * rise * beyond, rel=1e-3)
    assert outcome.energy_residual < 1e-6


def test_without_friction_a_berm_gives_all_of_it_back():
    rise, v = 0.5, 10.0
    bank = GroundZone("berm", box(10.0, 100.0), 0.0, 0.0, 0.01, 0.0, rise=(rise, 0.0))
    run = free(SiteParams(zones=(bank,)), v, time_limit=9.0)
    outcome = run.run()
    top = 10.0 + 0.5 * v * v / (GRAVITY * rise)
    assert top > 10.0 + HALF  # all of the car has been up
    assert run.sample().v[0, 0] == pytest.approx(-v, rel=1e-4)
    assert abs(outcome.energy["slopes"]) < 1e-4 * outcome.energy["initial"]


def test_a_rigid_wall_takes_momentum_and_energy_as_in_one_dimension():
    v = 6.0
    wall = FixedBody("wall", ((15.0, -30.0), (15.0, 30.0)))
    run = free(SiteParams(fixed=(wall,)), v)
    times = [0.0]
    impulse = 0.0
    last = 0.0
    while not run.ended:
        run.advance_steps(1)
        for t in np.linspace(run.previous_time, run.time, 9)[1:]:
            now = run.sample(t).collision_force[0, 0]
            impulse += 0.5 * (now + last) * (t - times[-1])
            times.append(t)
            last = now
    outcome = run.outcome()
    rebound, deepest, peak = head_on(v, LAW.force_max)
    speed = run.sample().v[0]
    assert speed[0] == pytest.approx(-rebound, rel=1e-4)
    assert speed[1] == pytest.approx(0.0, abs=1e-9)
    assert impulse == pytest.approx(-MASS * (v + rebound), rel=1e-4)
    (struck,) = outcome.site.fixed
    assert struck.struck_by == (1,)
    assert struck.force == pytest.approx(peak, rel=5e-3)
    assert struck.energy == pytest.approx(0.5 * MASS * (v * v - rebound**2), rel=5e-3)
    lost = 0.5 * MASS * (v * v - rebound**2)
    assert outcome.energy["fixed_bodies"] == pytest.approx(lost, rel=1e-3)
    assert outcome.energy_residual < 1e-6
    (blow,) = run.collisions
    assert (blow.car_a, blow.car_b, blow.object) == (1, 0, "wall")
    assert blow.x == pytest.approx(15.0, abs=0.2) and blow.closing_speed == pytest.approx(
        v, rel=0.02
    )
    assert (blow.normal_x, blow.normal_y) == pytest.approx((-1.0, 0.0))
    assert blow.energy_lost == pytest.approx(struck.energy, rel=1e-2)
    assert outcome.peak_force == 0.0  # between cars


def test_a_yielding_wall_is_pushed_in_and_stays_there():
    v, most = 8.0, 0.4e6
    wall = FixedBody("wall", ((15.0, -30.0), (15.0, 30.0)), force=most)
    run = free(SiteParams(fixed=(wall,)), v)
    deepest = 0.0
    while not run.ended:
        run.advance_steps(1)
        deepest = max(deepest, run.sample().q[0, 0] + HALF - 15.0)
    rebound, place, peak = head_on(v, most, most)
    # closed form: past the wall's line both corners push with the wall's force
    before = quad(lambda x: 2.0 * most * min(1.0, 0.5 ** ((x / 0.08) ** 2) * 3.0), 0.0, 0.8)[0]
    assert deepest == pytest.approx((0.5 * MASS * v * v - before) / (2.0 * most), abs=0.02)
    assert deepest == pytest.approx(-place, rel=1e-3)
    assert run.sample().v[0, 0] == pytest.approx(-rebound, rel=2e-2)
    assert rebound < 0.2 * v
    (struck,) = run.outcome().site.fixed
    assert struck.force == pytest.approx(most) == peak
    assert struck.energy == pytest.approx(0.5 * MASS * (v * v - rebound**2), rel=2e-3)


def test_a_wall_gives_way_when_it_has_taken_its_energy():
    v, energy = 12.0, 1.0e6
    wall = FixedBody("fence", ((15.0, -30.0), (15.0, 30.0)), force=0.5e6, energy=energy)
    run = free(SiteParams(fixed=(wall,)), v)
    outcome = run.run()
    (struck,) = outcome.site.fixed
    assert struck.given_way == 1
    # it goes at the end of a step, in which a corner moves 0.16 m at most
    assert energy <= struck.energy < energy + 2.0 * 0.16 * 0.5e6
    left = math.sqrt(v * v - 2.0 * struck.energy / MASS)
    assert run.sample().v[0, 0] == pytest.approx(left, rel=1e-3)
    assert run.sample().q[0, 0] > 15.0 + HALF
    # only the segment that was struck gives way
    chain = FixedBody("fence", ((15.0, -60.0), (15.0, -20.0), (15.0, 20.0)), False, 0.5e6, energy)
    assert free(SiteParams(fixed=(chain,)), v).run().site.fixed[0].given_way == 1


@pytest.mark.parametrize("angle", [0.0, 0.7, 2.3])
def test_the_corners_of_a_pier_push_the_side_of_a_car(angle):
    c, s = math.cos(angle), math.sin(angle)
    turn = np.array([[c, s], [-s, c]])
    square = np.array([(-2.0, 34.0), (2.0, 34.0), (2.0, 38.0), (-2.0, 38.0)])
    pier = FixedBody("pier", tuple(map(tuple, square @ turn)), closed=True)
    params = replace(free_train(1, speed=0.1), site=SiteParams(fixed=(pier,)))
    params = with_integration(tight(params, 1e-8), time_limit=3.0)
    q = [[*((0.0, 30.0) @ turn), angle, angle, angle]]
    run = start(params, q, [[-s * 5.0, c * 5.0, 0.0, 0.0, 0.0]])
    run.run()
    rebound, _, _ = head_on(5.0, LAW.force_max)
    v = run.sample().v[0]
    assert v[0] == pytest.approx(s * rebound, abs=2e-4 * rebound)
    assert v[1] == pytest.approx(-c * rebound, abs=2e-4 * rebound)
    assert v[2] == pytest.approx(0.0, abs=1e-6)


def test_a_wall_is_the_same_from_either_side_and_however_it_is_divided():
    ends = ((20.0, -30.0), (26.0, 30.0))
    middle = tuple(np.add(ends[0], k / 7 * np.subtract(ends[1], ends[0])) for k in range(8))
    results = []
    for outline in (ends, ends[::-1], tuple(map(tuple, middle))):
        run = free(SiteParams(fixed=(FixedBody("wall", outline),)), 9.0)
        run.run()
        results.append(np.concatenate([run.sample().q[0], run.sample().v[0]]))
    assert results[1] == pytest.approx(results[0], abs=1e-6)
    assert results[2] == pytest.approx(results[0], abs=1e-6)
    assert abs(results[0][7]) > 0.02  # it was turned


def test_a_car_passes_beside_the_end_of_a_wall_and_is_pushed_by_it():
    wall = FixedBody("wall", ((20.0, 1.5), (20.0, 30.0)))
    run = free(SiteParams(fixed=(wall,)), 8.0)
    run.run()
    q, v = run.sample().q[0], run.sample().v[0]
    assert q[0] > 20.0 and v[1] < 0.0
    assert run.outcome().energy_residual < 1e-5


def test_areas_tell_who_was_there_and_who_stays():
    v = 12.0
    stop = 0.5 * v * v / (0.6 * GRAVITY)
    areas = (
        Area("passed", ((8.0, -50.0), (8.0, 50.0)), closed=False),
        Area("left again", box(-6.9, -6.5)),
        Area("reached", box(stop - 2.0, stop + 100.0)),
        Area("never", box(stop + HALF + 0.1, stop + 100.0)),
        Area("beside", box(-30.0, 60.0, 1.4, 9.0)),
    )
    outcome = sliding(SiteParams(areas=areas), v).run()
    assert outcome.site.record()["inside"] == [
        {"name": "passed", "cars_ever": [1], "cars_at_rest": [1]},
        {"name": "left again", "cars_ever": [1], "cars_at_rest": []},
        {"name": "reached", "cars_ever": [1], "cars_at_rest": [1]},
        {"name": "never", "cars_ever": [], "cars_at_rest": []},
        {"name": "beside", "cars_ever": [], "cars_at_rest": []},
    ]


def wreck(site):
    """Ten cars that run into a break, with what stands beside the track."""
    push = (LateralForce(force=50e3),)
    params = make_train(
        10, speed=20.0, derailed=all_trucks(1), breaks=(8.0,), lateral=push, ground=GroundParams()
    )
    return PlanarSimulation(replace(params, site=site))


SCENE = SiteParams(
    zones=(
        zone(box(20.0, 200.0, 0.0, 60.0), 1.2, "mud", rise=(0.0, 0.2)),
        zone(box(40.0, 200.0, -60.0, 0.0), 0.4, "pavement"),
    ),
    fixed=(
        FixedBody("wall", ((10.0, 4.0), (60.0, 4.5), (120.0, 7.0)), force=2e6),
        FixedBody("pier", box(70.0, 72.0, -6.0, -4.0), closed=True),
    ),
    areas=(Area("road", box(0.0, 60.0, 1.5, 4.0)),),
)


def test_a_wreck_among_walls_and_zones_closes_its_ledger_and_goes_on_from_saved_states():
    run = wreck(SCENE)
    run.advance_to(2.5)
    other = PlanarSimulation.from_bytes(run.to_bytes())
    outcome = run.run()
    other.run()
    assert same_run(run, other)
    assert outcome.status == "at rest"
    assert outcome.energy_residual < 5e-4
    assert {s.name for s in outcome.site.fixed if s.struck_by} >= {"wall"}
    assert outcome.site.inside[0].ever


def test_ground_like_that_around_it_changes_nothing():
    same = GroundParams()
    like = GroundZone("like", box(-50.0, 500.0), same.c_s, same.c_d, same.eps, same.c_v)
    far = FixedBody("far", ((0.0, 300.0), (9.0, 300.0)))
    a = wreck(SiteParams())
    b = wreck(SiteParams(zones=(like,), fixed=(far,)))
    for run in (a, b):
        run.advance_to(1.0)
    assert b.step_count == a.step_count
    assert b.sample().q == pytest.approx(a.sample().q, abs=1e-9)
    assert a.outcome().site is None


@pytest.mark.parametrize(
    ("site", "field"),
    [
        (SiteParams(zones=(zone(((0, 0), (1, 0))),)), "site.zones.0.outline"),
        (SiteParams(zones=(zone(box(0, 1)), zone(box(2, 3)))), "site.zones.1.name"),
        (SiteParams(zones=(zone(box(0, math.inf)),)), "site.zones.0.outline.1"),
        (SiteParams(zones=(zone(box(0, 1), -1.0),)), "site.zones.0.c_s"),
        (SiteParams(fixed=(FixedBody("a", ((0, 9), (0, 9))),)), "site.fixed.0.outline.1"),
        (SiteParams(fixed=(FixedBody("a", ((0, 9), (1, 9)), force=0),)), "site.fixed.0.force"),
        (SiteParams(fixed=(FixedBody("a", ((-20, -9), (9, 9))),)), "site.fixed.0"),
        (SiteParams(border=0.0), "site.border"),
    ],
)
def test_a_place_that_cannot_be_is_refused(site, field):
    with pytest.raises(ParameterError) as error:
        PlanarSimulation(replace(make_train((make_car(0), make_car(1))), site=site))
    assert error.value.field == field
