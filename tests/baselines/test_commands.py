"""``derail simulate --model``, ``compare-models`` and ``joint-velocities``."""

import json

import numpy as np
import pytest

from derail_ros.baselines.comparison import cell, compare, comparison_table
from derail_ros.baselines.figures import figure
from derail_ros.baselines.models import MODELS
from derail_ros.scenario import load_scenario
from derail_ros.vocabulary.measures import MEASURES

SMALL = ("--set", "train.consist.0.count=10", "--set", "train.speed_kmh=30")


KEYS = ["schema", "schema_version", "scenario", "title", "hash", "constants", "one_draw", "seed",
        "members", "void", "failed", "outcomes", "mean", "sd", "site", "model", "notes",
        "warnings", "limits", "inputs"]  # fmt: skip


@pytest.mark.parametrize("model", list(MODELS))
def test_simulate_with_every_model(derail, model):
    answer = derail("simulate", "base_train", *SMALL, "--model", model, "--json")
    assert answer.code == 0
    outcome = answer.json["outcomes"][0]
    assert outcome["cars_derailed"] > 0
    assert answer.json["model"] == model
    assert list(outcome) == [
        *MEASURES,
        "train",
        "energy_J",
        "in_train",
        "parted",
        "site",
        "wall_s",
    ]
    assert list(answer.json) == KEYS


def test_a_table_with_what_is_not_known(derail):
    answer = derail("simulate", "base_train", *SMALL, "--model", "blockage")
    assert answer.code == 0
    assert "largest force (MN)" in answer.out
    assert "one-dimensional blockage model" in answer.out


def test_ensembles_of_models_that_know_the_push(derail):
    answer = derail("simulate", "base_train", *SMALL, "--model", "yang-manos", "-n", "3", "--json")
    assert answer.code == 0
    assert len(answer.json["outcomes"]) == 3
    assert answer.json["mean"]["cars_derailed"] > 0
    alone = derail(
        "simulate", "base_train", *SMALL, "--model", "yang-manos", "-n", "3", "-j", "1", "--json"
    )
    for a, b in zip(answer.json["outcomes"], alone.json["outcomes"], strict=True):
        assert {**a, "wall_s": 0.0} == {**b, "wall_s": 0.0}
    refused = derail("simulate", "base_train", "--model", "bar-1", "-n", "3")
    assert refused.code == 2
    assert "no lateral force" in refused.err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("base_train", "--model", "bar-9"), "bar-9"),
        (("curve_derailment", "--model", "yang-manos"), "straight"),
        (("curve_derailment", "--model", "roorda-gracie"), "straight"),
        (("base_train", "--model", "blockage", "--roll"), "--roll"),
    ],
)
def test_refusals_are_one_line(derail, arguments, words):
    answer = derail("simulate", *arguments)
    assert answer.code == 2
    assert words in answer.err
    assert answer.err.count("\n") == 1


def test_results_of_a_model(derail, tmp_path):
    answer = derail(
        "simulate", "base_train", *SMALL, "--model", "roorda-gracie", "-o", tmp_path / "out"
    )
    assert answer.code == 0
    names = {p.name for p in (tmp_path / "out").iterdir()}
    assert names == {"outcomes.json", "final_scene.png", "manifest.json"}
    manifest = json.loads((tmp_path / "out" / "manifest.json").read_text())
    assert manifest["model"] == "roorda-gracie"


def test_roll_on_the_command_line(derail):
    answer = derail("simulate", "base_train", *SMALL, "--roll", "--json")
    assert answer.code == 0
    assert len(answer.json["notes"]["roll_deg"]) == 10


def test_compare_models(derail, tmp_path):
    answer = derail("compare-models", "base_train", *SMALL, "-o", tmp_path / "out", "--json")
    assert answer.code == 0
    assert list(answer.json["models"]) == list(MODELS)
    assert {p.name for p in (tmp_path / "out").iterdir()} == {
        "comparison.json",
        "comparison.md",
        "comparison.png",
    }
    table = derail("compare-models", "base_train", *SMALL, "-m", "bar-1", "-m", "blockage")
    assert table.code == 0
    assert "bar-1" in table.out
    assert "planar" not in table.out


def test_compare_models_over_the_speed(derail, tmp_path):
    few = ("-m", "yang-manos", "-m", "bar-2", "-m", "blockage", "--speeds", "30,60")
    answer = derail("compare-models", "base_train", *few, "-o", tmp_path / "out", "--json")
    assert answer.code == 0
    assert answer.json["speeds_kmh"] == [30.0, 60.0]
    slow, fast = answer.json["models_by_speed"]
    for name in slow:
        derailed = [m[name]["outcome"]["cars_derailed"] for m in (slow, fast)]
        assert derailed[0] < derailed[1]
    assert (tmp_path / "out" / "comparison.png").stat().st_size > 1000
    for wrong in ("x", "60,30", "-1"):
        assert derail("compare-models", "base_train", f"--speeds={wrong}").code == 2


def test_a_model_that_cannot_is_an_entry_with_the_reason():
    params = load_scenario("curve_derailment").to_params()
    entries = compare(params, ["yang-manos", "blockage"])
    assert entries[0].run is None
    assert "straight" in comparison_table(entries).rows[0][-1]
    assert figure("curve", entries) is not None
    assert cell(None, "duration_s") == "-"


def test_joint_velocities(derail):
    answer = derail("joint-velocities", "--json")
    assert answer.code == 0
    assert len(answer.json["bars"]) == 6
    assert sum(b["mass_kg"] for b in answer.json["bars"]) == pytest.approx(450e3)
    relative = [b["front_joint_relative"] for b in answer.json["bars"]]
    assert relative[0] == 1.0
    assert np.sign(relative).tolist() == [1, -1, 1, -1, 1, -1]
    train = derail("joint-velocities", "mississauga_published", "--json")
    assert len(train.json["bars"]) == 74
    assert "tail" in derail("joint-velocities", "--cars", "3").out
    assert derail("joint-velocities", "--cars", "0").code == 2
    assert derail("joint-velocities", "--length", "-1").code == 2


def test_reasons_stand_below_the_table(derail):
    answer = derail("compare-models", "curve_derailment", "--model", "yang-manos",
                    "--model", "bar-2-corrected", "--model", "blockage")  # fmt: skip
    assert answer.code == 0
    lines = answer.out.splitlines()
    assert lines[-1] == "yang-manos: the model of Yang and Manos needs straight track"
    assert "straight track" not in "".join(lines[:-1])
    assert any(line.startswith("bar-2-corrected ") for line in lines)
