"""A bank of runs of reported trains, each with its own draw of the uncertain constants.

``python -m research bank FILES --results FOLDER -n RUNS`` adds runs until there are as many.
It can be ended and begun again, and several processes may work in one folder: each takes the
next part that nobody has (``part_00012.npz``, of :data:`PART` runs) and marks it as its own.
A part depends on its number, the reports and the proposal alone. The first runs are drawn from
the prior. ``research calibration`` leaves a proposal in the folder, about which further runs are
drawn: add runs and learn again until the constants stay.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from derail_ros.commands.common import CommandFailure, note
from derail_ros.predict.emulator import LOG, PRIOR
from derail_ros.predict.runs import OUTPUTS, run, summary
from derail_ros.predict.trains import Train, train_params
from derail_ros.scenario.calibrated import NAMES, Draw
from derail_ros.studies.accidents import GROUPS, AccidentFileError, Group, Report, read_reports
from research.pages import Options

PART = 40
"""Runs of a part."""
PROPOSAL = "proposal.json"
"""File in the folder of a bank: what further runs are drawn with."""


def to_draw(z: np.ndarray) -> Draw:
    """The draw of values in the order of :data:`NAMES`, logarithms where :data:`LOG`."""
    values = {n: float(np.exp(x) if n in LOG else x) for n, x in zip(NAMES, z, strict=True)}
    values["contact_even"] = float(values["contact_even"] > 0.0)
    return Draw(**values)


GROUPS_OF = {
    "long": (Group(GROUPS["broken_rail"].causes, behind=50), 0.6),
    "broken_rail": (GROUPS["broken_rail"], 0.18),
    "all": (GROUPS["all"], 0.22),
}
"""Which reports are run: group, share of the runs."""


def train_of(report: Report) -> Train:
    """The train of a report from its first car involved on."""
    assert report.mass_kg is not None
    return Train(
        report.speed_kmh / 3.6, report.behind, report.mass_kg, report.loaded / report.cars
    )


def proposal(folder: Path) -> tuple[np.ndarray, np.ndarray, float]:
    """Means and deviations that constants are drawn with; share of runs from the prior itself."""
    mean = np.array([PRIOR[n][0] for n in NAMES])
    sd = np.array([PRIOR[n][1] for n in NAMES])
    path = folder / PROPOSAL
    if not path.is_file():
        return mean, sd, 1.0
    data = json.loads(path.read_text(encoding="utf-8"))
    return np.array(data["mean"]), np.array(data["sd"]), data["share"]


def compute_part(
    reports: Sequence[Report], folder: Path, number: int, seed: int
) -> dict[str, Any]:
    """The runs of a part."""
    rng = np.random.default_rng([seed, number])
    mean, sd, share = proposal(folder)
    first, wide = proposal(Path(os.devnull))[:2]
    rows: dict[str, list[Any]] = {"report": [], "train": [], "z": [], "out": [], "order": []}
    chosen = {
        name: [i for i, r in enumerate(reports) if r.mass_kg is not None and r in group]
        for name, (group, _) in GROUPS_OF.items()
    }
    shares = np.array([s for _, s in GROUPS_OF.values()])
    for _ in range(PART):
        name = list(chosen)[rng.choice(len(shares), p=shares / shares.sum())]
        i = int(rng.choice(chosen[name]))
        prior = rng.random() < share
        z = rng.normal(first if prior else mean, wide if prior else sd)
        train, order = train_of(reports[i]), int(rng.integers(2**31))
        began = time.process_time()
        try:
            draw = to_draw(z)
            simulation = run(partial(train_params, train, draw, order), draw)
        except Exception as error:  # a run that fails is a run without a result
            note(f"research: part {number}: {error}")
            continue
        kept = summary(simulation, time.process_time() - began)
        for key, value in zip(rows, (i, list(asdict(train).values()), z, kept, order)):
            rows[key].append(value)
    return {key: np.array(value) for key, value in rows.items()}


def read_bank(folder: Path) -> dict[str, np.ndarray]:
    """All runs of a bank, valid ones."""
    parts = [np.load(p) for p in sorted(folder.glob("part_*.npz"))]
    if not parts:
        raise CommandFailure(f"{folder}: holds no runs; make them with `python -m research bank`")
    found = {k: np.concatenate([p[k] for p in parts]) for k in parts[0].files if k != "about"}
    good = found["out"][:, OUTPUTS.index("void")] == 0
    return {k: v[good] for k, v in found.items()}


def bank_engine(folder: Path) -> str:
    """Hash of the engine that made a bank; several are an error."""
    parts = (np.load(p) for p in sorted(folder.glob("part_*.npz")))
    engines = {json.loads(str(part["about"]))["engine"] for part in parts}
    if len(engines) != 1:
        raise CommandFailure(f"{folder}: holds runs of {len(engines)} engines")
    return engines.pop()


def _own(path: Path) -> bool:
    """Take a part: whether nobody else has it."""
    lock = path.with_suffix(".lock")
    if path.exists():
        return False
    try:
        os.close(os.open(lock, os.O_CREAT | os.O_EXCL))
    except FileExistsError:
        return False
    return True


def write(options: Options) -> None:
    """Add runs to the bank of a folder."""
    from derail_ros.models import source_hash

    if not options.names or options.results is None:
        raise CommandFailure("name the files of the accident reports, and --results FOLDER")
    folder = options.results
    folder.mkdir(parents=True, exist_ok=True)
    try:
        reports = read_reports([Path(name) for name in options.names])
    except AccidentFileError as error:
        raise CommandFailure(str(error)) from None
    for number in range(-(-(options.members or 400) // PART)):
        path = folder / f"part_{number:05d}.npz"
        if not _own(path):
            continue
        lock = path.with_suffix(".lock")
        try:
            rows = compute_part(reports, folder, number, options.seed)
            about = json.dumps({"engine": source_hash(), "seed": options.seed})
            with open(path.with_suffix(".tmp"), "wb") as stream:
                np.savez_compressed(stream, about=about, **rows)
            path.with_suffix(".tmp").replace(path)
        finally:
            lock.unlink()
    note(f"research: {len(read_bank(folder)['report'])} runs in {folder}")
