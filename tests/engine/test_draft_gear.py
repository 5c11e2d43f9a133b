"""Draft gear, and couplings that break: against closed forms; energy closes."""

import math
from dataclasses import replace

import numpy as np
import pytest

from derail_ros.engine import PlanarSimulation
from derail_ros.vocabulary.errors import ParameterError
from derail_ros.vocabulary.params import (
    BrakeParams,
    BrakeTrigger,
    CouplingParams,
    DraftGearParams,
    GradeChange,
    Notch,
    TrackParams,
    TractionParams,
    WeakCoupling,
)
from tests.engine.support import CURVE, make_car, make_train, start, tight, with_integration

NONE = BrakeParams(triggers=())
M, K = 100e3, 12e6
LINEAR = DraftGearParams(
    on=True, slack=0.0, preload=0.0, stiffness=K, unloading=1.0, solid=0.0, start=0.0
)


def geared(n, gear=LINEAR, speed=0.0, couplings=None, **options):
    """A train with draft gear."""
    options.setdefault("brakes", NONE)
    rows = tuple(make_car(i, mass=M) for i in range(n))
    params = make_train(rows, speed=speed, **options)
    return replace(params, couplings=couplings or CouplingParams(gear=gear))


def moving(params, velocities):
    """The run with each car at a speed of its own."""
    v = np.zeros((len(params.cars), 5))
    v[:, 0] = velocities
    return start(params, v=v)


@pytest.mark.parametrize("mode", [1, 2, 5])
def test_natural_frequencies_of_a_chain(mode):
    # free at both ends: 2 sqrt(k / m) sin(j pi / 2 N)
    n = 6
    shape = np.cos(mode * math.pi * (np.arange(n) + 0.5) / n)
    omega = 2.0 * math.sqrt(K / M) * math.sin(0.5 * mode * math.pi / n)
    params = tight(geared(n), 1e-9, max_step=0.01)
    run = moving(params, 0.05 * shape)
    home = run.sample().q[:, 0]
    for share in (0.25, 0.5, 1.0, 2.25):
        run.advance_to(share * 2.0 * math.pi / omega)
        s = run.sample()
        phase = omega * s.time
        assert s.v[:, 0] == pytest.approx(0.05 * shape * math.cos(phase), abs=2e-5)
        expected = 0.05 / omega * shape * math.sin(phase)
        assert s.q[:, 0] - home == pytest.approx(expected, abs=2e-6)
    assert run.outcome().energy_residual < 1e-6


def closing(gear, v, method="rkf45"):
    """Two cars run together: peak buff, speeds after, when it begins."""
    params = with_integration(geared(2, gear), method=method, rtol=1e-7, max_step=2e-3,
                              time_limit=3.0)  # fmt: skip
    run = moving(params, [0.0, v])
    touched = None
    while run.time < 1.0:
        run.advance_steps(1)
        if touched is None and run.sample().axial_force[0] < 0.0:
            touched = run.time
        s = run.sample()
        if touched and s.axial_force[0] == 0.0 and s.v[0, 0] > s.v[1, 0]:
            break
    return run, touched


def test_two_cars_meet_over_their_slack():
    # without friction: half the slack at v, then half a period of sqrt(k / mu); speeds exchanged
    v, slack = 0.6, 0.05
    gear = replace(LINEAR, slack=slack)
    run, touched = closing(gear, v)
    reduced = 0.5 * M
    assert touched == pytest.approx(0.5 * slack / v, abs=3e-3)
    (peak,) = run.outcome().couplings["max_buff_N"]
    assert peak == pytest.approx(v * math.sqrt(K * reduced), rel=1e-3)
    (when,) = run.outcome().couplings["max_buff_time_s"]
    assert when == pytest.approx(
        0.5 * slack / v + 0.5 * math.pi * math.sqrt(reduced / K), abs=5e-3
    )
    s = run.sample()
    assert s.v[:, 0] == pytest.approx([v, 0.0], abs=2e-3)
    assert s.time - touched == pytest.approx(math.pi * math.sqrt(reduced / K), abs=5e-3)


@pytest.mark.parametrize("method", ["rkf45", "row"])
def test_a_friction_gear_gives_back_its_share(method):
    # mu v^2 / 2 = F0 (u - d / 2) + k u^2 / 2 in, r times that out
    v, r, preload = 1.5, 0.25, 200e3
    gear = replace(LINEAR, slack=0.04, unloading=r, preload=preload, transition=1e-3)
    run, _ = closing(gear, v, method)
    energy = 0.5 * (0.5 * M) * v * v
    u = (-preload + math.sqrt(preload**2 + 2.0 * K * (energy + 0.5e-3 * preload))) / K
    (peak,) = run.outcome().couplings["max_buff_N"]
    assert peak == pytest.approx(preload + K * u, rel=0.01)
    back = run.sample().v[0, 0] - run.sample().v[1, 0]
    assert back == pytest.approx(v * math.sqrt(r), rel=0.02)
    lost = run.outcome().energy["draft_gear_friction"]
    assert lost == pytest.approx((1.0 - r) * energy, rel=0.02)
    assert run.outcome().energy_residual < 2e-3


def test_a_solid_gear_is_stiffer():
    soft = replace(LINEAR, travel=0.02)
    hard = replace(soft, solid=200e6)
    peaks = [closing(g, 1.0)[0].outcome().couplings["max_buff_N"][0] for g in (soft, hard)]
    u = 0.02
    rest = 0.25 * M - 0.5 * K * u * u  # mu v^2 / 2 less what the gear has taken to its end
    both = K + 200e6
    beyond = (-K * u + math.sqrt((K * u) ** 2 + 2.0 * both * rest)) / both
    assert peaks[0] == pytest.approx(math.sqrt(0.5 * K * M), rel=1e-3)
    assert peaks[1] == pytest.approx(K * u + both * beyond, rel=5e-3)


def test_a_gear_stands_under_its_load():
    # between its lines a friction gear holds any force without moving
    gear = DraftGearParams(on=True, start=1.0)
    rise = 0.1
    params = geared(6, gear, track=TrackParams(grades=(GradeChange(-math.inf, rise),)))
    first = replace(params.cars[0], mass=5e7)  # holds the others
    held = BrakeParams(force=2e8, triggers=(BrakeTrigger(mode="instant"),))
    params = replace(params, cars=(first, *params.cars[1:]), brakes=held)
    rows = [replace(c, brakes=()) for c in params.cars[1:]]
    params = replace(params, cars=(params.cars[0], *rows))
    run = PlanarSimulation(with_integration(params, time_limit=40.0, rest_speed=1e-9))
    forces, travels = [], []
    for t in np.arange(0.05, 39.0, 0.05):
        run.advance_to(t)
        s = run.sample(t)
        forces.append(s.axial_force)
        travels.append(s.couplings["draft_gear_travel_m"])
    # between the lines the gear is elastic: what is left is a small oscillation about the load
    half = len(forces) // 2
    load = [j * M * 9.81 * rise for j in (5, 4, 3, 2, 1)]
    assert np.mean(forces[half:], axis=0) == pytest.approx(load, rel=0.01)
    early, late = (
        np.mean(travels[half : -half // 2], axis=0),
        np.mean(travels[-half // 2 :], axis=0),
    )
    assert late == pytest.approx(early, abs=0.5e-3)
    assert late.min() > 0.025


def test_the_lateral_constraint_stays():
    params = geared(8, DraftGearParams(on=True), speed=12.0, position=30.0, track=CURVE)
    params = replace(params, brakes=BrakeParams(triggers=(BrakeTrigger(mode="instant"),)))
    run = PlanarSimulation(params)
    outcome = run.run()
    assert outcome.max_coupler_gap < 1e-9
    assert outcome.energy_residual < 1e-3
    assert np.abs(run.sample().couplings["draft_gear_travel_m"]).max() > 0.01


def test_a_chain_off_the_rails_keeps_its_momentum():
    params = geared(5, DraftGearParams(on=True), speed=5.0,
                    derailed=[(i, e) for i in range(1, 6) for e in ("front", "rear")])  # fmt: skip
    params = replace(params, ground=replace(params.ground, scale=0.0))
    run = PlanarSimulation(params)
    v = np.random.default_rng(4).normal(0.0, 0.3, (5, 5)) * [1, 0.05, 0.02, 0.02, 0.02]
    v[:, 0] += 5.0
    from tests.engine.support import project

    run = start(params, v=v)
    run._state.coupling["travel"] = 0.025
    run = project(run)
    before = (M * run.sample().v[:, :2]).sum(axis=0)
    run.advance_to(2.0)
    after = (M * run.sample().v[:, :2]).sum(axis=0)
    assert after == pytest.approx(before, abs=1e-8 * abs(before[0]))
    assert run.outcome().energy_residual < 1e-3


@pytest.mark.parametrize("gear", [DraftGearParams(), DraftGearParams(on=True, start=1.0)])
def test_a_knuckle_breaks_at_its_strength(gear):
    n = 12
    rows = [make_car(i, mass=M) for i in range(n)]
    rows[0] = replace(rows[0], tractive_effort=((0.0, 600e3),))
    couplings = CouplingParams(
        gear=gear, knuckle_strength=2.5e6, weak=(WeakCoupling(4, 300e3, "body"),)
    )
    params = replace(
        make_train(rows, speed=5.0, brakes=BrakeParams(vent_on_parting=True, triggers=())),
        traction=TractionParams(notches=(Notch(1.0, 8),)), couplings=couplings,
    )  # fmt: skip
    run = PlanarSimulation(with_integration(params, time_limit=25.0))
    outcome = run.run()
    (parted,) = outcome.parted
    assert (parted.coupling, parted.cause) == (4, "coupler body broke")
    assert parted.force == pytest.approx(300e3, rel=2e-3)
    assert outcome.couplings["max_draft_N"][3] == pytest.approx(300e3, rel=2e-3)
    (event,) = [e for e in run.events if e.cause == "coupler body broke"]
    assert event.time == parted.time
    assert "the coupler body broke at a tension of 300 kN" in event.text
    if not gear.on:
        # a rigid train: the tension is the pull's share of the cars behind
        pull = 600e3 * (parted.time - 1.0) / params.traction.response_time
        assert pytest.approx(pull * (n - 4) / n, rel=5e-3) == 300e3
    # the brake pipe vents from there
    assert any(e.cause == "vented" for e in run.events)


def test_largest_forces_are_those_of_the_samples():
    params = geared(10, DraftGearParams(on=True), speed=15.0,
                    derailed=((1, "front"), (1, "rear")))  # fmt: skip
    run = PlanarSimulation(params)
    draft, buff = np.zeros(9), np.zeros(9)
    while not run.ended:
        run.advance_steps(1)
        f = run.sample().axial_force
        draft, buff = np.maximum(draft, f), np.maximum(buff, -f)
    found = run.outcome().couplings
    assert found["max_draft_N"] == pytest.approx(draft, rel=1e-9, abs=1e-3)
    assert found["max_buff_N"] == pytest.approx(buff, rel=1e-9, abs=1e-3)
    assert found["max_buff_N"].max() > 100e3
    assert run.sample().couplings["max_buff_N"] == pytest.approx(buff, rel=1e-9, abs=1e-3)


@pytest.mark.parametrize(
    ("field", "couplings"),
    [
        ("couplings.gear.unloading", CouplingParams(gear=replace(LINEAR, unloading=1.5))),
        ("couplings.gear.transition", CouplingParams(gear=replace(LINEAR, transition=0.0))),
        ("couplings.knuckle_strength", CouplingParams(knuckle_strength=-1.0)),
        ("couplings.weak.0.coupling", CouplingParams(weak=(WeakCoupling(3, 1e6),))),
        ("couplings.weak.0.part", CouplingParams(weak=(WeakCoupling(1, 1e6, "sill"),))),
    ],
)
def test_mistakes_name_their_field(field, couplings):
    with pytest.raises(ParameterError) as error:
        PlanarSimulation(geared(3, couplings=couplings))
    assert error.value.field == field
