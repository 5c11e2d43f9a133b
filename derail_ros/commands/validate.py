"""``derail validate``: ensembles against the published runs."""

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
    settings: Sequence[str],
    as_json: bool,
    page: Path | None,
) -> int:
    """Compare and report; the exit code tells whether runs failed, not whether goals were met."""
    from derail_ros.scenario import parse_set
    from derail_ros.studies import validation as v

    overrides = dict(parse_set(text) for text in settings)
    if page is not None and overrides:
        raise CommandFailure("--write is for the model as it is, without --set")
    folder = None if page is None else common.image_beside(page, v.FIGURES[0][0]).parent
    common.warm_up()
    with common.progress(*common.counting_columns()) as bars:
        task = bars.add_task("validate", total=None)

        def show(done: int, total: int) -> None:
            bars.update(task, completed=done, total=total)

        result = v.validate(members, seed, jobs=jobs, settings=overrides, progress=show)
    if page is not None and folder is not None:
        _draw(result, folder, jobs)
        page.write_text(v.markdown(result, common.relative(folder, page)), encoding="utf-8")
        note(f"derail: wrote {page} and its figures in {folder}")
    if as_json:
        common.print_json(result.as_dict())
    else:
        _print(result)
    failed = sum(c.failed for c in (*result.cases, *result.doubtful, *result.beside))
    if failed:
        errors = {e for c in (*result.cases, *result.doubtful, *result.beside) for e in c.errors}
        note(f"derail: {count(failed, 'run')} failed: {'; '.join(sorted(errors))}")
    return FAILED if failed else OK


def _draw(result: Any, folder: Path, jobs: int | None) -> None:
    """Write the page's figures."""
    from derail_ros.review.drawing import save
    from derail_ros.review.figures import final_scene
    from derail_ros.studies import mississauga
    from derail_ros.studies import validation_figures as f
    from derail_ros.studies.validation import FIGURES

    published = mississauga.load_published_run()
    details = mississauga.details(result.members, result.seed, jobs=jobs, published=published)
    figures = (
        f.published_against_computed(result),
        f.peaks_by_car(details, published, "Mississauga"),
        f.scene_series(details, published, "Mississauga"),
        final_scene(details.final),
    )
    for figure, (name, _, _) in zip(figures, FIGURES, strict=True):
        save(figure, folder / name, dpi=common.IMAGE_DPI)


def _print(result: Any) -> None:
    from rich.table import Table

    from derail_ros.studies.impact import words
    from derail_ros.studies.validation import DIGITS, MEASURES, band, inside, shown, verdict

    console = common.out()
    for name, _, label, _ in MEASURES:
        rows = [
            (r.case.title, r.spreads[name])
            for r in (*result.cases, *result.beside)
            if r.spreads[name].published is not None
        ]
        if not rows:
            continue
        digits = DIGITS[name]
        table = Table(box=None, pad_edge=False, title=label, title_justify="left")
        table.add_column("case", min_width=46)
        for heading in ("published", "mean", "sd", "90 % band"):
            table.add_column(heading, justify="right")
        table.add_column("")
        for title, s in rows:
            table.add_row(
                title,
                shown(s.published, digits),
                shown(s.mean, digits),
                shown(s.sd, digits),
                band(s, digits),
                verdict(s, digits),
            )
        console.print(table)
        console.print()
    table = Table(box=None, pad_edge=False, title="goals", title_justify="left")
    table.add_column("measure", min_width=46)
    for heading in ("cases", "goal", "reached", ""):
        table.add_column(heading, justify="right")
    table.add_column("scatter of single runs", justify="right")
    for g in result.goals:
        sign = ">=" if g.at_least else "<="
        met = "met" if g.met else "[bold]missed[/bold]"
        table.add_row(
            g.text,
            str(g.cases),
            f"{sign} {g.limit:g}",
            shown(g.value, 2),
            met,
            shown(g.scatter, 2),
        )
    console.print(table)
    console.print()
    if result.doubtful:
        table = Table(
            box=None,
            pad_edge=False,
            title="published values in the 90 % band",
            title_justify="left",
        )
        table.add_column("measure", min_width=46)
        table.add_column("with chance alone", justify="right")
        table.add_column("constants in doubt too", justify="right")
        for name, _, label, _ in MEASURES[:5]:
            (a, of), (b, _) = inside(result.cases, name), inside(result.doubtful, name)
            table.add_row(label, f"{a} of {of}", f"{b} of {of}")
        console.print(table)
        console.print()
    console.print(f"Tank car impact tests: {words(result.impacts)}")
