"""A prediction: the number of derailed cars with bands, beside statistical models."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from derail_ros.predict import release, scores
from derail_ros.predict.emulator import quick_distribution
from derail_ros.predict.runs import CAUSES, LEVELS, OUTPUTS, Drawable, Member, members, runs_of
from derail_ros.predict.statistical import KINDS, WORDS, Statistical, covariates
from derail_ros.predict.trains import Train, first_car
from derail_ros.scenario.calibrated import Calibrated, load_calibrated
from derail_ros.studies.accidents import KMH_PER_MPH
from derail_ros.studies.ensemble import Progress
from derail_ros.vocabulary.params import TrainParams
from derail_ros.vocabulary.words import finite, joined

F64 = NDArray[np.float64]

BANDS = {"q05": 0.05, "q25": 0.25, "q50": 0.5, "q75": 0.75, "q95": 0.95}
"""Key of a quantile -> its level: the ends of the 50 and 90 % bands, and the median."""


def train_of(params: TrainParams) -> Train:
    """A scenario's train as a report describes it, from the first car involved on."""
    cars = params.cars[first_car(params) - 1 :]
    n = sum(c.represents for c in cars)
    loads, empties = sum(c.loads for c in cars), sum(c.empties for c in cars)
    share = loads / (loads + empties) if loads + empties else 1.0
    return Train(params.initiation.speed, n, sum(c.mass for c in cars) / n, share)


def of_values(values: F64) -> dict[str, float | None]:
    """Mean and quantiles of the values that are numbers."""
    good = values[np.isfinite(values)]
    if not len(good):
        return {"mean": None, **dict.fromkeys(BANDS)}
    quantiles = {
        k: finite(np.quantile(good, q, method="inverted_cdf"), 4) for k, q in BANDS.items()
    }
    return {"mean": finite(good.mean(), 4), **quantiles}


def of_distribution(p: F64) -> dict[str, float | None]:
    """The same of a distribution over 1, 2, ... cars."""
    return {
        "mean": finite(scores.mean(p), 4),
        **{k: float(scores.quantile(p, q)) for k, q in BANDS.items()},
    }


@dataclass(frozen=True)
class Prediction:
    """The prediction of an accident.

    Attributes
    ----------
    train : the train from its first car involved on
    cause : key of ``runs.CAUSES``
    constants : "calibrated" or "published"
    drawn : what was drawn of each run
    outputs : ``runs.OUTPUTS`` of each, (n, len(OUTPUTS)); nan of runs that failed
    statistical : kind -> distribution over 1 to ``train.behind`` cars
    few_share : share of accidents of which few cars derail
    """

    train: Train
    cause: str
    constants: str
    drawn: Sequence[Member]
    outputs: F64
    statistical: dict[str, F64]
    few_share: float

    def output(self, name: str) -> F64:
        """One of ``runs.OUTPUTS`` of all runs."""
        return self.outputs[:, OUTPUTS.index(name)]

    @property
    def cars_derailed(self) -> F64:
        """Cars derailed in the runs that did not fail."""
        n = self.output("derailed")
        return n[np.isfinite(n)]

    def as_dict(self, hazardous: int = 0) -> dict[str, Any]:
        """As plain data for JSON."""
        counts = self.cars_derailed
        t = self.train
        return {
            "constants": self.constants,
            "train": {
                "speed_kmh": finite(t.speed * 3.6, 4),
                "cars_behind": t.behind,
                "mean_mass_kg": finite(t.mass, 1),
                "loaded_share": finite(t.loaded, 4),
            },
            "cause": self.cause,
            "runs": len(self.outputs),
            "failed": int(len(self.outputs) - len(counts)),
            "few_share": finite(self.few_share, 4),
            "cars_derailed": {**of_values(counts), "samples": [int(n) for n in counts]},
            "cars_struck": {
                f"above_{level / 1e6:g}MN": of_values(self.output(f"above_{level / 1e6:g}MN"))
                for level in LEVELS
            },
            "peak_force_N": of_values(self.output("peak_force")),
            "scene_length_m": of_values(self.output("scene_length")),
            "scene_width_m": of_values(self.output("scene_width")),
            "duration_s": of_values(self.output("duration")),
            "statistical": {
                kind: {"words": WORDS[kind], **of_distribution(p)}
                for kind, p in self.statistical.items()
            },
            "releases": release.of_runs(self.outputs, t.behind, hazardous),
        }

    def sentences(self) -> list[str]:
        """The prediction in words."""
        d = self.as_dict()
        n, t = d["cars_derailed"], self.train
        dragged = [m.few for m in self.drawn if m.few]
        few = ""
        if dragged:
            few = (
                f" In {len(dragged) / len(self.drawn):.0%} of them no pile-up forms: the derailed "
            )
            few += f"cars are dragged along in line, {np.mean(dragged):.0f} on average and "
            few += f"{max(dragged)} at most, as in reports."
        return [
            f"{t.speed * 3.6:.0f} km/h ({t.speed * 3.6 / KMH_PER_MPH:.0f} mph), {t.behind} cars "
            f"from the break to the end, {t.mass / 1e3:.0f} t a car, {CAUSES[self.cause]}; "
            f"{self.constants} constants; {len(self.cars_derailed)} runs.{few}",
            f"Cars derailed: {n['mean']:.0f} on average. Half of such accidents derail "
            f"{n['q25']:.0f} to {n['q75']:.0f}, nine of ten {n['q05']:.0f} to {n['q95']:.0f}.",
        ]


APART = 1.0 / 3.0
"""Means that differ by more are told apart, of the statistical one."""


def differs(found: Prediction, params: TrainParams) -> str:
    """Why a scenario's runs may differ from the statistical models, which know the train only.

    "" where the mean of the runs is within a third of the statistical models' mean and inside
    their 90 % bands.
    """
    counts = found.cars_derailed
    if not len(counts):
        return ""
    mean = float(counts.mean())
    usual = float(np.mean([scores.mean(p) for p in found.statistical.values()]))
    bands = [[scores.quantile(p, q) for q in (0.05, 0.95)] for p in found.statistical.values()]
    if abs(mean - usual) <= APART * usual and all(a <= mean <= b for a, b in bands):
        return ""
    has = []
    curvature = [abs(c) for s in params.track.segments
                 for c in (s.curvature_start, s.curvature_end) if c]  # fmt: skip
    if curvature:
        has.append(f"a curve of {1.0 / max(curvature):.0f} m radius")
    grades = [g.grade for g in params.track.grades if g.grade]
    if grades:
        steepest = max(grades, key=abs)
        has.append(f"a grade of {100.0 * steepest:+.1f} %")
    brakes = params.brakes
    if not brakes.triggers:
        late = (
            "begin only where a coupling parts" if brakes.vent_on_parting else "are never applied"
        )
        has.append(f"brakes that {late}")
    if params.couplings.breaks:
        has.append("couplings that break in tension")
    if params.standing or params.site.fixed:
        has.append("bodies beside the track")
    text = (
        f"The runs derail {mean:.0f} cars on average, the statistical models {usual:.0f}: those "
        "know only speed, number, mass and load of the cars, and the cause"
    )
    return f"{text}. This scenario also has {joined(has)}." if has else f"{text}."


def quick_band(params: TrainParams) -> str:
    """A sentence: that a run is one draw, and the band of such accidents, without a run.

    For a broken rail or trucks off at the start on straight track; "" for anything else.
    """
    starts = params.track.rail_breaks or params.initiation.derailed_trucks
    train = train_of(params)
    if not starts or params.track.segments or train.behind < 5 or train.speed < 1.0:
        return ""
    p = quick_distribution(load_calibrated(), "broken_rail", train)
    a, b, c, d = (scores.quantile(p, q) for q in (0.25, 0.75, 0.05, 0.95))
    return (
        f"This is one possible run. Half of such trains derail {a} to {b} cars after a broken "
        f"rail, nine of ten {c} to {d} (estimated with calibrated constants; use derail predict "
        f"to compute it)."
    )


def statistical_of(constants: Calibrated, cause: str, train: Train) -> dict[str, F64]:
    """Distributions of the refitted statistical models."""
    x = covariates(*(np.array([float(v)]) for v in
                     (train.speed, train.behind, train.mass, train.loaded)))[0]  # fmt: skip
    fitted = constants.statistical[cause]
    return {k: Statistical(k, np.array(fitted[k])).pmf(x, train.behind) for k in KINDS}


def predict(
    subject: Train | Drawable,
    constants: Calibrated,
    cause: str = "broken_rail",
    *,
    draws: int = 1000,
    seed: int = 0,
    jobs: int | None = None,
    progress: Progress | None = None,
) -> Prediction:
    """Predict an accident.

    Parameters
    ----------
    subject : a train of which a report's numbers are known, or a scenario
    constants : the calibrated set
    cause : key of ``runs.CAUSES``
    draws : number of runs
    """
    train = subject if isinstance(subject, Train) else train_of(subject.to_params())
    drawn = members(constants, cause, train.speed, train.behind, draws, seed)
    outputs = runs_of(subject, drawn, jobs=jobs, progress=progress)
    return Prediction(
        train, cause, "calibrated", drawn, outputs, statistical_of(constants, cause, train),
        constants.few[cause].share(train.speed, train.behind),
    )  # fmt: skip
