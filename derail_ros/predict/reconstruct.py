"""Speed, brakes and ground of an accident from what is known of it.

Approximate Bayesian computation. Runs are drawn from the prior: a speed, and the calibrated
constants. Each has the weight of the evidence, ``exp(-sum((o - e)^2 / s^2) / 2)`` over the known
outcomes: computed ``o``, evidence ``e`` with its accuracy ``s`` as one standard deviation. Where
fewer than :data:`LEAST` runs would count, all ``s`` are widened by one factor, and that is said.
Beyond :data:`WIDE` the first thing said is that the evidence is not explained.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, create_model

from derail_ros.predict.prediction import BANDS
from derail_ros.predict.runs import OUTPUTS, Member, runs_of
from derail_ros.scenario import Scenario, load_scenario
from derail_ros.scenario.calibrated import Calibrated
from derail_ros.scenario.units import field_of
from derail_ros.studies.ensemble import Progress
from derail_ros.vocabulary.words import count, finite

F64 = NDArray[np.float64]

LEAST = 20.0
"""Effective number of runs that a posterior needs."""

WIDE = 3.0
"""Factor on the accuracies beyond which the evidence is not explained, and accuracies within which
a run agrees with an item. Widened by 3, a measurement tells a ninth of what it told (as
``1 / s^2``), and an error of 3 standard deviations happens once in 370 times."""

UNEVEN = 0.01
"""p of even ranks below which the bands are said not to hold."""

BEHIND = "rear_part_stopped_behind_break_m"

KNOWN = {
    "cars_derailed": "derailed",
    "scene_length_m": "scene_length",
    "scene_width_m": "scene_width",
    "cars_left_of_track": "left",
    BEHIND: "rear_place",
    "rear_part_stopped_at_m": "rear_place",
    "duration_s": "duration",
}
"""What may be known -> its place in ``runs.OUTPUTS``. Places of the rear part are of the front
truck of its first car: the way back from the rail break, or the track coordinate."""

_UNITS: type[BaseModel] = create_model(
    "_UNITS", **dict.fromkeys((*KNOWN, "speed_kmh"), (Any, None))
)  # type: ignore[call-overload]
"""The fields whose other units ``scenario.units`` knows."""


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

    @cached_property
    def break_at(self) -> float | None:
        """Track coordinate of the rail break, of several the first one, m; None without."""
        return min(self.scenario.to_params().track.rail_breaks, default=None)

    def computed(self, outputs: F64) -> dict[str, F64]:
        """What each run gives of what may be known: key of :data:`KNOWN` -> (n,)."""
        found = {key: outputs[:, OUTPUTS.index(name)] for key, name in KNOWN.items()}
        at = self.break_at
        found[BEHIND] = (math.nan if at is None else at) - found[BEHIND]
        return found


def read_evidence(path: Path) -> Evidence:
    """Read a file of evidence.

    Lengths and the speed may be given in the other units of scenarios, ``speed_mph`` for one.

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
    if "train" in data:
        raise EvidenceError(
            f"{path}: is a scenario and not evidence: a file of evidence names the scenario of "
            "the train (scenario), what is known (known) and the limits of the speed (speed_kmh)"
        )
    if data.get("version", 1) != 1:
        raise EvidenceError(f"{path}: version: must be 1")
    speed = {key: of for key in data if (of := _field(key)) and of[0] == "speed_kmh"}
    if extra := sorted(set(data) - {"version", "title", "scenario", "known", *speed}):
        raise EvidenceError(f"{path}: {extra[0]}: unknown key")
    for key, given in (("scenario", "scenario" in data), ("known", "known" in data),
                       ("speed_kmh", bool(speed))):  # fmt: skip
        if not given:
            raise EvidenceError(f"{path}: {key}: is required")
    if len(speed) > 1:
        raise EvidenceError(f"{path}: {list(speed)[1]}: gives the same quantity as {[*speed][0]}")
    key, (_, factor) = next(iter(speed.items()))
    low, high = _pair(data[key], f"{path}: {key}", "from", "to")
    if not 0.0 < low < high:
        raise EvidenceError(f"{path}: {key}: from must be above 0 and below to")
    limits = low * factor, high * factor
    try:
        scenario = load_scenario(str(data["scenario"]), [path.parent])
    except ScenarioError as error:
        raise EvidenceError(f"{path}: scenario: {error}") from None
    for limit in limits:
        try:
            scenario.with_overrides({"train.speed_kmh": limit})
        except ScenarioError as error:
            raise EvidenceError(f"{path}: {key}: {error.reason}") from None
    known = _known(data["known"], str(path))
    evidence = Evidence(str(data.get("title", path.stem)), scenario, known, limits)
    _possible(evidence, str(path))
    return evidence


def _field(key: str) -> tuple[str, float] | None:
    """The name of what a key gives, and the factor to its unit."""
    if key in _UNITS.model_fields:
        return key, 1.0
    found = field_of(key, _UNITS)
    return None if found is None else (found[0], found[1](1.0))


def _known(data: Any, file: str) -> dict[str, tuple[float, float]]:
    if not isinstance(data, dict) or not data:
        raise EvidenceError(f"{file}: known: must name at least one of {', '.join(KNOWN)}")
    known: dict[str, tuple[float, float]] = {}
    for key, value in data.items():
        where = f"{file}: known.{key}"
        name, factor = _field(key) or ("", 1.0)
        if name not in KNOWN:
            raise EvidenceError(f"{where}: unknown; there are {', '.join(KNOWN)}")
        if name in known:
            raise EvidenceError(f"{where}: gives the same quantity as another key")
        middle, within = _pair(value, where, "value", "within")
        if within <= 0.0:
            raise EvidenceError(f"{where}: within must be above 0, got {within:g}")
        known[name] = float(f"{middle * factor:.15g}"), float(f"{within * factor:.15g}")
    return known


def _possible(evidence: Evidence, file: str) -> None:
    """Refuse evidence that no run can give."""
    known, cars = evidence.known, evidence.scenario.n_cars
    break_at = evidence.break_at

    def refuse(key: str, reason: str) -> None:
        raise EvidenceError(f"{file}: known.{key}: {reason}, got {known[key][0]:g}")

    for key in known.keys() - {"rear_part_stopped_at_m", BEHIND}:
        if known[key][0] < 0.0:
            refuse(key, "must not be below 0")
    for key in known.keys() & {"cars_derailed", "cars_left_of_track"}:
        if known[key][0] > cars:
            refuse(key, f"the train has {count(cars, 'car')}")
    both = known.get("cars_left_of_track", (0.0,))[0], known.get("cars_derailed", (math.inf,))[0]
    if both[0] > both[1]:
        refuse("cars_left_of_track", f"is above cars_derailed ({both[1]:g})")
    if "rear_part_stopped_at_m" in known and BEHIND in known:
        refuse(BEHIND, "says the same as rear_part_stopped_at_m: give one of the two")
    if BEHIND in known:
        if break_at is None:
            refuse(BEHIND, f"the scenario {evidence.scenario.name} has no rail break")
        if known[BEHIND][0] < 0.0:
            refuse(BEHIND, "the rear part cannot have stopped ahead of the rail break: must not "
                   "be below 0")  # fmt: skip
    at = known.get("rear_part_stopped_at_m")
    if at is not None and break_at is not None and at[0] > break_at:
        refuse(
            "rear_part_stopped_at_m",
            f"is a coordinate along the track, and the rail break is at {break_at:g} m: the rear "
            f"part cannot have stopped ahead of it ({BEHIND} takes the way back from the break)",
        )


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
    draws: int = 0  # that were asked for; 0: as many as there are

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

    @property
    def asked(self) -> int:
        """Runs that were asked for; more than there are if the command was interrupted."""
        return self.draws or len(self.weights)

    @property
    def explained(self) -> bool:
        """The runs that count agree with the evidence, accuracies widened by :data:`WIDE`."""
        return self.widened <= WIDE

    def apart(self) -> dict[str, F64]:
        """Distance of each run from each known value, in its accuracies: key -> (n,)."""
        computed = self.evidence.computed(self.outputs)
        return {k: np.abs(computed[k] - v) / s for k, (v, s) in self.evidence.known.items()}

    def agreeing(self) -> int:
        """Number of runs within :data:`WIDE` accuracies of every known value."""
        far = np.max(list(self.apart().values()), axis=0)  # nan where an output does not exist
        return int(np.sum(far <= WIDE))

    def off(self) -> dict[str, float]:
        """Mean distance from each known value of the runs that count, in its accuracies."""
        on = self.weights > 0.0
        return {k: float(self.weights[on] @ far[on]) for k, far in self.apart().items()}

    def warnings(self) -> list[str]:
        """What to know before the table is read."""
        said = []
        off = self.off()
        worst = max(off, key=lambda k: off[k])
        if not self.explained:
            n, runs = self.agreeing(), count(len(self.weights), "run")
            which = f"none of {runs} explains" if not n else f"{n} of {runs} explain"
            value, within = self.evidence.known[worst]
            on = self.weights > 0.0
            mean = float(self.weights[on] @ self.evidence.computed(self.outputs)[worst][on])
            said.append(
                f"THE EVIDENCE IS NOT EXPLAINED: {which} all of it together. All accuracies were "
                f"widened by {self.widened:.1f}, so the bands are those of the prior more than of "
                f"the evidence. {worst} fits worst: {mean:.3g} in the runs that count, "
                f"{value:.4g} ± {within:.3g} in the evidence."
            )
        elif self.widened > 1.0:
            said.append(
                f"Few runs come near the evidence: its accuracies were widened by "
                f"{self.widened:.2f}; more draws (-n), or a wider range of speeds"
            )
        if self.even < UNEVEN:
            said.append(
                "The bands do not hold: the true speeds of runs taken as accidents lie unevenly "
                f"in the bands found for them (p = {self.even:.2g})"
            )
        return said

    def as_dict(self) -> dict[str, Any]:
        """As plain data for JSON."""
        even = np.full(len(self.weights), 1.0 / len(self.weights))

        def of(values: F64, w: F64) -> dict[str, float | None]:
            quantiles = {k: finite(quantile(values, w, q), 4) for k, q in BANDS.items()}
            return {"mean": finite(float(values @ w), 4), **quantiles}

        found = self.quantities()
        off = self.off()
        computed = self.evidence.computed(self.outputs)
        return {
            "warnings": self.warnings(),
            "title": self.evidence.title,
            "constants": "calibrated",
            "scenario": self.evidence.scenario.name,
            "known": {k: {"value": v, "within": s} for k, (v, s) in self.evidence.known.items()},
            "runs": len(self.weights),
            "interrupted": len(self.weights) < self.asked,
            "effective_runs": finite(effective(self.weights), 1),
            "accuracy_widened_by": finite(self.widened, 3),
            "explained": self.explained,
            "runs_that_explain_all": self.agreeing(),
            "off_by_accuracies": {k: finite(v, 2) for k, v in off.items()},
            "fits_worst": max(off, key=lambda k: off[k]),
            "prior": {k: of(v, even) for k, v in found.items()},
            "posterior": {k: of(v, self.weights) for k, v in found.items()},
            "ranks_even_p": finite(self.even, 3),
            "likeliest": [
                {
                    **{k: finite(v[i], 4) for k, v in found.items()},
                    **{k: finite(v[i], 2) for k, v in computed.items()},
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
    """Infer the unknown quantities of an accident.

    After an interruption (KeyboardInterrupt) the runs that are done are taken, if there are
    :data:`LEAST` of them.
    """
    from scipy.stats import kstest

    rng = np.random.default_rng([seed, draws])
    low, high = evidence.speed_kmh
    speeds = low + (high - low) * (rng.permutation(draws) + rng.random(draws)) / draws
    speeds = np.round(speeds, 2)
    members = [Member(constants.draw(i, seed), 0, 0) for i in range(draws)]

    def at_its_speed(i: int) -> Scenario:
        return evidence.scenario.with_overrides({"train.speed_kmh": float(speeds[i])})

    outputs = np.full((draws, len(OUTPUTS)), math.nan)
    try:
        runs_of(at_its_speed, members, jobs=jobs, progress=progress, into=outputs)
    except KeyboardInterrupt:
        done = np.isfinite(outputs[:, OUTPUTS.index("derailed")])
        if done.sum() < LEAST:
            raise
        outputs, speeds = outputs[done], speeds[done]
        members = [m for m, kept in zip(members, done, strict=True) if kept]
    computed = evidence.computed(outputs)
    known = np.column_stack([computed[k] for k in evidence.known])
    values = np.array([v for v, _ in evidence.known.values()])
    accuracy = np.array([s for _, s in evidence.known.values()])
    w, factor = widened(known, values, accuracy)
    if not w.any():
        raise EvidenceError(
            f"{evidence.title}: no run gives all of {', '.join(evidence.known)}: in each of them "
            "one does not exist (no car derailed, or none is left on the rails behind)"
        )
    good = np.isfinite(known).all(axis=1)
    places = ranks(known[good], speeds[good], factor * accuracy, rng)
    even = float(kstest(places, "uniform").pvalue) if len(places) > 10 else math.nan
    return Reconstruction(evidence, members, speeds, outputs, w, factor, even, draws)
