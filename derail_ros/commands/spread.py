"""``derail spread``: distributions of the outcomes of a scenario."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from derail_ros.commands import common
from derail_ros.commands.common import FAILED, OK, CommandFailure, note
from derail_ros.vocabulary.words import count


def run(
    names: Sequence[str],
    settings: Sequence[str],
    members: int,
    seed: int,
    jobs: int | None,
    as_json: bool,
    page: Path | None,
) -> int:
    """Run and report; the exit code tells whether runs failed."""
    from derail_ros.studies import spread as s
    from derail_ros.studies.validation import load_published

    if page is not None and settings:
        raise CommandFailure("--write is for the scenarios as they are, without --set")
    scenarios = [common.load(name, settings) for name in (names or s.DEFAULT)]
    for scenario in scenarios:
        if not scenario.to_params().initiation.lateral_forces:
            raise CommandFailure(
                f"{scenario.name}: has no lateral force (initiation.lateral_force_N), so all "
                "members of the ensemble would be the same"
            )
    if len({scenario.name for scenario in scenarios}) < len(scenarios):
        raise CommandFailure("a scenario is named twice")
    images = []
    if page is not None:
        images = [common.image_beside(page, f"spread_{x.name}.png") for x in scenarios]
    published = load_published()
    common.warm_up()
    spreads = []
    with common.progress(*common.counting_columns()) as bars:
        for scenario in scenarios:
            task = bars.add_task(scenario.name, total=members)
            accident = (
                {}
                if settings
                else s.ACCIDENTS.get(s.SAME_TRAIN.get(scenario.name, scenario.name), {})
            )
            spreads.append(
                s.spread(
                    scenario,
                    members,
                    seed,
                    jobs=jobs,
                    published=s.published_values(scenario.name, scenario.to_params(), published),
                    accident=accident,
                    progress=lambda done, task=task: bars.update(task, completed=done),
                )
            )
    if page is not None:
        from derail_ros.review.drawing import save
        from derail_ros.studies.histograms import histograms

        for one, image in zip(spreads, images, strict=True):
            save(histograms(one), image, dpi=common.IMAGE_DPI)
        places = [common.relative(image, page) for image in images]
        page.write_text(s.markdown(spreads, places), encoding="utf-8")
        note(f"derail: wrote {page} and {', '.join(map(str, images))}")
    if as_json:
        common.print_json({"spreads": [one.as_dict() for one in spreads]})
    else:
        for one in spreads:
            _print(one)
    failed = sum(one.failed for one in spreads)
    if failed:
        errors = sorted({text for one in spreads for text in one.errors})
        note(f"derail: {count(failed, 'run')} failed: {'; '.join(errors)}")
    return FAILED if failed else OK


def _print(one: Any) -> None:
    from rich.table import Table

    from derail_ros.studies.spread import sentence, shown, with_unit

    console = common.out()
    table = Table(box=None, pad_edge=False, title=one.title, title_justify="left")
    table.add_column("", min_width=26)
    for heading in ("mean", "sd", "5 %", "median", "95 %", "two differ by", "published"):
        table.add_column(heading, justify="right")
    table.add_column("accident", justify="right")
    for d in one.distributions.values():
        digits = d.measure.digits
        more = digits + (1 if d.measure.whole else 0)
        table.add_row(
            with_unit(d.measure),
            shown(d.mean, more),
            shown(d.sd, more),
            *(shown(d.quantile(q), digits) for q in (0.05, 0.5, 0.95)),
            shown(d.apart, more),
            "-" if d.published is None else f"{d.published:g}",
            "-" if d.accident is None else f"{d.accident:g}",
        )
    console.print(table)
    console.print(sentence(one))
    console.print()
