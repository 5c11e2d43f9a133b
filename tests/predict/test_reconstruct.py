"""Reconstruction: weights and posteriors against a case with a closed form, and its file."""

from pathlib import Path

import numpy as np
import pytest
from scipy.stats import kstest

from derail_ros.predict import reconstruct as r
from derail_ros.scenario.calibrated import load_calibrated

RNG = np.random.default_rng(5)


def test_a_normal_posterior_is_found() -> None:
    """Prior N(0, 1), output x + N(0, 0.3^2), evidence 1 within 0.4: N(0.8, 0.2)."""
    x = RNG.standard_normal(200_000)
    y = x + 0.3 * RNG.standard_normal(len(x))
    w = r.weights(y[:, None], np.array([1.0]), np.array([0.4]))
    mean = float(x @ w)
    assert mean == pytest.approx(1.0 / 1.25, abs=0.02)
    assert float(((x - mean) ** 2) @ w) == pytest.approx(0.25 / 1.25, rel=0.05)
    assert r.quantile(x, w, 0.5) == pytest.approx(0.8, abs=0.02)


def test_ranks_are_even_for_right_posteriors_and_not_for_narrow_ones() -> None:
    x = RNG.uniform(0.0, 10.0, 900)
    y = (x + 0.5 * RNG.standard_normal(900))[:, None]
    places = r.ranks(y, x, np.array([0.8]), RNG)
    assert kstest(places, "uniform").pvalue > 0.01
    biased = r.ranks(np.sort(y, axis=0), x, np.array([0.1]), RNG)
    assert kstest(biased - 0.2, "uniform").pvalue < 0.01


def test_accuracies_are_widened_until_enough_runs_count() -> None:
    y = RNG.standard_normal((100, 1)) + 30.0
    w, factor = r.widened(y, np.array([0.0]), np.array([1.0]))
    assert factor > 1.0 and r.effective(w) >= r.LEAST
    assert r.widened(y, np.array([30.0]), np.array([1.0]))[1] == 1.0


EXAMPLE = Path(__file__).parents[2] / "examples" / "mississauga_evidence.yaml"


def test_the_example_is_read_and_mistakes_are_named(tmp_path) -> None:
    evidence = r.read_evidence(EXAMPLE)
    assert evidence.known["scene_length_m"] == (132.0, 15.0)
    assert evidence.scenario.n_cars == 74
    text = EXAMPLE.read_text(encoding="utf-8")
    for old, new, words in (
        ("cars_derailed", "cars_lost", "known.cars_lost: unknown"),
        ("within: 1}", "within: 0}", "known.cars_derailed: within must be above 0"),
        ("from: 60", "from: 160", "speed_kmh: from must be above 0 and below to"),
        ("scenario: mississauga", "scenario: nowhere", "unknown scenario"),
        ("speed_kmh: {", "speed: {", "speed: unknown key"),
        ("version: 1", "version: 2", "version: must be 1"),
        ("to: 120", "to: 12000", "speed_kmh: "),
        ("value: 24", "value: 75", "known.cars_derailed: the train has 74 cars, got 75"),
        ("value: 24", "value: -1", "known.cars_derailed: must not be below 0"),
        ("value: 132", "value: -132", "known.scene_length_m: must not be below 0"),
        ("scene_width_m", "cars_left_of_track", "cars_left_of_track: is above cars_derailed"),
    ):
        path = tmp_path / "wrong.yaml"
        path.write_text(text.replace(old, new), encoding="utf-8")
        with pytest.raises(r.EvidenceError, match=words):
            r.read_evidence(path)


def short(tmp_path: Path) -> Path:
    """Evidence of an accident of twelve cars."""
    (tmp_path / "short.yaml").write_text(
        "version: 1\ntitle: Short\n"
        "train: {speed_kmh: 50, consist: [{car: source_base_car, count: 12}]}\n"
        "track: {rail_breaks: [0]}\ninitiation: {derailed_trucks: [{car: 1, truck: both}]}\n",
        encoding="utf-8",
    )
    path = tmp_path / "evidence.yaml"
    path.write_text(
        "version: 1\nscenario: short\nspeed_kmh: {from: 10, to: 90}\n"
        "known: {cars_derailed: {value: 5, within: 0.7}}\n",
        encoding="utf-8",
    )
    return path


def with_known(tmp_path: Path, known: str, track: str = "rail_breaks: [-120]") -> r.Evidence:
    """Evidence of a train of twelve cars about what is given."""
    path = short(tmp_path)
    train = tmp_path / "short.yaml"
    text = train.read_text(encoding="utf-8").replace("rail_breaks: [0]", track)
    train.write_text(text, encoding="utf-8")
    text = path.read_text(encoding="utf-8").replace(
        "cars_derailed: {value: 5, within: 0.7}", known
    )
    path.write_text(text, encoding="utf-8")
    return r.read_evidence(path)


def test_places_of_the_rear_part_are_told_from_the_break(tmp_path) -> None:
    """60 m behind a break at -120 m is the track coordinate -180 m."""
    outputs = np.full((2, len(r.OUTPUTS)), np.nan)
    outputs[:, r.OUTPUTS.index("rear_place")] = -180.0, -120.0
    evidence = with_known(tmp_path, "rear_part_stopped_behind_break_ft: {value: 200, within: 10}")
    name = "rear_part_stopped_behind_break_m"
    assert evidence.known == {name: (60.96, 3.048)}
    assert evidence.computed(outputs)[name].tolist() == [60.0, 0.0]
    older = with_known(tmp_path, "rear_part_stopped_at_m: {value: -180, within: 10}")
    assert older.computed(outputs)["rear_part_stopped_at_m"].tolist() == [-180.0, -120.0]


@pytest.mark.parametrize(
    ("known", "words"),
    [
        ("rear_part_stopped_at_m: {value: -60, within: 10}",
         "known.rear_part_stopped_at_m: is a coordinate along the track, and the rail break is at "
         "-120 m: the rear part cannot have stopped ahead of it"),
        ("rear_part_stopped_behind_break_m: {value: -60, within: 10}",
         "known.rear_part_stopped_behind_break_m: the rear part cannot have stopped ahead"),
        ("rear_part_stopped_behind_break_m: {value: 60, within: 10}, "
         "rear_part_stopped_at_m: {value: -180, within: 10}", "give one of the two"),
        ("scene_length_m: {value: 60, within: 10}, scene_length_ft: {value: 200, within: 10}",
         "known.scene_length_ft: gives the same quantity"),
        ("scene_length_kg: {value: 60, within: 10}", "known.scene_length_kg: unknown"),
    ],
)  # fmt: skip
def test_impossible_evidence_is_refused_by_name(tmp_path, known: str, words: str) -> None:
    with pytest.raises(r.EvidenceError, match=words):
        with_known(tmp_path, known)


def test_a_way_from_the_break_needs_a_break(tmp_path) -> None:
    known = "rear_part_stopped_behind_break_m: {value: 60, within: 10}"
    with pytest.raises(r.EvidenceError, match="has no rail break"):
        with_known(tmp_path, known, "rail_breaks: []")


def test_evidence_takes_the_units_of_scenarios(tmp_path) -> None:
    path = short(tmp_path)
    text = path.read_text(encoding="utf-8").replace("speed_kmh: {from: 10, to: 90}",
                                                    "speed_mph: {from: 10, to: 50}")  # fmt: skip
    path.write_text(text.replace("cars_derailed: {value: 5, within: 0.7}",
                                 "scene_length_ft: {value: 100, within: 10}"))  # fmt: skip
    evidence = r.read_evidence(path)
    assert evidence.speed_kmh == pytest.approx((16.09344, 80.4672))
    assert evidence.known == {"scene_length_m": (30.48, 3.048)}
    path.write_text(text + "speed_kmh: {from: 20, to: 80}\n", encoding="utf-8")
    with pytest.raises(r.EvidenceError, match="speed_kmh: gives the same quantity as speed_mph"):
        r.read_evidence(path)


def test_a_scenario_is_not_taken_for_evidence(tmp_path) -> None:
    short(tmp_path)
    with pytest.raises(r.EvidenceError, match=r"short.yaml: is a scenario and not evidence"):
        r.read_evidence(tmp_path / "short.yaml")


def reconstruction(evidence: r.Evidence, cars: np.ndarray, length: np.ndarray) -> r.Reconstruction:
    """What is found from runs that gave so many cars and such lengths."""
    constants = load_calibrated()
    outputs = np.full((len(cars), len(r.OUTPUTS)), 10.0)
    outputs[:, 0], outputs[:, r.OUTPUTS.index("scene_length")] = cars, length
    values = np.array([v for v, _ in evidence.known.values()])
    accuracy = np.array([s for _, s in evidence.known.values()])
    w, factor = r.widened(np.column_stack([cars, length]), values, accuracy)
    members = [r.Member(constants.draw(i, 0), 0, 0) for i in range(len(cars))]
    return r.Reconstruction(
        evidence, members, np.linspace(10, 90, len(cars)), outputs, w, factor, 0.5
    )


KNOWN = "cars_derailed: {value: 5, within: 0.7}, scene_length_m: {value: 40, within: 4}"


def test_evidence_that_no_run_explains_is_said_first(tmp_path, capsys) -> None:
    """Cars that agree and lengths 160 m off: the length fits worst, and no run explains both."""
    from derail_ros.commands.reconstruct import _print

    evidence = with_known(tmp_path, KNOWN)
    cars = np.full(40, 5.0)
    found = reconstruction(evidence, cars, np.linspace(200.0, 300.0, 40))
    d = found.as_dict()
    assert not d["explained"] and d["accuracy_widened_by"] > r.WIDE
    assert d["fits_worst"] == "scene_length_m" and d["runs_that_explain_all"] == 0
    assert d["off_by_accuracies"]["cars_derailed"] == 0.0
    assert d["off_by_accuracies"]["scene_length_m"] > 40.0
    _print(found, None)
    first = capsys.readouterr().out.splitlines()[0]
    assert first.startswith("THE EVIDENCE IS NOT EXPLAINED: none of 40 runs explains all of it")
    assert "scene_length_m fits worst" in first and "40 ± 4 in the evidence" in first
    assert "prior more than of the evidence" in first
    good = reconstruction(evidence, cars, np.full(40, 40.0))
    assert good.explained and good.warnings() == [] and good.agreeing() == 40
    _print(good, None)
    assert capsys.readouterr().out.splitlines()[0] == evidence.title


def test_the_picture_of_unexplained_evidence_says_so(tmp_path) -> None:
    from derail_ros.predict.picture import reconstruction_picture

    found = reconstruction(
        with_known(tmp_path, KNOWN), np.full(40, 5.0), np.linspace(200.0, 300.0, 40)
    )
    page = reconstruction_picture(found, [])
    texts = " ".join(t.get_text() for t in page.texts)
    assert "THE EVIDENCE IS NOT EXPLAINED" in texts
    assert f"scene length: 40 ± 4 m (taken as ± {4 * found.widened:.3g})" in texts


def test_an_interrupted_command_gives_what_it_has(tmp_path, monkeypatch, capsys) -> None:
    """Interrupted after 30 of 40 runs: a table of 30, and the exit code of an interruption."""
    import json

    from derail_ros.cli import main

    def runs_of(subject, members, *, jobs, progress, into):
        into[:30] = 10.0
        raise KeyboardInterrupt

    monkeypatch.setattr(r, "runs_of", runs_of)
    arguments = ["reconstruct", str(short(tmp_path)), "-n", "40"]
    assert main(arguments) == 130
    told = capsys.readouterr()
    assert "30 runs with calibrated constants" in told.out and "posterior" in told.out
    assert "interrupted after 30 of 40 runs" in told.err
    assert main([*arguments, "--json"]) == 130
    d = json.loads(capsys.readouterr().out)
    assert d["interrupted"] and d["runs"] == 30


def test_plain_progress_estimates_the_time_left(monkeypatch, capsys) -> None:
    """10 of 40 in 50 s: 150 s are left."""
    from derail_ros.commands import common

    clock = iter([0.0, 0.0, 5.0, 50.0, 90.0])
    monkeypatch.setattr(common.time, "monotonic", lambda: next(clock))
    bars = common.PlainProgress()
    task = bars.add_task("reconstruct", total=40)
    bars.update(task, completed=1)
    bars.update(task, completed=10)
    bars.update(task, completed=39)
    assert capsys.readouterr().err.splitlines() == [
        "derail: reconstruct: 10 of 40, about 2 min left",
        "derail: reconstruct: 39 of 40, about 2 s left",
    ]


def test_a_known_extent_follows_the_track() -> None:
    """On a track at 45 degrees the outline lies along it, as long and as wide as is known."""
    from types import SimpleNamespace

    from derail_ros.predict.picture import _known_extent

    u = np.array([1.0, 1.0]) / np.sqrt(2.0)
    cars = np.array([[40.0 * u, 50.0 * u]])
    scene = SimpleNamespace(
        corners=lambda: cars, derailed=np.array([True]), real=np.array([True]),
        track=np.array([0.0 * u, 60.0 * u, 100.0 * u]),
    )  # fmt: skip
    box = _known_extent(scene, 30.0, 8.0)
    along, across = box @ u, box @ np.array([-u[1], u[0]])
    assert along.min() == pytest.approx(30.0) and along.max() == pytest.approx(60.0)
    assert across.min() == pytest.approx(-4.0) and across.max() == pytest.approx(4.0)


def test_a_posterior_moves_to_the_speed_that_was(tmp_path) -> None:
    """Twelve cars: the evidence of a run at 50 km/h tells it from 20 and 80."""
    evidence = r.read_evidence(short(tmp_path))
    found = r.reconstruct(evidence, load_calibrated(), draws=60, jobs=1)
    d = found.as_dict()
    prior, posterior = (d[k]["speed_kmh"] for k in ("prior", "posterior"))
    assert posterior["q95"] - posterior["q05"] < prior["q95"] - prior["q05"]
    slow = d["posterior"]["speed_kmh"]["mean"]
    few = found.outputs[:, 0] <= 4
    assert found.weights[few].sum() < 0.35 and 10.0 < slow < 70.0


def test_the_likeliest_scenes_are_drawn_beside_the_evidence(tmp_path) -> None:
    from derail_ros.cli import main

    folder = tmp_path / "out"
    arguments = ["reconstruct", str(short(tmp_path)), "-n", "20", "-j", "1", "-o", str(folder)]
    assert main(arguments) == 0
    for name in ("reconstruction.png", "likeliest_3/final_scene.png"):
        assert (folder / name).read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


@pytest.mark.slow
def test_true_speeds_of_synthetic_accidents_are_ranked_evenly(tmp_path) -> None:
    """Simulation-based calibration with the engine (Talts et al. 2018)."""
    found = r.reconstruct(r.read_evidence(short(tmp_path)), load_calibrated(), draws=300, jobs=1)
    assert found.even > 0.01
