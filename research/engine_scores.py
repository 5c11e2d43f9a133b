"""Scores by runs of the engine: every draw is a run of the reported train.

``python -m research engine_scores FILES --results BANK -n REPORTS`` predicts broken rails with 50
or more cars behind, one report after the other, and writes the scores beside those of the
regression on the bank for the same reports. The constants of a report are learned without its
years. The order of the reports is spread over the speeds: a part of them is a stratified sample.
What was run is kept in ``BANK/engine_scores.jsonl``, so it can be ended and begun again; ``-n 0``
writes the table of what is there.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from derail_ros.commands.common import CommandFailure, note
from derail_ros.models import engine_hash
from derail_ros.predict import release
from derail_ros.predict.emulator import Emulator
from derail_ros.predict.runs import OUTPUTS, group_of, members, runs_of
from derail_ros.predict.scores import Scores, crps, fair_crps
from derail_ros.predict.statistical import KINDS, WORDS, covariates, fit
from derail_ros.predict.trains import Train
from derail_ros.scenario.calibrated import Calibrated, Few
from derail_ros.studies.accidents import (
    EDGES_MPH,
    KMH_PER_MPH,
    AccidentFileError,
    read_reports,
)
from derail_ros.studies.tables import Table
from research.bank import read_bank
from research.calibration import (
    FOLD,
    HEADS,
    Data,
    Population,
    data_of,
    draws_of,
    fit_few,
    fit_population,
    pmfs,
    score_row,
)
from research.pages import Options, fill, with_places

DRAWS = 20
"""Runs of a report. Few draws do not flatter: PIT and CRPS are those for samples."""

GOLDEN = 0.5 * (5.0**0.5 - 1.0)

CAUSE = "broken_rail"


def order_of(speed: NDArray[np.float64]) -> NDArray[np.int64]:
    """Numbers of reports so that each part from the first on is spread evenly over the speeds."""
    ranked = np.argsort(speed, kind="stable")
    return ranked[np.argsort(np.modf(np.arange(len(speed)) * GOLDEN)[0])]


def folds(data: Data, emulator: Emulator, path: Path) -> dict[int, dict[str, Any]]:
    """First year left out -> constants learned without these years; kept in a file."""
    found = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    first = int(data.year.min())
    long = data.train[:, 1] >= 50
    for fold in range(first, int(data.year.max()) + 1, FOLD):
        if str(fold) in found:
            continue
        note(f"research: learning without {fold} to {fold + FOLD - 1}")
        seen = (data.year < fold) | (data.year >= fold + FOLD)
        who, covariance = fit_population(emulator, data[seen & long])
        who = fit_few(emulator, who, data[seen])
        draws = draws_of(who, covariance, 500)
        found[str(fold)] = {"vector": who.vector.tolist(), "draws": draws.tolist()}
        path.write_text(json.dumps(found), encoding="utf-8")
    return {int(k): v for k, v in found.items()}


def constants_of(fold: dict[str, Any]) -> Calibrated:
    """The learned constants as ``derail predict`` takes them."""
    few = Population(np.array(fold["vector"])).few
    mixture = Few((few[0], few[1], few[2]), float(np.exp(few[3])), float(np.exp(few[4])))
    return Calibrated(tuple(map(tuple, fold["draws"])), {CAUSE: mixture}, {}, {}, {})


def write(options: Options) -> None:
    """Run reports and write the table."""
    if options.results is None or not options.names:
        raise CommandFailure("name the files of the accident reports, and --results BANK")
    text = with_places(options.page, ("scores_engine", "release"))
    try:
        reports = [r for r in read_reports([Path(n) for n in options.names]) if r.mass_kg]
    except AccidentFileError as error:
        raise CommandFailure(str(error)) from None
    data = data_of([r for r in reports if group_of(r.cause) == CAUSE])
    bank = read_bank(options.results)
    emulator = Emulator.of(bank["train"], bank["z"], bank["out"][:, 0])
    learned = folds(data, emulator, options.results / "folds.json")
    year = data.year - (data.year - data.year.min()) % FOLD
    long = np.flatnonzero(data.train[:, 1] >= 50)
    order = long[order_of(data.train[long, 0])]
    path = options.results / "engine_scores.jsonl"
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    done: dict[int, dict[str, Any]] = {row["report"]: row for row in map(json.loads, lines)}
    wanted = len(order) if options.members is None else options.members
    for i in order[:wanted]:
        if int(i) in done:
            continue
        speed, behind, mass, loaded = map(float, data.train[i])
        train = Train(speed, int(behind), mass, loaded)
        constants = constants_of(learned[int(year[i])])
        chosen = members(constants, CAUSE, speed, int(behind), DRAWS, int(i))
        outputs = runs_of(train, chosen, jobs=options.jobs)
        outputs = outputs[np.isfinite(outputs[:, 0])]
        row = {
            "report": int(i),
            "engine": engine_hash(),
            "counts": outputs[:, OUTPUTS.index("derailed")].astype(int).tolist(),
            "releases": {
                f"{rule}_{kind}": float(release.expected(outputs, kind, rule).sum())
                for rule in release.TESTS
                for kind in release.STRENGTH
            },
        }
        with path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")
        done[int(i)] = row
        note(f"research: {len(done)} reports")
    at = np.array(sorted(done), dtype=int)
    if len(at) < 2:
        raise CommandFailure(f"{path}: holds fewer than two reports")
    table, about = table_of(data, emulator, learned, year, at, done)
    releases = release_table(data, done)
    blocks = {"scores_engine": f"{about}\n\n{table.markdown()}", "release": releases}
    options.write(fill(text, blocks), {})
    note(f"{table.markdown()}\n{releases.markdown()}")


RELEASED = (0.05, 0.13, 0.13, 0.19, 0.23, 0.21, 0.34)
RELEASED_ERROR = (0.006, 0.015, 0.016, 0.023, 0.025, 0.039, 0.086)
"""Hazardous cars releasing over those damaged or derailed in the classes of speed ``EDGES_MPH``:
freight trains on main track, all tank designs mixed, and the standard errors."""


def release_table(data: Data, done: dict[int, dict[str, Any]]) -> Table:
    """Share of derailed cars that would release by the impact tests, beside the reports'."""
    rows = []
    for a, b, p, e in zip(EDGES_MPH, EDGES_MPH[1:], RELEASED, RELEASED_ERROR, strict=False):
        mph = {i: data.train[i, 0] * 3.6 / KMH_PER_MPH for i in done}
        chosen = [row for i, row in done.items() if a < mph[i] <= b]
        if len(chosen) < 2:
            continue
        off = sum(sum(row["counts"]) for row in chosen)
        shares = [
            " and ".join(f"{sum(row['releases'][f'{rule}_{kind}'] for row in chosen) / off:.2f}"
                         for kind in release.STRENGTH)
            for rule in release.TESTS
        ]  # fmt: skip
        runs = sum(len(row["counts"]) for row in chosen)
        rows.append([f"{a:.0f} to {b:.0f} mph", str(runs), f"{p:.2f} ± {e:.3f}", *shares])
    heads = [
        "",
        "runs",
        "reports",
        *(f"by {rule}: single, double shell" for rule in release.TESTS),
    ]
    return Table(heads, rows)


def table_of(
    data: Data, emulator: Emulator, learned: dict[int, dict[str, Any]], year: NDArray[np.int64],
    at: NDArray[np.int64], done: dict[int, dict[str, Any]],
) -> tuple[Table, str]:  # fmt: skip
    """Scores of all ways for the reports that were run, and how many there are."""
    ways: dict[str, dict[int, Any]] = {"regression on the bank": {}}
    alone = f"{WORDS['quantile']}, fitted to these long trains alone"
    for fold, one in learned.items():
        seen, test = year != fold, at[year[at] == fold]
        if not len(test):
            continue
        who = Population(np.array(one["vector"]))
        ways["regression on the bank"] |= dict(zip(test, pmfs(emulator, who, data[test])))
        z = covariates(*data.train[test].T)
        long = seen & (data.train[:, 1] >= 50)
        fits = [(WORDS[kind], kind, seen) for kind in KINDS] + [(alone, "quantile", long)]
        for words, kind, chosen in fits:
            x = covariates(*data.train[chosen].T)
            fitted = fit(kind, x, data.y[chosen], data.train[chosen, 1])
            ways.setdefault(words, {}).update(
                {i: fitted.pmf(row, int(data.train[i, 1])) for i, row in zip(test, z)}
            )
    samples = [np.array(done[int(i)]["counts"], dtype=float) for i in at]
    y = data.y[at].astype(int).tolist()
    mine = Scores.of_samples(samples, y)
    own = np.array([fair_crps(x, k) for x, k in zip(samples, y, strict=True)])
    apart = own - np.array([crps(ways[alone][i], k) for i, k in zip(at, y, strict=True)])
    rows = [mine.row("runs of the engine")]
    rows += [score_row(way, [p[i] for i in at], data.y[at]) for way, p in ways.items()]
    runs = sum(map(len, samples))
    engines = sorted({row["engine"][:16] for row in done.values()})
    about = (
        f"<sub>`python -m research engine_scores FILES --results BANK`: {len(at)} of "
        f"{int((data.train[:, 1] >= 50).sum())} reports, spread over the speeds, {runs} runs, "
        f"{DRAWS} a report, with constants learned without its years. Engine "
        f"{', '.join(engines)}. CRPS of the first row less that of the last, report by report: "
        f"{apart.mean():+.3f} ± {apart.std() / np.sqrt(len(at)):.3f} cars.</sub>"
    )
    return Table(HEADS, rows), about
