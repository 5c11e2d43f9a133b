"""simulation_interfaces, tf2_msgs and foxglove_msgs as they are installed: those of their own."""

import importlib
import json
from pathlib import Path

import pytest

HASHES = json.loads(Path(__file__).with_name("standard_hashes.json").read_text(encoding="utf-8"))
"""Hashes (REP 2011) of the types of simulation_interfaces 2.1.0 and foxglove_msgs 3.2, computed
from their own files."""

pytest.importorskip("rclpy")


def share(package: str) -> Path:
    """Folder of what is installed of a package beside its Python modules."""
    module = pytest.importorskip(package)
    parents = Path(module.__file__).resolve().parents
    return next(p / "share" / package for p in parents if (p / "share" / package).is_dir())


@pytest.mark.parametrize("name", HASHES)
def test_types_are_those_of_the_standard(name) -> None:
    package, kind, interface = name.split("/")
    file = share(package) / kind / f"{interface}.json"
    found = {h["type_name"]: h["hash_string"] for h in json.loads(file.read_text())["type_hashes"]}
    assert found[name] == HASHES[name]
    assert hasattr(importlib.import_module(f"{package}.{kind}"), interface)


def test_transforms_are_those_of_every_distribution() -> None:
    from msg_adapters.definitions import type_hash

    name = "tf2_msgs/msg/TFMessage"
    file = share("tf2_msgs") / "msg" / "TFMessage.json"
    found = {h["type_name"]: h["hash_string"] for h in json.loads(file.read_text())["type_hashes"]}
    assert found[name] == type_hash(name)
