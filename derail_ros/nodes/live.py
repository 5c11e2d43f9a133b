"""What follows from the messages of a recording: frames, joints, sensors, maps."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from derail_ros.nodes.outputs import Output
from derail_ros.nodes.parameters import SENSORS, Settings
from derail_ros.recording.recorded_run import Cars, SampledLine
from derail_ros.recording.session import Prepared
from derail_ros.review import maps
from derail_ros.vocabulary.events import EventKind
from derail_ros.vocabulary.place import Datum, datum_of
from derail_ros.vocabulary.sample import Sample
from derail_ros.vocabulary.simulation import Simulation
from msg_adapters import reports, sensors
from msg_adapters.common import RunContext
from msg_adapters.definitions import serialize
from msg_adapters.frames import (
    JointEncoder,
    TransformEncoder,
    robot_description,
    static_transforms,
)
from msg_adapters.markers import (
    BALLAST,
    CONCRETE,
    DERAILED,
    GREEN,
    HARD,
    ON_RAILS,
    SOIL,
    STANDING,
    STRUCK_HARD,
)
from msg_adapters.sensors import Sensor
from msg_adapters.topics import ON_MAP

Messages = list[tuple[str, bytes]]
GRAIN = 1e-9
"""Times closer than this are the same, s."""


def chosen_cars(text: str, n_cars: int) -> list[tuple[int, str]]:
    """Indices of cars, and what stands after a colon: ``"all"``, ``"1 20-25 30:front_truck"``.

    Each once; cars that the train does not have are left out.
    """
    found: dict[tuple[int, str], None] = {}
    for part in re.split(r"[\s,]+", text.strip()):
        cars, _, place = part.partition(":")
        first, _, last = cars.partition("-")
        if cars == "all":
            first, last = "1", str(n_cars)
        if first:
            low, high = sorted((int(first), int(last or first)))
            found |= {(i - 1, place): None for i in range(low, min(high, n_cars) + 1)}
    return list(found)


def _style(told: dict[str, Any]) -> dict[str, Any]:
    """How a map of Foxglove draws a feature: in the colours of the markers."""
    if "car" not in told:
        roles = {"fixed": CONCRETE, "zone": SOIL, "area": GREEN}
        color, filled = roles.get(told["role"], BALLAST), 0.1
    elif told["largest_force_N"] > HARD:
        color, filled = STRUCK_HARD, 0.6
    elif told["derailed"]:
        color, filled = DERAILED, 0.6
    else:
        color, filled = STANDING if told["standing"] else ON_RAILS, 0.6
    code = "#" + "".join(f"{round(255 * part):02x}" for part in color)
    return {"color": code, "weight": 2, "fillOpacity": filled}


class OnMap:
    """The place of a run and its cars at rest, as ``foxglove_msgs/GeoJSON``."""

    def __init__(
        self, prepared: Prepared, simulation: Simulation, context: RunContext, datum: Datum
    ) -> None:
        self._simulation, self._map = simulation, maps.Map(datum)
        self._start = simulation.sample()
        params, track = simulation.params, simulation.track
        coordinates = reports.track_coordinates(track, self._start.truck_coordinate)
        self._line = SampledLine.of_message(reports.track(track, coordinates, (), context))
        self._cars = Cars.of_message(
            reports.consist(params, context, car_types=prepared.car_types)
        )

    def message(self, *, ended: bool) -> bytes:
        """CDR bytes; the cars are there once the run has ended."""
        run = self._simulation
        pose = np.stack([self._start.pose, run.sample().pose])
        found = maps.place(self._line, run.params.site, pose, self._map)
        if ended:
            collisions = run.collisions
            found += maps.footprints(
                self._cars, self._line, pose[1], run.outcome(), collisions, self._map
            )
        for feature in found:
            told = feature["properties"]
            told["style"] = _style(told)
            told.setdefault("name", f"car {told.get('car')}: {told.get('type')}")
        return geojson(self._map.collection(found))


def geojson(data: dict[str, Any]) -> bytes:
    """CDR bytes of ``foxglove_msgs/GeoJSON``, which are those of a text."""
    return serialize(reports.string(json.dumps(data)))


NOTHING_ON_MAP = geojson({"type": "FeatureCollection", "features": []})


class LiveMessages:
    """The messages of one run that follow from those of its recording; see ``session.Live``."""

    def __init__(
        self,
        settings: Settings,
        output: Output,
        log: Any,
        prepared: Prepared,
        simulation: Simulation,
        context: RunContext,
    ) -> None:
        self._settings, self._simulation, self._context = settings, simulation, context
        self._output, self._prepared, self._log = output, prepared, log
        self._ticks: dict[str, Callable[[Sample], bytes]] = {}
        params, prefix = simulation.params, settings.prefix
        if settings.publish_tf:
            self._ticks["/tf"] = TransformEncoder(params, context, prefix)
        self._ticks["joint_states"] = JointEncoder(len(params.cars), context, prefix)
        self.topics = tuple(self._ticks)
        self.measured: dict[str, bytes] = {}
        self._events = 0
        self._reached: dict[int, float] = {}
        site = prepared.resolved.get("site") or {}
        self._datum = datum_of(site)
        if settings.navsat and self._datum is None:
            log.warning(f"no navsat: the scenario {prepared.name} has no site.datum")
        self._on_map: OnMap | None = None
        if self._datum is not None and output.offer(ON_MAP):
            self._on_map = OnMap(prepared, simulation, context, self._datum)
        # Rate, number of measurements so far, sensor.
        self._sensors: list[list[Any]] = []
        for rate, sensor in self._make_sensors():
            if output.offer(sensor.topic):
                self._sensors.append([rate, 0, sensor])
        self.due = 0.0 if self._sensors else math.inf

    def _make_sensors(self) -> Iterator[tuple[float, Sensor]]:
        settings, params, context = self._settings, self._simulation.params, self._context
        prefix, n = settings.prefix, len(self._simulation.params.cars)
        for number, name in enumerate(SENSORS):
            noise, rate = (
                getattr(settings, f"{name}_noise", 0.0),
                getattr(settings, f"{name}_rate"),
            )
            cars = chosen_cars(getattr(settings, name), n)
            if getattr(settings, name).strip() and not cars:
                self._log.warning(f"no {name}: the train has cars 1 to {n} only")
            for car, place in cars:
                rng = np.random.default_rng([settings.sensor_seed, number, car])
                mount = sensors.Mount(car, params, context, prefix, noise, rng)
                if name == "odometry":
                    yield rate, sensors.Odometry(mount, settings.odometry_speed_noise)
                elif name == "imu":
                    turn_noise = settings.imu_turn_noise
                    yield rate, sensors.Imu(mount, place or "body", turn_noise)
                elif name == "navsat" and self._datum is not None:
                    yield rate, sensors.NavSat(mount, self._datum)
                elif name == "wheel_speed":
                    yield rate, sensors.WheelSpeed(mount)
                elif name == "pipe_pressure":
                    yield rate, sensors.PipePressure(mount, self._reached)

    def begin(self) -> Messages:
        """Latched messages: the train's description, static frames, the place."""
        params, prefix = self._simulation.params, self._settings.prefix
        messages = [("robot_description", describe(self._prepared, self._settings))]
        if self._settings.publish_tf:
            messages.append(("/tf_static", static_transforms(params, self._context, prefix)))
        # A map that still shows the run before is cleared.
        place = NOTHING_ON_MAP if self._on_map is None else self._on_map.message(ended=False)
        return [*messages, (ON_MAP.name, place)]

    def end(self) -> Messages:
        """Latched messages at the end of the run: the map with the cars."""
        return [] if self._on_map is None else [(ON_MAP.name, self._on_map.message(ended=True))]

    def tick(self, sample: Sample) -> Messages:
        """Frames and joints that are recorded or that somebody listens to."""
        wanted, all_of_them = self._output.wanted, self._settings.records_all
        return [
            (topic, encode(sample))
            for topic, encode in self._ticks.items()
            if all_of_them or wanted(topic)
        ]

    def measure(self, sample: Sample) -> Messages:
        """The measurements that are due at the sample's time."""
        events = self._simulation.events
        for event in events[self._events :]:
            if event.kind == EventKind.BRAKE_SIGNAL_REACHED:
                self._reached.setdefault(event.cars[0], event.time)
        self._events = len(events)
        messages = []
        for entry in self._sensors:
            rate, count, sensor = entry
            if count / rate <= sample.time + GRAIN:
                entry[1] += 1
                self.measured[sensor.topic.name] = data = sensor(sample)
                messages.append((sensor.topic.name, data))
        self.due = min(count / rate for rate, count, _ in self._sensors)
        return messages


def describe(prepared: Prepared, settings: Settings) -> bytes:
    """The message ``robot_description``; of a long train it takes a while, and is kept."""
    kept = prepared.kept
    if "robot_description" not in kept:
        text = robot_description(prepared.simulation.params, settings.frame_id, settings.prefix)
        kept["robot_description"] = serialize(reports.string(text))
    return bytes(kept["robot_description"])


def live(settings: Settings, output: Output, log: Any) -> Callable[..., LiveMessages]:
    """Makes the messages of a run, from its scenario, its simulation and its context."""
    return lambda *run: LiveMessages(settings, output, log, *run)
