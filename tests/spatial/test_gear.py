"""Draft gear, breaking couplings, guidance and play in three dimensions."""

import math
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from derail_ros import models
from derail_ros.spatial.simulation import FlatSimulation, SpatialSimulation
from derail_ros.vocabulary.events import EventKind
from derail_ros.vocabulary.params import (
    CouplingParams,
    DerailmentParams,
    DraftGearParams,
    GroundParams,
    IntegrationParams,
    LateralForce,
)
from tests.spatial.test_physics import CAR, OFF, train

K = 12e6
LINEAR = DraftGearParams(
    on=True, slack=0.0, preload=0.0, stiffness=K, unloading=1.0, solid=0.0, start=0.0
)
NEVER = IntegrationParams(rest_hold=60.0)


def geared(n, gear=LINEAR, kind=SpatialSimulation, speed=0.0, **couplings):
    params = train(n, speed=speed, integration=NEVER)
    return kind(replace(params, couplings=CouplingParams(gear=gear, **couplings)))


def moving(run, speeds):
    """Give each car a speed along the track; rear couplers slide as the cars behind move."""
    for i, speed in enumerate(speeds):
        run._data.qvel[int(run._space.body[i]["qvel"])] = speed
        if run.params.couplings.gear.on and i + 1 < len(speeds):
            slide = int(run._space.body[i]["hinge_rear"]) + (1 if run.flat else 2)
            run._data.qvel[slide] = speed - speeds[i + 1]
    mujoco.mj_step1(run._mj, run._data)
    run._evaluate()
    run._space.before[:] = run._space.velocity


def speeds(run):
    return run.sample().velocity[:, 0]


@pytest.mark.parametrize(("kind", "rel"), [(FlatSimulation, 0.01), (SpatialSimulation, 0.04)])
def test_two_cars_meet_over_their_slack(kind, rel):
    # without friction: half the slack at v, then half a period of sqrt(k / mu); speeds exchanged.
    # In space couplers push below the centres of gravity, and the cars pitch on their springs
    v, slack, reduced = 0.6, 0.05, 0.5 * CAR.mass
    run = geared(2, replace(LINEAR, slack=slack), kind)
    moving(run, [0.0, v])
    touched = None
    while run.time < 1.0:
        run.advance_steps(1)
        force = run.sample().axial_force[0]
        if touched is None and force < -1e3:
            touched = run.time
        if touched and force > -1e3 and speeds(run)[0] > speeds(run)[1]:
            break
    assert touched == pytest.approx(0.5 * slack / v, abs=6e-3)
    (peak,) = run.outcome().couplings["max_buff_N"]
    assert peak == pytest.approx(v * math.sqrt(K * reduced), rel=rel)
    assert run.time - touched == pytest.approx(math.pi * math.sqrt(reduced / K), abs=8e-3)
    assert speeds(run) == pytest.approx([v, 0.0], abs=0.02)


def test_a_friction_gear_gives_back_its_share():
    # mu v^2 / 2 = F0 (u - d / 2) + k u^2 / 2 in, r times that out
    v, r, preload, reduced = 1.5, 0.25, 200e3, 0.5 * CAR.mass
    gear = replace(LINEAR, slack=0.04, unloading=r, preload=preload, transition=5e-3)
    run = geared(2, gear, FlatSimulation)
    moving(run, [0.0, v])
    energy = 0.5 * reduced * v * v
    u = (-preload + math.sqrt(preload**2 + 2.0 * K * (energy + 2.5e-3 * preload))) / K
    while run.time < 1.0 and speeds(run)[0] - speeds(run)[1] < 0.98 * v * math.sqrt(r):
        run.advance_steps(1)
    (peak,) = run.outcome().couplings["max_buff_N"]
    assert peak == pytest.approx(preload + K * u, rel=0.03)
    assert run.time < 0.5
    ledger = run.outcome().energy
    assert ledger["draft_gear_friction"] == pytest.approx((1.0 - r) * energy, rel=0.05)


def test_slack_runs_in_car_by_car_as_in_the_plane():
    # a stretched train of six is struck from behind: when each coupling meets, and how hard
    gear = DraftGearParams(on=True)
    runs = [geared(6, gear, FlatSimulation), None]
    params = replace(runs[0].params, model="planar")
    assert runs[0].sample().couplings["draft_gear_travel_m"] == pytest.approx(
        [0.025] * 5, abs=1e-9
    )
    runs[1] = models.build(params)
    moving(runs[0], [0.0] * 5 + [2.0])
    runs[1]._state.v[5, 0] = 2.0
    runs[1]._evaluate()
    told = []
    for run in runs:
        run.advance_to(2.0)
        values = run.outcome().couplings
        told.append((values["max_buff_N"], values["max_buff_time_s"]))
    # friction gears change between their lines within 5 mm: steps of 2 ms see it coarsely
    assert told[0][0] == pytest.approx(told[1][0], rel=0.08)
    assert told[0][1] == pytest.approx(told[1][1], abs=0.02)


def test_a_train_with_draft_gear_keeps_its_energy_and_is_repeated():
    params = train(5, speed=14.0, off=OFF, forces=(LateralForce(50e3),), breaks=(0.0,))
    gear = CouplingParams(gear=DraftGearParams(on=True), knuckle_strength=1.8e6)
    run = SpatialSimulation(replace(params, couplings=gear))
    run.advance_to(0.8)
    saved = run.to_bytes()
    run.advance_to(2.5)
    outcome = run.outcome()
    assert outcome.energy["draft_gear_friction"] > 0.0
    assert outcome.energy_residual < 0.02
    again = SpatialSimulation.from_bytes(saved)
    assert again.to_bytes() == saved
    again.advance_to(2.5)
    assert again.to_bytes() == run.to_bytes()


@pytest.mark.parametrize("on", [False, True])
def test_a_coupling_breaks_by_its_tension(on):
    run = geared(2, DraftGearParams(on=on), knuckle_strength=1.0e6)
    moving(run, [3.0, 0.0])
    run.advance_to(0.6)
    (parted,) = (e for e in run.events if e.kind == EventKind.COUPLER_PARTED)
    assert parted.cause == "knuckle broke" and parted.value >= 1.0e6
    # the coupler goes back into its pocket
    run.advance_to(1.6)
    if on:
        assert np.abs(run.sample().couplings["draft_gear_travel_m"]).max() == 0.0
        assert abs(run._data.qpos[int(run._space.body[0]["hinge_rear"]) + 2 + 1]) < 1e-3


def test_rails_guide_a_derailed_truck_until_they_break():
    ground = GroundParams(c_s=0.01, c_d=0.01, c_v=0.0)
    push = (LateralForce(60e3, place="front", duration=8.0),)
    paths = {}
    for name, strength in (("free", 0.0), ("weak", 20e3), ("strong", 800e3)):
        rules = DerailmentParams(guide_strength=strength)
        params = train(off=((1, "front"),), ground=ground, forces=push, speed=5.0,
                       derailment=rules, integration=NEVER)  # fmt: skip
        run = SpatialSimulation(params)
        run.advance_to(2.0)
        paths[name] = run.sample().pose[0, 1]
        if strength:
            assert run.outcome().energy["guidance"] > 0.0
            assert bool(run._state.loose[0, 0]) is (name == "weak")
    assert paths["strong"] < 0.6 and paths["free"] > 1.0
    assert paths["strong"] < paths["weak"] <= paths["free"]


def test_play_presses_cars_in_buff_sideways():
    # two cars that run together: with play the lateral load rises and the trucks leave earlier
    causes = {}
    for play in (0.0, 0.03):
        params = train(6, derailment=DerailmentParams(truck_play=play, lv_limit=0.05),
                       integration=NEVER)  # fmt: skip
        run = SpatialSimulation(params)
        moving(run, [0.0, 0.0, 0.0, 3.0, 3.0, 3.0])
        run.advance_to(0.3)
        causes[play] = [e.cause for e in run.events if e.kind == EventKind.TRUCK_DERAILED]
    assert causes[0.0] == [] and "lateral force" in causes[0.03]
