#!/usr/bin/env python3
"""Run the studies that ship and renew docs/studies.md: their figures, and what they print.

    .ci/studies.py                          # all, as they ship, into runs/study_NAME
    .ci/studies.py -n 10 placement          # some, with fewer runs a point
    .ci/studies.py --results DIR            # from results that are there: DIR/NAME

Finished runs are not repeated. The paragraphs between the results are written by hand: read them
again afterwards.
"""

import argparse
import io
import re
from pathlib import Path

from PIL import Image

from derail_ros import study
from derail_ros.review.drawing import save
from derail_ros.studies import plots
from derail_ros.studies.plan import list_studies
from derail_ros.studies.results import StudyResults

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "studies.md"
FIGURES = {
    "six_variations": ("relative", "ranking"),
    "brake_systems": ("settings",),
    "placement": ("settings",),
    "equal_energy": ("severity_over_energy",),
    "train_length": ("cars_derailed_over_train_length",),
    "break_position": ("cars_derailed_over_car",),
    "sobol_base_train": ("sobol",),
}
DPI = 80
MOST = 4
"""Most sentences a measure."""


def write_figures(results: StudyResults, name: str) -> None:
    """Write the figures of a study as small PNG files of 64 colours."""
    drawn = {d.name: d for d in plots.draw(results)}
    for figure in FIGURES[name]:
        path = ROOT / "docs" / "images" / f"study_{name}_{figure}.png"
        save(drawn[figure].figure, path, dpi=DPI)
        image = Image.open(io.BytesIO(path.read_bytes())).convert("RGB")
        image.quantize(64, dither=Image.Dither.NONE).save(path, optimize=True)


def block(results: StudyResults) -> str:
    """What a study says, as text."""
    manifest = results.manifest
    command = f"derail study {manifest['name']}"
    shipped = study_sizes()[manifest["name"]]
    if manifest["size"] != shipped:
        flag = "--points" if results.study.model.points else "-n"
        number = results.study.model.points or manifest["ensemble"]
        command += f" {flag} {number}"
    lines = [f"$ {command}", f"{manifest['title']}: {manifest['size']}"]
    for heading, sentences in results.findings():
        lines.append(heading)
        lines += [f"- {sentence}" for sentence in sentences[:MOST]]
        if len(sentences) > MOST:
            lines.append(f"- ... and {len(sentences) - MOST} more")
    engine = manifest["software"]["engine_hash"]
    return "```text\n" + "\n".join(lines) + f"\n```\n\n<sub>engine {engine}</sub>"


def study_sizes() -> dict[str, str]:
    """The sizes of the studies as they ship."""
    return {name: size for name, _, size in list_studies()}


def main() -> None:
    """Renew what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", default=sorted(FIGURES))
    parser.add_argument("-n", "--ensemble", type=int)
    parser.add_argument("--results", type=Path)
    options = parser.parse_args()
    text = PAGE.read_text(encoding="utf-8")
    for name in options.names:
        if options.results:
            results = StudyResults(options.results / name)
        else:
            results = study(name, ensemble=options.ensemble)
        write_figures(results, name)
        pattern = rf"(<!-- results: {name} -->\n).*?(<!-- end of results -->)"
        text, found = re.subn(
            pattern,
            lambda match, results=results: f"{match[1]}\n{block(results)}\n\n{match[2]}",
            text,
            flags=re.DOTALL,
        )
        if not found:
            raise SystemExit(f"{PAGE} has no place for the results of {name}")
        PAGE.write_text(text, encoding="utf-8")
        print(name)


if __name__ == "__main__":
    main()
