"""Brakes by equipment: arrival, build-up and force against closed forms and reports."""

import math

import numpy as np
import pytest

from derail_ros.engine.laws.brake import composition_factor
from derail_ros.engine.planar import PlanarSimulation
from derail_ros.scenario import loads_scenario
from derail_ros.vocabulary.events import EventKind

CAR = "{mass_kg: 119e3, length_over_couplers_m: 18.2, truck_centres_m: 14.3, coupler: E60"
EMPTY = (
    "{empty_mass_kg: 28.5e3, loaded_mass_kg: 130e3, load: empty, length_over_couplers_m: 18.2, "
    "truck_centres_m: 14.3, coupler: E60"
)
WAVE = 290.0


def train(*blocks, brakes="", initiation="", speed=60):
    """A run on the straight that nothing derails."""
    consist = "\n".join(f"    - {block}}}" for block in blocks)
    return loads_scenario(
        f"version: 1\ntitle: x\ntrain:\n  speed_kmh: {speed}\n  consist:\n{consist}\n"
        f"initiation: {{await_command: true, lateral_force_N: 0{initiation}}}\n"
        f"brakes: {{law: braking_ratio{brakes}}}\n"
    )


def run_of(*blocks, **options):
    return PlanarSimulation(train(*blocks, **options).to_params())


def arrivals(run):
    """Time at which the signal reaches each car, s."""
    return run._state.arrival[:, 0].copy()


def places(run):
    return np.asarray(run._model.unit["distance"])


def applied(run, t):
    """Share of the full force of each car at a time, s, from the forces of the run."""
    run.advance_to(t)
    sample = run.sample(t)
    full = np.array([car.brakes[0].force for car in run.params.cars])
    speed = np.hypot(sample.velocity[:, 0], sample.velocity[:, 1])
    return sample.brake_force / (full * [composition_factor(v) for v in speed])


def test_the_wave_of_each_system():
    cars = [f"{CAR}, count: 150"]
    at = places(conventional := run_of(*cars))
    assert arrivals(conventional) == pytest.approx(at / WAVE)
    eot = run_of(*cars, brakes=", system: two_way_eot")
    assert arrivals(eot) == pytest.approx(np.minimum(at / WAVE, 1.0 + (at[-1] - at) / WAVE))
    ecp = run_of(*cars, brakes=", system: ecp")
    assert np.all(arrivals(ecp) == 0.0)
    brakes = ", system: distributed_power, remote_locomotives: [76]"
    middle = arrivals(run_of(*cars, brakes=brakes))
    assert middle == pytest.approx(np.minimum(at / WAVE, 1.0 + abs(at - at[75]) / WAVE))


def test_distributed_power_listens_at_every_locomotive():
    """An emergency within the train: the nearest locomotive hears the wave and tells all."""
    brakes = ", system: {}, signal_source: car, signal_car: 70{}"
    cars = [f"{CAR}, count: 150"]
    remote = ", remote_locomotives: [76, 150]"
    dp = run_of(*cars, brakes=brakes.format("distributed_power", remote))
    at = places(dp)
    told = 1.0 + (at[75] - at[69]) / WAVE
    waves = [abs(at - at[69]) / WAVE] + [told + abs(at - at[i]) / WAVE for i in (0, 75, 149)]
    assert arrivals(dp) == pytest.approx(np.min(waves, axis=0))
    # the end of train is told by the head alone, which the wave must reach first
    eot = run_of(*cars, brakes=brakes.format("two_way_eot", ""))
    told = 1.0 + at[69] / WAVE
    waves = [abs(at - at[69]) / WAVE, told + (at[-1] - at) / WAVE]
    assert arrivals(eot) == pytest.approx(np.min(waves, axis=0))


@pytest.mark.parametrize("system", ["two_way_eot", "distributed_power"])
def test_full_application_on_the_test_rack(system):
    """150 cars, the hose parted behind the locomotives, a radio at the rear: full after 16 s.

    National Academies letter report 24698 (2017), appendix F, measured on real valves. Here the
    wave from both ends, with 1 s of radio and 10 s of rise, gives 15 s.
    """
    car = CAR.replace("18.2", "15.24").replace("14.3", "11")
    cars = ["{car: locomotive_sd70ace, count: 2", f"{car}, count: 150"]
    cars += ["{car: locomotive_sd70ace"] * (system == "distributed_power")
    brakes = f", system: {system}, vent_on_parting: true, signal_source: none"
    run = run_of(*cars, brakes=brakes, initiation=", parted_couplings: [2]")
    full = arrivals(run).max() + 10.0
    assert full == pytest.approx(16.0, abs=3.0)
    assert applied(run, full - 0.3).min() < 0.99
    assert applied(run, full + 0.01) == pytest.approx(1.0, rel=1e-5)  # direction is smoothed


def test_ecp_against_conventional():
    """Total brake force of 100 cars: ECP ahead by 46 % at 10 s and 22 % at 20 s.

    National Academies report 24903, appendix H. Ratio and build-up of the ECP brake are fitted to
    these two numbers; the friction of the shoes, which speed changes, is left out.
    """
    cars = [f"{CAR}, count: 100"]
    ecp, conventional = run_of(*cars, brakes=", system: ecp"), run_of(*cars)
    force = {run: [car.brakes[0].force for car in run.params.cars] for run in (ecp, conventional)}
    for t, lead in ((10.0, 0.46), (20.0, 0.22)):
        total = [applied(run, t) @ force[run] for run in (ecp, conventional)]
        assert total[0] / total[1] - 1.0 == pytest.approx(lead, abs=0.10)


def stopping_distance(run):
    """Way of car 1 until it stands, m."""
    start = float(run.sample().pose[0, 0])
    run.advance_to(300.0)
    assert run.status == "at rest"
    return float(run.sample().pose[0, 0]) - start


def way(v, deceleration):
    """Distance to stop from ``v`` with ``deceleration`` times the shoe's speed factor, m."""
    speeds = np.linspace(0.0, v, 20001)
    friction = np.array([composition_factor(u) for u in speeds])
    return np.trapezoid(speeds / (deceleration * friction), speeds)


@pytest.mark.parametrize(
    "block, ratio",
    [
        (CAR, 0.11),
        (EMPTY, 0.25),
        (f"{EMPTY}, brake: {{empty_load_device: false}}", 0.11 * 130.0 / 28.5),
        (f"{EMPTY}, brake: {{net_braking_ratio_empty: 0.15}}", 0.15),
    ],
    ids=["loaded", "empty", "empty without a device", "empty, ratio of its own"],
)
def test_stopping_distance_by_ratio_and_load(block, ratio):
    """All brakes at once: the distance is that of one car, whatever its mass."""
    run = run_of(f"{block}, count: 5", brakes=", instant: true")
    deceleration = ratio * 1.2 * 0.21 * 19.223 / 9.388 * 9.81
    # the end of a run is a speed of 0.3 m/s held for 0.5 s
    assert stopping_distance(run) == pytest.approx(way(60.0 / 3.6, deceleration), rel=2e-3)


def test_a_cut_out_car_and_a_hand_brake():
    cut = f"{CAR}, brake: {{cut_out: true}}"
    hand = f"{CAR}, brake: {{cut_out: true, hand_brake: true}}"
    run = run_of(CAR, cut, hand, brakes=", instant: true, signal_source: none")
    force = run.sample(run.time).brake_force / composition_factor(60.0 / 3.6)
    friction = 0.21 * 19.223 / 9.388
    assert force == pytest.approx([0.0, 0.0, 0.1 * 119e3 * 9.81 * friction])
    run.trigger_emergency_brake("instant", "front")
    force = run.sample().brake_force / composition_factor(60.0 / 3.6)
    assert force[0] == pytest.approx(0.11 * 1.2 * 119e3 * 9.81 * friction)
    assert force[1] == 0.0 and force[2] == pytest.approx(0.1 * 119e3 * 9.81 * friction)


def test_distributed_power_against_the_end_of_train_device():
    """Stopping distances: both systems gain on the pipe alone, and differ by their arrivals."""
    cars = ["{car: locomotive_sd70ace", f"{CAR}, count: 100", "{car: locomotive_sd70ace"]
    found, means = {}, {}
    for system, more in (
        ("conventional", ""),
        ("two_way_eot", ""),
        ("distributed_power", ", remote_locomotives: [52]"),
        ("ecp", ", ecp_ratio_factor: 1, ecp_rise_time_s: 10"),
    ):
        run = run_of(*cars, brakes=f", system: {system}{more}", speed=80)
        means[system] = arrivals(run).mean()
        found[system] = stopping_distance(run)
    v = 80.0 / 3.6
    for system, distance in found.items():
        # of equal brakes, an arrival later by dt costs v dt, less what the rest slows it by
        later = v * (means[system] - means["ecp"])
        assert 0.5 * later <= distance - found["ecp"] <= 1.05 * later + 1e-6, system
    gap = found["distributed_power"] - found["two_way_eot"]
    assert abs(gap) < 0.01 * found["two_way_eot"]
    assert found["conventional"] > 1.02 * max(found["two_way_eot"], found["distributed_power"])


def test_a_train_parted_at_the_start_vents_both_ways():
    brakes = ", vent_on_parting: true, signal_source: none"
    run = run_of(f"{CAR}, count: 20", brakes=brakes, initiation=", parted_couplings: [8]")
    at = places(run)
    assert arrivals(run) == pytest.approx(abs(at - 0.5 * (at[7] + at[8])) / WAVE)
    event = next(e for e in run.events if e.kind == EventKind.BRAKES_TRIGGERED)
    assert (event.cars, event.cause, event.time) == ((8, 9), "vented", 0.0)
    still = run_of(
        f"{CAR}, count: 20",
        brakes=brakes.replace("true", "false"),
        initiation=", parted_couplings: [8]",
    )
    assert np.all(arrivals(still) == math.inf)


def test_a_run_goes_on_from_its_bytes():
    brakes = ", system: distributed_power, remote_locomotives: [6]"
    run = run_of(f"{CAR}, count: 10", f"{EMPTY}, brake: {{hand_brake: true}}", brakes=brakes)
    run.advance_to(3.0)
    again = PlanarSimulation.from_bytes(run.to_bytes())
    for one in (run, again):
        one.advance_to(5.0)
    assert again.to_bytes() == run.to_bytes()
    assert again.params == run.params
