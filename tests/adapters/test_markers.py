"""Markers: real sizes, stable identities, colour and words that agree."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from derail_ros.engine import PlanarSimulation
from derail_ros.scenario import load_scenario_by_name
from derail_ros.vocabulary.site import Area, FixedBody, GroundZone
from msg_adapters import markers as M
from msg_adapters import reports
from msg_adapters.common import RunContext
from msg_adapters.definitions import deserialize, serialize
from tests.nodes.support import simulation

CONTEXT = RunContext("run-1", base=2_000_000_000)
KIND = "visualization_msgs/msg/MarkerArray"


def decode(data: bytes) -> dict[tuple[str, int], object]:
    """Markers by namespace and id; what was decoded serialises to the same bytes."""
    array = deserialize(data, KIND)
    assert serialize(array) == data
    found = {(m.ns, m.id): m for m in array.markers}
    assert len(found) == len(array.markers)
    return found


@pytest.fixture(scope="module")
def moments() -> list[tuple[object, np.ndarray, dict]]:
    """Samples of a run from start to end, peaks and markers, all by one encoder."""
    sim = simulation()
    encoder = M.MarkerEncoder(sim.params, CONTEXT)
    peak = np.zeros(sim.n_cars)
    out = []
    for k in range(200):
        sim.advance_to(0.1 * k)
        sample = sim.sample(0.1 * k) if not sim.ended else sim.sample()
        for c in sim.new_collisions():
            for car in (c.car_a, c.car_b):
                # Eightfold, so that this small train knows hard blows too.
                peak[car - 1] = max(peak[car - 1], 8.0 * c.peak_force)
        data = encoder(sample, peak, reset=k == 0)
        out.append((sample, peak.copy(), decode(data)))
        if sim.ended:
            break
    assert sim.ended
    return out


def test_the_first_array_clears_what_was_there(moments: list) -> None:
    first = moments[0][2]
    clear = first.pop(("", 0))
    assert clear.action == M.DELETE_ALL
    assert ("", 0) not in moments[1][2]


def test_cars_are_where_the_sample_says_and_as_large(moments: list) -> None:
    params = simulation().params
    for sample, _, found in moments:
        for i, car in enumerate(params.cars):
            cube = found["cars", i + 1]
            assert (cube.type, cube.action) == (M.CUBE, M.ADD)
            assert (cube.scale.x, cube.scale.y) == (car.length, car.width)
            place = cube.pose.position
            assert (place.x, place.y) == tuple(sample.q[i, :2])
            assert cube.pose.orientation.z == np.sin(0.5 * sample.q[i, 2])
            stamp = cube.header.stamp
            assert stamp.sec * 10**9 + stamp.nanosec == CONTEXT.stamp(sample.time)
            assert cube.header.frame_id == "map"


def test_colour_and_words_tell_the_same(moments: list) -> None:
    seen = set()
    for sample, peak, found in moments:
        derailed = (sample.truck_on == 0).any(axis=1)
        for i in range(len(peak)):
            color = found["cars", i + 1].color
            lines = found["labels", i + 1].text.split("\n")
            expected = M.ON_RAILS
            if derailed[i]:
                expected = M.DERAILED
            if peak[i] > M.HARD:
                expected = M.STRUCK_HARD
            np.testing.assert_allclose((color.r, color.g, color.b), expected, rtol=1e-6)
            assert color.a == 1.0
            told = ["off"] * int(derailed[i])
            told += [f"{peak[i] / 1e6:.0f} MN"] * int(peak[i] > M.HARD)
            assert lines == [str(i + 1), *told]
            # In a pile cars lie side by side: a wider label would hide those of its neighbours.
            assert all(len(line) <= 5 for line in lines)
            seen.add(expected)
    assert len(seen) == 3


def test_parted_couplings_are_gone(moments: list) -> None:
    counts = set()
    for sample, _, found in moments:
        lines = found["couplers", 0]
        assert len(lines.points) == 2 * int(sample.coupled.sum())
        counts.add(len(lines.points))
    assert len(counts) > 1


def test_forces_are_arrows_as_long_as_they_are_large(moments: list) -> None:
    shown = 0
    for sample, _, found in moments:
        size = np.hypot(*sample.collision_force.T)
        for i in range(len(size)):
            arrow = found["contact_forces", i + 1]
            assert arrow.type == M.ARROW
            assert arrow.action == (M.ADD if size[i] > M.FORCE_SHOWN else M.DELETE)
            if arrow.action == M.ADD:
                tail, tip = arrow.points
                length = np.hypot(tip.x - tail.x, tip.y - tail.y)
                assert length == pytest.approx(size[i] * M.FORCE_SCALE)
                assert (tip.x, tip.y) == tuple(sample.q[i, :2])
                shown += 1
    assert shown


def test_the_same_things_have_the_same_identities(moments: list) -> None:
    keys = [set(found) - {("", 0)} for _, _, found in moments]
    assert all(k == keys[0] for k in keys)


def test_the_track_is_drawn_with_its_breaks_and_clears_the_old_one() -> None:
    sim = PlanarSimulation(load_scenario_by_name("curve_derailment").to_params())
    s = reports.track_coordinates(sim.track, sim.sample().truck_coordinate)
    breaks = [(0.5 * (sim.track.start + sim.track.end), 0.0)]
    track = reports.track(sim.track, s, breaks, CONTEXT)
    found = decode(M.track_markers(track, CONTEXT))
    assert found["", 0].action == M.DELETE_ALL
    assert {"track_bed", "rails", "rail_breaks", "rail_break_labels"} <= {ns for ns, _ in found}
    left, right = found["rails", 0].points, found["rails", 1].points
    gauges = [np.hypot(a.x - b.x, a.y - b.y) for a, b in zip(left, right)]
    np.testing.assert_allclose(gauges, M.GAUGE)
    place = found["rail_breaks", 0].pose.position
    assert (place.x, place.y) == tuple(sim.track.point(breaks[0][0])[:2])
    # The label lies beside the bed, across from the break, where it hides no car on the track.
    label = found["rail_break_labels", 0]
    x, y, heading = sim.track.point(breaks[0][0])[:3]
    along = (label.pose.position.x - x) * np.cos(heading) + (label.pose.position.y - y) * np.sin(
        heading
    )
    across = np.hypot(label.pose.position.x - x, label.pose.position.y - y)
    assert abs(along) < 1e-6
    assert across - 0.5 * label.scale.z > 0.5 * M.BED_WIDTH
    assert len(found["track_bed", 0].points) % 3 == 0


def test_what_stands_beside_the_track_is_drawn_with_its_name() -> None:
    params = load_scenario_by_name("cars_on_a_siding").to_params()
    params = dataclasses.replace(
        params,
        site=dataclasses.replace(
            params.site,
            zones=(GroundZone("bog", ((0, 9), (40, 9), (40, 20)), 1.0, 1.0, 0.01, 0.0),),
            fixed=(FixedBody("wall", ((-20, -6), (0, -6), (20, -8)), beside=True, height=3.2),),
            areas=(Area("road", ((0, 30), (50, 30)), closed=False),),
        ),
    )
    sim = PlanarSimulation(params)
    s = reports.track_coordinates(sim.track, sim.sample().truck_coordinate)
    track = reports.track(sim.track, s, [], CONTEXT)
    shapes = params.site.shapes(sim.track)
    assert [shape.name for shape in shapes] == ["bog", "wall", "road", "siding"]
    found = decode(M.track_markers(track, CONTEXT, site=shapes))
    assert [found["site_labels", k].text for k in range(4)] == ["bog", "wall", "road", "siding"]
    ring = [(p.x, p.y) for p in found["zone", 0].points]
    assert ring == [(0, 9), (40, 9), (40, 20), (0, 9)]
    wall = found["fixed", 1]
    assert wall.type == M.TRIANGLE_LIST and len(wall.points) == 6 * 2
    assert {p.z for p in wall.points} == {0.1, 3.2}
    assert len(found["area", 2].points) == 2
    left, right = (found["second_rails", 6 + k].points for k in (0, 1))
    assert {p.y for p in left} == {4.5 + 0.5 * M.GAUGE}
    assert {p.y for p in right} == {4.5 - 0.5 * M.GAUGE}
    labels = decode(M.MarkerEncoder(params, CONTEXT)(sim.sample(), np.zeros(sim.n_cars)))
    assert labels["labels", 40].text == "40"
    assert labels["labels", 41].text == "41 (not of the train)"
    color = labels["cars", 41].color
    assert (color.r, color.g, color.b) == pytest.approx(M.STANDING)


def faults(marker: Any) -> list[str]:
    """What RViz refuses or warns of (marker displays of rviz_default_plugins)."""
    kind, size, points = marker.type, marker.scale, marker.points
    turn = marker.pose.orientation
    numbers = [p for point in points for p in (point.x, point.y, point.z)]
    place = marker.pose.position
    rules = {
        "a number is not finite": np.isfinite([*numbers, place.x, place.y, place.z]).all(),
        "the quaternion has another length than 1": abs(
            np.hypot(np.hypot(turn.x, turn.y), np.hypot(turn.z, turn.w)) - 1.0
        )
        < 1e-3,
        "no frame, or one with a slash in front": marker.header.frame_id.strip("/")
        == marker.header.frame_id
        != "",
        "it cannot be seen": marker.color.a > 0.0,
        "a colour is not from 0 to 1": all(
            0.0 <= c <= 1.0 for c in (marker.color.r, marker.color.g, marker.color.b)
        ),
        "colours are not those of the points": len(marker.colors) in (0, len(points)),
    }
    if kind in (M.CUBE, M.TRIANGLE_LIST):
        rules["scale of 0 in one of x/y/z"] = min(size.x, size.y, size.z) > 0.0
    if kind == M.TEXT:
        rules["no text"] = bool(marker.text.strip()) and size.z > 0.0
    if kind in (M.LINE_LIST, M.LINE_STRIP):
        rules["no width"] = size.x > 0.0
    if kind == M.ARROW:
        rules["an arrow has two points"] = len(points) == 2 and size.x + size.y > 0.0
    if kind in (M.LINE_LIST, M.LINE_STRIP, M.TRIANGLE_LIST):
        per = {M.LINE_LIST: 2, M.LINE_STRIP: 1, M.TRIANGLE_LIST: 3}[kind]
        rules["number of points"] = len(points) >= 2 and len(points) % per == 0
    return [rule for rule, kept in rules.items() if not kept]


def test_rviz_takes_every_marker(moments: list) -> None:
    sim = simulation()
    coordinates = reports.track_coordinates(sim.track, sim.sample().truck_coordinate)
    track = reports.track(sim.track, coordinates, [(5.0, 0.0), (20.0, 1.0)], CONTEXT, 1.0)
    sample, peak, _ = moments[-1]
    apart = dataclasses.replace(sample, coupled=np.zeros_like(sample.coupled))
    all_parted = decode(M.MarkerEncoder(sim.params, CONTEXT)(apart, peak))
    assert all_parted["couplers", 0].action == M.DELETE
    for found in (
        *(m for _, _, m in moments),
        decode(M.track_markers(track, CONTEXT)),
        all_parted,
    ):
        added = [m for m in found.values() if m.action == M.ADD]
        assert added and not [(m.ns, m.id, faults(m)) for m in added if faults(m)]


def test_a_message_that_only_clears() -> None:
    found = decode(M.clear(CONTEXT))
    assert [m.action for m in found.values()] == [M.DELETE_ALL]


def test_a_virtual_body_says_how_many_cars_it_stands_for() -> None:
    sim = PlanarSimulation(load_scenario_by_name("mississauga_published").to_params())
    found = decode(M.MarkerEncoder(sim.params, CONTEXT)(sim.sample(), np.zeros(sim.n_cars)))
    assert found["labels", sim.n_cars].text == f"{sim.n_cars} (50 cars)"


@pytest.mark.ros
def test_ros_reads_the_markers(moments: list) -> None:
    pytest.importorskip("rclpy")
    from rclpy.serialization import deserialize_message

    from msg_adapters.topics import rclpy_class

    sim = simulation()
    data = M.MarkerEncoder(sim.params, CONTEXT)(sim.sample(), np.zeros(sim.n_cars), reset=True)
    array = deserialize_message(data, rclpy_class(KIND))
    assert len(array.markers) == len(decode(data))
    assert array.markers[1].text == "" and array.markers[1].ns == "cars"
