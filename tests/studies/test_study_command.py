"""``derail study``."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path


def test_run_show_and_report(derail, folder):
    place, page = folder / "out", folder / "page"
    code, out, err = derail("study", folder / "study.yaml", "-o", place, "--table", "csv")
    assert code == 0, err
    assert "4 points x 2 runs = 8 runs" in out and "8 runs, on" in err
    assert "cannot be distinguished with 2 runs per point" in out
    assert (place / "runs.csv").read_text().count("\n") == 9
    code, shown, _ = derail("study", "show", place)
    assert code == 0 and shown == out
    code, out, _ = derail("study", "show", place, "--json")
    data = json.loads(out)
    assert data["complete"] is True
    assert {row["measure"] for row in data["summary"]} >= {"cars_derailed", "duration_s"}
    assert data["statements"] and data["effects"] and data["counts"]
    code, out, _ = derail("study", "report", place, "-o", page)
    assert code == 0 and out.strip() == str(page / "report.html")
    # again: nothing is computed
    code, out, err = derail("study", "run", folder / "study.yaml", "-o", place)
    assert code == 0 and out == shown


def test_options_change_the_study(derail, folder):
    code, out, err = derail(
        *("study", folder / "study.yaml", "-o", folder / "out", "-n", 3, "--seed", 5, "--json"),
        *("--set", "train.consist.0.count=4", "--jobs", 1),
    )
    assert code == 0, err
    assert json.loads(out)["size"] == "4 points x 3 runs = 12 runs"
    manifest = json.loads((folder / "out" / "manifest.json").read_text())
    assert manifest["seed"] == 5
    assert manifest["scenario"]["train"]["consist"][0]["count"] == 4


def test_check_runs_nothing(derail, folder):
    code, out, _ = derail("study", folder / "study.yaml", "--check", "-o", folder / "out")
    assert code == 0 and "every point can be run" in out
    assert not (folder / "out").exists()


def test_mistakes_are_one_line(derail, folder):
    text = (folder / "study.yaml").read_text().replace("[10, 15]", "[10, 1500]")
    (folder / "bad.yaml").write_text(text)
    place = folder / "out"
    for arguments, said in (
        (("study", folder / "bad.yaml", "-o", place), "bad.yaml:7: parameters.speed: at speed"),
        (("study", "nothing", "-o", place), "unknown study"),
        (("study", folder / "study.yaml", "--table", "xls"), "must be parquet or csv"),
        (("study", folder / "study.yaml", "--set", "train.sped=1", "-o", place), "train.sped"),
        (("study", "show", folder / "nowhere"), "No such file"),
        (("study", "report", folder, "-o", folder / "page"), "No such file"),
    ):
        code, out, err = derail(*arguments)
        assert (code, out) == (2, ""), err
        assert said in err and err.startswith("derail: ") and err.count("\n") <= 2
    assert not place.exists()


def test_list(derail):
    code, out, _ = derail("study", "list", "--json")
    assert code == 0
    sizes = {s["name"]: s["size"] for s in json.loads(out)["studies"]}
    assert sizes["six_variations"] == "25 points x 20 runs = 500 runs"


def test_help_imports_nothing_heavy():
    for arguments in (["study"], ["study", "run"], ["study", "report"]):
        code = (
            "import sys; from derail_ros.cli import main\n"
            f"code = main({[*arguments, '--help']!r})\n"
            "heavy = {'numpy', 'numba', 'scipy', 'pandas', 'yaml', 'matplotlib'}\n"
            "sys.exit(code or bool(heavy & set(sys.modules)))"
        )
        answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
        assert answer.returncode == 0, answer.stderr


def test_interrupted_it_goes_on(folder):
    """Ctrl-C after the first runs; the same command computes the rest."""
    text = (folder / "study.yaml").read_text().replace("ensemble: 2", "ensemble: 8")
    (folder / "study.yaml").write_text(text)
    place = folder / "out"
    command = [sys.executable, "-m", "derail_ros.cli", "study", str(folder / "study.yaml")]
    command += ["-o", str(place), "--jobs", "1"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    journal = place / "runs.journal"
    deadline = time.monotonic() + 120
    while not (journal.exists() and journal.read_bytes().count(b"\n") >= 3):
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=250)
    assert process.returncode == 130, err
    assert "the same command continues" in err
    kept = journal.read_bytes().count(b"\n")
    assert 3 <= kept < 32
    answer = subprocess.run(command, capture_output=True, text=True, timeout=250, env=os.environ)
    assert answer.returncode == 0, answer.stderr
    assert json.loads((place / "manifest.json").read_text())["table"]["rows"] == 32


def test_another_size_of_the_same_study_is_told_from_another_study(derail, folder):
    place = folder / "out"
    assert derail("study", folder / "study.yaml", "-o", place)[0] == 0
    code, _, err = derail("study", folder / "study.yaml", "-o", place, "-n", 3, "--seed", 9)
    assert code == 2
    assert "holds results of this study with ensemble 2 where 3 is asked for, seed" in err
    setting = ("--set", "train.consist.0.count=4")
    code, _, err = derail("study", folder / "study.yaml", "-o", place, "-n", 3, *setting)
    assert code == 2 and "holds results of another study" in err


def test_one_core_is_one_core(derail, folder):
    _, _, err = derail("study", folder / "study.yaml", "-o", folder / "out", "--jobs", 1)
    assert "on 1 core, into" in err


def test_the_documented_example_and_its_documented_mistake(derail, tmp_path):
    text = (Path(__file__).parents[2] / "docs" / "studies.md").read_text(encoding="utf-8")
    example = text.split("```yaml\n")[1].split("```")[0]
    path = tmp_path / "my_study.yaml"
    path.write_text(example, encoding="utf-8")
    code, out, _ = derail("study", path, "--check")
    assert code == 0 and "9 points x 20 runs = 180 runs" in out
    path.write_text(example.replace("[24, 32, 40]", "[24, 32, 600]"), encoding="utf-8")
    code, _, err = derail("study", path, "--check")
    assert code == 2
    assert err.split("my_study.yaml:")[1].strip() in text
