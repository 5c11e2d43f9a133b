"""``derail simulate`` in real runs of a short train."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from derail_ros.studies.ensemble import member_factor

KEYS = {
    "cars_derailed",
    "derailed_cars",
    "duration_s",
    "peak_force_N",
    "peak_force_pair",
    "peak_force_time_s",
    "scene_length_m",
    "scene_width_m",
    "scene_area_m2",
    "max_coupler_gap_m",
    "void",
    "steps",
    "wall_s",
    "energy_J",
    "energy_residual",
    "cars_above_5MN",
    "cars_above_10MN",
}


def physics(record):
    """A record without what differs between two equal runs."""
    return {k: v for k, v in record.items() if k != "wall_s"}


def test_one_run_as_json(derail, small):
    answer = derail("simulate", small, "--json")
    assert answer.code == 0
    assert answer.json["scenario"] == "small"
    (outcome,) = answer.json["outcomes"]
    assert outcome.keys() >= KEYS
    assert outcome["derailed_cars"][0] == 1
    assert outcome["cars_derailed"] == len(outcome["derailed_cars"])
    assert outcome["duration_s"] > 1.0
    assert outcome["scene_area_m2"] == pytest.approx(
        outcome["scene_length_m"] * outcome["scene_width_m"]
    )
    assert not outcome["void"]
    assert answer.json["mean"]["cars_derailed"] == outcome["cars_derailed"]
    train = outcome["in_train"]
    assert [row["coupling"] for row in train["couplings"]] == list(
        range(1, len(train["couplings"]) + 1)
    )
    for way in ("draft", "buff"):
        most = max(row[f"max_{way}_N"] for row in train["couplings"])
        assert train[f"max_{way}_N"] == outcome[f"max_{way}_N"] == (most or None)
    assert all(row["cause"] == "angle" for row in outcome["parted"])
    assert "couplings" not in answer.json["mean"].get("in_train", {})
    assert answer.json["sd"]["cars_derailed"] is None
    assert answer.json["void"] == 0
    assert answer.json["failed"] == 0


def test_one_run_as_a_table(derail, small):
    answer = derail("simulate", small)
    assert answer.code == 0
    rows = [line.strip(" │┃") for line in answer.out.splitlines()]
    leading = ("cars derailed", "scene length", "time to rest", "stopped by", "car to look at")
    rest = ("largest force (MN)", "severity")
    places = [next(k for k, row in enumerate(rows) if row.startswith(w)) for w in leading + rest]
    assert places == sorted(places)
    assert "A short train" in answer.out and "energy imbalance" not in answer.out
    assert "energy imbalance" in derail("simulate", small, "--verbose").out
    record = derail("simulate", small, "--json").json["outcomes"][0]
    car = record["max_draft_coupling"]
    time = record["in_train"]["couplings"][car - 1]["max_draft_time_s"]
    assert f"(between cars {car} and {car + 1} at {time:.2f} s)" in answer.out


def test_settings_change_the_run(derail, small):
    slow = derail("simulate", small, "--set", "train.speed_kmh=10", "--json")
    fast = derail("simulate", small, "--set", "train.speed_kmh=30", "--json")
    assert slow.json["hash"] != fast.json["hash"]
    assert slow.json["outcomes"][0]["duration_s"] < fast.json["outcomes"][0]["duration_s"]


@pytest.fixture
def ensemble(derail, small):
    return derail("simulate", small, "--ensemble", 5, "--seed", 7, "--jobs", 1, "--json")


def test_an_ensemble_does_not_depend_on_the_jobs(derail, small, ensemble):
    again = derail("simulate", small, "--ensemble", 5, "--seed", 7, "--jobs", 3, "--json")
    assert [physics(r) for r in again.json["outcomes"]] == [
        physics(r) for r in ensemble.json["outcomes"]
    ]
    assert physics(again.json["mean"]) == physics(ensemble.json["mean"])
    assert physics(again.json["sd"]) == physics(ensemble.json["sd"])


def test_member_0_is_the_scenario_and_the_others_differ(derail, small, ensemble):
    alone = derail("simulate", small, "--json")
    first, *others = (physics(r) for r in ensemble.json["outcomes"])
    assert first == physics(alone.json["outcomes"][0])
    assert all(other["energy_J"] != first["energy_J"] for other in others)


def test_a_member_is_a_run_with_its_force(derail, small, ensemble):
    force = 50e3 * member_factor(7, 3)
    setting = f"initiation.lateral_force_N={force!r}"
    alone = derail("simulate", small, "--set", setting, "--json")
    assert physics(alone.json["outcomes"][0]) == physics(ensemble.json["outcomes"][3])


def test_a_longer_ensemble_begins_with_the_shorter_one(derail, small, ensemble):
    longer = derail("simulate", small, "--ensemble", 7, "--seed", 7, "--json")
    assert [physics(r) for r in longer.json["outcomes"][:5]] == [
        physics(r) for r in ensemble.json["outcomes"]
    ]


def test_another_seed_is_another_ensemble(derail, small, ensemble):
    other = derail("simulate", small, "--ensemble", 5, "--seed", 8, "--json")
    assert physics(other.json["outcomes"][1]) != physics(ensemble.json["outcomes"][1])


def test_mean_and_sd(ensemble):
    durations = [r["duration_s"] for r in ensemble.json["outcomes"]]
    assert ensemble.json["mean"]["duration_s"] == pytest.approx(np.mean(durations))
    assert ensemble.json["sd"]["duration_s"] == pytest.approx(np.std(durations, ddof=1), abs=1e-12)
    assert ensemble.json["members"] == 5


def test_an_ensemble_as_a_table(derail, small):
    answer = derail("simulate", small, "--ensemble", 3)
    assert answer.code == 0
    for words in ("mean", "sd", "5 %", "95 %", "member 0", "3 runs"):
        assert words in answer.out
    lines = answer.out.splitlines()
    assert max(map(len, lines[: lines.index("")])) <= 80
    told = derail("simulate", small, "--ensemble", 3, "--json").json
    scene = [1.0 * r["scene_length_m"] for r in told["outcomes"]]
    (row,) = (line.split()[3:] for line in lines if line.startswith("scene length (m)"))
    quantiles = np.quantile(scene, [0.0, 0.05, 0.95, 1.0])
    assert row[2:6] == [f"{v:.1f}" for v in quantiles]
    (row,) = (line.split()[2:] for line in lines if line.startswith("cars derailed"))
    assert all(value.isdigit() for value in row[2:])


def test_a_member_that_leaves_the_alignment_rolls_on_straight(derail, small, tmp_path):
    """The first cars stay on the rails, and the alignment ends 5 m ahead."""
    text = Path(small).read_text().replace("car: 1", "car: 6").replace("rail_breaks: [0]", "{}")
    endless, short = tmp_path / "endless.yaml", tmp_path / "short.yaml"
    endless.write_text(text)
    ahead = "alignment: [{tangent: {length_m: 311}}]"
    ahead = f"track: {{start_coordinate_m: -300, start_x_m: -300, {ahead}}}"
    short.write_text(text.replace("track:\n  {}", ahead))
    whole = derail("simulate", endless, "--ensemble", 3, "--json").json["outcomes"]
    answer = derail("simulate", short, "--ensemble", 3, "--json")
    members = answer.json["outcomes"]
    for own, wanted in zip(members, whole):
        assert own["duration_s"] == pytest.approx(wanted["duration_s"], rel=1e-6)
        assert own["beyond_track_m"] > 0.0
    # The recorded run is that of the scenario itself, which has too short a track.
    answer = derail("simulate", short, "--ensemble", 3, "-o", tmp_path / "out")
    assert "member 0 failed: TrackEndError" in answer.err
    assert "make the alignment longer ahead" in answer.err
    out = " ".join(answer.out.split())
    assert "1 failed and not in the table (1 TrackEndError: a truck" in out
    assert "2 rolled beyond the end of the alignment" in out


# Failures ----------------------------------------------------------------------------------


@pytest.fixture
def failing(monkeypatch):
    """Make runs fail whose lateral force is one of those given; None for all."""
    from derail_ros.engine import PlanarSimulation
    from derail_ros.vocabulary.errors import StepSizeError

    real = PlanarSimulation.advance_to

    def arrange(forces):
        def advance_to(self, t):
            force = self.params.initiation.lateral_forces[0].force
            chosen = forces is None or any(abs(force - f) < 1e-6 for f in forces)
            if chosen and self.n_cars == 6:  # not the train that warms up the kernels
                raise StepSizeError("the step fell below its floor", self)
            return real(self, t)

        monkeypatch.setattr(PlanarSimulation, "advance_to", advance_to)

    return arrange


def test_a_failed_run_is_an_outcome_and_3(derail, small, failing):
    failing(None)
    answer = derail("simulate", small, "--json")
    assert answer.code == 3
    assert "StepSizeError" in answer.json["outcomes"][0]["error"]
    assert answer.json["failed"] == 1
    assert answer.json["mean"] == {}
    assert "StepSizeError" in answer.err
    assert len(answer.err.strip().splitlines()) == 1


def test_a_failed_run_leaves_its_state(derail, small, failing, tmp_path):
    from derail_ros.engine import PlanarSimulation

    failing(None)
    folder = tmp_path / "results"
    assert derail("simulate", small, "-o", folder).code == 3
    state = PlanarSimulation.from_bytes((folder / "failed_state.bin").read_bytes())
    assert state.n_cars == 6


def test_a_failed_member_leaves_the_others(derail, small, failing):
    failing([50e3 * member_factor(7, 2)])
    answer = derail("simulate", small, "--ensemble", 4, "--seed", 7, "--json")
    assert answer.code == 0
    assert ["error" in r for r in answer.json["outcomes"]] == [False, False, True, False]
    assert answer.json["failed"] == 1
    good = [r["duration_s"] for r in answer.json["outcomes"] if "error" not in r]
    assert answer.json["mean"]["duration_s"] == pytest.approx(np.mean(good))
    assert "member 2 failed" in answer.err


def test_void_members_are_counted_and_left_out(derail, small):
    virtual = ["--set", "train.virtual_from=3", "--set", "train.speed_kmh=60"]
    answer = derail("simulate", small, *virtual, "--ensemble", 2, "--json")
    assert answer.code == 0
    assert answer.json["void"] == 2
    assert [r["void"] for r in answer.json["outcomes"]] == [True, True]
    assert answer.json["mean"] == {}
    table = derail("simulate", small, *virtual)
    assert "model more cars" in " ".join(table.out.split())


# Files -------------------------------------------------------------------------------------


@pytest.fixture
def results(derail, small, tmp_path):
    folder = tmp_path / "results"
    answer = derail("simulate", small, "--ensemble", 3, "--seed", 1, "-o", folder, "--json")
    assert answer.code == 0, answer.err
    return folder, answer


def test_files_of_an_ensemble(results):
    folder, answer = results
    for name in ("final_scene.png", "peak_forces.png"):
        assert (folder / name).read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert json.loads((folder / "outcomes.json").read_text()) == answer.json
    with (folder / "outcomes.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["member"] for row in rows] == ["0", "1", "2"]
    assert float(rows[1]["duration_s"]) == answer.json["outcomes"][1]["duration_s"]
    assert "nan" not in (folder / "outcomes.csv").read_text().lower()


def test_manifest(results):
    from derail_ros.scenario import loads_scenario

    folder, answer = results
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["seed"] == 1
    assert manifest["ensemble"] == 3
    assert manifest["scenario_hash"] == answer.json["hash"]
    assert manifest["software"]["derail_ros"]
    assert set(manifest["files"]) == {p.name for p in folder.iterdir()}
    again = loads_scenario(json.dumps(manifest["scenario"]))
    assert again.hash == manifest["scenario_hash"]


def test_recording_is_of_member_0(results):
    from rosbags.highlevel import AnyReader

    folder, answer = results
    with AnyReader([folder / "recording"]) as reader:
        topics = {c.topic for c in reader.connections}
        assert {"/car_poses", "/train_state", "/events", "/outcome", "/consist"} <= topics
        end = 1e-9 * (reader.end_time - reader.start_time)
    assert end >= answer.json["outcomes"][0]["duration_s"] - 0.5


# Shipped scenarios -------------------------------------------------------------------------


def test_scenarios(derail):
    answer = derail("scenarios", "--json")
    names = [s["name"] for s in answer.json["scenarios"]]
    assert {"mississauga", "mississauga_published", "base_train"} <= set(names)
    table = derail("scenarios")
    assert all(name in table.out for name in names)


def test_mississauga_published(derail):
    answer = derail("simulate", "mississauga_published", "--json")
    (outcome,) = answer.json["outcomes"]
    assert 20 <= outcome["cars_derailed"] <= 24
    assert 20.0 < outcome["duration_s"] < 32.0
    assert outcome["max_coupler_gap_m"] < 1e-6
    assert outcome["energy_residual"] < 1e-3


# What a first-time user meets ---------------------------------------------------------------


@pytest.fixture
def first(tmp_path):
    """The first example of docs/scenarios.md, as a file."""
    text = (Path(__file__).parents[2] / "docs" / "scenarios.md").read_text(encoding="utf-8")
    path = tmp_path / "first.yaml"
    path.write_text(text.split("```yaml\n")[1].split("```")[0], encoding="utf-8")
    return str(path)


def test_the_first_example_of_the_documentation_turns_cars(derail, first):
    answer = derail("simulate", first, "--json")
    (outcome,) = answer.json["outcomes"]
    text = (Path(__file__).parents[2] / "docs" / "scenarios.md").read_text(encoding="utf-8")
    words = (
        f"derails {outcome['cars_derailed']} cars, with a largest force of "
        f"{outcome['peak_force_N'] * 1e-6:.1f} MN and a scene "
        f"{outcome['scene_width_m']:.1f} m wide"
    )
    assert words in text
    assert f"after {outcome['first_derailment_s']:.2f} s" in " ".join(text.split())
    assert outcome["peak_force_N"] > 1e6 and outcome["scene_width_m"] > 15.0
    assert answer.json["warnings"] == [] and answer.err == ""


def test_a_push_that_ends_before_the_break_is_warned_of(derail, first):
    answer = derail("simulate", first, "--set", "track.rail_breaks=[30]", "--json")
    assert answer.code == 0
    (warning,) = answer.json["warnings"]
    assert "the push ends at 1.00 s, before the first truck leaves the rails at 1.50 s" in warning
    assert answer.err == f"derail: warning: {warning}\n"
    assert answer.json["outcomes"][0]["cars_derailed"] == 6
    assert answer.json["outcomes"][0]["peak_force_N"] == 0.0
    later = ["--set", "initiation.lateral_force_start_s=1.4"]
    answer = derail(
        "simulate", first, "--set", "track.rail_breaks=[30]", *later, "-n", 2, "--json"
    )
    assert answer.json["warnings"] == [] and answer.err == ""
    assert answer.json["outcomes"][0]["peak_force_N"] > 1e6


def test_shipped_scenarios_are_not_warned_of(derail):
    for name in ("curve_derailment", "mid_train_break", "base_train"):
        assert derail("simulate", name, "--json").json["warnings"] == [], name


def test_a_run_that_its_time_limit_ends_says_so(derail, small, tmp_path):
    limit = ["--set", "integration.time_limit_s=0.5"]
    answer = derail("simulate", small, *limit, "--json")
    assert answer.code == 0
    (outcome,) = answer.json["outcomes"]
    assert outcome["status"] == "time limit" and outcome["at_rest"] is False
    # with the first step that ends then or later
    assert outcome["duration_s"] is None and 0.5 <= outcome["end_time_s"] < 0.56
    table = derail("simulate", small, *limit)
    assert "the run ended at its time limit, not at rest" in " ".join(table.out.split())
    several = derail("simulate", small, *limit, "-n", 3)
    assert "3 ended at the time limit, not at rest" in " ".join(several.out.split())
    whole = derail("simulate", small, "--json").json["outcomes"][0]
    assert whole["at_rest"] is True
    assert "time limit" not in derail("simulate", small).out


def test_the_sentence_of_a_run_that_was_cut_off(small):
    from derail_ros import simulate

    outcome = simulate(small, {"integration.time_limit_s": 0.5})
    assert "ended by its time limit, not at rest, at 0.5 s" in outcome.text
    assert "at rest after" not in outcome.text
    assert "at rest after" in simulate(small).text


def test_the_answer_says_which_run_of_an_ensemble_was_recorded(derail, small, tmp_path):
    answer = derail("simulate", small, "-n", 2, "-o", tmp_path / "out")
    assert "recording, scene and forces of member 0" in answer.out
    alone = derail("simulate", small, "-o", tmp_path / "alone")
    assert "member 0" not in alone.out


UNCERTAIN = """\
uncertain:
  train.speed_kmh: {uniform: [20, 30]}
  train.consist.*.mass_kg: {normal: {mean: 1, sd: 0.05}, relative: true}
"""


def test_members_are_kept_with_what_they_drew(derail, small, tmp_path):
    """The same members whatever -j; cells of the map are covered as often as the poses say."""
    from derail_ros.scenario import load_scenario

    path = Path(small)
    path.write_text(path.read_text(encoding="utf-8") + UNCERTAIN, encoding="utf-8")
    folder = tmp_path / "kept"
    answer = derail("simulate", small, "--ensemble", 6, "-j", 2, "-o", folder, "--json")
    assert answer.code == 0, answer.err
    again = derail("simulate", small, "--ensemble", 6, "-j", 1, "--json")
    assert physics(again.json["mean"]) == physics(answer.json["mean"])
    scenario = load_scenario(small)
    assert answer.json["inputs"] == [scenario.member_inputs(m) for m in range(6)]
    assert 20 <= answer.json["inputs"][4]["train.speed_kmh"] <= 30
    with (folder / "outcomes.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert float(rows[2]["train.speed_kmh"]) == answer.json["inputs"][2]["train.speed_kmh"]
    kept = np.load(folder / "poses.npz")
    assert kept["pose"].shape == (6, 6, 6)
    off = [r["cars_derailed"] for r in answer.json["outcomes"]]
    assert kept["derailed"].sum(axis=1).tolist() == off
    covered = json.loads((folder / "covered.geojson").read_text())
    areas = {}
    for feature in covered["features"]:
        told = feature["properties"]
        areas[told["probability"]] = areas.get(told["probability"], 0.0) + told["area_m2"]
    assert len(covered["features"]) == len(areas) <= 4
    assert areas[0.1667] == areas[0.05] > areas[0.5] > areas.get(0.95, 0.0)
    for name in ("covered.png", "histograms.png"):
        assert (folder / name).read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
