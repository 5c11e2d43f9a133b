"""``derail convergence``: ensembles at several tolerances."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from derail_ros.commands import common
from derail_ros.commands.common import FAILED, OK, CommandFailure, note


def run(
    names: Sequence[str],
    members: int,
    seed: int,
    jobs: int | None,
    tolerances: Sequence[float],
    as_json: bool,
    page: Path | None,
) -> int:
    """Run and report."""
    from derail_ros.studies import convergence as c

    if page is not None and (names or tolerances):
        raise CommandFailure("--write is for the default scenarios and tolerances")
    rtols = sorted(set(tolerances or c.TOLERANCES), reverse=True)
    if len(rtols) < 2:
        raise CommandFailure("--rtol: at least two tolerances are compared")
    for rtol in rtols:
        if not 1e-12 <= rtol <= 0.1:
            raise CommandFailure(f"--rtol: must lie within 1e-12 and 0.1, not {rtol:g}")
    scenarios = [common.load(name) for name in (names or c.SCENARIOS)]
    image = None if page is None else common.image_beside(page, "convergence.png")
    common.warm_up()
    studies = []
    with common.progress(*common.counting_columns()) as bars:
        for scenario in scenarios:
            task = bars.add_task(scenario.name, total=None)

            def show(done: int, total: int, task: Any = task) -> None:
                bars.update(task, completed=done, total=total)

            try:
                studies.append(
                    c.convergence(
                        scenario, members, seed, tolerances=rtols, jobs=jobs, progress=show
                    )
                )
            except RuntimeError as error:
                raise CommandFailure(f"{scenario.name}: {error}", FAILED) from None
    if page is not None and image is not None:
        from derail_ros.review.drawing import save
        from derail_ros.studies.convergence_figure import convergence_figure

        save(convergence_figure(studies, members), image, dpi=common.IMAGE_DPI)
        text = c.markdown(studies, members, seed, common.relative(image, page))
        page.write_text(text, encoding="utf-8")
        note(f"derail: wrote {page} and {image}")
    if as_json:
        values = {"members": members, "seed": seed, "studies": [s.as_dict() for s in studies]}
        common.print_json(values)
    else:
        for study in studies:
            _print(study)
    return OK


def _print(study: Any) -> None:
    from rich.table import Table

    from derail_ros.studies.convergence import MEASURES, median_time

    console = common.out()
    if not console.is_terminal:
        console.width = max(console.width, 150)
    table = Table(box=None, pad_edge=False, title=study.title, title_justify="left")
    for heading in ("rtol", "steps", "parted (s)"):
        table.add_column(heading, justify="right")
    for m in MEASURES:
        table.add_column(f"{m.label} ({m.unit})", justify="right")
    for level in study.all:
        tightest = level is study.levels[-1]
        cells = []
        for m in MEASURES:
            x = level.measures[m.name]
            text = f"{x.mean:.{m.digits}f} ± {x.half:.{m.digits}f}"
            cells.append(text if x.agrees else f"[bold]{text}[/bold]")
        when = "" if tightest else median_time(level.partings)
        table.add_row(level.label, f"{level.steps:.0f}", when, *cells)
    console.print(table)
    console.print(
        "Mean with its 95 % confidence; bold: the difference from the tightest is larger than "
        "the 95 % confidence of that difference.",
        style="dim",
    )
    console.print()
