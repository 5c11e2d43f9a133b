"""Speed, brakes and ground of an accident from what is known of it.

Approximate Bayesian computation. Runs are drawn from the prior: a speed, and the calibrated
constants. Each has the weight of the evidence, ``exp(-sum((o - e)^2 / s^2) / 2)`` over the known
outcomes: computed ``o``, evidence ``e`` with its accuracy ``s`` as one standard deviation. Where
fewer than :data:`LEAST` runs would count, all ``s`` are widened by one factor, and that is said.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from derail_ros.predict.prediction import BANDS
from derail_ros.predict.runs import OUTPUTS, Member, runs_of
from derail_ros.scenario import Scenario, load_scenario
from derail_ros.scenario.calibrated import Calibrated
from derail_ros.studies.ensemble import Progress
from derail_ros.vocabulary.words import finite

F64 = NDArray[np.float64]

LEAST = 20.0
"""Effective number of runs that a posterior needs."""

KNOWN = {
    "cars_derailed": "derailed",
    "scene_length_m": "scene_length",
    "scene_width_m": "scene_width",
    "cars_left_of_track": "left",
    "rear_part_stopped_at_m": "rear_place",
    "duration_s": "duration",
}
"""What may be known -> its place in ``runs.OUTPUTS``."""


class EvidenceError(ValueError):
    """Evidence that cannot be used; names file, field and reason."""


@dataclass(frozen=True)
class Evidence:
    """What is known of an accident.

    Attributes
    ----------
    title : what it is
    scenario : the train
    known : key of :data:`KNOWN` -> value, standard deviation
    speed_kmh : limits between which every speed is as likely before
    """

    title: str
    scenario: Scenario
    known: dict[str, tuple[float, float]]
    speed_kmh: tuple[float, float]


def read_evidence(path: Path) -> Evidence:
    """Read a file of evidence.

    Raises
    ------
    EvidenceError, ScenarioError
        Naming file and field.
    """
    from derail_ros.scenario.errors import ScenarioError
    from derail_ros.scenario.strict_yaml import parse

    try:
        data = parse(path.read_text(encoding="utf-8"), str(path)).data
    except (OSError, UnicodeDecodeError) as error:
        raise EvidenceError(f"{path}: {error}") from None
    if extra := sorted(set(data) - {"version", "title", "scenario", "known", "speed_kmh"}):
        raise EvidenceError(f"{path}: {extra[0]}: unknown key")
    for key in ("scenario", "known", "speed_kmh"):
        if key not in data:
            raise EvidenceError(f"{path}: {key}: is required")
    speed = _pair(data["speed_kmh"], f"{path}: speed_kmh", "from", "to")
    if not 0.0 < speed[0] < speed[1]:
        raise EvidenceError(f"{path}: speed_kmh: from must be above 0 and below to")
    if not isinstance(data["known"], dict) or not data["known"]:
        raise EvidenceError(f"{path}: known: must name at least one of {', '.join(KNOWN)}")
    known = {}
    for key, value in data["known"].items():
        where = f"{path}: known.{key}"
        if key not in KNOWN:
            raise EvidenceError(f"{where}: unknown; there are {', '.join(KNOWN)}")
        known[key] = _pair(value, where, "value", "within")
        if known[key][1] <= 0.0:
            raise EvidenceError(f"{where}: within must be above 0, got {known[key][1]:g}")
    try:
        scenario = load_scenario(str(data["scenario"]), [path.parent])
    except ScenarioError as error:
        raise EvidenceError(f"{path}: scenario: {error}") from None
    return Evidence(str(data.get("title", path.stem)), scenario, known, speed)


def _pair(value: Any, where: str, first: str, second: str) -> tuple[float, float]:
    good = isinstance(value, dict) and set(value) == {first, second}
    if not good or not all(type(v) in (int, float) and math.isfinite(v) for v in value.values()):
        raise EvidenceError(f"{where}: must be {{{first}: NUMBER, {second}: NUMBER}}")
    return float(value[first]), float(value[second])


def weights(outputs: F64, values: F64, deviations: F64) -> F64:
    """Weights of runs, (n,), summing to 1; 0 where an output does not exist.

    ``outputs`` (n, k), ``values`` and ``deviations`` (k,).
    """
    far = (((outputs - values) / deviations) ** 2).sum(axis=1)
    far = np.where(np.isfinite(far), far, np.inf)
    if not np.isfinite(far).any():
        return np.zeros(len(far))
    w = np.exp(-0.5 * (far - far.min()))
    return w / w.sum()


def effective(w: F64) -> float:
    """Effective number of runs, ``1 / sum(w^2)``."""
    total = float((w**2).sum())
    return 1.0 / total if total else 0.0


def widened(outputs: F64, values: F64, deviations: F64) -> tuple[F64, float]:
    """Weights with at least :data:`LEAST` effective runs, and the factor on the accuracies."""
    factor = 1.0
    while True:
        w = weights(outputs, values, factor * deviations)
        if effective(w) >= min(LEAST, 0.5 * len(w)) or factor > 1e3:
            return w, factor
        factor *= 1.1


def ranks(outputs: F64, truth: F64, deviations: F64, rng: np.random.Generator) -> F64:
    """Simulation-based calibration: rank of the truth of each run among the others, 0 to 1.

    Each run is taken as an accident: its outputs, with errors of the accuracies, are the evidence,
    and the other runs give its posterior. The ranks are even if posteriors are what they say
    (Talts et al. 2018).
    """
    found = []
    for i in range(len(truth)):
        noisy = outputs[i] + deviations * rng.standard_normal(outputs.shape[1])
        rest = np.arange(len(truth)) != i
        w = weights(outputs[rest], noisy, deviations)
        if effective(w) >= 2.0:
            found.append(float(w[truth[rest] < truth[i]].sum()))
    return np.array(found)


def quantile(values: F64, w: F64, level: float) -> float:
    """Weighted quantile."""
    order = np.argsort(values)
    at = int(np.searchsorted(np.cumsum(w[order]), level * w.sum()))
    return float(values[order][min(at, len(values) - 1)])


@dataclass(frozen=True)
class Reconstruction:
    """Runs, their weights, and the inferred quantities."""

    evidence: Evidence
    members: Sequence[Member]
    speeds: F64  # km/h
    outputs: F64
    weights: F64
    widened: float
    even: float  # p of the test that ranks of simulation-based calibration are even

    def quantities(self) -> dict[str, F64]:
        """Inferred quantities by name: values of all runs."""
        draws = [m.draw for m in self.members]
        return {
            "speed_kmh": self.speeds,
            "brake_delay_s": np.array(
                [d.delay(v / 3.6) for d, v in zip(draws, self.speeds, strict=True)]
            ),
            "brake_force_factor": np.array([d.brake_force for d in draws]),
            "ground_factor": np.array([d.ground for d in draws]),
        }

    def likeliest(self, n: int = 3) -> list[int]:
        """Numbers of the runs nearest to the evidence."""
        return [int(i) for i in np.argsort(-self.weights)[:n]]

    def as_dict(self) -> dict[str, Any]:
        """As plain data for JSON."""
        even = np.full(len(self.weights), 1.0 / len(self.weights))

        def of(values: F64, w: F64) -> dict[str, float | None]:
            quantiles = {k: finite(quantile(values, w, q), 4) for k, q in BANDS.items()}
            return {"mean": finite(float(values @ w), 4), **quantiles}

        found = self.quantities()
        return {
            "title": self.evidence.title,
            "constants": "calibrated",
            "scenario": self.evidence.scenario.name,
            "known": {k: {"value": v, "within": s} for k, (v, s) in self.evidence.known.items()},
            "runs": len(self.weights),
            "effective_runs": finite(effective(self.weights), 1),
            "accuracy_widened_by": finite(self.widened, 3),
            "prior": {k: of(v, even) for k, v in found.items()},
            "posterior": {k: of(v, self.weights) for k, v in found.items()},
            "ranks_even_p": finite(self.even, 3),
            "likeliest": [
                {
                    **{k: finite(v[i], 4) for k, v in found.items()},
                    **{k: finite(self.outputs[i, OUTPUTS.index(o)], 2) for k, o in KNOWN.items()},
                    "weight": finite(self.weights[i], 4),
                }
                for i in self.likeliest()
            ],
        }


def reconstruct(
    evidence: Evidence,
    constants: Calibrated,
    *,
    draws: int = 400,
    seed: int = 0,
    jobs: int | None = None,
    progress: Progress | None = None,
) -> Reconstruction:
    """Infer the unknown quantities of an accident."""
    from scipy.stats import kstest

    rng = np.random.default_rng([seed, draws])
    low, high = evidence.speed_kmh
    speeds = low + (high - low) * (rng.permutation(draws) + rng.random(draws)) / draws
    speeds = np.round(speeds, 2)
    members = [Member(constants.draw(i, seed), 0, 0) for i in range(draws)]

    def at_its_speed(i: int) -> Scenario:
        return evidence.scenario.with_overrides({"train.speed_kmh": float(speeds[i])})

    outputs = runs_of(at_its_speed, members, jobs=jobs, progress=progress)
    columns = [OUTPUTS.index(KNOWN[k]) for k in evidence.known]
    values = np.array([v for v, _ in evidence.known.values()])
    accuracy = np.array([s for _, s in evidence.known.values()])
    w, factor = widened(outputs[:, columns], values, accuracy)
    good = np.isfinite(outputs[:, columns]).all(axis=1)
    places = ranks(outputs[good][:, columns], speeds[good], factor * accuracy, rng)
    even = float(kstest(places, "uniform").pvalue) if len(places) > 10 else math.nan
    return Reconstruction(evidence, members, speeds, outputs, w, factor, even)
