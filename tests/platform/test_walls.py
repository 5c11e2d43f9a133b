"""What import-linter cannot check of the walls between the rooms (pyproject.toml has the rest)."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.platform.test_packaging import ROOT

HOUSE = ("derail_ros", "msg_adapters")
FILES = sorted(path for package in HOUSE for path in (ROOT / package).rglob("*.py"))


def room(path: Path) -> str:
    """Return the room of a file: a package or module of derail_ros, or msg_adapters."""
    package, inside = path.relative_to(ROOT).parts[:2]
    return package if package != "derail_ros" else f"derail_ros.{inside.removesuffix('.py')}"


def is_private(name: str) -> bool:
    return name.startswith("_") and not name.startswith("__")


def defined(tree: ast.AST) -> Iterator[str]:
    """Yield the private names that a file defines: functions, classes, variables, attributes."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.attr


def used(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Yield the names that a file takes from other objects and modules, with their lines.

    Not those of ``self``: a subclass may use what its base class leaves to subclasses.
    """
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Load):
            owner = node.value
            if not (isinstance(owner, ast.Name) and owner.id in ("self", "cls")):
                yield node.lineno, node.attr


def test_no_room_uses_the_private_names_of_another() -> None:
    trees = {path: ast.parse(path.read_text(encoding="utf-8")) for path in FILES}
    owners: dict[str, set[str]] = {}
    for path, tree in trees.items():
        for name in filter(is_private, defined(tree)):
            owners.setdefault(name, set()).add(room(path))
    found = [
        f"{path.relative_to(ROOT)}:{line}: {name} is private to {', '.join(sorted(owners[name]))}"
        for path, tree in trees.items()
        for line, name in used(tree)
        if is_private(name) and name in owners and room(path) not in owners[name]
    ]
    assert not found, "\n".join(found)


def test_every_room_has_its_place_in_the_order() -> None:
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    layers = re.search(r"^layers = \[(.*?)^\]", text, re.MULTILINE | re.DOTALL)[1]
    listed = re.findall(r"[\w.]+", layers)
    rooms = {room(path) for path in FILES} - {"derail_ros.__init__"} | {"research"}
    assert sorted(listed) == sorted(rooms)


CACHE = {"jit.py", "warming.py"}
"""Files of the engine that find and fill the cache of compiled kernels."""


@pytest.mark.parametrize("package", ["engine", "vocabulary"])
def test_engine_and_vocabulary_open_no_file(package) -> None:
    """The imports are forbidden by a contract; this is about the built-in function."""
    for path in (ROOT / "derail_ros" / package).rglob("*.py"):
        if path.name not in CACHE:
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                    assert node.func.id != "open", f"{path.relative_to(ROOT)}:{node.lineno}"
