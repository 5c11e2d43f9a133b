"""The standard interface of simulators, by the types of the package ``simulation_interfaces`` 2.x.

Cars are the entities, ``car_1`` ...; scenarios are the worlds. What cannot be done is refused with
``RESULT_FEATURE_UNSUPPORTED``, and ``get_simulator_features`` lists what can.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from derail_ros import models
from derail_ros.nodes.commands import Answer
from derail_ros.nodes.core import NO_RUN, Refusal, SimulatorCore, State
from derail_ros.nodes.serving import DeferredService, service_qos, snake
from derail_ros.recording.session import Prepared, Session
from derail_ros.scenario import list_scenarios
from derail_ros.scenario.messages import did_you_mean
from derail_ros.vocabulary.params import Car
from derail_ros.vocabulary.shapes import box_of
from msg_adapters.car_frame import Motion, heights, motion
from msg_adapters.common import NANOSECONDS
from msg_adapters.markers import CAR_FLOOR, CAR_HEIGHT

FEATURES = (
    "ENTITY_TAGS", "ENTITY_BOUNDS", "ENTITY_BOUNDS_BOX", "ENTITY_CATEGORIES",
    "ENTITY_STATE_GETTING", "ENTITY_INFO_GETTING", "SIMULATION_RESET", "SIMULATION_RESET_STATE",
    "SIMULATION_STATE_GETTING", "SIMULATION_STATE_SETTING", "SIMULATION_STATE_PAUSE",
    "STEP_SIMULATION_SINGLE", "STEP_SIMULATION_MULTIPLE", "STEP_SIMULATION_ACTION",
    "WORLD_LOADING", "WORLD_RESOURCE_STRING", "WORLD_UNLOADING", "WORLD_INFO_GETTING",
    "AVAILABLE_WORLDS",
)  # fmt: skip
"""What works: names of constants of ``SimulatorFeatures``. Time is set to its start only together
with the state, so that SIMULATION_RESET_TIME is not among them."""
COLLIDING = ("set_simulation_state", "step_simulation", "reset_simulation")
"""Names that services of ``derail_msgs`` had before; these are below ``~/derail`` now."""
COLLIDING_FEATURES = (
    "SIMULATION_RESET", "SIMULATION_RESET_STATE", "SIMULATION_STATE_SETTING",
    "SIMULATION_STATE_PAUSE", "STEP_SIMULATION_SINGLE",
)  # fmt: skip
"""Features of these services."""
NO_WORLD = "no world is loaded"
EVERYWHERE = 1e9
"""No car is beyond, m: the products of larger bounds would be no numbers."""
TOUCHING = 1e-9
"""Boxes that are closer overlap, m: of parallel axes nothing is left but rounding."""
REFUSED = {
    "SpawnEntity": "the train is that of its scenario; load_world takes another one",
    "SpawnEntities": "the train is that of its scenario; load_world takes another one",
    "DeleteEntity": "cars cannot be taken out of a run",
    "SetEntityState": "cars move by their equations of motion only",
    "SetEntityInfo": "what a car is comes from the scenario",
    "GetSpawnables": "nothing can be spawned",
    "GetNamedPoses": "there are no named poses",
    "GetNamedPoseBounds": "there are no named poses",
}
"""Service -> why it is refused."""


class _Unsupported(Exception):
    """A request for a feature that the simulator does not have."""


class StandardInterface:
    """Offers the standard's services and its action on a node.

    They are in ``namespace``, by default in that of the node's own name. ``legacy`` names of
    :data:`COLLIDING` are left to the services of ``derail_msgs``.
    ``load`` reads a scenario (name, text) in its own thread, calls back, and counts as loading.

    Raises
    ------
    ImportError
        If ``simulation_interfaces`` is not installed.
    """

    def __init__(
        self,
        node: Any,
        core: SimulatorCore,
        load: Callable[[str, str, Callable[[Prepared | ValueError], None]], None],
        loading: Callable[[], bool],
        loaded: Callable[[str], None],
        *,
        namespace: str = "",
        legacy: bool = False,
    ) -> None:
        from simulation_interfaces import action, msg, srv

        self._core, self._load, self._loading, self._loaded = core, load, loading, loaded
        self._msg, self._srv, self._legacy = msg, srv, legacy
        self._ok = msg.Result(result=msg.Result.RESULT_OK)
        place = f"{(namespace or '~').rstrip('/')}/"
        for name in (
            "GetSimulatorFeatures", "GetSimulationState", "SetSimulationState", "ResetSimulation",
            "GetEntities", "GetEntityState", "GetEntitiesStates", "GetEntityInfo",
            "GetEntityBounds", "UnloadWorld", "GetCurrentWorld", "GetAvailableWorlds", *REFUSED,
        ):  # fmt: skip
            service = snake(name)
            # Releases before 2.1 have no SpawnEntities, older ones no worlds.
            if hasattr(srv, name) and not (legacy and service in COLLIDING):
                handler = self._refuser(name) if name in REFUSED else getattr(self, f"_{service}")
                kind = getattr(srv, name)
                node.create_service(kind, place + service, handler, qos_profile=service_qos())
        self._deferred = [
            DeferredService(node, getattr(srv, name), place + snake(name), handler)
            for name, handler in (("LoadWorld", self._load_world), ("StepSimulation", self._step))
            if hasattr(srv, name) and not (legacy and snake(name) in COLLIDING)
        ]
        kind = action.SimulateSteps
        self._action = _StepAction(node, kind, f"{place}simulate_steps", core, self._result)

    def _result(self, code: int, why: str) -> Any:
        return self._msg.Result(result=code, error_message=why)

    def _failed(self, why: str) -> Any:
        return self._result(self._msg.Result.RESULT_OPERATION_FAILED, why)

    def _unsupported(self, why: str) -> Any:
        return self._result(self._msg.Result.RESULT_FEATURE_UNSUPPORTED, why)

    def _refuser(self, name: str) -> Callable[[Any, Any], Any]:
        def refuse(request: Any, response: Any) -> Any:
            response.result = self._unsupported(REFUSED[name])
            return response

        return refuse

    # --- simulation ----------------------------------------------------------------------------

    def _get_simulator_features(self, request: Any, response: Any) -> Any:
        import derail_ros

        names = [name for name in FEATURES if not (self._legacy and name in COLLIDING_FEATURES)]
        known = self._msg.SimulatorFeatures
        numbers = [getattr(known, name) for name in names if hasattr(known, name)]
        response.features.features = numbers
        response.features.custom_info = (
            f"derail_ros {derail_ros.__version__}: train derailments; cars are the entities, "
            "scenarios the worlds; breaking rails and braking: services of derail_msgs"
        )
        return response

    def _get_simulation_state(self, request: Any, response: Any) -> Any:
        states = self._msg.SimulationState
        state = int(self._core.state)
        if self._loading():
            state = states.STATE_LOADING_WORLD
        elif self._core.session is None and self._core.state != State.QUITTING:
            state = states.STATE_NO_WORLD
        response.state.state, response.result = state, self._ok
        return response

    def _set_simulation_state(self, request: Any, response: Any) -> Any:
        wanted, core, kinds = int(request.state.state), self._core, type(response)
        before = core.state
        if wanted not in set(State):
            why = f"state must be {min(State)} to {max(State)} to be set, got {wanted}"
            response.result = self._result(kinds.INCORRECT_TRANSITION, why)
        elif wanted == before and core.session is not None and not core.stepping:
            why = f"already {before.name.lower()}"
            response.result = self._result(kinds.ALREADY_IN_TARGET_STATE, why)
        elif core.session is None and wanted != State.QUITTING:
            response.result = self._result(kinds.INCORRECT_TRANSITION, NO_WORLD)
        else:
            answer = core.set_state(wanted)
            code = kinds.STATE_TRANSITION_ERROR
            if wanted == State.QUITTING:
                code = self._msg.Result.RESULT_OPERATION_FAILED
            response.result = self._ok if answer.success else self._result(code, answer.message)
        return response

    def _reset_simulation(self, request: Any, response: Any) -> Any:
        kinds, scope = type(request), int(request.scope)
        if scope == kinds.SCOPE_DEFAULT:
            scope = kinds.SCOPE_ALL
        if not scope & kinds.SCOPE_STATE:
            why = "time is set to its start together with the state only; nothing is spawned"
            response.result = self._unsupported(why)
            return response
        answer = self._core.reset(1 if scope & kinds.SCOPE_TIME else 0)
        response.result = self._ok if answer.success else self._state_error(answer)
        return response

    def _state_error(self, answer: Answer) -> Any:
        none = self._core.session is None
        results = self._msg.Result
        code = results.RESULT_INCORRECT_STATE if none else results.RESULT_OPERATION_FAILED
        return self._result(code, _in_words_of_the_standard(answer))

    def _step(self, request: Any, response: Any, finish: Callable[[], None]) -> None:
        def done(answer: Answer) -> None:
            response.result = (
                self._ok if answer.success else self._failed(_in_words_of_the_standard(answer))
            )
            finish()

        self._core.step_simulation(int(request.steps), done, field="steps")

    # --- entities ------------------------------------------------------------------------------

    @property
    def _run(self) -> Session:
        if self._core.session is None:
            raise Refusal(NO_WORLD)
        return self._core.session

    def _car(self, name: str) -> int:
        """Index of the car of a name, or a refusal."""
        found = re.fullmatch(r"car_([1-9][0-9]{0,5})", name)
        n = self._run.simulation.n_cars
        if found is None or int(found[1]) > n:
            raise Refusal(f"there is no entity {name!r}; they are car_1 to car_{n}")
        return int(found[1]) - 1

    def _of_car(self, request: Any, response: Any, fill: Callable[[int], None]) -> Any:
        """Answer a request about one car."""
        results = self._msg.Result
        try:
            fill(self._car(request.entity))
            response.result = self._ok
        except Refusal as error:
            none = self._core.session is None
            code = results.RESULT_INCORRECT_STATE if none else results.RESULT_NOT_FOUND
            response.result = self._result(code, str(error))
        return response

    def _get_entity_state(self, request: Any, response: Any) -> Any:
        def fill(i: int) -> None:
            response.state = self._state(i)

        return self._of_car(request, response, fill)

    def _get_entity_info(self, request: Any, response: Any) -> Any:
        def fill(i: int) -> None:
            response.info = self._info(i)

        return self._of_car(request, response, fill)

    def _get_entity_bounds(self, request: Any, response: Any) -> Any:
        from geometry_msgs.msg import Vector3

        def fill(i: int) -> None:
            corners = self._box(self._run.params.cars[i]).tolist()
            response.bounds.type = self._msg.Bounds.TYPE_BOX
            response.bounds.points = [Vector3(x=x, y=y, z=z) for x, y, z in corners]

        return self._of_car(request, response, fill)

    def _get_entities(self, request: Any, response: Any) -> Any:
        self._filtered(request, response)
        return response

    def _get_entities_states(self, request: Any, response: Any) -> Any:
        response.states = [self._state(i) for i in self._filtered(request, response)]
        return response

    def _filtered(self, request: Any, response: Any) -> list[int]:
        """Fill in result and names of the entities that pass the filters; gives their indices."""
        try:
            cars = self._pass(request.filters)
        except (Refusal, re.error) as error:
            response.result = self._failed(str(error))
            return []
        except _Unsupported as error:
            response.result = self._unsupported(str(error))
            return []
        response.result, response.entities = self._ok, [f"car_{i + 1}" for i in cars]
        return cars

    def _pass(self, filters: Any) -> list[int]:
        if self._core.session is None:
            return []
        session, msg = self._core.session, self._msg
        name = re.compile(filters.filter)
        cars = [i for i in range(session.simulation.n_cars) if name.search(f"car_{i + 1}")]
        categories = {category.category for category in filters.categories}
        if categories and msg.EntityCategory.CATEGORY_DYNAMIC_OBJECT not in categories:
            return []
        if wanted := set(filters.tags.tags):
            whole = filters.tags.filter_mode == msg.TagsFilter.FILTER_MODE_ALL
            of = {i: wanted & set(self._info(i).tags) for i in cars}
            cars = [i for i in cars if (of[i] == wanted if whole else of[i])]
        if filters.bounds.type != msg.Bounds.TYPE_EMPTY:
            cars = [i for i in cars if self._overlaps(i, filters.bounds)]
        return cars

    def _overlaps(self, i: int, bounds: Any) -> bool:
        """Whether a car's box overlaps with bounds in the world."""
        car = self._run.params.cars[i]
        kinds = self._msg.Bounds
        points = np.array([[p.x, p.y, p.z] for p in bounds.points]).reshape(-1, 3)
        if bounds.type not in (kinds.TYPE_BOX, kinds.TYPE_SPHERE):
            raise _Unsupported("bounds must be a box (1) or a sphere (3)")
        if len(points) != 2 or not np.isfinite(points).all():
            raise Refusal(f"bounds must have 2 points of finite numbers, got {len(points)}")
        if bounds.type == kinds.TYPE_SPHERE and points[1, 0] < 0.0:
            raise Refusal(f"the radius of bounds must be from 0 up, got {points[1, 0]:g}")
        points = np.clip(points, -EVERYWHERE, EVERYWHERE)
        moving = self._motion(i)
        upper, lower = self._box(car)
        turn, half = moving.axes[0], 0.5 * (upper - lower)
        middle = moving.place[0] + turn @ (0.5 * (upper + lower))
        if bounds.type == kinds.TYPE_SPHERE:
            beyond = np.maximum(np.abs(turn.T @ (points[0] - middle)) - half, 0.0)
            return bool(np.linalg.norm(beyond) <= points[1, 0])
        least, most = points.min(axis=0), points.max(axis=0)
        apart, size = 0.5 * (least + most) - middle, 0.5 * (most - least)
        # Separating axes: those of the box, those of the car, and across one of each.
        across = np.cross(np.eye(3)[:, None], turn.T[None]).reshape(-1, 3)
        lines = np.concatenate([np.eye(3), turn.T, across])
        reach = np.abs(lines) @ size + np.abs(lines @ turn) @ half
        return bool((np.abs(lines @ apart) <= reach + TOUCHING).all())

    def _box(self, car: Car) -> NDArray[np.float64]:
        """Upper and lower corner of the box of a car in its frame, m."""
        width, top = car.width, CAR_FLOOR + CAR_HEIGHT
        if models.rises(self._run.params.model):
            width, top = box_of(car)
        x, y = 0.5 * car.length, 0.5 * width
        return np.array([[x, y, top], [-x, -y, 0.0]])

    def _motion(self, i: int) -> Motion:
        session = self._run
        one = slice(i, i + 1)
        return motion(session.sample, heights(session.params.cars[one]), one)

    def _state(self, i: int) -> Any:
        session = self._run
        moving, state = self._motion(i), self._msg.EntityState()
        state.header.frame_id = session.context.frame_id
        stamp = divmod(session.stamp, NANOSECONDS)
        state.header.stamp.sec, state.header.stamp.nanosec = stamp
        pose = state.pose.position, state.pose.orientation
        twist, growth = state.twist, state.acceleration
        for names, message, numbers in (
            ("xyz", pose[0], moving.place[0]),
            ("xyzw", pose[1], session.sample.quaternions[i]),
            ("xyz", twist.linear, moving.velocity[0]),
            ("xyz", twist.angular, moving.spin[0]),
            ("xyz", growth.linear, moving.acceleration[0]),
            ("xyz", growth.angular, moving.spin_growth[0]),
        ):
            for name, number in zip(names, numbers.tolist()):
                setattr(message, name, number)
        return state

    def _info(self, i: int) -> Any:
        session, info = self._run, self._msg.EntityInfo()
        car, kind = session.params.cars[i], session.prepared.car_types[i]
        info.category.category = self._msg.EntityCategory.CATEGORY_DYNAMIC_OBJECT
        off = not session.sample.truck_on[i].all()
        info.tags = [tag for tag in (kind, car.contents) if tag]
        info.tags += ["derailed" if off else "on_the_rails"]
        name = car.name or kind or "car"
        many = f", stands for {car.represents} cars" if car.represents > 1 else ""
        load = f", {car.contents}" if car.contents else ""
        size = f"{car.length:.1f} m by {car.width:.1f} m, {car.mass / 1000:.1f} t"
        info.description = f"{name}: {size}{load}{many}"
        return info

    # --- worlds --------------------------------------------------------------------------------

    def _load_world(self, request: Any, response: Any, finish: Callable[[], None]) -> None:
        kinds = type(response)
        # Release 2.0 has the two fields in the request itself.
        resource = getattr(request, "world_resource", request)
        name, text = resource.uri, resource.resource_string
        if bool(name) == bool(text):
            why = "uri and resource_string are both given; give one of them"
            if not name:
                why = "give the name of a scenario as uri, or its YAML as resource_string"
            response.result = self._result(kinds.NO_RESOURCE, why)
            finish()
            return

        def begin(prepared: Prepared | ValueError) -> None:
            fields = {"scenario_name": name, "scenario_yaml": text, "start_paused": True}
            if isinstance(prepared, ValueError) and name:
                known = [scenario.name for scenario in self._scenarios()]
                if name not in known and "did you mean" not in str(prepared):
                    prepared = ValueError(f"{prepared}{_near_world(name, known)}")
            answer = self._core.load(
                prepared, fields, "load_world", State.STOPPED, service="load_world"
            )
            if answer.success:
                response.result, response.world = self._ok, self._world()
                self._loaded(name)
            else:
                missing = self._msg.Result.RESULT_NOT_FOUND
                code = kinds.RESOURCE_PARSE_ERROR if text else missing
                response.result = self._result(code, answer.message)
            finish()

        self._load(name, text, begin)

    def _world(self) -> Any:
        prepared, world = self._run.prepared, self._msg.WorldResource()
        world.name, world.world_resource.resource_string = prepared.name, prepared.yaml
        world.description = str(prepared.resolved.get("title", ""))
        if prepared.name in {scenario.name for scenario in self._scenarios()}:
            world.world_resource.uri = prepared.name
        return world

    def _scenarios(self) -> list[Any]:
        return list_scenarios(self._core.settings.scenario_dirs)

    def _unload_world(self, request: Any, response: Any) -> Any:
        answer = self._core.unload()
        code, why = type(response).NO_WORLD_LOADED, _in_words_of_the_standard(answer)
        response.result = self._ok if answer.success else self._result(code, why)
        if answer.success:
            self._loaded("")
        return response

    def _get_current_world(self, request: Any, response: Any) -> Any:
        if self._core.session is None:
            response.result = self._result(type(response).NO_WORLD_LOADED, NO_WORLD)
        else:
            response.result, response.world = self._ok, self._world()
        return response

    def _get_available_worlds(self, request: Any, response: Any) -> Any:
        elsewhere = bool(request.additional_sources) and not request.continue_on_error
        if elsewhere or request.filter.tags:
            response.result = self._unsupported(
                "scenarios have no tags, and are looked for in the folders of scenario_dirs only"
            )
            return response
        response.result = self._ok
        for scenario in self._scenarios():
            world = self._msg.WorldResource(name=scenario.name, description=scenario.title)
            world.world_resource.uri = scenario.name
            response.worlds.append(world)
        return response


def _in_words_of_the_standard(answer: Answer) -> str:
    """The reason of a refusal: what is loaded is a world there."""
    return NO_WORLD if answer.message == NO_RUN else answer.message


def _near_world(name: str, known: list[str]) -> str:
    """What to give in place of a name that is none of a scenario."""
    last = name.rstrip("/").rpartition("/")[2].removesuffix(".yaml")
    if last in known:
        return f"; give the name alone: {last}"
    text = "" if last == name else "; uri must be the name of a scenario, no path and no address"
    return f"{text}{did_you_mean(last, known)}"


class _StepAction:
    """The action ``simulate_steps``: ticks with feedback after each, which can be cancelled."""

    def __init__(self, node: Any, kind: Any, name: str, core: SimulatorCore, result: Any) -> None:
        from rclpy.action import ActionServer, CancelResponse

        self._kind, self._core, self._make = kind, core, result
        self._answer: dict[bytes, Answer] = {}
        self._server = ActionServer(
            node,
            kind,
            name,
            self._finish,
            handle_accepted_callback=self._begin,
            goal_callback=self._accept,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
        )
        self._log = node.get_logger()

    def _accept(self, goal: Any) -> Any:
        from rclpy.action import GoalResponse

        if goal.steps >= 1:
            return GoalResponse.ACCEPT
        # The protocol has no room for a reason.
        self._log.warning(f"simulate_steps refused: steps must be at least 1, got {goal.steps}")
        return GoalResponse.REJECT

    def _begin(self, goal: Any) -> None:
        # The goal is executed, in rclpy's words, once its ticks are done: its executor would
        # look at a coroutine that waits all the time, and serve nothing else.
        identity = bytes(goal.goal_id.uuid)

        def progress(made: int, left: int) -> bool:
            feedback = self._kind.Feedback(completed_steps=made, remaining_steps=left)
            goal.publish_feedback(feedback)
            return not goal.is_cancel_requested

        def done(answer: Answer) -> None:
            self._answer[identity] = answer
            goal.execute()

        name = "simulate_steps"
        steps = int(goal.request.steps)
        self._core.step_simulation(steps, done, name, progress, service=name, field="steps")

    def _finish(self, goal: Any) -> Any:
        from simulation_interfaces.msg import Result

        answer = self._answer.pop(bytes(goal.goal_id.uuid))
        if goal.is_cancel_requested:
            goal.canceled()
        elif answer.success:
            goal.succeed()
        else:
            goal.abort()
        code = Result.RESULT_OK if answer.success else Result.RESULT_OPERATION_FAILED
        why = "" if answer.success else _in_words_of_the_standard(answer)
        return self._kind.Result(result=self._make(code, why))
