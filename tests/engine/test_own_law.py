"""The example of docs/own_law.md, put into a copy of the package and run."""

import ast
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import derail_ros

PACKAGE = Path(derail_ros.__file__).parent
PAGE = PACKAGE.parent / "docs" / "own_law.md"


def blocks():
    """Python blocks of the page: the file that the first line names, and the code."""
    text = PAGE.read_text(encoding="utf-8")
    return re.findall(r"```python\n# (\S+)\n(.*?)```", text, re.DOTALL)


def functions(code):
    """Name -> first and last line (from 0, last excluded) of the functions of a file."""
    return {
        f.name: (min(d.lineno for d in f.decorator_list) - 1, f.end_lineno)
        for f in ast.parse(code).body
        if isinstance(f, ast.FunctionDef) and f.decorator_list
    }


def replace_functions(path, code):
    """Put the functions of ``code`` in the place of those of the same name in a file."""
    for name, (first, last) in functions(code).items():
        lines = path.read_text(encoding="utf-8").splitlines()
        a, b = functions("\n".join(lines))[name]
        lines[a:b] = code.splitlines()[first:last]
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def test_the_page_names_what_exists():
    text = PAGE.read_text(encoding="utf-8")
    for place in re.findall(r"`((?:laws|forces|engine|vocabulary|scenario)/\w+\.py)`", text):
        found = (PACKAGE / place).is_file() or (PACKAGE / "engine" / place).is_file()
        assert found, place


LAW_ONLY = "# a car alone"
"""Where the page's check, after the formula, begins to need all kernels."""


@pytest.fixture
def copy(tmp_path):
    """A copy of the package with the page's law in it and its check beside it."""
    shutil.copytree(
        PACKAGE, tmp_path / "derail_ros", ignore=shutil.ignore_patterns("__pycache__", "*.pyc")
    )
    (edited, law), (check, code) = blocks()
    replace_functions(tmp_path / edited, law)
    (tmp_path / check).write_text(code, encoding="utf-8")
    return tmp_path


def python(folder, *arguments):
    """Run Python on the copy."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    environment |= {"DERAIL_CACHE_DIR": str(folder / "cache"), "PYTHONPATH": str(folder)}
    return subprocess.run(
        [sys.executable, *arguments], cwd=folder, env=environment, capture_output=True,
        text=True, check=False,
    )  # fmt: skip


def test_the_law_of_the_page_passes_its_check_and_that_of_the_repository_does_not(copy):
    (edited, _), (_, code) = blocks()
    formula, _, run = code.partition(LAW_ONLY)
    assert "resistance" in formula and "PlanarSimulation(params)" in run
    done = python(copy, "-c", formula)
    assert done.returncode == 0, done.stderr
    (copy / edited).write_bytes((PACKAGE.parent / edited).read_bytes())
    assert "AssertionError" in python(copy, "-c", formula).stderr


@pytest.mark.slow
@pytest.mark.timeout(900)  # all kernels are compiled
def test_the_example_runs_as_the_page_says(copy):
    done = python(copy, blocks()[1][0])
    assert done.returncode == 0, done.stderr
    assert re.fullmatch(r"slid [\d.]+ m, expected [\d.]+ m\n", done.stdout)
