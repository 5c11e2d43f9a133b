"""``derail sensitivity``: what the reconstructed constants do."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from derail_ros.commands import common
from derail_ros.commands.common import FAILED, OK, CommandFailure, note
from derail_ros.vocabulary.words import count


def run(
    members: int,
    seed: int,
    jobs: int | None,
    cases: Sequence[str],
    constants: Sequence[str],
    as_json: bool,
    page: Path | None,
) -> int:
    """Vary and report; the exit code tells whether runs failed."""
    from derail_ros.studies import sensitivity as s

    if page is not None and constants:
        raise CommandFailure("--write is for all constants, without --only")
    image = None if page is None else common.image_beside(page, "sensitivity.png")
    try:
        s.choose_cases(s.load_published(), cases)
        s.choose_constants(constants)
    except ValueError as error:
        raise CommandFailure(str(error)) from None
    common.warm_up()
    with common.progress(*common.counting_columns()) as bars:
        task = bars.add_task("sensitivity", total=None)

        def show(done: int, total: int) -> None:
            bars.update(task, completed=done, total=total)

        study = s.sensitivity(
            members, seed, jobs=jobs, cases=cases, constants=constants, progress=show
        )
    if page is not None and image is not None:
        from derail_ros.review.drawing import save
        from derail_ros.studies.tornado import tornado

        save(tornado(study), image, dpi=common.IMAGE_DPI)
        page.write_text(s.markdown(study, common.relative(image, page)), encoding="utf-8")
        note(f"derail: wrote {page} and {image}")
    if as_json:
        common.print_json(study.as_dict())
    else:
        _print(study)
    if study.failed:
        errors = sorted({text for e in study.effects for text in e.errors})
        note(f"derail: {count(study.failed, 'run')} failed: {'; '.join(errors)}")
    return FAILED if study.failed else OK


def _print(study: Any) -> None:
    from rich.table import Table

    from derail_ros.studies.sensitivity import MEASURES, shown, stands_out

    console = common.out()
    if not console.is_terminal:
        console.width = max(console.width, 170)
    floor = study.floor
    table = Table(box=None, pad_edge=False)
    table.add_column("constant", no_wrap=True)
    table.add_column("default", justify="right")
    table.add_column("changed to", justify="right")
    for m in MEASURES:
        table.add_column(f"{m.label} ({m.unit})", justify="right")
    before = None
    for effect in study.effects:
        first, before = effect.constant is not before, effect.constant
        cells = []
        for m in MEASURES:
            d = effect.overall[m.name]
            text = shown(d, m)
            cells.append(f"[bold]{text}[/bold]" if stands_out(d, m, floor) else text)
        table.add_row(
            effect.constant.label if first else "",
            effect.constant.default if first else "",
            effect.change.value,
            *cells,
        )
    console.print(table)
    console.print(
        "Mean change against the default with its standard error; bold: more than two of them "
        "and more than any control.",
        style="dim",
    )
