"""Orders of convergence of the integrators and of the interpolation between steps."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from derail_ros.engine import PlanarSimulation, layout
from derail_ros.engine.interpolation import hermite
from derail_ros.engine.methods import METHODS
from derail_ros.engine.neighbours import rebuild
from derail_ros.vocabulary.params import GroundParams, LateralForce
from tests.engine.support import (
    NO_CONTACT,
    fixed_steps,
    free_train,
    kicked,
    make_train,
    mixed_cars,
    propose,
    start,
    steps_of,
    tight,
    with_integration,
)

ORDER = {"rkf45": 5, "row": 4}

# friction without a kink at the speeds of these runs: its damping is part of the implicit method
SMOOTH_GROUND = GroundParams(c_s=0.5, c_d=0.5, eps=0.5, c_v=0.1)


def smooth_train(end, ground, **options):
    """Four cars, swinging within the first stiffness of their strikers; a step ends at ``end``."""
    mark = LateralForce(force=0.0, start=end, duration=1.0)
    return free_train(
        mixed_cars(4), speed=2.0, ground=ground, lateral=(mark,), contact=NO_CONTACT, **options
    )


def slope(steps, errors):
    """Order of convergence by least squares."""
    return np.polyfit(np.log(steps), np.log(errors), 1)[0]


def test_every_method_has_an_expected_order():
    assert set(ORDER) == set(METHODS)


@pytest.mark.parametrize("stabilization", ["projection", "baumgarte"])
@pytest.mark.parametrize("scale", [0.0, 1.0])
@pytest.mark.parametrize("method", ORDER)
def test_order_of_the_integrator(method, scale, stabilization):
    end = 0.4
    ground = GroundParams(**{**vars(SMOOTH_GROUND), "scale": scale})
    params = with_integration(smooth_train(end, ground), stabilization=stabilization)

    def final(params):
        run = kicked(params, seed=1)
        propose(run, params.integration.max_step)
        run.advance_to(end)
        assert run.time == end
        s = run.sample()
        assert np.abs(s.knuckle_moment).max() == 0.0
        return np.concatenate([s.q, s.v])

    exact = final(fixed_steps(with_integration(params, method="rkf45"), 2e-4))
    steps = end / np.array([32, 45, 64, 90])
    errors = []
    for h in steps:
        errors.append(np.abs(final(fixed_steps(with_integration(params, method=method), h))
                             - exact).max())  # fmt: skip
    assert errors[0] > 100 * 1e-11
    assert slope(steps, errors) == pytest.approx(ORDER[method], abs=0.35), errors


@pytest.mark.parametrize("method", ORDER)
def test_error_follows_the_tolerance(method):
    end = 0.4
    params = with_integration(smooth_train(end, SMOOTH_GROUND), method=method)

    def final(params):
        run = kicked(params, seed=1)
        run.advance_to(end)
        return run.sample().q, run.step_count

    exact, _ = final(tight(with_integration(params, method="rkf45"), 1e-12))
    errors, steps = [], []
    for rtol in (1e-4, 1e-6, 1e-8):
        q, count = final(with_integration(params, rtol=rtol))
        errors.append(np.abs(q - exact).max())
        steps.append(count)
    # each hundredth of the tolerance gives between a tenth and a thousandth of the error
    ratios = np.array(errors[:-1]) / errors[1:]
    assert np.all((ratios > 10.0) & (ratios < 1000.0)), errors
    assert errors[0] < 1e-2
    assert steps == sorted(steps)
    assert steps[0] < steps[-1]


# Between steps ---------------------------------------------------------------------------------


def test_hermite_of_a_quintic_is_exact():
    rng = np.random.default_rng(0)
    for _ in range(20):
        p = np.polynomial.Polynomial(rng.normal(size=6))
        v, a = p.deriv(), p.deriv(2)
        h = rng.uniform(0.01, 2.0)
        t = 0.3
        for x in (0.0, 0.2, 0.5, 0.9, 1.0):
            got = hermite(x, h, p(t), v(t), a(t), p(t + h), v(t + h), a(t + h))
            want = [f(t + x * h) for f in (p, v, a)]
            assert got == pytest.approx(want, rel=1e-7, abs=1e-7)


@settings(deadline=None, max_examples=100, derandomize=True)
@given(st.floats(1e-4, 0.2), *[st.floats(-50.0, 50.0)] * 6)
def test_hermite_meets_both_ends(h, q0, v0, a0, dq, v1, a1):
    q1 = q0 + h * dq
    scale = 1.0 + max(abs(q0), abs(v0), abs(a0), abs(dq), abs(v1), abs(a1))
    left, right = (hermite(x, h, q0, v0, a0, q1, v1, a1) for x in (0.0, 1.0))
    assert left == (q0, v0, a0)
    assert right[0] == pytest.approx(q1, abs=1e-12 * scale)
    assert right[1] == pytest.approx(v1, abs=1e-11 * scale / h)
    assert right[2] == pytest.approx(a1, abs=1e-10 * scale / h**2)


def test_hermite_orders():
    errors = []
    steps = [0.4, 0.2, 0.1]
    for h in steps:
        got = hermite(
            0.4, h, math.sin(1), math.cos(1), -math.sin(1),
            math.sin(1 + h), math.cos(1 + h), -math.sin(1 + h),
        )  # fmt: skip
        t = 1 + 0.4 * h
        errors.append(np.abs(np.array(got) - [math.sin(t), math.cos(t), -math.sin(t)]))
    orders = [slope(steps, e) for e in np.transpose(errors)]
    assert orders == pytest.approx([6.0, 5.0, 4.0], abs=0.3)


def test_order_of_the_interpolation_in_a_run():
    params = tight(smooth_train(9.0, SMOOTH_GROUND), 1e-1, max_step=0.1, method="rkf45")
    exact = with_integration(params, rtol=1e-12, max_step=1e-3)
    steps = np.array([0.02, 0.014, 0.01, 0.007])
    names = ("striker_dampers", "ground_trucks")
    rows = []
    for h in steps:
        run = propose(kicked(params, seed=1), h)
        run.advance_steps(1)
        assert run.step_size == pytest.approx(h)
        t = 0.37 * h
        reference = propose(kicked(exact, seed=1), 1e-4)
        for _ in steps_of(reference, t):
            pass
        got, want = run.sample(t), reference.sample(t)
        rows.append([np.abs(getattr(got, k) - getattr(want, k)).max() for k in ("q", "v", "a")])
        rows[-1] += [abs(got.energy[name] - want.energy[name]) for name in names]
    orders = [slope(steps, e) for e in np.transpose(rows)]
    assert orders[0] > 5.5
    assert orders[1] > 4.6
    assert orders[2] > 3.6
    assert min(orders[3:]) > 3.6


def test_samples_at_both_ends_of_a_step_are_its_ends():
    run = kicked(smooth_train(9.0, SMOOTH_GROUND), seed=1)
    run.advance_steps(3)
    before = run.sample()
    run.advance_steps(1)
    again = run.sample(run.previous_time)
    after, end = run.sample(np.nextafter(run.time, 0.0)), run.sample()
    for name in ("q", "v", "a", "coupler_force", "striker_force", "ground_truck_force"):
        for a, b in ((again, before), (after, end)):
            got, want = getattr(a, name), getattr(b, name)
            assert got == pytest.approx(want, rel=1e-9, abs=1e-9 * (1 + np.abs(want).max())), name
    with pytest.raises(ValueError, match="outside the last step"):
        run.sample(run.previous_time - 1e-3)
    with pytest.raises(ValueError, match="outside the last step"):
        run.sample(run.time + 1e-3)


def corners_of(run):
    """(N, 4, 2) corners of all cars, as rows of the plane."""
    q = run.sample().q
    c, s = np.cos(q[:, 2])[:, None], np.sin(q[:, 2])[:, None]
    u, w = [
        np.array([[m * getattr(car, name) / 2 for m in signs] for car in run.params.cars])
        for name, signs in (("length", (1, 1, -1, -1)), ("width", (1, -1, 1, -1)))
    ]
    return np.stack([q[:, :1] + c * u - s * w, q[:, 1:2] + s * u + c * w], axis=2)


def seen_from(run, points):
    """(N, N, 4, 2) corners of each car (second index) as each car (first) sees them, m."""
    q = run.sample().q
    c, s = (f(q[:, 2])[:, None, None] for f in (np.cos, np.sin))
    d = points[None] - q[:, None, None, :2]
    return np.stack([c * d[..., 0] + s * d[..., 1], c * d[..., 1] - s * d[..., 0]], axis=-1)


@pytest.mark.parametrize("method", ORDER)
def test_no_corner_moves_further_than_its_share_of_the_buffer(method):
    params = with_integration(
        make_train(6, speed=30.0, derailed=((1, "front"), (1, "rear")), breaks=(0.0,),
                   lateral=(LateralForce(),)), method=method,
    )  # fmt: skip
    run = kicked(params, seed=2)
    last = corners_of(run)
    farthest = 0.0
    for _ in steps_of(run, 3.0):
        now = corners_of(run)
        farthest = max(farthest, np.hypot(*np.moveaxis(now - last, 2, 0)).max())
        last = now
    # the speed at the step's beginning decides: braking or a push change it a little
    assert 0.1 < farthest < 0.2 * 0.8 * 1.02


@pytest.mark.parametrize("method", ORDER)
def test_no_corner_passes_its_share_of_the_buffer_near_another_body(method):
    params = free_train(2, speed=0.0, parted=(1,))
    q = np.zeros((2, 5))
    v = np.zeros((2, 5))
    # a car comes from 13 m away, and turns; the other one has stood still
    q[1] = (-30.0, 1.0, 0.2, 0.2, 0.2)
    v[1] = (15.0, 0.0, 0.3, 0.3, 0.3)
    run = start(with_integration(params, method=method), q, v)
    half = np.array([(car.length / 2, car.width / 2) for car in params.cars])[:, None, None]
    near = ~np.eye(2, dtype=bool)[:, :, None]
    last = seen_from(run, corners_of(run))
    farthest = 0.0
    for _ in steps_of(run, 3.0):
        now = seen_from(run, corners_of(run))
        gap = np.max(np.abs(last) - half, axis=-1)
        moved = np.hypot(*np.moveaxis(now - last, -1, 0))
        # further away than half of the buffer a corner may come as much closer
        moved -= np.maximum(gap - 0.5 * 0.8, 0.0)
        farthest = max(farthest, moved[near.repeat(4, 2)].max())
        last = now
    # the speed at the step's beginning decides: braking or a push change it a little
    assert 0.1 < farthest < 0.2 * 0.8 * 1.02
    assert run.collisions


def test_a_train_that_moves_as_one_takes_the_longest_steps():
    run = PlanarSimulation(make_train(6, speed=30.0))
    run.advance_to(2.0)
    assert run.step_size == pytest.approx(run.params.integration.max_step)
    assert run.statistics["limited_by_cap"] == 0


def test_no_pair_that_touches_is_left_out():
    """The pairs that a step has looked at give the forces that all pairs of the train give."""
    rng = np.random.default_rng(3)
    q, v = np.zeros((2, 9, 5))
    for i in range(9):  # free cars, thrown together
        row, column = i // 3 - 1, i % 3 - 1
        q[i] = (18.0 * row, 4.0 * column, *[rng.normal(0.0, 0.05)] * 3)
        v[i] = (-6.0 * row, -3.0 * column, *[rng.normal(0.0, 0.3)] * 3)
    params = free_train(9, speed=0.0, parted=range(1, 9), ground=GroundParams())
    run = start(params, q, v)
    touched = 0
    for _ in steps_of(run, 3.0):
        own = run._state.power[layout.E_COLLISION]
        other = run.copy()
        other._state.built[:] = np.nan
        other._state.cnt["pairs"] = 0
        other._grow_until(rebuild(other._model, other._state, other._work))
        other._state.mask[...] = 0
        for p, (i, j) in enumerate(other._state.pairs[: other._state.cnt["pairs"][0]]):
            mine = np.flatnonzero((run._state.pairs == (i, j)).all(axis=1))
            if len(mine):
                other._state.mask[p] = run._state.mask[mine[0]]
        other._evaluate()
        assert other._state.power[layout.E_COLLISION] == pytest.approx(own, rel=1e-9, abs=1e-3)
        touched += own != 0.0
    assert touched > 20
