"""Numbers that are none, lists that do not match, cars that do not exist: never in a page."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import Reader

from derail_ros.engine import PlanarSimulation
from derail_ros.recording import record_run
from derail_ros.recording.files import add_topic, bag_writer
from derail_ros.recording.reader import read_bag
from derail_ros.recording.soundness import RULES
from derail_ros.recording.storage import BagError
from derail_ros.review import plots, summary
from derail_ros.review import replay_page as replay
from derail_ros.review.figures import final_scene
from derail_ros.scenario import load_scenario
from msg_adapters.definitions import deserialize, field_names, read_copy, serialize

Row = tuple[str, str, int, bytes]
KINDS = tuple(RULES)


@pytest.fixture(scope="module")
def rows(bag: Path) -> list[Row]:
    """Messages of a recording, of the states every tenth."""
    found: list[Row] = []
    count = 0
    with Reader(bag) as reader:
        for connection, stamp, data in reader.messages():
            if connection.msgtype not in read_copy():
                continue
            if connection.topic in ("/train_state", "/coupler_states", "/energy"):
                count += 1
                if count % 30 > 2:
                    continue
            found.append((connection.topic, connection.msgtype, stamp, bytes(data)))
    return found


def changed(rows: list[Row], kind: str, change: Callable[[Any], None], path: Path) -> Path:
    """A recording with all messages of a kind changed."""
    writer = bag_writer(path, "mcap")
    writer.open()
    topics: dict[str, Any] = {}
    for topic, msgtype, stamp, data in rows:
        if msgtype.endswith("/" + kind):
            message = deserialize(data, msgtype)
            change(message)
            data = serialize(message)
        if topic not in topics:
            topics[topic] = add_topic(writer, topic, msgtype, [])
        writer.write(topics[topic], stamp, data)
    writer.close()
    return path


def check(path: Path, *, drawn: bool = False) -> None:
    """Reviewed with sound JSON, page and text, or refused in a line."""
    try:
        run = read_bag(path)
    except BagError as error:
        assert "\n" not in str(error) and str(path) in str(error)
        return
    facts = summary.findings(run)
    json.dumps(facts, allow_nan=False)
    text = summary.text(run, facts)
    page = replay.page(run, facts)
    data = page.partition('id="data">')[2].partition("</script>")[0]
    json.loads(data, parse_constant=lambda word: pytest.fail(f"{word} in the page"))
    for place in (text, data):
        words = place.replace('"', " ").replace("°", " ").split()
        assert not {"nan", "NaN", "inf", "Infinity", "-inf"} & set(words)
    if drawn:
        assert final_scene(summary.final_scene(run)) is not None
        for draw in (plots.peak_forces, plots.speeds, plots.energy_over_time, plots.space_time):
            draw(run)
        for contact in plots.main_collisions(run):
            plots.collision(run, contact)


@pytest.mark.parametrize("values", [(math.nan,), (-math.inf, 1e300)], ids=["nan", "beyond"])
@pytest.mark.parametrize("kind", KINDS)
def test_numbers_that_are_none(kind, values, rows, tmp_path) -> None:
    rule = RULES[kind]
    for k, name in enumerate((*rule.numbers, *rule.or_none, *rule.positive)):
        value = values[k % len(values)]

        def change(message: Any, name: str = name, value: float = value) -> None:
            old = getattr(message, name)
            if isinstance(old, float):
                setattr(message, name, value)
            elif old.dtype.kind == "f" and len(old):
                setattr(message, name, np.where(np.arange(len(old)) % 2, old, value))

        path = changed(rows, kind, change, tmp_path / name)
        check(path, drawn=math.isnan(value) and name in rule.or_none[:3])


@pytest.mark.parametrize("keep", [0, -1])
@pytest.mark.parametrize("kind", KINDS)
def test_lists_that_do_not_match(kind, keep, rows, tmp_path) -> None:
    msgtype = f"derail_msgs/msg/{kind}"
    sample = deserialize(next(d for _, t, _, d in rows if t == msgtype), msgtype)
    for name in field_names(msgtype):
        if not isinstance(getattr(sample, name), (list, np.ndarray)):
            continue

        def change(message: Any, name: str = name) -> None:
            setattr(message, name, getattr(message, name)[:keep])

        check(changed(rows, kind, change, tmp_path / name))


@pytest.mark.parametrize("number", [0, 11, 2**32 - 1])
def test_cars_that_the_train_does_not_have(number, rows, tmp_path) -> None:
    """The train has ten."""
    for kind, name in (
        ("Collision", "car_a"),
        ("Collision", "car_b"),
        ("Collision", "corner_car"),
        ("TrainEvent", "cars"),
        ("Outcome", "peak_car_a"),
        ("Outcome", "derailed_cars"),
        ("Outcome", "car_peak_other_car"),
        ("Outcome", "rear_part_first_car"),
    ):

        def change(message: Any, name: str = name) -> None:
            old = getattr(message, name)
            setattr(message, name, number if isinstance(old, int) else np.full_like(old, number))

        check(changed(rows, kind, change, tmp_path / f"{kind}_{name}"), drawn=True)


def test_what_was_left_out_is_told(run, rows, tmp_path) -> None:
    def change(message: Any) -> None:
        if message.id == 1:
            message.x = math.nan

    found = read_bag(changed(rows, "Collision", change, tmp_path / "bag"))
    assert len(found.contacts) == len(run.contacts) - 1
    assert any("messages with impossible numbers left out" in w for w in found.warnings)
    assert any("1 collision is missing" in w for w in found.warnings)


def test_nan_only_where_the_definitions_allow_it() -> None:
    """Where a definition says that a number may be NaN, a message with it is believed."""
    for kind, rule in RULES.items():
        text = read_copy()[f"derail_msgs/msg/{kind}"]
        for line in text.splitlines():
            code, _, comment = line.partition("#")
            name = code.split()[-1] if code.split() else ""
            if name in rule.numbers + rule.positive:
                assert "NaN" not in comment, f"{kind}.{name}"


def test_a_body_that_stands_for_cars_is_no_mistake(tmp_path) -> None:
    """Events tell of the cars that it stands for, beyond the bodies there are."""
    scenario = load_scenario("mississauga_published").with_overrides(
        {"integration.time_limit_s": 2.0}
    )
    record_run(PlanarSimulation(scenario.to_params()), scenario, tmp_path / "bag")
    run = read_bag(tmp_path / "bag")
    assert run.n < run.cars.represents.sum()
    assert run.warnings == ()
    check(tmp_path / "bag")
