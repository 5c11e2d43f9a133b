"""``docs/validation.md``: the comparison with the published runs, and its figures."""

from __future__ import annotations

import math
from collections.abc import Sequence

from derail_ros.commands.common import counting_runs
from derail_ros.review.figures import final_scene
from derail_ros.studies.doubt import DOUBTS
from derail_ros.studies.ensemble import VARIATION
from derail_ros.studies.tables import Table
from derail_ros.studies.validation import (
    CaseResult,
    Validation,
    doubt_table,
    goal_table,
    measure_tables,
    pair_table,
    statement_table,
    validate,
)
from derail_ros.vocabulary.params import ContactParams
from derail_ros.vocabulary.words import capital
from research import mississauga
from research import validation_figures as f
from research.impact import STANDING, STRIKING, impacts, words
from research.pages import Options, document, picture, written_by

FIGURES = (
    ("validation.png", "", "Published values beside the ensembles"),
    ("validation_peaks.png", "Peak force on each car", "Peak force on each car"),
    ("validation_scenes.png", "The pile as it grows", "The scene at 5.7, 5.9, 8.0 and 8.6 s"),
    ("validation_final_scene.png", "The final scene", "The final scene of the Mississauga run"),
)
"""Files of the page's figures, headings within the section on Mississauga, what they show."""

ARGUED = (
    'The paragraph "Goals of the validation: why some are missed" of '
    "[decisions.md](decisions.md#engine) gives the reasons."
)


def write(options: Options) -> None:
    """Run the comparison, write the page and its figures."""
    members = options.members or 20
    options.images()
    with counting_runs("validation") as progress:
        result = validate(members, options.seed, jobs=options.jobs, progress=progress)
    with counting_runs("with the source's numerics") as progress:
        source = validate(
            members, options.seed, numerics="source", jobs=options.jobs, progress=progress
        )
    published = mississauga.load_published_run()
    details = mississauga.details(members, options.seed, jobs=options.jobs, published=published)
    drawn = (
        f.published_against_computed(result),
        f.peaks_by_car(details, published, "Mississauga"),
        f.scene_series(details, published, "Mississauga"),
        final_scene(details.final),
    )
    names = [name for name, *_ in FIGURES]
    options.write(page(result, source), dict(zip(names, drawn, strict=True)))


def pairs_words(results: Sequence[CaseResult]) -> str:
    """In how many cases the ensemble has the published pair of the largest force."""
    known = [r for r in results if r.pair_share is not None]
    if not known:
        return "No pair of cars with the largest force is published."
    found = sum(bool(r.pair_share) for r in known)
    share = sum(r.pair_share or 0.0 for r in known) / len(known)
    return (
        "The ensemble contains the published pair of cars with the largest force in "
        f"{found} of {len(known)} cases, whichever of the two struck; it is the hardest pair in "
        f"{100 * share:.0f} % of the runs."
    )


def statements_words(validation: Validation) -> str:
    """How many statements hold."""
    kept = sum(s.kept for s in validation.statements)
    return (
        f"The text of the source also describes its runs. {kept} of "
        f"{len(validation.statements)} statements hold for the model. Of sides it says only for "
        "which cars model and accident agree, not on which side they lie, so there is nothing to "
        "compare."
    )


def numerics_table(shipped: Validation, source: Validation) -> Table:
    """The goals with the numerics of this project and with those of the source."""
    rows = []
    for ours, theirs in zip(shipped.goals, source.goals, strict=True):
        cells = ["-" if g.value is None else f"{g.value:.2f}" for g in (ours, theirs)]
        rows.append([ours.text, ours.asked, *cells])
    return Table(["measure", "goal", "as shipped", "as the source"], rows, texts=2)


def _doubt_tables(validation: Validation) -> tuple[Table, Table]:
    """What is drawn, and the bands of the peak force."""
    drawn = [[d.label, d.words, d.why] for d in DOUBTS]
    rows = []
    for plain, doubtful in zip(validation.cases, validation.doubtful, strict=True):
        a, b = (r.distributions["peak_force_N"] for r in (plain, doubtful))
        cells = [a.measure.shown(a.published), a.shown_band(), b.shown_band()]
        rows.append([plain.case.title, *cells])
    heads = ["case", "published", "band of chance alone", "constants in doubt too"]
    return Table(["constant", "drawn from", "why"], drawn, texts=3), Table(heads, rows)


def _numerics(validation: Validation, source: Validation) -> list[str | Table]:
    return [
        "With the numerics of the source (`derail validate --numerics source`: RKF45, Baumgarte's "
        "stabilization, breaks and couplings tested at the ends of steps) the same comparison "
        "gives:",
        numerics_table(validation, source),
    ]


def page(validation: Validation, source: Validation | None = None) -> str:
    """The text of the page; ``source`` is the comparison with the numerics of the source."""
    everything = (*validation.cases, *validation.beside)
    missed = [g.text for g in validation.goals if not g.met]
    parts: list[str | Table] = [
        "# Validation: comparison with the published runs",
        written_by("validation"),
        "The model restates that of E. E. Toma, *A Computer Model of a Derailment*, PhD thesis, "
        "Queen's University, 1998. Its published results are single runs. Outcomes are chaotic: "
        "once cars collide, a small change of the force that starts the motion grows until "
        "another car is struck, or one more derails. Each published run is therefore compared "
        f"with an ensemble of {validation.members} runs. The lateral force is varied uniformly "
        f"by up to {100 * VARIATION:g} % (seed {validation.seed}); the first member is the case "
        "itself. The band is that of the 5 % and 95 % quantiles; sd is the standard deviation "
        "of single runs. Void runs (the body that stands for the cars behind reached the break) "
        "are left out. The source's forces scatter by some 8 % themselves, so bands of forces are "
        "widened by that before they are judged.",
        "## Goals",
        "The last column is the value that the scatter of single runs alone would give, if the "
        "published run were one more draw from the ensemble.",
        goal_table(validation),
        *([f"Missed: {'; '.join(missed)}. {ARGUED}"] if missed else []),
        pairs_words(validation.cases),
        *(_numerics(validation, source) if source else ()),
        picture(FIGURES[0][0], FIGURES[0][2]),
    ]
    for table in measure_tables(validation):
        parts += [f"## {capital(table.title)}", table]
    if validation.doubtful:
        drawn, peaks = _doubt_tables(validation)
        parts += [
            "## With the constants in doubt",
            "Some constants and forms of the source are lost. Here each run of an ensemble draws "
            "them too, all at once, uniformly from their possible range (k2 in its "
            "logarithm). The draws are the same for every case. Printed constants are not "
            "drawn.",
            drawn,
            "Published values in the 90 % band:",
            doubt_table(validation),
            "Peak force (MN):",
            peaks,
        ]
    laws = {inside: impacts(ContactParams(inside=inside)) for inside in ("held", "even")}
    rows = [
        [inside, f"{i.speed_kmh:g}", f"{i.peak_force_N / 1e6:.2f}", f"{i.duration_s:.3f}",
         f"{i.depth_m:.2f}",
         "passes through" if math.isnan(i.parting_speed_mps) else f"{i.parting_speed_mps:.2f}"]
        for inside, struck in laws.items()
        for i in struck
    ]  # fmt: skip
    compared = []
    for r in everything:
        changed = ", ".join(f"`{k}={v}`" for k, v in r.case.overrides.items())
        compared.append([r.case.title, f"`{r.case.scenario}`", changed, r.case.source])
    parts += [
        "## Pairs of the largest force",
        "Striking and struck car, and in how many of the runs; the share of runs whose hardest "
        "pair is the published one (whichever struck), and whose hardest pair is two cars apart.",
        pair_table(validation),
    ]
    if validation.statements:
        parts += [
            "## What the source says in words",
            statements_words(validation),
            statement_table(validation),
        ]
    parts += [
        "## Tank car impact tests",
        f"The collision law was derived from tests in which a car of {STRIKING / 1e3:g} t ran "
        f"into standing cars of {STANDING / 1e3:g} t, and then made stiffer. "
        f"{words(laws['held'])} The even law has the same peaks, and lets the hardest blow "
        "through: it is used for the published runs, and nowhere else by default "
        "([model.md](model.md#reconstructed-parts)).",
        Table(
            [
                "inside",
                "speed (km/h)",
                "peak force (MN)",
                "duration (s)",
                "depth (m)",
                "parting speed (m/s)",
            ],
            rows,
        ),
        "## Mississauga in detail",
    ]
    for file, title, text in FIGURES[1:]:
        parts += [f"### {title}", picture(file, text)]
    return document(
        *parts,
        "## What is compared",
        Table(["case", "scenario", "changed", "published as"], compared, texts=4),
        "The case with all 74 cars modelled is shown beside the others and counts in no goal: "
        "the published count of 24 equals the number of cars that were free to derail in that "
        "run.",
    )
