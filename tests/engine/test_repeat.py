"""The same run to the bit, whatever is done with it on the way."""

import hashlib
import os
import subprocess
import sys
import textwrap
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from derail_ros.engine import PlanarSimulation
from derail_ros.engine.methods import METHODS
from derail_ros.vocabulary.errors import CommandError
from derail_ros.vocabulary.events import Command
from derail_ros.vocabulary.params import BrakeParams, BrakeTrigger, LateralForce
from tests.engine.support import CURVE, make_train, mixed_cars, same_run, with_integration


def same(a, b):
    """Whether two attributes of samples are equal to the bit."""
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    return np.array_equal(a, b, equal_nan=True)


def lively(method="rkf45", force=50e3):
    """Derailments by breaks and by lateral force, parted couplings, pile-up, vented brakes."""
    params = make_train(
        mixed_cars(16),
        speed=22.0,
        position=320.0,
        derailed=((1, "front"), (1, "rear")),
        breaks=(318.0, 300.0),
        lateral=(LateralForce(force=force),),
        track=CURVE,
        brakes=BrakeParams(vent_on_parting=True, triggers=(BrakeTrigger(time=0.5),)),
    )
    return with_integration(params, method=method, time_limit=9.0)


@cache
def finished(method="rkf45"):
    """The undisturbed run, advanced in one go."""
    run = PlanarSimulation(lively(method))
    run.run()
    return run


pytestmark = pytest.mark.parametrize("method", METHODS)


def test_the_run_is_lively(method):
    run = finished(method)
    assert len(run.collisions) > 8
    causes = {e.cause for e in run.events if e.end}
    assert {"initial", "rail break"} <= causes
    assert any(e.cause == "angle" for e in run.events)
    assert any(e.cause == "vented" for e in run.events)
    assert 2 * 16 > len(run.outcome().derailed_cars) > 5


def test_twice(method):
    run = PlanarSimulation(lively(method))
    run.run()
    assert same_run(run, finished(method))


def test_another_force_gives_another_run(method):
    run = PlanarSimulation(lively(method, 50.001e3))
    run.run()
    assert not same_run(run, finished(method))
    assert run.state_hash() != finished(method).state_hash()


@pytest.mark.parametrize("interval", [0.01, 0.1, 1.7])
def test_any_output_rate(method, interval):
    run = PlanarSimulation(lively(method))
    rng = np.random.default_rng(1)
    heard = list(run.events)
    t = 0.0
    while not run.ended:
        t += interval
        heard += run.advance_to(t)
        # looking at it changes nothing
        at = run.previous_time + rng.random() * run.step_size
        run.sample(at)
        run.sample()
        run.outcome()
        run.new_collisions()
        run.state_hash()
    assert same_run(run, finished(method))
    assert repr(heard) == repr(run.events)


def test_samples_do_not_depend_on_the_output_rate(method):
    slow, fast = PlanarSimulation(lively(method)), PlanarSimulation(lively(method))
    for t in (0.5, 1.3, 2.9, 4.4):
        slow.advance_to(t)
        while fast.time < t:
            fast.advance_steps(1)
            fast.sample()
        a, b = slow.sample(t), fast.sample(t)
        for name in vars(a):
            assert same(getattr(a, name), getattr(b, name)), name


def test_step_by_step(method):
    run = PlanarSimulation(lively(method))
    for n in (1, 2, 3, 500):
        run.advance_steps(n)
    while not run.ended:
        run.advance_steps(7)
    assert same_run(run, finished(method))


def test_save_and_load_in_the_middle(method):
    run = PlanarSimulation(lively(method))
    for t in (0.0, 0.7, 2.6, 3.7, 8.0):
        run.advance_to(t)
        data = run.to_bytes()
        loaded = PlanarSimulation.from_bytes(data)
        assert same_run(loaded, run)
        assert loaded.params == run.params
        assert loaded.commands == run.commands
        assert loaded.to_bytes() == data
        if t in (0.7, 3.7):
            loaded.run()
            assert same_run(loaded, finished(method)), t
    # and a chain of loadings
    run = PlanarSimulation(lively(method))
    while not run.ended:
        run.advance_to(run.time + 2.2)
        run = PlanarSimulation.from_bytes(run.to_bytes())
    assert same_run(run, finished(method))


def test_load_and_go_on_whatever_the_masses(method):
    # implicit steps change the inverse masses: what they leave behind must be what loading makes
    random = np.random.default_rng(5)
    cars = [
        replace(car, mass=car.mass * factor, inertia=car.inertia * factor)
        for car, factor in zip(mixed_cars(12), random.uniform(0.3, 1.4, 12), strict=True)
    ]
    params = make_train(
        cars,
        speed=15.0,
        breaks=(-20.0,),
        triggers=(BrakeTrigger(),),
        # wakes the train when it is nearly at rest: explicit steps after implicit ones
        lateral=(LateralForce(car=3, force=2e6, start=4.6, duration=0.3),),
    )
    run = PlanarSimulation(with_integration(params, method=method, time_limit=20.0))
    while not run.ended:
        run.advance_steps(7)
        loaded = PlanarSimulation.from_bytes(run.to_bytes())
        run.advance_steps(1)
        loaded.advance_steps(1)
        assert loaded.state_hash() == run.state_hash()
    assert run.outcome().cars_derailed > 3


def test_samples_after_loading(method):
    run = PlanarSimulation(lively(method))
    run.advance_to(2.7)
    loaded = PlanarSimulation.from_bytes(run.to_bytes())
    for t in (run.previous_time, 0.5 * (run.previous_time + run.time), run.time):
        a, b = run.sample(t), loaded.sample(t)
        for name in vars(a):
            assert same(getattr(a, name), getattr(b, name)), name


def test_copies_are_independent(method):
    run = PlanarSimulation(lively(method))
    run.advance_to(2.0)
    at_two = run.state_hash()
    copy = run.copy()
    assert same_run(copy, run)
    copy.inject_rail_break(car=12)
    copy.advance_to(4.0)
    assert run.state_hash() == at_two
    assert len(run.commands) == 0
    other = run.copy()
    run.run()
    assert same_run(run, finished(method))
    assert other.state_hash() == at_two
    other.run()
    assert same_run(other, finished(method))
    copy.run()
    assert not same_run(copy, run)


def test_replay_of_the_command_log(method):
    params = replace(lively(method), brakes=BrakeParams(triggers=()))
    run = PlanarSimulation(params)
    run.advance_to(0.4)
    run.trigger_emergency_brake()
    run.advance_to(0.9)
    run.inject_rail_break(car=9)
    run.inject_rail_break(coordinate=180.0)
    run.trigger_emergency_brake("instant", "car", 12, delay=0.35)
    run.advance_steps(40)
    run.trigger_emergency_brake("traction_limited", "both_ends")
    run.run()
    replay = PlanarSimulation(params)
    for command in run.commands:
        replay.apply(command)
    replay.run()
    assert len(run.commands) == 5
    assert replay.commands == run.commands
    assert same_run(replay, run)
    untouched = PlanarSimulation(params)
    untouched.run()
    assert not same_run(untouched, run)


def test_a_command_logged_for_a_past_step_is_refused(method):
    run = PlanarSimulation(lively(method))
    run.advance_to(1.0)
    before = run.state_hash()
    for command in (Command("inject_rail_break", {"coordinate": 0.0, "car": 0}, step=3),
                    Command("derail", {}, step=run.step_count)):  # fmt: skip
        with pytest.raises(CommandError):
            run.apply(command)
    assert run.state_hash() == before


def test_runs_in_threads(method):
    def play(_):
        run = PlanarSimulation(lively(method))
        while not run.ended:
            run.advance_to(run.time + 0.2)
        return run

    with ThreadPoolExecutor(4) as pool:
        runs = list(pool.map(play, range(4)))
    assert all(same_run(run, finished(method)) for run in runs)


def test_in_another_process(method):
    code = f"""
        import hashlib
        from derail_ros.engine import PlanarSimulation
        from tests.engine.test_repeat import lively
        run = PlanarSimulation(lively({method!r}))
        run.run()
        print(run.state_hash(), hashlib.sha256(repr(run.events).encode()).hexdigest())
    """
    environment = {
        **os.environ,
        "PYTHONHASHSEED": "12345",
        "PYTHONPATH": os.pathsep.join(sys.path),
    }
    out = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)],
        env=environment, capture_output=True, text=True, check=True, timeout=250,
    ).stdout.split()  # fmt: skip
    run = finished(method)
    assert out == [run.state_hash(), hashlib.sha256(repr(run.events).encode()).hexdigest()]
