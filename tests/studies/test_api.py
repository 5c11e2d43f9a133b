"""What a notebook needs, as the documentation shows it."""

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
def test_notebooks_run(path, tmp_path, monkeypatch):
    """All cells, in a kernel of their own, in an empty folder; they have pictures."""
    nbclient = pytest.importorskip("nbclient")
    nbformat = pytest.importorskip("nbformat")
    pytest.importorskip("ipykernel")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.delenv("MPLBACKEND", raising=False)  # pictures are shown in the notebook
    notebook = nbformat.read(path, as_version=4)
    client = nbclient.NotebookClient(
        notebook, timeout=280, kernel_name="python3", resources={"metadata": {"path": tmp_path}}
    )
    client.execute()
    shown = {
        kind
        for cell in notebook.cells
        for o in cell.get("outputs", [])
        for kind in o.get("data", {})
    }
    assert "image/png" in shown
