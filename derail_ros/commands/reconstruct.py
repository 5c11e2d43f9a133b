"""``derail reconstruct``: speed, brakes and ground from what is known of an accident."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from derail_ros.commands import common
from derail_ros.commands.common import INTERRUPTED, OK, note
from derail_ros.commands.options import Jobs, Json, Seed, written

if TYPE_CHECKING:
    from derail_ros.predict.reconstruct import Reconstruction

WORDS = {
    "speed_kmh": "speed (km/h)",
    "brake_delay_s": "brakes took hold after (s)",
    "brake_force_factor": "brake force, factor",
    "ground_factor": "ground reaction, factor",
}


def run(
    evidence: Annotated[Path, typer.Argument(help="YAML file of what is known.")],
    draws: Annotated[int, typer.Option("--draws", "-n", min=20, help="Number of runs.")] = 400,
    seed: Seed = 0,
    jobs: Jobs = None,
    as_json: Json = False,
    output: Annotated[
        Path | None, written("Write reconstruction.json and pictures of the likeliest scenes.")
    ] = None,
) -> int:
    """Infer speed, brakes and ground of an accident from its cars derailed, scene and places."""
    from derail_ros.predict.reconstruct import EvidenceError, read_evidence, reconstruct
    from derail_ros.scenario.calibrated import load_calibrated

    with common.refusing(EvidenceError):
        known = read_evidence(evidence)
    if output is not None:
        output = common.output_directory(output)
    with common.refusing(EvidenceError), common.counting_runs("reconstruct") as progress:
        found = reconstruct(
            known, load_calibrated(), draws=draws, seed=seed, jobs=jobs, progress=progress
        )
    report = found.as_dict()
    if output is not None:
        common.write_json(output / "reconstruction.json", report)
        _draw(found, output, 0 if report["interrupted"] else 3)
    if as_json:
        common.print_json("reconstruction", report)
        for said in report["warnings"]:
            note(f"derail: warning: {said}")
    else:
        _print(found, output)
    if report["interrupted"]:
        scenes = "" if output is None else "; there are no likeliest scenes"
        note(f"derail: interrupted after {report['runs']} of {draws} runs{scenes}")
        return INTERRUPTED
    return OK


def _print(found: Reconstruction, output: Path | None) -> None:
    from derail_ros.predict.prediction import BANDS
    from derail_ros.studies.tables import Table

    report = found.as_dict()
    console = common.out()
    for said in report["warnings"]:
        console.print(said, style="bold", markup=False, soft_wrap=True)
    console.print(report["title"], style="bold", markup=False)
    console.print(
        f"{report['runs']} runs with calibrated constants, {report['effective_runs']:.0f} count",
        soft_wrap=True,
    )
    rows = []
    for key, words in WORDS.items():
        for which in ("prior", "posterior"):
            d = report[which][key]
            cells = (f"{d[k]:.3g}" for k in ("mean", *BANDS))
            rows.append([words if which == "prior" else "", which, *cells])
    heads = ["", "", "mean", "5 %", "25 %", "median", "75 %", "95 %"]
    common.print_tables(Table(heads, rows, texts=2))
    if output is not None:
        console.print(f"results in {output}", soft_wrap=True)


def _draw(found: Reconstruction, output: Path, likeliest: int) -> None:
    """The bands, and scenes of so many of the likeliest runs."""
    from derail_ros import models
    from derail_ros.predict.picture import reconstruction_picture
    from derail_ros.predict.trains import on_grade
    from derail_ros.review.drawing import save
    from derail_ros.review.figures import save_outcome
    from derail_ros.review.scene import scene_from_simulation
    from derail_ros.studies.ensemble import advance

    scenes = []
    for rank, i in enumerate(found.likeliest(likeliest), 1):
        draw = found.members[i].draw
        scenario = found.evidence.scenario.with_overrides(
            {"train.speed_kmh": float(found.speeds[i])}
        )
        simulation = models.build(on_grade(scenario.drawn_params(draw), draw))
        outcome = advance(simulation)
        folder = output / f"likeliest_{rank}"
        folder.mkdir()
        about = (
            f"{found.speeds[i]:.0f} km/h, brakes after {draw.delay(found.speeds[i] / 3.6):.1f} s; "
            f"{outcome.cars_derailed} cars, {outcome.scene_length:.0f} x "
            f"{outcome.scene_width:.0f} m"
        )
        title = f"{found.evidence.title}: number {rank} of the likeliest"
        scenes.append(scene_from_simulation(simulation, title, about))
        save_outcome(scenes[-1], outcome, folder)
    save(reconstruction_picture(found, scenes), output / "reconstruction.png")
