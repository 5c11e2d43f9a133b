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


@pytest.mark.timeout(900)  # all kernels are compiled
def test_the_example_runs_as_the_page_says(tmp_path):
    shutil.copytree(
        PACKAGE, tmp_path / "derail_ros", ignore=shutil.ignore_patterns("__pycache__", "*.pyc")
    )
    (edited, law), (check, code) = blocks()
    replace_functions(tmp_path / edited, law)
    (tmp_path / check).write_text(code, encoding="utf-8")
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    environment |= {"DERAIL_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, check], cwd=tmp_path, env=environment, capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert re.fullmatch(r"slid [\d.]+ m, expected [\d.]+ m\n", done.stdout)
    # the law of the repository, untouched, fails the page's check
    (tmp_path / edited).write_bytes((PACKAGE.parent / edited).read_bytes())
    unchanged = subprocess.run(
        [sys.executable, "-c", code.partition("# a car alone")[0]],
        cwd=tmp_path, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert "AssertionError" in unchanged.stderr
