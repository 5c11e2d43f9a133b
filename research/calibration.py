"""From a bank of runs and the reports to the distribution of the uncertain constants.

Each accident has constants of its own. Their distribution over accidents, :class:`Population`, is
what is learned: the pile's share, and for each constant (or its logarithm) a normal distribution.
The likelihood of a report is the probability of its count under runs of its own train with
constants from the population. An :class:`Emulator` of the engine, a regression on the bank,
computes it; predictions and their final scores are runs of the engine itself.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import expit, ndtr
from scipy.stats import ks_2samp, norm, qmc

from derail_ros.commands.common import CommandFailure, note
from derail_ros.config_path import config_path
from derail_ros.predict import scores
from derail_ros.predict.emulator import (
    LOG,
    PRIOR,
    PRIOR_MEAN,
    PRIOR_SD,
    Emulator,
    log_few,
    mixed,
    pile_pmf,
)
from derail_ros.predict.runs import CAUSES, group_of, run
from derail_ros.predict.statistical import KINDS, WORDS, covariates, fit
from derail_ros.predict.trains import Train, train_params
from derail_ros.review.drawing import BLUE, INK, dress, place, sheet, styled
from derail_ros.scenario.calibrated import FILE, NAMES
from derail_ros.studies.accidents import (
    SOURCE,
    AccidentFileError,
    Report,
    read_reports,
)
from derail_ros.studies.tables import Table
from research.bank import PROPOSAL, bank_engine, read_bank, to_draw, train_of
from research.pages import Options, fill, with_places

if TYPE_CHECKING:
    from matplotlib.figure import Figure

F64 = NDArray[np.float64]

FREE = ("brake_distance", "brake_time", "brake_force", "ground")
"""Constants whose distribution is learned; the others keep their prior's. Free grades went to 1.2
% downhill with stronger brakes: counts cannot tell the two apart, but grades are even."""

FEW_PRIOR = np.array([[-2.5, 1.0], [0.0, 0.7], [0.0, 0.5], [1.6, 0.7], [-0.7, 0.7]])
"""Mean and deviation of: ln odds of few, their slopes over ln speed and ln behind, ln mean cars
above 1, ln dispersion."""

START = np.concatenate([np.zeros(2 * len(FREE)), FEW_PRIOR[:, 0]])


@dataclass(frozen=True)
class Population:
    """Distribution of the constants over accidents, and how many of them are piles.

    ``vector``: shifts of the means of :data:`FREE` in prior deviations, logarithms of the ratios
    of their deviations to the prior's, then those of :data:`FEW_PRIOR`.
    """

    vector: F64

    def constants(self, normal: F64) -> F64:
        """Constants (..., 10) from standard normal numbers."""
        mean, sd = PRIOR_MEAN.copy(), PRIOR_SD.copy()
        for k, name in enumerate(FREE):
            i = NAMES.index(name)
            mean[i] += self.vector[k] * PRIOR_SD[i]
            sd[i] *= np.exp(self.vector[len(FREE) + k])
        return mean + sd * normal

    @property
    def few(self) -> F64:
        """The part of the vector that is about few."""
        return self.vector[2 * len(FREE) :]

    def share_few(self, train: F64) -> F64:
        """Probability that few cars derail of trains (n, 4)."""
        a, b, c = self.few[:3]
        return expit(a + b * np.log(train[:, 0] / 12.0) + c * np.log(train[:, 1] / 80.0))


@dataclass(frozen=True)
class Data:
    """Reports as arrays: trains (n, 4) as of ``predict.trains.Train``, counts, years."""

    train: F64
    y: F64
    year: NDArray[np.int64]

    def __getitem__(self, at: NDArray) -> Data:
        return Data(self.train[at], self.y[at], self.year[at])


def pile_probability(emulator: Emulator, who: Population, data: Data, normal: F64) -> F64:
    """Probability of each reported count, were it a pile."""
    mean, sd = emulator(data.train[:, None, :], who.constants(normal)[None, :, :])
    y = data.y[:, None]
    top = np.where(y >= data.train[:, 1:2], np.inf, np.log(y + 0.5))
    low = np.where(y <= 1.0, -np.inf, np.log(np.maximum(y - 0.5, 0.1)))
    return (ndtr((top - mean) / sd) - ndtr((low - mean) / sd)).mean(axis=1)


def log_likelihood(pile: F64, who: Population, data: Data) -> float:
    """Sum of the ln probabilities of the reported counts; ``pile``: were they piles."""
    share = who.share_few(data.train)
    p = (1.0 - share) * pile + share * np.exp(log_few(data.y, *np.exp(who.few[3:])))
    return float(np.sum(np.log(np.maximum(p, 1e-8))))


def log_prior(vector: F64) -> float:
    """The prior: means as before any report, ratios of deviations within a factor of about 1.6."""
    n = len(FREE)
    few = (vector[2 * n :] - FEW_PRIOR[:, 0]) / FEW_PRIOR[:, 1]
    return -0.5 * float(
        np.sum(vector[:n] ** 2) + np.sum((vector[n : 2 * n] / 0.5) ** 2) + np.sum(few**2)
    )


def normals(n: int, seed: int = 0) -> F64:
    """``n`` (a power of 2) sets of standard normal numbers, evenly spread (Sobol)."""
    u = qmc.Sobol(len(NAMES), seed=seed).random(n)
    return norm.ppf(np.clip(u, 1e-4, 1.0 - 1e-4))


def fit_population(
    emulator: Emulator, data: Data, draws: int = 64, start: F64 = START
) -> tuple[Population, F64]:
    """The most probable population, and the covariance of its vector (inverse Hessian)."""
    normal = normals(draws)

    def loss(vector: F64) -> float:
        who = Population(vector)
        pile = pile_probability(emulator, who, data, normal)
        return -log_likelihood(pile, who, data) - log_prior(vector)

    found = minimize(loss, start, method="BFGS", options={"gtol": 0.5, "maxiter": 60})
    return Population(found.x), found.hess_inv


def fit_few(emulator: Emulator, who: Population, data: Data, draws: int = 128) -> Population:
    """The same constants with the share and the number of few of other reports."""
    pile = pile_probability(emulator, who, data, normals(draws))
    fixed = who.vector[: 2 * len(FREE)]

    def loss(few: F64) -> float:
        vector = np.concatenate([fixed, few])
        return -log_likelihood(pile, Population(vector), data) - log_prior(vector)

    return Population(np.concatenate([fixed, minimize(loss, who.few, method="BFGS").x]))


def data_of(reports: Sequence[Report]) -> Data:
    """Reports, all with a mass, as arrays."""
    return Data(
        np.array([[t.speed, t.behind, t.mass, t.loaded] for t in map(train_of, reports)]),
        np.array([min(r.derailed, r.behind) for r in reports], dtype=float),
        np.array([r.year for r in reports]),
    )


# Scores -----------------------------------------------------------------------------------------

FOLD = 3
"""Years left out together."""


def pmfs(emulator: Emulator, who: Population, data: Data) -> list[F64]:
    """Predicted distribution of each report."""
    mean, sd = emulator(data.train[:, None, :], who.constants(normals(256, 5))[None, :, :])
    behind, share = data.train[:, 1].astype(int), who.share_few(data.train)
    few = np.exp(who.few[3:])
    return [mixed(pile_pmf(mean[i], sd[i], behind[i]), share[i], *few) for i in range(len(behind))]


@dataclass(frozen=True)
class Ablation:
    """The engine replaced by a regression: piles log-normal about ``exp(x b)``, the same few."""

    b: F64
    sd: float
    few: F64

    @classmethod
    def of(cls, data: Data) -> Ablation:
        """Fit by maximum likelihood."""
        x = covariates(*data.train.T)
        start = np.concatenate(
            [np.linalg.lstsq(x, np.log(data.y), rcond=None)[0], [-1.0], FEW_PRIOR[:, 0]]
        )
        n = x.shape[1]

        def loss(v: F64) -> float:
            return -cls(v[:n], float(np.exp(v[n])), v[n + 1 :])._log(data, x) - log_prior(
                np.concatenate([np.zeros(2 * len(FREE)), v[n + 1 :]])
            )

        v = minimize(loss, start, method="BFGS").x
        return cls(v[:n], float(np.exp(v[n])), v[n + 1 :])

    def _who(self) -> Population:
        return Population(np.concatenate([np.zeros(2 * len(FREE)), self.few]))

    def _log(self, data: Data, x: F64) -> float:
        m, y = x @ self.b, data.y
        top = np.where(y >= data.train[:, 1], np.inf, np.log(y + 0.5))
        low = np.where(y <= 1.0, -np.inf, np.log(np.maximum(y - 0.5, 0.1)))
        pile = ndtr((top - m) / self.sd) - ndtr((low - m) / self.sd)
        return log_likelihood(pile, self._who(), data)

    def pmfs(self, data: Data) -> list[F64]:
        """Predicted distribution of each report."""
        means = covariates(*data.train.T) @ self.b
        share, few, sd = (
            self._who().share_few(data.train),
            np.exp(self.few[3:]),
            np.array([self.sd]),
        )
        return [
            mixed(pile_pmf(means[i : i + 1], sd, int(n)), share[i], *few)
            for i, n in enumerate(data.train[:, 1])
        ]


MODEL, WITHOUT = "this model", "the same, engine replaced by a regression"


def left_out(emulator: Emulator, who: Population, cause: str, data: Data) -> dict[str, list[F64]]:
    """Predictions of each report by fits that did not see its years: way -> distributions.

    For a broken rail the constants are learned anew as well, from the trains with 50 or more
    behind; for other causes the share of few alone.
    """
    ways: dict[str, list[Any]] = {
        w: [None] * len(data.y) for w in (MODEL, WITHOUT, *(WORDS[k] for k in KINDS))
    }
    first = int(data.year.min())
    for fold in sorted(set((data.year - first) // FOLD)):
        out = (data.year - first) // FOLD == fold
        seen, test = data[~out], data[out]
        mine = who
        if cause == "broken_rail":
            mine, _ = fit_population(emulator, seen[seen.train[:, 1] >= 50], start=who.vector)
        mine = fit_few(emulator, mine, seen)
        found = {MODEL: pmfs(emulator, mine, test), WITHOUT: Ablation.of(seen).pmfs(test)}
        x, z = covariates(*seen.train.T), covariates(*test.train.T)
        for kind in KINDS:
            fitted = fit(kind, x, seen.y, seen.train[:, 1])
            found[WORDS[kind]] = [
                fitted.pmf(row, int(t[1])) for row, t in zip(z, test.train, strict=True)
            ]
        for way, p in found.items():
            for i, one in zip(np.flatnonzero(out), p, strict=True):
                ways[way][i] = one
    return ways


def score_row(name: str, predicted: Sequence[F64], y: F64) -> list[str]:
    """A row of a table of scores."""
    return scores.Scores.of(predicted, y.astype(int).tolist()).row(name)


HEADS = ["", "reports", "in 50 % bands", "in 90 % bands", "bias of the mean, %", "CRPS, cars",
         "log score", "error of the median, cars"]  # fmt: skip


def ways_table(ways: dict[str, list[F64]], data: Data, keep: NDArray) -> Table:
    """Scores of all ways over chosen reports."""
    at = np.flatnonzero(keep)
    rows = [score_row(way, [p[i] for i in at], data.y[at]) for way, p in ways.items()]
    return Table(HEADS, rows)


def groups_table(predicted: Sequence[F64], data: Data) -> Table:
    """Scores of this model over classes of speed, cars behind and mass."""
    kmh, behind, mass = data.train[:, 0] * 3.6, data.train[:, 1], data.train[:, 2] / 1e3
    classes = [
        *((f"{a} to {b} km/h", (kmh > a) & (kmh <= b))
          for a, b in ((0, 24), (24, 40), (40, 56), (56, 72), (72, 145))),
        *((f"{a} to {b - 1} cars behind", (behind >= a) & (behind < b))
          for a, b in ((1, 20), (20, 50), (50, 75), (75, 100), (100, 300))),
        *((f"{a} to {b} t a car", (mass > a) & (mass <= b))
          for a, b in ((20, 60), (60, 100), (100, 150))),
    ]  # fmt: skip
    rows = []
    for name, chosen in classes:
        at = np.flatnonzero(chosen)
        if len(at) > 9:
            rows.append(score_row(name, [predicted[i] for i in at], data.y[at]))
    return Table(HEADS, rows)


@styled
def pit_figure(ways: dict[str, list[F64]], data: Data, keep: NDArray) -> Figure:
    """Histograms of the probability integral transforms."""
    page = sheet(7.2, 2.9)
    at = np.flatnonzero(keep)
    for k, way in enumerate((MODEL, WORDS["quantile"], WORDS["negative_binomial"])):
        axes = place(page, 0.6 + 2.25 * k, 0.5, 1.95, 1.75)
        pit = scores.pits([ways[way][i] for i in at], data.y[at].astype(int).tolist())
        heights, _ = np.histogram(pit, np.linspace(0.0, 1.0, 11))
        axes.bar(np.arange(10) / 10.0 + 0.05, heights / len(pit) * 10.0, width=0.09, color=BLUE)
        axes.axhline(1.0, color=INK, lw=1.0)
        axes.set_title(way.replace("zero-truncated ", ""), loc="left", size=9.5, weight="bold")
        axes.set_ylim(0.0, 1.8)
        axes.set_xlabel("PIT (even if calibrated)")
        dress(axes, "y")
    return page


# The shipped set --------------------------------------------------------------------------------

SHIPPED = 1000
"""Draws that are shipped."""


def draws_of(who: Population, covariance: F64, n: int = SHIPPED, seed: int = 0) -> F64:
    """Draws of the constants: populations from their posterior, constants from those."""
    rng = np.random.default_rng(seed)
    values, vectors = np.linalg.eigh(covariance)
    spread = vectors * np.sqrt(np.clip(values, 0.0, 1.0))
    z = normals(1024, seed + 1)[:n]
    k = 2 * len(FREE)
    rows = []
    for i in range(n):
        vector = who.vector.copy()
        vector[:k] += (spread @ rng.standard_normal(len(vector)))[:k]
        draw = to_draw(Population(vector).constants(z[i]))
        rows.append([float(f"{getattr(draw, name):.4g}") for name in NAMES])
    return np.array(rows)


def proposal_of(who: Population) -> dict[str, Any]:
    """What the next runs of the bank are drawn with: about the learned population, wider.

    The deviation is 1.5 times that over accidents and half the way back to the prior; three runs
    of ten are drawn from the prior itself. A regression on runs of the prior alone is worst where
    the learned constants are, in the prior's tail.
    """
    mean = who.constants(np.zeros(len(NAMES)))
    sd = who.constants(np.ones(len(NAMES))) - mean
    wide = np.hypot(1.5 * sd, 0.5 * (mean - PRIOR_MEAN))
    return {"mean": mean.tolist(), "sd": wide.tolist(), "share": 0.3}


def rounded(values: Any) -> Any:
    """Coefficients with five digits."""
    return [rounded(v) if np.ndim(v) else float(f"{v:.5g}") for v in values]


CHECKED = 200
"""Runs of a bank that another engine is compared with."""


def check(options: Options) -> None:
    """Run some of a bank again; an engine with the same counts is noted in the shipped set.

    The same: the mean of the ratio's logarithm within three standard errors or 0.02 of 0, and
    the two-sample test of Kolmogorov and Smirnov not below 1 %.
    """
    from derail_ros.models import source_hash

    if options.results is None:
        raise CommandFailure("--check: name the folder of the bank with --results")
    bank = read_bank(options.results)
    n = min(options.members or CHECKED, len(bank["z"]))
    at = np.random.default_rng(options.seed).permutation(len(bank["z"]))[:n]
    old = bank["out"][at, 0]
    new = np.array([again(bank, i) for i in at])
    ratio = np.log(np.maximum(new, 1.0) / np.maximum(old, 1.0))
    error = float(ratio.std() / np.sqrt(n))
    p = float(ks_2samp(old, new).pvalue)
    note(
        f"research: {n} runs again: mean ln ratio {ratio.mean():+.4f} ± {error:.4f}, its "
        f"deviation {ratio.std():.3f}; Kolmogorov-Smirnov p = {p:.2f}"
    )
    if abs(ratio.mean()) > max(0.02, 3.0 * error) or p < 0.01:
        raise CommandFailure("this engine derails other numbers of cars: make the bank anew")
    path = config_path(*FILE)
    shipped = json.loads(path.read_text(encoding="utf-8"))
    known = shipped["provenance"]
    if source_hash() not in (known["engine"], *known["checked"]):
        known["checked"].append(source_hash())
        path.write_text(as_text(shipped), encoding="utf-8")
    note(f"research: engine {source_hash()[:16]} agrees")


def again(bank: dict[str, NDArray], i: int) -> float:
    """Cars derailed in a run of the bank, by this engine."""
    speed, behind, mass, loaded = map(float, bank["train"][i])
    draw = to_draw(bank["z"][i])
    train = Train(speed, int(behind), mass, loaded)
    simulation = run(partial(train_params, train, draw, int(bank["order"][i])), draw)
    return float(simulation.outcome().cars_derailed)


def write(options: Options) -> None:
    """Learn the constants from a bank and the reports; write the shipped set and the page."""
    if options.check:
        check(options)
        return
    if options.results is None or not options.names:
        raise CommandFailure("name the files of the accident reports, and --results FOLDER")
    text = with_places(options.page, BLOCKS)
    try:
        reports = [r for r in read_reports([Path(n) for n in options.names]) if r.mass_kg]
    except AccidentFileError as error:
        raise CommandFailure(str(error)) from None
    bank = read_bank(options.results)
    emulator = Emulator.of(bank["train"], bank["z"], bank["out"][:, 0])
    sets = {c: data_of([r for r in reports if group_of(r.cause) == c]) for c in CAUSES}
    sets = {c: d if len(d.y) >= 200 else data_of(reports) for c, d in sets.items()}
    rail = sets["broken_rail"]
    note(f"research: {len(bank['z'])} runs; learning")
    who, covariance = fit_population(emulator, rail[rail.train[:, 1] >= 50])
    fitted = {c: fit_few(emulator, who, d) for c, d in sets.items()}
    shipped = {
        "names": list(NAMES),
        "provenance": {
            "command": "python -m research calibration FILES --results BANK",
            "engine": bank_engine(options.results),
            "checked": [],
            "runs": len(bank["z"]),
            "reports": len(reports),
            "years": [int(min(r.year for r in reports)), int(max(r.year for r in reports))],
            "source": SOURCE,
        },
        "few": {
            c: {"odds": rounded(w.few[:3]), "mean": float(f"{np.exp(w.few[3]):.4g}"),
                "dispersion": float(f"{np.exp(w.few[4]):.4g}")}
            for c, w in fitted.items()
        },
        "statistical": {
            c: {k: rounded(fit(k, covariates(*d.train.T), d.y, d.train[:, 1]).coefficients)
                for k in KINDS}
            for c, d in sets.items()
        },
        "emulator": {
            "coefficients": rounded(emulator.coefficients),
            "spread": rounded(emulator.spread),
            "residual": float(f"{emulator.residual:.4g}"),
        },
        "draws": draws_of(who, covariance).tolist(),
    }  # fmt: skip
    path = config_path(*FILE)
    path.parent.mkdir(exist_ok=True)
    path.write_text(as_text(shipped), encoding="utf-8")
    note(f"research: wrote {path}")
    proposal = json.dumps(proposal_of(who))
    (options.results / PROPOSAL).write_text(proposal + "\n", encoding="utf-8")
    blocks, figures = shown(emulator, who, covariance, sets, len(bank["z"]))
    options.write(fill(text, blocks), figures)


BLOCKS = ("about", "constants", "scores", "scores_all", "groups", "causes")


def shown(
    emulator: Emulator, who: Population, covariance: F64, sets: dict[str, Data], runs: int
) -> tuple[dict[str, Any], dict[str, Figure]]:
    """Results and figures of the page."""
    rail = sets["broken_rail"]
    ways = left_out(emulator, who, "broken_rail", rail)
    long = rail.train[:, 1] >= 50
    causes = []
    for c, d in sets.items():
        if c in ("broken_rail", "signal"):
            continue
        note(f"research: scoring {c}")
        one = left_out(emulator, who, c, d)
        every = range(len(d.y))
        for way in (MODEL, WORDS["quantile"], WORDS["negative_binomial"]):
            row = score_row(way, [one[way][i] for i in every], d.y)
            causes.append([f"{CAUSES[c]}: {row[0]}", *row[1:]])
    n = len(FREE)
    sd = np.sqrt(np.clip(np.diag(covariance), 0.0, None))
    constants = []
    for k, name in enumerate(FREE):
        mean, width = PRIOR[name]
        shift, ratio = who.vector[k], np.exp(who.vector[n + k])
        middle, wide, error = mean + shift * width, width * ratio, sd[k] * width
        if name in LOG:
            pairs = ((mean, width), (middle, wide))
            cells = [f"{np.exp(m):.3g} (×÷ {np.exp(w):.2f})" for m, w in pairs]
            cells.append(f"×÷ {np.exp(error):.2f}")
        else:
            cells = [f"{mean:.3g} ± {width:.2g}", f"{middle:.2g} ± {wide:.2g}", f"± {error:.1g}"]
        constants.append([name.replace("_", " "), *cells])
    about = (
        f"<sub>`python -m research calibration FILES --results BANK`: {runs} runs of the engine, "
        f"{len(rail.y)} broken rails, {int(long.sum())} of them with 50 or more behind. "
        f"Regression on the runs: {emulator.residual:.2f} left in the count's logarithm, chaos. "
        f"Years are left out {FOLD} at a time.</sub>"
    )
    blocks = {
        "about": about,
        "constants": Table(
            ["constant", "before", "learned: over accidents", "middle to within"], constants
        ),
        "scores": ways_table(ways, rail, long),
        "scores_all": ways_table(ways, rail, long | True),
        "groups": groups_table(ways[MODEL], rail),
        "causes": Table(HEADS, causes),
    }  # fmt: skip
    return blocks, {"prediction_pit.png": pit_figure(ways, rail, long)}


def as_text(shipped: dict[str, Any]) -> str:
    """JSON with a draw a line."""
    draws = shipped.pop("draws")
    head = json.dumps(shipped, indent=1)
    rows = ",\n".join(json.dumps(row) for row in draws)
    return f'{head[:-2]},\n "draws": [\n{rows}\n]\n}}\n'
