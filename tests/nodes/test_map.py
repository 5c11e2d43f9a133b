"""The place and the cars at rest as GeoJSON, without a graph."""

from __future__ import annotations

import json
from collections import Counter
from typing import Any

import numpy as np
import pytest

from derail_ros.review.maps import ROUND
from derail_ros.vocabulary.place import datum_of
from derail_ros.vocabulary.scene import car_corners
from msg_adapters.definitions import deserialize
from msg_adapters.topics import ON_MAP
from tests.nodes.support import SIDING, SMALL
from tests.nodes.test_core import Bench


def shown(bench: Bench) -> list[list[dict[str, Any]]]:
    """Features of each message."""
    texts = [deserialize(d, "std_msgs/msg/String") for n, d in bench.heard.raw if n == ON_MAP.name]
    maps = [json.loads(text.data) for text in texts]
    assert all(m["type"] == "FeatureCollection" for m in maps)
    return [m["features"] for m in maps]


def names(features: list[dict[str, Any]]) -> list[str]:
    return [feature["properties"]["name"] for feature in features]


def test_the_place_and_at_the_end_the_cars() -> None:
    bench = Bench(speed_factor=0.0)
    bench.load(SIDING)
    assert bench.heard.offered[ON_MAP.name] == ON_MAP.msgtype
    (before,) = shown(bench)
    assert names(before) == ["track", "wall", "siding"]
    while not bench.core.finished:
        bench.loop.work()
    place, ended = shown(bench)
    assert ended[:3] == place
    cars = ended[3:]
    session = bench.core.session
    outcome, params = session.simulation.outcome(), session.params
    assert [c["properties"]["car"] for c in cars] == [1, 2, 3, 4, 5, 6, 7]
    size = np.array([[car.length, car.width] for car in params.cars]).T
    corners = car_corners(session.simulation.sample().pose, *size)[:, ROUND]
    datum = datum_of(session.prepared.resolved["site"])
    for i, feature in enumerate(cars):
        told, ring = feature["properties"], feature["geometry"]["coordinates"][0]
        off = (*outcome.derailed_cars, *outcome.standing.derailed)
        assert told["derailed"] == (told["car"] in off)
        assert told["standing"] == (i >= 4)
        back = np.array([datum.local(latitude, longitude) for longitude, latitude in ring[:-1]])
        apart = np.hypot(*(back[:, None] - corners[i][None]).transpose(2, 0, 1)).min(axis=1)
        assert (apart < 2e-3).all()
    # Colours are those of the markers: one for cars off the rails, another for those on them.
    colors = Counter(
        (c["properties"]["derailed"], c["properties"]["style"]["color"]) for c in cars
    )
    assert len({color for _, color in colors}) >= 2
    # A new run clears the cars.
    bench.core.reset(0)
    assert names(shown(bench)[-1]) == ["track", "wall", "siding"]


def test_a_run_without_a_datum_is_on_no_map_and_clears_that_of_another() -> None:
    bench = Bench()
    bench.load(SMALL)
    assert not bench.heard.offered and shown(bench) == [[]]
    bench.load(SIDING)
    bench.load(SMALL)
    assert [len(features) for features in shown(bench)] == [0, 3, 0]
    bench.load(SIDING)
    bench.core.unload()
    assert shown(bench)[-1] == []


@pytest.mark.ros
def test_who_comes_late_gets_the_map(tmp_path) -> None:
    pytest.importorskip("rclpy")
    pytest.importorskip("derail_msgs")
    pytest.importorskip("foxglove_msgs")
    from tests.nodes.graph import graph

    with graph(tmp_path) as made:
        made.simulator(scenario="", speed_factor=0.0)
        made.listen("outcome")
        answer = made.ask("load_consist", scenario_yaml=SIDING)
        assert answer.success, answer.message
        made.until(lambda: any(m.is_final for m in made.heard["outcome"]), "the end")
        made.listen(ON_MAP.name)
        heard = made.heard[ON_MAP.name]
        made.until(lambda: heard, "the map")
        assert len(json.loads(heard[-1].geojson)["features"]) == 3 + 7
