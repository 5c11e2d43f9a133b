"""The standard interface of simulators, as a client written for another simulator uses it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy")
pytest.importorskip("derail_msgs")
pytest.importorskip("simulation_interfaces")

from action_msgs.msg import GoalStatus
from geometry_msgs.msg import Vector3
from rclpy.action import ActionClient
from simulation_interfaces import msg, srv
from simulation_interfaces.action import SimulateSteps
from simulation_interfaces.msg import Bounds, Resource, Result, SimulationState, SimulatorFeatures

from derail_ros.nodes.serving import snake
from derail_ros.nodes.standard import FEATURES, REFUSED
from tests.nodes.graph import Graph, graph
from tests.nodes.support import ENDLESS, SMALL

pytestmark = pytest.mark.ros

STOPPED, PLAYING, PAUSED, NO_WORLD = 0, 1, 2, 4
KINDS = [name for name in dir(srv) if re.fullmatch(r"[A-Z][A-Za-z]+", name)]


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Graph:
    folder = tmp_path_factory.mktemp("standard")
    (folder / "scenarios").mkdir()
    (folder / "scenarios" / "endless.yaml").write_text(ENDLESS)
    with graph(folder) as found:
        found.process = found.simulator(scenario="", scenario_dirs=f"[{folder / 'scenarios'}]")
        found.listen("train_state", "/clock")
        yield found
        assert found.process.end() == 0, found.process.output
        assert "Traceback" not in found.process.output


def call(made: Graph, name: str, **fields: Any) -> Any:
    """Call a service of the standard."""
    client = made.node.create_client(getattr(srv, name), f"/simulator/{snake(name)}")
    made.until(client.service_is_ready, f"{name} is there")
    future = client.call_async(getattr(srv, name).Request(**fields))
    made.until(future.done, f"{name} answers")
    made.node.destroy_client(client)
    return future.result()


def code(answer: Any) -> int:
    result = answer.result
    assert result.result == Result.RESULT_OK or result.error_message, "a refusal has a reason"
    return int(result.result)


def state(made: Graph) -> int:
    return int(call(made, "GetSimulationState").state.state)


def go_to(made: Graph, wanted: int) -> int:
    return code(call(made, "SetSimulationState", state=SimulationState(state=wanted)))


@pytest.fixture
def loaded(made: Graph) -> Graph:
    """Three cars, stopped."""
    resource = Resource(resource_string=ENDLESS)
    assert code(call(made, "LoadWorld", world_resource=resource)) == Result.RESULT_OK
    return made


def types_of(made: Graph, service: str) -> list[str]:
    """Types of a service, once the graph knows it."""
    path = f"/simulator/{service}"
    found = made.until(
        lambda: dict(made.node.get_service_names_and_types()).get(path), f"{path} is there"
    )
    return list(found)


def test_every_service_of_the_standard_is_there(made: Graph) -> None:
    for name in KINDS:
        assert types_of(made, snake(name)) == [f"simulation_interfaces/srv/{name}"]
    for name in ("set_simulation_state", "step_simulation", "reset_simulation"):
        (kind,) = types_of(made, f"derail/{name}")
        assert kind.startswith("derail_msgs/srv/")


def test_what_is_not_there_is_refused_and_not_listed(made: Graph) -> None:
    listed = set(call(made, "GetSimulatorFeatures").features.features)
    assert listed == {getattr(SimulatorFeatures, name) for name in FEATURES}
    for name in REFUSED:
        assert code(call(made, name)) == Result.RESULT_FEATURE_UNSUPPORTED
    f = SimulatorFeatures
    missing = (f.SPAWNING, f.SPAWNING_ENTITIES, f.DELETING, f.NAMED_POSES, f.POSE_BOUNDS,
               f.ENTITY_STATE_SETTING, f.ENTITY_INFO_SETTING, f.SPAWNABLES)  # fmt: skip
    assert not listed & set(missing)


def test_without_a_world(made: Graph) -> None:
    call(made, "UnloadWorld")
    assert state(made) == NO_WORLD
    assert code(call(made, "UnloadWorld")) == srv.UnloadWorld.Response.NO_WORLD_LOADED
    assert code(call(made, "GetCurrentWorld")) == srv.GetCurrentWorld.Response.NO_WORLD_LOADED
    assert go_to(made, PLAYING) == srv.SetSimulationState.Response.INCORRECT_TRANSITION
    assert code(call(made, "StepSimulation", steps=1)) == Result.RESULT_OPERATION_FAILED
    assert code(call(made, "ResetSimulation")) == Result.RESULT_INCORRECT_STATE
    assert call(made, "GetEntities").entities == []
    assert code(call(made, "GetEntityState", entity="car_1")) == Result.RESULT_INCORRECT_STATE


def test_no_state_is_reached_without_a_world(made: Graph) -> None:
    call(made, "UnloadWorld")
    kinds = srv.SetSimulationState.Response
    for state in (0, 1, 2):
        answer = call(made, "SetSimulationState", state=SimulationState(state=state))
        assert answer.result.result == kinds.INCORRECT_TRANSITION, state
        assert call(made, "GetSimulationState").state.state == SimulationState.STATE_NO_WORLD


def test_worlds_are_the_scenarios(made: Graph) -> None:
    worlds = {w.name: w for w in call(made, "GetAvailableWorlds").worlds}
    assert {"endless", "mississauga", "base_train"} <= set(worlds)
    assert worlds["endless"].description == "Three cars that roll on"
    resource = worlds["endless"].world_resource
    assert resource.uri == "endless"
    answer = call(made, "LoadWorld", world_resource=resource)
    assert code(answer) == Result.RESULT_OK and answer.world.name == "endless"
    assert state(made) == STOPPED
    world = call(made, "GetCurrentWorld").world
    assert (world.name, world.world_resource.uri) == ("endless", "endless")
    assert made.get_parameter("scenario") == "endless"
    # Its text is a world again.
    again = Resource(resource_string=world.world_resource.resource_string)
    assert code(call(made, "LoadWorld", world_resource=again)) == Result.RESULT_OK
    assert len(call(made, "GetEntities").entities) == 3
    sources = call(made, "GetAvailableWorlds", additional_sources=["/etc"])
    assert code(sources) == Result.RESULT_FEATURE_UNSUPPORTED
    sources = call(made, "GetAvailableWorlds", additional_sources=["/etc"], continue_on_error=True)
    assert code(sources) == Result.RESULT_OK and {w.name for w in sources.worlds} == set(worlds)


@pytest.mark.parametrize(
    ("resource", "expected"),
    [
        (Resource(), srv.LoadWorld.Response.NO_RESOURCE),
        (Resource(uri="base_train", resource_string=ENDLESS), srv.LoadWorld.Response.NO_RESOURCE),
        (Resource(uri="nowhere"), Result.RESULT_NOT_FOUND),
        (Resource(uri="/etc/passwd"), Result.RESULT_NOT_FOUND),
        (Resource(resource_string="<sdf/>"), srv.LoadWorld.Response.RESOURCE_PARSE_ERROR),
    ],
)
def test_a_world_that_cannot_be_loaded_leaves_the_present_one(loaded, resource, expected) -> None:
    assert code(call(loaded, "LoadWorld", world_resource=resource)) == expected
    assert len(call(loaded, "GetEntities").entities) == 3


@pytest.mark.parametrize(
    ("resource", "reason"),
    [
        (Resource(uri="base_train", resource_string="x"), "uri and resource_string are both"),
        (Resource(), "give the name of a scenario as uri, or its YAML as resource_string"),
        (Resource(uri="base_trian"), "did you mean 'base_train'?"),
        (Resource(uri="/opt/worlds/base_train.yaml"), "give the name alone: base_train"),
        (Resource(uri="file:///opt/base_trian.yaml"), "uri must be the name of a scenario"),
    ],
)  # fmt: skip
def test_a_world_that_is_not_there_says_what_to_give(loaded, resource, reason) -> None:
    assert reason in call(loaded, "LoadWorld", world_resource=resource).result.error_message


def test_the_standard_speaks_of_worlds(made: Graph) -> None:
    call(made, "UnloadWorld")
    for answer in (
        call(made, "UnloadWorld"), call(made, "GetCurrentWorld"), call(made, "ResetSimulation"),
        call(made, "StepSimulation", steps=1), call(made, "GetEntityState", entity="car_1"),
        call(made, "SetSimulationState", state=SimulationState(state=PLAYING)),
    ):  # fmt: skip
        assert answer.result.error_message == "no world is loaded"


def test_a_goal_without_steps_is_rejected(loaded: Graph) -> None:
    go_to(loaded, PAUSED)
    client = ActionClient(loaded.node, SimulateSteps, "/simulator/simulate_steps")
    loaded.until(client.server_is_ready, "the action is there")
    future = client.send_goal_async(SimulateSteps.Goal(steps=0))
    loaded.until(future.done, "the goal is answered")
    assert not future.result().accepted
    answer = call(loaded, "StepSimulation", steps=0)
    assert "steps must be at least 1, got 0" in answer.result.error_message


def test_states_and_transitions(loaded: Graph) -> None:
    already = srv.SetSimulationState.Response.ALREADY_IN_TARGET_STATE
    assert state(loaded) == STOPPED and go_to(loaded, STOPPED) == already
    assert go_to(loaded, PLAYING) == Result.RESULT_OK and state(loaded) == PLAYING
    assert go_to(loaded, PAUSED) == Result.RESULT_OK and go_to(loaded, PAUSED) == already
    assert go_to(loaded, NO_WORLD) == srv.SetSimulationState.Response.INCORRECT_TRANSITION
    assert go_to(loaded, 3) == Result.RESULT_OPERATION_FAILED, "quitting needs allow_quit"
    assert go_to(loaded, STOPPED) == Result.RESULT_OK and state(loaded) == STOPPED


def test_steps_are_made_while_paused_only(loaded: Graph) -> None:
    assert code(call(loaded, "StepSimulation", steps=3)) == Result.RESULT_OPERATION_FAILED
    go_to(loaded, PAUSED)
    at = call(loaded, "GetEntityState", entity="car_1").state
    assert code(call(loaded, "StepSimulation", steps=5)) == Result.RESULT_OK
    after = call(loaded, "GetEntityState", entity="car_1").state
    moved = after.pose.position.x - at.pose.position.x
    # 70 km/h, 5 ticks of 20 ms, nothing that brakes.
    assert moved == pytest.approx(0.1 * 70 / 3.6, rel=1e-3)
    assert after.twist.linear.x == pytest.approx(70 / 3.6, rel=1e-3)
    assert after.header.frame_id == "map" and state(loaded) == PAUSED


def test_resets(loaded: Graph) -> None:
    scopes = srv.ResetSimulation.Request
    go_to(loaded, PAUSED)
    start = call(loaded, "GetEntityState", entity="car_2").state
    call(loaded, "StepSimulation", steps=10)
    for scope, zero in ((scopes.SCOPE_STATE, False), (scopes.SCOPE_DEFAULT, True)):
        before = call(loaded, "GetEntityState", entity="car_2").state
        assert code(call(loaded, "ResetSimulation", scope=scope)) == Result.RESULT_OK
        after = call(loaded, "GetEntityState", entity="car_2").state
        assert after.pose == start.pose
        times = [s.header.stamp.sec + 1e-9 * s.header.stamp.nanosec for s in (before, after)]
        assert times[1] == 1.0 if zero else times[1] > times[0]
        call(loaded, "StepSimulation", steps=10)
    for scope in (scopes.SCOPE_TIME, scopes.SCOPE_SPAWNED):
        refused = call(loaded, "ResetSimulation", scope=scope)
        assert code(refused) == Result.RESULT_FEATURE_UNSUPPORTED


def test_cars_are_entities(loaded: Graph) -> None:
    assert call(loaded, "GetEntities").entities == ["car_1", "car_2", "car_3"]
    info = call(loaded, "GetEntityInfo", entity="car_2").info
    assert info.category.category == msg.EntityCategory.CATEGORY_DYNAMIC_OBJECT
    assert "on_the_rails" in info.tags and " t" in info.description
    bounds = call(loaded, "GetEntityBounds", entity="car_2").bounds
    assert bounds.type == Bounds.TYPE_BOX and len(bounds.points) == 2
    upper, lower = bounds.points
    assert upper.x == -lower.x > 5.0 and upper.y == -lower.y > 1.0 and upper.z > lower.z
    for name in ("car_0", "car_4", "car_01", "train", ""):
        for service in ("GetEntityState", "GetEntityInfo", "GetEntityBounds"):
            assert code(call(loaded, service, entity=name)) == Result.RESULT_NOT_FOUND
    answer = call(loaded, "GetEntitiesStates")
    assert len(answer.states) == len(answer.entities) == 3
    assert answer.states[0].pose.position.x > answer.states[2].pose.position.x, "car 1 leads"


def test_filters(loaded: Graph) -> None:
    def found(**filters: Any) -> list[str]:
        answer = call(loaded, "GetEntities", filters=msg.EntityFilters(**filters))
        assert code(answer) == Result.RESULT_OK
        return list(answer.entities)

    car, human = (msg.EntityCategory(category=c) for c in (4, 2))
    assert found(filter="_[12]$") == ["car_1", "car_2"]
    assert found(categories=[human]) == [] and len(found(categories=[human, car])) == 3
    both = msg.TagsFilter(tags=["derailed", "on_the_rails"])
    assert len(found(tags=both)) == 3
    both.filter_mode = msg.TagsFilter.FILTER_MODE_ALL
    assert found(tags=both) == []
    place = call(loaded, "GetEntityState", entity="car_2").state.pose.position
    ball = [Vector3(x=place.x, y=place.y, z=place.z), Vector3(x=0.5)]
    assert found(bounds=Bounds(type=Bounds.TYPE_SPHERE, points=ball)) == ["car_2"]
    ball[0].y += 10.0
    assert found(bounds=Bounds(type=Bounds.TYPE_SPHERE, points=ball)) == []
    box = [Vector3(x=place.x + 0.1, y=9.0, z=9.0), Vector3(x=place.x - 0.1, y=-9.0)]
    assert found(bounds=Bounds(type=Bounds.TYPE_BOX, points=box)) == ["car_2"]
    box[1].y = 5.0
    assert found(bounds=Bounds(type=Bounds.TYPE_BOX, points=box)) == []
    huge = [Vector3(x=s * 1e308, y=s * 1e308, z=s * 1e308) for s in (1.0, -1.0)]
    assert len(found(bounds=Bounds(type=Bounds.TYPE_BOX, points=huge))) == 3
    for filters, expected in (
        ({"filter": "["}, Result.RESULT_OPERATION_FAILED),
        ({"bounds": Bounds(type=1, points=box[:1])}, Result.RESULT_OPERATION_FAILED),
        ({"bounds": Bounds(type=3, points=[*ball[:1], huge[1]])}, Result.RESULT_OPERATION_FAILED),
        ({"bounds": Bounds(type=2, points=[*box, *box])}, Result.RESULT_FEATURE_UNSUPPORTED),
    ):
        answer = call(loaded, "GetEntities", filters=msg.EntityFilters(**filters))
        assert code(answer) == expected


def send(made: Graph, steps: int, feedback: list) -> Any:
    client = ActionClient(made.node, SimulateSteps, "/simulator/simulate_steps")
    made.until(client.server_is_ready, "the action is there")
    future = client.send_goal_async(
        SimulateSteps.Goal(steps=steps), lambda m: feedback.append(m.feedback)
    )
    made.until(future.done, "the goal is answered")
    goal = future.result()
    assert goal.accepted
    return goal


def finished(made: Graph, goal: Any) -> Any:
    future = goal.get_result_async()
    made.until(future.done, "the action ends")
    return future.result()


def test_the_action_tells_after_each_step(loaded: Graph) -> None:
    go_to(loaded, PAUSED)
    # The action's client of rclpy drops what comes after the result: who listens gets it all.
    told: list = []
    loaded.node.create_subscription(
        SimulateSteps.Impl.FeedbackMessage,
        "/simulator/simulate_steps/_action/feedback",
        lambda m: told.append(m.feedback),
        100,
    )
    while not told:  # until the subscriber has matched
        assert finished(loaded, send(loaded, 1, [])).status == GoalStatus.STATUS_SUCCEEDED
        loaded.spin()
    feedback: list = []
    answer = finished(loaded, send(loaded, 20, feedback))
    assert answer.status == GoalStatus.STATUS_SUCCEEDED
    assert answer.result.result.result == Result.RESULT_OK
    last = (20, 0)
    loaded.until(
        lambda: last in [(f.completed_steps, f.remaining_steps) for f in told], "the last feedback"
    )
    assert all(f.completed_steps + f.remaining_steps == 20 for f in feedback)
    assert state(loaded) == PAUSED


def test_the_action_can_be_cancelled(loaded: Graph) -> None:
    go_to(loaded, PAUSED)
    feedback: list = []
    goal = send(loaded, 10**12, feedback)
    loaded.until(lambda: len(feedback) > 2, "it steps")
    cancel = goal.cancel_goal_async()
    loaded.until(cancel.done, "cancelling is answered")
    answer = finished(loaded, goal)
    assert answer.status == GoalStatus.STATUS_CANCELED
    assert answer.result.result.result == Result.RESULT_OPERATION_FAILED
    at = call(loaded, "GetEntityState", entity="car_1").state.pose
    assert call(loaded, "GetEntityState", entity="car_1").state.pose == at, "it stands"
    assert code(call(loaded, "StepSimulation", steps=1)) == Result.RESULT_OK


def test_the_action_of_a_run_that_plays_fails(loaded: Graph) -> None:
    go_to(loaded, PLAYING)
    answer = finished(loaded, send(loaded, 5, []))
    assert answer.status == GoalStatus.STATUS_ABORTED
    assert answer.result.result.result == Result.RESULT_OPERATION_FAILED
    assert "paused" in answer.result.result.error_message


def test_old_names_are_there_if_they_are_wanted(tmp_path: Path) -> None:
    with graph(tmp_path) as other:
        other.simulator(scenario="", legacy_service_names=True)
        for name in ("set_simulation_state", "step_simulation", "reset_simulation"):
            (kind,) = types_of(other, name)
            assert kind.startswith("derail_msgs/srv/")
        client = other.node.create_client(
            srv.GetSimulatorFeatures, "/simulator/get_simulator_features"
        )
        other.until(client.service_is_ready, "the standard's others are there")
        future = client.call_async(srv.GetSimulatorFeatures.Request())
        other.until(future.done, "it answers")
        listed = set(future.result().features.features)
        assert SimulatorFeatures.SIMULATION_STATE_SETTING not in listed
        assert SimulatorFeatures.STEP_SIMULATION_ACTION in listed
        assert other.ask("load_consist", scenario_yaml=SMALL, start_paused=True).success


def test_clients_that_call_at_the_root_find_everything(tmp_path: Path) -> None:
    """Clients of Isaac Sim and O3DE call `/get_entities`; a panel of RViz looks for types."""
    with graph(tmp_path) as other:
        other.simulator(scenario="", standard_namespace="/")
        names = {snake(name) for name in KINDS}

        def found() -> dict[str, list[str]]:
            listed = other.node.get_service_names_and_types()
            return {n: t for n, t in listed if t[0].startswith("simulation_interfaces/")}

        places = {f"/{name}" for name in names}
        action = {"/simulate_steps/_action/send_goal", "/simulate_steps/_action/get_result"}
        other.until(lambda: places | action <= set(found()), "all are at the root")
        assert set(found()) == places | action
        assert other.ask("load_consist", scenario_yaml=SMALL, start_paused=True).success
