"""Numbers that are none, lists that do not match, cars that do not exist: never in a page."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import Reader

from derail_ros.engine import PlanarSimulation
from derail_ros.recording import record_run
from derail_ros.recording.files import add_topic, bag_writer
from derail_ros.recording.plausibility import FREE, GROUPS, MAY_BE_NAN, POSITIVE
from derail_ros.recording.reader import read_bag
from derail_ros.recording.storage import BagError
from derail_ros.review import figures, plots, summary
from derail_ros.review import replay_page as replay
from derail_ros.review.scene import final_scene
from derail_ros.scenario import load_scenario
from msg_adapters.definitions import (
    deserialize,
    field_names,
    fields_of,
    read_copy,
    serialize,
)

Row = tuple[str, str, int, bytes]
KINDS = (
    "Collision",
    "Consist",
    "CouplerStates",
    "EnergyLedger",
    "Outcome",
    "Track",
    "TrainEvent",
    "TrainState",
)


@pytest.fixture(scope="module")
def rows(bag: Path) -> list[Row]:
    """Messages of a recording: of each state topic one in a hundred, of outcomes the last two."""
    found: list[Row] = []
    seen: Counter[str] = Counter()
    with Reader(bag) as reader:
        for connection, stamp, data in reader.messages():
            if connection.msgtype not in read_copy():
                continue
            if connection.topic in ("/train_state", "/coupler_states", "/energy"):
                seen[connection.topic] += 1
                if seen[connection.topic] % 100 > 1:
                    continue
            found.append((connection.topic, connection.msgtype, stamp, bytes(data)))
    outcomes = [row for row in found if row[0] == "/outcome"]
    return [row for row in found if row not in outcomes[:-2]]


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
        assert figures.final_scene(final_scene(run)) is not None
        assert figures.peak_forces(run.outcome) is not None
        for draw in (plots.speeds, plots.energy_over_time, plots.space_time):
            draw(run)
        for contact in plots.main_collisions(run):
            plots.collision(run, contact)


def numbers(kind: str) -> list[str]:
    """Fields of a message that hold numbers or quantities."""
    kinds = ("float64", "float64[]", "derail_msgs/msg/Quantity[]")
    return [name for name, of in fields_of(f"derail_msgs/msg/{kind}") if of in kinds]


def spoiled(old: Any, value: float) -> Any:
    """A field with a value that it cannot have, in a list at every second place."""
    if isinstance(old, float):
        return value
    if isinstance(old, np.ndarray):
        return np.where(np.arange(len(old)) % 2, old, value)
    for quantity in old:
        quantity.values = spoiled(quantity.values, value)
    return old


@pytest.mark.parametrize("values", [(math.nan,), (-math.inf, 1e300)], ids=["nan", "beyond"])
@pytest.mark.parametrize("kind", KINDS)
def test_numbers_that_are_none(kind, values, rows, tmp_path) -> None:
    for k, name in enumerate(numbers(kind)):
        value = values[k % len(values)]

        def change(message: Any, name: str = name, value: float = value) -> None:
            setattr(message, name, spoiled(getattr(message, name), value))

        path = changed(rows, kind, change, tmp_path / name)
        check(path, drawn=math.isnan(value) and name in MAY_BE_NAN.get(kind, ())[:3])


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
    for kind, name, key in (
        ("Collision", "car_a", ""),
        ("Collision", "car_b", ""),
        ("Collision", "corner_car", ""),
        ("TrainEvent", "cars", ""),
        ("Outcome", "measures", "peak_force_pair"),
        ("Outcome", "measures", "derailed_cars"),
        ("Outcome", "measures", "rear_part_first_car"),
        ("Outcome", "cars", "car_peak_other"),
    ):

        def change(message: Any, name: str = name, key: str = key) -> None:
            old = getattr(message, name)
            for quantity in old if key else ():
                if quantity.key == key:
                    quantity.values = np.full(len(quantity.values), float(number))
            if not key:
                new = number if isinstance(old, int) else np.full_like(old, number)
                setattr(message, name, new)

        check(changed(rows, kind, change, tmp_path / f"{kind}_{name}_{key}"), drawn=True)


def test_what_was_left_out_is_told(run, rows, tmp_path) -> None:
    def change(message: Any) -> None:
        if message.id == 1:
            message.x = math.nan

    found = read_bag(changed(rows, "Collision", change, tmp_path / "bag"))
    assert len(found.collisions) == len(run.collisions) - 1
    assert any("messages with impossible numbers skipped" in w for w in found.warnings)
    assert any("1 collision is missing" in w for w in found.warnings)


def test_nan_only_where_the_definitions_allow_it() -> None:
    """A message with NaN is believed where its definition says that there may be one."""
    unsaid = {"axial_force"}  # of recordings of version 1, which did not hold it
    for kind in KINDS:
        text = read_copy()[f"derail_msgs/msg/{kind}"]
        named = {
            line.partition("#")[0].split()[-1]
            for line in text.splitlines()
            if "NaN" in line.partition("#")[2] and line.startswith("float64")
        }
        assert set(MAY_BE_NAN.get(kind, ())) - unsaid == named, kind


def test_the_rules_name_fields_that_there_are() -> None:
    for table in (MAY_BE_NAN, POSITIVE, FREE):
        for kind, names in table.items():
            assert set(names) <= set(field_names(f"derail_msgs/msg/{kind}")), kind
    lists = [n for k in KINDS for n, of in fields_of(f"derail_msgs/msg/{k}") if of.endswith("[]")]
    assert all(any(name.startswith(group) for name in lists) for group in GROUPS)


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
