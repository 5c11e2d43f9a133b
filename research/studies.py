"""The results and figures of ``docs/studies.md``: the studies that ship, run and told.

Finished runs are not repeated. The paragraphs between the results are written by hand: read them
again afterwards.
"""

from __future__ import annotations

import io
from pathlib import Path

from PIL import Image

from derail_ros import study
from derail_ros.review.drawing import save
from derail_ros.studies import plots
from derail_ros.studies.design import list_studies
from derail_ros.studies.results import StudyResults
from derail_ros.studies.sentences import findings
from research.pages import Options, fill, with_places

FIGURES = {
    "six_variations": ("relative", "ranking"),
    "brake_systems": ("settings",),
    "placement": ("settings",),
    "equal_energy": ("relative_severity_over_energy",),
    "train_length": ("cars_derailed_over_train_length",),
    "break_position": ("cars_derailed_over_car",),
    "sobol_base_train": ("sobol",),
}
MOST = 4
"""Most sentences a measure."""


def write(options: Options) -> None:
    """Run the studies and fill their places in the page."""
    for name in options.names or sorted(FIGURES):
        text = with_places(options.page, [name])
        if options.results:
            results = StudyResults(options.results / name)
        else:
            results = study(name, ensemble=options.members, jobs=options.jobs)
        write_figures(results, name, options.images())
        options.page.write_text(fill(text, {name: block(results)}), encoding="utf-8")
        print(name)


def write_figures(results: StudyResults, name: str, folder: Path) -> None:
    """Write the figures of a study as small PNG files of 64 colours."""
    drawn = {d.name: d for d in plots.draw(results)}
    for figure in FIGURES[name]:
        path = folder / f"study_{name}_{figure}.png"
        small(Image.open(save(drawn[figure].figure, path, dpi=80)), path, 64)


def small(picture: Image.Image, path: Path, colours: int) -> None:
    """Write a picture as a small file."""
    buffer = io.BytesIO()
    reduced = picture.convert("RGB").quantize(colours, dither=Image.Dither.NONE)
    reduced.save(buffer, format="png", optimize=True)
    path.write_bytes(buffer.getvalue())


def block(results: StudyResults) -> str:
    """What a study says, as text."""
    manifest = results.manifest
    command = f"derail study {manifest['name']}"
    shipped = {name: size for name, _, size in list_studies()}[manifest["name"]]
    if manifest["size"] != shipped:
        points = results.study.model.points
        command += f" --points {points}" if points else f" -n {manifest['ensemble']}"
    lines = [f"$ {command}", f"{manifest['title']}: {manifest['size']}"]
    for heading, sentences in findings(results):
        lines.append(heading)
        lines += [f"- {sentence}" for sentence in sentences[:MOST]]
        if len(sentences) > MOST:
            lines.append(f"- ... and {len(sentences) - MOST} more")
    engine = manifest["software"]["engine_hash"]
    return "```text\n" + "\n".join(lines) + f"\n```\n\n<sub>engine {engine}</sub>"
