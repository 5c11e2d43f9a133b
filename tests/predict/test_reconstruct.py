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
