"""What people who know other simulators, recorders and viewers expect; without a graph."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from derail_ros.nodes.core import State
from derail_ros.nodes.live import chosen_cars
from derail_ros.nodes.parameters import NODES, Settings
from msg_adapters.common import TIME_ZERO, stamp_of, stamp_of_bytes
from msg_adapters.definitions import deserialize
from msg_adapters.topics import LIVE_TOPICS, ON_MAP, STATE_TOPICS, TOPICS
from tests.nodes.bench import Simulator
from tests.nodes.support import ENDLESS, SMALL
from tests.nodes.test_core import Bench

PARAMETERS = {(node, p.name): p for node, table in NODES.items() for p in table}
SITE = "site:\n  datum: {latitude_deg: 43.55, longitude_deg: -79.6, altitude_m: 100}\n"


def stamped(bench: Bench) -> list[tuple[str, int]]:
    """Topic and time of all messages with one, in the order in which they went out."""
    kinds = {n: t.msgtype for n, t in (TOPICS | LIVE_TOPICS).items()} | bench.heard.offered
    without = (
        "std_msgs/msg/String",
        "visualization_msgs/msg/MarkerArray",
        "tf2_msgs/msg/TFMessage",
        "foxglove_msgs/msg/GeoJSON",
    )
    return [
        (name, stamp_of_bytes(data))
        for name, data in bench.heard.raw
        if kinds[name] not in without
    ]


# --- time ------------------------------------------------------------------------------------


@pytest.mark.parametrize("state_rate", [1.0, 7.0, 50.0, 400.0])
@pytest.mark.parametrize("factor", [0.3, 1.0, 20.0])
def test_no_message_is_ahead_of_the_clock(state_rate, factor) -> None:
    bench = Bench(state_rate=state_rate, speed_factor=factor, imu="1", imu_rate=333.0)
    bench.load(ENDLESS)
    bench.run(0.3, each=0.11, do=lambda: bench.core.trigger_emergency_brake(0, 0, 0, 0.0))
    bench.core.set_state(State.PAUSED)
    bench.run(0.1)
    bench.core.reset(0)
    bench.core.set_state(State.PLAYING)
    bench.run(0.2)
    clock, seen = 0, set()
    for name, stamp in stamped(bench):
        if name == "/clock":
            assert stamp >= clock, "the clock goes back"
            clock = stamp
        else:
            seen.add(name)
            assert stamp <= clock, name
    assert seen >= {*STATE_TOPICS, "events", "command_log", "joint_states"}
    if factor * 0.25 > 1.0 / state_rate:
        assert "car_1/imu_body" in seen


def test_the_clock_runs_with_the_run_and_not_with_its_output() -> None:
    bench = Bench(state_rate=1.0)
    bench.load(ENDLESS)
    bench.run(3.0)
    clocks = [stamp for name, stamp in stamped(bench) if name == "/clock"]
    assert max(np.diff(clocks)) <= 0.025e9, "a timer of 40 Hz would miss nothing"
    assert clocks[-1] - clocks[0] == pytest.approx(3e9, abs=0.05e9)


def test_a_pause_within_a_tick_loses_no_time() -> None:
    bench = Bench(state_rate=1.0)
    bench.load(ENDLESS)
    bench.run(0.4)
    bench.core.set_state(State.PAUSED)
    stood = bench.core.now
    bench.run(5.0)
    assert bench.core.now == stood
    bench.core.set_state(State.PLAYING)
    bench.run(0.55)
    assert bench.ticks() == 1
    bench.run(0.1)
    assert bench.ticks() == 2


def test_time_begins_above_zero_also_after_a_reset() -> None:
    """Zero means "not set" to clocks, to tf2, to recorders that wait for time."""
    bench = Bench()
    bench.run(0.1)
    bench.load(ENDLESS)
    bench.run(0.2)
    assert bench.core.reset(1).stamp == TIME_ZERO
    bench.run(0.2)
    assert min(stamp for _, stamp in stamped(bench)) == TIME_ZERO > 0


# --- who comes late --------------------------------------------------------------------------


@pytest.mark.parametrize("state", [State.STOPPED, State.PAUSED])
@pytest.mark.parametrize("topic", [*STATE_TOPICS, "/tf", "joint_states"])
def test_who_comes_while_nothing_moves_gets_the_state(topic, state) -> None:
    bench = Bench()
    bench.load(ENDLESS, paused=True)
    bench.core.set_state(state)
    bench.run(0.5)
    before = len(bench.heard.raw)
    bench.heard.listening[topic] = 1
    bench.run(12.0)
    live = (*STATE_TOPICS, "/tf", "joint_states")
    got = [name for name, _ in bench.heard.raw[before:] if name in live]
    assert set(got) == {topic} and len(got) <= 5, "it and nobody else, and not for ever"
    bench.run(12.0)
    again = [name for name, _ in bench.heard.raw[before:] if name in live]
    assert again == got
    bench.heard.listening[topic] = 2
    bench.run(0.5)
    assert [name for name, _ in bench.heard.raw[before:]].count(topic) > len(got)


@pytest.mark.parametrize("text", [ENDLESS, SMALL])
def test_who_has_heard_the_last_tick_does_not_get_it_again(text) -> None:
    bench = Bench()
    bench.heard.listening |= {"/tf": 1, "train_state": 1}
    bench.load(text, paused=True)
    bench.run(2.0)
    bench.core.set_state(State.PLAYING)
    bench.run(0.5 if text == ENDLESS else 40.0)
    bench.core.set_state(State.PAUSED)
    bench.run(12.0)
    for topic in ("/tf", "train_state"):
        data = [data for name, data in bench.heard.raw if name == topic]
        assert len(data) == len(set(data)) == bench.ticks() > 20


def test_tf2_sees_no_time_twice() -> None:
    bench = Bench()
    bench.load(ENDLESS, paused=True)
    bench.run(0.5)
    bench.heard.listening["/tf"] = 1
    bench.run(12.0)
    bench.core.set_state(State.PLAYING)
    bench.run(0.1)
    frames = [deserialize(d, "tf2_msgs/msg/TFMessage") for n, d in bench.heard.raw if n == "/tf"]
    stamps = [stamp_of(m.transforms[0]) for m in frames]
    assert len(stamps) > 5 and len(set(stamps)) == len(stamps) and stamps == sorted(stamps)


def test_who_comes_between_the_last_tick_and_a_look_gets_it() -> None:
    bench = Bench()
    bench.load(ENDLESS, paused=True)
    bench.heard.listening["energy"] = 1  # before the loop comes round
    bench.run(1.5)
    assert len(bench.heard.of("energy")) > 1


@pytest.mark.parametrize("began", [False, True])
def test_who_comes_while_nothing_moves_gets_the_last_measurement(began) -> None:
    bench = Bench(imu="1", odometry="2", imu_noise=0.1)
    bench.load(ENDLESS, paused=True)
    if began:
        bench.heard.listening["car_2/odometry"] = 1
        bench.core.set_state(State.PLAYING)
        bench.run(0.3)
        bench.core.set_state(State.PAUSED)
    bench.run(0.5)
    before = dict(bench.heard.raw)
    sent = len(bench.heard.raw)
    bench.heard.listening["car_1/imu_body"] = 1
    bench.run(12.0)
    got = [(n, d) for n, d in bench.heard.raw[sent:] if n in bench.heard.offered]
    assert got and set(got) == {("car_1/imu_body", before["car_1/imu_body"])}


def test_a_train_that_nothing_derails_is_told_what_does() -> None:
    bench = Bench()
    assert bench.load(ENDLESS).message.endswith("nothing pushes it: see ~/inject_rail_break")
    for more in (
        "track: {rail_breaks: [50]}",
        "initiation: {derailed_trucks: [{car: 1, truck: front}]}",
    ):
        text = ENDLESS.split("initiation:")[0] + more + "\n"
        assert "inject_rail_break" not in bench.load(text).message, more


# --- states ----------------------------------------------------------------------------------


@pytest.mark.parametrize("state", [State.PAUSED, State.STOPPED, State.PLAYING])
def test_the_state_that_is_reported_is_the_state_that_is_reached(state) -> None:
    running = Simulator()  # with the real clock: ticks without a pace fill a slice of its time
    assert running.ask("load_consist", scenario_yaml=ENDLESS, start_paused=True).success
    answers: list[Any] = []
    running.core.step_simulation(2**63, answers.append)
    while running.core.session.tick == 0:
        running.loop.work()
    assert running.core.set_state(state).success
    assert not running.core.stepping and running.core.state == state
    (answer,) = answers
    made = int(answer.message.split()[0])
    assert made > 0 and f"{made} of {2**63} ticks done" in answer.message
    if state != State.PLAYING:
        at = running.core.session.tick
        for _ in range(5):
            running.loop.work()
        assert running.core.session.tick == at


# --- values ----------------------------------------------------------------------------------


@pytest.mark.parametrize("value", ["", "/map", "my frame", "map/", "a//b", "\t", "käse"])
def test_frames_that_tf2_does_not_take_are_refused(value) -> None:
    with pytest.raises(ValueError, match="frame_id must be the name of a frame"):
        PARAMETERS["simulator", "frame_id"].check(value)
    if value not in ("", "map/"):
        with pytest.raises(ValueError, match="frame_prefix must be"):
            PARAMETERS["simulator", "frame_prefix"].check(value)


@pytest.mark.parametrize("value", ["map", "north/map", "odom_2", "Site-7.b"])
def test_frames_that_tf2_takes_are_taken(value) -> None:
    assert PARAMETERS["simulator", "frame_id"].check(value) == value


@pytest.mark.parametrize(
    ("node", "name"),
    [("simulator", "record"), ("simulator", "scenario_dirs"), ("recorder", "path"),
     ("player", "path")],
)  # fmt: skip
def test_paths_that_pass_no_shell_are_expanded(node, name, monkeypatch) -> None:
    monkeypatch.setenv("HOME", "/home/somebody")
    monkeypatch.setenv("BAGS", "/data/bags")
    parameter = PARAMETERS[node, name]
    many = isinstance(parameter.default, list)
    for given, meant in (("~/bag", "/home/somebody/bag"), ("$BAGS/bag", "/data/bags/bag")):
        value = parameter.check([given] if many else given)
        assert value == ([meant] if many else meant)


@pytest.mark.parametrize("path", ["$NO_SUCH_NAME/bag", "${NO_SUCH_NAME}", "~nobody_there/x"])
def test_paths_that_cannot_be_expanded_are_refused(path) -> None:
    with pytest.raises(ValueError, match="record: there is nothing to put for .*[Nn][Oo]"):
        PARAMETERS["simulator", "record"].check(path)
    assert PARAMETERS["simulator", "record"].check("costs 5$ ü/~") == "costs 5$ ü/~"


def test_frames_of_the_train_are_not_the_inertial_one() -> None:
    for prefix, frame in (("", "car_1"), ("", "car_3/front_truck"), ("north/", "north/car_12")):
        with pytest.raises(ValueError, match=f"frame_id must not be .* got '{frame}'"):
            Settings(frame_prefix=prefix, frame_id=frame).check_frames()
    for frame in ("map", "car_1", "north/cars", "north/car"):
        Settings(frame_prefix="north/", frame_id=frame).check_frames()


def test_each_train_has_frames_of_its_own() -> None:
    def names(**settings: Any) -> set[str]:
        bench = Bench(**settings)
        bench.load(ENDLESS)
        found = set()
        for name, data in bench.heard.raw:
            if name.startswith("/tf"):
                found |= {
                    t.child_frame_id
                    for t in deserialize(data, LIVE_TOPICS[name].msgtype).transforms
                }
        return found

    assert "car_1" in names() and "car_1/front_coupler/head" in names()
    north, south = names(namespace="/north"), names(namespace="/south")
    assert "north/car_1" in north and not north & south
    assert "train_car_3" in names(namespace="/north", frame_prefix="train_")
    assert "car_3" in names(namespace="/north", frame_prefix="")


def test_diagnostics_are_told_apart_by_the_namespace() -> None:
    statuses = []
    for namespace in ("/north", "/south"):
        bench = Bench(namespace=namespace, name="simulator")
        bench.run(0.1)
        statuses.append(bench.heard.last("/diagnostics").status[0])
    assert statuses[0].name == "north/simulator: simulation"
    assert statuses[0].name != statuses[1].name
    assert statuses[0].hardware_id != statuses[1].hardware_id
    assert Settings(namespace="/").prefix == ""


# --- sensors ---------------------------------------------------------------------------------


def measured(bench: Bench, topic: str) -> list[Any]:
    kind = bench.heard.offered[topic]
    return [deserialize(data, kind) for name, data in bench.heard.raw if name == topic]


def test_sensors_are_off_unless_they_are_asked_for() -> None:
    bench = Bench()
    bench.load(SMALL + SITE)
    bench.run(0.2)
    assert set(bench.heard.offered) == {ON_MAP.name}


def test_cars_are_chosen_by_numbers_and_ranges() -> None:
    assert list(chosen_cars("", 9)) == []
    assert list(chosen_cars(" 1, 3-4 7:front_truck", 9)) == [
        (0, ""), (2, ""), (3, ""), (6, "front_truck")
    ]  # fmt: skip
    assert [i for i, _ in chosen_cars("all", 3)] == [0, 1, 2]
    assert [i for i, _ in chosen_cars("2-5", 3)] == [1, 2], "only cars that the train has"
    assert chosen_cars("2 2 3-2", 3) == [(1, ""), (2, "")], "each once, in whatever order"
    assert PARAMETERS["simulator", "imu"].check(5) == "5", "as -p imu:=5 has it"
    with pytest.raises(ValueError, match="imu must be car numbers"):
        PARAMETERS["simulator", "imu"].check("locomotive")
    with pytest.raises(ValueError, match="imu must be car numbers"):
        PARAMETERS["simulator", "imu"].check("0")
    with pytest.raises(ValueError, match="imu: there is no place 'axle'; places are body, front_"):
        PARAMETERS["simulator", "imu"].check("5:axle")
    assert PARAMETERS["simulator", "imu"].check("5:front_truck 6") == "5:front_truck 6"


def test_a_sensor_of_a_car_that_is_not_there_is_told() -> None:
    bench = Bench(imu="20-30", odometry="1 77")
    bench.load(SMALL)
    told = [text for level, text in bench.heard.logs if level == "warning"]
    assert [text for text in told if "no imu: the train has cars 1 to 10 only" in text]
    assert not [text for text in told if "no odometry" in text]


def test_odometry_is_the_state() -> None:
    bench = Bench(odometry="2", odometry_rate=50.0)
    bench.load(SMALL)
    bench.run(1.0)
    states = {stamp_of(m): m for m in bench.heard.of("train_state")}
    found = measured(bench, "car_2/odometry")
    assert len(found) == pytest.approx(51, abs=1)
    for m in found[:-1]:
        s = states[stamp_of(m)]
        assert (m.pose.pose.position.x, m.pose.pose.position.y) == pytest.approx((s.x[1], s.y[1]))
        c, n = np.cos(s.yaw[1]), np.sin(s.yaw[1])
        assert m.twist.twist.linear.x == pytest.approx(c * s.vx[1] + n * s.vy[1])
        assert m.twist.twist.angular.z == pytest.approx(s.yaw_rate[1])
        assert (m.header.frame_id, m.child_frame_id) == ("map", "car_2")


def test_what_an_imu_feels_adds_up_to_the_change_of_speed() -> None:
    """Turned into the inertial frame, and less gravity, its integral is the change of velocity."""
    bench = Bench(imu="1", imu_rate=2000.0, odometry="1", odometry_rate=2000.0)
    bench.load(SMALL)
    bench.run(1.5)
    felt, moved = measured(bench, "car_1/imu_body"), measured(bench, "car_1/odometry")
    n = min(len(felt), len(moved))
    yaw = np.array([2 * np.arctan2(m.orientation.z, m.orientation.w) for m in felt[:n]])
    a = np.array([[m.linear_acceleration.x, m.linear_acceleration.y] for m in felt[:n]])
    v = np.array([[m.twist.twist.linear.x, m.twist.twist.linear.y] for m in moved[:n]])
    c, s = np.cos(yaw), np.sin(yaw)

    def turned(u: np.ndarray) -> np.ndarray:
        return np.stack([c * u[:, 0] - s * u[:, 1], s * u[:, 0] + c * u[:, 1]], axis=1)

    change = 0.5 * (turned(a)[1:] + turned(a)[:-1]).sum(axis=0) / 2000.0
    assert change == pytest.approx(turned(v)[-1] - turned(v)[0], abs=0.02)
    assert abs(change).max() > 0.5, "it did derail"
    assert {m.linear_acceleration.z for m in felt} == {9.81}


def test_a_place_off_the_centre_feels_the_turning() -> None:
    """a_P = a_M + dw/dt x r + w x (w x r), from the state messages."""
    bench = Bench(imu="2 2:rear_truck", imu_rate=50.0)
    bench.load(SMALL)
    bench.run(2.0)
    states = {stamp_of(m): m for m in bench.heard.of("train_state")}
    centre = {stamp_of(m): m for m in measured(bench, "car_2/imu_body")}
    arm = -bench.core.session.params.cars[1].truck_distance
    compared = 0
    for m in measured(bench, "car_2/imu_rear_truck"):
        s = states.get(stamp_of(m))
        if s is None:
            continue
        more = m.linear_acceleration.x - centre[stamp_of(m)].linear_acceleration.x
        across = m.linear_acceleration.y - centre[stamp_of(m)].linear_acceleration.y
        assert more == pytest.approx(-(s.yaw_rate[1] ** 2) * arm, abs=1e-9)
        assert across == pytest.approx(s.yaw_acceleration[1] * arm, abs=1e-9)
        compared += abs(across) > 0.1
    assert compared > 5


def test_noise_has_the_size_that_the_covariance_tells() -> None:
    bench = Bench(imu="1", imu_rate=2000.0, imu_noise=0.2, sensor_seed=5)
    bench.load(ENDLESS)
    bench.run(1.0)
    found = measured(bench, "car_1/imu_body")
    z = np.array([m.linear_acceleration.z for m in found]) - 9.81
    # The standard deviation of 2000 draws is known to 1.6 %.
    assert z.std() == pytest.approx(0.2, rel=0.08) and abs(z.mean()) < 0.02
    assert found[0].linear_acceleration_covariance[0] == pytest.approx(0.04)
    again = Bench(imu="1", imu_rate=2000.0, imu_noise=0.2, sensor_seed=5)
    again.load(ENDLESS)
    again.run(0.1)
    first = measured(again, "car_1/imu_body")[0].linear_acceleration
    assert first.x == found[0].linear_acceleration.x


def test_odometry_has_noise_of_place_and_of_velocity() -> None:
    exact, noisy = (Bench(odometry="1", odometry_rate=2000.0, **more) for more in
                    ({}, {"odometry_noise": 0.5, "odometry_speed_noise": 0.1}))  # fmt: skip
    found = []
    for bench in (exact, noisy):
        bench.load(ENDLESS)
        bench.run(1.0)
        found.append(measured(bench, "car_1/odometry"))
    place, velocity = (
        np.array([[getattr(of(b), k) - getattr(of(a), k) for k in "xyz"] for a, b in zip(*found)])
        for of in (lambda m: m.pose.pose.position, lambda m: m.twist.twist.linear)
    )
    # The standard deviation of 6000 draws is known to 1 %.
    assert place.std() == pytest.approx(0.5, rel=0.06) and abs(place.mean()) < 0.03
    assert velocity.std() == pytest.approx(0.1, rel=0.06) and abs(velocity.mean()) < 0.006
    assert list(np.diag(found[1][0].pose.covariance.reshape(6, 6))) == [0.25] * 3 + [0.0] * 3
    speeds = np.diag(found[1][0].twist.covariance.reshape(6, 6))
    assert speeds == pytest.approx([0.01] * 3 + [0.0] * 3)
    assert not found[0][0].pose.covariance.any() and not found[0][0].twist.covariance.any()
    assert found[0][9].pose.pose.orientation == found[1][9].pose.pose.orientation


def ecef(latitude: float, longitude: float, altitude: float) -> np.ndarray:
    """Place on the ellipsoid of WGS 84 in its Cartesian frame, m: the textbook's formulas."""
    a, f = 6_378_137.0, 1 / 298.257223563
    p, q = np.radians(latitude), np.radians(longitude)
    n = a / np.sqrt(1 - f * (2 - f) * np.sin(p) ** 2)
    flat = (n + altitude) * np.cos(p)
    return np.array(
        [flat * np.cos(q), flat * np.sin(q), (n * (1 - f) ** 2 + altitude) * np.sin(p)]
    )


def test_places_on_the_earth_are_as_far_apart_as_on_the_track() -> None:
    bench = Bench(navsat="all", odometry="all", odometry_rate=5.0)
    bench.load(SMALL + SITE)
    bench.run(0.1)
    n = bench.core.session.simulation.n_cars
    fixes = [measured(bench, f"car_{i}/fix")[0] for i in range(1, n + 1)]
    places = [measured(bench, f"car_{i}/odometry")[0].pose.pose.position for i in range(1, n + 1)]
    assert {f.position_covariance_type for f in fixes} == {0}, "exact: no covariance is known"
    earth = np.array([ecef(f.latitude, f.longitude, f.altitude) for f in fixes])
    plane = np.array([[p.x, p.y, p.z] for p in places])
    for i in range(1, n):
        apart = np.linalg.norm(earth[i] - earth[0])
        assert apart == pytest.approx(np.linalg.norm(plane[i] - plane[0]), rel=2e-5)
    # The x axis points east unless the datum says otherwise, and car 1 leads.
    assert fixes[0].longitude > fixes[-1].longitude
    assert fixes[0].latitude == pytest.approx(fixes[-1].latitude, abs=1e-9)


def test_without_a_datum_there_is_no_fix_and_a_word_why() -> None:
    bench = Bench(navsat="1")
    bench.load(SMALL)
    assert not bench.heard.offered
    assert ("warning", "no navsat: the scenario small has no site.datum") in bench.heard.logs


def test_the_pipe_of_a_car_empties_when_the_signal_reaches_it() -> None:
    bench = Bench(pipe_pressure="1 3", pipe_pressure_rate=200.0)
    bench.load(ENDLESS)
    bench.run(0.5)
    bench.core.trigger_emergency_brake(0, 0, 0, 0.0)
    bench.run(3.0)
    reached = {
        e.cars[0]: stamp_of(e)
        for e in bench.heard.of("events")
        if e.kind_name == "brake_signal_reached"
    }
    for car in (1, 3):
        found = measured(bench, f"car_{car}/brake_pipe_pressure")
        before = [m.fluid_pressure for m in found if stamp_of(m) < reached[car] - 5e6]
        assert set(before) == {620_500.0}
        after = [(stamp_of(m) - reached[car], m.fluid_pressure) for m in found]
        assert next(p for t, p in after if t > 0.5e9) == pytest.approx(620_500 / np.e, rel=0.05)
        assert found[-1].fluid_pressure < 10_000


def test_wheels_turn_with_the_train_and_a_derailed_truck_has_none_that_roll() -> None:
    bench = Bench(wheel_speed="1 10", wheel_speed_rate=50.0)
    bench.load(SMALL)
    bench.run(1.5)
    first, last = (measured(bench, f"car_{i}/wheel_speed") for i in (1, 10))
    assert np.isnan(first[-1].twist.linear.x), "car 1 derails at the start"
    states = {stamp_of(m): m for m in bench.heard.of("train_state")}
    assert last[0].twist.linear.x == pytest.approx(80 / 3.6, rel=1e-6)
    assert last[20].twist.linear.x == pytest.approx(states[stamp_of(last[20])].vx[9], abs=0.05)
