"""Messages hold what the engine reports: field by field, unit by unit."""

from __future__ import annotations

import dataclasses
import json
import math
from xml.etree import ElementTree

import numpy as np
import pytest

from derail_ros.engine import PlanarSimulation
from derail_ros.scenario import load_scenario_by_name
from derail_ros.vocabulary.events import Collision, Event, EventKind
from derail_ros.vocabulary.measures import outcome_record
from msg_adapters import common, reports
from msg_adapters.definitions import (
    deserialize,
    message_class,
    read_copy,
    read_sources,
    serialize,
    typestore,
)
from msg_adapters.frames import (
    TransformEncoder,
    joint_names,
    robot_description,
    static_transforms,
)
from msg_adapters.state import StateEncoder
from msg_adapters.topics import STATE_TOPICS, TOPICS, bag_qos
from tests.nodes.support import simulation

CONTEXT = common.RunContext("run-1", base=7_000_000_000, frame_id="map")


@pytest.fixture(scope="module")
def run() -> PlanarSimulation:
    """A train in the middle of its pile-up."""
    sim = simulation()
    sim.advance_to(3.0)
    return sim


@pytest.fixture(scope="module")
def decoded(run: PlanarSimulation) -> dict[str, object]:
    """The state messages of that moment, as a subscriber gets them."""
    encoder = StateEncoder(run.params, CONTEXT)
    return {
        name: deserialize(data, TOPICS[name].msgtype)
        for name, data in encoder.encode(run.sample())
    }


def test_the_copy_of_the_definitions_is_current() -> None:
    assert read_copy() == read_sources(), "run: python -m msg_adapters.definitions"


def test_every_topic_has_a_type_and_a_quality_of_service() -> None:
    for topic in TOPICS.values():
        assert message_class(topic.msgtype)
        assert bag_qos(topic).depth == topic.depth


def test_poses_are_those_of_the_mass_centres(run: PlanarSimulation, decoded: dict) -> None:
    sample = run.sample()
    message = decoded["car_poses"]
    assert message.header.frame_id == "map"
    assert common.stamp_of(message) == 7_000_000_000 + round(sample.time * 1e9)
    assert len(message.poses) == run.n_cars
    for pose, (x, y, yaw, _, _) in zip(message.poses, sample.q):
        assert (pose.position.x, pose.position.y, pose.position.z) == (x, y, 0.0)
        assert pose.orientation.z == math.sin(yaw / 2)
        assert pose.orientation.w == math.cos(yaw / 2)
        assert (pose.orientation.x, pose.orientation.y) == (0.0, 0.0)


def test_the_pose_encoder_writes_what_the_serialiser_would(run: PlanarSimulation) -> None:
    pose_array = message_class("geometry_msgs/msg/PoseArray")
    pose = message_class("geometry_msgs/msg/Pose")
    point = message_class("geometry_msgs/msg/Point")
    quaternion = message_class("geometry_msgs/msg/Quaternion")
    sample = run.sample()
    slow = pose_array(
        CONTEXT.header(sample.time),
        [
            pose(point(x, y, 0.0), quaternion(0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)))
            for x, y, yaw, _, _ in sample.q.tolist()
        ],
    )
    fast = StateEncoder(run.params, CONTEXT).poses(sample)
    assert fast == serialize(slow)


def test_the_state_encoder_writes_what_the_serialiser_would(run: PlanarSimulation) -> None:
    """Also when it renews the numbers of the message before."""
    encoder = StateEncoder(run.params, CONTEXT)
    for time in (run.previous_time, run.time):
        sample = run.sample(time)
        slow = {
            "train_state": serialize(encoder.train_state(sample)),
            "coupler_states": serialize(encoder.coupler_states(sample)),
            "energy": serialize(encoder.energy(sample)),
        }
        fast = dict(encoder.encode(sample))
        assert {name: fast[name] for name in slow} == slow


def test_train_state_holds_every_array_of_the_sample(run: PlanarSimulation, decoded: dict) -> None:
    s, m = run.sample(), decoded["train_state"]
    assert (m.run_id, m.step, m.time) == ("run-1", s.step, s.time)
    expected = {
        "x": s.q[:, 0],
        "y": s.q[:, 1],
        "yaw": s.q[:, 2],
        **dict(zip(("z", "roll", "pitch"), np.zeros((3, s.n_cars)))),
        **dict(zip(("vz", "roll_rate", "pitch_rate"), np.zeros((3, s.n_cars)))),
        **dict(zip(("az", "roll_acceleration", "pitch_acceleration"), np.zeros((3, s.n_cars)))),
        "coupler_angle_front": s.q[:, 3],
        "coupler_angle_rear": s.q[:, 4],
        "vx": s.v[:, 0],
        "vy": s.v[:, 1],
        "yaw_rate": s.v[:, 2],
        "coupler_rate_front": s.v[:, 3],
        "coupler_rate_rear": s.v[:, 4],
        "ax": s.a[:, 0],
        "ay": s.a[:, 1],
        "yaw_acceleration": s.a[:, 2],
        "coupler_acceleration_front": s.a[:, 3],
        "coupler_acceleration_rear": s.a[:, 4],
        "truck_status_front": s.truck_on[:, 0],
        "truck_status_rear": s.truck_on[:, 1],
        "track_coordinate_front": s.truck_coordinate[:, 0],
        "track_coordinate_rear": s.truck_coordinate[:, 1],
        "rail_force_front": s.rail_force[:, 0],
        "rail_force_rear": s.rail_force[:, 1],
        "brake_force": s.brake_force,
        "ground_force_front_x": s.ground_truck_force[:, 0, 0],
        "ground_force_front_y": s.ground_truck_force[:, 0, 1],
        "ground_force_rear_x": s.ground_truck_force[:, 1, 0],
        "ground_force_rear_y": s.ground_truck_force[:, 1, 1],
        "ground_force_body_x": s.ground_body_force[:, 0],
        "ground_force_body_y": s.ground_body_force[:, 1],
        "ground_moment": s.ground_moment,
        "collision_force_x": s.collision_force[:, 0],
        "collision_force_y": s.collision_force[:, 1],
        "collision_moment": s.collision_moment,
        "corner_force": s.corner_force.ravel(),
        "corner_gap": s.corner_gap.ravel(),
        "corner_closing_speed": s.corner_closing_speed.ravel(),
        "corner_other_car": s.corner_other.ravel(),
        "external_force_x": s.external_force[:, 0],
        "external_force_y": s.external_force[:, 1],
    }
    for name, values in expected.items():
        np.testing.assert_array_equal(getattr(m, name), values, err_msg=name)
    rest = {"header", "run_id", "step", "time", "largest_corner_force", "external_moment", "more"}
    fields = {f.name for f in dataclasses.fields(m) if f.init}
    constants = {name for name in fields if name.isupper() or name == "__msgtype__"}
    assert fields - constants == set(expected) | rest


def test_a_struck_car_knows_the_largest_force_at_a_corner_of_the_striking_one() -> None:
    sim = simulation()
    while not sim.ended:
        sim.advance_steps(5)
        s = sim.sample()
        if s.corner_force.max() > 1e4:
            break
    car, corner = np.unravel_index(np.argmax(s.corner_force), s.corner_force.shape)
    struck = int(s.corner_other[car, corner]) - 1
    largest = StateEncoder(sim.params, CONTEXT).train_state(s).largest_corner_force
    assert largest[car] == largest[struck] == s.corner_force[car, corner]


def test_the_moment_of_the_force_that_starts_the_motion() -> None:
    sim = simulation()
    sim.advance_to(0.2)
    s = sim.sample()
    force = sim.params.initiation.lateral_forces[0]
    moment = StateEncoder(sim.params, CONTEXT).train_state(s).external_moment
    arm = sim.params.cars[force.car - 1].truck_distance
    assert moment[force.car - 1] == pytest.approx(force.force * arm, rel=1e-3)
    assert np.count_nonzero(moment) == 1


def test_couplings(run: PlanarSimulation, decoded: dict) -> None:
    s, m = run.sample(), decoded["coupler_states"]
    np.testing.assert_array_equal(m.coupled, s.coupled)
    np.testing.assert_array_equal(m.relative_angle, s.relative_angle)
    np.testing.assert_array_equal(m.knuckle_moment, s.knuckle_moment)
    np.testing.assert_array_equal(m.constraint_force_x, s.coupler_force[:, 0])
    np.testing.assert_array_equal(m.constraint_force_y, s.coupler_force[:, 1])
    np.testing.assert_array_equal(m.axial_force, s.axial_force)
    np.testing.assert_array_equal(m.gap_error, s.coupler_gap)
    np.testing.assert_array_equal(m.striker_force_front, s.striker_force[:, 0])
    np.testing.assert_array_equal(m.striker_force_rear, s.striker_force[:, 1])


def test_the_ledger_balances_as_the_message_says(run: PlanarSimulation, decoded: dict) -> None:
    m = decoded["energy"]
    ledger = reports.ledger_from_message(m.entries)
    assert ledger == run.sample().energy

    def total(role: str) -> float:
        return sum(v for v, r in zip(ledger.values(), m.roles) if r == role)

    assert total("stored") == pytest.approx(
        total("initial") + total("put in") - total("taken out") - ledger["residual"],
        rel=1e-12,
        abs=1e-3,
    )
    assert ledger["brakes"] > 0.0 < ledger["external"]


def test_draft_is_positive_and_buff_negative() -> None:
    """Of a straight braked train, the rear of which runs up on the front."""
    from derail_ros.vocabulary.sample import Sample, planar

    pose = planar(np.array([[0.0, 0.0, 0.0], [-18.0, 0.0, 0.0]]))
    pulled = Sample.make(0.0, 0, pose, coupler_force=np.array([[-1e5, 0.0]]))
    pushed = Sample.make(0.0, 0, pose, coupler_force=np.array([[1e5, 0.0]]))
    assert pulled.axial_force == pytest.approx([1e5])
    assert pushed.axial_force == pytest.approx([-1e5])


def test_events_survive_the_round_trip(run: PlanarSimulation) -> None:
    for number, event in enumerate(run.events):
        message = deserialize(
            serialize(reports.train_event(event, number, CONTEXT)), "derail_msgs/msg/TrainEvent"
        )
        back = reports.event_from_message(message)
        assert repr(back) == repr(event)
        assert message.sequence == number
        assert message.text
        assert common.stamp_of(message) == CONTEXT.stamp(event.time)


def test_a_place_at_a_hair_before_zero_has_no_sign() -> None:
    event = Event(EventKind.TRUCK_DERAILED, 1.0, 3, cars=(2,), track_coordinate=-1e-9)
    assert " at 0.0 m" in event.text


def test_every_kind_of_event_has_a_number_and_a_line_of_text() -> None:
    cls = message_class("derail_msgs/msg/TrainEvent")
    for kind in EventKind:
        event = Event(kind, 1.0, 1, cars=(3, 4), more={"force_N": 2.0})
        message = reports.train_event(event, 0, CONTEXT)
        assert message.text and message.kind == getattr(cls, f"KIND_{kind.name}")
        assert reports.event_from_message(message).more == {"force_N": 2.0}


def test_contacts_survive_the_round_trip() -> None:
    sim = simulation()
    sim.run()
    assert sim.collisions
    for contact in sim.collisions:
        message = reports.collision(contact, 5, CONTEXT)
        back = reports.collision_from_message(
            deserialize(serialize(message), "derail_msgs/msg/Collision")
        )
        assert back == contact
    open_contact = dataclasses.replace(contact, final=False, end=math.nan)
    assert common.stamp_of(reports.collision(open_contact, 5, CONTEXT)) == CONTEXT.stamp(
        contact.peak_time
    )
    assert {f.name for f in dataclasses.fields(Collision)}


def test_an_outcome_survives_the_round_trip() -> None:
    sim = simulation()
    outcome = sim.run()
    message = deserialize(
        serialize(reports.outcome(outcome, CONTEXT, time=sim.time, step=sim.step_count)),
        "derail_msgs/msg/Outcome",
    )
    assert message.is_final and message.status_name == "at rest"
    back = reports.outcome_from_message(message)
    for field in dataclasses.fields(outcome):
        ours, theirs = getattr(outcome, field.name), getattr(back, field.name)
        if field.name not in ("values", "car_values"):
            np.testing.assert_equal(theirs, ours, err_msg=field.name)
    assert outcome_record(back) == outcome_record(outcome)
    assert back.values["cars_derailed"] == outcome.cars_derailed


def test_the_consist_of_mississauga() -> None:
    scenario = load_scenario_by_name("mississauga_published")
    params = scenario.to_params()
    message = reports.consist(params, CONTEXT, name="m", scenario_hash="sha256:x")
    assert len(message.mass) == len(params.cars) == 25
    assert message.represents_cars[-1] == 50
    assert len(message.coupling_angle_limit) == 24
    heads = {(c.rear.head, d.front.head) for c, d in zip(params.cars[:-1], params.cars[1:])}
    assert heads == {("F", "F")}
    assert set(message.coupling_angle_limit) == {params.derailment.knuckle_limit_ff}
    serialize(message)


def test_the_track_of_a_curve_has_its_whole_length() -> None:
    sim = PlanarSimulation(load_scenario_by_name("curve_derailment").to_params())
    coordinates = reports.track_coordinates(sim.track, sim.sample().truck_coordinate)
    message = reports.track(sim.track, coordinates, [(10.0, 1.5)], CONTEXT)
    assert message.s[0] == sim.track.start and message.s[-1] == sim.track.end
    assert np.diff(message.s).max() <= reports.TRACK_SPACING + 1e-9
    steps = np.hypot(np.diff(message.x), np.diff(message.y))
    np.testing.assert_allclose(steps, np.diff(message.s), rtol=1e-3)
    assert message.rail_break_time.tolist() == [1.5]


def test_a_request_becomes_json_whatever_is_in_it() -> None:
    message = reports.command_log(
        context=CONTEXT,
        step=1,
        time=2.0,
        sequence=3,
        command="inject_rail_break",
        request={"track_coordinate": math.nan, "car": np.uint32(4), "x": [math.inf, -math.inf]},
        caller="me",
        accepted=False,
        answer="no",
    )
    assert json.loads(message.request_json) == {
        "track_coordinate": "nan",
        "car": 4,
        "x": ["inf", "-inf"],
    }
    assert common.stamp_of(message) == 9_000_000_000


def test_stamps_are_whole_nanoseconds() -> None:
    context = common.RunContext("r", base=10)
    assert context.stamp(0.1) == 100_000_010
    assert context.stamp(86_400.000000001) == 86_400_000_000_011
    data = reports.clock(1_500_000_000)
    assert common.stamp_of_bytes(data) == 1_500_000_000


def test_one_car_alone_is_a_train_too() -> None:
    from tests.nodes.support import small

    text = "version: 1\ntitle: One\ntrain:\n  speed_kmh: 40\n  consist: [{car: source_base_car}]\n"
    text += "track: {rail_breaks: [20]}\n"
    sim = PlanarSimulation(small(text).to_params())
    sim.advance_to(0.5)
    encoder = StateEncoder(sim.params, CONTEXT)
    messages = dict(encoder.encode(sim.sample()))
    assert set(messages) == set(STATE_TOPICS)
    couplers = deserialize(messages["coupler_states"], "derail_msgs/msg/CouplerStates")
    assert len(couplers.coupled) == 0 and len(couplers.striker_force_front) == 1


@pytest.mark.ros
def test_ros_reads_the_same_from_the_bytes(run: PlanarSimulation) -> None:
    """What is published serialised is what ROS would have published itself."""
    pytest.importorskip("rclpy")
    from rclpy.serialization import deserialize_message, serialize_message

    from msg_adapters.topics import check_interfaces, rclpy_class

    check_interfaces()
    encoder = StateEncoder(run.params, CONTEXT)
    outcome = reports.outcome(run.outcome(), CONTEXT, time=1.0, step=2)
    event = reports.train_event(run.events[0], 1, CONTEXT)
    messages = encoder.encode(run.sample()) + [
        ("outcome", serialize(outcome)),
        ("events", serialize(event)),
        ("consist", serialize(reports.consist(run.params, CONTEXT, name="n"))),
        ("/clock", reports.clock(5)),
        ("/diagnostics", serialize(reports.diagnostics(5, "n", 2, "m", {"a": 1.5}, "h"))),
    ]
    for name, data in messages:
        kind = TOPICS[name].msgtype
        message = deserialize_message(data, rclpy_class(kind))
        again = typestore().deserialize_cdr(serialize_message(message), kind)
        assert repr(again) == repr(deserialize(data, kind)), name


def test_frames_of_the_cars(run: PlanarSimulation) -> None:
    """Cars in the inertial frame, and their couplers in them at their angles."""
    sample = run.sample()
    data = TransformEncoder(run.params, CONTEXT, "north/")(sample)
    message = deserialize(data, "tf2_msgs/msg/TFMessage")
    assert serialize(message) == data
    found = {one.child_frame_id: one for one in message.transforms}
    for i, car in enumerate(run.params.cars):
        for k, (end, sign) in enumerate((("front", 1.0), ("rear", -1.0))):
            arm = found[f"north/car_{i + 1}/{end}_coupler"]
            assert arm.header.frame_id == f"north/car_{i + 1}"
            assert arm.transform.translation.x == sign * car.pivot_distance
            turned = 2.0 * math.atan2(arm.transform.rotation.z, arm.transform.rotation.w)
            assert turned == pytest.approx(sample.coupler_yaw[i, k] - sample.pose[i, 5])
    for i in range(run.n_cars):
        one = found[f"north/car_{i + 1}"]
        assert one.header.frame_id == "map"
        assert common.stamp_of(one) == CONTEXT.stamp(sample.time)
        place, turn = one.transform.translation, one.transform.rotation
        assert (place.x, place.y, place.z) == (sample.q[i, 0], sample.q[i, 1], 0.0)
        assert (turn.x, turn.y) == (0.0, 0.0)
        assert turn.z == math.sin(sample.q[i, 2] / 2) and turn.w == math.cos(sample.q[i, 2] / 2)
    assert len(message.transforms) == 3 * run.n_cars


def test_the_description_is_a_tree_whose_links_are_the_frames(run: PlanarSimulation) -> None:
    """As urdfdom and robot_state_publisher want it: one root, each other link of one joint."""
    root = ElementTree.fromstring(robot_description(run.params, "map", "north/"))
    links = [link.get("name") for link in root.findall("link")]
    joints = root.findall("joint")
    children = [joint.find("child").get("link") for joint in joints]
    assert len(set(links)) == len(links) and len(set(children)) == len(children)
    assert set(links) - set(children) == {"map"}
    assert {joint.find("parent").get("link") for joint in joints} <= set(links)
    moving = deserialize(
        TransformEncoder(run.params, CONTEXT, "north/")(run.sample()), "tf2_msgs/msg/TFMessage"
    )
    fixed = deserialize(static_transforms(run.params, CONTEXT, "north/"), "tf2_msgs/msg/TFMessage")
    sent = {t.child_frame_id: t for t in (*moving.transforms, *fixed.transforms)}
    assert set(sent) == set(children), "RobotModel asks TF for each link"
    for joint in joints:
        parent, child = joint.find("parent").get("link"), joint.find("child").get("link")
        assert sent[child].header.frame_id == parent
        if joint.get("type") != "floating":
            place = [float(v) for v in joint.find("origin").get("xyz").split()]
            t = sent[child].transform.translation
            assert [t.x, t.y, t.z] == pytest.approx(place, abs=1e-3)
    turning = [j.get("name") for j in joints if j.get("type") == "continuous"]
    assert turning == joint_names(run.n_cars, "north/")
    materials = {m.get("name") for m in root.findall("material")}
    assert {m.get("name") for m in root.iter("material")} == materials


def test_the_description_has_the_sizes_and_masses_of_the_train(run: PlanarSimulation) -> None:
    root = ElementTree.fromstring(robot_description(run.params))
    for number, car in enumerate(run.params.cars, 1):
        link = next(x for x in root.findall("link") if x.get("name") == f"car_{number}")
        length, width, _ = link.find("visual/geometry/box").get("size").split()
        assert (float(length), float(width)) == pytest.approx((car.length, car.width), rel=1e-5)
        # Bodies and wheels collide as they are drawn.
        assert len(link.findall("collision")) == 1
        for part in ("origin", "geometry/box"):
            assert link.find(f"collision/{part}").attrib == link.find(f"visual/{part}").attrib
        assert float(link.find("inertial/mass").get("value")) == pytest.approx(car.mass, rel=1e-5)
        izz = float(link.find("inertial/inertia").get("izz"))
        assert izz == pytest.approx(car.inertia, rel=1e-5)
