"""What a notebook needs, as the documentation shows it."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def test_a_run_in_five_lines(folder):
    from derail_ros import simulate

    outcome = simulate(folder / "small.yaml", {"train.speed_kmh": 15})
    assert outcome.cars_derailed >= 1
    assert outcome.duration > 1.0
    assert outcome.final
    varied = simulate(folder / "small.yaml", {"train.speed_kmh": 15}, member=1)
    assert varied.scene_area != outcome.scene_area


def test_a_study_in_five_lines(folder):
    from derail_ros import study

    results = study(folder / "study.yaml", folder / "out", ensemble=3)
    assert len(results.summary()) == 4 * len(results.measures)
    assert len(results.statements()) >= 2
    assert results.report(folder / "page").is_file()
    assert "4 points x 3 runs" in repr(results)


def test_a_study_of_a_mapping(folder):
    from derail_ros import study

    plan = {
        "scenario": str(folder / "small.yaml"),
        "design": "grid",
        "ensemble": 1,
        "parameters": {"speed": {"path": "train.speed_kmh", "values": [10, 12]}},
    }
    table = study(plan, folder / "out", seed=3, overrides={"ground.scale": 1.1}).table
    assert list(table["speed"]) == [10, 12]


def test_what_the_documentation_shows_is_what_there_is():
    """The lines of docs/studies.md under "From Python" compile, and name what is there."""
    from derail_ros.api import StudyAnswers as StudyResults

    text = (ROOT / "docs" / "studies.md").read_text(encoding="utf-8")
    blocks = [b.split("```")[0] for b in text.split("```python\n")[1:]]
    assert len(blocks) >= 2
    for block in blocks:
        compile(block, "docs/studies.md", "exec")
    for name in ("table", "summary", "statements", "report"):
        assert hasattr(StudyResults, name)


def test_importing_the_package_imports_nothing_heavy():
    code = (
        "import sys, derail_ros; assert set(derail_ros.__all__) >= {'simulate', 'study'}\n"
        "assert not {'numpy', 'numba', 'pandas', 'yaml'} & set(sys.modules)\n"
        "from derail_ros import simulate, study\n"
        "assert 'numba' not in sys.modules and 'pandas' not in sys.modules"
    )
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert answer.returncode == 0, answer.stderr


def test_unknown_names_are_unknown():
    import derail_ros

    with pytest.raises(AttributeError, match="simulat"):
        derail_ros.simulat  # noqa: B018


@pytest.mark.parametrize("path", sorted((ROOT / "examples").glob("*.ipynb")), ids=lambda p: p.name)
def test_notebooks_run(path, tmp_path):
    """All code cells, in order, in an interpreter of their own, in an empty folder."""
    notebook = json.loads(path.read_text(encoding="utf-8"))
    assert notebook["nbformat"] == 4
    cells = [c for c in notebook["cells"] if c["cell_type"] == "code"]
    assert cells
    source = "\n".join("".join(cell["source"]) for cell in cells)
    assert "%" not in [line.strip()[:1] for line in source.splitlines()]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "agg"}
    answer = subprocess.run(
        [sys.executable, "-c", source],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=280,
    )
    assert answer.returncode == 0, answer.stderr
